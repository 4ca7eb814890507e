// SPDX-License-Identifier: MIT
/* Runs whole blocks of samples through the public header est.h, for the tests. */

#include "est.h"
#include "est_correlation.h"
#include "est_delta.h"
#include "est_fit.h"
#include "est_isolation.h"

#include <stddef.h>
#include <string.h>

typedef struct {
    double na, nb, nk, nc, offset, noise_estimated, refresh_n, stuck_n, idle_n, edge_instants;
    double forgetting, random_walk, p0, p0_offset, noise_variance, c[2], edge_codes, code_low, code_high;
    double kind, ceiling, hold_off_n, warm_up_n, absolute, reset, custom;
} driver_config_t;

static est_t        self;
static est_config_t config;

/* The estimate of the caller; na = 2. */
static void set_theta(const double* theta) {
    for (unsigned i = 0; i < est_theta_count(&self); i++) {
        self.theta[i] = (float)theta[i];
    }
    if (est_delta_applies(&self)) {
        float a[] = { 1.0F, self.theta[0], self.theta[1] };
        est_delta_from_coefficients(a, 2U);
        self.theta[0] = a[1];
        self.theta[1] = a[2];
        est_delta_from_coefficients(&self.theta[2], (uint_fast8_t)(config.nb - 1U));
    }
}

/* A trigger of the caller's own: counts the innovations since it began anew, in its context. */
static float counted;

static float count_innovations(void* context, float innovation, float variance, bool anew) {
    float* const counter = context;
    *counter = (anew ? 0.0F : *counter) + (((innovation * innovation) >= 0.0F) && (variance > 0.0F) ? 1.0F : 0.0F);
    return *counter;
}

/* Another: the squared innovation in predicted variances. */
static float normalise(void* context, float innovation, float variance, bool anew) {
    (void)context;
    (void)anew;
    return (innovation * innovation) / variance;
}

int driver_init(const driver_config_t* in) {
    config = (est_config_t){
        .na              = (uint8_t)in->na,
        .nb              = (uint8_t)in->nb,
        .nk              = (uint8_t)in->nk,
        .nc              = (uint8_t)in->nc,
        .offset          = in->offset != 0,
        .noise_estimated = in->noise_estimated != 0,
        .refresh_n       = (uint16_t)in->refresh_n,
        .stuck_n         = (uint8_t)in->stuck_n,
        .idle_n          = (uint16_t)in->idle_n,
        .edge_instants   = (est_edge_instants_t)in->edge_instants,
        .forgetting      = (float)in->forgetting,
        .random_walk     = (float)in->random_walk,
        .p0              = (float)in->p0,
        .p0_offset       = (float)in->p0_offset,
        .noise_variance  = (float)in->noise_variance,
        .c               = { (float)in->c[0], (float)in->c[1] },
        .edge_codes      = (float)in->edge_codes,
        .code_low        = (float)in->code_low,
        .code_high       = (float)in->code_high,
        .trigger         = { .kind       = (est_trigger_kind_t)in->kind,
                             .ceiling    = (float)in->ceiling,
                             .hold_off_n = (uint16_t)in->hold_off_n,
                             .warm_up_n  = (uint16_t)in->warm_up_n,
                             .absolute   = in->absolute != 0,
                             .reset      = (est_reset_t)in->reset,
                             .custom     = (in->custom == 2) ? normalise : ((in->custom == 1) ? count_innovations : 0),
                             .context    = &counted },
    };
    return est_init(&self, &config) ? 1 : 0;
}

void driver_default(driver_config_t* out) {
    const est_config_t c = est_config_default();
    *out                 = (driver_config_t){ c.na,
                                              c.nb,
                                              c.nk,
                                              c.nc,
                                              c.offset,
                                              c.noise_estimated,
                                              c.refresh_n,
                                              c.stuck_n,
                                              c.idle_n,
                                              c.edge_instants,
                                              c.forgetting,
                                              c.random_walk,
                                              c.p0,
                                              c.p0_offset,
                                              c.noise_variance,
                                              { c.c[0], c.c[1] },
                                              c.edge_codes,
                                              c.code_low,
                                              c.code_high,
                                              c.trigger.kind,
                                              c.trigger.ceiling,
                                              c.trigger.hold_off_n,
                                              c.trigger.warm_up_n,
                                              c.trigger.absolute,
                                              c.trigger.reset,
                                              0 };
}

