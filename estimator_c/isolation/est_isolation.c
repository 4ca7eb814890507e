// SPDX-License-Identifier: MIT

#include "est_isolation.h"
#include "est_assert.h"
#include "est_shape.h"

#include <stddef.h>

#define EFFECTS EST_ISOLATION_EFFECTS_N
#define JOINT EST_ISOLATION_JOINT_N
#define IMPULSES EST_ISOLATION_IMPULSES_N
#define TRIANGLE_N ((JOINT * (JOINT + 1U)) / 2U)
#define SINGLES EST_ISOLATION_SINGLES_N
#define CHANNELS EST_ISOLATION_CHANNELS_N

/// Index of the first impulse among the effects, and of the first fault among the single changes. M, B and K come
/// before it.
#define PARAMETERS 3U

/// Channels.
#define FORCE 0U
#define DISPLACEMENT 1U

/// Faults of a channel. The first three have effects that are linear in their size.
#define OFFSET 0U
#define GAIN 1U
#define DELAY 2U
#define STUCK 3U
#define NOISE 4U
#define LINEAR_N 3U
#define KINDS_N 5U

/// Onsets that a slice of work enters a sample into. Last slices in which a sample is entered, and weighed.
#define AT_ONCE 2U
#define ENTERED (EST_ISOLATION_ONSETS_N / AT_ONCE)
#define WEIGHED (ENTERED + (2U * EST_ISOLATION_ONSETS_N))

/// Samples after an alarm at which theta counts as the plant again, and the refinement of the extent ends.
#define SETTLED_N 100U

/// Evidence for a single change [nats]. SURE: over any other single change, a factor of 20. MORE_LIKELY: over two
/// changed parameters together, 1.2; without a force they explain the same, and soon after far less. ALONE: over itself
/// and a second parameter that changed by WORTH_TELLING or more, 7. FAULTY: for a fault of a channel, on top of SURE.
#define SURE 3.0F
#define MORE_LIKELY 0.2F
#define ALONE 2.0F
#define WORTH_TELLING 0.15F
#define FAULTY 2.0F

/// What rounding may add to the evidence of one hypothesis over another, relative to that over no change: the sums of a
/// hundred samples have lost their last five bits.
#define ROUNDING 1.0e-6F

/// Evidence for a second changed parameter [nats].
#define NOT_BY_CHANCE 11.0F

/// Samples from the onset of a fault on which its diagnosis is based, at least. Fewer are explained by any fault.
#define FAULT_N 12U

/// Accuracy at which an extent is stated: a standard deviation of 0.011 of new/old - 1, and for M and gains of
/// 1 - old/new. Reciprocal variances are halved here
/// and in the normal equations: a deviation then costs its square times that [nats].
#define EXTENT_KNOWN 4000.0F

/// Prior of a change: a standard deviation of 1. The impulses have that of the noise.
#define PRIOR 0.5F

/// Prior of the size of a change: its logarithm may lie anywhere in an interval of 4. A size x then costs
/// ln(1 + SIZES x^2 known) / 2.
#define SIZES 20.0F

/// Half the reciprocal variance, per sample, of the logarithm of a variance.
#define VARIANCE_KNOWN 0.25F

/// Samples on which the habits of the channels are based.
#define HABITS_N 128U

/// Variance that a noisy force exceeds, in usual variances, and the largest square that counts, in such variances.
#define UNUSUAL 4.0F
#define UNREST_MAX 25.0F

/// Halvings that suffice for the largest arcosh of a plant, 7.6 with a2 = 1e-6.
#define HALVINGS_N 8U

/// Scalings that suffice for the logarithm of the smallest number, 2^-31.
#define SCALINGS_N 5U

#define LN_2 0.69314718F

// ---------------------------------------------         PLANT          ---------------------------------------------

