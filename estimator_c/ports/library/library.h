/// The estimator as a shared library of this computer: whole blocks of samples through est_step(), without frames or links.
/// For campaigns and for exploring; the caller owns the state.

#ifndef LIBRARY_H_INCLUDED
#define LIBRARY_H_INCLUDED

#include "est.h"
#include "settings.h"

#include <stddef.h>

typedef struct {
    settings_t settings;
    est_t      estimator;
} library_t;

/// What each of n samples gave. A null pointer: not wanted.
typedef struct {
    float*   theta;       ///< n rows of est_theta_count()
    float*   innovation;  ///< n
    float*   statistic;   ///< n
    uint8_t* status;      ///< n of est_status_t
    uint8_t* alarm;       ///< n
} library_out_t;

/// Of library_t [bytes].
size_t library_size(void);

/// The default configuration; the estimator is not yet there.
void library_init(library_t* self);

/// One field of the configuration, by its key of the catalogue; see settings_set().
settings_result_t library_set(library_t* self, uint8_t key, float value);

/// The first sample is the next. Returns false iff the fields of the configuration do not go together.
bool library_start(library_t* self);

/// n samples, one after the other. A sample counts as missing where valid[] is 0; a null pointer: all are valid.
/// Returns the number of alarms.
size_t
library_run(library_t* self, size_t n, const float* u, const float* y, const uint8_t* valid, const library_out_t* out);

/// Parameters of theta.
uint8_t library_theta_count(const library_t* self);

est_counters_t library_counters(const library_t* self);

#endif  // LIBRARY_H_INCLUDED
