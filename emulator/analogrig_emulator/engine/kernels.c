/// The inner loops, for every width of the processor's registers that occurs. With ENGINE_NARROW for the least one alone.

#include "engine_state.h"

#define LANES 2
#define TARGET
#include "lanes.h"

#if defined(__x86_64__) && !defined(ENGINE_NARROW)
#define LANES 4
#define TARGET __attribute__((target("avx2")))
#include "lanes.h"
#endif

#if defined(__x86_64__) && !defined(ENGINE_NARROW)
#include <cpuid.h>

#define AVX_STATES 6U  // of the registers that the operating system saves: XMM and YMM

/// True if processor and operating system support AVX2: Intel 64 Software Developer's Manual, volume 1, section 14.7.1.
/// __builtin_cpu_supports() would do, but does not link into a shared library of zig.
static bool has_avx2(void) {
    uint32_t eax;
    uint32_t ebx;
    uint32_t ecx;
    uint32_t edx;
    if ((__get_cpuid(1U, &eax, &ebx, &ecx, &edx) == 0) || ((ecx & bit_OSXSAVE) == 0U) || ((ecx & bit_AVX) == 0U)) {
        return false;
    }
    __asm__("xgetbv" : "=a"(eax), "=d"(edx) : "c"(0U));
    if ((eax & AVX_STATES) != AVX_STATES) {
        return false;
    }
    return (__get_cpuid_count(7U, 0U, &eax, &ebx, &ecx, &edx) != 0) && ((ebx & bit_AVX2) != 0U);
}
#endif

const kernels_t* kernels_find(void) {
#if defined(__x86_64__) && !defined(ENGINE_NARROW)
    static int width;  // kept: in a virtual machine the question is slow
    int        known = __atomic_load_n(&width, __ATOMIC_RELAXED);
    if (known == 0) {
        known = has_avx2() ? 4 : 2;
        __atomic_store_n(&width, known, __ATOMIC_RELAXED);
    }
    if (known == 4) {
        return &kernels_4;
    }
#endif
    return &kernels_2;
}
