/// Assertions about the arguments of public functions. Override EST_ASSERT with -D; NDEBUG removes it. Private.

#ifndef EST_ASSERT_H_INCLUDED
#define EST_ASSERT_H_INCLUDED

#ifndef EST_ASSERT
#ifdef NDEBUG  // a freestanding compiler has no assert.h
#define EST_ASSERT(x) ((void)0)
#else
#include <assert.h>
#define EST_ASSERT(x) assert(x)  // NOLINT(cppcoreguidelines-macro-usage)
#endif
#endif

#endif  // EST_ASSERT_H_INCLUDED
