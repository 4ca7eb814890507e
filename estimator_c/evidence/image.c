// SPDX-License-Identifier: MIT
/// Bare-metal program for a Cortex-M: generate the samples of a realistic run, enter them into a subject, and end the
/// simulation. Instructions in the section .outside are not counted (see cost.py).

#include "plant.h"
#include "subject.h"

#include <stddef.h>

#define OUTSIDE __attribute__((section(".outside"), noinline, used))

#ifndef SAMPLES_N
#define SAMPLES_N 600U
#endif
#define MISSING_SAMPLE 330U
#ifndef LATE_SAMPLE
#define LATE_SAMPLE 381U  ///< first sample after a drifting edge crosses a sampling instant
#endif
#define SOFT_SAMPLE (LATE_SAMPLE + 99U)  ///< first sample of the changed plant

static float u_codes[SAMPLES_N];
static float y_codes[SAMPLES_N];

extern uint32_t stack_top;

OUTSIDE void reset(void);

__attribute__((section(".vectors"), used)) static const void* const vectors[16] = { &stack_top, (const void*)reset };

#ifdef __ARM_FP
OUTSIDE static void enable_fpu(void) {
    *(volatile uint32_t*)0xE000ED88U |= 0xFUL << 20U;  // CPACR
    __asm volatile("dsb\n isb");
}
#endif

/// Generate all samples before the first step: the routines of soft float are counted wherever they are called.
OUTSIDE static void make_samples(void) {
    // edges coincide with sampling instants
    plant_t plant = plant_at_rest(PLANT_FRONT, 1U, 10U * PLANT_TICKS_PER_SAMPLE);
    for (uint32_t k = 0U; k < SAMPLES_N; k++) {
        plant.reads_first = subject_drifts && (k >= LATE_SAMPLE);
        if (k == SOFT_SAMPLE) {
            plant.mechanics = PLANT_FRONT_SOFT;
        }
        const plant_codes_t codes = plant_next(&plant);
        u_codes[k]                = (float)codes.u;
        y_codes[k]                = (float)codes.y;
    }
}

/// End the simulation with SYS_EXIT_EXTENDED of Arm semihosting.
OUTSIDE static void end_simulation(const uint32_t status) {
    const uint32_t           block[2]              = { 0x20026U, status };
    register uint32_t        operation __asm("r0") = 0x20U;
    register const uint32_t* argument __asm("r1")  = block;
    __asm volatile("bkpt 0xab" : : "r"(operation), "r"(argument) : "memory");
    for (;;) {
    }
}

/// End of the last step. Inside the counted sections.
__attribute__((noinline, used)) void after_last_step(void) { __asm volatile(""); }

OUTSIDE void reset(void) {
#ifdef __ARM_FP
    enable_fpu();
#endif
    make_samples();
    subject_begin();
    for (uint32_t k = 0U; k < SAMPLES_N; k++) {
        subject_enter(u_codes[k], y_codes[k], k != MISSING_SAMPLE);
    }
    after_last_step();
    end_simulation(subject_judge());
}

// Functions of the C library that the compiler calls implicitly.

__attribute__((section(".library"), used)) void* memset(void* const to, const int value, const size_t n) {
    for (size_t i = 0U; i < n; i++) {
        ((volatile unsigned char*)to)[i] = (unsigned char)value;
    }
    return to;
}

__attribute__((section(".library"), used)) void* memcpy(void* const to, const void* const from, const size_t n) {
    for (size_t i = 0U; i < n; i++) {
        ((volatile unsigned char*)to)[i] = ((const unsigned char*)from)[i];
    }
    return to;
}
