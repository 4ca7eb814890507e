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

/// Functions with several callers, or with one or none in a build without robustness.
#if EST_WITH_ROBUSTNESS
#define EST_ROBUST_SHARED EST_SHARED
#else
#define EST_ROBUST_SHARED EST_INLINE
#endif

/// Copy n values; return the end of the copy.
EST_SHARED float* append(float* const out, const float* const from, const uint_fast8_t n) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < n; i++) {
        out[i] = from[i];
    }
    return &out[n];
}

/// True iff this configuration uses the delta form: with the cumulative sum. The other triggers keep the parameters and
/// the prior of the thesis.
EST_INLINE bool est_delta_applies(const est_config_t* const config) {
    return EST_WITH_ROBUSTNESS && (config->trigger.kind == EST_TRIGGER_CUSUM);
}

/// Replace order + 1 consecutive values, newest first, by D^order x(k), D^(order-1) x(k-1), ..., x(k-order).
EST_ROBUST_SHARED void est_delta_difference(float* const x, const uint_fast8_t order) {
    EST_UNROLL
    for (uint_fast8_t rest = EST_WITH_ROBUSTNESS ? order : 0U; rest > 0U; rest--) {
        EST_UNROLL
        for (uint_fast8_t i = 0U; i < rest; i++) {
            x[i] -= x[i + 1U];
        }
    }
}

/// Coefficients of the values from those of these differences: the transpose of the above. `x` holds all but the first,
/// which is the same in both forms: `lead`. The result is `out`, which may be `x`; without conversions it is `x`.
EST_ROBUST_SHARED const float*
est_delta_to_plain(const float* const x, const float lead, const uint_fast8_t order, float* const out) {
#if EST_WITH_ROBUSTNESS
    (void)append(out, x, order);
    EST_UNROLL
    for (uint_fast8_t n = 1U; n <= order; n++) {
        EST_UNROLL
        for (uint_fast8_t i = (uint_fast8_t)(n - 1U); i > 0U; i--) {
            out[i] -= out[i - 1U];
        }
        out[0] -= lead;
    }
    return out;
#else
    (void)lead;
    (void)order;
    (void)out;
    return x;
#endif
}

/// The inverse of est_delta_to_plain().
EST_ROBUST_SHARED void est_delta_from_plain(float* const x, const float lead, const uint_fast8_t order) {
    EST_UNROLL
    for (uint_fast8_t n = EST_WITH_ROBUSTNESS ? order : 0U; n > 0U; n--) {
        x[0] += lead;
        EST_UNROLL
        for (uint_fast8_t i = 1U; i < n; i++) {
            x[i] += x[i - 1U];
        }
    }
}

#endif  // EST_DELTA_H_INCLUDED
