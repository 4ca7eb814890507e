// SPDX-License-Identifier: MIT
/// The text firmware on the first UART of a Cortex-M board.

#include "text_io.h"
#include "uart.h"

#define LINE 0U

void text_start(void) { board_start(); }

int text_read(void) {
    static uint8_t  buffer[64];
    static size_t   from;
    static size_t   to;
    static uint32_t lost;
    while (from == to) {
        uart_hold();
        if (!uart_has_input(LINE)) {
            uart_sleep();
        }
        uart_release();
        from = 0U;
        to   = uart_read(LINE, buffer, sizeof(buffer), &lost);
    }
    if (lost != 0U) {
        lost = 0U;
        return TEXT_LOST;
    }
    return buffer[from++];
}

void text_write(const char* const text, const size_t n) {
    for (size_t sent = 0U; sent < n;) {
        sent += uart_write(LINE, (const uint8_t*)&text[sent], n - sent);
    }
}
