// SPDX-License-Identifier: MIT
/// The estimator of estimator_c behind analogrig_estimator.h, with its default settings.
#include "analogrig_estimator.h"
#include "est.h"

#define PARAMETERS (EST_DEFAULT_NA + EST_DEFAULT_NB + 1U)

static const est_config_t config = EST_CONFIG_DEFAULT;

static int init(est_t* const self) { return est_init(self, &config) ? 0 : 1; }

static void step(est_t* const self, const analogrig_in_t* const in, analogrig_out_t* const out) {
    const est_step_t done = est_step(self, (est_sample_t){ .u = in->u, .y = in->y, .valid = in->valid != 0U });
    out->alarm            = done.alarm;
    out->refused          = done.status == EST_REFUSED;
    out->statistic        = done.statistic;
    out->innovation       = done.innovation;
    for (uint8_t i = 0U; i < PARAMETERS; i++) {
        out->theta[i] = est_theta(self, i);
    }
}

ANALOGRIG_ESTIMATOR(est_t, init, step, "est", PARAMETERS, ANALOGRIG_STATISTIC | ANALOGRIG_INNOVATION);
