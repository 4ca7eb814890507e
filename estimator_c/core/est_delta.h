// SPDX-License-Identifier: MIT
/// Delta form of the model. A plant that is slow against the sampling period has nearly equal consecutive samples, and
/// its a's differ little from binomial coefficients: float32 loses the information in the difference. The estimator
/// therefore works with differences of the samples and with the parameters that belong to them:
///
///     A(z) = D^na + alpha_1 D^(na-1) z^-1 + ... + alpha_na z^-na,     D = 1 - z^-1
///
/// and likewise B(z). With na = 2: alpha_1 = 2 + a1, alpha_2 = 1 + a1 + a2. The functions below convert samples and
/// coefficients. Middleton and Goodwin, "Improved finite word length characteristics in digital control using delta
/// operators" (1986). EST_WITH_ROBUSTNESS=0 omits the conversions.

#ifndef EST_DELTA_H_INCLUDED
#define EST_DELTA_H_INCLUDED

#include "est_shape.h"

/// True iff this configuration uses the delta form: with the cumulative sum. The other triggers keep the parameters and
/// the prior of the thesis.
EST_INLINE bool est_delta_applies(const est_t* const self) {
#if EST_WITH_ROBUSTNESS
    return is_cusum(self->config);
#else
    (void)self;
    return false;
#endif
}

/// Replace order + 1 consecutive values, newest first, by D^order x(k), D^(order-1) x(k-1), ..., x(k-order).
static inline void est_delta_difference(float* const x, const uint_fast8_t order) {
    EST_UNROLL
    for (uint_fast8_t rest = EST_WITH_ROBUSTNESS ? order : 0U; rest > 0U; rest--) {
        EST_UNROLL
        for (uint_fast8_t i = 0U; i < rest; i++) {
            x[i] -= x[i + 1U];
        }
    }
}

/// Replace y(k), y(k-1), ..., u(k-nk), ... by their differences, and a gradient in coefficients likewise.
static inline void est_delta_difference_both(float* const x, const uint_fast8_t na, const uint_fast8_t nb) {
    est_delta_difference(x, na);
    est_delta_difference(&x[na + 1U], (uint_fast8_t)(nb - 1U));
}

/// Add to each coefficient `factor` times the one before it: n passes, each over one coefficient more than the last.
static inline void est_delta_add(float* const x, const uint_fast8_t order, const float factor) {
    EST_UNROLL
    for (uint_fast8_t n = 1U; n <= (EST_WITH_ROBUSTNESS ? order : 0U); n++) {
        EST_UNROLL
        for (uint_fast8_t i = n; i > 0U; i--) {
            x[i] += factor * x[i - 1U];
        }
    }
}

/// Coefficients of the values from those of these differences: the transpose of the above. The first is the same in
/// both forms.
EST_INLINE void est_delta_to_coefficients(float* const x, const uint_fast8_t order) { est_delta_add(x, order, -1.0F); }

/// The inverse of est_delta_to_coefficients().
EST_INLINE void est_delta_from_coefficients(float* const x, const uint_fast8_t order) { est_delta_add(x, order, 1.0F); }

#endif  // EST_DELTA_H_INCLUDED
