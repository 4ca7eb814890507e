// SPDX-License-Identifier: MIT
/// libFuzzer target for the device on a serial line; see fuzz_line.h. `make fuzz` builds and runs it.

#include "analogrig_catalogue.h"
#include "fuzz_line.h"
#include "serial_device.h"

void target_begin(stream_t* const stream) { (void)stream; }

void target_add_message(stream_t* const stream, const uint8_t id, const uint8_t* const payload, input_t* const input) {
    (void)input;
    stream->n += frame_encode(ANALOGRIG_CATALOGUE_HASH, id, payload, &stream->bytes[stream->n]);
}

void target_add_noise(stream_t* const stream, input_t* const input) {
    for (uint8_t n = (uint8_t)(1U + (take_byte(input) % 32U)); n > 0U; n--) {
        stream->bytes[stream->n++] = take_byte(input);
    }
}

size_t target_messages(const stream_t* const stream) {
    frame_decoder_t decoder;
    frame_decoder_init(&decoder, ANALOGRIG_CATALOGUE_HASH);
    size_t frames = 0U;
    for (size_t i = 0U; i < stream->n; i++) {
        frames += frame_decoder_enter(&decoder, stream->bytes[i]) ? 1U : 0U;
    }
    return frames;
}

/// Expects complete frames only.
size_t target_checked(const answers_t* const answers) {
    frame_decoder_t decoder;
    frame_decoder_init(&decoder, ANALOGRIG_CATALOGUE_HASH);
    size_t frames = 0U;
    size_t bytes  = 0U;
    for (size_t i = 0U; i < answers->n; i++) {
        if (frame_decoder_enter(&decoder, answers->bytes[i])) {
            const uint8_t length = analogrig_length(frame_id(&decoder));
            expect_answer(frame_id(&decoder), frame_payload(&decoder), length, frames);
            bytes += FRAME_SIZE(length);
            frames++;
        }
    }
    expect((frame_dropped(&decoder) == 0U) && (bytes == answers->n));
    return frames;
}

target_t target(const uint8_t* const data, const size_t size) {
    (void)data;
    (void)size;
    return (target_t){ .line = &serial_line, .item_size = 1U, .answer_size = SERIAL_DEVICE_ANSWER };
}
