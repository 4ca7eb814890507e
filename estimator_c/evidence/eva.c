// SPDX-License-Identifier: MIT
/// Entry point for Frama-C's Eva: est_config_valid() with any configuration; then any number of any samples with a
/// valid configuration of these orders (-DNA=2U and so on). A float may have any value, including NaN and the
/// infinities. eva.py runs the analysis.

#include "est.h"

volatile float    any_number;
volatile unsigned any_whole_number;

static unsigned any_up_to(const unsigned most) { return any_whole_number % (most + 1U); }

static uint8_t any_byte(void) { return (uint8_t)any_up_to(UINT8_MAX); }

static bool any_truth(void) { return any_up_to(1U) != 0U; }

static float own_trigger(void* const context, const float innovation, const float variance, const bool anew) {
    (void)context;
    (void)innovation;
    (void)variance;
    (void)anew;
    return any_number;
}

static est_config_t any_config(const uint8_t na, const uint8_t nb, const uint8_t nc, const bool offset) {
    return (est_config_t){ .na              = na,
                           .nb              = nb,
                           .nk              = any_byte(),
                           .nc              = nc,
                           .offset          = offset,
                           .noise_estimated = any_truth(),
                           .refresh_n       = (uint16_t)any_up_to(UINT16_MAX),
                           .stuck_n         = any_byte(),
                           .idle_n          = (uint16_t)any_up_to(UINT16_MAX),
                           .edge_instants   = (est_edge_instants_t)any_up_to(3U),
                           .forgetting      = any_number,
                           .random_walk     = any_number,
                           .p0              = any_number,
                           .p0_offset       = any_number,
                           .noise_variance  = any_number,
                           .c               = { any_number, any_number },
                           .edge_codes      = any_number,
                           .code_low        = any_number,
                           .code_high       = any_number,
                           .trigger         = { .kind       = (est_trigger_kind_t)any_up_to(5U),
                                                .reset      = (est_reset_t)any_up_to(2U),
                                                .absolute   = any_truth(),
                                                .hold_off_n = (uint16_t)any_up_to(UINT16_MAX),
                                                .warm_up_n  = (uint16_t)any_up_to(UINT16_MAX),
                                                .ceiling    = any_number,
                                                .custom     = own_trigger } };
}

static void read_all(const est_t* const estimator) {
    for (uint8_t i = 0U; i < est_theta_count(estimator); i++) {
        (void)est_theta(estimator, i);
        (void)est_variance(estimator, i);
    }
    for (uint8_t i = 0U; i < EST_NA_MAX; i++) {
        (void)est_prefilter(estimator, i);
    }
    (void)est_noise_variance(estimator);
    (void)est_counters(estimator);
    (void)est_invariants_hold(estimator);
}

int main(void) {
    const est_config_t whatever = any_config(any_byte(), any_byte(), any_byte(), any_truth());
    (void)est_config_valid(&whatever);
    const est_config_t config = any_config(NA, NB, NC, OFFSET != 0U);
    est_t              estimator;
    if (!est_init(&estimator, &config)) {
        return 1;
    }
    while (any_truth()) {
        const est_sample_t sample = { .u = any_number, .y = any_number, .valid = any_truth() };
        (void)est_step(&estimator, sample);
        read_all(&estimator);
    }
    return 0;
}
