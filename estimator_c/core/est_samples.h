// SPDX-License-Identifier: MIT
/// Stored samples, from which the equations are made. Private to the library.

#ifndef EST_SAMPLES_H_INCLUDED
#define EST_SAMPLES_H_INCLUDED

#include "est_shape.h"

static inline uint8_t larger(const uint8_t a, const uint8_t b) { return (a > b) ? a : b; }

/// Shift n values, newest first, by one place.
static inline void shift(float* const x, const uint_fast8_t n, const float newest) {
    EST_UNROLL
    for (uint_fast8_t i = (uint_fast8_t)(n - 1U); i > 0U; i--) {
        x[i] = x[i - 1U];
    }
    x[0] = newest;
}

static inline void shift_u(est_t* const self, const float newest) { shift(self->u, EST_INPUTS_KEPT, newest); }

static inline void shift_y(est_t* const self, const float newest) { shift(self->y, EST_NA_MAX, newest); }

/// Number of samples before its own that an equation needs.
static inline uint8_t count_past(const est_config_t* const config) {
    return larger(config->na, (uint8_t)(config->nb + config->nk - 1U));
}

/// Declare the samples so far unknown: the next equation must not use them.
static inline void forget_samples(est_t* const self) {
    self->known     = false;
    self->pending_n = count_past(self->config);
    if (EST_WITH_EDGES) {
        self->ambiguity_n = 0U;
    }
}

/// True iff the code is finite and within +-EST_CODE_LIMIT.
static inline bool is_plausible(const float code) { return est_magnitude(code) <= EST_CODE_LIMIT; }

#endif  // EST_SAMPLES_H_INCLUDED
