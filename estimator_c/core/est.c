// SPDX-License-Identifier: MIT

#include "est.h"
#include "est_assert.h"
#include "est_edges.h"
#include "est_equation.h"
#include "est_samples.h"
#include "est_trigger.h"

#if EST_WITH_ROBUSTNESS
#include "est_robust.h"
#else
#include "est_lean.h"
#endif

#include <float.h>
#include <stddef.h>

/// Factor by which a slip increases the variance of every parameter. With 10, the covariance of the shifted b's is too
/// small and false alarms follow. With 10,000, a simultaneous change of the plant passes unnoticed.
#define SLIP_UNCERTAINTY 1000.0F

/// Smallest forgetting factor. It bounds the growth of P between two limitations of the d's.
#define FORGETTING_MIN 0.5F

/// C is the estimate of A with its zeros moved towards the origin by this factor: a C with zeros on the unit circle
/// never forgets.
#define CONTRACTION 0.99F

/// Squared distance between A and C below which C is kept. The innovations are then white enough: their variance is
/// at most 1 % too large with poles up to 0.95. A hundred times this distance may put a zero of C on the unit circle.
#define REFRESH_STEP 8.0e-6F

/// Squared distance between A and C beyond which the whitening begins anew. The old filter leaves noise that is not
/// white to the new one.
#define REFRESH_STRIDE 0.005F

/// The estimate remembers some 1 / (1 - forgetting) samples. After this many times that without an edge, A is
/// determined by the noise, which any A = C fits, and C must not follow.
#define REFRESH_MEMORIES 2.0F

/// Samples after an edge of u within which another one is part of a slope: no edge that could slip.
#define SLOPE_N 5U

/// Square of the smallest ratio of the range of the codes to the standard deviation of the noise.
#define NOISE_SHARE 1024.0F

static void increment_long(uint32_t* const counter) {
    const uint32_t next = *counter + (uint32_t)1U;
    if (next > 0U) {  // cppcheck F5
        *counter = next;
    }
}

// ---------------------------------------------     CONFIGURATION      ---------------------------------------------

EST_INLINE bool same_shape(const est_shape_t a, const est_shape_t b) {
    return (a.na == b.na) && (a.nb == b.nb) && (a.nk == b.nk) && (a.nc == b.nc) && (a.offset == b.offset);
}

EST_INLINE est_shape_t requested_shape(const est_config_t* const config) {
    return (est_shape_t){
        .na = config->na, .nb = config->nb, .nk = config->nk, .nc = config->nc, .offset = config->offset ? 1U : 0U
    };
}

static bool orders_valid(const est_config_t* const config) {
    return (config->na >= 1U) && (config->na <= EST_NA_MAX) && (config->nb >= 1U) && (config->nb <= EST_NB_MAX) &&
           (config->nk <= EST_NK_MAX) && (config->nc <= EST_NC_MAX) &&
           (est_shape_count(requested_shape(config)) <= EST_THETA_MAX);
}

static bool variances_valid(const est_config_t* const config) {
    return within(config->p0, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->p0_offset, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->noise_variance, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->random_walk, 0.0F, EST_VARIANCE_MAX) && within(config->forgetting, FORGETTING_MIN, 1.0F);
}

/// An edge or a noise that does not fit into the range of the codes is in another unit.
static bool codes_valid(const est_config_t* const config) {
    const float range = config->code_high - config->code_low;
    return within(config->code_low, -EST_CODE_LIMIT, config->code_high) && (config->code_high <= EST_CODE_LIMIT) &&
           within(config->edge_codes, FLT_MIN, range) && ((config->noise_variance * NOISE_SHARE) <= (range * range)) &&
           ((uint32_t)config->edge_instants <= (uint32_t)EST_EDGES_ANYWHERE);
}

