// SPDX-License-Identifier: MIT
/// Header for Arduino and PlatformIO, which look for headers in src/. Private.

#include "../core/est_shape.h"
