// SPDX-License-Identifier: MIT

#include "settings.h"

#include "analogrig_codec.h"

#include <stddef.h>

typedef struct {
    uint8_t  key;
    uint8_t  size;    ///< size of the member [bytes]
    uint16_t offset;  ///< offset of the member in settings_t
    uint16_t limit;   ///< largest value of an integer; 0: a floating-point number
} field_t;

#define MEMBER(name, member, most)                                                                                     \
    {                                                                                                                  \
        .key = ANALOGRIG_CONFIGURE_KEY_##name##_CHOICE, .size = (uint8_t)sizeof(((settings_t*)0)->member),             \
        .offset = (uint16_t)offsetof(settings_t, member), .limit = (most)                                              \
    }

#define NUMBER(name, member) MEMBER(name, member, 0U)

static const field_t FIELDS[] = {
    MEMBER(NA, estimator.na, UINT8_MAX),
    MEMBER(NB, estimator.nb, UINT8_MAX),
    MEMBER(NK, estimator.nk, UINT8_MAX),
    MEMBER(NC, estimator.nc, UINT8_MAX),
    MEMBER(OFFSET, estimator.offset, 1U),
    MEMBER(NOISE_ESTIMATED, estimator.noise_estimated, 1U),
    MEMBER(REFRESH_N, estimator.refresh_n, UINT16_MAX),
    MEMBER(STUCK_N, estimator.stuck_n, UINT8_MAX),
    MEMBER(IDLE_N, estimator.idle_n, UINT16_MAX),
    MEMBER(EDGE_INSTANTS, estimator.edge_instants, EST_EDGES_ANYWHERE),
    MEMBER(TRIGGER, estimator.trigger.kind, EST_TRIGGER_CUSUM),
    MEMBER(RESET, estimator.trigger.reset, EST_RESET_ALL),
    MEMBER(ABSOLUTE, estimator.trigger.absolute, 1U),
    MEMBER(HOLD_OFF_N, estimator.trigger.hold_off_n, UINT16_MAX),
    MEMBER(WARM_UP_N, estimator.trigger.warm_up_n, UINT16_MAX),
    MEMBER(ISOLATION, isolation, 1U),
    MEMBER(MISFIT, misfit, 1U),
    NUMBER(FORGETTING, estimator.forgetting),
    NUMBER(RANDOM_WALK, estimator.random_walk),
    NUMBER(P0, estimator.p0),
    NUMBER(P0_OFFSET, estimator.p0_offset),
    NUMBER(NOISE_VARIANCE, estimator.noise_variance),
    NUMBER(EDGE_CODES, estimator.edge_codes),
    NUMBER(CODE_LOW, estimator.code_low),
    NUMBER(CODE_HIGH, estimator.code_high),
    NUMBER(CEILING, estimator.trigger.ceiling),
    NUMBER(FORCE_ZERO, force_zero),
};

#define FIELDS_N (sizeof(FIELDS) / sizeof(FIELDS[0]))

/// Field of a key; its size is 0 if the key is unknown.
static field_t find_field(const uint8_t key) {
    const uint8_t first = ANALOGRIG_CONFIGURE_KEY_C1_CHOICE;
    if ((key >= first) && (key < (first + EST_NA_MAX))) {
        const size_t offset = offsetof(settings_t, estimator.c) + ((key - first) * sizeof(float));
        return (field_t){ .key = key, .size = (uint8_t)sizeof(float), .offset = (uint16_t)offset, .limit = 0U };
    }
    for (uint8_t i = 0U; i < FIELDS_N; i++) {
        if (FIELDS[i].key == key) {
            return FIELDS[i];
        }
    }
    return (field_t){ .key = key, .size = 0U };
}

/// Write an integer. Members have one byte, two, or the size of an enum.
static void put_whole(uint8_t* const member, const uint8_t size, const uint16_t value) {
    if (size == sizeof(uint8_t)) {
        *member = (uint8_t)value;
    } else if (size == sizeof(uint16_t)) {
        *(uint16_t*)(void*)member = value;
    } else {
        *(uint32_t*)(void*)member = value;
    }
}

static uint16_t get_whole(const uint8_t* const member, const uint8_t size) {
    if (size == sizeof(uint8_t)) {
        return *member;
    }
    return (size == sizeof(uint16_t)) ? *(const uint16_t*)(const void*)member
                                      : (uint16_t) * (const uint32_t*)(const void*)member;
}

/// True iff the field can hold the value. False for NaN.
static bool can_hold(const field_t field, const float value) {
    if (field.limit == 0U) {
        return analogrig_configure_value_is_in_range(value);
    }
    return (value >= 0.0F) && (value <= (float)field.limit) && !((value - (float)(uint16_t)value) > 0.0F);
}

static void put(settings_t* const self, const field_t field, const float value) {
    uint8_t* const member = (uint8_t*)self + field.offset;
    if (field.limit == 0U) {
        *(float*)(void*)member = value;
    } else {
        put_whole(member, field.size, (uint16_t)value);
    }
}

/// True iff the estimator accepts the value with suitable other fields. They are set one by one, in any order.
static bool is_acceptable(const field_t field, const float value) {
    settings_t base = settings_default();
#ifndef EST_FIXED_NA
    base.estimator.na     = 1U;
    base.estimator.nb     = 1U;
    base.estimator.nc     = 0U;
    base.estimator.offset = false;
#endif
    put(&base, field, value);
    for (uint8_t i = 0U; i < EST_NA_MAX; i++) {
        base.estimator.c[i] = 0.0F;
    }
    return est_config_valid(&base.estimator) && (base.force_zero >= -EST_CODE_LIMIT) &&
           (base.force_zero <= EST_CODE_LIMIT) && (DEVICE_WITH_FIT || !base.misfit);
}

settings_t settings_default(void) {
    return (settings_t){
        .estimator = est_config_default(), .force_zero = 0.0F, .isolation = true, .misfit = DEVICE_WITH_FIT
    };
}

settings_result_t settings_set(settings_t* const self, const uint8_t key, const float value) {
    const field_t field = find_field(key);
    if (field.size == 0U) {
        return SETTINGS_UNKNOWN;
    }
    if (!can_hold(field, value) || !is_acceptable(field, value)) {
        return SETTINGS_OUT_OF_RANGE;
    }
    put(self, field, value);
    return SETTINGS_APPLIED;
}

float settings_get(const settings_t* const self, const uint8_t key) {
    const field_t field = find_field(key);
    if (field.size == 0U) {
        return 0.0F;
    }
    const uint8_t* const member = (const uint8_t*)self + field.offset;
    return (field.limit == 0U) ? *(const float*)(const void*)member : (float)get_whole(member, field.size);
}
