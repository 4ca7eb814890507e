// SPDX-License-Identifier: MIT
/// Assertions about the arguments of public functions. EST_ASSERT is described in est.h. Private.

#ifndef EST_ASSERT_H_INCLUDED
#define EST_ASSERT_H_INCLUDED

#if !defined(EST_ASSERT) && defined(__has_include)
#if !__has_include(<assert.h>)  // the compiler comes without a C library
#define EST_ASSERT(x) ((void)0)
#endif
#endif
#ifndef EST_ASSERT
#ifdef NDEBUG
#define EST_ASSERT(x) ((void)0)
#else
#include <assert.h>
#define EST_ASSERT(x) assert(x)  // NOLINT(cppcoreguidelines-macro-usage)
#endif
#endif

#endif  // EST_ASSERT_H_INCLUDED
