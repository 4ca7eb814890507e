// SPDX-License-Identifier: MIT
/// Run the estimator in every configuration on data that are identical everywhere. Print the numbers of steps and
/// events, and a hash of all results. bit_exact.py compares the output between compilers and targets.

#include "est.h"
#include "est_correlation.h"
#include "est_isolation.h"
#include "plant.h"

#include <stdio.h>

#define STEPS_N 120U  ///< in each configuration

/// Steps of each run with isolation; the plant changes in it.
#define ISOLATION_STEPS_N 500U
#define ISOLATION_CHANGE 300U
#define ISOLATION_RUNS_N 36U

#define LONG_RUNS_N 86U  ///< with disturbances

typedef struct {
    uint64_t hash;
    uint32_t steps;
    uint32_t nan_n;
    uint32_t alarms;
    uint32_t slips;
    uint32_t refused;
    uint32_t missing;
    uint32_t refreshes;
    uint32_t diagnoses;
    uint32_t hypotheses;  ///< steps with a second hypothesis
    uint32_t violations;  ///< steps after which est_invariants_hold() failed
} record_t;

/// Hash the four bytes by FNV-1a, lowest first.
static void enter_bits(record_t* const self, const uint32_t bits) {
    for (uint32_t shift = 0U; shift < 32U; shift += 8U) {
        self->hash = (self->hash ^ ((bits >> shift) & 0xFFU)) * 1099511628211U;
    }
}

typedef union {
    float    number;
    uint32_t bits;
} word_t;

/// Hash the bits of a number. The bits of a NaN depend on the target, so it is counted instead; none is expected.
static void enter_number(record_t* const self, const float number) {
    const word_t word = { .number = number };
    if ((word.bits & 0x7FFFFFFFU) > 0x7F800000U) {
        self->nan_n++;
    } else {
        enter_bits(self, word.bits);
    }
}

static float of_bits(const uint32_t bits) {
    const word_t word = { .bits = bits };
    return word.number;
}

/// A custom trigger: the normalised squared innovation, averaged over some ten equations.
static float own_trigger(void* const context, const float innovation, const float variance, const bool anew) {
    float* const mean = context;
    *mean             = anew ? 0.0F : *mean;
    *mean += 0.1F * (((innovation * innovation) / variance) - *mean);
    return *mean;
}

/// Remove the last digit of a number in this base and return it. One number thus encodes a whole configuration.
static uint32_t digit(uint32_t* const number, const uint32_t base) {
    const uint32_t out = *number % base;
    *number /= base;
    return out;
}

static est_trigger_config_t trigger_of(const est_trigger_kind_t kind, uint32_t* const random, float* const context) {
    static const float ceilings[] = { 1.0F, 30.0F, 8.0F, 11.5F, 12.0F };
    return (est_trigger_config_t){ .kind       = kind,
                                   .reset      = (digit(random, 2U) > 0U) ? EST_RESET_ALL : EST_RESET_COVARIANCE,
                                   .absolute   = digit(random, 2U) > 0U,
                                   .hold_off_n = (uint16_t)digit(random, 8U),
                                   .warm_up_n  = (uint16_t)(5U * digit(random, 4U)),
                                   .ceiling    = ceilings[kind],
                                   .custom     = own_trigger,
                                   .context    = context };
}

/// Configuration of this number: every combination of orders, triggers, edge instants and prefilter; other fields at
/// random.
static est_config_t configuration_of(uint32_t number, uint32_t random, float* const context) {
    static const float forgettings[] = { 1.0F, 0.99F, 0.9F, 0.5F };
    static const float walks[]       = { 0.0F, 1.0e-6F, 0.01F };
    est_config_t       config        = est_config_default();
    config.na                        = (uint8_t)(1U + digit(&number, 2U));
    config.nb                        = (uint8_t)(1U + digit(&number, 3U));
    config.nk                        = (uint8_t)digit(&number, 2U);
    config.nc                        = (uint8_t)digit(&number, 3U);
    config.offset                    = digit(&number, 2U) > 0U;
    config.edge_instants             = (est_edge_instants_t)digit(&number, 3U);
    config.trigger                   = trigger_of((est_trigger_kind_t)digit(&number, 5U), &random, context);
    config.forgetting                = forgettings[digit(&random, 4U)];
    config.random_walk               = walks[digit(&random, 3U)];
    config.noise_estimated           = digit(&random, 2U) > 0U;
    config.refresh_n                 = (uint16_t)(10U * digit(&random, 3U));
    config.stuck_n                   = (uint16_t)(6U * digit(&random, 2U));
    config.idle_n                    = (uint16_t)(20U * digit(&random, 2U));
    config.code_low                  = -1000.0F;
    config.code_high                 = 5000.0F;
    const float zero                 = 0.2F * (float)digit(&random, 5U);  // double zero of C
    config.c[0]                      = -zero;
    config.c[1]                      = 0.0F;
    if (config.na == 2U) {
        config.c[0] = -2.0F * zero;
        config.c[1] = zero * zero;
    }
    return config;
}

