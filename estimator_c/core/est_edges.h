// SPDX-License-Identifier: MIT
/// Edges of u whose instant is in doubt. A generator on its own clock drifts against the sampling clock. When one of
/// its edges crosses a sampling instant, u is recorded one sample earlier or later from then on, relative to its
/// effect on the plant. The b's jump, but the plant has not changed. This module computes the effect of moving the
/// recent edges by one sample, so that the trigger can test whether that explains the innovations.

#ifndef EST_EDGES_H_INCLUDED
#define EST_EDGES_H_INCLUDED

#include "est_whitener.h"

/// Duration of a doubt in samples. The readings differ most in the first few.
#define EST_DOUBT_N 12U

/// True iff there is an edge between u[1] and u[0].
static inline bool est_edges_is_edge(const est_config_t* const config, const float* const u) {
    return est_magnitude(u[0] - u[1]) >= config->edge_codes;
}

/// Begin a doubt at an edge of height `step`, with the present theta. An early edge would also have entered the
/// equation before; if there was none, the gain of the filter is zero and the term has no effect.
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

/// Compute what early edges, and late edges, would have added to the present equation, whitened. With an early edge u
/// changes in the sample before it was recorded, with a late one in the sample after. u since the beginning of the
/// doubt is therefore shifted by one sample against y, including its noise.
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
