// SPDX-License-Identifier: MIT
/// library: the estimator as a shared library of the host. It runs est_step() over blocks of samples, without frames
/// or links, for campaigns and exploration. The caller owns the state.

#ifndef LIBRARY_H_INCLUDED
#define LIBRARY_H_INCLUDED

#include "est.h"
#include "settings.h"

#include <stddef.h>

typedef struct {
    settings_t settings;
    est_t      estimator;
} library_t;

/// Results for each of n samples. A null pointer omits that result.
typedef struct {
    float*   theta;       ///< n rows of est_theta_count()
    float*   innovation;  ///< n
    float*   statistic;   ///< n
    uint8_t* status;      ///< n of est_status_t
    uint8_t* alarm;       ///< n
} library_out_t;

/// sizeof(library_t), for callers in other languages.
size_t library_size(void);

/// Set the default configuration. The estimator is not started.
void library_init(library_t* self);

/// Set one field of the configuration by its key in the catalogue; see settings_set().
settings_result_t library_set(library_t* self, uint8_t key, float value);

/// Start the estimator. Return false iff the fields of the configuration do not fit together.
bool library_start(library_t* self);

/// Enter n samples in order. A sample is missing where valid[] is 0; with a null pointer all are valid.
/// Return the number of alarms.
size_t
library_run(library_t* self, size_t n, const float* u, const float* y, const uint8_t* valid, const library_out_t* out);

/// Enter codes as they lie in a table of all channels, `stride` codes from sample to sample; else as library_run().
size_t library_run_codes(library_t*           self,
                         size_t               n,
                         size_t               stride,
                         const uint16_t*      u,
                         const uint16_t*      y,
                         const uint8_t*       valid,
                         const library_out_t* out);

/// Enter `records` records of n codes each, one after the other, as library_run_codes(). The estimator is started before each.
/// out has room for all samples. counters: those after each record. Return false iff library_start() does.
bool library_run_records(library_t*           self,
                         size_t               records,
                         size_t               n,
                         size_t               stride,
                         const uint16_t*      u,
                         const uint16_t*      y,
                         const uint8_t*       valid,
                         const library_out_t* out,
                         est_counters_t*      counters);

/// Number of parameters.
uint8_t library_theta_count(const library_t* self);

est_counters_t library_counters(const library_t* self);

#endif  // LIBRARY_H_INCLUDED
