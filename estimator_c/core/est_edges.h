/// Edges of u whose instant is in doubt. A generator on a clock of its own drifts against the sampling clock; when one of
/// its edges crosses a sampling instant, the level is from then on recorded one sample earlier or later than the plant
/// feels it. That is a jump of the b's, but no change of the plant: the innovations after the edge are then explained by
/// moving the edges by one sample, and this module says what that would have done to them.

#ifndef EST_EDGES_H_INCLUDED
#define EST_EDGES_H_INCLUDED

#include "est_whitener.h"

/// Doubt ends, one way or the other, so many samples after it began: the readings differ most in the first few.
#define EST_DOUBT_N 12U

/// True iff u[0] comes after an edge, the values of u newest first.
static inline bool est_edges_is_edge(const est_config_t* const config, const float* const u) {
    return est_magnitude(u[0] - u[1]) >= config->edge_codes;
}

/// An edge, a step of u, has just come, and doubt begins. `theta` is what is believed. An edge one sample early would have
/// entered the equation before; if that was none, the gains are such that this does not count.
EST_INLINE void
est_edges_begin(est_edges_t* const self, const est_config_t* const config, const float* const theta, const float step) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        self->early.x[i] = 0.0F;
        self->late.x[i]  = 0.0F;
    }
    if (config->nk == 0U) {
        self->early.x[0] = theta[config->na] * step;
    }
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_THETA_MAX; i++) {
        self->theta[i] = theta[i];
    }
}

/// What the edges, had they come early, and late, would have added to the present equation, whitened. One that is a sample
/// early had its new level already in the sample before, and one that came late not yet in its own: u since the doubt began
/// is moved by one place against y, its noise too.
EST_INLINE void est_edges_shares(est_edges_t* const          self,
                                 const est_shape_t           shape,
                                 const est_whitener_t* const whitener,
                                 const float* const          u,
                                 const uint_fast8_t          doubt_n,
                                 const uint_fast16_t         edge_age_n,
                                 float* const                early,
                                 float* const                late) {
    const float* const b         = &self->theta[shape.na];
    float              early_raw = 0.0F;
    float              late_raw  = 0.0F;
    if (edge_age_n < ((uint32_t)shape.nb + shape.nk)) {
        EST_UNROLL
        for (uint_fast8_t j = 0U; j < shape.nb; j++) {
            const uint_fast8_t lag = (uint_fast8_t)(shape.nk + j);
            late_raw -= b[j] * ((lag < doubt_n) ? (u[lag] - u[lag + 1U]) : 0.0F);
            if (lag > 0U) {
                early_raw += b[j] * ((lag <= doubt_n) ? (u[lag - 1U] - u[lag]) : 0.0F);
            }
        }
    }
    *early = est_filter(whitener->gain[0], &self->early, early_raw);
    *late  = est_filter(whitener->gain[0], &self->late, late_raw);
}

#endif  // EST_EDGES_H_INCLUDED
