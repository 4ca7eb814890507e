#include "est_trigger.h"

/// The likelihood ratio of "the innovation's variance has grown fourfold" is exp(0.375 z^2 - ln 2). Its mean is at most 1
/// for every conditionally 1-sub-Gaussian z, so that by Ville's inequality a sum that restarts at zero passes h at most
/// once in exp(h) samples on average: the ceiling is ln(ARL0) without any asymptotics.
#define CUSUM_GAIN 0.375F
#define CUSUM_DRIFT 0.69314718F

static float magnitude(const float x) { return (x < 0.0F) ? -x : x; }

static float prediction_error(const float innovation) { return magnitude(innovation); }

/// Thesis 4.4.3. The running mean in the form that needs no sum, so that it cannot grow without bound.
static float mean_between_faults(est_trigger_t* const self, const bool absolute, const float innovation)
{
    const float term = absolute ? magnitude(innovation) : innovation;
    self->mean_n += (self->mean_n < UINT32_MAX) ? 1U : 0U;
    self->mean += (term - self->mean) / (float)self->mean_n;
    return magnitude(self->mean);
}

static float cusum(const est_trigger_t* const self, const float normalised_square)
{
    const float sum = self->statistic + (CUSUM_GAIN * normalised_square) - CUSUM_DRIFT;
    return (sum > 0.0F) ? sum : 0.0F;
}

bool est_trigger_config_valid(const est_trigger_config_t* const config)
{
    const bool known = (config->kind >= EST_TRIGGER_NONE) && (config->kind <= EST_TRIGGER_CUSUM);
    const bool reset = (config->reset == EST_RESET_COVARIANCE) || (config->reset == EST_RESET_ALL);
    return known && reset && (config->ceiling > 0.0F) && (config->ceiling <= EST_CEILING_LIMIT);
}

void est_trigger_restart(est_trigger_t* const self, const uint32_t quiet_n)
{
    self->statistic = 0.0F;
    self->mean      = 0.0F;
    self->mean_n    = 0U;
    self->quiet_n   = quiet_n;
}

bool est_trigger_step(est_trigger_t* const              self,
                      const est_trigger_config_t* const config,
                      const float                       innovation,
                      const float                       normalised_square)
{
    if (self->quiet_n > 0U) {
        self->quiet_n--;
        return false;
    }
    switch (config->kind) {
    case EST_TRIGGER_PREDICTION_ERROR:
        self->statistic = prediction_error(innovation);
        break;
    case EST_TRIGGER_MEAN_BETWEEN_FAULTS:
        self->statistic = mean_between_faults(self, config->absolute, innovation);
        break;
    case EST_TRIGGER_CUSUM:
        self->statistic = cusum(self, normalised_square);
        break;
    case EST_TRIGGER_NONE:
    default:
        return false;
    }
    return self->statistic >= config->ceiling;
}
