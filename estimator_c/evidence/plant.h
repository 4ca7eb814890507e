/// A mass on a spring and a damper, driven by a square wave and read by a 12-bit card with 1 LSB of noise: in integers
/// alone, so that every compiler and every target makes the same codes of it.

#ifndef PLANT_H_INCLUDED
#define PLANT_H_INCLUDED

#include <stdbool.h>
#include <stdint.h>

/// The equation of motion takes so many steps (semi-implicit Euler) between two samples; edges come at any of them.
#define PLANT_TICKS_PER_SAMPLE 16U

/// What is multiplied by it: displacement and velocity in codes, and the coefficients per tick.
#define PLANT_UNIT 16777216
#define PLANT_COEFFICIENT_UNIT 1073741824

#define PLANT_LOW_CODES 410
#define PLANT_HIGH_CODES 3686

typedef struct {
    int32_t stiffness;  ///< K / M times the square of a tick
    int32_t damping;    ///< B / M times a tick
    int32_t drive;      ///< acceleration per code of the force
} plant_mechanics_t;

/// The front suspension: M 115 kg, B 3021 N s/m, K 24,500 N/m, 10 ms between samples; the second has K at 18,000 N/m.
#define PLANT_FRONT ((plant_mechanics_t){ .stiffness = 89357, .damping = 17629207, .drive = 53614 })
#define PLANT_FRONT_SOFT ((plant_mechanics_t){ .stiffness = 65650, .damping = 17629207, .drive = 53614 })

typedef struct {
    plant_mechanics_t mechanics;
    uint32_t          random;
    uint32_t          tick;
    uint32_t          edge_tick;          ///< of the next edge
    uint32_t          half_period_ticks;  ///< between two edges
    int32_t           force;              ///< [codes]
    bool              reads_first;        ///< an edge at the very instant of a sample is not yet in it
    int64_t           displacement;
    int64_t           velocity;  ///< per tick
} plant_t;

typedef struct {
    int32_t u;  ///< the force as read [codes]
    int32_t y;  ///< the displacement as read [codes]
} plant_codes_t;

/// At rest under the low force.
static inline plant_t plant_at_rest(const plant_mechanics_t mechanics, const uint32_t seed, const uint32_t edge_tick) {
    const int64_t still = ((int64_t)mechanics.drive * PLANT_LOW_CODES * PLANT_UNIT) / mechanics.stiffness;
    return (plant_t){ .mechanics         = mechanics,
                      .random            = seed,
                      .edge_tick         = edge_tick,
                      .half_period_ticks = 50U * PLANT_TICKS_PER_SAMPLE,
                      .force             = PLANT_LOW_CODES,
                      .displacement      = still };
}

/// The upper half of a linear congruential generator (Knuth, Lewis).
static inline uint32_t plant_random(plant_t* const self) {
    self->random = (self->random * 1664525U) + 1013904223U;
    return self->random >> 16U;
}

/// Close to Gaussian: the sum of four even ones; standard deviation 1 LSB.
static inline int64_t plant_noise(plant_t* const self) {
    int64_t sum = -2 * 65535;
    for (int i = 0; i < 4; i++) {
        sum += plant_random(self);
    }
    return sum * 443;
}

/// As a card reads it: with noise, and rounded.
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

/// Reads both channels and lets the plant go on until the next sample.
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
