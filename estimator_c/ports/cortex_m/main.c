// SPDX-License-Identifier: MIT
/// The device as firmware of a Cortex-M board, on either of two UARTs: frames on the first, slcan on the second. The UART
/// that first receives a byte is served until the board is reset. The processor sleeps while there is no work.

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "device_loop.h"
#include "serial_device.h"
#include "slcan_device.h"
#include "uart.h"

#ifndef FIRMWARE_ID
#error "say which firmware this is: -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_BOARD_CHOICE"
#endif

#define UART_SERIAL 0U
#define UART_SLCAN 1U

/// The UART that is served.
static unsigned line;

uint32_t port_boot_nonce(void) { return board_nonce(); }

size_t port_receive(uint8_t* const bytes, const size_t n, uint32_t* const lost) {
    return uart_read(line, bytes, n, lost);
}

size_t port_transmit(const uint8_t* const bytes, const size_t n) { return uart_write(line, bytes, n); }

/// An interrupt between the check and the sleep remains pending and ends the sleep at once. Room that comes before its
/// interrupt is enabled raises none, so it is enabled before the check.
bool port_idle(const bool wants_input, const bool has_output) {
    uart_hold();
    if (has_output) {
        board_await_room(line);
    }
    if (!(wants_input && uart_has_input(line)) && !(has_output && board_has_room(line))) {
        uart_sleep();
    }
    uart_release();
    return true;
}

/// Sleep until a byte has arrived on either UART, and return that one.
static unsigned first_to_speak(void) {
    while (!uart_has_input(UART_SERIAL) && !uart_has_input(UART_SLCAN)) {
        uart_hold();
        if (!uart_has_input(UART_SERIAL) && !uart_has_input(UART_SLCAN)) {
            uart_sleep();
        }
        uart_release();
    }
    return uart_has_input(UART_SERIAL) ? UART_SERIAL : UART_SLCAN;
}

int main(void) {
    static serial_device_t serial;
    static slcan_device_t  slcan;
    board_start();
    line = first_to_speak();
    if (line == UART_SERIAL) {
        device_loop(&serial_line, &serial, (uint8_t)FIRMWARE_ID, (uint32_t)ANALOGRIG_CATALOGUE_HASH);
    } else {
        device_loop(&slcan_line, &slcan, (uint8_t)FIRMWARE_ID, (uint32_t)ANALOGRIG_CATALOGUE_HASH);
    }
    return 0;
}
