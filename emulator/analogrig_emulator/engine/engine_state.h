/// The state of an engine and the functions that its chapters share. Private: engine.h is the interface.
///
///     engine.c    calls from outside, edges, recording
///     events.c    steps with variable length, search for the tick of an event
///     modes.c     the mode in which the circuit is, and the store of modes
///     kinks.c     arguments w of the kinks, and the circuit with the kinks substituted
///     ladder.c    matrix exponentials
///     products.c  steps of a circuit with products
///     matrices.c  panels, products, linear equations
///     kernels.c   inner loops, from lanes.h
///     noise.c     noise of a linear circuit, independent of the rest
///     card.c      steps of a data-acquisition card, independent of the rest
///     fast/       what only saves time, behind fast.h: -DENGINE_FAST=0 leaves it out

#ifndef ENGINE_STATE_H
#define ENGINE_STATE_H

#include "engine.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

#define TOP_LEVEL (ENGINE_LEVELS - 1)
#define NEVER INT64_C(-1)
#define NO_END INT64_MAX
#define MAX_COLUMNS (ENGINE_MAX_STATES + ENGINE_MAX_INPUTS + 1)
#define MAX_SQUARE (ENGINE_MAX_STATES * ENGINE_MAX_STATES)

/// Matrices of the inner loop are stored in panels of four rows, each panel column by column.
#define PANEL 4
#define PANELS(rows) (((rows) + PANEL - 1) / PANEL)
#define PANEL_ELEMENTS(rows, columns) (PANELS(rows) * PANEL * (columns))
#define PADDED(rows) (PANELS(rows) * PANEL)

/// Matrices of a ladder under construction are row-major, with rows padded by zeros to whole panels.
#define MAX_STRIDE PADDED(MAX_COLUMNS)
#define MAX_ELEMENTS (ENGINE_MAX_STATES * MAX_STRIDE)

/// Capacity of the store of modes. The suspension visits about ten.
#define MODES 64

/// Circuits that are kept with their modes, so that a return to one of them costs nothing.
#define CIRCUITS 8

/// Terms of the Taylor series of the exponential over the shortest step of a mode. With |A t| <= TAYLOR_NORM they leave 1e-16
/// of the first one.
#define TERMS 14
#define TAYLOR_NORM 0.5

/// Level of the shortest step near a bound that is not crossed: 1/64 of a sample period, with a look at its middle.
/// Anything faster was set off by an event just before, and after an event the steps grow from the shortest one.
#define NEAR_LEVEL (TOP_LEVEL - 6)

#include "fast/fast.h"

/// The pieces of phi.
enum { PIECE_LOW = 0, PIECE_MIDDLE = 1, PIECE_HIGH = 2 };

/// Nodes of a step of a circuit with products, beyond its beginning; and all of them.
#define NODES 4
#define ORDER (NODES + 1)

/// Matrices of a mode of a circuit with products, for steps of each level.
typedef struct collocation collocation_t;

/// A mode and its matrices, in one block. base: level of the shortest step, of h = 2^base ticks. |A h| is so small that
/// TERMS terms give the exponential of any part of h, unless `stiff`: then base is 0.
typedef struct {
    unsigned char  piece[ENGINE_MAX_KINKS];
    int            base;
    bool           stiff;
    double*        block;
    int            capacity;  // of the block
    int            top;       // the highest level computed so far
    double*        ladder;    // panelled matrices exp([A B c] 2^level ticks) - I for levels base .. top, states only
    double*        looks;     // panelled w over the z of 2^level ticks before, for the same levels
    double*        change;    // the matrix of level `top`, row-major
    double*        terms;     // ([A B c] h)^k / k! for k = 1 .. TERMS, as series_pack() stores them
    double*        readings;  // panelled w and y over z; used if phi feeds one of them
    slow_t         slow;
    bool           has_slow;
    int64_t        tuning;       // that of its circuit when it was built
    bool           is_pinned;    // another engine uses it: it must stay
    collocation_t* collocation;  // of a circuit with products, else NULL
} mode_t;

/// The end of a step with respect to the bounds of the present mode. A step inside all bounds is CLEAR if w could not have
/// left them on the way, even straying beyond both ends by the larger of two amounts: its change in this step, and its change
/// at the speed of the step before. At the top of a peak the first alone may be zero.
typedef enum { CLEAR, NEAR, CROSSED } judgement_t;

