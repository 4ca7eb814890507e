/// Streams of numpy.random.default_rng([seed, stream]), for many seeds at once: O'Neill, "Simple portable C++ seed entropy"
/// (2015) and "PCG: a family of simple fast space-efficient statistically good algorithms" (2014), PCG XSL RR 128/64.

#include "../engine.h"

#include <stdbool.h>
#include <string.h>

#define POOL 4

__extension__ typedef unsigned __int128 wide_t;

/// Scramble one word; every call has another constant.
static uint32_t scramble(uint32_t value, uint32_t* constant, uint32_t factor) {
    value ^= *constant;
    *constant *= factor;
    value *= *constant;
    return value ^ (value >> 16);
}

static uint32_t mix(uint32_t one, uint32_t other) {
    const uint32_t mixed = UINT32_C(0xca01f9dd) * one - UINT32_C(0x4973f715) * other;
    return mixed ^ (mixed >> 16);
}

/// Pool of entropy of [seed, stream]. A seed below 2^32 is one word, any other two.
static void fill_pool(uint64_t seed, uint32_t stream, uint32_t* pool) {
    const uint32_t low = (uint32_t)seed, high = (uint32_t)(seed >> 32);
    const uint32_t words[POOL] = { low, high > 0 ? high : stream, high > 0 ? stream : 0 };
    uint32_t       constant    = UINT32_C(0x43b0d7e5);
    for (int i = 0; i < POOL; i++) {
        pool[i] = scramble(words[i], &constant, UINT32_C(0x931e8875));
    }
    for (int from = 0; from < POOL; from++) {
        for (int to = 0; to < POOL; to++) {
            if (from != to) {
                pool[to] = mix(pool[to], scramble(pool[from], &constant, UINT32_C(0x931e8875)));
            }
        }
    }
}

static wide_t join(uint64_t high, uint64_t low) { return (wide_t)high << 64 | low; }

static wide_t step(wide_t state, wide_t increment) {
    return state * join(UINT64_C(2549297995355413924), UINT64_C(4865540595714422341)) + increment;
}

void engine_seed(int64_t count, const uint64_t* seed, uint32_t stream, uint64_t* states) {
    for (int64_t i = 0; i < count; i++, states += 4) {
        uint32_t pool[POOL], constant = UINT32_C(0x8b51f9dd);
        uint64_t drawn[POOL];
        fill_pool(seed[i], stream, pool);
        for (int k = 0; k < POOL; k++) {
            const uint64_t low = scramble(pool[2 * k % POOL], &constant, UINT32_C(0x58f38ded));
            drawn[k] = (uint64_t)scramble(pool[(2 * k + 1) % POOL], &constant, UINT32_C(0x58f38ded)) << 32 | low;
        }
        const wide_t increment = join(drawn[2], drawn[3]) << 1 | 1;
        const wide_t state     = step(increment + join(drawn[0], drawn[1]), increment);
        states[0]              = (uint64_t)(state >> 64);
        states[1]              = (uint64_t)state;
        states[2]              = (uint64_t)(increment >> 64);
        states[3]              = (uint64_t)increment;
    }
}

/// The next word of a stream.
static uint64_t next_word(wide_t* state, wide_t increment) {
    *state               = step(*state, increment);
    const uint64_t bits  = (uint64_t)(*state >> 64) ^ (uint64_t)*state;
    const unsigned turns = (unsigned)(*state >> 122);
    return bits >> turns | bits << (-turns & 63U);
}

static double uniform_of(uint64_t word) { return (double)(word >> 11) * (1.0 / 9007199254740992.0); }

void engine_draw(int64_t streams, int64_t count, const uint64_t* states, double* out) {
    for (int64_t i = 0; i < streams; i++, states += 4) {
        const wide_t increment = join(states[2], states[3]);
        wide_t       state     = join(states[0], states[1]);
        for (int64_t k = 0; k < count; k++) {
            *out++ = uniform_of(next_word(&state, increment));
        }
    }
}

// ---------------------------------------------     NORMAL NUMBERS     ---------------------------------------------

// Numpy draws them by Marsaglia and Tsang, "The ziggurat method for generating random variables" (2000): a word is a box, a sign
// and a magnitude. A magnitude below the limit of its box is a number at once, times the width of the box.

