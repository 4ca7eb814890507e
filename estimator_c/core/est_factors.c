#include "est_factors.h"

#include "est_orders.h"

/// Certain beyond the precision of float32 by any measure of the data.
#define VARIANCE_NEGLIGIBLE 1.0e-30F

static float prior_of(const est_prior_t prior, const uint8_t count, const uint8_t j) {
    return ((j + 1U) == count) ? prior.p0_last : prior.p0;
}

static float limited(const float d, const float upper) {
    const float capped = (d > upper) ? upper : d;
    return (capped < VARIANCE_NEGLIGIBLE) ? VARIANCE_NEGLIGIBLE : capped;
}

void est_factors_reset(est_factors_t* const self, const uint8_t count, const est_prior_t prior) {
    float* column = self->upper;
    EST_UNROLL
    for (uint8_t j = 0U; j < COUNT(count); j++) {
        self->d[j] = prior_of(prior, COUNT(count), j);
        EST_UNROLL
        for (uint8_t i = 0U; i < j; i++) {
            column[i] = 0.0F;
        }
        column += j;
    }
}

float est_factors_measure(est_factors_t* const self,
                          const uint8_t        count,
                          const est_prior_t    prior,
                          const float* const   phi,
                          const float          forgetting,
                          const float          variance,
                          float* const         gain) {
    const float remembering = 1.0F / forgetting;
    float       alpha       = forgetting * variance;
    float       inverse     = 1.0F / alpha;
    float*      column      = self->upper;
    EST_UNROLL
    for (uint8_t j = 0U; j < COUNT(count); j++) {
        float f = phi[j];
        EST_UNROLL
        for (uint8_t i = 0U; i < j; i++) {
            f += column[i] * phi[i];
        }
        const float v     = self->d[j] * f;
        const float p     = f * inverse;
        const float prior_alpha = alpha;
        alpha += f * v;
        inverse    = 1.0F / alpha;
        self->d[j] = limited(self->d[j] * (prior_alpha * inverse) * remembering, prior_of(prior, COUNT(count), j));
        EST_UNROLL
        for (uint8_t i = 0U; i < j; i++) {
            const float u = column[i];
            column[i]     = u - (p * gain[i]);
            gain[i] += u * v;
        }
        gain[j] = v;
        column += j;
    }
    return alpha;
}

/// Row i of U with its unit diagonal.
static void fill_row(const est_factors_t* const self, const uint8_t count, const uint8_t i, float* const row) {
    for (uint8_t j = 0U; j < count; j++) {
        row[j] = (j > i) ? self->upper[((j * (j - 1U)) / 2U) + i] : ((j == i) ? 1.0F : 0.0F);
    }
}

/// sum over k of a_k w_k b_k + variance a'_k b'_k: a and b rows of (U, I), weighted with (D, variance).
static float weighted(const float* const d,
                      const uint8_t      count,
                      const float        variance,
                      const float* const a,
                      const float* const b) {
    float sum = 0.0F;
    for (uint8_t k = 0U; k < count; k++) {
        sum += (a[k] * d[k] * b[k]) + (variance * a[count + k] * b[count + k]);
    }
    return sum;
}

void est_factors_walk(est_factors_t* const self, const uint8_t count, const est_prior_t prior, const float variance) {
    float rows[EST_THETA_MAX][2U * EST_THETA_MAX];
    float d[EST_THETA_MAX];
    for (uint8_t i = 0U; i < count; i++) {
        fill_row(self, count, i, rows[i]);
        for (uint8_t k = 0U; k < count; k++) {
            rows[i][count + k] = (k == i) ? 1.0F : 0.0F;
        }
        d[i] = self->d[i];
    }
    for (uint8_t j = count; j > 0U; j--) {
        const float* const pivot  = rows[j - 1U];
        const float        norm   = weighted(d, count, variance, pivot, pivot);
        float* const       column = &self->upper[((j - 1U) * (uint32_t)(j - 2U)) / 2U];
        self->d[j - 1U]           = limited(norm, prior_of(prior, count, (uint8_t)(j - 1U)));
        for (uint8_t i = 0U; (i + 1U) < j; i++) {
            const float u = weighted(d, count, variance, rows[i], pivot) / norm;
            column[i]     = u;
            for (uint8_t k = 0U; k < (2U * count); k++) {
                rows[i][k] -= u * pivot[k];
            }
        }
    }
}

void est_factors_inflate(est_factors_t* const self, const uint8_t count, const est_prior_t prior, const float factor) {
    for (uint8_t j = 0U; j < count; j++) {
        self->d[j] = limited(self->d[j] * factor, prior_of(prior, count, j));
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
