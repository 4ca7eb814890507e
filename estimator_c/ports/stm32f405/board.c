// SPDX-License-Identifier: MIT
/// An STM32F405 (ST RM0090) with USART1 on PA9 and PA10 and USART2 on PA2 and PA3, on its internal clock of 16 MHz. Needs
/// nothing of a debugger or emulator; QEMU runs it on its machine netduinoplus2.

#include "board.h"

typedef struct {
    volatile uint32_t sr;
    volatile uint32_t dr;
    volatile uint32_t brr;
    volatile uint32_t cr1;
} usart_t;

#define SR_ORE 0x08U       ///< a byte was lost
#define SR_RXNE 0x20U      ///< a byte was received
#define SR_TXE 0x80U       ///< room for a byte
#define CR1_USUAL 0x202CU  ///< UE, RXNEIE, TE, RE
#define CR1_TXEIE 0x80U
#define BRR_115200 139U  ///< 16 MHz / 115,200

#define REGISTER(address) (*(volatile uint32_t*)(address))
#define RCC_AHB1ENR REGISTER(0x40023830U)
#define RCC_APB1ENR REGISTER(0x40023840U)
#define RCC_APB2ENR REGISTER(0x40023844U)
#define GPIOA_MODER REGISTER(0x40020000U)
#define GPIOA_AFRL REGISTER(0x40020020U)
#define GPIOA_AFRH REGISTER(0x40020024U)
#define SYSTICK_CONTROL REGISTER(0xE000E010U)
#define SYSTICK_RELOAD REGISTER(0xE000E014U)
#define SYSTICK_VALUE REGISTER(0xE000E018U)
#define NVIC_ENABLE_32_TO_63 REGISTER(0xE000E104U)
#define SCB_AIRCR REGISTER(0xE000ED0CU)

#define RCC_GPIOA 0x1U
#define RCC_USART1 0x10U
#define RCC_USART2 0x20000U
#define MODER_ALTERNATE 0x2800A0U  ///< pins 2, 3, 9, 10
#define AFRL_USART2 0x7700U
#define AFRH_USART1 0x770U
#define SYSTICK_LONGEST 0xFFFFFFU
#define SYSTICK_BEGIN 5U   ///< on the clock of the processor
#define NVIC_USARTS 0x60U  ///< interrupts 37 and 38
#define AIRCR_RESET 0x05FA0004U

static usart_t* const usarts[UART_COUNT] = { (usart_t*)0x40011000U, (usart_t*)0x40004400U };

/// Reading the state and then the data clears the interrupt, the overrun too, whose byte comes after that in the data.
static void serve(const unsigned uart) {
    usart_t* const usart = usarts[uart];
    const uint32_t state = usart->sr;
    if ((state & (SR_RXNE | SR_ORE)) != 0U) {
        const uint8_t byte = (uint8_t)usart->dr;
        if ((state & SR_RXNE) != 0U) {
            uart_received(uart, byte);
        }
        if ((state & SR_ORE) != 0U) {
            uart_lost(uart);
        }
    }
    if ((state & SR_TXE) != 0U) {
        usart->cr1 = CR1_USUAL;
    }
}

static void usart1_interrupt(void) { serve(0U); }
static void usart2_interrupt(void) { serve(1U); }

__attribute__((section(".vectors.board"), used)) static const board_handler_t handlers[82] = {
    [37] = usart1_interrupt,
    [38] = usart2_interrupt,
};

void board_start(void) {
    RCC_AHB1ENR |= RCC_GPIOA;
    RCC_APB1ENR |= RCC_USART2;
    RCC_APB2ENR |= RCC_USART1;
    (void)RCC_APB2ENR;  // the clocks take two cycles to begin
    GPIOA_AFRL |= AFRL_USART2;
    GPIOA_AFRH |= AFRH_USART1;
    GPIOA_MODER |= MODER_ALTERNATE;
    for (unsigned uart = 0U; uart < UART_COUNT; uart++) {
        usarts[uart]->brr = BRR_115200;
        usarts[uart]->cr1 = CR1_USUAL;
    }
    SYSTICK_RELOAD       = SYSTICK_LONGEST;
    SYSTICK_VALUE        = 0U;
    SYSTICK_CONTROL      = SYSTICK_BEGIN;
    NVIC_ENABLE_32_TO_63 = NVIC_USARTS;
}

/// The time from power-on to the first byte, in cycles of the processor, modulo 2^24: a second at 16 MHz.
uint32_t board_nonce(void) { return SYSTICK_VALUE; }

/// Reset the board. The harness notices by the boot nonce.
void board_fail(const char* const line) {
    (void)line;
    SCB_AIRCR = AIRCR_RESET;
    for (;;) {
    }
}

bool board_has_room(const unsigned uart) { return (usarts[uart]->sr & SR_TXE) != 0U; }

void board_send(const unsigned uart, const uint8_t byte) { usarts[uart]->dr = byte; }

void board_await_room(const unsigned uart) { usarts[uart]->cr1 = CR1_USUAL | CR1_TXEIE; }
