#include "device_loop.h"

#include "analogrig_codec.h"

#if DEVICE_LOOP_OUTPUT_SIZE < SERIAL_DEVICE_ANSWER
#error "DEVICE_LOOP_OUTPUT_SIZE must hold an answer"
#endif

#define INPUT_BLOCKS (DEVICE_LOOP_INPUT_SIZE / FRAME_SIZE(ANALOGRIG_SAMPLE_BLOCK_LENGTH))

#if (INPUT_BLOCKS < 1) || (INPUT_BLOCKS > 255)
#error "DEVICE_LOOP_INPUT_SIZE must hold 1 to 255 SampleBlocks"
#endif

/// What is on its way from and to the line.
typedef struct {
    uint8_t input[DEVICE_LOOP_INPUT_SIZE];
    size_t  input_from;
    size_t  input_to;
    uint8_t output[DEVICE_LOOP_OUTPUT_SIZE];
    size_t  output_from;
    size_t  output_to;
} buffers_t;

/// New input is taken only when the old is done with: until then it waits in the line, and its sender with it.
static bool wants_input(const serial_device_t* const device, const buffers_t* const buffers) {
    return (buffers->input_from == buffers->input_to) && !serial_device_is_busy(device);
}

static bool has_output(const buffers_t* const buffers) { return buffers->output_from != buffers->output_to; }

static void receive(serial_device_t* const device, buffers_t* const buffers) {
    uint32_t lost       = 0U;
    buffers->input_from = 0U;
    buffers->input_to   = port_receive(buffers->input, sizeof(buffers->input), &lost);
    device_overrun(&device->device, lost);
}

static void transmit(buffers_t* const buffers) {
    buffers->output_from +=
        port_transmit(&buffers->output[buffers->output_from], buffers->output_to - buffers->output_from);
    if (!has_output(buffers)) {
        buffers->output_from = 0U;
        buffers->output_to   = 0U;
    }
}

/// Lets the device work on what has come, as far as its answers have room.
static void work(serial_device_t* const device, buffers_t* const buffers) {
    const serial_progress_t progress =
        serial_device_run(device, &buffers->input[buffers->input_from], buffers->input_to - buffers->input_from,
                   &buffers->output[buffers->output_to], sizeof(buffers->output) - buffers->output_to);
    buffers->input_from += progress.taken;
    buffers->output_to += progress.given;
}

void device_loop(const uint8_t firmware_id, const uint32_t catalogue_hash) {
    static serial_device_t  device;
    static buffers_t        buffers;
    const device_identity_t identity = { .catalogue_hash = catalogue_hash,
                                         .boot_nonce     = port_boot_nonce(),
                                         .input_blocks   = (uint8_t)INPUT_BLOCKS,
                                         .firmware_id    = firmware_id };
    serial_device_init(&device, &identity);
    bool more = true;
    while (more) {
        if (wants_input(&device, &buffers)) {
            receive(&device, &buffers);
        }
        work(&device, &buffers);
        if (has_output(&buffers)) {
            transmit(&buffers);
        }
        // Work that is left over while the output is empty waits for nobody.
        const bool wants = wants_input(&device, &buffers);
        if (wants || has_output(&buffers)) {
            more = port_idle(wants, has_output(&buffers));
        }
    }
}
