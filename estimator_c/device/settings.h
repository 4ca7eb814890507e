/// The fields of the configuration by the keys of the catalogue: one table says what each key stands for.

#ifndef SETTINGS_H_INCLUDED
#define SETTINGS_H_INCLUDED

#include "est.h"

typedef enum {
    SETTINGS_APPLIED      = 0,
    SETTINGS_UNKNOWN      = 1,  ///< no such key in this build
    SETTINGS_OUT_OF_RANGE = 2,  ///< not a value that the estimator can take for this field, whatever the others
} settings_result_t;

/// Sets one field. The configuration is as it was unless the result is SETTINGS_APPLIED. The fields come one by one: whether
/// they go together (C stable, theta not too long) is found out by whoever starts the estimator.
settings_result_t settings_set(est_config_t* config, uint8_t key, float value);

/// What is set now; 0 for an unknown key.
float settings_get(const est_config_t* config, uint8_t key);

#endif  // SETTINGS_H_INCLUDED
