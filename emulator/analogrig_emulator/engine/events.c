/// The search for events. From the tick of an edge, an event or a new circuit (the origin) on, w is looked at 1, 2, 4, 8 ...
/// shortest steps later, straight from the state there. From a sample period after it on, steps are of one sample period.

#include "engine_state.h"

#include <string.h>

#define NO_LOOK (TOP_LEVEL + 1)
#define NEAR_TICKS (INT64_C(1) << NEAR_LEVEL)

/// Steps of Newton's method, and places from which it is tried, before the search for a tick turns to bisection.
#define NEWTON_STEPS 6
#define NEWTON_PLACES 6

/// Part of a tick to which a root is found.
#define ROOT_TOLERANCE 1e-3

/// Set w_there to panels z, and judge the step from `clear` that ends so many ticks later.
static judgement_t look(engine_t* const self, int columns, const double* panels, const double* z, int64_t ticks) {
    self->counts.steps++;
    return self->kernels->look(self, columns, panels, z, self->stride > 0 ? (double)ticks / (double)self->stride : 0.0);
}

bool events_extend(engine_t* const self, int64_t tick, int columns, const double* panels, const double* z) {
    const int64_t ticks = tick - self->clear;
    if (look(self, columns, panels, z, ticks) != CLEAR) {
        return false;
    }
    step_accept(self, ticks);
    return true;
}

static void measure(const engine_t* const self, const double* z) {
    self->kernels->multiply(self->kinks, self->columns, self->w_panels, z, self->w_there);
}

/// Go on with steps from z and the present instant, at the end of a quiet stretch.
static void resume(engine_t* const self) {
    measure(self, self->z);
    step_accept(self, 0);
    self->clear = self->now;
    self->look  = NO_LOOK;
}

static bool is_beyond(const engine_t* const self, int kink, double w) {
    return !(w >= self->lower[kink] && w <= self->upper[kink]);
}

// ---------------------------------------------       CROSSINGS        ---------------------------------------------

/// The way of one argument beyond its bound, for times from `clear` on. A place is a state from which its series is known.
typedef struct {
    int    kink;
    double sign;  // of w beyond the bound
    double bound;
    double before, now, end;  // excess over the bound a stride ago, at `clear` and at the end of the step
} crossing_t;

typedef struct {
    int64_t tick;  // after `clear`
    double  z[PADDED(MAX_COLUMNS)];
    double  terms[TERMS * PADDED(ENGINE_MAX_STATES)];
} place_t;

static double compute_excess(const engine_t* const self, const crossing_t* crossing, const double* z) {
    const double* row = w_row_of(self, crossing->kink);
    double        w   = 0.0;
    for (int j = 0; j < self->columns; j++) {
        w += row[j * PANEL] * z[j];
    }
    return crossing->sign * (w - crossing->bound);
}

/// The instant of a crossing by the parabola through its excess at three instants, or by the line through two.
static double guess_tick(const engine_t* const self, const crossing_t* crossing, int64_t ticks) {
    const double length = (double)ticks, line = (crossing->end - crossing->now) / length;
    double       curvature = 0.0;
    if (self->stride > 0) {
        const double before = (double)self->stride;
        curvature           = (line - (crossing->now - crossing->before) / before) / (length + before);
    }
    // The root of now + slope t + curvature t^2 that has the sign of the line, in the form that does not cancel.
    const double slope = line - curvature * length;
    const double root  = sqrt(slope * slope - 4.0 * curvature * crossing->now);
    return -2.0 * crossing->now / (slope + root);
}

/// Improve a guess by Newton's method on the series at a place. Return true if it has converged within a shortest step.
static bool improve_guess(const engine_t* const self, const crossing_t* crossing, const place_t* place, double* guess) {
    const double* row  = w_row_of(self, crossing->kink);
    const double  step = (double)(INT64_C(1) << self->mode->base);
    double        excess[TERMS + 1], part = (*guess - (double)place->tick) / step;
    double        gain[PADDED(ENGINE_MAX_STATES)] = { 0.0 };
    for (int j = 0; j < self->states; j++) {
        gain[j] = crossing->sign * row[j * PANEL];
    }
    excess[0] = compute_excess(self, crossing, place->z);
    for (int k = 0; k < TERMS; k++) {
        excess[k + 1] = 0.0;
        for (int j = 0; j < self->states; j += PANEL) {
            const double* term = &place->terms[j * TERMS + k * PANEL];
            const double* by   = &gain[j];
            excess[k + 1]      = excess[k + 1] + by[0] * term[0] + by[1] * term[1] + by[2] * term[2] + by[3] * term[3];
        }
    }
    for (int i = 0; i < NEWTON_STEPS; i++) {
        double value = 0.0, slope = 0.0;
        for (int k = TERMS; k >= 0; k--) {
            slope = slope * part + value;
            value = value * part + excess[k];
        }
        const double change = value / slope;
        part -= change;
        *guess = (double)place->tick + part * step;
        if (!(fabs(part) <= 1.0)) {
            return false;
        }
        if (fabs(change) * step < ROOT_TOLERANCE) {
            return true;
        }
    }
    return false;
}

