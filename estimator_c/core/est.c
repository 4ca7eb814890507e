#include "est.h"
#include "est_edges.h"
#include "est_trigger.h"

#include <float.h>

#ifndef EST_ASSERT
#include <assert.h>
#define EST_ASSERT(x) assert(x)  // NOLINT(cppcoreguidelines-macro-usage)
#endif

/// Prior variance of an initial condition, in noise variances: the past of a signal of any code below EST_CODE_LIMIT is
/// as good as unknown, and one float32 update still brings it down to the order of one.
#define UNKNOWN_VARIANCE 1.0e9F

/// The initial conditions are dropped once their regressors are this small: the largest, times any signal that the
/// default orders can filter, is then far below one code.
#define IMPULSE_NEGLIGIBLE 1.0e-7F

/// Certain beyond the precision of float32 by any measure of the data.
#define VARIANCE_NEGLIGIBLE 1.0e-30F

/// A prefilter coefficient cannot reasonably be larger: (1 - z^-1)^8 has 70.
#define C_LIMIT 70.0F

static void count(uint32_t* const counter) { *counter += (*counter < UINT32_MAX) ? 1U : 0U; }

/// The orders of the default configuration, as far as this build has room for them.
#define DEFAULT_NA ((EST_NA_MAX < 2U) ? EST_NA_MAX : 2U)
#define DEFAULT_NB ((EST_NB_MAX < 3U) ? EST_NB_MAX : 3U)

/// How much less certain a slip leaves every parameter: enough for b's whose covariance is that of their neighbours (10 is
/// too little, false alarms follow), not so much that a change of the plant that goes on meanwhile passes unnoticed (10,000).
#define SLIP_DOUBT 1000.0F

// ---------------------------------------------      U-D FACTORS      ---------------------------------------------

/// The part of column j of U above its diagonal: rows 0 .. j-1.
static float* column(est_t* const self, const uint8_t j) { return &self->upper[(j * (j - 1U)) / 2U]; }

static bool is_offset(const est_t* const self, const uint8_t j) {
    return self->config.offset && (j == (uint8_t)(self->dim - 1U));
}

static float prior_variance(const est_t* const self, const uint8_t j) {
    if (j < self->past) {
        return UNKNOWN_VARIANCE;
    }
    return is_offset(self, j) ? self->config.p0_offset : self->config.p0;
}

/// P := P0 for the rows below `rows`, which become uncorrelated with all others. Since
/// P_ij = sum over k >= max(i, j) of U_ik d_k U_jk, the covariance of the rows from `rows` on is untouched.
static void reset_covariance(est_t* const self, const uint8_t rows) {
    for (uint8_t j = 0U; j < self->dim; j++) {
        float* const upper = column(self, j);
        for (uint8_t i = 0U; (i < j) && (i < rows); i++) {
            upper[i] = 0.0F;
        }
        if (j < rows) {
            self->d[j] = prior_variance(self, j);
        }
    }
}

/// Without the upper limit the variance of a direction that is not excited grows by 1 / forgetting per sample, without end
/// ("covariance blow-up", thesis 3.6); no direction needs to be less certain than it was at the start. Without the lower
/// one a direction excited beyond all measure would be lost to underflow.
static float limited(const est_t* const self, const uint8_t j, const float d) {
    const float upper = prior_variance(self, j);
    if (d > upper) {
        return upper;
    }
    return (d < VARIANCE_NEGLIGIBLE) ? VARIANCE_NEGLIGIBLE : d;
}

/// One measurement: Bierman, "Factorization Methods for Discrete Sequential Estimation" (1977), section V.3, with the
/// forgetting factor of thesis Equ 3.21. gain[] receives P phi, unscaled; returns alpha = forgetting + phi' P phi.
static float update_factors(est_t* const self, const float* const phi, float* const gain) {
    const float forgetting = self->config.forgetting;
    float       alpha      = forgetting;
    for (uint8_t j = self->first; j < self->dim; j++) {
        float* const upper = column(self, j);
        float        f     = phi[j];
        for (uint8_t i = self->first; i < j; i++) {
            f += upper[i] * phi[i];
        }
        const float v     = self->d[j] * f;
        const float prior = alpha;
        alpha += f * v;
        self->d[j]    = limited(self, j, (self->d[j] * prior) / (alpha * forgetting));
        const float p = f / prior;
        for (uint8_t i = self->first; i < j; i++) {
            const float u = upper[i];
            upper[i]      = u - (p * gain[i]);
            gain[i] += u * v;
        }
        gain[j] = v;
    }
    return alpha;
}

