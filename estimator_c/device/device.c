#include "device.h"

#include "analogrig_codec.h"
#include "settings.h"

#ifndef DEVICE_ASSERT
#ifdef NDEBUG  // a freestanding compiler has no assert.h
#define DEVICE_ASSERT(x) ((void)0)
#else
#include <assert.h>
#define DEVICE_ASSERT(x) assert(x)  // NOLINT(cppcoreguidelines-macro-usage)
#endif
#endif

#if ANALOGRIG_SAMPLE_BLOCK_FORCE_N > 16
#error "the mask of missing samples has 16 bits"
#endif

#define RUN_MAX 7U      ///< of the run ids, which have three bits
#define PAYLOAD_MAX 8U  ///< of an answer; all fit classic CAN

#define COUNTER_FIRST ANALOGRIG_STATUS_COUNTER_UPDATED_CHOICE
#define COUNTER_LAST ANALOGRIG_STATUS_COUNTER_RECEIVE_OVERRUNS_CHOICE

/// Where the answers of one step of work go.
typedef struct {
    uint8_t* bytes;
    size_t   n;
} answer_t;

static void add(uint32_t* const counter, const uint32_t n) {
    *counter = (*counter < (UINT32_MAX - n)) ? (*counter + n) : UINT32_MAX;
}

static uint16_t word(const uint8_t* const bytes) { return (uint16_t)(bytes[0] | ((uint32_t)bytes[1] << 8U)); }

// ---------------------------------------------        ANSWERS         ---------------------------------------------

static void put(device_t* const self, answer_t* const answer, const uint8_t id, const uint8_t* const payload) {
    answer->n += frame_encode(self->identity.catalogue_hash, id, payload, &answer->bytes[answer->n]);
    self->seq++;
}

static void put_hello(device_t* const self, answer_t* const answer, const uint8_t answers) {
    const struct analogrig_hello_t message = { .seq            = self->seq,
                                               .theta_max      = EST_THETA_MAX,
                                               .answers        = answers,
                                               .catalogue_hash = self->identity.catalogue_hash };
    uint8_t                        payload[PAYLOAD_MAX];
    (void)analogrig_hello_pack(payload, &message, sizeof(payload));
    put(self, answer, ANALOGRIG_HELLO_FRAME_ID, payload);
}

static void put_firmware(device_t* const self, answer_t* const answer, const uint8_t answers) {
    const struct analogrig_firmware_t message = { .seq          = self->seq,
                                                  .firmware_id  = self->identity.firmware_id,
                                                  .answers      = answers,
                                                  .input_blocks = self->identity.input_blocks,
                                                  .boot_nonce   = self->identity.boot_nonce };
    uint8_t                           payload[PAYLOAD_MAX];
    (void)analogrig_firmware_pack(payload, &message, sizeof(payload));
    put(self, answer, ANALOGRIG_FIRMWARE_FRAME_ID, payload);
}

static void put_estimate(device_t* const self, answer_t* const answer, const uint8_t element, const float value) {
    const struct analogrig_estimate_t message = {
        .seq = self->seq, .element = element, .sample_index = self->next_index, .value = value
    };
    uint8_t payload[PAYLOAD_MAX];
    (void)analogrig_estimate_pack(payload, &message, sizeof(payload));
    put(self, answer, ANALOGRIG_ESTIMATE_FRAME_ID, payload);
}

static void put_alarm(device_t* const self, answer_t* const answer, const float statistic) {
    const struct analogrig_alarm_t message = { .seq          = self->seq,
                                               .trigger      = (uint8_t)self->settings.estimator.trigger.kind,
                                               .sample_index = self->next_index,
                                               .statistic    = statistic };
    uint8_t                        payload[PAYLOAD_MAX];
    (void)analogrig_alarm_pack(payload, &message, sizeof(payload));
    put(self, answer, ANALOGRIG_ALARM_FRAME_ID, payload);
}

static void put_diagnosis(device_t* const self, answer_t* const answer, const est_diagnosis_t* const diagnosis) {
    const struct analogrig_diagnosis_t message = { .seq         = self->seq,
                                                   .change      = (uint8_t)diagnosis->change,
                                                   .onset_index = (uint16_t)(self->alarm_index - diagnosis->onset_n),
                                                   .extent      = diagnosis->extent };
    uint8_t                            payload[PAYLOAD_MAX];
    (void)analogrig_diagnosis_pack(payload, &message, sizeof(payload));
    put(self, answer, ANALOGRIG_DIAGNOSIS_FRAME_ID, payload);
}

