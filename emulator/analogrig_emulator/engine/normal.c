/// Standard normal numbers of numpy's Generator on PCG64 (O'Neill 2014), to the bit. Its ziggurat (Marsaglia and Tsang 2000)
/// accepts 99 of 100 numbers at once, and these are computed here. numpy's own function computes the others, and tells
/// engine_normal_learn() the table of the ziggurat.

#include "engine.h"

#include <stdbool.h>

#define BOXES 256
#define BOX_BITS 8
#define SIGN (UINT64_C(1) << BOX_BITS)
#define HALF (UINT64_C(1) << 63)
#define DISTANCE_BITS 52
#define DISTANCE ((UINT64_C(1) << DISTANCE_BITS) - 1)

#ifdef __SIZEOF_INT128__

__extension__ typedef unsigned __int128 uint128_t;

#define MULTIPLIER ((uint128_t)UINT64_C(0x2360ED051FC65DA4) << 64 | UINT64_C(0x4385DF649FCCF645))

/// A source whose first word is known. Without a generator, HALF follows, which every loop of numpy's function accepts.
typedef struct {
    uint64_t  first;
    int       taken;
    bool      has_generator;
    uint128_t state, increment;
} source_t;

static inline uint64_t step(uint128_t* state, uint128_t increment) {
    *state              = *state * MULTIPLIER + increment;
    const uint64_t high = (uint64_t)(*state >> 64), mixed = high ^ (uint64_t)*state;
    const unsigned places = (unsigned)(high >> 58);
    return mixed >> places | mixed << (-places & 63U);
}

static uint64_t next_word(void* const opaque) {
    source_t* const source = opaque;
    if (source->taken++ == 0) {
        return source->first;
    }
    return source->has_generator ? step(&source->state, source->increment) : HALF;
}

static double next_double(void* const opaque) { return (double)(next_word(opaque) >> 11) * 0x1p-53; }

static uint32_t next_half(void* const opaque) { return (uint32_t)next_word(opaque); }

static double call(engine_normal_t normal, source_t* source) {
    engine_bits_t bits = { source, next_word, next_half, next_double, next_word };
    return normal(&bits);
}

/// True if the ziggurat accepts this distance in a box at once.
static bool accepts(engine_normal_t normal, uint64_t box, uint64_t distance) {
    source_t source = { .first = distance << (BOX_BITS + 1) | box };
    call(normal, &source);
    return source.taken == 1;
}

int engine_normal_learn(engine_normal_t normal, double* width, uint64_t* limit) {
    for (uint64_t box = 0; box < BOXES; box++) {
        source_t source = { .first = SIGN << 1 | box };  // distance 1
        uint64_t low = 0, high = DISTANCE;
        width[box] = call(normal, &source);
        while (low < high) {
            const uint64_t middle = low + (high - low) / 2;
            if (accepts(normal, box, middle)) {
                low = middle + 1;
            } else {
                high = middle;
            }
        }
        limit[box] = low;
    }
    return 1;
}

void engine_normal_fill(engine_normal_t normal,
                        const double*   width,
                        const uint64_t* limit,
                        uint64_t*       generator,
                        int64_t         count,
                        double*         out) {
    source_t source  = { .has_generator = true };
    source.state     = (uint128_t)generator[0] << 64 | generator[1];
    source.increment = (uint128_t)generator[2] << 64 | generator[3];
    uint128_t state  = source.state;
    for (int64_t i = 0; i < count; i++) {
        const uint64_t word = step(&state, source.increment), box = word % BOXES;
        const uint64_t distance = word >> (BOX_BITS + 1) & DISTANCE;
        if (distance < limit[box]) {
            const double size = (double)(int64_t)distance * width[box];
            out[i]            = (word & SIGN) != 0 ? -size : size;
        } else {
            source.first = word;
            source.taken = 0;
            source.state = state;
            out[i]       = call(normal, &source);
            state        = source.state;
        }
    }
    generator[0] = (uint64_t)(state >> 64);
    generator[1] = (uint64_t)state;
}

#else

int engine_normal_learn(engine_normal_t normal, double* width, uint64_t* limit) {
    (void)normal;
    (void)width;
    (void)limit;
    return 0;
}

void engine_normal_fill(engine_normal_t normal,
                        const double*   width,
                        const uint64_t* limit,
                        uint64_t*       generator,
                        int64_t         count,
                        double*         out) {
    (void)normal;
    (void)width;
    (void)limit;
    (void)generator;
    (void)count;
    (void)out;
}

#endif
