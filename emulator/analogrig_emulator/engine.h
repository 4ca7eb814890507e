/* The circuit engine: exact stepping of a piecewise-linear circuit between events.
 *
 *     dx/dt = A x + B u + c + G phi(w),   w = C x + D u + e + P phi(w),   y = L x + M u + n + R phi(w)
 *
 * phi acts on each element of w by itself; it is continuous and has three linear pieces ("kinks"). A vector of pieces,
 * one per kink, is a mode; within a mode the circuit is affine and is stepped with its matrix exponential. Inputs u are
 * constant between edges. Where phi feeds w (P is not 0), w is solved for; it must exist and be unique.
 *
 * Time is counted in ticks of 2^-22 of a sample period. For every mode that occurs the engine keeps exp(A h / 2^k) - I
 * for k = 22..0 (a ladder), so any whole number of ticks is a product of a few of them, and an event is found by
 * bisection to the tick. Where a Lyapunov function proves that no event can come before the next edge, only the states
 * that last longer than a sample period are stepped.
 *
 * Rows of [A B c], [C D e] and [L M n] are stored side by side: (states + inputs + 1) columns, row-major.
 * Not for interrupts or for the device: it allocates, and it is meant for the host. One engine must not be used by two
 * threads at once; different engines may. Results depend on the inputs alone, and not on how a run is cut into calls.
 */
#ifndef ENGINE_H
#define ENGINE_H

#include <stdint.h>

#define ENGINE_MAX_STATES 32
#define ENGINE_MAX_INPUTS 8
#define ENGINE_MAX_KINKS 64
#define ENGINE_MAX_OUTPUTS 256
#define ENGINE_MAX_UNKNOWNS 256
#define ENGINE_LEVELS 23
#define ENGINE_TICKS_PER_SAMPLE (INT64_C(1) << (ENGINE_LEVELS - 1))

typedef struct engine engine;

enum engine_status {
    ENGINE_OK = 0,
    ENGINE_NO_MEMORY,  /* a ladder could not be allocated */
    ENGINE_TOO_STIFF,  /* a rate so fast that no ladder of sensible height reaches it */
    ENGINE_EVENTS,     /* more events within one sample period than allowed */
    ENGINE_NOT_FINITE, /* the state has left the numbers */
    ENGINE_EDGE,       /* edges out of order, in the past, beyond the run, or of an input that is not there */
    ENGINE_NO_SYSTEM,  /* engine_set_system has not been called, or its last circuit was refused */
    ENGINE_NOT_UNIQUE  /* w = r + P phi(w) has no solution, or more than one, for some r */
};

/* One kink: phi(w) = slope[p] w + intercept[p], with p = 0 below lower, 1 between, 2 above upper. */
struct engine_kink {
    double lower;
    double upper;
    double slope[3];
    double intercept[3];
};

/* A circuit: abc (states rows), g (states x kinks), cde (kinks rows), w_phi (P, kinks x kinks), lmn (outputs rows),
 * y_phi (R, outputs x kinks). */
struct engine_system {
    const double *abc;
    const double *g;
    const double *cde;
    const double *w_phi;
    const double *lmn;
    const double *y_phi;
    const struct engine_kink *kinks;
};

struct engine_counts {
    int64_t samples;     /* recorded so far */
    int64_t events;      /* changes of mode at an instant the engine had to find */
    int64_t steps;       /* products tried, accepted or not */
    int64_t quiet;       /* samples stepped with the slow states alone */
    int64_t modes_built; /* ladders computed; more than there are modes when the store is too small */
};

/* A new engine at rest: x = 0, u = 0, before its first sample. NULL iff a size is out of range or memory is short. */
engine *engine_new(int states, int inputs, int kinks, int outputs, double sample_period_s, int64_t events_per_sample);

/* Frees the engine; NULL is allowed. */
void engine_free(engine *self);

/* As new, without a circuit; the memory of its ladders is kept. */
void engine_restart(engine *self);

/* Sets or replaces the circuit. x and u stay as they are; a circuit equal to the one before, bit for bit, changes
 * nothing at all. Cost: a copy, then a ladder for each mode that occurs (about 30 n^2 (n + m + 1) multiplications), and,
 * for each combination of pieces of the kinks that feed a w, a determinant; of more than 4096 combinations only those
 * that occur are checked. Call it before engine_run. On failure the engine has no circuit until one is accepted. */
enum engine_status engine_set_system(engine *self, const struct engine_system *system);

/* Copies the state x out and in. Setting it looks for events anew. */
void engine_get_state(const engine *self, double *x);
enum engine_status engine_set_state(engine *self, const double *x);

/* Advances to tick `until` and records y at every sample instant on the way that has not been recorded yet, the one at
 * `until` included, after the edges that fall on that very instant. Sample k is at tick k ENGINE_TICKS_PER_SAMPLE. y:
 * (as many samples as that is) x outputs, row-major. edges: at tick[i] input[i] becomes level[i]; ticks must not
 * decrease, must not lie before where the engine stands, and must not pass `until`. Afterwards the engine stands at
 * `until`. On failure it stands where it failed and only engine_free is sensible. */
enum engine_status engine_run(
    engine *self, int64_t until, int64_t edges, const int64_t *tick, const int32_t *input, const double *level,
    double *y);

/* engine_set_system and engine_run by turns: circuit[i] to tick until[i], which must not decrease. A circuit whose tick
 * has been reached is set, and not run. All edges of all turns, as of engine_run. */
enum engine_status engine_play(
    engine *self, int64_t turns, const struct engine_system *circuit, const int64_t *until, int64_t edges,
    const int64_t *tick, const int32_t *input, const double *level, double *y);

/* Watches, from here on, for kinks that stay outside their middle piece for `patience` ticks without a break (one
 * sample period when never called). Costs nothing where no mode changes. */
void engine_watch(engine *self, int64_t patience);

/* For each kink the first tick, since engine_watch, at which it had been outside for so long; -1 where it has not. */
void engine_get_overdue(const engine *self, int64_t *tick);

void engine_get_counts(const engine *self, struct engine_counts *counts);

/* Solves a x = b in place by Gaussian elimination with partial pivoting (a: n x n, b: n x columns, row-major; both
 * overwritten, b by x). Returns -1, or the index of the unknown for which no pivot was left (ENGINE_MAX_UNKNOWNS when n
 * exceeds that). Here and not in LAPACK: the same bits on every machine. */
int engine_solve(int n, int columns, double *a, double *b);

/* White noise of intensity q (n x n, symmetric) drives dx/dt = a x for period_s. phi (n x n) is exp(a period_s); cov is
 * the covariance gathered, integral of exp(a s) q exp(a' s) ds; factor is lower triangular with factor factor' = cov,
 * with columns of zeros for directions without noise. Returns whether all are finite. n <= ENGINE_MAX_STATES. */
int engine_noise_gather(int n, double period_s, const double *a, const double *q, double *phi, double *cov, double *factor);

/* For each of the samples y = reading x (outputs), then x = phi x + factor (the next n of normal). */
void engine_noise_run(
    int n, int outputs, int64_t samples, const double *phi, const double *factor, const double *reading,
    const double *normal, double *x, double *y);

#endif
