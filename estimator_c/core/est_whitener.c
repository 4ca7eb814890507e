#include "est_whitener.h"

/// The gains have come to C once the variance of the noise is below this; what is left makes no difference worth the name.
#define SETTLED 1.0001F

void est_whitener_restart(est_whitener_t* const self) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        self->precision[i] = 0.0F;
    }
    for (uint_fast8_t j = 0U; j <= EST_THETA_MAX; j++) {
        for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
            self->past[j].x[i] = 0.0F;
        }
    }
}

/// The autocovariance of C(z) e at this lag.
static float autocovariance(const float* const c, const uint_fast8_t lag) {
    float sum = (lag == 0U) ? 1.0F : c[lag - 1U];
    EST_UNROLL
    for (uint_fast8_t i = lag; i < EST_NA_MAX; i++) {
        sum += c[i] * c[i - lag];
    }
    return sum;
}

/// The gains of a new equation.
EST_INLINE void remember(est_whitener_t* const self, const float* const gain, const float variance) {
    EST_UNROLL
    for (uint_fast8_t row = EST_NA_MAX - 1U; row > 0U; row--) {
        self->precision[row] = self->precision[row - 1U];
    }
    for (uint_fast8_t row = EST_GAINS_KEPT - 1U; row > 0U; row--) {
        for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
            self->gain[row][i] = self->gain[row - 1U][i];
        }
    }
    self->precision[0] = 1.0F / variance;
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        self->gain[0][i] = gain[i];
    }
}

/// One row of the Cholesky factor of the banded covariance matrix of the noise. c[] is zero beyond its order.
float est_whitener_advance(est_whitener_t* const self, bool* const settled) {
    float gain[EST_NA_MAX];
    float covariance[EST_NA_MAX];  // of the noise of this equation and that of the whitened one i + 1 before
    float variance = autocovariance(self->c, 0U);
    EST_UNROLL
    for (uint_fast8_t i = EST_NA_MAX; i > 0U; i--) {
        float sum = autocovariance(self->c, i);
        EST_UNROLL
        for (uint_fast8_t m = EST_NA_MAX; m > i; m--) {
            sum -= covariance[m - 1U] * self->gain[i - 1U][m - i - 1U];  // cppcheck F1
        }
        covariance[i - 1U] = sum;
        gain[i - 1U]       = sum * self->precision[i - 1U];  // 0 where there was no equation
        variance -= sum * gain[i - 1U];
    }
    if (variance < SETTLED) {
        variance = 1.0F;
        *settled = true;
        est_whitener_set(self, self->c, EST_NA_MAX);
    } else {
        remember(self, gain, variance);
    }
    return variance;
}