static void put_stepped(device_t* const self, answer_t* const answer, const est_step_t* step, const bool restarted) {
    const struct analogrig_stepped_t message = { .seq          = self->seq,
                                                 .missing      = (step->status == EST_MISSING) ? 1U : 0U,
                                                 .refused      = (step->status == EST_REFUSED) ? 1U : 0U,
                                                 .restarted    = restarted ? 1U : 0U,
                                                 .gathering    = (step->status == EST_GATHERING) ? 1U : 0U,
                                                 .idle         = step->idle ? 1U : 0U,
                                                 .run          = self->run,
                                                 .sample_index = self->next_index,
                                                 .statistic    = step->statistic };
    uint8_t                          payload[PAYLOAD_MAX];
    (void)analogrig_stepped_pack(payload, &message, sizeof(payload));
    put(self, answer, ANALOGRIG_STEPPED_FRAME_ID, payload);
}

// ---------------------------------------------        SAMPLES         ---------------------------------------------

static est_step_t step(device_t* const self, const est_sample_t sample) {
    const est_step_t out = est_step(&self->estimator, sample);
    if (self->isolating) {
        est_isolation_enter(&self->isolation, &self->estimator, sample, out);
    }
    return out;
}

/// Works on the diagnosis of the last alarm, if there is one to come, and says it once.
static void isolate(device_t* const self, answer_t* const answer) {
    const est_change_t before = est_isolation_diagnosis(&self->isolation).change;
    for (uint8_t i = 0U; (i < DEVICE_ISOLATION_SLICES) && est_isolation_work(&self->isolation); i++) {
    }
    const est_diagnosis_t diagnosis = est_isolation_diagnosis(&self->isolation);
    if (diagnosis.change != before) {
        put_diagnosis(self, answer, &diagnosis);
    }
}

static void enter_gap(device_t* const self, const uint16_t lost_n) {
    const est_sample_t missing = { .u = 0.0F, .y = 0.0F, .valid = false };
    for (uint16_t i = 0U; (i < lost_n) && (i < DEVICE_GAP_MAX); i++) {
        (void)step(self, missing);
    }
    add(&self->counters.samples_lost, lost_n);
    self->next_index   = (uint16_t)(self->next_index + lost_n);
    self->unreported_n = (uint16_t)(((uint32_t)self->unreported_n + lost_n) % self->report_interval_n);
}

static void report(device_t* const self, answer_t* const answer, const float innovation) {
    self->unreported_n++;
    if (self->unreported_n < self->report_interval_n) {
        return;
    }
    self->unreported_n = 0U;
    for (uint8_t i = 0U; i < est_theta_count(&self->estimator); i++) {
        put_estimate(self, answer, i, est_theta(&self->estimator, i));
    }
    put_estimate(self, answer, ANALOGRIG_ESTIMATE_ELEMENT_INNOVATION_CHOICE, innovation);
}

static void
enter_sample(device_t* const self, answer_t* const answer, const uint16_t index, const est_sample_t sample) {
    const uint16_t ahead = (uint16_t)(index - self->next_index);
    if (ahead > (UINT16_MAX / 2U)) {
        add(&self->counters.samples_ignored, 1U);
        return;
    }
    if (ahead > 0U) {
        enter_gap(self, ahead);
    }
    const uint32_t   restarts = est_counters(&self->estimator).restarts;
    const est_step_t stepped  = step(self, sample);
    if (stepped.alarm) {
        self->alarm_index = self->next_index;
        put_alarm(self, answer, stepped.statistic);
    }
    if (self->isolating) {
        isolate(self, answer);
    }
    report(self, answer, stepped.innovation);
    put_stepped(self, answer, &stepped, est_counters(&self->estimator).restarts != restarts);
    self->next_index++;
}

/// Counts samples that cannot be entered.
static bool accepts_samples(device_t* const self, const uint8_t run, const uint8_t samples) {
    if (!self->running || (samples < 1U) || (samples > ANALOGRIG_SAMPLE_BLOCK_FORCE_N)) {
        add(&self->counters.messages_refused, 1U);
        return false;
    }
    if (run != self->run) {
        add(&self->counters.samples_of_other_runs, samples);
        return false;
    }
    return true;
}

static void on_sample(device_t* const self, answer_t* const answer, const uint8_t* const payload) {
    struct analogrig_sample_t message;
    (void)analogrig_sample_unpack(&message, payload, ANALOGRIG_SAMPLE_LENGTH);
    if (!accepts_samples(self, message.run, 1U)) {
        return;
    }
    const est_sample_t sample = { .u     = (float)message.force,
                                  .y     = (float)message.displacement,
                                  .valid = message.missing == 0U };
    enter_sample(self, answer, message.sample_index, sample);
}

