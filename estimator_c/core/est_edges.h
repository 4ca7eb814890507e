// SPDX-License-Identifier: MIT
/// Edges of u whose instant is ambiguous. A generator on its own clock drifts against the sampling clock. When one of
/// its edges crosses a sampling instant, u is recorded one sample earlier or later from then on, relative to its
/// effect on the plant. The b's jump, but the plant has not changed. This module computes the effect of moving the
/// recent edges by one sample, so that the trigger can test whether that explains the innovations.

#ifndef EST_EDGES_H_INCLUDED
#define EST_EDGES_H_INCLUDED

#include "est_delta.h"
#include "est_whitener.h"

/// Duration of an ambiguity window in samples. The hypotheses differ most in the first few.
#define EST_AMBIGUITY_N 12U

/// True iff there is an edge between u[1] and u[0].
static inline bool est_edges_is_edge(const est_config_t* const config, const float* const u) {
    return est_magnitude(u[0] - u[1]) >= config->edge_codes;
}

/// Begin an ambiguity window at an edge of height `step`, with the present theta. An early edge would also have entered
/// the equation before; if there was none, the gain of the filter is zero and the term has no effect.
EST_INLINE void
est_edges_begin(est_edges_t* const self, const est_config_t* const config, const float* const theta, const float step) {
    const float before = (config->nk == 0U) ? (theta[config->na] * step) : 0.0F;
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        self->past[0].x[i] = ((i == 0U) || EST_WITH_ROBUSTNESS) ? before : 0.0F;  // its differences are equal to it
        self->past[1].x[i] = 0.0F;
    }
    (void)append(self->theta, theta, EST_THETA_MAX);
}

/// Compute what early edges, and late edges, would have added to the present equation, whitened. With an early edge u
/// changes in the sample before it was recorded, with a late one in the sample after. u since the beginning of the
/// ambiguity window is therefore shifted by one sample against y, including its noise. share[0] is that of early edges,
/// share[1] that of late ones with the opposite sign.
static inline void est_edges_shares(est_t* const self, const est_shape_t shape, float* const share) {
    est_edges_t* const edges = &self->edges;
    share[0]                 = 0.0F;
    share[1]                 = 0.0F;
    if (self->edge_age_n < ((uint32_t)shape.nb + shape.nk)) {
        const float* const u = self->u;
        float              b[EST_NB_MAX];
        (void)append(b, &edges->theta[shape.na], shape.nb);
        est_delta_to_coefficients(b, (uint_fast8_t)(shape.nb - 1U));
        EST_UNROLL
        for (uint_fast8_t hypothesis = 0U; hypothesis < EST_OTHER_HYPOTHESES; hypothesis++) {
            float sum = 0.0F;
            EST_UNROLL
            for (uint_fast8_t j = 0U; j < shape.nb; j++) {
                const uint_fast8_t lag = (uint_fast8_t)(shape.nk + j + hypothesis);
                if ((lag > 0U) && (lag <= self->ambiguity_n)) {
                    sum += b[j] * (u[lag - 1U] - u[lag]);
                }
            }
            share[hypothesis] = sum;
        }
    }
    EST_UNROLL
    for (uint_fast8_t hypothesis = 0U; hypothesis < EST_OTHER_HYPOTHESES; hypothesis++) {
        share[hypothesis] = est_filter(est_filter_of(&self->whitener), &edges->past[hypothesis], share[hypothesis]);
    }
}

#endif  // EST_EDGES_H_INCLUDED
