// SPDX-License-Identifier: MIT
/// Start-up code for any Cortex-M, from reset to main(): vector table, initialised memory, floating-point unit.

#include "board.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

int main(void);

/// Symbols of image.ld.
extern uint32_t       data_begin;
extern uint32_t       data_end;
extern const uint32_t data_image;
extern uint32_t       bss_begin;
extern uint32_t       bss_end;
extern uint32_t       stack_top;

void start(void);

/// Enable the floating-point unit before any C code: the compiler may use its instructions anywhere.
__attribute__((naked)) void start_reset(void) {
#ifdef __ARM_FP
    __asm volatile("ldr r0, =0xE000ED88\n"
                   "ldr r1, [r0]\n"
                   "orr r1, r1, #0xF00000\n"
                   "str r1, [r0]\n"
                   "dsb\n"
                   "isb\n");
#endif
    __asm volatile("ldr r0, =start\n"
                   "bx r0\n"
                   ".ltorg\n");
}

void start(void) {
    const uint32_t* from = &data_image;
    for (uint32_t* to = &data_begin; to < &data_end; to++) {
        *to = *from++;
    }
    for (uint32_t* to = &bss_begin; to < &bss_end; to++) {
        *to = 0U;
    }
    (void)main();
    board_fail("analogrig: main() has returned\n");
}

static void fault(void) { board_fail("analogrig: hard fault\n"); }

static void unexpected(void) { board_fail("analogrig: an interrupt that nobody asked for\n"); }

/// Vector table of Armv6-M and Armv7-M: the 16 entries of the processor. Those of the board follow: see board.h.
__attribute__((section(".vectors"), used)) static const struct {
    const uint32_t* stack;
    board_handler_t system[15];
} vectors = {
    .stack  = &stack_top,
    .system = { start_reset, unexpected, fault, fault, fault, fault, NULL, NULL, NULL, NULL, unexpected, unexpected,
                NULL, unexpected, unexpected },
};
