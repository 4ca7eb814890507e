#include "est_isolation.h"

#include <stddef.h>

#ifndef EST_ASSERT
#ifdef NDEBUG  // a freestanding compiler has no assert.h
#define EST_ASSERT(x) ((void)0)
#else
#include <assert.h>
#define EST_ASSERT(x) assert(x)  // NOLINT(cppcoreguidelines-macro-usage)
#endif
#endif

#define EFFECTS EST_ISOLATION_EFFECTS_N
#define PUSH 3U  ///< the effect that stands for an onset between those that are tried
#define NEVER UINT8_MAX

#define EARLIEST_N 24U  ///< before the alarm
#define LATEST_N 1U

/// Samples after an alarm before theta is taken for the plant again, and after which the extent is refined no more.
#define SETTLED_N 100U

/// In nats: one of two rivals at 2.5 % each; as much as a second change may explain by chance, onset and magnitude being at
/// its choice; and what none but a second change explains.
#define SURE 3.64F
#define BY_CHANCE 2.0F
#define NOT_BY_CHANCE 11.0F

/// In nats: by how much one change alone must lead the two others together, which have a magnitude more to fit the samples with.
/// M alone is soon like a B and a K that grow alike, and so on round.
#define AGAINST_TWO 2.0F

/// A second change must be known to so much before it is ruled out: a standard deviation of 5 %.
#define RULED_OUT 400.0F

/// The extent is not told before it is known to a standard deviation of 0.8 %.
#define EXTENT_KNOWN 16000.0F

/// Reciprocal variance, per noise variance, below which a change is not known at all.
#define UNKNOWN 1.0e-3F

/// Enough for the largest arcosh of a plant, 7.6 with a2 = 1e-6.
#define HALVINGS_N 8U

/// Of the smallest a2, 1e-6.
#define DOUBLINGS_N 20U

#define LN_2 0.69314718F

// ---------------------------------------------         PLANT          ---------------------------------------------

/// Natural logarithm of 1e-6 < a < 1: 2 artanh((x - 1) / (x + 1)) near 1.
static float logarithm(const float a) {
    float x   = a;
    float out = 0.0F;
    for (uint8_t i = 0U; i < DOUBLINGS_N; i++) {
        if (x < 0.70710678F) {
            x += x;
            out -= LN_2;
        }
    }
    const float t = (x - 1.0F) / (x + 1.0F);
    const float s = t * t;
    return out + (2.0F * t * (1.0F + (s * (0.33333333F + (s * (0.2F + (s * 0.14285714F)))))));
}

/// Square root of x >= 0 by Newton's method from above.
static float root(const float x) {
    float out = (x > 1.0F) ? x : 1.0F;
    for (uint8_t i = 0U; i < 24U; i++) {
        out = 0.5F * (out + (x / out));
    }
    return out;
}

/// arcosh(a)^2, which is -arccos(a)^2 below 1. a > -1; is halved by cosh(w / 2)^2 = (1 + cosh(w)) / 2 until the series serves.
static float squared_arcosh(const float a) {
    float x     = a;
    float scale = 2.0F;
    for (uint8_t i = 0U; i < HALVINGS_N; i++) {
        if ((x > 1.1F) || (x < 0.9F)) {
            x = root(0.5F * (1.0F + x));
            scale *= 4.0F;
        }
    }
    const float z = x - 1.0F;
    return scale * z * (1.0F - (z * (0.16666667F - (z * (0.044444444F - (z * 0.014285714F))))));
}

/// Coefficients of z^0, z^-1, z^-2 from their sum and their first and second moment.
static void from_moments(float* const out, const float sum, const float first, const float second) {
    out[2] = 0.5F * (second - first);
    out[1] = first - (2.0F * out[2]);
    out[0] = sum - out[1] - out[2];
}

