/* See engine.h. */
#include "engine.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#define TOP_LEVEL (ENGINE_LEVELS - 1)
#define NO_LEVEL (-1)
#define MAX_COLUMNS (ENGINE_MAX_STATES + ENGINE_MAX_INPUTS + 1)

/* Matrices that are multiplied in the inner loop are cut into panels of four rows; a panel is stored column by column.
 * */
#define PANEL 4
#define PANELS(rows) (((rows) + PANEL - 1) / PANEL)
#define PANEL_ELEMENTS(rows, columns) (PANELS(rows) * PANEL * (columns))
#define PADDED(rows) (PANELS(rows) * PANEL)

/* Ladders kept at a time; the oldest is replaced. The suspension visits about ten modes. */
#define MODES 64

/* Where a kink comes near without being crossed, steps of h / 64 with a look at their middle are fine enough: whatever
 * is faster than that has just been set off by an event, and after an event the steps grow from one tick. */
#define NEAR_LEVEL (TOP_LEVEL - 6)

/* Taylor series of the exponential: |A t| <= 1/16 and 10 terms leave 1e-21. */
#define TAYLOR_TERMS 10
#define TAYLOR_NORM 0.0625
#define MAX_HALVINGS 40

struct mode {
    unsigned char piece[ENGINE_MAX_KINKS];
    double *ladder; /* ENGINE_LEVELS panelled matrices F = exp([A B c] 2^level ticks) - I, rows of the states only */
};

/* z = [x, u, 1] and the arguments w of the kinks there. */
struct point {
    double z[MAX_COLUMNS];
    double w[PADDED(ENGINE_MAX_KINKS)];
};

struct engine {
    int states, inputs, kinks, outputs, columns;
    double tick_s;
    int64_t events_per_sample;

    bool has_system, has_started;
    double abc[ENGINE_MAX_STATES * MAX_COLUMNS];
    double g[ENGINE_MAX_STATES * ENGINE_MAX_KINKS];
    double cde[ENGINE_MAX_KINKS * MAX_COLUMNS];
    double lmn[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    struct engine_kink kink[ENGINE_MAX_KINKS];
    double cde_panels[PANEL_ELEMENTS(ENGINE_MAX_KINKS, MAX_COLUMNS)];
    double lmn_panels[PANEL_ELEMENTS(ENGINE_MAX_OUTPUTS, MAX_COLUMNS)];

    int64_t now;     /* tick */
    int64_t elapsed; /* ticks since the last event, edge or new circuit; stops counting at one sample period */
    int64_t events_left;
    struct point points[4];
    struct point *before, *here, *there, *middle;
    int level_before; /* of the step that led here from before; NO_LEVEL when w has had a kink here */

    unsigned char piece[ENGINE_MAX_KINKS];
    double lower[ENGINE_MAX_KINKS], upper[ENGINE_MAX_KINKS]; /* bounds of w in the present pieces */
    const struct mode *mode;
    struct mode store[MODES];
    int stored, oldest;

    struct engine_counts counts;
};

/* How a step ended with respect to the bounds of the present mode. */
enum judgement { CLEAR, NEAR, CROSSED };

/* ---- matrices
 * ---------------------------------------------------------------------------------------------------------------- */

static void to_panels(int rows, int columns, int stride, const double *matrix, double *panels)
{
    for (int i = 0; i < PADDED(rows); i++) {
        for (int j = 0; j < columns; j++) {
            panels[((i / PANEL) * columns + j) * PANEL + i % PANEL] = i < rows ? matrix[i * stride + j] : 0.0;
        }
    }
}

/* out = matrix z; out has room for a whole last panel. */
static void product(int rows, int columns, const double *panels, const double *z, double *out)
{
    for (int i = 0; i < rows; i += PANEL) {
        double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
        for (int j = 0; j < columns; j++) {
            const double zj = z[j];
            s0 += panels[0] * zj;
            s1 += panels[1] * zj;
            s2 += panels[2] * zj;
            s3 += panels[3] * zj;
            panels += PANEL;
        }
        out[i] = s0;
        out[i + 1] = s1;
        out[i + 2] = s2;
        out[i + 3] = s3;
    }
}

/* While a ladder is built, its matrices are row-major with rows padded by zeros to whole panels. */
#define MAX_STRIDE PADDED(MAX_COLUMNS)
#define MAX_ELEMENTS (ENGINE_MAX_STATES * MAX_STRIDE)

/* out = left[:, :n] right, with left and right n x stride: the product of two affine maps without their constant rows. */
static void compose(int n, int stride, const double *left, const double *right, double *out)
{
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < stride; j += PANEL) {
            double s0 = 0.0, s1 = 0.0, s2 = 0.0, s3 = 0.0;
            for (int k = 0; k < n; k++) {
                const double factor = left[i * stride + k];
                const double *element = &right[k * stride + j];
                s0 += factor * element[0];
                s1 += factor * element[1];
                s2 += factor * element[2];
                s3 += factor * element[3];
            }
            out[i * stride + j] = s0;
            out[i * stride + j + 1] = s1;
            out[i * stride + j + 2] = s2;
            out[i * stride + j + 3] = s3;
        }
    }
}

