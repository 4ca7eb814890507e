/// One equation of the model: filled from the samples, whitened, and entered into the estimate. These functions take the most
/// of a step's time. They are inline, so that a call with a constant shape becomes straight-line code.

#ifndef EST_EQUATION_H_INCLUDED
#define EST_EQUATION_H_INCLUDED

#include "est_factors.h"
#include "est_shape.h"
#include "est_whitener.h"

typedef struct {
    float phi[EST_THETA_MAX + 1U];  ///< the regressor in the order of theta, and y(k) last
    float innovation;               ///< what was not foreseen of y(k) [codes]
    float variance;                 ///< of the equation's noise, in noise variances
} est_equation_t;

EST_INLINE float* append(float* const out, const float* const from, const uint8_t n) {
    EST_UNROLL
    for (uint8_t i = 0U; i < n; i++) {
        out[i] = from[i];
    }
    return &out[n];
}

/// From the samples.
EST_INLINE void est_equation_fill(const est_t* const self, const est_shape_t shape, const float y, float* const phi) {
    float* out = phi;
    EST_UNROLL
    for (uint8_t i = 0U; i < shape.na; i++) {
        *out++ = -self->y[i];
    }
    out = append(out, &self->u[shape.nk], shape.nb);
#if EST_NC_MAX > 0
    out = append(out, self->residual, shape.nc);
#endif
    if (shape.offset) {
        *out++ = 1.0F;
    }
    *out = y;
}

/// Whitens the equation in place, and finds its innovation.
EST_INLINE void est_equation_whiten(est_equation_t* const equation,
                                    const est_shape_t     shape,
                                    est_whitener_t* const whitener,
                                    const float* const    theta) {
    const uint8_t count = est_shape_count(shape);
    float* const  phi   = equation->phi;
    float         gain[EST_NA_MAX];
    float         predicted = 0.0F;
    EST_UNROLL
    for (uint8_t i = 0U; i < EST_NA_MAX; i++) {
        gain[i] = whitener->gain[0][i];
    }
    EST_UNROLL
    for (uint8_t j = 0U; j < count; j++) {
        const float x = est_filter(gain, &whitener->past[j], phi[j]);
        phi[j]        = x;
        predicted += x * theta[j];
    }
    phi[count]           = est_filter(gain, &whitener->past[count], phi[count]);
    equation->innovation = phi[count] - predicted;
}

/// One measurement: Bierman, "Factorization Methods for Discrete Sequential Estimation" (1977), section V.3, with the
/// forgetting factor of thesis Equ 3.21. Moves theta, and returns 1 / (forgetting * variance + phi' P phi).
EST_INLINE float est_equation_measure(est_factors_t* const        self,
                                      const est_config_t* const   config,
                                      const est_shape_t           shape,
                                      const est_equation_t* const equation,
                                      float* const                theta) {
    const uint8_t      count       = est_shape_count(shape);
    const float        remembering = 1.0F / config->forgetting;
    const float* const phi         = equation->phi;
    float              gain[EST_THETA_MAX] = { 0.0F };  // P phi, unscaled
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
        self->d[j] = est_limited(d, config->p0);
        EST_UNROLL
        for (uint8_t i = 0U; i < j; i++) {
            const float u = *column;
            *column++     = u - (p * gain[i]);
            gain[i] += u * v;
        }
        gain[j] = v;
    }
    if (shape.offset) {
        self->d[count - 1U] = est_limited(d, config->p0_offset);
    }
    const float scale = equation->innovation * inverse;
    EST_UNROLL
    for (uint8_t i = 0U; i < count; i++) {
        theta[i] += gain[i] * scale;
    }
    return inverse;
}

#endif  // EST_EQUATION_H_INCLUDED