/// Natural logarithm of 2^-31 <= a < 1. Near 1 it is 2 artanh((x - 1) / (x + 1)).
static float logarithm(const float a) {
    static const float scales[SCALINGS_N] = { 65536.0F, 256.0F, 16.0F, 4.0F, 2.0F };
    static const float logs[SCALINGS_N]   = { 16.0F * LN_2, 8.0F * LN_2, 4.0F * LN_2, 2.0F * LN_2, LN_2 };
    float              x                  = a;
    float              out                = 0.0F;
    for (uint8_t i = 0U; i < SCALINGS_N; i++) {
        const float scaled = scales[i] * x;
        if (scaled < 1.41421356F) {
            x = scaled;
            out -= logs[i];
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

/// Compute p = B T / M and q = K T^2 / M of the plant of thesis Equ 4.2, M x'' + B x' + K x = F. Sampled every T, its
/// poles are exp(-p/2 +- w) with p^2/4 - w^2 = q, so that a2 = exp(-p) and -a1 = 2 exp(-p/2) cosh(w). Return false if
/// theta is not such a plant.
static bool poles_of(const float* const theta, float* const p_out, float* const q_out) {
    const float a1  = theta[0];
    const float a2  = theta[1];
    const float sum = 1.0F + a1 + a2;
    if ((a2 < 1.0e-6F) || (a2 >= 1.0F) || (sum < 1.0e-6F)) {
        return false;
    }
    const float cosh_w = -a1 / (2.0F * root(a2));
    const float p      = -logarithm(a2);
    if (cosh_w < -0.9F) {
        return false;
    }
    const float q = (0.25F * p * p) - squared_arcosh(cosh_w);
    if (q <= 0.0F) {
        return false;
    }
    *p_out = p;
    *q_out = q;
    return true;
}

/// Derive the plant from theta. A force that deflects the plant by 1, t or t^2 when static is answered by 1, t - D and
/// t^2 - 2 D t + 2 (D^2 - 1/q), with the lag D = B / K. The coefficients are those that give the same answers at the
/// samples. Return false if theta is not a plant.
static bool derive_plant(est_plant_t* const self, const est_config_t* const config, const float force_zero) {
    const float a1  = self->theta[0];
    const float a2  = self->theta[1];
    const float sum = 1.0F + a1 + a2;
    float       p   = 0.0F;
    float       q   = 0.0F;
    self->a[0]      = 1.0F;
    self->a[1]      = a1;
    self->a[2]      = a2;
    if (!poles_of(self->theta, &p, &q)) {
        return false;
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
    for (uint8_t i = 0U; i < EST_ISOLATION_LAGS_N; i++) {
        const bool acts = (i >= config->nk) && (i < (config->nb + config->nk));  // nb + nk: est_isolation_init()
        self->b[i]      = acts ? self->theta[(2U + i) - config->nk] : 0.0F;
        self->gain += self->b[i] / sum;
    }
    self->direct       = (config->nk == 0U) ? self->b[0] : 0.0F;
    const float offset = config->offset ? (self->theta[2U + config->nb + config->nc] / sum) : 0.0F;
    self->rest         = offset + (self->gain * force_zero);
    return true;
}

// ---------------------------------------------        SAMPLES         ---------------------------------------------

static const est_kept_t* sample_before(const est_isolation_t* const self, const uint32_t ago) {
    return &self->kept[((self->newest + EST_ISOLATION_KEPT_N) - ago) % EST_ISOLATION_KEPT_N];
}

static bool equal(const float a, const float b) { return !((a < b) || (a > b)); }

static uint8_t count_up(const uint8_t n) { return (n < UINT8_MAX) ? (uint8_t)(n + 1U) : n; }

static void keep(est_isolation_t* const self, const est_sample_t sample, const float innovation) {
    self->newest             = (uint8_t)((self->newest + 1U) % EST_ISOLATION_KEPT_N);
    self->kept[self->newest] = (est_kept_t){ .u = sample.u, .y = sample.y, .innovation = innovation };
    self->known_n            = (uint8_t)((self->known_n < EST_ISOLATION_KEPT_N) ? (self->known_n + 1U) : self->known_n);
}

/// Square of the smaller one of two steps of u, between three samples. An edge is a step beside a small one.
static float squared_step(const float newest, const float middle, const float oldest) {
    const float last  = newest - middle;
    const float first = oldest - middle;
    const float newer = last * last;
    const float older = first * first;
    return (newer < older) ? newer : older;
}

/// Mean square of the steps of u that is never unusual: that of steps of a 64th of an edge.
static float least_unrest(const est_isolation_t* const self) {
    return (self->config->edge_codes * self->config->edge_codes) / 4096.0F;
}

/// Follow the habits of the channels. A noise that has just begun hardly counts.
static void follow_habits(est_isolation_t* const self) {
    est_habits_t* const     habits  = &self->habits;
    const est_kept_t* const now     = sample_before(self, 0U);
    const est_kept_t* const last    = sample_before(self, 1U);
    const bool              learns  = habits->known_n < HABITS_N;
    const float             present = squared_step(now->u, last->u, sample_before(self, 2U)->u);
    const float             most    = UNUSUAL * (habits->unrest + least_unrest(self));
    habits->known_n                 = learns ? (uint8_t)(habits->known_n + 1U) : habits->known_n;
    const float rate                = 1.0F / (float)habits->known_n;
    habits->same[FORCE] += rate * ((equal(now->u, last->u) ? 1.0F : 0.0F) - habits->same[FORCE]);
    habits->same[DISPLACEMENT] += rate * ((equal(now->y, last->y) ? 1.0F : 0.0F) - habits->same[DISPLACEMENT]);
    habits->unrest += rate * (((learns || (present < most)) ? present : most) - habits->unrest);
}

/// Move on to the sample `ago` samples before the newest one.
static void advance(est_isolation_t* const self, const uint32_t ago) {
    const est_kept_t* const now = sample_before(self, ago);
    for (uint8_t i = EST_ISOLATION_LAGS_N; i > 0U; i--) {
        self->force[i]        = self->force[i - 1U];
        self->displacement[i] = self->displacement[i - 1U];
    }
    self->force[0]        = now->u - self->force_zero;
    self->displacement[0] = now->y - self->plant.rest;
}

/// Sum of products over the lags.
static float filter(const float* const factors, const float* const x) {
    return (factors[0] * x[0]) + (factors[1] * x[1]) + (factors[2] * x[2]);
}

/// Compute the inputs of the effects of M, B and K for an onset `age_n` samples ago. With x the measured displacement
/// and all else unchanged,
///     M0 d'' + B0 d' + K0 d = -nu (F - B0 x' - K0 x) - dB x' - dK x,    nu = 1 - M0/M,
/// gives the deviation d of the plant from its course. It is linear in a change of M, of B, and of K. In the first
/// sample, the force acts from the onset on, and the second sample has half the weight. An edge of u may come anywhere
/// within the interval; b_0 is then the share of the new level.
static void drive_plant(const est_isolation_t* const self, const uint16_t age_n, float* const out) {
    const est_plant_t* const plant  = &self->plant;
    const float* const       f      = self->force;
    const float* const       x      = self->displacement;
    const bool               first  = age_n == 1U;
    const float              rise   = x[0] - x[1];
    const float              spring = first ? (plant->hold * (x[1] + (0.33333333F * rise))) : filter(plant->spring, x);
    const float              damper = first ? ((plant->hold * plant->lag_n) * rise) : filter(plant->damper, x);
    const float              later  = (plant->gain * plant->hold) - plant->direct;
    const float              force  = first ? ((plant->direct * f[0]) + (later * f[1])) : filter(plant->b, f);
    out[0]                          = spring + damper - force;
    out[1]                          = -damper;
    out[2]                          = -spring;
}

/// Compute the inputs of the effects of an offset, a gain and a delay of the force for an onset `age_n` samples ago. A
/// force that is measured f too high leaves the equation a residual of -B f. An offset is f = 1. A gain is f = u less
/// its zero, as its size is 1 - old/new. A delay is f(k) = u(k) - u(k + 1); the one of the present sample is not known.
static void drive_force(const est_isolation_t* const self, const uint16_t age_n, float* const out) {
    const float* const b = self->plant.b;
    const float* const f = self->force;
    const uint16_t     n = (age_n < EST_ISOLATION_LAGS_N) ? age_n : EST_ISOLATION_LAGS_N;
    out[OFFSET]          = -b[0];
    out[GAIN]            = -b[0] * f[0];
    out[DELAY]           = 0.0F;
    for (uint16_t i = 1U; i < n; i++) {  // cppcheck F5
        out[OFFSET] -= b[i];
        out[GAIN] -= b[i] * f[i];
        out[DELAY] -= b[i] * (f[i] - f[i - 1U]);
    }
}

/// The same of the displacement. If it is measured f too high the residual is A f. A late displacement obeys the
/// equation of the sample before: the residual is the step of -B u, and at first A times the steps of y before the
/// onset, because one code comes twice.
static void drive_displacement(const est_isolation_t* const self, const uint16_t age_n, float* const out) {
    const float* const a = self->plant.a;
    const float* const f = self->force;
    const float* const x = self->displacement;
    out[OFFSET]          = 0.0F;
    out[GAIN]            = 0.0F;
    out[DELAY]           = filter(self->plant.b, &f[1]) - filter(self->plant.b, f);
    for (uint16_t i = 0U; i < EST_ISOLATION_LAGS_N; i++) {
        if (age_n > i) {
            out[OFFSET] += a[i];
            out[GAIN] += a[i] * x[i];
        } else {
            out[DELAY] += a[i] * (x[i] - x[i + 1U]);
        }
    }
}

/// Compute the inputs of all effects for an onset `age_n` samples ago. The second impulse is a past value of its
/// effect.
static void drive(const est_isolation_t* const self, const uint16_t age_n, float* const out) {
    drive_plant(self, age_n, out);
    out[PARAMETERS]      = (age_n == 1U) ? 1.0F : 0.0F;
    out[PARAMETERS + 1U] = 0.0F;
    drive_force(self, age_n, &out[JOINT]);
    drive_displacement(self, age_n, &out[JOINT + LINEAR_N]);
}

/// Enter the sample into the residual: y less the response of the plant before the change, whitened by C as in
/// est_whitener.h.
static void enter_residual(est_isolation_t* const self) {
    const est_plant_t* const plant = &self->plant;
    const float              out   = filter(plant->a, self->displacement) - filter(plant->b, self->force);
    const float              white = out - (plant->c[0] * self->residual[0]) - (plant->c[1] * self->residual[1]);
    self->residual[1]              = self->residual[0];
    self->residual[0]              = white;
}

/// Enter the sample into the runs of equal codes, and into the unrest of the force: "the variance of its steps is four
/// times an unusual one", a likelihood ratio.
static void enter_habits(est_isolation_t* const self) {
    const float* const f     = self->force;
    const float* const x     = self->displacement;
    const float        ratio = squared_step(f[0], f[1], f[2]) / (UNUSUAL * (self->habits.unrest + least_unrest(self)));
    const float        counted = (ratio < UNREST_MAX) ? ratio : UNREST_MAX;
    self->unrest               = (self->habits.known_n < HABITS_N) ? 0.0F : ((0.375F * counted) - LN_2);
    self->same_n[FORCE]        = equal(f[0], f[1]) ? count_up(self->same_n[FORCE]) : 0U;
    self->same_n[DISPLACEMENT] = equal(x[0], x[1]) ? count_up(self->same_n[DISPLACEMENT]) : 0U;
}

/// Samples from an onset to the present sample.
static uint16_t age_of(const est_isolation_t* const self, const est_onset_t* const onset) {
    return (uint16_t)((self->worked_n + onset->before_n) - self->onsets[0].before_n);
}

/// Prepare an onset for its first sample. The second impulse came one sample before.
static void clear_onset(est_onset_t* const onset) {
    for (uint8_t i = 0U; i < EFFECTS; i++) {
        onset->past[i][0] = (i == (PARAMETERS + 1U)) ? 1.0F : 0.0F;
        onset->past[i][1] = 0.0F;
        onset->vector[i]  = 0.0F;
    }
    for (uint8_t i = 0U; i < TRIANGLE_N; i++) {
        onset->matrix[i] = 0.0F;
    }
    for (uint8_t i = 0U; i < EST_ISOLATION_FAULTS_N; i++) {
        onset->known[i] = 0.0F;
        for (uint8_t j = 0U; j < IMPULSES; j++) {
            onset->shared[i][j] = 0.0F;
        }
    }
    onset->energy = 0.0F;
    onset->unrest = 0.0F;
}

/// Enter the sample into the effects of one onset and their normal equations. All onsets that the equation does not
/// reach back to are driven alike.
static void enter_onset(est_isolation_t* const self, est_onset_t* const onset) {
    float          first[EFFECTS];
    const float*   driving = self->driving;
    float*         matrix  = onset->matrix;
    const uint16_t age_n   = age_of(self, onset);
    if (age_n == 1U) {
        clear_onset(onset);
    }
    if (age_n < EST_ISOLATION_LAGS_N) {
        drive(self, age_n, first);
        driving = first;
    }
    const float c0       = self->plant.c[0];
    const float c1       = self->plant.c[1];
    const float residual = self->residual[0];
    const float nats     = self->nats;
    float       now[EFFECTS];
    for (uint_fast8_t i = 0U; i < EFFECTS; i++) {
        float* const past = onset->past[i];
        now[i]            = driving[i] - (c0 * past[0]) - (c1 * past[1]);
        past[1]           = past[0];
        past[0]           = now[i];
        onset->vector[i] += (now[i] * nats) * residual;
    }
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < JOINT; i++) {
        EST_UNROLL
        for (uint_fast8_t j = 0U; j <= i; j++) {
            *matrix++ += (now[i] * nats) * now[j];
        }
    }
    for (uint_fast8_t i = 0U; i < EST_ISOLATION_FAULTS_N; i++) {
        const float weight = now[JOINT + i] * nats;
        onset->known[i] += weight * now[JOINT + i];
        EST_UNROLL
        for (uint_fast8_t j = 0U; j < IMPULSES; j++) {
            onset->shared[i][j] += weight * now[PARAMETERS + j];
        }
    }
    onset->energy += (self->residual[0] * self->nats) * self->residual[0];
    onset->unrest += self->unrest;
}

// ---------------------------------------------        VERDICT         ---------------------------------------------

/// ln(exp(a) + exp(b)), to 0.03.
static float log_add(const float a, const float b) {
    const float most  = est_max(a, b);
    const float least = (a > b) ? b : a;
    const float near  = est_max(2.83F - (most - least), 0.0F);
    return most + ((0.0866F * near) * near);
}

/// Log-likelihood gain if n samples of this energy have an unknown variance instead of the usual one [nats].
static float gain_of_variance(const float energy, const float n) {
    const float usual = 0.5F * n;
    if (energy <= usual) {
        return 0.0F;
    }
    return (energy - usual) + (usual * logarithm(est_max(usual / energy, 1.0e-9F)));
}

/// Discount a gain by what it costs to make the change x, known this well, a relevant one.
static float discount(const float gain, const float x, const float known) {
    const float size = (x < 0.0F) ? -x : x;
    const float lack = est_max(WORTH_TELLING - size, 0.0F);
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
    const float   left  = est_max(ones[i].known - (ij * share), PRIOR);  // smaller only by rounding
    const float   rest  = ones[i].vector - (share * ones[j].vector);
    const float   x     = rest / left;
    const float   both  = ones[j].gain + (rest * x);
    fit->any_pair[pair] = log_add(fit->any_pair[pair], both);
    fit->beside[j]      = est_max(fit->beside[j], discount(both, x, left));
    fit->beside[i] =
        est_max(fit->beside[i], discount(both, ones[j].change - (share * x), (left * ones[j].known) / ones[i].known));
}

/// Enter the evidence of one onset for a single change.
EST_INLINE void enter_single(est_isolation_t* const self,
                             const uint_fast8_t     one,
                             const uint_fast8_t     number,
                             const float            gain,
                             const float            change,
                             const float            known) {
    est_single_t* const single = &self->fit.single[one];
    float* const        most   = &self->fit.onset[number];
    single->any                = log_add(single->any, gain);
    *most                      = est_max(*most, gain);
    if (gain > single->best) {
        single->best     = gain;
        single->change   = change;
        single->known    = known;
        single->before_n = self->onsets[number].before_n;
    }
}

/// The impulses of one onset, the second less its share of the first. Private.
typedef struct {
    float share;
    float variance[IMPULSES];  ///< doubled
    float change[IMPULSES];
    float gain;
} impulses_t;

static impulses_t free_impulses(const est_isolation_t* const self, const est_onset_t* const onset) {
    const float* const first  = &onset->matrix[(PARAMETERS * (PARAMETERS + 1U)) / 2U];
    const float* const second = &first[PARAMETERS + 1U];
    impulses_t         out;
    out.variance[0]  = 1.0F / (first[PARAMETERS] + self->nats);
    out.share        = second[PARAMETERS] * out.variance[0];
    out.variance[1]  = 1.0F / (est_max(second[PARAMETERS + 1U] - (out.share * second[PARAMETERS]), 0.0F) + self->nats);
    const float rest = onset->vector[PARAMETERS + 1U] - (out.share * onset->vector[PARAMETERS]);
    out.change[0]    = onset->vector[PARAMETERS] * out.variance[0];
    out.change[1]    = rest * out.variance[1];
    out.gain         = (out.change[0] * onset->vector[PARAMETERS]) + (out.change[1] * rest);
    return out;
}

/// Weigh the parameters for one onset. The impulses are eliminated from the normal equations.
static void weigh_plant(est_isolation_t* const self, const uint8_t number) {
    est_fit_t* const         fit      = &self->fit;
    const est_onset_t* const onset    = &self->onsets[number];
    const impulses_t         impulses = free_impulses(self, onset);
    const float* const       first    = &onset->matrix[(PARAMETERS * (PARAMETERS + 1U)) / 2U];
    const float* const       second   = &first[PARAMETERS + 1U];
    const float*             row      = onset->matrix;
    float                    rest[PARAMETERS];
    one_t                    ones[PARAMETERS];
    for (uint8_t i = 0U; i < PARAMETERS; i++) {
        float       left[PARAMETERS];
        const float share = first[i] * impulses.variance[0];
        rest[i]           = second[i] - (impulses.share * first[i]);
        for (uint8_t j = 0U; j <= i; j++) {
            left[j] = row[j] - (share * first[j]) - ((rest[i] * impulses.variance[1]) * rest[j]);
        }
        const float vector = onset->vector[i] - (first[i] * impulses.change[0]) - (rest[i] * impulses.change[1]);
        const float known  = left[i] + PRIOR;
        const float change = vector / known;
        const float gain   = impulses.gain + (vector * change);
        ones[i]            = (one_t){ .vector = vector, .known = known, .change = change, .gain = gain };
        enter_single(self, i, number, gain, change, known);
        for (uint8_t j = 0U; j < i; j++) {
            weigh_pair(fit, ones, i, j, left[j]);
        }
        row = &row[i + 1U];
    }
}

/// A hypothesis of one fault whose effect is linear in its size. Private.
typedef struct {
    float known;
    float change;
    float gain;
} fault_t;

/// Evidence of one onset for a fault whose effect is linear in its size. A delay has the size 1.
EST_INLINE fault_t weigh_linear(const est_onset_t* const onset,
                                const impulses_t* const  impulses,
                                const uint_fast8_t       i,
                                const bool               delays) {
    const float* const shared = onset->shared[i];
    const float        rest   = shared[1] - (impulses->share * shared[0]);
    const float vector = onset->vector[JOINT + i] - (shared[0] * impulses->change[0]) - (rest * impulses->change[1]);
    const float known =
        onset->known[i] - ((shared[0] * impulses->variance[0]) * shared[0]) - ((rest * impulses->variance[1]) * rest);
    const float left   = est_max(known, 1.0e-9F);  // smaller only by rounding
    const float change = delays ? 1.0F : (vector / left);
    const float gain   = impulses->gain + (((2.0F * vector) - (left * change)) * change);
    return (fault_t){ .known = delays ? 0.0F : left, .change = change, .gain = gain };
}

/// Part of the gain by undoing a gain of the displacement that is no evidence: the noise is scaled as well.
static float gain_of_scaling(const float change, const float samples_n) {
    const float counted = est_max((change < 1.0F) ? change : 1.0F, -0.5F);
    return samples_n * counted * (1.0F - (0.5F * counted));
}

static uint8_t fault_of(const uint_fast8_t channel, const uint_fast8_t kind) {
    return (uint8_t)(PARAMETERS + (channel * KINDS_N) + kind);
}

/// Weigh the faults of the channels for one onset. A force that is stuck while the true one has changed is an offset
/// whose codes are all equal. A displacement that is stuck explains every residual. Noise has an unknown variance; in
/// the force it shows in the force too.
static void weigh_faults(est_isolation_t* const self, const uint8_t number) {
    const est_onset_t* const onset           = &self->onsets[number];
    const impulses_t         impulses        = free_impulses(self, onset);
    const uint16_t           age_n           = age_of(self, onset);
    const float              n               = (float)age_n;
    const float              noise           = gain_of_variance(onset->energy, n);
    const float              unrest          = 0.5F * onset->unrest;  // steps of neighbours are correlated
    const float              noisy[CHANNELS] = { noise + unrest, noise };
    for (uint_fast8_t channel = 0U; channel < CHANNELS; channel++) {
        fault_t stuck = { .gain = onset->energy };
        for (uint_fast8_t kind = 0U; kind < LINEAR_N; kind++) {
            fault_t found = weigh_linear(onset, &impulses, (uint_fast8_t)((channel * LINEAR_N) + kind), kind == DELAY);
            if ((channel == FORCE) && (kind == OFFSET)) {
                stuck = found;
            }
            if ((channel == DISPLACEMENT) && (kind == GAIN)) {
                found.gain -= gain_of_scaling(found.change, n);
            }
            enter_single(self, fault_of(channel, kind), number, found.gain, found.change, found.known);
        }
        if (self->same_n[channel] >= age_n) {
            const float gain = stuck.gain + (n * self->surprise[channel]);
            enter_single(self, fault_of(channel, STUCK), number, gain, stuck.change, stuck.known);
        }
        enter_single(self, fault_of(channel, NOISE), number, noisy[channel], 1.0F, VARIANCE_KNOWN * n);
    }
}

static void clear_fit(est_fit_t* const fit) {
    for (uint8_t i = 0U; i < SINGLES; i++) {
        fit->single[i] = (est_single_t){ .any = 0.0F };
    }
    for (uint8_t i = 0U; i < PARAMETERS; i++) {
        fit->any_pair[i] = 0.0F;
        fit->beside[i]   = 0.0F;
    }
    for (uint8_t i = 0U; i < EST_ISOLATION_ONSETS_N; i++) {
        fit->onset[i] = 0.0F;
    }
}

/// Change with this index among the single ones.
static est_change_t change_of(const uint8_t one) {
    const uint32_t number = (uint32_t)one + ((one < PARAMETERS) ? 1U : 2U);
    return (est_change_t)number;
}

static uint8_t index_of(const est_change_t change) {
    return (uint8_t)((uint8_t)change - ((change < EST_CHANGE_SEVERAL) ? 1U : 2U));
}

static bool is_gain(const est_change_t change) {
    return (change == EST_CHANGE_FORCE_GAIN) || (change == EST_CHANGE_DISPLACEMENT_GAIN);
}

/// Extent of a change: from 1 - old/new for M and gains, new/old - 1 for B and K. At least 0.01, or at most 100.
static float extent_of(const est_change_t change, const float x) {
    const bool  inverted = (change == EST_CHANGE_MASS) || is_gain(change);
    const float parts    = est_max(1.0F + (inverted ? -x : x), 0.01F);
    const float inverse  = 1.0F / parts;
    return inverted ? inverse : parts;
}

/// Log-likelihood of an extent a priori, negated [nats]: near 1 it is ln(extent)^2 / 2, as if factors of e were
/// usual. Without it a hundredfold mass would explain anything where the mass hardly matters, because y drives its
/// effect.
static float penalty_of(const float extent) { return 0.5F * ((extent + (1.0F / extent)) - 2.0F); }

/// Cost of a size that is free [nats].
static float cost_of_size(const est_single_t* const found) {
    const float explained = found->change * found->change * found->known;
    return -0.5F * logarithm(est_max(1.0F / (1.000001F + (SIZES * explained)), 1.0e-9F));
}

/// Most likely single change by these gains.
static uint8_t find_likeliest(const float* const gains) {
    uint8_t out = 0U;
    for (uint8_t i = 1U; i < SINGLES; i++) {
        out = (gains[i] > gains[out]) ? i : out;
    }
    return out;
}

/// True iff a parameter alone is more likely than beside another one, and its extent is known.
static bool stands_alone(const est_fit_t* const fit, const uint8_t one, const float penalty) {
    const est_single_t* const found  = &fit->single[one];
    const float               likely = found->any - (penalty + (ROUNDING * found->any));
    return (found->known > EXTENT_KNOWN) && ((likely - fit->beside[one]) >= ALONE) &&
           ((likely - fit->any_pair[2U - one]) >= MORE_LIKELY);
}

/// Largest gain of two changed parameters, one of which is this one, unless it is a fault.
static float gain_of_pairs(const est_fit_t* const fit, const uint8_t one) {
    float out = 0.0F;
    for (uint8_t i = 0U; i < PARAMETERS; i++) {
        const bool without = (i + one) == 2U;
        out                = without ? out : est_max(out, fit->any_pair[i]);
    }
    return out;
}

/// Decide from the evidence so far, `samples_n` samples after the alarm.
static est_change_t decide(const est_fit_t* const fit, const uint16_t samples_n) {
    float gains[SINGLES];
    for (uint8_t i = 0U; i < SINGLES; i++) {
        gains[i] = fit->single[i].any - cost_of_size(&fit->single[i]);
    }
    const uint8_t             one   = find_likeliest(gains);
    const est_single_t* const found = &fit->single[one];
    const float               pair  = gain_of_pairs(fit, one);
    const float               lost  = ROUNDING * found->any;
    float                     lead  = SURE + lost;
    bool                      sure;
    if ((pair - found->any) > (NOT_BY_CHANCE + lost)) {
        return EST_CHANGE_SEVERAL;
    }
    if (one < PARAMETERS) {
        const float penalty = penalty_of(extent_of(change_of(one), found->change));
        lead += penalty;
        sure = stands_alone(fit, one, penalty);
    } else {
        lead += FAULTY;
        sure = (((uint32_t)samples_n + found->before_n) >= FAULT_N) && ((found->any - pair) >= (MORE_LIKELY + lost));
    }
    for (uint8_t other = 0U; other < SINGLES; other++) {
        sure = sure && ((other == one) || ((gains[one] - gains[other]) >= lead));
    }
    return sure ? change_of(one) : EST_CHANGE_UNDECIDED;
}

/// True iff the present sample comes after the alarm.
static bool is_after_alarm(const est_isolation_t* const self) { return self->worked_n > self->onsets[0].before_n; }

static void diagnose(est_isolation_t* const self) {
    est_diagnosis_t* const out = &self->diagnosis;
    out->samples_n             = (uint16_t)(self->worked_n - self->onsets[0].before_n);
    if (out->change == EST_CHANGE_UNDECIDED) {
        out->change = decide(&self->fit, out->samples_n);
    }
    if ((out->change == EST_CHANGE_UNDECIDED) || (out->change == EST_CHANGE_SEVERAL)) {
        return;
    }
    const uint8_t             one   = index_of(out->change);
    const est_single_t* const found = &self->fit.single[one];
    const float               level = found->best - 2.0F;
    out->extent       = ((one < PARAMETERS) || is_gain(out->change)) ? extent_of(out->change, found->change) : 1.0F;
    out->onset_n      = (uint16_t)(found->before_n + self->repeated_n);
    out->onset_low_n  = out->onset_n;
    out->onset_high_n = out->onset_n;
    for (uint8_t i = 0U; i < EST_ISOLATION_ONSETS_N; i++) {
        const uint16_t n = (uint16_t)(self->onsets[i].before_n + self->repeated_n);
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
/// the change before the alarm, and the impulses compensate for coarser steps.
static uint8_t onset_before(const uint8_t i, const uint8_t earliest_n) {
    static const uint8_t wanted_n[EST_ISOLATION_ONSETS_N] = { 20U, 13U, 9U, 6U, 4U, 3U, 2U, 1U };
    return (wanted_n[i] < earliest_n) ? wanted_n[i] : earliest_n;
}

/// Start the diagnosis of an alarm. One that is under way continues: such alarms are usual after a fault.
static void start(est_isolation_t* const self, const est_t* const estimator) {
    const uint8_t past_n     = 4U;
    const uint8_t earliest_n = (self->known_n > past_n) ? (uint8_t)(self->known_n - past_n) : 0U;
    const bool    was_quiet  = self->quiet;
    if (self->active && (self->diagnosis.change == EST_CHANGE_UNDECIDED)) {
        self->repeated_n = (uint8_t)(self->repeated_n + self->since_n);
        self->since_n    = 0U;
        return;
    }
    stop(self);
    self->since_n    = 0U;
    self->repeated_n = 0U;
    self->diagnosis  = (est_diagnosis_t){ .change = EST_CHANGE_UNDECIDED, .extent = 1.0F };
    if (!was_quiet || (earliest_n < 1U) || !derive_plant(&self->plant, self->config, self->force_zero)) {
        return;
    }
    for (uint8_t i = 0U; i < EST_ISOLATION_ONSETS_N; i++) {
        self->onsets[i].before_n = onset_before(i, earliest_n);
    }
    for (uint8_t i = 0U; i < CHANNELS; i++) {
        const float same  = (self->habits.known_n < HABITS_N) ? 0.999F : est_max(self->habits.same[i], 0.01F);
        self->surprise[i] = -logarithm((same < 0.999F) ? same : 0.999F);
        self->same_n[i]   = 0U;
    }
    self->active      = true;
    self->slot        = 0U;
    self->worked_n    = 0U;
    self->waiting_n   = self->onsets[0].before_n;
    self->nats        = 0.5F / est_scale(estimator);  // the misfit of the model is noise to isolation
    self->residual[0] = sample_before(self, self->waiting_n)->innovation;
    self->residual[1] = sample_before(self, self->waiting_n + 1U)->innovation;
    for (uint32_t i = EST_ISOLATION_LAGS_N; i > 0U; i--) {
        advance(self, (self->waiting_n + i) - 1U);
    }
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
    self->quiet = true;
    est_copy_theta(estimator, self->plant.theta);
    self->plant.c[0] = est_prefilter(estimator, 0U);
    self->plant.c[1] = est_prefilter(estimator, 1U);
}

static void enter_quiet(est_isolation_t* const self, const est_t* const estimator, const est_step_t step) {
    if (step.status == EST_GATHERING) {
        self->since_n = (self->known_n > 1U) ? 0U : self->since_n;  // without a gap: theta has jumped
        self->known_n = 0U;
        self->quiet   = false;
    } else if ((step.statistic <= 0.0F) && (self->since_n >= SETTLED_N)) {
        take_theta(self, estimator);
        if (self->known_n >= EST_ISOLATION_LAGS_N) {
            follow_habits(self);
        }
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
        return;
    }
    keep(self, sample, step.innovation);
    if (self->active) {
        self->waiting_n++;
        if ((self->waiting_n > (EST_ISOLATION_KEPT_N - 4U)) ||
            (((uint32_t)self->since_n + self->repeated_n) >= SETTLED_N)) {
            stop(self);
        }
    } else {
        enter_quiet(self, estimator, step);
    }
    if (step.alarm) {
        start(self, estimator);
    }
}

/// Number of onsets before the present sample.
static uint8_t count_begun(const est_isolation_t* const self) {
    uint8_t out = 0U;
    while ((out < EST_ISOLATION_ONSETS_N) &&
           ((self->worked_n + self->onsets[out].before_n) > self->onsets[0].before_n)) {
        out++;
    }
    return out;
}

/// Begin a sample. Hypotheses are weighed after the alarm, with the newest sample: a delay of the work does not grow.
static void begin_sample(est_isolation_t* const self) {
    advance(self, self->waiting_n - 1U);
    enter_residual(self);
    enter_habits(self);
    drive(self, EST_ISOLATION_LAGS_N, self->driving);
    self->worked_n++;
    self->begun_n  = count_begun(self);
    self->slices_n = (uint8_t)(1U + ((self->begun_n + 1U) / AT_ONCE));
    if (is_after_alarm(self) && (self->waiting_n == 1U)) {
        clear_fit(&self->fit);
        self->slices_n = EST_ISOLATION_SLICES_N;
    }
}

static void enter_onsets(est_isolation_t* const self, const uint8_t first) {
    for (uint8_t i = first; (i < (first + AT_ONCE)) && (i < self->begun_n); i++) {
        enter_onset(self, &self->onsets[i]);
    }
}

bool est_isolation_work(est_isolation_t* const self) {
    EST_ASSERT(self != NULL);
    if (!self->active || (self->waiting_n == 0U)) {
        return false;
    }
    if (self->slot == 0U) {
        begin_sample(self);
    } else if (self->slot <= ENTERED) {
        enter_onsets(self, (uint8_t)(AT_ONCE * (self->slot - 1U)));
    } else if (self->slot <= WEIGHED) {
        const uint8_t number = (uint8_t)((self->slot - (ENTERED + 1U)) / 2U);
        if (((self->slot - ENTERED) % 2U) == 1U) {
            weigh_plant(self, number);
        } else {
            weigh_faults(self, number);
        }
    } else {
        diagnose(self);
    }
    self->slot++;
    if (self->slot >= self->slices_n) {
        self->slot = 0U;
        self->waiting_n--;
    }
    return self->waiting_n > 0U;
}

est_diagnosis_t est_isolation_diagnosis(const est_isolation_t* const self) {
    EST_ASSERT(self != NULL);
    return self->diagnosis;
}

bool est_isolation_parameters(const est_t* const estimator, const est_units_t units, est_parameters_t* const out) {
    EST_ASSERT((estimator != NULL) && (out != NULL));
    const est_config_t* const config = estimator->config;
    float                     theta[EST_THETA_MAX];
    float                     b = 0.0F;
    float                     p = 0.0F;
    float                     q = 0.0F;
    if (config->na != 2U) {
        return false;
    }
    est_copy_theta(estimator, theta);
    for (uint_fast8_t i = 0U; i < config->nb; i++) {
        b += theta[2U + i];
    }
    if (!(b > 0.0F) || !poles_of(theta, &p, &q)) {
        return false;
    }
    out->stiffness = (units.force * (1.0F + theta[0] + theta[1])) / (units.displacement * b);
    out->mass      = (out->stiffness * units.period * units.period) / q;
    out->damping   = (out->mass * p) / units.period;
    return true;
}
