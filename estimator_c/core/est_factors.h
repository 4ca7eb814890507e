// SPDX-License-Identifier: MIT
/// Covariance of theta in factors: P = U D U' / weight with U unit upper triangular, in units of the noise variance. A
/// product of this form cannot lose symmetry, and stays positive as long as D does.

#ifndef EST_FACTORS_H_INCLUDED
#define EST_FACTORS_H_INCLUDED

#include "est_shape.h"

/// Lower limit of the d's. Without it, extreme data could make a d underflow to zero, and its direction would never be
/// updated again.
#define EST_D_MIN 1.0e-30F

/// Weight below which the d's are limited at the next opportunity, and below which they are limited in any step.
#define EST_WEIGHT_DUE 0.5F
#define EST_WEIGHT_OVERDUE 0.25F

/// Increase the variance of every parameter of this shape by `factor`, but limit each d to its prior, and set the
/// weight to 1. Without the limit, the variance of a direction that is not excited grows by 1 / forgetting per
/// equation without bound ("covariance blow-up", thesis 3.6). No direction needs to be less certain than at the
/// start.
EST_INLINE void est_factors_scale(est_factors_t* const      self,
                                  const est_config_t* const config,
                                  const est_shape_t         shape,
                                  const float               factor) {
    const uint_fast8_t count     = est_shape_count(shape);
    const float        p0        = config->p0;
    const float        p0_offset = config->p0_offset;
    const float        scale     = factor / self->weight;
    self->weight                 = 1.0F;
    EST_UNROLL
    for (uint_fast8_t j = 0U; j < count; j++) {
        const float d     = self->d[j] * scale;
        const float prior = est_is_offset(shape, j) ? p0_offset : p0;
        self->d[j]        = est_min(d, prior);
    }
}

/// est_factors_scale() with the shape of the configuration.
static inline void est_factors_inflate(est_t* const self, const float factor) {
    est_factors_scale(&self->factors, self->config, est_shape_of(self->config), factor);
}

static inline void est_factors_reset(est_t* const self) {
    self->factors.weight = 1.0F;
    for (uint_fast8_t j = 0U; j < EST_THETA_MAX; j++) {
        self->factors.d[j] = EST_VARIANCE_MAX;
    }
    clear(self->factors.upper, EST_UPPER_N);
    est_factors_inflate(self, 1.0F);  // limits each d to its prior
}

/// P := P + variance e e' with e the unit vector of this row: Agee and Turner (1972), as in Bierman, section III.3.
static inline void walk_row(est_factors_t* const self, const uint_fast8_t row, const float variance) {
    float a[EST_THETA_MAX];
    float c = variance;
    clear(a, EST_THETA_MAX);
    a[row] = 1.0F;
    for (uint_fast8_t left = (uint_fast8_t)(row + 1U); left > 0U; left--) {
        const uint_fast8_t j      = (uint_fast8_t)(left - 1U);
        float* const       column = &self->upper[(j * (j - 1U)) / 2U];
        const float        s      = a[j];
        const float        before = self->d[j];
        const float        d      = before + (c * s * s);
        const float        b      = (c * s) / d;
        c *= before / d;
        self->d[j] = d;
        for (uint_fast8_t i = 0U; i < j; i++) {
            a[i] -= s * column[i];
            column[i] += b * a[i];
        }
    }
}

/// P := P + random_walk I. The factors are those of Thornton's time update, "Triangular covariance factorizations for
/// Kalman filtering" (1976). Rank-one updates compute them without work space.
static inline void est_factors_walk(est_factors_t* const self, const float random_walk, const uint_fast8_t count) {
    const float variance = random_walk * self->weight;
    for (uint_fast8_t i = 0U; i < count; i++) {
        walk_row(self, i, variance);
    }
}

/// Variance of the sum of `factor` times the parameters.
static inline float
est_factors_variance(const est_factors_t* const self, const uint_fast8_t count, const float* const factor) {
    float        out    = 0.0F;
    const float* column = self->upper;
    for (uint_fast8_t k = 0U; k < count; k++) {
        float sum = factor[k];
        for (uint_fast8_t i = 0U; i < k; i++) {
            sum += *column++ * factor[i];
        }
        out += sum * sum * self->d[k];
    }
    return out / self->weight;
}

#endif  // EST_FACTORS_H_INCLUDED
