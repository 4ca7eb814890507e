// SPDX-License-Identifier: MIT

#include "semihosting.h"

#include <stdbool.h>

#define SYS_WRITE0 0x04U
#define SYS_GET_CMDLINE 0x15U
#define SYS_EXIT_EXTENDED 0x20U
#define APPLICATION_EXIT 0x20026U

static uint32_t call(const uint32_t operation, const void* const argument) {
    register uint32_t    r0 __asm("r0") = operation;
    register const void* r1 __asm("r1") = argument;
    __asm volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

/// Value of a hexadecimal digit; -1 for any other character.
static int32_t digit(const char c) {
    if ((c >= '0') && (c <= '9')) {
        return c - '0';
    }
    return ((c >= 'a') && (c <= 'f')) ? (10 + (c - 'a')) : -1;
}

uint32_t semihosting_argument(void) {
    static char line[80];
    struct {
        char*    text;
        uint32_t size;
    } block        = { .text = line, .size = sizeof(line) };
    uint32_t value = 0U;
    if (call(SYS_GET_CMDLINE, &block) != 0U) {
        return value;
    }
    bool in_argument = false;  // the name of the program comes first
    for (const char* c = line; *c != '\0'; c++) {
        const int32_t next = digit(*c);
        if (*c == ' ') {
            in_argument = true;
        } else if (in_argument && (next >= 0)) {
            value = (value << 4U) | (uint32_t)next;
        } else {
            // part of the name, or not a digit
        }
    }
    return value;
}

void semihosting_end(const char* const line, const uint32_t status) {
    const uint32_t block[2] = { APPLICATION_EXIT, status };
    (void)call(SYS_WRITE0, line);
    (void)call(SYS_EXIT_EXTENDED, block);
    for (;;) {
    }
}
