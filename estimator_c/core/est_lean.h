// SPDX-License-Identifier: MIT
/// EST_WITH_ROBUSTNESS=0: the functions of est_robust.h for a model that is known to fit. Private to est.c.

#ifndef EST_LEAN_H_INCLUDED
#define EST_LEAN_H_INCLUDED  // MISRA D1

#include "est_edges.h"
#include "est_equation.h"
#include "est_trigger.h"

// Without a scale of the innovations, the trigger expects the configured noise variance.

static inline void init_robustness(est_t* const self) { (void)self; }

static inline float weight_of(const est_t* const self) { return EST_CUSUM_GAIN / self->noise_variance; }

static inline float scale_factor(const est_t* const self) {
    (void)self;
    return 1.0F;
}

static inline void watch_scale(est_t* const                self,
                               const est_shape_t           shape,
                               const est_equation_t* const equation,
                               const float                 term,
                               const float                 precision) {
    (void)self;
    (void)shape;
    (void)equation;
    (void)term;
    (void)precision;
}

// Without validations, every alarm is justified.

static inline void begin_validation(est_t* const self, const bool overflown) {
    (void)self;
    (void)overflown;
}

static inline bool validates_alarm(const est_t* const self) {
    (void)self;
    return false;
}

// Innovations have one hypothesis.

EST_INLINE void enter_innovation(
    est_t* const self, const float e, const float term, const float weight, const float precision, const bool held) {
    (void)weight;
    est_trigger_enter(&self->trigger, &self->config->trigger, e, self->noise_variance / precision,
                      est_trigger_share(held) * term, held);
}

static inline void forget_innovations(est_t* const self) { (void)self; }

// The position of the edges is as configured.

static inline est_edge_instants_t edge_instants_of(const est_t* const self) { return self->config->edge_instants; }

static inline void begin_comparison(est_t* const self) { (void)self; }

static inline void watch_edges(est_t* const self, const float e, const float effect) {
    (void)self;
    (void)e;
    (void)effect;
}

// Codes are what they are.

static inline void subtract_reference(est_t* const self, float* const u, float* const y) {
    (void)self;
    (void)u;
    (void)y;
}

static inline void add_reference(const est_t* const self, const est_shape_t shape, float* const coefficients) {
    (void)self;
    (void)shape;
    (void)coefficients;
}

static inline void add_reference_factors(const est_t* const self, const est_shape_t shape, float* const factor) {
    (void)self;
    (void)shape;
    (void)factor;
}

// No sample is predicted: equations begin anew after a gap, and an outlier is an innovation as any other.

static inline bool can_bridge(const est_t* const self) {
    (void)self;
    return false;
}

static inline void cross_gap(est_t* const self, float* const y) {
    (void)self;
    (void)y;
}

static inline bool in_gap(const est_t* const self) {
    (void)self;
    return false;
}

static inline void end_bridge(est_t* const self) { (void)self; }

static inline void predict(est_t* const self, const float innovation) {
    (void)self;
    (void)innovation;
}

static inline void count_edge(est_t* const self) { (void)self; }

static inline bool is_lone_outlier(const est_t* const self, const float term) {
    (void)self;
    (void)term;
    return false;
}

static inline void set_outlier_aside(est_t* const self, const float innovation, est_step_t* const step) {
    (void)self;
    (void)innovation;
    (void)step;
}

#endif  // EST_LEAN_H_INCLUDED
