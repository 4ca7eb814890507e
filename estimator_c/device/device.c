// SPDX-License-Identifier: MIT

#include "device.h"
#include "est_assert.h"

#include "analogrig_catalogue.h"
#include "analogrig_codec.h"
#include "settings.h"

#if ANALOGRIG_SAMPLE_BLOCK_FORCE_N > 16
#error "the mask of missing samples has 16 bits"
#endif

#define RUN_MAX 7U  ///< largest run identifier: it has three bits

#define COUNTER_FIRST ANALOGRIG_STATUS_COUNTER_UPDATED_CHOICE
#define COUNTER_LAST ANALOGRIG_STATUS_COUNTER_FRAMES_FOREIGN_CHOICE

/// Answers due for a sample, in this order.
#define DUE_ALARM 1U
#define DUE_DIAGNOSIS 2U
#define DUE_MISFIT 4U
#define DUE_ESTIMATES 8U
#define DUE_STEPPED 16U

static void add_saturating(uint32_t* const counter, const uint32_t n) {
    *counter = (*counter < (UINT32_MAX - n)) ? (*counter + n) : UINT32_MAX;
}

static uint16_t read_word(const uint8_t* const bytes) { return (uint16_t)(bytes[0] | ((uint32_t)bytes[1] << 8U)); }

// ---------------------------------------------        ANSWERS         ---------------------------------------------

static void pack_hello(const device_t* const self, device_message_t* const answer) {
    const struct analogrig_hello_t message = { .seq            = self->seq,
                                               .theta_max      = EST_THETA_MAX,
                                               .answers        = self->job_answers,
                                               .catalogue_hash = self->identity.catalogue_hash };
    answer->id                             = ANALOGRIG_HELLO_FRAME_ID;
    (void)analogrig_hello_pack(answer->payload, &message, sizeof(answer->payload));
}

static void pack_firmware(const device_t* const self, device_message_t* const answer) {
    const struct analogrig_firmware_t message = { .seq          = self->seq,
                                                  .firmware_id  = self->identity.firmware_id,
                                                  .answers      = self->job_answers,
                                                  .input_blocks = self->identity.input_blocks,
                                                  .boot_nonce   = self->identity.boot_nonce };
    answer->id                                = ANALOGRIG_FIRMWARE_FRAME_ID;
    (void)analogrig_firmware_pack(answer->payload, &message, sizeof(answer->payload));
}

static void pack_configured(const device_t* const self, device_message_t* const answer) {
    const struct analogrig_configured_t message = { .seq     = self->seq,
                                                    .key     = self->job_next,
                                                    .answers = self->job_answers,
                                                    .result  = self->job_result,
                                                    .value   = settings_get(&self->settings, self->job_next) };
    answer->id                                  = ANALOGRIG_CONFIGURED_FRAME_ID;
    (void)analogrig_configured_pack(answer->payload, &message, sizeof(answer->payload));
}

static void pack_controlled(const device_t* const self, device_message_t* const answer) {
    const struct analogrig_controlled_t message = { .seq      = self->seq,
                                                    .command  = self->job_next,
                                                    .answers  = self->job_answers,
                                                    .result   = self->job_result,
                                                    .argument = self->job_argument };
    answer->id                                  = ANALOGRIG_CONTROLLED_FRAME_ID;
    (void)analogrig_controlled_pack(answer->payload, &message, sizeof(answer->payload));
}

static void pack_status(const device_t* const self, device_message_t* const answer, const uint32_t value) {
    const struct analogrig_status_t message = {
        .seq = self->seq, .counter = self->job_next, .answers = self->job_answers, .value = value
    };
    answer->id = ANALOGRIG_STATUS_FRAME_ID;
    (void)analogrig_status_pack(answer->payload, &message, sizeof(answer->payload));
}

static void
pack_estimate(const device_t* const self, device_message_t* const answer, const uint8_t element, const float value) {
    const struct analogrig_estimate_t message = {
        .seq = self->seq, .element = element, .sample_index = self->next_index, .value = value
    };
    answer->id = ANALOGRIG_ESTIMATE_FRAME_ID;
    (void)analogrig_estimate_pack(answer->payload, &message, sizeof(answer->payload));
}

