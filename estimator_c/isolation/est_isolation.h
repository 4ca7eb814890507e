// SPDX-License-Identifier: MIT
/// est_isolation: after an alarm of est.h, diagnose the parameter that has changed (mass, damping or stiffness), its
/// extent and its onset, or the fault of a channel. Thesis 6.2.1.2 leaves this open.
///
/// The plant is M x'' + B x' + K x = F. Any estimator with na = 2 and nb + nk <= 3 will do, with or without offset;
/// T, M, B and K need not be known. harness/docs/background/estimator.md derives the algorithm.
///
/// The module is optional: est.c does not depend on it. No heap, no libm, no globals. The caller owns the state, which
/// belongs to one context: an interrupt must not enter a sample while another context works on it.
///
///     const est_step_t step = est_step(&estimator, sample);
///     est_isolation_enter(&isolation, &estimator, sample, step);           // right after every est_step()
///     while (est_isolation_work(&isolation)) { }                           // now, or later and a few calls at a time
///     const est_diagnosis_t diagnosis = est_isolation_diagnosis(&isolation);
///     if (diagnosis.change != EST_CHANGE_UNDECIDED) { ... }

#ifndef EST_ISOLATION_H_INCLUDED
#define EST_ISOLATION_H_INCLUDED

#include "est.h"

