#include "est_trigger.h"

#include <float.h>
#include <stddef.h>

/// Thesis 4.4.3. The running mean in the form that needs no sum, so that it cannot grow without bound.
static float mean_between_faults(est_trigger_t* const self, const bool absolute, const float innovation) {
    const float term = absolute ? est_magnitude(innovation) : innovation;
    float* const mean = &self->rival[0];
    *mean             = (self->mean_n == 0U) ? 0.0F : *mean;
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
}

void est_trigger_begin_doubt(est_trigger_t* const self) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_OTHER_READINGS; i++) {
        self->rival[i] = self->statistic;
    }
}

bool est_trigger_end_doubt(est_trigger_t* const self, const est_trigger_config_t* const config) {
    if (self->statistic >= config->ceiling) {
        return true;  // MISRA D4
    }
    if (est_trigger_in_doubt(self)) {
        self->statistic = est_trigger_best_rival(self);
    }
    est_trigger_begin_doubt(self);
    return false;
}

bool est_trigger_settle_late(est_trigger_t* const self) {
    const bool late = self->rival[1] < self->rival[0];
    self->statistic = est_trigger_best_rival(self);
    est_trigger_begin_doubt(self);
    return late;
}

bool est_trigger_in_doubt(const est_trigger_t* const self) {
    return est_trigger_best_rival(self) < self->statistic;
}

float est_trigger_other_statistic(est_trigger_t* const              self,
                                  const est_trigger_config_t* const config,
                                  const float                       innovation,
                                  const float                       weight) {
    if (config->kind == EST_TRIGGER_PREDICTION_ERROR) {
        return est_magnitude(innovation);  // MISRA D4
    }
    if (config->kind == EST_TRIGGER_MEAN_BETWEEN_FAULTS) {
        return mean_between_faults(self, config->absolute, innovation);  // MISRA D4
    }
    return custom(self, config, innovation, EST_CUSUM_GAIN / weight);
}
