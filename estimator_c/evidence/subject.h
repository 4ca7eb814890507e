// SPDX-License-Identifier: MIT
/// subject: interface of the code that image.c measures. These functions are not counted; those that they call are.

#ifndef SUBJECT_H_INCLUDED
#define SUBJECT_H_INCLUDED

#include <stdbool.h>
#include <stdint.h>

#define SUBJECT __attribute__((section(".outside"), noinline, used))

/// True if the edges of the generator drift across a sampling instant once.
extern const bool subject_drifts;

void subject_begin(void);
void subject_enter(float u, float y, bool valid);

/// Return 0 if everything happened that the run is designed to provoke, else another exit status.
uint32_t subject_judge(void);

#endif  // SUBJECT_H_INCLUDED
