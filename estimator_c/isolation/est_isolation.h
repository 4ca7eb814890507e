/// est_isolation: after an alarm of est.h, which of mass, damping and stiffness has changed, by how much, and since when
/// (thesis 6.2.1.2, left open there).
///
/// The plant is M x'' + B x' + K x = F. It serves any estimator with na = 2 and nb + nk <= 3, with or
/// without offset: neither T nor M, B, K need be known. estimator_c/README.md derives it.
///
/// Optional: est.c does not know of it, and what is not called is not linked. The caller owns the state. Two contexts of
/// different priority must not be in it at the same time.
///
///     const est_step_t step = est_step(&estimator, sample);
///     est_isolation_enter(&isolation, &estimator, sample, step);           // right after every est_step()
///     while (est_isolation_work(&isolation)) { }                           // now, or later and a few calls at a time
///     const est_diagnosis_t diagnosis = est_isolation_diagnosis(&isolation);
///     if (diagnosis.change != EST_CHANGE_UNDECIDED) { ... }
///
/// Distributed under the terms of the MIT License.

#ifndef EST_ISOLATION_H_INCLUDED
#define EST_ISOLATION_H_INCLUDED

#include "est.h"

#ifdef __cplusplus
extern "C" {
#endif

/// Samples kept: those before the alarm, among which is the onset, and those that wait for est_isolation_work().
#define EST_ISOLATION_KEPT_N 40U

/// Onsets that are tried.
#define EST_ISOLATION_ONSETS_N 6U

/// Slices of work that a sample takes after the alarm: it is prepared; then each onset, at its sample, and between it and
/// another. One before it takes at most half as many.
#define EST_ISOLATION_SLICES_N (1U + (2U * EST_ISOLATION_ONSETS_N))

/// What is looked at, one by one, in every equation: the effects of M, B, K, and of a push at the onset.
#define EST_ISOLATION_EFFECTS_N 4U

typedef enum {
    EST_CHANGE_UNDECIDED = 0,  ///< no alarm, or not sure
    EST_CHANGE_MASS      = 1,
    EST_CHANGE_DAMPING   = 2,
    EST_CHANGE_STIFFNESS = 3,
    EST_CHANGE_SEVERAL   = 4,  ///< none of them alone explains the samples
} est_change_t;

typedef struct {
    est_change_t change;
    float        extent;     ///< of that parameter, new over old; 1 unless it is one parameter that has changed
    uint16_t     samples_n;  ///< samples after the alarm that this rests on
    uint16_t     onset_n;    ///< from the likeliest of the onsets that were tried to the alarm [samples]
    uint16_t onset_low_n;    ///< and from the last and the first of those that do as well but for a factor of e^2. They
    uint16_t onset_high_n;   ///< are far apart where the changed parameter had no effect yet
} est_diagnosis_t;

/// A sample. Private.
typedef struct {
    float u;
    float y;
    float innovation;
} est_kept_t;

/// How the plant would have left its course since one onset. Private.
typedef struct {
    float   past[EST_ISOLATION_EFFECTS_N][2];  ///< each effect, newest first
    float   matrix[EST_ISOLATION_EFFECTS_N * (EST_ISOLATION_EFFECTS_N + 1U) /
                 2U];                       ///< normal equations: lower triangle by rows
    float   vector[EST_ISOLATION_EFFECTS_N];  ///< and right-hand side
    uint8_t before_n;                         ///< from this onset to the alarm
} est_onset_t;

/// What changes explain, in nats: the best of all onsets, or all of them together (any_). Private.
typedef struct {
    float   any_alone[3];  ///< M, B, K alone has changed
    float   any_pair[3];   ///< M and B, M and K, B and K have changed
    float   alone[3];
    float   beside[3];    ///< M, B, K has changed, and another by as much as is worth telling
    float   change[3];    ///< of M, B, K alone, by how much: 1 - old/new for M, new/old - 1 for B and K
    float   known[3];     ///< half its reciprocal variance
    uint8_t before_n[3];  ///< and when
    float   onset[EST_ISOLATION_ONSETS_N];  ///< most by one parameter alone
} est_fit_t;

/// The plant as it was, in samples. Private.
typedef struct {
    float theta[EST_THETA_MAX];
    float c[2];
    float hold;       ///< share of its deflection after the first sample of a constant force
    float lag_n;      ///< B / K
    float spring[3];  ///< K y and B y' for F: what they add to the equation of y from y(k), y(k-1), y(k-2)
    float damper[3];
    float rest;  ///< y where F = 0 [codes]
    float gain;  ///< y per u at rest
} est_believed_t;

/// The fields are private; read est_isolation_diagnosis().
typedef struct {
    const est_config_t* config;
    float               force_zero;  ///< u where F = 0 [codes]
    float               nats;        ///< per squared code of residual
    uint8_t             newest;      ///< in kept
    uint8_t             known_n;     ///< in kept, without a gap
    bool                quiet;    ///< the statistic has been zero: theta of the last such sample is the plant as it was
    uint8_t             since_n;  ///< samples since the alarm
    uint8_t             waiting_n;  ///< samples still to be worked on
    uint8_t             turn;       ///< the slice of the sample to work on
    uint8_t             slices_n;   ///< that this sample takes
    uint16_t            worked_n;   ///< samples from the first onset to the one worked on
    bool                active;     ///< after an alarm
    est_believed_t      believed;
    float               driving[3];   ///< what drives the effects of M, B, K since an earlier sample
    float               residual[2];  ///< y less what the plant as it was would have done, newest first
    est_fit_t           fit;
    est_diagnosis_t     diagnosis;
    est_onset_t         onsets[EST_ISOLATION_ONSETS_N];  ///< the first onset first
    est_kept_t          kept[EST_ISOLATION_KEPT_N];
} est_isolation_t;

/// Ready for the first sample of an estimator with this configuration, which is kept as est_init() keeps it. `force_zero` is
/// u where F = 0 [codes]: what the spring carries is counted from there.
/// False iff na is not 2, nb + nk is beyond 3, the trigger is not the cumulative sum, or edges of u may come anywhere: the plant
/// is then not one of mass, damper and spring, or nothing tells when it was last well, or what forced it since. The state is then
/// unusable. Cost: constant. May be called from an interrupt.
bool est_isolation_init(est_isolation_t* self, const est_config_t* config, float force_zero);

/// To be called after every est_step(), with what went in and came out. Cost: some 150 instructions on a Cortex-M4F, at the
/// alarm 2,400 (make cost). May be called from an interrupt. A gap before the diagnosis leaves it undecided.
void est_isolation_enter(est_isolation_t* self, const est_t* estimator, est_sample_t sample, est_step_t step);

/// One slice of what is to be done after an alarm: one sample with one onset. True iff more is waiting. A sample waits for
/// up to EST_ISOLATION_SLICES_N calls; if more than EST_ISOLATION_KEPT_N - 4 samples wait, the diagnosis remains undecided.
/// Cost: some 680 instructions on a Cortex-M4F, at most 830; nothing before an alarm.
bool est_isolation_work(est_isolation_t* self);

/// The diagnosis of the last alarm: the change is stated once it is 95 % sure and then stays; the extent is refined until
/// 100 samples after the alarm. Cost: constant.
est_diagnosis_t est_isolation_diagnosis(const est_isolation_t* self);

#ifdef __cplusplus
}
#endif

#endif  // EST_ISOLATION_H_INCLUDED