/// What theta says of the plant. The poles of A are exp(-p/2 +- w) with p = B T / M and p^2/4 - w^2 = q = K T^2 / M. The
/// plant answers 1, t and t^2, as deflections by a force, with 1, t - D, and t^2 - 2 D t + 2 (D^2 - 1/q), where D = B / K
/// is its lag: the coefficients follow that make the sampled answers the same. False iff it is no plant.
static bool believe(est_believed_t* const self, const est_config_t* const config, const float force_zero) {
    const float a1  = self->theta[0];
    const float a2  = self->theta[1];
    const float sum = 1.0F + a1 + a2;
    if ((a2 < 1.0e-6F) || (a2 >= 1.0F) || (sum < 1.0e-6F)) {
        return false;  // MISRA D4
    }
    const float cosh_w = -a1 / (2.0F * root(a2));
    const float p      = -logarithm(a2);
    if (cosh_w < -0.9F) {
        return false;  // MISRA D4
    }
    const float q = (0.25F * p * p) - squared_arcosh(cosh_w);
    if (q <= 0.0F) {
        return false;  // MISRA D4
    }
    const float first  = a1 + (2.0F * a2);
    const float second = a1 + (4.0F * a2);
    const float lag_n  = p / q;
    const float drag_n = lag_n * sum;
    self->lag_n        = lag_n;
    self->hold         = sum - ((sum * (lag_n - 0.5F)) + first);
    from_moments(self->spring, sum, drag_n + first, second + (2.0F * ((lag_n * (first + drag_n)) - (sum / q))));
    from_moments(self->damper, 0.0F, -drag_n, -2.0F * lag_n * (first + drag_n));
    self->gain = 0.0F;
    for (uint8_t i = 0U; i < config->nb; i++) {
        self->gain += self->theta[2U + i] / sum;
    }
    const float offset = config->offset ? (self->theta[2U + config->nb + config->nc] / sum) : 0.0F;
    self->rest         = offset + (self->gain * force_zero);
    return true;
}

// ---------------------------------------------        SAMPLES         ---------------------------------------------

static const est_kept_t* kept(const est_isolation_t* const self, const uint32_t ago) {
    return &self->kept[((self->newest + EST_ISOLATION_KEPT_N) - ago) % EST_ISOLATION_KEPT_N];
}

static uint8_t one_more(const uint8_t n) { return (n < UINT8_MAX) ? (uint8_t)(n + 1U) : n; }

static void keep(est_isolation_t* const self, const est_sample_t sample, const float innovation) {
    self->newest             = (uint8_t)((self->newest + 1U) % EST_ISOLATION_KEPT_N);
    self->kept[self->newest] = (est_kept_t){ .u = sample.u, .y = sample.y, .innovation = innovation };
    self->known_n            = (uint8_t)((self->known_n < EST_ISOLATION_KEPT_N) ? (self->known_n + 1U) : self->known_n);
}

/// Measured u, counted from where F = 0.
static float force(const est_isolation_t* const self, const uint32_t ago) { return kept(self, ago)->u - self->force_zero; }

/// The force on the plant in the past sample, times what it does to y, since an onset `age_n` samples ago. An edge of u may
/// come anywhere within the interval, as the b's tell: b_0, if nk is 0, is the share of the new level.
static float pushed(const est_isolation_t* const self, const uint32_t ago, const uint16_t age_n) {
    const est_config_t* const config = self->config;
    const float* const        b      = &self->believed.theta[2];
    if (age_n == 1U) {
        const float direct = (config->nk == 0U) ? b[0] : 0.0F;
        const float whole  = self->believed.gain * self->believed.hold;
        return (direct * force(self, ago)) + ((whole - direct) * force(self, ago + 1U));  // MISRA D4
    }
    float out = 0.0F;
    for (uint8_t i = 0U; i < config->nb; i++) {
        out += b[i] * force(self, ago + i + config->nk);  // at most two samples back: est_isolation_init()
    }
    return out;
}

/// What drives the effects since an onset so long ago. With x the displacement, everything else as it was,
///     M0 d'' + B0 d' + K0 d = -nu (F - B0 x' - K0 x) - dB x' - dK x,    nu = 1 - M0/M,
/// is how d, by which the plant leaves its course, follows from a change of M, of B, or of K: linear in each.
static void drive(const est_isolation_t* const self, const uint32_t ago, const uint16_t age_n, float* const out) {
    const est_believed_t* const plant = &self->believed;
    float spring;
    float damper;
    if (age_n == 1U) {  // the second of the two samples matters half as much: the force acts from the first on
        const float rise = kept(self, ago)->y - kept(self, ago + 1U)->y;
        spring = plant->hold * (kept(self, ago + 1U)->y + (0.33333333F * rise) - plant->rest);
        damper = plant->hold * plant->lag_n * rise;
    } else {
        spring = 0.0F;
        damper = 0.0F;
        for (uint32_t i = 0U; i < 3U; i++) {
            const float x = kept(self, ago + i)->y - plant->rest;
            spring += plant->spring[i] * x;
            damper += plant->damper[i] * x;
        }
    }
    out[0]    = spring + damper - pushed(self, ago, age_n);
    out[1]    = -damper;
    out[2]    = -spring;
    out[PUSH] = (age_n == 1U) ? 1.0F : 0.0F;
}

