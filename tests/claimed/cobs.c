// SPDX-License-Identifier: MIT
/// A firmware that speaks binary frames: COBS, a zero after each, CRC-16/CCITT-FALSE, little-endian.
///
///     01 seq:u16 u:u16 y:u16 flags:u8 crc:u16    a sample; bit 0 of flags: it is valid
///     02 crc:u16                                 reset, answered with 82 crc:u16
///     81 seq:u16 a1 a2 b0 b1 b2 d e s:f32 alarm:u8 crc:u16
///
/// The argument is the number of the planted defect.

#include "sampling.h"

#include <stdio.h>

#define MOST 64U

static unsigned taken;
static unsigned u_before;
static unsigned y_before;
static bool     is_latched;

static unsigned crc16(const uint8_t* const data, const size_t n) {
    unsigned crc = 0xFFFFU;
    for (size_t i = 0; i < n; i++) {
        crc ^= (unsigned)data[i] << 8U;
        for (unsigned k = 0; k < 8U; k++) {
            crc = ((crc & 0x8000U) != 0U) ? ((crc << 1U) ^ 0x1021U) : (crc << 1U);
        }
        crc &= 0xFFFFU;
    }
    return crc;
}

static size_t decode(const uint8_t* const in, const size_t n, uint8_t* const out) {
    size_t length = 0;
    for (size_t i = 0; i < n;) {
        const uint8_t code = in[i++];
        for (unsigned k = 1; (k < code) && (i < n); k++) {
            out[length++] = in[i++];
        }
        if ((code < 0xFFU) && (i < n)) {
            out[length++] = 0U;
        }
    }
    return length;
}

static void send(uint8_t* const data, size_t n) {
    const unsigned crc = crc16(data, n);
    data[n++]          = (uint8_t)crc;
    data[n++]          = (uint8_t)(crc >> 8U);
    uint8_t out[MOST + 2U];
    size_t  length = 1U;
    size_t  code   = 0U;
    for (size_t i = 0; i < n; i++) {
        if (data[i] == 0U) {
            out[code] = (uint8_t)(length - code);
            code      = length++;
        } else {
            out[length++] = data[i];
        }
    }
    out[code]     = (uint8_t)(length - code);
    out[length++] = 0U;
    (void)fwrite(out, 1U, length, stdout);
    (void)fflush(stdout);
}

static answer_t sample(const unsigned seq, const unsigned u, const unsigned y, bool valid) {
    const unsigned index = taken++;
    unsigned       u_in  = u;
    unsigned       y_in  = y;
    switch (bug) {
    case 1:
        if (((u & 0xFFU) == 0U) || ((y & 0xFFU) == 0U)) {
            return last;  // the decoder stops at a zero
        }
        break;
    case 2:
        u_in = ((u & 0xFFU) << 8U) | (u >> 8U);
        y_in = ((y & 0xFFU) << 8U) | (y >> 8U);
        break;
    case 3:
        if ((index > 0U) && ((seq & 0xFFU) == 0U)) {
            return last;  // 0 is the number of no sample
        }
        break;
    case 4:
        y_in = (u >> 8U) | ((y & 0xFFU) << 8U);
        break;
    case 5:
        if (index > 0U) {
            u_in = u_before;
            y_in = y_before;
        }
        break;
    case 8:
        if ((index >= 65536U) && ((index & 0xFFFFU) == 0U)) {
            begin();
        }
        break;
    case 9:
        valid = true;
        break;
    case 10:
        if (index == 0U) {
            u_in = u_before;
            y_in = y_before;
        }
        break;
    default:
        break;
    }
    u_before        = u;
    y_before        = y;
    answer_t answer = step((float)u_in, (float)y_in, valid);
    if ((bug == 14) && ((index % 100U) == 99U)) {
        answer = step((float)u_in, (float)y_in, valid);
    }
    return answer;
}

static void put(uint8_t* const to, const float x) {
    uint32_t bits;
    (void)memcpy(&bits, &x, sizeof(bits));
    if (bug == 6) {
        bits = (bits << 16U) | (bits >> 16U);
    }
    for (unsigned k = 0; k < 4U; k++) {
        to[k] = (uint8_t)(bits >> (8U * k));
    }
}

static void answer_to(const unsigned seq, const answer_t* const answer) {
    uint8_t data[MOST] = { 0x81U, (uint8_t)seq, (uint8_t)(seq >> 8U) };
    for (unsigned k = 0; k < 6U; k++) {
        const unsigned from = ((bug == 13) && (k < 2U)) ? (1U - k) : k;
        put(&data[3U + (4U * k)], answer->theta[from]);
    }
    float innovation = answer->innovation;
    if (bug == 7) {
        innovation = (float)(int16_t)(int32_t)(1000.0F * innovation) / 1000.0F;
    }
    put(&data[27], innovation);
    put(&data[31], (bug == 15) ? last.statistic : answer->statistic);
    is_latched = is_latched || (answer->alarm != 0U);
    data[35]   = (uint8_t)((bug == 12) ? is_latched : answer->alarm);
    send(data, 36U);
}

static void take(const uint8_t* const frame, const size_t n) {
    if ((n < 3U) || (crc16(frame, n - 2U) != (frame[n - 2U] | ((unsigned)frame[n - 1U] << 8U)))) {
        return;
    }
    if (frame[0] == 2U) {
        begin();
        taken            = 0U;
        is_latched       = false;
        uint8_t ok[MOST] = { 0x82U };
        send(ok, 1U);
    } else if ((frame[0] == 1U) && (n == 10U)) {
        const unsigned seq    = frame[1] | ((unsigned)frame[2] << 8U);
        const answer_t answer = sample(seq, frame[3] | ((unsigned)frame[4] << 8U),
                                       frame[5] | ((unsigned)frame[6] << 8U), (frame[7] & 1U) != 0U);
        answer_to(seq, &answer);
        last = answer;
    } else {
        // another message
    }
}

int main(const int argc, char** const argv) {
    bug = (argc > 1) ? atoi(argv[1]) : 0;
    if (bug == 11) {
        config.edge_instants = EST_EDGES_ANYWHERE;
    }
    begin();
    uint8_t in[MOST];
    uint8_t frame[MOST];
    size_t  n = 0;
    for (int c = getchar(); c != EOF; c = getchar()) {
        if (c != 0) {
            in[n % MOST] = (uint8_t)c;
            n            = (n + 1U) % MOST;
        } else {
            take(frame, decode(in, n, frame));
            n = 0;
        }
    }
    return 0;
}
