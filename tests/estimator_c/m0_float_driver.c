/* Runs one routine of estimator_c/ports/cortex_m0/float.S, for the tests: its name is the argument; reads pairs of words,
   the operands, and writes a word for each pair. */

#include <stdint.h>
#include <stdio.h>
#include <string.h>

typedef uint32_t routine_t(uint32_t a, uint32_t b);

#define WITH_EACH_ROUTINE(X)                                                                                           \
    X(fadd) X(fsub) X(frsub) X(fmul) X(fdiv) X(fcmpeq) X(fcmplt) X(fcmple) X(fcmpge) X(fcmpgt) X(fcmpun)               \
    X(i2f) X(ui2f) X(f2iz) X(f2uiz)
#define WITH_EACH_COMPARISON(X) X(cfcmpeq) X(cfcmple) X(cfrcmple)

#define DECLARE(name) routine_t __aeabi_##name;
WITH_EACH_ROUTINE(DECLARE)

/* These answer in the flags: 2 Z + C, and 4 unless the operands stayed where they were. */
#define DEFINE(name)                                                                                                   \
    static uint32_t flags_##name(const uint32_t a, const uint32_t b) {                                                 \
        register uint32_t r0 __asm("r0") = a, r1 __asm("r1") = b, r2 __asm("r2") = ~a, r3 __asm("r3") = ~b;            \
        uint32_t          flags;                                                                                       \
        __asm volatile("bl __aeabi_" #name "\n mrs %0, cpsr"                                                           \
                       : "=&r"(flags), "+r"(r0), "+r"(r1), "+r"(r2), "+r"(r3) : : "r12", "lr", "cc");                  \
        const int kept = (r0 == a) && (r1 == b) && (r2 == ~a) && (r3 == ~b);                                           \
        return ((flags >> 29U) & 3U) | (kept ? 0U : 4U);                                                               \
    }
WITH_EACH_COMPARISON(DEFINE)

#define NAMED(name) { #name, __aeabi_##name },
#define NAMED_FLAGS(name) { #name, flags_##name },
static const struct {
    const char* name;
    routine_t*  routine;
} routines[] = { WITH_EACH_ROUTINE(NAMED) WITH_EACH_COMPARISON(NAMED_FLAGS) };

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
