#include "est_edges.h"

#include "est_orders.h"

void est_edges_forget(est_edges_t* const self) { self->age_n = 0U; }

float est_edges_height(const est_config_t* const config, const float* const u) {
    const float step = u[0] - u[1];
    return ((step >= config->edge_codes) || (step <= -config->edge_codes)) ? step : 0.0F;
}

void est_edges_begin(est_edges_t* const        self,
                     const est_config_t* const config,
                     const float* const        theta,
                     const uint8_t             count,
                     const float               height,
                     const bool                after_equation) {
    self->age_n = 0U;
    for (uint8_t i = 0U; i < NA(config); i++) {
        self->early[i] = 0.0F;
        self->late[i]  = 0.0F;
    }
    if (after_equation && (NK(config) == 0U)) {
        self->early[0] = theta[NA(config)] * height;
    }
    for (uint8_t i = 0U; i < COUNT(count); i++) {
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
    const float* const b         = &self->theta[NA(config)];
    float              early_raw = 0.0F;
    float              late_raw  = 0.0F;
    for (uint8_t lag = 0U; (lag < (NK(config) + NB(config))) && (lag < self->age_n); lag++) {
        const float   height = est_edges_height(config, &u[lag]);
        const uint8_t next   = (uint8_t)(lag + 1U);
        late_raw -= (lag >= NK(config)) ? (b[lag - NK(config)] * height) : 0.0F;
        early_raw += ((next >= NK(config)) && ((next - NK(config)) < NB(config))) ? (b[next - NK(config)] * height) : 0.0F;
    }
    *early = est_whitener_filter(whitener, NA(config), self->early, early_raw);
    *late  = est_whitener_filter(whitener, NA(config), self->late, late_raw);
}