/* f <- exp(2 t) - I from f = exp(t) - I: 2 f + f f. Kept as a difference from I, slow states lose no digits. */
static void square(int n, int stride, double *f)
{
    double ff[MAX_ELEMENTS];
    compose(n, stride, f, f, ff);
    for (int i = 0; i < n * stride; i++) {
        f[i] = 2.0 * f[i] + ff[i];
    }
}

/* f = exp(a) - I for small a, by its Taylor series. */
static void taylor(int n, int stride, const double *a, double *f)
{
    double term[MAX_ELEMENTS];
    double next[MAX_ELEMENTS];
    memcpy(term, a, (size_t)(n * stride) * sizeof term[0]);
    memcpy(f, a, (size_t)(n * stride) * sizeof f[0]);
    for (int k = 2; k <= TAYLOR_TERMS; k++) {
        compose(n, stride, a, term, next);
        for (int i = 0; i < n * stride; i++) {
            term[i] = next[i] / (double)k;
            f[i] += term[i];
        }
    }
}

/* Largest absolute row sum of the first n columns. */
static double norm(int n, int stride, const double *a)
{
    double largest = 0.0;
    for (int i = 0; i < n; i++) {
        double sum = 0.0;
        for (int j = 0; j < n; j++) {
            sum += fabs(a[i * stride + j]);
        }
        largest = sum > largest ? sum : largest;
    }
    return largest;
}

/* ---- modes
 * -------------------------------------------------------------------------------------------------------------------
 * */

/* [A B c] + G phi'([C D e]) for the given pieces. */
static void affine_map(const engine *self, const unsigned char *piece, double *a)
{
    const int n = self->states, q = self->kinks, columns = self->columns, stride = PADDED(columns);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < stride; j++) {
            a[i * stride + j] = j < columns ? self->abc[i * columns + j] : 0.0;
        }
    }
    for (int k = 0; k < q; k++) {
        const double slope = self->kink[k].slope[piece[k]];
        const double intercept = self->kink[k].intercept[piece[k]];
        for (int i = 0; i < n; i++) {
            const double gain = self->g[i * q + k];
            for (int j = 0; j < columns; j++) {
                a[i * stride + j] += gain * (slope * self->cde[k * columns + j]);
            }
            a[i * stride + columns - 1] += gain * intercept;
        }
    }
}

static enum engine_status build_ladder(const engine *self, const unsigned char *piece, double *ladder)
{
    const int n = self->states, columns = self->columns, stride = PADDED(columns);
    double a[MAX_ELEMENTS];
    double f[MAX_ELEMENTS];
    double step_s = self->tick_s;
    int halvings = 0;

