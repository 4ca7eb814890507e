// SPDX-License-Identifier: MIT

#include "slcan.h"
#include "est_assert.h"

#define CR 0x0DU
#define BEL 0x07U

#define STANDARD_DIGITS 3U
#define EXTENDED_DIGITS 8U
#define STANDARD_MAX 0x7FFU
#define EXTENDED_MAX 0x1FFFFFFFU
#define NO_DIGIT 16U
#define CODES_MAX 16U

/// Bytes of data for each length code (ISO 11898-1, table 5).
static const uint8_t length_of_code[CODES_MAX] = { 0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64 };

// ---------------------------------------------         DIGITS         ---------------------------------------------

static uint8_t digit(const uint8_t character) {
    uint8_t out = NO_DIGIT;
    if ((character >= (uint8_t)'0') && (character <= (uint8_t)'9')) {
        out = (uint8_t)(character - (uint8_t)'0');
    } else if ((character >= (uint8_t)'A') && (character <= (uint8_t)'F')) {
        out = (uint8_t)(character - (uint8_t)'A' + 10U);
    } else if ((character >= (uint8_t)'a') && (character <= (uint8_t)'f')) {
        out = (uint8_t)(character - (uint8_t)'a' + 10U);
    } else {
        // not a digit
    }
    return out;
}

static uint8_t character(const uint32_t value) {
    const uint8_t low = (uint8_t)(value & 0xFU);
    return (uint8_t)(low + ((low < 10U) ? (uint8_t)'0' : ((uint8_t)'A' - 10U)));
}

/// Parse a number of n hexadecimal digits. Return false if there is another character.
static bool parse_number(const uint8_t* const text, const uint8_t n, uint32_t* const out) {
    uint32_t value = 0U;
    for (uint8_t i = 0U; i < n; i++) {
        const uint8_t next = digit(text[i]);
        if (next == NO_DIGIT) {
            return false;
        }
        value = (value << 4U) | next;
    }
    *out = value;
    return true;
}

// ---------------------------------------------         FRAMES         ---------------------------------------------

/// Flags of the kind of frame in a line. Return false if the line is not a frame.
static bool kind_flags(const uint8_t kind, uint8_t* const flags) {
    bool is_frame = true;
    switch (kind) {
    case (uint8_t)'t':
        *flags = 0U;
        break;
    case (uint8_t)'T':
        *flags = CAN_FRAME_EXTENDED;
        break;
    case (uint8_t)'r':
        *flags = CAN_FRAME_REMOTE;
        break;
    case (uint8_t)'R':
        *flags = CAN_FRAME_REMOTE | CAN_FRAME_EXTENDED;
        break;
    case (uint8_t)'d':
    case (uint8_t)'b':
        *flags = CAN_FRAME_FD;
        break;
    case (uint8_t)'D':
    case (uint8_t)'B':
        *flags = CAN_FRAME_FD | CAN_FRAME_EXTENDED;
        break;
    default:
        is_frame = false;
        break;
    }
    return is_frame;
}

static bool decode_data(const uint8_t* const text, can_frame_t* const frame) {
    for (uint8_t i = 0U; i < frame->length; i++) {
        uint32_t byte = 0U;
        if (!parse_number(&text[2U * i], 2U, &byte)) {
            return false;
        }
        frame->data[i] = (uint8_t)byte;
    }
    return true;
}

/// Parse the frame in a line of n characters, without CR. Return false if it is malformed.
static bool decode(const uint8_t* const line, const uint8_t n, can_frame_t* const frame) {
    *frame = (can_frame_t){ 0 };
    if (!kind_flags(line[0], &frame->flags)) {
        return false;
    }
    const bool    is_extended = (frame->flags & CAN_FRAME_EXTENDED) != 0U;
    const uint8_t digits      = is_extended ? EXTENDED_DIGITS : STANDARD_DIGITS;
    const uint8_t head        = (uint8_t)(digits + 2U);
    if ((n < head) || !parse_number(&line[1], digits, &frame->id) ||
        (frame->id > (is_extended ? EXTENDED_MAX : STANDARD_MAX))) {
        return false;
    }
    const uint8_t code  = digit(line[head - 1U]);
    const bool    is_fd = (frame->flags & CAN_FRAME_FD) != 0U;
    if ((code == NO_DIGIT) || (!is_fd && (code > CAN_FRAME_CLASSIC_MAX))) {
        return false;
    }
    if ((frame->flags & CAN_FRAME_REMOTE) != 0U) {
        return n == head;
    }
    frame->length = length_of_code[code];
    return (n == (head + (2U * frame->length))) && decode_data(&line[head], frame);
}

// ---------------------------------------------        COMMANDS        ---------------------------------------------

static void reply(slcan_event_t* const event, const uint8_t byte) { event->reply[event->reply_n++] = byte; }

static void reply_text(slcan_event_t* const event, const char* const text) {
    for (uint8_t i = 0U; text[i] != '\0'; i++) {
        reply(event, (uint8_t)text[i]);
    }
}

