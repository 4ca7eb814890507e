#include "est.h"
#include "est_edges.h"
#include "est_equation.h"
#include "est_trigger.h"

#include <float.h>
#include <stddef.h>

#ifndef EST_ASSERT
#ifdef NDEBUG  // a freestanding compiler has no assert.h
#define EST_ASSERT(x) ((void)0)
#else
#include <assert.h>
#define EST_ASSERT(x) assert(x)  // NOLINT(cppcoreguidelines-macro-usage)
#endif
#endif

/// The orders of the default configuration: those that the build has fixed, or ARX(2, 3) with offset as far as there is room, the
/// offset being the first to go, A the last.
#ifdef EST_FIXED_NA
#define DEFAULT_NA EST_FIXED_NA
#define DEFAULT_NB EST_FIXED_NB
#define DEFAULT_NK EST_FIXED_NK
#define DEFAULT_NC EST_FIXED_NC
#define DEFAULT_OFFSET EST_FIXED_OFFSET
#else
#if (EST_NA_MAX < 2) || (EST_THETA_MAX < 3)
#define DEFAULT_NA 1U
#else
#define DEFAULT_NA 2U
#endif
#define WANTED_NB ((EST_NB_MAX < 3U) ? EST_NB_MAX : 3U)
#define ROOM_NB (EST_THETA_MAX - DEFAULT_NA)
#define DEFAULT_NB ((WANTED_NB < ROOM_NB) ? WANTED_NB : ROOM_NB)
#define DEFAULT_NK 0U
#define DEFAULT_NC 0U
#define DEFAULT_OFFSET ((DEFAULT_NA + DEFAULT_NB) < EST_THETA_MAX)
#endif

/// How much less certain a slip leaves every parameter: enough for b's whose covariance is that of their neighbours (10 is
/// too little, false alarms follow), not so much that a change of the plant that goes on meanwhile passes unnoticed (10,000).
#define SLIP_DOUBT 1000.0F

/// P must not grow without bound between two looks at it.
#define FORGETTING_MIN 0.5F

/// C is the estimate of A with its zeros moved towards the origin by this factor: a C whose zeros lie on the unit circle
/// would remember for ever.
#define CONTRACTION 0.99F

/// C is left as it is while A is as near to it as this, as the sum of the squares of the coefficients' distances: the
/// innovations are then white enough, their variance at most 1 % too large with poles up to 0.95. A hundred times that may put a
/// zero of C on the unit circle.
#define REFRESH_STEP 8.0e-6F

/// Further away, again as a sum of squares, it makes another filter: what the old one left of the noise of the equations before
/// is not white to the new one, which therefore begins anew.
#define REFRESH_STRIDE 0.005F

/// The estimate remembers some 1 / (1 - forgetting) samples. After so many times that without an edge, what it says of A comes from
/// the noise, which any A = C fits: C would follow it anywhere.
#define REFRESH_MEMORIES 2.0F

/// The variance of the noise is followed at this rate. A squared innovation beyond NOISE_CLIP times what was expected
/// counts as no more, so that a change of the plant is not taken for noise; of Gaussian noise that keeps NOISE_KEPT.
#define NOISE_RATE 0.005F
#define NOISE_CLIP 9.0F
#define NOISE_KEPT 0.9851F

EST_OUTLINE void count(uint16_t* const counter) {
    *counter = (uint16_t)(*counter + ((*counter < UINT16_MAX) ? 1U : 0U));
}

EST_OUTLINE void count_long(uint32_t* const counter) { *counter += (*counter < UINT32_MAX) ? 1U : 0U; }

static uint8_t larger(const uint8_t a, const uint8_t b) { return (a > b) ? a : b; }

EST_OUTLINE bool within(const float x, const float low, const float high) { return (x >= low) && (x <= high); }

// ---------------------------------------------     CONFIGURATION      ---------------------------------------------

EST_WITHIN bool alike(const est_shape_t a, const est_shape_t b) {
    return (a.na == b.na) && (a.nb == b.nb) && (a.nk == b.nk) && (a.nc == b.nc) && (a.offset == b.offset);
}

