/// est: recursive least-squares estimation of an ARX model with a change trigger, for small embedded targets.
///
/// The model, in sampled codes y (output) and u (input):
///
///     y(k) = -a1 y(k-1) - ... - a_na y(k-na) + b_0 u(k-nk) + ... + b_(nb-1) u(k-nk-nb+1) [+ d] + C(z) e(k)
///
/// theta = (a1 .. a_na, b_0 .. b_(nb-1) [, c_1 .. c_nc] [, d]) is estimated by Bierman's U-D factorised least squares on
/// the equation whitened by 1/C; a trigger watches the innovation and tells when theta has jumped. Missing samples are
/// survived. estimator_c/README.md derives it; this header says how to use it.
///
/// The library is freestanding C99 in float32: no heap, no libm, no globals, no recursion. The caller owns the state;
/// any number of instances may live side by side. It is not thread-safe: one instance belongs to one context, which
/// may be an interrupt. Of the pointers that it is given it keeps that to the configuration, which must stay as it
/// is, and with it the context of a trigger of the caller's own.
///
/// Compile every file with -ffp-contract=off: only then are the estimates the same bits on every target.
///
/// Typical use:
///
///     static est_t estimator;
///     const est_config_t config = est_config_default();
///     if (!est_init(&estimator, &config)) { ... a value of config is out of range ... }
///     for (;;) {
///         const est_step_t step = est_step(&estimator, (est_sample_t){ .u = force, .y = displacement, .valid = true });
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

/// The largest orders that est_init() accepts, and the most parameters. They fix the size of est_t; override them with -D.
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

/// The samples that the longest model reaches back to.
#define EST_INPUT_PAST_MAX (EST_NB_MAX + EST_NK_MAX - 1U)

/// The change triggers.
typedef enum {
    EST_TRIGGER_NONE = 0,
    /// Alarm when |innovation| reaches the ceiling. Thesis 4.4.2.
    EST_TRIGGER_PREDICTION_ERROR = 1,
    /// Alarm when |mean innovation since the last alarm| reaches the ceiling; the mean is held at zero for hold_off_n
    /// samples after an alarm. Thesis 4.4.3.
    EST_TRIGGER_MEAN_BETWEEN_FAULTS = 2,
    /// Cumulative sum of the normalised squared innovation; ceiling = ln(ARL0), the logarithm of the wanted mean
    /// number of samples between false alarms. The default.
    EST_TRIGGER_CUSUM = 3,
    /// The caller's own: see est_trigger_config_t.
    EST_TRIGGER_CUSTOM = 4,
} est_trigger_kind_t;

/// What an alarm does to the estimate.
typedef enum {
    /// The covariance returns to its initial value, theta is kept. Thesis 4.4.3 (i).
    EST_RESET_COVARIANCE = 0,
    /// Theta returns to zero as well. Thesis 4.4.2.
    EST_RESET_ALL = 1,
} est_reset_t;

/// A trigger of the caller's own: takes in one innovation [codes] and its predicted variance [codes^2] and returns its
/// statistic, finite and not negative, which raises an alarm when it reaches the ceiling. `anew` is true for the first innovation after est_init()
/// and after an alarm. Nothing else of the estimator is its business.
typedef float (*est_trigger_fn)(void* context, float innovation, float variance, bool anew);

typedef struct {
    est_trigger_kind_t kind;
    est_reset_t        reset;
    bool               absolute;    ///< the mean between faults averages |innovation| instead of the innovation
    uint16_t           hold_off_n;  ///< innovations after an alarm in which the statistic is held at zero
    uint16_t           warm_up_n;   ///< innovations after est_init() in which the statistic is held at zero
    float              ceiling;     ///< [codes] for the first two kinds, ln(ARL0) for the cumulative sum; > 0
    est_trigger_fn     custom;      ///< used by EST_TRIGGER_CUSTOM, with the context
    void*              context;
} est_trigger_config_t;

