/// What a build is made for: the shape of the model, what it can do, and how loops are unrolled. Private to the library.

#ifndef EST_SHAPE_H_INCLUDED
#define EST_SHAPE_H_INCLUDED

#include "est.h"

/// What a build can leave out, with -DEST_WITH_...=0: a configuration that asks for it is then refused.
#ifndef EST_WITH_EDGES
#define EST_WITH_EDGES 1  ///< edges that may slip, or come anywhere
#endif
#ifndef EST_WITH_TRIGGERS
#define EST_WITH_TRIGGERS 1  ///< triggers other than the cumulative sum
#endif
#ifndef EST_WITH_ADAPTATION
#define EST_WITH_ADAPTATION 1  ///< nc, random_walk, noise_estimated, refresh_n
#endif
#ifndef EST_WITH_WATCH
#define EST_WITH_WATCH 1  ///< stuck_n, idle_n, and to count what is saturated
#endif

/// Without, est_init() takes the configuration at its word. For a build whose configuration is a constant that est_config_valid()
/// has accepted elsewhere, as in a test on the host.
#ifndef EST_WITH_CHECKS
#define EST_WITH_CHECKS 1
#endif

#ifdef EST_FIXED_NA
#if (EST_FIXED_NA > EST_NA_MAX) || (EST_FIXED_NB > EST_NB_MAX) || (EST_FIXED_NK > EST_NK_MAX) ||                       \
    (EST_FIXED_NC > EST_NC_MAX)
#error "the orders that are fixed must not be beyond the largest: EST_NA_MAX and so on"
#endif
#endif

/// Whether the build is for size: -Os.
#if defined(__GNUC__) && defined(__OPTIMIZE_SIZE__)
#define EST_FOR_SIZE 1
#else
#define EST_FOR_SIZE 0
#endif

/// How a function becomes part of its callers: gcc guesses wrong both ways, and a build for size has a seventh more code if it
/// is left alone.
#ifdef __GNUC__
#define EST_WITHIN static inline __attribute__((always_inline))
#else
#define EST_WITHIN static inline
#endif

#if EST_FOR_SIZE
#define EST_INLINE static inline                              ///< inline for each shape
#define EST_OUTLINE static __attribute__((noinline, unused))  ///< short, but wanted in many places
#else
#define EST_INLINE EST_WITHIN
#define EST_OUTLINE static inline
#endif

/// Inline for each shape, but wanted in more than one place if edges may slip.
#if EST_FOR_SIZE && EST_WITH_EDGES
#define EST_SHAPED EST_OUTLINE
#else
#define EST_SHAPED EST_INLINE
#endif

/// Loops over the parameters, and over the constants EST_NA_MAX and EST_INPUTS_KEPT, which are small; EST_ROLL: one that gcc
/// would unroll in a build for size too.
#if defined(__GNUC__) && (defined(EST_FIXED_NA) || !EST_FOR_SIZE)
#define EST_UNROLL _Pragma("GCC unroll 8")
#define EST_ROLL EST_UNROLL
#elif defined(__GNUC__)
#define EST_UNROLL
#define EST_ROLL _Pragma("GCC unroll 1")
#else
#define EST_UNROLL
#define EST_ROLL
#endif

/// Whether anything wants to know of the edges of u.
#define EST_KNOWS_EDGES (EST_WITH_EDGES || EST_WITH_ADAPTATION || EST_WITH_WATCH)

/// How many values of u are kept, u(k) included: all of the past, whatever the order needs, since a loop of fixed length is the
/// faster one. An edge takes two to be seen, and one more than the model if it may have come early or late.
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

/// One instruction where there is one.
EST_INLINE float est_magnitude(const float x) {
#ifdef __GNUC__
    return __builtin_fabsf(x);
#else
    return (x > 0.0F) ? x : (0.0F - x);
#endif
}

/// The orders of the model.
typedef struct {
    uint8_t na;
    uint8_t nb;
    uint8_t nk;
    uint8_t nc;
    uint8_t offset;  ///< 1 with one, else 0
} est_shape_t;

/// The orders that the configuration asks for, or that the build has fixed by -DEST_FIXED_NA=2U, _NB, _NK, _NC and _OFFSET.
EST_WITHIN est_shape_t est_shape_of(const est_config_t* const config) {
#ifdef EST_FIXED_NA
    (void)config;
    return (est_shape_t){ EST_FIXED_NA, EST_FIXED_NB, EST_FIXED_NK, EST_FIXED_NC, EST_FIXED_OFFSET };
#else
    return (est_shape_t){ .na     = config->na,
                          .nb     = config->nb,
                          .nk     = config->nk,
                          .nc     = EST_WITH_ADAPTATION ? config->nc : 0U,
                          .offset = config->offset ? 1U : 0U };
#endif
}

/// The number of parameters.
EST_WITHIN uint_fast8_t est_shape_count(const est_shape_t shape) {
    return (uint_fast8_t)((uint32_t)shape.na + shape.nb + shape.nc + shape.offset);
}

/// Whether parameter j, one of them, is the offset, the last, which has a prior of its own.
EST_INLINE bool est_is_offset(const est_shape_t shape, const uint_fast8_t j) {
    return j >= ((uint32_t)shape.na + shape.nb + shape.nc);
}

#endif  // EST_SHAPE_H_INCLUDED
