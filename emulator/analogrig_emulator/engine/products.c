/// Exponential collocation: steps of a circuit with products. In a step of length h a product is the polynomial through its
/// values at the Lobatto nodes c h, and the state at each node follows exactly:
///
///     x(c h) = exp(A c h) x + [terms of u and 1] + sum over moments k of M_k(c) g_k,   f(s) = sum g_k (s / h)^k
///
/// with M_k(c) the integral of exp(A (c h - s)) F (s / h)^k over 0 .. c h. Doubling h gives these matrices for one level of
/// the ladder after another. The values at the nodes are found by iteration, on the arguments of the products alone. Values
/// at the nodes beyond the beginning, and moments beyond g_0, are one panel for each product.

#include "engine_state.h"

#include <stdlib.h>
#include <string.h>

#if ENGINE_DRIVE_TERMS != ORDER
#error a drive must be a polynomial through the nodes of a step
#endif
#if NODES != PANEL
#error the nodes of a step must fill a panel
#endif

#define MAX_VALUES (NODES * ENGINE_MAX_PRODUCTS)
#define MAX_ARGUMENTS (2 * MAX_VALUES)
#define MAX_WIDTH (MAX_COLUMNS + MAX_VALUES)
#define MAX_BLOCK_STRIDE PADDED(MAX_WIDTH)
#define MAX_BLOCK (ENGINE_MAX_STATES * MAX_BLOCK_STRIDE)

/// Largest last Legendre coefficient of a product in a step, in V. Below GROWING of it the next step is twice as long.
#define TAIL_V 1e-6
#define GROWING 0.02

/// Steps within a sample period after which products are given up; shipped programs take at most some 1,000.
#define MOST_STEPS 1000000

/// Change of a product, in V, after which an iteration has converged, or error: the sum of all changes to come, of which each is
/// the same part, the contraction, of the one before.
#define CONVERGED_V 1e-7
#define ITERATIONS 14

/// Contraction of relaxation, from its last step, from which Newton's iteration begins. Relaxation itself leaves at most 4 to a
/// step that is at most twice as long.
#define HOPELESS 8.0

/// Least change of a product, in V, of which a contraction is computed: smaller ones are rounding. A contraction of 0 would
/// hold for all steps to come, since each step then ends after one iteration.
#define ROUNDING_V 1e-15

/// Change of an argument, in V, after which Newton's iteration is as good as its square. Rounding in long steps may leave more.
#define SETTLED_V 1e-5

/// Passes after which products that feed one another without a state between must have settled.
#define PASSES (2 * ENGINE_MAX_PRODUCTS + 2)
#define SETTLED 1e-13

/// Leading coefficient of the Legendre polynomial of degree 4 on 0 .. 1.
#define LEADING 70.0

static const double nodes[ORDER] = { 0.0, 0.17267316464601143, 0.5, 0.82732683535398857, 1.0 };

/// Matrices of steps of one level, panelled. z is [x u 1] at the beginning, g the moments of the products beyond g_0.
typedef struct {
    double* block;
    double* arguments;      // of each product p, then q, at the other nodes, over z
    double* feedback;       // the same, over the values of the products at these nodes
    double* change[NODES];  // of x up to each node, over [z g]
} rung_t;

/// The moments of a node are stored row-major over [z g], as differences from x.
struct collocation {
    double* block;
    double* map;             // [A B c] of one tick, and once more the columns of the product for each of its g
    double* moments[NODES];  // of the level `top`
    int     base, top;       // base: the level below which moments come from their series
    rung_t  rungs[ENGINE_LEVELS];
};

// ---------------------------------------------        MATRICES        ---------------------------------------------

static int width_of(const engine_t* const self) { return self->columns + NODES * self->products; }

static int stride_of(const engine_t* const self) { return PADDED(width_of(self)); }

/// Column of a moment of a product.
static int column_of(const engine_t* const self, int product, int moment) {
    return moment == 0 ? self->states + self->inputs - self->products + product
                       : self->columns + product * NODES + moment - 1;
}

