/// Streams of numpy.random.default_rng([seed, stream]), for many seeds at once: O'Neill, "Simple portable C++ seed entropy"
/// (2015) and "PCG: a family of simple fast space-efficient statistically good algorithms" (2014), PCG XSL RR 128/64.

#include "engine.h"

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

void engine_draw(int64_t streams, int64_t count, const uint64_t* states, double* out) {
    for (int64_t i = 0; i < streams; i++, states += 4) {
        const wide_t increment = join(states[2], states[3]);
        wide_t       state     = join(states[0], states[1]);
        for (int64_t k = 0; k < count; k++) {
            state                = step(state, increment);
            const uint64_t bits  = (uint64_t)(state >> 64) ^ (uint64_t)state;
            const unsigned turns = (unsigned)(state >> 122);
            *out++ = (double)((bits >> turns | bits << (-turns & 63U)) >> 11) * (1.0 / 9007199254740992.0);
        }
    }
}
