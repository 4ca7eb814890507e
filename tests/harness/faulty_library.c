// SPDX-License-Identifier: MIT
/// An estimator that counts valid samples, and fails as its settings order: with `fault` at the sample `at`.
/// FAULT_AT_LOAD aborts while it is loaded. ABOUT replaces what analogrig_about returns. FLUSH turns off denormals.
#include "analogrig_estimator.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>

enum { NONE, SEGV, ABORT, EXIT_0, STACK, HANG, CLOSE, INPUT, STATE, RECORD, UNDONE, NOT_A_NUMBER, PRINT, NEXT_BYTE };
enum { EXTRA = NEXT_BYTE + 1, FORK, INIT };

typedef struct {
    double   fault, at;
    unsigned n, valid_n;
} faulty_t;

static int init(faulty_t* const self) {
    self->at = 1e9;
    return 0;
}

static int set(faulty_t* const self, const char* const name, const double value) {
    if (strcmp(name, "fault") == 0) {
        self->fault = value;
    } else if (strcmp(name, "at") == 0) {
        self->at = value;
    } else {
        return 1;
    }
    if ((int)self->fault == INIT) {
        abort();
    }
    return (value >= 0.0) ? 0 : 1;
}

static unsigned recurse(volatile unsigned char* const below, const unsigned depth) {
    volatile unsigned char frame[4096];
    frame[0] = *below;
    return (depth == 0U) ? frame[0] : (recurse(frame, depth - 1U) + frame[0]);
}

static void fail(faulty_t* const self, const analogrig_in_t* const in, analogrig_out_t* const out) {
    static volatile unsigned long turns = 0U;
    unsigned char                 byte  = 1U;
    switch ((int)self->fault) {
    case SEGV:
        *(volatile int*)(uintptr_t)self->at = 1;  // nothing is at such addresses
        break;
    case ABORT:
        abort();
    case EXIT_0:
        exit(0);
    case STACK:
        out->alarm = (uint8_t)recurse(&byte, 1000000U);
        break;
    case HANG:
        for (;;) {
            turns = turns + 1U;
        }
    case CLOSE:
        for (int fd = 0; fd < 100; fd++) {
            (void)close(fd);
        }
        break;
    case INPUT:
        ((analogrig_in_t*)(uintptr_t)in)->y = 0.0F;
        break;
    case STATE:
        (void)memset(self, 0, 100000U);
        break;
    case NEXT_BYTE:
        ((volatile char*)self)[sizeof(*self)] = 1;
        break;
    case FORK:
        if (fork() == 0) {
            (void)pause();  // holds all descriptors
        }
        abort();
    case NOT_A_NUMBER:
        out->theta[0] = out->statistic = NAN;
        break;
    case PRINT:
        for (int line = 0; line < 20000; line++) {
            (void)printf("estimator: line %d of many that a library may print\n", line);
        }
        (void)fflush(stdout);
        break;
    default:
        break;
    }
}

static void step(faulty_t* const self, const analogrig_in_t* const in, analogrig_out_t* const out) {
    self->valid_n += (in->valid != 0U) ? 1U : 0U;
    out->theta[0]  = (float)self->valid_n;
    out->theta[1]  = in->y;
    out->statistic = in->u;
    out->alarm     = (self->n % 100U) == 99U;
    if (self->n == (unsigned)self->at) {
        fail(self, in, out);
    }
    self->n++;
}

#ifdef ABOUT
const analogrig_about_t* analogrig_about(void) {
    static const analogrig_about_t about = ABOUT;
    return &about;
}
#define analogrig_about analogrig_other_about
const analogrig_about_t* analogrig_about(void);
#endif

#ifdef FLUSH
__attribute__((constructor)) void flush(void) {
#if defined(__SSE__)
    __builtin_ia32_ldmxcsr(0x9FC0U);
#elif defined(__aarch64__)
    __asm__ volatile("msr fpcr, %0" : : "r"(1UL << 24U));
#endif
}
#else
static void flush(void) {}
#endif

#ifdef FAULT_AT_LOAD
__attribute__((constructor)) static void crash(void) { abort(); }
#endif

#define analogrig_step analogrig_honest_step
void analogrig_step(void* state, size_t n, const analogrig_in_t* in, void* out, size_t stride);
ANALOGRIG_ESTIMATOR_WITH_SETTINGS(faulty_t, init, set, step, "faulty 1.0", 2, ANALOGRIG_STATISTIC);
#undef analogrig_step

/// As above, but some records are wrong as a whole.
#ifndef NO_STEP
void analogrig_step(void* state, size_t n, const analogrig_in_t* in, void* out, size_t stride) {
    const faulty_t* const self  = (const faulty_t*)state;
    const unsigned        first = self->n;
    flush();
    analogrig_honest_step(state, n, in, out, stride);
    if ((self->at >= first) && (self->at < self->n)) {
        analogrig_out_t* const wrong = (analogrig_out_t*)(void*)((char*)out + (((size_t)self->at - first) * stride));
        if ((int)self->fault == UNDONE) {
            wrong->done = 0U;
        } else if ((int)self->fault == RECORD) {
            wrong->theta[2] = 0.0F;
        } else if ((int)self->fault == EXTRA) {
            ((analogrig_out_t*)(void*)((char*)out + (n * stride)))->done = 1U;
        }
    }
}
#endif