static void pack_alarm(const device_t* const self, device_message_t* const answer) {
    const struct analogrig_alarm_t message = { .seq          = self->seq,
                                               .trigger      = (uint8_t)self->settings.estimator.trigger.kind,
                                               .sample_index = self->next_index,
                                               .statistic    = self->stepped.statistic };
    answer->id                             = ANALOGRIG_ALARM_FRAME_ID;
    (void)analogrig_alarm_pack(answer->payload, &message, sizeof(answer->payload));
}

static void pack_diagnosis(const device_t* const self, device_message_t* const answer) {
    const est_diagnosis_t              stated  = est_isolation_diagnosis(&self->isolation);
    const struct analogrig_diagnosis_t message = { .seq         = self->seq,
                                                   .change      = (uint8_t)stated.change,
                                                   .onset_index = (uint16_t)(self->alarm_index - stated.onset_n),
                                                   .extent      = stated.extent };
    answer->id                                 = ANALOGRIG_DIAGNOSIS_FRAME_ID;
    (void)analogrig_diagnosis_pack(answer->payload, &message, sizeof(answer->payload));
}

#if DEVICE_WITH_FIT
/// Number in units of a message of 16 bits; the largest one if it does not fit.
static uint16_t in_units(const float number, const float units) {
    const float scaled = (number * units) + 0.5F;
    return (scaled < (float)UINT16_MAX) ? (uint16_t)scaled : UINT16_MAX;
}

static void pack_misfit(const device_t* const self, device_message_t* const answer) {
    const est_misfit_t              found   = est_fit_misfit(&self->fit);
    const struct analogrig_misfit_t message = { .seq          = self->seq,
                                                .cause        = (uint8_t)found.kind,
                                                .sample_index = self->next_index,
                                                .frequency    = in_units(found.frequency, 65536.0F),
                                                .strength     = in_units(found.strength, 256.0F) };
    answer->id                              = ANALOGRIG_MISFIT_FRAME_ID;
    (void)analogrig_misfit_pack(answer->payload, &message, sizeof(answer->payload));
}
#endif

static void pack_stepped(const device_t* const self, device_message_t* const answer) {
    const est_step_t* const          last    = &self->stepped;
    const struct analogrig_stepped_t message = { .seq          = self->seq,
                                                 .missing      = (last->status == EST_MISSING) ? 1U : 0U,
                                                 .refused      = (last->status == EST_REFUSED) ? 1U : 0U,
                                                 .restarted    = self->restarted ? 1U : 0U,
                                                 .gathering    = (last->status == EST_GATHERING) ? 1U : 0U,
                                                 .idle         = last->idle ? 1U : 0U,
                                                 .run          = self->run,
                                                 .sample_index = self->next_index,
                                                 .statistic    = last->statistic };
    answer->id                               = ANALOGRIG_STEPPED_FRAME_ID;
    (void)analogrig_stepped_pack(answer->payload, &message, sizeof(answer->payload));
}

// ---------------------------------------------        SAMPLES         ---------------------------------------------

static est_step_t step(device_t* const self, const est_sample_t sample) {
    const est_step_t out = est_step(&self->estimator, sample);
    if (self->isolating) {
        est_isolation_enter(&self->isolation, &self->estimator, sample, out);
    }
#if DEVICE_WITH_FIT
    if (self->watching) {
        est_fit_enter(&self->fit, &self->estimator, out);
    }
#endif
    return out;
}

#if DEVICE_WITH_FIT
/// Start the watch of the fit, if the settings and the estimator allow it.
static void start_watch(device_t* const self) {
    self->watching = est_fit_init(&self->fit, &self->settings.estimator) && self->settings.misfit;
    self->reported = EST_MISFIT_NONE;
}

/// True iff the cause of the misfit is another than the last that was reported, which it then is.
static bool misfit_is_due(device_t* const self) {
    const est_misfit_kind_t before = self->reported;
    if (self->watching) {
        self->reported = est_fit_misfit(&self->fit).kind;
    }
    return self->reported != before;
}
#endif

/// Work on the diagnosis of the last alarm. Return true iff it has just been completed.
static bool isolate(device_t* const self) {
    const est_change_t before = est_isolation_diagnosis(&self->isolation).change;
    for (uint8_t i = 0U; (i < DEVICE_ISOLATION_SLICES) && est_isolation_work(&self->isolation); i++) {
    }
    return est_isolation_diagnosis(&self->isolation).change != before;
}

