// SPDX-License-Identifier: MIT
/// Robustness: what est.c does beyond the model that fits. Scale of the innovations and validations of alarms, second
/// hypothesis, edges that vary, reference of the codes, predicted samples and lone outliers. est_lean.h has the same
/// functions for EST_WITH_ROBUSTNESS=0, where they do nothing. Private to est.c.

#ifndef EST_ROBUST_H_INCLUDED
#define EST_ROBUST_H_INCLUDED

#include "est_correlation.h"
#include "est_edges.h"
#include "est_equation.h"
#include "est_samples.h"
#include "est_scale.h"
#include "est_trigger.h"

#include <float.h>

/// Samples after an edge in which an outlier is one at the edge, and bits of edge_outliers for the two edges before.
#define AT_EDGE_N 3U
#define EDGES_BEFORE 6U

/// Longest gap that is bridged by predicted samples, and smallest precision of the whitening at which it is. Soon after
/// a start the prediction would rest on few noisy samples.
#define BRIDGED_MAX 8U
#define BRIDGE_PRECISION 0.6F

/// Weight of the squared residual before an edge, beside those in the ambiguity window after it.
#define EST_AMBIGUITY_BEFORE_N (2.0F * (float)EST_AMBIGUITY_N)

/// Part of the energy that a displacement must explain, of more than which the excess is evidence, and the evidence
/// that suffices. Displacements that differ explain 0.7 to 0.9 after each edge; noise explains 0.1 on average.
#define EST_DISPLACED 0.5F
#define EST_DISPLACED_SUM 1.5F

/// Forget the last innovations: the next one does not follow them.
EST_INLINE void forget_innovations(est_t* const self) { est_correlation_forget(&self->correlation); }

/// Subtract the reference from the codes. The first sample becomes the reference: the samples that follow are then
/// small numbers, which float32 rounds less. Without an offset in the model, codes are what they are.
EST_INLINE void subtract_reference(est_t* const self, float* const u, float* const y) {
    if (est_shape_of(self->config).offset > 0U) {
        if ((self->counters.updated == 0U) && est_delta_applies(self)) {
            self->reference_u = *u;
            self->reference_y = *y;
        }
        *u -= self->reference_u;
        *y -= self->reference_y;
    }
}

/// Innovation of the last equation, with the present theta.
static inline float last_innovation(const est_t* const self) {
    const uint_fast8_t count = est_theta_count(self);
    float              out   = self->whitener.past[0].x[0];
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < count; i++) {
        out -= self->whitener.past[i + 1U].x[0] * self->theta[i];
    }
    return out;
}

/// Begin to compare the innovations after an edge with the effect of a displacement. `before`: residual before it.
static inline void est_edges_begin_comparison(est_edges_t* const self, const float before) {
    self->along  = 0.0F;
    self->span   = 0.0F;
    self->energy = EST_AMBIGUITY_BEFORE_N * before * before;
}

/// Enter an innovation with the effect of a displacement on it: the share of early edges less that of late ones.
EST_INLINE void est_edges_compare(est_edges_t* const self, const float e, const float effect) {
    self->along += e * effect;
    self->span += effect * effect;
    self->energy += e * e;
}

/// Conclude the comparison. Return true iff the edges are displaced again and again.
static inline bool est_edges_displaced(est_edges_t* const self) {
    const float whole = self->span * self->energy;
    const float part  = (whole > 0.0F) ? ((self->along * self->along) / whole) : 0.0F;
    self->misfit      = est_max(self->misfit + (part - EST_DISPLACED), 0.0F);
    return self->misfit > EST_DISPLACED_SUM;
}

/// Begin that comparison at an edge which begins an ambiguity window.
static inline void begin_comparison(est_t* const self) {
    est_edges_begin_comparison(&self->edges, last_innovation(self));
}

/// Position of the edges: as configured, unless the innovations show that it varies.
EST_INLINE est_edge_instants_t edge_instants_of(const est_t* const self) {
    if (self->edges_vary) {
        return EST_EDGES_ANYWHERE;
    }
    return self->config->edge_instants;
}

/// True while the last alarm is under validation. No ambiguity window begins: the validation compares two estimates.
EST_INLINE bool validates_alarm(const est_t* const self) { return est_scale_validates(&self->scale); }

/// True iff the previous sample is missing, and was predicted.
static inline bool in_gap(const est_t* const self) { return self->bridged_n > 0U; }

/// End a bridge: the y of the present sample is not predicted.
EST_INLINE void end_bridge(est_t* const self) {
    self->bridged_n = 0U;
    self->set_aside = false;
}

/// Count an edge, in which no outlier has come yet.
static inline void count_edge(est_t* const self) {
    self->correlation.edge_outliers = (uint8_t)(self->correlation.edge_outliers << 1U);
}

/// True iff the next sample may be predicted: the model is known, and the whitening has nearly settled. y must not be
/// stuck: a prediction would end the count. The residuals of a missing sample are unknown.
static inline bool can_bridge(const est_t* const self) {
    return (((uint32_t)self->pending_n | self->trigger.quiet_n | self->same_n) == 0U) &&
           (self->bridged_n < BRIDGED_MAX) && !self->set_aside && (self->whitener.precision[0] > BRIDGE_PRECISION) &&
           (est_shape_of(self->config).nc == 0U);
}

