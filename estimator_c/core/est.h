/// est: recursive least-squares estimation of an ARX model with a change trigger, for small embedded targets.
///
/// The model, in sampled codes y (output) and u (input):
///
///     y(k) = -a1 y(k-1) - ... - a_na y(k-na) + b_0 u(k-nk) + ... + b_(nb-1) u(k-nk-nb+1) [+ d] + C(z) e(k)
///
/// The parameters are theta = (a1 .. a_na, b_0 .. b_(nb-1) [, c_1 .. c_nc] [, d]). They are estimated by Bierman's U-D
/// factorised least squares on the equation whitened by 1/C. A trigger watches the innovation and raises an alarm when
/// theta has jumped. Missing samples are tolerated. harness/docs/background/estimator.md derives
/// the algorithm.
///
/// The library is freestanding C99 in float32: no heap, no libm, no globals, no recursion. The caller owns the state;
/// any number of instances may coexist. It is not thread-safe: one instance belongs to one context, which may be an
/// interrupt. An instance keeps the pointer to its configuration, and with it the context of a custom trigger. Both
/// must stay valid and unchanged while the instance is used.
///
/// Compile every file with -ffp-contract=off: contraction rounds differently on each target.
///
/// Typical use:
///
///     static est_t estimator;
///     const est_config_t config = est_config_default();
///     if (!est_init(&estimator, &config)) { ... a value of config is out of range ... }
///     for (;;) {
///         const est_sample_t sample = { .u = force, .y = displacement, .valid = true };
///         const est_step_t step = est_step(&estimator, sample);
///         if (step.alarm) { ... the plant has changed ... }
///         use(est_theta(&estimator, 0), ...);
///     }
///
/// Distributed under the terms of the MIT License.

#ifndef EST_H_INCLUDED
#define EST_H_INCLUDED

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define EST_VERSION_MAJOR 0  // MISRA D1
#define EST_VERSION_MINOR 1  // MISRA D1

/// Maximum orders and maximum number of parameters. They determine sizeof(est_t); override them with -D in every file.
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

/// Number of past samples in the longest model.
#define EST_INPUT_PAST_MAX (EST_NB_MAX + EST_NK_MAX - 1U)

/// Change triggers.
typedef enum {
    EST_TRIGGER_NONE = 0,
    /// Alarm when |innovation| reaches the ceiling. Thesis 4.4.2.
    EST_TRIGGER_PREDICTION_ERROR = 1,
    /// Alarm when |mean innovation since the last alarm| reaches the ceiling. The mean is held at zero for hold_off_n
    /// samples after an alarm. Thesis 4.4.3.
    EST_TRIGGER_MEAN_BETWEEN_FAULTS = 2,
    /// Cumulative sum of the normalised squared innovation. The ceiling is ln(ARL0), with ARL0 the mean number of
    /// samples between false alarms. The default.
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
    est_trigger_kind_t kind;
    est_reset_t        reset;
    bool               absolute;    ///< mean between faults: average |innovation| instead of the innovation
    uint16_t           hold_off_n;  ///< innovations after an alarm during which the statistic is held at zero
    uint16_t           warm_up_n;   ///< innovations after est_init() during which the statistic is held at zero
    float              ceiling;  ///< > 0; ln(ARL0) for the cumulative sum, [codes] for the two triggers of the thesis
    est_trigger_fn     custom;   ///< for EST_TRIGGER_CUSTOM
    void*              context;  ///< first argument of custom
} est_trigger_config_t;

/// Position of the edges of u between two sampling instants. The sampled u does not show it.
typedef enum {
    /// Always the same position, as with a generator on the clock of the card. The b's absorb it.
    EST_EDGES_LOCKED = 0,
    /// Nearly the same position, but it may drift across a sampling instant. The edge is then recorded one sample
    /// earlier or later than before, which is counted as a slip and raises no alarm. For a generator on its own
    /// clock, to some 20 ppm, whose period is a whole number of samples. Forgetting must follow the drift of the b's.
    /// Requires the cumulative sum; with any other trigger the effect is that of EST_EDGES_LOCKED.
    EST_EDGES_MAY_SLIP = 1,
    /// Any position, different for each edge. The na equations that involve an edge are omitted, because the effect
    /// of the edge within its interval is unknown. For any generator. Cost: some 10 % of detection delay.
    EST_EDGES_ANYWHERE = 2,
} est_edge_instants_t;

