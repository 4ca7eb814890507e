#include "est_whitener.h"

#include "est_orders.h"

/// The gains have come to C once they are as near as this; what is left makes no noise worth the name.
#define SETTLED 1.0e-3F

/// Reflection coefficients beyond this belong to a C that filters the data into overflow.
#define REFLECTION_MAX 0.9999F

/// Schur-Cohn (step-down): all zeros are inside iff every reflection coefficient is below 1.
bool est_whitener_accepts(const float* const c, const uint8_t na) {
    float a[EST_NA_MAX];
    for (uint8_t i = 0U; i < na; i++) {
        a[i] = c[i];
    }
    for (uint8_t order = na; order > 0U; order--) {
        const float k = a[order - 1U];
        if (!((k > -REFLECTION_MAX) && (k < REFLECTION_MAX))) {
            return false;
        }
        const float rest = 1.0F - (k * k);
        float       lower[EST_NA_MAX];
        for (uint8_t i = 0U; (i + 1U) < order; i++) {
            lower[i] = (a[i] - (k * a[order - 2U - i])) / rest;
        }
        for (uint8_t i = 0U; (i + 1U) < order; i++) {
            a[i] = lower[i];
        }
    }
    return true;
}

void est_whitener_set(est_whitener_t* const self, const float* const c, const uint8_t na) {
    for (uint8_t i = 0U; i < na; i++) {
        self->c[i]       = c[i];
        self->gain[0][i] = c[i];
    }
}

void est_whitener_restart(est_whitener_t* const self) {
    self->n       = 0U;
    self->settled = false;
    for (uint8_t i = 0U; i < EST_NA_MAX; i++) {
        self->variance[i] = 1.0F;
        for (uint8_t j = 0U; j < EST_NA_MAX; j++) {
            self->gain[i][j] = 0.0F;
        }
        for (uint8_t j = 0U; j <= EST_THETA_MAX; j++) {
            self->past[i][j] = 0.0F;
        }
    }
}

/// The autocovariance of C(z) e at this lag.
static float autocovariance(const est_whitener_t* const self, const uint8_t na, const uint8_t lag) {
    float sum = (lag == 0U) ? 1.0F : self->c[lag - 1U];
    for (uint8_t i = 0U; (i + lag) < na; i++) {
        sum += self->c[i] * self->c[i + lag];
    }
    return sum;
}

static void shift_gains(est_whitener_t* const self, const uint8_t na) {
    for (uint8_t row = (uint8_t)(na - 1U); row > 0U; row--) {
        for (uint8_t i = 0U; i < na; i++) {
            self->gain[row][i] = self->gain[row - 1U][i];
        }
    }
}

static bool near(const float a, const float b) { return ((a - b) < SETTLED) && ((b - a) < SETTLED); }

static void settle(est_whitener_t* const self, const uint8_t na) {
    for (uint8_t i = 0U; i < na; i++) {
        if (!near(self->gain[0][i], self->c[i])) {
            return;
        }
    }
    self->settled = true;
}

/// One row of the Cholesky factor of the banded covariance matrix of the noise, scaled by its diagonal.
float est_whitener_advance(est_whitener_t* const self, const uint8_t na) {
    if (self->settled) {
        return 1.0F;
    }
    const uint8_t reach = (self->n < na) ? self->n : na;
    float         rest  = autocovariance(self, na, 0U);
    shift_gains(self, na);
    for (uint8_t i = na; i > 0U; i--) {
        float gain = 0.0F;
        if (i <= reach) {
            gain = autocovariance(self, na, i);
            for (uint8_t m = (uint8_t)(i + 1U); m <= reach; m++) {
                gain -= self->gain[0][m - 1U] * self->gain[i][m - i - 1U] * self->variance[m - 1U];
            }
            gain /= self->variance[i - 1U];
            rest -= gain * gain * self->variance[i - 1U];
        }
        self->gain[0][i - 1U] = gain;
    }
    for (uint8_t i = (uint8_t)(na - 1U); i > 0U; i--) {
        self->variance[i] = self->variance[i - 1U];
    }
    self->variance[0] = (rest > 1.0F) ? rest : 1.0F;
    self->n           = (uint8_t)(reach + 1U);
    settle(self, na);
    return self->variance[0];
}

float est_whitener_filter(const est_whitener_t* const self, const uint8_t na, float* const past, const float x) {
    float out = x;
    for (uint8_t i = NA_OF(na); i > 0U; i--) {
        out -= self->gain[0][i - 1U] * past[i - 1U];
        past[i - 1U] = (i > 1U) ? past[i - 2U] : out;
    }
    past[0] = out;
    return out;
}

void est_whitener_apply(est_whitener_t* const self, const uint8_t na, const uint8_t count, float* const phi) {
    EST_UNROLL
    for (uint8_t j = 0U; j <= COUNT(count); j++) {
        float out = phi[j];
        EST_UNROLL
        for (uint8_t i = (uint8_t)(NA_OF(na) - 1U); i > 0U; i--) {
            out -= self->gain[0][i] * self->past[i][j];
            self->past[i][j] = self->past[i - 1U][j];
        }
        out -= self->gain[0][0] * self->past[0][j];
        self->past[0][j] = out;
        phi[j]           = out;
    }
}
