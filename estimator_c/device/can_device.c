// SPDX-License-Identifier: MIT

#include "can_device.h"
#include "est_assert.h"

#if ANALOGRIG_LENGTH_MAX > CAN_FRAME_MAX
#error "a message of the catalogue is longer than a frame"
#endif

void can_device_init(can_device_t* const self, const device_identity_t* const identity, const bool is_fd) {
    EST_ASSERT(self != 0);
    *self = (can_device_t){ .is_fd = is_fd };
    device_init(&self->device, identity);
}

/// True iff the frame may be a message of the harness: a data frame with an identifier of one.
static bool is_ours(const can_frame_t* const frame) {
    return ((frame->flags | CAN_FRAME_FD) == CAN_FRAME_FD) && (frame->id <= UINT8_MAX) &&
           analogrig_is_from_harness((uint8_t)frame->id);
}

/// True iff the frame has the length of its message. A message of more than eight bytes needs CAN FD.
static bool is_whole(const can_device_t* const self, const can_frame_t* const frame) {
    const bool is_fd = (frame->flags & CAN_FRAME_FD) != 0U;
    return (frame->length == analogrig_length((uint8_t)frame->id)) &&
           (is_fd ? self->is_fd : (frame->length <= CAN_FRAME_CLASSIC_MAX));
}

void can_device_enter(can_device_t* const self, const can_frame_t* const frame) {
    EST_ASSERT((self != 0) && (frame != 0));
    if ((frame->flags & CAN_FRAME_ERROR) != 0U) {
        return;  // an error report, not a frame
    }
    if (!is_ours(frame)) {
        device_foreign(&self->device, 1U);
    } else if (!is_whole(self, frame)) {
        device_dropped(&self->device, 1U);
    } else {
        for (uint8_t i = 0U; i < frame->length; i++) {
            self->payload[i] = frame->data[i];
        }
        device_enter(&self->device, (uint8_t)frame->id, self->payload);
    }
}

bool can_device_answer(can_device_t* const self, can_frame_t* const answer) {
    EST_ASSERT((self != 0) && (answer != 0));
    device_message_t message;
    if (!device_answer(&self->device, &message)) {
        return false;
    }
    *answer = (can_frame_t){ .id = message.id, .length = DEVICE_ANSWER_LENGTH };
    for (uint8_t i = 0U; i < DEVICE_ANSWER_LENGTH; i++) {
        answer->data[i] = message.payload[i];
    }
    return true;
}

device_progress_t can_device_run(can_device_t* const      self,
                                 const can_frame_t* const in,
                                 const size_t             in_n,
                                 can_frame_t* const       out,
                                 const size_t             out_n) {
    EST_ASSERT((self != 0) && ((in != 0) || (in_n == 0U)) && ((out != 0) || (out_n == 0U)));
    device_progress_t progress = { .taken = 0U, .given = 0U };
    while (progress.given < out_n) {
        if (can_device_answer(self, &out[progress.given])) {
            progress.given++;
        } else if (progress.taken < in_n) {
            can_device_enter(self, &in[progress.taken++]);
        } else {
            break;
        }
    }
    return progress;
}

size_t can_device_size(void) { return sizeof(can_device_t); }
