/// The orders of the model, at run time from the configuration, or fixed by the build with -DEST_FIXED_NA=2U, _NB, _NK, _NC
/// and _OFFSET, all of them: the loops over the parameters are then unrolled, which saves a third of the time.

#ifndef EST_ORDERS_H_INCLUDED
#define EST_ORDERS_H_INCLUDED

#ifdef EST_FIXED_NA
#define NA(config) EST_FIXED_NA
#define NB(config) EST_FIXED_NB
#define NK(config) EST_FIXED_NK
#define NC(config) EST_FIXED_NC
#define OFFSET(config) EST_FIXED_OFFSET
#define COUNT(count) (EST_FIXED_NA + EST_FIXED_NB + EST_FIXED_NC + EST_FIXED_OFFSET)
#define EST_UNROLL _Pragma("GCC unroll 8")
#else
#define NA(config) ((config)->na)
#define NB(config) ((config)->nb)
#define NK(config) ((config)->nk)
#define NC(config) ((config)->nc)
#define OFFSET(config) ((config)->offset)
#define COUNT(count) (count)
#define EST_UNROLL
#endif

/// A loop over the constant EST_NA_MAX, which is small.
#ifdef __GNUC__
#define EST_UNROLL_NA _Pragma("GCC unroll 2")
#else
#define EST_UNROLL_NA
#endif

#define PARAMETERS(config) COUNT((uint8_t)((uint32_t)NA(config) + NB(config) + NC(config) + (OFFSET(config) ? 1U : 0U)))

#endif  // EST_ORDERS_H_INCLUDED