/// A product, the degrees of its factors, and its law.
typedef struct {
    engine_product_t factors;
    int              x_degree, y_degree, kind;
} law_t;

/// A circuit and its modes. Arrays as in engine_system_t, in one block.
struct circuit {
    bool              is_set;  // it has a unique solution
    double*           block;
    double *          abc, *g, *cde, *w_phi, *lmn, *y_phi;
    engine_kink_t*    kink;
    engine_product_t* products;
    law_t             law[ENGINE_MAX_PRODUCTS];
    double *          cde_panels, *lmn_panels;
    bool              feeds;                                     // phi feeds some w or y
    int               coupled[ENGINE_MAX_KINKS], coupled_count;  // the kinks that feed a w
    mode_t            store[MODES];
    int               stored, oldest;
    int64_t           tuning;  // how often the constants have changed
};

/// The inner loops. Memory must not overlap.
typedef struct {
    /// out = matrix z. out needs room for whole panels.
    void (*multiply)(int rows, int columns, const double* panels, const double* z, double* out);

    /// z += matrix z, for the first rows of z.
    void (*advance)(int rows, int columns, const double* panels, double* z);

    /// out = left[:, :n] right; rows of all are `stride` long, which is a multiple of PANEL.
    void (*compose)(int rows, int n, int stride, const double* left, const double* right, double* out);

    /// to = factor to + gain from; count is a multiple of PANEL.
    void (*add)(int count, double factor, const double* from, double gain, double* to);

    /// Set PANEL values to those of a law at PANEL arguments p and the q after them, plus `driven`. Return their largest
    /// change; INFINITY if one is not finite.
    double (*apply)(const law_t* law, const double* arguments, const double* driven, double* values);

    /// Set w_there = matrix z, and judge it as the end of a step. growth: its length over that of the step before; 0 if
    /// there is none.
    judgement_t (*look)(engine_t* self, int columns, const double* panels, const double* z, double growth);

    /// Look from the origin at ever later instants until `clear` is at a tick or beyond, or there is no further look. Stop at
    /// a step that is not CLEAR.
    judgement_t (*look_on)(engine_t* self, int64_t tick);

    /// engine_see() of a card of PANEL channels that holds nothing. Return NaN if a voltage is not finite, else 0.
    double (*see)(int64_t samples, const double* card, const double* volts, const double* normals, double* seen);

    /// engine_convert() without levels, limited to `most`; count is a multiple of PANEL.
    void (*convert)(int64_t       count,
                    double        most,
                    unsigned      stuck_high,
                    unsigned      stuck_low,
                    const double* seen,
                    uint16_t*     codes,
                    uint8_t*      clipped);
} kernels_t;

/// See engine_drive(); terms is NULL without one.
typedef struct {
    int64_t       first, samples;
    const double* terms;
} drive_t;

struct engine {
    const kernels_t* kernels;

    int     states, inputs, products, kinks, outputs, columns;  // inputs: products included
    double  tick_s;
    int64_t events_per_sample;

    bool       has_system;
    circuit_t* circuit;             // the present one
    circuit_t* circuits[CIRCUITS];  // NULL from the first free place on
    int        oldest;              // place of the circuit set longest ago

    int64_t now;
    double  z[PADDED(MAX_COLUMNS)];  // [x u 1] now; without x in a stretch of slow states
    int64_t origin;                  // tick of the last event, edge or new circuit
    double  origin_z[PADDED(MAX_COLUMNS)];
    int64_t clear;   // no event comes up to this tick; NO_END in a quiet stretch and at its end
    int64_t stride;  // ticks from w_before to w; 0 if w has a kink between
    int look;  // level of the next look from the origin, above TOP_LEVEL if there is none; with products, of the next step
    double *w, *w_before, *w_there;  // arguments of the kinks: at `clear`, a stride earlier, at the end of a step
    double  arguments[3][PADDED(ENGINE_MAX_KINKS)];
    int64_t events_left;

    unsigned char piece[ENGINE_MAX_KINKS];
    double        lower[PADDED(ENGINE_MAX_KINKS)], upper[PADDED(ENGINE_MAX_KINKS)];  // bounds of w in the present mode
    mode_t*       mode;
    const double *w_panels, *y_panels;  // of the present mode
    bool          is_slow;              // slow_z holds the state, and z does not
    double        slow_z[MAX_COLUMNS];  // [s u 1], slow_age samples ago
    int           slow_age;
    bool          has_limit;                        // rest and energy_limit are those of the present mode and inputs
    double        rest[PADDED(ENGINE_MAX_STATES)];  // of the slow states
    double        energy_limit;  // no event comes while e'Q e is below it; negative if there is no such limit