/// Set the moments of all nodes of a step of `ticks` by their series.
static void
sum_series(const engine_t* const self, const collocation_t* matrices, double ticks, double* const* moments) {
    const int n = self->states, stride = stride_of(self);
    double    a[MAX_BLOCK], power[MAX_BLOCK], next[MAX_BLOCK], scale[MAX_BLOCK_STRIDE] = { 0.0 };
    double    part[NODES] = { 1.0, 1.0, 1.0, 1.0 };  // c^r / r!
    for (int i = 0; i < n * stride; i++) {
        a[i] = power[i] = matrices->map[i] * ticks;
    }
    for (int node = 0; node < NODES; node++) {
        memset(moments[node], 0, (size_t)(n * stride) * sizeof a[0]);
    }
    for (int r = 1; r <= TERMS; r++) {
        for (int node = 0; node < NODES; node++) {
            const double c = nodes[node + 1];
            part[node] *= c / (double)r;
            double moment_part = part[node];  // c^(r + k) k! / (r + k)!
            for (int j = 0; j < self->columns; j++) {
                scale[j] = moment_part;
            }
            for (int k = 1; k < ORDER; k++) {
                moment_part *= c * (double)k / (double)(r + k);
                for (int product = 0; product < self->products; product++) {
                    scale[column_of(self, product, k)] = moment_part;
                }
            }
            for (int i = 0; i < n * stride; i += stride) {
                for (int j = 0; j < stride; j++) {
                    moments[node][i + j] += scale[j] * power[i + j];
                }
            }
        }
        self->kernels->compose(n, n, stride, a, power, next);
        memcpy(power, next, (size_t)(n * stride) * sizeof a[0]);
    }
}

/// Moments of a node for twice the step: the second half begins where the first ends, with s / h in c/2 .. c.
static void double_moments(const engine_t* const self, int node, double* moments) {
    const int n = self->states, stride = stride_of(self);
    double    product[MAX_BLOCK];
    self->kernels->compose(n, n, stride, moments, moments, product);
    for (int i = 0; i < n * stride; i += stride) {
        double* const       row = &moments[i];
        const double* const fed = &product[i];
        for (int j = 0; j < self->products; j++) {
            const double        first = row[column_of(self, j, 0)];
            double* const       g     = &row[column_of(self, j, 1)];
            const double* const g_fed = &fed[column_of(self, j, 1)];
            for (int k = ORDER - 1; k > 0; k--) {  // each needs those below it
                const double* const binomial = self->binomial[node][k];
                double              sum      = g[k - 1] + g_fed[k - 1] + binomial[0] * first;
                for (int l = 1; l <= k; l++) {
                    sum += binomial[l] * g[l - 1];
                }
                g[k - 1] = sum / (double)(1 << k);
            }
        }
        for (int j = 0; j < self->columns; j++) {
            row[j] = 2.0 * row[j] + fed[j];
        }
    }
}

/// Turn a row over [z g] into one over z and the values of the products at the other nodes.
static void weigh(const engine_t* const self, double* row) {
    for (int i = 0; i < self->products; i++) {
        double* const g               = &row[column_of(self, i, 1)];
        double        by_value[ORDER] = { 0.0 };
        for (int node = 0; node < ORDER; node++) {
            for (int k = 0; k < NODES; k++) {
                by_value[node] += g[k] * self->weight[node * PANEL + k];
            }
        }
        row[column_of(self, i, 0)] += by_value[0];
        memcpy(g, &by_value[1], NODES * sizeof g[0]);
    }
}

