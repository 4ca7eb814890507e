#include "engine_state.h"

#include <string.h>

/// Combinations of pieces that kinks_are_unique() checks. Of more, mode_enter() checks those that occur.
#define MAX_COMBINATIONS 4096

/// Pieces that the walk of solve_coupled() may cross.
#define MAX_CROSSINGS (16 * ENGINE_MAX_KINKS)

// ---------------------------------------------      SUBSTITUTION      ---------------------------------------------

/// a = I - P diag(slopes) in the given pieces, restricted to the kinks listed.
static void
build_feedback(const engine_t* const self, const unsigned char* piece, int count, const int* listed, double* a) {
    for (int i = 0; i < count; i++) {
        for (int j = 0; j < count; j++) {
            const int    k = listed[j];
            const double fed =
                self->circuit->w_phi[listed[i] * self->kinks + k] * self->circuit->kink[k].slope[piece[k]];
            a[i * count + j] = (i == j ? 1.0 : 0.0) - fed;
        }
    }
}

/// Add phi_gain phi(w) to the rows of an affine function of z. w is affine too, in the given pieces.
static void add_phi(const engine_t*      self,
                    const unsigned char* piece,
                    const double*        w,
                    int                  rows,
                    const double*        phi_gain,
                    int                  stride,
                    double*              a) {
    const int columns = self->columns;
    for (int k = 0; k < self->kinks; k++) {
        const double slope     = self->circuit->kink[k].slope[piece[k]];
        const double intercept = self->circuit->kink[k].intercept[piece[k]];
        for (int i = 0; i < rows; i++) {
            const double gain = phi_gain[i * self->kinks + k];
            for (int j = 0; j < columns && fabs(gain) > 0.0; j++) {
                a[i * stride + j] += gain * (slope * w[k * columns + j]);
            }
            a[i * stride + columns - 1] += gain * intercept;
        }
    }
}

/// w over z in the given pieces: the solution of w = [C D e] z + P phi(w).
static void substitute_kinks(const engine_t* const self, const unsigned char* piece, double* w) {
    const int q = self->kinks, columns = self->columns;
    int       all[ENGINE_MAX_KINKS];
    double    a[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    memcpy(w, self->circuit->cde, (size_t)(q * columns) * sizeof w[0]);
    if (self->circuit->coupled_count == 0) {
        return;
    }
    for (int k = 0; k < q; k++) {
        all[k] = k;
        for (int i = 0; i < q; i++) {
            w[i * columns + columns - 1] +=
                self->circuit->w_phi[i * q + k] * self->circuit->kink[k].intercept[piece[k]];
        }
    }
    build_feedback(self, piece, q, all, a);
    (void)engine_solve(q, columns, a, w);  // cannot fail after kinks_are_unique()
}

void kinks_build_map(const engine_t* const self, const unsigned char* piece, double* a) {
    const int n = self->states, columns = self->columns, stride = PADDED(columns);
    double    w[ENGINE_MAX_KINKS * MAX_COLUMNS];
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < stride; j++) {
            a[i * stride + j] = j < columns ? self->circuit->abc[i * columns + j] : 0.0;
        }
    }
    substitute_kinks(self, piece, w);
    add_phi(self, piece, w, n, self->circuit->g, stride, a);
}

