/// device: the device under test without its hardware. Bytes go in, bytes come out; the estimator works in between.
///
/// It speaks the messages of estimator_c/catalogue in the frames of frame.h, and never without being asked: each message
/// of the harness has its answers, and a message that cannot be understood has none. It does not wait, and it never holds
/// more than one message: what does not fit into the output stays in the input, so that a slow line slows the harness
/// down and nothing is lost.
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
#include "frame.h"
#include "settings.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/// The most bytes that one step of work answers with: an alarm, a diagnosis, theta, the innovation and Stepped.
#define DEVICE_ANSWER_MAX ((EST_THETA_MAX + 4U) * FRAME_SIZE(8U))

/// Of a gap so many samples are entered as missing, at most. The estimate is the same from the first one on; this bounds
/// the time that one message may take.
#define DEVICE_GAP_MAX 1024U

/// A message that comes again, however late, must not be obeyed twice: one with a sequence number so far behind is one.
#define DEVICE_LATE_MAX 32U

/// Slices of work on a diagnosis with each sample. A sample takes EST_ISOLATION_ONSETS_N of them, and at the alarm up to 24
/// are waiting: with twice as many the diagnosis comes 0.7 samples later than with all of them at once.
#define DEVICE_ISOLATION_SLICES (2U * EST_ISOLATION_ONSETS_N)

/// What a port knows about itself.
typedef struct {
    uint32_t catalogue_hash;  ///< ANALOGRIG_CATALOGUE_HASH; another one makes the device a stranger, for tests
    uint32_t boot_nonce;      ///< another number after every boot
    uint8_t  input_blocks;    ///< so many SampleBlocks may wait in the port's input; at least 1
    uint8_t  firmware_id;     ///< ANALOGRIG_FIRMWARE_FIRMWARE_ID_..._CHOICE
} device_identity_t;

/// Counters since device_init() or RESET. They saturate, they do not wrap.
typedef struct {
    uint32_t sequence_gaps;          ///< messages whose sequence number was not the one after the last
    uint32_t messages_repeated;      ///< messages with one of the last DEVICE_LATE_MAX sequence numbers; ignored
    uint32_t messages_refused;       ///< good frames that made no sense here or now, such as samples before START
    uint32_t samples_lost;           ///< skipped indices
    uint32_t samples_ignored;        ///< samples that came again or late
    uint32_t samples_of_other_runs;  ///< which the line has kept; ignored
    uint32_t receive_overruns;       ///< bytes that the port could not take, as it told
} device_counters_t;

/// What is left to do of the last message. Private.
typedef enum {
    DEVICE_IDLE = 0,
    DEVICE_STEPPING,
    DEVICE_COUNTING,
} device_job_t;

/// The state of a device. The fields are private.
typedef struct {
    device_identity_t identity;
    frame_decoder_t   decoder;
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
    uint8_t           job_next;     ///< sample of the block, or counter
    uint8_t           job_count;    ///< samples in the block
    uint16_t          job_index;    ///< of its first sample
    uint16_t          job_missing;  ///< bit i: its sample i is missing
    uint8_t           job_answers;  ///< sequence number of the message that asked for the counters
} device_t;

typedef struct {
    size_t taken;  ///< bytes of the input that are done with
    size_t given;  ///< bytes written to the output
} device_progress_t;

/// Makes the device ready: default configuration, stopped.
void device_init(device_t* self, const device_identity_t* identity);

/// Works until all input is taken and answered, or until the output has less than DEVICE_ANSWER_MAX bytes left: then call
/// again, with the rest of the input and a new output. Call again too when all input was taken and the output was nearly
/// full: device_is_busy() tells. Input is taken only as far as it could be answered.
/// Cost: per byte O(1); per sample one est_step() and its answers; a gap at most DEVICE_GAP_MAX missing samples on top,
/// for some 100 samples after an alarm DEVICE_ISOLATION_SLICES of est_isolation_work().
device_progress_t device_run(device_t* self, const uint8_t* in, size_t in_n, uint8_t* out, size_t out_n);

/// So many bytes came that the port could not keep. The harness can ask for their sum.
void device_overrun(device_t* self, uint32_t lost_n);

/// Whether answers to input already taken are still to come.
bool device_is_busy(const device_t* self);

/// sizeof(device_t), for callers in other languages.
size_t device_size(void);

#ifdef __cplusplus
}
#endif

#endif  // DEVICE_H_INCLUDED
