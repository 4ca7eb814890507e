// SPDX-License-Identifier: MIT
/// The estimator as a subject. -DSUBJECT_NA=2U, _NB, _NK and _OFFSET set the orders, -DSUBJECT_LOCKED the generator
/// on the clock of the card, -DSUBJECT_ISOLATES the isolation of the change, -DSUBJECT_WATCHES the watch of
/// the fit.

#include "est.h"
#include "est_fit.h"
#include "est_isolation.h"
#include "subject.h"

#ifdef SUBJECT_LOCKED
const bool subject_drifts = false;
#else
const bool subject_drifts = true;
#endif

static est_t        estimator;
static est_config_t config;

#ifdef SUBJECT_ISOLATES
static est_isolation_t isolation;
#endif

#ifdef SUBJECT_WATCHES
static est_fit_watch_t fit;
#endif

SUBJECT void subject_begin(void) {
    config                   = est_config_default();
    config.na                = SUBJECT_NA;
    config.nb                = SUBJECT_NB;
    config.nk                = SUBJECT_NK;
    config.offset            = SUBJECT_OFFSET;
    config.trigger.warm_up_n = 150U;  // the change comes before the default ends
#ifdef SUBJECT_LOCKED
    config.edge_instants = EST_EDGES_LOCKED;
#endif
    const bool accepted = est_init(&estimator, &config);
    (void)accepted;  // subject_judge() detects a refusal: nothing is counted
#ifdef SUBJECT_ISOLATES
    const bool applies = est_isolation_init(&isolation, &config, 0.0F);
    (void)applies;
#endif
#ifdef SUBJECT_WATCHES
    const bool watches = est_fit_init(&fit, &config);
    (void)watches;
#endif
}

SUBJECT void subject_enter(const float u, const float y, const bool valid) {
    const est_sample_t sample = { .u = u, .y = y, .valid = valid };
#ifdef SUBJECT_ISOLATES
    est_isolation_enter(&isolation, &estimator, sample, est_step(&estimator, sample));
    while (est_isolation_work(&isolation)) {
    }
#elif defined(SUBJECT_WATCHES)
    est_fit_enter(&fit, &estimator, est_step(&estimator, sample));
#else
    (void)est_step(&estimator, sample);
#endif
}

/// True iff the change was identified as one of the stiffness.
static bool is_isolated(void) {
#ifdef SUBJECT_ISOLATES
    return est_isolation_diagnosis(&isolation).change == EST_CHANGE_STIFFNESS;
#else
    return true;
#endif
}

/// Check that the change raised an alarm, the drift did not, and the gap was counted.
SUBJECT uint32_t subject_judge(void) {
    const est_counters_t counters = est_counters(&estimator);
    return (est_invariants_hold(&estimator) ? 0U : 1U) | ((counters.alarms == 1U) ? 0U : 2U) |
           ((counters.missing == 1U) ? 0U : 4U) | ((counters.slips == (subject_drifts ? 1U : 0U)) ? 0U : 8U) |
           (is_isolated() ? 0U : 16U);
}
