/// The change triggers of est.h, apart from the estimator: they see the innovation and nothing else.
/// A new trigger is a new est_trigger_kind_t and a new function in est_trigger.c; the estimator does not change.

#ifndef EST_TRIGGER_H_INCLUDED
#define EST_TRIGGER_H_INCLUDED

#include "est.h"

/// True iff every value that this kind of trigger uses is in the range stated in est.h.
bool est_trigger_config_valid(const est_trigger_config_t* config);

typedef enum {
    EST_QUIET = 0,
    EST_ALARM = 1,
    EST_SLIP  = 2,  ///< not the plant, but the edges of u have moved by one sample
} est_finding_t;

/// Ready for the first innovation; the statistic is zero for the next quiet_n samples.
void est_trigger_restart(est_trigger_t* self, uint32_t quiet_n);

/// Edges are in doubt from this sample on: all readings of them start from what the statistic is now.
void est_trigger_begin_doubt(est_trigger_t* self);

/// True iff another reading of the edges in doubt has so far explained the innovations better than what was recorded.
bool est_trigger_in_doubt(const est_trigger_t* self);

/// Enters one innovation [codes] in every reading of the edges in doubt, the first as recorded, and its predicted
/// variance [codes^2]. doubt_n: samples since the doubt began; 0: no doubt, and only the first reading counts.
est_finding_t est_trigger_step(est_trigger_t*              self,
                               const est_trigger_config_t* config,
                               const float                 readings[EST_READINGS],
                               float                       variance,
                               uint16_t                    doubt_n);

#endif  // EST_TRIGGER_H_INCLUDED
