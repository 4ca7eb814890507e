// SPDX-License-Identifier: MIT
/// The device as a subject: enter the frame of a sample, and write the frames of its answers.

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "serial_device.h"
#include "subject.h"

#define ANSWERS_N 9U  ///< an alarm, six parameters, the innovation, Stepped

const bool subject_drifts = true;

static serial_device_t device;
static uint8_t         seq;
static uint16_t        sample_index;
static uint8_t         output[(EST_THETA_MAX + 5U) * SERIAL_DEVICE_ANSWER];
static size_t          least_answer;
static size_t          longest_answer;

void device_step(const uint8_t* in, size_t in_n);
void between_steps(void);

/// Begin of the counted part. Inside the counted sections.
__attribute__((noinline, used)) void device_step(const uint8_t* const in, const size_t in_n) {
    const size_t given = serial_device_run(&device, in, in_n, output, sizeof(output)).given;
    least_answer       = (given < least_answer) ? given : least_answer;
    longest_answer     = (given > longest_answer) ? given : longest_answer;
}

/// End of the counted part. The work of the harness follows, which is inside the counted sections too.
__attribute__((noinline, used)) void between_steps(void) { __asm volatile(""); }

static size_t frame_of(const uint8_t id, const uint8_t* const payload, uint8_t* const frame) {
    seq++;
    return frame_encode((uint32_t)ANALOGRIG_CATALOGUE_HASH, id, payload, frame);
}

SUBJECT void subject_begin(void) {
    const device_identity_t identity = { .catalogue_hash = (uint32_t)ANALOGRIG_CATALOGUE_HASH, .input_blocks = 1U };
    const struct analogrig_control_t start = { .seq = seq, .command = ANALOGRIG_CONTROL_COMMAND_START_CHOICE };
    uint8_t                          payload[ANALOGRIG_CONTROL_LENGTH];
    uint8_t                          frame[FRAME_SIZE(ANALOGRIG_CONTROL_LENGTH)];
    serial_device_init(&device, &identity);
    (void)analogrig_control_pack(payload, &start, sizeof(payload));
    const size_t frame_n = frame_of(ANALOGRIG_CONTROL_FRAME_ID, payload, frame);
    (void)serial_device_run(&device, frame, frame_n, output, sizeof(output));
    least_answer = sizeof(output);
}

SUBJECT void subject_enter(const float u, const float y, const bool valid) {
    const struct analogrig_sample_t sample = { .seq          = seq,
                                               .missing      = valid ? 0U : 1U,
                                               .sample_index = sample_index,
                                               .force        = (uint16_t)u,
                                               .displacement = (uint16_t)y };
    uint8_t                         payload[ANALOGRIG_SAMPLE_LENGTH];
    uint8_t                         frame[FRAME_SIZE(ANALOGRIG_SAMPLE_LENGTH)];
    sample_index++;
    (void)analogrig_sample_pack(payload, &sample, sizeof(payload));
    const size_t frame_n = frame_of(ANALOGRIG_SAMPLE_FRAME_ID, payload, frame);
    device_step(frame, frame_n);
    between_steps();
}

/// Check that every sample was answered completely, and one with an alarm.
SUBJECT uint32_t subject_judge(void) {
    return ((least_answer == ((ANSWERS_N - 1U) * FRAME_SIZE(8U))) ? 0U : 1U) |
           ((longest_answer >= (ANSWERS_N * FRAME_SIZE(8U))) ? 0U : 2U);
}
