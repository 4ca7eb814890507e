/// Edges of u whose instant is in doubt. A generator on a clock of its own drifts against the sampling clock; when one of
/// its edges crosses a sampling instant, the level is from then on recorded one sample earlier or later than the plant
/// feels it. That is a jump of the b's, but no change of the plant: the innovations after the edge are then explained by
/// moving the edges by one sample, and this module says what that would have done to them.

#ifndef EST_EDGES_H_INCLUDED
#define EST_EDGES_H_INCLUDED

#include "est_whitener.h"

/// Doubt ends, one way or the other, so many samples after it began: the readings differ most in the first few.
#define EST_DOUBT_N 12U

/// No edge is in doubt.
void est_edges_forget(est_edges_t* self);

/// One sample later, with an edge in doubt. A doubt that has lasted its term has been decided by est_trigger_step().
void est_edges_age(est_edges_t* self);

/// True iff u[0] comes after an edge, the values of u newest first.
static inline bool est_edges_is_edge(const est_config_t* const config, const float* const u) {
    const float step = u[0] - u[1];
    return (step >= config->edge_codes) || (step <= -config->edge_codes);
}

/// An edge, a step of u, has just come, and doubt begins. `theta` is what is believed; `after_equation` is true iff the
/// sample before had an equation, which an edge one sample early would have entered.
void est_edges_begin(
    est_edges_t* self, const est_config_t* config, const float* theta, uint_fast8_t count, float step, bool after_equation);

/// What the edges, had they come early, and late, would have added to the present equation, whitened.
void est_edges_shares(est_edges_t*          self,
                      const est_config_t*   config,
                      const est_whitener_t* whitener,
                      const float*          u,
                      float*                early,
                      float*                late);

#endif  // EST_EDGES_H_INCLUDED