/// Where between two sampling instants the edges of u come. The sampled u does not tell.
typedef enum {
    /// Always at the same place, as with a generator on the card's clock: the b's take it in.
    EST_EDGES_LOCKED = 0,
    /// At nearly the same place, but it may drift across a sampling instant: then the edge is recorded one sample earlier
    /// or later than before, and no alarm is raised for that alone. For a generator on a clock of its own whose period is
    /// a whole number of samples, to some 20 ppm: the forgetting must follow what the drift does to the b's. With the
    /// cumulative sum; to any other trigger such an edge is one of EST_EDGES_LOCKED.
    EST_EDGES_MAY_SLIP = 1,
    /// Anywhere, and each elsewhere: what an edge did to the plant within its interval is unknown, so that the na equations
    /// that involve it are left out. For any generator; costs some 10 % of latency.
    EST_EDGES_ANYWHERE = 2,
} est_edge_instants_t;

/// Everything that is fixed before a run. P is in units of the noise variance of y: P = 10 means a prior standard
/// deviation of sqrt(10) times that of the noise.
typedef struct {
    uint8_t na;       ///< order of A, 1 .. EST_NA_MAX
    uint8_t nb;       ///< number of b's, 1 .. EST_NB_MAX
    uint8_t nk;       ///< delay of the first b, 0 .. EST_NK_MAX; 0 is the direct term y(k) <- u(k), which a
                      ///< free-running generator needs
    uint8_t nc;       ///< estimate so many coefficients of C as well (extended least squares, thesis Equ 3.11),
                      ///< 0 .. EST_NC_MAX; na + nb + nc + offset must not exceed EST_THETA_MAX
    bool     offset;  ///< estimate the constant d as well
    bool     noise_estimated;  ///< follow the variance of the noise, beginning with noise_variance
    uint16_t refresh_n;  ///< take C from the estimate of A after so many equations and each time A has moved; 0: never
    uint8_t  stuck_n;    ///< y is stuck once it was the same for so many samples after an edge of u; 0: never
    uint16_t idle_n;     ///< excitation is lost once u had no edge for so many samples; 0: never
    est_edge_instants_t edge_instants;
    float               forgetting;  ///< lambda of thesis Equ 3.21; 0.5 .. 1, 1 forgets nothing
    float random_walk;     ///< variance by which each parameter walks per equation (thesis Equ 3.23); 0 .. 1e9
    float p0;              ///< initial variance of each a, b and c; > 0
    float p0_offset;       ///< initial variance of d; > 0 [codes^2]
    float noise_variance;  ///< of the noise e, not underestimated; > 0 [codes^2]
    float c[EST_NA_MAX];   ///< prefilter C = 1 + c[0] z^-1 + ...; all zero: none. Zeros inside the unit circle
    float edge_codes;      ///< a step of u at least this large is an edge; > 0, at most EST_CODE_LIMIT [codes]
    float code_low;        ///< u or y at or below code_low, or at or above code_high, is saturated: beyond the range of
    float code_high;       ///< the converter [codes]; at most EST_CODE_LIMIT in magnitude
    est_trigger_config_t trigger;
} est_config_t;

/// One pair of samples taken at the same instant. If valid is false u and y are ignored.
typedef struct {
    float u;
    float y;
    bool  valid;
} est_sample_t;

typedef enum {
    EST_UPDATED = 0,  ///< the sample entered the estimate
    EST_MISSING = 1,  ///< the sample was declared missing: theta and its covariance stay as they were
    EST_REFUSED = 2,  ///< u or y was not finite, saturated or stuck: counted, otherwise as a missing sample
    EST_GATHERING =
        3,  ///< the sample was taken in, but the samples that its equation reaches back to are not all known
} est_status_t;

/// A sample of larger magnitude than this is refused [codes].
#define EST_CODE_LIMIT 1.0e6F

/// The largest ceiling of a trigger [codes, or ln(ARL0)].
#define EST_CEILING_LIMIT 1.0e9F

