// SPDX-License-Identifier: MIT
/// libFuzzer target for the device behind slcan: lines, commands and any bytes; see fuzz_line.h. `make fuzz` builds
/// and runs it.

#include "analogrig_catalogue.h"
#include "fuzz_line.h"
#include "slcan_device.h"

#include <string.h>

#define CR 0x0DU
#define BEL 0x07U

/// Length of an answer: t, three digits of identifier, the length, sixteen digits of data.
#define ANSWER_LINE 21U

/// Length of the line of a SampleBlock.
#define BLOCK_LINE 133U

static void add_text(stream_t* const stream, const char* const text) {
    const size_t n = strlen(text);
    (void)memcpy(&stream->bytes[stream->n], text, n);
    stream->n += n;
}

void target_begin(stream_t* const stream) { add_text(stream, "O\r"); }

/// Occasionally uses the wrong kind of frame, or a line that is one digit too long.
void target_add_message(stream_t* const stream, const uint8_t id, const uint8_t* const payload, input_t* const input) {
    const slcan_t adapter = { .is_open = true };
    const uint8_t choice  = take_byte(input);
    can_frame_t   frame   = { .id = id, .length = analogrig_length(id) };
    frame.flags           = ((frame.length > CAN_FRAME_CLASSIC_MAX) || (choice >= 0xF0U)) ? CAN_FRAME_FD : 0U;
    (void)memcpy(frame.data, payload, frame.length);
    stream->n += slcan_encode(&adapter, &frame, &stream->bytes[stream->n]);
    if ((choice & 0xF0U) == 0xE0U) {
        stream->bytes[stream->n - 1U] = (uint8_t)'0';
        stream->bytes[stream->n++]    = CR;
    }
}

/// Adds any bytes, or only characters of lines.
void target_add_noise(stream_t* const stream, input_t* const input) {
    static const char letters[] = "\r\r\r\rtTrRdDbBOOOLCSsYVNFZ0123456789ABCDEFabcdef0000";
    const uint8_t     choice    = take_byte(input);
    for (uint8_t n = (uint8_t)(1U + (choice % 32U)); n > 0U; n--) {
        const uint8_t next         = take_byte(input);
        stream->bytes[stream->n++] = (choice < 0x80U) ? next : (uint8_t)letters[next % (sizeof(letters) - 1U)];
    }
}

/// True iff the line has the length of a data frame with 8 or 64 bytes.
static bool may_be_message(const uint8_t* const line, const size_t n) {
    return ((n == ANSWER_LINE) && (line[4] == (uint8_t)'8')) ||
           ((n == BLOCK_LINE) && ((line[4] == (uint8_t)'F') || (line[4] == (uint8_t)'f')));
}

size_t target_messages(const stream_t* const stream) {
    size_t found = 0U;
    size_t start = 0U;
    for (size_t i = 0U; i < stream->n; i++) {
        if (stream->bytes[i] == CR) {
            found += may_be_message(&stream->bytes[start], i - start) ? 1U : 0U;
            start = i + 1U;
        }
    }
    return found;
}

static uint8_t hex(const uint8_t character) {
    const char* const digits = "0123456789ABCDEF";
    const char* const found  = (character != 0U) ? strchr(digits, (int)character) : 0;
    expect(found != 0);
    return (uint8_t)(found - digits);
}

static uint8_t hex_byte(const uint8_t* const text) { return (uint8_t)((hex(text[0]) << 4U) | hex(text[1])); }

static void expect_frame(const uint8_t* const line, const size_t number) {
    uint8_t payload[DEVICE_ANSWER_LENGTH];
    expect((line[0] == (uint8_t)'t') && (line[1] == (uint8_t)'0') && (line[4] == (uint8_t)'8'));
    for (uint8_t i = 0U; i < sizeof(payload); i++) {
        payload[i] = hex_byte(&line[5U + (2U * i)]);
    }
    expect_answer(hex_byte(&line[2]), payload, sizeof(payload), number);
}

static bool is_reply(const uint8_t* const line, const size_t n) {
    static const char* const replies[] = { "", "z", "Z", "V0101", "NRIG1", "F00" };
    for (size_t i = 0U; i < (sizeof(replies) / sizeof(replies[0])); i++) {
        if ((strlen(replies[i]) == n) && (memcmp(line, replies[i], n) == 0)) {
            return true;
        }
    }
    return false;
}

/// Expects complete lines only: replies, and frames of the device.
size_t target_checked(const answers_t* const answers) {
    size_t frames = 0U;
    size_t start  = 0U;
    for (size_t i = 0U; i < answers->n; i++) {
        const uint8_t* const line = &answers->bytes[start];
        if ((answers->bytes[i] == CR) && ((i - start) == ANSWER_LINE)) {
            expect_frame(line, frames);
            frames++;
            start = i + 1U;
        } else if (answers->bytes[i] == CR) {
            expect(is_reply(line, i - start));
            start = i + 1U;
        } else if (answers->bytes[i] == BEL) {
            expect(i == start);
            start = i + 1U;
        } else {
            // inside a line
        }
    }
    expect(start == answers->n);
    return frames;
}

target_t target(const uint8_t* const data, const size_t size) {
    (void)data;
    (void)size;
    return (target_t){ .line = &slcan_line, .item_size = 1U, .answer_size = SLCAN_DEVICE_ANSWER };
}
