/// Other constants of a circuit, as by the offsets of amplifiers: its modes keep all matrices but their last columns.

#include "../engine_state.h"

#include <string.h>

/// True if two matrices agree in all columns but the last.
static bool is_equal_but_last(int rows, int columns, const double* one, const double* other) {
    bool equal = true;
    for (int i = 0; i < rows && equal; i++) {
        equal = is_equal((size_t)columns - 1U, sizeof(double), &one[i * columns], &other[i * columns]);
    }
    return equal;
}

/// True if a circuit differs from the one kept in its constants alone, as by the offsets of amplifiers.
static bool is_variant(const engine_t* const self, const circuit_t* circuit, const engine_system_t* system) {
    const sizes_t sizes = sizes_of(self);
    return circuit->is_set && self->products == 0 &&
           is_equal_but_last(self->states, self->columns, circuit->abc, system->abc) &&
           is_equal(sizes.g, sizeof(double), circuit->g, system->g) &&
           is_equal_but_last(self->kinks, self->columns, circuit->cde, system->cde) &&
           is_equal(sizes.w_phi, sizeof(double), circuit->w_phi, system->w_phi) &&
           is_equal_but_last(self->outputs, self->columns, circuit->lmn, system->lmn) &&
           is_equal(sizes.y_phi, sizeof(double), circuit->y_phi, system->y_phi) &&
           is_equal(sizes.kinks, sizeof(engine_kink_t), circuit->kink, system->kinks);
}

/// Give the constants of a variant to a circuit.
static void retune(const engine_t* const self, const engine_system_t* system, circuit_t* circuit) {
    const sizes_t sizes = sizes_of(self);
    copy(sizes.abc, sizeof(double), system->abc, circuit->abc);
    copy(sizes.cde, sizeof(double), system->cde, circuit->cde);
    copy(sizes.lmn, sizeof(double), system->lmn, circuit->lmn);
    circuit_pack(self, circuit);
    circuit->tuning++;
}

circuit_t* fast_retune_circuit(const engine_t* const self, const engine_system_t* system) {
    for (int place = 0; place < CIRCUITS && self->circuits[place] != NULL; place++) {
        if (is_variant(self, self->circuits[place], system)) {
            retune(self, system, self->circuits[place]);
            return self->circuits[place];
        }
    }
    return NULL;
}

/// Store the last column of a panelled matrix.
static void set_last(int rows, int columns, const double* column, double* panels) {
    for (int i = 0; i < rows; i++) {
        panels[((i / PANEL) * columns + columns - 1) * PANEL + i % PANEL] = column[i];
    }
}

/// Store a level's last column, which is followed by zeros in the place of inputs and 1.
static void store_last(engine_t* const self, int rung, const double* column) {
    const int n = self->states, q = self->kinks, columns = self->columns;
    double    look[PADDED(ENGINE_MAX_KINKS)];
    set_last(n, columns, column, &self->mode->ladder[rung * PANEL_ELEMENTS(n, columns)]);
    self->kernels->multiply(q, columns, self->w_panels, column, look);
    for (int i = 0; i < q; i++) {
        look[i] += self->w_panels[((i / PANEL) * columns + columns - 1) * PANEL + i % PANEL];
    }
    set_last(q, columns, look, &self->mode->looks[rung * PANEL_ELEMENTS(q, columns)]);
}

/// The last column of the terms and levels anew, with the bits of ladder_build() and ladder_reach(). The mode is not stiff.
static void retune_ladder(engine_t* const self, const double* a) {
    const mode_t* mode = self->mode;
    const int     n = self->states, columns = self->columns, stride = PADDED(columns), last = columns - 1;
    double        f[MAX_COLUMNS] = { 0.0 }, term[ENGINE_MAX_STATES], next[PADDED(ENGINE_MAX_STATES)];
    const double  step_s         = self->tick_s * (double)(INT64_C(1) << mode->base);
    for (int k = 1; k <= TERMS; k++) {
        for (int i = 0; i < n && k > 1; i += PANEL) {  // the first term is a, but for its last column
            self->kernels->multiply(PANEL, n, &mode->terms[i * TERMS * columns], term, &next[i]);
        }
        for (int i = 0; i < n; i++) {
            term[i] = k == 1 ? step_s * a[i * stride + last] : 1.0 / (double)k * next[i];
            f[i]    = k == 1 ? term[i] : f[i] + term[i];
            mode->terms[((i / PANEL * TERMS + k - 1) * columns + last) * PANEL + i % PANEL] = term[i];
        }
    }
    store_last(self, 0, f);
    for (int rung = 0; rung < mode->top - mode->base; rung++) {
        self->kernels->multiply(n, columns, &mode->ladder[rung * PANEL_ELEMENTS(n, columns)], f, next);
        for (int i = 0; i < n; i++) {
            f[i] = 2.0 * f[i] + next[i];
        }
        store_last(self, rung + 1, f);
    }
    for (int i = 0; i < n; i++) {
        mode->change[i * stride + last] = f[i];
    }
}

void fast_retune_mode(engine_t* const self) {
    mode_t* const mode = self->mode;
    double        a[MAX_ELEMENTS];
    kinks_build_map(self, mode->piece, a);
    if (self->circuit->feeds) {
        kinks_build_readings(self, mode->piece, mode->readings);
    }
    mode_point_readings(self);
    if (mode->stiff) {
        ladder_build(self, a);
    } else {
        retune_ladder(self, a);
    }
    mode->has_slow = false;
    mode->tuning   = self->circuit->tuning;
}
