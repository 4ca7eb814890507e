/* Runs whole blocks of samples through the public header est.h, for the tests. */

#include "est.h"

#include <stddef.h>

typedef struct {
    double na, nb, nk, offset, forgetting, p0, p0_offset, noise_variance, c[2], edge_codes, edge_instants;
    double kind, ceiling, hold_off_n, warm_up_n, absolute, reset;
} driver_config_t;

static est_t        self;
static est_config_t config;

int driver_init(const driver_config_t* in) {
    config = (est_config_t){
        .na = (uint8_t)in->na, .nb = (uint8_t)in->nb, .nk = (uint8_t)in->nk, .offset = in->offset != 0,
        .forgetting = (float)in->forgetting, .p0 = (float)in->p0, .p0_offset = (float)in->p0_offset,
        .noise_variance = (float)in->noise_variance, .stuck_n = 16, .idle_n = 1000, .code_low = -EST_CODE_LIMIT,
        .code_high = EST_CODE_LIMIT, .c = { (float)in->c[0], (float)in->c[1] },
        .edge_codes = (float)in->edge_codes, .edge_instants = (est_edge_instants_t)in->edge_instants,
        .trigger = { .kind = (est_trigger_kind_t)in->kind, .ceiling = (float)in->ceiling,
                     .hold_off_n = (uint16_t)in->hold_off_n, .warm_up_n = (uint16_t)in->warm_up_n,
                     .absolute = in->absolute != 0, .reset = (est_reset_t)in->reset },
    };
    return est_init(&self, &config) ? 1 : 0;
}

void driver_default(driver_config_t* out) {
    const est_config_t c = est_config_default();
    *out = (driver_config_t){ c.na, c.nb, c.nk, c.offset, c.forgetting, c.p0, c.p0_offset, c.noise_variance,
                              { c.c[0], c.c[1] }, c.edge_codes, c.edge_instants, c.trigger.kind, c.trigger.ceiling,
                              c.trigger.hold_off_n, c.trigger.warm_up_n, c.trigger.absolute, c.trigger.reset };
}

/* theta: (n, est_theta_count()); returns whether the invariants held after every sample. */
int driver_run(size_t n, const double* u, const double* y, const unsigned char* valid, float* theta, float* innovation,
               float* statistic, unsigned char* alarm, unsigned char* status) {
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
        held          = held && est_invariants_hold(&self);
    }
    return held;
}

int driver_theta_count(void) { return est_theta_count(&self); }

float driver_variance(int index) { return est_variance(&self, (uint8_t)index); }

void driver_counters(unsigned out[6]) {
    const est_counters_t c = est_counters(&self);
    out[0] = c.updated;
    out[1] = c.missing;
    out[2] = c.refused;
    out[3] = c.alarms;
    out[4] = c.restarts;
    out[5] = c.slips;
}
