#include "est_edges.h"

#define TRAIN_N (EST_PAST_MAX + 2U)

static void clear_train(est_edges_t* const self) {
    for (uint8_t i = 0U; i < TRAIN_N; i++) {
        self->train[i] = 0.0F;
    }
}

/// The next value of the train if no further edge came.
static float coasting(const est_edges_t* const self, const est_config_t* const config) {
    float out = 0.0F;
    for (uint8_t i = 0U; i < config->na; i++) {
        out -= config->c[i] * self->train[i];
    }
    return out;
}

static void advance_train(est_edges_t* const self, const est_config_t* const config, const float height) {
    const float newest = height + coasting(self, config);
    for (uint8_t i = (uint8_t)(TRAIN_N - 1U); i > 0U; i--) {
        self->train[i] = self->train[i - 1U];
    }
    self->train[0] = newest;
}

void est_edges_forget(est_edges_t* const self) {
    self->u_known = false;
    self->age_n   = 0U;
    clear_train(self);
}

static float step_of(const est_edges_t* const self, const float u) {
    return self->u_known ? (u - self->u_previous) : 0.0F;
}

bool est_edges_is_edge(const est_edges_t* const self, const est_config_t* const config, const float u) {
    const float step = step_of(self, u);
    return (step >= config->edge_codes) || (step <= -config->edge_codes);
}

bool est_edges_enter(est_edges_t* const self, const est_config_t* const config, const float u, const bool keep) {
    const float height = est_edges_is_edge(self, config, u) ? step_of(self, u) : 0.0F;
    const bool  begin  = (config->edge_instants == EST_EDGES_MAY_SLIP) && est_edges_is_edge(self, config, u) && !keep;
    self->u_previous   = u;
    self->u_known      = true;
    if (begin) {
        clear_train(self);
        self->age_n = 0U;
    }
    if (begin || (self->age_n > 0U)) {
        advance_train(self, config, height);
        self->age_n++;
    }
    return begin;
}

void est_edges_shares(const est_edges_t* const  self,
                      const est_config_t* const config,
                      const float* const        b,
                      float* const              early,
                      float* const              late) {
    *early = (config->nk == 0U) ? (b[0] * coasting(self, config)) : 0.0F;
    *late  = 0.0F;
    for (uint8_t j = 0U; j < config->nb; j++) {
        const uint8_t lag = (uint8_t)(config->nk + j);
        *late -= b[j] * self->train[lag];
        *early += (lag > 0U) ? (b[j] * self->train[lag - 1U]) : 0.0F;
    }
}
