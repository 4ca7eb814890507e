// SPDX-License-Identifier: MIT
/// The device as firmware of the MPS2 boards, on either of their first two UARTs (Arm's CMSDK APB UART, DDI 0479):
/// frames on the first, slcan on the second. The UART that first receives a byte is served until the board is reset.
/// Interrupts store received bytes in a ring, so that none is lost while the estimator runs. The processor sleeps
/// while there is no work.

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "device_loop.h"
#include "semihosting.h"
#include "serial_device.h"
#include "slcan_device.h"

#ifndef FIRMWARE_ID
#error "say which firmware this is: -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_QEMU_M4_CHOICE"
#endif

typedef struct {
    volatile uint32_t data;
    volatile uint32_t state;
    volatile uint32_t control;
    volatile uint32_t interrupts;  ///< read: pending; write: clear
    volatile uint32_t divider;
} uart_t;

#define UART_SERIAL ((uart_t*)0x40004000U)
#define UART_SLCAN ((uart_t*)0x40005000U)

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

/// Set-enable register of the interrupt controller. Its first four bits are the interrupts of the two UARTs.
#define NVIC_ENABLE (*(volatile uint32_t*)0xE000E100U)
#define NVIC_UARTS 0xFU

#define RING_SIZE 4096U  ///< a power of 2

/// Received bytes. The interrupt writes at `to`, the loop reads at `from`; both counters run freely modulo 2^32.
typedef struct {
    volatile uint32_t from;
    volatile uint32_t to;
    volatile uint32_t lost;
    volatile uint8_t  bytes[RING_SIZE];
} ring_t;

/// A UART and its received bytes.
typedef struct {
    uart_t* uart;
    ring_t* ring;
} port_t;

static ring_t       serial_ring;
static ring_t       slcan_ring;
static const port_t serial_port = { .uart = UART_SERIAL, .ring = &serial_ring };
static const port_t slcan_port  = { .uart = UART_SLCAN, .ring = &slcan_ring };

/// The UART that is served.
static const port_t* port;

void serial_receive_interrupt(void);
void serial_transmit_interrupt(void);
void slcan_receive_interrupt(void);
void slcan_transmit_interrupt(void);

/// Move a byte from the UART to the ring. A UART holds one byte; the next byte has an interrupt of its own.
static void take_byte(uart_t* const uart, ring_t* const ring) {
    uart->interrupts     = INTERRUPT_RECEIVE;
    const uint32_t state = uart->state;
    const uint32_t to    = ring->to;
    if ((state & STATE_RECEIVE_OVERRUN) != 0U) {
        uart->state = STATE_RECEIVE_OVERRUN;
        ring->lost++;
    }
    if ((state & STATE_RECEIVE_FULL) != 0U) {
        const uint8_t byte = (uint8_t)uart->data;
        if ((to - ring->from) < RING_SIZE) {
            ring->bytes[to % RING_SIZE] = byte;
            ring->to                    = to + 1U;
        } else {
            ring->lost++;
        }
    }
}

/// Clear the interrupt that reports room to transmit. Its only purpose is to wake the processor.
static void note_room(uart_t* const uart) {
    uart->control    = CONTROL_USUAL;
    uart->interrupts = INTERRUPT_TRANSMIT;
}

void serial_receive_interrupt(void) { take_byte(UART_SERIAL, &serial_ring); }
void serial_transmit_interrupt(void) { note_room(UART_SERIAL); }
void slcan_receive_interrupt(void) { take_byte(UART_SLCAN, &slcan_ring); }
void slcan_transmit_interrupt(void) { note_room(UART_SLCAN); }

uint32_t port_boot_nonce(void) { return semihosting_argument(); }

size_t port_receive(uint8_t* const bytes, const size_t n, uint32_t* const lost) {
    ring_t* const ring  = port->ring;
    size_t        taken = 0U;
    while ((taken < n) && (ring->from != ring->to)) {
        bytes[taken] = ring->bytes[ring->from % RING_SIZE];
        ring->from++;
        taken++;
    }
    __asm volatile("cpsid i" ::: "memory");
    *lost += ring->lost;
    ring->lost = 0U;
    __asm volatile("cpsie i" ::: "memory");
    return taken;
}

size_t port_transmit(const uint8_t* const bytes, const size_t n) {
    size_t sent = 0U;
    while ((sent < n) && ((port->uart->state & STATE_TRANSMIT_FULL) == 0U)) {
        port->uart->data = bytes[sent];
        sent++;
    }
    return sent;
}

/// An interrupt between the check and the sleep remains pending and ends the sleep at once.
bool port_idle(const bool wants_input, const bool has_output) {
    __asm volatile("cpsid i" ::: "memory");
    const bool has_input = port->ring->from != port->ring->to;
    const bool has_room  = (port->uart->state & STATE_TRANSMIT_FULL) == 0U;
    if (!(wants_input && has_input) && !(has_output && has_room)) {
        if (has_output) {
            port->uart->control = CONTROL_USUAL | CONTROL_TRANSMIT_INTERRUPT;
        }
        __asm volatile("wfi" ::: "memory");
    }
    __asm volatile("cpsie i" ::: "memory");
    return true;
}

static bool has_spoken(const port_t* const candidate) { return candidate->ring->from != candidate->ring->to; }

/// Sleep until a byte has arrived on either UART, and serve that one.
static void choose_port(void) {
    while (!has_spoken(&serial_port) && !has_spoken(&slcan_port)) {
        __asm volatile("cpsid i" ::: "memory");
        if (!has_spoken(&serial_port) && !has_spoken(&slcan_port)) {
            __asm volatile("wfi" ::: "memory");
        }
        __asm volatile("cpsie i" ::: "memory");
    }
    port = has_spoken(&serial_port) ? &serial_port : &slcan_port;
}

static void begin(uart_t* const uart) {
    uart->divider = DIVIDER;
    uart->control = CONTROL_USUAL;
    (void)uart->data;  // QEMU receives only after a first read
}

int main(void) {
    static serial_device_t serial;
    static slcan_device_t  slcan;
    begin(UART_SERIAL);
    begin(UART_SLCAN);
    NVIC_ENABLE = NVIC_UARTS;
    choose_port();
    if (port == &serial_port) {
        device_loop(&serial_line, &serial, (uint8_t)FIRMWARE_ID, (uint32_t)ANALOGRIG_CATALOGUE_HASH);
    } else {
        device_loop(&slcan_line, &slcan, (uint8_t)FIRMWARE_ID, (uint32_t)ANALOGRIG_CATALOGUE_HASH);
    }
    return 0;
}
