/// The device as firmware of the MPS2 boards, on their first UART: Arm's CMSDK APB UART (DDI 0479). Received bytes come by
/// interrupt and wait in a ring, so that none is lost while the estimator works; else the processor sleeps.

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "device_loop.h"
#include "semihosting.h"

#ifndef FIRMWARE_ID
#error "say which firmware this is: -DFIRMWARE_ID=ANALOGRIG_FIRMWARE_FIRMWARE_ID_QEMU_M4_CHOICE"
#endif

typedef struct {
    volatile uint32_t data;
    volatile uint32_t state;
    volatile uint32_t control;
    volatile uint32_t interrupts;  ///< read: pending; write: done with
    volatile uint32_t divider;
} uart_t;

#define UART ((uart_t*)0x40004000U)

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

/// Set-enable register of the interrupt controller; those of the UART are its first two.
#define NVIC_ENABLE (*(volatile uint32_t*)0xE000E100U)
#define NVIC_UART 0x3U

#define RING_SIZE 4096U  ///< a power of 2

/// Written by the interrupt at `to`, read by the loop at `from`; both count on for ever.
static struct {
    volatile uint32_t from;
    volatile uint32_t to;
    volatile uint32_t lost;
    volatile uint8_t  bytes[RING_SIZE];
} ring;

void uart_receive_interrupt(void);
void uart_transmit_interrupt(void);

/// The UART holds one byte: the next one has an interrupt of its own.
void uart_receive_interrupt(void) {
    UART->interrupts     = INTERRUPT_RECEIVE;
    const uint32_t state = UART->state;
    const uint32_t to    = ring.to;
    if ((state & STATE_RECEIVE_OVERRUN) != 0U) {
        UART->state = STATE_RECEIVE_OVERRUN;
        ring.lost++;
    }
    if ((state & STATE_RECEIVE_FULL) != 0U) {
        const uint8_t byte = (uint8_t)UART->data;
        if ((to - ring.from) < RING_SIZE) {
            ring.bytes[to % RING_SIZE] = byte;
            ring.to                    = to + 1U;
        } else {
            ring.lost++;
        }
    }
}

/// There is room again: that it wakes the processor is all.
void uart_transmit_interrupt(void) {
    UART->control    = CONTROL_USUAL;
    UART->interrupts = INTERRUPT_TRANSMIT;
}

uint32_t port_boot_nonce(void) { return semihosting_argument(); }

size_t port_receive(uint8_t* const bytes, const size_t n, uint32_t* const lost) {
    size_t taken = 0U;
    while ((taken < n) && (ring.from != ring.to)) {
        bytes[taken] = ring.bytes[ring.from % RING_SIZE];
        ring.from++;
        taken++;
    }
    __asm volatile("cpsid i" ::: "memory");
    *lost += ring.lost;
    ring.lost = 0U;
    __asm volatile("cpsie i" ::: "memory");
    return taken;
}

size_t port_transmit(const uint8_t* const bytes, const size_t n) {
    size_t sent = 0U;
    while ((sent < n) && ((UART->state & STATE_TRANSMIT_FULL) == 0U)) {
        UART->data = bytes[sent];
        sent++;
    }
    return sent;
}

/// An interrupt that comes between the look and the sleep is pending, and ends the sleep at once.
bool port_idle(const bool wants_input, const bool has_output) {
    __asm volatile("cpsid i" ::: "memory");
    const bool has_input = ring.from != ring.to;
    const bool has_room  = (UART->state & STATE_TRANSMIT_FULL) == 0U;
    if (!(wants_input && has_input) && !(has_output && has_room)) {
        if (has_output) {
            UART->control = CONTROL_USUAL | CONTROL_TRANSMIT_INTERRUPT;
        }
        __asm volatile("wfi" ::: "memory");
    }
    __asm volatile("cpsie i" ::: "memory");
    return true;
}

int main(void) {
    UART->divider = DIVIDER;
    UART->control = CONTROL_USUAL;
    (void)UART->data;  // QEMU begins to receive after the first read
    NVIC_ENABLE   = NVIC_UART;
    device_loop((uint8_t)FIRMWARE_ID, (uint32_t)ANALOGRIG_CATALOGUE_HASH);
    return 0;
}
