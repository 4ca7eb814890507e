/* See engine.h. */
#include "engine.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>
#include <string.h>

#define TOP_LEVEL (ENGINE_LEVELS - 1)
#define NO_LEVEL (-1)
#define NEVER INT64_C(-1)
#define MAX_COLUMNS (ENGINE_MAX_STATES + ENGINE_MAX_INPUTS + 1)

/* Matrices that are multiplied in the inner loop are cut into panels of four rows; a panel is stored column by column. */
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
#define SERIES_END 1e-24

/* In quiet stretches so many samples are computed from the same state: they need not wait for one another. */
#define LEAP 4
#define LEAP_DOUBLINGS 2

/* What a mode keeps of its states in a sample period, as a part of the largest: less than this counts as nothing. It is
 * above the rounding errors of the ladder, and 1e-12 V of 10 V. */
#define FORGOTTEN 1e-13

/* Doublings of the series that sums a Lyapunov equation: enough for rates that differ by 2^50. */
#define LYAPUNOV_DOUBLINGS 60
#define LYAPUNOV_END 1e-12
#define CERTAINTY (1.0 - 1e-9)

/* Up to so many combinations of pieces are checked for a unique solution beforehand; of more, those that occur. */
#define MAX_COMBINATIONS 4096

/* The slow part of a mode, s = x[row]: a sample period after its last event, x is a function of s, u and 1 alone.
 * Panelled matrices over [s u 1]; rest and rest_w over [u 1]. */
struct slow {
    int rank;
    bool certain; /* the matrices below exist: s comes to rest, and a Lyapunov function says how far it strays before */
    int row[ENGINE_MAX_STATES];
    double change[PANEL_ELEMENTS(ENGINE_MAX_STATES, MAX_COLUMNS)]; /* of s in a sample period */
    double leap[PANEL_ELEMENTS(ENGINE_MAX_STATES, MAX_COLUMNS)];   /* of s in LEAP of them */
    double state[PANEL_ELEMENTS(ENGINE_MAX_STATES, MAX_COLUMNS)];  /* x */
    double y[LEAP * PANEL_ELEMENTS(ENGINE_MAX_OUTPUTS, MAX_COLUMNS)]; /* 1, 2, ... LEAP samples later, one by one */
    double rest[PANEL_ELEMENTS(ENGINE_MAX_STATES, ENGINE_MAX_INPUTS + 1)];  /* s at rest */
    double rest_w[PANEL_ELEMENTS(ENGINE_MAX_KINKS, ENGINE_MAX_INPUTS + 1)]; /* w there */
    double energy[ENGINE_MAX_STATES * ENGINE_MAX_STATES]; /* Q: e'Q e, e the distance from rest, never grows */
    double reach[ENGINE_MAX_KINKS];                       /* (w - rest_w)^2 <= reach e'Q e */
};

struct mode {
    unsigned char piece[ENGINE_MAX_KINKS];
    double *ladder; /* ENGINE_LEVELS panelled matrices F = exp([A B c] 2^level ticks) - I, rows of the states only */
    double *direct; /* panelled w and y over z where phi feeds them; NULL when it feeds none */
    struct slow *slow;
    bool has_slow;
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

