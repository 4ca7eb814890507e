// SPDX-License-Identifier: MIT
/// frame: serial framing of messages.
///
///     0x00 | COBS(identifier, payload, CRC-32C) | 0x00        checksum little-endian
///
/// COBS (Cheshire and Baker 1999) removes every zero from the content. A receiver that has lost synchronisation
/// regains it at the next zero. The zero before the frame ends any unfinished frame. The payload has the length that
/// the catalogue assigns to the identifier.
///
/// The CRC register starts from the hash of the catalogue, so that a frame of a different catalogue is never accepted.
/// Identify and Hello are exempt: devices with a different catalogue can still identify themselves.
///
/// No heap, no mutable globals, no recursion. The caller owns the decoder.
/// Distributed under the terms of the MIT License.

#ifndef FRAME_H_INCLUDED
#define FRAME_H_INCLUDED

#include "analogrig_catalogue.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Size of identifier, checksum and a payload of n bytes.
#define FRAME_CONTENT_SIZE(n) ((n) + 5U)

/// Size of a frame with a payload of n bytes: one byte of COBS, which suffices below 254 bytes, and two zeros.
#define FRAME_SIZE(n) (FRAME_CONTENT_SIZE(n) + 3U)

/// Maximum number of bytes between two zeros.
#define FRAME_ENCODED_MAX (FRAME_CONTENT_SIZE(ANALOGRIG_LENGTH_MAX) + 1U)

/// Decoder of one frame at a time. The fields are private.
typedef struct {
    uint32_t catalogue_hash;
    uint32_t dropped;
    uint8_t  fill;
    bool     overlong;
    uint8_t  bytes[FRAME_ENCODED_MAX];
} frame_decoder_t;

/// CRC-32C (Castagnoli) of n bytes. Seed 0 gives the standard checksum: 0xe3069283 for "123456789". The checksum of a
/// first part is the seed for a second. Cost: O(n).
uint32_t frame_crc(uint32_t seed, const uint8_t* bytes, size_t n);

/// Write the frame of a message that the catalogue contains (asserted). The payload has the length of its identifier.
/// Return the number of bytes written: FRAME_SIZE(length). Cost: O(length).
size_t frame_encode(uint32_t catalogue_hash, uint8_t id, const uint8_t* payload, uint8_t* out);

/// Prepare the decoder for the first byte. The hash is normally ANALOGRIG_CATALOGUE_HASH.
void frame_decoder_init(frame_decoder_t* self, uint32_t catalogue_hash);

/// Enter one byte. Return true iff it completes a valid frame, which frame_id() and frame_payload() show until the
/// next byte. An invalid frame (too long, not COBS, unknown identifier, wrong length or checksum) is dropped and
/// counted once. Cost: constant; for a zero after n bytes O(n).
bool frame_decoder_enter(frame_decoder_t* self, uint8_t byte);

/// Identifier and payload of the frame that the last byte completed.
static inline uint8_t        frame_id(const frame_decoder_t* const self) { return self->bytes[0]; }
static inline const uint8_t* frame_payload(const frame_decoder_t* const self) { return &self->bytes[1]; }

/// Number of frames dropped. Saturates.
static inline uint32_t frame_dropped(const frame_decoder_t* const self) { return self->dropped; }

#ifdef __cplusplus
}
#endif

#endif  // FRAME_H_INCLUDED
