// SPDX-License-Identifier: MIT
/// fuzz_line: common part of the fuzz targets for the device, one for each kind of line. Any bytes and messages are
/// entered in pieces of any size, and answered into outputs of any size. The output must consist of complete messages
/// of the device with consecutive numbers. The answers to a message are bounded, the size of the pieces has no
/// effect, and the invariants of the estimator hold.

#ifndef FUZZ_LINE_H_INCLUDED
#define FUZZ_LINE_H_INCLUDED

#include "device_line.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define STREAM_MAX 4096U
#define ANSWERS_MAX (1U << 20U)

/// Rest of the fuzzer's input.
typedef struct {
    const uint8_t* bytes;
    size_t         n;
} input_t;

/// Bytes that arrive over the line, and the next sequence number.
typedef struct {
    uint8_t seq;
    size_t  n;
    uint8_t bytes[STREAM_MAX];
} stream_t;

typedef struct {
    size_t  n;
    uint8_t bytes[ANSWERS_MAX];
} answers_t;

/// Maximum number of bytes that one step adds to a stream.
#define NOISE_MAX 256U

// ---- functions that each target defines

/// Kind of line.
typedef struct {
    const device_line_t* line;
    size_t               item_size;    ///< bytes that arrive together
    size_t               answer_size;  ///< room in bytes that an answer needs
} target_t;

/// Return the kind of line for this input.
target_t target(const uint8_t* data, size_t size);

/// Add the messages that must come first.
void target_begin(stream_t* stream);

/// Add a message of the harness.
void target_add_message(stream_t* stream, uint8_t id, const uint8_t* payload, input_t* input);

/// Add at most NOISE_MAX bytes of anything else.
void target_add_noise(stream_t* stream, input_t* input);

/// Upper bound of the number of messages of the harness in the stream.
size_t target_messages(const stream_t* stream);

/// Check each answer with expect_answer(), and return their number.
size_t target_checked(const answers_t* answers);

// ---- functions for the targets

/// Abort unless the condition holds.
void expect(bool holds);

/// Take the next byte; 0 at the end.
uint8_t take_byte(input_t* input);

/// Abort unless the message is one of the device with this sequence number.
void expect_answer(uint8_t id, const uint8_t* payload, size_t length, size_t number);

#endif  // FUZZ_LINE_H_INCLUDED
