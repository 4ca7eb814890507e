// SPDX-License-Identifier: MIT
/// An estimator as a program: samples on standard input, answers on standard output.
///
///     line             answer
///     U,Y              a1,a2,b0,b1,b2,d,STATISTIC,ALARM
///     -                the same: the sample is missing
///     R                OK: everything begins anew

#include "est.h"

#include <stdio.h>
#include <string.h>

static const est_config_t config = EST_CONFIG_DEFAULT;
static est_t              estimator;

static void answer(const est_step_t step) {
    for (uint8_t i = 0U; i < 6U; i++) {
        (void)printf("%a,", (double)est_theta(&estimator, i));
    }
    (void)printf("%a,%a,%d\n", (double)step.innovation, (double)step.statistic, step.alarm ? 1 : 0);
}

int main(void) {
    char line[64];
    bool is_ready = est_init(&estimator, &config);
    (void)setvbuf(stdout, NULL, _IOLBF, BUFSIZ);  // the other end waits for each line
    while (is_ready && (fgets(line, sizeof(line), stdin) != NULL)) {
        int u = 0;
        int y = 0;
        if (sscanf(line, "%d,%d", &u, &y) == 2) {
            answer(est_step(&estimator, (est_sample_t){ .u = (float)u, .y = (float)y, .valid = true }));
        } else if (strcmp(line, "-\n") == 0) {
            answer(est_step(&estimator, (est_sample_t){ .valid = false }));
        } else if (strcmp(line, "R\n") == 0) {
            is_ready = est_init(&estimator, &config);
            (void)puts("OK");
        } else {
            (void)puts("ERROR");
        }
    }
    return is_ready ? 0 : 1;
}
