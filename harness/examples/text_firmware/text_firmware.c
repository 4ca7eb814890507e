// SPDX-License-Identifier: MIT
/// A firmware with a protocol of its own: samples and estimates as lines of text, in codes of the converter.
///
///     line from the bench   answer
///     INDEX,U,Y             INDEX,a1,a2,b0,b1,b2,d,ALARM
///     INDEX,-               the same: the sample with this index is missing
///     U,Y or -              the same, with the count of samples as the index
///     R                     OK: everything begins anew
///     anything else         ERROR
///
/// Each parameter is eight hexadecimal digits: the bits of the float. ALARM is 0 or 1. A first line names the firmware.

#include "est.h"
#include "text_io.h"

#define LINE_MAX 48U
#define FIELDS_MAX 3U
#define VALUE_MAX 1000000000
#define GAP_MAX 16U  ///< so many missing samples in a row have the effect of any larger number

static const est_config_t config = EST_CONFIG_DEFAULT;
static est_t              estimator;
static uint32_t           next_index;

#define THETA_N (config.na + config.nb + config.nc + (config.offset ? 1 : 0))

/// Last estimate that was sent.
static struct {
    char   text[96];
    size_t n;
} answer;

/// A value between commas; "-" is a missing one.
typedef struct {
    bool    is_missing;
    int32_t value;
} field_t;

// ---------------------------------------------       ANSWERS        ---------------------------------------------

static void put(const char c) { answer.text[answer.n++] = c; }

static void put_decimal(const uint32_t value) {
    uint32_t power = 1U;
    while ((value / power) >= 10U) {
        power *= 10U;
    }
    for (; power > 0U; power /= 10U) {
        put((char)('0' + (char)((value / power) % 10U)));
    }
}

static void put_bits(const float value) {
    const union {
        float    value;
        uint32_t bits;
    } same = { .value = value };
    for (unsigned shift = 32U; shift > 0U; shift -= 4U) {
        put("0123456789abcdef"[(same.bits >> (shift - 4U)) & 0xFU]);
    }
}

static void send_text(const char* const text) {
    size_t n = 0U;
    while (text[n] != '\0') {
        n++;
    }
    text_write(text, n);
}

static void send_estimate(const uint32_t index, const bool alarm) {
    answer.n = 0U;
    put_decimal(index);
    for (uint8_t i = 0U; i < (uint8_t)THETA_N; i++) {
        put(',');
        put_bits(est_theta(&estimator, i));
    }
    put(',');
    put(alarm ? '1' : '0');
    put('\n');
    text_write(answer.text, answer.n);
}

// ---------------------------------------------        LINES         ---------------------------------------------

/// Parse one field and move *text behind it. Return false if there is none.
static bool parse_field(const char** const text, field_t* const out) {
    const char* c        = *text;
    const bool  has_sign = *c == '-';
    c += has_sign ? 1 : 0;
    out->is_missing          = has_sign && ((*c < '0') || (*c > '9'));
    out->value               = 0;
    const char* const digits = c;
    for (; (*c >= '0') && (*c <= '9'); c++) {
        const int32_t digit = *c - '0';
        if (out->value > ((VALUE_MAX - digit) / 10)) {
            return false;
        }
        out->value = (10 * out->value) + digit;
    }
    out->value = has_sign ? -out->value : out->value;
    *text      = c;
    return out->is_missing || (c != digits);
}

/// Parse the fields of a line. Return their number; 0 if it is malformed.
static size_t parse(const char* text, field_t fields[FIELDS_MAX]) {
    for (size_t n = 0U; n < FIELDS_MAX; n++) {
        if (!parse_field(&text, &fields[n])) {
            return 0U;
        }
        if (*text == '\0') {
            return n + 1U;
        }
        if (*text++ != ',') {
            return 0U;
        }
    }
    return 0U;
}

/// Process a sample. Those between the last and this one are missing.
static void step(const uint32_t index, const est_sample_t sample) {
    if ((index + 1U) == next_index) {
        text_write(answer.text, answer.n);  // the bench has missed the answer
        return;
    }
    if (index < next_index) {
        send_text("ERROR\n");
        return;
    }
    const uint32_t gap = index - next_index;
    for (uint32_t i = 0U; (i < gap) && (i < GAP_MAX); i++) {
        (void)est_step(&estimator, (est_sample_t){ .valid = false });
    }
    next_index = index + 1U;
    send_estimate(index, est_step(&estimator, sample).alarm);
}

static bool reset(void) {
    next_index = 0U;
    return est_init(&estimator, &config);
}

static void process(const char* const line) {
    field_t      fields[FIELDS_MAX];
    const size_t n         = parse(line, fields);
    const bool   is_valid  = (n > 0U) && !fields[n - 1U].is_missing;
    const size_t values    = is_valid ? 2U : 1U;  // u and y, or the dash
    const bool   has_index = n == (values + 1U);
    if ((line[0] == 'R') && (line[1] == '\0')) {
        send_text(reset() ? "OK\n" : "ERROR\n");
    } else if ((n < values) || (n > (values + 1U)) ||
               ((n > 1U) && (fields[0].is_missing || fields[n - 2U].is_missing)) ||
               (has_index && (fields[0].value < 0))) {
        send_text("ERROR\n");
    } else {
        const est_sample_t sample = {
            .u     = is_valid ? (float)fields[n - 2U].value : 0.0F,
            .y     = is_valid ? (float)fields[n - 1U].value : 0.0F,
            .valid = is_valid,
        };
        step(has_index ? (uint32_t)fields[0].value : next_index, sample);
    }
}

int main(void) {
    char   line[LINE_MAX];
    size_t n      = 0U;
    bool   is_bad = false;
    text_start();
    if (!reset()) {
        return 1;
    }
    send_text("text firmware with est\n");
    for (int c = text_read(); c != TEXT_END; c = text_read()) {
        if (c == '\n') {
            line[n] = '\0';
            if (is_bad) {
                send_text("ERROR\n");
            } else {
                process(line);
            }
            n      = 0U;
            is_bad = false;
        } else if (c == '\r') {
            // ends a line of some terminals, before the line feed
        } else if ((c == TEXT_LOST) || (c == '\0') || (n == (LINE_MAX - 1U))) {
            is_bad = true;
        } else {
            line[n++] = (char)c;
        }
    }
    return 0;
}
