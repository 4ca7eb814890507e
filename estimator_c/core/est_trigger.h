/// The change triggers of est.h, apart from the estimator: they see the innovation and nothing else.
/// A new trigger is a new est_trigger_kind_t and a new function in est_trigger.c; the estimator does not change.

#ifndef EST_TRIGGER_H_INCLUDED
#define EST_TRIGGER_H_INCLUDED

#include "est.h"

/// True iff every value that this kind of trigger uses is in the range stated in est.h.
bool est_trigger_config_valid(const est_trigger_config_t* config);

/// Ready for the first innovation; the statistic is zero for the next quiet_n samples.
void est_trigger_restart(est_trigger_t* self, uint32_t quiet_n);

/// Enters one innovation [codes] and its square divided by its predicted variance [1]; true: alarm.
bool est_trigger_step(est_trigger_t* self, const est_trigger_config_t* config, float innovation, float normalised_square);

#endif  // EST_TRIGGER_H_INCLUDED