/* est_copy_theta() and est_theta() give the same bits. */
static int copies_theta(const float* theta) {
    float copy[EST_THETA_MAX];
    est_copy_theta(&self, copy);
    return memcmp(copy, theta, est_theta_count(&self) * sizeof(float)) == 0;
}

/* theta: (n, est_theta_count()); returns whether the invariants held after every sample. */
int driver_run(size_t               n,
               const double*        u,
               const double*        y,
               const unsigned char* valid,
               float*               theta,
               float*               innovation,
               float*               statistic,
               unsigned char*       alarm,
               unsigned char*       status,
               unsigned char*       idle) {
    const uint8_t count = est_theta_count(&self);
    int           held  = 1;
    for (size_t k = 0; k < n; k++) {
        const est_step_t step =
            est_step(&self, (est_sample_t){ .u = (float)u[k], .y = (float)y[k], .valid = valid[k] != 0 });
        for (uint8_t i = 0; i < count; i++) {
            theta[(k * count) + i] = est_theta(&self, i);
        }
        innovation[k] = step.innovation;
        statistic[k]  = step.statistic;
        alarm[k]      = step.alarm;
        status[k]     = (unsigned char)step.status;
        idle[k]       = step.idle;
        held          = held && est_invariants_hold(&self) && copies_theta(&theta[k * count]);
    }
    return held;
}

/* t runs of n samples, each from the start: where the alarms came, and theta at the end of each run, (t, count). */
void driver_watch(size_t t, size_t n, const double* u, const double* y, unsigned char* alarm, float* theta) {
    const est_config_t* const kept  = &config;
    const uint8_t             count = est_theta_count(&self);
    for (size_t run = 0; run < t; run++) {
        if (!est_init(&self, kept)) {
            return;
        }
        for (size_t k = run * n; k < ((run + 1) * n); k++) {
            alarm[k] = est_step(&self, (est_sample_t){ .u = (float)u[k], .y = (float)y[k], .valid = true }).alarm;
        }
        for (uint8_t i = 0; i < count; i++) {
            theta[(run * count) + i] = est_theta(&self, i);
        }
    }
}

int driver_theta_count(void) { return est_theta_count(&self); }

float driver_variance(int index) { return est_variance(&self, (uint8_t)index); }

/* Sets counters to one below their limits, as after years. */
void driver_age_counters(void) {
    self.counters =
        (est_counters_t){ UINT32_MAX - 1U, UINT32_MAX - 1U, UINT16_MAX - 1U, UINT16_MAX - 1U, UINT16_MAX - 1U,
                          UINT16_MAX - 1U, UINT16_MAX - 1U, UINT16_MAX - 1U, UINT16_MAX - 1U, UINT16_MAX - 1U };
}

/* Sets the inflation of the scale, as after alarms that were not justified. The weight follows with the next block. */
void driver_inflate(double inflation) { self.scale.inflation = (float)inflation; }

/* partial, (2,): partial correlations of the innovations at lags 1 and 2; returns whether they have a second reading. */
int driver_correlation(double* partial) {
    partial[0] = self.correlation.partial[0];
    partial[1] = self.correlation.partial[1];
    return est_correlation_coloured(&self.correlation) ? 1 : 0;
}