/// y less what the plant as it was would have done, from its equation, whitened by C as in est_whitener.h.
static void enter_residual(est_isolation_t* const self, const uint32_t ago) {
    const est_config_t* const config = self->config;
    const float* const        theta  = self->believed.theta;
    float out = kept(self, ago)->y + (theta[0] * kept(self, ago + 1U)->y) + (theta[1] * kept(self, ago + 2U)->y);
    for (uint8_t i = 0U; i < config->nb; i++) {
        out -= theta[2U + i] * kept(self, ago + i + config->nk)->u;
    }
    out -= config->offset ? theta[2U + config->nb + config->nc] : 0.0F;
    out -= (self->believed.c[0] * self->residual[0]) + (self->believed.c[1] * self->residual[1]);
    self->residual[1] = self->residual[0];
    self->residual[0] = out;
}

static void enter_onset(est_isolation_t* const self, est_onset_t* const onset, const uint32_t ago, const uint16_t age_n) {
    float  driving[EFFECTS];
    float* matrix = onset->matrix;
    drive(self, ago, age_n, driving);
    for (uint8_t i = 0U; i < EFFECTS; i++) {
        float* const past = onset->past[i];
        const float  now  = driving[i] - (self->believed.c[0] * past[0]) - (self->believed.c[1] * past[1]);
        past[1]           = past[0];
        past[0]           = now;
        onset->vector[i] += now * self->residual[0];
        for (uint8_t j = 0U; j <= i; j++) {
            *matrix++ += now * onset->past[j][0];
        }
    }
}

// ---------------------------------------------        VERDICT         ---------------------------------------------

/// An element of the normal equations once the push is eliminated; i >= j.
static float element(const est_onset_t* const self, const uint8_t i, const uint8_t j) {
    const float* const push = &self->matrix[6];
    return self->matrix[((i * (i + 1U)) / 2U) + j] - ((push[i] * push[j]) / (push[PUSH] + UNKNOWN));
}

/// Of the pair i > j, whose number is i + j - 1.
static void judge_pair(est_fit_t* const fit, const est_onset_t* const onset, const float* const vector, const float gain, const uint8_t i, const uint8_t j) {
    const uint8_t pair = (uint8_t)(i + j - 1U);
    const float   jj   = element(onset, j, j) + UNKNOWN;
    const float   ij   = element(onset, i, j);
    const float   left = element(onset, i, i) + UNKNOWN - (ij * ij / jj);
    const float   rest = vector[i] - (ij * vector[j] / jj);
    if (left > UNKNOWN) {
        const float both = gain + (vector[j] * vector[j] / jj) + (rest * rest / left);
        if (both > fit->pair[pair]) {
            const float ii       = element(onset, i, i) + UNKNOWN;
            fit->pair[pair]      = both;
            fit->certainty[pair] = (ii > jj) ? ((left * jj) / ii) : left;
        }
    }
}

/// What this onset explains, if it explains more than the others did.
static void judge(est_fit_t* const fit, const est_onset_t* const onset, const uint8_t number) {
    const float push    = onset->vector[PUSH];
    const float gain    = push * push / (onset->matrix[9] + UNKNOWN);
    float       vector[3];
    fit->onset[number] = 0.0F;
    for (uint8_t i = 0U; i < 3U; i++) {
        vector[i]         = onset->vector[i] - (onset->matrix[6U + i] * push / (onset->matrix[9] + UNKNOWN));
        const float ii    = element(onset, i, i) + UNKNOWN;
        const float alone = gain + (vector[i] * vector[i] / ii);
        if (alone > fit->alone[i]) {
            fit->alone[i]    = alone;
            fit->change[i]   = vector[i] / ii;
            fit->known[i]    = ii;
            fit->before_n[i] = onset->before_n;
        }
        fit->onset[number] = (alone > fit->onset[number]) ? alone : fit->onset[number];
        for (uint8_t j = 0U; j < i; j++) {
            judge_pair(fit, onset, vector, gain, i, j);
        }
    }
}

static void begin_round(est_fit_t* const fit) { *fit = (est_fit_t){ .alone = { 0.0F } }; }

/// The parameter that explains most alone.
static uint8_t best(const est_fit_t* const fit) {
    const uint8_t first = (fit->alone[1] > fit->alone[0]) ? 1U : 0U;
    return (fit->alone[2] > fit->alone[first]) ? 2U : first;
}