EST_WITHIN est_shape_t asked_for(const est_config_t* const config) {
    return (est_shape_t){
        .na = config->na, .nb = config->nb, .nk = config->nk, .nc = config->nc, .offset = config->offset ? 1U : 0U
    };
}

static bool orders_valid(const est_config_t* const config) {
    return (config->na >= 1U) && (config->na <= EST_NA_MAX) && (config->nb >= 1U) && (config->nb <= EST_NB_MAX) &&
           (config->nk <= EST_NK_MAX) && (config->nc <= EST_NC_MAX) &&
           (est_shape_count(asked_for(config)) <= EST_THETA_MAX);
}

static bool variances_valid(const est_config_t* const config) {
    return within(config->p0, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->p0_offset, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->noise_variance, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->random_walk, 0.0F, EST_VARIANCE_MAX) && within(config->forgetting, FORGETTING_MIN, 1.0F);
}

static bool codes_valid(const est_config_t* const config) {
    return within(config->edge_codes, FLT_MIN, EST_CODE_LIMIT) &&
           within(config->code_low, -EST_CODE_LIMIT, EST_CODE_LIMIT) &&
           within(config->code_high, -EST_CODE_LIMIT, EST_CODE_LIMIT) && (config->code_low < config->code_high) &&
           (config->edge_instants >= EST_EDGES_LOCKED) && (config->edge_instants <= EST_EDGES_ANYWHERE);
}

static bool adaptive(const est_config_t* const config) {
    return (config->nc > 0U) || config->noise_estimated || (config->random_walk > 0.0F);
}

/// A build may have left something out, or know one shape only.
static bool in_this_build(const est_config_t* const config) {
    return alike(asked_for(config), est_shape_of(config)) &&
           (EST_WITH_EDGES || (config->edge_instants == EST_EDGES_LOCKED)) &&
           (EST_WITH_ADAPTATION || (!adaptive(config) && (config->refresh_n == 0U))) &&
           (EST_WITH_WATCH || ((config->stuck_n == 0U) && (config->idle_n == 0U)));
}

bool est_config_valid(const est_config_t* const config) {
    EST_ASSERT(config != NULL);
    return orders_valid(config) && est_whitener_accepts(config->c, config->na) && variances_valid(config) &&
           codes_valid(config) && in_this_build(config) && est_trigger_config_valid(&config->trigger);
}

// ---------------------------------------------        SAMPLES         ---------------------------------------------

static void shift_u(est_t* const self, const float newest) {
    EST_UNROLL
    for (uint_fast8_t i = EST_INPUTS_KEPT - 1U; i > 0U; i--) {
        self->u[i] = self->u[i - 1U];
    }
    self->u[0] = newest;
}

static void shift_y(est_t* const self, const float newest) {
    EST_UNROLL
    for (uint_fast8_t i = EST_NA_MAX - 1U; i > 0U; i--) {
        self->y[i] = self->y[i - 1U];
    }
    self->y[0] = newest;
}

/// How many samples before its own an equation reaches back to.
static inline uint8_t past_n(const est_config_t* const config) {
    return larger(config->na, (uint8_t)(config->nb + config->nk - 1U));
}

static void zero(float* const x, const uint_fast8_t n) {
    for (uint_fast8_t i = 0U; i < n; i++) {
        x[i] = 0.0F;
    }
}

/// What was believed before the doubt holds on, but for the b's, which move by one place: y(k) now depends on u(k-1) as it
/// did on u(k), or the other way round.
static void follow_slip(est_t* const self, const bool late) {
    const uint32_t     nb     = self->config->nb;
    float* const       b      = &self->theta[self->config->na];
    const float* const before = &self->edges.theta[self->config->na];
    const uint32_t     place  = late ? UINT32_MAX : 1U;  // where each b comes from, modulo 2^32
    for (uint_fast8_t i = 0U; i < EST_THETA_MAX; i++) {
        self->theta[i] = self->edges.theta[i];
    }
    for (uint32_t j = 0U; j < nb; j++) {
        b[j] = ((j + place) < nb) ? before[j + place] : 0.0F;
    }
    est_factors_inflate(&self->factors, self->config, SLIP_DOUBT);
}