/// Matrices of the arguments at a node, row-major over [z g]: w of the state there, with the products as they are there.
static void
read_arguments(const engine_t* const self, const double* w, int node, const double* moments, double* arguments) {
    const int stride = stride_of(self), count = 2 * self->products;
    double    there[2 * ENGINE_MAX_PRODUCTS * MAX_BLOCK_STRIDE];
    self->kernels->compose(count, self->states, stride, w, moments, there);
    for (int i = 0; i < count; i++) {
        double* const row = &arguments[(i * NODES + node) * stride];
        for (int j = 0; j < stride; j++) {
            row[j] = there[i * stride + j] + w[i * stride + j];
        }
        for (int j = 0; j < self->products; j++) {
            double gain = w[i * stride + column_of(self, j, 0)];
            for (int k = 1; k < ORDER; k++) {
                gain *= nodes[node + 1];
                row[column_of(self, j, k)] += gain;
            }
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
    const int width = width_of(self), stride = stride_of(self), columns = self->columns;
    const int count = 2 * self->products, first = self->kinks - count;
    double    w[2 * ENGINE_MAX_PRODUCTS * MAX_BLOCK_STRIDE] = { 0.0 };
    double    arguments[MAX_ARGUMENTS * MAX_BLOCK_STRIDE];
    for (int i = 0; i < count; i++) {
        for (int j = 0; j < columns; j++) {
            w[i * stride + j] = w_row_of(self, first + i)[j * PANEL];
        }
    }
    for (int node = 0; node < NODES; node++) {
        panels_pack(self->states, width, stride, moments[node], rung->change[node]);
        read_arguments(self, w, node, moments[node], arguments);
    }
    for (int i = 0; i < NODES * count; i++) {
        weigh(self, &arguments[i * stride]);
    }
    panels_pack(NODES * count, columns, stride, arguments, rung->arguments);
    panels_pack(NODES * count, NODES * self->products, stride, &arguments[columns], rung->feedback);
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
            double_moments(self, node, matrices->moments[node]);
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
        for (int j = 0; j < NODES * self->products; j++) {
            matrices->map[i * stride + self->columns + j] = matrices->map[i * stride + column_of(self, j / NODES, 0)];
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
            double_moments(self, node, matrices->moments[node]);
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
    panels_pack(NODES, ORDER, ORDER, &weight[ORDER], self->weight);
    for (int node = 0; node < NODES; node++) {
        for (int k = 0; k < ORDER; k++) {
            double binomial = 1.0;  // k! / (l! (k - l)!) c^(k - l)
            for (int l = k; l >= 0; l--) {
                self->binomial[node][k][l] = binomial;
                binomial *= nodes[node + 1] * (double)l / (double)(k - l + 1);
            }
        }
    }
}

// ---------------------------------------------         LAWS           ---------------------------------------------

static double evaluate(const double* coefficients, int degree, double at) {
    double value = coefficients[degree];
    for (int k = degree - 1; k >= 0; k--) {
        value = value * at + coefficients[k];
    }
    return value;
}

/// Slope of a polynomial.
static double slope_at(const double* coefficients, int degree, double at) {
    double value = (double)degree * coefficients[degree];
    for (int k = degree - 1; k > 0; k--) {
        value = value * at + (double)k * coefficients[k];
    }
    return value;
}

/// Add the value of a drive at an instant in ticks.
static void follow_drive(const drive_t* drive, double tick, double* value) {
    const double  period = (double)ENGINE_TICKS_PER_SAMPLE;
    const int64_t last = drive->first + drive->samples - 1, now = (int64_t)(tick / period),
                  sample = now < last ? now : last;
    const double since   = tick / period - (double)sample;
    *value += evaluate(&drive->terms[(sample - drive->first) * ENGINE_DRIVE_TERMS], ENGINE_DRIVE_TERMS - 1,
                       since < 1.0 ? since : 1.0);
}

/// Value of a product at its arguments.
static double value_of(const law_t* law, double p, double q) {
    const double x = evaluate(law->factors.x, law->x_degree, p), y = evaluate(law->factors.y, law->y_degree, q);
    if (law->kind == ENGINE_ROOT) {
        return (x > 0.0 ? sqrt(x) : 0.0) * y;
    }
    return law->kind == ENGINE_QUOTIENT ? x / y : x * y;
}

/// Evaluate all products at the present instant.
static void multiply_out(const engine_t* const self, const double* arguments, double* values) {
    const law_t* law = self->circuit->law;
    for (int i = 0; i < self->products; i++, law++, arguments += 2) {
        values[i] = value_of(law, arguments[0], arguments[1]);
        if (self->drives[i].terms != NULL) {
            follow_drive(&self->drives[i], (double)self->now, &values[i]);
        }
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
        law[i] = (law_t){ products[i], degree_of(products[i].x), degree_of(products[i].y), (int)products[i].law };
    }
}

engine_status_t products_solve(engine_t* const self) {
    double* const held = &self->z[column_of(self, 0, 0)];
    double        values[ENGINE_MAX_PRODUCTS];
    for (int pass = 0; pass < PASSES; pass++) {
        const engine_status_t status  = kinks_solve(self);
        bool                  settled = true;
        if (status != ENGINE_OK) {
            return status;
        }
        multiply_out(self, &self->w[self->kinks - 2 * self->products], values);
        for (int i = 0; i < self->products; i++) {
            settled = settled && fabs(values[i] - held[i]) <= SETTLED * fabs(held[i]);
            if (isfinite(values[i])) {  // a quotient waits for a divisor that is itself a product
                held[i] = values[i];
            }
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
    double begun[PADDED(ENGINE_MAX_PRODUCTS)];  // values of the products at its beginning, for its polynomials
    double values[MAX_VALUES];                  // of the products at the nodes beyond its beginning
    double contraction;                         // of their changes from one iteration to the next
    double vector[MAX_WIDTH];                   // [z g]
    double z[PADDED(MAX_COLUMNS)];              // at the end
} step_t;

/// Extend the polynomials of the step before to the nodes of this one.
static void predict(engine_t* const self, int64_t ticks, step_t* step) {
    const double ratio = self->stride > 0 ? (double)ticks / (double)self->stride : 0.0;
    if (ratio < self->ratio || ratio > self->ratio) {
        self->ratio = ratio;
        for (int node = 0; node < NODES; node++) {
            double power = 1.0;
            for (int k = 0; k < ORDER; k++) {
                self->extension[k * PANEL + node] = power;
                power *= 1.0 + ratio * nodes[node + 1];
            }
        }
    }
    for (int i = 0; i < self->products; i++) {
        double* const value = &step->values[i * NODES];
        if (self->stride > 0) {
            self->kernels->multiply(NODES, ORDER, self->extension, self->moments[i], value);
        } else {
            value[0] = value[1] = value[2] = value[3] = self->z[column_of(self, i, 0)];
        }
    }
}

/// Set [z g] of the polynomials through the products at the nodes.
static void fit(const engine_t* const self, step_t* step) {
    copy_z(self, self->z, step->vector);
    for (int i = 0; i < self->products; i++) {
        double value[ORDER] = { step->begun[i] };
        memcpy(&value[1], &step->values[i * NODES], NODES * sizeof value[0]);
        step->vector[column_of(self, i, 0)] = value[0];
        self->kernels->multiply(NODES, ORDER, self->weight, value, &step->vector[column_of(self, i, 1)]);
    }
}

/// Last moment of the polynomial through a value at the beginning and those at the other nodes.
static double last_moment(const engine_t* const self, double first, const double* values) {
    double last = first * self->weight[NODES - 1];
    for (int node = 0; node < NODES; node++) {
        last += self->weight[(node + 1) * PANEL + NODES - 1] * values[node];
    }
    return last;
}

/// Largest last Legendre coefficient of the products that are not driven, with what they truly are at the beginning.
static double find_tail(const engine_t* const self, const step_t* step) {
    double largest = 0.0;
    for (int i = 0; i < self->products; i++) {
        const double first = self->z[column_of(self, i, 0)];
        const double tail  = fabs(last_moment(self, first, &step->values[i * NODES])) / LEADING;
        largest            = self->drives[i].terms == NULL && tail > largest ? tail : largest;
    }
    return largest;
}

/// Arguments of the products at the nodes of a step as far as the iteration does not change them, and what drives add.
typedef struct {
    double fixed[MAX_ARGUMENTS], driven[MAX_VALUES];
} given_t;

static void prepare(const engine_t* const self, const rung_t* rung, int64_t ticks, given_t* given) {
    const int values = NODES * self->products;
    self->kernels->multiply(2 * values, self->columns, rung->arguments, self->z, given->fixed);
    memset(given->driven, 0, (size_t)values * sizeof given->driven[0]);
    for (int i = 0; i < self->products; i++) {
        for (int node = 0; node < NODES && self->drives[i].terms != NULL; node++) {
            follow_drive(&self->drives[i], (double)self->now + nodes[node + 1] * (double)ticks,
                         &given->driven[i * NODES + node]);
        }
    }
}

/// Arguments of the product whose first value is `first`: p at the nodes, then q.
static void read_fed(
    const engine_t* const self, const rung_t* rung, const given_t* given, const step_t* step, int first, double* fed) {
    const int values = NODES * self->products;
    self->kernels->multiply(2 * NODES, values, &rung->feedback[2 * first * values], step->values, fed);
    self->kernels->add(2 * NODES, 1.0, &given->fixed[2 * first], 1.0, fed);
}

/// True if an iteration has converged. `moved`: the last change of the products.
static bool has_converged(double moved, double contraction) {
    return moved <= CONVERGED_V || contraction * moved <= CONVERGED_V * (1.0 - contraction);
}

/// Find the products at the nodes by taking the new values again and again. Return false if they do not converge.
static bool relax(const engine_t* const self, const rung_t* rung, const given_t* given, step_t* step) {
    double before = 0.0;
    for (int i = 0; i < ITERATIONS; i++) {
        double moved = 0.0;
        for (int j = 0; j < NODES * self->products; j += NODES) {
            // Each product takes the new values of those before it.
            double fed[2 * NODES];
            read_fed(self, rung, given, step, j, fed);
            const double change =
                self->kernels->apply(&self->circuit->law[j / NODES], fed, &given->driven[j], &step->values[j]);
            moved = change > moved ? change : moved;
        }
        step->contraction = i > 0 ? fmax(moved, ROUNDING_V) / before : step->contraction;
        if (has_converged(moved, step->contraction)) {
            step->contraction = fmin(step->contraction, 1.0);
            return true;
        }
        if (!isfinite(moved) || (i > 0 && !(moved < before))) {
            return false;
        }
        before = moved;
    }
    return false;
}

/// Weight of a value in that at the beginning of the cubic polynomial through the values of its product; 0 for one that is driven.
static double back_weight(const engine_t* const self, int value) {
    return self->drives[value / NODES].terms != NULL
               ? 0.0
               : -self->weight[(value % NODES + 1) * PANEL + NODES - 1] / self->weight[NODES - 1];
}

/// Set the arguments that come from the products at the beginning to those of step->begun instead of those of z.
static void
restart(const engine_t* const self, const rung_t* rung, const given_t* held, const step_t* step, given_t* given) {
    const int products = self->products, first = column_of(self, 0, 0);
    double    change[PADDED(ENGINE_MAX_PRODUCTS)], moved[PANEL];
    for (int i = 0; i < products; i++) {
        change[i] = step->begun[i] - self->z[first + i];
    }
    for (int panel = 0; panel < 2 * products; panel++) {
        const double* const arguments = &rung->arguments[(panel * self->columns + first) * PANEL];
        self->kernels->multiply(PANEL, products, arguments, change, moved);
        for (int i = 0; i < PANEL; i++) {
            given->fixed[panel * PANEL + i] = held->fixed[panel * PANEL + i] + moved[i];
        }
    }
}

/// Slopes of a product over its arguments p and q.
static void find_slopes(const law_t* law, double p, double q, double* by_p, double* by_q) {
    const double x = evaluate(law->factors.x, law->x_degree, p), y = evaluate(law->factors.y, law->y_degree, q);
    const double x_slope = slope_at(law->factors.x, law->x_degree, p),
                 y_slope = slope_at(law->factors.y, law->y_degree, q);
    if (law->kind == ENGINE_ROOT) {
        *by_p = x > 0.0 ? 0.5 * x_slope / sqrt(x) * y : 0.0;
        *by_q = x > 0.0 ? sqrt(x) * y_slope : 0.0;
    } else if (law->kind == ENGINE_QUOTIENT) {
        *by_p = x_slope / y;
        *by_q = -x * y_slope / (y * y);
    } else {
        *by_p = x_slope * y;
        *by_q = y_slope * x;
    }
}

/// Equations for the changes of all values in the next of Newton's iterations.
typedef struct {
    double left[MAX_VALUES * MAX_VALUES], right[MAX_VALUES];
} equations_t;

/// Set the row of the equations of a product at a node. by_p, by_q: its slopes over its arguments there. Return the sum of what
/// the values contribute.
static double
set_row(const engine_t* const self, const rung_t* rung, int row, double by_p, double by_q, equations_t* equations) {
    const int           values = NODES * self->products, node = row % NODES, panel = 2 * (row - node);
    const double* const feedback = &rung->feedback[panel * values + node];
    const double* const begun    = &rung->arguments[panel * self->columns + column_of(self, 0, 0) * PANEL + node];
    double              sum      = 0.0;
    for (int j = 0; j < values; j++) {
        const int    first = (j / NODES) * PANEL;
        const double back  = back_weight(self, j);
        const double p_fed = feedback[j * PANEL] + back * begun[first];
        const double q_fed = feedback[(values + j) * PANEL] + back * begun[self->columns * PANEL + first];
        const double gain  = by_p * p_fed + by_q * q_fed;
        equations->left[row * values + j] = (row == j ? 1.0 : 0.0) - gain;
        sum += fabs(gain);
    }
    return sum;
}

/// Arguments of all products at the nodes, about which the laws are straight, and what they have moved by from those before.
typedef struct {
    double at[MAX_ARGUMENTS], moved;
} place_t;

/// Go to the arguments that the values give.
static void
move(const engine_t* const self, const rung_t* rung, const given_t* given, const step_t* step, place_t* place) {
    place->moved = 0.0;
    for (int row = 0; row < NODES * self->products; row += NODES) {
        double fed[2 * NODES];
        read_fed(self, rung, given, step, row, fed);
        for (int i = 0; i < 2 * NODES; i++) {
            const double change = fabs(fed[i] - place->at[2 * row + i]);
            place->moved        = change <= place->moved ? place->moved : isfinite(change) ? change : (double)INFINITY;
            place->at[2 * row + i] = fed[i];
        }
    }
}

/// Set the equations at a place. The contraction is that of relaxation.
static void linearise(const engine_t* const self,
                      const rung_t*         rung,
                      const given_t*        given,
                      const place_t*        place,
                      step_t*               step,
                      equations_t*          equations) {
    step->contraction = 0.0;
    for (int row = 0; row < NODES * self->products; row += NODES) {
        const law_t* const  law = &self->circuit->law[row / NODES];
        const double* const at  = &place->at[2 * row];
        double              fed[2 * NODES], value[NODES];
        read_fed(self, rung, given, step, row, fed);
        memcpy(value, &step->values[row], sizeof value);
        (void)self->kernels->apply(law, at, &given->driven[row], value);
        for (int p = 0, q = NODES; p < NODES; p++, q++) {
            double by_p, by_q;
            find_slopes(law, at[p], at[q], &by_p, &by_q);
            equations->right[row + p] =
                value[p] - step->values[row + p] + by_p * (fed[p] - at[p]) + by_q * (fed[q] - at[q]);
            step->contraction = fmax(step->contraction, set_row(self, rung, row + p, by_p, by_q, equations));
        }
    }
}

/// Take the cubic polynomials of the products through the nodes beyond the beginning; drives keep theirs.
static void extend_back(const engine_t* const self, step_t* step) {
    for (int i = 0; i < self->products; i++) {
        double sum = self->drives[i].terms != NULL ? self->z[column_of(self, i, 0)] : 0.0;
        for (int j = i * NODES; j < (i + 1) * NODES; j++) {
            sum += back_weight(self, j) * step->values[j];
        }
        step->begun[i] = sum;
    }
}

/// Find the products at the nodes by Newton's iteration, which serves loops that are faster than the step. What such a loop has
/// not settled by the first node does not ring on: its value at the beginning is left out.
static bool approach(const engine_t* const self, const rung_t* rung, const given_t* held, step_t* step) {
    const int   values = NODES * self->products;
    given_t     given  = *held;
    place_t     place  = { .moved = 0.0 };
    equations_t equations;
    for (int i = 0; i < 2 * values; i++) {
        place.at[i] = self->w[self->kinks - 2 * self->products + i / NODES];
    }
    for (int i = 0; i < ITERATIONS; i++) {
        extend_back(self, step);
        restart(self, rung, held, step, &given);
        if (i > 0) {
            move(self, rung, &given, step, &place);
            if (place.moved <= SETTLED_V) {
                return true;
            }
        }
        linearise(self, rung, &given, &place, step, &equations);
        if (!isfinite(place.moved) || engine_solve(values, 1, equations.left, equations.right) >= 0) {
            return false;
        }
        for (int j = 0; j < values; j++) {
            step->values[j] += equations.right[j];
        }
    }
    return false;
}

/// Find the products at the nodes of a step from now. Return false if no iteration converges.
static bool iterate(engine_t* const self, const rung_t* rung, int64_t ticks, step_t* step) {
    given_t given;
    prepare(self, rung, ticks, &given);
    predict(self, ticks, step);
    // Until the second change, that of the step before counts twice, and the more the longer this step is.
    step->contraction = self->stride > 0 ? 2.0 * self->ratio * self->contraction : 1.0;
    if (self->stride == 0 || step->contraction < HOPELESS) {
        memcpy(step->begun, &self->z[column_of(self, 0, 0)], (size_t)self->products * sizeof step->begun[0]);
        if (relax(self, rung, &given, step)) {
            return true;
        }
        predict(self, ticks, step);
    }
    return approach(self, rung, &given, step);
}

/// Set z to the state at a node.
static void arrive(const engine_t* const self, const rung_t* rung, int node, const step_t* step, double* z) {
    double change[PADDED(ENGINE_MAX_STATES)];
    copy_z(self, self->z, z);
    self->kernels->multiply(self->states, width_of(self), rung->change[node], step->vector, change);
    for (int i = 0; i < self->states; i++) {
        z[i] += change[i];
    }
    for (int i = 0; i < self->products; i++) {
        z[column_of(self, i, 0)] = step->values[i * NODES + node];
    }
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
        if ((ticks <= since || level <= self->mode->base) && (self->now & (ticks - 1)) == 0 &&
            self->now + ticks <= tick) {
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
    if (!iterate(self, rung, ticks, step)) {
        return level > 0 ? TOO_LONG : FAILED;
    }
    fit(self, step);
    *tail = find_tail(self, step);
    if (level > 0 && !(*tail <= TAIL_V)) {
        return TOO_LONG;
    }
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
    for (int i = 0; i < self->products; i++) {
        self->moments[i][0] = step->vector[column_of(self, i, 0)];
        memcpy(&self->moments[i][1], &step->vector[column_of(self, i, 1)], NODES * sizeof self->moments[0][0]);
    }
    self->contraction = step->contraction;
    copy_z(self, step->z, self->z);
    self->clear = self->now;
    step_accept(self, INT64_C(1) << level);
    self->now = self->clear;
}

engine_status_t products_advance(engine_t* const self, int64_t tick) {
    const int64_t last = self->counts.steps + MOST_STEPS;
    step_t        step;
    double        tail = 0.0;
    while (self->now < tick) {
        const int       level   = choose_level(self, tick);
        const rung_t*   rung    = reach(self, level);
        const outcome_t outcome = rung == NULL ? FAILED : attempt(self, rung, level, &step, &tail);
        if (outcome == TOO_LONG) {
            self->look = level - 1;
            continue;
        }
        if (outcome == FAILED || self->counts.steps > last) {
            return rung == NULL ? ENGINE_NO_MEMORY : ENGINE_NOT_CONVERGED;
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
