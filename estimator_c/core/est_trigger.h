/// The change triggers of est.h. They see the innovation, in every reading of the edges in doubt, and its variance, and
/// nothing else of the estimator. A user's trigger is a function in the configuration (est_trigger_fn); one of the library's
/// own is a new est_trigger_kind_t, a new function here, and a new value wherever a kind is set: device/, catalogue/, harness/.

#ifndef EST_TRIGGER_H_INCLUDED
#define EST_TRIGGER_H_INCLUDED

#include "est_edges.h"
#include "est_shape.h"

#include <float.h>
#include <stddef.h>

/// True iff every value is in the range stated in est.h, whether this kind of trigger uses it or not.
static inline bool est_trigger_config_valid(const est_trigger_config_t* const config) {
    const bool known =
        (config->kind >= EST_TRIGGER_NONE) && (config->kind <= EST_TRIGGER_CUSTOM) &&
        (EST_WITH_TRIGGERS || (config->kind == EST_TRIGGER_NONE) || (config->kind == EST_TRIGGER_CUSUM)) &&
        ((config->kind != EST_TRIGGER_CUSTOM) || (config->custom != NULL));
    const bool reset = (config->reset == EST_RESET_COVARIANCE) || (config->reset == EST_RESET_ALL);
    return known && reset && (config->ceiling > 0.0F) && (config->ceiling <= EST_CEILING_LIMIT);
}

typedef enum {
    EST_QUIET = 0,
    EST_ALARM = 1,
    EST_SLIP  = 2,  ///< not the plant, but the edges of u have moved by one sample
} est_finding_t;

/// Ready for the first innovation; the statistic is zero for the next quiet_n samples.
static inline void est_trigger_restart(est_trigger_t* const self, const uint16_t quiet_n) {
    self->statistic = 0.0F;
    self->quiet_n   = quiet_n;
    if (EST_WITH_TRIGGERS) {
        self->mean_n = 0U;
    }
}

/// Edges are in doubt from this sample on: all readings of them start from what the statistic is now.
static inline void est_trigger_begin_doubt(est_trigger_t* const self) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_OTHER_READINGS; i++) {
        self->rival[i] = self->statistic;
    }
}

/// The statistic of the other reading that explains the innovations better.
EST_OUTLINE float est_trigger_best_rival(const est_trigger_t* const self) {
    return (self->rival[0] < self->rival[1]) ? self->rival[0] : self->rival[1];
}

/// True iff another reading of the edges in doubt has so far explained the innovations better than what was recorded.
static inline bool est_trigger_in_doubt(const est_trigger_t* const self) {
    return est_trigger_best_rival(self) < self->statistic;
}

/// The doubt ends before its term, as when a gap takes away what the other readings rest on. If the innovations as recorded
/// had already passed the ceiling, another reading explained them: a slip, and true. Else the statistic goes on from the best
/// reading, since none can be followed any further; at its term a doubt has seen all there is of an edge, and the recorded one
/// goes on.
static inline bool est_trigger_end_doubt(est_trigger_t* const self, const est_trigger_config_t* const config) {
    if (self->statistic >= config->ceiling) {
        return true;  // MISRA D4
    }
    if (est_trigger_in_doubt(self)) {
        self->statistic = est_trigger_best_rival(self);
    }
    return false;
}

/// Makes the best of the other readings the statistic; true iff it is the one in which the edges came late.
static inline bool est_trigger_settle_late(est_trigger_t* const self) {
    const bool late = self->rival[1] < self->rival[0];
    self->statistic = est_trigger_best_rival(self);
    return late;
}

/// The likelihood ratio of "the innovation's variance has grown fourfold" is exp(0.375 z^2 - ln 2). Its mean is at most 1
/// for every conditionally 1-sub-Gaussian z, so that by Ville's inequality a sum that restarts at zero passes h at most
/// once in exp(h) samples on average: the ceiling is ln(ARL0) without any asymptotics.
#define EST_CUSUM_GAIN (0.375F / (EST_INNOVATION_SCALE * EST_INNOVATION_SCALE))
#define EST_CUSUM_DRIFT 0.69314718F