/// The C that the estimate asks for. After convergence the noise of the equations is coloured by A itself (thesis section
/// 3.5: noise on the output).
EST_SHAPED void contracted(const est_t* const self, const uint_fast8_t na, float* const c) {
    float factor = 1.0F;
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        factor *= CONTRACTION;
        c[i] = (i < na) ? (self->theta[i] * factor) : 0.0F;
    }
}

static void refresh_prefilter(est_t* const self) {
    float c[EST_NA_MAX];
    contracted(self, est_shape_of(self->config).na, c);
    self->refresh_in = self->config->refresh_n;
    if (est_whitener_accepts(c, EST_NA_MAX)) {
        est_whitener_set(&self->whitener, c, EST_NA_MAX);
        count(&self->counters.refreshes);
    }
}

/// What an alarm, a slip or a C that moves far leaves to do.
static void renew(est_t* const self) {
    if (self->renewal == EST_RENEWAL_RESET) {
        est_factors_reset(&self->factors, self->config);
        if (EST_WITH_ADAPTATION) {
            self->refresh_in = self->config->refresh_n;
        }
    } else if (EST_WITH_EDGES && (self->renewal >= EST_RENEWAL_EARLY)) {
        follow_slip(self, self->renewal == EST_RENEWAL_LATE);
    } else if (EST_WITH_ADAPTATION && (self->renewal == EST_RENEWAL_PREFILTER)) {
        refresh_prefilter(self);
    } else {
        // they are as they should be
    }
    self->renewal = EST_RENEWAL_NONE;
}

/// They are of the equations before, and may be beyond all measure.
EST_INLINE void forget_residuals(est_t* const self) {
#if EST_NC_MAX > 0
    zero(self->residual, EST_NC_MAX);
#else
    (void)self;
#endif
}

/// One sample less to come before the next equation is complete. There is time here for what the step that found a change
/// left to do: that one is long enough.
EST_OUTLINE void gather(est_t* const self) {
    self->pending_n--;
    self->known = true;
    renew(self);
    if (self->pending_n == 0U) {
        est_whitener_restart(&self->whitener);
        forget_residuals(self);
        self->settled = false;
        count(&self->counters.restarts);
    }
}

/// The samples before the next are unknown, or belong to another plant.
EST_OUTLINE void forget_samples(est_t* const self) {
    if (self->known) {
        self->known     = false;
        self->pending_n = past_n(self->config);
        if (EST_WITH_EDGES) {
            self->doubt_n = 0U;
        }
    }
}

/// Of this world. False for NaN too.
static bool plausible(const float code) { return within(code, -EST_CODE_LIMIT, EST_CODE_LIMIT); }

/// Within the range of the converter. False for NaN and the infinities too.
static bool inside(const est_config_t* const config, const float code) {
    return (code > config->code_low) && (code < config->code_high);
}

/// Whether the two are the same number, to the bit.
static bool same(const float a, const float b) {
    typedef union {       // MISRA D5
        float    number;  // cppcheck F4
        uint32_t bits;
    } est_bits_t;
    const est_bits_t first  = { .number = a };  // MISRA D5
    const est_bits_t second = { .number = b };  // MISRA D5
    return first.bits == second.bits;
}

/// The plant answers every edge of u within a few samples: a y that stays the same to the bit comes from no plant, until it
/// is another. It may rest while u does.
EST_OUTLINE bool stuck(est_t* const self, const float y, const bool edge) {
    if (!same(y, self->y[0])) {
        self->same_n = 0U;
        return false;  // MISRA D4
    }
    const uint32_t watched = (edge ? 1U : 0U) | self->same_n;  // none: there is no edge that it has not answered
    if ((watched > 0U) && (self->same_n < UINT8_MAX)) {
        self->same_n++;
    }
    return (self->config->stuck_n > 0U) && (self->same_n >= self->config->stuck_n);
}

/// An edge joins the doubt about earlier ones if another reading of those is ahead, and otherwise begins a doubt of its own.
static void doubt_edge(est_t* const self) {
    if ((self->doubt_n > 0U) && est_trigger_in_doubt(&self->trigger)) {
        return;  // MISRA D4
    }
    const float step = self->u[0] - self->u[1];
    self->doubt_n    = 1U;
    est_edges_begin(&self->edges, self->config, self->theta, step);
    est_trigger_begin_doubt(&self->trigger);
}

