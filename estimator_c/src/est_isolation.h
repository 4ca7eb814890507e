// SPDX-License-Identifier: MIT
/// Header for Arduino and PlatformIO, which look for headers in src/.

#include "../isolation/est_isolation.h"  // IWYU pragma: export
