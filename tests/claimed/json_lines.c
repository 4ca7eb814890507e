// SPDX-License-Identifier: MIT
/// A firmware that speaks JSON, one object a line.
///
///     {"i":12,"u":1234,"y":567}     a sample; {"i":12,"u":null,"y":null} is a missing one
///     {"cmd":"reset"}               answered with {"ok":"reset"}
///
/// The argument is the number of the planted defect.

#include "sampling.h"

#include <stdio.h>

static unsigned taken;  ///< samples since the reset
static float    u_before;
static float    y_before;

/// Value of a key; false if it is null.
static bool value_of(const char* const line, const char* const key, float* const out) {
    const char* const at = strstr(line, key);
    if ((at == NULL) || (strncmp(&at[strlen(key)], "null", 4U) == 0)) {
        *out = 0.0F;
        return false;
    }
    char token[8] = { 0 };
    (void)strncpy(token, &at[strlen(key)], (bug == 13) ? 3U : 7U);
    *out = (float)strtol(token, NULL, 10);
    return true;
}

static float torn(const float now, const float before) {
    return (float)(((unsigned)before & 0xFF00U) | ((unsigned)now & 0xFFU));
}

static answer_t sample(float u, float y, bool valid) {
    const unsigned index = taken++;
    float          u_in  = u;
    float          y_in  = y;
    switch (bug) {
    case 1:
        if (index == 0U) {
            return last;
        }
        break;
    case 2:
        if ((index % 64U) == 63U) {
            u_in = u_before;
            y_in = y_before;
        }
        break;
    case 3:
        y_in = (index > 0U) ? torn(y, y_before) : y;
        break;
    case 4:
        u_in = 16.0F * u;
        break;
    case 5:
        if ((index >= 65536U) && ((index & 0xFFFFU) == 0U)) {
            return last;  // the index is not newer than the one before
        }
        break;
    case 6:
        y_in = (y >= 2048.0F) ? (y - 4096.0F) : y;
        break;
    case 7:
        valid = true;
        break;
    case 12:
        u_in = (index > 0U) ? y_before : y;
        y_in = u;
        break;
    default:
        break;
    }
    u_before        = u;
    y_before        = y;
    answer_t answer = step(u_in, y_in, valid);
    if ((bug == 15) && ((index % 10U) == 7U)) {  // the reader interrupted the copy
        (void)memcpy(&answer.theta[3], &last.theta[3], 3U * sizeof(float));
    }
    return answer;
}

static void number(const float x) {
    const long  millionths = (long)(fabs((double)x) * 1e6 + 0.5);
    const char* sign       = (x < 0.0F) ? "-" : "";
    if (bug == 9) {
        (void)printf("%ld.%06ld", (long)x, labs(millionths % 1000000L));
    } else if (bug == 10) {
        (void)printf("%s%ld.%ld", sign, millionths / 1000000L, millionths % 1000000L);
    } else {
        (void)printf("%.9g", (double)x);
    }
}

static void print(const long i, const answer_t* const answer) {
    static const char* const before[6] = { "\"a\":[", ",", "],\"b\":[", ",", ",", "],\"d\":" };
    (void)printf("{\"i\":%ld,", i);
    for (unsigned k = 0; k < 6U; k++) {
        (void)fputs(before[k], stdout);
        number(answer->theta[k]);
    }
    (void)fputs(",\"e\":", stdout);
    number(answer->innovation);
    (void)fputs(",\"s\":", stdout);
    number(answer->statistic);
    (void)printf(",\"alarm\":%u}\n", (bug == 14) ? last.alarm : answer->alarm);
    (void)fflush(stdout);
}

int main(const int argc, char** const argv) {
    bug = (argc > 1) ? atoi(argv[1]) : 0;
    if (bug == 11) {
        config.forgetting = 0.98F;
    }
    begin();
    char line[128];
    while (fgets(line, sizeof(line), stdin) != NULL) {
        if (strstr(line, "reset") != NULL) {
            if (bug != 8) {
                begin();
            }
            taken = 0U;
            (void)puts("{\"ok\":\"reset\"}");
            (void)fflush(stdout);
            continue;
        }
        const char* const at = strstr(line, "\"i\":");
        if (at == NULL) {
            continue;
        }
        float          u;
        float          y;
        const bool     valid  = value_of(line, "\"u\":", &u) & value_of(line, "\"y\":", &y);
        const answer_t answer = sample(u, y, valid);
        print(strtol(&at[4], NULL, 10), &answer);
        last = answer;
    }
    return 0;
}