// ---------------------------------------------  PREFILTER, REGRESSOR  ---------------------------------------------

static void zero(float* const x, const uint8_t n) {
    for (uint8_t i = 0U; i < n; i++) {
        x[i] = 0.0F;
    }
}

static void shift(float* const x, const uint8_t n, const float newest) {
    for (uint8_t i = (uint8_t)(n - 1U); i > 0U; i--) {
        x[i] = x[i - 1U];
    }
    x[0] = newest;
}

/// One sample of x / C: past[] holds the newest filtered value first.
static float filtered(const est_t* const self, const float* const past, const float x) {
    float out = x;
    for (uint8_t i = 0U; i < self->config.na; i++) {
        out -= self->config.c[i] * past[i];
    }
    return out;
}

/// The samples before this one are unknown. The filters start from zero, and what they would have remembered enters the
/// regression as unknown amplitudes of the impulse response of 1/C and its delays.
static void begin_segment(est_t* const self) {
    zero(self->y, self->config.na);
    zero(self->u, (uint8_t)(self->past + 1U));
    zero(self->impulse, self->past);
    zero(self->theta, self->past);
    est_edges_forget(&self->edges);
    reset_covariance(self, self->past);
    self->first   = 0U;
    self->running = true;
    count(&self->counters.restarts);
}

/// The impulse response of 1/C, one sample further; its input is the 1 at the first sample of the segment.
static void advance_impulse(est_t* const self, const bool first_sample) {
    shift(self->impulse, self->past, filtered(self, self->impulse, first_sample ? 1.0F : 0.0F));
    if (first_sample) {
        return;
    }
    for (uint8_t i = 0U; i < self->past; i++) {
        if ((self->impulse[i] > IMPULSE_NEGLIGIBLE) || (self->impulse[i] < -IMPULSE_NEGLIGIBLE)) {
            return;
        }
    }
    self->first = self->past;
}

/// phi(k) in the order of theta, the initial conditions first.
static void fill_regressor(const est_t* const self, float* const phi) {
    const est_config_t* const config = &self->config;
    float*                    out    = phi;
    for (uint8_t i = 0U; i < self->past; i++) {
        *out++ = self->impulse[i];
    }
    for (uint8_t i = 0U; i < config->na; i++) {
        *out++ = -self->y[i];
    }
    for (uint8_t i = 0U; i < config->nb; i++) {
        *out++ = self->u[config->nk + i];
    }
    if (config->offset) {
        *out = 1.0F;
    }
}

// ---------------------------------------------       ESTIMATOR       ---------------------------------------------

/// Beyond this the products of the update could overflow. Only an unstable prefilter gets there.
#define FILTERED_LIMIT 1.0e9F

/// False for NaN too.
static bool plausible(const float code) { return (code >= -EST_CODE_LIMIT) && (code <= EST_CODE_LIMIT); }

static bool within(const float x, const float low, const float high) { return (x >= low) && (x <= high); }

static bool bounded(const float x) { return within(x, -FILTERED_LIMIT, FILTERED_LIMIT); }

static uint8_t larger(const uint8_t a, const uint8_t b) { return (a > b) ? a : b; }

static bool orders_valid(const est_config_t* const config) {
    return (config->na >= 1U) && (config->na <= EST_NA_MAX) && (config->nb >= 1U) && (config->nb <= EST_NB_MAX) &&
           (config->nk <= EST_NK_MAX);
}

static bool prefilter_valid(const est_config_t* const config) {
    for (uint8_t i = 0U; i < config->na; i++) {
        if (!within(config->c[i], -C_LIMIT, C_LIMIT)) {
            return false;
        }
    }
    return true;
}

static bool config_valid(const est_config_t* const config) {
    return orders_valid(config) && prefilter_valid(config) && within(config->forgetting, 0.5F, 1.0F) &&
           within(config->p0, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->p0_offset, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->noise_variance, EST_VARIANCE_MIN, EST_VARIANCE_MAX) &&
           within(config->edge_codes, FLT_MIN, EST_CODE_LIMIT) && (config->edge_instants >= EST_EDGES_LOCKED) &&
           (config->edge_instants <= EST_EDGES_ANYWHERE) && est_trigger_config_valid(&config->trigger);
}

