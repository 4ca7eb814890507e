#include "engine_state.h"

/// Level of the shortest step near a bound that is not crossed: 1/64 of a sample period, with a look at its middle.
/// Anything faster was set off by an event just before, and after an event the steps grow from one tick.
#define NEAR_LEVEL (TOP_LEVEL - 6)

/// The end of a step with respect to the bounds of the present mode.
typedef enum { CLEAR, NEAR, CROSSED } judgement_t;

static void step(engine_t* const self, int level, point_t* to) {
    double        change[PADDED(ENGINE_MAX_STATES)];
    const double* f = &self->mode->ladder[level * PANEL_ELEMENTS(self->states, self->columns)];
    panels_multiply(self->states, self->columns, f, self->here->z, change);
    for (int i = 0; i < self->states; i++) {
        to->z[i] = self->here->z[i] + change[i];
    }
    measure_kinks(self, to);
    self->counts.steps++;
}

/// Length of a step of this level over that of the step before; 0 if there is no step to compare with.
static double compute_growth(const engine_t* const self, int level) {
    if (self->level_before == NO_LEVEL) {
        return 0.0;
    }
    return (double)(INT64_C(1) << level) / (double)(INT64_C(1) << self->level_before);
}

/// Compare the end of a step with the bounds. A step inside all bounds is CLEAR if w could not have left them on the
/// way, even straying beyond both ends by the larger of two amounts: its change in this step, and its change at the
/// speed of the step before. At the top of a peak the first alone may be zero.
static judgement_t judge(const engine_t* const self, int level, const point_t* to) {
    const double *before = self->before->w, *here = self->here->w;
    const double  factor = compute_growth(self, level);
    bool          near   = false;
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

static judgement_t attempt(engine_t* const self, int level, point_t* to) {
    step(self, level, to);
    return judge(self, level, to);
}

static void accept(engine_t* const self, int level) {
    const int64_t ticks  = INT64_C(1) << level;
    point_t*      oldest = self->before;
    self->before         = self->here;
    self->here           = self->there;
    self->there          = oldest;
    self->level_before   = level;
    self->now += ticks;
    self->elapsed += ticks;
    if (self->elapsed > ENGINE_TICKS_PER_SAMPLE) {
        self->elapsed = ENGINE_TICKS_PER_SAMPLE;
    }
}

/// Level of the longest step allowed: not longer than the time since the last event. The steps after an event are then
/// 1, 1, 2, 4, ... ticks and resolve whatever it sets off.
static int longest_level(const engine_t* const self, int64_t ticks) {
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

/// Approach a bound that is crossed within the next 2^level ticks, step over it by less than a tick, and enter the mode
/// beyond.
static engine_status_t cross(engine_t* const self, int level) {
    while (--level >= 0) {
        if (attempt(self, level, self->there) != CROSSED) {
            accept(self, level);
        }
    }
    const judgement_t last = attempt(self, 0, self->there);
    accept(self, 0);
    if (last != CROSSED) {
        return ENGINE_OK;
    }
    self->counts.events++;
    return self->events_left-- > 0 ? mode_enter(self) : ENGINE_EVENTS;
}

engine_status_t events_step(engine_t* const self, int64_t ticks) {
    int         level     = longest_level(self, ticks);
    judgement_t judgement = attempt(self, level, self->there);
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