/// True iff this build supports the configuration.
static bool is_supported(const est_config_t* const config) {
    return same_shape(requested_shape(config), est_shape_of(config)) &&
           (EST_WITH_EDGES || (config->edge_instants == EST_EDGES_LOCKED)) &&
           (EST_WITH_ROBUSTNESS || !config->noise_estimated) &&
           (EST_WITH_ADAPTATION || ((config->random_walk <= 0.0F) && (config->refresh_n == 0U))) &&
           (EST_WITH_WATCH || ((config->stuck_n == 0U) && (config->idle_n == 0U)));
}

bool est_config_valid(const est_config_t* const config) {
    EST_ASSERT(config != NULL);
    return orders_valid(config) && est_whitener_accepts(config->c, config->na) && variances_valid(config) &&
           codes_valid(config) && is_supported(config) && est_trigger_config_valid(&config->trigger);
}

// ---------------------------------------------        SAMPLES         ---------------------------------------------

/// Restore theta from before the ambiguity window, with the b's moved by one place: y(k) now depends on u(k-1) as it
/// did on u(k), or the reverse. Every parameter becomes less certain.
static void follow_slip(est_t* const self, const bool late) {
    (void)append(self->theta, self->edges.theta, EST_THETA_MAX);
    const uint_fast8_t last = (uint_fast8_t)(self->config->nb - 1U);
    float* const       b    = &self->theta[self->config->na];
    est_delta_to_coefficients(b, last);
    if (late) {
        shift(b, self->config->nb, 0.0F);
    } else {
        *append(b, &b[1], last) = 0.0F;
    }
    est_delta_from_coefficients(b, last);
    est_factors_inflate(self, SLIP_UNCERTAINTY);
}

/// Compute theta in the coefficients of est.h, after the first coefficient of A.
static void compute_coefficients(const est_t* const self, const est_shape_t shape, float* const coefficients) {
    float* const b  = &coefficients[shape.na + 1U];
    coefficients[0] = 1.0F;
    (void)append(&coefficients[1], self->theta, EST_THETA_MAX);
    add_reference(self, shape, coefficients);
    if (est_delta_applies(self)) {
        est_delta_to_coefficients(coefficients, shape.na);
        est_delta_to_coefficients(b, (uint_fast8_t)(shape.nb - 1U));
    }
}

/// Compute the estimate of A, contracted: 1, c[0], ... With noise on the output, the noise of the equations is coloured
/// by A (thesis section 3.5).
static void contract_a(const est_t* const self, const est_shape_t shape, float* const out) {
    float factor = 1.0F;
    *out         = 1.0F;
    (void)append(&out[1], self->theta, shape.na);
    if (est_delta_applies(self)) {
        est_delta_to_coefficients(out, shape.na);
    }
    EST_UNROLL
    for (uint_fast8_t i = 1U; i <= shape.na; i++) {
        factor *= CONTRACTION;
        out[i] *= factor;
    }
}

static void refresh_prefilter(est_t* const self, const est_shape_t shape) {
    float a[EST_NA_MAX + 1U] = { 0.0F };  // MISRA D2
    contract_a(self, shape, a);
    self->refresh_in = self->config->refresh_n;
    if (est_whitener_accepts(&a[1], EST_NA_MAX)) {
        est_whitener_set(&self->whitener, &a[1], shape.na);
        increment(&self->counters.refreshes);
    }
}

/// Complete the work that the last step left.
static void renew(est_t* const self) {
    if (self->renewal == EST_RENEWAL_RESET) {
        est_factors_reset(self);
        if (EST_WITH_ADAPTATION) {
            self->refresh_in = self->config->refresh_n;
        }
    } else if (EST_WITH_EDGES && (self->renewal >= EST_RENEWAL_EARLY)) {
        follow_slip(self, self->renewal == EST_RENEWAL_LATE);
    } else if (EST_WITH_ADAPTATION && (self->renewal == EST_RENEWAL_PREFILTER)) {
        refresh_prefilter(self, est_shape_of(self->config));
    } else {
        // the last step left no work
    }
    self->renewal = EST_RENEWAL_NONE;
}