static void on_sample_block(device_t* const self, const uint8_t* const payload) {
    struct analogrig_sample_block_t block;
    (void)analogrig_sample_block_unpack(&block, payload, ANALOGRIG_SAMPLE_BLOCK_LENGTH);
    if (!accepts_samples(self, block.run, block.samples)) {
        return;
    }
    self->job         = DEVICE_STEPPING;
    self->job_next    = 0U;
    self->job_count   = block.samples;
    self->job_index   = block.sample_index;
    self->job_missing = block.missing;
}

/// The next sample of the block that still lies in the decoder. The codec has a name for each of its codes, no array.
static void step_block(device_t* const self, answer_t* const answer) {
    const uint8_t* const payload = frame_payload(&self->decoder);
    const uint8_t        i       = self->job_next;
    const uint8_t* const force =
        &payload[ANALOGRIG_SAMPLE_BLOCK_FORCE_BYTE + (i * ANALOGRIG_SAMPLE_BLOCK_FORCE_STRIDE)];
    const uint8_t* const displacement =
        &payload[ANALOGRIG_SAMPLE_BLOCK_DISPLACEMENT_BYTE + (i * ANALOGRIG_SAMPLE_BLOCK_DISPLACEMENT_STRIDE)];
    const est_sample_t sample = { .u     = (float)word(force),
                                  .y     = (float)word(displacement),
                                  .valid = (((uint32_t)self->job_missing >> i) & 1U) == 0U };
    enter_sample(self, answer, (uint16_t)(self->job_index + i), sample);
    self->job_next++;
    if (self->job_next == self->job_count) {
        self->job = DEVICE_IDLE;
    }
}

// ---------------------------------------------     CONFIGURATION      ---------------------------------------------

static uint8_t configure(device_t* const self, const uint8_t key, const float value) {
    if (self->running) {
        return ANALOGRIG_CONFIGURED_RESULT_RUNNING_CHOICE;
    }
    switch (settings_set(&self->settings, key, value)) {
    case SETTINGS_APPLIED:
        return ANALOGRIG_CONFIGURED_RESULT_APPLIED_CHOICE;
    case SETTINGS_OUT_OF_RANGE:
        return ANALOGRIG_CONFIGURED_RESULT_OUT_OF_RANGE_CHOICE;
    case SETTINGS_UNKNOWN:
    default:
        return ANALOGRIG_CONFIGURED_RESULT_UNKNOWN_CHOICE;
    }
}

static void on_configure(device_t* const self, answer_t* const answer, const uint8_t* const payload) {
    struct analogrig_configure_t message;
    (void)analogrig_configure_unpack(&message, payload, ANALOGRIG_CONFIGURE_LENGTH);
    const uint8_t                       result  = configure(self, message.key, message.value);
    const struct analogrig_configured_t applied = {
        .seq     = self->seq,
        .key     = message.key,
        .answers = message.seq,
        .result  = result,
        .value   = settings_get(&self->settings, message.key),
    };
    uint8_t out[PAYLOAD_MAX];
    (void)analogrig_configured_pack(out, &applied, sizeof(out));
    put(self, answer, ANALOGRIG_CONFIGURED_FRAME_ID, out);
}

// ---------------------------------------------        CONTROL         ---------------------------------------------

/// As after device_init(), except for the identity, the input and the sequence numbers.
static void reset(device_t* const self) {
    frame_decoder_init(&self->decoder, self->identity.catalogue_hash);
    self->counters          = (device_counters_t){ 0 };
    self->stopped           = (est_counters_t){ 0 };
    self->settings          = settings_default();
    self->running           = false;
    self->report_interval_n = 1U;
    (void)est_init(&self->estimator, &self->settings.estimator);
}

static uint8_t start(device_t* const self, const uint32_t run) {
    if (self->running) {
        return ANALOGRIG_CONTROLLED_RESULT_RUNNING_CHOICE;
    }
    if ((run > RUN_MAX) || !est_init(&self->estimator, &self->settings.estimator)) {
        return ANALOGRIG_CONTROLLED_RESULT_OUT_OF_RANGE_CHOICE;
    }
    self->isolating = est_isolation_init(&self->isolation, &self->settings.estimator, self->settings.force_zero) &&
                      self->settings.isolation;
    self->running      = true;
    self->run          = (uint8_t)run;
    self->next_index   = 0U;
    self->unreported_n = 0U;
    return ANALOGRIG_CONTROLLED_RESULT_APPLIED_CHOICE;
}

