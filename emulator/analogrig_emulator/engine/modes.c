#include "engine_state.h"

#include <stdlib.h>
#include <string.h>

int64_t mode_overdue_tick(const engine_t* const self, int kink) {
    if (self->overdue[kink] != NEVER || self->outside[kink] == NEVER) {
        return self->overdue[kink];
    }
    const int64_t due = self->outside[kink] + self->patience;
    return due <= self->now ? due : NEVER;
}

/// Record that a kink is in its present piece from now on.
static void watch_kink(engine_t* const self, int kink) {
    if (self->piece[kink] == PIECE_MIDDLE) {
        self->overdue[kink] = mode_overdue_tick(self, kink);
        self->outside[kink] = NEVER;
    } else if (self->outside[kink] == NEVER) {
        self->outside[kink] = self->now;
    }
}

static mode_t* find_mode(engine_t* const self) {
    for (int i = 0; i < self->stored; i++) {
        if (memcmp(self->store[i].piece, self->piece, (size_t)self->kinks) == 0) {
            return &self->store[i];
        }
    }
    return NULL;
}

static bool allocate(double** elements, int count) {
    if (*elements == NULL) {
        *elements = malloc((size_t)count * sizeof(double));
    }
    return *elements != NULL;
}

/// Build the present mode in the place of the oldest of the store.
static engine_status_t build_mode(engine_t* const self) {
    double    a[MAX_ELEMENTS];
    mode_t*   slot     = &self->store[self->oldest];
    const int columns  = self->columns;
    const int readings = PANEL_ELEMENTS(self->kinks, columns) + PANEL_ELEMENTS(self->outputs, columns);
    if (!allocate(&slot->ladder, ENGINE_LEVELS * PANEL_ELEMENTS(self->states, columns)) ||
        (self->feeds && !allocate(&slot->readings, readings))) {
        return ENGINE_NO_MEMORY;
    }
    memcpy(slot->piece, self->piece, (size_t)self->kinks);
    slot->has_slow = false;
    self->oldest   = (self->oldest + 1) % MODES;
    self->stored   = self->stored < MODES ? self->stored + 1 : MODES;
    self->mode     = slot;
    self->counts.modes_built++;
    if (self->feeds) {
        kinks_build_readings(self, slot->piece, slot->readings);
    }
    kinks_build_map(self, slot->piece, a);
    return ladder_build(self, a, slot->ladder);
}

engine_status_t mode_enter(engine_t* const self) {
    engine_status_t status = kinks_solve(self);
    if (status != ENGINE_OK) {
        return status;
    }
    for (int k = 0; k < self->kinks; k++) {
        self->piece[k] = kink_piece(&self->kink[k], self->here->w[k]);
        self->lower[k] = kink_lower_bound(&self->kink[k], self->piece[k]);
        self->upper[k] = kink_upper_bound(&self->kink[k], self->piece[k]);
        watch_kink(self, k);
    }
    self->elapsed      = 0;
    self->level_before = NO_LEVEL;
    self->quiet        = false;
    self->has_limit    = false;
    self->mode         = find_mode(self);
    if (self->mode == NULL) {
        status = build_mode(self);
    }
    if (status == ENGINE_OK && self->feeds) {
        self->w_panels = self->mode->readings;
        self->y_panels = &self->mode->readings[PANEL_ELEMENTS(self->kinks, self->columns)];
        measure_kinks(self, self->here);
    }
    return status;
}
