/// The change triggers of est.h. They see the innovation, in every reading of the edges in doubt, and its variance, and
/// nothing else of the estimator. A user's trigger is a function in the configuration (est_trigger_fn); one of the library's
/// own is a new est_trigger_kind_t and a new function in est_trigger.c.

#ifndef EST_TRIGGER_H_INCLUDED
#define EST_TRIGGER_H_INCLUDED

#include "est_shape.h"

/// True iff every value is in the range stated in est.h, whether this kind of trigger uses it or not.
bool est_trigger_config_valid(const est_trigger_config_t* config);

typedef enum {
    EST_QUIET = 0,
    EST_ALARM = 1,
    EST_SLIP  = 2,  ///< not the plant, but the edges of u have moved by one sample
} est_finding_t;

/// Ready for the first innovation; the statistic is zero for the next quiet_n samples.
void est_trigger_restart(est_trigger_t* self, uint16_t quiet_n);

/// Edges are in doubt from this sample on: all readings of them start from what the statistic is now.
EST_OUTLINE void est_trigger_begin_doubt(est_trigger_t* const self) {
    EST_UNROLL
    for (uint_fast8_t i = 0U; i < (EST_READINGS - 1U); i++) {
        self->rival[i] = self->statistic;
    }
}

/// The doubt ends before its term, as when a gap takes away what the other readings rest on. If the innovations as recorded
/// had already passed the ceiling, another reading explained them: a slip. Else the statistic goes on from the best reading.
est_finding_t est_trigger_end_doubt(est_trigger_t* self, const est_trigger_config_t* config);

/// Makes the best of the other readings the statistic; true iff it is the one in which the edges came late.
bool est_trigger_settle_late(est_trigger_t* self);

/// True iff another reading of the edges in doubt has so far explained the innovations better than what was recorded.
bool est_trigger_in_doubt(const est_trigger_t* self);

/// Enters one innovation [codes] in every reading of the edges in doubt, the first as recorded, and the
/// reciprocal of its predicted variance [codes^-2]. doubt_n: samples since the doubt began; 0: no doubt, and only the first reading counts.
est_finding_t est_trigger_step(est_trigger_t*              self,
                               const est_trigger_config_t* config,
                               const float                 readings[EST_READINGS],
                               float                       precision,
                               uint16_t                    doubt_n);

#endif  // EST_TRIGGER_H_INCLUDED