static void stop(device_t* const self) {
    if (self->running) {
        self->stopped = est_counters(&self->estimator);
        self->running = false;
    }
}

static uint8_t set_report_interval(device_t* const self, const uint32_t interval_n) {
    if ((interval_n < 1U) || (interval_n > UINT16_MAX)) {
        return ANALOGRIG_CONTROLLED_RESULT_OUT_OF_RANGE_CHOICE;
    }
    self->report_interval_n = (uint16_t)interval_n;
    self->unreported_n      = 0U;
    return ANALOGRIG_CONTROLLED_RESULT_APPLIED_CHOICE;
}

static uint8_t control(device_t* const self, const uint8_t command, const uint32_t argument) {
    switch (command) {
    case ANALOGRIG_CONTROL_COMMAND_START_CHOICE:
        return start(self, argument);
    case ANALOGRIG_CONTROL_COMMAND_STOP_CHOICE:
        stop(self);
        return ANALOGRIG_CONTROLLED_RESULT_APPLIED_CHOICE;
    case ANALOGRIG_CONTROL_COMMAND_RESET_CHOICE:
        reset(self);
        return ANALOGRIG_CONTROLLED_RESULT_APPLIED_CHOICE;
    case ANALOGRIG_CONTROL_COMMAND_REPORT_INTERVAL_CHOICE:
        return set_report_interval(self, argument);
    default:
        return ANALOGRIG_CONTROLLED_RESULT_UNKNOWN_CHOICE;
    }
}

static void on_control(device_t* const self, answer_t* const answer, const uint8_t* const payload) {
    struct analogrig_control_t message;
    (void)analogrig_control_unpack(&message, payload, ANALOGRIG_CONTROL_LENGTH);
    if (message.command == ANALOGRIG_CONTROL_COMMAND_STATUS_CHOICE) {
        self->job         = DEVICE_COUNTING;
        self->job_next    = COUNTER_FIRST;
        self->job_answers = message.seq;
        return;
    }
    const uint8_t                       result = control(self, message.command, message.argument);
    const struct analogrig_controlled_t done   = { .seq      = self->seq,
                                                   .command  = message.command,
                                                   .answers  = message.seq,
                                                   .result   = result,
                                                   .argument = message.argument };
    uint8_t                             out[PAYLOAD_MAX];
    (void)analogrig_controlled_pack(out, &done, sizeof(out));
    put(self, answer, ANALOGRIG_CONTROLLED_FRAME_ID, out);
}

static uint32_t counter_value(const device_t* const self, const uint8_t counter) {
    const est_counters_t estimator = self->running ? est_counters(&self->estimator) : self->stopped;
    switch (counter) {
    case ANALOGRIG_STATUS_COUNTER_UPDATED_CHOICE:
        return estimator.updated;
    case ANALOGRIG_STATUS_COUNTER_MISSING_CHOICE:
        return estimator.missing;
    case ANALOGRIG_STATUS_COUNTER_REFUSED_CHOICE:
        return estimator.refused;
    case ANALOGRIG_STATUS_COUNTER_ALARMS_CHOICE:
        return estimator.alarms;
    case ANALOGRIG_STATUS_COUNTER_RESTARTS_CHOICE:
        return estimator.restarts;
    case ANALOGRIG_STATUS_COUNTER_SLIPS_CHOICE:
        return estimator.slips;
    case ANALOGRIG_STATUS_COUNTER_SATURATED_CHOICE:
        return estimator.saturated;
    case ANALOGRIG_STATUS_COUNTER_STUCK_CHOICE:
        return estimator.stuck;
    case ANALOGRIG_STATUS_COUNTER_REFRESHES_CHOICE:
        return estimator.refreshes;
    case ANALOGRIG_STATUS_COUNTER_FRAMES_DROPPED_CHOICE:
        return frame_dropped(&self->decoder);
    case ANALOGRIG_STATUS_COUNTER_SEQUENCE_GAPS_CHOICE:
        return self->counters.sequence_gaps;
    case ANALOGRIG_STATUS_COUNTER_MESSAGES_REPEATED_CHOICE:
        return self->counters.messages_repeated;
    case ANALOGRIG_STATUS_COUNTER_MESSAGES_REFUSED_CHOICE:
        return self->counters.messages_refused;
    case ANALOGRIG_STATUS_COUNTER_SAMPLES_LOST_CHOICE:
        return self->counters.samples_lost;
    case ANALOGRIG_STATUS_COUNTER_SAMPLES_IGNORED_CHOICE:
        return self->counters.samples_ignored;
    case ANALOGRIG_STATUS_COUNTER_SAMPLES_OF_OTHER_RUNS_CHOICE:
        return self->counters.samples_of_other_runs;
    case ANALOGRIG_STATUS_COUNTER_RECEIVE_OVERRUNS_CHOICE:
        return self->counters.receive_overruns;
    default:
        return 0U;
    }
}

