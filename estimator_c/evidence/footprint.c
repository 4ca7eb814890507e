// SPDX-License-Identifier: MIT
/// Call the functions that a typical program calls, so that the linker keeps them and drops the rest. -DFOOTPRINT_ALL
/// adds the rest of the interface, -DFOOTPRINT_ISOLATES isolation, -DFOOTPRINT_WATCHES the watch of the fit.

#include "est.h"
#include "est_fit.h"
#include "est_isolation.h"

#include <stddef.h>

#define OUTSIDE __attribute__((section(".outside"), used))

est_t                 estimator;
static est_config_t   config;
static volatile float sink;

#ifdef FOOTPRINT_ISOLATES
est_isolation_t isolation;
#endif

#ifdef FOOTPRINT_WATCHES
est_fit_watch_t fit;
#endif

OUTSIDE void reset(void) {
    config                    = est_config_default();
    sink                      = est_init(&estimator, &config) ? 1.0F : 0.0F;
    const est_sample_t sample = { .u = sink, .y = sink, .valid = true };
    const est_step_t   step   = est_step(&estimator, sample);
    sink                      = step.statistic + est_theta(&estimator, 0U);
#ifdef FOOTPRINT_ALL
    sink = est_variance(&estimator, 0U) + est_noise_variance(&estimator);
    sink = (float)(est_counters(&estimator).alarms + est_theta_count(&estimator));
    sink = est_invariants_hold(&estimator) ? 1.0F : 0.0F;
#endif
#ifdef FOOTPRINT_ISOLATES
    sink = est_isolation_init(&isolation, &config, 0.0F) ? 1.0F : 0.0F;
    est_isolation_enter(&isolation, &estimator, sample, step);
    (void)est_isolation_work(&isolation);
    sink = est_isolation_diagnosis(&isolation).extent;
#endif
#ifdef FOOTPRINT_WATCHES
    sink = est_fit_init(&fit, &config) ? 1.0F : 0.0F;
    est_fit_enter(&fit, &estimator, step);
    sink = est_fit_misfit(&fit).strength;
#endif
}

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
