// SPDX-License-Identifier: MIT
/// libFuzzer target for the public API of core, isolation and fit: any configuration, any samples, any number of slices of
/// work. The invariants must hold after every step, and the sanitizers must find nothing. `make fuzz` builds and runs
/// it.

#include "est.h"
#include "est_fit.h"
#include "est_isolation.h"

#include <stddef.h>
#include <stdlib.h>
#include <string.h>

typedef struct {
    const uint8_t* bytes;
    size_t         n;
} input_t;

static uint32_t word(input_t* const input) {
    uint32_t value = 0U;
    for (size_t i = 0U; i < sizeof(value); i++) {
        value <<= 8U;
        if (input->n > 0U) {
            value |= *input->bytes++;
            input->n--;
        }
    }
    return value;
}

static uint8_t byte(input_t* const input) {
    if (input->n == 0U) {
        return 0U;
    }
    input->n--;
    return *input->bytes++;
}

/// Return a number: any bit pattern, or a code, with equal probability.
static float number(input_t* const input) {
    const uint8_t kind = byte(input);
    if ((kind & 1U) != 0U) {
        const uint32_t bits = word(input);
        float          value;
        memcpy(&value, &bits, sizeof(value));
        return value;
    }
    return (float)((int32_t)(word(input) >> 20U) - ((kind & 2U) != 0U ? 2048 : 0)) /
           ((kind & 4U) != 0U ? 1024.0F : 1.0F);
}

static float trigger(void* const context, const float innovation, const float variance, const bool anew) {
    (void)context;
    return (anew || !(variance > 0.0F)) ? 0.0F : ((innovation * innovation) / variance);
}

/// Return a configuration. Most values are defaults, otherwise almost no configuration would be valid.
static est_config_t configuration(input_t* const input) {
    est_config_t config       = est_config_default();
    config.na                 = (uint8_t)(byte(input) % (EST_NA_MAX + 2U));
    config.nb                 = (uint8_t)(byte(input) % (EST_NB_MAX + 2U));
    config.nk                 = (uint8_t)(byte(input) % (EST_NK_MAX + 2U));
    config.nc                 = (uint8_t)(byte(input) % (EST_NC_MAX + 2U));
    const uint8_t flags       = byte(input);
    config.offset             = (flags & 1U) != 0U;
    config.noise_estimated    = (flags & 2U) != 0U;
    config.trigger.absolute   = (flags & 4U) != 0U;
    config.trigger.reset      = ((flags & 8U) != 0U) ? EST_RESET_ALL : EST_RESET_COVARIANCE;
    config.trigger.custom     = ((flags & 16U) != 0U) ? trigger : 0;
    config.refresh_n          = byte(input);
    config.stuck_n            = byte(input);
    config.idle_n             = byte(input);
    config.trigger.hold_off_n = byte(input);
    config.trigger.warm_up_n  = byte(input);
    config.trigger.kind       = (est_trigger_kind_t)(byte(input) % 6U);
    config.edge_instants      = (est_edge_instants_t)(byte(input) % 4U);
    float* const values[]     = {
            &config.forgetting,        &config.random_walk, &config.p0,       &config.p0_offset, &config.c[0],
            &config.noise_variance,    &config.edge_codes,  &config.code_low, &config.code_high, &config.trigger.ceiling,
            &config.c[EST_NA_MAX - 1U]
    };
    const uint32_t changed = word(input);
    for (size_t i = 0U; i < (sizeof(values) / sizeof(values[0])); i++) {
        if (((changed >> i) & 1U) != 0U) {
            *values[i] = number(input);
        }
    }
    return config;
}

static void expect(const bool holds) {
    if (!holds) {
        abort();
    }
}

static bool number_is_finite(const float x) { return (x - x) == 0.0F; }

/// Largest distance of an onset from the last alarm: the earliest onset that is tried, and the samples in which further
/// alarms belong to the same diagnosis.
#define ONSET_MAX_N (20U + 99U)

/// Enter a step into the isolation, and call est_isolation_work() this many times, whatever it returns.
static void isolate(est_isolation_t* const isolation,
                    const est_t* const     estimator,
                    const est_sample_t     sample,
                    const est_step_t       step,
                    const uint8_t          slices) {
    est_isolation_enter(isolation, estimator, sample, step);
    for (uint8_t i = 0U; i < slices; i++) {
        (void)est_isolation_work(isolation);
    }
    const est_diagnosis_t diagnosis = est_isolation_diagnosis(isolation);
    expect(number_is_finite(diagnosis.extent) && (diagnosis.change <= EST_CHANGE_DISPLACEMENT_NOISE));
    expect((diagnosis.onset_low_n <= diagnosis.onset_n) && (diagnosis.onset_n <= diagnosis.onset_high_n));
    expect(diagnosis.onset_high_n <= ONSET_MAX_N);
}

/// Enter a step into the watch of the fit.
static void watch(est_fit_watch_t* const fit, const est_t* const estimator, const est_step_t step) {
    est_fit_enter(fit, estimator, step);
    const est_misfit_t misfit = est_fit_misfit(fit);
    expect((misfit.kind <= EST_MISFIT_EXCITATION) && (misfit.strength >= 0.0F));
    expect((misfit.frequency >= 0.0F) && (misfit.frequency <= (0.5F / (float)EST_FIT_SUM_N)));
    expect((misfit.kind == EST_MISFIT_NONE) == (misfit.strength < 1.0F));
}

int LLVMFuzzerTestOneInput(const uint8_t* const data, const size_t size) {
    input_t            input  = { .bytes = data, .n = size };
    const est_config_t config = configuration(&input);
    est_t              estimator;
    if (!est_init(&estimator, &config)) {
        return 0;
    }
    expect(est_config_valid(&config) && est_invariants_hold(&estimator));
    est_isolation_t isolation;
    const bool      isolates = est_isolation_init(&isolation, &config, (float)byte(&input));
    const uint8_t   slices   = (uint8_t)(byte(&input) % 32U);
    est_fit_watch_t fit;
    const bool      watches = est_fit_init(&fit, &config);
    while (input.n > 0U) {
        const uint8_t repeats = (uint8_t)(1U + (byte(&input) % 32U));
        const bool    valid   = (byte(&input) % 16U) != 0U;
        const float   u       = number(&input);
        const float   y       = number(&input);
        const float   drift   = number(&input);
        for (uint8_t i = 0U; i < repeats; i++) {
            const est_sample_t sample = { .u = u, .y = y + (drift * (float)i), .valid = valid };
            const est_step_t   step   = est_step(&estimator, sample);
            expect(est_invariants_hold(&estimator));
            expect(number_is_finite(step.innovation) && number_is_finite(step.statistic));
            if (isolates) {
                isolate(&isolation, &estimator, sample, step, slices);
            }
            if (watches) {
                watch(&fit, &estimator, step);
            }
        }
    }
    for (uint8_t i = 0U; i < est_theta_count(&estimator); i++) {
        expect(number_is_finite(est_theta(&estimator, i)) && (est_variance(&estimator, i) >= 0.0F));
    }
    expect(est_noise_variance(&estimator) > 0.0F);
    (void)est_counters(&estimator);
    return 0;
}