#ifdef __cplusplus
extern "C" {
#endif

/// A name with the layout of est.h: files compiled with different ones do not link.
#define est_isolation_init EST_NAME(est_isolation_init)

/// Number of stored samples: those before the alarm, which contain the onset, and those that wait for
/// est_isolation_work().
#define EST_ISOLATION_KEPT_N 40U

/// Number of onsets that are tried.
#define EST_ISOLATION_ONSETS_N 8U

/// Slices of work on a sample that is weighed: one to prepare it, one for every two onsets to enter it, two for each
/// onset to weigh it, for the plant and for the channels, and one to decide. Another one takes at most the first five.
#define EST_ISOLATION_SLICES_N (2U + (EST_ISOLATION_ONSETS_N / 2U) + (2U * EST_ISOLATION_ONSETS_N))

/// Number of samples in an equation.
#define EST_ISOLATION_LAGS_N 3U

/// Number of impulses at the onset. They stand for the deviation of the filter's two states if the onset was earlier.
#define EST_ISOLATION_IMPULSES_N 2U

/// Number of effects that are weighed together: those of M, B, K, and of the impulses.
#define EST_ISOLATION_JOINT_N (3U + EST_ISOLATION_IMPULSES_N)

/// Number of channels, the force and the displacement.
#define EST_ISOLATION_CHANNELS_N 2U

/// Number of effects of faults: an offset, a gain and a delay of each channel.
#define EST_ISOLATION_FAULTS_N (3U * EST_ISOLATION_CHANNELS_N)

/// Number of effects in every equation.
#define EST_ISOLATION_EFFECTS_N (EST_ISOLATION_JOINT_N + EST_ISOLATION_FAULTS_N)

/// Number of single changes: M, B, K, and five faults of each channel.
#define EST_ISOLATION_SINGLES_N (3U + (5U * EST_ISOLATION_CHANNELS_N))

/// Changes that are told apart.
typedef enum {
    EST_CHANGE_UNDECIDED = 0,  ///< no alarm, or not enough evidence
    EST_CHANGE_MASS      = 1,
    EST_CHANGE_DAMPING   = 2,
    EST_CHANGE_STIFFNESS = 3,
    EST_CHANGE_SEVERAL   = 4,  ///< no single parameter and no fault of a channel explains the samples
    // faults of a channel; the plant has not changed
    EST_CHANGE_FORCE_OFFSET        = 5,
    EST_CHANGE_FORCE_GAIN          = 6,
    EST_CHANGE_FORCE_DELAY         = 7,  ///< codes come one sample late
    EST_CHANGE_FORCE_STUCK         = 8,
    EST_CHANGE_FORCE_NOISE         = 9,
    EST_CHANGE_DISPLACEMENT_OFFSET = 10,
    EST_CHANGE_DISPLACEMENT_GAIN   = 11,  ///< about the displacement at F = 0
    EST_CHANGE_DISPLACEMENT_DELAY  = 12,  ///< codes come one sample late
    EST_CHANGE_DISPLACEMENT_STUCK  = 13,
    EST_CHANGE_DISPLACEMENT_NOISE  = 14,
} est_change_t;

typedef struct {
    est_change_t change;
    float        extent;        ///< new value over old value of that parameter or gain; 1 for every other change
    uint16_t     samples_n;     ///< samples after the first alarm on which this is based
    uint16_t     onset_n;       ///< samples from the likeliest onset to the last alarm
    uint16_t     onset_low_n;   ///< from the last onset that is less likely by a factor of e^2 at most
    uint16_t     onset_high_n;  ///< from the first such onset; far from onset_low_n if the change had no effect yet
} est_diagnosis_t;

/// Units of the codes, from which parameters are computed.
typedef struct {
    float period;        ///< time between two samples [s]
    float force;         ///< force per code of u [N]
    float displacement;  ///< displacement per code of y [m]
} est_units_t;

/// Parameters of the plant M x'' + B x' + K x = F.
typedef struct {
    float mass;       ///< M [kg]
    float damping;    ///< B [N s/m]
    float stiffness;  ///< K [N/m]
} est_parameters_t;

/// A stored sample. Private.
typedef struct {
    float u;
    float y;
    float innovation;
} est_kept_t;

/// Deviation of the plant from its course since one onset, by effect. Private.
typedef struct {
    float past[EST_ISOLATION_EFFECTS_N][2];  ///< last values of each effect, newest first
    /// Normal equations of the joint effects: lower triangle by rows. Right-hand side of all effects.
    float   matrix[EST_ISOLATION_JOINT_N * (EST_ISOLATION_JOINT_N + 1U) / 2U];
    float   vector[EST_ISOLATION_EFFECTS_N];
    float   known[EST_ISOLATION_FAULTS_N];                             ///< normal equations of each fault
    float   shared[EST_ISOLATION_FAULTS_N][EST_ISOLATION_IMPULSES_N];  ///< their elements with the impulses
    float   energy;    ///< log-likelihood of the residual since the onset, negated [nats]
    float   unrest;    ///< log-likelihood ratio of a noisy force since the onset [nats]
    uint8_t before_n;  ///< samples from this onset to the alarm
} est_onset_t;

/// Evidence for a single change. Private.
typedef struct {
    float   any;       ///< log-likelihood gain, summed over all onsets [nats]
    float   best;      ///< the same for its best onset
    float   change;    ///< estimate there: 1 - old/new for M and gains, new/old - 1 for B and K
    float   known;     ///< half the reciprocal variance of change; 0 if the size is given
    uint8_t before_n;  ///< samples from the best onset to the alarm
} est_single_t;

/// Evidence for all hypotheses. Private.
typedef struct {
    est_single_t single[EST_ISOLATION_SINGLES_N];
    float        any_pair[3];  ///< log-likelihood gain if M and B, M and K, B and K have changed, over all onsets
    float        beside[3];    ///< the same if M, B, K and another parameter have, by a relevant amount
    float        onset[EST_ISOLATION_ONSETS_N];  ///< the same of the best single change, for each onset
} est_fit_t;

/// Habits of the channels while the plant is unchanged. Private.
typedef struct {
    float   same[EST_ISOLATION_CHANNELS_N];  ///< share of codes that equal the last one
    float   unrest;                          ///< mean square of the steps of u that are not edges [codes^2]
    uint8_t known_n;                         ///< samples on which this is based, as far as they count
} est_habits_t;

/// The plant before the change, in units of samples. Private.
typedef struct {
    float theta[EST_THETA_MAX];
    float c[2];
    float a[EST_ISOLATION_LAGS_N];       ///< factors of y(k), y(k-1), y(k-2)
    float b[EST_ISOLATION_LAGS_N];       ///< factors of u(k), u(k-1), u(k-2)
    float direct;                        ///< share of b[0] that an edge within the interval may have
    float hold;                          ///< share of the final deflection reached one sample after a force step
    float lag_n;                         ///< B / K
    float spring[EST_ISOLATION_LAGS_N];  ///< effect of K y, as a force, on the equation of y: factors as those of a
    float damper[EST_ISOLATION_LAGS_N];  ///< the same for B y'
    float rest;                          ///< y at F = 0 [codes]
    float gain;                          ///< static gain: y per u
} est_plant_t;

/// State of an isolation. The fields are private; read est_isolation_diagnosis().
typedef struct {
    const est_config_t* config;
    float               force_zero;  ///< u at F = 0 [codes]
    float               nats;        ///< log-likelihood per squared code of residual
    uint8_t             newest;      ///< index in kept
    uint8_t             known_n;     ///< samples in kept without a gap
    bool                quiet;       ///< the plant before a change is known, from the last sample with statistic zero
    uint8_t             since_n;     ///< samples since the last alarm, or since whitening began anew
    uint8_t             repeated_n;  ///< samples from the alarm that is being diagnosed to the last alarm
    uint8_t             waiting_n;   ///< samples waiting for work
    uint8_t             slot;        ///< next slice of the present sample
    uint8_t             slices_n;    ///< number of slices of the present sample
    uint8_t             begun_n;     ///< onsets before the present sample
    uint16_t            worked_n;    ///< samples from the first onset to the present one
    bool                active;      ///< an alarm is being diagnosed
    est_plant_t         plant;
    est_habits_t        habits;
    uint8_t             same_n[EST_ISOLATION_CHANNELS_N];    ///< codes that equal the last one, up to this sample
    float               surprise[EST_ISOLATION_CHANNELS_N];  ///< of each of them, unless the channel is stuck [nats]
    float               force[EST_ISOLATION_LAGS_N + 1U];    ///< u less its zero, up to the present sample
    float               displacement[EST_ISOLATION_LAGS_N + 1U];  ///< y less its rest, likewise
    float               unrest;                                   ///< of this sample, as in est_onset_t
    float               driving[EST_ISOLATION_EFFECTS_N];         ///< input of the effects, if the onset was long ago
    float               residual[2];  ///< whitened y less the response of the plant before the change, newest first
    est_fit_t           fit;
    est_diagnosis_t     diagnosis;
    est_onset_t         onsets[EST_ISOLATION_ONSETS_N];  ///< earliest onset first
    est_kept_t          kept[EST_ISOLATION_KEPT_N];
} est_isolation_t;

/// Prepare for the first sample of an estimator with this configuration. The configuration is not copied; it must
/// stay unchanged. `force_zero` is u at F = 0 [codes], from which the force of the spring is counted. Returns false
/// iff na is not 2, nb + nk exceeds 3, the trigger is not the cumulative sum, or edges may come anywhere. The method
/// then does not apply and the state is unusable. Cost: constant. RAM: 3.3 kB. May be called from an interrupt.
EST_RESULT_USED bool est_isolation_init(est_isolation_t* self, const est_config_t* config, float force_zero);

/// Enter the input and result of an est_step(); to be called after every step. A gap before the diagnosis leaves it
/// undecided. An alarm before the diagnosis does not interrupt it. Cost: 60 to 340 instructions on a Cortex-M4F, at an
/// alarm 944 (make cost). May be called from an interrupt.
void est_isolation_enter(est_isolation_t* self, const est_t* estimator, est_sample_t sample, est_step_t step);

/// Do one slice of the work after an alarm. Return true iff more work is waiting. A sample needs five calls, and
/// EST_ISOLATION_SLICES_N if none comes after it: the more slices per sample, the more samples are weighed. If more
/// than EST_ISOLATION_KEPT_N - 4 samples wait, the diagnosis remains undecided. Cost: some 710 instructions on a
/// Cortex-M4F, at most 1,720; none before an alarm. May be called from an interrupt.
bool est_isolation_work(est_isolation_t* self);

/// Diagnosis of the last alarm. The change is stated once it is 95 % certain, and is then final. The extent is refined
/// until 100 samples after the alarm. Faults that cannot be told apart remain undecided. Cost: constant. May be called
/// from an interrupt.
est_diagnosis_t est_isolation_diagnosis(const est_isolation_t* self);

/// Compute M, B and K from the present theta: the inverse of the zero-order hold that leads from thesis Equ 4.2 to 4.3.
/// With p = B T / M and q = K T^2 / M, a2 = exp(-p), -a1 = 2 exp(-p/2) cosh(w), w^2 = p^2/4 - q, and 1/K = sum of the
/// b's / (1 + a1 + a2), in codes. Needs no state of isolation. Other quantities serve as well: for an RLC circuit, L, R
/// and 1/C with u in volts and y in coulombs.
/// Returns false iff na is not 2 or theta describes no such plant, as before the first edge; *out is then unchanged.
/// Cost: at most 230 divisions. May be called from an interrupt.
EST_RESULT_USED bool est_isolation_parameters(const est_t* estimator, est_units_t units, est_parameters_t* out);

#ifdef __cplusplus
}
#endif

#endif  // EST_ISOLATION_H_INCLUDED
