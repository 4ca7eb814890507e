#include "est.h"
#include "est_edges.h"
#include "est_factors.h"
#include "est_orders.h"
#include "est_trigger.h"
#include "est_whitener.h"

#include <float.h>

#ifndef EST_ASSERT
#include <assert.h>
#define EST_ASSERT(x) assert(x)  // NOLINT(cppcoreguidelines-macro-usage)
#endif

/// The orders of the default configuration, as far as this build has room for them.
#define DEFAULT_NA ((EST_NA_MAX < 2U) ? EST_NA_MAX : 2U)
#define DEFAULT_NB ((EST_NB_MAX < 3U) ? EST_NB_MAX : 3U)

/// How much less certain a slip leaves every parameter: enough for b's whose covariance is that of their neighbours (10 is
/// too little, false alarms follow), not so much that a change of the plant that goes on meanwhile passes unnoticed (10,000).
#define SLIP_DOUBT 1000.0F

/// C is the estimate of A with its zeros moved towards the origin by this factor: a C whose zeros lie on the unit circle
/// would remember for ever.
#define CONTRACTION 0.99F

/// C is left as it is while every coefficient of A is as near to it as this: the innovations are white enough.
#define REFRESH_STEP 0.02F

/// The variance of the noise is followed at this rate. A squared innovation beyond NOISE_CLIP times what was expected
/// counts as no more, so that a change of the plant is not taken for noise; of Gaussian noise that keeps NOISE_KEPT.
#define NOISE_RATE 0.005F
#define NOISE_CLIP 9.0F
#define NOISE_KEPT 0.9851F

static void count(uint16_t* const counter) { *counter = (uint16_t)(*counter + ((*counter < UINT16_MAX) ? 1U : 0U)); }

static void count_long(uint32_t* const counter) { *counter += (*counter < UINT32_MAX) ? 1U : 0U; }

static uint8_t larger(const uint8_t a, const uint8_t b) { return (a > b) ? a : b; }

static bool within(const float x, const float low, const float high) { return (x >= low) && (x <= high); }

// ---------------------------------------------     CONFIGURATION      ---------------------------------------------

static uint8_t parameters(const est_config_t* const config) {
    return (uint8_t)((uint32_t)NA(config) + NB(config) + NC(config) + (OFFSET(config) ? 1U : 0U));
}

static est_prior_t prior_of(const est_config_t* const config) {
    return (est_prior_t){ .p0 = config->p0, .p0_last = OFFSET(config) ? config->p0_offset : config->p0 };
}

static bool orders_fixed(const est_config_t* const config) {
    return (config->na == NA(config)) && (config->nb == NB(config)) && (config->nk == NK(config)) &&
           (config->nc == NC(config)) && (config->offset == OFFSET(config));
}

static bool orders_valid(const est_config_t* const config) {
    return (config->na >= 1U) && (config->na <= EST_NA_MAX) && (config->nb >= 1U) && (config->nb <= EST_NB_MAX) &&
           (config->nk <= EST_NK_MAX) && (config->nc <= EST_NC_MAX) && orders_fixed(config) &&
           (parameters(config) <= EST_THETA_MAX);
}

static bool variances_valid(const est_config_t* const config) {
    return within(config->p0, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->p0_offset, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->noise_variance, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->random_walk, 0.0F, EST_VARIANCE_MAX) && within(config->forgetting, 0.5F, 1.0F);
}

static bool codes_valid(const est_config_t* const config) {
    return within(config->edge_codes, FLT_MIN, EST_CODE_LIMIT) &&
           within(config->code_low, -EST_CODE_LIMIT, EST_CODE_LIMIT) &&
           within(config->code_high, -EST_CODE_LIMIT, EST_CODE_LIMIT) && (config->code_low < config->code_high) &&
           (config->edge_instants >= EST_EDGES_LOCKED) && (config->edge_instants <= EST_EDGES_ANYWHERE);
}

