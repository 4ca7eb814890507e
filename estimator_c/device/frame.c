// SPDX-License-Identifier: MIT

#include "frame.h"
#include "est_assert.h"

#if ANALOGRIG_LENGTH_MAX > 248
#error "a content of more than 253 bytes needs a second byte of COBS, and FRAME_SIZE() knows of one"
#endif

#define CRC_SIZE 4U

uint32_t frame_crc(const uint32_t seed, const uint8_t* const bytes, const size_t n) {
    // Four bits at a time: a sixteenth of the size of a table of bytes.
    static const uint32_t nibbles[16] = {
        0x00000000UL, 0x105ec76fUL, 0x20bd8edeUL, 0x30e349b1UL, 0x417b1dbcUL, 0x5125dad3UL, 0x61c69362UL, 0x7198540dUL,
        0x82f63b78UL, 0x92a8fc17UL, 0xa24bb5a6UL, 0xb21572c9UL, 0xc38d26c4UL, 0xd3d3e1abUL, 0xe330a81aUL, 0xf36e6f75UL,
    };
    uint32_t crc = ~seed;
    for (size_t i = 0U; i < n; i++) {
        crc ^= bytes[i];
        crc = (crc >> 4U) ^ nibbles[crc & 0x0FU];
        crc = (crc >> 4U) ^ nibbles[crc & 0x0FU];
    }
    return ~crc;
}

static uint32_t seed_of(const uint32_t catalogue_hash, const uint8_t id) {
    return analogrig_is_seeded(id) ? catalogue_hash : 0U;
}

// ---------------------------------------------        ENCODING        ---------------------------------------------

/// COBS encoder, byte by byte. A zero becomes the distance to the next zero, filled in once that is known.
typedef struct {
    uint8_t* out;
    size_t   n;
    size_t   code;  ///< position of the distance that is not known yet
} stuffer_t;

static void stuff(stuffer_t* const self, const uint8_t byte) {
    if (byte != 0U) {
        self->out[self->n++] = byte;
        return;
    }
    self->out[self->code] = (uint8_t)(self->n - self->code);
    self->code            = self->n++;
}

size_t frame_encode(const uint32_t catalogue_hash, const uint8_t id, const uint8_t* const payload, uint8_t* const out) {
    const uint8_t length = analogrig_length(id);
    EST_ASSERT((length > 0U) && (payload != 0) && (out != 0));
    uint32_t  crc     = frame_crc(frame_crc(seed_of(catalogue_hash, id), &id, 1U), payload, length);
    stuffer_t stuffer = { .out = out, .n = 2U, .code = 1U };
    out[0]            = 0U;
    stuff(&stuffer, id);
    for (uint8_t i = 0U; i < length; i++) {
        stuff(&stuffer, payload[i]);
    }
    for (uint8_t i = 0U; i < CRC_SIZE; i++) {
        stuff(&stuffer, (uint8_t)(crc & 0xFFU));
        crc >>= 8U;
    }
    stuff(&stuffer, 0U);  // fills in the last distance; the zero that ends the frame takes the place of this one
    out[stuffer.code] = 0U;
    return stuffer.n;
}

// ---------------------------------------------        DECODING        ---------------------------------------------

/// Decode COBS in place; writing never overtakes reading. Return the size of the content, 0 if it is not COBS.
static uint8_t unstuff(uint8_t* const bytes, const uint8_t n) {
    uint8_t in  = 0U;
    uint8_t out = 0U;
    while (in < n) {
        const uint8_t distance = bytes[in++];
        const uint8_t run      = (uint8_t)(distance - 1U);
        if (run > (uint8_t)(n - in)) {
            return 0U;
        }
        for (uint8_t i = 0U; i < run; i++) {
            bytes[out++] = bytes[in++];
        }
        if (in < n) {
            bytes[out++] = 0U;
        }
    }
    return out;
}

static uint32_t little_endian(const uint8_t* const bytes) {
    return (uint32_t)bytes[0] | ((uint32_t)bytes[1] << 8U) | ((uint32_t)bytes[2] << 16U) | ((uint32_t)bytes[3] << 24U);
}

static bool is_good(const frame_decoder_t* const self, const uint8_t size) {
    const uint8_t id     = self->bytes[0];
    const uint8_t length = analogrig_length(id);
    if ((size == 0U) || (length == 0U) || (size != FRAME_CONTENT_SIZE(length))) {
        return false;
    }
    const uint8_t checked = (uint8_t)(size - CRC_SIZE);
    return frame_crc(seed_of(self->catalogue_hash, id), self->bytes, checked) == little_endian(&self->bytes[checked]);
}

/// Handle the bytes before a zero: none (two zeros in a row), a valid frame, or one to drop.
static bool finish(frame_decoder_t* const self) {
    const uint8_t fill     = self->fill;
    const bool    overlong = self->overlong;
    self->fill             = 0U;
    self->overlong         = false;
    if (fill == 0U) {
        return false;
    }
    if (!overlong && is_good(self, unstuff(self->bytes, fill))) {
        return true;
    }
    self->dropped += (self->dropped < UINT32_MAX) ? 1U : 0U;
    return false;
}

void frame_decoder_init(frame_decoder_t* const self, const uint32_t catalogue_hash) {
    EST_ASSERT(self != 0);
    *self = (frame_decoder_t){ .catalogue_hash = catalogue_hash };
}

bool frame_decoder_enter(frame_decoder_t* const self, const uint8_t byte) {
    EST_ASSERT(self != 0);
    if (byte == 0U) {
        return finish(self);
    }
    if (self->fill < FRAME_ENCODED_MAX) {
        self->bytes[self->fill++] = byte;
    } else {
        self->overlong = true;
    }
    return false;
}
