// SPDX-License-Identifier: MIT
/// Whitening filter. Consecutive equations of the model have the coloured noise C(z) e. The filter makes it white and
/// treats every element of the equation alike, so that the equation still holds. It is not 1/C, which would need the
/// e's before the first equation. It is the innovations filter of a moving average that begins there (Brockwell and
/// Davis, "Time Series: Theory and Methods" (1991), section 5.3). Its gains begin at zero and converge to C; the
/// variance of the noise converges to 1.

#ifndef EST_WHITENER_H_INCLUDED
#define EST_WHITENER_H_INCLUDED

#include "est_shape.h"

/// Largest reflection coefficient of C. Beyond it the filter would make the data overflow.
#define REFLECTION_MAX 0.9999F

/// Noise variance below which the gains count as converged to C. The remaining difference has no visible effect.
#define SETTLED 1.0001F

/// True iff all zeros of C = 1 + c[0] z^-1 + ... are inside the unit circle, with a margin. By the Schur-Cohn
/// recursion: all zeros are inside iff every reflection coefficient is below 1.
static inline bool est_whitener_accepts(const float* const c, const uint_fast8_t na) {
    float a[EST_NA_MAX] = { 0.0F };  // MISRA D2
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < na; i++) {
        a[i] = c[i];
    }
    EST_UNROLL
    for (uint_fast8_t order = na; order > 0U; order--) {
        const float k = a[order - 1U];
        if (!(est_magnitude(k) < REFLECTION_MAX)) {
            return false;
        }
        const float rest = 1.0F - (k * k);
        EST_UNROLL
        for (uint_fast8_t i = 0U; ((2U * i) + 1U) < order; i++) {
            float* const mirror = &a[order - 2U - i];
            const float  lower  = (a[i] - (k * *mirror)) / rest;
            *mirror             = (*mirror - (k * a[i])) / rest;
            a[i]                = lower;
        }
    }
    return true;
}

/// Store the gains of the newest equation and determine the filter from them. With D = 1 - z^-1, its equation D^n w(k)
/// = x(k) - sum of step[j] D^j w(k-1) is that of x(k) = w(k) + gain[0] w(k-1) + ..., without the rounding of products
/// that cancel.
static inline void store_gains(est_whitener_t* const self, const float* const gain) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_GAIN_COLUMNS; i++) {
        self->gain[0][i] = gain[i];
    }
#if EST_WITH_ROBUSTNESS
    float sum[EST_NA_MAX];
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        sum[i] = gain[i];
    }
    EST_UNROLL
    for (uint_fast8_t j = 0U; j < EST_NA_MAX; j++) {
        EST_UNROLL
        for (uint_fast8_t i = EST_NA_MAX - 1U; i > 0U; i--) {
            sum[i - 1U] += (i > j) ? sum[i] : 0.0F;
        }
        self->step[j] = ((j % 2U) == 0U) ? (1.0F + sum[j]) : (1.0F - sum[j]);
    }
#endif
}

/// Set the first na coefficients of C. The filter continues from its present state.
static inline void est_whitener_set(est_whitener_t* const self, const float* const c, const uint_fast8_t na) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < na; i++) {
        self->c[i] = c[i];
    }
    store_gains(self, self->c);
}

/// Restart: the next equation is the first.
static inline void est_whitener_restart(est_whitener_t* const self) {
    clear(self->precision, EST_NA_MAX);
    for (uint_fast8_t j = 0U; j <= EST_THETA_MAX; j++) {
        self->past[j] = (est_past_t){ { 0.0F } };
    }
}

/// Autocovariance of C(z) e at this lag.
EST_INLINE float autocovariance(const float* const c, const uint_fast8_t lag) {
    float sum = (lag == 0U) ? 1.0F : c[lag - 1U];
    EST_UNROLL
    for (uint_fast8_t i = lag; i < EST_NA_MAX; i++) {
        sum += c[i] * c[i - lag];
    }
    return sum;
}

/// Store the gains of a new equation.
EST_INLINE void remember(est_whitener_t* const self, const float* const gain, const float variance) {
    EST_UNROLL
    for (uint_fast8_t row = EST_NA_MAX - 1U; row > 0U; row--) {
        self->precision[row] = self->precision[row - 1U];
    }
    for (uint_fast8_t row = EST_GAINS_KEPT - 1U; row > 0U; row--) {
        for (uint_fast8_t i = 0U; i < EST_GAIN_COLUMNS; i++) {
            self->gain[row][i] = self->gain[row - 1U][i];
        }
    }
    self->precision[0] = 1.0F / variance;
    store_gains(self, gain);
}

/// Advance to the next equation. Return the variance of its whitened noise in variances of e, at least 1. Once it is
/// 1, the gains have settled: *settled is set, and they stay constant until the next restart.
static inline float est_whitener_advance(est_whitener_t* const self, bool* const settled) {
    float gain[EST_NA_MAX];
    float covariance[EST_NA_MAX];  // between this equation's noise and the whitened noise i + 1 equations before
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

/// Coefficients of the filter.
EST_INLINE const float* est_filter_of(const est_whitener_t* const self) {
#if EST_WITH_ROBUSTNESS
    return self->step;
#else
    return self->gain[0];
#endif
}

/// Filter one sample of one signal. Gains beyond the order of C are zero: a loop of fixed length is faster.
static inline float est_filter(const float* const gain, est_past_t* const past, const float x) {
    float out = x;
#if EST_WITH_ROBUSTNESS
    EST_UNROLL
    for (uint_fast8_t i = EST_NA_MAX; i > 0U; i--) {
        out -= gain[i - 1U] * past->x[i - 1U];
    }
    EST_UNROLL
    for (uint_fast8_t i = EST_NA_MAX; i > 0U; i--) {
        out += past->x[i - 1U];
        past->x[i - 1U] = out;
    }
    return out;
#else
    EST_UNROLL
    for (uint_fast8_t i = EST_NA_MAX - 1U; i > 0U; i--) {
        out -= gain[i] * past->x[i];
        past->x[i] = past->x[i - 1U];
    }
    out -= gain[0] * past->x[0];
    past->x[0] = out;
    return out;
#endif
}

#endif  // EST_WHITENER_H_INCLUDED
