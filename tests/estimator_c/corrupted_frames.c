// SPDX-License-Identifier: MIT
/// Frames of any message, every one of them corrupted, for both decoders; and whether that of the device takes any of them
/// for something that nobody sent. test_corrupted_frames.py compiles it together with frame.c.

#include "frame.h"

#include <string.h>

#define PACKET_MAX (1U + ANALOGRIG_LENGTH_MAX)
#define LONGEST FRAME_SIZE(ANALOGRIG_LENGTH_MAX)
#define REMEMBERED 4U  ///< packets that a frame taken now may be a copy of

typedef enum {
    FLIPPED_BITS,
    LOST_BYTES,
    INSERTED_BYTES,
    TRUNCATED,
    REPEATED_BYTES,
    REVERSED_BYTES,
    NOISE,
    INSERTED_ZERO,
    SPLICED,  ///< the head of this frame, the tail of the one before
    CORRUPTIONS,
} corruption_t;

typedef struct {
    size_t  n;
    uint8_t bytes[4U * LONGEST];
} piece_t;

typedef struct {
    uint64_t        random;
    uint64_t        turn;
    frame_decoder_t decoder;
    uint8_t         sent[REMEMBERED][PACKET_MAX];
    piece_t         last;  ///< frame, as it was before it was corrupted
} line_t;

typedef struct {
    uint64_t taken;  ///< what was sent, all the same: the corruption only touched the zeros between two frames
    uint64_t wrong;
    uint64_t dropped;
    uint64_t stream_n;
    uint64_t packets_n;
} outcome_t;

size_t line_size(void) { return sizeof(line_t); }
size_t piece_max(void) { return sizeof(((piece_t*)0)->bytes); }

void line_init(line_t* const self, const uint64_t seed) {
    memset(self, 0, sizeof(*self));
    self->random = seed;
    frame_decoder_init(&self->decoder, ANALOGRIG_CATALOGUE_HASH);
}

/// SplitMix64 (Steele, Lea and Flood 2014).
static uint64_t draw(line_t* const self) {
    self->random += 0x9e3779b97f4a7c15ULL;
    uint64_t z = self->random;
    z          = (z ^ (z >> 30U)) * 0xbf58476d1ce4e5b9ULL;
    z          = (z ^ (z >> 27U)) * 0x94d049bb133111ebULL;
    return z ^ (z >> 31U);
}

static size_t  below(line_t* const self, const size_t n) { return (size_t)(draw(self) % n); }
static uint8_t any_byte(line_t* const self) { return (uint8_t)(draw(self) >> 56U); }

/// Any message; with many zeros, which are what COBS is about, in half of them.
static void draw_packet(line_t* const self, uint8_t* const packet) {
    uint8_t id = 0U;
    while (analogrig_length(id) == 0U) {
        id = any_byte(self);
    }
    packet[0]          = id;
    const bool   zeros = below(self, 2U) == 0U;
    const size_t n     = 1U + (size_t)analogrig_length(id);
    for (size_t i = 1U; i < n; i++) {
        packet[i] = (zeros && (below(self, 2U) == 0U)) ? 0U : any_byte(self);
    }
}

/// Bytes at..at+gone are replaced by n others.
static void replace(piece_t* const piece, const size_t at, const size_t gone, const uint8_t* const by, const size_t n) {
    memmove(&piece->bytes[at + n], &piece->bytes[at + gone], piece->n - at - gone);
    memcpy(&piece->bytes[at], by, n);
    piece->n = piece->n - gone + n;
}

static void corrupt(line_t* const self, piece_t* const piece, const corruption_t how) {
    uint8_t      other[LONGEST];
    const size_t at     = below(self, piece->n);
    const size_t beyond = piece->n - at;
    const size_t most   = (beyond < 16U) ? beyond : 16U;
    const size_t n      = 1U + below(self, most);
    for (size_t i = 0U; i < n; i++) {
        other[i] = (how == REVERSED_BYTES) ? piece->bytes[at + n - 1U - i] : any_byte(self);
    }
    switch (how) {
    case FLIPPED_BITS:
        for (size_t flips = 1U + below(self, 8U); flips > 0U; flips--) {
            piece->bytes[below(self, piece->n)] ^= (uint8_t)(1U << below(self, 8U));
        }
        break;
    case LOST_BYTES:
        replace(piece, at, n, other, 0U);
        break;
    case INSERTED_BYTES:
        replace(piece, at, 0U, other, n);
        break;
    case TRUNCATED:
        piece->n = at;
        break;
    case REPEATED_BYTES:
        memcpy(other, &piece->bytes[at], n);
        replace(piece, at, 0U, other, n);
        break;
    case REVERSED_BYTES:
    case NOISE:
        replace(piece, at, n, other, n);
        break;
    case INSERTED_ZERO:
        other[0] = 0U;
        replace(piece, at, 0U, other, 1U);
        break;
    case SPLICED:
    default:
        if (self->last.n > 0U) {
            const size_t from = below(self, self->last.n);
            replace(piece, at, beyond, &self->last.bytes[from], self->last.n - from);
        }
        break;
    }
}

/// The next frame, corrupted once or twice; it is never what it was.
static piece_t next_piece(line_t* const self) {
    uint8_t* const packet = self->sent[self->turn++ % REMEMBERED];
    draw_packet(self, packet);
    piece_t whole = { .n = 0U };
    whole.n       = frame_encode(ANALOGRIG_CATALOGUE_HASH, packet[0], &packet[1], whole.bytes);
    piece_t piece = whole;
    do {
        corrupt(self, &piece, (corruption_t)below(self, CORRUPTIONS));
        if ((piece.n > 0U) && (below(self, 2U) == 0U)) {
            corrupt(self, &piece, (corruption_t)below(self, CORRUPTIONS));
        }
    } while ((piece.n == whole.n) && (memcmp(piece.bytes, whole.bytes, whole.n) == 0));
    self->last = whole;
    return piece;
}

static bool was_sent(const line_t* const self, const uint8_t* const packet, const size_t n) {
    for (size_t i = 0U; i < REMEMBERED; i++) {
        if (memcmp(self->sent[i], packet, n) == 0) {
            return true;
        }
    }
    return false;
}

/// Corrupts so many frames, and enters them into the decoder. The stream is what came over the line, the packets what the
/// decoder took, one after the other; each has room for frames * piece_max() bytes.
outcome_t line_run(line_t* const self, const size_t frames, uint8_t* const stream, uint8_t* const packets) {
    outcome_t outcome = { 0U, 0U, 0U, 0U, 0U };
    for (size_t i = 0U; i < frames; i++) {
        const piece_t piece = next_piece(self);
        memcpy(&stream[outcome.stream_n], piece.bytes, piece.n);
        outcome.stream_n += piece.n;
        for (size_t k = 0U; k < piece.n; k++) {
            if (!frame_decoder_enter(&self->decoder, piece.bytes[k])) {
                continue;
            }
            const size_t n = 1U + (size_t)analogrig_length(frame_id(&self->decoder));
            memcpy(&packets[outcome.packets_n], self->decoder.bytes, n);
            outcome.packets_n += n;
            outcome.taken++;
            outcome.wrong += was_sent(self, self->decoder.bytes, n) ? 0U : 1U;
        }
    }
    outcome.dropped = frame_dropped(&self->decoder);
    return outcome;
}
