// SPDX-License-Identifier: MIT
/// Serial correlation of the innovations. The innovations of a model that fits are white. With coloured noise, or a
/// model that is not exact, they come in waves, whose squares reach the ceiling of the trigger together. An alarm then
/// needs a second hypothesis of them: what an autoregression of order 2, estimated here, leaves of each innovation. The
/// plant has changed only if the sums of both hypotheses have passed the ceiling. Part of est_robust.h.

#ifndef EST_CORRELATION_H_INCLUDED
#define EST_CORRELATION_H_INCLUDED

#include "est_scale.h"

/// Sum of the squared partial correlations from which on the innovations have a second hypothesis. That of white
/// innovations is 0.002 on average.
#define EST_CORRELATED 0.012F

/// Squared correlation beyond which they have none. Such innovations are the slow residual of a poor model: their
/// squares have no peaks, while what an autoregression leaves of them has.
#define EST_SMOOTH 0.62F

/// Share of a block in a partial correlation, before the trigger is armed and later.
#define EST_PARTIAL_WARM 0.5F
#define EST_PARTIAL_SHARE 0.04F

/// Energy of the innovations, over the measured one, to which their products are related: noise of the estimate would
/// otherwise remove part of a change. Largest magnitude of a partial correlation.
#define EST_PARTIAL_LOAD 1.05F
#define EST_PARTIAL_MAX 0.98F

/// Increase of the variance of the second hypothesis per unit of leverage, which is the part of an innovation's
/// variance that is due to theta. What a poor model leaves is largest where the regressor is larger than those before.
#define EST_LEVERAGE 25.0F

/// Work of each step of a block: none, or products of innovations at lag 1 or 2, and the second hypothesis.
#define EST_WORK_LAG_1 1U
#define EST_WORK_LAG_2 2U
#define EST_WORK_LAGS 3U
#define EST_WORK_COLOURED 4U
#define EST_WORK_OTHER_TRIGGER 8U  ///< none, for good: the trigger is not the cumulative sum

/// Blocks from one with products to the next while there is no second hypothesis: most steps are without work. Even.
#define EST_RESTING_N 4U

/// True iff the innovations have a second hypothesis.
EST_INLINE bool est_correlation_coloured(const est_correlation_t* const self) {
    return (self->work & EST_WORK_COLOURED) != 0U;
}

/// True iff the innovations are the slow residual of a poor model.
static inline bool est_correlation_smooth(const est_correlation_t* const self) {
    return (self->partial[0] * self->partial[0]) > EST_SMOOTH;
}

/// Forget the last innovations: the next one does not follow them.
static inline void est_correlation_forget(est_correlation_t* const self) {
    clear(self->last, 2U);
    self->lead = 0.0F;
}

/// Enter one innovation into the products of the block at lag 1. `precision`: reciprocal of its variance [1 / noise
/// variance].
static inline void est_correlation_multiply(est_correlation_t* const self,
                                            est_scale_t* const       scale,
                                            const float              e,
                                            const float              precision) {
    est_scale_enter_product(scale, precision * (e * self->last[0]));
    self->last[0] = e;
}

/// Enter one innovation into the products of the block and into both hypotheses. `statistic`: their smaller sum so far;
/// `term`: of the first hypothesis; `weight`: of a squared innovation in the sums; `precision`: reciprocal of its
/// variance [1 / noise variance]. Return the smaller sum.
static inline float est_correlation_enter(est_correlation_t* const self,
                                          est_scale_t* const       scale,
                                          const float              e,
                                          const float              statistic,
                                          const float              term,
                                          const float              weight,
                                          const float              precision) {
    const float first    = self->partial[0];
    const float second   = self->partial[1];
    const float before   = self->last[0];
    const float forward  = e - (first * before);
    const float backward = self->last[1] - (first * before);
    self->last[1]        = before;
    if ((self->work & EST_WORK_LAG_2) != 0U) {
        est_scale_enter_product(scale, precision * (forward * backward));
        self->last[0] = e;
    } else {
        est_correlation_multiply(self, scale, e, precision);
    }
    const float left   = (1.0F - (first * first)) * (1.0F - (second * second));  // of the variance
    const float spread = 1.0F + (EST_LEVERAGE * (1.0F - precision));
    const float one    = est_trigger_sum(statistic + est_max(self->lead, 0.0F), term);
    const float other  = est_trigger_sum(statistic + est_max(-self->lead, 0.0F),
                                         est_trigger_term(forward - (second * backward), weight / (left * spread)));
    self->lead         = one - other;
    return est_min(one, other);
}

/// Improve the partial correlation of the lag of a complete block. `product`: sum of its products; `mean`: its mean
/// square; `share`: of the block in the estimate.
static inline void est_correlation_follow(est_correlation_t* const self,
                                          const float              product,
                                          const float              mean,
                                          const float              noise_variance,
                                          const float              share) {
    const bool   second  = (self->work & EST_WORK_LAG_2) != 0U;
    float* const partial = &self->partial[second ? 1U : 0U];
    const float  left    = second ? (1.0F - (self->partial[0] * self->partial[0])) : 1.0F;
    const float  error   = (product / (float)EST_BLOCK_N) - (EST_PARTIAL_LOAD * left * mean * *partial);
    const float  next    = *partial + ((share * error) / est_max(mean, noise_variance));
    *partial             = est_max(est_min(next, EST_PARTIAL_MAX), -EST_PARTIAL_MAX);
}

/// Begin a block. The correlation at lag 2 is estimated while there is a second hypothesis.
static inline void est_correlation_restart(est_correlation_t* const self) {
    const float squares  = (self->partial[0] * self->partial[0]) + (self->partial[1] * self->partial[1]);
    const bool  coloured = (squares > EST_CORRELATED) && !est_correlation_smooth(self);
    if (!est_correlation_coloured(self)) {
        est_correlation_forget(self);
    }
    self->slot = (uint8_t)((self->slot + 1U) % EST_RESTING_N);
    if (coloured) {
        self->work = (uint8_t)(EST_WORK_COLOURED + (((self->slot % 2U) == 0U) ? EST_WORK_LAG_1 : EST_WORK_LAG_2));
    } else {
        self->work = (self->slot == 0U) ? EST_WORK_LAG_1 : 0U;
    }
}

#endif  // EST_CORRELATION_H_INCLUDED
