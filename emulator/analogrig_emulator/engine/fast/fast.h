/// What makes the engine faster and no more exact. Without it (ENGINE_FAST=0) voltages agree within rounding, 1e-14 V.
///
///     quiet.c     stretches of slow states, where no event can come
///     retune.c    other constants of a known circuit
///     random.c    numpy's random streams, for many seeds at once; their interface is in engine.h

#ifndef ENGINE_FAST_H
#define ENGINE_FAST_H

#ifndef ENGINE_FAST
#define ENGINE_FAST 1
#endif

typedef struct circuit circuit_t;

/// Samples of a quiet stretch that are computed from the same state. They do not depend on one another, so that the
/// processor can overlap them.
#define LEAP 4

/// The slow part of a mode, s = x[row]. 2^least_level ticks after the last event and later, x is a function of s, u and 1.
/// Matrices are panelled, over [s u 1]; those named rest are over [u 1]. They lie in one block.
typedef struct {
    double* block;
    int     rank;
    int     least_level;
    int64_t ahead;   // that of the engine for which y was built
    bool is_chosen;  // rank, row, least_level and whether it is certain are those of the mode, whatever its constants
    int  doublings;  // of a sample period to the instant from which on these states alone matter
    bool certain;    // s comes to rest, and energy bounds how far w strays until then
    int  row[ENGINE_MAX_STATES];
    double* change;  // of s in one sample period
    double* leap;    // of s in LEAP sample periods
    int     base;    // |change of s| is so small in 2^base ticks that a series gives it
    int     count;   // of the terms of that series
    double* terms;   // of that series, as series_pack() stores them
    double* ladder;  // changes of s in 2^level ticks, for levels from base on
    double* state;   // x
    double* first;   // s 2^least_level ticks after an event, over the z of that event
    double* w;
    double* y;       // the row of a sample now and after 1, 2, ... LEAP - 1 sample periods
    double* rest;    // s at rest
    double* rest_w;  // w at rest
    double* energy;  // Q: e'Q e never grows, with e the distance of s from rest
    double* reach;   // (w - rest_w)^2 <= reach e'Q e, for each kink
} slow_t;

#ifdef __GNUC__
#pragma GCC visibility push(hidden)
#endif

#if ENGINE_FAST

/// Advance the slow states towards a tick. Return false if they do not suffice: z holds the state then, and `now` may lie
/// before the tick.
bool fast_advance(engine_t* self, int64_t tick);

/// Advance from the origin to a sample instant up to which no event comes, by the slow states alone. Return false if they do
/// not suffice.
bool fast_begin(engine_t* self, int64_t tick);

/// Record the samples of a quiet stretch that come before a tick. Return their number.
int64_t fast_run(engine_t* self, int64_t before, double* y);

/// Row of the present sample in a stretch of slow states.
void fast_read(const engine_t* self, double* row);

/// x in a stretch of slow states.
void fast_get_state(const engine_t* self, double* x);

/// End a stretch of slow states, if there is one: z holds the state again.
void fast_leave(engine_t* self);

/// The kept circuit from which a system differs in its constants alone, with the constants of the system; NULL if there is
/// none.
circuit_t* fast_retune_circuit(const engine_t* self, const engine_system_t* system);

/// Adapt the present mode to the constants of its circuit, which have changed since it was built.
void fast_retune_mode(engine_t* self);

#else

static inline bool    fast_advance(engine_t* self, int64_t tick) { return (void)self, (void)tick, false; }
static inline bool    fast_begin(engine_t* self, int64_t tick) { return (void)self, (void)tick, false; }
static inline int64_t fast_run(engine_t* self, int64_t before, double* y) {
    return (void)self, (void)before, (void)y, 0;
}
static inline void       fast_read(const engine_t* self, double* row) { (void)self, (void)row; }
static inline void       fast_get_state(const engine_t* self, double* x) { (void)self, (void)x; }
static inline void       fast_leave(engine_t* self) { (void)self; }
static inline circuit_t* fast_retune_circuit(const engine_t* self, const engine_system_t* system) {
    return (void)self, (void)system, (circuit_t*)NULL;
}
static inline void fast_retune_mode(engine_t* self) { (void)self; }

#endif

#ifdef __GNUC__
#pragma GCC visibility pop
#endif

#endif  // ENGINE_FAST_H
