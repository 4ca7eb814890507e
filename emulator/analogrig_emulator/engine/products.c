/// Exponential collocation: steps of a circuit with products. In a step of length h a product is the polynomial through its
/// values at the Lobatto nodes c h, and the state at each node follows exactly:
///
///     x(c h) = exp(A c h) x + [terms of u and 1] + sum over moments k of M_k(c) g_k,   f(s) = sum g_k (s / h)^k
///
/// with M_k(c) the integral of exp(A (c h - s)) F (s / h)^k over 0 .. c h. Doubling h gives these matrices for one level of
/// the ladder after another. The values at the nodes are found by iteration, on the arguments of the products alone.

#include "engine_state.h"

#include <stdlib.h>
#include <string.h>

#if ENGINE_DRIVE_TERMS != ORDER
#error a drive must be a polynomial through the nodes of a step
#endif

#define MAX_MOMENTS (ORDER * ENGINE_MAX_PRODUCTS)
#define MAX_VALUES (NODES * ENGINE_MAX_PRODUCTS)
#define MAX_ARGUMENTS (2 * MAX_VALUES)
#define MAX_WIDTH (MAX_COLUMNS + MAX_VALUES)
#define MAX_BLOCK_STRIDE PADDED(MAX_COLUMNS + MAX_MOMENTS)
#define MAX_BLOCK (ENGINE_MAX_STATES * MAX_BLOCK_STRIDE)

/// Largest last Legendre coefficient of a product in a step, in V. Below GROWING of it the next step is twice as long.
#define TAIL_V 1e-4
#define GROWING 0.02

/// Change of a product, in V, at which an iteration has converged.
#define CONVERGED_V 1e-7
#define ITERATIONS 14

/// Passes after which products that feed one another without a state between must have settled.
#define PASSES (2 * ENGINE_MAX_PRODUCTS + 2)
#define SETTLED 1e-13

/// Leading coefficient of the Legendre polynomial of degree 4 on 0 .. 1.
#define LEADING 70.0

static const double nodes[ORDER] = { 0.0, 0.17267316464601143, 0.5, 0.82732683535398857, 1.0 };

/// Matrices of steps of one level, panelled. z is [x u 1] at the beginning, v the products at the other nodes.
typedef struct {
    double* block;
    double* arguments;      // of the products at the other nodes, over z
    double* feedback;       // the same, over v
    double* change[NODES];  // of x up to each node, over [z v]
} rung_t;

/// The moments of a node are stored row-major: [x u 1 and k = 0 | k = 1 | .. | k = 4], as differences from x.
struct collocation {
    double* block;
    double* map;             // [A B c] of one tick
    double* moments[NODES];  // of the level `top`
    int     base, top;       // base: the level below which moments come from their series
    bool    stiff;
    rung_t  rungs[ENGINE_LEVELS];
};

// ---------------------------------------------        MATRICES        ---------------------------------------------

static int stride_of(const engine_t* const self) { return PADDED(self->columns + (ORDER - 1) * self->products); }

static int width_of(const engine_t* const self) { return self->columns + NODES * self->products; }

/// First column of a moment.
static int column_of(const engine_t* const self, int moment) {
    const int held = self->states + self->inputs - self->products;
    return moment == 0 ? held : self->columns + (moment - 1) * self->products;
}