#define BOXES 256
#define MAGNITUDES (UINT64_C(1) << 52)

static uint64_t word_of(int box, uint64_t sign, uint64_t magnitude) {
    return magnitude << 9 | sign << 8 | (uint64_t)box;
}

/// numpy/random/bitgen.h: a source of random bits.
typedef struct {
    void* state;
    uint64_t (*next_uint64)(void*);
    uint32_t (*next_uint32)(void*);
    double (*next_double)(void*);
    uint64_t (*next_raw)(void*);
} source_t;

/// State of a source that gives one word, then 0s, which numpy makes a number at once.
typedef struct {
    uint64_t word;
    int      calls;
} given_t;

static uint64_t give_word(void* state) {
    given_t* const given = state;
    return given->calls++ == 0 ? given->word : 0;
}

static uint32_t give_half(void* state) { return (uint32_t)give_word(state); }

static double give_uniform(void* state) {
    ((given_t*)state)->calls++;
    return 0.5;
}

/// Number that numpy makes of a word. Return true if it takes that word alone.
static bool make_number(engine_normal_t* normal, uint64_t word, double* number) {
    given_t  given  = { word, 0 };
    source_t source = { &given, give_word, give_half, give_uniform, give_word };
    *number         = normal(&source);
    return given.calls == 1;
}

static bool is_number(engine_normal_t* normal, int box, uint64_t sign, uint64_t magnitude, double expected) {
    double number;
    return make_number(normal, word_of(box, sign, magnitude), &number) && !(number < expected || number > expected);
}

void engine_learn(engine_normal_t* normal, double* width, uint64_t* limit) {
    for (int box = 0; box < BOXES; box++) {
        uint64_t below = 0, above = MAGNITUDES;  // the limit is above `below`, if there is one
        double   number;
        (void)make_number(normal, word_of(box, 0, 1), &width[box]);
        while (above - below > 1) {
            const uint64_t middle = below + (above - below) / 2;
            if (make_number(normal, word_of(box, 0, middle), &number)) {
                below = middle;
            } else {
                above = middle;
            }
        }
        const double last = (double)below * width[box], inner = (double)(below / 3) * width[box];
        const bool   is_as_expected = below > 1 && is_number(normal, box, 0, 1, width[box]) &&
                                    is_number(normal, box, 0, below, last) && is_number(normal, box, 1, below, -last) &&
                                    is_number(normal, box, 1, below / 3, -inner);
        limit[box] = is_as_expected ? below + 1 : 0;
    }
}

/// State of a stream as numpy's function draws from it.
typedef struct {
    wide_t state, increment;
} stream_t;

static uint64_t draw_word(void* state) {
    stream_t* const stream = state;
    return next_word(&stream->state, stream->increment);
}

static uint32_t draw_half(void* state) { return (uint32_t)draw_word(state); }

static double draw_uniform(void* state) { return uniform_of(draw_word(state)); }

void engine_normals(engine_normal_t* normal,
                    const double*    width,
                    const uint64_t*  limit,
                    int64_t          streams,
                    int64_t          count,
                    uint64_t*        states,
                    double*          out) {
    for (int64_t i = 0; i < streams; i++, states += 4) {
        stream_t stream = { join(states[0], states[1]), join(states[2], states[3]) };
        source_t source = { &stream, draw_word, draw_half, draw_uniform, draw_word };
        for (int64_t k = 0; k < count; k++, out++) {
            wide_t         after     = stream.state;
            const uint64_t word      = next_word(&after, stream.increment);
            const uint64_t magnitude = word >> 9 & (MAGNITUDES - 1);
            const int      box       = (int)(word % BOXES);
            if (magnitude < limit[box]) {
                const double number = (double)(int64_t)magnitude * width[box];
                uint64_t     bits;
                memcpy(&bits, &number, sizeof bits);
                bits ^= (word & UINT64_C(0x100)) << 55;
                memcpy(out, &bits, sizeof bits);
                stream.state = after;
            } else {
                *out = normal(&source);
            }
        }
        states[0] = (uint64_t)(stream.state >> 64);
        states[1] = (uint64_t)stream.state;
    }
}
