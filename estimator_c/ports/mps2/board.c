// SPDX-License-Identifier: MIT
/// The MPS2 boards, which QEMU emulates: Arm's CMSDK APB UART (DDI 0479), boot nonce and errors by semihosting.

#include "board.h"
#include "semihosting.h"

typedef struct {
    volatile uint32_t data;
    volatile uint32_t state;
    volatile uint32_t control;
    volatile uint32_t interrupts;  ///< read: pending; write: clear
    volatile uint32_t divider;
} uart_t;

#define STATE_TRANSMIT_FULL 0x1U
#define STATE_RECEIVE_FULL 0x2U
#define STATE_RECEIVE_OVERRUN 0x8U
#define CONTROL_TRANSMIT 0x1U
#define CONTROL_RECEIVE 0x2U
#define CONTROL_TRANSMIT_INTERRUPT 0x4U
#define CONTROL_RECEIVE_INTERRUPT 0x8U
#define CONTROL_USUAL (CONTROL_TRANSMIT | CONTROL_RECEIVE | CONTROL_RECEIVE_INTERRUPT)
#define INTERRUPT_TRANSMIT 0x1U
#define INTERRUPT_RECEIVE 0x2U
#define DIVIDER 217U  ///< 25 MHz / 115,200

#define FAULT_STATUS 70U  ///< EX_SOFTWARE of sysexits.h

/// Set-enable register of the interrupt controller. Its first four bits are the interrupts of the two UARTs.
#define NVIC_ENABLE (*(volatile uint32_t*)0xE000E100U)
#define NVIC_UARTS 0xFU

static uart_t* const uarts[UART_COUNT] = { (uart_t*)0x40004000U, (uart_t*)0x40005000U };

/// Take the byte from a UART, which holds one; the next byte has an interrupt of its own.
static void take_byte(const unsigned uart) {
    uarts[uart]->interrupts = INTERRUPT_RECEIVE;
    const uint32_t state    = uarts[uart]->state;
    if ((state & STATE_RECEIVE_OVERRUN) != 0U) {
        uarts[uart]->state = STATE_RECEIVE_OVERRUN;
        uart_lost(uart);
    }
    if ((state & STATE_RECEIVE_FULL) != 0U) {
        uart_received(uart, (uint8_t)uarts[uart]->data);
    }
}

/// Clear the interrupt that reports room to transmit.
static void note_room(const unsigned uart) {
    uarts[uart]->control    = CONTROL_USUAL;
    uarts[uart]->interrupts = INTERRUPT_TRANSMIT;
}

static void first_receive_interrupt(void) { take_byte(0U); }
static void first_transmit_interrupt(void) { note_room(0U); }
static void second_receive_interrupt(void) { take_byte(1U); }
static void second_transmit_interrupt(void) { note_room(1U); }

__attribute__((section(".vectors.board"), used)) static const board_handler_t handlers[] = {
    first_receive_interrupt,
    first_transmit_interrupt,
    second_receive_interrupt,
    second_transmit_interrupt,
};

void board_start(void) {
    for (unsigned uart = 0U; uart < UART_COUNT; uart++) {
        uarts[uart]->divider = DIVIDER;
        uarts[uart]->control = CONTROL_USUAL;
        (void)uarts[uart]->data;  // QEMU receives only after a first read
    }
    NVIC_ENABLE = NVIC_UARTS;
}

uint32_t board_nonce(void) { return semihosting_argument(); }

void board_fail(const char* const line) { semihosting_end(line, FAULT_STATUS); }

bool board_has_room(const unsigned uart) { return (uarts[uart]->state & STATE_TRANSMIT_FULL) == 0U; }

void board_send(const unsigned uart, const uint8_t byte) { uarts[uart]->data = byte; }

void board_await_room(const unsigned uart) { uarts[uart]->control = CONTROL_USUAL | CONTROL_TRANSMIT_INTERRUPT; }