bool est_config_valid(const est_config_t* const config) {
    EST_ASSERT(config != 0);
    return orders_valid(config) && est_whitener_accepts(config->c, config->na) && variances_valid(config) &&
           codes_valid(config) && est_trigger_config_valid(&config->trigger);
}

// ---------------------------------------------        SAMPLES         ---------------------------------------------

/// False for NaN too.
static bool plausible(const float code) { return within(code, -EST_CODE_LIMIT, EST_CODE_LIMIT); }

static bool saturated(const est_config_t* const config, const float code) {
    return (code <= config->code_low) || (code >= config->code_high);
}

static void shift(float* const x, const uint8_t n, const float newest) {
    for (uint8_t i = (uint8_t)(n - 1U); i > 0U; i--) {
        x[i] = x[i - 1U];
    }
    x[0] = newest;
}

/// How many samples before its own an equation reaches back to.
static uint8_t past_n(const est_config_t* const config) {
    return larger(NA(config), (uint8_t)(NB(config) + NK(config) - 1U));
}

/// The next equation is at least `pending_n` samples away, and the first of its kind.
static void restart(est_t* const self, const uint8_t pending_n) {
    self->pending_n = larger(self->pending_n, pending_n);
}

/// One sample less to come before the next equation is complete.
static void gather(est_t* const self) {
    self->pending_n--;
    if (self->pending_n == 0U) {
        est_whitener_restart(&self->whitener);
        count(&self->counters.restarts);
    }
}

/// The samples before the next are unknown, or belong to another plant.
static void forget_samples(est_t* const self) {
    if (self->known) {
        self->known  = false;
        self->same_n = 0U;
        est_edges_forget(&self->edges);
        restart(self, past_n(self->config));
    }
}

/// The plant answers every edge of u within a few samples: a y that stays the same to the bit comes from no plant.
static bool stuck(est_t* const self, const float y, const bool edge) {
    const bool same = self->known && !((y < self->y[0]) || (y > self->y[0]));
    if (!same) {
        self->same_n = 0U;
    } else if (edge || (self->same_n > 0U)) {
        count(&self->same_n);
    } else {
        // y may rest while u does
    }
    return (self->config->stuck_n > 0U) && (self->same_n >= self->config->stuck_n);
}

/// An edge joins the doubt about earlier ones if another reading of those is ahead, and otherwise begins a doubt of its own.
/// A doubt that has lasted its term has been decided by est_trigger_step().
static void enter_edge(est_t* const self, const float height) {
    const bool expired = self->edges.age_n >= EST_DOUBT_N;
    if (expired) {
        est_edges_forget(&self->edges);
    }
    const bool edge  = (height > 0.0F) || (height < 0.0F);
    const bool joins = !expired && est_trigger_in_doubt(&self->trigger);
    if (edge && (self->config->edge_instants == EST_EDGES_ANYWHERE)) {
        restart(self, NA(self->config));
    }
    if (edge && !joins && (self->config->edge_instants == EST_EDGES_MAY_SLIP)) {
        est_edges_begin(&self->edges, self->config, self->theta, self->count, height, self->pending_n == 0U);
        est_trigger_begin_doubt(&self->trigger);
        self->edges.age_n = 1U;
    } else if (self->edges.age_n > 0U) {
        self->edges.age_n++;
    } else {
        // no doubt
    }
}

// ---------------------------------------------       EQUATIONS        ---------------------------------------------

/// The regressor in the order of theta, and y(k) last.
static void fill_equation(const est_t* const self, const float y, float* const phi) {
    const est_config_t* const config = self->config;
    float*                    out    = phi;
    EST_UNROLL
    for (uint8_t i = 0U; i < NA(config); i++) {
        *out++ = -self->y[i];
    }
    EST_UNROLL
    for (uint8_t i = 0U; i < NB(config); i++) {
        *out++ = self->u[NK(config) + i];
    }
    EST_UNROLL
    for (uint8_t i = 0U; i < NC(config); i++) {
        *out++ = self->residual[i];
    }
    if (OFFSET(config)) {
        *out++ = 1.0F;
    }
    *out = y;
}

