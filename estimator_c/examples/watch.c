// SPDX-License-Identifier: MIT
/// Watch a plant for changes. The plant here is simulated; yours is behind a converter.
#include "est.h"

static const est_config_t config = EST_CONFIG_FOR_CODES(-1.0F, 4096.0F);  // a 12-bit converter
static est_t              estimator;                                      // keeps a pointer to config

int main(void) {
    float y = 1000.0F;
    if (!est_init(&estimator, &config)) {
        return 1;  // a value of config is out of its range
    }
    for (uint16_t k = 0U; k < 2000U; k++) {
        const float u = (((k / 50U) % 2U) == 0U) ? 1000.0F : 3000.0F;  // to your actuator
        y += ((k < 1000U) ? 0.20F : 0.25F) * (u - y);                  // from your sensor; faster from sample 1000 on
        if (est_step(&estimator, (est_sample_t){ .u = u, .y = (float)(uint16_t)y, .valid = true }).alarm) {
            return ((k >= 1000U) && (k < 1200U)) ? 0 : 2;  // 0: detected in time
        }
    }
    return 3;  // missed
}