/// Put a place at the shortest step before an instant.
static void put_place(engine_t* const self, double instant, place_t* place) {
    place->tick = (int64_t)instant >> self->mode->base << self->mode->base;
    copy_z(self, self->z, place->z);
    ladder_move(self, place->tick, place->z);
    ladder_expand(self, place->z, place->terms);
}

/// Return the tick after `clear` at which a kink is beyond its bound, at the latest `ticks`. Set z to the state there.
static int64_t find_tick(engine_t* const self, const crossing_t* crossing, int64_t ticks, double* z) {
    int64_t low = 0, high = ticks;
    double  guess = guess_tick(self, crossing, ticks);
    place_t place;
    for (int i = 0; i < NEWTON_PLACES && !self->mode->stiff && guess >= 0.0 && guess <= (double)ticks; i++) {
        put_place(self, guess, &place);
        if (improve_guess(self, crossing, &place, &guess) && guess >= 0.0 && guess < (double)ticks) {
            high = (int64_t)guess + 1;
            copy_z(self, place.z, z);
            ladder_sum(self, place.terms, high - place.tick, z);
            return high;
        }
    }
    while (high - low > 1) {
        const int64_t middle = low + (high - low) / 2;
        copy_z(self, self->z, z);
        ladder_move(self, middle, z);
        if (compute_excess(self, crossing, z) <= 0.0) {
            low = middle;
        } else {
            high = middle;
        }
    }
    copy_z(self, self->z, z);
    ladder_move(self, high, z);
    return high;
}

/// Go to the first tick beyond a bound that is crossed within the next ticks, and enter the mode there. z is at `clear`,
/// and w_there at the end of the step.
static engine_status_t cross(engine_t* const self, int64_t ticks) {
    bool   found[ENGINE_MAX_KINKS] = { false };
    double z[PADDED(MAX_COLUMNS)], end[PADDED(MAX_COLUMNS)] = { 0.0 };
    bool   has_end = false;
    for (int k = 0; k < self->kinks; k++) {
        if (found[k] || !is_beyond(self, k, self->w_there[k])) {
            continue;
        }
        const bool       above = self->w_there[k] > self->upper[k];
        const double     sign = above ? 1.0 : -1.0, bound = above ? self->upper[k] : self->lower[k];
        const crossing_t crossing = { k,
                                      sign,
                                      bound,
                                      sign * (self->w_before[k] - bound),
                                      sign * (self->w[k] - bound),
                                      sign * (self->w_there[k] - bound) };
        const int64_t    tick     = find_tick(self, &crossing, ticks, z);
        found[k]                  = true;
        if (!has_end || tick < ticks) {
            has_end = true;
            ticks   = tick;
            copy_z(self, z, end);
            measure(self, end);
            k = -1;  // another one may have crossed before
        }
    }
    copy_z(self, end, self->z);
    self->now = self->clear += ticks;
    self->counts.events++;
    return self->events_left-- > 0 ? mode_enter(self) : ENGINE_EVENTS;
}

// ---------------------------------------------          STEPS         ---------------------------------------------

/// True if an argument is beyond its bound so many ticks after `from`. w_there is then there.
static bool crosses_within(engine_t* const self, const double* from, int64_t ticks) {
    double z[PADDED(MAX_COLUMNS)], w[PADDED(ENGINE_MAX_KINKS)];
    copy_z(self, from, z);
    ladder_move(self, ticks, z);
    self->kernels->multiply(self->kinks, self->columns, self->w_panels, z, w);
    for (int k = 0; k < self->kinks; k++) {
        if (is_beyond(self, k, w[k])) {
            memcpy(self->w_there, w, (size_t)self->kinks * sizeof w[0]);
            return true;
        }
    }
    return false;
}

