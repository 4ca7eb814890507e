// SPDX-License-Identifier: MIT
/// settings: the configuration of a device, accessed by the keys of the catalogue.

#ifndef SETTINGS_H_INCLUDED
#define SETTINGS_H_INCLUDED

#include "est.h"

/// 0 omits the watch of the fit, est_fit.h. A device without it has the setting, but only as false.
#ifndef DEVICE_WITH_FIT
#define DEVICE_WITH_FIT 1
#endif

/// Configuration of a device.
typedef struct {
    est_config_t estimator;
    float        force_zero;  ///< u at zero force, for the isolation [codes]
    bool         isolation;   ///< diagnose the changed parameter, if the configuration of the estimator allows it
    bool         misfit;      ///< watch whether the model fits, if the configuration of the estimator allows it
} settings_t;

/// Result of settings_set().
typedef enum {
    SETTINGS_APPLIED      = 0,
    SETTINGS_UNKNOWN      = 1,  ///< this build has no such key
    SETTINGS_OUT_OF_RANGE = 2,  ///< the estimator accepts no such value, whatever the other fields
} settings_result_t;

/// Return the default configuration.
settings_t settings_default(void);

/// Set one field. Unless the result is SETTINGS_APPLIED, the configuration is unchanged. Fields are checked one by
/// one; whether they fit together (C stable, theta not too long) is checked by est_init().
settings_result_t settings_set(settings_t* self, uint8_t key, float value);

/// Return the value of a field; 0 for an unknown key.
float settings_get(const settings_t* self, uint8_t key);

#endif  // SETTINGS_H_INCLUDED
