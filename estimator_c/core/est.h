// SPDX-License-Identifier: MIT
/// est: recursive least-squares estimation of an ARX model with a change trigger, for small embedded targets.
///
/// The model, in sampled codes y (output) and u (input):
///
///     y(k) = -a1 y(k-1) - ... - a_na y(k-na) + b_0 u(k-nk) + ... + b_(nb-1) u(k-nk-nb+1) [+ d] + C(z) e(k)
///
/// The parameters are theta = (a1 .. a_na, b_0 .. b_(nb-1) [, c_1 .. c_nc] [, d]). They are estimated by Bierman's U-D
/// factorised least squares on the equation whitened by 1/C. A trigger watches the innovation and raises an alarm when
/// theta has jumped. Missing samples are tolerated. harness/docs/background/estimator.md derives the algorithm.
///
/// The library is freestanding C99 in float32: no heap, no libm, no globals, no recursion. The caller owns the state;
/// any number of instances may coexist. It is not thread-safe: one instance belongs to one context, which may be an
/// interrupt. An instance keeps the pointer to its configuration, and with it the context of a custom trigger. Both
/// must stay valid and unchanged while the instance is used.
///
/// Compile every file with -ffp-contract=off: contraction rounds differently on each target.
///
/// Typical use, with a 12-bit converter. Both objects are static, because the estimator keeps a pointer to `config`:
///
///     static const est_config_t config = EST_CONFIG_FOR_CODES(-1.0F, 4096.0F);
///     static est_t              estimator;
///     if (!est_init(&estimator, &config)) { ... a value of config is out of range ... }
///     for (;;) {
///         const est_sample_t sample = { .u = force, .y = displacement, .valid = true };
///         const est_step_t step = est_step(&estimator, sample);
///         if (step.alarm) { ... the plant has changed ... }
///         use(est_theta(&estimator, 0), ...);
///     }
///
/// The false-alarm rate holds from the end of the warm-up on, by default 550 innovations after est_init(). It holds for
/// white noise of 0.3 to 4 codes, 10 to 18 bits, and poles from 0.3 to 0.999. If the edges of u drift by 20 ppm, it
/// holds on average over such plants, and slow ones have up to 2.5 times as many false alarms. If the noise is
/// coloured, or the model does not fit the plant, the trigger becomes less sensitive: est_scale() grows, and an alarm
/// needs a second hypothesis of correlated innovations. est_fit.h names the cause.
///
/// Units: signals are in codes of the converter, so that quantisation is 1. The defaults assume noise of about one
/// code. If signals have another unit, say volts, either divide them by the volts per code, which needs no other
/// change, or scale noise_variance, p0, edge_codes, code_low and code_high by the unit stated at each.

#ifndef EST_H_INCLUDED
#define EST_H_INCLUDED

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define EST_VERSION_MAJOR 0  // MISRA D1
#define EST_VERSION_MINOR 1  // MISRA D1
#define EST_VERSION_PATCH 0  // MISRA D1

// ---------------------------------------------     BUILD OPTIONS      ---------------------------------------------

