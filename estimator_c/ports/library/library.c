// SPDX-License-Identifier: MIT

#include "library.h"

/// With LIBRARY_FLAT this file contains the estimator, and the step becomes part of the loop over samples. A call for each sample
/// takes a quarter longer.
#ifdef LIBRARY_FLAT
#include "est.c"
#define FLAT __attribute__((flatten))
#else
#define FLAT
#endif

/// A second loop for processors with AVX: it takes a tenth less time, and its results have the same bits.
#if defined(LIBRARY_FLAT) && !defined(LIBRARY_NARROW) && defined(__x86_64__)
#define WITH_AVX 1
#include <cpuid.h>
#else
#define WITH_AVX 0
#endif

size_t library_size(void) { return sizeof(library_t); }

void library_init(library_t* const self) { self->settings = settings_default(); }

settings_result_t library_set(library_t* const self, const uint8_t key, const float value) {
    return settings_set(&self->settings, key, value);
}

bool library_start(library_t* const self) { return est_init(&self->estimator, &self->settings.estimator); }

static void
keep(const library_t* const self, const size_t k, const est_step_t* const step, const library_out_t* const out) {
    if (out->theta != 0) {
        const uint8_t count = est_theta_count(&self->estimator);
        float         theta[EST_THETA_MAX];
        est_copy_theta(&self->estimator, theta);
        for (uint8_t i = 0U; i < count; i++) {
            out->theta[(k * count) + i] = theta[i];
        }
    }
    if (out->innovation != 0) {
        out->innovation[k] = step->innovation;
    }
    if (out->statistic != 0) {
        out->statistic[k] = step->statistic;
    }
    if (out->status != 0) {
        out->status[k] = (uint8_t)step->status;
    }
    if (out->alarm != 0) {
        out->alarm[k] = step->alarm ? 1U : 0U;
    }
}

/// Enter sample k; return the number of alarms.
static size_t enter(library_t* const           self,
                    const size_t               k,
                    const float                u,
                    const float                y,
                    const uint8_t* const       valid,
                    const library_out_t* const out) {
    const est_sample_t sample = { .u = u, .y = y, .valid = (valid == 0) || (valid[k] != 0U) };
    const est_step_t   step   = est_step(&self->estimator, sample);
    keep(self, k, &step, out);
    return step.alarm ? 1U : 0U;
}

size_t library_run(library_t* const           self,
                   const size_t               n,
                   const float* const         u,
                   const float* const         y,
                   const uint8_t* const       valid,
                   const library_out_t* const out) {
    size_t alarms = 0U;
    for (size_t k = 0U; k < n; k++) {
        alarms += enter(self, k, u[k], y[k], valid, out);
    }
    return alarms;
}

/// The loop of library_run_codes(), which becomes part of each of its callers.
static inline size_t enter_codes(library_t* const           self,
                                 const size_t               n,
                                 const size_t               stride,
                                 const uint16_t* const      u,
                                 const uint16_t* const      y,
                                 const uint8_t* const       valid,
                                 const library_out_t* const out) {
    size_t alarms = 0U;
    for (size_t k = 0U; k < n; k++) {
        alarms += enter(self, k, (float)u[k * stride], (float)y[k * stride], valid, out);
    }
    return alarms;
}

#if WITH_AVX
#define AVX_STATES 6U  // of the registers that the operating system saves: XMM and YMM

/// True if processor and operating system support AVX: Intel 64 Software Developer's Manual, volume 1, section 14.3.
static bool ask_for_avx(void) {
    uint32_t eax;
    uint32_t ebx;
    uint32_t ecx;
    uint32_t edx;
    if ((__get_cpuid(1U, &eax, &ebx, &ecx, &edx) == 0) || ((ecx & bit_OSXSAVE) == 0U) || ((ecx & bit_AVX) == 0U)) {
        return false;
    }
    __asm__("xgetbv" : "=a"(eax), "=d"(edx) : "c"(0U));
    return (eax & AVX_STATES) == AVX_STATES;
}

/// ask_for_avx(), asked once: in a virtual machine the question is slow.
static bool has_avx(void) {
    static int known;
    int        answer = __atomic_load_n(&known, __ATOMIC_RELAXED);
    if (answer == 0) {
        answer = ask_for_avx() ? 1 : -1;
        __atomic_store_n(&known, answer, __ATOMIC_RELAXED);
    }
    return answer > 0;
}

__attribute__((target("avx"))) FLAT static size_t enter_codes_with_avx(library_t* const           self,
                                                                       const size_t               n,
                                                                       const size_t               stride,
                                                                       const uint16_t* const      u,
                                                                       const uint16_t* const      y,
                                                                       const uint8_t* const       valid,
                                                                       const library_out_t* const out) {
    return enter_codes(self, n, stride, u, y, valid, out);
}
#endif

FLAT size_t library_run_codes(library_t* const           self,
                              const size_t               n,
                              const size_t               stride,
                              const uint16_t* const      u,
                              const uint16_t* const      y,
                              const uint8_t* const       valid,
                              const library_out_t* const out) {
#if WITH_AVX
    if (has_avx()) {
        return enter_codes_with_avx(self, n, stride, u, y, valid, out);
    }
#endif
    return enter_codes(self, n, stride, u, y, valid, out);
}

/// Start of the rows of record r in a result; a null pointer remains one.
#define ROWS(result, r, size) ((result) == 0 ? 0 : &(result)[(r) * (size)])

bool library_run_records(library_t* const           self,
                         const size_t               records,
                         const size_t               n,
                         const size_t               stride,
                         const uint16_t* const      u,
                         const uint16_t* const      y,
                         const uint8_t* const       valid,
                         const library_out_t* const out,
                         est_counters_t* const      counters) {
    bool started = true;
    for (size_t r = 0U; started && (r < records); r++) {
        const library_out_t rows = {
            .theta      = ROWS(out->theta, r, n * library_theta_count(self)),
            .innovation = ROWS(out->innovation, r, n),
            .statistic  = ROWS(out->statistic, r, n),
            .status     = ROWS(out->status, r, n),
            .alarm      = ROWS(out->alarm, r, n),
        };
        started = library_start(self);
        if (started) {
            (void)library_run_codes(self, n, stride, &u[r * n * stride], &y[r * n * stride], ROWS(valid, r, n), &rows);
            counters[r] = library_counters(self);
        }
    }
    return started;
}

uint8_t library_theta_count(const library_t* const self) { return est_theta_count(&self->estimator); }

est_counters_t library_counters(const library_t* const self) { return est_counters(&self->estimator); }