/* Damages the state in one way, asks for the invariants, and mends it. */
int driver_invariants_hold_if_damaged(int way) {
    const est_t  kept    = self;
    est_config_t invalid = config;
    invalid.forgetting   = 2.0F;
    switch (way) {
    case 0:
        self.config = 0;
        break;
    case 1:
        self.config = &invalid;
        break;
    case 2:
        self.factors.weight = 0.0F;
        break;
    case 3:
        self.factors.d[1] = -1.0F;
        break;
    case 4:
        self.theta[0] = __builtin_nanf("");
        break;
    case 5:
        self.trigger.statistic = -1.0F;
        break;
    case 6:
        self.noise_variance = 0.0F;
        break;
    case 7:
        self.factors.d[1] = __builtin_inff();
        break;
    case 9:
        self.factors.weight = 1.5F;
        break;
    default:
        break;
    }
    const int held = est_invariants_hold((way == 8) ? 0 : &self) ? 1 : 0;
    self           = kept;
    return held;
}

float driver_noise_variance(void) { return est_noise_variance(&self); }

float driver_scale(void) { return est_scale(&self); }

void driver_counters(unsigned out[10]) {
    const est_counters_t c       = est_counters(&self);
    const unsigned       all[10] = { c.updated, c.missing,   c.refused, c.alarms,    c.restarts,
                                     c.slips,   c.saturated, c.stuck,   c.refreshes, c.outliers };
    for (int i = 0; i < 10; i++) {
        out[i] = all[i];
    }
}

/* out, (2,): range of the codes of est_config_for_codes(). */
void driver_for_codes(double low, double high, double* out) {
    const est_config_t c = est_config_for_codes((float)low, (float)high);
    out[0]               = (double)c.code_low;
    out[1]               = (double)c.code_high;
}

/* out, (3,): M, B, K from the present theta, or unchanged. */
int driver_parameters(double period, double force, double displacement, double* out) {
    const est_units_t units = { .period = (float)period, .force = (float)force, .displacement = (float)displacement };
    est_parameters_t  found = { .mass = (float)out[0], .damping = (float)out[1], .stiffness = (float)out[2] };
    const bool        has   = est_isolation_parameters(&self, units, &found);
    out[0]                  = (double)found.mass;
    out[1]                  = (double)found.damping;
    out[2]                  = (double)found.stiffness;
    return has ? 1 : 0;
}

int driver_can_isolate(void) {
    static est_isolation_t isolation;
    return est_isolation_init(&isolation, &config, 0.0F) ? 1 : 0;
}

/* t runs of n samples, each from the start; `slices` calls of est_isolation_work() after each sample. found, (t, 8): the first
   alarm at or after `from`, the sample of the diagnosis (n: none), class, extent then and at the end, onset before the alarm,
   the least and the most. */
void driver_isolate(size_t               t,
                    size_t               n,
                    const double*        u,
                    const double*        y,
                    const unsigned char* valid,
                    const long long*     from,
                    int                  slices,
                    double               force_zero,
                    double*              found) {
    static est_isolation_t isolation;
    for (size_t run = 0; run < t; run++) {
        double* const out = &found[run * 8U];
        out[0] = out[1] = (double)n;
        out[2] = out[3] = 0.0;
        if (!est_init(&self, &config) || !est_isolation_init(&isolation, &config, (float)force_zero)) {
            return;
        }
        for (size_t k = 0; k < n; k++) {
            const size_t       at     = (run * n) + k;
            const est_sample_t sample = { .u = (float)u[at], .y = (float)y[at], .valid = valid[at] != 0 };
            const est_step_t   step   = est_step(&self, sample);
            est_isolation_enter(&isolation, &self, sample, step);
            for (int i = 0; (i < slices) && est_isolation_work(&isolation); i++) {
            }
            const est_diagnosis_t now = est_isolation_diagnosis(&isolation);
            if (step.alarm && (out[0] >= (double)n) && ((long long)k >= from[run])) {
                out[0] = (double)k;
            }
            if ((out[0] < (double)n) && (out[1] >= (double)n) && (now.change != EST_CHANGE_UNDECIDED)) {
                out[1] = (double)k;
                out[2] = (double)now.change;
                out[3] = now.extent;
                out[5] = now.onset_n;
                out[6] = now.onset_low_n;
                out[7] = now.onset_high_n;
            }
            out[4] = now.extent;
        }
    }
}