/// Every option is a macro to be set with -D, to the same value in every file that includes this header.
///
/// | macro                       | default    | effect                                                             |
/// |-----------------------------|------------|--------------------------------------------------------------------|
/// | EST_NA_MAX                  | 2U         | maximum order of A; 1 .. 8                                         |
/// | EST_NB_MAX                  | 3U         | maximum number of b's; 1 .. 8                                      |
/// | EST_NK_MAX                  | 1U         | maximum delay; 0 .. 8                                              |
/// | EST_NC_MAX                  | 0U         | maximum order of C, if it is estimated; 0 .. 8                     |
/// | EST_THETA_MAX               | 6U         | maximum number of parameters; 2 .. 25                              |
/// | EST_FIXED_NA, _NB, _NK, _NC | undefined  | fixed orders, for fewer instructions. Define all five or none.     |
/// | EST_FIXED_OFFSET            | undefined  | 1U: the offset is estimated; 0U: it is not                         |
/// | EST_WITH_EDGES              | 1          | 0 omits EST_EDGES_MAY_SLIP and EST_EDGES_ANYWHERE                  |
/// | EST_WITH_TRIGGERS           | 1          | 0 omits the triggers other than the cumulative sum                 |
/// | EST_WITH_ADAPTATION         | 1          | 0 omits nc, random_walk and refresh_n                              |
/// | EST_WITH_WATCH              | 1          | 0 omits stuck_n, idle_n and the count of saturated samples         |
/// | EST_WITH_ROBUSTNESS         | 1          | 0 omits noise_estimated, the delta form, inflation, lone outliers, |
/// |                             |            | and bridges over gaps: for rigs that the model is known to fit     |
/// | EST_WITH_CHECKS             | 1          | 0 omits the check of the configuration by est_init()               |
/// | EST_ASSERT(x)               | assert(x)  | statement that must not continue if x is false: the caller made a  |
/// |                             |            | mistake. Empty by default with NDEBUG or without an assert.h       |
///
/// The five maxima and EST_WITH_ROBUSTNESS determine the layout of the state. They are part of the names that the
/// linker sees: if the library and its caller disagree, est_init() is an undefined reference. Write the maxima as
/// numbers, with U or without it, alike in every file. A configuration that requests an omitted feature is refused by
/// est_init(). EST_WITH_CHECKS=0 is for a constant configuration that est_config_valid() has accepted elsewhere, as in
/// a test on the host.
#ifndef EST_NA_MAX
#define EST_NA_MAX 2U
#endif
#ifndef EST_NB_MAX
#define EST_NB_MAX 3U
#endif
#ifndef EST_NK_MAX
#define EST_NK_MAX 1U
#endif
#ifndef EST_NC_MAX
#define EST_NC_MAX 0U
#endif
#ifndef EST_THETA_MAX
#define EST_THETA_MAX 6U
#endif
#if (EST_NA_MAX < 1) || (EST_NA_MAX > 8) || (EST_NB_MAX < 1) || (EST_NB_MAX > 8) || (EST_NK_MAX > 8) || (EST_NC_MAX > 8)
#error "EST_NA_MAX and EST_NB_MAX must be in the range [1, 8], EST_NK_MAX and EST_NC_MAX in [0, 8]"
#endif
#if (EST_THETA_MAX < 2) || (EST_THETA_MAX > 25)
#error "EST_THETA_MAX must be in the range [2, 25]"
#endif
#ifndef EST_WITH_EDGES
#define EST_WITH_EDGES 1
#endif
#ifndef EST_WITH_TRIGGERS
#define EST_WITH_TRIGGERS 1
#endif
#ifndef EST_WITH_ADAPTATION
#define EST_WITH_ADAPTATION 1
#endif
#ifndef EST_WITH_WATCH
#define EST_WITH_WATCH 1
#endif
#ifndef EST_WITH_CHECKS
#define EST_WITH_CHECKS 1
#endif
#ifndef EST_WITH_ROBUSTNESS
#define EST_WITH_ROBUSTNESS 1
#endif

/// Names with everything that determines the layout of the state, as est_init_na2U_nb3U_nk1U_nc0U_theta6U_full.
/// Private.
#if EST_WITH_ROBUSTNESS
#define EST_NAME_BUILD _full
#else
#define EST_NAME_BUILD _lean
#endif
#define EST_NAME_JOINED(name, a, b, k, c, n, build) name##_na##a##_nb##b##_nk##k##_nc##c##_theta##n##build  // MISRA D5
#define EST_NAME_EXPANDED(name, a, b, k, c, n, build) EST_NAME_JOINED(name, a, b, k, c, n, build)
#define EST_NAME(name)                                                                                                 \
    EST_NAME_EXPANDED(name, EST_NA_MAX, EST_NB_MAX, EST_NK_MAX, EST_NC_MAX, EST_THETA_MAX, EST_NAME_BUILD)
#define est_init EST_NAME(est_init)
#define est_config_default EST_NAME(est_config_default)
#define est_config_for_codes EST_NAME(est_config_for_codes)

/// Warning if the result of a function is ignored. Private.
#ifdef __GNUC__
#define EST_RESULT_USED __attribute__((warn_unused_result))
#else
#define EST_RESULT_USED
#endif

// ---------------------------------------------     CONFIGURATION      ---------------------------------------------