/// Set the moments of all nodes of a step of `ticks` by their series.
static void
sum_series(const engine_t* const self, const collocation_t* matrices, double ticks, double* const* moments) {
    const int n = self->states, columns = self->columns, stride = stride_of(self), held = column_of(self, 0);
    double    a[MAX_BLOCK], power[MAX_BLOCK], next[MAX_BLOCK];
    for (int i = 0; i < n * stride; i++) {
        a[i] = power[i] = matrices->map[i] * ticks;
    }
    for (int node = 0; node < NODES; node++) {
        memset(moments[node], 0, (size_t)(n * stride) * sizeof a[0]);
    }
    double factorial = 1.0;  // of r
    for (int r = 1; r <= TERMS; r++) {
        factorial *= (double)r;
        for (int node = 0; node < NODES; node++) {
            const double c     = nodes[node + 1];
            double       scale = 1.0;  // c^r / r!
            for (int k = 0; k < r; k++) {
                scale *= c;
            }
            scale /= factorial;
            for (int i = 0; i < n; i++) {
                double* const       row  = &moments[node][i * stride];
                const double* const term = &power[i * stride];
                for (int j = 0; j < columns; j++) {
                    row[j] += scale * term[j];
                }
                double moment_scale = scale;  // c^(r + k) k! / (r + k)!
                for (int k = 1; k < ORDER; k++) {
                    moment_scale *= c * (double)k / (double)(r + k);
                    for (int j = 0; j < self->products; j++) {
                        row[column_of(self, k) + j] += moment_scale * term[held + j];
                    }
                }
            }
        }
        self->kernels->compose(n, n, stride, a, power, next);
        memcpy(power, next, (size_t)(n * stride) * sizeof a[0]);
    }
}

/// Moments of a node for twice the step: the second half begins where the first ends, with s / h in 1/2 .. 1.
static void double_moments(const engine_t* const self, double c, double* moments) {
    const int n = self->states, products = self->products, stride = stride_of(self);
    double    product[MAX_BLOCK], power[ORDER];
    self->kernels->compose(n, n, stride, moments, moments, product);
    power[0] = 1.0;
    for (int k = 1; k < ORDER; k++) {
        power[k] = power[k - 1] * c;
    }
    for (int i = 0; i < n; i++) {
        double* const       row = &moments[i * stride];
        const double* const fed = &product[i * stride];
        for (int k = ORDER - 1; k > 0; k--) {  // each needs those below it
            const int column = column_of(self, k);
            for (int j = 0; j < products; j++) {
                double sum = row[column + j] + fed[column + j], binomial = 1.0;
                for (int l = k; l >= 0; l--) {
                    sum += binomial * power[k - l] * row[column_of(self, l) + j];
                    binomial *= (double)l / (double)(k - l + 1);
                }
                row[column + j] = sum / (double)(1 << k);
            }
        }
        for (int j = 0; j < self->columns; j++) {
            row[j] = 2.0 * row[j] + fed[j];
        }
    }
}

/// change of x up to a node over [z v], row-major, from its moments.
static void weigh(const engine_t* const self, const double* moments, int stride, double* change) {
    const int held = column_of(self, 0), products = self->products;
    memset(change, 0, (size_t)(self->states * stride) * sizeof change[0]);
    for (int i = 0; i < self->states; i++) {
        const double* const row = &moments[i * stride_of(self)];
        double* const       out = &change[i * stride];
        for (int j = 0; j < self->columns; j++) {
            out[j] = row[j];
        }
        for (int j = 0; j < products; j++) {
            out[held + j] = 0.0;
            for (int k = 0; k < ORDER; k++) {
                const double moment = row[column_of(self, k) + j];
                out[held + j] += moment * self->weight[k][0];
                for (int node = 0; node < NODES; node++) {
                    out[self->columns + node * products + j] += moment * self->weight[k][node + 1];
                }
            }
        }
    }
}

/// Matrices of the arguments at a node, row-major over [z v]: w of the state there.
static void read_arguments(
    const engine_t* const self, const double* w, int node, int stride, const double* change, double* arguments) {
    const int n = self->states, count = 2 * self->products, held = column_of(self, 0);
    self->kernels->compose(count, n, stride, w, change, arguments);
    for (int i = 0; i < count; i++) {
        double* const row = &arguments[i * stride];
        for (int j = 0; j < self->columns; j++) {
            const bool at_node = j >= held && j < held + self->products;
            row[at_node ? self->columns + node * self->products + j - held : j] += w[i * stride + j];
        }
    }
}