/// What can be said so far. `unit`: squared codes per nat.
static est_change_t verdict(const est_fit_t* const fit, const float unit, const float noise_variance) {
    static const est_change_t alone[3] = { EST_CHANGE_MASS, EST_CHANGE_DAMPING, EST_CHANGE_STIFFNESS };
    const uint8_t one    = best(fit);
    const float   two = fit->pair[2U - one];  // of the two others
    bool ruled = (fit->known[one] > (EXTENT_KNOWN * noise_variance)) && ((fit->alone[one] - two) >= (AGAINST_TWO * unit));
    for (uint8_t other = 0U; other < 3U; other++) {
        if (other != one) {
            const uint8_t pair   = (uint8_t)(one + other - 1U);
            const float   second = fit->pair[pair] - fit->alone[one];
            if (second > (NOT_BY_CHANCE * unit)) {
                return EST_CHANGE_SEVERAL;  // MISRA D4
            }
            ruled = ruled && (second < (BY_CHANCE * unit)) && (fit->certainty[pair] > (RULED_OUT * noise_variance)) &&
                    ((fit->alone[one] - fit->alone[other]) >= (SURE * unit));
        }
    }
    return ruled ? alone[one] : EST_CHANGE_UNDECIDED;
}

/// 1 - old/new of M; new/old - 1 of B and K.
static float extent_of(const est_change_t change, const float x) {
    if (change == EST_CHANGE_MASS) {
        return (x < 0.99F) ? (1.0F / (1.0F - x)) : 100.0F;  // MISRA D4
    }
    return 1.0F + x;
}

static void diagnose(est_isolation_t* const self) {
    est_diagnosis_t* const out  = &self->diagnosis;
    const float            unit = 2.0F * self->noise_variance;
    const uint16_t         to_alarm_n = self->onsets[0].before_n;
    if (self->worked_n <= to_alarm_n) {
        return;  // MISRA D4
    }
    out->samples_n = (uint16_t)(self->worked_n - to_alarm_n);
    if (out->change == EST_CHANGE_UNDECIDED) {
        out->change = verdict(&self->fit, unit, self->noise_variance);
    }
    if ((out->change == EST_CHANGE_UNDECIDED) || (out->change == EST_CHANGE_SEVERAL)) {
        return;  // MISRA D4
    }
    const uint8_t one   = (uint8_t)((uint8_t)out->change - 1U);
    const float   level = self->fit.alone[one] - (2.0F * unit);
    out->extent         = extent_of(out->change, self->fit.change[one]);
    out->onset_n        = self->fit.before_n[one];
    out->onset_low_n    = out->onset_n;
    out->onset_high_n   = out->onset_n;
    for (uint8_t i = 0U; i < EST_ISOLATION_ONSETS_N; i++) {
        const uint8_t n = self->onsets[i].before_n;
        if (self->fit.onset[i] >= level) {
            out->onset_low_n  = (n < out->onset_low_n) ? n : out->onset_low_n;
            out->onset_high_n = (n > out->onset_high_n) ? n : out->onset_high_n;
        }
    }
}

// ---------------------------------------------          API           ---------------------------------------------

static void stop(est_isolation_t* const self) {
    self->active    = false;
    self->waiting_n = 0U;
    self->quiet_n   = NEVER;
}

/// Onsets are tried around the last sample whose statistic was zero: the sooner the alarm, the stronger the change, the
/// closer together. What a push makes up for is an onset so far off that the force of the change has not yet moved y.
static uint32_t spacing(const uint8_t quiet_n) {
    if (quiet_n < 5U) {
        return 1U;  // MISRA D4
    }
    return (quiet_n < 9U) ? 2U : 4U;
}

/// How long before the alarm onset number i is tried: the first onset first.
static uint8_t before(const uint8_t quiet_n, const uint8_t i, const uint8_t earliest_n) {
    const uint32_t spacing_n = spacing(quiet_n);
    const uint32_t later_n   = spacing_n * i;
    const uint32_t n         = quiet_n + (spacing_n * (EST_ISOLATION_ONSETS_N / 2U));
    const uint32_t latest_n  = later_n + LATEST_N;
    const uint32_t wanted_n  = ((n > latest_n) ? n : latest_n) - later_n;
    return (uint8_t)((wanted_n < earliest_n) ? wanted_n : earliest_n);
}