/// Number of past samples in the longest model.
#define EST_INPUT_PAST_MAX (EST_NB_MAX + EST_NK_MAX - 1U)

/// Largest magnitude of a sample that is accepted [codes].
#define EST_CODE_LIMIT 1.0e6F

/// Largest ceiling of a trigger [codes, or ln(ARL0)].
#define EST_CEILING_LIMIT 1.0e9F

/// Range of p0, p0_offset and noise_variance.
#define EST_VARIANCE_MIN 1.0e-9F
#define EST_VARIANCE_MAX 1.0e9F

/// Change triggers.
typedef enum {
    EST_TRIGGER_NONE = 0,
    /// Alarm when |innovation| reaches the ceiling. Thesis 4.4.2.
    EST_TRIGGER_PREDICTION_ERROR = 1,
    /// Alarm when |mean innovation since the last alarm| reaches the ceiling. The mean is held at zero for hold_off_n
    /// samples after an alarm. Thesis 4.4.3.
    EST_TRIGGER_MEAN_BETWEEN_FAULTS = 2,
    /// Cumulative sum of the normalised squared innovation. The ceiling is ln(ARL0), with ARL0 the mean number of
    /// samples between false alarms, as measured. The default.
    EST_TRIGGER_CUSUM = 3,
    /// A function of the caller: see est_trigger_fn.
    EST_TRIGGER_CUSTOM = 4,
} est_trigger_kind_t;

/// Effect of an alarm on the estimate.
typedef enum {
    /// Reset the covariance to its initial value; keep theta. Thesis 4.4.3 (i).
    EST_RESET_COVARIANCE = 0,
    /// Reset the covariance, and theta to zero. Thesis 4.4.2.
    EST_RESET_ALL = 1,
} est_reset_t;

/// Custom trigger: enter one innovation [codes] with its predicted variance [codes^2] and return the statistic, which
/// must be finite and not negative. An alarm is raised when it reaches the ceiling. `anew` is true for the first
/// innovation after est_init() and after an alarm. Called from est_step(), in its context; it must not call the
/// estimator.
typedef float (*est_trigger_fn)(void* context, float innovation, float variance, bool anew);

typedef struct {
    est_trigger_kind_t kind;      ///< statistic
    est_reset_t        reset;     ///< effect of an alarm
    bool               absolute;  ///< mean between faults: average |innovation| instead of the innovation
    uint16_t hold_off_n;          ///< innovations after an alarm during which the statistic is held at zero; usually 0
    uint16_t warm_up_n;           ///< innovations after est_init() during which it is held at zero; usually 550
    /// > 0, at most EST_CEILING_LIMIT. Cumulative sum: ln(ARL0), usually 9 .. 16. The two triggers of the thesis:
    /// [codes], usually 4 .. 10 times the standard deviation of the noise.
    float          ceiling;
    est_trigger_fn custom;   ///< for EST_TRIGGER_CUSTOM
    void*          context;  ///< first argument of custom
} est_trigger_config_t;

/// Position of the edges of u between two sampling instants. The sampled u does not show it.
typedef enum {
    /// Always the same position, as with a generator on the clock of the card. The b's absorb it.
    EST_EDGES_LOCKED = 0,
    /// Nearly the same position, but it may drift across a sampling instant. The edge is then recorded one sample
    /// earlier or later than before, which is counted as a slip and raises no alarm. For a generator on its own
    /// clock, to some 20 ppm, whose period is a whole number of samples. Forgetting must follow the drift of the b's.
    /// Requires the cumulative sum; with any other trigger the effect is that of EST_EDGES_LOCKED. If the innovations
    /// after several edges show another position each time, the effect becomes that of EST_EDGES_ANYWHERE.
    EST_EDGES_MAY_SLIP = 1,
    /// Any position, different for each edge. The na equations that involve an edge are omitted, because the effect
    /// of the edge within its interval is unknown. For any generator. Cost: some 10 % of detection delay.
    EST_EDGES_ANYWHERE = 2,
} est_edge_instants_t;

