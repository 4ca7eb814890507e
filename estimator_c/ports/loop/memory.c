// SPDX-License-Identifier: MIT
/// Functions of a C library that the compiler calls implicitly, for targets without one: compile with -ffreestanding.
/// The pointers are volatile, because gcc would replace the loops by calls of the same functions.

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if !__STDC_HOSTED__

void* memset(void* const to, const int value, const size_t n) {
    volatile uint8_t* const bytes = to;
    for (size_t i = 0U; i < n; i++) {
        bytes[i] = (uint8_t)value;
    }
    return to;
}

void* memcpy(void* const restrict to, const void* const restrict from, const size_t n) {
    volatile uint8_t* const bytes  = to;
    const uint8_t* const    source = from;
    for (size_t i = 0U; i < n; i++) {
        bytes[i] = source[i];
    }
    return to;
}

void* memmove(void* const to, const void* const from, const size_t n) {
    volatile uint8_t* const bytes   = to;
    const uint8_t* const    source  = from;
    const bool              is_down = (uintptr_t)to < (uintptr_t)from;
    for (size_t i = 0U; i < n; i++) {
        const size_t at = is_down ? i : (n - 1U - i);  // never overwrites a byte that is still to be read
        bytes[at]       = source[at];
    }
    return to;
}

#endif