/// Clear the residuals: they belong to earlier equations, and may have overflowed.
EST_INLINE void forget_residuals(est_t* const self) {
#if EST_NC_MAX > 0
    clear(self->residual, EST_NC_MAX);
#else
    (void)self;
#endif
}

/// Count one sample towards the next complete equation. The step has time for the work that an alarm or a slip left,
/// because it has no equation of its own.
static void gather(est_t* const self) {
    self->pending_n--;
    self->known = true;
    renew(self);
    if (self->pending_n == 0U) {
        est_whitener_restart(&self->whitener);
        forget_innovations(self);
        forget_residuals(self);
        self->settled = false;
        increment(&self->counters.restarts);
    }
}

/// Set theta to zero.
static void clear_theta(est_t* const self) {
    clear(self->theta, EST_THETA_MAX);
    if (est_delta_applies(self)) {
        self->theta[0] = 1.0F;  // the first coefficient of A, which is no parameter
        est_delta_from_coefficients(self->theta, self->config->na);
        *append(self->theta, &self->theta[1], self->config->na) = 0.0F;
    }
}

/// True iff the code is within the range of the converter. False for NaN and the infinities.
static bool in_range(const est_config_t* const config, const float code) {
    return (code > config->code_low) && (code < config->code_high);
}

/// True iff the two numbers have the same bits.
static bool same_bits(const float a, const float b) {
    typedef union {       // MISRA D4
        float    number;  // cppcheck F3
        uint32_t bits;
    } est_bits_t;
    const est_bits_t first  = { .number = a };  // MISRA D4
    const est_bits_t second = { .number = b };  // MISRA D4
    return first.bits == second.bits;
}

/// True iff y has been constant for too long after an edge of u. The plant answers every edge within a few samples,
/// so a constant y comes from a defective channel. While u rests, y may rest too.
static bool is_stuck(est_t* const self, const float y, const bool edge) {
    if (!same_bits(y, self->y[0])) {
        self->same_n = 0U;
        return false;
    }
    const uint32_t watched = (edge ? 1U : 0U) | self->same_n;  // 0: every edge was answered
    if ((watched > 0U) && (self->same_n < UINT8_MAX)) {
        self->same_n++;
    }
    return (self->config->stuck_n > 0U) && (self->same_n >= self->config->stuck_n);
}

/// True iff another hypothesis of the ambiguous edges explains the innovations better than the recorded one.
static bool other_hypothesis_leads(const est_t* const self) {
    return (self->ambiguity_n > 0U) && est_trigger_is_ambiguous(&self->trigger);
}

/// Enter an edge into the ambiguity window. It joins the ambiguity window about earlier edges if another hypothesis of
/// these leads; otherwise it begins a new ambiguity window.
static void enter_ambiguous_edge(est_t* const self) {
    if (other_hypothesis_leads(self)) {
        return;
    }
    const float step  = self->u[0] - self->u[1];
    self->ambiguity_n = 1U;
    est_edges_begin(&self->edges, self->config, self->theta, step);
    est_trigger_begin_ambiguity(&self->trigger);
    begin_comparison(self);
}

static void enter_edge(est_t* const self) {
    if (in_gap(self)) {
        increment(&self->edge_age_n);  // the instant of the edge is unknown
        forget_samples(self);
        return;
    }
    count_edge(self);
    const bool slope = self->edge_age_n < SLOPE_N;
    self->edge_age_n = 0U;
    if (!EST_WITH_EDGES) {
        return;
    }
    const est_edge_instants_t instants = edge_instants_of(self);
    if ((instants == EST_EDGES_MAY_SLIP) && !slope && !validates_alarm(self) && is_cusum(self->config)) {
        enter_ambiguous_edge(self);
    } else if (instants == EST_EDGES_ANYWHERE) {
        self->pending_n = larger(self->pending_n, self->config->na);
    } else {
        // the b's absorb the edge
    }
}

