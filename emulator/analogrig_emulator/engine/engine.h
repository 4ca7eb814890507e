/// Engine: exact stepping of a piecewise-linear circuit between events.
///
///     dx/dt = A x + B u + c + G phi(w),   w = C x + D u + e + P phi(w),   y = L x + M u + n + R phi(w)
///
/// phi acts on each element of w separately. It is continuous and has three linear pieces; an element of phi is called a
/// kink. A mode is one piece for every kink. Within a mode the circuit is affine and is stepped with its matrix
/// exponential. The inputs u are constant between edges. Where phi feeds w (P is not 0), w is solved for; the solution
/// must exist and be unique.
///
/// Time is counted in ticks of 2^-22 sample periods. For every mode that occurs, the engine keeps a ladder: the matrices
/// exp(A h / 2^k) - I. Products of a few of them, and the Taylor series over the shortest step, advance by any number of
/// ticks. After an edge or an event w is looked at ever later instants, straight from the state there. The tick of an event
/// is found by Newton's method. Soon after it the fast states follow the slow ones, which alone are then stepped. Where a
/// Lyapunov function proves that no event comes before the next edge, w is looked at no more.
///
/// The last elements of u may be products: functions of two elements of w each, its arguments. Between events a circuit with
/// products is affine but for them. It is stepped by exponential collocation: the products are polynomials through the
/// Lobatto nodes of a step, and all else follows exactly. A product can be driven: a polynomial of time in each sample period
/// is added to it. Without factors it is an input that moves between samples, such as a recorded one.
///
/// The library is C99 with malloc, libm and the vectors of GCC and clang, for the host: not for interrupts and not for the
/// device. One engine must not be used by two threads at once; different engines may. Results depend on the inputs alone,
/// not on how a run is cut into calls, on the compiler's options or on the processor. RAM: 10 kB an engine, 40 kB a
/// circuit; for each of up to 64 modes 45 kB with seven states, and 40 kB once it has been without events for a sample period.
/// With products, a mode takes some 12 kB for each length of step in use instead. Stack: up to 600 kB with products.
///
/// Rows of [A B c], [C D e] and [L M n] are stored side by side: (states + inputs + 1) columns, row-major.
///
/// Distributed under the terms of the MIT License.

#ifndef ENGINE_H
#define ENGINE_H

#include <stdint.h>

#define ENGINE_MAX_STATES 96
#define ENGINE_MAX_NOISE_STATES 128
#define ENGINE_MAX_INPUTS 24
#define ENGINE_MAX_PRODUCTS 16
#define ENGINE_MAX_KINKS 192
#define ENGINE_MAX_OUTPUTS 256
#define ENGINE_MAX_UNKNOWNS 640
#define ENGINE_MAX_FACTOR_TERMS 16
#define ENGINE_DRIVE_TERMS 5
#define ENGINE_LEVELS 23
#define ENGINE_TICKS_PER_SAMPLE (INT64_C(1) << (ENGINE_LEVELS - 1))

typedef struct engine engine_t;

typedef enum {
    ENGINE_OK         = 0,
    ENGINE_NO_MEMORY  = 1,  ///< malloc failed
    ENGINE_TOO_STIFF  = 2,  ///< a time constant is 10^17 times shorter than a sample period
    ENGINE_EVENTS     = 3,  ///< more events within one sample period than allowed
    ENGINE_NOT_FINITE = 4,  ///< the state is no longer finite
    ENGINE_EDGE      = 5,  ///< an edge is out of order, in the past, beyond the run, or of an input that does not exist
    ENGINE_NO_SYSTEM = 6,  ///< no circuit was set, or the last one was refused
    ENGINE_NOT_UNIQUE = 7,  ///< w = r + P phi(w) has no solution, or several, for some r; or products feed one another
    ENGINE_NOT_CONVERGED = 8,  ///< products grow without bound, or have no solution; or their steps become ever shorter
} engine_status_t;

/// One kink: phi(w) = slope[p] w + intercept[p], with p = 0 below lower, 1 between, 2 above upper.
typedef struct {
    double lower;
    double upper;
    double slope[3];
    double intercept[3];
} engine_kink_t;

