/// What image.c measures. The code of these functions lies outside of what is counted; what they call lies inside.

#ifndef SUBJECT_H_INCLUDED
#define SUBJECT_H_INCLUDED

#include <stdbool.h>
#include <stdint.h>

#define SUBJECT __attribute__((section(".outside"), noinline, used))

/// Whether the generator's edges may drift across a sampling instant: they then do, once.
extern const bool subject_drifts;

void subject_begin(void);
void subject_enter(float u, float y, bool valid);

/// 0 if all has happened that the run is made for; the exit status of the simulator.
uint32_t subject_judge(void);

#endif  // SUBJECT_H_INCLUDED
