/// Matrices of a mode. Ladder: F = exp([A B c] 2^level ticks) - I; as differences from I, slow states lose no digits. Looks:
/// the arguments of the kinks that many ticks later. Terms: the Taylor series over the shortest of these steps.

#include "engine_state.h"

#include <string.h>

#define MAX_HALVINGS 40

/// The longest of the shortest steps: its middle is looked at as well.
#define MAX_BASE (NEAR_LEVEL - 1)

/// f = exp(2 t) - I from f = exp(t) - I, as 2 f + f f.
static void square(const engine_t* const self, double* f) {
    const int n = self->states, stride = PADDED(self->columns);
    double    ff[MAX_ELEMENTS];
    self->kernels->compose(n, n, stride, f, f, ff);
    self->kernels->add(n * stride, 2.0, ff, 1.0, f);
}

engine_status_t ladder_plan(const engine_t* const self, const double* a, int* base, bool* stiff) {
    const double rate = matrix_norm(self->states, PADDED(self->columns), a) * self->tick_s;
    *base             = 0;
    *stiff            = !(rate <= TAYLOR_NORM);
    while (*base < MAX_BASE && rate * (double)(INT64_C(2) << *base) <= TAYLOR_NORM) {
        ++*base;
    }
    return rate <= TAYLOR_NORM * (double)(INT64_C(1) << MAX_HALVINGS) ? ENGINE_OK : ENGINE_TOO_STIFF;
}

/// f = exp(a) - I, with the terms of its series.
static void sum_terms(const engine_t* const self, const double* a, double* terms, double* f) {
    const int n = self->states, columns = self->columns, stride = PADDED(columns);
    double    term[MAX_ELEMENTS], next[MAX_ELEMENTS];
    memcpy(term, a, (size_t)(n * stride) * sizeof term[0]);
    memcpy(f, a, (size_t)(n * stride) * sizeof f[0]);
    series_pack(n, columns, stride, term, 0, TERMS, terms);
    for (int k = 2; k <= TERMS; k++) {
        self->kernels->compose(n, n, stride, a, term, next);
        self->kernels->add(n * stride, 0.0, next, 1.0 / (double)k, term);
        self->kernels->add(n * stride, 1.0, term, 1.0, f);
        series_pack(n, columns, stride, term, k - 1, TERMS, terms);
    }
}

/// Store the matrix of the highest level in the ladder, and its look.
static void store_level(engine_t* const self) {
    const mode_t* mode = self->mode;
    const int     n = self->states, q = self->kinks, columns = self->columns, stride = PADDED(columns);
    const int     rung = mode->top - mode->base;
    double        w[ENGINE_MAX_KINKS * MAX_STRIDE], later[ENGINE_MAX_KINKS * MAX_STRIDE];
    memset(w, 0, (size_t)(q * stride) * sizeof w[0]);
    panels_pack(n, columns, stride, mode->change, &mode->ladder[rung * PANEL_ELEMENTS(n, columns)]);
    panels_unpack(q, columns, stride, self->w_panels, w);
    self->kernels->compose(q, n, stride, w, mode->change, later);
    self->kernels->add(q * stride, 1.0, w, 1.0, later);
    panels_pack(q, columns, stride, later, &mode->looks[rung * PANEL_ELEMENTS(q, columns)]);
}

/// Scale a to the shortest step of the present mode, or a part of it. Return the number of its halvings.
static int scale(const engine_t* const self, double* a) {
    const int    n = self->states, stride = PADDED(self->columns);
    const double step_s   = self->tick_s * (double)(INT64_C(1) << self->mode->base);
    double       part     = 1.0;
    int          halvings = 0;
    while (self->mode->stiff && matrix_norm(n, stride, a) * step_s * part > TAYLOR_NORM) {
        part *= 0.5;
        halvings++;
    }
    for (int i = 0; i < n * stride; i++) {
        a[i] *= step_s * part;
    }
    return halvings;
}

void ladder_build(engine_t* const self, double* a) {
    mode_t* const mode     = self->mode;
    int           halvings = scale(self, a);
    sum_terms(self, a, mode->terms, mode->change);
    while (halvings-- > 0) {
        square(self, mode->change);
    }
    mode->top = mode->base;
    store_level(self);
}

void ladder_reach(engine_t* const self, int level) {
    while (self->mode->top < level) {
        square(self, self->mode->change);
        self->mode->top++;
        store_level(self);
    }
}

void ladder_expand(const engine_t* const self, const double* z, double* terms) {
    self->kernels->multiply(TERMS * PADDED(self->states), self->columns, self->mode->terms, z, terms);
}

void ladder_sum(const engine_t* const self, const double* terms, int64_t ticks, double* z) {
    series_sum(self->kernels, self->states, TERMS, terms, (double)ticks / (double)(INT64_C(1) << self->mode->base), z);
}

void ladder_move(engine_t* const self, int64_t ticks, double* z) {
    const int     base = self->mode->base, elements = PANEL_ELEMENTS(self->states, self->columns);
    const int64_t rest = ticks & ((INT64_C(1) << base) - 1);
    for (int level = base; ticks >> level != 0; level++) {
        if ((ticks >> level & 1) != 0) {
            ladder_reach(self, level);
            self->kernels->advance(self->states, self->columns, &self->mode->ladder[(level - base) * elements], z);
            self->counts.steps++;
        }
    }
    if (rest != 0) {
        double terms[TERMS * PADDED(ENGINE_MAX_STATES)];
        ladder_expand(self, z, terms);
        ladder_sum(self, terms, rest, z);
        self->counts.steps++;
    }
}
