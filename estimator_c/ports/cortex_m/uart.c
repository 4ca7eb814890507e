// SPDX-License-Identifier: MIT

#include "uart.h"

#define RING_SIZE 4096U  ///< a power of 2

/// Received bytes. The interrupt writes at `to`, the program reads at `from`; both counters run freely modulo 2^32.
typedef struct {
    volatile uint32_t from;
    volatile uint32_t to;
    volatile uint32_t lost;
    volatile uint8_t  bytes[RING_SIZE];
} ring_t;

static ring_t rings[UART_COUNT];

void uart_received(const unsigned uart, const uint8_t byte) {
    ring_t* const  ring = &rings[uart];
    const uint32_t to   = ring->to;
    if ((to - ring->from) < RING_SIZE) {
        ring->bytes[to % RING_SIZE] = byte;
        ring->to                    = to + 1U;
    } else {
        ring->lost++;
    }
}

void uart_lost(const unsigned uart) { rings[uart].lost++; }

bool uart_has_input(const unsigned uart) { return rings[uart].from != rings[uart].to; }

size_t uart_read(const unsigned uart, uint8_t* const bytes, const size_t n, uint32_t* const lost) {
    ring_t* const ring  = &rings[uart];
    size_t        taken = 0U;
    while ((taken < n) && uart_has_input(uart)) {
        bytes[taken] = ring->bytes[ring->from % RING_SIZE];
        ring->from++;
        taken++;
    }
    uart_hold();
    *lost += ring->lost;
    ring->lost = 0U;
    uart_release();
    return taken;
}

size_t uart_write(const unsigned uart, const uint8_t* const bytes, const size_t n) {
    size_t sent = 0U;
    while ((sent < n) && board_has_room(uart)) {
        board_send(uart, bytes[sent]);
        sent++;
    }
    return sent;
}
