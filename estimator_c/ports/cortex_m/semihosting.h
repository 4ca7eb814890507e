/// What a simulator or a debugger does for the processor that it holds: Arm's semihosting.

#ifndef SEMIHOSTING_H_INCLUDED
#define SEMIHOSTING_H_INCLUDED

#include <stdint.h>

/// The word of the command line that QEMU was given for the program, as a hexadecimal number; 0 if there is none.
uint32_t semihosting_argument(void);

/// Prints a line on the simulator's standard error, and ends the simulation with this status.
void semihosting_end(const char* line, uint32_t status);

#endif  // SEMIHOSTING_H_INCLUDED
