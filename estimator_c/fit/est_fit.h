// SPDX-License-Identifier: MIT
/// est_fit: watch whether the model of est.h still fits, and name the cause if it does not.
///
/// The model promises innovations that are white, have the declared variance, and depend on nothing that came before.
/// The module tests this over blocks of EST_FIT_BLOCK_N samples. A kind of misfit is stated once two blocks in
/// succession agree on it. Exactly one kind is stated, the likeliest cause. harness/docs/background/estimator.md gives
/// the statistics and their limits.
///
/// The module is optional: est.c does not depend on it. No heap, no libm, no globals. The caller owns the state, which
/// belongs to one context.
///
///     const est_step_t step = est_step(&estimator, sample);
///     est_fit_enter(&fit, &estimator, sample, step);                       // right after every est_step()
///     const est_misfit_t misfit = est_fit_misfit(&fit);
///     if (misfit.kind != EST_MISFIT_NONE) { ... alarms may be false, and changes may be missed ... }

#ifndef EST_FIT_H_INCLUDED
#define EST_FIT_H_INCLUDED

#include "est.h"

#ifdef __cplusplus
extern "C" {
#endif

/// A name with the maxima of est.h: files compiled with different ones do not link.
#define est_fit_init EST_NAME(est_fit_init)

/// Number of samples whose sum is one sample of the spectrum. Lines up to 1 / (2 * EST_FIT_SUM_N) cycles per sample
/// are found: 625 Hz at 20 kHz.
#define EST_FIT_SUM_N 16U

/// Number of lines in the spectrum; the first is the mean.
#define EST_FIT_LINES_N 24U

/// Number of samples in a block. EST_FIT_SUM_N more are needed to evaluate it.
#define EST_FIT_BLOCK_N (2U * EST_FIT_LINES_N * EST_FIT_SUM_N)

/// Number of equations before the first block, in which the estimate settles.
#define EST_FIT_SETTLING_N 320U

/// Regions of the state of the plant: four levels of y, each falling, resting or rising.
#define EST_FIT_REGIONS_N 12U

/// Causes of a poor fit, in the order in which they are tested, except EST_MISFIT_SLOW_PLANT: it replaces a cause
/// behind EST_MISFIT_HUM if the poles are too close to 1 for the resolution of the codes.
typedef enum {
    EST_MISFIT_NONE       = 0,
    EST_MISFIT_DRIFT      = 1,  ///< y drifts: the innovations have a mean
    EST_MISFIT_HUM        = 2,  ///< a periodic disturbance of y
    EST_MISFIT_EDGES      = 3,  ///< the position of the edges of u between two samples varies
    EST_MISFIT_NONLINEAR  = 4,  ///< the response depends on the level of y, or the order of the model is too low
    EST_MISFIT_NOISE      = 5,  ///< the variance of the noise is larger than declared, or the noise is correlated
    EST_MISFIT_SLOW_PLANT = 6,  ///< the plant hardly moves between two samples
    EST_MISFIT_EXCITATION = 7,  ///< u is too small for a change of the mass to be seen
} est_misfit_kind_t;

typedef struct {
    est_misfit_kind_t kind;
    float             strength;   ///< statistic over its limit, at least 1; 0 without a misfit
    float             frequency;  ///< of the line [cycles per sample]; 0 unless the kind is EST_MISFIT_HUM
} est_misfit_t;

/// Sums over a block. Private.
typedef struct {
    uint16_t innovations_n;
    uint16_t alarms_n;
    uint16_t edges_n;    ///< innovations in `edges`
    float    sum;        ///< of the innovations
    float    squares;    ///< of their squares
    float    lagged;     ///< of every second one's product with the sum of the four before
    float    edges;      ///< of the squares of those that an edge of u affects directly
    float    product;    ///< of the innovations with the whitened steps of u, up to the last edge
    float    steps;      ///< of the squares of these steps, up to the last edge
    float    shifts;     ///< energy of the innovations explained by a shift of each edge
    float    explained;  ///< energy of every second innovation explained by the regions
} est_fit_sums_t;

/// State of the watch. The fields are private; read est_fit_misfit().
typedef struct {
    const est_config_t* config;
    uint16_t            settling_n;  ///< equations until the first block
    uint16_t            position_n;  ///< samples of the block so far
    uint16_t            since_n;     ///< equations since the last alarm
    uint16_t            learnt_n;    ///< samples in level and spread, limited
    uint8_t             excluded_n;  ///< equations after an alarm that are still excluded
    uint8_t             edge_age_n;  ///< samples since the last edge of u, limited
    uint8_t             peak;        ///< line with the largest power
    float               deviation;   ///< mean magnitude of the innovations [codes]
    float               level;       ///< mean of y [codes]
    float               spread;      ///< mean distance of y from its level [codes]
    float               y[3];        ///< newest first
    float               u;
    float               c[2];                          ///< prefilter
    float               step[2];                       ///< whitened steps of u, newest first
    float               past[4];                       ///< innovations, newest first; 0 where there is none
    float               shift[2];                      ///< sums.product and sums.steps since the last edge
    float               pending;                       ///< incomplete sum of the innovations for the spectrum
    float               entered;                       ///< sum of the innovations that the resonators take
    float               now[EST_FIT_LINES_N];          ///< resonators; during the evaluation the powers
    float               before[EST_FIT_LINES_N];       ///< resonators, one step before
    float               regions[EST_FIT_REGIONS_N];    ///< sums of every second innovation, by region
    uint16_t            regions_n[EST_FIT_REGIONS_N];  ///< innovations in each of them
    est_fit_sums_t      sums;
    float               first_spread;    ///< at the end of the first block [codes]
    float               first_variance;  ///< of the innovations of the first block [codes^2]; 0: none yet
    est_misfit_t        found;           ///< in the block that is evaluated
    est_misfit_kind_t   candidate;       ///< cause found in the last block
    est_misfit_t        misfit;
} est_fit_watch_t;

/// Prepare for the first sample of an estimator with this configuration. The configuration is not copied; it must
/// stay unchanged. Returns false iff na is not 2; the tests of the excitation and of slow plants then do not apply
/// and the state is unusable. Cost: constant. RAM: 0.4 kB. May be called from an interrupt.
EST_RESULT_USED bool est_fit_init(est_fit_watch_t* self, const est_config_t* config);

/// Enter the input and result of an est_step(); to be called after every step. Cost: some 200
/// instructions on a Cortex-M4F, at most 350 (make cost). May be called from an interrupt.
void est_fit_enter(est_fit_watch_t* self, const est_t* estimator, est_sample_t sample, est_step_t step);

/// Present misfit. Cost: constant. May be called from an interrupt.
est_misfit_t est_fit_misfit(const est_fit_watch_t* self);

#ifdef __cplusplus
}
#endif

#endif  // EST_FIT_H_INCLUDED
