// SPDX-License-Identifier: MIT

#include "can_device.h"
#include "device_line.h"

#include <string.h>

static void init_classic(void* const state, const device_identity_t* const identity) {
    can_device_init(state, identity, false);
}

static void init_fd(void* const state, const device_identity_t* const identity) {
    can_device_init(state, identity, true);
}

/// Run the device on whole frames. Each is copied, because the bytes need not be aligned.
static device_progress_t
run(void* const state, const uint8_t* const in, const size_t in_n, uint8_t* const out, const size_t out_n) {
    device_progress_t progress = { .taken = 0U, .given = 0U };
    while ((out_n - progress.given) >= sizeof(can_frame_t)) {
        can_frame_t frame;
        if (can_device_answer(state, &frame)) {
            (void)memcpy(&out[progress.given], &frame, sizeof(frame));
            progress.given += sizeof(frame);
        } else if ((in_n - progress.taken) >= sizeof(frame)) {
            (void)memcpy(&frame, &in[progress.taken], sizeof(frame));
            progress.taken += sizeof(frame);
            can_device_enter(state, &frame);
        } else {
            break;
        }
    }
    return progress;
}

const device_line_t can_line = { .init = init_classic, .run = run, .block_size = sizeof(can_frame_t) };

const device_line_t can_fd_line = { .init = init_fd, .run = run, .block_size = sizeof(can_frame_t) };
