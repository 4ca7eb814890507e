// SPDX-License-Identifier: MIT
/// One equation of the model: filled from the samples, whitened, and used to update the estimate. Most of the time of
/// a step is spent here. The functions are inline, so that a call with a constant shape becomes straight-line code.

#ifndef EST_EQUATION_H_INCLUDED
#define EST_EQUATION_H_INCLUDED

#include "est_delta.h"
#include "est_factors.h"
#include "est_shape.h"
#include "est_whitener.h"

typedef struct {
    float* x;           ///< y(k), followed by the regressor phi in the order of theta
    float* gain;        ///< P phi, unscaled
    float  innovation;  ///< prediction error of y(k) [codes]
    float  factor;      ///< innovation over its variance, in units of the gain
    float  variance;    ///< variance of the equation's noise [noise variances]
} est_equation_t;

/// Fill x from the stored samples.
EST_INLINE void est_equation_fill(const est_t* const self, const est_shape_t shape, const float y, float* const x) {
    float* const inputs = append(&x[1], self->y, shape.na);
    float*       out    = append(inputs, &self->u[shape.nk], shape.nb);
    x[0]                = y;
    if (est_delta_applies(self)) {
        est_delta_difference_both(x, shape.na, shape.nb);
    }
    EST_UNROLL
    for (uint_fast8_t i = 1U; i <= shape.na; i++) {
        x[i] = -x[i];
    }
#if EST_NC_MAX > 0
    out = append(out, self->residual, shape.nc);
#endif
    if (shape.offset > 0U) {
        *out = 1.0F;
    }
}

/// Prediction error of y(k) with this theta of n parameters.
static inline float est_equation_residual(const float* const x, const float* const theta, const uint_fast8_t n) {
    float out = x[0];
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < n; i++) {
        out -= x[i + 1U] * theta[i];
    }
    return out;
}

/// Whiten the equation in place and compute its innovation.
EST_INLINE void est_equation_whiten(est_equation_t* const equation,
                                    const est_shape_t     shape,
                                    est_whitener_t* const whitener,
                                    const float* const    theta) {
    const uint_fast8_t count = est_shape_count(shape);
    float* const       x     = equation->x;
    EST_UNROLL
    for (uint_fast8_t j = 0U; j <= count; j++) {
        x[j] = est_filter(est_filter_of(whitener), &whitener->past[j], x[j]);
    }
    equation->innovation = est_equation_residual(x, theta, count);
}

/// Update the covariance with one measurement: Bierman, "Factorization Methods for Discrete Sequential Estimation"
/// (1977), section V.3. The forgetting factor of thesis Equ 3.21 divides the weight of P, and with it every d at once.
/// Store the gain. Return the reciprocal of the innovation's variance [1 / noise variance].
EST_INLINE float est_equation_measure(est_factors_t* const  self,
                                      const float           forgetting,
                                      const est_shape_t     shape,
                                      est_equation_t* const equation) {
    const uint_fast8_t count   = est_shape_count(shape);
    const float* const phi     = &equation->x[1];
    float* const       gain    = equation->gain;
    const float        weight  = forgetting * self->weight;
    float              alpha   = weight * equation->variance;
    float              inverse = 0.0F;  // 1 / alpha of the column before
    float*             column  = self->upper;
    EST_UNROLL
    for (uint_fast8_t j = 0U; j < count; j++) {
        float f = phi[j];
        EST_UNROLL
        for (uint_fast8_t i = 0U; i < j; i++) {
            f += column[i] * phi[i];
        }
        const float v      = self->d[j] * f;
        const float p      = f * inverse;
        const float shrunk = self->d[j] * alpha;
        alpha += f * v;
        inverse    = 1.0F / alpha;
        self->d[j] = (shrunk * inverse) + EST_D_MIN;
        EST_UNROLL
        for (uint_fast8_t i = 0U; i < j; i++) {
            const float u = *column;
            *column++     = u - (p * gain[i]);  // MISRA D3
            gain[i] += u * v;
        }
        gain[j] = v;
    }
    equation->factor = equation->innovation * inverse;
    self->weight     = weight;
    return weight * inverse;
}

/// Update theta with the gain of est_equation_measure().
EST_INLINE void
est_equation_update_theta(const est_equation_t* const equation, const est_shape_t shape, float* const theta) {
    const uint_fast8_t count = est_shape_count(shape);
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < count; i++) {
        theta[i] += equation->gain[i] * equation->factor;
    }
}

#endif  // EST_EQUATION_H_INCLUDED