/// A power of two, so that nothing is rounded. No plant with codes below EST_CODE_LIMIT has an innovation whose square overflows
/// with it, 1.1e15: theta has, or is about to.
#define EST_INNOVATION_SCALE 16384.0F

/// Infinite or not a number if the innovation is beyond all measure, whatever the weight, or is none: the comparisons with the
/// ceiling are such that this is an alarm.
EST_SHAPED float est_trigger_sum(const float before, const float innovation, const float weight) {
    const float scaled = EST_INNOVATION_SCALE * innovation;
    const float sum    = before + ((scaled * scaled * weight) - EST_CUSUM_DRIFT);
    return (sum <= 0.0F) ? 0.0F : sum;
}

/// Enters the innovation in the other readings of the edges in doubt, that of what was recorded being the statistic already. The
/// plant has changed only if no reading explains the innovations, or theta has overflowed. `expires` is true iff the doubt has lasted its term.
static inline est_finding_t est_trigger_find_in_doubt(est_trigger_t* const self,
                                                      const float          ceiling,
                                                      const float          early,
                                                      const float          late,
                                                      const float          weight,
                                                      const bool           expires) {
    self->rival[0] = est_trigger_sum(self->rival[0], early, weight);
    self->rival[1] = est_trigger_sum(self->rival[1], late, weight);
    if (self->statistic < ceiling) {
        return EST_QUIET;  // MISRA D4
    }
    if ((est_trigger_best_rival(self) < ceiling) && (self->statistic < FLT_MAX)) {
        return expires ? EST_SLIP : EST_QUIET;  // MISRA D4
    }
    return EST_ALARM;
}

/// Thesis 4.4.3. The running mean in the form that needs no sum, so that it cannot grow without bound.
static inline float mean_between_faults(est_trigger_t* const self, const bool absolute, const float innovation) {
    const float  term = absolute ? est_magnitude(innovation) : innovation;
    float* const mean = &self->rival[0];
    *mean             = (self->mean_n == 0U) ? 0.0F : *mean;
    self->mean_n      = (uint16_t)(self->mean_n + ((self->mean_n < UINT16_MAX) ? 1U : 0U));
    *mean += (term - *mean) / (float)self->mean_n;
    return est_magnitude(*mean);
}

static inline float custom(est_trigger_t* const              self,
                           const est_trigger_config_t* const config,
                           const float                       innovation,
                           const float                       variance) {
    const bool anew = self->mean_n == 0U;
    self->mean_n    = 1U;
    return config->custom(config->context, innovation, variance, anew);
}

/// Of the kinds that are no cumulative sum. The one that is not named is the caller's.
static inline float est_trigger_other_statistic(est_trigger_t* const              self,
                                                const est_trigger_config_t* const config,
                                                const float                       innovation,
                                                const float                       weight) {
    if (config->kind == EST_TRIGGER_PREDICTION_ERROR) {
        return est_magnitude(innovation);  // MISRA D4
    }
    if (config->kind == EST_TRIGGER_MEAN_BETWEEN_FAULTS) {
        return mean_between_faults(self, config->absolute, innovation);  // MISRA D4
    }
    return custom(self, config, innovation, EST_CUSUM_GAIN / weight);
}

/// Whether the statistic is held at zero.
EST_INLINE bool est_trigger_holds(est_trigger_t* const self, const est_trigger_kind_t kind) {
    if (self->quiet_n > 0U) {
        self->quiet_n--;
        return true;  // MISRA D4
    }
    return kind == EST_TRIGGER_NONE;
}

/// Enters one innovation [codes], as recorded, whose square has this weight in the cumulative sum: none while that is held.
EST_INLINE void est_trigger_enter(est_trigger_t* const              self,
                                  const est_trigger_config_t* const config,
                                  const float                       innovation,
                                  const float                       weight,
                                  const bool                        held) {
    if (EST_WITH_TRIGGERS && (config->kind != EST_TRIGGER_CUSUM) && !held) {
        self->statistic = est_trigger_other_statistic(self, config, innovation, weight);
    } else {
        self->statistic = est_trigger_sum(self->statistic, innovation, weight);
    }
}

#endif  // EST_TRIGGER_H_INCLUDED
