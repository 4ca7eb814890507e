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

/// True in a build for size: -Os.
#if defined(__GNUC__) && defined(__OPTIMIZE_SIZE__)
#define EST_FOR_SIZE 1
#else
#define EST_FOR_SIZE 0
#endif

/// Functions that become part of each caller: with a constant shape they are straight-line code. gcc alone decides
/// wrongly in both directions.
#ifdef __GNUC__
#define EST_INLINE static inline __attribute__((always_inline))
#else
#define EST_INLINE static inline
#endif

/// Functions with several callers. They are inline too, except in a build for size, whose code would grow by a seventh,
/// and in one without optimisation, whose stack would double. With EST_WITH_EDGES=0 most of them have one caller left,
/// and gcc decides.
#if (EST_FOR_SIZE && EST_WITH_EDGES) || (defined(__GNUC__) && !defined(__OPTIMIZE__))
#define EST_SHARED static __attribute__((noinline, unused))
#elif EST_FOR_SIZE
#define EST_SHARED static inline
#else
#define EST_SHARED EST_INLINE
#endif

/// Loops over the parameters and over small constants. A build for size keeps them as loops.
#if (defined(__clang__) || (defined(__GNUC__) && (__GNUC__ >= 8))) && !EST_FOR_SIZE
#define EST_UNROLL _Pragma("GCC unroll 8")
#else
#define EST_UNROLL
#endif

/// True in a build that has code specialised for the two usual shapes: the shape is not fixed, and there is room.
#if !defined(EST_FIXED_NA) && !EST_FOR_SIZE && (EST_NA_MAX >= 2U) && (EST_NB_MAX >= 3U) && (EST_NK_MAX >= 1U) &&       \
    (EST_THETA_MAX >= 6U)
#define EST_SPECIALISED 1
#else
#define EST_SPECIALISED 0
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

/// Functions with several callers, or with one or none in a build without robustness.
#if EST_WITH_ROBUSTNESS
#define EST_ROBUST_SHARED EST_SHARED
#else
#define EST_ROBUST_SHARED EST_INLINE
#endif

/// Copy n values; return the end of the copy.
EST_SHARED float* append(float* const out, const float* const from, const uint_fast8_t n) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < n; i++) {
        out[i] = from[i];
    }
    return &out[n];
}

/// Set n values to zero.
EST_ROBUST_SHARED void clear(float* const out, const uint_fast16_t n) {
    for (uint_fast16_t i = 0U; i < n; i++) {
        out[i] = 0.0F;
    }
}

/// The smaller number; the second one if either is NaN.
EST_SHARED float est_min(const float a, const float b) { return (a < b) ? a : b; }

/// The larger number; the second one if either is NaN.
EST_SHARED float est_max(const float a, const float b) { return (a > b) ? a : b; }

/// Count one up, to UINT16_MAX.
EST_SHARED void increment(uint16_t* const counter) {
    const uint32_t next = *counter + (uint32_t)1U;
    *counter            = (uint16_t)(next - (next >> 16U));
}

/// True iff the number is in the range. False for NaN.
EST_SHARED bool within(const float x, const float low, const float high) { return (x >= low) && (x <= high); }

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

/// The shape of most plants on a rig whose generator is free-running.
#define EST_SHAPE_FREE_RUNNING ((est_shape_t){ .na = 2U, .nb = 3U, .nk = 0U, .nc = 0U, .offset = 1U })

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

/// The shape, read anew in a build for size, where that is shorter than to pass it.
EST_INLINE est_shape_t est_shape_here(const est_config_t* const config, const est_shape_t shape) {
#if EST_FOR_SIZE
    (void)shape;
    return est_shape_of(config);
#else
    (void)config;
    return shape;
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