/// Configuration of an estimator, fixed during a run. P is in units of the noise variance of y: P = 10 is a prior
/// standard deviation of sqrt(10) times that of the noise. A count of 0 disables the feature.
typedef struct {
    uint8_t  na;      ///< order of A; 1 .. EST_NA_MAX
    uint8_t  nb;      ///< number of b's; 1 .. EST_NB_MAX
    uint8_t  nk;      ///< delay of the first b; 0 .. EST_NK_MAX. A free-running generator needs 0: y(k) <- u(k)
    uint8_t  nc;      ///< coefficients of C to estimate (extended least squares, thesis Equ 3.11); 0 .. EST_NC_MAX
    bool     offset;  ///< estimate d. na + nb + nc + offset must not exceed EST_THETA_MAX
    bool     noise_estimated;  ///< estimate the noise variance, starting from noise_variance
    uint16_t refresh_n;        ///< equations after which C follows the estimate of A; 0: C is constant
    uint8_t  stuck_n;          ///< samples of constant y after an edge of u that count as stuck; 0: no check
    uint16_t idle_n;           ///< samples without an edge of u that count as lost excitation; 0: no check
    /// Position of the edges of u.
    est_edge_instants_t edge_instants;
    float               forgetting;      ///< lambda of thesis Equ 3.21; 0.5 .. 1; 1 forgets nothing
    float               random_walk;     ///< variance added to each parameter per equation (thesis Equ 3.23); 0 .. 1e9
    float               p0;              ///< initial variance of each a, b and c; > 0
    float               p0_offset;       ///< initial variance of d; > 0 [codes^2]
    float               noise_variance;  ///< variance of e; must not be underestimated; > 0 [codes^2]
    float               c[EST_NA_MAX];   ///< prefilter C = 1 + c[0] z^-1 + ...; zeros inside the unit circle; 0: none
    float               edge_codes;      ///< smallest step of u that is an edge; > 0, at most EST_CODE_LIMIT [codes]
    float               code_low;        ///< u and y saturate at or below this code; at least -EST_CODE_LIMIT
    float               code_high;       ///< u and y saturate at or above this code; at most EST_CODE_LIMIT
    /// Trigger and its parameters.
    est_trigger_config_t trigger;
} est_config_t;

/// A pair of samples taken at the same instant. u and y are ignored unless valid.
typedef struct {
    float u;
    float y;
    bool  valid;
} est_sample_t;

/// Treatment of a sample.
typedef enum {
    EST_UPDATED   = 0,  ///< the sample updated the estimate
    EST_MISSING   = 1,  ///< the sample was not valid: theta and its covariance are unchanged
    EST_REFUSED   = 2,  ///< u or y was non-finite, saturated or stuck: counted, otherwise as EST_MISSING
    EST_GATHERING = 3,  ///< the sample was stored, but its equation also needs samples that are still unknown
} est_status_t;

/// Largest magnitude of a sample that is accepted [codes].
#define EST_CODE_LIMIT 1.0e6F

/// Largest ceiling of a trigger [codes, or ln(ARL0)].
#define EST_CEILING_LIMIT 1.0e9F

/// Range of p0, p0_offset and noise_variance.
#define EST_VARIANCE_MIN 1.0e-9F
#define EST_VARIANCE_MAX 1.0e9F

/// Result of one step.
typedef struct {
    est_status_t status;
    bool         alarm;       ///< the plant has changed; estimation restarts with the next sample
    bool         idle;        ///< excitation is lost: the estimate does not improve
    float        innovation;  ///< e(k) = y_f(k) - phi_f(k)' theta(k-1) [codes]; 0 unless status is EST_UPDATED
    float        statistic;   ///< statistic of the trigger after this sample, before an alarm or a gap resets it
} est_step_t;