    affine_map(self, piece, a);
    const double rate = norm(n, stride, a);
    while (!(rate * step_s <= TAYLOR_NORM)) {
        if (++halvings > MAX_HALVINGS) {
            return ENGINE_TOO_STIFF;
        }
        step_s *= 0.5;
    }
    for (int i = 0; i < n * stride; i++) {
        a[i] *= step_s;
    }
    taylor(n, stride, a, f);
    while (halvings-- > 0) {
        square(n, stride, f);
    }
    for (int level = 0; level < ENGINE_LEVELS; level++) {
        to_panels(n, columns, stride, f, &ladder[level * PANEL_ELEMENTS(n, columns)]);
        square(n, stride, f);
    }
    return ENGINE_OK;
}

static const struct mode *find_mode(const engine *self)
{
    for (int i = 0; i < self->stored; i++) {
        if (memcmp(self->store[i].piece, self->piece, (size_t)self->kinks) == 0) {
            return &self->store[i];
        }
    }
    return NULL;
}

static enum engine_status make_mode(engine *self)
{
    struct mode *slot = &self->store[self->oldest];
    if (slot->ladder == NULL) {
        const int elements = ENGINE_LEVELS * PANEL_ELEMENTS(self->states, self->columns);
        slot->ladder = malloc((size_t)elements * sizeof(double));
        if (slot->ladder == NULL) {
            return ENGINE_NO_MEMORY;
        }
    }
    memcpy(slot->piece, self->piece, (size_t)self->kinks);
    self->oldest = (self->oldest + 1) % MODES;
    self->stored = self->stored < MODES ? self->stored + 1 : MODES;
    self->mode = slot;
    self->counts.modes_built++;
    return build_ladder(self, slot->piece, slot->ladder);
}

/* The mode in which the circuit is here; afterwards the steps grow from one tick again. */
static enum engine_status enter_mode(engine *self)
{
    for (int k = 0; k < self->kinks; k++) {
        const struct engine_kink *kink = &self->kink[k];
        const double w = self->here->w[k];
        if (!isfinite(w)) {
            return ENGINE_NOT_FINITE;
        }
        self->piece[k] = w < kink->lower ? 0 : w > kink->upper ? 2 : 1;
        self->lower[k] = self->piece[k] == 0 ? -(double)INFINITY : self->piece[k] == 1 ? kink->lower : kink->upper;
        self->upper[k] = self->piece[k] == 0 ? kink->lower : self->piece[k] == 1 ? kink->upper : (double)INFINITY;
    }
    self->elapsed = 0;
    self->level_before = NO_LEVEL;
    self->mode = find_mode(self);
    return self->mode != NULL ? ENGINE_OK : make_mode(self);
}

/* ---- steps
 * -------------------------------------------------------------------------------------------------------------------
 * */

static void measure(const engine *self, struct point *point)
{
    product(self->kinks, self->columns, self->cde_panels, point->z, point->w);
}

static void step(engine *self, int level, struct point *to)
{
    double change[PADDED(ENGINE_MAX_STATES)];
    const double *f = &self->mode->ladder[level * PANEL_ELEMENTS(self->states, self->columns)];
    product(self->states, self->columns, f, self->here->z, change);
    for (int i = 0; i < self->states; i++) {
        to->z[i] = self->here->z[i] + change[i];
    }
    measure(self, to);
    self->counts.steps++;
}

/* By what factor a step of this level is longer than the one before it; 0 when there is none to compare with. */
static double growth(const engine *self, int level)
{
    if (self->level_before == NO_LEVEL) {
        return 0.0;
    }
    return (double)(INT64_C(1) << level) / (double)(INT64_C(1) << self->level_before);
}

/* A step that ends inside all bounds is CLEAR when w could not have left them on the way even if, beyond the values at
 * both ends, it had strayed by as much as it changes in this step, or would at the speed of the step before. (Over the
 * top of a peak the former alone may be nothing.) */
