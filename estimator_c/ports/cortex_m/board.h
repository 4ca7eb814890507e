// SPDX-License-Identifier: MIT
/// board: functions that a board with two UARTs provides, and those that its interrupts call.
///
/// A board is one file (ports/mps2/board.c, ports/stm32f405/board.c) and its memory.ld. Everything else of an image is
/// shared: start.c, uart.c, image.ld.

#ifndef BOARD_H_INCLUDED
#define BOARD_H_INCLUDED

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/// UARTs are numbered from 0.
#define UART_COUNT 2U

// ---- functions that the board provides

/// Set up clocks, pins and both UARTs with their receive interrupts: 115,200 baud, 8 bits, no parity, 1 stop bit.
void board_start(void);

/// Return a number that differs after every boot. Called after the first byte has arrived.
uint32_t board_nonce(void);

/// Report an error from which the program cannot continue, and stop or reset. Does not return.
void board_fail(const char* line);

/// True iff the UART can take a byte to transmit.
bool board_has_room(unsigned uart);

/// Transmit a byte. The UART has room.
void board_send(unsigned uart, uint8_t byte);

/// Request an interrupt, once, when the UART has room. Its only purpose is to wake the processor.
void board_await_room(unsigned uart);

/// Interrupt handler. The table of the board's handlers is in the section .vectors.board.
typedef void (*board_handler_t)(void);

// ---- functions for the interrupts of the board, in uart.c

/// Store a received byte.
void uart_received(unsigned uart, uint8_t byte);

/// Count a received byte that the hardware has dropped.
void uart_lost(unsigned uart);

#endif  // BOARD_H_INCLUDED
