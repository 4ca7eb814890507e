/// est: recursive least-squares estimation of an ARX model with a change trigger, for small embedded targets.
///
/// The model, in sampled codes y (output) and u (input):
///
///     y(k) = -a1 y(k-1) - ... - a_na y(k-na) + b_0 u(k-nk) + ... + b_(nb-1) u(k-nk-nb+1) + C(1) d + C(z) e(k)
///
/// theta = (a1 .. a_na, b_0 .. b_(nb-1) [, d]) is estimated by Bierman's U-D factorised least squares on the signals
/// filtered by 1/C; a trigger watches the innovation and tells when theta has jumped. Missing samples are survived.
/// estimator_c/README.md derives it; this header says how to use it.
///
/// The library is freestanding C99 in float32: no heap, no libm, no globals, no recursion. The caller owns the state;
/// any number of instances may live side by side. It is not thread-safe: one instance belongs to one context, which
/// may be an interrupt. Nothing here reads beyond, or keeps, a pointer that it is given.
///
/// Compile every file with -ffp-contract=off: only then are the estimates the same bits on every target.
///
/// Typical use:
///
///     est_config_t config = est_config_default();
///     est_t estimator;
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

#define EST_VERSION_MAJOR 0
#define EST_VERSION_MINOR 1

/// The largest orders that est_init() accepts. They fix the size of est_t; override them with -D to save RAM.
#ifndef EST_NA_MAX
#define EST_NA_MAX 2U
#endif
#ifndef EST_NB_MAX
#define EST_NB_MAX 3U
#endif
#ifndef EST_NK_MAX
#define EST_NK_MAX 1U
#endif
#if (EST_NA_MAX < 1) || (EST_NA_MAX > 8) || (EST_NB_MAX < 1) || (EST_NB_MAX > 8) || (EST_NK_MAX > 8)
#error "EST_NA_MAX and EST_NB_MAX must be in the range [1, 8], EST_NK_MAX in [0, 8]"
#endif

/// The samples before a (re)start that the model reaches back to, at most; each is one unknown initial condition.
#define EST_INPUT_PAST_MAX (EST_NB_MAX + EST_NK_MAX - 1U)
#define EST_PAST_MAX ((EST_NA_MAX > EST_INPUT_PAST_MAX) ? EST_NA_MAX : EST_INPUT_PAST_MAX)

/// The most parameters theta can have: a's, b's and the offset.
#define EST_THETA_MAX (EST_NA_MAX + EST_NB_MAX + 1U)

/// The dimension of the least-squares problem: the initial conditions first, then theta.
#define EST_DIM_MAX (EST_PAST_MAX + EST_THETA_MAX)

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
} est_trigger_kind_t;

/// What an alarm does to the estimate.
typedef enum {
    /// The covariance returns to its initial value, theta is kept. Thesis 4.4.3 (i).
    EST_RESET_COVARIANCE = 0,
    /// Theta returns to zero as well. Thesis 4.4.2.
    EST_RESET_ALL = 1,
} est_reset_t;

typedef struct {
    est_trigger_kind_t kind;
    float              ceiling;     ///< [codes] for the first two kinds, ln(ARL0) for the cumulative sum; > 0
    uint16_t           hold_off_n;  ///< valid samples after an alarm in which the statistic is held at zero
    uint16_t           warm_up_n;   ///< valid samples after est_init() in which the statistic is held at zero
    bool               absolute;    ///< the mean between faults averages |innovation| instead of the innovation
    est_reset_t        reset;
} est_trigger_config_t;

/// Where between two sampling instants the edges of u come. The sampled u does not tell.
typedef enum {
    /// Always at the same place, as with a generator on the card's clock: the b's take it in.
    EST_EDGES_LOCKED = 0,
    /// At nearly the same place, but it may drift across a sampling instant: then the edge is recorded one sample earlier
    /// or later than before, and no alarm is raised for that alone. For a generator on a clock of its own whose period is
    /// a whole number of samples, to some 20 ppm: the forgetting must follow what the drift does to the b's.
    EST_EDGES_MAY_SLIP = 1,
    /// Anywhere, and each elsewhere: what an edge did to the plant within its interval is unknown, so that each begins the
    /// past anew. For any generator; costs some 10 % of latency.
    EST_EDGES_ANYWHERE = 2,
} est_edge_instants_t;

