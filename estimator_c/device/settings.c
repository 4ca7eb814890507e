#include "settings.h"

#include "analogrig_codec.h"

#include <float.h>
#include <stddef.h>

typedef struct {
    uint8_t  key;
    uint8_t  size;    ///< of the member [bytes]
    uint16_t offset;  ///< of the member in est_config_t
    uint16_t limit;   ///< the largest whole number; 0: a floating-point number
} field_t;

#define MEMBER(name, member, most)                                                                                     \
    {                                                                                                                  \
        .key = ANALOGRIG_CONFIGURE_KEY_##name##_CHOICE, .size = (uint8_t)sizeof(((est_config_t*)0)->member),           \
        .offset = (uint16_t)offsetof(est_config_t, member), .limit = (most)                                            \
    }

#define NUMBER(name, member) MEMBER(name, member, 0U)

static const field_t FIELDS[] = {
    MEMBER(NA, na, UINT8_MAX),
    MEMBER(NB, nb, UINT8_MAX),
    MEMBER(NK, nk, UINT8_MAX),
    MEMBER(NC, nc, UINT8_MAX),
    MEMBER(OFFSET, offset, 1U),
    MEMBER(NOISE_ESTIMATED, noise_estimated, 1U),
    MEMBER(REFRESH_N, refresh_n, UINT16_MAX),
    MEMBER(STUCK_N, stuck_n, UINT8_MAX),
    MEMBER(IDLE_N, idle_n, UINT16_MAX),
    MEMBER(EDGE_INSTANTS, edge_instants, EST_EDGES_ANYWHERE),
    MEMBER(TRIGGER, trigger.kind, EST_TRIGGER_CUSUM),
    MEMBER(RESET, trigger.reset, EST_RESET_ALL),
    MEMBER(ABSOLUTE, trigger.absolute, 1U),
    MEMBER(HOLD_OFF_N, trigger.hold_off_n, UINT16_MAX),
    MEMBER(WARM_UP_N, trigger.warm_up_n, UINT16_MAX),
    NUMBER(FORGETTING, forgetting),
    NUMBER(RANDOM_WALK, random_walk),
    NUMBER(P0, p0),
    NUMBER(P0_OFFSET, p0_offset),
    NUMBER(NOISE_VARIANCE, noise_variance),
    NUMBER(EDGE_CODES, edge_codes),
    NUMBER(CODE_LOW, code_low),
    NUMBER(CODE_HIGH, code_high),
    NUMBER(CEILING, trigger.ceiling),
};

#define FIELDS_N (sizeof(FIELDS) / sizeof(FIELDS[0]))

/// What the key stands for; a field of size 0 for an unknown key.
static field_t field_of(const uint8_t key) {
    const uint8_t first = ANALOGRIG_CONFIGURE_KEY_C1_CHOICE;
    if ((key >= first) && (key < (first + EST_NA_MAX))) {
        const size_t offset = offsetof(est_config_t, c) + ((key - first) * sizeof(float));
        return (field_t){ .key = key, .size = (uint8_t)sizeof(float), .offset = (uint16_t)offset, .limit = 0U };
    }
    for (uint8_t i = 0U; i < FIELDS_N; i++) {
        if (FIELDS[i].key == key) {
            return FIELDS[i];
        }
    }
    return (field_t){ .key = key, .size = 0U };
}

/// Of a whole number: the members have one byte, two, or that of an enumeration.
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

/// A value that the field can hold. False for NaN too.
static bool holds(const field_t field, const float value) {
    if (field.limit == 0U) {
        return (value >= -FLT_MAX) && (value <= FLT_MAX);
    }
    return (value >= 0.0F) && (value <= (float)field.limit) && !((value - (float)(uint16_t)value) > 0.0F);
}

static void put(est_config_t* const config, const field_t field, const float value) {
    uint8_t* const member = (uint8_t*)config + field.offset;
    if (field.limit == 0U) {
        *(float*)(void*)member = value;
    } else {
        put_whole(member, field.size, (uint16_t)value);
    }
}

/// A value that the estimator can take, whatever the other fields will come to: they are set one by one.
static bool acceptable(const field_t field, const float value) {
    est_config_t base = est_config_default();
#ifndef EST_FIXED_NA
    base.na     = 1U;
    base.nb     = 1U;
    base.nc     = 0U;
    base.offset = false;
#endif
    put(&base, field, value);
    for (uint8_t i = 0U; i < EST_NA_MAX; i++) {
        base.c[i] = 0.0F;
    }
    return est_config_valid(&base);
}

settings_result_t settings_set(est_config_t* const config, const uint8_t key, const float value) {
    const field_t field = field_of(key);
    if (field.size == 0U) {
        return SETTINGS_UNKNOWN;
    }
    if (!holds(field, value) || !acceptable(field, value)) {
        return SETTINGS_OUT_OF_RANGE;
    }
    put(config, field, value);
    return SETTINGS_APPLIED;
}

float settings_get(const est_config_t* const config, const uint8_t key) {
    const field_t field = field_of(key);
    if (field.size == 0U) {
        return 0.0F;
    }
    const uint8_t* const member = (const uint8_t*)config + field.offset;
    return (field.limit == 0U) ? *(const float*)(const void*)member : (float)get_whole(member, field.size);
}
