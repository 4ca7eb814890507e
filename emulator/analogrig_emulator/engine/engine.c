#include "engine_state.h"

#include <stdlib.h>
#include <string.h>

// ---------------------------------------------       LIFE CYCLE       ---------------------------------------------

static bool is_within(int value, int low, int high) { return value >= low && value <= high; }

engine_t* engine_new(
    int states, int inputs, int products, int kinks, int outputs, double sample_period_s, int64_t events_per_sample) {
    if (!is_within(states, 0, ENGINE_MAX_STATES) || !is_within(inputs, 0, ENGINE_MAX_INPUTS) ||
        !is_within(products, 0, ENGINE_MAX_PRODUCTS) || products > inputs || 2 * products > kinks ||
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
    self->products          = products;
    self->kinks             = kinks;
    self->outputs           = outputs;
    self->columns           = states + inputs + 1;
    self->tick_s            = sample_period_s / (double)ENGINE_TICKS_PER_SAMPLE;
    self->events_per_sample = events_per_sample;
    products_plan(self);
    engine_restart(self);
    return self;
}

void engine_restart(engine_t* const self) {
    self->has_system = false;
    self->now        = 0;
    self->counts     = (engine_counts_t){ 0 };
    self->is_slow    = false;
    self->ahead      = 0;
    self->w          = self->arguments[0];
    self->w_before   = self->arguments[1];
    self->w_there    = self->arguments[2];
    memset(self->z, 0, sizeof self->z);
    memset(self->drives, 0, sizeof self->drives);
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
    for (int i = 0; i < CIRCUITS && self->circuits[i] != NULL; i++) {
        for (int k = 0; k < MODES; k++) {
            free(self->circuits[i]->store[k].block);
            free(self->circuits[i]->store[k].slow.block);
            products_free(self->circuits[i]->store[k].collocation);
        }
        free(self->circuits[i]->block);
        free(self->circuits[i]);
    }
    free(self);
}

// ---------------------------------------------    CIRCUIT AND STATE   ---------------------------------------------

static bool holds(const engine_t* const self, const circuit_t* circuit, const engine_system_t* system) {
    const sizes_t sizes = sizes_of(self);
    return circuit->is_set && is_equal(sizes.abc, sizeof(double), circuit->abc, system->abc) &&
           is_equal(sizes.g, sizeof(double), circuit->g, system->g) &&
           is_equal(sizes.cde, sizeof(double), circuit->cde, system->cde) &&
           is_equal(sizes.w_phi, sizeof(double), circuit->w_phi, system->w_phi) &&
           is_equal(sizes.lmn, sizeof(double), circuit->lmn, system->lmn) &&
           is_equal(sizes.y_phi, sizeof(double), circuit->y_phi, system->y_phi) &&
           is_equal(sizes.kinks, sizeof(engine_kink_t), circuit->kink, system->kinks) &&
           is_equal(sizes.products, sizeof(engine_product_t), circuit->products, system->products);
}

/// Take `count` elements of a block.
static double* carve(double** block, size_t count) {
    double* const part = *block;
    *block += count;
    return part;
}

/// Return a circuit with room for its arrays; NULL if memory is short.
static circuit_t* new_circuit(const engine_t* const self) {
    const sizes_t    sizes     = sizes_of(self);
    const size_t     of_kinks  = (size_t)PANEL_ELEMENTS(self->kinks, self->columns);
    const size_t     of_panels = of_kinks + (size_t)PANEL_ELEMENTS(self->outputs, self->columns);
    const size_t     matrices  = sizes.abc + sizes.g + sizes.cde + sizes.w_phi + sizes.lmn + sizes.y_phi;
    circuit_t* const circuit   = calloc(1, sizeof *circuit);
    if (circuit != NULL) {
        circuit->block = malloc((matrices + of_panels) * sizeof(double) + sizes.kinks * sizeof(engine_kink_t) +
                                sizes.products * sizeof(engine_product_t) + 1U);
    }
    if (circuit == NULL || circuit->block == NULL) {
        free(circuit);
        return NULL;
    }
    double* free_part   = circuit->block;
    circuit->abc        = carve(&free_part, sizes.abc);
    circuit->g          = carve(&free_part, sizes.g);
    circuit->cde        = carve(&free_part, sizes.cde);
    circuit->w_phi      = carve(&free_part, sizes.w_phi);
    circuit->lmn        = carve(&free_part, sizes.lmn);
    circuit->y_phi      = carve(&free_part, sizes.y_phi);
    circuit->cde_panels = carve(&free_part, of_kinks);
    circuit->lmn_panels = carve(&free_part, of_panels - of_kinks);
    circuit->kink       = (engine_kink_t*)(void*)free_part;
    circuit->products   = (engine_product_t*)(void*)&circuit->kink[sizes.kinks];
    return circuit;
}

void circuit_pack(const engine_t* const self, circuit_t* circuit) {
    panels_pack(self->kinks, self->columns, self->columns, circuit->cde, circuit->cde_panels);
    panels_pack(self->outputs, self->columns, self->columns, circuit->lmn, circuit->lmn_panels);
}

/// Put a circuit in the place of the one set longest ago, and make it the present one.
static engine_status_t keep_circuit(engine_t* const self, const engine_system_t* system) {
    const sizes_t sizes = sizes_of(self);
    circuit_t**   place = &self->circuits[self->oldest];
    if (*place == NULL) {
        *place = new_circuit(self);
    }
    circuit_t* const circuit = *place;
    if (circuit == NULL) {
        return ENGINE_NO_MEMORY;
    }
    self->oldest = (self->oldest + 1) % CIRCUITS;
    copy(sizes.abc, sizeof(double), system->abc, circuit->abc);
    copy(sizes.g, sizeof(double), system->g, circuit->g);
    copy(sizes.cde, sizeof(double), system->cde, circuit->cde);
    copy(sizes.w_phi, sizeof(double), system->w_phi, circuit->w_phi);
    copy(sizes.lmn, sizeof(double), system->lmn, circuit->lmn);
    copy(sizes.y_phi, sizeof(double), system->y_phi, circuit->y_phi);
    copy(sizes.kinks, sizeof(engine_kink_t), system->kinks, circuit->kink);
    copy(sizes.products, sizeof(engine_product_t), system->products, circuit->products);
    circuit->stored = 0;
    circuit->oldest = 0;
    self->circuit   = circuit;
    products_set_laws(self, circuit->products);
    kinks_list_feeding(self);
    circuit->is_set = kinks_are_unique(self);
    circuit_pack(self, circuit);
    return circuit->is_set ? ENGINE_OK : ENGINE_NOT_UNIQUE;
}

/// The kept circuit that equals a system; NULL if there is none.
static circuit_t* find_circuit(const engine_t* const self, const engine_system_t* system) {
    int place = 0;
    while (place < CIRCUITS && self->circuits[place] != NULL && !holds(self, self->circuits[place], system)) {
        place++;
    }
    return place < CIRCUITS ? self->circuits[place] : NULL;
}

engine_status_t engine_set_system(engine_t* const self, const engine_system_t* system) {
    engine_status_t status = ENGINE_OK;
    if (self->has_system && holds(self, self->circuit, system)) {
        return ENGINE_OK;
    }
    if (self->has_system) {
        fast_leave(self);
    }
    circuit_t* equal = find_circuit(self, system);
    if (equal == NULL) {
        equal = fast_retune_circuit(self, system);
    }
    if (equal != NULL) {
        self->circuit = equal;
    } else {
        status = keep_circuit(self, system);
    }
    if (status == ENGINE_OK) {
        self->w_panels = self->circuit->cde_panels;
        self->y_panels = self->circuit->lmn_panels;
        status         = mode_enter(self);
    }
    self->has_system = status == ENGINE_OK;
    return status;
}

void engine_get_state(const engine_t* const self, double* x) {
    if (self->is_slow) {
        fast_get_state(self, x);
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
    if (self->products > 0) {
        return products_advance(self, tick);
    }
    while (status == ENGINE_OK && self->now < tick) {
        if (!fast_advance(self, tick)) {
            status = events_advance(self, tick);
        }
    }
    return status;
}

/// Advance to the instant of an edge and apply it. An edge to the present level is ignored: it must not change how the
/// steps are cut.
static engine_status_t take_edge(engine_t* const self, int64_t tick, int32_t input, double level) {
    if (tick < self->now || input < 0 || input >= self->inputs - self->products) {
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
    fast_leave(self);
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
        fast_read(self, y);
        return;
    }
    self->kernels->multiply(self->outputs, self->columns, self->y_panels, self->z, out);
    if (out != y) {
        memcpy(y, padded, (size_t)self->outputs * sizeof y[0]);
    }
}

/// The place in a copy of an engine's array, of which `there` points to a row.
static double* place_in(engine_t* copy, const engine_t* const self, const double* there) {
    return (double*)(void*)((char*)copy + ((const char*)there - (const char*)self));
}

/// Record y of engine_look_ahead(), unless record_sample() has. A copy advances, whose modes are those of the original.
static engine_status_t record_ahead(const engine_t* const self, double* y) {
    if (self->is_slow && self->clear >= self->now + self->ahead) {
        return ENGINE_OK;
    }
    engine_t copy                = *self;
    copy.w                       = place_in(&copy, self, self->w);
    copy.w_before                = place_in(&copy, self, self->w_before);
    copy.w_there                 = place_in(&copy, self, self->w_there);
    self->mode->is_pinned        = true;
    const engine_status_t status = advance(&copy, self->now + self->ahead);
    self->mode->is_pinned        = false;
    fast_leave(&copy);
    record_sample(&copy, y);
    return status;
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
            status = self->ahead > 0 ? record_ahead(self, &y[self->outputs]) : ENGINE_OK;
            y += row_length(self);
            self->counts.samples++;
            y += row_length(self) * fast_run(self, edge < edges && tick[edge] <= until ? tick[edge] : until + 1, y);
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
            y += (self->counts.samples - recorded) * row_length(self);
        }
    }
    return status == ENGINE_OK && taken < edges ? ENGINE_EDGE : status;
}