/// Enter a missing sample whose y is to be predicted; its u is taken for the last one.
static inline void cross_gap(est_t* const self, float* const y) {
    self->bridged_n++;
    shift_u(self, self->u[0]);
    *y = self->y[0];
    increment(&self->edge_age_n);
}

/// Replace the y of an equation by its prediction, the one whose innovation is zero. With C close to A the next
/// equations then lose nothing but the information of this sample. A model that is not stable can predict what no plant
/// does; the equations then begin anew.
static inline void predict(est_t* const self, const float innovation) {
    float* const past = self->whitener.past[0].x;
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        past[i] -= innovation;  // the differences contain y(k) with the factor 1
    }
    self->y[0] -= innovation;
    if (!is_plausible(self->y[0])) {
        forget_samples(self);
    }
}

/// Compare an innovation after an edge with the effect of a displaced edge. If every edge is displaced by another part
/// of an interval, edges come anywhere from now on. The innovations so far are those of the wrong model.
EST_INLINE void watch_edges(est_t* const self, const float e, const float effect) {
    est_edges_compare(&self->edges, e, effect);
    if ((self->ambiguity_n >= EST_AMBIGUITY_N) && est_edges_displaced(&self->edges)) {
        self->edges_vary  = true;
        self->correlation = (est_correlation_t){ .work = 0U };
        est_scale_forgive(self);
    }
}

/// Put an alarm of the cumulative sum under validation, unless theta has overflown: the present estimate is kept and
/// compared with the next one. An earlier validation ends.
static inline void begin_validation(est_t* const self, const bool overflown) {
    if (est_scale_validates(&self->scale)) {
        est_scale_conclude(self);
    }
    if (!overflown && is_cusum(self->config)) {
        est_scale_begin_validation(&self->scale);
        (void)append(self->before_alarm, self->theta, EST_THETA_MAX);
    }
}

/// Weight of a squared innovation of unit precision in the cumulative sum.
EST_INLINE float weight_of(const est_t* const self) { return self->scale.weight; }

/// Let the next innovation raise an alarm if the blocks of late were high. `mean`: mean square of the newest one.
static inline void find_hidden_change(est_t* const self, const float mean) {
    est_scale_t* const scale = &self->scale;
    if ((self->trigger.quiet_n > 0U) || !self->config->noise_estimated) {
        scale->high_n = 0U;
        return;
    }
    est_scale_count(scale, mean >= (EST_HIGH * self->noise_variance));
    if ((scale->high_n >= EST_HIGH_LIMIT) && (self->ambiguity_n == 0U)) {  // an ambiguity window comes first
        scale->high_n           = 0U;
        self->trigger.statistic = 2.0F * self->config->trigger.ceiling;
    }
}

/// Let correlation and dispersion of the innovations follow a complete block of this mean square. The dispersion of
/// squares without peaks does not count. Neither does it before the trigger is armed, while theta settles.
static inline void follow_shape(est_t* const self, const float mean) {
    const bool               armed       = self->trigger.quiet_n == 0U;
    est_correlation_t* const correlation = &self->correlation;
    est_scale_t* const       scale       = &self->scale;
    if ((correlation->work & EST_WORK_LAGS) != 0U) {
        est_correlation_follow(correlation, scale->product, mean, self->noise_variance,
                               armed ? EST_PARTIAL_SHARE : EST_PARTIAL_WARM);
    }
    if (armed && !est_correlation_smooth(correlation)) {
        est_scale_disperse(scale, mean / self->noise_variance);
    } else {
        scale->dispersion = 1.0F;
    }
}

/// Update the scale after a block, by one stage. A block that ends with a large statistic may contain a change and is
/// discarded.
static inline void renew_scale(est_t* const self) {
    est_scale_t* const scale = &self->scale;
    if (scale->stage == EST_STAGE_END) {
        est_scale_relax(scale);
        est_scale_restart(self);
        return;
    }
    const float mean = est_scale_mean(scale);
    if (scale->stage == EST_STAGE_CHANGE) {
        if (is_cusum(self->config)) {
            find_hidden_change(self, mean);
            est_correlation_restart(&self->correlation);
        }
    } else if (scale->stage == EST_STAGE_NOISE) {
        est_scale_follow(self, mean);
    } else if (self->config->noise_estimated && (self->trigger.statistic < (0.5F * self->config->trigger.ceiling))) {
        follow_shape(self, mean);
    } else {
        scale->stage = EST_STAGE_NOISE;  // the block is discarded, and its noise variance with it
    }
    scale->stage++;
}

/// Continue the validation of the last alarm by one equation.
EST_INLINE void validate_alarm(est_t* const                self,
                               const est_shape_t           shape,
                               const est_equation_t* const equation,
                               const float                 precision) {
    const float old = est_equation_residual(equation->x, self->before_alarm, est_shape_count(shape));
    const float e   = equation->innovation;
    if (!est_scale_validate(&self->scale, old * old, e * e * precision, self->edge_age_n)) {
        est_scale_conclude(self);
    }
}

