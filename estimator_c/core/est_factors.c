#include "est_factors.h"

#include "est_orders.h"

/// Certain beyond the precision of float32 by any measure of the data.
#define VARIANCE_NEGLIGIBLE 1.0e-30F

static float prior_of(const est_config_t* const config, const uint8_t count, const uint8_t j) {
    return (((j + 1U) == count) && OFFSET(config)) ? config->p0_offset : config->p0;
}

static float limited(const float d, const float upper) {
    const float positive = d + VARIANCE_NEGLIGIBLE;
    return (positive < upper) ? positive : upper;
}

void est_factors_reset(est_factors_t* const self, const est_config_t* const config) {
    const uint8_t count  = PARAMETERS(config);
    float*        column = self->upper;
    for (uint8_t j = 0U; j < count; j++) {
        self->d[j] = prior_of(config, count, j);
        for (uint8_t i = 0U; i < j; i++) {
            *column++ = 0.0F;
        }
    }
}

EST_INLINE float measure(est_factors_t* const        self,
                         const est_config_t* const   config,
                         const est_equation_t* const equation,
                         float* const                theta,
                         const uint8_t               count) {
    const float        remembering = 1.0F / config->forgetting;
    const float* const phi         = equation->phi;
    float              gain[EST_THETA_MAX];  // P phi, unscaled
    float              alpha   = config->forgetting * equation->variance;
    float              inverse = (equation->variance > 1.0F) ? (remembering / equation->variance) : remembering;
    float              d       = 0.0F;
    float*             column  = self->upper;
    EST_UNROLL
    for (uint8_t j = 0U; j < count; j++) {
        float f = phi[j];
        EST_UNROLL
        for (uint8_t i = 0U; i < j; i++) {
            f += column[i] * phi[i];
        }
        const float v      = self->d[j] * f;
        const float p      = f * inverse;
        const float shrunk = self->d[j] * (alpha * remembering);
        alpha += f * v;
        inverse    = 1.0F / alpha;
        d          = shrunk * inverse;
        self->d[j] = limited(d, config->p0);
        EST_UNROLL
        for (uint8_t i = 0U; i < j; i++) {
            const float u = *column;
            *column++     = u - (p * gain[i]);
            gain[i] += u * v;
        }
        gain[j] = v;
    }
    if (OFFSET(config)) {
        self->d[count - 1U] = limited(d, config->p0_offset);
    }
    const float scale = equation->innovation * inverse;
    EST_UNROLL
    for (uint8_t i = 0U; i < count; i++) {
        theta[i] += gain[i] * scale;
    }
    return inverse;
}

float est_factors_measure(est_factors_t* const        self,
                          const est_config_t* const   config,
                          const est_equation_t* const equation,
                          float* const                theta) {
#define MEASURE(count) measure(self, config, equation, theta, (count))
    return EST_FOR_COUNT(equation->count, MEASURE);
}

/// P := P + variance e e', where e is the unit vector of this row: Agee and Turner (1972), as in Bierman, section III.3.
static void walk_row(est_factors_t* const self, const uint8_t row, const float variance) {
    float a[EST_THETA_MAX] = { 0.0F };
    float c                = variance;
    a[row]                 = 1.0F;
    for (uint8_t j = (uint8_t)(row + 1U); j > 0U; j--) {
        float* const column = &self->upper[((j - 1U) * (j - 2U)) / 2U];
        const float  s      = a[j - 1U];
        const float  before = self->d[j - 1U];
        const float  d      = before + (c * s * s);
        const float  b      = (c * s) / d;
        c *= before / d;
        self->d[j - 1U] = d;
        for (uint8_t i = 0U; (i + 1U) < j; i++) {
            a[i] -= s * column[i];
            column[i] += b * a[i];
        }
    }
}

void est_factors_walk(est_factors_t* const self, const est_config_t* const config) {
    for (uint8_t i = 0U; i < PARAMETERS(config); i++) {
        walk_row(self, i, config->random_walk);
    }
    est_factors_inflate(self, config, 1.0F);
}

void est_factors_inflate(est_factors_t* const self, const est_config_t* const config, const float factor) {
    const uint8_t count = PARAMETERS(config);
    for (uint8_t j = 0U; j < count; j++) {
        self->d[j] = limited(self->d[j] * factor, prior_of(config, count, j));
    }
}

float est_factors_variance(const est_factors_t* const self, const uint8_t count, const uint8_t index) {
    float sum = self->d[index];
    for (uint8_t k = (uint8_t)(index + 1U); k < count; k++) {
        const float u = self->upper[((k * (k - 1U)) / 2U) + index];
        sum += u * u * self->d[k];
    }
    return sum;
}
