/// Our estimator: analogrig's core, and a lockout of our own: after an alarm the next one is kept back for a while.

#include "est.h"

#if BUG
#define LOCKOUT_N 250U  // meant were 25
#else
#define LOCKOUT_N 25U
#endif

est_step_t core_est_step(est_t* self, est_sample_t sample);

est_step_t est_step(est_t* const self, const est_sample_t sample) {
    static uint32_t last_alarm;
    const uint32_t  now  = est_counters(self).updated + est_counters(self).missing;
    est_step_t      step = core_est_step(self, sample);
    if (now < last_alarm) {
        last_alarm = 0U;  // another run
    }
    if (step.alarm) {
        step.alarm = (last_alarm == 0U) || ((now - last_alarm) > LOCKOUT_N);
        last_alarm = step.alarm ? now : last_alarm;
    }
    return step;
}
