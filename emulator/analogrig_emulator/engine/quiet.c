/// Quiet stretches. One sample period after the last event the fast states are functions of the slow ones. Where a
/// Lyapunov function proves that no kink is reached before the next edge, the slow states alone are stepped.

#include "engine_state.h"

#include <stdlib.h>
#include <string.h>

/// Share of a state that survives one sample period and still counts, relative to the largest. It is above the rounding
/// errors of the ladder, and stands for 1e-12 V of 10 V.
#define FORGOTTEN 1e-13

/// Doublings of the series that solves a Lyapunov equation: enough for rates that differ by a factor of 2^50.
#define LYAPUNOV_DOUBLINGS 60
#define LYAPUNOV_END 1e-12

/// Part of the gap to a bound that is used, to allow for rounding.
#define CERTAINTY (1.0 - 1e-9)

#define LEAP_DOUBLINGS 2

// ---------------------------------------------      SLOW STATES       ---------------------------------------------

/// Find the rows of e = exp(A h) on which all others depend, by elimination with total pivoting. Rows of slow states are
/// preferred, so that nothing cancels in their changes. Returns their number; column[i] holds the pivot of row[i].
static int independent_rows(int n, const double* e, const double* slowness, int* row, int* column) {
    double left[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double largest = 0.0;
    memcpy(left, e, (size_t)(n * n) * sizeof left[0]);
    for (int i = 0; i < n * n; i++) {
        largest = fabs(e[i]) > largest ? fabs(e[i]) : largest;
    }
    for (int rank = 0; rank < n; rank++) {
        double best = 0.0;
        for (int i = 0; i < n; i++) {
            for (int j = 0; j < n; j++) {
                const double size = fabs(left[i * n + j]);
                if (size > FORGOTTEN * largest && size * slowness[i] > best) {
                    best         = size * slowness[i];
                    row[rank]    = i;
                    column[rank] = j;
                }
            }
        }
        if (!(best > 0.0)) {
            return rank;
        }
        for (int i = 0; i < n; i++) {
            const double factor = left[i * n + column[rank]] / left[row[rank] * n + column[rank]];
            for (int j = 0; j < n && i != row[rank]; j++) {
                left[i * n + j] -= factor * left[row[rank] * n + j];
            }
        }
        for (int j = 0; j < n; j++) {
            left[row[rank] * n + j] = 0.0;
        }
        for (int i = 0; i < n; i++) {
            left[i * n + column[rank]] = 0.0;
        }
    }
    return n;
}

/// out = matrix (rows over z) applied to x = map [s u 1]; row-major, over [s u 1].
static void restrict_to_slow(
    const engine_t* const self, int rank, int rows, const double* matrix, int stride, const double* map, double* out) {
    const int n = self->states, constants = self->columns - n, width = rank + constants;
    for (int i = 0; i < rows; i++) {
        for (int j = 0; j < width; j++) {
            double sum = j < rank ? 0.0 : matrix[i * stride + n + j - rank];
            for (int k = 0; k < n; k++) {
                sum += matrix[i * stride + k] * map[k * width + j];
            }
            out[i * width + j] = sum;
        }
    }
}

/// restrict_to_slow() for the rows of the slow states.
static void restrict_slow_rows(
    const engine_t* const self, const slow_t* slow, const double* matrix, int stride, const double* map, double* out) {
    const int width = slow->rank + self->columns - self->states;
    for (int i = 0; i < slow->rank; i++) {
        restrict_to_slow(self, slow->rank, 1, &matrix[slow->row[i] * stride], stride, map, &out[i * width]);
    }
}

/// x over [s u 1], row-major: x = U s + (b - U b_s) [u 1], with e = U e_s and x(h) = e x(0) + b [u 1]. Returns false if
/// the slow rows are dependent.
static bool build_slow_map(const engine_t* const self, slow_t* slow, const double* f, double* map) {
    const int n = self->states, columns = self->columns, constants = columns - n;
    double    e[ENGINE_MAX_STATES * ENGINE_MAX_STATES], slowness[ENGINE_MAX_STATES];
    double    a[ENGINE_MAX_STATES * ENGINE_MAX_STATES], u[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    int       column[ENGINE_MAX_STATES];
    for (int i = 0; i < n; i++) {
        double sum = 1e-6;
        for (int j = 0; j < n; j++) {
            e[i * n + j] = f[i * columns + j] + (i == j ? 1.0 : 0.0);
            sum += fabs(f[i * columns + j]);
        }
        slowness[i] = 1.0 / sum;
    }
    const int rank = slow->rank = independent_rows(n, e, slowness, slow->row, column);
    for (int i = 0; i < rank; i++) {
        for (int j = 0; j < rank; j++) {
            a[i * rank + j] = e[slow->row[j] * n + column[i]];
        }
        for (int j = 0; j < n; j++) {
            u[i * n + j] = e[j * n + column[i]];
        }
    }
    if (engine_solve(rank, n, a, u) >= 0) {
        return false;
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < rank; j++) {
            map[i * (rank + constants) + j] = u[j * n + i];
        }
        for (int j = 0; j < constants; j++) {
            double sum = f[i * columns + n + j];
            for (int k = 0; k < rank; k++) {
                sum -= u[k * n + i] * f[slow->row[k] * columns + n + j];
            }
            map[i * (rank + constants) + rank + j] = sum;
        }
    }
    return true;
}

// ---------------------------------------------    LYAPUNOV FUNCTION   ---------------------------------------------

/// q = sum over k of (e')^k r e^k, by doubling. Overwrites e. Returns false if the series does not converge.
static bool sum_series(int n, double* e, const double* r, double* q) {
    double qe[ENGINE_MAX_STATES * ENGINE_MAX_STATES], eqe[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    memcpy(q, r, (size_t)(n * n) * sizeof q[0]);
    for (int k = 0; k < LYAPUNOV_DOUBLINGS; k++) {
        if (matrix_norm(n, n, e) < LYAPUNOV_END) {
            return true;
        }
        matrix_multiply(n, q, e, false, qe);
        matrix_multiply(n, e, qe, true, eqe);
        for (int i = 0; i < n * n; i++) {
            q[i] += eqe[i];
        }
        matrix_multiply(n, e, e, false, eqe);
        memcpy(e, eqe, (size_t)(n * n) * sizeof e[0]);
    }
    return false;
}

/// Solve a'q + q a = -p I with p the norm of a: e'q e then never grows along de/dt = a e. By Cayley's transform,
/// q = sum (E')^k r E^k with E = (p - a)^-1 (p + a) and r = 2 p^2 (p - a)^-T (p - a)^-1 (Smith 1968). Returns false if
/// the residual a'q + q a + p I is not small against p I.
static bool solve_lyapunov(int n, const double* a, double* q) {
    const double p = matrix_norm(n, n, a);
    double       left[ENGINE_MAX_STATES * ENGINE_MAX_STATES], right[2 * ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double       e[ENGINE_MAX_STATES * ENGINE_MAX_STATES], inverse[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double       r[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            const double one         = i == j ? 1.0 : 0.0;
            left[i * n + j]          = p * one - a[i * n + j];
            right[i * 2 * n + j]     = p * one + a[i * n + j];
            right[i * 2 * n + n + j] = one;
        }
    }
    if (engine_solve(n, 2 * n, left, right) >= 0) {
        return n == 0;
    }
    for (int i = 0; i < n; i++) {
        memcpy(&e[i * n], &right[i * 2 * n], (size_t)n * sizeof e[0]);
        memcpy(&inverse[i * n], &right[i * 2 * n + n], (size_t)n * sizeof e[0]);
    }
    matrix_multiply(n, inverse, inverse, true, r);
    for (int i = 0; i < n * n; i++) {
        r[i] *= 2.0 * p * p;
    }
    if (!sum_series(n, e, r, q)) {
        return false;
    }
    matrix_multiply(n, q, a, false, left);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            r[i * n + j] = left[i * n + j] + left[j * n + i] + (i == j ? p : 0.0);
        }
    }
    return matrix_norm(n, n, r) <= 0.5 * p;
}

/// s at rest over [u 1], from its change over [s u 1]. Returns false if s does not come to rest.
static bool find_rest(int rank, int constants, const double* change, double* rest) {
    double a[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    for (int i = 0; i < rank; i++) {
        for (int j = 0; j < rank; j++) {
            a[i * rank + j] = change[i * (rank + constants) + j];
        }
        for (int j = 0; j < constants; j++) {
            rest[i * constants + j] = -change[i * (rank + constants) + rank + j];
        }
    }
    return engine_solve(rank, constants, a, rest) < 0;
}

/// Bound the distance of each w from rest. w - rest_w = c e, so its square is at most (c Q^-1 c') e'Q e. Returns false if Q
/// is singular.
static bool find_reach(int rank, int width, int kinks, const double* w, const double* energy, double* reach) {
    double a[ENGINE_MAX_STATES * ENGINE_MAX_STATES], x[ENGINE_MAX_STATES * ENGINE_MAX_KINKS];
    memcpy(a, energy, (size_t)(rank * rank) * sizeof a[0]);
    for (int i = 0; i < rank; i++) {
        for (int k = 0; k < kinks; k++) {
            x[i * kinks + k] = w[k * width + i];
        }
    }
    if (engine_solve(rank, kinks, a, x) >= 0) {
        return false;
    }
    for (int k = 0; k < kinks; k++) {
        reach[k] = 0.0;
        for (int i = 0; i < rank; i++) {
            reach[k] += w[k * width + i] * x[i * kinks + k];
        }
    }
    return true;
}

/// Compute rest, energy and reach of the slow states. Return false if s does not provably come to rest.
static bool
certify_slow(const engine_t* const self, slow_t* slow, const double* map, const double* w, const double* change) {
    const int rank = slow->rank, constants = self->columns - self->states, width = rank + constants;
    double    a[MAX_ELEMENTS], flow[ENGINE_MAX_STATES * MAX_COLUMNS], rate[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double    rest[ENGINE_MAX_STATES * (ENGINE_MAX_INPUTS + 1)], rest_w[ENGINE_MAX_KINKS * (ENGINE_MAX_INPUTS + 1)];
    kinks_build_map(self, self->mode->piece, a);
    restrict_slow_rows(self, slow, a, PADDED(self->columns), map, flow);
    for (int i = 0; i < rank; i++) {
        memcpy(&rate[i * rank], &flow[i * width], (size_t)rank * sizeof rate[0]);
    }
    if (!find_rest(rank, constants, change, rest) || !solve_lyapunov(rank, rate, slow->energy) ||
        !find_reach(rank, width, self->kinks, w, slow->energy, slow->reach)) {
        return false;
    }
    for (int k = 0; k < self->kinks; k++) {
        for (int j = 0; j < constants; j++) {
            rest_w[k * constants + j] = w[k * width + rank + j];
            for (int i = 0; i < rank; i++) {
                rest_w[k * constants + j] += w[k * width + i] * rest[i * constants + j];
            }
        }
    }
    panels_pack(rank, constants, constants, rest, slow->rest);
    panels_pack(self->kinks, constants, constants, rest_w, slow->rest_w);
    return true;
}

// ---------------------------------------------      CONSTRUCTION      ---------------------------------------------

/// later = row (I + change): rows over [s u 1], one sample period later.
static void advance_rows(int rank, int width, int rows, const double* change, const double* row, double* later) {
    for (int i = 0; i < rows; i++) {
        for (int j = 0; j < width; j++) {
            double sum = row[i * width + j];
            for (int k = 0; k < rank; k++) {
                sum += row[i * width + k] * change[k * width + j];
            }
            later[i * width + j] = sum;
        }
    }
}

/// Build the slow part of the present mode.
static void build_slow(const engine_t* const self, slow_t* slow) {
    const int n = self->states, q = self->kinks, p = self->outputs, columns = self->columns;
    double    f[ENGINE_MAX_STATES * MAX_COLUMNS], map[ENGINE_MAX_STATES * MAX_COLUMNS];
    double    change[ENGINE_MAX_STATES * MAX_COLUMNS];
    double    rows[ENGINE_MAX_OUTPUTS * MAX_COLUMNS], y[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    double    later[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    double    w[ENGINE_MAX_KINKS * MAX_COLUMNS];
    panels_unpack(n, columns, &self->mode->ladder[TOP_LEVEL * PANEL_ELEMENTS(n, columns)], f);
    slow->certain = false;
    if (!build_slow_map(self, slow, f, map)) {
        return;
    }
    const int rank = slow->rank, width = rank + columns - n;
    restrict_slow_rows(self, slow, f, columns, map, change);
    panels_pack(rank, width, width, change, slow->change);
    panels_pack(n, width, width, map, slow->state);
    panels_unpack(p, columns, self->y_panels, rows);
    restrict_to_slow(self, rank, p, rows, columns, map, y);
    for (int i = 0; i < LEAP; i++) {
        advance_rows(rank, width, p, change, y, later);
        panels_pack(p, width, width, later, &slow->y[i * PANEL_ELEMENTS(p, width)]);
        memcpy(y, later, (size_t)(p * width) * sizeof y[0]);
    }
    panels_unpack(q, columns, self->w_panels, rows);
    restrict_to_slow(self, rank, q, rows, columns, map, w);
    slow->certain = certify_slow(self, slow, map, w, change);
    for (int i = 0; i < LEAP_DOUBLINGS; i++) {
        memcpy(later, change, (size_t)(rank * width) * sizeof later[0]);
        advance_rows(rank, width, rank, later, later, change);
        for (int k = 0; k < rank * width; k++) {
            change[k] += later[k];
        }
    }
    panels_pack(rank, width, width, change, slow->leap);
}

/// The slow part of the present mode, built on first use. NULL if it is not certain or memory is short: the engine then
/// steps all states.
static const slow_t* find_slow(engine_t* const self) {
    mode_t* mode = self->mode;
    if (!mode->has_slow) {
        if (mode->slow == NULL) {
            mode->slow = malloc(sizeof *mode->slow);
        }
        if (mode->slow == NULL) {
            return NULL;
        }
        build_slow(self, mode->slow);
        mode->has_slow = true;
    }
    return mode->slow->certain ? mode->slow : NULL;
}

// ---------------------------------------------       STRETCHES        ---------------------------------------------

/// The energy below which no w can reach a bound; negative if some w is beyond a bound at rest.
static double find_limit(const engine_t* const self, const slow_t* slow) {
    double rest_w[PADDED(ENGINE_MAX_KINKS)];
    double limit = (double)INFINITY;
    panels_multiply(self->kinks, self->columns - self->states, slow->rest_w, &self->here->z[self->states], rest_w);
    for (int k = 0; k < self->kinks; k++) {
        const double above = self->upper[k] - rest_w[k], below = rest_w[k] - self->lower[k];
        const double gap = CERTAINTY * (above < below ? above : below);
        if (!(gap > 0.0)) {
            return -1.0;
        }
        if (gap * gap < limit * slow->reach[k]) {
            limit = gap * gap / slow->reach[k];
        }
    }
    return limit;
}

/// e'Q e at the present state.
static double compute_energy(const engine_t* const self, const slow_t* slow) {
    double e[PADDED(ENGINE_MAX_STATES)];
    double sum = 0.0;
    panels_multiply(slow->rank, self->columns - self->states, slow->rest, &self->here->z[self->states], e);
    for (int i = 0; i < slow->rank; i++) {
        e[i] = self->here->z[slow->row[i]] - e[i];
    }
    for (int i = 0; i < slow->rank; i++) {
        for (int j = 0; j < slow->rank; j++) {
            sum += e[i] * slow->energy[i * slow->rank + j] * e[j];
        }
    }
    return sum;
}

static void advance_slow(const slow_t* slow, int width, const double* change, double* z) {
    double padded[PADDED(ENGINE_MAX_STATES)];
    panels_multiply(slow->rank, width, change, z, padded);
    for (int i = 0; i < slow->rank; i++) {
        z[i] += padded[i];
    }
}

bool quiet_holds(engine_t* const self) {
    if (self->quiet) {
        return true;
    }
    if (self->elapsed < ENGINE_TICKS_PER_SAMPLE || self->now % ENGINE_TICKS_PER_SAMPLE != 0) {
        return false;
    }
    const slow_t* slow = find_slow(self);
    if (slow == NULL) {
        return false;
    }
    if (!self->has_limit) {
        self->energy_limit = find_limit(self, slow);
        self->has_limit    = true;
    }
    if (!(compute_energy(self, slow) < self->energy_limit)) {
        return false;
    }
    for (int i = 0; i < slow->rank; i++) {
        self->slow_z[i] = self->here->z[slow->row[i]];
    }
    const int constants = self->columns - self->states;
    memcpy(&self->slow_z[slow->rank], &self->here->z[self->states], (size_t)constants * sizeof(double));
    self->slow_age = 0;
    self->quiet    = true;
    return true;
}

void quiet_step(engine_t* const self) {
    const slow_t* slow = self->mode->slow;
    if (self->slow_age == LEAP) {
        advance_slow(slow, slow->rank + self->columns - self->states, slow->leap, self->slow_z);
        self->slow_age = 0;
    }
    self->slow_age++;
    self->now += ENGINE_TICKS_PER_SAMPLE;
    self->counts.quiet++;
}

void quiet_leap(engine_t* const self, double* y) {
    const slow_t* slow  = self->mode->slow;
    const int     width = slow->rank + self->columns - self->states;
    advance_slow(slow, width, slow->leap, self->slow_z);
    panels_multiply(LEAP * self->outputs, width, slow->y, self->slow_z, y);
    self->now += LEAP * ENGINE_TICKS_PER_SAMPLE;
    self->counts.quiet += LEAP;
}

void quiet_read(const engine_t* const self, double* y) {
    const slow_t* slow  = self->mode->slow;
    const int     width = slow->rank + self->columns - self->states;
    const int     start = (self->slow_age - 1) * PANEL_ELEMENTS(self->outputs, width);
    panels_multiply(self->outputs, width, &slow->y[start], self->slow_z, y);
}

void quiet_get_state(const engine_t* const self, double* x) {
    double        padded[PADDED(ENGINE_MAX_STATES)], z[MAX_COLUMNS];
    const slow_t* slow  = self->mode->slow;
    const int     width = slow->rank + self->columns - self->states;
    memcpy(z, self->slow_z, sizeof z);
    for (int i = 0; i < self->slow_age; i++) {
        advance_slow(slow, width, slow->change, z);
    }
    panels_multiply(self->states, width, slow->state, z, padded);
    memcpy(x, padded, (size_t)self->states * sizeof x[0]);
}

void quiet_leave(engine_t* const self) {
    if (self->quiet) {
        quiet_get_state(self, self->here->z);
        measure_kinks(self, self->here);
        self->level_before = NO_LEVEL;
        self->quiet        = false;
    }
}