/* What est_isolation makes of n steps that are given, the estimate being theta all the time; `slices` calls of
   est_isolation_work() after each. worked, (n,): how many of them left more to do. found, (3,): class, extent, samples. */
void driver_diagnose(size_t               n,
                     const double*        theta,
                     const double*        u,
                     const double*        y,
                     const double*        statistic,
                     const unsigned char* status,
                     const unsigned char* alarm,
                     int                  slices,
                     int*                 worked,
                     double*              found) {
    static est_isolation_t isolation;
    if (!est_init(&self, &config) || !est_isolation_init(&isolation, &config, 0.0F)) {
        return;
    }
    set_theta(theta);
    for (size_t k = 0; k < n; k++) {
        const est_step_t step = { .status    = (est_status_t)status[k],
                                  .statistic = (float)statistic[k],
                                  .alarm     = alarm[k] != 0 };
        est_isolation_enter(&isolation, &self, (est_sample_t){ .u = (float)u[k], .y = (float)y[k], .valid = true },
                            step);
        worked[k] = 0;
        for (int i = 0; i < slices; i++) {
            worked[k] += est_isolation_work(&isolation) ? 1 : 0;
        }
    }
    const est_diagnosis_t now = est_isolation_diagnosis(&isolation);
    found[0]                  = (double)now.change;
    found[1]                  = now.extent;
    found[2]                  = now.samples_n;
}

int driver_can_watch_fit(void) {
    static est_fit_watch_t fit;
    return est_fit_init(&fit, &config) ? 1 : 0;
}

/* t runs of n samples, each from the start. cause, (t, n): the cause of the misfit after each sample. found, (t, 2):
   strength and frequency after the last one. */
void driver_watch_fit(size_t               t,
                      size_t               n,
                      const double*        u,
                      const double*        y,
                      const unsigned char* valid,
                      unsigned char*       cause,
                      double*              found) {
    static est_fit_watch_t fit;
    for (size_t run = 0; run < t; run++) {
        if (!est_init(&self, &config) || !est_fit_init(&fit, &config)) {
            return;
        }
        for (size_t at = run * n; at < ((run + 1U) * n); at++) {
            const est_sample_t sample = { .u = (float)u[at], .y = (float)y[at], .valid = valid[at] != 0 };
            est_fit_enter(&fit, &self, est_step(&self, sample));
            cause[at] = (unsigned char)est_fit_misfit(&fit).kind;
        }
        found[2U * run]        = est_fit_misfit(&fit).strength;
        found[(2U * run) + 1U] = est_fit_misfit(&fit).frequency;
    }
}

/* The same for one run whose innovations, treatment and alarms are given. inflation: of the scale. found, (2,). */
void driver_judge_fit(size_t               n,
                      double               inflation,
                      const double*        u,
                      const double*        y,
                      const double*        innovation,
                      const unsigned char* status,
                      const unsigned char* alarm,
                      unsigned char*       cause,
                      double*              found) {
    static est_fit_watch_t fit;
    if (!est_init(&self, &config) || !est_fit_init(&fit, &config)) {
        return;
    }
    for (size_t k = 0; k < n; k++) {
        const est_sample_t sample = { .u = (float)u[k], .y = (float)y[k], .valid = status[k] != EST_MISSING };
        est_step_t         step   = est_step(&self, sample);
        step.status               = (est_status_t)status[k];
        step.alarm                = alarm[k] != 0;
        step.innovation           = (float)innovation[k];
        self.scale.inflation      = (float)inflation;
        self.scale.dispersion     = 1.0F;
        est_fit_enter(&fit, &self, step);
        cause[k] = (unsigned char)est_fit_misfit(&fit).kind;
    }
    found[0] = est_fit_misfit(&fit).strength;
    found[1] = est_fit_misfit(&fit).frequency;
}
