#include "engine_state.h"

#include <stdlib.h>
#include <string.h>

// ---------------------------------------------       LIFE CYCLE       ---------------------------------------------

static bool is_within(int value, int low, int high) { return value >= low && value <= high; }

engine_t*
engine_new(int states, int inputs, int kinks, int outputs, double sample_period_s, int64_t events_per_sample) {
    if (!is_within(states, 0, ENGINE_MAX_STATES) || !is_within(inputs, 0, ENGINE_MAX_INPUTS) ||
        !is_within(kinks, 0, ENGINE_MAX_KINKS) || !is_within(outputs, 0, ENGINE_MAX_OUTPUTS) ||
        !(sample_period_s > 0.0)) {
        return NULL;
    }
    engine_t* const self = calloc(1, sizeof *self);
    if (self == NULL) {
        return NULL;
    }
    self->kernels           = kernels_find();
    self->states            = states;
    self->inputs            = inputs;
    self->kinks             = kinks;
    self->outputs           = outputs;
    self->columns           = states + inputs + 1;
    self->tick_s            = sample_period_s / (double)ENGINE_TICKS_PER_SAMPLE;
    self->events_per_sample = events_per_sample;
    engine_restart(self);
    return self;
}

void engine_restart(engine_t* const self) {
    self->has_system = false;
    self->now        = 0;
    self->counts     = (engine_counts_t){ 0 };
    self->is_slow    = false;
    self->w          = self->arguments[0];
    self->w_before   = self->arguments[1];
    self->w_there    = self->arguments[2];
    memset(self->z, 0, sizeof self->z);
    self->z[self->columns - 1] = 1.0;
    for (int k = 0; k < PADDED(ENGINE_MAX_KINKS); k++) {
        self->lower[k] = -(double)INFINITY;
        self->upper[k] = (double)INFINITY;
    }
    for (int k = 0; k < ENGINE_MAX_KINKS; k++) {
        self->outside[k] = NEVER;
    }
    engine_watch(self, ENGINE_TICKS_PER_SAMPLE);
}

void engine_free(engine_t* const self) {
    if (self == NULL) {
        return;
    }
    for (int i = 0; i < MODES; i++) {
        free(self->store[i].block);
        free(self->store[i].slow.block);
    }
    free(self);
}

// ---------------------------------------------    CIRCUIT AND STATE   ---------------------------------------------

/// Copy count elements. Return true iff they differ from those before.
static bool replace_elements(void* to, const void* from, size_t count, size_t size) {
    if (count == 0U || memcmp(to, from, count * size) == 0) {
        return false;
    }
    memcpy(to, from, count * size);
    return true;
}

engine_status_t engine_set_system(engine_t* const self, const engine_system_t* system) {
    const size_t n = (size_t)self->states, q = (size_t)self->kinks, p = (size_t)self->outputs;
    const size_t columns = (size_t)self->columns;
    bool         changed = !self->has_system;
    changed |= replace_elements(self->abc, system->abc, n * columns, sizeof(double));
    changed |= replace_elements(self->g, system->g, n * q, sizeof(double));
    changed |= replace_elements(self->cde, system->cde, q * columns, sizeof(double));
    changed |= replace_elements(self->w_phi, system->w_phi, q * q, sizeof(double));
    changed |= replace_elements(self->lmn, system->lmn, p * columns, sizeof(double));
    changed |= replace_elements(self->y_phi, system->y_phi, p * q, sizeof(double));
    changed |= replace_elements(self->kink, system->kinks, q, sizeof(engine_kink_t));
    if (!changed) {
        return ENGINE_OK;
    }
    if (self->has_system) {
        quiet_leave(self);
    }
    self->stored = 0;
    self->oldest = 0;
    kinks_list_feeding(self);
    self->has_system = kinks_are_unique(self);
    if (!self->has_system) {
        return ENGINE_NOT_UNIQUE;
    }
    panels_pack(self->kinks, self->columns, self->columns, self->cde, self->cde_panels);
    panels_pack(self->outputs, self->columns, self->columns, self->lmn, self->lmn_panels);
    self->w_panels               = self->cde_panels;
    self->y_panels               = self->lmn_panels;
    const engine_status_t status = mode_enter(self);
    self->has_system             = status == ENGINE_OK;
    return status;
}

void engine_get_state(const engine_t* const self, double* x) {
    if (self->is_slow) {
        quiet_get_state(self, x);
    } else {
        memcpy(x, self->z, (size_t)self->states * sizeof x[0]);
    }
}

