// SPDX-License-Identifier: MIT
/// est_fit: watch whether the model of est.h still fits, and name the cause if it does not.
///
/// The model promises innovations that are white, have the declared variance, and depend on nothing that came before.
/// The module tests this over blocks of EST_FIT_BLOCK_N samples. A kind of misfit is stated once two blocks in
/// succession agree on it. Alarms are evidence of noise, most of all those that were not justified, as the scale of
/// est.h shows. After two of these one block suffices, and the kind with the most evidence is stated. Exactly one kind
/// is stated, the likeliest cause.
/// harness/docs/background/estimator.md gives the statistics and their limits.
///
/// The module is optional: est.c does not depend on it. It reads the state of the estimator, so both must be compiled
/// from the same version. No heap, no libm, no globals. The caller owns the state, which belongs to one context.
///
///     const est_step_t step = est_step(&estimator, sample);
///     est_fit_enter(&fit, &estimator, step);                               // right after every est_step()
///     const est_misfit_t misfit = est_fit_misfit(&fit);
///     if (misfit.kind != EST_MISFIT_NONE) { ... alarms may be false, and changes may be missed ... }

#ifndef EST_FIT_H_INCLUDED
#define EST_FIT_H_INCLUDED

#include "est.h"

#ifdef __cplusplus
extern "C" {
#endif

/// A name with the layout of est.h: files compiled with different ones do not link.
#define est_fit_init EST_NAME(est_fit_init)

/// Number of samples whose sum is one sample of the spectrum. Lines up to 1 / (2 * EST_FIT_SUM_N) cycles per sample
/// are found: 416 Hz at 20 kHz.
#define EST_FIT_SUM_N 24U

/// Number of lines in the spectrum; the first is the mean.
#define EST_FIT_LINES_N 16U

/// Number of sums in a block, and number of samples. EST_FIT_SUM_N more are needed to evaluate it.
#define EST_FIT_SUMS_N (2U * EST_FIT_LINES_N)
#define EST_FIT_BLOCK_N (EST_FIT_SUMS_N * EST_FIT_SUM_N)

/// Number of sums before the first block, in which the estimate settles. They are a block that is too short to state
/// anything, and EST_FIT_SUM_N more samples.
#define EST_FIT_SETTLING_N 13U

/// Regions of the state of the plant: four levels of y, each falling, resting or rising.
#define EST_FIT_REGIONS_N 12U

/// Causes of a poor fit. EST_MISFIT_SLOW_PLANT replaces EST_MISFIT_EXCITATION if the poles are too close to 1 for the
/// resolution of the codes.
typedef enum {
    EST_MISFIT_NONE      = 0,
    EST_MISFIT_DRIFT     = 1,  ///< y drifts: the innovations have a mean
    EST_MISFIT_HUM       = 2,  ///< a periodic disturbance of y
    EST_MISFIT_EDGES     = 3,  ///< the position of the edges of u between two samples varies
    EST_MISFIT_NONLINEAR = 4,  ///< the response depends on the level of y, or the order of the model is too low
    EST_MISFIT_NOISE = 5,  ///< the noise is larger than declared, correlated, has outliers, or more than one variance
    EST_MISFIT_SLOW_PLANT = 6,  ///< the plant hardly moves between two samples
    EST_MISFIT_EXCITATION = 7,  ///< u is too small for a change of the mass to be seen
} est_misfit_kind_t;

typedef struct {
    est_misfit_kind_t kind;
    float             strength;   ///< statistic over its limit; 0 without a misfit
    float             frequency;  ///< of the line [cycles per sample]; 0 unless the kind is EST_MISFIT_HUM
} est_misfit_t;

/// Sums over a block. Private.
typedef struct {
    float total;    ///< of the innovations; of the clear ones up to the last sum
    float squares;  ///< of their squares
    float fourths;  ///< of their squares, less limited, times the squares
    float along;  ///< of the products of a clear innovation and the clear one before; clear: no edge of u is ambiguous
    float power;  ///< of the squares of the sums of the clear ones over EST_FIT_SUM_N samples
    float counted;            ///< part of `squares` that the regions contain
    float moved;              ///< of the squares of the whitened second difference of y, as predicted
    float drawn;              ///< of the squares of the innovations drawn for the regions
    float explained;          ///< energy of these that the regions explain beyond chance
    float repeated;           ///< energy of these that the regions of the block before explain
    float uneven;             ///< squared deviations of the energies of the regions, over their numbers
    float energy;             ///< of the clear innovations in the regions
    float steep;              ///< the same, each times the steepness of y before it
    float steepness;          ///< of y before each of these
    float steepness_squares;  ///< squares of these
    uint16_t lost_n;          ///< samples without an innovation, or whose innovation is excluded
    uint16_t ambiguous_n;     ///< innovations that are not clear
    uint16_t counted_n;       ///< innovations in `counted`
    uint16_t moved_n;         ///< differences in `moved`
    uint16_t drawn_n;         ///< innovations in `drawn`
    uint16_t energy_n;        ///< innovations in `energy`
} est_fit_sums_t;

/// State of the watch. The fields are private; read est_fit_misfit().
typedef struct {
    const est_config_t* config;
    uint8_t             slot;                           ///< samples of the present sum so far
    uint8_t             sum_n;                          ///< sums of the block so far
    uint8_t             excluded_n;                     ///< samples after an alarm that are still excluded
    uint8_t             region;                         ///< of the state of the plant before the present sample
    uint8_t             learnt_n;                       ///< samples in level and spread, limited
    uint8_t             peak;                           ///< line with the largest power
    uint8_t             beyond_end;                     ///< slot after that of an innovation beyond its limit; 0: none
    uint16_t            alarms_n;                       ///< alarms in the block; one that was not justified counts more
    uint16_t            last_alarms_n;                  ///< the same in the block before
    float               limit;                          ///< of an innovation [codes]
    float               last;                           ///< innovation
    float               sum;                            ///< of the clear innovations since the last complete sum
    float               entered;                        ///< last complete sum
    float               level;                          ///< mean of y [codes]
    float               spread;                         ///< mean distance of y from its level [codes]
    float               steepness;                      ///< squared change of y before the present samples
    float               now[EST_FIT_LINES_N];           ///< resonators; during the evaluation the powers
    float               before[EST_FIT_LINES_N];        ///< resonators, one step before
    float               regions[EST_FIT_REGIONS_N];     ///< sums of the drawn innovations, by region
    float               means[EST_FIT_REGIONS_N];       ///< mean of each region in the block before
    float               energies[EST_FIT_REGIONS_N];    ///< sums of the squares of clear innovations, by region
    uint16_t            energies_n[EST_FIT_REGIONS_N];  ///< innovations in each of these
    uint8_t             regions_n[EST_FIT_REGIONS_N];   ///< innovations in each of `regions`
    est_fit_sums_t      sums;
    float               first_spread;    ///< at the end of the first block [codes]
    float               first_variance;  ///< of the innovations of the first block [codes^2]; 0: none yet
    float               last_variance;   ///< the same of the block before
    float               last_frequency;  ///< of the line in the block before [cycles per sample]
    float               last_power;      ///< of the peak in the block before
    float               last_tails;      ///< evidence for outliers in the block before
    float               last_steep;    ///< energy where y is steep in the block before, beyond its share, in variances
    float               last_variety;  ///< squared deviations of the steepness in the block before
    float               inflation;     ///< of the scale at the end of the block before, over its limit
    float               noise;         ///< evidence for noise in the block that is evaluated; 1: twice what suffices
    float               last_noise;    ///< the same in the block before
    est_misfit_t        found;         ///< in the block that is evaluated
    est_misfit_kind_t   last_kind;     ///< found in the block before, by itself
    est_misfit_kind_t   candidate;     ///< found in the block before
    est_misfit_t        misfit;
} est_fit_watch_t;

/// Prepare for the first sample of an estimator with this configuration. The configuration is not copied; it must
/// stay unchanged. Returns false iff na is not 2; the test of the excitation then does not apply and the state is
/// unusable. The test needs the cumulative sum and EST_WITH_ROBUSTNESS, and EST_MISFIT_EDGES needs EST_EDGES_MAY_SLIP;
/// otherwise these are not found. Cost: constant. RAM: 0.5 kB. May be called from an interrupt.
EST_RESULT_USED bool est_fit_init(est_fit_watch_t* self, const est_config_t* config);

/// Enter the result of an est_step(); to be called after every step. Cost: typically 62
/// instructions on a Cortex-M4F, 105 on average, at most 273 (make cost). May be called from an interrupt.
void est_fit_enter(est_fit_watch_t* self, const est_t* estimator, est_step_t step);

/// Present misfit. Cost: constant. May be called from an interrupt.
est_misfit_t est_fit_misfit(const est_fit_watch_t* self);

#ifdef __cplusplus
}
#endif

#endif  // EST_FIT_H_INCLUDED