static void step_over_gap(device_t* const self, const uint16_t lost_n) {
    const est_sample_t missing = { .u = 0.0F, .y = 0.0F, .valid = false };
    for (uint16_t i = 0U; (i < lost_n) && (i < DEVICE_GAP_MAX); i++) {
        (void)step(self, missing);
    }
    add_saturating(&self->counters.samples_lost, lost_n);
    self->next_index   = (uint16_t)(self->next_index + lost_n);
    self->unreported_n = (uint16_t)(((uint32_t)self->unreported_n + lost_n) % self->report_interval_n);
}

static bool report_is_due(device_t* const self) {
    self->unreported_n++;
    if (self->unreported_n < self->report_interval_n) {
        return false;
    }
    self->unreported_n = 0U;
    return true;
}

/// Step the estimator, and record the answers that are due.
static void step_sample(device_t* const self, const uint16_t index, const est_sample_t sample) {
    const uint16_t ahead = (uint16_t)(index - self->next_index);
    if (ahead > (UINT16_MAX / 2U)) {
        add_saturating(&self->counters.samples_ignored, 1U);
        return;
    }
    if (ahead > 0U) {
        step_over_gap(self, ahead);
    }
    const uint32_t restarts = est_counters(&self->estimator).restarts;
    self->stepped           = step(self, sample);
    self->restarted         = est_counters(&self->estimator).restarts != restarts;
    self->due               = DUE_STEPPED;
    self->element           = 0U;
    if (self->stepped.alarm) {
        self->alarm_index = self->next_index;
        self->due |= DUE_ALARM;
    }
    if (self->isolating && isolate(self)) {
        self->due |= DUE_DIAGNOSIS;
    }
#if DEVICE_WITH_FIT
    if (misfit_is_due(self)) {
        self->due |= DUE_MISFIT;
    }
#endif
    if (report_is_due(self)) {
        self->due |= DUE_ESTIMATES;
    }
}

/// Report the next element of theta; after the last one, the innovation.
static void answer_estimate(device_t* const self, device_message_t* const answer) {
    if (self->element < est_theta_count(&self->estimator)) {
        pack_estimate(self, answer, self->element, est_theta(&self->estimator, self->element));
        self->element++;
    } else {
        pack_estimate(self, answer, ANALOGRIG_ESTIMATE_ELEMENT_INNOVATION_CHOICE, self->stepped.innovation);
        self->due &= (uint8_t)~DUE_ESTIMATES;
    }
}

/// Write the next answer that is due for the sample.
static void answer_sample(device_t* const self, device_message_t* const answer) {
    if ((self->due & DUE_ALARM) != 0U) {
        pack_alarm(self, answer);
        self->due &= (uint8_t)~DUE_ALARM;
    } else if ((self->due & DUE_DIAGNOSIS) != 0U) {
        pack_diagnosis(self, answer);
        self->due &= (uint8_t)~DUE_DIAGNOSIS;
#if DEVICE_WITH_FIT
    } else if ((self->due & DUE_MISFIT) != 0U) {
        pack_misfit(self, answer);
        self->due &= (uint8_t)~DUE_MISFIT;
#endif
    } else if ((self->due & DUE_ESTIMATES) != 0U) {
        answer_estimate(self, answer);
    } else {
        pack_stepped(self, answer);
        self->due = 0U;
        self->next_index++;
    }
}

/// True iff samples of this run can be entered. Counts those that cannot.
static bool accepts_samples(device_t* const self, const uint8_t run, const uint8_t samples) {
    if (!self->running || (samples < 1U) || (samples > ANALOGRIG_SAMPLE_BLOCK_FORCE_N)) {
        add_saturating(&self->counters.messages_refused, 1U);
        return false;
    }
    if (run != self->run) {
        add_saturating(&self->counters.samples_of_other_runs, samples);
        return false;
    }
    return true;
}

static void on_sample(device_t* const self, const uint8_t* const payload) {
    struct analogrig_sample_t message;
    (void)analogrig_sample_unpack(&message, payload, ANALOGRIG_SAMPLE_LENGTH);
    if (!accepts_samples(self, message.run, 1U)) {
        return;
    }
    const est_sample_t sample = { .u     = (float)message.force,
                                  .y     = (float)message.displacement,
                                  .valid = message.missing == 0U };
    step_sample(self, message.sample_index, sample);
    self->job       = DEVICE_STEPPING;
    self->job_next  = 1U;
    self->job_count = 1U;
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
    self->job_payload = payload;
}