static enum judgement judge(const engine *self, int level, const struct point *to)
{
    const double *before = self->before->w, *here = self->here->w;
    const double factor = growth(self, level);
    bool near = false;
    for (int k = 0; k < self->kinks; k++) {
        const double w0 = here[k], w1 = to->w[k];
        const double lower = self->lower[k], upper = self->upper[k];
        if (!(w1 >= lower && w1 <= upper)) {
            return CROSSED;
        }
        const double change = fabs(w1 - w0), change_before = factor * fabs(w0 - before[k]);
        const double stray = change > change_before ? change : change_before;
        near |= (w0 > w1 ? w0 : w1) + stray > upper || (w0 < w1 ? w0 : w1) - stray < lower;
    }
    return near ? NEAR : CLEAR;
}

static enum judgement attempt(engine *self, int level, struct point *to)
{
    step(self, level, to);
    return judge(self, level, to);
}

static void accept(engine *self, int level)
{
    const int64_t ticks = INT64_C(1) << level;
    struct point *oldest = self->before;
    self->before = self->here;
    self->here = self->there;
    self->there = oldest;
    self->level_before = level;
    self->now += ticks;
    self->elapsed += ticks;
    if (self->elapsed > ENGINE_TICKS_PER_SAMPLE) {
        self->elapsed = ENGINE_TICKS_PER_SAMPLE;
    }
}

/* The longest step allowed: not longer than the time since the last event, so that the steps after it are 1, 1, 2, 4,
 * ... ticks and see whatever it set off, at the scale at which that happens. */
static int longest_level(const engine *self, int64_t ticks)
{
    const int64_t limit = ticks < self->elapsed ? ticks : self->elapsed;
    if (limit >= ENGINE_TICKS_PER_SAMPLE) {
        return TOP_LEVEL;
    }
    int level = 0;
    while ((INT64_C(2) << level) <= limit) {
        level++;
    }
    return level;
}

/* A bound is crossed within the next 2^level ticks: closes in on it, steps over it by less than a tick, and enters the
 * mode beyond. */
static enum engine_status cross(engine *self, int level)
{
    while (--level >= 0) {
        if (attempt(self, level, self->there) != CROSSED) {
            accept(self, level);
        }
    }
    const enum judgement last = attempt(self, 0, self->there);
    accept(self, 0);
    if (last != CROSSED) {
        return ENGINE_OK;
    }
    self->counts.events++;
    return self->events_left-- > 0 ? enter_mode(self) : ENGINE_EVENTS;
}

/* One step, of at most the given number of ticks. */
static enum engine_status stride(engine *self, int64_t ticks)
{
    int level = longest_level(self, ticks);
    enum judgement judgement = attempt(self, level, self->there);
    while (judgement == NEAR && level > NEAR_LEVEL) {
        judgement = attempt(self, --level, self->there);
    }
    if (judgement == NEAR && level > 0) {
        judgement = attempt(self, level - 1, self->middle);
    }
    if (judgement == CROSSED) {
        return cross(self, level);
    }
    accept(self, level);
    return ENGINE_OK;
}

static enum engine_status advance(engine *self, int64_t tick)
{
    enum engine_status status = ENGINE_OK;
    while (status == ENGINE_OK && self->now < tick) {
        status = stride(self, tick - self->now);
    }
    return status;
}

/* ---- the public functions
 * ------------------------------------------------------------------------------------------------------ */

static bool within(int value, int low, int high)
{
    return value >= low && value <= high;
}

