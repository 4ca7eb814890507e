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

const kernels_t* kernels_find(void) {
#if defined(__x86_64__) && !defined(ENGINE_NARROW)
    if (__builtin_cpu_supports("avx2")) {
        return &kernels_4;
    }
#endif
    return &kernels_2;
}
