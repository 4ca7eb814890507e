/// Edges of u whose instant is in doubt. A generator on a clock of its own drifts against the sampling clock; when one of
/// its edges crosses a sampling instant, the level is from then on recorded one sample earlier or later than the plant
/// feels it. That is a jump of the b's, but no change of the plant: the innovations after the edge are then explained by
/// moving the edges by one sample, and this module says what that would have done to them.

#ifndef EST_EDGES_H_INCLUDED
#define EST_EDGES_H_INCLUDED

#include "est.h"

/// Doubt ends, one way or the other, so many samples after it began: the readings differ most in the first few.
#define EST_DOUBT_N 12U

/// No edge is in doubt, and the level before the next sample is unknown.
void est_edges_forget(est_edges_t* self);

/// Whether u(k), unfiltered, would be an edge.
bool est_edges_is_edge(const est_edges_t* self, const est_config_t* config, float u);

/// Enters u(k), unfiltered. If it is an edge and no doubt is kept, a new doubt begins; returns true then.
/// `keep` is true while the present doubt must not be dropped for a new one.
bool est_edges_enter(est_edges_t* self, const est_config_t* config, float u, bool keep);

/// The share of the innovation that is due to the edges having come early, and late, given the b's.
void est_edges_shares(const est_edges_t* self, const est_config_t* config, const float* b, float* early, float* late);

#endif  // EST_EDGES_H_INCLUDED
