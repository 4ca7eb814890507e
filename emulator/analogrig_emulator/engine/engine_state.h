/// The state of an engine and the functions that its chapters share. Private: engine.h is the interface.
///
///     engine.c    calls from outside, edges, recording
///     events.c    steps with variable length, search for the tick of an event
///     quiet.c     stretches that provably have no event
///     modes.c     the mode in which the circuit is, and the store of modes
///     kinks.c     arguments w of the kinks, and the circuit with the kinks substituted
///     ladder.c    matrix exponentials
///     matrices.c  panels, products, linear equations
///     noise.c     noise of a linear circuit, independent of the rest

#ifndef ENGINE_STATE_H
#define ENGINE_STATE_H

#include "engine.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>

#define TOP_LEVEL (ENGINE_LEVELS - 1)
#define NO_LEVEL (-1)
#define NEVER INT64_C(-1)
#define MAX_COLUMNS (ENGINE_MAX_STATES + ENGINE_MAX_INPUTS + 1)
#define MAX_SQUARE (ENGINE_MAX_STATES * ENGINE_MAX_STATES)

/// Matrices of the inner loop are stored in panels of four rows, each panel column by column: the compiler then
/// computes four sums at once.
#define PANEL 4
#define PANELS(rows) (((rows) + PANEL - 1) / PANEL)
#define PANEL_ELEMENTS(rows, columns) (PANELS(rows) * PANEL * (columns))
#define PADDED(rows) (PANELS(rows) * PANEL)

/// Matrices of a ladder under construction are row-major, with rows padded by zeros to whole panels.
#define MAX_STRIDE PADDED(MAX_COLUMNS)
#define MAX_ELEMENTS (ENGINE_MAX_STATES * MAX_STRIDE)

/// Capacity of the store of modes. The suspension visits about ten.
#define MODES 64

/// Samples of a quiet stretch that are computed from the same state. They do not depend on one another, so that the
/// processor can overlap them.
#define LEAP 4

/// The pieces of phi.
enum { PIECE_LOW = 0, PIECE_MIDDLE = 1, PIECE_HIGH = 2 };

/// The slow part of a mode, s = x[row]. From one sample period after the last event on, x is a function of s, u and 1.
/// Matrices are panelled, over [s u 1]; those named rest are over [u 1].
typedef struct {
    int    rank;
    bool   certain;  // s comes to rest, and energy bounds how far w strays until then
    int    row[ENGINE_MAX_STATES];
    double change[PANEL_ELEMENTS(ENGINE_MAX_STATES, MAX_COLUMNS)];           // of s in one sample period
    double leap[PANEL_ELEMENTS(ENGINE_MAX_STATES, MAX_COLUMNS)];             // of s in LEAP sample periods
    double state[PANEL_ELEMENTS(ENGINE_MAX_STATES, MAX_COLUMNS)];            // x
    double y[LEAP * PANEL_ELEMENTS(ENGINE_MAX_OUTPUTS, MAX_COLUMNS)];        // y after 1, 2, ... LEAP sample periods
    double rest[PANEL_ELEMENTS(ENGINE_MAX_STATES, ENGINE_MAX_INPUTS + 1)];   // s at rest
    double rest_w[PANEL_ELEMENTS(ENGINE_MAX_KINKS, ENGINE_MAX_INPUTS + 1)];  // w at rest
    double energy[MAX_SQUARE];       // Q: e'Q e never grows, with e the distance of s from rest
    double reach[ENGINE_MAX_KINKS];  // (w - rest_w)^2 <= reach e'Q e
} slow_t;

typedef struct {
    unsigned char piece[ENGINE_MAX_KINKS];
    double*       ladder;    // ENGINE_LEVELS panelled matrices exp([A B c] 2^level ticks) - I, rows of the states only
    double*       readings;  // panelled w and y over z; NULL unless phi feeds one of them
    slow_t*       slow;
    bool          has_slow;
} mode_t;

/// z = [x u 1] and the arguments w of the kinks there.
typedef struct {
    double z[MAX_COLUMNS];
    double w[PADDED(ENGINE_MAX_KINKS)];
} point_t;

struct engine {
    int     states, inputs, kinks, outputs, columns;
    double  tick_s;
    int64_t events_per_sample;

    bool          has_system;
    double        abc[ENGINE_MAX_STATES * MAX_COLUMNS];
    double        g[ENGINE_MAX_STATES * ENGINE_MAX_KINKS];
    double        cde[ENGINE_MAX_KINKS * MAX_COLUMNS];
    double        w_phi[ENGINE_MAX_KINKS * ENGINE_MAX_KINKS];
    double        lmn[ENGINE_MAX_OUTPUTS * MAX_COLUMNS];
    double        y_phi[ENGINE_MAX_OUTPUTS * ENGINE_MAX_KINKS];
    bool          feeds;                                     // phi feeds some w or y
    int           coupled[ENGINE_MAX_KINKS], coupled_count;  // the kinks that feed a w
    engine_kink_t kink[ENGINE_MAX_KINKS];
    double        cde_panels[PANEL_ELEMENTS(ENGINE_MAX_KINKS, MAX_COLUMNS)];
    double        lmn_panels[PANEL_ELEMENTS(ENGINE_MAX_OUTPUTS, MAX_COLUMNS)];

