// SPDX-License-Identifier: MIT

#include "device_line.h"
#include "serial_device.h"

static void init(void* const state, const device_identity_t* const identity) { serial_device_init(state, identity); }

static device_progress_t
run(void* const state, const uint8_t* const in, const size_t in_n, uint8_t* const out, const size_t out_n) {
    return serial_device_run(state, in, in_n, out, out_n);
}

const device_line_t serial_line = { .init = init, .run = run, .block_size = FRAME_SIZE(ANALOGRIG_LENGTH_MAX) };
