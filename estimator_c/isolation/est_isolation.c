// SPDX-License-Identifier: MIT

#include "est_isolation.h"
#include "est_assert.h"

#include <stddef.h>

#define EFFECTS EST_ISOLATION_EFFECTS_N
#define PUSH 3U  ///< index of the impulse, which stands for an onset between two samples; M, B and K come before it

/// Samples after an alarm at which theta counts as the plant again, and the refinement of the extent ends.
#define SETTLED_N 100U

/// Evidence for a single changed parameter [nats]. SURE: over any other single parameter, a factor of 20.
/// MORE_LIKELY: over the two others together, 1.5; without a force they explain the same, and soon after far less.
/// ALONE: over itself and a second parameter that changed by WORTH_TELLING or more, 7.
#define SURE 3.0F
#define MORE_LIKELY 0.4F
#define ALONE 2.0F
#define WORTH_TELLING 0.15F

/// Evidence for a second changed parameter [nats], and for an onset between two samples, which has one more free
/// parameter than an onset at a sample.
#define NOT_BY_CHANCE 11.0F
#define BETWEEN 2.0F

/// Accuracy of the extent at which it is stated: a standard deviation of 1.1 %. Reciprocal variances are halved here
/// and in the normal equations: a deviation then costs its square times that [nats].
#define EXTENT_KNOWN 4000.0F

/// Prior of a change: a standard deviation of 1. Prior of an impulse: almost none.
#define PRIOR 0.5F
#define UNKNOWN 1.0e-3F

/// Halvings that suffice for the largest arcosh of a plant, 7.6 with a2 = 1e-6.
#define HALVINGS_N 8U

/// Doublings that suffice for the logarithm of the smallest a2, 1e-6.
#define DOUBLINGS_N 20U

#define LN_2 0.69314718F

// ---------------------------------------------         PLANT          ---------------------------------------------

/// Natural logarithm of 1e-6 < a < 1. Near 1 it is 2 artanh((x - 1) / (x + 1)).
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

/// arcosh(a)^2, which is -arccos(a)^2 below 1, for a > -1. Halves the argument by cosh(w / 2)^2 = (1 + cosh(w)) / 2
/// until the series converges.
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

/// Compute the coefficients of z^0, z^-1, z^-2 from their sum, their first and their second moment.
static void from_moments(float* const out, const float sum, const float first, const float second) {
    out[2] = 0.5F * (second - first);
    out[1] = first - (2.0F * out[2]);
    out[0] = sum - out[1] - out[2];
}

