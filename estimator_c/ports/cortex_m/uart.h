// SPDX-License-Identifier: MIT
/// uart: received bytes in ring buffers, which interrupts fill, so that none is lost while the estimator runs; and sleep.

#ifndef UART_H_INCLUDED
#define UART_H_INCLUDED

#include "board.h"

/// True iff a received byte is waiting.
bool uart_has_input(unsigned uart);

/// Take at most n received bytes without waiting. Return their number. Add the number of bytes lost to *lost.
size_t uart_read(unsigned uart, uint8_t* bytes, size_t n, uint32_t* lost);

/// Transmit as many bytes as the UART takes without waiting. Return their number.
size_t uart_write(unsigned uart, const uint8_t* bytes, size_t n);

/// Hold interrupts off, so that none comes between a check and uart_sleep().
static inline void uart_hold(void) { __asm volatile("cpsid i" ::: "memory"); }

/// Sleep until an interrupt is pending, held off or not.
static inline void uart_sleep(void) { __asm volatile("wfi" ::: "memory"); }

/// Let interrupts pass again.
static inline void uart_release(void) { __asm volatile("cpsie i" ::: "memory"); }

#endif  // UART_H_INCLUDED
