/// fuzz_line: what the fuzz targets over the device have in common, one for each kind of line: any bytes and any messages, in
/// pieces of any size, answered into outputs of any size. Whatever comes, all that goes out is whole and comes from the device,
/// numbered one after the other; the answers to a message are bounded, the size of the pieces changes nothing, and the
/// estimator's invariants hold.

#ifndef FUZZ_LINE_H_INCLUDED
#define FUZZ_LINE_H_INCLUDED

#include "device_line.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define STREAM_MAX 4096U
#define ANSWERS_MAX (1U << 20U)

/// What is left of the fuzzer's input.
typedef struct {
    const uint8_t* bytes;
    size_t         n;
} input_t;

/// What comes over the line, and the sequence number that is due next.
typedef struct {
    uint8_t seq;
    size_t  n;
    uint8_t bytes[STREAM_MAX];
} stream_t;

typedef struct {
    size_t  n;
    uint8_t bytes[ANSWERS_MAX];
} answers_t;

/// Most bytes that one step may add to a stream.
#define NOISE_MAX 256U

// ---- what each target defines

/// Its kind of line.
typedef struct {
    const device_line_t* line;
    size_t               item_size;    ///< bytes that come together
    size_t               answer_size;  ///< bytes of room for which something is answered
} target_t;

/// For this input of the fuzzer.
target_t target(const uint8_t* data, size_t size);

/// What must be said first.
void target_begin(stream_t* stream);

/// Adds a message of the harness.
void target_add_message(stream_t* stream, uint8_t id, const uint8_t* payload, input_t* input);

/// Adds at most NOISE_MAX bytes of anything else.
void target_add_noise(stream_t* stream, input_t* input);

/// No fewer than the harness's messages in it.
size_t target_messages(const stream_t* stream);

/// How many answers there are; expect_answer() for each.
size_t target_checked(const answers_t* answers);

// ---- what they have to do it with

/// Aborts unless it holds.
void expect(bool holds);

/// The next byte; 0 when there is none.
uint8_t take_byte(input_t* input);

/// Expects the message to be one of the device with that number.
void expect_answer(uint8_t id, const uint8_t* payload, size_t length, size_t number);

#endif  // FUZZ_LINE_H_INCLUDED