/// Sample of a card that occasionally delivers nothing, extreme values, or a constant.
static est_sample_t sample_of(plant_t* const plant, const uint32_t k) {
    static const uint32_t nonsense[] = { 0x7FC00000U, 0x7F800000U, 0xFF800000U, 0x45BB8000U,
                                         0x7F7FFFFFU };  // the first is NaN
    const plant_codes_t   codes      = plant_next(plant);
    const uint32_t        chance     = plant_random(plant);
    est_sample_t          sample     = { .u = (float)codes.u, .y = (float)codes.y, .valid = (chance % 64U) != 0U };
    if ((chance % 64U) == 1U) {
        const float absurd = of_bits(nonsense[(chance / 64U) % 5U]);
        if ((chance / 512U) > 63U) {
            sample.u = absurd;
        } else {
            sample.y = absurd;
        }
    }
    if ((k >= 85U) && (k < 97U)) {
        sample.y = 1234.0F;
    }
    return sample;
}

static void enter_outcome(record_t* const self, const est_step_t step) {
    enter_bits(self, (uint32_t)step.status | (step.alarm ? 16U : 0U) | (step.idle ? 32U : 0U));
    enter_number(self, step.innovation);
    enter_number(self, step.statistic);
    self->steps++;
}

static void enter_theta(record_t* const self, const est_t* const estimator) {
    for (uint8_t i = 0U; i < est_theta_count(estimator); i++) {
        enter_number(self, est_theta(estimator, i));
    }
    self->violations += est_invariants_hold(estimator) ? 0U : 1U;
}

static void enter_end(record_t* const self, const est_t* const estimator) {
    const est_counters_t c     = est_counters(estimator);
    const uint32_t       all[] = { c.updated, c.missing,  c.refused, c.saturated, c.stuck,
                                   c.alarms,  c.restarts, c.slips,   c.refreshes };
    for (uint32_t i = 0U; i < (sizeof(all) / sizeof(all[0])); i++) {
        enter_bits(self, all[i]);
    }
    for (uint8_t i = 0U; i < est_theta_count(estimator); i++) {
        enter_number(self, est_variance(estimator, i));
    }
    enter_number(self, est_noise_variance(estimator));
    self->missing += c.missing;
    self->refused += c.refused;
    self->alarms += c.alarms;
    self->slips += c.slips;
    self->refreshes += c.refreshes;
}

/// Plant whose edges come at sampling instants, drift across them, or come anywhere.
static plant_t plant_of(const est_edge_instants_t edge_instants, const uint32_t seed) {
    plant_t plant           = plant_at_rest(PLANT_FRONT, seed, 5U * PLANT_TICKS_PER_SAMPLE);
    plant.half_period_ticks = 10U * PLANT_TICKS_PER_SAMPLE;
    if (edge_instants == EST_EDGES_ANYWHERE) {
        plant.half_period_ticks += 5U;
    }
    return plant;
}

static bool run(record_t* const self, const uint32_t number) {
    plant_t seeds = { .random = number };
    (void)plant_random(&seeds);
    const uint32_t     random  = (plant_random(&seeds) << 16U) | plant_random(&seeds);
    float              context = 0.0F;
    const est_config_t config  = configuration_of(number, random, &context);
    plant_t            plant   = plant_of(config.edge_instants, number);
    est_t              estimator;
    if (!est_init(&estimator, &config)) {
        return false;
    }
    for (uint32_t k = 0U; k < STEPS_N; k++) {
        if (k == 60U) {
            plant.mechanics = PLANT_FRONT_SOFT;
        }
        plant.reads_first = (config.edge_instants == EST_EDGES_MAY_SLIP) && ((k % 40U) >= 20U);
        enter_outcome(self, est_step(&estimator, sample_of(&plant, k)));
        if ((k % 4U) == 0U) {
            enter_theta(self, &estimator);
        }
    }
    enter_end(self, &estimator);
    return true;
}

/// Disturbance of the displacement: noise(k) = (last noise(k-1) + before noise(k-2)) / 1024 + gain white(k) / 16. The
/// gain grows from `gain` to `gain_end` within `period` samples; then it starts again, with a jump of the noise.
typedef struct {
    int32_t last;
    int32_t before;
    int32_t gain;
    int32_t gain_end;
    int32_t jump;  ///< [codes]
    int32_t period;
    int64_t noise[2];  ///< newest first, in the unit of the plant
} disturbance_t;