    drive_t drives[ENGINE_MAX_PRODUCTS];  // of the products

    int64_t ahead;                          // ticks; see engine_look_ahead()
    double  weight[NODES * ORDER];          // panelled moments of a polynomial over its values at the nodes
    double  binomial[NODES][ORDER][ORDER];  // (s + c)^k over s^l, with c each node
    double  ratio;                          // length of a step over that of the one before
    double  extension[NODES * ORDER];  // panelled values at the nodes of this step over the moments of the one before
    double  moments[ENGINE_MAX_PRODUCTS][ORDER];  // of the products in the last step
    double  contraction;  // ratio of the last change of the products in an iteration to the change before

    int64_t patience;                   // ticks; see engine_watch()
    int64_t outside[ENGINE_MAX_KINKS];  // tick at which a kink left its middle piece, or NEVER
    int64_t overdue[ENGINE_MAX_KINKS];  // results of engine_get_overdue() for kinks that have come back since

    engine_counts_t counts;
};

/// Accept the end of a step from `clear`: no event comes before it.
static inline void step_accept(engine_t* self, int64_t ticks) {
    double* oldest = self->w_before;
    self->w_before = self->w;
    self->w        = self->w_there;
    self->w_there  = oldest;
    self->stride   = ticks;
    self->clear += ticks;
}

/// The piece in which w is. A bound belongs to the middle piece.
static inline unsigned char kink_piece(const engine_kink_t* kink, double w) {
    return w < kink->lower ? PIECE_LOW : w > kink->upper ? PIECE_HIGH : PIECE_MIDDLE;
}

/// Bounds of w in a piece.
static inline double kink_lower_bound(const engine_kink_t* kink, unsigned char piece) {
    return piece == PIECE_LOW ? -(double)INFINITY : piece == PIECE_MIDDLE ? kink->lower : kink->upper;
}

static inline double kink_upper_bound(const engine_kink_t* kink, unsigned char piece) {
    return piece == PIECE_LOW ? kink->lower : piece == PIECE_MIDDLE ? kink->upper : (double)INFINITY;
}

/// Number of elements of each array of engine_system_t.
typedef struct {
    size_t abc, g, cde, w_phi, lmn, y_phi, kinks, products;
} sizes_t;

static inline sizes_t sizes_of(const engine_t* self) {
    const size_t n = (size_t)self->states, q = (size_t)self->kinks, p = (size_t)self->outputs;
    const size_t columns = (size_t)self->columns;
    return (sizes_t){ n * columns, n * q, q * columns, q * q, p * columns, p * q, q, (size_t)self->products };
}

static inline bool is_equal(size_t count, size_t size, const void* one, const void* other) {
    return count == 0U || memcmp(one, other, count * size) == 0;
}

static inline void copy(size_t count, size_t size, const void* from, void* to) {
    if (count > 0U) {
        memcpy(to, from, count * size);
    }
}

/// Numbers in the row of a sample.
static inline int row_length(const engine_t* self) { return self->ahead > 0 ? 2 * self->outputs : self->outputs; }

static inline void copy_z(const engine_t* self, const double* from, double* to) {
    memcpy(to, from, (size_t)self->columns * sizeof to[0]);
}

/// First element of a row of w_panels; its columns are PANEL apart.
static inline const double* w_row_of(const engine_t* self, int row) {
    return &self->w_panels[row / PANEL * PANEL * self->columns + row % PANEL];
}

// The functions below are shared by the chapters, but not exported by the library.
#ifdef __GNUC__
#pragma GCC visibility push(hidden)
#endif

// ---------------------------------------------        MATRICES        ---------------------------------------------

/// The inner loops for this processor.
const kernels_t* kernels_find(void);

/// Store term k of a series, counted from 0, such that the product of all `count` of them with z is a panelled matrix of
/// rows x count.
void series_pack(int rows, int columns, int stride, const double* term, int k, int count, double* terms);

/// z += the series whose terms at z are a panelled matrix of rows x count, at a part of its step.
void series_sum(const kernels_t* kernels, int rows, int count, const double* terms, double part, double* z);