/// Look from the origin at ever later instants. Return CLEAR if no event comes up to a tick; NEAR if steps have to go on from
/// `clear`; CROSSED if a bound is crossed within the next *ticks.
static judgement_t search(engine_t* const self, int64_t tick, int64_t* ticks) {
    while (self->clear < tick && self->look <= TOP_LEVEL) {
        ladder_reach(self, self->look);
        const judgement_t judgement = self->kernels->look_on(self, tick);
        if (judgement == CLEAR) {
            continue;
        }
        *ticks = self->origin + (INT64_C(1) << self->look) - self->clear;
        if (judgement == CROSSED || *ticks > NEAR_TICKS) {
            return judgement;
        }
        // Within the first step after an event the circuit hardly moves: it has no look at its middle.
        if (self->clear > self->origin &&
            crosses_within(self, self->origin_z, self->clear - self->origin + *ticks / 2)) {
            *ticks /= 2;
            return CROSSED;
        }
        step_accept(self, *ticks);
        self->look++;
    }
    return self->clear >= tick ? CLEAR : NEAR;
}

bool events_look_until(engine_t* const self, int64_t tick) {
    int64_t ticks;
    return search(self, tick, &ticks) == CLEAR;
}

/// Length of the longest step from `clear` towards a tick: not longer than the time since the last event. The steps after
/// an event grow with it and resolve whatever it sets off; the first is as long as the first look.
static int64_t longest_step(const engine_t* const self, int64_t tick) {
    const int64_t left = tick - self->clear, passed = self->clear - self->origin;
    const int64_t since = passed > 0 ? passed : INT64_C(1) << self->mode->base;
    const int64_t limit = left < since ? left : since;
    int           level = self->mode->base;
    while (level < TOP_LEVEL && (INT64_C(2) << level) <= limit) {
        level++;
    }
    return limit < INT64_C(1) << level ? limit : INT64_C(1) << level;
}

static judgement_t attempt(engine_t* const self, int64_t ticks, double* z) {
    copy_z(self, self->z, z);
    ladder_move(self, self->clear + ticks - self->now, z);
    return look(self, self->columns, self->w_panels, z, ticks);
}

static void go(engine_t* const self, int64_t tick) {
    ladder_move(self, tick - self->now, self->z);
    self->now = tick;
}

/// Take one step from `clear`, where z is, towards a tick.
static engine_status_t step(engine_t* const self, int64_t tick) {
    double      z[PADDED(MAX_COLUMNS)];
    int64_t     ticks     = longest_step(self, tick);
    judgement_t judgement = attempt(self, ticks, z);
    while (judgement == NEAR && ticks > NEAR_TICKS) {
        ticks /= 2;
        judgement = attempt(self, ticks, z);
    }
    if (judgement == NEAR && ticks > 1 && crosses_within(self, self->z, ticks / 2)) {
        ticks /= 2;
        judgement = CROSSED;
    }
    if (judgement == CROSSED) {
        return cross(self, ticks);
    }
    copy_z(self, z, self->z);
    step_accept(self, ticks);
    self->now = self->clear;
    return ENGINE_OK;
}

/// Take one step over the sample period that ends at a tick, if no event comes in the rest of it.
static bool step_over(engine_t* const self, int64_t tick) {
    double        z[PADDED(MAX_COLUMNS)];
    const int64_t ticks = tick - self->clear;
    if (tick - self->now != ENGINE_TICKS_PER_SAMPLE || ticks > self->clear - self->origin ||
        attempt(self, ticks, z) != CLEAR) {
        return false;
    }
    copy_z(self, z, self->z);
    step_accept(self, ticks);
    self->now = tick;
    return true;
}

engine_status_t events_advance(engine_t* const self, int64_t tick) {
    int64_t     ticks;
    judgement_t judgement;
    if (self->clear == NO_END && self->kinks > 0) {
        resume(self);
    }
    while ((judgement = search(self, tick, &ticks)) != CLEAR) {
        if (self->look > TOP_LEVEL && self->now < self->clear && step_over(self, tick)) {
            return ENGINE_OK;
        }
        self->look = NO_LOOK;
        go(self, self->clear);
        const bool            crosses = judgement == CROSSED && self->clear + ticks <= tick;
        const engine_status_t status  = crosses ? cross(self, ticks) : step(self, tick);
        if (status != ENGINE_OK || crosses) {
            return status;
        }
    }
    if (self->now != self->origin || tick % ENGINE_TICKS_PER_SAMPLE != 0 || !fast_begin(self, tick)) {
        go(self, tick);
    }
    return ENGINE_OK;
}