/// Configuration of an estimator, fixed during a run. est_init() refuses a value out of its range; "usually" is a
/// recommendation. P is in units of the noise variance: the prior variance of a parameter is p0 * noise_variance. With
/// EST_WITH_ROBUSTNESS the parameters of this prior are those of the delta form, such as 2 + a1 and 1 + a1 + a2.
/// A count of 0 disables the feature. Counts are in samples.
typedef struct {
    uint8_t  na;      ///< order of A; 1 .. EST_NA_MAX, usually 2
    uint8_t  nb;      ///< number of b's; 1 .. EST_NB_MAX, usually na, or na + 1 if nk = 0
    uint8_t  nk;      ///< delay of the first b; 0 .. EST_NK_MAX. A free-running generator needs 0: y(k) <- u(k)
    uint8_t  nc;      ///< coefficients of C to estimate (extended least squares, thesis Equ 3.11); 0 .. EST_NC_MAX
    bool     offset;  ///< estimate d. na + nb + nc + offset must not exceed EST_THETA_MAX
    bool     noise_estimated;  ///< follow the noise variance, starting from noise_variance; usually true
    uint16_t refresh_n;        ///< equations after which C follows the estimate of A; 0: C is constant; usually 40
    uint8_t  stuck_n;          ///< samples of constant y after an edge of u that count as stuck; usually 8 .. 32
    uint16_t idle_n;           ///< samples without an edge of u that count as lost excitation; usually 20 periods of u
    /// Position of the edges of u.
    est_edge_instants_t edge_instants;
    /// lambda of thesis Equ 3.21; 0.5 .. 1, usually 0.98 .. 0.999. The memory is 1 / (1 - forgetting) samples; 1
    /// forgets nothing.
    float forgetting;
    /// Variance added to each parameter per equation (thesis Equ 3.23), in the unit of p0; 0 .. 1e9. Usually 0 with
    /// forgetting < 1, else 1e-12 .. 1e-11: with 1e-9 theta follows a change of 10 % so fast that no alarm is raised.
    float random_walk;
    float p0;         ///< initial variance of each a, b and c; 1e-9 .. 1e9, usually 1 .. 100 [1 / codes^2]
    float p0_offset;  ///< initial variance of d; 1e-9 .. 1e9, usually 1e6 [noise variances]
    /// Variance of e; 1e-9 .. 1e9 [codes^2], usually 0.1 .. 100. If the noise is estimated, the first value, and 14
    /// times the smallest one that is followed: usually 1.2, for noise from 0.3 codes on. Else it is to be measured at
    /// rest: too small a value causes false alarms, too large a value hides changes. The standard deviation is at most
    /// 1/32 of code_high - code_low.
    float noise_variance;
    float c[EST_NA_MAX];  ///< prefilter C = 1 + c[0] z^-1 + ...; zeros inside the unit circle; 0: none
    /// Smallest step of u that is an edge; > 0, at most code_high - code_low [codes]. Usually a tenth to a half of the
    /// steps of u, and at least 10 times the noise.
    float edge_codes;
    /// u and y are refused as saturated at or beyond these codes; -EST_CODE_LIMIT <= code_low < code_high <=
    /// EST_CODE_LIMIT. Usually the ends of the converter's range, or one code beyond those that u or y may reach.
    float code_low;
    float code_high;
    /// Trigger and its parameters.
    est_trigger_config_t trigger;
} est_config_t;

/// Orders of the default configuration: those fixed by the build, else ARX(2, 3) with offset. A build with less room
/// drops the offset first, then b's, then a's. Private.
#ifdef EST_FIXED_NA
#define EST_DEFAULT_NA EST_FIXED_NA
#define EST_DEFAULT_NB EST_FIXED_NB
#define EST_DEFAULT_NK EST_FIXED_NK
#define EST_DEFAULT_NC EST_FIXED_NC
#define EST_DEFAULT_OFFSET (EST_FIXED_OFFSET != 0)
#else
#if (EST_NA_MAX < 2) || (EST_THETA_MAX < 3)
#define EST_DEFAULT_NA 1U
#else
#define EST_DEFAULT_NA 2U
#endif
#define EST_WANTED_NB ((EST_NB_MAX < 3U) ? EST_NB_MAX : 3U)
#define EST_ROOM_NB (EST_THETA_MAX - EST_DEFAULT_NA)
#define EST_DEFAULT_NB ((EST_WANTED_NB < EST_ROOM_NB) ? EST_WANTED_NB : EST_ROOM_NB)
#define EST_DEFAULT_NK 0U
#define EST_DEFAULT_NC 0U
#define EST_DEFAULT_OFFSET ((EST_DEFAULT_NA + EST_DEFAULT_NB) < EST_THETA_MAX)
#endif
#if EST_DEFAULT_NA > 1
#define EST_DEFAULT_C                                                                                                  \
    { -1.6F, 0.64F }
