// SPDX-License-Identifier: MIT
/// Header for Arduino and PlatformIO, which look for headers in src/.

#include "../fit/est_fit.h"  // IWYU pragma: export
