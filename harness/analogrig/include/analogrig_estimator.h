// SPDX-License-Identifier: MIT
/// Interface of an estimator to analogrig: a shared library with three functions. Needs no other file of analogrig.
///
///     #include "analogrig_estimator.h"
///     typedef struct { float mean; } mine_t;
///     static int  mine_init(mine_t* self) { self->mean = 2048.0F; return 0; }
///     static void mine_step(mine_t* self, const analogrig_in_t* in, analogrig_out_t* out) { ... out->alarm = 1U; }
///     ANALOGRIG_ESTIMATOR(mine_t, mine_init, mine_step, "mine 1.0", 0, 0);
///
///     cc -shared -fPIC -O2 -I"$(analogrig include)" -o mine.so mine.c && analogrig run --dut library:./mine.so
///
/// Samples come at the rate of the rig's card: 20,000/s on the shipped rigs, so T = 50 us of the machine. A program runs
/// `speed` times faster than its plant (front, shock: 200), so T is speed * 50 us of the plant: 10 ms for front.
/// Codes are volts at the card: volts = low + code * (high - low) / 2^bits. On the rig `emulator`, with 12 bits, u of
/// front is -1 to 11 V, y is -1 to 9 V, and channels of other programs are -12.5 to 12.5 V. Volts times the unit per
/// volt of the channel are the plant's units. `analogrig patch PROGRAM` prints T and all of these figures, the equations
/// with their parameters and, of a linear program, A, B, C and the sampled F, G.
///
/// u is held between samples: that of sample k moves y from sample k + 1 on. Both have noise of 1 LSB rms and are
/// rounded. Amplifiers' offsets move y off its model by some codes: estimate an offset, or a fixed model alarms at once.
/// An estimator with a fixed model states latches = true in the [datasheet] of its device file, which judges a record
/// up to its first alarm.
#ifndef ANALOGRIG_ESTIMATOR_H
#define ANALOGRIG_ESTIMATOR_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define ANALOGRIG_ABI 1U
#define ANALOGRIG_THETA_MAX 64U

/// Quantities that the estimator reports beside alarms and theta, for analogrig_about_t.reports. Others stay unjudged.
enum { ANALOGRIG_STATISTIC = 1, ANALOGRIG_INNOVATION = 2, ANALOGRIG_ARMED = 4 };

typedef struct {
    uint32_t    abi;          ///< ANALOGRIG_ABI
    uint32_t    theta_n;      ///< elements of theta, at most ANALOGRIG_THETA_MAX; 0: no estimate
    uint64_t    state_bytes;  ///< size of the state
    uint32_t    reports;      ///< or of ANALOGRIG_STATISTIC and others
    const char* name;         ///< name and version, for the record
} analogrig_about_t;

typedef struct {
    float    u, y;   ///< input and output of the plant in codes of the converter, 0 to 4095 at 12 bits
    uint32_t valid;  ///< 0: the sample is missing; u and y repeat the last valid sample
} analogrig_in_t;

typedef struct {
    uint8_t alarm;       ///< 1: the plant has changed
    uint8_t armed;       ///< 1: no warm-up or hold-off, an alarm was possible; for ANALOGRIG_ARMED
    uint8_t refused;     ///< 1: the estimator did not use this valid sample
    uint8_t done;        ///< 1: the other fields are written; a crash is reported at the first sample without it
    float   statistic;   ///< of the trigger, for ANALOGRIG_STATISTIC
    float   innovation;  ///< prediction error in codes, for ANALOGRIG_INNOVATION
    float   theta[ANALOGRIG_THETA_MAX];  ///< the record ends after the first theta_n
} analogrig_out_t;

typedef struct {
    const char* name;
    double      value;
} analogrig_setting_t;

#ifdef __cplusplus
extern "C" {
#endif
__attribute__((visibility("default"))) const analogrig_about_t* analogrig_about(void);

/// Begin a record. `state` is state_bytes of zeros, aligned to 64; it is never released, so it must not own memory.
/// Returns 0: ready; i > 0: settings[i - 1] is unknown or out of range; below 0: cannot start.
__attribute__((visibility("default"))) int analogrig_init(void* state, const analogrig_setting_t* settings, size_t n);

/// Take n samples in order. Record k of `out` is at k * stride, all zeros at first, and ends after theta_n elements.
__attribute__((visibility("default"))) void
analogrig_step(void* state, size_t n, const analogrig_in_t* in, void* out, size_t stride);
#ifdef __cplusplus
}
#endif

/// The three functions from two for one sample: int init(type*), 0 if ready, and
/// void step(type*, const analogrig_in_t*, analogrig_out_t*), whose output is all zeros at first; `done` is set for it.
#define ANALOGRIG_ESTIMATOR(type, init, step, name, theta_n, reports)                                                  \
    static int analogrig_has_no_setting(type* const self, const char* const key, const double value) {                 \
        (void)self, (void)key, (void)value;                                                                            \
        return 1;                                                                                                      \
    }                                                                                                                  \
    ANALOGRIG_ESTIMATOR_WITH_SETTINGS(type, init, analogrig_has_no_setting, step, name, theta_n, reports)

/// The same with int set(type*, const char* name, double value), called after init; 0: taken, other values: refused.
#define ANALOGRIG_ESTIMATOR_WITH_SETTINGS(type, init, set, step, name_, theta_n_, reports_)                            \
    const analogrig_about_t* analogrig_about(void) {                                                                   \
        static const analogrig_about_t about = { ANALOGRIG_ABI, theta_n_, sizeof(type), reports_, name_ };             \
        return &about;                                                                                                 \
    }                                                                                                                  \
    int analogrig_init(void* const state, const analogrig_setting_t* const settings, const size_t n) {                 \
        if (init((type*)state) != 0) {                                                                                 \
            return -1;                                                                                                 \
        }                                                                                                              \
        for (size_t i = 0U; i < n; i++) {                                                                              \
            if (set((type*)state, settings[i].name, settings[i].value) != 0) {                                         \
                return (int)i + 1;                                                                                     \
            }                                                                                                          \
        }                                                                                                              \
        return 0;                                                                                                      \
    }                                                                                                                  \
    void analogrig_step(void* const state, const size_t n, const analogrig_in_t* const in, void* const out,            \
                        const size_t stride) {                                                                         \
        const size_t used = offsetof(analogrig_out_t, theta) + (theta_n_) * sizeof(float);                             \
        for (size_t k = 0U; k < n; k++) {                                                                              \
            analogrig_out_t one;                                                                                       \
            char* const     record = (char*)out + k * stride;                                                          \
            (void)memset(&one, 0, used);                                                                               \
            step((type*)state, &in[k], &one);                                                                          \
            one.done = 0U;                                                                                             \
            (void)memcpy(record, &one, used);                                                                          \
            *(volatile uint8_t*)(record + offsetof(analogrig_out_t, done)) = 1U;                                       \
        }                                                                                                              \
    }                                                                                                                  \
    typedef char analogrig_theta_n_is_at_most_64[(theta_n_) <= ANALOGRIG_THETA_MAX ? 1 : -1]

#endif