#else
#define EST_DEFAULT_C                                                                                                  \
    { -0.8F }
#endif

/// Initialiser of an est_config_t for signals between these two codes. Outside them a sample is saturated, and
/// est_init() refuses noise and edges that do not fit in between: the defaults in a range of volts, for example. The
/// configuration is for a generator on a clock of its own: ARX(2, 3) with delay 0 and offset; forgetting 0.995; C from
/// A, starting at (1 - 0.8 z^-1)^2; noise of any variance; cumulative sum with ARL0 = 1e5, armed after 550 samples. A
/// build with less room drops the offset first, then b's. For static objects of C; elsewhere, and in C++ before C++20,
/// use est_config_for_codes(). To change a value, define the object without const and assign before est_init().
#define EST_CONFIG_FOR_CODES(low, high)                                                                                \
    {                                                                                                                  \
        .na = (uint8_t)EST_DEFAULT_NA, .nb = (uint8_t)EST_DEFAULT_NB, .nk = (uint8_t)EST_DEFAULT_NK,                   \
        .nc = (uint8_t)EST_DEFAULT_NC, .offset = EST_DEFAULT_OFFSET, .noise_estimated = EST_WITH_ROBUSTNESS != 0,      \
        .refresh_n = EST_WITH_ADAPTATION ? 40U : 0U, .stuck_n = EST_WITH_WATCH ? 16U : 0U,                             \
        .idle_n        = EST_WITH_WATCH ? 1000U : 0U,                                                                  \
        .edge_instants = EST_WITH_EDGES ? EST_EDGES_MAY_SLIP : EST_EDGES_LOCKED, .forgetting = 0.995F,                 \
        .random_walk = 0.0F, .p0 = 10.0F, .p0_offset = 1.0e6F, .noise_variance = 1.2F, .c = EST_DEFAULT_C,             \
        .edge_codes = 64.0F, .code_low = (low), .code_high = (high),                                                   \
        .trigger = {                                                                                                   \
            .kind       = EST_TRIGGER_CUSUM,                                                                           \
            .reset      = EST_RESET_COVARIANCE,                                                                        \
            .absolute   = false,                                                                                       \
            .hold_off_n = 0U,                                                                                          \
            .warm_up_n  = EST_WITH_ROBUSTNESS ? 550U : 150U,                                                           \
            .ceiling    = 11.512925F, /* ln 1e5: ARL0 of 100,000 */                                                    \
            .custom     = NULL,                                                                                        \
            .context    = NULL,                                                                                        \
        },                                                                                                             \
    }

/// EST_CONFIG_FOR_CODES() with the widest range: nothing is saturated, and a wrong unit goes unnoticed.
#define EST_CONFIG_DEFAULT EST_CONFIG_FOR_CODES(-EST_CODE_LIMIT, EST_CODE_LIMIT)

// ---------------------------------------------         STATE          ---------------------------------------------

/// A pair of samples taken at the same instant.
typedef struct {
    float u;      ///< input [codes]
    float y;      ///< output [codes]
    bool  valid;  ///< false: u and y are ignored
} est_sample_t;

/// Treatment of a sample.
typedef enum {
    EST_UPDATED   = 0,  ///< the sample updated the estimate
    EST_MISSING   = 1,  ///< the sample was not valid: theta and its covariance are unchanged. See est_step()
    EST_REFUSED   = 2,  ///< u or y was non-finite, saturated or stuck: counted, otherwise as EST_MISSING
    EST_GATHERING = 3,  ///< the sample was stored, but its equation also needs samples that are still unknown
    EST_OUTLIER   = 4,  ///< lone outlier: theta is unchanged, y is replaced by its prediction. See est_step()
} est_status_t;