/// Write the numbers of one play to the circuits.
static void set_numbers(const engine_schedule_t* schedule, const double* constants) {
    for (int64_t turn = 0; turn < schedule->turns; turn++) {
        double* const row = &schedule->numbers[turn * schedule->row];
        for (int64_t i = 0; i < schedule->places; i++) {
            row[schedule->place[i]] = constants[turn * schedule->places + i];
        }
    }
}

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
                                double*                  end) {
    engine_status_t status = ENGINE_OK;
    for (int64_t i = 0; status == ENGINE_OK && i < plays; i++) {
        set_numbers(schedule, &constants[i * schedule->turns * schedule->places]);
        engine_restart(self);
        engine_watch(self, schedule->patience);
        if (start != NULL) {
            status = engine_set_system(self, schedule->circuit);
            status = status == ENGINE_OK ? engine_set_state(self, &start[i * self->states]) : status;
        }
        if (status == ENGINE_OK) {
            status = engine_play(self, schedule->turns, schedule->circuit, schedule->until, edges[i], &tick[i * room],
                                 input, &level[i * room], y);
        }
        engine_get_overdue(self, &overdue[i * self->kinks]);
        engine_get_state(self, &end[i * self->states]);
        y += self->counts.samples * self->outputs;
    }
    return status;
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

engine_status_t engine_drive(engine_t* const self, int product, int64_t first, int64_t samples, const double* terms) {
    if (product < 0 || product >= self->products || first < 0 || samples < 1 ||
        first > self->now / ENGINE_TICKS_PER_SAMPLE) {
        return ENGINE_EDGE;
    }
    self->drives[product] = (drive_t){ first, samples, terms };
    return ENGINE_OK;
}

void engine_look_ahead(engine_t* const self, int64_t ticks) { self->ahead = ticks; }

void engine_get_counts(const engine_t* const self, engine_counts_t* counts) { *counts = self->counts; }
