/// Ladders: F = exp([A B c] 2^level ticks) - I for every level. As differences from I, slow states lose no digits.

#include "engine_state.h"

#include <string.h>

/// Taylor series of the exponential: 10 terms of |A t| <= 1/16 leave 1e-21.
#define TAYLOR_TERMS 10
#define TAYLOR_NORM 0.0625
#define MAX_HALVINGS 40
#define SERIES_END 1e-24

/// out = left[:, :n] right, with left and right n x stride: the product of two affine maps without their
/// constant rows.
static void compose(int n, int stride, const double* left, const double* right, double* out) {
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < stride; j += PANEL) {
            double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
            for (int k = 0; k < n; k++) {
                const double  factor  = left[i * stride + k];
                const double* element = &right[k * stride + j];
                s0 += factor * element[0];
                s1 += factor * element[1];
                s2 += factor * element[2];
                s3 += factor * element[3];
            }
            out[i * stride + j]     = s0;
            out[i * stride + j + 1] = s1;
            out[i * stride + j + 2] = s2;
            out[i * stride + j + 3] = s3;
        }
    }
}

/// f = exp(2 t) - I from f = exp(t) - I, as 2 f + f f.
static void square(int n, int stride, double* f) {
    double ff[MAX_ELEMENTS];
    compose(n, stride, f, f, ff);
    for (int i = 0; i < n * stride; i++) {
        f[i] = 2.0 * f[i] + ff[i];
    }
}

/// f = exp(a) - I by its Taylor series. `rate` is the norm of a, at most TAYLOR_NORM.
static void taylor(int n, int stride, double rate, const double* a, double* f) {
    double term[MAX_ELEMENTS];
    double next[MAX_ELEMENTS];
    memcpy(term, a, (size_t)(n * stride) * sizeof term[0]);
    memcpy(f, a, (size_t)(n * stride) * sizeof f[0]);
    double size = 1.0;
    for (int k = 2; k <= TAYLOR_TERMS && size > SERIES_END; k++) {
        size *= rate / (double)k;
        compose(n, stride, a, term, next);
        for (int i = 0; i < n * stride; i++) {
            term[i] = next[i] / (double)k;
            f[i] += term[i];
        }
    }
}

engine_status_t ladder_build(const engine_t* const self, double* a, double* ladder) {
    const int n = self->states, columns = self->columns, stride = PADDED(columns);
    double    f[MAX_ELEMENTS];
    double    step_s   = self->tick_s;
    int       halvings = 0;

    const double rate = matrix_norm(n, stride, a);
    while (!(rate * step_s <= TAYLOR_NORM)) {
        if (++halvings > MAX_HALVINGS) {
            return ENGINE_TOO_STIFF;
        }
        step_s *= 0.5;
    }
    for (int i = 0; i < n * stride; i++) {
        a[i] *= step_s;
    }
    taylor(n, stride, rate * step_s, a, f);
    while (halvings-- > 0) {
        square(n, stride, f);
    }
    for (int level = 0; level < ENGINE_LEVELS; level++) {
        panels_pack(n, columns, stride, f, &ladder[level * PANEL_ELEMENTS(n, columns)]);
        square(n, stride, f);
    }
    return ENGINE_OK;
}