/// Result of one step.
typedef struct {
    est_status_t status;      ///< treatment of the sample
    bool         alarm;       ///< the plant has changed; estimation restarts with the next sample
    bool         idle;        ///< excitation is lost: the estimate does not improve. Always: edge_codes is too large
    float        innovation;  ///< e(k) = y_f(k) - phi_f(k)' theta(k-1) [codes]; 0 unless EST_UPDATED or EST_OUTLIER
    float statistic;  ///< of the trigger after this sample, before an alarm or a gap resets it; 0 for EST_OUTLIER
} est_step_t;

/// Counters since est_init(). They saturate instead of wrapping.
typedef struct {
    uint32_t updated;    ///< samples with EST_UPDATED, EST_GATHERING or EST_OUTLIER
    uint32_t missing;    ///< samples that were not valid
    uint16_t refused;    ///< samples refused for any reason
    uint16_t saturated;  ///< samples refused because u or y was saturated
    uint16_t stuck;      ///< samples refused because y was stuck
    uint16_t alarms;
    uint16_t restarts;   ///< times the whitening began anew, including the first
    uint16_t slips;      ///< times the edges of u began to be recorded one sample earlier or later
    uint16_t refreshes;  ///< times C was taken from the estimate of A
    uint16_t outliers;   ///< samples with EST_OUTLIER
} est_counters_t;

#define EST_UPPER_N ((EST_THETA_MAX * (EST_THETA_MAX - 1U)) / 2U)

/// P = U D U' / weight with U unit upper triangular. Private to est_factors.h.
typedef struct {
    float weight;  ///< product of the forgetting factors since the d's were last limited
    float d[EST_THETA_MAX];
    float upper[EST_UPPER_N];  ///< U by columns, without its diagonal
} est_factors_t;

/// Number of equations whose gains determine those of the next one.
#if EST_NA_MAX > 1
#define EST_GAINS_KEPT (EST_NA_MAX - 1U)
#else
#define EST_GAINS_KEPT 1U
#endif

/// Number of these gains: all but the last one, unless the filter uses them directly.
#if EST_WITH_ROBUSTNESS
#define EST_GAIN_COLUMNS EST_GAINS_KEPT
#else
#define EST_GAIN_COLUMNS EST_NA_MAX
#endif

/// Last whitened values of one signal, newest first; or the last one and its differences of order 1, 2, ... Private.
typedef struct {
    float x[EST_NA_MAX];
} est_past_t;

/// Filter that whitens the noise of consecutive equations. Private to est_whitener.h.
typedef struct {
    float c[EST_NA_MAX];
    float gain[EST_GAINS_KEPT][EST_GAIN_COLUMNS];  ///< one row per equation, newest first
    float precision[EST_NA_MAX];                   ///< of the whitened equations, newest first; 0: no equation
#if EST_WITH_ROBUSTNESS
    float step[EST_NA_MAX];  ///< factors of the differences in est_past_t, from the newest gains
#endif
    est_past_t past[EST_THETA_MAX + 1U];  ///< one for each element of the equation
} est_whitener_t;

/// Hypotheses of the recent edges other than the recorded one: one sample early, one sample late.
#define EST_OTHER_HYPOTHESES 2U

/// Effect of the recent edges of u under the other hypotheses. Private to est_edges.h.
typedef struct {
    est_past_t past[EST_OTHER_HYPOTHESES];  ///< their share in the whitened equations
    float      theta[EST_THETA_MAX];        ///< theta before the first of these edges
#if EST_WITH_ROBUSTNESS
    float along;   ///< sum of innovation times the effect of a displaced edge, since the edge
    float span;    ///< sum of that effect squared
    float energy;  ///< sum of the squared residuals, and a multiple of the last one before the edge
    float misfit;  ///< evidence that each edge is displaced otherwise
#endif
} est_edges_t;

/// State of a trigger. Private to est_trigger.h.
typedef struct {
    uint16_t quiet_n;  ///< remaining innovations during which the statistic is held at zero
    uint16_t mean_n;   ///< innovations in the mean between faults; 0: the next one is the first
    float    mean;     ///< mean between faults [codes]
    float    statistic;
    float    rival[EST_OTHER_HYPOTHESES];  ///< cumulative sum under each other hypothesis
} est_trigger_t;