/// Laws of a product, with X and Y the values of its polynomials.
enum {
    ENGINE_PRODUCT  = 0,  ///< X Y
    ENGINE_QUOTIENT = 1,  ///< X / Y
    ENGINE_ROOT     = 2,  ///< sqrt(max(0, X)) Y
};

/// One product: a law of the value at p of the polynomial with coefficients x, in order of powers, and that of y at q. Its
/// arguments p and q are two elements of w without limits.
typedef struct {
    double x[ENGINE_MAX_FACTOR_TERMS];
    double y[ENGINE_MAX_FACTOR_TERMS];
    double law;
} engine_product_t;

/// A circuit, as arrays of the caller. They are copied. The arguments of the products are the last elements of w, in their
/// order.
typedef struct {
    const double*           abc;    ///< states rows
    const double*           g;      ///< states x kinks
    const double*           cde;    ///< kinks rows
    const double*           w_phi;  ///< P, kinks x kinks
    const double*           lmn;    ///< outputs rows
    const double*           y_phi;  ///< R, outputs x kinks
    const engine_kink_t*    kinks;
    const engine_product_t* products;
} engine_system_t;

/// Counters since engine_new() or engine_restart().
typedef struct {
    int64_t samples;      ///< samples recorded
    int64_t events;       ///< changes of mode at an instant that the engine had to find
    int64_t steps;        ///< matrix products tried, accepted or not
    int64_t quiet;        ///< samples stepped with the slow states alone
    int64_t modes_built;  ///< ladders computed; exceeds the number of modes if the store is too small
} engine_counts_t;

/// Return a new engine at rest before its first sample: x = 0, u = 0. products: number of inputs, the last ones, that are
/// products; kinks: elements of w, the arguments of products among them. NULL iff a size is out of range, the sample period
/// is not positive, or memory is short. Cost: one calloc.
engine_t* engine_new(
    int states, int inputs, int products, int kinks, int outputs, double sample_period_s, int64_t events_per_sample);

/// Free the engine. NULL is allowed.
void engine_free(engine_t* self);

/// Return the engine to the state of engine_new(), without a circuit. Memory and the matrices of circuits are kept.
void engine_restart(engine_t* self);

/// Set or replace the circuit; to be called before engine_run(). x and u keep their values. A circuit equal to the present
/// one to the bit changes nothing. The last 8 circuits are kept, with the matrices of their modes. One
/// that differs from these in its constants alone, as by the offsets of amplifiers, replaces that circuit at a small part of
/// the cost.
///
/// Fails with ENGINE_NOT_UNIQUE, or as engine_run() where it enters the mode. Without a circuit, engine_run() then fails.
/// Cost: a comparison with those kept; for a new one a copy, one determinant for each combination of pieces of the kinks that
/// feed a w, and later one ladder for each mode that occurs: about 30 n^2 (n + m + 1) multiplications with n states and m
/// inputs. Of more than 4096 combinations, only those that occur are checked.
engine_status_t engine_set_system(engine_t* self, const engine_system_t* system);

/// Copy the state to x. Cannot fail.
void engine_get_state(const engine_t* self, double* x);

/// Copy x to the state, and enter its mode. Fails with ENGINE_NO_SYSTEM, or as engine_run().
engine_status_t engine_set_state(engine_t* self, const double* x);

/// Advance to tick `until`, and record y at every sample instant up to it that is not recorded yet. Sample k is at tick
/// k ENGINE_TICKS_PER_SAMPLE, and follows the edges of that tick.
///
/// y: one row of outputs for each of these samples. edges: at tick[i], input[i] becomes level[i]. Ticks must not decrease,
/// lie before the present tick, or exceed `until`.
///
/// On failure the engine stands where it failed; only engine_restart() and engine_free() are then allowed.
/// Cost: one product of (states + inputs + 1) x kinks a look; about one look a sample, some 25 an event.
engine_status_t engine_run(engine_t*      self,
                           int64_t        until,
                           int64_t        edges,
                           const int64_t* tick,
                           const int32_t* input,
                           const double*  level,
                           double*        y);