/// Derive the plant from theta. The poles of A are exp(-p/2 +- w) with p = B T / M and p^2/4 - w^2 = q = K T^2 / M. A
/// force that deflects the plant by 1, t or t^2 when static is answered by 1, t - D and t^2 - 2 D t + 2 (D^2 - 1/q),
/// with the lag D = B / K. The coefficients are those that give the same answers at the samples. Return false if
/// theta is not a plant.
static bool derive_plant(est_plant_t* const self, const est_config_t* const config, const float force_zero) {
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

static const est_kept_t* sample_before(const est_isolation_t* const self, const uint32_t ago) {
    return &self->kept[((self->newest + EST_ISOLATION_KEPT_N) - ago) % EST_ISOLATION_KEPT_N];
}

static uint8_t count_up(const uint8_t n) { return (n < UINT8_MAX) ? (uint8_t)(n + 1U) : n; }

static void keep(est_isolation_t* const self, const est_sample_t sample, const float innovation) {
    self->newest             = (uint8_t)((self->newest + 1U) % EST_ISOLATION_KEPT_N);
    self->kept[self->newest] = (est_kept_t){ .u = sample.u, .y = sample.y, .innovation = innovation };
    self->known_n            = (uint8_t)((self->known_n < EST_ISOLATION_KEPT_N) ? (self->known_n + 1U) : self->known_n);
}

/// Measured force: u counted from F = 0.
static float force(const est_isolation_t* const self, const uint32_t ago) {
    return sample_before(self, ago)->u - self->force_zero;
}

/// Effect on y of the force during the past sample, for an onset `age_n` samples ago. An edge of u may come anywhere
/// within the interval; b_0 is then the share of the new level, if nk is 0.
static float force_effect(const est_isolation_t* const self, const uint32_t ago, const uint16_t age_n) {
    const est_config_t* const config = self->config;
    const float* const        b      = &self->plant.theta[2];
    if (age_n == 1U) {
        const float direct = (config->nk == 0U) ? b[0] : 0.0F;
        const float whole  = self->plant.gain * self->plant.hold;
        return (direct * force(self, ago)) + ((whole - direct) * force(self, ago + 1U));  // MISRA D4
    }
    float out = 0.0F;
    for (uint8_t i = 0U; i < config->nb; i++) {
        out += b[i] * force(self, ago + i + config->nk);  // at most two samples back: checked by est_isolation_init()
    }
    return out;
}

/// Compute the inputs of the effects for an onset `age_n` samples ago. With x the measured displacement and all else
/// unchanged,
///     M0 d'' + B0 d' + K0 d = -nu (F - B0 x' - K0 x) - dB x' - dK x,    nu = 1 - M0/M,
/// gives the deviation d of the plant from its course. It is linear in a change of M, of B, and of K.
static void drive(const est_isolation_t* const self, const uint32_t ago, const uint16_t age_n, float* const out) {
    const est_plant_t* const plant = &self->plant;
    float                    spring;
    float                    damper;
    if (age_n == 1U) {  // the force acts from the first sample on: the second has half the weight
        const float rise = sample_before(self, ago)->y - sample_before(self, ago + 1U)->y;
        spring           = plant->hold * (sample_before(self, ago + 1U)->y + (0.33333333F * rise) - plant->rest);
        damper           = plant->hold * plant->lag_n * rise;
    } else {
        spring = 0.0F;
        damper = 0.0F;
        for (uint32_t i = 0U; i < 3U; i++) {
            const float x = sample_before(self, ago + i)->y - plant->rest;
            spring += plant->spring[i] * x;
            damper += plant->damper[i] * x;
        }
    }
    out[0] = spring + damper - force_effect(self, ago, age_n);
    out[1] = -damper;
    out[2] = -spring;
}

/// Enter a sample into the residual: y less the response of the plant before the change, whitened by C as in
/// est_whitener.h.
static void enter_residual(est_isolation_t* const self, const uint32_t ago) {
    const est_config_t* const config = self->config;
    const float* const        theta  = self->plant.theta;
    float                     out    = sample_before(self, ago)->y + (theta[0] * sample_before(self, ago + 1U)->y) +
                (theta[1] * sample_before(self, ago + 2U)->y);
    for (uint8_t i = 0U; i < config->nb; i++) {
        out -= theta[2U + i] * sample_before(self, ago + i + config->nk)->u;
    }
    out -= config->offset ? theta[2U + config->nb + config->nc] : 0.0F;
    out -= (self->plant.c[0] * self->residual[0]) + (self->plant.c[1] * self->residual[1]);
    self->residual[1] = self->residual[0];
    self->residual[0] = out;
}

static void
enter_onset(est_isolation_t* const self, est_onset_t* const onset, const uint32_t ago, const uint16_t age_n) {
    float        first[PUSH];
    const float* driving = self->driving;
    float*       matrix  = onset->matrix;
    if (age_n == 1U) {
        drive(self, ago, age_n, first);
        driving = first;
    }
    for (uint8_t i = 0U; i < EFFECTS; i++) {
        float* const past   = onset->past[i];
        const float  pushes = (age_n == 1U) ? 1.0F : 0.0F;
        const float  drives = (i == PUSH) ? pushes : driving[i];
        const float  now    = drives - (self->plant.c[0] * past[0]) - (self->plant.c[1] * past[1]);
        const float  weight = now * self->nats;
        past[1]             = past[0];
        past[0]             = now;
        onset->vector[i] += weight * self->residual[0];
        for (uint8_t j = 0U; j <= i; j++) {
            *matrix++ += weight * onset->past[j][0];
        }
    }
}

// ---------------------------------------------        VERDICT         ---------------------------------------------

static float greater(const float a, const float b) { return (a > b) ? a : b; }

/// ln(exp(a) + exp(b)), to 0.03.
static float log_add(const float a, const float b) {
    const float most  = greater(a, b);
    const float least = (a > b) ? b : a;
    const float near  = greater(2.83F - (most - least), 0.0F);
    return most + ((0.0866F * near) * near);
}

/// Discount a gain by what it costs to make the change x, known this well, a relevant one.
static float discount(const float gain, const float x, const float known) {
    const float size = (x < 0.0F) ? -x : x;
    const float lack = greater(WORTH_TELLING - size, 0.0F);
    return gain - ((known * lack) * lack);
}

/// A hypothesis of one changed parameter. Private.
typedef struct {
    float vector;
    float known;   ///< half the reciprocal variance of change
    float change;  ///< most likely value
    float gain;
} one_t;

/// Weigh the pair of parameters i > j, whose index is i + j - 1. `ij`: their element of the normal equations.
static void
weigh_pair(est_fit_t* const fit, const one_t* const ones, const uint8_t i, const uint8_t j, const float ij) {
    const uint8_t pair  = (uint8_t)(i + j - 1U);
    const float   share = ij / ones[j].known;
    const float   left  = greater(ones[i].known - (ij * share), PRIOR);  // smaller only by rounding
    const float   rest  = ones[i].vector - (share * ones[j].vector);
    const float   x     = rest / left;
    const float   both  = ones[j].gain + (rest * x);
    fit->any_pair[pair] = log_add(fit->any_pair[pair], both);
    fit->beside[j]      = greater(fit->beside[j], discount(both, x, left));
    fit->beside[i] =
        greater(fit->beside[i], discount(both, ones[j].change - (share * x), (left * ones[j].known) / ones[i].known));
}

/// Weigh all hypotheses for one onset. The normal equations contain M, B and K only. `gain`: the gain without any of
/// them.
static void weigh(est_fit_t* const   fit,
                  const float* const matrix,
                  const float* const vector,
                  const float        gain,
                  const uint8_t      number,
                  const uint8_t      before_n) {
    one_t        ones[PUSH];
    const float* row = matrix;
    for (uint8_t i = 0U; i < PUSH; i++) {
        const float known  = row[i] + PRIOR;
        const float change = vector[i] / known;
        const float alone  = gain + (vector[i] * change);
        ones[i]            = (one_t){ .vector = vector[i], .known = known, .change = change, .gain = alone };
        fit->any_alone[i]  = log_add(fit->any_alone[i], alone);
        fit->onset[number] = greater(fit->onset[number], alone);
        if (alone > fit->alone[i]) {
            fit->alone[i]    = alone;
            fit->change[i]   = change;
            fit->known[i]    = known;
            fit->before_n[i] = before_n;
        }
        for (uint8_t j = 0U; j < i; j++) {
            weigh_pair(fit, ones, i, j, row[j]);
        }
        row = &row[i + 1U];
    }
}

/// Weigh an onset at its sample.
static void judge(est_fit_t* const fit, const est_onset_t* const onset, const uint8_t number) {
    fit->onset[number] = 0.0F;
    weigh(fit, onset->matrix, onset->vector, 0.0F, number, onset->before_n);
}

/// Weigh an onset between its sample and the next. The impulse that this needs is eliminated.
static void judge_pushed(est_fit_t* const fit, const est_onset_t* const onset, const uint8_t number) {
    const float* const push   = &onset->matrix[6];
    const float        known  = push[PUSH] + UNKNOWN;
    const float        change = onset->vector[PUSH] / known;
    float              matrix[6];
    float              vector[PUSH];
    uint8_t            at = 0U;
    for (uint8_t i = 0U; i < PUSH; i++) {
        const float share = push[i] / known;
        vector[i]         = onset->vector[i] - (push[i] * change);
        for (uint8_t j = 0U; j <= i; j++) {
            matrix[at] = onset->matrix[at] - (share * push[j]);
            at++;
        }
    }
    weigh(fit, matrix, vector, (change * onset->vector[PUSH]) - BETWEEN, number, onset->before_n);
}

static void clear_fit(est_fit_t* const fit) { *fit = (est_fit_t){ .alone = { 0.0F } }; }

/// Most likely parameter.
static uint8_t find_likeliest(const est_fit_t* const fit) {
    const uint8_t first = (fit->any_alone[1] > fit->any_alone[0]) ? 1U : 0U;
    return (fit->any_alone[2] > fit->any_alone[first]) ? 2U : first;
}

/// Extent of a change: from 1 - old/new for M, new/old - 1 for B and K. At least 0.01, for M at most 100.
static float extent_of(const est_change_t change, const float x) {
    const bool  of_mass = change == EST_CHANGE_MASS;
    const float parts   = greater(1.0F + (of_mass ? -x : x), 0.01F);
    const float inverse = 1.0F / parts;
    return of_mass ? inverse : parts;
}

/// Log-likelihood of an extent a priori, negated [nats]: near 1 it is ln(extent)^2 / 2, as if factors of e were
/// usual. Without it a hundredfold mass would explain anything where the mass hardly matters, because y drives its
/// effect.
static float penalty_of(const float extent) { return 0.5F * ((extent + (1.0F / extent)) - 2.0F); }

/// Decide from the evidence so far.
static est_change_t decide(const est_fit_t* const fit) {
    static const est_change_t alone[3] = { EST_CHANGE_MASS, EST_CHANGE_DAMPING, EST_CHANGE_STIFFNESS };
    const uint8_t             one      = find_likeliest(fit);
    const float               likely   = fit->any_alone[one] - penalty_of(extent_of(alone[one], fit->change[one]));
    bool                      sure     = (fit->known[one] > EXTENT_KNOWN) && ((likely - fit->beside[one]) >= ALONE) &&
                ((likely - fit->any_pair[2U - one]) >= MORE_LIKELY);
    for (uint8_t other = 0U; other < 3U; other++) {
        if (other != one) {
            if ((fit->any_pair[one + other - 1U] - fit->any_alone[one]) > NOT_BY_CHANCE) {
                return EST_CHANGE_SEVERAL;  // MISRA D4
            }
            sure = sure && ((likely - fit->any_alone[other]) >= SURE);
        }
    }
    return sure ? alone[one] : EST_CHANGE_UNDECIDED;
}

/// True iff the present sample comes after the alarm.
static bool is_after_alarm(const est_isolation_t* const self) { return self->worked_n > self->onsets[0].before_n; }

static void diagnose(est_isolation_t* const self) {
    est_diagnosis_t* const out = &self->diagnosis;
    if (!is_after_alarm(self)) {
        return;  // MISRA D4
    }
    out->samples_n = (uint16_t)(self->worked_n - self->onsets[0].before_n);
    if (out->change == EST_CHANGE_UNDECIDED) {
        out->change = decide(&self->fit);
    }
    if ((out->change == EST_CHANGE_UNDECIDED) || (out->change == EST_CHANGE_SEVERAL)) {
        return;  // MISRA D4
    }
    const uint8_t one   = (uint8_t)((uint8_t)out->change - 1U);
    const float   level = self->fit.alone[one] - 2.0F;
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
    self->quiet     = false;
}

/// Samples from onset number i to the alarm, earliest onset first. The longer the delay, the smaller the effect of
/// the change before the alarm, and the impulse compensates for coarser steps.
static uint8_t onset_before(const uint8_t i, const uint8_t earliest_n) {
    static const uint8_t wanted_n[EST_ISOLATION_ONSETS_N] = { 20U, 12U, 7U, 4U, 2U, 1U };
    return (wanted_n[i] < earliest_n) ? wanted_n[i] : earliest_n;
}

static void start(est_isolation_t* const self, const est_t* const estimator) {
    const uint8_t past_n     = 4U;
    const uint8_t earliest_n = (self->known_n > past_n) ? (uint8_t)(self->known_n - past_n) : 0U;
    const bool    was_quiet  = self->quiet;
    stop(self);
    self->since_n   = 0U;
    self->diagnosis = (est_diagnosis_t){ .change = EST_CHANGE_UNDECIDED, .extent = 1.0F };
    if (!was_quiet || (earliest_n < 1U) || !derive_plant(&self->plant, self->config, self->force_zero)) {
        return;  // MISRA D4
    }
    for (uint8_t i = 0U; i < EST_ISOLATION_ONSETS_N; i++) {
        self->onsets[i] = (est_onset_t){ .before_n = onset_before(i, earliest_n) };
    }
    self->active      = true;
    self->turn        = 0U;
    self->worked_n    = 0U;
    self->waiting_n   = self->onsets[0].before_n;
    self->nats        = 0.5F / est_noise_variance(estimator);
    self->residual[0] = sample_before(self, self->waiting_n)->innovation;
    self->residual[1] = sample_before(self, self->waiting_n + 1U)->innovation;
}

bool est_isolation_init(est_isolation_t* const self, const est_config_t* const config, const float force_zero) {
    EST_ASSERT((self != NULL) && (config != NULL));
    *self           = (est_isolation_t){ .config = config, .force_zero = force_zero };
    self->diagnosis = (est_diagnosis_t){ .change = EST_CHANGE_UNDECIDED, .extent = 1.0F };
    return (config->na == 2U) && ((config->nb + config->nk) <= 3U) && (config->trigger.kind == EST_TRIGGER_CUSUM) &&
           (config->edge_instants != EST_EDGES_ANYWHERE);
}

/// Store theta and C as the plant before a change.
static void take_theta(est_isolation_t* const self, const est_t* const estimator) {
    const uint8_t count = est_theta_count(estimator);
    self->quiet         = true;
    for (uint8_t i = 0U; i < count; i++) {
        self->plant.theta[i] = est_theta(estimator, i);
    }
    self->plant.c[0] = est_prefilter(estimator, 0U);
    self->plant.c[1] = est_prefilter(estimator, 1U);
}

static void enter_quiet(est_isolation_t* const self, const est_t* const estimator, const est_step_t step) {
    if (step.status != EST_UPDATED) {
        self->known_n = 0U;
        self->quiet   = false;
    } else if ((step.statistic <= 0.0F) && (self->since_n >= SETTLED_N)) {
        take_theta(self, estimator);
    } else {
        // theta absorbs a change
    }
}

void est_isolation_enter(est_isolation_t* const self,
                         const est_t* const     estimator,
                         const est_sample_t     sample,
                         const est_step_t       step) {
    EST_ASSERT((self != NULL) && (estimator != NULL));
    self->since_n = count_up(self->since_n);
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

/// True iff the present sample comes after this onset.
static bool has_begun(const est_isolation_t* const self, const est_onset_t* const onset) {
    return (self->worked_n + onset->before_n) > self->onsets[0].before_n;
}

/// Number of slices of the present sample. Hypotheses are weighed only after the alarm.
static uint8_t count_slices(const est_isolation_t* const self) {
    uint8_t out = 1U;
    for (uint8_t i = 0U; i < EST_ISOLATION_ONSETS_N; i++) {
        out = has_begun(self, &self->onsets[i]) ? (uint8_t)(out + 1U) : out;
    }
    return is_after_alarm(self) ? EST_ISOLATION_SLICES_N : out;
}

static void begin_sample(est_isolation_t* const self, const uint32_t ago) {
    clear_fit(&self->fit);
    enter_residual(self, ago);
    drive(self, ago, 2U, self->driving);
    self->worked_n++;
    self->slices_n = count_slices(self);
}

static void enter_and_judge(est_isolation_t* const self, const uint8_t number) {
    est_onset_t* const onset = &self->onsets[number];
    const uint32_t     age_n = (uint32_t)self->worked_n + onset->before_n - self->onsets[0].before_n;
    enter_onset(self, onset, self->waiting_n - 1U, (uint16_t)age_n);
    if (is_after_alarm(self)) {
        judge(&self->fit, onset, number);
    }
}

bool est_isolation_work(est_isolation_t* const self) {
    EST_ASSERT(self != NULL);
    if (!self->active || (self->waiting_n == 0U)) {
        return false;  // MISRA D4
    }
    if (self->turn == 0U) {
        begin_sample(self, self->waiting_n - 1U);
    } else if (self->turn <= EST_ISOLATION_ONSETS_N) {
        enter_and_judge(self, (uint8_t)(self->turn - 1U));
    } else {
        const uint8_t number = (uint8_t)(self->turn - (EST_ISOLATION_ONSETS_N + 1U));
        judge_pushed(&self->fit, &self->onsets[number], number);
    }
    self->turn++;
    if (self->turn >= self->slices_n) {
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
