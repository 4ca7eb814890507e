// SPDX-License-Identifier: MIT

#include "slcan_device.h"
#include "est_assert.h"

void slcan_device_init(slcan_device_t* const self, const device_identity_t* const identity) {
    EST_ASSERT(self != 0);
    can_device_init(&self->can, identity, true);
    slcan_init(&self->adapter, true);
}

/// Enter a byte, and the frame that it completes. Return the number of bytes of the reply.
static size_t enter(slcan_device_t* const self, const uint8_t byte, uint8_t* const out) {
    slcan_event_t event;
    if (!slcan_enter(&self->adapter, byte, &event)) {
        return 0U;
    }
    if (event.has_frame) {
        can_device_enter(&self->can, &event.frame);
    }
    for (uint8_t i = 0U; i < event.reply_n; i++) {
        out[i] = event.reply[i];
    }
    return event.reply_n;
}

device_progress_t slcan_device_run(
    slcan_device_t* const self, const uint8_t* const in, const size_t in_n, uint8_t* const out, const size_t out_n) {
    EST_ASSERT((self != 0) && ((in != 0) || (in_n == 0U)) && ((out != 0) || (out_n == 0U)));
    device_progress_t progress = { .taken = 0U, .given = 0U };
    while ((out_n - progress.given) >= SLCAN_DEVICE_ANSWER) {
        can_frame_t answer;
        if (can_device_answer(&self->can, &answer)) {
            progress.given += slcan_encode(&self->adapter, &answer, &out[progress.given]);
        } else if (progress.taken < in_n) {
            progress.given += enter(self, in[progress.taken++], &out[progress.given]);
        } else {
            break;
        }
    }
    return progress;
}

size_t slcan_device_size(void) { return sizeof(slcan_device_t); }