static float predicted(const est_t* const self, const float* const phi, const float* const theta) {
    float out = 0.0F;
    EST_UNROLL
    for (uint8_t i = 0U; i < COUNT(self->count); i++) {
        out += phi[i] * theta[i];
    }
    return out;
}

/// Three readings of the innovation: as recorded, and with the edges in doubt moved by one sample. The estimate has
/// followed what was recorded since, so the other two are taken against what was believed before the doubt.
static void read_innovation(est_t* const self, const float* const phi, float* const readings) {
    const float y = phi[COUNT(self->count)];
    readings[0]   = y - predicted(self, phi, self->theta);
    if (self->edges.age_n == 0U) {
        return;
    }
    const float e = y - predicted(self, phi, self->edges.theta);
    float       early;
    float       late;
    est_edges_shares(&self->edges, self->config, &self->whitener, self->u, &early, &late);
    readings[1] = e - early;
    readings[2] = e - late;
}

/// Thesis Equ 3.19, 3.21 on the whitened equation. Returns the innovation's variance over that of the noise.
static float update_estimate(est_t* const self, const float* const phi, const float innovation, const float variance) {
    const est_config_t* const config = self->config;
    float                     gain[EST_THETA_MAX];
    const float               alpha = est_factors_measure(
        &self->factors, self->count, prior_of(config), phi, config->forgetting, variance, gain);
    const float scale = innovation / alpha;
    EST_UNROLL
    for (uint8_t i = 0U; i < COUNT(self->count); i++) {
        self->theta[i] += gain[i] * scale;
    }
    if (config->random_walk > 0.0F) {
        est_factors_walk(&self->factors, self->count, prior_of(config), config->random_walk);
    }
    return alpha / config->forgetting;
}

/// The residual of an equation, after its update, stands in for its e in the next ones (thesis section 3.5).
static void keep_residual(est_t* const self, const float* const phi) {
    if (NC(self->config) > 0U) {
        shift(self->residual, NC(self->config), phi[COUNT(self->count)] - predicted(self, phi, self->theta));
    }
}

static void follow_noise(est_t* const self, const float innovation, const float variance) {
    const float square  = (innovation * innovation) / variance;
    const float ceiling = NOISE_CLIP * self->noise_variance;
    const float clipped = (square < ceiling) ? square : ceiling;
    const float noise   = self->noise_variance + (NOISE_RATE * ((clipped / NOISE_KEPT) - self->noise_variance));
    self->noise_variance = (noise > EST_VARIANCE_MIN) ? noise : EST_VARIANCE_MIN;
}

/// After convergence the noise of the equations is coloured by A itself (thesis section 3.5: noise on the output).
static void refresh_prefilter(est_t* const self) {
    const uint8_t na = NA(self->config);
    float         c[EST_NA_MAX];
    float         factor = 1.0F;
    bool          moved  = false;
    for (uint8_t i = 0U; i < na; i++) {
        factor *= CONTRACTION;
        c[i]  = self->theta[i] * factor;
        moved = moved || !within(c[i] - self->whitener.c[i], -REFRESH_STEP, REFRESH_STEP);
    }
    self->equations_n = 0U;
    if (moved && est_whitener_accepts(c, na)) {
        est_whitener_set(&self->whitener, c, na);
        count(&self->counters.refreshes);
    }
}

// ---------------------------------------------        CHANGES         ---------------------------------------------