/// Scale of the innovations and the validation of the last alarm. Private to est_scale.h.
typedef struct {
    uint8_t  stage;         ///< see est_scale.h
    uint8_t  block_n;       ///< equations in this block
    uint8_t  validation_n;  ///< equations in the validation of the last alarm
    uint8_t  high_n;        ///< steps of high blocks
    uint16_t budget_n;      ///< blocks that justify alarms which are not evident
    float    weight;        ///< of a squared innovation in the cumulative sum
    float    sum;           ///< terms of this block
    float    gained;        ///< in a validation, squared errors of the old estimate less those of the new one
    float    product;       ///< sum of this block's products of innovations at one lag: see est_correlation.h
    float    share;         ///< share of this block in the noise variance
    float    inflation;     ///< factor for what the model does not explain
    float    dispersion;    ///< mean of the squared mean squares of the blocks [noise variances^2]
} est_scale_t;

/// Serial correlation of the innovations. Private to est_correlation.h.
typedef struct {
    uint8_t work;           ///< of each step of this block; 0: none
    uint8_t slot;           ///< blocks so far
    uint8_t edge_outliers;  ///< a bit for each recent edge, the last one first: an outlier came right after it
    float   last[2];        ///< innovations of the last two equations, newest first [codes]
    float   partial[2];     ///< partial correlations at lags 1 and 2
    float   lead;           ///< sum of the first hypothesis less that of the second
} est_correlation_t;

/// Work that a step leaves to the next one. Private.
typedef enum {
    EST_RENEWAL_NONE      = 0,
    EST_RENEWAL_COMPARE   = 1,  ///< compare A with C at the next equation
    EST_RENEWAL_PREFILTER = 2,  ///< take C from A
    EST_RENEWAL_RESET     = 3,  ///< P := P0, after an alarm
    EST_RENEWAL_EARLY     = 4,  ///< after a slip: edges come one sample earlier, and theta is less certain
    EST_RENEWAL_LATE      = 5,  ///< after a slip: edges come one sample later, and theta is less certain
} est_renewal_t;

/// State of an estimator. The fields are private; use the functions below. Small fields come first, because an offset
/// below 128 bytes fits a short Thumb instruction.
typedef struct {
    const est_config_t* config;
    uint16_t            edge_age_n;   ///< samples since the last edge of u
    uint8_t             same_n;       ///< samples of constant y since an edge of u
    uint8_t             pending_n;    ///< samples needed before the next equation is complete
    est_renewal_t       renewal;      ///< work left by the last step
    bool                known;        ///< the previous sample is known; if not, pending_n > 0
    bool                settled;      ///< the gains of the whitener are c, and its variance is 1
    uint8_t             ambiguity_n;  ///< samples since the first ambiguous edge, inclusive; 0: none
#if EST_WITH_ROBUSTNESS
    bool    edges_vary;  ///< edges come anywhere, against the configuration
    uint8_t bridged_n;   ///< missing samples before the next one that were predicted
    bool    set_aside;   ///< the last sample was an outlier, and its y was predicted
#endif
    uint16_t refresh_in;  ///< equations until C is compared with A; 0: never
#if EST_WITH_ROBUSTNESS
    est_scale_t       scale;
    est_correlation_t correlation;
    float             reference_u;  ///< codes of the first sample, subtracted from all if the offset is estimated
    float             reference_y;
#endif
    est_trigger_t  trigger;
    est_counters_t counters;
    float          noise_variance;              ///< [codes^2]
    float          y[EST_NA_MAX];               ///< y(k-1), y(k-2), ...
    float          u[EST_INPUT_PAST_MAX + 2U];  ///< u(k), u(k-1), ...
    float          theta[EST_THETA_MAX];
    est_factors_t  factors;
    est_whitener_t whitener;
    est_edges_t    edges;
#if EST_WITH_ROBUSTNESS
    float before_alarm[EST_THETA_MAX];  ///< theta before the alarm under validation
#endif
#if EST_NC_MAX > 0
    float residual[EST_NC_MAX];  ///< of the previous equations, newest first
#endif
} est_t;

// ---------------------------------------------       FUNCTIONS        ---------------------------------------------