static void put_counter(device_t* const self, answer_t* const answer) {
    const struct analogrig_status_t message = { .seq     = self->seq,
                                                .counter = self->job_next,
                                                .answers = self->job_answers,
                                                .value   = counter_value(self, self->job_next) };
    uint8_t                         payload[PAYLOAD_MAX];
    (void)analogrig_status_pack(payload, &message, sizeof(payload));
    put(self, answer, ANALOGRIG_STATUS_FRAME_ID, payload);
    if (self->job_next == COUNTER_LAST) {
        self->job = DEVICE_IDLE;
    }
    self->job_next++;
}

// ---------------------------------------------        MESSAGES        ---------------------------------------------

/// Every message is numbered. One with the number of any of the last ones is a repetition, which must not be obeyed twice;
/// false for that. Identify begins a conversation, so its number is any.
static bool sequence_allows(device_t* const self, const uint8_t id, const uint8_t seq) {
    const bool    begins = (id == ANALOGRIG_IDENTIFY_FRAME_ID) || !self->seq_known;
    const uint8_t behind = (uint8_t)(self->seq_expected - seq);
    if (!begins && (behind >= 1U) && (behind <= DEVICE_LATE_MAX)) {
        add(&self->counters.messages_repeated, 1U);
        return false;
    }
    if (!begins && (seq != self->seq_expected)) {
        add(&self->counters.sequence_gaps, 1U);
    }
    self->seq_known    = true;
    self->seq_expected = (uint8_t)(seq + 1U);
    return true;
}

static void on_message(device_t* const self, answer_t* const answer) {
    const uint8_t        id      = frame_id(&self->decoder);
    const uint8_t* const payload = frame_payload(&self->decoder);
    if (!analogrig_is_from_harness(id)) {
        add(&self->counters.messages_refused, 1U);
        return;
    }
    if (!sequence_allows(self, id, payload[0])) {
        return;
    }
    switch (id) {
    case ANALOGRIG_IDENTIFY_FRAME_ID:
        put_hello(self, answer, payload[0]);
        put_firmware(self, answer, payload[0]);
        break;
    case ANALOGRIG_CONTROL_FRAME_ID:
        on_control(self, answer, payload);
        break;
    case ANALOGRIG_CONFIGURE_FRAME_ID:
        on_configure(self, answer, payload);
        break;
    case ANALOGRIG_SAMPLE_FRAME_ID:
        on_sample(self, answer, payload);
        break;
    case ANALOGRIG_SAMPLE_BLOCK_FRAME_ID:
        on_sample_block(self, payload);
        break;
    default:
        add(&self->counters.messages_refused, 1U);
        break;
    }
}

static void continue_job(device_t* const self, answer_t* const answer) {
    if (self->job == DEVICE_STEPPING) {
        step_block(self, answer);
    } else {
        put_counter(self, answer);
    }
}

void device_init(device_t* const self, const device_identity_t* const identity) {
    DEVICE_ASSERT((self != 0) && (identity != 0));
    *self          = (device_t){ 0 };
    self->identity = *identity;
    reset(self);
}

device_progress_t
device_run(device_t* const self, const uint8_t* const in, const size_t in_n, uint8_t* const out, const size_t out_n) {
    DEVICE_ASSERT((self != 0) && ((in != 0) || (in_n == 0U)) && ((out != 0) || (out_n == 0U)));
    device_progress_t progress = { .taken = 0U, .given = 0U };
    while ((out_n - progress.given) >= DEVICE_ANSWER_MAX) {
        answer_t answer = { .bytes = &out[progress.given], .n = 0U };
        if (device_is_busy(self)) {
            continue_job(self, &answer);
        } else if (progress.taken == in_n) {
            break;
        } else if (frame_decoder_enter(&self->decoder, in[progress.taken++])) {
            on_message(self, &answer);
        }
        progress.given += answer.n;
    }
    return progress;
}

void device_overrun(device_t* const self, const uint32_t lost_n) {
    DEVICE_ASSERT(self != 0);
    add(&self->counters.receive_overruns, lost_n);
}

bool device_is_busy(const device_t* const self) {
    DEVICE_ASSERT(self != 0);
    return self->job != DEVICE_IDLE;
}

size_t device_size(void) { return sizeof(device_t); }
