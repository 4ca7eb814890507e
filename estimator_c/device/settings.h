/// The configuration of a device, its fields by the keys of the catalogue: one table says what each key stands for.

#ifndef SETTINGS_H_INCLUDED
#define SETTINGS_H_INCLUDED

#include "est.h"

typedef struct {
    est_config_t estimator;
    float        force_zero;  ///< u where the force is zero, for isolation [codes]
    bool         isolation;   ///< say which parameter has changed, where the estimator's configuration allows it
} settings_t;

typedef enum {
    SETTINGS_APPLIED      = 0,
    SETTINGS_UNKNOWN      = 1,  ///< no such key in this build
    SETTINGS_OUT_OF_RANGE = 2,  ///< not a value that the estimator can take for this field, whatever the others
} settings_result_t;

settings_t settings_default(void);

/// Sets one field. The configuration is as it was unless the result is SETTINGS_APPLIED. The fields come one by one: whether
/// they go together (C stable, theta not too long) is found out by whoever starts the estimator.
settings_result_t settings_set(settings_t* self, uint8_t key, float value);

/// What is set now; 0 for an unknown key.
float settings_get(const settings_t* self, uint8_t key);

#endif  // SETTINGS_H_INCLUDED
