// SPDX-License-Identifier: MIT

#include "device_line.h"
#include "slcan_device.h"

static void init(void* const state, const device_identity_t* const identity) { slcan_device_init(state, identity); }

static device_progress_t
run(void* const state, const uint8_t* const in, const size_t in_n, uint8_t* const out, const size_t out_n) {
    return slcan_device_run(state, in, in_n, out, out_n);
}

const device_line_t slcan_line = { .init = init, .run = run, .block_size = SLCAN_STANDARD_LINE(ANALOGRIG_LENGTH_MAX) };
