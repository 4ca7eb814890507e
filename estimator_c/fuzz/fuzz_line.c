// SPDX-License-Identifier: MIT

#include "fuzz_line.h"

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "can_device.h"
#include "serial_device.h"
#include "slcan_device.h"

#include <stdlib.h>
#include <string.h>

/// Upper bound of the answers to one message: all answers to the samples of a block. There are fewer counters.
#define ANSWERS_PER_MESSAGE (ANALOGRIG_SAMPLE_BLOCK_FORCE_N * (EST_THETA_MAX + 3U))

void expect(const bool holds) {
    if (!holds) {
        abort();
    }
}

uint8_t take_byte(input_t* const input) {
    if (input->n == 0U) {
        return 0U;
    }
    input->n--;
    return *input->bytes++;
}

/// Add a message of the harness, mostly with the expected sequence number. Identifiers and checksums are computed,
/// because a fuzzer does not find them in reasonable time.
static void add_message(stream_t* const stream, input_t* const input) {
    static const uint8_t ids[] = { ANALOGRIG_SAMPLE_FRAME_ID,   ANALOGRIG_SAMPLE_BLOCK_FRAME_ID,
                                   ANALOGRIG_CONTROL_FRAME_ID,  ANALOGRIG_CONFIGURE_FRAME_ID,
                                   ANALOGRIG_IDENTIFY_FRAME_ID, ANALOGRIG_HELLO_FRAME_ID };
    const uint8_t        which = take_byte(input);
    const uint8_t        id    = ids[which % sizeof(ids)];
    uint8_t              payload[ANALOGRIG_LENGTH_MAX];
    for (uint8_t i = 0U; i < analogrig_length(id); i++) {
        payload[i] = take_byte(input);
    }
    if ((which & 0x80U) == 0U) {
        payload[0] = stream->seq;
    }
    stream->seq = (uint8_t)(payload[0] + 1U);
    target_add_message(stream, id, payload, input);
}

static void add_next(stream_t* const stream, input_t* const input) {
    if ((take_byte(input) % 8U) != 0U) {
        add_message(stream, input);
    } else {
        target_add_noise(stream, input);
    }
}

/// Pass the stream to the device in pieces, and take its answers in pieces. The sizes come from the input, or are the
/// largest.
static void play(const target_t* const kind,
                 void* const           state,
                 const stream_t* const stream,
                 input_t* const        sizes,
                 answers_t* const      answers) {
    const device_t* const device = state;
    size_t                taken  = 0U;
    while ((taken < stream->n) || device_is_busy(device)) {
        const bool   any_size = sizes->n > 0U;
        const size_t left     = stream->n - taken;
        const size_t piece    = any_size ? (kind->item_size * (take_byte(sizes) % 100U)) : left;
        const size_t in_n     = (piece < left) ? piece : left;
        const size_t room     = any_size ? (4U * (size_t)take_byte(sizes)) : (64U * kind->answer_size);
        expect(answers->n + room <= ANSWERS_MAX);
        const device_progress_t progress =
            kind->line->run(state, &stream->bytes[taken], in_n, &answers->bytes[answers->n], room);
        expect((progress.taken <= in_n) && (progress.given <= room));
        expect((room < kind->answer_size) || (in_n == 0U) || (progress.taken > 0U) || (progress.given > 0U));
        expect(!device->running || est_invariants_hold(&device->estimator));
        taken += progress.taken;
        answers->n += progress.given;
    }
}

void expect_answer(const uint8_t id, const uint8_t* const payload, const size_t length, const size_t number) {
    expect((analogrig_length(id) == length) && !analogrig_is_from_harness(id));
    expect(payload[0] == (uint8_t)number);
}

/// State of any shell.
typedef union {
    serial_device_t serial;
    can_device_t    can;
    slcan_device_t  slcan;
} shell_t;

int LLVMFuzzerTestOneInput(const uint8_t* const data, const size_t size) {
    static shell_t          shell;
    static shell_t          shell_at_once;
    static stream_t         stream;
    static answers_t        answers;
    static answers_t        answers_at_once;
    const target_t          kind     = target(data, size);
    const device_identity_t identity = { .catalogue_hash = ANALOGRIG_CATALOGUE_HASH,
                                         .boot_nonce     = 1U,
                                         .firmware_id    = 1U };
    const size_t            sizes_n  = (size > 0U) ? ((data[0] < size) ? data[0] : (size - 1U)) : 0U;
    input_t                 sizes    = { .bytes = &data[(size > 0U) ? 1U : 0U], .n = sizes_n };
    input_t                 input = { .bytes = &sizes.bytes[sizes_n], .n = (size > 0U) ? (size - 1U - sizes_n) : 0U };
    stream.n                      = 0U;
    stream.seq                    = 0U;
    answers.n                     = 0U;
    answers_at_once.n             = 0U;
    target_begin(&stream);
    while ((input.n > 0U) && (stream.n < (STREAM_MAX - NOISE_MAX))) {
        add_next(&stream, &input);
    }
    kind.line->init(&shell, &identity);
    kind.line->init(&shell_at_once, &identity);
    play(&kind, &shell, &stream, &sizes, &answers);
    play(&kind, &shell_at_once, &stream, &(input_t){ .bytes = 0, .n = 0U }, &answers_at_once);
    expect((answers.n == answers_at_once.n) && (memcmp(answers.bytes, answers_at_once.bytes, answers.n) == 0));
    expect(target_checked(&answers) <= (target_messages(&stream) * ANSWERS_PER_MESSAGE));
    return 0;
}