static bool allocate_rung(const engine_t* const self, rung_t* rung) {
    const int width = width_of(self), count = 2 * NODES * self->products;
    const int of_arguments = PANEL_ELEMENTS(count, self->columns);
    const int of_feedback  = PANEL_ELEMENTS(count, NODES * self->products);
    const int of_change    = PANEL_ELEMENTS(self->states, width);
    rung->block            = malloc((size_t)(of_arguments + of_feedback + NODES * of_change) * sizeof(double));
    if (rung->block == NULL) {
        return false;
    }
    rung->arguments = rung->block;
    rung->feedback  = rung->arguments + of_arguments;
    for (int node = 0; node < NODES; node++) {
        rung->change[node] = rung->feedback + of_feedback + node * of_change;
    }
    return true;
}

/// Fill a rung from the moments of its nodes.
static void fill_rung(const engine_t* const self, double* const* moments, rung_t* rung) {
    const int width = width_of(self), stride = PADDED(width), columns = self->columns, values = NODES * self->products;
    const int count = 2 * self->products, first = self->kinks - count;
    double    change[ENGINE_MAX_STATES * PADDED(MAX_WIDTH)];
    double    w[2 * ENGINE_MAX_PRODUCTS * PADDED(MAX_WIDTH)] = { 0.0 };
    double    arguments[MAX_ARGUMENTS * PADDED(MAX_WIDTH)];
    for (int i = 0; i < count; i++) {
        for (int j = 0; j < columns; j++) {
            const int row     = first + i;
            w[i * stride + j] = self->w_panels[((row / PANEL) * columns + j) * PANEL + row % PANEL];
        }
    }
    for (int node = 0; node < NODES; node++) {
        weigh(self, moments[node], stride, change);
        panels_pack(self->states, width, stride, change, rung->change[node]);
        read_arguments(self, w, node, stride, change, &arguments[node * count * stride]);
    }
    panels_pack(NODES * count, columns, stride, arguments, rung->arguments);
    panels_pack(NODES * count, values, stride, &arguments[columns], rung->feedback);
}

/// Matrices of the present mode for steps of a level. NULL if memory is short.
static const rung_t* reach(engine_t* const self, int level) {
    collocation_t* const matrices = self->mode->collocation;
    rung_t* const        rung     = &matrices->rungs[level];
    if (rung->block != NULL) {
        return rung;
    }
    if (!allocate_rung(self, rung)) {
        return NULL;
    }
    if (level < matrices->base) {
        double        memory[NODES][MAX_BLOCK];
        double* const moments[NODES] = { memory[0], memory[1], memory[2], memory[3] };
        sum_series(self, matrices, (double)(INT64_C(1) << level), moments);
        fill_rung(self, moments, rung);
        return rung;
    }
    for (; matrices->top < level; matrices->top++) {
        for (int node = 0; node < NODES; node++) {
            double_moments(self, nodes[node + 1], matrices->moments[node]);
        }
    }
    fill_rung(self, matrices->moments, rung);
    return rung;
}

void products_free(collocation_t* matrices) {
    if (matrices == NULL) {
        return;
    }
    for (int level = 0; level < ENGINE_LEVELS; level++) {
        free(matrices->rungs[level].block);
    }
    free(matrices->block);
    free(matrices);
}

engine_status_t products_build(engine_t* const self, const double* a) {
    mode_t* const mode = self->mode;
    const int     n = self->states, stride = stride_of(self), from = PADDED(self->columns);
    products_free(mode->collocation);
    collocation_t* const matrices = mode->collocation = calloc(1, sizeof *matrices);
    if (matrices == NULL) {
        return ENGINE_NO_MEMORY;
    }
    matrices->block = calloc((size_t)((1 + NODES) * n * stride) + 1U, sizeof(double));
    if (matrices->block == NULL) {
        return ENGINE_NO_MEMORY;
    }
    matrices->map = matrices->block;
    for (int node = 0; node < NODES; node++) {
        matrices->moments[node] = &matrices->block[(1 + node) * n * stride];
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < self->columns; j++) {
            matrices->map[i * stride + j] = a[i * from + j] * self->tick_s;
        }
    }
    matrices->base = matrices->top = mode->base;
    int    halvings                = 0;
    double ticks                   = (double)(INT64_C(1) << mode->base);
    while (mode->stiff && matrix_norm(n, stride, matrices->map) * ticks > TAYLOR_NORM) {
        ticks *= 0.5;
        halvings++;
    }
    sum_series(self, matrices, ticks, matrices->moments);
    for (; halvings > 0; halvings--) {
        for (int node = 0; node < NODES; node++) {
            double_moments(self, nodes[node + 1], matrices->moments[node]);
        }
    }
    return ENGINE_OK;
}