/// Call engine_set_system() and engine_run() in turn: circuit[i] up to tick until[i], which must not decrease. A circuit whose
/// tick has been reached is set, but not run. edges: those of all turns. Fails as these two functions.
engine_status_t engine_play(engine_t*              self,
                            int64_t                turns,
                            const engine_system_t* circuit,
                            const int64_t*         until,
                            int64_t                edges,
                            const int64_t*         tick,
                            const int32_t*         input,
                            const double*          level,
                            double*                y);

/// Circuits of repeated plays, as of engine_play(), and the places in them of the numbers that differ between the plays.
typedef struct {
    int64_t                turns;
    const engine_system_t* circuit;  ///< matrices within the rows of numbers
    const int64_t*         until;
    int64_t                patience;  ///< as for engine_watch()
    double*                numbers;   ///< a row for each turn
    int64_t                row;       ///< length of a row
    int64_t                places;
    const int64_t*         place;  ///< indices in a row
} engine_schedule_t;

/// Call engine_restart(), engine_watch(), engine_play(), engine_get_overdue() and engine_get_state() for each of `plays` plays,
/// which differ in their edges and in some numbers. constants: turns x places for each play. start: states for each play, which
/// the first circuit starts from; NULL: rest. edges: their number in each play, of `room` in its row of tick and level; input: as
/// for engine_play(), in common. y: the rows of all plays. overdue: kinks for each play. end: states for each play.
///
/// Fails as engine_play(), in the first play that does.
engine_status_t engine_play_all(engine_t*                self,
                                const engine_schedule_t* schedule,
                                int64_t                  plays,
                                const double*            constants,
                                const double*            start,
                                const int32_t*           input,
                                int64_t                  room,
                                const int64_t*           edges,
                                const int64_t*           tick,
                                const double*            level,
                                double*                  y,
                                int64_t*                 overdue,
                                double*                  end);

/// Watch, from the present tick on, for kinks that stay outside their middle piece for `patience` ticks without a break.
/// Before the first call, patience is one sample period. Cost: none while no mode changes.
void engine_watch(engine_t* self, int64_t patience);

/// For each kink, write the first tick since engine_watch() at which it had been outside for that long; -1 if there is none.
void engine_get_overdue(const engine_t* self, int64_t* tick);

/// Drive a product from now until engine_restart(): add to it the polynomial of the present sample period, with ENGINE_DRIVE_TERMS
/// coefficients in order of powers of the time since its sample, in sample periods. terms: a row for each of `samples` samples
/// from sample `first` on; the level at the end of the last one holds. They are not copied. Neighbouring polynomials must meet, also
/// those of one call and the next. No sample before `first` may follow. Fails with ENGINE_EDGE iff there is no such product,
/// first < 0 or samples < 1. Its own curvature shortens no step.
engine_status_t engine_drive(engine_t* self, int product, int64_t first, int64_t samples, const double* terms);

/// From now on record y once more `ticks` after each sample, at most one sample period: a row then holds both. To be called
/// before the first sample. Edges and circuits after the sample are not foreseen, and the samples do not change.
/// Cost: a longer product a sample, and a copy of the engine where it does not step slow states.
void engine_look_ahead(engine_t* self, int64_t ticks);

/// Copy the counters.
void engine_get_counts(const engine_t* self, engine_counts_t* counts);

/// Solve a x = b by Gaussian elimination with partial pivoting. a: n x n, b: n x columns, both row-major and overwritten, b
/// by x. Return -1 on success, else the index of the unknown that has no pivot; ENGINE_MAX_UNKNOWNS if n exceeds that.
/// Written by hand because LAPACK's bits differ between machines. Cost: n^3 / 3 + n^2 columns multiplications.
int engine_solve(int n, int columns, double* a, double* b);

/// Gather white noise of intensity q (n x n, symmetric) that drives dx/dt = a x for period_s. All results are n x n:
/// phi = exp(a period_s); cov, the integral of exp(a s) q exp(a' s) ds; factor, lower triangular with factor factor' = cov
/// and zero columns for directions without noise. Return 1 iff phi and cov are finite. n is at most ENGINE_MAX_STATES.
int engine_noise_gather(
    int n, double period_s, const double* a, const double* q, double* phi, double* cov, double* factor);

