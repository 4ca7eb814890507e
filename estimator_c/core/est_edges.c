#include "est_edges.h"

void est_edges_forget(est_edges_t* const self) { self->age_n = 0U; }

void est_edges_age(est_edges_t* const self) { self->age_n = (self->age_n < EST_DOUBT_N) ? (uint8_t)(self->age_n + 1U) : 0U; }

EST_OUTLINE float height(const est_config_t* const config, const float* const u) {
    return est_edges_is_edge(config, u) ? (u[0] - u[1]) : 0.0F;
}

void est_edges_begin(est_edges_t* const        self,
                     const est_config_t* const config,
                     const float* const        theta,
                     const uint_fast8_t             count,
                     const float               step,
                     const bool                after_equation) {
    self->age_n = 1U;
    for (uint_fast8_t i = 0U; i < EST_NA_MAX; i++) {
        self->early.x[i] = 0.0F;
        self->late.x[i]  = 0.0F;
    }
    if (after_equation && (config->nk == 0U)) {
        self->early.x[0] = theta[config->na] * step;
    }
    for (uint_fast8_t i = 0U; i < count; i++) {
        self->theta[i] = theta[i];
    }
}

/// An edge one sample early had its new level already in the sample before, and one that came late not yet in its own.
void est_edges_shares(est_edges_t* const          self,
                      const est_config_t* const   config,
                      const est_whitener_t* const whitener,
                      const float* const          u,
                      float* const                early,
                      float* const                late) {
    const float* const b         = &self->theta[config->na];
    float              early_raw = 0.0F;
    float              late_raw  = 0.0F;
    for (uint_fast8_t j = 0U; (j < config->nb) && (self->since_n < (config->nb + config->nk)); j++) {
        const uint_fast8_t lag = (uint_fast8_t)(config->nk + j);
        if (lag < self->age_n) {
            late_raw -= b[j] * height(config, &u[lag]);
        }
        if ((lag > 0U) && (lag <= self->age_n)) {
            early_raw += b[j] * height(config, &u[lag - 1U]);
        }
    }
    *early = est_whitener_filter(whitener, &self->early, early_raw);
    *late  = est_whitener_filter(whitener, &self->late, late_raw);
}