static bool open_channel(slcan_t* const self, const bool only_listens) {
    if (self->is_open) {
        return false;
    }
    self->is_open      = true;
    self->only_listens = only_listens;
    return true;
}

static bool close_channel(slcan_t* const self) {
    const bool was_open = self->is_open;
    self->is_open       = false;
    return was_open;
}

/// Execute a line that is not a frame. Return false if it is refused.
static bool command(slcan_t* const self, slcan_event_t* const event) {
    const bool is_single = self->fill == 1U;
    switch (self->line[0]) {
    case (uint8_t)'O':
        return is_single && open_channel(self, false);
    case (uint8_t)'L':
        return is_single && open_channel(self, true);
    case (uint8_t)'C':
        return is_single && close_channel(self);
    case (uint8_t)'S':
    case (uint8_t)'s':
    case (uint8_t)'Y':
        return !is_single && !self->is_open;
    case (uint8_t)'V':
        reply_text(event, "V0101");
        return is_single;
    case (uint8_t)'N':
        reply_text(event, "NRIG1");
        return is_single;
    case (uint8_t)'F':
        reply_text(event, "F00");
        return is_single && self->is_open;
    case (uint8_t)'Z':  // time stamps are not supported
        return (self->fill == 2U) && (self->line[1] == (uint8_t)'0');
    default:
        return false;
    }
}

static bool transmit(const slcan_t* const self, slcan_event_t* const event) {
    const bool is_fd = (event->frame.flags & CAN_FRAME_FD) != 0U;
    if (!self->is_open || self->only_listens || (is_fd && !self->is_fd)) {
        return false;
    }
    event->has_frame = true;
    reply(event, ((event->frame.flags & CAN_FRAME_EXTENDED) != 0U) ? (uint8_t)'Z' : (uint8_t)'z');
    return true;
}

/// Execute a complete line. An empty line is accepted: users probe the adapter with it.
static bool execute(slcan_t* const self, slcan_event_t* const event) {
    if (self->overlong) {
        return false;
    }
    if (self->fill == 0U) {
        return true;
    }
    return decode(self->line, self->fill, &event->frame) ? transmit(self, event) : command(self, event);
}

void slcan_init(slcan_t* const self, const bool is_fd) {
    EST_ASSERT(self != 0);
    *self = (slcan_t){ .is_fd = is_fd };
}

bool slcan_enter(slcan_t* const self, const uint8_t byte, slcan_event_t* const event) {
    EST_ASSERT((self != 0) && (event != 0));
    if (byte != CR) {
        if (self->fill < SLCAN_LINE_MAX) {
            self->line[self->fill++] = byte;
        } else {
            self->overlong = true;
        }
        return false;
    }
    *event = (slcan_event_t){ .has_frame = false };
    if (execute(self, event)) {
        reply(event, CR);
    } else {
        event->reply_n = 0U;
        reply(event, BEL);
    }
    self->fill     = 0U;
    self->overlong = false;
    return true;
}

// ---------------------------------------------        ENCODING        ---------------------------------------------

static uint8_t kind_of(const uint8_t flags) {
    const bool is_extended = (flags & CAN_FRAME_EXTENDED) != 0U;
    uint8_t    kind        = is_extended ? (uint8_t)'T' : (uint8_t)'t';
    if ((flags & CAN_FRAME_FD) != 0U) {
        kind = is_extended ? (uint8_t)'D' : (uint8_t)'d';
    } else if ((flags & CAN_FRAME_REMOTE) != 0U) {
        kind = is_extended ? (uint8_t)'R' : (uint8_t)'r';
    } else {
        // classic data frame
    }
    return kind;
}

/// Smallest length code that holds n bytes.
static uint8_t code_of(const uint8_t length) {
    uint8_t code = 0U;
    while (length_of_code[code] < length) {
        code++;
    }
    return code;
}

size_t slcan_encode(const slcan_t* const self, const can_frame_t* const frame, uint8_t* const out) {
    EST_ASSERT((self != 0) && (frame != 0) && (frame->length <= CAN_FRAME_MAX) && (out != 0));
    if (!self->is_open) {
        return 0U;
    }
    const uint8_t digits = ((frame->flags & CAN_FRAME_EXTENDED) != 0U) ? EXTENDED_DIGITS : STANDARD_DIGITS;
    const uint8_t code   = code_of(frame->length);
    size_t        n      = 0U;
    out[n++]             = kind_of(frame->flags);
    for (uint8_t i = digits; i > 0U; i--) {
        out[n++] = character(frame->id >> (4U * (i - 1U)));
    }
    out[n++]             = character(code);
    const uint8_t data_n = ((frame->flags & CAN_FRAME_REMOTE) != 0U) ? 0U : length_of_code[code];
    for (uint8_t i = 0U; i < data_n; i++) {
        out[n++] = character((uint32_t)frame->data[i] >> 4U);
        out[n++] = character(frame->data[i]);
    }
    out[n++] = CR;
    return n;
}
