// SPDX-License-Identifier: MIT
/// text_io: the serial line of the text firmware: of a board (on_board.c), or standard input and output (on_host.c).

#ifndef TEXT_IO_H_INCLUDED
#define TEXT_IO_H_INCLUDED

#include <stddef.h>

#define TEXT_END (-1)   ///< the input has ended; a board's never does
#define TEXT_LOST (-2)  ///< bytes were lost before the next

/// Set up the line.
void text_start(void);

/// Wait for a byte and return it, or TEXT_END or TEXT_LOST.
int text_read(void);

/// Write all bytes.
void text_write(const char* text, size_t n);

#endif  // TEXT_IO_H_INCLUDED