    bool has_system;
    double abc[ENGINE_MAX_STATES * MAX_COLUMNS];
    double g[ENGINE_MAX_STATES * ENGINE_MAX_KINKS];
    double cde[ENGINE_MAX_KINKS * MAX_COLUMNS];
    double w_phi[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    double lmn[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    double y_phi[ENGINE_MAX_OUTPUTS * ENGINE_MAX_KINKS];
    bool feeds; /* whether phi feeds any w or y */
    int coupled[ENGINE_MAX_KINKS], coupled_count; /* the kinks that feed a w */
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
    struct mode *mode;
    const double *w_panels, *y_panels; /* of the present mode */
    bool quiet;                        /* slow_z holds the state, and no event can come before the next edge */
    bool has_limit;
    double energy_limit;         /* e'Q e below which no event can come; negative when there is none */
    double slow_z[MAX_COLUMNS]; /* [s u 1] some samples ago, as many as: */
    int slow_age;
    struct mode store[MODES];
    int stored, oldest;

    int64_t patience;                  /* ticks; see engine_watch */
    int64_t outside[ENGINE_MAX_KINKS]; /* the tick since which a kink has been outside its middle piece, or NEVER */
    int64_t overdue[ENGINE_MAX_KINKS]; /* what engine_get_overdue tells of kinks that have come back since */

    struct engine_counts counts;
};

/* How a step ended with respect to the bounds of the present mode. */
enum judgement { CLEAR, NEAR, CROSSED };

/* ---- matrices ---- */

static void to_panels(int rows, int columns, int stride, const double *matrix, double *panels)
{
    for (int i = 0; i < PADDED(rows); i++) {
        for (int j = 0; j < columns; j++) {
            panels[((i / PANEL) * columns + j) * PANEL + i % PANEL] = i < rows ? matrix[i * stride + j] : 0.0;
        }
    }
}

/* out = matrix z; out has room for a whole last panel. */
static inline void product(int rows, int columns, const double *panels, const double *z, double *out)
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

/* f = exp(a) - I for a of small norm, rate, by its Taylor series. */
static void taylor(int n, int stride, double rate, const double *a, double *f)
{
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

/* ---- linear equations ---- */

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

/* ---- modes ---- */

/* I - [w_phi] diag(slopes) of the given pieces, restricted to the kinks listed. */
static void feedback(const engine *self, const unsigned char *piece, int count, const int *listed, double *a)
{
    for (int i = 0; i < count; i++) {
        for (int j = 0; j < count; j++) {
            const int k = listed[j];
            const double fed = self->w_phi[listed[i] * self->kinks + k] * self->kink[k].slope[piece[k]];
            a[i * count + j] = (i == j ? 1.0 : 0.0) - fed;
        }
    }
}

/* Adds phi_gain phi(w) to rows of an affine function of z, w being affine too: the kinks in the given pieces. */
static void add_phi(
    const engine *self, const unsigned char *piece, const double *w, int rows, const double *phi_gain, int stride,
    double *a)
{
    const int columns = self->columns;
    for (int k = 0; k < self->kinks; k++) {
        const double slope = self->kink[k].slope[piece[k]];
        const double intercept = self->kink[k].intercept[piece[k]];
        for (int i = 0; i < rows; i++) {
            const double gain = phi_gain[i * self->kinks + k];
            for (int j = 0; j < columns; j++) {
                a[i * stride + j] += gain * (slope * w[k * columns + j]);
            }
            a[i * stride + columns - 1] += gain * intercept;
        }
    }
}

/* w over z in the given pieces: the solution of w = [C D e] z + w_phi phi(w). */
static void arguments(const engine *self, const unsigned char *piece, double *w)
{
    const int q = self->kinks, columns = self->columns;
    int all[ENGINE_MAX_KINKS];
    double a[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    memcpy(w, self->cde, (size_t)(q * columns) * sizeof w[0]);
    if (self->coupled_count == 0) {
        return;
    }
    for (int k = 0; k < q; k++) {
        all[k] = k;
        for (int i = 0; i < q; i++) {
            w[i * columns + columns - 1] += self->w_phi[i * q + k] * self->kink[k].intercept[piece[k]];
        }
    }
    feedback(self, piece, q, all, a);
    (void)engine_solve(q, columns, a, w); /* that it can be solved has been checked: has_one_sign() */
}

/* [A B c] + G phi'(w) for the given pieces. */
static void affine_map(const engine *self, const unsigned char *piece, double *a)
{
    const int n = self->states, columns = self->columns, stride = PADDED(columns);
    double w[ENGINE_MAX_KINKS * MAX_COLUMNS];
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < stride; j++) {
            a[i * stride + j] = j < columns ? self->abc[i * columns + j] : 0.0;
        }
    }
    arguments(self, piece, w);
    add_phi(self, piece, w, n, self->g, stride, a);
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
    taylor(n, stride, rate * step_s, a, f);
    while (halvings-- > 0) {
        square(n, stride, f);
    }
    for (int level = 0; level < ENGINE_LEVELS; level++) {
        to_panels(n, columns, stride, f, &ladder[level * PANEL_ELEMENTS(n, columns)]);
        square(n, stride, f);
    }
    return ENGINE_OK;
}

static struct mode *find_mode(engine *self)
{
    for (int i = 0; i < self->stored; i++) {
        if (memcmp(self->store[i].piece, self->piece, (size_t)self->kinks) == 0) {
            return &self->store[i];
        }
    }
    return NULL;
}

/* w and y of a mode over z, where phi feeds them. */
static void build_direct(const engine *self, const unsigned char *piece, double *direct)
{
    const int q = self->kinks, p = self->outputs, columns = self->columns;
    double w[ENGINE_MAX_KINKS * MAX_COLUMNS];
    double y[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    arguments(self, piece, w);
    memcpy(y, self->lmn, (size_t)(p * columns) * sizeof y[0]);
    add_phi(self, piece, w, p, self->y_phi, columns, y);
    to_panels(q, columns, columns, w, direct);
    to_panels(p, columns, columns, y, &direct[PANEL_ELEMENTS(q, columns)]);
}

static bool allocate(double **elements, int count)
{
    if (*elements == NULL) {
        *elements = malloc((size_t)count * sizeof(double));
    }
    return *elements != NULL;
}

static enum engine_status make_mode(engine *self)
{
    struct mode *slot = &self->store[self->oldest];
    const int columns = self->columns;
    const int direct = PANEL_ELEMENTS(self->kinks, columns) + PANEL_ELEMENTS(self->outputs, columns);
    if (!allocate(&slot->ladder, ENGINE_LEVELS * PANEL_ELEMENTS(self->states, columns)) ||
        (self->feeds && !allocate(&slot->direct, direct))) {
        return ENGINE_NO_MEMORY;
    }
    memcpy(slot->piece, self->piece, (size_t)self->kinks);
    slot->has_slow = false;
    self->oldest = (self->oldest + 1) % MODES;
    self->stored = self->stored < MODES ? self->stored + 1 : MODES;
    self->mode = slot;
    self->counts.modes_built++;
    if (self->feeds) {
        build_direct(self, slot->piece, slot->direct);
    }
    return build_ladder(self, slot->piece, slot->ladder);
}

/* The first tick at which a kink had been outside for as long as patience allows, by now; NEVER if it has not. */
static int64_t overdue(const engine *self, int kink)
{
    if (self->overdue[kink] != NEVER || self->outside[kink] == NEVER) {
        return self->overdue[kink];
    }
    const int64_t due = self->outside[kink] + self->patience;
    return due <= self->now ? due : NEVER;
}

/* Notes that a kink is in its present piece from here on. */
static void watch(engine *self, int kink)
{
    if (self->piece[kink] == 1) {
        self->overdue[kink] = overdue(self, kink);
        self->outside[kink] = NEVER;
    } else if (self->outside[kink] == NEVER) {
        self->outside[kink] = self->now;
    }
}

static void measure(const engine *self, struct point *point)
{
    product(self->kinks, self->columns, self->w_panels, point->z, point->w);
}

static unsigned char piece_of(const struct engine_kink *kink, double w)
{
    return w < kink->lower ? 0 : w > kink->upper ? 2 : 1;
}

static double lower_bound(const struct engine_kink *kink, unsigned char piece)
{
    return piece == 0 ? -(double)INFINITY : piece == 1 ? kink->lower : kink->upper;
}

static double upper_bound(const struct engine_kink *kink, unsigned char piece)
{
    return piece == 0 ? kink->lower : piece == 1 ? kink->upper : (double)INFINITY;
}

/* What part of the way along a coupled w stays within its piece; the kink that ends it, or -1. */
static double way_within(
    const engine *self, const unsigned char *piece, const double *w, const double *way, int *ends_at)
{
    double part = 1.0;
    *ends_at = -1;
    for (int i = 0; i < self->coupled_count; i++) {
        const int k = self->coupled[i];
        const struct engine_kink *kink = &self->kink[k];
        const double bound = way[i] > 0.0 ? upper_bound(kink, piece[k]) : lower_bound(kink, piece[k]);
        if (fabs(way[i]) > 0.0 && (bound - w[i]) / way[i] < part) {
            part = (bound - w[i]) / way[i];
            *ends_at = i;
        }
    }
    return part;
}

/* The coupled w from their values without any phi, by Katzenelson's walk: from w = 0 straight to the wanted right-hand
 * side, in every piece along its linear map. There is one solution, and the walk ends there, when all these maps have
 * determinants of one sign (Kojima and Saigal 1979). Leaves pieces and w at it. */
static bool solve_coupled(const engine *self, const double *wanted, unsigned char *piece, double *w)
{
    const int count = self->coupled_count;
    double left[ENGINE_MAX_KINKS], way[ENGINE_MAX_KINKS], a[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    for (int i = 0; i < count; i++) {
        w[i] = 0.0;
        piece[self->coupled[i]] = piece_of(&self->kink[self->coupled[i]], 0.0);
    }
    for (int i = 0; i < count; i++) {
        left[i] = wanted[self->coupled[i]];
        for (int j = 0; j < count; j++) {
            const int k = self->coupled[j];
            left[i] += self->w_phi[self->coupled[i] * self->kinks + k] * self->kink[k].intercept[piece[k]];
        }
    }
    for (int flips = 0; flips <= 16 * ENGINE_MAX_KINKS; flips++) {
        int ends_at;
        memcpy(way, left, (size_t)count * sizeof way[0]);
        feedback(self, piece, count, self->coupled, a);
        if (engine_solve(count, 1, a, way) >= 0) {
            return false;
        }
        const double part = way_within(self, piece, w, way, &ends_at);
        for (int i = 0; i < count; i++) {
            w[i] += part * way[i];
            left[i] *= 1.0 - part;
        }
        if (ends_at < 0) {
            return true;
        }
        const int k = self->coupled[ends_at];
        w[ends_at] = way[ends_at] > 0.0 ? upper_bound(&self->kink[k], piece[k]) : lower_bound(&self->kink[k], piece[k]);
        piece[k] = (unsigned char)(way[ends_at] > 0.0 ? piece[k] + 1 : piece[k] - 1);
    }
    return false;
}

/* here->w from z alone; where kinks feed one another, it is solved for. */
static enum engine_status find_arguments(engine *self)
{
    double *w = self->here->w;
    double coupled_w[ENGINE_MAX_KINKS];
    product(self->kinks, self->columns, self->cde_panels, self->here->z, w);
    for (int k = 0; k < self->kinks; k++) {
        if (!isfinite(w[k])) {
            return ENGINE_NOT_FINITE;
        }
    }
    if (self->coupled_count == 0) {
        return ENGINE_OK;
    }
    if (!solve_coupled(self, w, self->piece, coupled_w)) {
        return ENGINE_NOT_UNIQUE;
    }
    for (int j = 0; j < self->coupled_count; j++) {
        const struct engine_kink *kink = &self->kink[self->coupled[j]];
        const unsigned char piece = self->piece[self->coupled[j]];
        const double phi = kink->slope[piece] * coupled_w[j] + kink->intercept[piece];
        for (int i = 0; i < self->kinks; i++) {
            w[i] += self->w_phi[i * self->kinks + self->coupled[j]] * phi;
        }
    }
    return ENGINE_OK;
}

/* The mode in which the circuit is here; afterwards the steps grow from one tick again. */
static enum engine_status enter_mode(engine *self)
{
    enum engine_status status = find_arguments(self);
    if (status != ENGINE_OK) {
        return status;
    }
    for (int k = 0; k < self->kinks; k++) {
        self->piece[k] = piece_of(&self->kink[k], self->here->w[k]);
        self->lower[k] = lower_bound(&self->kink[k], self->piece[k]);
        self->upper[k] = upper_bound(&self->kink[k], self->piece[k]);
        watch(self, k);
    }
    self->elapsed = 0;
    self->level_before = NO_LEVEL;
    self->quiet = false;
    self->has_limit = false;
    self->mode = find_mode(self);
    if (self->mode == NULL) {
        status = make_mode(self);
    }
    if (status == ENGINE_OK && self->feeds) {
        self->w_panels = self->mode->direct;
        self->y_panels = &self->mode->direct[PANEL_ELEMENTS(self->kinks, self->columns)];
        measure(self, self->here);
    }
    return status;
}

/* ---- steps ---- */

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
static enum engine_status one_step(engine *self, int64_t ticks)
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

/* ---- quiet stretches ---- */

/* The rows of exp(A h) that all others depend on, found by elimination: slow ones first, so that nothing cancels in
 * their changes. e = exp(A h), f = e - I. Returns how many; column[i] is where row[i] has its pivot. */
static int independent_rows(int n, const double *e, const double *slowness, int *row, int *column)
{
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
                    best = size * slowness[i];
                    row[rank] = i;
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

/* One element of a panelled matrix. */
static double element(const double *panels, int columns, int i, int j)
{
    return panels[((i / PANEL) * columns + j) * PANEL + i % PANEL];
}

/* out = matrix (rows over z) after x = map over [s u 1]: rows over [s u 1], row-major. */
static void over_slow(
    const engine *self, int rank, int rows, const double *matrix, int stride, const double *map, double *out)
{
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

/* x over [s u 1], row-major: x = U s + (b - U b_s) [u 1], with e = U e_s, x(h) = e x(0) + b [u 1]. */
static bool slow_map(const engine *self, struct slow *slow, const double *f, double *map)
{
    const int n = self->states, columns = self->columns, constants = columns - n;
    double e[ENGINE_MAX_STATES * ENGINE_MAX_STATES], slowness[ENGINE_MAX_STATES];
    double a[ENGINE_MAX_STATES * ENGINE_MAX_STATES], u[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    int column[ENGINE_MAX_STATES];
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

static void multiply(int n, const double *left, const double *right, bool transpose_left, double *out)
{
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            double sum = 0.0;
            for (int k = 0; k < n; k++) {
                sum += left[transpose_left ? k * n + i : i * n + k] * right[k * n + j];
            }
            out[i * n + j] = sum;
        }
    }
}

/* q = the sum over k of (e')^k r e^k, by doubling; e is overwritten. False when it does not converge. */
static bool sum_series(int n, double *e, const double *r, double *q)
{
    double qe[ENGINE_MAX_STATES * ENGINE_MAX_STATES], eqe[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    memcpy(q, r, (size_t)(n * n) * sizeof q[0]);
    for (int k = 0; k < LYAPUNOV_DOUBLINGS; k++) {
        if (norm(n, n, e) < LYAPUNOV_END) {
            return true;
        }
        multiply(n, q, e, false, qe);
        multiply(n, e, qe, true, eqe);
        for (int i = 0; i < n * n; i++) {
            q[i] += eqe[i];
        }
        multiply(n, e, e, false, eqe);
        memcpy(e, eqe, (size_t)(n * n) * sizeof e[0]);
    }
    return false;
}

/* q with a'q + q a = -rate I, so that e'q e never grows along de/dt = a e. By Cayley's transform with p = rate, the norm
 * of a: q = sum (E')^k r E^k, E = (p - a)^-1 (p + a), r = 2 p^2 (p - a)^-T (p - a)^-1 (Smith 1968). What comes out is
 * checked: a'q + q a + rate I must be small against rate I. */
static bool lyapunov(int n, const double *a, double *q)
{
    const double p = norm(n, n, a);
    double left[ENGINE_MAX_STATES * ENGINE_MAX_STATES], right[2 * ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double e[ENGINE_MAX_STATES * ENGINE_MAX_STATES], inverse[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double r[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            const double one = i == j ? 1.0 : 0.0;
            left[i * n + j] = p * one - a[i * n + j];
            right[i * 2 * n + j] = p * one + a[i * n + j];
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
    multiply(n, inverse, inverse, true, r);
    for (int i = 0; i < n * n; i++) {
        r[i] *= 2.0 * p * p;
    }
    if (!sum_series(n, e, r, q)) {
        return false;
    }
    multiply(n, q, a, false, left);
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            r[i * n + j] = left[i * n + j] + left[j * n + i] + (i == j ? p : 0.0);
        }
    }
    return norm(n, n, r) <= 0.5 * p;
}

/* s at rest over [u 1], from its change over [s u 1]. */
static bool find_rest(int rank, int constants, const double *change, double *rest)
{
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

/* How far each w strays from rest: w - rest_w = c e, so its square is at most (c Q^-1 c') e'Q e. */
static bool find_reach(int rank, int width, int kinks, const double *w, const double *energy, double *reach)
{
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

static void from_panels(int rows, int columns, const double *panels, double *matrix)
{
    for (int i = 0; i < rows; i++) {
        for (int j = 0; j < columns; j++) {
            matrix[i * columns + j] = element(panels, columns, i, j);
        }
    }
}

/* Rows [first, first + 1, ...] of over_slow for the slow states alone. */
static void over_slow_rows(
    const engine *self, const struct slow *slow, const double *matrix, int stride, const double *map, double *out)
{
    const int width = slow->rank + self->columns - self->states;
    for (int i = 0; i < slow->rank; i++) {
        over_slow(self, slow->rank, 1, &matrix[slow->row[i] * stride], stride, map, &out[i * width]);
    }
}

static bool certify(const engine *self, struct slow *slow, const double *map, const double *w, const double *change)
{
    const int rank = slow->rank, constants = self->columns - self->states, width = rank + constants;
    double a[MAX_ELEMENTS], flow[ENGINE_MAX_STATES * MAX_COLUMNS], rate[ENGINE_MAX_STATES * ENGINE_MAX_STATES];
    double rest[ENGINE_MAX_STATES * (ENGINE_MAX_INPUTS + 1)], rest_w[ENGINE_MAX_KINKS * (ENGINE_MAX_INPUTS + 1)];
    affine_map(self, self->mode->piece, a);
    over_slow_rows(self, slow, a, PADDED(self->columns), map, flow);
    for (int i = 0; i < rank; i++) {
        memcpy(&rate[i * rank], &flow[i * width], (size_t)rank * sizeof rate[0]);
    }
    if (!find_rest(rank, constants, change, rest) || !lyapunov(rank, rate, slow->energy) ||
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
    to_panels(rank, constants, constants, rest, slow->rest);
    to_panels(self->kinks, constants, constants, rest_w, slow->rest_w);
    return true;
}

/* later = rows (I + change): what rows over [s u 1] give a sample later. */
static void after_sample(int rank, int width, int rows, const double *change, const double *row, double *later)
{
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

/* The slow part of the present mode. */
static void build_slow(const engine *self, struct slow *slow)
{
    const int n = self->states, q = self->kinks, p = self->outputs, columns = self->columns;
    double f[ENGINE_MAX_STATES * MAX_COLUMNS], map[ENGINE_MAX_STATES * MAX_COLUMNS];
    double change[ENGINE_MAX_STATES * MAX_COLUMNS];
    double rows[ENGINE_MAX_OUTPUTS * MAX_COLUMNS], y[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    double later[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    double w[ENGINE_MAX_KINKS * MAX_COLUMNS];
    from_panels(n, columns, &self->mode->ladder[TOP_LEVEL * PANEL_ELEMENTS(n, columns)], f);
    slow->certain = false;
    if (!slow_map(self, slow, f, map)) {
        return;
    }
    const int rank = slow->rank, width = rank + columns - n;
    over_slow_rows(self, slow, f, columns, map, change);
    to_panels(rank, width, width, change, slow->change);
    to_panels(n, width, width, map, slow->state);
    from_panels(p, columns, self->y_panels, rows);
    over_slow(self, rank, p, rows, columns, map, y);
    for (int i = 0; i < LEAP; i++) {
        after_sample(rank, width, p, change, y, later);
        to_panels(p, width, width, later, &slow->y[i * PANEL_ELEMENTS(p, width)]);
        memcpy(y, later, (size_t)(p * width) * sizeof y[0]);
    }
    from_panels(q, columns, self->w_panels, rows);
    over_slow(self, rank, q, rows, columns, map, w);
    slow->certain = certify(self, slow, map, w, change);
    for (int i = 0; i < LEAP_DOUBLINGS; i++) {
        memcpy(later, change, (size_t)(rank * width) * sizeof later[0]);
        after_sample(rank, width, rank, later, later, change);
        for (int k = 0; k < rank * width; k++) {
            change[k] += later[k];
        }
    }
    to_panels(rank, width, width, change, slow->leap);
}

/* The energy below which no w can reach a bound; negative when some w is beyond one at rest. */
static double find_limit(const engine *self, const struct slow *slow)
{
    double rest_w[PADDED(ENGINE_MAX_KINKS)];
    double limit = (double)INFINITY;
    product(self->kinks, self->columns - self->states, slow->rest_w, &self->here->z[self->states], rest_w);
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

/* e'Q e here. */
static double energy_here(const engine *self, const struct slow *slow)
{
    double e[PADDED(ENGINE_MAX_STATES)];
    double sum = 0.0;
    product(slow->rank, self->columns - self->states, slow->rest, &self->here->z[self->states], e);
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

/* The slow part of the present mode if it is certain, else NULL. */
static const struct slow *slow_part(engine *self)
{
    struct mode *mode = self->mode;
    if (!mode->has_slow) {
        if (mode->slow == NULL) {
            mode->slow = malloc(sizeof *mode->slow);
        }
        if (mode->slow == NULL) {
            return NULL; /* it goes on without */
        }
        build_slow(self, mode->slow);
        mode->has_slow = true;
    }
    return mode->slow->certain ? mode->slow : NULL;
}

/* Whether no event can come before the next edge, which is decided at sample instants only. From then on the slow states
 * alone are stepped. A sample period after the last event all else has been forgotten; see FORGOTTEN. */
static bool is_quiet(engine *self)
{
    if (self->quiet) {
        return true;
    }
    if (self->elapsed < ENGINE_TICKS_PER_SAMPLE || self->now % ENGINE_TICKS_PER_SAMPLE != 0) {
        return false;
    }
    const struct slow *slow = slow_part(self);
    if (slow == NULL) {
        return false;
    }
    if (!self->has_limit) {
        self->energy_limit = find_limit(self, slow);
        self->has_limit = true;
    }
    if (!(energy_here(self, slow) < self->energy_limit)) {
        return false;
    }
    for (int i = 0; i < slow->rank; i++) {
        self->slow_z[i] = self->here->z[slow->row[i]];
    }
    const int constants = self->columns - self->states;
    memcpy(&self->slow_z[slow->rank], &self->here->z[self->states], (size_t)constants * sizeof(double));
    self->slow_age = 0;
    self->quiet = true;
    return true;
}

static void change_slowly(const struct slow *slow, int width, const double *change, double *z)
{
    double padded[PADDED(ENGINE_MAX_STATES)];
    product(slow->rank, width, change, z, padded);
    for (int i = 0; i < slow->rank; i++) {
        z[i] += padded[i];
    }
}

static void slow_step(engine *self)
{
    const struct slow *slow = self->mode->slow;
    if (self->slow_age == LEAP) {
        change_slowly(slow, slow->rank + self->columns - self->states, slow->leap, self->slow_z);
        self->slow_age = 0;
    }
    self->slow_age++;
    self->now += ENGINE_TICKS_PER_SAMPLE;
    self->counts.quiet++;
}

/* x from the slow states. */
static void expand(const engine *self, double *x)
{
    double padded[PADDED(ENGINE_MAX_STATES)], z[MAX_COLUMNS];
    const struct slow *slow = self->mode->slow;
    const int width = slow->rank + self->columns - self->states;
    memcpy(z, self->slow_z, sizeof z);
    for (int i = 0; i < self->slow_age; i++) {
        change_slowly(slow, width, slow->change, z);
    }
    product(self->states, width, slow->state, z, padded);
    memcpy(x, padded, (size_t)self->states * sizeof x[0]);
}

static void leave_quiet(engine *self)
{
    if (self->quiet) {
        expand(self, self->here->z);
        measure(self, self->here);
        self->level_before = NO_LEVEL;
        self->quiet = false;
    }
}

/* ---- a run ---- */

static enum engine_status advance(engine *self, int64_t tick)
{
    enum engine_status status = ENGINE_OK;
    while (status == ENGINE_OK && self->now < tick) {
        if (tick - self->now >= ENGINE_TICKS_PER_SAMPLE && is_quiet(self)) {
            slow_step(self);
            continue;
        }
        leave_quiet(self);
        status = one_step(self, tick - self->now);
    }
    return status;
}

/* ---- the public functions ---- */

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
    engine_restart(self);
    return self;
}

void engine_restart(engine *self)
{
    self->has_system = false;
    self->now = 0;
    self->elapsed = 0;
    self->counts = (struct engine_counts){0};
    self->quiet = false;
    self->here = &self->points[0];
    self->there = &self->points[1];
    self->middle = &self->points[2];
    self->before = &self->points[3];
    memset(self->points, 0, sizeof self->points);
    for (int i = 0; i < 4; i++) {
        self->points[i].z[self->columns - 1] = 1.0;
    }
    for (int k = 0; k < ENGINE_MAX_KINKS; k++) {
        self->outside[k] = NEVER;
    }
    engine_watch(self, ENGINE_TICKS_PER_SAMPLE);
}

void engine_free(engine *self)
{
    if (self == NULL) {
        return;
    }
    for (int i = 0; i < MODES; i++) {
        free(self->store[i].ladder);
        free(self->store[i].direct);
        free(self->store[i].slow);
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

static bool any(int count, const double *values)
{
    for (int i = 0; i < count; i++) {
        if (fabs(values[i]) > 0.0) {
            return true;
        }
    }
    return false;
}

/* Lists the kinks that feed a w, and notes whether any feeds a w or y. */
static void list_feeding(engine *self)
{
    const int q = self->kinks;
    self->coupled_count = 0;
    for (int k = 0; k < q; k++) {
        bool feeds = false;
        for (int i = 0; i < q; i++) {
            feeds = feeds || fabs(self->w_phi[i * q + k]) > 0.0;
        }
        if (feeds) {
            self->coupled[self->coupled_count++] = k;
        }
    }
    self->feeds = self->coupled_count > 0 || any(self->outputs * q, self->y_phi);
}

/* Whether the determinant of a (overwritten) is positive, and not only by rounding. */
static bool is_positive(int n, double *a)
{
    double least[ENGINE_MAX_KINKS];
    bool positive = true;
    for (int j = 0; j < n; j++) {
        least[j] = PIVOT_TOLERANCE * fabs(a[largest_in_column(n, a, j, 0) * n + j]);
    }
    for (int pivot = 0; pivot < n; pivot++) {
        const int best = largest_in_column(n, a, pivot, pivot);
        if (!(fabs(a[best * n + pivot]) > least[pivot])) {
            return false;
        }
        if (best != pivot) {
            swap_rows(n, a, pivot, best);
            positive = !positive;
        }
        positive = positive == (a[pivot * n + pivot] > 0.0);
        for (int row = pivot + 1; row < n; row++) {
            eliminate(n, 0, a, NULL, pivot, row);
        }
    }
    return positive;
}

static unsigned char lowest_piece(const struct engine_kink *kink)
{
    return kink->lower > -(double)INFINITY ? 0 : 1;
}

/* The next combination of pieces; false after the last. */
static bool next_combination(const engine *self, unsigned char *piece)
{
    for (int j = 0; j < self->coupled_count; j++) {
        const int k = self->coupled[j];
        if (piece[k] < 2 && isfinite(self->kink[k].upper)) {
            piece[k] = (unsigned char)(piece[k] + 1);
            return true;
        }
        piece[k] = lowest_piece(&self->kink[k]);
    }
    return false;
}

/* Whether w = r + w_phi phi(w) has one solution w for every r: the determinants of I - w_phi phi' have one sign in all
 * combinations of pieces, that of the one in which all slopes are 0. */
static bool has_one_sign(const engine *self)
{
    unsigned char piece[ENGINE_MAX_KINKS];
    double a[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    for (int k = 0; k < self->kinks; k++) {
        piece[k] = lowest_piece(&self->kink[k]);
    }
    for (int i = 0; i < MAX_COMBINATIONS; i++) {
        feedback(self, piece, self->coupled_count, self->coupled, a);
        if (!is_positive(self->coupled_count, a)) {
            return false;
        }
        if (!next_combination(self, piece)) {
            break;
        }
    }
    return true;
}

enum engine_status engine_set_system(engine *self, const struct engine_system *system)
{
    const size_t n = (size_t)self->states, q = (size_t)self->kinks, p = (size_t)self->outputs;
    const size_t columns = (size_t)self->columns;
    bool changed = !self->has_system;
    changed |= replace(self->abc, system->abc, n * columns, sizeof(double));
    changed |= replace(self->g, system->g, n * q, sizeof(double));
    changed |= replace(self->cde, system->cde, q * columns, sizeof(double));
    changed |= replace(self->w_phi, system->w_phi, q * q, sizeof(double));
    changed |= replace(self->lmn, system->lmn, p * columns, sizeof(double));
    changed |= replace(self->y_phi, system->y_phi, p * q, sizeof(double));
    changed |= replace(self->kink, system->kinks, q, sizeof(struct engine_kink));
    if (!changed) {
        return ENGINE_OK;
    }
    if (self->has_system) {
        leave_quiet(self);
    }
    self->stored = 0;
    self->oldest = 0;
    list_feeding(self);
    self->has_system = has_one_sign(self);
    if (!self->has_system) {
        return ENGINE_NOT_UNIQUE;
    }
    to_panels(self->kinks, self->columns, self->columns, self->cde, self->cde_panels);
    to_panels(self->outputs, self->columns, self->columns, self->lmn, self->lmn_panels);
    self->w_panels = self->cde_panels;
    self->y_panels = self->lmn_panels;
    const enum engine_status status = enter_mode(self);
    self->has_system = status == ENGINE_OK;
    return status;
}

void engine_get_state(const engine *self, double *x)
{
    if (self->quiet) {
        expand(self, x);
    } else {
        memcpy(x, self->here->z, (size_t)self->states * sizeof x[0]);
    }
}

enum engine_status engine_set_state(engine *self, const double *x)
{
    if (!self->has_system) {
        return ENGINE_NO_SYSTEM;
    }
    memcpy(self->here->z, x, (size_t)self->states * sizeof x[0]);
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
    leave_quiet(self);
    for (int i = 0; i < 4; i++) {
        self->points[i].z[column] = level;
    }
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
    double *out = self->outputs % PANEL == 0 ? y : padded;
    if (self->quiet) {
        const struct slow *slow = self->mode->slow;
        const int width = slow->rank + self->columns - self->states;
        const int start = (self->slow_age - 1) * PANEL_ELEMENTS(self->outputs, width);
        product(self->outputs, width, &slow->y[start], self->slow_z, out);
    } else {
        product(self->outputs, self->columns, self->y_panels, self->here->z, out);
    }
    if (out != y) {
        memcpy(y, padded, (size_t)self->outputs * sizeof y[0]);
    }
}

/* LEAP samples of a quiet stretch at once, by the same arithmetic as one by one. */
static void leap(engine *self, double *y)
{
    const struct slow *slow = self->mode->slow;
    const int width = slow->rank + self->columns - self->states;
    change_slowly(slow, width, slow->leap, self->slow_z);
    product(LEAP * self->outputs, width, slow->y, self->slow_z, y);
    self->now += LEAP * ENGINE_TICKS_PER_SAMPLE;
    self->counts.quiet += LEAP;
}

/* Records the samples of a quiet stretch that come before tick `before`; returns how many. */
static int64_t run_quiet(engine *self, int64_t before, double *y)
{
    const int64_t samples = self->quiet ? (before - 1 - self->now) / ENGINE_TICKS_PER_SAMPLE : 0;
    int64_t k = 0;
    while (k < samples) {
        if (self->slow_age == LEAP && self->outputs % PANEL == 0 && samples - k >= LEAP) {
            leap(self, &y[k * self->outputs]);
            k += LEAP;
        } else {
            slow_step(self);
            record(self, &y[k * self->outputs]);
            k++;
        }
    }
    self->counts.samples += samples > 0 ? samples : 0;
    return samples > 0 ? samples : 0;
}

enum engine_status engine_run(
    engine *self, int64_t until, int64_t edges, const int64_t *tick, const int32_t *input, const double *level, double *y)
{
    enum engine_status status = self->has_system ? ENGINE_OK : ENGINE_NO_SYSTEM;
    int64_t edge = 0;
    while (status == ENGINE_OK) {
        const int64_t instant = self->counts.samples * ENGINE_TICKS_PER_SAMPLE;
        const int64_t target = instant <= until ? instant : until;
        self->events_left = self->events_per_sample;
        while (status == ENGINE_OK && edge < edges && tick[edge] <= target) {
            status = take_edge(self, tick[edge], input[edge], level[edge]);
            edge++;
        }
        if (status == ENGINE_OK) {
            status = advance(self, target);
        }
        if (instant > until) {
            break;
        }
        if (status == ENGINE_OK) {
            record(self, y);
            y += self->outputs;
            self->counts.samples++;
            y += self->outputs * run_quiet(self, edge < edges && tick[edge] <= until ? tick[edge] : until + 1, y);
        }
    }
    if (status == ENGINE_OK && edge < edges) {
        status = ENGINE_EDGE;
    }
    return status == ENGINE_OK && !is_finite(self) ? ENGINE_NOT_FINITE : status;
}

enum engine_status engine_play(
    engine *self, int64_t turns, const struct engine_system *circuit, const int64_t *until, int64_t edges,
    const int64_t *tick, const int32_t *input, const double *level, double *y)
{
    enum engine_status status = ENGINE_OK;
    int64_t taken = 0;
    for (int64_t turn = 0; status == ENGINE_OK && turn < turns; turn++) {
        const int64_t first = taken, recorded = self->counts.samples;
        while (taken < edges && tick[taken] <= until[turn]) {
            taken++;
        }
        status = engine_set_system(self, &circuit[turn]);
        if (status == ENGINE_OK && recorded * ENGINE_TICKS_PER_SAMPLE <= until[turn]) {
            status = engine_run(self, until[turn], taken - first, &tick[first], &input[first], &level[first], y);
            y += (self->counts.samples - recorded) * self->outputs;
        }
    }
    return status == ENGINE_OK && taken < edges ? ENGINE_EDGE : status;
}

void engine_watch(engine *self, int64_t patience)
{
    self->patience = patience;
    for (int k = 0; k < ENGINE_MAX_KINKS; k++) {
        self->overdue[k] = NEVER;
        self->outside[k] = self->outside[k] == NEVER ? NEVER : self->now;
    }
}

void engine_get_overdue(const engine *self, int64_t *tick)
{
    for (int k = 0; k < self->kinks; k++) {
        tick[k] = overdue(self, k);
    }
}

void engine_get_counts(const engine *self, struct engine_counts *counts)
{
    *counts = self->counts;
}

/* ---- noise ---- */

/* The short step h of engine_noise_gather: |a h| up to this, and so many terms end the series within 1e-19 of its sum. */
#define NOISE_NORM 1e-2
#define NOISE_TERMS 8

/* What Cholesky leaves of a variance counts as none below this part of it. */
#define NO_VARIANCE 1e-12

#define MAX_SQUARE (ENGINE_MAX_STATES * ENGINE_MAX_STATES)

/* The short step: change = exp(a h) - I, and cov by the Taylor series of dP/dt = a P + P a' + q. */
static void gather_shortly(int n, double step_s, const double *a, const double *q, double *change, double *cov)
{
    double power[MAX_SQUARE] = {0.0}, term[MAX_SQUARE] = {0.0}, grown[MAX_SQUARE];
    for (int i = 0; i < n * n; i++) {
        change[i] = power[i] = a[i] * step_s;
        cov[i] = term[i] = q[i] * step_s;
    }
    for (int k = 2; k <= NOISE_TERMS; k++) {
        const double h = step_s / (double)k;
        multiply(n, a, term, false, grown);
        for (int i = 0; i < n * n; i++) {
            term[i] = (grown[i] + grown[(i % n) * n + i / n]) * h;
            cov[i] += term[i];
        }
        multiply(n, power, a, false, grown);
        for (int i = 0; i < n * n; i++) {
            power[i] = grown[i] * h;
            change[i] += power[i];
        }
    }
}

/* Twice the step: P + Phi P Phi' and Phi Phi - I, with Phi = I + change, so that slow states lose no digits. */
static void gather_twice(int n, double *change, double *cov)
{
    double grown[MAX_SQUARE] = {0.0}, transposed[MAX_SQUARE] = {0.0}, both[MAX_SQUARE];
    multiply(n, change, cov, false, grown);
    for (int i = 0; i < n * n; i++) {
        transposed[i] = grown[(i % n) * n + i / n];
    }
    multiply(n, change, transposed, false, both);
    for (int i = 0; i < n * n; i++) {
        cov[i] = 2.0 * cov[i] + grown[i] + transposed[i] + both[i];
    }
    multiply(n, change, change, false, both);
    for (int i = 0; i < n * n; i++) {
        change[i] = 2.0 * change[i] + both[i];
    }
}

/* Cholesky. */
static void factorise(int n, const double *cov, double *factor)
{
    for (int j = 0; j < n; j++) {
        for (int i = 0; i < n; i++) {
            double left = i < j ? 0.0 : cov[i * n + j];
            for (int k = 0; k < j && i >= j; k++) {
                left -= factor[i * n + k] * factor[j * n + k];
            }
            factor[i * n + j] = left;
        }
        const double left = factor[j * n + j];
        const double scale = left > NO_VARIANCE * cov[j * n + j] ? 1.0 / sqrt(left) : 0.0;
        for (int i = j; i < n; i++) {
            factor[i * n + j] *= scale;
        }
    }
}

int engine_noise_gather(int n, double period_s, const double *a, const double *q, double *phi, double *cov, double *factor)
{
    double step_s = period_s;
    int doublings = 0;
    bool finite = true;
    const double rate = norm(n, n, a);
    while (rate * step_s > NOISE_NORM && doublings < 2 * MAX_HALVINGS) {
        step_s *= 0.5;
        doublings++;
    }
    gather_shortly(n, step_s, a, q, phi, cov);
    while (doublings-- > 0) {
        gather_twice(n, phi, cov);
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

void engine_noise_run(
    int n, int outputs, int64_t samples, const double *phi, const double *factor, const double *reading,
    const double *normal, double *x, double *y)
{
    double next[ENGINE_MAX_STATES];
    for (int64_t sample = 0; sample < samples; sample++, normal += n, y += outputs) {
        for (int i = 0; i < outputs; i++) {
            y[i] = 0.0;
            for (int j = 0; j < n; j++) {
                y[i] += reading[i * n + j] * x[j];
            }
        }
        for (int i = 0; i < n; i++) {
            next[i] = 0.0;
            for (int j = 0; j < n; j++) {
                next[i] += phi[i * n + j] * x[j] + factor[i * n + j] * normal[j];
            }
        }
        memcpy(x, next, (size_t)n * sizeof x[0]);
    }
}
