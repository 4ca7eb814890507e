#include "est_trigger.h"

#include "est_edges.h"
#include "est_shape.h"

#include <float.h>
#include <stddef.h>

/// The likelihood ratio of "the innovation's variance has grown fourfold" is exp(0.375 z^2 - ln 2). Its mean is at most 1
/// for every conditionally 1-sub-Gaussian z, so that by Ville's inequality a sum that restarts at zero passes h at most
/// once in exp(h) samples on average: the ceiling is ln(ARL0) without any asymptotics.
#define CUSUM_GAIN 0.375F
#define CUSUM_DRIFT 0.69314718F

static float magnitude(const float x) { return (x < 0.0F) ? -x : x; }

/// No plant with codes below EST_CODE_LIMIT has such an innovation: theta has overflowed, or is about to.
#define INNOVATION_LIMIT 1.0e15F

/// Where there is none: beyond every ceiling if the innovation is beyond all measure, or is not a number.
static float no_statistic(const float innovation) {
    return (magnitude(innovation) < INNOVATION_LIMIT) ? 0.0F : FLT_MAX;
}

/// Thesis 4.4.3. The running mean in the form that needs no sum, so that it cannot grow without bound.
static float mean_between_faults(est_trigger_t* const self, const bool absolute, const float innovation) {
    const float term = absolute ? magnitude(innovation) : innovation;
    float* const mean = &self->rival[0];
    self->mean_n      = (uint16_t)(self->mean_n + ((self->mean_n < UINT16_MAX) ? 1U : 0U));
    *mean += (term - *mean) / (float)self->mean_n;
    return magnitude(*mean);
}

static float custom(est_trigger_t* const              self,
                    const est_trigger_config_t* const config,
                    const float                       innovation,
                    const float                       variance) {
    const bool anew = self->mean_n == 0U;
    self->mean_n    = 1U;
    return config->custom(config->context, innovation, variance, anew);
}

/// Of the triggers that know nothing of edges; the one that is not named is the caller's.
static float other_statistic(est_trigger_t* const              self,
                             const est_trigger_config_t* const config,
                             const float                       innovation,
                             const float                       precision) {
    switch (config->kind) {
    case EST_TRIGGER_PREDICTION_ERROR:
        return magnitude(innovation);  // MISRA D4
    case EST_TRIGGER_MEAN_BETWEEN_FAULTS:
        return mean_between_faults(self, config->absolute, innovation);  // MISRA D4
    case EST_TRIGGER_NONE:
        return no_statistic(innovation);  // MISRA D4
    case EST_TRIGGER_CUSTOM:
    case EST_TRIGGER_CUSUM:
    default:
        return custom(self, config, innovation, 1.0F / precision);  // MISRA D4
    }
}

/// Not a number if the innovation is none: the comparisons with the ceiling are such that this is an alarm.
EST_OUTLINE float cusum(const float before, const float innovation, const float weight) {
    const float sum = before + ((innovation * innovation * weight) - CUSUM_DRIFT);
    return (sum <= 0.0F) ? 0.0F : sum;
}

/// The statistic of the other reading that explains the innovations better.
EST_OUTLINE float best_rival(const est_trigger_t* const self) {
    return (self->rival[0] < self->rival[1]) ? self->rival[0] : self->rival[1];
}

/// The plant has changed only if no reading of the edges explains the innovations.
static est_finding_t
find_in_doubt(
    est_trigger_t* const self, const float ceiling, const float* const readings, const float weight, const bool expires) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < (EST_READINGS - 1U); i++) {
        self->rival[i] = cusum(self->rival[i], readings[i + 1U], weight);
    }
    if (self->statistic < ceiling) {
        return EST_QUIET;  // MISRA D4
    }
    if (best_rival(self) < ceiling) {
        return expires ? EST_SLIP : EST_QUIET;  // MISRA D4
    }
    return EST_ALARM;
}

bool est_trigger_config_valid(const est_trigger_config_t* const config) {
    const bool known = (config->kind >= EST_TRIGGER_NONE) && (config->kind <= EST_TRIGGER_CUSTOM) &&
                       (EST_WITH_TRIGGERS || (config->kind == EST_TRIGGER_NONE) || (config->kind == EST_TRIGGER_CUSUM)) &&
                       ((config->kind != EST_TRIGGER_CUSTOM) || (config->custom != NULL));
    const bool reset = (config->reset == EST_RESET_COVARIANCE) || (config->reset == EST_RESET_ALL);
    return known && reset && (config->ceiling > 0.0F) && (config->ceiling <= EST_CEILING_LIMIT);
}

void est_trigger_restart(est_trigger_t* const self, const uint16_t quiet_n) {
    self->statistic = 0.0F;
    self->mean_n    = 0U;
    self->quiet_n   = quiet_n;
    est_trigger_begin_doubt(self);
}

est_finding_t est_trigger_end_doubt(est_trigger_t* const self, const est_trigger_config_t* const config) {
    if (self->statistic >= config->ceiling) {
        return EST_SLIP;  // MISRA D4
    }
    if (est_trigger_in_doubt(self)) {
        self->statistic = best_rival(self);
    }
    est_trigger_begin_doubt(self);
    return EST_QUIET;
}

bool est_trigger_settle_late(est_trigger_t* const self) {
    const bool late = self->rival[1] < self->rival[0];
    self->statistic = best_rival(self);
    est_trigger_begin_doubt(self);
    return late;
}

bool est_trigger_in_doubt(const est_trigger_t* const self) {
    return best_rival(self) < self->statistic;
}

est_finding_t est_trigger_step(est_trigger_t* const              self,
                               const est_trigger_config_t* const config,
                               const float                       readings[EST_READINGS],
                               const float                       precision,
                               const uint16_t                    doubt_n) {
    if (self->quiet_n > 0U) {
        self->quiet_n--;
        self->statistic = no_statistic(readings[0]);
    } else if (config->kind == EST_TRIGGER_CUSUM) {
        const float weight = CUSUM_GAIN * precision;
        self->statistic = cusum(self->statistic, readings[0], weight);
        if (EST_WITH_EDGES && (doubt_n > 0U)) {
            return find_in_doubt(self, config->ceiling, readings, weight, doubt_n >= EST_DOUBT_N);  // MISRA D4
        }
    } else if (EST_WITH_TRIGGERS) {
        self->statistic = other_statistic(self, config, readings[0], precision);
    } else {
        // no trigger
    }
    return (self->statistic < config->ceiling) ? EST_QUIET : EST_ALARM;
}
