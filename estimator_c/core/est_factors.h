/// The covariance of theta in factors: P = U D U' / weight with U unit upper triangular, in units of the noise variance. A product of
/// this form cannot lose symmetry, and stays positive as long as D does.

#ifndef EST_FACTORS_H_INCLUDED
#define EST_FACTORS_H_INCLUDED

#include "est_shape.h"

/// Without a lower limit, certain beyond the precision of float32 by any measure of the data, a direction excited beyond all
/// measure would be lost to underflow.
#define EST_D_MIN 1.0e-30F

/// Below this weight the d's are due for a look at their upper limit; below the second one also if the step is a long one.
#define EST_WEIGHT_DUE 0.5F
#define EST_WEIGHT_OVERDUE 0.25F

/// Every parameter of this shape is less certain by this factor, but no d beyond the prior, and the weight 1 again. Without that limit the
/// variance of a direction that is not excited grows by 1 / forgetting per equation, without end ("covariance blow-up", thesis
/// 3.6); no direction needs to be less certain than it was at the start.
EST_INLINE void est_factors_scale(est_factors_t* const      self,
                                  const est_config_t* const config,
                                  const est_shape_t         shape,
                                  const float               factor) {
    const float p0        = config->p0;
    const float p0_offset = config->p0_offset;
    const float scale     = factor / self->weight;
    self->weight          = 1.0F;
    const uint_fast8_t count = est_shape_count(shape);
    EST_UNROLL
    for (uint_fast8_t j = 0U; j < count; j++) {
        const float d     = self->d[j] * scale;
        const float prior = est_is_offset(shape, j) ? p0_offset : p0;
        self->d[j]        = (d < prior) ? d : prior;
    }
}

/// The same for the shape of the configuration.
void est_factors_inflate(est_factors_t* self, const est_config_t* config, float factor);

void est_factors_reset(est_factors_t* self, const est_config_t* config);

/// Every parameter walks: P := P + random_walk I. The factors of Thornton's time update, "Triangular
/// covariance factorizations for Kalman filtering" (1976), by rank-one updates, which need no work space.
void est_factors_walk(est_factors_t* self, const est_config_t* config);

/// One diagonal element of P.
float est_factors_variance(const est_factors_t* self, uint_fast8_t count, uint_fast8_t index);

#endif  // EST_FACTORS_H_INCLUDED