/// Enter the term of an innovation into the scale. Updates wait for a step without other optional work.
EST_INLINE void watch_scale(est_t* const                self,
                            const est_shape_t           shape,
                            const est_equation_t* const equation,
                            const float                 term,
                            const float                 precision) {
    if (est_scale_enter(&self->scale, term)) {
        return;
    }
    if (est_scale_validates(&self->scale)) {
        validate_alarm(self, shape, equation, precision);
    } else if (self->renewal == EST_RENEWAL_NONE) {
        renew_scale(self);
    } else {
        // the block waits
    }
}

/// True iff another hypothesis of the ambiguous edges may explain the innovations.
static inline bool may_be_displaced(const est_t* const self) {
    return (self->ambiguity_n > 0U) &&
           (est_trigger_best_rival(&self->trigger) < (EST_LONE_EXPLAINED * self->config->trigger.ceiling));
}

/// True iff an outlier comes right after an edge, as at one of the two edges before: a poor model, and no interference.
static inline bool returns_at_edge(const est_t* const self) {
    return (self->edge_age_n < AT_EDGE_N) && ((self->correlation.edge_outliers & EDGES_BEFORE) != 0U);
}

/// True iff this innovation alone lifted the statistic over the ceiling, and nothing else explains it. After a change
/// of the plant the next innovation is large too. `term`: of the innovation in the cumulative sum.
static inline bool is_lone_outlier(const est_t* const self, const float term) {
    if (may_be_displaced(self)) {
        return false;
    }
    const float reached =
        self->trigger.statistic + est_max(self->correlation.lead, 0.0F);  // sum of the first hypothesis
    const float before = (reached - term) + EST_CUSUM_DRIFT;
    const float least  = (EST_LONE_LEAST * self->config->trigger.ceiling) / self->scale.inflation;
    return (term > est_max(before * EST_LONE_RATIO, least)) && (term < FLT_MAX) && (self->bridged_n == 0U) &&
           is_cusum(self->config) && can_bridge(self) && !returns_at_edge(self);
}

/// Set a lone outlier aside: replace its y by its prediction, keep theta, and restart the statistic. An ambiguity
/// window about edges ends, since its hypotheses have lost their base. The next innovation decides.
static inline void set_outlier_aside(est_t* const self, const float innovation, est_step_t* const step) {
    self->set_aside = true;
    predict(self, innovation);
    self->trigger.statistic = 0.0F;
    self->ambiguity_n       = 0U;
    est_scale_discard_products(&self->scale);
    forget_innovations(self);
    if (self->edge_age_n < AT_EDGE_N) {
        self->correlation.edge_outliers |= 1U;
    }
    increment(&self->counters.outliers);
    step->status    = EST_OUTLIER;
    step->statistic = 0.0F;
}

/// Enter an innovation into the statistic. `term`: of the cumulative sum, `weight`: of a squared innovation in it;
/// `precision`: reciprocal of the innovation's variance [1 / noise variance]; `held`: the statistic is held at zero.
EST_INLINE void enter_innovation(
    est_t* const self, const float e, const float term, const float weight, const float precision, const bool held) {
    est_trigger_t* const     trigger     = &self->trigger;
    const float              share       = est_trigger_share(held);
    est_correlation_t* const correlation = &self->correlation;
    if (correlation->work == EST_WORK_LAG_1) {
        est_correlation_multiply(correlation, &self->scale, e, precision);
    }
    if (correlation->work <= EST_WORK_LAG_1) {
        trigger->statistic = est_trigger_sum(trigger->statistic, share * term);
        return;  // the usual step
    }
    if (correlation->work != EST_WORK_OTHER_TRIGGER) {
        trigger->statistic = est_correlation_enter(correlation, &self->scale, e, trigger->statistic, share * term,
                                                   share * weight, precision);
        return;
    }
    est_trigger_enter(trigger, &self->config->trigger, e, self->noise_variance / precision, share * term, held);
}

/// Replace the offset to the reference by that of the codes, in theta of the delta form. Its last parameters are A(1)
/// and B(1).
static inline void add_reference(const est_t* const self, const est_shape_t shape, float* const coefficients) {
    float* const b = &coefficients[shape.na + 1U];
    if (shape.offset > 0U) {
        b[shape.nb + shape.nc] += (coefficients[shape.na] * self->reference_y) - (b[shape.nb - 1U] * self->reference_u);
    }
}

/// The same for the factors of theta whose sum is the offset.
static inline void add_reference_factors(const est_t* const self, const est_shape_t shape, float* const factor) {
    factor[shape.na] += self->reference_y;
    factor[shape.na + shape.nb] -= self->reference_u;
}

static inline void init_robustness(est_t* const self) {
    est_scale_init(self);
    self->correlation.work = is_cusum(self->config) ? 0U : EST_WORK_OTHER_TRIGGER;
}

/// Scale of the innovations over the noise variance.
static inline float scale_factor(const est_t* const self) { return est_scale_factor(&self->scale); }

#endif  // EST_ROBUST_H_INCLUDED