static void enter_edge(est_t* const self) {
    self->edge_age_n = 0U;
    if (!EST_WITH_EDGES) {
        return;  // MISRA D4
    }
    if ((self->config->edge_instants == EST_EDGES_MAY_SLIP) && (self->config->trigger.kind == EST_TRIGGER_CUSUM)) {
        doubt_edge(self);
    } else if (self->config->edge_instants == EST_EDGES_ANYWHERE) {
        self->pending_n = larger(self->pending_n, self->config->na);
    } else {
        // the b's take it in
    }
}

/// Takes in u(k). The equation of this sample can be made unless the samples that it reaches back to are not all known.
static est_status_t enter_input(est_t* const self, const est_sample_t sample) {
    shift_u(self, sample.u);
    const bool edge = EST_KNOWS_EDGES && est_edges_is_edge(self->config, self->u) && self->known;
    if (EST_WITH_WATCH && stuck(self, sample.y, edge)) {
        count(&self->counters.stuck);
        return EST_REFUSED;  // MISRA D4
    }
    if (EST_KNOWS_EDGES) {
        count(&self->edge_age_n);
    }
    if (EST_WITH_EDGES && (self->doubt_n > 0U)) {
        self->doubt_n = (self->doubt_n < EST_DOUBT_N) ? (uint8_t)(self->doubt_n + 1U) : 0U;
    }
    if (edge) {
        enter_edge(self);
    }
    count_long(&self->counters.updated);
    if (self->pending_n > 0U) {
        gather(self);
        return EST_GATHERING;  // MISRA D4
    }
    return EST_UPDATED;
}

/// Whether the sample is one, and what will become of it.
static est_status_t examine(est_t* const self, const est_sample_t sample) {
    if (!sample.valid) {
        return EST_MISSING;  // MISRA D4
    }
    if (inside(self->config, sample.u) && inside(self->config, sample.y)) {
        return enter_input(self, sample);  // MISRA D4
    }
    if (EST_WITH_WATCH && plausible(sample.u) && plausible(sample.y)) {
        count(&self->counters.saturated);
    }
    return EST_REFUSED;
}

// ---------------------------------------------       EQUATIONS        ---------------------------------------------

/// What the innovation says in the other readings of the edges in doubt. The estimate has followed what was recorded since, so
/// that they are taken against what was believed before the doubt.
EST_INLINE est_finding_t read_otherwise(est_t* const                self,
                                        const est_shape_t           shape,
                                        const est_equation_t* const equation,
                                        const float                 weight) {
    const float e = (self->doubt_n > 1U)
                        ? est_equation_residual(equation->phi, self->edges.theta, est_shape_count(shape))
                        : equation->innovation;  // theta has not moved since
    float       early;
    float       late;
    est_edges_shares(&self->edges, shape, &self->whitener, self->u, self->doubt_n, self->edge_age_n, &early, &late);
    return est_trigger_find_in_doubt(&self->trigger, self->config->trigger.ceiling, e - early, e - late, weight,
                                     self->doubt_n >= EST_DOUBT_N);
}

#if EST_NC_MAX > 0
static void shift(float* const x, const uint_fast8_t n, const float newest) {
    for (uint_fast8_t i = (uint_fast8_t)(n - 1U); i > 0U; i--) {
        x[i] = x[i - 1U];
    }
    x[0] = newest;
}
#endif

/// The residual of an equation, after its update, stands in for its e in the next ones (thesis section 3.5).
static void keep_residual(est_t* const self, const float* const phi) {
#if EST_NC_MAX > 0
    if (self->config->nc > 0U) {
        shift(self->residual, self->config->nc, est_equation_residual(phi, self->theta, est_theta_count(self)));
    }
#else
    (void)self;
    (void)phi;
#endif
}

