// SPDX-License-Identifier: MIT
/// Change triggers. They see the innovation and its variance, under every hypothesis of the ambiguous edges, and
/// nothing else of the estimator. A trigger of the user is a function in the configuration (est_trigger_fn). A new
/// trigger of the library needs a new est_trigger_kind_t, a function here, and a value in device/, catalogue/ and
/// harness/.

#ifndef EST_TRIGGER_H_INCLUDED
#define EST_TRIGGER_H_INCLUDED

#include "est_edges.h"
#include "est_shape.h"

#include <float.h>
#include <stddef.h>

/// True iff every value is in the range stated in est.h. Values that this kind of trigger ignores are checked too.
static inline bool est_trigger_config_valid(const est_trigger_config_t* const config) {
    const bool known =
        (config->kind <= EST_TRIGGER_CUSTOM) &&
        (EST_WITH_TRIGGERS || (config->kind == EST_TRIGGER_NONE) || (config->kind == EST_TRIGGER_CUSUM)) &&
        ((config->kind != EST_TRIGGER_CUSTOM) || (config->custom != NULL));
    const bool reset = (config->reset == EST_RESET_COVARIANCE) || (config->reset == EST_RESET_ALL);
    return known && reset && (config->ceiling > 0.0F) && (config->ceiling <= EST_CEILING_LIMIT);
}

typedef enum {
    EST_QUIET     = 0,
    EST_ALARM     = 1,
    EST_SLIP      = 2,  ///< the edges of u have moved by one sample; the plant has not changed
    EST_UNDECIDED = 3,  ///< the statistic has reached the ceiling, that of another hypothesis of the edges has not
} est_finding_t;

/// Prepare for the first innovation. The statistic is held at zero for the next quiet_n innovations.
static inline void est_trigger_restart(est_trigger_t* const self, const uint16_t quiet_n) {
    self->statistic = 0.0F;
    self->quiet_n   = quiet_n;
    if (EST_WITH_TRIGGERS) {
        self->mean_n = 0U;
        self->mean   = 0.0F;
    }
}

/// Begin an ambiguity window: all hypotheses of the edges start from the present statistic.
static inline void est_trigger_begin_ambiguity(est_trigger_t* const self) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_OTHER_HYPOTHESES; i++) {
        self->rival[i] = self->statistic;
    }
}

/// Smaller statistic of the two other hypotheses: that of the better explanation.
static inline float est_trigger_best_rival(const est_trigger_t* const self) {
    return est_min(self->rival[0], self->rival[1]);
}

/// True iff another hypothesis of the ambiguous edges explains the innovations better than the recorded one.
static inline bool est_trigger_is_ambiguous(const est_trigger_t* const self) {
    return est_trigger_best_rival(self) < self->statistic;
}

/// End an ambiguity window before its term, because a gap removes the samples that the other hypotheses need. Return
/// true iff it was a slip: the recorded hypothesis has passed the ceiling, and another hypothesis explained the
/// innovations. Otherwise the statistic continues from the best hypothesis. At its term, by contrast, an ambiguity
/// window has seen the whole effect of an edge, and the recorded hypothesis continues.
static inline bool est_trigger_end_ambiguity(est_trigger_t* const self, const est_trigger_config_t* const config) {
    if (self->statistic >= config->ceiling) {
        return true;
    }
    self->statistic = est_min(est_trigger_best_rival(self), self->statistic);
    return false;
}

/// Make the better of the other hypotheses the statistic. Return true iff it is the one with late edges.
static inline bool est_trigger_settle_late(est_trigger_t* const self) {
    const bool late = self->rival[1] < self->rival[0];
    self->statistic = est_trigger_best_rival(self);
    return late;
}

/// Gain and drift of the cumulative sum: 1.15 times those of the likelihood ratio of "the innovation's variance has
/// grown to 7.1 times its value", exp(0.43 z^2 - 0.983). Its mean is 1 for Gaussian z. By Ville's inequality, a sum
/// that restarts at zero then passes h at most once in exp(h) samples on average. In fact it does so thirty times as
/// rarely, because it rarely leaves zero. The factor makes the ceiling ln(ARL0) as measured, for an ARL0 of 1e3 to 1e7.
#define EST_TERM_GAIN 0.4945F
#define EST_CUSUM_DRIFT 1.1305F
#define EST_CUSUM_GAIN (EST_TERM_GAIN / (EST_INNOVATION_SCALE * EST_INNOVATION_SCALE))

/// A lone outlier has a term of more than EST_LONE_LEAST ceilings, computed without the inflation of the scale, and of
/// more than EST_LONE_RATIO times the sum before it. The innovations after a change grow from sample to sample; at 12
/// bits the first ones are small.
#define EST_LONE_LEAST 6.0F
#define EST_LONE_RATIO 30.0F

/// Part of the ceiling below which the sum of another hypothesis explains an outlier.
#define EST_LONE_EXPLAINED 0.5F

