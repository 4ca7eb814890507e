#include "est_trigger.h"

#include <float.h>
#include <stddef.h>

/// No plant with codes below EST_CODE_LIMIT has such an innovation: theta has overflowed, or is about to.
#define INNOVATION_LIMIT 1.0e15F

/// Where there is none: beyond every ceiling if the innovation is beyond all measure, or is not a number.
static float no_statistic(const float innovation) {
    return (est_magnitude(innovation) < INNOVATION_LIMIT) ? 0.0F : FLT_MAX;
}

/// Thesis 4.4.3. The running mean in the form that needs no sum, so that it cannot grow without bound.
static float mean_between_faults(est_trigger_t* const self, const bool absolute, const float innovation) {
    const float term = absolute ? est_magnitude(innovation) : innovation;
    float* const mean = &self->rival[0];
    self->mean_n      = (uint16_t)(self->mean_n + ((self->mean_n < UINT16_MAX) ? 1U : 0U));
    *mean += (term - *mean) / (float)self->mean_n;
    return est_magnitude(*mean);
}

static float custom(est_trigger_t* const              self,
                    const est_trigger_config_t* const config,
                    const float                       innovation,
                    const float                       variance) {
    const bool anew = self->mean_n == 0U;
    self->mean_n    = 1U;
    return config->custom(config->context, innovation, variance, anew);
}

/// The statistic of the other reading that explains the innovations better.
EST_OUTLINE float best_rival(const est_trigger_t* const self) {
    return (self->rival[0] < self->rival[1]) ? self->rival[0] : self->rival[1];
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

bool est_trigger_end_doubt(est_trigger_t* const self, const est_trigger_config_t* const config) {
    if (self->statistic >= config->ceiling) {
        return true;  // MISRA D4
    }
    if (est_trigger_in_doubt(self)) {
        self->statistic = best_rival(self);
    }
    est_trigger_begin_doubt(self);
    return false;
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

/// The plant has changed only if no reading of the edges explains the innovations.
est_finding_t est_trigger_find_in_doubt(est_trigger_t* const self,
                                        const float          ceiling,
                                        const float          readings[EST_OTHER_READINGS],
                                        const float          weight,
                                        const bool           expires) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_OTHER_READINGS; i++) {
        self->rival[i] = est_trigger_sum(self->rival[i], readings[i], weight);
    }
    if (self->statistic < ceiling) {
        return EST_QUIET;  // MISRA D4
    }
    if (best_rival(self) < ceiling) {
        return expires ? EST_SLIP : EST_QUIET;  // MISRA D4
    }
    return EST_ALARM;
}

/// The kind that is not named is the caller's.
float est_trigger_other_statistic(est_trigger_t* const              self,
                                  const est_trigger_config_t* const config,
                                  const float                       innovation,
                                  const float                       precision) {
    if (self->quiet_n > 0U) {
        self->quiet_n--;
        return no_statistic(innovation);  // MISRA D4
    }
    switch (EST_WITH_TRIGGERS ? config->kind : EST_TRIGGER_NONE) {
    case EST_TRIGGER_PREDICTION_ERROR:
        return est_magnitude(innovation);  // MISRA D4
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