/// The range of p0, p0_offset and noise_variance.
#define EST_VARIANCE_MIN 1.0e-9F
#define EST_VARIANCE_MAX 1.0e9F

typedef struct {
    est_status_t status;
    bool         alarm;       ///< the plant has changed: theta is being estimated afresh from the next sample on
    bool         idle;        ///< excitation is lost: the estimate can only be as good as it was
    float        innovation;  ///< e(k) = y_f(k) - phi_f(k)' theta(k-1), [codes]; 0 unless status is EST_UPDATED
    float        statistic;   ///< the trigger's statistic after this sample, before any reset by an alarm or a gap
} est_step_t;

/// Counters since est_init(). They saturate, they do not wrap.
typedef struct {
    uint32_t updated;  ///< samples taken in, those without an equation included
    uint32_t missing;
    uint16_t refused;    ///< not finite or absurd, saturated, stuck
    uint16_t saturated;  ///< of those
    uint16_t stuck;      ///< of those
    uint16_t alarms;
    uint16_t restarts;   ///< how often the equations began afresh, the first time included
    uint16_t slips;      ///< how often the edges of u began to be recorded one sample earlier or later
    uint16_t refreshes;  ///< how often C was taken from the estimate of A
} est_counters_t;

#define EST_UPPER_N ((EST_THETA_MAX * (EST_THETA_MAX - 1U)) / 2U)

/// P = U D U' / weight with U unit upper triangular. Private to est_factors.h.
typedef struct {
    float weight;  ///< forgetting to the power of the equations since the d's were last limited
    float d[EST_THETA_MAX];
    float upper[EST_UPPER_N];  ///< U by columns, without its diagonal
} est_factors_t;

/// The gains of so many equations are needed to find those of the next.
#if EST_NA_MAX > 1
#define EST_GAINS_KEPT (EST_NA_MAX - 1U)
#else
#define EST_GAINS_KEPT 1U
#endif

/// The last values of one whitened signal, newest first. Private.
typedef struct {
    float x[EST_NA_MAX];
} est_past_t;

/// Makes the noise of consecutive equations white. Private to est_whitener.h.
typedef struct {
    float      c[EST_NA_MAX];
    float      gain[EST_GAINS_KEPT][EST_NA_MAX];  ///< of the newest equation first
    float      precision[EST_NA_MAX];             ///< of the whitened equations, newest first; 0: there was none
    est_past_t past[EST_THETA_MAX + 1U];          ///< of the elements of the equation
} est_whitener_t;

/// What the edges of u since a moment of doubt would have done, had they come one sample early or late. Private.
typedef struct {
    est_past_t early;  ///< their share in the whitened equations
    est_past_t late;
    float      theta[EST_THETA_MAX];  ///< what was believed before the doubt began
} est_edges_t;

/// The readings of the recent edges besides the recorded one: one sample early, one sample late.
#define EST_OTHER_READINGS 2U

/// The state of a trigger. Private to est_trigger.h.
typedef struct {
    float    statistic;
    float    rival[EST_OTHER_READINGS];  ///< the cumulative sum as it would be under the other readings
    uint16_t quiet_n;                    ///< innovations for which the statistic is still held at zero
    uint16_t mean_n;                     ///< innovations in the mean between faults, which is rival[0]; 0: begins anew
} est_trigger_t;

/// The values of est_t.renewal. Private.
#define EST_RENEWAL_NONE 0U
#define EST_RENEWAL_COMPARE 1U    ///< nothing, but A is to be compared with C at the next one
#define EST_RENEWAL_PREFILTER 2U  ///< nothing, but C is to be taken from A
#define EST_RENEWAL_RESET 3U      ///< P := P0, after an alarm
#define EST_RENEWAL_EARLY 4U      ///< theta as before, but the edges of u come one sample earlier, and less certain
#define EST_RENEWAL_LATE 5U       ///< one sample later