engine_status_t engine_set_state(engine_t* const self, const double* x) {
    if (!self->has_system) {
        return ENGINE_NO_SYSTEM;
    }
    memcpy(self->z, x, (size_t)self->states * sizeof x[0]);
    return mode_enter(self);
}

// ---------------------------------------------         RUNS           ---------------------------------------------

static engine_status_t advance(engine_t* const self, int64_t tick) {
    engine_status_t status = ENGINE_OK;
    while (status == ENGINE_OK && self->now < tick) {
        if (!quiet_advance(self, tick)) {
            status = events_advance(self, tick);
        }
    }
    return status;
}

/// Advance to the instant of an edge and apply it. An edge to the present level is ignored: it must not change how the
/// steps are cut.
static engine_status_t take_edge(engine_t* const self, int64_t tick, int32_t input, double level) {
    if (tick < self->now || input < 0 || input >= self->inputs) {
        return ENGINE_EDGE;
    }
    const int    column = self->states + (int)input;
    const double before = self->z[column];
    if (before >= level && before <= level) {
        return ENGINE_OK;
    }
    const engine_status_t status = advance(self, tick);
    if (status != ENGINE_OK) {
        return status;
    }
    quiet_leave(self);
    self->z[column] = level;
    return mode_enter(self);
}

static bool is_finite(const engine_t* const self) {
    bool finite = true;
    for (int i = 0; i < self->states; i++) {
        finite = finite && isfinite(self->z[i]);
    }
    return finite;
}

static void record_sample(const engine_t* const self, double* y) {
    double  padded[PADDED(ENGINE_MAX_OUTPUTS)];
    double* out = self->outputs % PANEL == 0 ? y : padded;
    if (self->is_slow) {
        quiet_read(self, out);
    } else {
        self->kernels->multiply(self->outputs, self->columns, self->y_panels, self->z, out);
    }
    if (out != y) {
        memcpy(y, padded, (size_t)self->outputs * sizeof y[0]);
    }
}

/// Record the samples of a quiet stretch that come before a tick. Return their number.
static int64_t run_quiet(engine_t* const self, int64_t before, double* y) {
    const bool    quiet   = self->is_slow && self->clear == NO_END;
    const int64_t samples = quiet ? (before - 1 - self->now) / ENGINE_TICKS_PER_SAMPLE : 0;
    int64_t       k       = 0;
    while (k < samples) {
        if (self->slow_age == LEAP - 1 && self->outputs % PANEL == 0 && samples - k >= LEAP) {
            quiet_leap(self, &y[k * self->outputs]);
            k += LEAP;
        } else {
            quiet_step(self);
            record_sample(self, &y[k * self->outputs]);
            k++;
        }
    }
    self->counts.samples += samples > 0 ? samples : 0;
    return samples > 0 ? samples : 0;
}

engine_status_t engine_run(engine_t*      self,
                           int64_t        until,
                           int64_t        edges,
                           const int64_t* tick,
                           const int32_t* input,
                           const double*  level,
                           double*        y) {
    engine_status_t status = self->has_system ? ENGINE_OK : ENGINE_NO_SYSTEM;
    int64_t         edge   = 0;
    while (status == ENGINE_OK) {
        const int64_t instant = self->counts.samples * ENGINE_TICKS_PER_SAMPLE;
        const int64_t target  = instant <= until ? instant : until;
        self->events_left     = self->events_per_sample;
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
            record_sample(self, y);
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

engine_status_t engine_play(engine_t*              self,
                            int64_t                turns,
                            const engine_system_t* circuit,
                            const int64_t*         until,
                            int64_t                edges,
                            const int64_t*         tick,
                            const int32_t*         input,
                            const double*          level,
                            double*                y) {
    engine_status_t status = ENGINE_OK;
    int64_t         taken  = 0;
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

// ---------------------------------------------    WATCH AND COUNTS    ---------------------------------------------

void engine_watch(engine_t* const self, int64_t patience) {
    self->patience = patience;
    for (int k = 0; k < ENGINE_MAX_KINKS; k++) {
        self->overdue[k] = NEVER;
        self->outside[k] = self->outside[k] == NEVER ? NEVER : self->now;
    }
}

void engine_get_overdue(const engine_t* const self, int64_t* tick) {
    for (int k = 0; k < self->kinks; k++) {
        tick[k] = mode_overdue_tick(self, k);
    }
}

void engine_get_counts(const engine_t* const self, engine_counts_t* counts) { *counts = self->counts; }
