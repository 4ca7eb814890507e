#include "engine_state.h"

#include <limits.h>
#include <stdlib.h>
#include <string.h>

/// Of a mode whose matrices could not be made: it must not be found.
#define NO_PIECE UCHAR_MAX

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
    for (int i = 0; i < self->circuit->stored; i++) {
        if (memcmp(self->circuit->store[i].piece, self->piece, (size_t)self->kinks) == 0) {
            return &self->circuit->store[i];
        }
    }
    return NULL;
}

/// Make room for the matrices of a mode whose shortest step has level `base`.
static bool allocate(const engine_t* const self, mode_t* mode) {
    const int n = PANEL_ELEMENTS(self->states, self->columns), q = PANEL_ELEMENTS(self->kinks, self->columns);
    const int levels = ENGINE_LEVELS - mode->base;
    const int matrix = self->states * PADDED(self->columns);
    const int needed = (levels + TERMS) * n + matrix + (levels + 1) * q + PANEL_ELEMENTS(self->outputs, self->columns);
    if (mode->capacity < needed) {
        free(mode->block);
        mode->block    = malloc((size_t)needed * sizeof(double));
        mode->capacity = mode->block == NULL ? 0 : needed;
    }
    mode->ladder   = mode->block;
    mode->terms    = mode->ladder + levels * n;
    mode->change   = mode->terms + TERMS * n;
    mode->looks    = mode->change + matrix;
    mode->readings = mode->looks + levels * q;
    return mode->block != NULL;
}

void mode_point_readings(engine_t* const self) {
    if (self->circuit->feeds) {
        self->w_panels = self->mode->readings;
        self->y_panels = &self->mode->readings[PANEL_ELEMENTS(self->kinks, self->columns)];
    }
}

/// Build the present mode in the place of the oldest of the store.
static engine_status_t build_mode(engine_t* const self) {
    double a[MAX_ELEMENTS];
    if (self->circuit->store[self->circuit->oldest].is_pinned) {
        self->circuit->oldest = (self->circuit->oldest + 1) % MODES;
    }
    mode_t* const mode = &self->circuit->store[self->circuit->oldest];
    kinks_build_map(self, self->piece, a);
    const engine_status_t status = ladder_plan(self, a, &mode->base, &mode->stiff);
    if (status != ENGINE_OK || !allocate(self, mode)) {
        return status != ENGINE_OK ? status : ENGINE_NO_MEMORY;
    }
    memcpy(mode->piece, self->piece, (size_t)self->kinks);
    mode->has_slow        = false;
    mode->slow.is_chosen  = false;
    mode->tuning          = self->circuit->tuning;
    self->circuit->oldest = (self->circuit->oldest + 1) % MODES;
    self->circuit->stored = self->circuit->stored < MODES ? self->circuit->stored + 1 : MODES;
    self->mode            = mode;
    self->counts.modes_built++;
    if (self->circuit->feeds) {
        kinks_build_readings(self, mode->piece, mode->readings);
    }
    mode_point_readings(self);
    if (self->products > 0) {
        const engine_status_t built = products_build(self, a);
        mode->piece[0]              = built == ENGINE_OK ? mode->piece[0] : NO_PIECE;
        return built;
    }
    ladder_build(self, a);
    return ENGINE_OK;
}

engine_status_t mode_enter(engine_t* const self) {
    engine_status_t status = self->products > 0 ? products_solve(self) : kinks_solve(self);
    if (status != ENGINE_OK) {
        return status;
    }
    for (int k = 0; k < self->kinks; k++) {
        self->piece[k] = kink_piece(&self->circuit->kink[k], self->w[k]);
        self->lower[k] = kink_lower_bound(&self->circuit->kink[k], self->piece[k]);
        self->upper[k] = kink_upper_bound(&self->circuit->kink[k], self->piece[k]);
        watch_kink(self, k);
    }
    self->mode = find_mode(self);
    if (self->mode == NULL) {
        status = build_mode(self);
    } else if (self->mode->tuning != self->circuit->tuning) {
        fast_retune_mode(self);
    }
    if (status != ENGINE_OK) {
        return status;
    }
    if (self->circuit->feeds) {
        mode_point_readings(self);
        self->kernels->multiply(self->kinks, self->columns, self->w_panels, self->z, self->w);
    }
    copy_z(self, self->z, self->origin_z);
    self->origin    = self->now;
    self->clear     = self->kinks > 0 ? self->now : NO_END;
    self->stride    = 0;
    self->look      = self->mode->base;
    self->is_slow   = false;
    self->has_limit = false;
    return ENGINE_OK;
}
