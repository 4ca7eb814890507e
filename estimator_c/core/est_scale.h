// SPDX-License-Identifier: MIT
/// Scale of the innovations: the variance that the trigger expects of them. It is the noise variance, followed on line,
/// times an inflation. The inflation grows with alarms that the new estimate does not justify: the model then does not
/// fit the plant, and what cannot be told from the misfit must not raise alarms. Part of est_robust.h.

#ifndef EST_SCALE_H_INCLUDED
#define EST_SCALE_H_INCLUDED

#include "est_trigger.h"

/// Equations of a block. The four stages of the update take one equation each, so that a block comes every 36. A change
/// that raises an alarm within its block leaves the scale as it was before the change.
#define EST_BLOCK_N 32U

/// Stages of the scale. A block is followed by the stages of the update, one a step, so that none is long: correlation
/// and dispersion of the innovations follow the block, the noise variance follows it, a hidden change is found, and the
/// next block begins. The validation of an alarm replaces all of these.
#define EST_STAGE_BLOCK 0U
#define EST_STAGE_SHAPE 1U
#define EST_STAGE_NOISE 2U
#define EST_STAGE_CHANGE 3U
#define EST_STAGE_END 4U
#define EST_STAGE_VALIDATION 5U

/// Smallest share of a new block in the noise variance: a memory of 1,100 equations. Before the trigger is armed the
/// share is larger, because C and theta still change.
#define EST_SHARE_MIN 0.032F
#define EST_SHARE_WARM 0.25F

/// A block is high if its mean square reaches this many noise variances that contain it. A high block counts a step,
/// each other block takes one off; at the limit an alarm is due. It finds a change that an inflated scale hides: the
/// residual of a misfit has peaks, a change lasts.
#define EST_HIGH 5.0F
#define EST_HIGH_STEP 3U
#define EST_HIGH_LIMIT 7U

/// Increase of the scale per share of the newest block: after few blocks the noise variance is uncertain.
#define EST_MARGIN 2.0F

/// Dispersion of the blocks, mean of their squared mean squares in noise variances, beyond which the scale grows, and
/// factor. That of Gaussian innovations is 1.06; noise whose variance varies has more. Largest value of one block.
#define EST_DISPERSED 1.15F
#define EST_DISPERSION_GAIN 2.0F
#define EST_DISPERSION_MAX 10.0F

/// Smallest noise variance that is followed, in configured ones: quantisation alone, with the default. The innovations
/// of a plant without noise come in bursts.
#define EST_NOISE_LEAST 0.07F

/// Largest mean square of a block that counts, in noise variances. Before the trigger is armed, an outlier might pass
/// all bounds; later it raises an alarm or is set aside.
#define EST_GROWTH_MAX 9.0F

/// Inflation: factor per unjustified alarm, factor per block on the way back to 1 (a factor of 4 in 470,000 equations),
/// and largest value.
#define EST_INFLATION_STEP 4.0F
#define EST_INFLATION_DECAY 0.9998933F
#define EST_INFLATION_MAX 1.0e6F

/// After an alarm, whose equation counts as the first, the old estimate is compared with the new one from equation
/// EST_VALIDATION_BEGIN_N + 1 to EST_VALIDATION_N, and further until an edge of u came, but no further than
/// EST_VALIDATION_MAX_N. A validation that ends at an alarm needs EST_VALIDATION_LEAST_N equations.
#define EST_VALIDATION_BEGIN_N 16U
#define EST_VALIDATION_LEAST_N 20U
#define EST_VALIDATION_N 56U
#define EST_VALIDATION_MAX_N 120U

/// An alarm is justified if the squared errors of the old estimate exceed those of the new one by this factor.
#define EST_JUSTIFIED 4.0F

/// A justified alarm is evident if its sum exceeds 64 expected variances per equation.
#define EST_EVIDENT (64.0F * ((float)EST_VALIDATION_N - (float)EST_VALIDATION_BEGIN_N) * EST_CUSUM_GAIN)

/// Blocks that justify an alarm which is not evident, and largest number of them: one alarm per 5,700 equations, at
/// most four in close succession. A plant whose equations fit it only for a while justifies every alarm, but its
/// squared errors stay comparable to the scale.
#define EST_BUDGET_N 157U
#define EST_BUDGET_MAX_N (4U * EST_BUDGET_N)

/// Mean square of a block, of the sum of its terms over their weight.
#define EST_MEAN_SQUARE (1.0F / (EST_INNOVATION_SCALE * EST_INNOVATION_SCALE * (float)EST_BLOCK_N))

/// Equations to the end of the warm-up below which the noise variance is followed with its final memory.
#define EST_WARM_N 64U

/// Factor of the noise variance in the scale.
static inline float est_scale_factor(const est_scale_t* const self) {
    return self->inflation * (1.0F + (EST_DISPERSION_GAIN * est_max(self->dispersion - EST_DISPERSED, 0.0F)));
}

/// Begin a block. The scale determines the weight of a squared innovation in the cumulative sum.
static inline void est_scale_restart(est_t* const estimator) {
    est_scale_t* const self = &estimator->scale;
    self->weight =
        EST_CUSUM_GAIN / (estimator->noise_variance * est_scale_factor(self) * (1.0F + (EST_MARGIN * self->share)));
    self->sum     = 0.0F;
    self->product = 0.0F;
    self->stage   = EST_STAGE_BLOCK;
    self->block_n = 0U;
}

