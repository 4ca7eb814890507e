/// Stretches of slow states. Soon after the last event the fast states are functions of the slow ones, and these alone are
/// stepped, from sample to sample. Where a Lyapunov function proves that no kink is reached before the next edge, the
/// stretch is quiet and nothing is judged any more.

#include "../engine_state.h"

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

/// Where every state still matters one sample period after an event, those that matter 2^LATER_DOUBLINGS periods after it are
/// stepped from then on.
#define LATER_DOUBLINGS 6

/// Size of the term after which the series of the slow states ends.
#define TAYLOR_END 1e-18

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

/// Fill the columns of [u 1] of build_slow_map().
static void map_constants(const engine_t* const self, const slow_t* slow, const double* f, double* map) {
    const int n = self->states, columns = self->columns, rank = slow->rank, width = rank + columns - n;
    for (int i = 0; i < n; i++) {
        for (int j = n; j < columns; j++) {
            double sum = f[i * columns + j];
            for (int k = 0; k < rank; k++) {
                sum -= map[i * width + k] * f[slow->row[k] * columns + j];
            }
            map[i * width + rank + j - n] = sum;
        }
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
    }
    map_constants(self, slow, f, map);
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

/// change = its double: of twice the time.
static void double_change(int rank, int width, double* change) {
    double later[ENGINE_MAX_STATES * MAX_COLUMNS];
    advance_rows(rank, width, rank, change, change, later);
    for (int i = 0; i < rank * width; i++) {
        change[i] += later[i];
    }
}

/// Find the longest step over which a series gives the slow states, and the number of its terms.
static void plan_slow_ladder(slow_t* slow, double rate) {
    double step = rate * (double)ENGINE_TICKS_PER_SAMPLE, term = 1.0;
    slow->base = TOP_LEVEL;
    while (slow->base > 0 && step > TAYLOR_NORM) {
        slow->base--;
        step *= 0.5;
    }
    slow->count = 0;
    while (slow->count < TERMS && (slow->count == 0 || term > TAYLOR_END)) {
        slow->count++;
        term *= step / (double)slow->count;
    }
}

/// Build the terms and the ladder of the slow states from their flow per second.
static void build_slow_ladder(const engine_t* const self, slow_t* slow, const double* flow) {
    const int rank = slow->rank, width = rank + self->columns - self->states, elements = PANEL_ELEMENTS(rank, width);
    double    change[ENGINE_MAX_STATES * MAX_COLUMNS], term[ENGINE_MAX_STATES * MAX_COLUMNS];
    double    next[ENGINE_MAX_STATES * MAX_COLUMNS];
    plan_slow_ladder(slow, matrix_norm(rank, width, flow) * self->tick_s);
    const double step_s = self->tick_s * (double)(INT64_C(1) << slow->base);
    for (int i = 0; i < rank * width; i++) {
        term[i] = change[i] = flow[i] * step_s;
    }
    series_pack(rank, width, width, term, 0, slow->count, slow->terms);
    for (int k = 2; k <= slow->count; k++) {
        for (int i = 0; i < rank; i++) {
            for (int j = 0; j < width; j++) {
                next[i * width + j] = 0.0;
                for (int l = 0; l < rank; l++) {
                    next[i * width + j] += flow[i * width + l] * (step_s / (double)k) * term[l * width + j];
                }
            }
        }
        memcpy(term, next, (size_t)(rank * width) * sizeof term[0]);
        for (int i = 0; i < rank * width; i++) {
            change[i] += term[i];
        }
        series_pack(rank, width, width, term, k - 1, slow->count, slow->terms);
    }
    for (int level = slow->base; level < ENGINE_LEVELS; level++) {
        panels_pack(rank, width, width, change, &slow->ladder[(level - slow->base) * elements]);
        double_change(rank, width, change);
    }
}

/// Compute rest, energy and reach of the slow states; the last two do not depend on constants. Return false if s does not
/// provably come to rest.
static bool
certify_slow(const engine_t* const self, slow_t* slow, const double* map, const double* w, const double* change) {
    const int rank = slow->rank, constants = self->columns - self->states, width = rank + constants;
    double    a[MAX_ELEMENTS], flow[ENGINE_MAX_STATES * MAX_COLUMNS], rate[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double    rest[ENGINE_MAX_STATES * (ENGINE_MAX_INPUTS + 1)], rest_w[ENGINE_MAX_KINKS * (ENGINE_MAX_INPUTS + 1)];
    kinks_build_map(self, self->mode->piece, a);
    restrict_slow_rows(self, slow, a, PADDED(self->columns), map, flow);
    build_slow_ladder(self, slow, flow);
    for (int i = 0; i < rank; i++) {
        memcpy(&rate[i * rank], &flow[i * width], (size_t)rank * sizeof rate[0]);
    }
    if (!find_rest(rank, constants, change, rest) ||
        (!slow->certain && (!solve_lyapunov(rank, rate, slow->energy) ||
                            !find_reach(rank, width, self->kinks, w, slow->energy, slow->reach)))) {
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

/// f = exp([A B c] h) - I. True if x at h is the map of its slow rows, whatever x was before.
static bool forgets(const engine_t* const self, const slow_t* slow, const double* map, const double* f) {
    const int n = self->states, columns = self->columns, width = slow->rank + columns - n;
    double    largest = 0.0, error = 0.0;
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            const double e    = f[i * columns + j] + (i == j ? 1.0 : 0.0);
            double       left = e;
            for (int k = 0; k < slow->rank; k++) {
                const int row = slow->row[k];
                left -= map[i * width + k] * (f[row * columns + j] + (row == j ? 1.0 : 0.0));
            }
            error   = fabs(left) > error ? fabs(left) : error;
            largest = fabs(e) > largest ? fabs(e) : largest;
        }
    }
    return error <= FORGOTTEN * largest;
}

/// Pack the slow rows after the time of a level over the z before. f: exp([A B c] h) - I over that time.
static void pack_first(const engine_t* const self, slow_t* slow, const double* f) {
    const int columns = self->columns;
    double    rows[ENGINE_MAX_STATES * MAX_COLUMNS];
    for (int i = 0; i < slow->rank; i++) {
        memcpy(&rows[i * columns], &f[slow->row[i] * columns], (size_t)columns * sizeof rows[0]);
        rows[i * columns + slow->row[i]] += 1.0;
    }
    panels_pack(slow->rank, columns, columns, rows, slow->first);
}

/// f = exp([A B c] h) - I over the time of a level.
static void get_flow(const engine_t* const self, int level, double* f) {
    const int rung = level - self->mode->base;
    panels_unpack(self->states, self->columns, self->columns,
                  &self->mode->ladder[rung * PANEL_ELEMENTS(self->states, self->columns)], f);
}

/// Find the level of the shortest time up to one sample period after which the state no longer depends on the fast states,
/// and the slow rows then.
static void find_first(const engine_t* const self, slow_t* slow, const double* map) {
    double f[ENGINE_MAX_STATES * MAX_COLUMNS];
    for (int level = TOP_LEVEL; level >= self->mode->base; level--) {
        get_flow(self, level, f);
        if (level < TOP_LEVEL && !forgets(self, slow, map, f)) {
            return;
        }
        pack_first(self, slow, f);
        slow->least_level = level;
    }
}

/// f = exp([A B c] h) - I, over twice the time.
static void double_flow(int n, int columns, double* f) {
    double doubled[ENGINE_MAX_STATES * MAX_COLUMNS];
    advance_rows(n, columns, n, f, f, doubled);
    for (int i = 0; i < n * columns; i++) {
        f[i] += doubled[i];
    }
}

static int width_of(const engine_t* const self, const slow_t* slow) {
    return slow->rank + self->columns - self->states;
}

/// later = f over 2^doublings times its time.
static void get_later(const engine_t* const self, const double* f, int doublings, double* later) {
    memcpy(later, f, (size_t)(self->states * self->columns) * sizeof f[0]);
    for (int i = 0; i < doublings; i++) {
        double_flow(self->states, self->columns, later);
    }
}

/// Find the states that matter 2^doublings sample periods after an event, x over them, and after how long they alone do. f:
/// exp([A B c] h) - I over one sample period. Return false if there is no such map.
static bool choose_slow(const engine_t* const self, slow_t* slow, const double* f, int doublings, double* map) {
    double later[ENGINE_MAX_STATES * MAX_COLUMNS];
    get_later(self, f, doublings, later);
    slow->doublings = doublings;
    if (!build_slow_map(self, slow, later, map)) {
        return false;
    }
    slow->least_level = TOP_LEVEL;
    get_later(self, f, 0, later);
    while (slow->least_level < TOP_LEVEL + doublings && !forgets(self, slow, map, later)) {
        double_flow(self->states, self->columns, later);
        slow->least_level++;
    }
    if (slow->least_level == TOP_LEVEL) {
        find_first(self, slow, map);
    }
    return true;
}

/// choose_slow() with the choice made for other constants.
static void keep_choice(const engine_t* const self, slow_t* slow, const double* f, double* map) {
    const int width = width_of(self, slow);
    double    later[ENGINE_MAX_STATES * MAX_COLUMNS];
    panels_unpack(self->states, width, width, slow->state, map);
    get_later(self, f, slow->doublings, later);
    map_constants(self, slow, later, map);
    if (slow->least_level <= TOP_LEVEL) {
        get_flow(self, slow->least_level, later);
        pack_first(self, slow, later);
    }
}

/// Advance slow states by a number of ticks, at most one sample period.
static void move_slow(const engine_t* const self, const slow_t* slow, int64_t ticks, double* z) {
    const int     width = width_of(self, slow), rows = PADDED(slow->rank), elements = PANEL_ELEMENTS(slow->rank, width);
    const int64_t rest = ticks & ((INT64_C(1) << slow->base) - 1);
    for (int level = slow->base; ticks >> level != 0; level++) {
        if ((ticks >> level & 1) != 0) {
            self->kernels->advance(slow->rank, width, &slow->ladder[(level - slow->base) * elements], z);
        }
    }
    if (rest != 0) {
        const double part = (double)rest / (double)(INT64_C(1) << slow->base);
        double       terms[TERMS * PADDED(ENGINE_MAX_STATES)];
        self->kernels->multiply(slow->count * rows, width, slow->terms, z, terms);
        series_sum(self->kernels, slow->rank, slow->count, terms, part, z);
    }
}

/// Change of s over [s u 1] in a number of ticks.
static void find_change(const engine_t* const self, const slow_t* slow, int64_t ticks, double* change) {
    const int width = width_of(self, slow);
    for (int j = 0; j < width; j++) {
        double z[MAX_COLUMNS] = { 0.0 };
        z[j]                  = 1.0;
        move_slow(self, slow, ticks, z);
        for (int i = 0; i < slow->rank; i++) {
            change[i * width + j] = z[i] - (i == j ? 1.0 : 0.0);
        }
    }
}

/// Pack the rows of the present sample and of the next ones over [s u 1]. change: that of s in one sample period.
static void pack_rows(const engine_t* const self, slow_t* slow, const double* map, const double* change) {
    const int p = self->outputs, columns = self->columns, width = width_of(self, slow), row = row_length(self);
    double    y[ENGINE_MAX_OUTPUTS * MAX_COLUMNS], rows[2 * ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    double    ahead[ENGINE_MAX_STATES * MAX_COLUMNS];
    panels_unpack(p, columns, columns, self->y_panels, y);
    restrict_to_slow(self, slow->rank, p, y, columns, map, rows);
    find_change(self, slow, self->ahead, ahead);
    for (int i = 0; i < LEAP; i++) {
        if (self->ahead > 0) {
            advance_rows(slow->rank, width, p, ahead, rows, &rows[p * width]);
        }
        panels_pack(row, width, width, rows, &slow->y[i * PANEL_ELEMENTS(row, width)]);
        advance_rows(slow->rank, width, p, change, rows, y);
        memcpy(rows, y, (size_t)(p * width) * sizeof y[0]);
    }
}

/// Build the slow part of the present mode.
static void build_slow(engine_t* const self, slow_t* slow) {
    const int n = self->states, q = self->kinks, columns = self->columns;
    double    f[ENGINE_MAX_STATES * MAX_COLUMNS], map[ENGINE_MAX_STATES * MAX_COLUMNS];
    double    change[ENGINE_MAX_STATES * MAX_COLUMNS];
    double    rows[ENGINE_MAX_KINKS * MAX_COLUMNS], w[ENGINE_MAX_KINKS * MAX_COLUMNS];
    if (slow->is_chosen && !slow->certain) {
        return;
    }
    ladder_reach(self, TOP_LEVEL);
    get_flow(self, TOP_LEVEL, f);
    if (slow->is_chosen) {
        keep_choice(self, slow, f, map);
    } else {
        slow->is_chosen = true;
        slow->certain   = false;
        bool found      = choose_slow(self, slow, f, 0, map);
        if (found && slow->rank == n) {
            found = choose_slow(self, slow, f, LATER_DOUBLINGS, map);
        }
        if (!found) {
            return;
        }
    }
    const int rank = slow->rank, width = rank + columns - n;
    restrict_slow_rows(self, slow, f, columns, map, change);
    panels_pack(rank, width, width, change, slow->change);
    panels_pack(n, width, width, map, slow->state);
    panels_unpack(q, columns, columns, self->w_panels, rows);
    restrict_to_slow(self, rank, q, rows, columns, map, w);
    panels_pack(q, width, width, w, slow->w);
    slow->certain = certify_slow(self, slow, map, w, change);
    if (slow->certain) {
        pack_rows(self, slow, map, change);
    }
    for (int i = 0; i < LEAP_DOUBLINGS; i++) {
        double_change(rank, width, change);
    }
    panels_pack(rank, width, width, change, slow->leap);
}

/// Make room for the slow part of a mode. Return false if memory is short.
static bool allocate(const engine_t* const self, slow_t* slow) {
    const int n = self->states, columns = self->columns, constants = columns - n;
    const int of_states = PANEL_ELEMENTS(n, columns), of_kinks = PANEL_ELEMENTS(self->kinks, columns);
    const int of_outputs = LEAP * PANEL_ELEMENTS(2 * self->outputs, columns);
    const int of_rest = PANEL_ELEMENTS(n, constants), of_rest_w = PANEL_ELEMENTS(self->kinks, constants);
    const int count = (ENGINE_LEVELS + TERMS + 4) * of_states + of_kinks + of_outputs + of_rest + of_rest_w + n * n;
    if (slow->block == NULL) {
        slow->block = malloc((size_t)(count + self->kinks) * sizeof(double));
    }
    slow->change = slow->block;
    slow->leap   = slow->change + of_states;
    slow->state  = slow->leap + of_states;
    slow->first  = slow->state + of_states;
    slow->ladder = slow->first + of_states;
    slow->terms  = slow->ladder + ENGINE_LEVELS * of_states;
    slow->w      = slow->terms + TERMS * of_states;
    slow->y      = slow->w + of_kinks;
    slow->rest   = slow->y + of_outputs;
    slow->rest_w = slow->rest + of_rest;
    slow->energy = slow->rest_w + of_rest_w;
    slow->reach  = slow->energy + n * n;
    return slow->block != NULL;
}

/// The slow part of the present mode, built on first use. NULL if it is not certain or memory is short: the engine then
/// steps all states.
static const slow_t* find_slow(engine_t* const self) {
    slow_t* slow = &self->mode->slow;
    if (!self->mode->has_slow || slow->ahead != self->ahead) {
        if (!allocate(self, slow)) {
            return NULL;
        }
        slow->ahead = self->ahead;
        build_slow(self, slow);
        self->mode->has_slow = true;
    }
    return slow->certain ? slow : NULL;
}

// ---------------------------------------------        CERTAINTY       ---------------------------------------------

/// Compute where s rests with the present inputs, and the energy below which no w can reach a bound; negative if some w is
/// beyond a bound at rest.
static void find_limit(engine_t* const self, const slow_t* slow) {
    const int     constants = self->columns - self->states;
    const double* inputs    = &self->z[self->states];
    double        rest_w[PADDED(ENGINE_MAX_KINKS)];
    double        limit = (double)INFINITY;
    self->kernels->multiply(slow->rank, constants, slow->rest, inputs, self->rest);
    self->kernels->multiply(self->kinks, constants, slow->rest_w, inputs, rest_w);
    for (int k = 0; k < self->kinks; k++) {
        const double above = self->upper[k] - rest_w[k], below = rest_w[k] - self->lower[k];
        const double gap = CERTAINTY * (above < below ? above : below);
        if (!(gap > 0.0)) {
            limit = -1.0;
            break;
        }
        if (gap * gap < limit * slow->reach[k]) {
            limit = gap * gap / slow->reach[k];
        }
    }
    self->energy_limit = limit;
    self->has_limit    = true;
}

/// Begin a quiet stretch if no event can come before the next edge: e'Q e is below the limit. slow_z must be that of the
/// present sample.
static void certify(engine_t* const self, const slow_t* slow) {
    double e[ENGINE_MAX_STATES], energy = 0.0;
    if (!self->has_limit) {
        find_limit(self, slow);
    }
    for (int i = 0; i < slow->rank; i++) {
        e[i] = self->slow_z[i] - self->rest[i];
    }
    for (int i = 0; i < slow->rank; i++) {
        for (int j = 0; j < slow->rank; j++) {
            energy += e[i] * slow->energy[i * slow->rank + j] * e[j];
        }
    }
    if (energy < self->energy_limit) {
        self->clear = NO_END;
    }
}

// ---------------------------------------------       STRETCHES        ---------------------------------------------

/// Begin a stretch at the present sample, with the slow states in slow_z.
static void begin(engine_t* const self, const slow_t* slow) {
    for (int j = self->states; j < self->columns; j++) {
        self->slow_z[slow->rank + j - self->states] = self->z[j];
    }
    self->slow_age = 0;
    self->is_slow  = true;
}

bool fast_begin(engine_t* const self, int64_t tick) {
    double        s[PADDED(ENGINE_MAX_STATES)];
    const slow_t* slow  = events_look_until(self, self->origin + ENGINE_TICKS_PER_SAMPLE) ? find_slow(self) : NULL;
    const int64_t since = tick - self->origin;
    if (slow == NULL || since < INT64_C(1) << slow->least_level) {
        return false;
    }
    self->kernels->multiply(slow->rank, self->columns, slow->first, self->origin_z, s);
    for (int i = 0; i < slow->rank; i++) {
        self->slow_z[i] = s[i];
    }
    begin(self, slow);
    move_slow(self, slow, since - (INT64_C(1) << slow->least_level), self->slow_z);
    self->now = tick;
    certify(self, slow);
    return true;
}

/// Begin a stretch at the present instant. Return false if it is no sample instant, or if the fast states still matter.
static bool begin_here(engine_t* const self) {
    if (self->now % ENGINE_TICKS_PER_SAMPLE != 0 || self->now - self->origin < ENGINE_TICKS_PER_SAMPLE) {
        return false;
    }
    const slow_t* slow = find_slow(self);
    if (slow == NULL || self->now - self->origin < INT64_C(1) << slow->least_level) {
        return false;
    }
    for (int i = 0; i < slow->rank; i++) {
        self->slow_z[i] = self->z[slow->row[i]];
    }
    begin(self, slow);
    certify(self, slow);
    return true;
}

/// Advance by one sample period if no event comes in it.
static bool watch_step(engine_t* const self) {
    const slow_t* slow  = &self->mode->slow;
    const int     width = width_of(self, slow);
    double        z[MAX_COLUMNS];
    memcpy(z, self->slow_z, (size_t)width * sizeof z[0]);
    self->kernels->advance(slow->rank, width, slow->change, z);
    if (!events_extend(self, self->now + ENGINE_TICKS_PER_SAMPLE, width, slow->w, z)) {
        return false;
    }
    memcpy(self->slow_z, z, (size_t)width * sizeof z[0]);
    self->now += ENGINE_TICKS_PER_SAMPLE;
    certify(self, slow);
    return true;
}

static void step(engine_t* const self) {
    const slow_t* slow = &self->mode->slow;
    self->slow_age++;
    if (self->slow_age == LEAP) {
        self->kernels->advance(slow->rank, width_of(self, slow), slow->leap, self->slow_z);
        self->slow_age = 0;
    }
    self->now += ENGINE_TICKS_PER_SAMPLE;
    self->counts.quiet++;
}

static void leap(engine_t* const self, double* y) {
    const slow_t* slow  = &self->mode->slow;
    const int     width = width_of(self, slow);
    self->kernels->advance(slow->rank, width, slow->leap, self->slow_z);
    self->kernels->multiply(LEAP * row_length(self), width, slow->y, self->slow_z, y);
    self->now += LEAP * ENGINE_TICKS_PER_SAMPLE;
    self->counts.quiet += LEAP;
}

void fast_read(const engine_t* const self, double* row) {
    const slow_t* slow  = &self->mode->slow;
    const int     width = width_of(self, slow), length = row_length(self);
    double        padded[PADDED(2 * ENGINE_MAX_OUTPUTS)];
    double*       out = length % PANEL == 0 ? row : padded;
    self->kernels->multiply(length, width, &slow->y[self->slow_age * PANEL_ELEMENTS(length, width)], self->slow_z, out);
    if (out != row) {
        memcpy(row, padded, (size_t)length * sizeof row[0]);
    }
}

/// x a number of ticks later.
static void get_state_after(const engine_t* const self, int64_t ticks, double* x) {
    double        padded[PADDED(ENGINE_MAX_STATES)], z[MAX_COLUMNS];
    const slow_t* slow  = &self->mode->slow;
    const int     width = width_of(self, slow);
    memcpy(z, self->slow_z, (size_t)width * sizeof z[0]);
    for (int i = 0; i < self->slow_age; i++) {
        self->kernels->advance(slow->rank, width, slow->change, z);
    }
    move_slow(self, slow, ticks, z);
    self->kernels->multiply(self->states, width, slow->state, z, padded);
    memcpy(x, padded, (size_t)self->states * sizeof x[0]);
}

void fast_get_state(const engine_t* const self, double* x) { get_state_after(self, 0, x); }

/// End a stretch a number of ticks later.
static void leave(engine_t* const self, int64_t ticks) {
    get_state_after(self, ticks, self->z);
    self->is_slow = false;
    self->now += ticks;
}

void fast_leave(engine_t* const self) {
    if (self->is_slow) {
        leave(self, 0);
    }
}

bool fast_advance(engine_t* const self, int64_t tick) {
    const int64_t next = self->now + ENGINE_TICKS_PER_SAMPLE;
    if (!self->is_slow && (tick < next || !begin_here(self))) {
        return false;
    }
    if (tick >= next && self->clear == NO_END) {
        step(self);
        return true;
    }
    if (tick >= next && watch_step(self)) {
        return true;
    }
    if (tick < next && self->clear >= tick) {
        leave(self, tick - self->now);
        return true;
    }
    fast_leave(self);
    return false;
}

int64_t fast_run(engine_t* const self, int64_t before, double* y) {
    const bool    quiet   = self->is_slow && self->clear == NO_END;
    const int64_t samples = quiet ? (before - 1 - self->now) / ENGINE_TICKS_PER_SAMPLE : 0;
    const int     row     = row_length(self);
    int64_t       k       = 0;
    while (k < samples) {
        if (self->slow_age == LEAP - 1 && row % PANEL == 0 && samples - k >= LEAP) {
            leap(self, &y[k * row]);
            k += LEAP;
        } else {
            step(self);
            fast_read(self, &y[k * row]);
            k++;
        }
    }
    self->counts.samples += samples > 0 ? samples : 0;
    return samples > 0 ? samples : 0;
}
