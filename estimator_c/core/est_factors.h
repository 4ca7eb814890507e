/// The covariance of theta in factors: P = U D U' with U unit upper triangular, in units of the noise variance. A product of
/// this form cannot lose symmetry, and stays positive as long as D does. A build of fixed order unrolls its loops.

#ifndef EST_FACTORS_H_INCLUDED
#define EST_FACTORS_H_INCLUDED

#include "est.h"

/// The variances that a reset gives: of all parameters but the last, and of the last.
typedef struct {
    float p0;
    float p0_last;
} est_prior_t;

/// P := P0.
void est_factors_reset(est_factors_t* self, uint8_t count, est_prior_t prior);

/// One measurement: Bierman, "Factorization Methods for Discrete Sequential Estimation" (1977), section V.3, with the
/// forgetting factor of thesis Equ 3.21. gain[] receives P phi, unscaled.
/// Returns alpha = forgetting * variance + phi' P phi, where variance is that of the measurement's noise.
///
/// No d leaves the range that makes sense. Without the upper limit the variance of a direction that is not excited grows by
/// 1 / forgetting per equation, without end ("covariance blow-up", thesis 3.6); no direction needs to be less certain than it
/// was at the start. Without the lower one a direction excited beyond all measure would be lost to underflow.
float est_factors_measure(est_factors_t* self,
                          uint8_t        count,
                          est_prior_t    prior,
                          const float*   phi,
                          float          forgetting,
                          float          variance,
                          float*         gain);

/// Every parameter walks: P := P + variance I, no d beyond the prior. Thornton, "Triangular covariance factorizations for
/// Kalman filtering" (1976): modified weighted Gram-Schmidt on (U, I).
void est_factors_walk(est_factors_t* self, uint8_t count, est_prior_t prior, float variance);

/// Every parameter is less certain by this factor.
void est_factors_inflate(est_factors_t* self, uint8_t count, est_prior_t prior, float factor);

/// One diagonal element of P.
float est_factors_variance(const est_factors_t* self, uint8_t count, uint8_t index);

#endif  // EST_FACTORS_H_INCLUDED