/// Return the next value [codes].
static int32_t disturb(disturbance_t* const self, plant_t* const plant, const uint32_t k) {
    const int32_t phase = (int32_t)k % self->period;
    const int32_t gain  = self->gain + (((self->gain_end - self->gain) * phase) / self->period);
    const int64_t past  = ((self->last * self->noise[0]) + (self->before * self->noise[1])) / 1024;
    self->noise[1]      = self->noise[0];
    self->noise[0] =
        past + ((gain * plant_noise(plant)) / 16) + ((phase == 0) ? (self->jump * (int64_t)PLANT_UNIT) : 0);
    return (int32_t)(self->noise[0] / PLANT_UNIT);
}

/// Circumstances of a run with disturbances.
typedef struct {
    float    noise_variance;
    bool     noise_estimated;
    float    ceiling;
    uint32_t edge_every;    ///< samples
    uint32_t change_every;  ///< samples
    int32_t  change;        ///< of the stiffness [1/64]
    uint32_t steps_n;
} circumstances_t;

/// Model of a run with disturbances: as the plant is, with or without doubtful edges, or of order 1.
static est_config_t long_configuration_of(const uint32_t model, const circumstances_t* const circumstances) {
    est_config_t config = est_config_default();
    if (model > 0U) {
        config.nb            = 2U;
        config.nk            = 1U;
        config.offset        = false;
        config.edge_instants = EST_EDGES_LOCKED;
    }
    if (model > 1U) {
        config.na   = 1U;
        config.nb   = 1U;
        config.c[0] = -0.8F;
        config.c[1] = 0.0F;
    }
    config.noise_variance  = circumstances->noise_variance;
    config.noise_estimated = circumstances->noise_estimated;
    config.trigger.ceiling = circumstances->ceiling;
    return config;
}

/// Run with the usual trigger, disturbances, changes of the plant and gaps: these determine the scale of the innovations
/// and their correlation. Every disturbance with every model in the first four circumstances. The others, whose steps
/// are many, have coloured noise of varying variance.
static bool run_long(record_t* const self, const uint32_t run_number) {
    static const disturbance_t disturbances[] = {
        { .period = 1 },                                           // none
        { .last = 922, .gain = 16, .gain_end = 16, .period = 1 },  // correlation 0.9
        { .last = -870, .gain = 24, .gain_end = 24, .period = 1 },
        { .last = 614, .before = -410, .gain = 32, .gain_end = 32, .period = 1 },
        { .gain_end = 96, .period = 256 },
        { .last = 922, .gain_end = 48, .period = 1024 },
        { .last = 819, .jump = 1000, .period = 97 },  // decays between jumps
    };
    static const circumstances_t circumstances[] = {
        { 1.2F, true, 11.5F, 50U, 700U, -16, 1600U }, { 30.0F, true, 11.5F, 300U, 500U, -16, 1600U },
        { 1.2F, true, 4.0F, 50U, 150U, 4, 1600U },    { 1.0e-6F, false, 11.5F, 50U, 700U, -16, 1600U },
        { 1.2F, true, 11.5F, 50U, 1032U, -2, 9000U }, { 1.2F, true, 11.5F, 50U, 1038U, -2, 9000U },
    };
    uint32_t                number      = (run_number < 84U) ? run_number : (89U + (21U * (run_number - 84U)));
    const plant_mechanics_t front       = PLANT_FRONT;
    plant_t                 plant       = plant_at_rest(front, number, 5U * PLANT_TICKS_PER_SAMPLE);
    const uint32_t          warm_up_n   = 300U + number;
    disturbance_t           disturbance = disturbances[digit(&number, 7U)];
    const uint32_t          model       = digit(&number, 3U);
    const circumstances_t*  around      = &circumstances[number];
    est_config_t            config      = long_configuration_of(model, around);
    uint32_t                gap_n       = 0U;
    est_t                   estimator;
    config.trigger.warm_up_n = (uint16_t)warm_up_n;
    plant.half_period_ticks  = around->edge_every * PLANT_TICKS_PER_SAMPLE;
    if (!est_init(&estimator, &config)) {
        return false;
    }
    for (uint32_t k = 0U; k < around->steps_n; k++) {
        if ((k % around->change_every) == 99U) {
            const bool back           = plant.mechanics.stiffness != front.stiffness;
            plant.mechanics.stiffness = back ? front.stiffness : ((front.stiffness / 64) * (64 + around->change));
        }
        const plant_codes_t codes = plant_next(&plant);
        const int32_t       y     = codes.y + disturb(&disturbance, &plant, k);
        gap_n                     = ((k % 450U) == 449U) ? (3U * ((k / 450U) % 4U)) : gap_n - ((gap_n > 0U) ? 1U : 0U);
        enter_outcome(self, est_step(&estimator, (est_sample_t){ (float)codes.u, (float)y, gap_n == 0U }));
        enter_number(self, est_scale(&estimator));
        if ((k % 16U) == 0U) {
            enter_theta(self, &estimator);
            enter_bits(self, estimator.scale.high_n);
            enter_number(self, est_scale_validates(&estimator.scale) ? estimator.scale.gained : estimator.scale.sum);
            enter_number(self, estimator.correlation.partial[0]);
            enter_number(self, estimator.correlation.partial[1]);
        }
        self->hypotheses += est_correlation_coloured(&estimator.correlation) ? 1U : 0U;
    }
    enter_end(self, &estimator);
    return true;
}

