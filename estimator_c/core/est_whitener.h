/// Consecutive equations of the model have the coloured noise C(z) e. This filter makes it white, and passes every element
/// of the equation alike, so that the equation still holds. It is not 1/C, which would need the e's before the first
/// equation, but the innovations filter of a moving average that begins there (Brockwell and Davis, "Time Series: Theory and
/// Methods" (1991), section 5.3): its gains begin at zero and come to C, and the variance of the noise comes down to 1.

#ifndef EST_WHITENER_H_INCLUDED
#define EST_WHITENER_H_INCLUDED

#include "est_shape.h"

/// Reflection coefficients beyond this belong to a C that filters the data into overflow.
#define REFLECTION_MAX 0.9999F

/// True iff all zeros of C = 1 + c[0] z^-1 + ... are inside the unit circle, with a margin.
/// Schur-Cohn (step-down): all zeros are inside iff every reflection coefficient is below 1.
EST_OUTLINE bool est_whitener_accepts(const float* const c, const uint_fast8_t na) {
    float a[EST_NA_MAX] = { 0.0F };  // MISRA D2
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < na; i++) {
        a[i] = c[i];
    }
    EST_UNROLL
    for (uint_fast8_t order = na; order > 0U; order--) {
        const float k = a[order - 1U];
        if (!((k > -REFLECTION_MAX) && (k < REFLECTION_MAX))) {
            return false;  // MISRA D4
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

/// From now on C is this, and its other coefficients as they are; how the next equations hang together with those before is kept.
EST_OUTLINE void est_whitener_set(est_whitener_t* const self, const float* const c, const uint_fast8_t na) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < na; i++) {
        self->c[i]       = c[i];
        self->gain[0][i] = c[i];
    }
}

/// The next equation is the first.
void est_whitener_restart(est_whitener_t* self);

/// Goes on to the next equation. Returns the variance of its noise once whitened, in variances of e; at least 1. If that is 1
/// the gains have settled, which is noted, and stay as they are until the next restart.
float est_whitener_advance(est_whitener_t* self, bool* settled);

/// One sample of one signal. A loop of fixed length is the faster one; the gains beyond the order of C are zero.
EST_SHAPED float est_filter(const float* const gain, est_past_t* const past, const float x) {
    float out = x;
    EST_UNROLL
    for (uint_fast8_t i = EST_NA_MAX - 1U; i > 0U; i--) {
        out -= gain[i] * past->x[i];
        past->x[i] = past->x[i - 1U];
    }
    out -= gain[0] * past->x[0];
    past->x[0] = out;
    return out;
}

#endif  // EST_WHITENER_H_INCLUDED
