// SPDX-License-Identifier: MIT
/// The estimator of a firmware with one planted defect, the same behind every protocol.

#include "est.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

static int bug;  ///< number of the planted defect; 0: none

static est_config_t config = EST_CONFIG_DEFAULT;
static est_t        estimator;

typedef struct {
    float    theta[6];
    float    innovation;
    float    statistic;
    unsigned alarm;
} answer_t;

static answer_t last;  ///< answer to the sample before

static void begin(void) {
    if (!est_init(&estimator, &config)) {
        abort();
    }
    (void)memset(&last, 0, sizeof(last));
}

static answer_t step(const float u, const float y, const bool valid) {
    const est_step_t out    = est_step(&estimator, (est_sample_t){ .u = u, .y = y, .valid = valid });
    answer_t         answer = { .innovation = out.innovation, .statistic = out.statistic, .alarm = out.alarm };
    for (unsigned i = 0; i < 6U; i++) {
        answer.theta[i] = est_theta(&estimator, i);
    }
    return answer;
}
