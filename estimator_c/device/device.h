/// device: the device under test without its hardware. Messages go in, messages come out; the estimator works in between.
///
/// It speaks the messages of estimator_c/catalogue, and never without being asked: each message of the harness has its
/// answers, and a message that cannot be understood has none. It does not wait, and it never holds more than one message:
/// the next one is taken when the last has all its answers, which are made one at a time, as the line has room for them.
/// A slow line slows the harness down and nothing is lost. What a line is made of, bytes or CAN frames, is for the shells
/// to know: serial_device.h, can_device.h, slcan_device.h.
///
///     Identify    -> Hello, Firmware          Configure   -> Configured
///     Control     -> Controlled               Sample      -> [Alarm] [Diagnosis] [Estimate ...] Stepped
///     STATUS      -> Status, one per counter  SampleBlock -> the same for each of its samples
///
/// A sample that is not the next one in the order of its index is never entered: one that comes again or late is ignored,
/// and those skipped by one that comes early are entered as missing. Both are counted.
///
/// No heap, no globals, no recursion, no operating system. The caller owns the state, which belongs to one context.
/// Distributed under the terms of the MIT License.

#ifndef DEVICE_H_INCLUDED
#define DEVICE_H_INCLUDED

#include "est.h"
#include "est_isolation.h"
#include "settings.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Bytes in the payload of every answer: all fit classic CAN.
#define DEVICE_ANSWER_LENGTH 8U

/// Of a gap so many samples are entered as missing, at most. The estimate is the same from the first one on; this bounds
/// the time that one message may take.
#define DEVICE_GAP_MAX 1024U

/// A message that comes again, however late, must not be obeyed twice: one with a sequence number so far behind is one.
#define DEVICE_LATE_MAX 32U

/// Slices of work on a diagnosis with each sample. A sample takes EST_ISOLATION_SLICES_N of them, and at the alarm up to 20,
/// which take less, are waiting: the diagnosis comes 0.6 samples later than with all of them at once.
#define DEVICE_ISOLATION_SLICES 18U

/// What a port knows about itself.
typedef struct {
    uint32_t catalogue_hash;  ///< ANALOGRIG_CATALOGUE_HASH; another one makes the device a stranger, for tests
    uint32_t boot_nonce;      ///< another number after every boot
    uint8_t  input_blocks;    ///< so many SampleBlocks may wait in the port's input; at least 1
    uint8_t  firmware_id;     ///< ANALOGRIG_FIRMWARE_FIRMWARE_ID_..._CHOICE
} device_identity_t;

/// Counters since device_init() or RESET. They saturate, they do not wrap.
typedef struct {
    uint32_t frames_dropped;         ///< what came and was no frame, or not whole, as the shell told
    uint32_t frames_foreign;         ///< frames of others on the same bus, as the shell told
    uint32_t sequence_gaps;          ///< messages whose sequence number was not the one after the last
    uint32_t messages_repeated;      ///< messages with one of the last DEVICE_LATE_MAX sequence numbers; ignored
    uint32_t messages_refused;       ///< good frames that made no sense here or now, such as samples before START
    uint32_t samples_lost;           ///< skipped indices
    uint32_t samples_ignored;        ///< samples that came again or late
    uint32_t samples_of_other_runs;  ///< which the line has kept; ignored
    uint32_t receive_overruns;       ///< bytes that the port could not take, as it told
} device_counters_t;

/// A message of the device.
typedef struct {
    uint8_t id;  ///< of the catalogue
    uint8_t payload[DEVICE_ANSWER_LENGTH];
} device_message_t;

/// How far a shell of the device has come with its input and output, both counted in items: bytes, or frames. Its run function
/// works until all input is taken and answered, or until the output has less room than an answer needs: then call again, with
/// the rest of the input and a new output. Call again too when all input was taken and the output was nearly full:
/// device_is_busy() tells. Input is taken only as far as it could be answered.
/// Cost: per item O(1); per message as device_enter() and device_answer().
typedef struct {
    size_t taken;  ///< of the input: done with
    size_t given;  ///< written to the output
} device_progress_t;

/// What is left to answer of the last message. Private.
typedef enum {
    DEVICE_IDLE = 0,
    DEVICE_GREETING,
    DEVICE_INTRODUCING,
    DEVICE_CONFIGURING,
    DEVICE_CONTROLLING,
    DEVICE_COUNTING,
    DEVICE_STEPPING,
} device_job_t;

/// The state of a device. The fields are private.
typedef struct {
    device_identity_t identity;
    device_counters_t counters;
    settings_t        settings;  ///< what START will use
    est_t             estimator;
    est_isolation_t   isolation;
    bool              isolating;
    uint16_t          alarm_index;
    est_counters_t    stopped;  ///< the estimator's counters when it was stopped; it may have been overwritten since
    bool              running;
    uint8_t           run;  ///< of START
    uint16_t          next_index;
    uint16_t          report_interval_n;
    uint16_t          unreported_n;  ///< samples since the last report
    bool              seq_known;
    uint8_t           seq_expected;  ///< of the next message of the harness
    uint8_t           seq;           ///< of the next message of the device
    device_job_t      job;
    uint8_t           job_answers;   ///< sequence number of the message that is being answered
    uint8_t           job_next;      ///< sample of the block, counter, key or command
    uint8_t           job_result;    ///< of a Configure or Control
    uint32_t          job_argument;  ///< of a Control
    uint8_t           job_count;     ///< samples in the block
    uint16_t          job_index;     ///< of its first sample
    uint16_t          job_missing;   ///< bit i: its sample i is missing
    const uint8_t*    job_payload;   ///< of the block
    uint8_t           to_say;        ///< about the last sample
    uint8_t           element;       ///< of theta, the next to say
    bool              restarted;
    est_step_t        stepped;
} device_t;

/// Makes the device ready: default configuration, stopped.
void device_init(device_t* self, const device_identity_t* identity);

/// Takes a message, when the last one has all its answers (asserted: the device is not busy). Its payload has the length that
/// the catalogue gives to its id, and stays as it is until the device is not busy any more. What makes no sense here or now
/// is refused and counted.
/// Cost: O(1); a Sample one est_step().
void device_enter(device_t* self, uint8_t id, const uint8_t* payload);

/// The next answer to the last message; false if there is none.
/// Cost: O(1), or one est_step() for the first answer about a sample of a block; a gap at most DEVICE_GAP_MAX missing samples
/// on top, for some 100 samples after an alarm DEVICE_ISOLATION_SLICES of est_isolation_work().
bool device_answer(device_t* self, device_message_t* answer);

/// So many bytes came that the port could not keep. The harness can ask for their sum.
void device_overrun(device_t* self, uint32_t lost_n);

/// So many frames were no good: the shell has dropped them.
void device_dropped(device_t* self, uint32_t frames_n);

/// So many frames were those of others on the same bus: the shell has passed over them.
void device_foreign(device_t* self, uint32_t frames_n);

/// Whether there may still be answers to the last message: ask for them before the next one is entered.
bool device_is_busy(const device_t* self);

#ifdef __cplusplus
}
#endif

#endif  // DEVICE_H_INCLUDED