void products_plan(engine_t* const self) {
    double powers[ORDER * ORDER], weight[ORDER * ORDER] = { 0.0 };
    for (int i = 0; i < ORDER; i++) {
        weight[i * ORDER + i] = 1.0;
        powers[i * ORDER]     = 1.0;
        for (int k = 1; k < ORDER; k++) {
            powers[i * ORDER + k] = powers[i * ORDER + k - 1] * nodes[i];
        }
    }
    (void)engine_solve(ORDER, ORDER, powers, weight);  // a Vandermonde matrix of distinct nodes
    memcpy(self->weight, weight, sizeof weight);
}

// ---------------------------------------------         LAWS           ---------------------------------------------

static double evaluate(const double* coefficients, int degree, double at) {
    double value = coefficients[degree];
    for (int k = degree - 1; k >= 0; k--) {
        value = value * at + coefficients[k];
    }
    return value;
}

/// Values of all drives at an instant in ticks.
static void follow_drives(const engine_t* const self, double tick, double* driven) {
    for (int i = 0; i < self->products; i++) {
        const drive_t* const drive = &self->drives[i];
        driven[i]                  = 0.0;
        if (drive->terms != NULL) {
            const double  period = (double)ENGINE_TICKS_PER_SAMPLE;
            const int64_t last = drive->first + drive->samples - 1, now = (int64_t)(tick / period),
                          sample = now < last ? now : last;
            const double since   = tick / period - (double)sample;
            driven[i] = evaluate(&drive->terms[(sample - drive->first) * ENGINE_DRIVE_TERMS], ENGINE_DRIVE_TERMS - 1,
                                 since < 1.0 ? since : 1.0);
        }
    }
}

/// Evaluate all products of one instant, at which these are their drives.
static void multiply_out(const engine_t* const self, const double* driven, const double* arguments, double* values) {
    const law_t* law = self->circuit->law;
    for (int i = 0; i < self->products; i++, law++, arguments += 2) {
        values[i] = evaluate(law->factors.x, law->x_degree, arguments[0]) *
                        evaluate(law->factors.y, law->y_degree, arguments[1]) +
                    driven[i];
    }
}

static int degree_of(const double* coefficients) {
    int degree = ENGINE_MAX_FACTOR_TERMS - 1;
    while (degree > 0 && !(fabs(coefficients[degree]) > 0.0)) {
        degree--;
    }
    return degree;
}

void products_set_laws(const engine_t* self, const engine_product_t* products) {
    law_t* const law = self->circuit->law;
    for (int i = 0; i < self->products; i++) {
        law[i] = (law_t){ products[i], degree_of(products[i].x), degree_of(products[i].y) };
    }
}

engine_status_t products_solve(engine_t* const self) {
    double* const held = &self->z[column_of(self, 0)];
    double        values[ENGINE_MAX_PRODUCTS], driven[ENGINE_MAX_PRODUCTS];
    follow_drives(self, (double)self->now, driven);
    for (int pass = 0; pass < PASSES; pass++) {
        const engine_status_t status  = kinks_solve(self);
        bool                  settled = true;
        if (status != ENGINE_OK) {
            return status;
        }
        multiply_out(self, driven, &self->w[self->kinks - 2 * self->products], values);
        for (int i = 0; i < self->products; i++) {
            settled = settled && fabs(values[i] - held[i]) <= SETTLED * fabs(held[i]);
            if (!isfinite(values[i])) {
                return ENGINE_NOT_UNIQUE;  // they feed one another without bound: all w were finite
            }
            held[i] = values[i];
        }
        if (settled) {
            return ENGINE_OK;
        }
    }
    return ENGINE_NOT_UNIQUE;
}

