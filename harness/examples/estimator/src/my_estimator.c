#include "est.h"

#include <stddef.h>
#include <string.h>

#define N 6U  // a1, a2, b0, b1, b2, d

est_config_t est_config_default(void) {
    est_config_t out      = { .na = 2U, .nb = 3U, .nk = 0U, .offset = true, .refresh_n = 0U };
    out.forgetting        = 0.99F;
    out.p0                = 1.0F;
    out.p0_offset         = 1.0F;
    out.noise_variance    = 1.0F;
    out.edge_codes        = 100.0F;
    out.code_low          = 0.0F;
    out.code_high         = 4095.0F;
    out.trigger.kind      = EST_TRIGGER_CUSUM;
    out.trigger.warm_up_n = 150U;
    out.trigger.ceiling   = 11.5F;
    return out;
}

bool est_config_valid(const est_config_t* const c) {
    const bool orders = (c->na == 2U) && (c->nb == 3U) && (c->nk == 0U) && (c->nc == 0U);
    return orders && c->offset && (c->noise_variance > 0.0F);
}

bool est_init(est_t* const self, const est_config_t* const config) {
    memset(self, 0, sizeof(*self));
    self->config   = config;
    self->my.noise = config->noise_variance;
    return est_config_valid(config);
}

static est_step_t update(est_t* const self, const est_sample_t sample) {
    const float x[N]       = { -self->y[0], -self->y[1], sample.u, self->u[0], self->u[1], 100.0F };
    float       innovation = sample.y;
    float       power      = 1.0F;
    for (size_t i = 0U; i < N; i++) {
        innovation -= self->theta[i] * x[i];
        power += x[i] * x[i];
    }
    for (size_t i = 0U; i < N; i++) {
        self->theta[i] += 0.5F * innovation * x[i] / power;
    }
    const float statistic = innovation * innovation / self->my.noise;
    const bool  armed     = self->my.known_n > self->config->trigger.warm_up_n;
    const bool  alarm     = armed && (statistic > 100.0F);
    self->my.noise += 0.01F * (innovation * innovation - self->my.noise);
    self->my.known_n = alarm ? 0U : self->my.known_n + 1U;
    self->counters.updated++;
    self->counters.alarms += alarm ? 1U : 0U;
    est_step_t out = { .status = EST_UPDATED, .alarm = alarm };
    out.innovation = innovation;
    out.statistic  = statistic;
    return out;
}

est_step_t est_step(est_t* const self, const est_sample_t sample) {
    if (!sample.valid) {
        self->counters.missing++;
        return (est_step_t){ .status = EST_MISSING };
    }
    const est_step_t out = update(self, sample);
    self->y[1]           = self->y[0];
    self->y[0]           = sample.y;
    self->u[1]           = self->u[0];
    self->u[0]           = sample.u;
    return out;
}

uint8_t est_theta_count(const est_t* const self) { return (self != NULL) ? N : 0U; }

float est_theta(const est_t* const self, const uint8_t i) {
    return (i == 5U) ? (100.0F * self->theta[i]) : self->theta[i];
}

float est_noise_variance(const est_t* const self) { return self->my.noise; }

float est_prefilter(const est_t* const self, const uint8_t i) {
    (void)self;
    (void)i;
    return 0.0F;
}

est_counters_t est_counters(const est_t* const self) { return self->counters; }
