// SPDX-License-Identifier: MIT
/// The text firmware as a program: lines on standard input, answers on standard output.

#include "text_io.h"

#include <stdio.h>

void text_start(void) {}

int text_read(void) {
    const int c = getchar();
    return (c == EOF) ? TEXT_END : c;
}

void text_write(const char* const text, const size_t n) {
    (void)fwrite(text, 1U, n, stdout);
    (void)fflush(stdout);  // the other end waits for the answer
}
