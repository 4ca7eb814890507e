#include "engine_state.h"

#include <string.h>

/// The short step h: |a h| is at most NOISE_NORM, and NOISE_TERMS terms end the series within 1e-19 of its sum.
#define NOISE_NORM 1e-2
#define NOISE_TERMS 8
#define MAX_DOUBLINGS 80

#define MAX_NOISE_SQUARE (ENGINE_MAX_NOISE_STATES * ENGINE_MAX_NOISE_STATES)

/// Part of a variance below which the remainder of the Cholesky factorisation counts as zero.
#define NO_VARIANCE 1e-12

/// change = exp(a h) - I over the short step, and cov by the Taylor series of dP/dt = a P + P a' + q.
static void gather_one_step(int n, double step_s, const double* a, const double* q, double* change, double* cov) {
    double power[MAX_NOISE_SQUARE] = { 0.0 }, term[MAX_NOISE_SQUARE] = { 0.0 }, grown[MAX_NOISE_SQUARE];
    for (int i = 0; i < n * n; i++) {
        change[i] = power[i] = a[i] * step_s;
        cov[i] = term[i] = q[i] * step_s;
    }
    for (int k = 2; k <= NOISE_TERMS; k++) {
        const double h = step_s / (double)k;
        matrix_multiply(n, a, term, false, grown);
        for (int i = 0; i < n * n; i++) {
            term[i] = (grown[i] + grown[(i % n) * n + i / n]) * h;
            cov[i] += term[i];
        }
        matrix_multiply(n, power, a, false, grown);
        for (int i = 0; i < n * n; i++) {
            power[i] = grown[i] * h;
            change[i] += power[i];
        }
    }
}

/// Double the step: P + Phi P Phi' and Phi Phi - I with Phi = I + change. Slow states lose no digits.
static void double_step(int n, double* change, double* cov) {
    double grown[MAX_NOISE_SQUARE] = { 0.0 }, transposed[MAX_NOISE_SQUARE] = { 0.0 }, both[MAX_NOISE_SQUARE];
    matrix_multiply(n, change, cov, false, grown);
    for (int i = 0; i < n * n; i++) {
        transposed[i] = grown[(i % n) * n + i / n];
    }
    matrix_multiply(n, change, transposed, false, both);
    for (int i = 0; i < n * n; i++) {
        cov[i] = 2.0 * cov[i] + grown[i] + transposed[i] + both[i];
    }
    matrix_multiply(n, change, change, false, both);
    for (int i = 0; i < n * n; i++) {
        change[i] = 2.0 * change[i] + both[i];
    }
}

/// Cholesky factorisation of a covariance that may be singular.
static void factorise(int n, const double* cov, double* factor) {
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < n; i++) {
            double left = i < j ? 0.0 : cov[i * n + j];
            for (int k = 0; k < j && i >= j; k++) {
                left -= factor[i * n + k] * factor[j * n + k];
            }
            factor[i * n + j] = left;
        }
        const double left  = factor[j * n + j];
        const double scale = left > NO_VARIANCE * cov[j * n + j] ? 1.0 / sqrt(left) : 0.0;
        for (int i = j; i < n; i++) {
            factor[i * n + j] *= scale;
        }
    }
}

int engine_noise_gather(
    int n, double period_s, const double* a, const double* q, double* phi, double* cov, double* factor) {
    double       step_s    = period_s;
    int          doublings = 0;
    bool         finite    = true;
    const double rate      = matrix_norm(n, n, a);
    while (rate * step_s > NOISE_NORM && doublings < MAX_DOUBLINGS) {
        step_s *= 0.5;
        doublings++;
    }
    gather_one_step(n, step_s, a, q, phi, cov);
    while (doublings-- > 0) {
        double_step(n, phi, cov);
    }
    for (int i = 0; i < n; i++) {
        phi[i * n + i] += 1.0;
    }
    factorise(n, cov, factor);
    for (int i = 0; i < n * n; i++) {
        finite = finite && isfinite(phi[i]) && isfinite(cov[i]);
    }
    return finite ? 1 : 0;
}

/// Panels of [phi factor] over those of [reading 0]: the next x, padded to whole panels, and y over [x v].
static void pack(int n, int outputs, const engine_noise_t* noise, double* panels) {
    double both[ENGINE_MAX_OUTPUTS * 2 * ENGINE_MAX_NOISE_STATES];
    memset(both, 0, (size_t)outputs * 2 * (size_t)n * sizeof both[0]);
    for (int i = 0; i < outputs; i++) {
        memcpy(&both[i * 2 * n], &noise->reading[i * n], (size_t)n * sizeof both[0]);
    }
    panels_pack(outputs, 2 * n, 2 * n, both, &panels[PANEL_ELEMENTS(n, 2 * n)]);
    for (int i = 0; i < n; i++) {
        memcpy(&both[i * 2 * n], &noise->phi[i * n], (size_t)n * sizeof both[0]);
        memcpy(&both[i * 2 * n + n], &noise->factor[i * n], (size_t)n * sizeof both[0]);
    }
    panels_pack(n, 2 * n, 2 * n, both, panels);
}

void engine_noise_add(int                   n,
                      int                   outputs,
                      int64_t               stretches,
                      const engine_noise_t* noise,
                      const double*         sign,
                      const double*         normal,
                      double*               x,
                      double*               volts) {
    const kernels_t* const kernels = kernels_find();
    const int              rows    = PADDED(n) + outputs;
    double panels[PANEL_ELEMENTS(ENGINE_MAX_NOISE_STATES + ENGINE_MAX_OUTPUTS, 2 * ENGINE_MAX_NOISE_STATES)];
    double z[2 * ENGINE_MAX_NOISE_STATES], next[PADDED(ENGINE_MAX_NOISE_STATES) + PADDED(ENGINE_MAX_OUTPUTS)];
    memcpy(z, x, (size_t)n * sizeof z[0]);
    for (int64_t stretch = 0; stretch < stretches; stretch++, noise++) {
        pack(n, outputs, noise, panels);
        for (int64_t sample = 0; sample < noise->samples; sample++, normal += n, volts += outputs) {
            memcpy(&z[n], normal, (size_t)n * sizeof z[0]);
            kernels->multiply(rows, 2 * n, panels, z, next);
            memcpy(z, next, (size_t)n * sizeof z[0]);
            for (int i = 0; i < outputs; i++) {
                volts[i] += sign[i] * next[PADDED(n) + i];
            }
        }
    }
    memcpy(x, z, (size_t)n * sizeof z[0]);
}