engine *engine_new(int states, int inputs, int kinks, int outputs, double sample_period_s, int64_t events_per_sample)
{
    if (!within(states, 0, ENGINE_MAX_STATES) || !within(inputs, 0, ENGINE_MAX_INPUTS) ||
        !within(kinks, 0, ENGINE_MAX_KINKS) || !within(outputs, 0, ENGINE_MAX_OUTPUTS) || !(sample_period_s > 0.0)) {
        return NULL;
    }
    engine *self = calloc(1, sizeof *self);
    if (self == NULL) {
        return NULL;
    }
    self->states = states;
    self->inputs = inputs;
    self->kinks = kinks;
    self->outputs = outputs;
    self->columns = states + inputs + 1;
    self->tick_s = sample_period_s / (double)ENGINE_TICKS_PER_SAMPLE;
    self->events_per_sample = events_per_sample;
    self->here = &self->points[0];
    self->there = &self->points[1];
    self->middle = &self->points[2];
    self->before = &self->points[3];
    for (int i = 0; i < 4; i++) {
        self->points[i].z[self->columns - 1] = 1.0;
    }
    return self;
}

void engine_free(engine *self)
{
    if (self == NULL) {
        return;
    }
    for (int i = 0; i < MODES; i++) {
        free(self->store[i].ladder);
    }
    free(self);
}

/* Copies count elements; true when they differ from those before. */
static bool replace(void *to, const void *from, size_t count, size_t size)
{
    if (count == 0U || memcmp(to, from, count * size) == 0) {
        return false;
    }
    memcpy(to, from, count * size);
    return true;
}

enum engine_status engine_set_system(
    engine *self, const double *abc, const double *g, const double *cde, const double *lmn,
    const struct engine_kink *kinks)
{
    const size_t n = (size_t)self->states, q = (size_t)self->kinks, p = (size_t)self->outputs;
    const size_t columns = (size_t)self->columns;
    bool changed = !self->has_system;
    changed |= replace(self->abc, abc, n * columns, sizeof(double));
    changed |= replace(self->g, g, n * q, sizeof(double));
    changed |= replace(self->cde, cde, q * columns, sizeof(double));
    changed |= replace(self->kink, kinks, q, sizeof(struct engine_kink));
    if (replace(self->lmn, lmn, p * columns, sizeof(double))) {
        to_panels(self->outputs, self->columns, self->columns, self->lmn, self->lmn_panels);
    }
    if (!changed) {
        return ENGINE_OK;
    }
    self->has_system = true;
    self->stored = 0;
    self->oldest = 0;
    to_panels(self->kinks, self->columns, self->columns, self->cde, self->cde_panels);
    measure(self, self->here);
    return enter_mode(self);
}

void engine_get_state(const engine *self, double *x)
{
    memcpy(x, self->here->z, (size_t)self->states * sizeof x[0]);
}

enum engine_status engine_set_state(engine *self, const double *x)
{
    if (!self->has_system) {
        return ENGINE_NO_SYSTEM;
    }
    memcpy(self->here->z, x, (size_t)self->states * sizeof x[0]);
    measure(self, self->here);
    return enter_mode(self);
}

/* Goes to the instant of an edge and applies it. An edge to the present level is none: it must not change how the steps
 * are cut. */
static enum engine_status take_edge(engine *self, int64_t tick, int32_t input, double level)
{
    if (tick < self->now || input < 0 || input >= self->inputs) {
        return ENGINE_EDGE;
    }
    const int column = self->states + (int)input;
    const double before = self->here->z[column];
    if (before >= level && before <= level) {
        return ENGINE_OK;
    }
    const enum engine_status status = advance(self, tick);
    if (status != ENGINE_OK) {
        return status;
    }
    for (int i = 0; i < 4; i++) {
        self->points[i].z[column] = level;
    }
    measure(self, self->here);
    return enter_mode(self);
}

static bool is_finite(const engine *self)
{
    bool finite = true;
    for (int i = 0; i < self->states; i++) {
        finite = finite && isfinite(self->here->z[i]);
    }
    return finite;
}

static void record(const engine *self, double *y)
{
    double padded[PADDED(ENGINE_MAX_OUTPUTS)];
    product(self->outputs, self->columns, self->lmn_panels, self->here->z, padded);
    memcpy(y, padded, (size_t)self->outputs * sizeof y[0]);
}