static void enter_diagnosis(record_t* const self, const est_diagnosis_t diagnosis) {
    enter_bits(self, (uint32_t)diagnosis.change | ((uint32_t)diagnosis.samples_n << 8U));
    enter_bits(self,
               diagnosis.onset_n | ((uint32_t)diagnosis.onset_low_n << 8U) | ((uint32_t)diagnosis.onset_high_n << 16U));
    enter_number(self, diagnosis.extent);
}

/// Run isolation: four parameters with locked edges or six with edges that may slip; a change of M, B, K or two of
/// them.
static bool run_isolation(record_t* const self, uint32_t number) {
    const plant_mechanics_t front     = PLANT_FRONT;
    const plant_mechanics_t changed[] = { PLANT_FRONT_SOFT,
                                          { front.stiffness, front.damping * 3 / 2, front.drive },
                                          { front.stiffness * 5 / 4, front.damping * 5 / 4, front.drive * 5 / 4 },
                                          { front.stiffness * 3 / 2, front.damping * 2 / 3, front.drive } };
    est_config_t            config    = est_config_default();
    plant_t                 plant     = plant_at_rest(PLANT_FRONT, number, 5U * PLANT_TICKS_PER_SAMPLE);
    const uint32_t          change    = digit(&number, 4U);
    config.edge_instants              = (est_edge_instants_t)digit(&number, 2U);
    config.trigger.warm_up_n          = 150U;
    if (config.edge_instants == EST_EDGES_LOCKED) {
        config.nb     = 2U;
        config.nk     = 1U;
        config.offset = false;
    } else {
        plant.edge_tick += 5U;
    }
    est_t           estimator;
    est_isolation_t isolation;
    if (!est_init(&estimator, &config) || !est_isolation_init(&isolation, &config, 0.0F)) {
        return false;
    }
    for (uint32_t k = 0U; k < ISOLATION_STEPS_N; k++) {
        if (k == ISOLATION_CHANGE) {
            plant.mechanics = changed[change];
        }
        const plant_codes_t codes  = plant_next(&plant);
        const est_sample_t  sample = { .u = (float)codes.u, .y = (float)codes.y, .valid = true };
        est_isolation_enter(&isolation, &estimator, sample, est_step(&estimator, sample));
        while (est_isolation_work(&isolation)) {
        }
        enter_diagnosis(self, est_isolation_diagnosis(&isolation));
    }
    self->diagnoses += (est_isolation_diagnosis(&isolation).change != EST_CHANGE_UNDECIDED) ? 1U : 0U;
    return true;
}

int main(void) {
    record_t record = { .hash = 14695981039346656037U };
    for (uint32_t number = 0U; number < (2U * 3U * 2U * 3U * 2U * 3U * 5U); number++) {
        if (!run(&record, number)) {
            (void)printf("configuration %lu was refused\n", (unsigned long)number);
            return 1;
        }
    }
    for (uint32_t number = 0U; number < LONG_RUNS_N; number++) {
        if (!run_long(&record, number)) {
            (void)printf("configuration %lu with disturbances was refused\n", (unsigned long)number);
            return 1;
        }
    }
    for (uint32_t number = 0U; number < ISOLATION_RUNS_N; number++) {
        if (!run_isolation(&record, number)) {
            (void)printf("configuration %lu with isolation was refused\n", (unsigned long)number);
            return 1;
        }
    }
    (void)printf(
        "steps %lu nan %lu violations %lu alarms %lu slips %lu refused %lu missing %lu refreshes %lu diagnoses %lu "
        "hypotheses %lu hash %08lx%08lx\n",
        (unsigned long)record.steps, (unsigned long)record.nan_n, (unsigned long)record.violations,
        (unsigned long)record.alarms, (unsigned long)record.slips, (unsigned long)record.refused,
        (unsigned long)record.missing, (unsigned long)record.refreshes, (unsigned long)record.diagnoses,
        (unsigned long)record.hypotheses, (unsigned long)(record.hash >> 32U),
        (unsigned long)(record.hash & 0xFFFFFFFFU));
    return 0;
}