static void start(est_isolation_t* const self, const est_t* const estimator) {
    const uint8_t past_n     = 4U;
    const uint8_t known_n    = (self->known_n > past_n) ? (uint8_t)(self->known_n - past_n) : 0U;
    const uint8_t earliest_n = (known_n < EARLIEST_N) ? known_n : (uint8_t)EARLIEST_N;
    const uint8_t quiet_n    = self->quiet_n;
    stop(self);
    self->since_n   = 0U;
    self->diagnosis = (est_diagnosis_t){ .change = EST_CHANGE_UNDECIDED, .extent = 1.0F };
    if ((quiet_n >= NEVER) || (earliest_n < LATEST_N) || !believe(&self->believed, self->config, self->force_zero)) {
        return;  // MISRA D4
    }
    for (uint8_t i = 0U; i < EST_ISOLATION_ONSETS_N; i++) {
        const uint8_t held_n = (quiet_n < EARLIEST_N) ? quiet_n : (uint8_t)EARLIEST_N;
        self->onsets[i]      = (est_onset_t){ .before_n = before(held_n, i, earliest_n) };
    }
    self->active         = true;
    self->turn           = 0U;
    self->worked_n       = 0U;
    self->waiting_n      = self->onsets[0].before_n;
    self->noise_variance = est_noise_variance(estimator);
    self->residual[0]    = kept(self, self->waiting_n)->innovation;
    self->residual[1]    = kept(self, self->waiting_n + 1U)->innovation;
}

bool est_isolation_init(est_isolation_t* const self, const est_config_t* const config, const float force_zero) {
    EST_ASSERT((self != NULL) && (config != NULL));
    *self           = (est_isolation_t){ .config = config, .force_zero = force_zero };
    self->quiet_n   = NEVER;
    self->diagnosis = (est_diagnosis_t){ .change = EST_CHANGE_UNDECIDED, .extent = 1.0F };
    return (config->na == 2U) && ((config->nb + config->nk) <= 3U) && (config->trigger.kind == EST_TRIGGER_CUSUM);
}

/// The plant is well: this is what it is.
static void take_theta(est_isolation_t* const self, const est_t* const estimator) {
    const uint8_t count = est_theta_count(estimator);
    self->quiet_n       = 0U;
    for (uint8_t i = 0U; i < count; i++) {
        self->believed.theta[i] = est_theta(estimator, i);
    }
    self->believed.c[0] = est_prefilter(estimator, 0U);
    self->believed.c[1] = est_prefilter(estimator, 1U);
}

static void enter_quiet(est_isolation_t* const self, const est_t* const estimator, const est_step_t step) {
    if (step.status != EST_UPDATED) {
        self->known_n = 0U;
        self->quiet_n = NEVER;
    } else if ((step.statistic <= 0.0F) && (self->since_n >= SETTLED_N)) {
        take_theta(self, estimator);
    } else if (self->quiet_n != NEVER) {
        self->quiet_n = (uint8_t)((self->quiet_n < (NEVER - 1U)) ? (self->quiet_n + 1U) : self->quiet_n);
    } else {
        // not known when the plant was last well
    }
}

void est_isolation_enter(est_isolation_t* const self, const est_t* const estimator, const est_sample_t sample, const est_step_t step) {
    EST_ASSERT((self != NULL) && (estimator != NULL));
    self->since_n = one_more(self->since_n);
    if ((step.status == EST_MISSING) || (step.status == EST_REFUSED)) {
        self->known_n = 0U;
        stop(self);
        return;  // MISRA D4
    }
    keep(self, sample, step.innovation);
    if (self->active) {
        self->waiting_n++;
        if ((self->waiting_n > (EST_ISOLATION_KEPT_N - 4U)) || (self->since_n >= SETTLED_N) || step.alarm) {
            stop(self);
        }
    } else {
        enter_quiet(self, estimator, step);
    }
    if (step.alarm) {
        start(self, estimator);
    }
}

bool est_isolation_work(est_isolation_t* const self) {
    EST_ASSERT(self != NULL);
    if (!self->active || (self->waiting_n == 0U)) {
        return false;  // MISRA D4
    }
    const uint32_t     ago   = self->waiting_n - 1U;
    est_onset_t* const onset = &self->onsets[self->turn];
    if (self->turn == 0U) {
        begin_round(&self->fit);
        enter_residual(self, ago);
        self->worked_n++;
    }
    const uint16_t later_n = (uint16_t)(self->onsets[0].before_n - onset->before_n);
    if (self->worked_n > later_n) {
        enter_onset(self, onset, ago, (uint16_t)(self->worked_n - later_n));
        judge(&self->fit, onset, self->turn);
    }
    self->turn++;
    if (self->turn == EST_ISOLATION_ONSETS_N) {
        self->turn = 0U;
        self->waiting_n--;
        diagnose(self);
    }
    return self->waiting_n > 0U;
}

est_diagnosis_t est_isolation_diagnosis(const est_isolation_t* const self) {
    EST_ASSERT(self != NULL);
    return self->diagnosis;
}
