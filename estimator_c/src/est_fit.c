// SPDX-License-Identifier: MIT
/// Source for Arduino and PlatformIO, which compile the files in src/. Every other build compiles ../fit/est_fit.c.

#if defined(__GNUC__) && !defined(__clang__)  // the build options of an Arduino library cannot be set
#pragma GCC optimize("fp-contract=off")
#endif
#include "../fit/est_fit.c"  // NOLINT(bugprone-suspicious-include)