/// Subtract the reference and enter u(k). Return EST_GATHERING while the equation of this sample needs unknown
/// samples.
static est_status_t enter_input(est_t* const self, float u, float* const y) {
    subtract_reference(self, &u, y);
    shift_u(self, u);
    const bool edge = EST_KNOWS_EDGES && est_edges_is_edge(self->config, self->u) && self->known;
    if (EST_WITH_WATCH && is_stuck(self, *y, edge)) {
        increment(&self->counters.stuck);
        return EST_REFUSED;
    }
    if (EST_WITH_EDGES && (self->ambiguity_n > 0U)) {
        self->ambiguity_n = (self->ambiguity_n < EST_AMBIGUITY_N) ? (uint8_t)(self->ambiguity_n + 1U) : 0U;
    }
    if (edge) {
        enter_edge(self);
    } else if (EST_KNOWS_EDGES) {
        increment(&self->edge_age_n);
    } else {
        // nothing depends on the age of edges
    }
    increment_long(&self->counters.updated);
    if (self->pending_n > 0U) {
        end_bridge(self);
        gather(self);
        shift_y(self, *y);
        return EST_GATHERING;
    }
    return EST_UPDATED;
}

/// Classify the sample, and enter its u if it is good. `y`: that of its equation.
static est_status_t examine(est_t* const self, const est_sample_t sample, float* const y) {
    if (!sample.valid) {
        return EST_MISSING;
    }
    if (in_range(self->config, sample.u) && in_range(self->config, sample.y)) {
        *y = sample.y;
        return enter_input(self, sample.u, y);
    }
    if (EST_WITH_WATCH && is_plausible(sample.u) && is_plausible(sample.y)) {
        increment(&self->counters.saturated);
    }
    return EST_REFUSED;
}

// ---------------------------------------------       EQUATIONS        ---------------------------------------------

/// Enter the innovation under the other hypotheses of the ambiguous edges. They are compared with theta before the
/// ambiguity window, because the estimate has followed the recorded hypothesis since.
EST_INLINE void
judge_hypotheses(est_t* const self, const est_shape_t shape, const est_equation_t* const equation, const float weight) {
    const bool  same = self->ambiguity_n <= 1U;  // theta has not changed yet
    const float e =
        same ? equation->innovation : est_equation_residual(equation->x, self->edges.theta, est_shape_count(shape));
    float share[EST_OTHER_HYPOTHESES];
    est_edges_shares(self, shape, share);
    watch_edges(self, e, share[0] + share[1]);
    est_trigger_enter_hypotheses(&self->trigger, e, share, weight);
}

/// Store the residual of an equation after its update: it replaces e in the next equations (thesis section 3.5).
static void store_residual(est_t* const self, const float* const x) {
#if EST_NC_MAX > 0
    if (self->config->nc > 0U) {
        shift(self->residual, self->config->nc, est_equation_residual(x, self->theta, est_theta_count(self)));
    }
#else
    (void)self;
    (void)x;
#endif
}

/// Squared distance between these coefficients and the present C.
EST_INLINE float distance(const est_whitener_t* const whitener, const float* const c, const uint_fast8_t na) {
    float sum = 0.0F;
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < na; i++) {
        const float step = c[i] - whitener->c[i];
        sum += step * step;
    }
    return sum;
}

static bool remembers_edge(const est_t* const self) {
    return ((1.0F - self->config->forgetting) * (float)self->edge_age_n) < REFRESH_MEMORIES;
}

/// Decide whether C follows A. If C moves far, or the gains have not settled, the whitening begins anew: C is then
/// taken at the next sample, which has no equation.
EST_INLINE void compare_prefilter(est_t* const self, const est_shape_t shape) {
    float a[EST_NA_MAX + 1U];
    contract_a(self, shape, a);
    const float moved = distance(&self->whitener, &a[1], shape.na);
    if (moved < REFRESH_STEP) {
        self->renewal    = EST_RENEWAL_NONE;
        self->refresh_in = self->config->refresh_n;
        return;
    }
    self->renewal = EST_RENEWAL_PREFILTER;
    if (!self->settled || (moved > REFRESH_STRIDE)) {
        self->pending_n = 1U;
    }
}