    int64_t  now;      // tick
    int64_t  elapsed;  // ticks since the last event, edge or new circuit; at most one sample period
    int64_t  events_left;
    point_t  points[4];
    point_t *before, *here, *there, *middle;
    int      level_before;  // level of the step from before to here; NO_LEVEL if w has a kink here

    unsigned char piece[ENGINE_MAX_KINKS];
    double        lower[ENGINE_MAX_KINKS], upper[ENGINE_MAX_KINKS];  // bounds of w in the present mode
    mode_t*       mode;
    const double *w_panels, *y_panels;  // of the present mode
    bool          quiet;                // slow_z holds the state, and no event comes before the next edge
    bool          has_limit;
    double        energy_limit;         // no event comes while e'Q e is below it; negative if there is no such limit
    double        slow_z[MAX_COLUMNS];  // [s u 1], slow_age samples ago
    int           slow_age;
    mode_t        store[MODES];
    int           stored, oldest;

    int64_t patience;                   // ticks; see engine_watch()
    int64_t outside[ENGINE_MAX_KINKS];  // tick at which a kink left its middle piece, or NEVER
    int64_t overdue[ENGINE_MAX_KINKS];  // results of engine_get_overdue() for kinks that have come back since

    engine_counts_t counts;
};

/// out = matrix z. out needs room for whole panels. In the header so that the inner loops can inline it.
static inline void panels_multiply(int rows, int columns, const double* panels, const double* z, double* out) {
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
        out[i]     = s0;
        out[i + 1] = s1;
        out[i + 2] = s2;
        out[i + 3] = s3;
    }
}

/// Update w of a point from its z. In the header for the same reason.
static inline void measure_kinks(const engine_t* self, point_t* point) {
    panels_multiply(self->kinks, self->columns, self->w_panels, point->z, point->w);
}

// The functions below are shared by the chapters, but not exported by the library.
#ifdef __GNUC__
#pragma GCC visibility push(hidden)
#endif

// ---------------------------------------------        MATRICES        ---------------------------------------------

/// Cut a row-major matrix into panels. Rows beyond the last are zero.
void panels_pack(int rows, int columns, int stride, const double* matrix, double* panels);

/// Copy panels into a row-major matrix.
void panels_unpack(int rows, int columns, const double* panels, double* matrix);

/// Largest absolute row sum of the first n columns.
double matrix_norm(int n, int stride, const double* a);

/// out = left right, or left' right; all n x n.
void matrix_multiply(int n, const double* left, const double* right, bool transpose_left, double* out);

/// True iff the determinant of a is positive by more than rounding. Overwrites a.
bool matrix_is_positive(int n, double* a);

// ---------------------------------------------         MODES          ---------------------------------------------

/// Compute the ladder of dx/dt = a [x u 1], with a padded to whole panels. Return ENGINE_TOO_STIFF if a is too large.
engine_status_t ladder_build(const engine_t* self, double* a, double* ladder);

/// Update the list of kinks that feed a w, and whether any feeds a w or y.
void kinks_list_feeding(engine_t* self);

/// True iff w = r + P phi(w) has exactly one solution for every r.
bool kinks_are_unique(const engine_t* self);

/// Set here->w from here->z alone. Return ENGINE_NOT_FINITE or ENGINE_NOT_UNIQUE if there is no such w.
engine_status_t kinks_solve(engine_t* self);

/// a = [A B c] + G phi'(w) in the given pieces, with rows padded to whole panels.
void kinks_build_map(const engine_t* self, const unsigned char* piece, double* a);

/// Panelled w, followed by panelled y, over z in the given pieces.
void kinks_build_readings(const engine_t* self, const unsigned char* piece, double* readings);

/// Bounds of w in a piece.
double kink_lower_bound(const engine_kink_t* kink, unsigned char piece);
double kink_upper_bound(const engine_kink_t* kink, unsigned char piece);

/// The piece in which w is. A bound belongs to the middle piece.
unsigned char kink_piece(const engine_kink_t* kink, double w);

/// Make the mode of the present z the mode of the engine. The steps that follow grow from one tick again.
engine_status_t mode_enter(engine_t* self);

/// First tick at which a kink had been outside its middle piece for `patience` ticks; NEVER if there is none by now.
int64_t mode_overdue_tick(const engine_t* self, int kink);

// ---------------------------------------------         STEPS          ---------------------------------------------

/// Take one step of at most this many ticks, and enter the mode beyond if an event ends it.
engine_status_t events_step(engine_t* self, int64_t ticks);

/// True iff no event can come before the next edge. Begins a quiet stretch if so: the slow states alone are then
/// stepped. Decided at sample instants only.
bool quiet_holds(engine_t* self);

/// Advance a quiet stretch by one sample period.
void quiet_step(engine_t* self);

/// Advance a quiet stretch by LEAP samples and record them, with the bits of LEAP single steps.
void quiet_leap(engine_t* self, double* y);

/// y of the present sample of a quiet stretch. y needs room for whole panels.
void quiet_read(const engine_t* self, double* y);

/// x in a quiet stretch.
void quiet_get_state(const engine_t* self, double* x);

/// End a quiet stretch, if there is one: here holds the state again.
void quiet_leave(engine_t* self);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif

#endif  // ENGINE_STATE_H
