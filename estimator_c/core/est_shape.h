// SPDX-License-Identifier: MIT
/// Compile-time choices of a build: the shape of the model, its features, inlining and unrolling. Private to the
/// library.

#ifndef EST_SHAPE_H_INCLUDED
#define EST_SHAPE_H_INCLUDED

#include "est.h"

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ > 0))
#error "compile without -ffast-math, -Ofast and -ffinite-math-only: bad samples are detected by NaN and infinities"
#endif

#ifdef EST_FIXED_NA
#if (EST_FIXED_NA > EST_NA_MAX) || (EST_FIXED_NB > EST_NB_MAX) || (EST_FIXED_NK > EST_NK_MAX) ||                       \
    (EST_FIXED_NC > EST_NC_MAX)
#error "EST_FIXED_NA, _NB, _NK and _NC must not exceed EST_NA_MAX, _NB_MAX, _NK_MAX and _NC_MAX"
#endif
#endif

/// Functions that become part of each caller: with a constant shape they are straight-line code. gcc alone decides
/// wrongly in both directions.
#ifdef __GNUC__
#define EST_INLINE static inline __attribute__((always_inline))
#else
#define EST_INLINE static inline
#endif

/// Loops over the parameters and over small constants. A build for size, -Os, keeps them as loops.
#if (defined(__clang__) || (defined(__GNUC__) && (__GNUC__ >= 8))) && !defined(__OPTIMIZE_SIZE__)
#define EST_UNROLL _Pragma("GCC unroll 8")
#else
#define EST_UNROLL
#endif

/// True iff some feature of the build observes the edges of u.
#define EST_KNOWS_EDGES (EST_WITH_EDGES || EST_WITH_ADAPTATION || EST_WITH_WATCH || EST_WITH_ROBUSTNESS)

/// Number of stored values of u, including u(k): that of the longest model, because a loop of fixed length is faster.
/// To see an edge takes two values; an edge that may be early or late takes one more than the model.
#ifdef EST_FIXED_NA
#define EST_INPUTS_WANTED (EST_FIXED_NB + EST_FIXED_NK)
#else
#define EST_INPUTS_WANTED (EST_NB_MAX + EST_NK_MAX)
#endif
#if EST_WITH_EDGES || (EST_KNOWS_EDGES && (EST_INPUTS_WANTED < 2U))
#define EST_INPUTS_KEPT (EST_INPUTS_WANTED + 1U)
#else
#define EST_INPUTS_KEPT EST_INPUTS_WANTED
#endif

/// Magnitude, in one instruction where the processor has it.
EST_INLINE float est_magnitude(const float x) {
#ifdef __GNUC__
    return __builtin_fabsf(x);
#else
    return (x > 0.0F) ? x : (0.0F - x);
#endif
}

/// Copy n values; return the end of the copy.
static inline float* append(float* const out, const float* const from, const uint_fast8_t n) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < n; i++) {
        out[i] = from[i];
    }
    return &out[n];
}

/// Set n values to zero.
static inline void clear(float* const out, const uint_fast16_t n) {
    for (uint_fast16_t i = 0U; i < n; i++) {
        out[i] = 0.0F;
    }
}

/// The smaller number; the second one if either is NaN.
static inline float est_min(const float a, const float b) { return (a < b) ? a : b; }

/// The larger number; the second one if either is NaN.
static inline float est_max(const float a, const float b) { return (a > b) ? a : b; }

/// Count one up, to UINT16_MAX.
static inline void increment(uint16_t* const counter) {
    const uint32_t next = *counter + (uint32_t)1U;
    *counter            = (uint16_t)(next - (next >> 16U));
}

/// True iff the number is in the range. False for NaN.
static inline bool within(const float x, const float low, const float high) { return (x >= low) && (x <= high); }

/// True iff the trigger is the cumulative sum.
EST_INLINE bool is_cusum(const est_config_t* const config) { return config->trigger.kind == EST_TRIGGER_CUSUM; }

/// Orders of the model.
typedef struct {
    uint8_t na;
    uint8_t nb;
    uint8_t nk;
    uint8_t nc;
    uint8_t offset;  ///< 1 if the offset is estimated, else 0
} est_shape_t;

/// Orders of the configuration, or those that the build fixes with -DEST_FIXED_NA=2U, _NB, _NK, _NC and _OFFSET.
EST_INLINE est_shape_t est_shape_of(const est_config_t* const config) {
#ifdef EST_FIXED_NA
    (void)config;
    return (est_shape_t){ EST_FIXED_NA, EST_FIXED_NB, EST_FIXED_NK, EST_FIXED_NC, EST_FIXED_OFFSET };
#else
    return (est_shape_t){ .na     = config->na,
                          .nb     = config->nb,
                          .nk     = config->nk,
                          .nc     = (EST_WITH_ADAPTATION && (EST_NC_MAX > 0U)) ? config->nc : 0U,
                          .offset = config->offset ? 1U : 0U };
#endif
}

/// Number of parameters.
EST_INLINE uint_fast8_t est_shape_count(const est_shape_t shape) {
    return (uint_fast8_t)((uint32_t)shape.na + shape.nb + shape.nc + shape.offset);
}

/// True iff parameter j is the offset: the last parameter, with a prior of its own.
EST_INLINE bool est_is_offset(const est_shape_t shape, const uint_fast8_t j) {
    return j >= ((uint32_t)shape.na + shape.nb + shape.nc);
}

#endif  // EST_SHAPE_H_INCLUDED