/// Refresh C in three equations, so that no step is long: judge A, compare C with A, take C. Suspended while another
/// hypothesis of the edges leads, because theta may have followed an edge that was misread. An ambiguity window alone
/// does not suspend it: with edges in quick succession it never ends.
EST_INLINE void consider_refresh(est_t* const self, const est_shape_t shape) {
    if (EST_WITH_EDGES && other_hypothesis_leads(self)) {
        self->renewal = EST_RENEWAL_NONE;
    } else if (self->renewal == EST_RENEWAL_COMPARE) {
        compare_prefilter(self, shape);
    } else if (self->renewal == EST_RENEWAL_PREFILTER) {
        self->renewal = EST_RENEWAL_NONE;
        refresh_prefilter(self, shape);
    } else if (remembers_edge(self)) {
        self->renewal = EST_RENEWAL_COMPARE;
    } else {
        // A is determined by noise
    }
}

// ---------------------------------------------        CHANGES         ---------------------------------------------

/// Raise an alarm. The samples so far belong to the plant before the change. Extreme data can make theta overflow; the
/// statistic then overflows too, and the estimate is discarded.
static void raise_alarm(est_t* const self, est_step_t* const step) {
    step->alarm          = true;
    const bool overflown = !(step->statistic < FLT_MAX);
    begin_validation(self, overflown);
    if (overflown || (self->config->trigger.reset == EST_RESET_ALL)) {
        clear_theta(self);
    }
    if (overflown) {
        step->statistic = FLT_MAX;
        if (EST_WITH_ADAPTATION) {  // P may have overflowed with the residuals in its regressors
            est_factors_reset(self);
        }
    }
    self->renewal = EST_RENEWAL_RESET;
    est_trigger_restart(&self->trigger, self->config->trigger.hold_off_n);
    increment(&self->counters.alarms);
    forget_samples(self);
}

/// Count a slip: edges of u come one sample earlier or later from now on. The samples so far belong to the old
/// instants.
static void note_slip(est_t* const self) {
    self->renewal = est_trigger_settle_late(&self->trigger) ? EST_RENEWAL_LATE : EST_RENEWAL_EARLY;
    increment(&self->counters.slips);
    forget_samples(self);
}

/// Enter a sample that is not good. Return true iff its y is to be predicted; its u is taken for the last one.
static bool enter_gap(est_t* const self, const est_status_t status, float* const y) {
    if (status == EST_REFUSED) {
        increment(&self->counters.refused);
    } else {
        increment_long(&self->counters.missing);
    }
    if (!can_bridge(self)) {
        self->known = false;
    }
    if (EST_WITH_EDGES && (self->ambiguity_n > 0U)) {
        self->ambiguity_n++;
        // the last sample of an ambiguity window decides and must be good
        if (!self->known || (self->ambiguity_n >= EST_AMBIGUITY_N)) {
            self->ambiguity_n = 0U;
            if (est_trigger_end_ambiguity(&self->trigger, &self->config->trigger)) {
                note_slip(self);
            }
        }
    }
    if (self->known) {
        cross_gap(self, y);
        return true;
    }
    forget_samples(self);
    return false;
}

/// Let every parameter become less certain: the random walk of the configuration.
static void walk(est_t* const self) {
    est_factors_walk(&self->factors, self->config->random_walk, est_theta_count(self));
    est_factors_inflate(self, 1.0F);
}

/// Limit P. Done in a step without other optional work, unless that comes too late.
EST_INLINE void limit_factors(est_t* const self) {
    const bool busy = (EST_WITH_EDGES && (self->ambiguity_n > 0U)) || (EST_WITH_ADAPTATION && (self->refresh_in == 1U));
    if (!busy || (self->factors.weight < EST_WEIGHT_OVERDUE)) {
        est_factors_inflate(self, 1.0F);
    }
}