static float predicted(const est_t* const self, const float* const phi, const float* const theta) {
    float out = 0.0F;
    for (uint8_t i = self->first; i < self->dim; i++) {
        out += phi[i] * theta[i];
    }
    return out;
}

/// Three readings of the innovation: as recorded, and with the edges in doubt moved by one sample. The estimate has
/// followed what was recorded since, so the other two are taken against what was believed before the doubt.
static void read_innovation(const est_t* const self, const float* const phi, const float y, float* const readings) {
    readings[0] = y - predicted(self, phi, self->theta);
    if (self->edges.age_n == 0U) {
        readings[1] = readings[0];
        readings[2] = readings[0];
        return;
    }
    const float* const believed = self->edges.theta;
    const float        e        = y - predicted(self, phi, believed);
    float              early;
    float              late;
    est_edges_shares(&self->edges, &self->config, &believed[self->past + self->config.na], &early, &late);
    readings[1] = e - early;
    readings[2] = e - late;
}

/// A doubt that has lasted its term has been decided by est_trigger_step(). Until then another edge joins it if another
/// reading of the earlier ones is ahead, and otherwise begins a doubt of its own.
static void enter_edge(est_t* const self, const float u) {
    const bool expired = self->edges.age_n >= EST_DOUBT_N;
    if (expired) {
        self->edges.age_n = 0U;
    }
    if (est_edges_enter(&self->edges, &self->config, u, !expired && est_trigger_in_doubt(&self->trigger))) {
        est_trigger_begin_doubt(&self->trigger);
        for (uint8_t i = 0U; i < self->dim; i++) {
            self->edges.theta[i] = self->theta[i];
        }
    }
}

/// An edge at an unknown instant leaves the plant in an unknown state, as a gap does.
static bool begins_anew(const est_t* const self, const float u) {
    return (self->config.edge_instants == EST_EDGES_ANYWHERE) && est_edges_is_edge(&self->edges, &self->config, u);
}

/// Thesis Equ 3.19, 3.21 on the filtered signals. Returns the innovation's variance over that of the noise.
static float update_estimate(est_t* const self, const float* const phi, const float innovation) {
    float       gain[EST_DIM_MAX];
    const float alpha = update_factors(self, phi, gain);
    const float scale = innovation / alpha;
    for (uint8_t i = self->first; i < self->dim; i++) {
        self->theta[i] += gain[i] * scale;
    }
    return alpha / self->config.forgetting;
}

/// What was believed before the doubt holds on, but for the b's, which move by one place: y(k) now depends on u(k-1) as it
/// did on u(k), or the other way round. The statistic goes on as this reading has it, so that a change is not lost in it.
static void follow_slip(est_t* const self) {
    const uint8_t nb = self->config.nb;
    float* const  b  = &self->theta[self->past + self->config.na];
    for (uint8_t i = self->past; i < self->dim; i++) {
        self->theta[i] = self->edges.theta[i];
        self->d[i]     = limited(self, i, self->d[i] * SLIP_DOUBT);
    }
    if (est_trigger_settle_late(&self->trigger)) {
        shift(b, nb, 0.0F);
        return;
    }
    for (uint8_t j = 0U; j < nb; j++) {
        b[j] = ((j + 1U) < nb) ? b[j + 1U] : 0.0F;
    }
}

static void estimate_afresh(est_t* const self) {
    if (self->config.trigger.reset == EST_RESET_ALL) {
        zero(self->theta, self->dim);
    }
    reset_covariance(self, self->dim);
    est_trigger_restart(&self->trigger, self->config.trigger.hold_off_n);
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
    self->running = false;  // the filters remember the plant, or the clock, as it was
}

static est_step_t enter_gap(est_t* const self, const est_status_t status) {
    count((status == EST_REFUSED) ? &self->counters.refused : &self->counters.missing);
    if (self->running && (self->edges.age_n > 0U)) {
        react(self, est_trigger_end_doubt(&self->trigger, &self->config.trigger));
    }
    self->running = false;
    return (est_step_t){ .status = status, .alarm = false, .innovation = 0.0F, .statistic = self->trigger.statistic };
}

