// SPDX-License-Identifier: MIT
/// libFuzzer target for the device on a CAN bus, with and without CAN FD; see fuzz_line.h. Messages of the harness
/// are mixed with frames of any identifier, kind and length. `make fuzz` builds and runs it.

#include "analogrig_catalogue.h"
#include "can_device.h"
#include "fuzz_line.h"

#include <string.h>

void target_begin(stream_t* const stream) { (void)stream; }

static void add_frame(stream_t* const stream, const can_frame_t* const frame) {
    (void)memcpy(&stream->bytes[stream->n], frame, sizeof(*frame));
    stream->n += sizeof(*frame);
}

/// Occasionally uses the wrong kind of frame, or another identifier with the same last byte.
void target_add_message(stream_t* const stream, const uint8_t id, const uint8_t* const payload, input_t* const input) {
    can_frame_t   frame  = { .id = id, .length = analogrig_length(id) };
    const uint8_t choice = take_byte(input);
    frame.flags          = (frame.length > CAN_FRAME_CLASSIC_MAX) ? CAN_FRAME_FD : 0U;
    frame.flags ^= ((choice & 0xF0U) == 0xF0U) ? (choice & 0xFU) : 0U;
    frame.id |= ((choice & 0xF0U) == 0xE0U) ? ((choice & 7U) << 8U) : 0U;
    (void)memcpy(frame.data, payload, frame.length);
    add_frame(stream, &frame);
}

void target_add_noise(stream_t* const stream, input_t* const input) {
    can_frame_t frame = { .flags = take_byte(input), .length = take_byte(input) };
    for (uint8_t i = 0U; i < 4U; i++) {
        frame.id = (frame.id << 8U) | take_byte(input);
    }
    for (uint8_t i = 0U; (i < frame.length) && (i < CAN_FRAME_MAX); i++) {
        frame.data[i] = take_byte(input);
    }
    add_frame(stream, &frame);
}

/// Counts data frames with the identifier and length of a message of the harness.
size_t target_messages(const stream_t* const stream) {
    size_t n = 0U;
    for (size_t i = 0U; i < stream->n; i += sizeof(can_frame_t)) {
        can_frame_t frame;
        (void)memcpy(&frame, &stream->bytes[i], sizeof(frame));
        const bool is_data = (frame.flags | CAN_FRAME_FD) == CAN_FRAME_FD;
        const bool is_ours = (frame.id <= UINT8_MAX) && analogrig_is_from_harness((uint8_t)frame.id);
        n += (is_data && is_ours && (frame.length == analogrig_length((uint8_t)frame.id))) ? 1U : 0U;
    }
    return n;
}

/// Expects classic frames of the device only.
size_t target_checked(const answers_t* const answers) {
    const size_t frames = answers->n / sizeof(can_frame_t);
    expect((answers->n % sizeof(can_frame_t)) == 0U);
    for (size_t i = 0U; i < frames; i++) {
        can_frame_t frame;
        (void)memcpy(&frame, &answers->bytes[i * sizeof(frame)], sizeof(frame));
        expect((frame.flags == 0U) && (frame.length <= CAN_FRAME_CLASSIC_MAX) && (frame.id <= UINT8_MAX));
        expect_answer((uint8_t)frame.id, frame.data, frame.length, i);
    }
    return frames;
}

target_t target(const uint8_t* const data, const size_t size) {
    const bool is_fd = (size > 0U) && ((data[size - 1U] & 1U) != 0U);
    return (target_t){ .line        = is_fd ? &can_fd_line : &can_line,
                       .item_size   = sizeof(can_frame_t),
                       .answer_size = sizeof(can_frame_t) };
}