/// Noise of some samples: x becomes phi x + factor v in a sample period, and y = reading x. reading: outputs x n.
typedef struct {
    int64_t       samples;
    const double* phi;
    const double* factor;
    const double* reading;
} engine_noise_t;

/// For each sample of all stretches, add sign y to volts, outputs a row, then advance x by a sample period. v: the next n of
/// normal.
void engine_noise_add(int                   n,
                      int                   outputs,
                      int64_t               stretches,
                      const engine_noise_t* noise,
                      const double*         sign,
                      const double*         normal,
                      double*               x,
                      double*               volts);

/// Round the instants of `count` edges to ticks, and up to a multiple of grid; those before tick 0 move there. Of edges at one
/// tick keep the last, and of those only the ones that change the level. Write the edges from tick start to stop - 1 to tick and
/// level, and their number to edges. instant: rising; level: the level after each instant, overwritten. All this for each of
/// `plays` rows of `count`.
void engine_edges(int64_t       plays,
                  int64_t       count,
                  int64_t       grid,
                  int64_t       start,
                  int64_t       stop,
                  const double* instant,
                  double*       level,
                  int64_t*      tick,
                  int64_t*      edges);

/// Record in seen the input of a card's converter in LSB, for each play's `samples` rows of `channels` voltages. Return 1 iff all
/// are finite. card: rows of `channels` numbers: gain, droop [V], lower end of the range [V], LSB [V], noise [LSB] and offset
/// [LSB]. normal: standard normal numbers, one for each voltage. held: a row of voltages for each play, held before, then those
/// of the last sample: the step from sample to sample lacks the part `residual`. NULL: it lacks nothing.
int engine_see(int64_t       plays,
               int64_t       samples,
               int           channels,
               const double* card,
               double        residual,
               const double* volts,
               const double* normal,
               double*       held,
               double*       seen);

/// Convert `count` inputs in LSB to codes of `bits` bits, at most 16. clipped: 1 where the input is beyond the end codes.
/// levels: 2^bits transitions, that of code 0 unused, for successive approximation; NULL: the ideal ones.
/// stuck_high, stuck_low: masks of stuck bits.
void engine_convert(int64_t       count,
                    int           bits,
                    const double* levels,
                    unsigned      stuck_high,
                    unsigned      stuck_low,
                    const double* seen,
                    uint16_t*     codes,
                    uint8_t*      clipped);

/// For each sample and channel, record in out the voltage `late` sample periods after row[channel] of the `stride` rows of that
/// sample. A row has the voltages at its instant, and those `ahead` sample periods later. Between these, and between a row and
/// the one before, voltages are taken from a straight line. before: the row before the first one.
void engine_take(int64_t        samples,
                 int            channels,
                 int64_t        stride,
                 const int64_t* row,
                 double         ahead,
                 const double*  before,
                 const double*  probes,
                 const double*  late,
                 double*        out);

/// Write the states of numpy.random.PCG64 that default_rng([seed[i], stream]) begins with: rows of the high and the low half of the
/// state, and those of the increment.
void engine_seed(int64_t count, const uint64_t* seed, uint32_t stream, uint64_t* states);

/// Write the next `count` uniform numbers from 0 to 1 of each of the streams. The states stay as they are.
void engine_draw(int64_t streams, int64_t count, const uint64_t* states, double* out);

/// Numpy's random_standard_normal(), of a bitgen_t*.
typedef double engine_normal_t(void* source);

/// Learn from numpy's function how it makes a normal number of one word: the width of each of its 256 boxes, and the limit below
/// which a magnitude becomes a number at once; 0 where it does otherwise than it did in numpy 2.4.
void engine_learn(engine_normal_t* normal, double* width, uint64_t* limit);

/// Write the next `count` standard normal numbers of each of the streams, those of numpy's function to the bit, and the states
/// after them. The function makes those that take more than one word.
void engine_normals(engine_normal_t* normal,
                    const double*    width,
                    const uint64_t*  limit,
                    int64_t          streams,
                    int64_t          count,
                    uint64_t*        states,
                    double*          out);

#endif  // ENGINE_H
