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

/// A kind of line as its fuzz target knows it.
typedef struct {
    const device_line_t* line;
    size_t               item_size;    ///< bytes that come together
    size_t               answer_size;  ///< bytes of room for which something is answered
    void (*begin)(stream_t* stream);   ///< what must be said first
    void (*add_message)(stream_t* stream, uint8_t id, const uint8_t* payload, input_t* input);
    void (*add_noise)(stream_t* stream, input_t* input);  ///< adds at most NOISE_MAX bytes
    size_t (*messages)(const stream_t* stream);           ///< no fewer than the harness's messages in it
    size_t (*checked)(const answers_t* answers);          ///< how many answers; with answer() for each
} fuzz_line_t;

/// Most bytes that one step may add to a stream.
#define NOISE_MAX 256U

/// Plays an input; two states of the shell's size.
void fuzz_line(const fuzz_line_t* kind, void* state, void* state_at_once, const uint8_t* data, size_t size);

/// Aborts unless it holds.
void expect(bool holds);

/// The next byte; 0 when there is none.
uint8_t take_byte(input_t* input);

/// Expects the message to be one of the device with that number.
void expect_answer(uint8_t id, const uint8_t* payload, size_t length, size_t number);

#endif  // FUZZ_LINE_H_INCLUDED
