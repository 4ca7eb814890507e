// SPDX-License-Identifier: MIT
/// device: the device under test without its hardware. It receives messages, runs the estimator, and returns answers.
///
/// The messages are those of estimator_c/catalogue. The device sends nothing unasked: each message of the harness has
/// its answers, and a message that cannot be decoded has none. The device never waits and holds at most one message.
/// The next one is entered after the last answer, and answers are made one at a time, when the line has room for
/// them. A slow line thus slows the harness down without losses. The shells adapt the device to a kind of line, bytes
/// or CAN frames: serial_device.h, can_device.h, slcan_device.h.
///
///     Identify    -> Hello, Firmware          Configure   -> Configured
///     Control     -> Controlled               Sample      -> [Alarm] [Diagnosis] [Misfit] [Estimate ...] Stepped
///     STATUS      -> Status, one per counter  SampleBlock -> the same for each of its samples
///
/// Samples are entered in the order of their index. A repeated or late sample is ignored; indices skipped by an early
/// sample are entered as missing. Both are counted.
///
/// No heap, no globals, no recursion, no operating system. The caller owns the state, which belongs to one context.
/// Distributed under the terms of the MIT License.

#ifndef DEVICE_H_INCLUDED
#define DEVICE_H_INCLUDED

#include "est.h"
#include "est_fit.h"
#include "est_isolation.h"
#include "settings.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// Bytes in the payload of every answer, chosen to fit classic CAN.
#define DEVICE_ANSWER_LENGTH 8U

/// Maximum number of samples of a gap that are entered as missing. It bounds the time per message; the estimate
/// depends on the first one only.
#define DEVICE_GAP_MAX 1024U

/// Number of recent sequence numbers that mark a message as repeated. A repeated message must not be executed twice.
#define DEVICE_LATE_MAX 32U

/// Slices of work on a diagnosis per sample. Up to 20 samples wait at the alarm, which take 55; then every second or
/// third sample is weighed. The diagnosis is 3 samples later than with unlimited work.
#define DEVICE_ISOLATION_SLICES 12U

/// Properties of a port.
typedef struct {
    uint32_t catalogue_hash;  ///< ANALOGRIG_CATALOGUE_HASH; tests use others to simulate a foreign device
    uint32_t boot_nonce;      ///< a different number after every boot
    uint8_t  input_blocks;    ///< number of SampleBlocks that fit the input of the port; at least 1
    uint8_t  firmware_id;     ///< ANALOGRIG_FIRMWARE_FIRMWARE_ID_..._CHOICE
} device_identity_t;

/// Counters since device_init() or RESET. They saturate instead of wrapping.
typedef struct {
    uint32_t frames_dropped;         ///< malformed or incomplete frames, reported by the shell
    uint32_t frames_foreign;         ///< frames of other nodes on the bus, reported by the shell
    uint32_t sequence_gaps;          ///< messages whose sequence number does not follow the last one
    uint32_t messages_repeated;      ///< messages with one of the last DEVICE_LATE_MAX sequence numbers; ignored
    uint32_t messages_refused;       ///< messages that are invalid in the present state, such as samples before START
    uint32_t samples_lost;           ///< skipped indices
    uint32_t samples_ignored;        ///< repeated or late samples
    uint32_t samples_of_other_runs;  ///< samples of an earlier run that the line had stored; ignored
    uint32_t receive_overruns;       ///< bytes that the port could not store, reported by the port
} device_counters_t;

/// An answer of the device.
typedef struct {
    uint8_t id;  ///< identifier of the catalogue
    uint8_t payload[DEVICE_ANSWER_LENGTH];
} device_message_t;

/// Progress of a shell through its input and output, counted in items: bytes or frames. The run function of a shell
/// works until all input is answered, or until the output has less room than an answer needs. Call it again with the
/// rest of the input and a new output; also when all input was taken but device_is_busy(). Input is taken only as far
/// as it can be answered. Cost: O(1) per item, plus device_enter() and device_answer() per message.
typedef struct {
    size_t taken;  ///< items of the input that are processed
    size_t given;  ///< items written to the output
} device_progress_t;

/// The message that is being answered. Private.
typedef enum {
    DEVICE_IDLE = 0,
    DEVICE_GREETING,
    DEVICE_INTRODUCING,
    DEVICE_CONFIGURING,
    DEVICE_CONTROLLING,
    DEVICE_COUNTING,
    DEVICE_STEPPING,
} device_job_t;

/// State of a device. The fields are private.
typedef struct {
    device_identity_t identity;
    device_counters_t counters;
    settings_t        settings;  ///< configuration for the next START
    est_t             estimator;
    est_isolation_t   isolation;
    bool              isolating;
    uint16_t          alarm_index;
    est_counters_t    stopped;  ///< counters of the estimator at the last STOP; a later START overwrites the estimator
    bool              running;
    uint8_t           run;  ///< identifier of the run, from START
    uint16_t          next_index;
    uint16_t          report_interval_n;
    uint16_t          unreported_n;  ///< samples since the last report
    bool              seq_known;
    uint8_t           seq_expected;  ///< sequence number of the next message of the harness
    uint8_t           seq;           ///< sequence number of the next answer
    device_job_t      job;
    uint8_t           job_answers;   ///< sequence number of the message that is being answered
    uint8_t           job_next;      ///< next sample of the block, or next counter; or the key, or the command
    uint8_t           job_result;    ///< result of a Configure or Control
    uint32_t          job_argument;  ///< argument of a Control
    uint8_t           job_count;     ///< samples in the block
    uint16_t          job_index;     ///< index of the first sample of the block
    uint16_t          job_missing;   ///< bit i is set if sample i of the block is missing
    const uint8_t*    job_payload;   ///< payload of the block
    uint8_t           due;           ///< answers still due for the last sample
    uint8_t           element;       ///< next element of theta to report
    bool              restarted;
    est_step_t        stepped;
#if DEVICE_WITH_FIT
    est_fit_watch_t   fit;
    bool              watching;
    est_misfit_kind_t reported;  ///< last cause of a misfit
#endif
} device_t;

/// Prepare the device: default configuration, stopped. Cost: as est_init().
void device_init(device_t* self, const device_identity_t* identity);

/// Enter a message. The device must not be busy (asserted). The payload has the length that the catalogue assigns to
/// the id, and must stay unchanged until the device is no longer busy. A message that is invalid in the present state
/// is counted in messages_refused. Cost: O(1); for a Sample one est_step().
void device_enter(device_t* self, uint8_t id, const uint8_t* payload);

/// Write the next answer to the last message. Return false if there is none.
/// Cost: O(1); for the first answer to each sample of a block one est_step(), and up to DEVICE_GAP_MAX more after a
/// gap. For some 100 samples after an alarm, DEVICE_ISOLATION_SLICES calls of est_isolation_work() on top.
bool device_answer(device_t* self, device_message_t* answer);

/// Report bytes that the port received but could not store. STATUS returns their sum.
void device_overrun(device_t* self, uint32_t lost_n);

/// Report malformed frames that the shell has dropped.
void device_dropped(device_t* self, uint32_t frames_n);

/// Report frames of other nodes on the bus that the shell has skipped.
void device_foreign(device_t* self, uint32_t frames_n);

/// True iff the last message may still have answers. Take them before the next device_enter().
bool device_is_busy(const device_t* self);

#ifdef __cplusplus
}
#endif

#endif  // DEVICE_H_INCLUDED