void kinks_build_readings(const engine_t* const self, const unsigned char* piece, double* readings) {
    const int q = self->kinks, p = self->outputs, columns = self->columns;
    double    w[ENGINE_MAX_KINKS * MAX_COLUMNS];
    double    y[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    substitute_kinks(self, piece, w);
    memcpy(y, self->circuit->lmn, (size_t)(p * columns) * sizeof y[0]);
    add_phi(self, piece, w, p, self->circuit->y_phi, columns, y);
    panels_pack(q, columns, columns, w, readings);
    panels_pack(p, columns, columns, y, &readings[PANEL_ELEMENTS(q, columns)]);
}

// ---------------------------------------------       SOLUTION        ---------------------------------------------

/// The part of the way along which all coupled w stay in their pieces. ends_at: the index of the kink that ends it,
/// or -1.
static double
find_exit(const engine_t* const self, const unsigned char* piece, const double* w, const double* way, int* ends_at) {
    double part = 1.0;
    *ends_at    = -1;
    for (int i = 0; i < self->circuit->coupled_count; i++) {
        const int            k     = self->circuit->coupled[i];
        const engine_kink_t* kink  = &self->circuit->kink[k];
        const double         bound = way[i] > 0.0 ? kink_upper_bound(kink, piece[k]) : kink_lower_bound(kink, piece[k]);
        if (fabs(way[i]) > 0.0 && (bound - w[i]) / way[i] < part) {
            part     = (bound - w[i]) / way[i];
            *ends_at = i;
        }
    }
    return part;
}

/// Solve for the coupled w by Katzenelson's walk: from w = 0 straight to the wanted right-hand side, in every piece
/// along its linear map. The walk ends at the only solution if all these maps have determinants of one sign (Kojima
/// and Saigal 1979). wanted: the w without any phi. Sets pieces and w. Returns false if the walk does not end.
static bool solve_coupled(const engine_t* const self, const double* wanted, unsigned char* piece, double* w) {
    const int count = self->circuit->coupled_count;
    double    left[ENGINE_MAX_KINKS], way[ENGINE_MAX_KINKS], a[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    for (int i = 0; i < count; i++) {
        w[i]                             = 0.0;
        piece[self->circuit->coupled[i]] = kink_piece(&self->circuit->kink[self->circuit->coupled[i]], 0.0);
    }
    for (int i = 0; i < count; i++) {
        left[i] = wanted[self->circuit->coupled[i]];
        for (int j = 0; j < count; j++) {
            const int k = self->circuit->coupled[j];
            left[i] += self->circuit->w_phi[self->circuit->coupled[i] * self->kinks + k] *
                       self->circuit->kink[k].intercept[piece[k]];
        }
    }
    for (int crossings = 0; crossings <= MAX_CROSSINGS; crossings++) {
        int ends_at;
        memcpy(way, left, (size_t)count * sizeof way[0]);
        build_feedback(self, piece, count, self->circuit->coupled, a);
        if (engine_solve(count, 1, a, way) >= 0) {
            return false;
        }
        const double part = find_exit(self, piece, w, way, &ends_at);
        for (int i = 0; i < count; i++) {
            w[i] += part * way[i];
            left[i] *= 1.0 - part;
        }
        if (ends_at < 0) {
            return true;
        }
        const int k = self->circuit->coupled[ends_at];
        w[ends_at]  = way[ends_at] > 0.0 ? kink_upper_bound(&self->circuit->kink[k], piece[k])
                                         : kink_lower_bound(&self->circuit->kink[k], piece[k]);
        piece[k]    = (unsigned char)(way[ends_at] > 0.0 ? piece[k] + 1 : piece[k] - 1);
    }
    return false;
}

engine_status_t kinks_solve(engine_t* const self) {
    double* w = self->w;
    double  coupled_w[ENGINE_MAX_KINKS];
    self->kernels->multiply(self->kinks, self->columns, self->circuit->cde_panels, self->z, w);
    for (int k = 0; k < self->kinks; k++) {
        if (!isfinite(w[k])) {
            return ENGINE_NOT_FINITE;
        }
    }
    if (self->circuit->coupled_count == 0) {
        return ENGINE_OK;
    }
    if (!solve_coupled(self, w, self->piece, coupled_w)) {
        return ENGINE_NOT_UNIQUE;
    }
    for (int j = 0; j < self->circuit->coupled_count; j++) {
        const engine_kink_t* kink  = &self->circuit->kink[self->circuit->coupled[j]];
        const unsigned char  piece = self->piece[self->circuit->coupled[j]];
        const double         phi   = kink->slope[piece] * coupled_w[j] + kink->intercept[piece];
        for (int i = 0; i < self->kinks; i++) {
            w[i] += self->circuit->w_phi[i * self->kinks + self->circuit->coupled[j]] * phi;
        }
    }
    return ENGINE_OK;
}

// ---------------------------------------------       UNIQUENESS       ---------------------------------------------

static bool has_nonzero(int count, const double* values) {
    for (int i = 0; i < count; i++) {
        if (fabs(values[i]) > 0.0) {
            return true;
        }
    }
    return false;
}

void kinks_list_feeding(engine_t* const self) {
    const int q                  = self->kinks;
    self->circuit->coupled_count = 0;
    for (int k = 0; k < q; k++) {
        bool feeds = false;
        for (int i = 0; i < q; i++) {
            feeds = feeds || fabs(self->circuit->w_phi[i * q + k]) > 0.0;
        }
        if (feeds) {
            self->circuit->coupled[self->circuit->coupled_count++] = k;
        }
    }
    self->circuit->feeds = self->circuit->coupled_count > 0 || has_nonzero(self->outputs * q, self->circuit->y_phi);
}

static unsigned char lowest_piece(const engine_kink_t* kink) {
    return kink->lower > -(double)INFINITY ? PIECE_LOW : PIECE_MIDDLE;
}

/// Advance to the next combination of pieces. Return false after the last.
static bool next_combination(const engine_t* const self, unsigned char* piece) {
    for (int j = 0; j < self->circuit->coupled_count; j++) {
        const int k = self->circuit->coupled[j];
        if (piece[k] < PIECE_HIGH && isfinite(self->circuit->kink[k].upper)) {
            piece[k] = (unsigned char)(piece[k] + 1);
            return true;
        }
        piece[k] = lowest_piece(&self->circuit->kink[k]);
    }
    return false;
}

/// The solution is unique if the determinants of I - P phi' have the sign of the one whose slopes are all 0, in all
/// combinations of pieces.
bool kinks_are_unique(const engine_t* const self) {
    unsigned char piece[ENGINE_MAX_KINKS];
    double        a[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    for (int k = 0; k < self->kinks; k++) {
        piece[k] = lowest_piece(&self->circuit->kink[k]);
    }
    for (int i = 0; i < MAX_COMBINATIONS; i++) {
        build_feedback(self, piece, self->circuit->coupled_count, self->circuit->coupled, a);
        if (!matrix_is_positive(self->circuit->coupled_count, a)) {
            return false;
        }
        if (!next_combination(self, piece)) {
            break;
        }
    }
    return true;
}
