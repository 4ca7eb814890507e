// SPDX-License-Identifier: MIT

#include "serial_device.h"
#include "est_assert.h"

void serial_device_init(serial_device_t* const self, const device_identity_t* const identity) {
    EST_ASSERT(self != 0);
    self->dropped = 0U;
    device_init(&self->device, identity);
    frame_decoder_init(&self->decoder, identity->catalogue_hash);
}

/// Enter bytes up to the end of a message. Return false if they end before. Dropped frames are reported first,
/// because the message may ask for their number.
static bool take_message(serial_device_t* const self, const uint8_t* const in, const size_t in_n, size_t* const taken) {
    bool is_whole = false;
    while (!is_whole && (*taken < in_n)) {
        is_whole = frame_decoder_enter(&self->decoder, in[*taken]);
        (*taken)++;
    }
    if (is_whole) {
        const uint32_t dropped = frame_dropped(&self->decoder);
        device_dropped(&self->device, dropped - self->dropped);
        self->dropped = dropped;
        device_enter(&self->device, frame_id(&self->decoder), frame_payload(&self->decoder));
    }
    return is_whole;
}

device_progress_t serial_device_run(
    serial_device_t* const self, const uint8_t* const in, const size_t in_n, uint8_t* const out, const size_t out_n) {
    EST_ASSERT((self != 0) && ((in != 0) || (in_n == 0U)) && ((out != 0) || (out_n == 0U)));
    const uint32_t    hash     = self->decoder.catalogue_hash;
    device_progress_t progress = { .taken = 0U, .given = 0U };
    while ((out_n - progress.given) >= SERIAL_DEVICE_ANSWER) {
        device_message_t answer;
        if (device_answer(&self->device, &answer)) {
            progress.given += frame_encode(hash, answer.id, answer.payload, &out[progress.given]);
        } else if (!take_message(self, in, in_n, &progress.taken)) {
            break;
        } else {
            // the message may have answers
        }
    }
    return progress;
}

size_t serial_device_size(void) { return sizeof(serial_device_t); }
