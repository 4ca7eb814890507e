#include "est_factors.h"

void est_factors_inflate(est_factors_t* const self, const est_config_t* const config, const float factor) {
    est_factors_scale(self, config, est_shape_of(config), factor);
}

void est_factors_reset(est_factors_t* const self, const est_config_t* const config) {
    self->weight = 1.0F;
    for (uint_fast8_t j = 0U; j < EST_THETA_MAX; j++) {
        self->d[j] = EST_VARIANCE_MAX;
    }
    for (uint_fast8_t i = 0U; i < EST_UPPER_N; i++) {
        self->upper[i] = 0.0F;
    }
    est_factors_inflate(self, config, 1.0F);  // no d beyond the prior
}

/// P := P + variance e e', where e is the unit vector of this row: Agee and Turner (1972), as in Bierman, section III.3.
static void walk_row(est_factors_t* const self, const uint_fast8_t row, const float variance) {
    float a[EST_THETA_MAX] = { 0.0F };  // MISRA D2
    float c                = variance;
    a[row]                 = 1.0F;
    for (uint_fast8_t j = (uint_fast8_t)(row + 1U); j > 0U; j--) {
        float* const column = &self->upper[((j - 1U) * (j - 2U)) / 2U];
        const float  s      = a[j - 1U];
        const float  before = self->d[j - 1U];
        const float  d      = before + (c * s * s);
        const float  b      = (c * s) / d;
        c *= before / d;
        self->d[j - 1U] = d;
        for (uint_fast8_t i = 0U; (i + 1U) < j; i++) {
            a[i] -= s * column[i];
            column[i] += b * a[i];
        }
    }
}

void est_factors_walk(est_factors_t* const self, const est_config_t* const config) {
    for (uint_fast8_t i = 0U; i < est_shape_count(est_shape_of(config)); i++) {
        walk_row(self, i, config->random_walk * self->weight);
    }
}

float est_factors_variance(const est_factors_t* const self, const uint_fast8_t count, const uint_fast8_t index) {
    float sum = self->d[index];
    for (uint_fast8_t k = (uint_fast8_t)(index + 1U); k < count; k++) {
        const float u = self->upper[((k * (k - 1U)) / 2U) + index];
        sum += u * u * self->d[k];
    }
    return sum / self->weight;
}
