// SPDX-License-Identifier: MIT
/// plant: a mass on a spring and a damper, driven by a square wave and sampled by a 12-bit card with 1 LSB of noise.
/// Integer arithmetic only, so that every compiler and target computes the same codes.

#ifndef PLANT_H_INCLUDED
#define PLANT_H_INCLUDED

#include <stdbool.h>
#include <stdint.h>

/// Steps of the equation of motion (semi-implicit Euler) per sample. An edge may come at any step.
#define PLANT_TICKS_PER_SAMPLE 16U

/// Fixed-point scale of displacement and velocity [codes], and of the coefficients per tick.
#define PLANT_UNIT 16777216
#define PLANT_COEFFICIENT_UNIT 1073741824

#define PLANT_LOW_CODES 410
#define PLANT_HIGH_CODES 3686

typedef struct {
    int32_t stiffness;  ///< K / M, times tick^2
    int32_t damping;    ///< B / M, times tick
    int32_t drive;      ///< acceleration per code of the force
} plant_mechanics_t;

/// Front suspension: M 115 kg, B 3021 N s/m, K 24,500 N/m, sampled every 10 ms. The second plant has K = 18,000 N/m.
#define PLANT_FRONT ((plant_mechanics_t){ .stiffness = 89357, .damping = 17629207, .drive = 53614 })
#define PLANT_FRONT_SOFT ((plant_mechanics_t){ .stiffness = 65650, .damping = 17629207, .drive = 53614 })

typedef struct {
    plant_mechanics_t mechanics;
    uint32_t          random;
    uint32_t          tick;
    uint32_t          edge_tick;          ///< tick of the next edge
    uint32_t          half_period_ticks;  ///< ticks between two edges
    int32_t           force;              ///< [codes]
    bool              reads_first;        ///< a sample precedes an edge of the same tick
    int64_t           displacement;
    int64_t           velocity;  ///< [codes per tick]
} plant_t;

typedef struct {
    int32_t u;  ///< the force as read [codes]
    int32_t y;  ///< the displacement as read [codes]
} plant_codes_t;

/// Return a plant at rest under the low force.
static inline plant_t plant_at_rest(const plant_mechanics_t mechanics, const uint32_t seed, const uint32_t edge_tick) {
    const int64_t still = ((int64_t)mechanics.drive * PLANT_LOW_CODES * PLANT_UNIT) / mechanics.stiffness;
    return (plant_t){ .mechanics         = mechanics,
                      .random            = seed,
                      .edge_tick         = edge_tick,
                      .half_period_ticks = 50U * PLANT_TICKS_PER_SAMPLE,
                      .force             = PLANT_LOW_CODES,
                      .displacement      = still };
}

/// Pseudo-random number: upper half of a linear congruential generator (Knuth, Lewis).
static inline uint32_t plant_random(plant_t* const self) {
    self->random = (self->random * 1664525U) + 1013904223U;
    return self->random >> 16U;
}

/// Approximately Gaussian noise: sum of four uniform numbers, standard deviation 1 LSB.
static inline int64_t plant_noise(plant_t* const self) {
    int64_t sum = -2 * 65535;
    for (int i = 0; i < 4; i++) {
        sum += plant_random(self);
    }
    return sum * 443;
}

/// Sample a value: with noise, rounded to a code.
static inline int32_t plant_read(plant_t* const self, const int64_t value) {
    const int64_t noisy = value + plant_noise(self);
    const int64_t half  = (noisy < 0) ? (-PLANT_UNIT / 2) : (PLANT_UNIT / 2);
    return (int32_t)((noisy + half) / PLANT_UNIT);
}

static inline void plant_toggle(plant_t* const self) {
    if (self->tick == self->edge_tick) {
        self->force = PLANT_LOW_CODES + PLANT_HIGH_CODES - self->force;
        self->edge_tick += self->half_period_ticks;
    }
}

static inline void plant_move(plant_t* const self) {
    const plant_mechanics_t* const m    = &self->mechanics;
    const int64_t                  push = (int64_t)m->drive * self->force * PLANT_UNIT;
    const int64_t                  pull = (m->stiffness * self->displacement) + (m->damping * self->velocity);
    self->velocity += (push - pull) / PLANT_COEFFICIENT_UNIT;
    self->displacement += self->velocity;
    self->tick++;
}

/// Sample both channels and advance the plant to the next sample.
static inline plant_codes_t plant_next(plant_t* const self) {
    if (!self->reads_first) {
        plant_toggle(self);
    }
    const int32_t u = plant_read(self, (int64_t)self->force * PLANT_UNIT);
    const int32_t y = plant_read(self, self->displacement);
    for (uint32_t i = 0U; i < PLANT_TICKS_PER_SAMPLE; i++) {
        plant_toggle(self);
        plant_move(self);
    }
    return (plant_codes_t){ .u = u, .y = y };
}

#endif  // PLANT_H_INCLUDED
