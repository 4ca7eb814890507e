#include "engine.h"

#include <string.h>

/// engine_follow() for a number of states that the compiler may know.
static inline void
follow(int n, int64_t samples, const double* phi, const double* gamma, const double* input, double* x, double* out) {
    double now[ENGINE_MAX_STATES], next[ENGINE_MAX_STATES];
    memcpy(now, x, (size_t)n * sizeof x[0]);
    for (int64_t k = 0; k < samples; k++) {
        for (int i = 0; i < n; i++) {
            double sum = phi[i * n] * now[0];
            for (int j = 1; j < n; j++) {
                sum += phi[i * n + j] * now[j];
            }
            next[i] = sum + gamma[i] * input[k];
        }
        memcpy(now, next, (size_t)n * sizeof x[0]);
        out[k] = now[0];
    }
    memcpy(x, now, (size_t)n * sizeof x[0]);
}

void engine_follow(
    int n, int64_t samples, const double* phi, const double* gamma, const double* input, double* x, double* out) {
    if (n == 2) {
        follow(2, samples, phi, gamma, input, x, out);
    } else if (n > 0) {
        follow(n, samples, phi, gamma, input, x, out);
    }
}
