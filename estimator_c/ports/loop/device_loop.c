// SPDX-License-Identifier: MIT

#include "device_loop.h"

#if (DEVICE_LOOP_INPUT_SIZE < DEVICE_LOOP_LEAST) || (DEVICE_LOOP_OUTPUT_SIZE < DEVICE_LOOP_LEAST)
#error "each of the buffers must hold a frame of any line: DEVICE_LOOP_LEAST bytes"
#endif

/// Bytes on their way from and to the line.
typedef struct {
    uint8_t input[DEVICE_LOOP_INPUT_SIZE];
    size_t  input_from;
    size_t  input_to;
    uint8_t output[DEVICE_LOOP_OUTPUT_SIZE];
    size_t  output_from;
    size_t  output_to;
} buffers_t;

/// True iff new input is wanted: only after the old is processed. Until then it stays in the line and holds up its
/// sender.
static bool wants_input(const device_t* const device, const buffers_t* const buffers) {
    return (buffers->input_from == buffers->input_to) && !device_is_busy(device);
}

static bool has_output(const buffers_t* const buffers) { return buffers->output_from != buffers->output_to; }

static void receive(device_t* const device, buffers_t* const buffers) {
    uint32_t lost       = 0U;
    buffers->input_from = 0U;
    buffers->input_to   = port_receive(buffers->input, sizeof(buffers->input), &lost);
    device_overrun(device, lost);
}

static void transmit(buffers_t* const buffers) {
    buffers->output_from +=
        port_transmit(&buffers->output[buffers->output_from], buffers->output_to - buffers->output_from);
    if (!has_output(buffers)) {
        buffers->output_from = 0U;
        buffers->output_to   = 0U;
    }
}

/// Run the device on the input, as far as its answers have room.
static void work(const device_line_t* const line, void* const state, buffers_t* const buffers) {
    const device_progress_t progress =
        line->run(state, &buffers->input[buffers->input_from], buffers->input_to - buffers->input_from,
                  &buffers->output[buffers->output_to], sizeof(buffers->output) - buffers->output_to);
    buffers->input_from += progress.taken;
    buffers->output_to += progress.given;
}

/// Number of SampleBlocks that fit the input; at least the one that is being processed.
static uint8_t input_blocks(const device_line_t* const line) {
    const size_t room = DEVICE_LOOP_INPUT_SIZE / line->block_size;
    const size_t most = (room < UINT8_MAX) ? room : UINT8_MAX;
    return (uint8_t)((most > 0U) ? most : 1U);
}

void device_loop(const device_line_t* const line,
                 void* const                state,
                 const uint8_t              firmware_id,
                 const uint32_t             catalogue_hash) {
    static buffers_t        buffers;
    device_t* const         device   = state;
    const device_identity_t identity = { .catalogue_hash = catalogue_hash,
                                         .boot_nonce     = port_boot_nonce(),
                                         .input_blocks   = input_blocks(line),
                                         .firmware_id    = firmware_id };
    buffers                          = (buffers_t){ .input_from = 0U };
    line->init(state, &identity);
    bool more = true;
    while (more) {
        if (wants_input(device, &buffers)) {
            receive(device, &buffers);
        }
        work(line, state, &buffers);
        if (has_output(&buffers)) {
            transmit(&buffers);
        }
        // With the output empty, remaining work can go on at once.
        const bool wants = wants_input(device, &buffers);
        if (wants || has_output(&buffers)) {
            more = port_idle(wants, has_output(&buffers));
        }
    }
}