/// `precision`: the reciprocal of the innovation's variance over that of the noise.
static void follow_noise(est_t* const self, const float innovation, const float precision) {
    const float square   = innovation * innovation * precision;
    const float ceiling  = NOISE_CLIP * self->noise_variance;
    const float clipped  = (square < ceiling) ? square : ceiling;
    const float noise    = self->noise_variance + (NOISE_RATE * ((clipped / NOISE_KEPT) - self->noise_variance));
    self->noise_variance = (noise > EST_VARIANCE_MIN) ? noise : EST_VARIANCE_MIN;
}

/// How far these coefficients are from the C in use, squared.
EST_INLINE float distance(const est_whitener_t* const whitener, const float* const c) {
    const float first = c[0] - whitener->c[0];
    float       sum   = first * first;
    EST_UNROLL
    for (uint_fast8_t i = 1U; i < EST_NA_MAX; i++) {
        const float step = c[i] - whitener->c[i];
        sum += step * step;
    }
    return sum;
}

static bool remembers_edge(const est_t* const self) {
    return ((1.0F - self->config->forgetting) * (float)self->edge_age_n) < REFRESH_MEMORIES;
}

/// Where C moves far, or the gains are on their way to it anyway, the whitening begins anew: C is then taken with the next
/// sample, which has no equation.
EST_INLINE void compare_prefilter(est_t* const self, const est_shape_t shape) {
    float c[EST_NA_MAX];
    contracted(self, shape.na, c);
    const float moved = distance(&self->whitener, c);
    if (moved < REFRESH_STEP) {
        self->renewal    = EST_RENEWAL_NONE;
        self->refresh_in = self->config->refresh_n;
        return;  // MISRA D4
    }
    self->renewal = EST_RENEWAL_PREFILTER;
    if (!self->settled || (moved > REFRESH_STRIDE)) {
        self->pending_n = 1U;
    }
}

/// Whether the estimate is worth taking C from, whether C is still near to it, and to take it are for three equations, so
/// that no step is a long one. Not while edges are in doubt: theta may have followed what did not happen.
EST_INLINE void consider_refresh(est_t* const self, const est_shape_t shape) {
    if (EST_WITH_EDGES && (self->doubt_n > 0U)) {
        self->renewal = EST_RENEWAL_NONE;
    } else if (self->renewal == EST_RENEWAL_COMPARE) {
        compare_prefilter(self, shape);
    } else if (self->renewal == EST_RENEWAL_PREFILTER) {
        self->renewal = EST_RENEWAL_NONE;
        refresh_prefilter(self);
    } else if (remembers_edge(self)) {
        self->renewal = EST_RENEWAL_COMPARE;
    } else {
        // A comes from noise
    }
}

// ---------------------------------------------        CHANGES         ---------------------------------------------

/// The plant has changed, and the samples before the next belong to what it was. Data beyond all measure can drive theta to where
/// its products overflow. So does the statistic then, and nothing of the estimate is worth keeping.
static void raise_alarm(est_t* const self, est_step_t* const step) {
    step->alarm          = true;
    const bool overflown = !(step->statistic < FLT_MAX);
    if (overflown) {
        step->statistic = FLT_MAX;
    }
    if (overflown || (self->config->trigger.reset == EST_RESET_ALL)) {
        zero(self->theta, EST_THETA_MAX);
    }
    if (EST_WITH_ADAPTATION && overflown) {  // the residuals among the regressors may have been, too
        est_factors_reset(&self->factors, self->config);
    }
    self->renewal = EST_RENEWAL_RESET;
    est_trigger_restart(&self->trigger, self->config->trigger.hold_off_n);
    count(&self->counters.alarms);
    forget_samples(self);
}

/// The clock of the edges has moved by a sample, and the samples before the next belong to what it was.
EST_OUTLINE void note_slip(est_t* const self) {
    self->renewal = est_trigger_settle_late(&self->trigger) ? EST_RENEWAL_LATE : EST_RENEWAL_EARLY;
    count(&self->counters.slips);
    forget_samples(self);
}

static void enter_gap(est_t* const self, const est_status_t status) {
    if (status == EST_REFUSED) {
        count(&self->counters.refused);
    } else {
        count_long(&self->counters.missing);
    }
    if (EST_WITH_EDGES && self->known && (self->doubt_n > 0U)) {
        if (est_trigger_end_doubt(&self->trigger, &self->config->trigger)) {
            note_slip(self);
        }
    }
    forget_samples(self);
}