/// EST_CONFIG_FOR_CODES() of these codes, with the features of the build of est.c. Assign it to a static object: see
/// est_init(). Cannot fail. Cost: a copy. May be called from an interrupt.
est_config_t est_config_for_codes(float low, float high);

/// The same of EST_CONFIG_DEFAULT.
est_config_t est_config_default(void);

/// True iff every value of the configuration is in the range stated at its field, and this build supports it. Cannot
/// fail. Cost: constant. May be called from an interrupt.
bool est_config_valid(const est_config_t* config);

/// Prepare the estimator for the first sample: theta zero, P = P0, counters zero. With an offset and the cumulative
/// sum, d is that y after the first sample. The configuration is not copied. It must stay unchanged while the estimator
/// is used: a static object, or a constant in flash, but no local variable of a function that returns. With assertions,
/// est_step() detects most violations. Returns false iff the configuration is not valid; the state is then unusable. A
/// build with -DEST_WITH_CHECKS=0 omits the check. Cost: as one est_step(). RAM: the state. May be called from an
/// interrupt.
EST_RESULT_USED bool est_init(est_t* self, const est_config_t* config);

/// Enter one sample: whiten the equation, update P, run the trigger, update theta (Bierman 1977).
/// Bad data never fails and never enters the estimate: see est_status_t. Up to 8 samples in a row that are missing or
/// refused are predicted, if C is that of the plant and u is the same before and after them; the next good sample then
/// has its equation. After any other gap the equations begin anew, as after est_init().
/// With the cumulative sum, a lone outlier is set aside: an innovation of 12 standard deviations, at the default
/// ceiling, after small ones. It may be an interference of one sample. The next innovation is not set aside, and raises
/// the alarm if it passes the ceiling. This applies where a missing sample would be predicted.
/// Cost: about 3 n^2 / 2 multiplications and n divisions with n parameters. The longest step takes up to 1.45 times a
/// typical one if edges may slip, 1.33 times otherwise.
/// RAM: the state, and stack: on a Cortex-M 240 to 320 bytes, at -O0 1,190; on an AVR 250, at -O0 760 (make
/// cost). May be called from an interrupt.
est_step_t est_step(est_t* self, est_sample_t sample);

/// Number of parameters: na + nb + nc + offset. Cost: constant. May be called from an interrupt.
uint8_t est_theta_count(const est_t* self);

/// One element of theta. index is in [0, est_theta_count()), asserted. After a slip and until the next sample, theta
/// still contains the effect of the slipped edge. Cost: constant. May be called from an interrupt.
float est_theta(const est_t* self, uint8_t index);

/// All elements of theta, as est_theta() of each. out has EST_THETA_MAX elements, those beyond est_theta_count()
/// without meaning. Cost: as one est_theta(). May be called from an interrupt.
void est_copy_theta(const est_t* self, float* out);

/// One diagonal element of P [noise variances]. index is in [0, est_theta_count()), asserted. After an alarm and
/// until the next sample, P is still that before the alarm. Cost: O(n). May be called from an interrupt.
float est_variance(const est_t* self, uint8_t index);

/// Noise variance [codes^2], configured or estimated. Cost: constant. May be called from an interrupt.
float est_noise_variance(const est_t* self);

/// Scale of the innovations [codes^2]: the noise variance times the inflation, and more if the noise variance varies.
/// While the noise variance is young, the trigger expects up to three times as much; in the end 6 % more. Cost:
/// constant. May be called from an interrupt.
float est_scale(const est_t* self);

/// One coefficient of the prefilter C; zero beyond the order of A. index is in [0, EST_NA_MAX), asserted. Cost:
/// constant. May be called from an interrupt.
float est_prefilter(const est_t* self, uint8_t index);

/// A copy of the counters. Cost: constant. May be called from an interrupt.
est_counters_t est_counters(const est_t* self);

/// True iff the state is one that est_init() and est_step() can produce: the configuration is valid, every d positive
/// and finite, its weight in range, theta finite, statistic and noise variance in range. Counters and flags are not
/// checked. For self-tests in the field and for fuzzing. Cost: O(n). May be called from an interrupt.
bool est_invariants_hold(const est_t* self);

#ifdef __cplusplus
}
#endif

#endif  // EST_H_INCLUDED