// ---------------------------------------------         STEPS          ---------------------------------------------

/// One step under trial.
typedef struct {
    double values[ORDER * ENGINE_MAX_PRODUCTS];   // of the products at the nodes, the beginning first
    double moments[ORDER * ENGINE_MAX_PRODUCTS];  // of the polynomials through them
    double vector[MAX_WIDTH];                     // [z v]
    double z[PADDED(MAX_COLUMNS)];                // at the end
} step_t;

/// Extend the polynomials of the step before to the nodes of this one.
static void predict(const engine_t* const self, int64_t ticks, step_t* step) {
    const int    products = self->products;
    const double ratio    = self->stride > 0 ? (double)ticks / (double)self->stride : 0.0;
    memcpy(step->values, &self->z[column_of(self, 0)], (size_t)products * sizeof step->values[0]);
    for (int node = 1; node < ORDER; node++) {
        const double at = 1.0 + ratio * nodes[node];
        for (int i = 0; i < products; i++) {
            double value = step->values[i];
            if (self->stride > 0) {
                value = self->moments[NODES * products + i];
                for (int k = NODES - 1; k >= 0; k--) {
                    value = value * at + self->moments[k * products + i];
                }
            }
            step->values[node * products + i] = value;
        }
    }
}

/// Find the products at the nodes of a step from now. Return false if the iteration does not converge.
static bool iterate(const engine_t* const self, const rung_t* rung, int64_t ticks, step_t* step) {
    const int     products = self->products, count = 2 * NODES * products, values = NODES * products;
    double        fixed[MAX_ARGUMENTS], fed[MAX_ARGUMENTS], next[MAX_VALUES], driven[MAX_VALUES];
    double* const v = &step->values[products];
    self->kernels->multiply(count, self->columns, rung->arguments, self->z, fixed);
    for (int node = 0; node < NODES; node++) {
        follow_drives(self, (double)self->now + nodes[node + 1] * (double)ticks, &driven[node * products]);
    }
    for (int i = 0; i < ITERATIONS; i++) {
        double moved     = 0.0;
        bool   converged = true;
        self->kernels->multiply(count, values, rung->feedback, v, fed);
        for (int j = 0; j < count; j++) {
            fed[j] += fixed[j];
        }
        for (int node = 0; node < NODES; node++) {
            multiply_out(self, &driven[node * products], &fed[node * 2 * products], &next[node * products]);
        }
        for (int j = 0; j < values; j++) {
            const double change = fabs(next[j] - v[j]);
            converged           = converged && change <= CONVERGED_V;
            moved += change;
            v[j] = next[j];
        }
        if (converged) {
            return true;
        }
        if (!isfinite(moved)) {
            return false;
        }
    }
    return false;
}

/// Set the polynomials through the products at the nodes. Return the largest last Legendre coefficient of those not driven.
static double fit(const engine_t* const self, step_t* step) {
    const int products = self->products;
    double    largest  = 0.0;
    for (int i = 0; i < products; i++) {
        for (int k = 0; k < ORDER; k++) {
            double sum = 0.0;
            for (int node = 0; node < ORDER; node++) {
                sum += self->weight[k][node] * step->values[node * products + i];
            }
            step->moments[k * products + i] = sum;
        }
        const double tail = fabs(step->moments[NODES * products + i]) / LEADING;
        largest           = self->drives[i].terms == NULL && tail > largest ? tail : largest;
    }
    return largest;
}

/// Set z to the state at a node.
static void arrive(const engine_t* const self, const rung_t* rung, int node, const step_t* step, double* z) {
    double change[PADDED(ENGINE_MAX_STATES)];
    copy_z(self, self->z, z);
    self->kernels->multiply(self->states, width_of(self), rung->change[node], step->vector, change);
    for (int i = 0; i < self->states; i++) {
        z[i] += change[i];
    }
    memcpy(&z[column_of(self, 0)], &step->values[(node + 1) * self->products], (size_t)self->products * sizeof z[0]);
}