est_config_t est_config_default(void) {
    est_config_t config = {
        .na             = (uint8_t)DEFAULT_NA,
        .nb             = (uint8_t)DEFAULT_NB,
        .nk             = 0U,
        .offset         = true,
        .forgetting     = 0.9925F,
        .p0             = 10.0F,
        .p0_offset      = 1.0e6F,
        .noise_variance = 1.2F,
        .c              = { 0.0F },
        .edge_codes     = 64.0F,
        .edge_instants  = EST_EDGES_MAY_SLIP,
        .trigger        = { .kind       = EST_TRIGGER_CUSUM,
                            .ceiling    = 11.512925F,
                            .hold_off_n = 0U,
                            .warm_up_n  = 0U,
                            .absolute   = false,
                            .reset      = EST_RESET_COVARIANCE },
    };
#if EST_NA_MAX >= 2
    config.c[0] = -1.6F;
    config.c[1] = 0.64F;
#endif
    return config;
}

bool est_init(est_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != 0) && (config != 0));
    if (!config_valid(config)) {
        return false;
    }
    self->config   = *config;
    self->past     = larger(config->na, (uint8_t)(config->nb + config->nk - 1U));
    self->dim      = (uint8_t)(self->past + config->na + config->nb + (config->offset ? 1 : 0));
    self->first    = 0U;
    self->running  = false;
    self->counters = (est_counters_t){ 0 };
    zero(self->theta, self->dim);
    reset_covariance(self, self->dim);
    est_edges_forget(&self->edges);
    est_trigger_restart(&self->trigger, config->trigger.warm_up_n);
    return true;
}

est_step_t est_step(est_t* const self, const est_sample_t sample) {
    EST_ASSERT(self != 0);
    if (!sample.valid) {
        return enter_gap(self, EST_MISSING);
    }
    if (!plausible(sample.u) || !plausible(sample.y)) {
        return enter_gap(self, EST_REFUSED);
    }
    const bool first_sample = !self->running || begins_anew(self, sample.u);
    if (first_sample) {
        begin_segment(self);
    }
    if (self->first == 0U) {
        advance_impulse(self, first_sample);
    }
    const float y = filtered(self, self->y, sample.y);
    const float u = filtered(self, self->u, sample.u);
    if (!bounded(y) || !bounded(u) || !bounded(self->impulse[0])) {
        return enter_gap(self, EST_REFUSED);
    }
    shift(self->u, (uint8_t)(self->past + 1U), u);
    enter_edge(self, sample.u);

    float phi[EST_DIM_MAX];
    float readings[EST_READINGS];
    fill_regressor(self, phi);
    read_innovation(self, phi, y, readings);
    const float variance = update_estimate(self, phi, readings[0]) * self->config.noise_variance;
    shift(self->y, self->config.na, y);
    count(&self->counters.updated);

    const est_finding_t finding =
        est_trigger_step(&self->trigger, &self->config.trigger, readings, variance, self->edges.age_n);
    const est_step_t step = { .status     = EST_UPDATED,
                              .alarm      = finding == EST_ALARM,
                              .innovation = readings[0],
                              .statistic  = self->trigger.statistic };
    react(self, finding);
    return step;
}

uint8_t est_theta_count(const est_t* const self) {
    EST_ASSERT(self != 0);
    return (uint8_t)(self->dim - self->past);
}

float est_theta(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != 0) && (index < est_theta_count(self)));
    return self->theta[self->past + index];
}

float est_variance(const est_t* const self, const uint8_t index) {
    EST_ASSERT((self != 0) && (index < est_theta_count(self)));
    const uint8_t row = (uint8_t)(self->past + index);
    float         sum = self->d[row];
    for (uint8_t k = (uint8_t)(row + 1U); k < self->dim; k++) {
        const float u = self->upper[((k * (k - 1U)) / 2U) + row];
        sum += u * u * self->d[k];
    }
    return sum;
}

est_counters_t est_counters(const est_t* const self) {
    EST_ASSERT(self != 0);
    return self->counters;
}

bool est_invariants_hold(const est_t* const self) {
    if ((self == 0) || !config_valid(&self->config) || (self->dim > EST_DIM_MAX) || (self->past > EST_PAST_MAX) ||
        (self->dim <= self->past) || ((self->first != 0U) && (self->first != self->past))) {
        return false;
    }
    for (uint8_t i = self->first; i < self->dim; i++) {
        if (!within(self->d[i], FLT_MIN, FLT_MAX) || !within(self->theta[i], -FLT_MAX, FLT_MAX)) {
            return false;
        }
    }
    return within(self->trigger.statistic, 0.0F, FLT_MAX);
}
