/// The orders of the model, at run time from the configuration, or fixed by the build with -DEST_FIXED_NA=2U, _NB, _NK, _NC
/// and _OFFSET, all of them. Where the number of parameters is known, the loops over them are unrolled, which saves a third
/// of the time: in a build of fixed order, and in one of the usual size, by a copy for
/// each number, unless it is optimised for size.

#ifndef EST_ORDERS_H_INCLUDED
#define EST_ORDERS_H_INCLUDED

#include "est.h"

/// What a build can leave out, with -DEST_WITH_...=0: its configuration is then refused.
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
#define EST_WITH_WATCH 1  ///< stuck_n, idle_n
#endif

#ifdef EST_FIXED_NA
#define NA(config) EST_FIXED_NA
#define NB(config) EST_FIXED_NB
#define NK(config) EST_FIXED_NK
#define NC(config) EST_FIXED_NC
#define OFFSET(config) EST_FIXED_OFFSET
#define COUNT(count) (EST_FIXED_NA + EST_FIXED_NB + EST_FIXED_NC + EST_FIXED_OFFSET)
#else
#define NA(config) ((config)->na)
#define NB(config) ((config)->nb)
#define NK(config) ((config)->nk)
#if EST_WITH_ADAPTATION
#define NC(config) ((config)->nc)
#else
#define NC(config) 0U
#endif
#define OFFSET(config) ((config)->offset)
#define COUNT(count) (count)
#endif

/// Loops over the constants EST_NA_MAX and EST_INPUT_PAST_MAX, which are small.
#if defined(__GNUC__) && !defined(__OPTIMIZE_SIZE__)
#define EST_UNROLL_NA _Pragma("GCC unroll 2")
#define EST_UNROLL_PAST _Pragma("GCC unroll 8")
#else
#define EST_UNROLL_NA
#define EST_UNROLL_PAST
#endif

/// The value of f(count), an inline function's, with the number of parameters as a constant where it may be one.
#if defined(EST_FIXED_NA)
#define EST_FOR_COUNT(count, f) f(COUNT(count))
#define EST_UNROLL_COUNT
#elif (EST_THETA_MAX == 6U) && !defined(__OPTIMIZE_SIZE__)
#define EST_FOR_COUNT(count, f)                                                                                        \
    (((count) == 6U) ? f(6U) : ((count) == 4U) ? f(4U) : ((count) == 5U) ? f(5U) : ((count) == 3U) ? f(3U) : f(2U))
#define EST_UNROLL_COUNT
#else
#define EST_FOR_COUNT(count, f) f(count)
#endif

#if defined(__GNUC__) && defined(EST_UNROLL_COUNT)
#define EST_UNROLL _Pragma("GCC unroll 8")
#else
#define EST_UNROLL
#endif

/// gcc would rather call a long function than inline it three times.
#ifdef __GNUC__
#define EST_INLINE static inline __attribute__((always_inline))
#else
#define EST_INLINE static inline
#endif

#define PARAMETERS(config) COUNT((uint8_t)((uint32_t)NA(config) + NB(config) + NC(config) + (OFFSET(config) ? 1U : 0U)))

#endif  // EST_ORDERS_H_INCLUDED