/// Everything that is fixed before a run. P is in units of the noise variance of y: P = 10 means a prior standard
/// deviation of sqrt(10) times that of the noise.
typedef struct {
    uint8_t na;      ///< order of A, 1 .. EST_NA_MAX
    uint8_t nb;      ///< number of b's, 1 .. EST_NB_MAX
    uint8_t nk;      ///< delay of the first b; 0 is the direct term y(k) <- u(k), which a free-running generator needs
    bool    offset;  ///< estimate the constant d as well
    float   forgetting;      ///< lambda of thesis Equ 3.21; 0.5 .. 1, 1 forgets nothing
    float   p0;              ///< initial variance of each a and b; > 0
    float   p0_offset;       ///< initial variance of d; > 0 [codes^2]
    float   noise_variance;  ///< of the noise e, not underestimated; > 0 [codes^2]
    float   c[EST_NA_MAX];   ///< prefilter C = 1 + c[0] z^-1 + ...; all zero: no prefilter. |c| <= 70
    float   edge_codes;      ///< a step of u at least this large is an edge; > 0, at most EST_CODE_LIMIT [codes]
    est_edge_instants_t  edge_instants;
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
    EST_REFUSED = 2,  ///< u or y was not finite, or beyond EST_CODE_LIMIT, or C is unstable and what it makes of them
                      ///< has grown beyond all use: counted, otherwise as a missing sample
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
    float        innovation;  ///< e(k) = y_f(k) - phi_f(k)' theta(k-1), [codes]; 0 unless status is EST_UPDATED
    float        statistic;   ///< the trigger's statistic after this sample, before any reset by the alarm
} est_step_t;

/// Counters since est_init(). They saturate, they do not wrap.
typedef struct {
    uint32_t updated;
    uint32_t missing;
    uint32_t refused;
    uint32_t alarms;
    uint32_t restarts;  ///< how often the prefilters began afresh, the first time included
    uint32_t slips;     ///< how often the edges of u began to be recorded one sample earlier or later
} est_counters_t;

/// What the edges of u since a moment of doubt would have done, had they come one sample early or late. Private.
typedef struct {
    float    u_previous;
    bool     u_known;
    uint16_t age_n;                     ///< samples since the first of these edges, that one included; 0: no doubt
    float    train[EST_PAST_MAX + 2U];  ///< their heights as impulses, filtered by 1/C, newest first
    float    theta[EST_DIM_MAX];        ///< what was believed before the doubt began
} est_edges_t;

/// The readings of the recent edges: as recorded, one sample early, one sample late.
#define EST_READINGS 3U

/// The state of a trigger. Private to the trigger.
typedef struct {
    float    statistic;
    float    rival[EST_READINGS - 1U];  ///< the cumulative sum as it would be under the other readings
    float    mean;                      ///< of the innovations since the last alarm, signed
    uint32_t mean_n;                    ///< how many they are
    uint32_t quiet_n;                   ///< samples for which the statistic is still held at zero
} est_trigger_t;

/// The state of an estimator. The fields are private; read them through the functions below.
typedef struct {
    est_config_t   config;
    uint8_t        past;           ///< number of initial conditions of this model
    uint8_t        dim;            ///< past + number of parameters
    uint8_t        first;          ///< the first active row: 0 while the initial conditions matter, past afterwards
    bool           running;        ///< false before the first sample and inside a gap
    float          y[EST_NA_MAX];  ///< filtered outputs y_f(k-1), y_f(k-2), ...
    float          u[EST_PAST_MAX + 1U];   ///< filtered inputs u_f(k), u_f(k-1), ...
    float          impulse[EST_PAST_MAX];  ///< impulse response of 1/C at m, m-1, ...: the regressors of the past
    float          theta[EST_DIM_MAX];
    float          d[EST_DIM_MAX];                                  ///< P = U D U', U unit upper triangular
    float          upper[(EST_DIM_MAX * (EST_DIM_MAX - 1U)) / 2U];  ///< U by columns, without its diagonal
    est_edges_t    edges;
    est_trigger_t  trigger;
    est_counters_t counters;
} est_t;

/// The configuration for a rig whose generator has a clock of its own: ARX(2, 3) with delay 0 and offset, C fixed at
/// (1 - 0.8 z^-1)^2, forgetting 0.9925, the cumulative sum with ARL0 = 1e5. Constant time. Cannot fail.
est_config_t est_config_default(void);

/// Makes the estimator ready for the first sample: theta zero, P = P0, counters zero.
/// Returns false iff a value of the configuration is out of the range stated at its field; the state is then unusable.
/// Cost: as one est_step(). May be called from an interrupt.
bool est_init(est_t* self, const est_config_t* config);

/// Enters one sample: filters, regressor, U-D update (Bierman 1977), trigger.
/// Cost: constant for a given order, about 3 n^2 / 2 multiplications and n divisions with n the dimension.
/// RAM: none beyond the state and some 300 bytes of stack. May be called from an interrupt.
/// Bad data never fails and never enters the estimate: see est_status_t.
est_step_t est_step(est_t* self, est_sample_t sample);

/// The number of parameters: na + nb, and one more with the offset.
uint8_t est_theta_count(const est_t* self);

/// One element of theta; index in [0, est_theta_count()), asserted.
float est_theta(const est_t* self, uint8_t index);

/// One diagonal element of P [noise variances]; index in [0, est_theta_count()), asserted. Cost: O(n).
float est_variance(const est_t* self, uint8_t index);

est_counters_t est_counters(const est_t* self);

/// True iff the state is one that est_init() and est_step() can produce: every d positive and finite, theta finite,
/// indices in range. For self-tests in the field and for fuzzing. Cost: O(n).
bool est_invariants_hold(const est_t* self);

#ifdef __cplusplus
}
#endif

#endif  // EST_H_INCLUDED