/// What was believed before the doubt holds on, but for the b's, which move by one place: y(k) now depends on u(k-1) as it
/// did on u(k), or the other way round. The statistic goes on as this reading has it, so that a change is not lost in it.
static void follow_slip(est_t* const self) {
    const uint8_t nb = NB(self->config);
    float* const  b  = &self->theta[NA(self->config)];
    for (uint8_t i = 0U; i < self->count; i++) {
        self->theta[i] = self->edges.theta[i];
    }
    est_factors_inflate(&self->factors, self->count, prior_of(self->config), SLIP_DOUBT);
    if (est_trigger_settle_late(&self->trigger)) {
        shift(b, nb, 0.0F);
        return;
    }
    for (uint8_t j = 0U; j < nb; j++) {
        b[j] = ((j + 1U) < nb) ? b[j + 1U] : 0.0F;
    }
}

static void zero(float* const x, const uint8_t n) {
    for (uint8_t i = 0U; i < n; i++) {
        x[i] = 0.0F;
    }
}

static void estimate_afresh(est_t* const self) {
    if (self->config->trigger.reset == EST_RESET_ALL) {
        zero(self->theta, self->count);
    }
    self->equations_n = 0U;
    est_factors_reset(&self->factors, self->count, prior_of(self->config));
    est_trigger_restart(&self->trigger, self->config->trigger.hold_off_n);
}

static void react(est_t* const self, const est_finding_t finding) {
    if (finding == EST_QUIET) {
        return;
    }
    if (finding == EST_ALARM) {
        count(&self->counters.alarms);
        estimate_afresh(self);
    } else {
        count(&self->counters.slips);
        follow_slip(self);
    }
    forget_samples(self);  // they belong to the plant, or the clock, as it was
}

static bool idle(const est_t* const self) {
    return (self->config->idle_n > 0U) && (self->idle_n >= self->config->idle_n);
}

static est_step_t no_equation(const est_t* const self, const est_status_t status) {
    return (est_step_t){
        .status = status, .alarm = false, .idle = idle(self), .innovation = 0.0F, .statistic = self->trigger.statistic
    };
}

static est_step_t enter_gap(est_t* const self, const est_status_t status) {
    count_long((status == EST_REFUSED) ? &self->counters.refused : &self->counters.missing);
    if (self->known && (self->edges.age_n > 0U)) {
        react(self, est_trigger_end_doubt(&self->trigger, &self->config->trigger));
    }
    forget_samples(self);
    return no_equation(self, status);
}

// ---------------------------------------------          API           ---------------------------------------------

est_config_t est_config_default(void) {
    est_config_t config = {
        .na             = (uint8_t)DEFAULT_NA,
        .nb             = (uint8_t)DEFAULT_NB,
        .nk             = 0U,
        .nc             = 0U,
        .offset         = true,
        .stuck_n        = 16U,
        .idle_n         = 1000U,
        .edge_instants  = EST_EDGES_MAY_SLIP,
        .forgetting     = 0.9925F,
        .random_walk    = 0.0F,
        .p0             = 10.0F,
        .p0_offset      = 1.0e6F,
        .noise_variance = 1.2F,
        .c              = { 0.0F },
        .edge_codes     = 64.0F,
        .code_low       = -EST_CODE_LIMIT,
        .code_high      = EST_CODE_LIMIT,
        .trigger        = { .kind       = EST_TRIGGER_CUSUM,
                            .reset      = EST_RESET_COVARIANCE,
                            .absolute   = false,
                            .hold_off_n = 0U,
                            .warm_up_n  = 0U,
                            .ceiling    = 11.512925F },
    };
#if EST_NA_MAX >= 2
    config.c[0] = -1.6F;
    config.c[1] = 0.64F;
#endif
    return config;
}

bool est_init(est_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != 0) && (config != 0));
    if (!est_config_valid(config)) {
        return false;
    }
    *self                = (est_t){ .config = config };
    self->count          = parameters(config);
    self->noise_variance = config->noise_variance;
    est_whitener_set(&self->whitener, config->c, config->na);
    restart(self, past_n(config));
    est_factors_reset(&self->factors, self->count, prior_of(config));
    est_trigger_restart(&self->trigger, config->trigger.warm_up_n);
    return true;
}