/// True if an argument is beyond its bound at a node within a step.
static bool strays(const engine_t* const self, const rung_t* rung, const step_t* step) {
    double z[PADDED(MAX_COLUMNS)], w[PADDED(ENGINE_MAX_KINKS)];
    for (int node = 0; node < NODES - 1; node++) {
        arrive(self, rung, node, step, z);
        self->kernels->multiply(self->kinks, self->columns, self->w_panels, z, w);
        for (int k = 0; k < self->kinks; k++) {
            if (!(w[k] >= self->lower[k] && w[k] <= self->upper[k])) {
                return true;
            }
        }
    }
    return false;
}

/// Longest step towards a tick that ends on a multiple of its length, and is no longer than the time since the last event.
static int choose_level(const engine_t* const self, int64_t tick) {
    const int64_t since = self->now - self->origin;
    int           level = self->look;
    while (level > 0) {
        const int64_t ticks = INT64_C(1) << level;
        if ((ticks <= since || level <= self->mode->base) && self->now % ticks == 0 && self->now + ticks <= tick) {
            break;
        }
        level--;
    }
    return level;
}

typedef enum { ACCEPTED, TOO_LONG, LEFT, FAILED } outcome_t;

/// Try a step of a level. tail: the largest last coefficient of its products.
static outcome_t attempt(engine_t* const self, const rung_t* rung, int level, step_t* step, double* tail) {
    const int64_t ticks = INT64_C(1) << level;
    self->counts.steps++;
    predict(self, ticks, step);
    if (!iterate(self, rung, ticks, step)) {
        return level > 0 ? TOO_LONG : FAILED;
    }
    *tail = fit(self, step);
    if (level > 0 && !(*tail <= TAIL_V)) {
        return TOO_LONG;
    }
    copy_z(self, self->z, step->vector);
    memcpy(&step->vector[self->columns], &step->values[self->products],
           (size_t)(NODES * self->products) * sizeof step->vector[0]);
    arrive(self, rung, NODES - 1, step, step->z);
    const double      growth    = self->stride > 0 ? (double)ticks / (double)self->stride : 0.0;
    const judgement_t judgement = self->kernels->look(self, self->columns, self->w_panels, step->z, growth);
    if (judgement == CLEAR || (judgement == NEAR && level <= NEAR_LEVEL && !strays(self, rung, step))) {
        return ACCEPTED;
    }
    return level > 0 ? TOO_LONG : judgement == CROSSED ? LEFT : ACCEPTED;
}

/// Accept a step.
static void accept(engine_t* const self, int level, const step_t* step) {
    copy_z(self, step->z, self->z);
    memcpy(self->moments, step->moments, (size_t)(ORDER * self->products) * sizeof self->moments[0]);
    self->clear = self->now;
    step_accept(self, INT64_C(1) << level);
    self->now = self->clear;
    double driven[ENGINE_MAX_PRODUCTS];
    follow_drives(self, (double)self->now, driven);
    multiply_out(self, driven, &self->w[self->kinks - 2 * self->products], &self->z[column_of(self, 0)]);
}

engine_status_t products_advance(engine_t* const self, int64_t tick) {
    step_t step;
    double tail = 0.0;
    while (self->now < tick) {
        const int       level   = choose_level(self, tick);
        const rung_t*   rung    = reach(self, level);
        const outcome_t outcome = rung == NULL ? FAILED : attempt(self, rung, level, &step, &tail);
        if (outcome == TOO_LONG) {
            self->look = level - 1;
            continue;
        }
        if (outcome == FAILED) {
            return rung == NULL ? ENGINE_NO_MEMORY : ENGINE_NOT_UNIQUE;
        }
        accept(self, level, &step);
        if (level == self->look && level < TOP_LEVEL && tail < GROWING * TAIL_V) {
            self->look++;
        }
        if (outcome == LEFT) {
            self->counts.events++;
            const engine_status_t status = self->events_left-- > 0 ? mode_enter(self) : ENGINE_EVENTS;
            if (status != ENGINE_OK) {
                return status;
            }
        }
    }
    return ENGINE_OK;
}
