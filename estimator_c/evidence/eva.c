/// What Frama-C's Eva analyses: any configuration of one shape (-DNA=2U and so on), then any samples, for ever. Numbers may be
/// anything that a float can hold, NaN and the infinities included. eva.py runs it.

#include "est.h"

#include "__fc_builtin.h"

volatile float any_number;

static bool any_truth(void) { return Frama_C_interval(0, 1) != 0; }

static float own_trigger(void* const context, const float innovation, const float variance, const bool anew) {
    (void)context;
    (void)innovation;
    (void)variance;
    (void)anew;
    return any_number;
}

static est_config_t any_config(void) {
    return (est_config_t){ .na              = NA,
                           .nb              = NB,
                           .nk              = NK,
                           .nc              = NC,
                           .offset          = OFFSET,
                           .noise_estimated = any_truth(),
                           .refresh_n       = (uint16_t)Frama_C_interval(0, UINT16_MAX),
                           .stuck_n         = (uint8_t)Frama_C_interval(0, UINT8_MAX),
                           .idle_n          = (uint16_t)Frama_C_interval(0, UINT16_MAX),
                           .edge_instants   = (est_edge_instants_t)Frama_C_interval(0, 3),
                           .forgetting      = any_number,
                           .random_walk     = any_number,
                           .p0              = any_number,
                           .p0_offset       = any_number,
                           .noise_variance  = any_number,
                           .c               = { any_number, any_number },
                           .edge_codes      = any_number,
                           .code_low        = any_number,
                           .code_high       = any_number,
                           .trigger         = { .kind       = (est_trigger_kind_t)Frama_C_interval(0, 5),
                                                .reset      = (est_reset_t)Frama_C_interval(0, 2),
                                                .absolute   = any_truth(),
                                                .hold_off_n = (uint16_t)Frama_C_interval(0, UINT16_MAX),
                                                .warm_up_n  = (uint16_t)Frama_C_interval(0, UINT16_MAX),
                                                .ceiling    = any_number,
                                                .custom     = own_trigger } };
}

static void read_all(const est_t* const estimator) {
    for (uint8_t i = 0U; i < est_theta_count(estimator); i++) {
        (void)est_theta(estimator, i);
        (void)est_variance(estimator, i);
    }
    (void)est_noise_variance(estimator);
    (void)est_counters(estimator);
    (void)est_invariants_hold(estimator);
}

int main(void) {
    const est_config_t config = any_config();
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
