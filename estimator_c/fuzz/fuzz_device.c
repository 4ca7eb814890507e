/// libFuzzer target over the device as a whole: any bytes and any messages, in pieces of any size, answered into outputs of
/// any size. Whatever comes, every byte that goes out belongs to a good frame of the device, numbered after the last, the
/// answers to a message are bounded, the size of the pieces changes nothing, and the estimator's invariants hold. `make fuzz`
/// builds and runs it.

#include "analogrig_codec.h"
#include "serial_device.h"

#include <stdlib.h>
#include <string.h>

#define STREAM_MAX 4096U
#define ANSWERS_MAX (1U << 20U)

/// A block's worth of samples, or all the counters: no message has more answers.
#define ANSWERS_PER_MESSAGE (ANALOGRIG_SAMPLE_BLOCK_FORCE_N * (EST_THETA_MAX + 3U))

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

static void expect(const bool holds) {
    if (!holds) {
        abort();
    }
}

static uint8_t byte(input_t* const input) {
    if (input->n == 0U) {
        return 0U;
    }
    input->n--;
    return *input->bytes++;
}

/// A message of the harness, mostly with the sequence number that is due; values that no fuzzer finds in reasonable time,
/// identifiers and checksums, are made for it.
static void add_message(stream_t* const stream, input_t* const input) {
    static const uint8_t ids[] = { ANALOGRIG_SAMPLE_FRAME_ID,   ANALOGRIG_SAMPLE_BLOCK_FRAME_ID,
                                   ANALOGRIG_CONTROL_FRAME_ID,  ANALOGRIG_CONFIGURE_FRAME_ID,
                                   ANALOGRIG_IDENTIFY_FRAME_ID, ANALOGRIG_HELLO_FRAME_ID };
    const uint8_t        kind  = byte(input);
    const uint8_t        id    = ids[kind % sizeof(ids)];
    uint8_t              payload[ANALOGRIG_LENGTH_MAX];
    for (uint8_t i = 0U; i < analogrig_length(id); i++) {
        payload[i] = byte(input);
    }
    if ((kind & 0x80U) == 0U) {
        payload[0] = stream->seq;
    }
    stream->seq = (uint8_t)(payload[0] + 1U);
    stream->n += frame_encode(ANALOGRIG_CATALOGUE_HASH, id, payload, &stream->bytes[stream->n]);
}

static void add_bytes(stream_t* const stream, input_t* const input) {
    for (uint8_t n = (uint8_t)(1U + (byte(input) % 32U)); n > 0U; n--) {
        stream->bytes[stream->n++] = byte(input);
    }
}

static void add_next(stream_t* const stream, input_t* const input) {
    if ((byte(input) % 8U) != 0U) {
        add_message(stream, input);
    } else {
        add_bytes(stream, input);
    }
}

/// The stream in pieces into the device, its answers in pieces out of it; sizes come from the input, the largest without one.
static void play(serial_device_t* const device, const stream_t* const stream, input_t* const sizes, answers_t* const answers) {
    size_t taken = 0U;
    while ((taken < stream->n) || device_is_busy(&device->device)) {
        const bool   any_size = sizes->n > 0U;
        const size_t left     = stream->n - taken;
        const size_t piece    = any_size ? (byte(sizes) % 100U) : left;
        const size_t in_n     = (piece < left) ? piece : left;
        const size_t room     = any_size ? (4U * (size_t)byte(sizes)) : (64U * SERIAL_DEVICE_ANSWER);
        expect(answers->n + room <= ANSWERS_MAX);
        const device_progress_t progress =
            serial_device_run(device, &stream->bytes[taken], in_n, &answers->bytes[answers->n], room);
        expect((progress.taken <= in_n) && (progress.given <= room));
        expect((room < SERIAL_DEVICE_ANSWER) || (in_n == 0U) || (progress.taken > 0U) || (progress.given > 0U));
        expect(!device->device.running || est_invariants_hold(&device->device.estimator));
        taken += progress.taken;
        answers->n += progress.given;
    }
}

static size_t good_frames(const stream_t* const stream) {
    frame_decoder_t decoder;
    frame_decoder_init(&decoder, ANALOGRIG_CATALOGUE_HASH);
    size_t frames = 0U;
    for (size_t i = 0U; i < stream->n; i++) {
        frames += frame_decoder_enter(&decoder, stream->bytes[i]) ? 1U : 0U;
    }
    return frames;
}

/// Nothing but whole frames of the device, numbered one after the other. Returns how many.
static size_t checked_answers(const answers_t* const answers) {
    frame_decoder_t decoder;
    frame_decoder_init(&decoder, ANALOGRIG_CATALOGUE_HASH);
    size_t frames = 0U;
    size_t bytes  = 0U;
    for (size_t i = 0U; i < answers->n; i++) {
        if (frame_decoder_enter(&decoder, answers->bytes[i])) {
            expect(!analogrig_is_from_harness(frame_id(&decoder)));
            expect(frame_payload(&decoder)[0] == (uint8_t)frames);
            bytes += FRAME_SIZE(analogrig_length(frame_id(&decoder)));
            frames++;
        }
    }
    expect((frame_dropped(&decoder) == 0U) && (bytes == answers->n));
    return frames;
}

int LLVMFuzzerTestOneInput(const uint8_t* const data, const size_t size) {
    static stream_t  stream;
    static answers_t answers;
    static answers_t answers_at_once;
    const size_t     sizes_n = (size > 0U) ? ((data[0] < size) ? data[0] : (size - 1U)) : 0U;
    input_t          sizes   = { .bytes = &data[(size > 0U) ? 1U : 0U], .n = sizes_n };
    input_t          input   = { .bytes = &sizes.bytes[sizes_n], .n = (size > 0U) ? (size - 1U - sizes_n) : 0U };
    stream.n                 = 0U;
    stream.seq               = 0U;
    answers.n                = 0U;
    answers_at_once.n        = 0U;
    while ((input.n > 0U) && (stream.n < (STREAM_MAX - FRAME_SIZE(ANALOGRIG_LENGTH_MAX)))) {
        add_next(&stream, &input);
    }
    const device_identity_t identity = { .catalogue_hash = ANALOGRIG_CATALOGUE_HASH,
                                         .boot_nonce     = 1U,
                                         .firmware_id    = 1U };
    serial_device_t         device;
    serial_device_t         device_at_once;
    serial_device_init(&device, &identity);
    serial_device_init(&device_at_once, &identity);
    play(&device, &stream, &sizes, &answers);
    play(&device_at_once, &stream, &(input_t){ .bytes = 0, .n = 0U }, &answers_at_once);
    expect((answers.n == answers_at_once.n) && (memcmp(answers.bytes, answers_at_once.bytes, answers.n) == 0));
    expect(checked_answers(&answers) <= (good_frames(&stream) * ANSWERS_PER_MESSAGE));
    return 0;
}