/// Predict a missing y.
EST_INLINE void bridge(est_t* const self, const est_shape_t shape, const float innovation) {
    if (EST_WITH_EDGES && (self->ambiguity_n > 0U)) {
        float share[EST_OTHER_HYPOTHESES];
        est_edges_shares(self, shape, share);
    }
    predict(self, innovation);
}

/// Accept an equation: update theta, store its residual, and end the bridge.
EST_INLINE void accept_equation(est_t* const self, const est_shape_t shape, const est_equation_t* const equation) {
    est_equation_update_theta(equation, shape, self->theta);
    if (EST_WITH_ADAPTATION) {
        store_residual(self, equation->x);
    }
    end_bridge(self);
}

EST_INLINE void enter_equation(est_t* const self, const est_shape_t shape, const float y, est_step_t* const step) {
    const est_config_t* const config     = self->config;
    float          x[EST_THETA_MAX + 2U] = { 0.0F };  // one to spare: gcc warns of an access that never is; MISRA D2
    float          gain[EST_THETA_MAX]   = { 0.0F };  // MISRA D2
    est_equation_t equation              = { .x = x, .gain = gain };
    float          weight_min;
    if (self->settled) {
        equation.variance = 1.0F;
        weight_min        = EST_WEIGHT_DUE;
    } else {
        equation.variance = est_whitener_advance(&self->whitener, &self->settled);
        weight_min        = EST_WEIGHT_OVERDUE;
    }
    if (self->factors.weight < weight_min) {
        limit_factors(self);
    }
    est_equation_fill(self, shape, y, equation.x);
    shift_y(self, y);
    est_equation_whiten(&equation, shape, &self->whitener, self->theta);
    if (EST_WITH_ROBUSTNESS && (step->status != EST_UPDATED)) {
        bridge(self, shape, equation.innovation);
        return;
    }
    const float precision = est_equation_measure(&self->factors, config->forgetting, shape, &equation);
    if (EST_WITH_ADAPTATION && (config->random_walk > 0.0F)) {
        walk(self);
    }
    const bool  held   = est_trigger_holds(&self->trigger);
    const float weight = precision * weight_of(self);
    const float term   = est_trigger_term(equation.innovation, weight);
    enter_innovation(self, equation.innovation, term, weight, precision, held);
    step->innovation = equation.innovation;
    step->statistic  = self->trigger.statistic;
    if (EST_WITH_EDGES && (self->ambiguity_n > 0U)) {
        judge_hypotheses(self, shape, &equation, est_trigger_share(held) * weight);
    }
    const est_finding_t finding = est_trigger_find(&self->trigger, config->trigger.ceiling, self->ambiguity_n);
    if (finding == EST_QUIET) {  // two copies of accept_equation() save four instructions a step
        accept_equation(self, shape, &equation);
    } else {
        if (is_lone_outlier(self, term)) {
            set_outlier_aside(self, equation.innovation, step);
            return;
        }
        accept_equation(self, shape, &equation);
        if (finding == EST_ALARM) {
            raise_alarm(self, step);
            return;
        }
        if (EST_WITH_EDGES && (finding == EST_SLIP)) {
            note_slip(self);
            return;
        }
    }
    watch_scale(self, shape, &equation, term, precision);
    if (EST_WITH_ADAPTATION && (self->refresh_in > 1U)) {
        self->refresh_in--;
    } else if (EST_WITH_ADAPTATION && (self->refresh_in == 1U)) {
        consider_refresh(self, shape);
    } else {
        // C is constant
    }
}

// ---------------------------------------------          API           ---------------------------------------------

static const est_config_t default_config = EST_CONFIG_DEFAULT;

est_config_t est_config_for_codes(const float low, const float high) {
    est_config_t out = default_config;
    out.code_low     = low;
    out.code_high    = high;
    return out;
}

est_config_t est_config_default(void) { return default_config; }

