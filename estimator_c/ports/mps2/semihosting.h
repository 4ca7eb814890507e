// SPDX-License-Identifier: MIT
/// semihosting: services of a simulator or debugger for its target (Arm semihosting).

#ifndef SEMIHOSTING_H_INCLUDED
#define SEMIHOSTING_H_INCLUDED

#include <stdint.h>

/// Argument of the program on QEMU's command line, a hexadecimal number; 0 if there is none.
uint32_t semihosting_argument(void);

/// Print a line on the standard error of the simulator, and end the simulation with this status.
void semihosting_end(const char* line, uint32_t status);

#endif  // SEMIHOSTING_H_INCLUDED
