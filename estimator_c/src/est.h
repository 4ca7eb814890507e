// SPDX-License-Identifier: MIT
/// Header for Arduino and PlatformIO, which look for headers in src/.

#include "../core/est.h"  // IWYU pragma: export