/// Scale of the innovation before it is squared; a power of two, so that nothing is rounded. The scaled square
/// overflows from 1.1e15 on, which no plant with codes below EST_CODE_LIMIT reaches: theta then has overflowed, or is
/// about to.
#define EST_INNOVATION_SCALE 16384.0F

/// Term of one innovation in a cumulative sum. It is infinite or NaN if the innovation is, or is extreme, whatever its
/// weight. Comparisons with the ceiling are written such that this raises an alarm.
EST_INLINE float est_trigger_term(const float innovation, const float weight) {
    const float scaled = EST_INNOVATION_SCALE * innovation;
    return scaled * scaled * weight;
}

/// Add one term to a cumulative sum.
static inline float est_trigger_sum(const float before, const float term) {
    const float sum = before + (term - EST_CUSUM_DRIFT);
    return est_max(0.0F, sum);
}

/// Enter the innovation under the other hypotheses of the ambiguous edges. `share`: as from est_edges_shares().
static inline void est_trigger_enter_hypotheses(est_trigger_t* const self,
                                                const float          innovation,
                                                const float* const   share,
                                                const float          weight) {
    self->rival[0] = est_trigger_sum(self->rival[0], est_trigger_term(innovation - share[0], weight));
    self->rival[1] = est_trigger_sum(self->rival[1], est_trigger_term(innovation + share[1], weight));
}

/// Judge all hypotheses of the edges, after the innovation was entered into each. The plant has changed only if no
/// hypothesis explains the innovations, or if theta has overflowed. `ambiguity_n`: duration of the ambiguity window so
/// far, at most EST_AMBIGUITY_N.
EST_INLINE est_finding_t est_trigger_find(const est_trigger_t* const self,
                                          const float                ceiling,
                                          const uint_fast8_t         ambiguity_n) {
    if (self->statistic < ceiling) {
        return EST_QUIET;
    }
    if (EST_WITH_EDGES && (ambiguity_n > 0U) && (est_trigger_best_rival(self) < ceiling) &&
        (self->statistic < FLT_MAX)) {
        return (ambiguity_n >= EST_AMBIGUITY_N) ? EST_SLIP : EST_UNDECIDED;
    }
    return EST_ALARM;
}

/// Mean between faults, thesis 4.4.3. The recursive form of the mean cannot grow without bound.
static inline float mean_between_faults(est_trigger_t* const self, const bool absolute, const float innovation) {
    const float term = absolute ? est_magnitude(innovation) : innovation;
    increment(&self->mean_n);
    self->mean += (term - self->mean) / (float)self->mean_n;
    return est_magnitude(self->mean);
}

static inline float call_custom(est_trigger_t* const              self,
                                const est_trigger_config_t* const config,
                                const float                       innovation,
                                const float                       variance) {
    const bool anew = self->mean_n == 0U;
    self->mean_n    = 1U;
    return config->custom(config->context, innovation, variance, anew);
}

/// Statistic of the triggers other than the cumulative sum. `variance`: of the innovation [codes^2].
static inline float est_trigger_other_statistic(est_trigger_t* const              self,
                                                const est_trigger_config_t* const config,
                                                const float                       innovation,
                                                const float                       variance) {
    if (config->kind == EST_TRIGGER_PREDICTION_ERROR) {
        return est_magnitude(innovation);
    }
    if (config->kind == EST_TRIGGER_MEAN_BETWEEN_FAULTS) {
        return mean_between_faults(self, config->absolute, innovation);
    }
    return call_custom(self, config, innovation, variance);
}

/// True iff the statistic is held at zero. Counts down the innovations of the hold.
EST_INLINE bool est_trigger_holds(est_trigger_t* const self) {
    if (self->quiet_n > 0U) {
        self->quiet_n--;
        return true;
    }
    return false;
}

/// Share of a term that counts. A theta that overflows raises an alarm although the statistic is held at zero.
EST_INLINE float est_trigger_share(const bool held) { return held ? 0.0F : 1.0F; }

/// Enter one innovation [codes] as recorded, with its variance [codes^2] and its term in the cumulative sum. The term
/// is zero while the statistic is held.
EST_INLINE void est_trigger_enter(est_trigger_t* const              self,
                                  const est_trigger_config_t* const config,
                                  const float                       innovation,
                                  const float                       variance,
                                  const float                       term,
                                  const bool                        held) {
    if (EST_WITH_TRIGGERS && (config->kind > EST_TRIGGER_NONE) && (config->kind != EST_TRIGGER_CUSUM) && !held) {
        self->statistic = est_trigger_other_statistic(self, config, innovation, variance);
    } else {
        self->statistic = est_trigger_sum(self->statistic, est_trigger_share(config->kind == EST_TRIGGER_NONE) * term);
    }
}

#endif  // EST_TRIGGER_H_INCLUDED