/// Takes in u(k); the equation of this sample can be made unless the samples before are not all known. False: stuck.
static bool enter_input(est_t* const self, const est_sample_t sample) {
    const est_config_t* const config = self->config;
    shift(self->u, (uint8_t)(NB(config) + NK(config) + 1U), sample.u);
    const float height = self->known ? est_edges_height(config, self->u) : 0.0F;
    const bool  edge   = (height > 0.0F) || (height < 0.0F);
    if (stuck(self, sample.y, edge)) {
        return false;
    }
    if (edge) {
        self->idle_n = 0U;
    } else {
        count(&self->idle_n);
    }
    enter_edge(self, height);
    self->known = true;
    return true;
}

static est_step_t enter_equation(est_t* const self, const float y) {
    const est_config_t* const config = self->config;
    float                     phi[EST_THETA_MAX + 1U];
    float                     readings[EST_READINGS] = { 0.0F };
    fill_equation(self, y, phi);
    const float whitened = est_whitener_advance(&self->whitener, NA(config));
    est_whitener_apply(&self->whitener, NA(config), self->count, phi);
    read_innovation(self, phi, readings);
    const float variance = update_estimate(self, phi, readings[0], whitened);
    keep_residual(self, phi);
    count(&self->equations_n);

    const est_finding_t finding = est_trigger_step(
        &self->trigger, &config->trigger, readings, variance * self->noise_variance, self->edges.age_n);
    const est_step_t step = { .status     = EST_UPDATED,
                              .alarm      = finding == EST_ALARM,
                              .idle       = idle(self),
                              .innovation = readings[0],
                              .statistic  = self->trigger.statistic };
    if (config->noise_estimated) {
        follow_noise(self, readings[0], variance);
    }
    react(self, finding);
    if ((config->refresh_n > 0U) && (self->equations_n >= config->refresh_n) && (self->edges.age_n == 0U)) {
        refresh_prefilter(self);
    }
    return step;
}

est_step_t est_step(est_t* const self, const est_sample_t sample) {
    EST_ASSERT(self != 0);
    if (!sample.valid) {
        return enter_gap(self, EST_MISSING);
    }
    if (!plausible(sample.u) || !plausible(sample.y)) {
        return enter_gap(self, EST_REFUSED);
    }
    if (saturated(self->config, sample.u) || saturated(self->config, sample.y)) {
        count(&self->counters.saturated);
        return enter_gap(self, EST_REFUSED);
    }
    if (!enter_input(self, sample)) {
        count(&self->counters.stuck);
        return enter_gap(self, EST_REFUSED);
    }
    count_long(&self->counters.updated);
    est_step_t step;
    if (self->pending_n > 0U) {
        gather(self);
        step = no_equation(self, EST_GATHERING);
    } else {
        step = enter_equation(self, sample.y);
    }
    shift(self->y, NA(self->config), sample.y);
    return step;
}

uint8_t est_theta_count(const est_t* const self) {
    EST_ASSERT(self != 0);
    return self->count;
}

float est_theta(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != 0) && (index < self->count));
    return self->theta[index];
}

float est_variance(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != 0) && (index < self->count));
    return est_factors_variance(&self->factors, self->count, index);
}

float est_noise_variance(const est_t* const self) {
    EST_ASSERT(self != 0);
    return self->noise_variance;
}

est_counters_t est_counters(const est_t* const self) {
    EST_ASSERT(self != 0);
    return self->counters;
}

bool est_invariants_hold(const est_t* const self) {
    if ((self == 0) || (self->config == 0) || !est_config_valid(self->config) || (self->count != parameters(self->config))) {
        return false;
    }
    for (uint8_t i = 0U; i < self->count; i++) {
        if (!within(self->factors.d[i], FLT_MIN, FLT_MAX) || !within(self->theta[i], -FLT_MAX, FLT_MAX)) {
            return false;
        }
    }
    return within(self->trigger.statistic, 0.0F, FLT_MAX) && within(self->noise_variance, EST_VARIANCE_MIN, FLT_MAX);
}
