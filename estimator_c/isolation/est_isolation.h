// SPDX-License-Identifier: MIT
/// est_isolation: after an alarm of est.h, diagnose the parameter that has changed (mass, damping or stiffness), its
/// extent and its onset. Thesis 6.2.1.2 leaves this open.
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

/// A name with the maxima of est.h: files compiled with different ones do not link.
#define est_isolation_init EST_NAME(est_isolation_init)

/// Number of stored samples: those before the alarm, which contain the onset, and those that wait for
/// est_isolation_work().
#define EST_ISOLATION_KEPT_N 40U

/// Number of onsets that are tried.
#define EST_ISOLATION_ONSETS_N 6U

/// Slices of work per sample after the alarm: one to prepare it, two for each onset, at its sample and between
/// samples. A sample before the alarm takes at most half as many.
#define EST_ISOLATION_SLICES_N (1U + (2U * EST_ISOLATION_ONSETS_N))

/// Number of effects in every equation: those of M, B, K, and of an impulse at the onset.
#define EST_ISOLATION_EFFECTS_N 4U

/// Changes that are told apart.
typedef enum {
    EST_CHANGE_UNDECIDED = 0,  ///< no alarm, or not enough evidence
    EST_CHANGE_MASS      = 1,
    EST_CHANGE_DAMPING   = 2,
    EST_CHANGE_STIFFNESS = 3,
    EST_CHANGE_SEVERAL   = 4,  ///< no single parameter explains the samples
} est_change_t;

typedef struct {
    est_change_t change;
    float        extent;        ///< new value over old value of that parameter; 1 unless a single parameter has changed
    uint16_t     samples_n;     ///< samples after the alarm on which this is based
    uint16_t     onset_n;       ///< samples from the likeliest onset to the alarm
    uint16_t     onset_low_n;   ///< from the last onset that is less likely by a factor of e^2 at most
    uint16_t     onset_high_n;  ///< from the first such onset; far from onset_low_n if the change had no effect yet
} est_diagnosis_t;

/// A stored sample. Private.
typedef struct {
    float u;
    float y;
    float innovation;
} est_kept_t;

/// Deviation of the plant from its course since one onset, by effect. Private.
typedef struct {
    float past[EST_ISOLATION_EFFECTS_N][2];  ///< last values of each effect, newest first
    /// Normal equations: lower triangle by rows, and right-hand side.
    float   matrix[EST_ISOLATION_EFFECTS_N * (EST_ISOLATION_EFFECTS_N + 1U) / 2U];
    float   vector[EST_ISOLATION_EFFECTS_N];
    uint8_t before_n;  ///< samples from this onset to the alarm
} est_onset_t;

/// Log-likelihood gain of each hypothesis [nats], for its best onset or summed over all onsets (any_). Private.
typedef struct {
    float   any_alone[3];  ///< M, B, K alone has changed
    float   any_pair[3];   ///< M and B, M and K, B and K have changed
    float   alone[3];      ///< M, B, K alone has changed
    float   beside[3];     ///< M, B, K and another parameter have changed, the other by a relevant amount
    float   change[3];     ///< estimate for M, B, K alone: 1 - old/new for M, new/old - 1 for B and K
    float   known[3];      ///< half the reciprocal variance of change
    uint8_t before_n[3];   ///< samples from the best onset to the alarm
    float   onset[EST_ISOLATION_ONSETS_N];  ///< best single parameter, for each onset
} est_fit_t;

/// The plant before the change, in units of samples. Private.
typedef struct {
    float theta[EST_THETA_MAX];
    float c[2];
    float hold;       ///< share of the final deflection reached one sample after a force step
    float lag_n;      ///< B / K
    float spring[3];  ///< effect of K y, as a force, on the equation of y: factors of y(k), y(k-1), y(k-2)
    float damper[3];  ///< the same for B y'
    float rest;       ///< y at F = 0 [codes]
    float gain;       ///< static gain: y per u
} est_plant_t;

/// State of an isolation. The fields are private; read est_isolation_diagnosis().
typedef struct {
    const est_config_t* config;
    float               force_zero;  ///< u at F = 0 [codes]
    float               nats;        ///< log-likelihood per squared code of residual
    uint8_t             newest;      ///< index in kept
    uint8_t             known_n;     ///< samples in kept without a gap
    bool                quiet;       ///< the plant before a change is known, from the last sample with statistic zero
    uint8_t             since_n;     ///< samples since the alarm
    uint8_t             waiting_n;   ///< samples waiting for work
    uint8_t             turn;        ///< next slice of the present sample
    uint8_t             slices_n;    ///< number of slices of the present sample
    uint16_t            worked_n;    ///< samples from the first onset to the present one
    bool                active;      ///< an alarm is being diagnosed
    est_plant_t         plant;
    float               driving[3];   ///< input of the effects of M, B, K, if the onset was at an earlier sample
    float               residual[2];  ///< whitened y less the response of the plant before the change, newest first
    est_fit_t           fit;
    est_diagnosis_t     diagnosis;
    est_onset_t         onsets[EST_ISOLATION_ONSETS_N];  ///< earliest onset first
    est_kept_t          kept[EST_ISOLATION_KEPT_N];
} est_isolation_t;

/// Prepare for the first sample of an estimator with this configuration. The configuration is not copied; it must
/// stay unchanged. `force_zero` is u at F = 0 [codes], from which the force of the spring is counted. Returns false
/// iff na is not 2, nb + nk exceeds 3, the trigger is not the cumulative sum, or edges may come anywhere. The method
/// then does not apply and the state is unusable. Cost: constant. RAM: 1.3 kB. May be called from an interrupt.
EST_RESULT_USED bool est_isolation_init(est_isolation_t* self, const est_config_t* config, float force_zero);

/// Enter the input and result of an est_step(); to be called after every step. A gap before the diagnosis leaves it
/// undecided. Cost: some 150 instructions on a Cortex-M4F, at an alarm 2,400 (make cost). May be called from an
/// interrupt.
void est_isolation_enter(est_isolation_t* self, const est_t* estimator, est_sample_t sample, est_step_t step);

/// Do one slice of the work after an alarm: one sample with one onset. Return true iff more work is waiting. A sample
/// needs up to EST_ISOLATION_SLICES_N calls. If more than EST_ISOLATION_KEPT_N - 4 samples wait, the diagnosis
/// remains undecided. Cost: some 680 instructions on a Cortex-M4F, at most 830; none before an alarm. May be called
/// from an interrupt.
bool est_isolation_work(est_isolation_t* self);

/// Diagnosis of the last alarm. The change is stated once it is 95 % certain, and is then final. The extent is refined
/// until 100 samples after the alarm. Cost: constant. May be called from an interrupt.
est_diagnosis_t est_isolation_diagnosis(const est_isolation_t* self);

#ifdef __cplusplus
}
#endif

#endif  // EST_ISOLATION_H_INCLUDED