/// What an equation says besides theta.
static void adapt(est_t* const self, const float* const phi, const float innovation, const float precision) {
    const est_config_t* const config = self->config;
    if (config->random_walk > 0.0F) {
        est_factors_walk(&self->factors, config);
        est_factors_inflate(&self->factors, config, 1.0F);
    }
    keep_residual(self, phi);
    if (config->noise_estimated) {
        follow_noise(self, innovation, precision);
    }
}

/// P is kept bounded in a step that has nothing else to do besides, if there is one in time.
EST_INLINE void limit_factors(est_t* const self, const est_shape_t shape) {
    const bool busy = (EST_WITH_EDGES && (self->doubt_n > 0U)) || (EST_WITH_ADAPTATION && (self->refresh_in == 1U));
    if (!busy || (self->factors.weight < EST_WEIGHT_OVERDUE)) {
        if (EST_FOR_SIZE) {
            est_factors_inflate(&self->factors, self->config, 1.0F);
        } else {
            est_factors_scale(&self->factors, self->config, shape, 1.0F);
        }
    }
}

EST_INLINE void enter_equation(est_t* const self, const est_shape_t shape, const float y, est_step_t* const step) {
    const est_config_t* const config = self->config;
    est_equation_t            equation;
    float                     weight_min;
    if (self->settled) {
        equation.variance = 1.0F;
        weight_min        = EST_WEIGHT_DUE;
    } else {
        equation.variance = est_whitener_advance(&self->whitener, &self->settled);
        weight_min        = EST_WEIGHT_OVERDUE;
    }
    if (self->factors.weight < weight_min) {
        limit_factors(self, shape);
    }
    est_equation_fill(self, shape, y, equation.phi);
    est_equation_whiten(&equation, shape, &self->whitener, self->theta);
    const float precision = est_equation_measure(&self->factors, config->forgetting, shape, &equation, self->theta);
    if (EST_WITH_ADAPTATION && self->adaptive) {
        adapt(self, equation.phi, equation.innovation, precision);
    }
    const bool  held   = est_trigger_holds(&self->trigger, config->trigger.kind);
    const float weight = (held ? 0.0F : EST_CUSUM_GAIN) * (precision / self->noise_variance);
    est_trigger_enter(&self->trigger, &config->trigger, equation.innovation, weight, held);
    step->innovation      = equation.innovation;
    step->statistic       = self->trigger.statistic;
    est_finding_t finding = (self->trigger.statistic < config->trigger.ceiling) ? EST_QUIET : EST_ALARM;
    if (EST_WITH_EDGES && (self->doubt_n > 0U)) {
        finding = read_otherwise(self, shape, &equation, weight);
    }
    if (finding == EST_ALARM) {
        raise_alarm(self, step);
    } else if (EST_WITH_EDGES && (finding == EST_SLIP)) {
        note_slip(self);
    } else if (EST_WITH_ADAPTATION && (self->refresh_in > 1U)) {
        self->refresh_in--;
    } else if (EST_WITH_ADAPTATION && (self->refresh_in == 1U)) {
        consider_refresh(self, shape);
    } else {
        // C stays
    }
}

/// The usual shapes have code of their own, unless the build has one anyway, or room is scarce.
static void enter_equation_of_any_shape(est_t* const self, const float y, est_step_t* const step) {
    const est_shape_t shape = est_shape_of(self->config);
#if !defined(EST_FIXED_NA) && !EST_FOR_SIZE && (EST_NA_MAX >= 2U) && (EST_NB_MAX >= 3U) && (EST_NK_MAX >= 1U) &&       \
    (EST_THETA_MAX >= 6U)
    const est_shape_t locked       = { .na = 2U, .nb = 2U, .nk = 1U, .nc = 0U, .offset = 0U };
    const est_shape_t free_running = { .na = 2U, .nb = 3U, .nk = 0U, .nc = 0U, .offset = 1U };
    if (alike(shape, free_running)) {
        enter_equation(self, free_running, y, step);
        return;  // MISRA D4
    }
    if (alike(shape, locked)) {
        enter_equation(self, locked, y, step);
        return;  // MISRA D4
    }
#endif
    enter_equation(self, shape, y, step);
}