/// Cut a row-major matrix into panels. Rows beyond the last are zero.
void panels_pack(int rows, int columns, int stride, const double* matrix, double* panels);

/// Copy panels into a row-major matrix.
void panels_unpack(int rows, int columns, int stride, const double* panels, double* matrix);

/// Largest absolute row sum of the first n columns.
double matrix_norm(int n, int stride, const double* a);

/// out = left right, or left' right; all n x n.
void matrix_multiply(int n, const double* left, const double* right, bool transpose_left, double* out);

/// True iff the determinant of a is positive by more than rounding. Overwrites a.
bool matrix_is_positive(int n, double* a);

// ---------------------------------------------         MODES          ---------------------------------------------

/// Level of the shortest step of dx/dt = a [x u 1], with a padded to whole panels, and whether it is `stiff`. Return
/// ENGINE_TOO_STIFF if a is too large.
engine_status_t ladder_plan(const engine_t* self, const double* a, int* base, bool* stiff);

/// Compute the terms of the present mode, and its lowest level. Overwrites a.
void ladder_build(engine_t* self, double* a);

/// Compute the levels of the present mode up to this one.
void ladder_reach(engine_t* self, int level);

/// Advance z by a number of ticks of the present mode, at most one sample period.
void ladder_move(engine_t* self, int64_t ticks, double* z);

/// The terms of the series at z: a panelled matrix of states x TERMS.
void ladder_expand(const engine_t* self, const double* z, double* terms);

/// Advance z by a number of ticks within a shortest step, forwards or backwards, by the terms at z.
void ladder_sum(const engine_t* self, const double* terms, int64_t ticks, double* z);

/// Update the list of kinks that feed a w, and whether any feeds a w or y.
void kinks_list_feeding(engine_t* self);

/// True iff w = r + P phi(w) has exactly one solution for every r.
bool kinks_are_unique(const engine_t* self);

/// Set w from z alone. Return ENGINE_NOT_FINITE or ENGINE_NOT_UNIQUE if there is no such w.
engine_status_t kinks_solve(engine_t* self);

/// a = [A B c] + G phi'(w) in the given pieces, with rows padded to whole panels.
void kinks_build_map(const engine_t* self, const unsigned char* piece, double* a);

/// Panelled w, followed by panelled y, over z in the given pieces.
void kinks_build_readings(const engine_t* self, const unsigned char* piece, double* readings);

/// Panels of the matrices of w and y of a circuit.
void circuit_pack(const engine_t* self, circuit_t* circuit);

/// Take w and y from the readings of the present mode if phi feeds one of them.
void mode_point_readings(engine_t* self);

/// Make the mode of the present z the mode of the engine. The steps that follow grow from one tick again.
engine_status_t mode_enter(engine_t* self);

/// First tick at which a kink had been outside its middle piece for `patience` ticks; NEVER if there is none by now.
int64_t mode_overdue_tick(const engine_t* self, int kink);

// ---------------------------------------------        PRODUCTS        ---------------------------------------------

/// Set what depends on the nodes alone.
void products_plan(engine_t* self);

/// Set the laws of the present circuit.
void products_set_laws(const engine_t* self, const engine_product_t* products);

/// Compute the matrices of the present mode from its map [A B c]: those of its lowest level, the others as they are needed.
engine_status_t products_build(engine_t* self, const double* a);

/// Free the matrices of a mode. NULL is allowed.
void products_free(collocation_t* matrices);

/// Set w and the products in z from the state and the other inputs. Fails like kinks_solve(), and with ENGINE_NOT_UNIQUE if
/// the products feed one another.
engine_status_t products_solve(engine_t* self);

/// Advance to a tick, and enter the modes on the way.
engine_status_t products_advance(engine_t* self, int64_t tick);

// ---------------------------------------------         STEPS          ---------------------------------------------

/// Advance to a tick, or to an event before it, and enter the mode beyond.
engine_status_t events_advance(engine_t* self, int64_t tick);

/// Look from the origin at ever later instants until no event comes up to a tick. Return false if steps have to go on from
/// `clear`.
bool events_look_until(engine_t* self, int64_t tick);

/// Advance `clear` to a tick, at which w is panels z. Return false if w could have left its bounds on the way.
bool events_extend(engine_t* self, int64_t tick, int columns, const double* panels, const double* z);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif

#endif  // ENGINE_STATE_H