/// Enter the next sample of the block. Read from the payload, because the codec has one member per code and no array.
static void step_block(device_t* const self) {
    const uint8_t        i = self->job_next;
    const uint8_t* const force =
        &self->job_payload[ANALOGRIG_SAMPLE_BLOCK_FORCE_BYTE + (i * ANALOGRIG_SAMPLE_BLOCK_FORCE_STRIDE)];
    const uint8_t* const displacement =
        &self->job_payload[ANALOGRIG_SAMPLE_BLOCK_DISPLACEMENT_BYTE + (i * ANALOGRIG_SAMPLE_BLOCK_DISPLACEMENT_STRIDE)];
    const est_sample_t sample = { .u     = (float)read_word(force),
                                  .y     = (float)read_word(displacement),
                                  .valid = (((uint32_t)self->job_missing >> i) & 1U) == 0U };
    step_sample(self, (uint16_t)(self->job_index + i), sample);
    self->job_next++;
}

/// Write the next answer about the samples of the message. Return false if there is none.
static bool answer_samples(device_t* const self, device_message_t* const answer) {
    while ((self->due == 0U) && (self->job_next < self->job_count)) {
        step_block(self);
    }
    const bool has_answer = self->due != 0U;
    if (has_answer) {
        answer_sample(self, answer);
    }
    if ((self->due == 0U) && (self->job_next == self->job_count)) {
        self->job = DEVICE_IDLE;
    }
    return has_answer;
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

static void on_configure(device_t* const self, const uint8_t* const payload) {
    struct analogrig_configure_t message;
    (void)analogrig_configure_unpack(&message, payload, ANALOGRIG_CONFIGURE_LENGTH);
    self->job        = DEVICE_CONFIGURING;
    self->job_next   = message.key;
    self->job_result = configure(self, message.key, message.value);
}

// ---------------------------------------------        CONTROL         ---------------------------------------------

/// Return to the state after device_init(), but keep the identity and the sequence numbers.
static void reset(device_t* const self) {
    self->counters          = (device_counters_t){ 0 };
    self->stopped           = (est_counters_t){ 0 };
    self->settings          = settings_default();
    self->running           = false;
    self->report_interval_n = 1U;
    const bool accepted     = est_init(&self->estimator, &self->settings.estimator);
    EST_ASSERT(accepted);  // the default configuration is valid
    (void)accepted;
}

static uint8_t start_run(device_t* const self, const uint32_t run) {
    if (self->running) {
        return ANALOGRIG_CONTROLLED_RESULT_RUNNING_CHOICE;
    }
    if ((run > RUN_MAX) || !est_init(&self->estimator, &self->settings.estimator)) {
        return ANALOGRIG_CONTROLLED_RESULT_OUT_OF_RANGE_CHOICE;
    }
    self->isolating = est_isolation_init(&self->isolation, &self->settings.estimator, self->settings.force_zero) &&
                      self->settings.isolation;
#if DEVICE_WITH_FIT
    start_watch(self);
#endif
    self->running      = true;
    self->run          = (uint8_t)run;
    self->next_index   = 0U;
    self->unreported_n = 0U;
    return ANALOGRIG_CONTROLLED_RESULT_APPLIED_CHOICE;
}

static void stop_run(device_t* const self) {
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
        return start_run(self, argument);
    case ANALOGRIG_CONTROL_COMMAND_STOP_CHOICE:
        stop_run(self);
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

static void on_control(device_t* const self, const uint8_t* const payload) {
    struct analogrig_control_t message;
    (void)analogrig_control_unpack(&message, payload, ANALOGRIG_CONTROL_LENGTH);
    if (message.command == ANALOGRIG_CONTROL_COMMAND_STATUS_CHOICE) {
        self->job      = DEVICE_COUNTING;
        self->job_next = COUNTER_FIRST;
        return;
    }
    self->job          = DEVICE_CONTROLLING;
    self->job_next     = message.command;
    self->job_result   = control(self, message.command, message.argument);
    self->job_argument = message.argument;
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
        return self->counters.frames_dropped;
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
    case ANALOGRIG_STATUS_COUNTER_FRAMES_FOREIGN_CHOICE:
        return self->counters.frames_foreign;
    default:
        return 0U;
    }
}

// ---------------------------------------------        MESSAGES        ---------------------------------------------

/// Check the sequence number of a message. Return false for a repetition, which must not be executed twice. Identify
/// begins a conversation and may have any number.
static bool check_sequence(device_t* const self, const uint8_t id, const uint8_t seq) {
    const bool    begins = (id == ANALOGRIG_IDENTIFY_FRAME_ID) || !self->seq_known;
    const uint8_t behind = (uint8_t)(self->seq_expected - seq);
    if (!begins && (behind >= 1U) && (behind <= DEVICE_LATE_MAX)) {
        add_saturating(&self->counters.messages_repeated, 1U);
        return false;
    }
    if (!begins && (seq != self->seq_expected)) {
        add_saturating(&self->counters.sequence_gaps, 1U);
    }
    self->seq_known    = true;
    self->seq_expected = (uint8_t)(seq + 1U);
    return true;
}

static void on_message(device_t* const self, const uint8_t id, const uint8_t* const payload) {
    switch (id) {
    case ANALOGRIG_IDENTIFY_FRAME_ID:
        self->job = DEVICE_GREETING;
        break;
    case ANALOGRIG_CONTROL_FRAME_ID:
        on_control(self, payload);
        break;
    case ANALOGRIG_CONFIGURE_FRAME_ID:
        on_configure(self, payload);
        break;
    case ANALOGRIG_SAMPLE_FRAME_ID:
        on_sample(self, payload);
        break;
    case ANALOGRIG_SAMPLE_BLOCK_FRAME_ID:
        on_sample_block(self, payload);
        break;
    default:
        add_saturating(&self->counters.messages_refused, 1U);
        break;
    }
}

void device_init(device_t* const self, const device_identity_t* const identity) {
    EST_ASSERT((self != 0) && (identity != 0));
    *self          = (device_t){ 0 };
    self->identity = *identity;
    reset(self);
}

void device_enter(device_t* const self, const uint8_t id, const uint8_t* const payload) {
    EST_ASSERT((self != 0) && (payload != 0) && !device_is_busy(self));
    if (!analogrig_is_from_harness(id)) {
        add_saturating(&self->counters.messages_refused, 1U);
        return;
    }
    if (check_sequence(self, id, payload[0])) {
        self->job_answers = payload[0];
        on_message(self, id, payload);
    }
}

bool device_answer(device_t* const self, device_message_t* const answer) {
    EST_ASSERT((self != 0) && (answer != 0));
    bool has_answer = true;
    switch (self->job) {
    case DEVICE_GREETING:
        pack_hello(self, answer);
        self->job = DEVICE_INTRODUCING;
        break;
    case DEVICE_INTRODUCING:
        pack_firmware(self, answer);
        self->job = DEVICE_IDLE;
        break;
    case DEVICE_CONFIGURING:
        pack_configured(self, answer);
        self->job = DEVICE_IDLE;
        break;
    case DEVICE_CONTROLLING:
        pack_controlled(self, answer);
        self->job = DEVICE_IDLE;
        break;
    case DEVICE_COUNTING:
        pack_status(self, answer, counter_value(self, self->job_next));
        self->job = (self->job_next == COUNTER_LAST) ? DEVICE_IDLE : DEVICE_COUNTING;
        self->job_next++;
        break;
    case DEVICE_STEPPING:
        has_answer = answer_samples(self, answer);
        break;
    case DEVICE_IDLE:
    default:
        has_answer = false;
        break;
    }
    if (has_answer) {
        self->seq++;
    }
    return has_answer;
}

void device_overrun(device_t* const self, const uint32_t lost_n) {
    EST_ASSERT(self != 0);
    add_saturating(&self->counters.receive_overruns, lost_n);
}

void device_dropped(device_t* const self, const uint32_t frames_n) {
    EST_ASSERT(self != 0);
    add_saturating(&self->counters.frames_dropped, frames_n);
}

void device_foreign(device_t* const self, const uint32_t frames_n) {
    EST_ASSERT(self != 0);
    add_saturating(&self->counters.frames_foreign, frames_n);
}

bool device_is_busy(const device_t* const self) {
    EST_ASSERT(self != 0);
    return self->job != DEVICE_IDLE;
}