bool est_init(est_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != NULL) && (config != NULL));
    if (EST_WITH_CHECKS && !est_config_valid(config)) {
        return false;
    }
    *self                = (est_t){ .config = config };
    self->refresh_in     = EST_WITH_ADAPTATION ? config->refresh_n : 0U;
    self->noise_variance = config->noise_variance;
    init_robustness(self);
    est_whitener_set(&self->whitener, config->c, config->na);
    clear_theta(self);
    forget_samples(self);
    est_factors_reset(self);
    self->trigger.quiet_n = config->trigger.warm_up_n;
    return true;
}

est_step_t est_step(est_t* const self, const est_sample_t sample) {
    EST_ASSERT(self != NULL);
    EST_ASSERT(within(self->config->forgetting, FORGETTING_MIN, 1.0F));  // else the configuration was overwritten
    float              y            = 0.0F;
    const est_status_t status       = examine(self, sample, &y);
    bool               has_equation = status == EST_UPDATED;
    est_step_t         step;  // enter_equation() completes that of EST_UPDATED
    step.status = status;
    step.alarm  = false;
    if (!has_equation) {
        step.innovation = 0.0F;
        step.statistic  = self->trigger.statistic;
        has_equation    = (status != EST_GATHERING) && enter_gap(self, status, &y);
    }
    if (has_equation) {
        enter_equation(self, est_shape_of(self->config), y, &step);
    }
    step.idle = EST_WITH_WATCH && (self->config->idle_n > 0U) && (self->edge_age_n >= self->config->idle_n);
    return step;
}

uint8_t est_theta_count(const est_t* const self) {
    EST_ASSERT(self != NULL);
    return (uint8_t)est_shape_count(est_shape_of(self->config));
}

float est_theta(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != NULL) && (index < est_theta_count(self)));
    float coefficients[EST_THETA_MAX + 1U];
    compute_coefficients(self, est_shape_of(self->config), coefficients);
    return coefficients[index + 1U];
}

void est_copy_theta(const est_t* const self, float* const out) {
    EST_ASSERT((self != NULL) && (out != NULL));
    float coefficients[EST_THETA_MAX + 1U];
    compute_coefficients(self, est_shape_of(self->config), coefficients);
    (void)append(out, &coefficients[1], EST_THETA_MAX);
}

float est_variance(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != NULL) && (index < est_theta_count(self)));
    const est_shape_t shape = est_shape_of(self->config);
    float             factor[EST_THETA_MAX + 1U];  // 0 for the first coefficient of A, then those of theta
    clear(factor, EST_THETA_MAX + 1U);
    factor[index + 1U] = 1.0F;
    if (est_delta_applies(self)) {
        est_delta_difference_both(factor, shape.na, shape.nb);
    }
    if (est_is_offset(shape, index)) {
        add_reference_factors(self, shape, factor);
    }
    return est_factors_variance(&self->factors, est_shape_count(shape), &factor[1]);
}

float est_noise_variance(const est_t* const self) {
    EST_ASSERT(self != NULL);
    return self->noise_variance;
}

float est_scale(const est_t* const self) {
    EST_ASSERT(self != NULL);
    return self->noise_variance * scale_factor(self);
}

float est_prefilter(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != NULL) && (index < EST_NA_MAX));
    return self->whitener.c[index];
}

est_counters_t est_counters(const est_t* const self) {
    EST_ASSERT(self != NULL);
    return self->counters;
}

bool est_invariants_hold(const est_t* const self) {
    if ((self == NULL) || (self->config == NULL) || !est_config_valid(self->config)) {
        return false;
    }
    for (uint_fast8_t i = 0U; i < EST_THETA_MAX; i++) {
        if (!(est_magnitude(self->theta[i]) <= FLT_MAX) || !within(self->factors.d[i], FLT_MIN, FLT_MAX)) {
            return false;
        }
    }
    return within(self->noise_variance, FLT_MIN, FLT_MAX) && within(self->trigger.statistic, 0.0F, FLT_MAX) &&
           within(self->factors.weight, FORGETTING_MIN * EST_WEIGHT_OVERDUE, 1.0F);
}