enum engine_status engine_run(
    engine *self, int64_t samples, int64_t edges, const int64_t *tick, const int32_t *input, const double *level,
    double *y)
{
    enum engine_status status = self->has_system ? ENGINE_OK : ENGINE_NO_SYSTEM;
    int64_t edge = 0;
    for (int64_t k = 0; status == ENGINE_OK && k < samples; k++) {
        const int64_t instant = self->has_started ? self->now + ENGINE_TICKS_PER_SAMPLE : self->now;
        self->has_started = true;
        self->events_left = self->events_per_sample;
        while (status == ENGINE_OK && edge < edges && tick[edge] <= instant) {
            status = take_edge(self, tick[edge], input[edge], level[edge]);
            edge++;
        }
        if (status == ENGINE_OK) {
            status = advance(self, instant);
        }
        if (status == ENGINE_OK) {
            record(self, &y[k * self->outputs]);
            self->counts.samples++;
        }
    }
    if (status == ENGINE_OK && edge < edges) {
        status = ENGINE_EDGE;
    }
    return status == ENGINE_OK && !is_finite(self) ? ENGINE_NOT_FINITE : status;
}

void engine_get_counts(const engine *self, struct engine_counts *counts)
{
    *counts = self->counts;
}

/* ---- linear equations
 * ---------------------------------------------------------------------------------------------------------- */

/* A pivot smaller than this part of the largest element its column began with counts as none: it is what rounding
 * leaves of a zero. */
#define PIVOT_TOLERANCE 1e-13

static void swap_rows(int columns, double *matrix, int i, int j)
{
    for (int k = 0; k < columns; k++) {
        const double kept = matrix[i * columns + k];
        matrix[i * columns + k] = matrix[j * columns + k];
        matrix[j * columns + k] = kept;
    }
}

static int largest_in_column(int n, const double *a, int column, int first)
{
    int best = first;
    for (int i = first + 1; i < n; i++) {
        if (fabs(a[i * n + column]) > fabs(a[best * n + column])) {
            best = i;
        }
    }
    return best;
}

static void eliminate(int n, int columns, double *a, double *b, int pivot, int row)
{
    const double factor = a[row * n + pivot] / a[pivot * n + pivot];
    if (fabs(factor) > 0.0) {
        for (int j = pivot; j < n; j++) {
            a[row * n + j] -= factor * a[pivot * n + j];
        }
        for (int j = 0; j < columns; j++) {
            b[row * columns + j] -= factor * b[pivot * columns + j];
        }
    }
}

static void substitute_back(int n, int columns, const double *a, double *b)
{
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) {
            const double factor = a[i * n + k];
            for (int j = 0; j < columns; j++) {
                b[i * columns + j] -= factor * b[k * columns + j];
            }
        }
        for (int j = 0; j < columns; j++) {
            b[i * columns + j] /= a[i * n + i];
        }
    }
}

int engine_solve(int n, int columns, double *a, double *b)
{
    double least[ENGINE_MAX_UNKNOWNS];
    if (n > ENGINE_MAX_UNKNOWNS) {
        return ENGINE_MAX_UNKNOWNS;
    }
    for (int j = 0; j < n; j++) {
        least[j] = PIVOT_TOLERANCE * fabs(a[largest_in_column(n, a, j, 0) * n + j]);
    }
    for (int pivot = 0; pivot < n; pivot++) {
        const int best = largest_in_column(n, a, pivot, pivot);
        if (!(fabs(a[best * n + pivot]) > least[pivot])) {
            return pivot;
        }
        swap_rows(n, a, pivot, best);
        swap_rows(columns, b, pivot, best);
        for (int row = pivot + 1; row < n; row++) {
            eliminate(n, columns, a, b, pivot, row);
        }
    }
    substitute_back(n, columns, a, b);
    return -1;
}