/// The state of an estimator. The fields are private; read them through the functions below. The small ones come first: an
/// offset below 128 bytes is a shorter instruction.
typedef struct {
    const est_config_t* config;
    uint8_t             same_n;          ///< samples since an edge of u for which y has been the same
    uint8_t             pending_n;       ///< samples to come before the next equation is complete
    bool                adaptive;        ///< there is more to adapt than theta and C
    uint8_t             renewal;         ///< what is to be done to P before the next equation
    bool                known;           ///< the sample before this one is known; if not, samples are pending
    bool                settled;         ///< the gains of the whitener are c, and its variance is 1
    uint16_t            refresh_in;      ///< equations to come before C is considered; 0: never
    uint16_t            edge_age_n;      ///< samples since the last edge of u
    uint8_t             doubt_n;         ///< samples since the first edge in doubt, that one included; 0: no doubt
    float               noise_variance;  ///< [codes^2]
    float               y[EST_NA_MAX];   ///< y(k-1), y(k-2), ...
    float               u[EST_INPUT_PAST_MAX + 2U];  ///< u(k), u(k-1), ...
    est_trigger_t       trigger;
    est_counters_t      counters;
    float               theta[EST_THETA_MAX];
    est_factors_t       factors;
    est_whitener_t      whitener;
    est_edges_t         edges;
#if EST_NC_MAX > 0
    float residual[EST_NC_MAX];  ///< of the equations before this one, newest first
#endif
} est_t;

/// The configuration for a rig whose generator has a clock of its own: ARX(2, 3) with delay 0 and offset, C at first
/// (1 - 0.8 z^-1)^2 and then from A, forgetting 0.99, the cumulative sum with ARL0 = 1e5 after 150 samples. Constant time. Cannot fail.
est_config_t est_config_default(void);

/// True iff every value of the configuration is in the range stated at its field. Cost: constant. Cannot fail.
bool est_config_valid(const est_config_t* config);

/// Makes the estimator ready for the first sample: theta zero, P = P0, counters zero.
/// The configuration is not copied: it must stay as it is for as long as the estimator is used (it may be in flash).
/// Returns false iff the configuration is not valid; the state is then unusable. A build with -DEST_WITH_CHECKS=0 does not ask.
/// Cost: as one est_step(). May be called from an interrupt.
bool est_init(est_t* self, const est_config_t* config);

/// Enters one sample: filters, regressor, U-D update (Bierman 1977), trigger.
/// Cost: for a given order, about 3 n^2 / 2 multiplications and n divisions with n the dimension; up to 1.3 times that where
/// an edge may have slipped, 1.2 times elsewhere.
/// RAM: none beyond the state and some 300 bytes of stack. May be called from an interrupt.
/// Bad data never fails and never enters the estimate: see est_status_t.
est_step_t est_step(est_t* self, est_sample_t sample);

/// The number of parameters: na + nb + nc, and one more with the offset.
uint8_t est_theta_count(const est_t* self);

/// One element of theta; index in [0, est_theta_count()), asserted. After a slip it is what the innovations that the slip
/// explains have made of it until the next sample.
float est_theta(const est_t* self, uint8_t index);

/// One diagonal element of P [noise variances]; index in [0, est_theta_count()), asserted. Cost: O(n).
/// After an alarm it is that of before until the next sample.
float est_variance(const est_t* self, uint8_t index);

/// The variance of the noise [codes^2]: as configured, or as estimated.
float est_noise_variance(const est_t* self);

/// One coefficient of the prefilter C; index in [0, EST_NA_MAX), asserted. Zero beyond the order of A.
float est_prefilter(const est_t* self, uint8_t index);

est_counters_t est_counters(const est_t* self);

/// True iff the numbers that the estimate lives on are ones that est_init() and est_step() can produce: the configuration
/// valid, every d positive and finite, their weight in range, theta finite, statistic and noise variance in range. Counters
/// and flags are not looked at. For self-tests in the field and for fuzzing. Cost: O(n).
bool est_invariants_hold(const est_t* self);

#ifdef __cplusplus
}
#endif

#endif  // EST_H_INCLUDED