static inline void est_scale_init(est_t* const estimator) {
    est_scale_t* const self = &estimator->scale;
    self->inflation         = 1.0F;
    self->dispersion        = 1.0F;
    if (estimator->config->noise_estimated) {
        self->share = 1.0F;
    }
    self->budget_n = EST_BUDGET_MAX_N;
    est_scale_restart(estimator);
}

/// Begin anew with another model of the edges: the innovations so far are those of the wrong one.
static inline void est_scale_forgive(est_t* const estimator) {
    est_scale_t* const self = &estimator->scale;
    self->inflation         = 1.0F;
    self->dispersion        = 1.0F;
    if (estimator->config->noise_estimated) {
        self->share = EST_SHARE_WARM;
    }
    est_scale_restart(estimator);
}

/// Enter the term of one innovation in the cumulative sum. Return false iff the block is complete.
EST_INLINE bool est_scale_enter(est_scale_t* const self, const float term) {
    if (self->stage != EST_STAGE_BLOCK) {
        return false;
    }
    self->block_n++;
    self->sum += term;
    if (self->block_n >= EST_BLOCK_N) {
        self->stage = EST_STAGE_SHAPE;
    }
    return true;
}

/// Enter a product of innovations, unless the block is complete.
static inline void est_scale_enter_product(est_scale_t* const self, const float product) {
    if (self->stage == EST_STAGE_BLOCK) {
        self->product += product;
    }
}

/// Discard the products of an incomplete block.
static inline void est_scale_discard_products(est_scale_t* const self) {
    if (self->stage == EST_STAGE_BLOCK) {
        self->product = 0.0F;
    }
}

/// Mean square of the innovations of a complete block.
static inline float est_scale_mean(const est_scale_t* const self) {
    return (self->sum * EST_MEAN_SQUARE) / self->weight;
}

/// Let the dispersion follow a complete block, whose mean square is `ratio` noise variances.
static inline void est_scale_disperse(est_scale_t* const self, const float ratio) {
    const float square = est_min(ratio * ratio, EST_DISPERSION_MAX);
    self->dispersion += self->share * (square - self->dispersion);
}

/// Let the noise variance follow a complete block of this mean square.
static inline void est_scale_follow(est_t* const estimator, const float mean) {
    est_scale_t* const self    = &estimator->scale;
    const float        before  = estimator->noise_variance;
    const float        limited = est_min(mean, EST_GROWTH_MAX * before);
    const float        noise   = before + (self->share * (limited - before));
    const float        least   = (estimator->trigger.quiet_n < EST_WARM_N) ? EST_SHARE_MIN : EST_SHARE_WARM;
    self->share                = est_max(self->share / (1.0F + self->share), least);
    estimator->noise_variance  = est_max(noise, EST_NOISE_LEAST * estimator->config->noise_variance);
}

/// Count a complete block, which is high or not.
static inline void est_scale_count(est_scale_t* const self, const bool high) {
    if (high && (self->high_n < EST_HIGH_LIMIT)) {
        self->high_n = (uint8_t)(self->high_n + EST_HIGH_STEP);
    } else if (!high && (self->high_n > 0U)) {
        self->high_n--;
    } else {
        // at a bound
    }
}

/// Let the inflation decrease, and the number of alarms that may be justified increase, by one block.
static inline void est_scale_relax(est_scale_t* const self) {
    self->inflation = est_max(self->inflation * EST_INFLATION_DECAY, 1.0F);
    if (self->budget_n < EST_BUDGET_MAX_N) {
        self->budget_n++;
    }
}

/// Begin the validation of an alarm. The block restarts after it.
static inline void est_scale_begin_validation(est_scale_t* const self) {
    self->stage        = EST_STAGE_VALIDATION;
    self->validation_n = 1U;
    self->gained       = 0.0F;
}

/// True while an alarm is under validation.
static inline bool est_scale_validates(const est_scale_t* const self) { return self->stage == EST_STAGE_VALIDATION; }

/// Conclude the validation of an alarm: the alarm is justified, or the scale is inflated.
static inline void est_scale_conclude(est_t* const estimator) {
    est_scale_t* const self      = &estimator->scale;
    const bool         justified = (self->validation_n > EST_VALIDATION_LEAST_N) && (self->gained > 0.0F);
    if (justified && ((self->gained * self->weight) > EST_EVIDENT)) {
        // an evident one costs no budget
    } else if (justified && (self->budget_n >= EST_BUDGET_N)) {
        self->budget_n = (uint16_t)(self->budget_n - EST_BUDGET_N);
    } else if (self->inflation < EST_INFLATION_MAX) {
        self->inflation *= EST_INFLATION_STEP;
    } else {
        // the scale is large enough
    }
    est_scale_restart(estimator);
}

/// Enter one equation into the validation of an alarm: the squared errors of the old and the new estimate, the latter
/// relative to its variance. Return false iff the equation is the last one.
EST_INLINE bool est_scale_validate(est_scale_t* const  self,
                                   const float         old_square,
                                   const float         new_square,
                                   const uint_fast16_t edge_age_n) {
    self->validation_n++;
    const uint32_t n = self->validation_n;
    if (n > EST_VALIDATION_BEGIN_N) {
        self->gained += old_square - (EST_JUSTIFIED * new_square);
    }
    return (n < EST_VALIDATION_N) || ((edge_age_n >= n) && (n < EST_VALIDATION_MAX_N));
}

#endif  // EST_SCALE_H_INCLUDED
