/// frame: the serial framing of messages.
///
///     0x00 | COBS(identifier, payload, CRC-32C) | 0x00        the checksum little-endian
///
/// COBS (Cheshire and Baker 1999) removes every zero from the content, so that a receiver which has lost its place finds
/// it again at the next zero. The zero before the frame ends whatever was left unfinished. A payload has exactly the
/// length that the catalogue gives to its identifier.
///
/// The register of the checksum starts from the hash of the catalogue, so that a frame of another catalogue is never
/// accepted; only Identify and Hello are exempt, so that such a device can still say what it is.
///
/// No heap, no globals that change, no recursion. The caller owns the decoder. Distributed under the terms of the MIT
/// License.

#ifndef FRAME_H_INCLUDED
#define FRAME_H_INCLUDED

#include "analogrig_catalogue.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Identifier and checksum around a payload of n bytes.
#define FRAME_CONTENT_SIZE(n) ((n) + 5U)

/// A whole frame around a payload of n bytes: one byte of COBS (a content below 254 bytes needs no more), two zeros.
#define FRAME_SIZE(n) (FRAME_CONTENT_SIZE(n) + 3U)

/// What may stand between two zeros, at most.
#define FRAME_ENCODED_MAX (FRAME_CONTENT_SIZE(ANALOGRIG_LENGTH_MAX) + 1U)

/// Collects the bytes of one frame. The fields are private.
typedef struct {
    uint32_t catalogue_hash;
    uint32_t dropped;
    uint8_t  fill;
    bool     overlong;
    uint8_t  bytes[FRAME_ENCODED_MAX];
} frame_decoder_t;

/// CRC-32C (Castagnoli) of n bytes with its register started from the complement of the seed: seed 0 gives the checksum
/// that everybody knows (0xe3069283 for "123456789"), and the checksum of a first part is the seed for a second.
uint32_t frame_crc(uint32_t seed, const uint8_t* bytes, size_t n);

/// Writes the frame of a message that the catalogue knows (asserted); its payload has the length that belongs to it.
/// Returns how many bytes were written: FRAME_SIZE(length).
size_t frame_encode(uint32_t catalogue_hash, uint8_t id, const uint8_t* payload, uint8_t* out);

/// Makes the decoder ready for the first byte. The hash is normally ANALOGRIG_CATALOGUE_HASH.
void frame_decoder_init(frame_decoder_t* self, uint32_t catalogue_hash);

/// Takes one byte. True iff it completed a good frame, which frame_id() and frame_payload() then show until the next byte.
/// Whatever is not a good frame (too long, not COBS, unknown identifier, wrong length or checksum) is dropped as a whole
/// and counted once. Cost: constant, except for a zero after n bytes: O(n).
bool frame_decoder_enter(frame_decoder_t* self, uint8_t byte);

/// Of the frame that the last byte completed.
static inline uint8_t        frame_id(const frame_decoder_t* const self) { return self->bytes[0]; }
static inline const uint8_t* frame_payload(const frame_decoder_t* const self) { return &self->bytes[1]; }

/// How many frames have been dropped. Saturates.
static inline uint32_t frame_dropped(const frame_decoder_t* const self) { return self->dropped; }

#ifdef __cplusplus
}
#endif

#endif  // FRAME_H_INCLUDED