// ---------------------------------------------          API           ---------------------------------------------

/// A copy as such, or gcc makes instructions of it that store each field.
EST_OUTLINE est_config_t copied(const est_config_t* const config) { return *config; }

est_config_t est_config_default(void) {
    static const est_config_t config = {  // MISRA D2
        .na             = (uint8_t)DEFAULT_NA,
        .nb             = (uint8_t)DEFAULT_NB,
        .nk             = (uint8_t)DEFAULT_NK,
        .nc             = (uint8_t)DEFAULT_NC,
        .offset         = DEFAULT_OFFSET,
        .refresh_n      = EST_WITH_ADAPTATION ? 40U : 0U,
        .stuck_n        = EST_WITH_WATCH ? 16U : 0U,
        .idle_n         = EST_WITH_WATCH ? 1000U : 0U,
        .edge_instants  = EST_WITH_EDGES ? EST_EDGES_MAY_SLIP : EST_EDGES_LOCKED,
        .forgetting     = 0.99F,
        .random_walk    = 0.0F,
        .p0             = 10.0F,
        .p0_offset      = 1.0e6F,
        .noise_variance = 1.2F,
#if DEFAULT_NA > 1
        .c = { -1.6F, 0.64F },
#else
        .c = { -0.8F },
#endif
        .edge_codes = 64.0F,
        .code_low   = -EST_CODE_LIMIT,
        .code_high  = EST_CODE_LIMIT,
        .trigger    = { .kind       = EST_TRIGGER_CUSUM,
                        .reset      = EST_RESET_COVARIANCE,
                        .absolute   = false,
                        .hold_off_n = 0U,
                        .warm_up_n  = 150U,
                        .ceiling    = 11.512925F },
    };
    return copied(&config);
}

bool est_init(est_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != NULL) && (config != NULL));
    if (EST_WITH_CHECKS && !est_config_valid(config)) {
        return false;  // MISRA D4
    }
    *self                = (est_t){ .config = config };
    self->adaptive       = EST_WITH_ADAPTATION && adaptive(config);
    self->refresh_in     = EST_WITH_ADAPTATION ? config->refresh_n : 0U;
    self->noise_variance = config->noise_variance;
    est_whitener_set(&self->whitener, config->c, config->na);
    self->pending_n = past_n(config);
    est_factors_reset(&self->factors, config);
    est_trigger_restart(&self->trigger, config->trigger.warm_up_n);
    return true;
}

est_step_t est_step(est_t* const self, const est_sample_t sample) {
    EST_ASSERT(self != NULL);
    est_step_t step = { .status = examine(self, sample), .alarm = false, .innovation = 0.0F };
    step.statistic  = self->trigger.statistic;
    if ((step.status == EST_MISSING) || (step.status == EST_REFUSED)) {
        enter_gap(self, step.status);
    } else {
        if (step.status == EST_UPDATED) {
            enter_equation_of_any_shape(self, sample.y, &step);
        }
        shift_y(self, sample.y);
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
    return self->theta[index];
}

float est_variance(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != NULL) && (index < est_theta_count(self)));
    return est_factors_variance(&self->factors, est_theta_count(self), index);
}

float est_noise_variance(const est_t* const self) {
    EST_ASSERT(self != NULL);
    return self->noise_variance;
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
        return false;  // MISRA D4
    }
    for (uint_fast8_t i = 0U; i < est_theta_count(self); i++) {
        if (!within(self->factors.d[i], FLT_MIN, FLT_MAX) || !within(self->theta[i], -FLT_MAX, FLT_MAX)) {
            return false;  // MISRA D4
        }
    }
    return within(self->factors.weight, FORGETTING_MIN * EST_WEIGHT_OVERDUE, 1.0F) &&
           within(self->trigger.statistic, 0.0F, FLT_MAX) && within(self->noise_variance, EST_VARIANCE_MIN, FLT_MAX);
}
