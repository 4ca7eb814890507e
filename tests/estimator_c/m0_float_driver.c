// SPDX-License-Identifier: MIT
/* Runs one routine of estimator_c/ports/cortex_m0/float.S, for the tests: its name is the argument; reads pairs of
   words, the operands, and writes a word for each pair. */

#include <stdint.h>
#include <stdio.h>
#include <string.h>

typedef uint32_t routine_t(uint32_t a, uint32_t b);

// The layout of X-macros by clang-format is not stable.
// clang-format off
#define WITH_EACH_ROUTINE(X) \
    X(fadd) X(fsub) X(frsub) X(fmul) X(fdiv) X(fcmpeq) X(fcmplt) X(fcmple) X(fcmpge) X(fcmpgt) X(fcmpun) \
    X(i2f) X(ui2f) X(f2iz) X(f2uiz)
// clang-format on

#define DECLARE(name) routine_t __aeabi_##name;
WITH_EACH_ROUTINE(DECLARE)

#define NAMED(name) { #name, __aeabi_##name },
static const struct {
    const char* name;
    routine_t*  routine;
} routines[] = { WITH_EACH_ROUTINE(NAMED) };

static uint32_t in[2U * 4096U], out[4096U];

int main(const int count, const char* const* const arguments) {
    routine_t* routine = 0;
    for (size_t i = 0U; (count == 2) && (i < (sizeof(routines) / sizeof(routines[0]))); i++) {
        if (strcmp(arguments[1], routines[i].name) == 0) {
            routine = routines[i].routine;
        }
    }
    if (routine == 0) {
        return 2;
    }
    size_t pairs;
    while ((pairs = fread(in, 8U, 4096U, stdin)) > 0U) {
        for (size_t i = 0U; i < pairs; i++) {
            out[i] = routine(in[2U * i], in[(2U * i) + 1U]);
        }
        if (fwrite(out, 4U, pairs, stdout) != pairs) {
            return 3;
        }
    }
    return 0;
}