/// Counters since est_init(). They saturate instead of wrapping.
typedef struct {
    uint32_t updated;    ///< samples with EST_UPDATED or EST_GATHERING
    uint32_t missing;    ///< samples that were not valid
    uint16_t refused;    ///< samples refused for any reason
    uint16_t saturated;  ///< samples refused because u or y was saturated
    uint16_t stuck;      ///< samples refused because y was stuck
    uint16_t alarms;
    uint16_t restarts;   ///< times the whitening began anew, including the first
    uint16_t slips;      ///< times the edges of u began to be recorded one sample earlier or later
    uint16_t refreshes;  ///< times C was taken from the estimate of A
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

/// Last values of one whitened signal, newest first. Private.
typedef struct {
    float x[EST_NA_MAX];
} est_past_t;

/// Filter that whitens the noise of consecutive equations. Private to est_whitener.h.
typedef struct {
    float      c[EST_NA_MAX];
    float      gain[EST_GAINS_KEPT][EST_NA_MAX];  ///< one row an equation, newest first
    float      precision[EST_NA_MAX];             ///< of the whitened equations, newest first; 0: no equation
    est_past_t past[EST_THETA_MAX + 1U];          ///< one for each element of the equation
} est_whitener_t;

/// Effect of the recent edges of u if they had come one sample early or late. Private to est_edges.h.
typedef struct {
    est_past_t early;                 ///< their share in the whitened equations
    est_past_t late;                  ///< the same for late edges
    float      theta[EST_THETA_MAX];  ///< theta before the first of these edges
} est_edges_t;

/// Readings of the recent edges other than the recorded one: one sample early, one sample late.
#define EST_OTHER_READINGS 2U

/// State of a trigger. Private to est_trigger.h.
typedef struct {
    float    statistic;
    float    rival[EST_OTHER_READINGS];  ///< cumulative sum under each other reading; rival[0] also holds the mean
    uint16_t quiet_n;                    ///< remaining innovations during which the statistic is held at zero
    uint16_t mean_n;                     ///< innovations in the mean between faults; 0: the next one is the first
} est_trigger_t;

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
    uint8_t             same_n;                      ///< samples of constant y since an edge of u
    uint8_t             pending_n;                   ///< samples needed before the next equation is complete
    bool                adaptive;                    ///< residuals, random walk or noise variance need an update
    est_renewal_t       renewal;                     ///< work left by the last step
    bool                known;                       ///< the previous sample is known; if not, pending_n > 0
    bool                settled;                     ///< the gains of the whitener are c, and its variance is 1
    uint16_t            refresh_in;                  ///< equations until C is compared with A; 0: never
    uint16_t            edge_age_n;                  ///< samples since the last edge of u
    uint8_t             doubt_n;                     ///< samples since the first edge in doubt, inclusive; 0: no doubt
    float               noise_variance;              ///< [codes^2]
    float               y[EST_NA_MAX];               ///< y(k-1), y(k-2), ...
    float               u[EST_INPUT_PAST_MAX + 2U];  ///< u(k), u(k-1), ...
    est_trigger_t       trigger;
    est_counters_t      counters;
    float               theta[EST_THETA_MAX];
    est_factors_t       factors;
    est_whitener_t      whitener;
    est_edges_t         edges;
#if EST_NC_MAX > 0
    float residual[EST_NC_MAX];  ///< of the previous equations, newest first
#endif
} est_t;

/// Return the configuration for a generator on a clock of its own: ARX(2, 3) with delay 0 and offset; forgetting
/// 0.99; C from A, starting at (1 - 0.8 z^-1)^2; cumulative sum with ARL0 = 1e5, armed after 150 samples. A build
/// with less room drops the offset first, then b's. Cannot fail. Cost: a copy. May be called from an interrupt.
est_config_t est_config_default(void);

/// True iff every value of the configuration is in the range stated at its field, and this build supports it. Cannot
/// fail. Cost: constant. May be called from an interrupt.
bool est_config_valid(const est_config_t* config);

/// Prepare the estimator for the first sample: theta zero, P = P0, counters zero.
/// The configuration is not copied. It must stay unchanged while the estimator is used; it may be in flash.
/// Returns false iff the configuration is not valid; the state is then unusable. A build with -DEST_WITH_CHECKS=0 omits
/// the check. Cost: as one est_step(). RAM: the state. May be called from an interrupt.
bool est_init(est_t* self, const est_config_t* config);

/// Enter one sample: whiten the equation, update theta and P (Bierman 1977), run the trigger.
/// Bad data never fails and never enters the estimate: see est_status_t.
/// Cost: about 3 n^2 / 2 multiplications and n divisions with n parameters. The longest step takes up to 1.3 times a
/// typical one if edges may slip, 1.2 times otherwise.
/// RAM: the state, and some 300 bytes of stack. May be called from an interrupt.
est_step_t est_step(est_t* self, est_sample_t sample);

/// Number of parameters: na + nb + nc + offset. Cost: constant. May be called from an interrupt.
uint8_t est_theta_count(const est_t* self);

/// One element of theta. index is in [0, est_theta_count()), asserted. After a slip and until the next sample, theta
/// still contains the effect of the slipped edge. Cost: constant. May be called from an interrupt.
float est_theta(const est_t* self, uint8_t index);

/// One diagonal element of P [noise variances]. index is in [0, est_theta_count()), asserted. After an alarm and
/// until the next sample, P is still that before the alarm. Cost: O(n). May be called from an interrupt.
float est_variance(const est_t* self, uint8_t index);

/// Noise variance [codes^2], configured or estimated. Cost: constant. May be called from an interrupt.
float est_noise_variance(const est_t* self);

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
