// SPDX-License-Identifier: MIT
/// Part of a C library that the generated codecs need, for targets without one. Defined in ports/loop/memory.c.

#ifndef STRING_H_INCLUDED
#define STRING_H_INCLUDED

#include <stddef.h>

void* memset(void* to, int value, size_t n);
void* memcpy(void* restrict to, const void* restrict from, size_t n);
void* memmove(void* to, const void* from, size_t n);

#endif  // STRING_H_INCLUDED
