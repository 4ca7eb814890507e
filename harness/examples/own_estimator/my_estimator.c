/// Recursive least squares of y(k) = -a1 y(k-1) - a2 y(k-2) + b0 u(k) + b1 u(k-1) + b2 u(k-2) + d, and a naive CUSUM of
/// the squared innovation.
#include "analogrig_estimator.h"

enum { PARAMETERS = 6, WARM_UP_N = 60 };

typedef struct {
    double   theta[PARAMETERS], p[PARAMETERS][PARAMETERS];
    double   u1, u2, y1, y2;  // the samples before
    double   forgetting, variance, sum, drift, ceiling;
    unsigned valid_n;  // valid samples without a gap; two make an equation
    unsigned used_n;   // equations since the start or the last alarm
} rls_t;

static void forget(rls_t* self) {
    memset(self->p, 0, sizeof(self->p));
    for (int i = 0; i < PARAMETERS; i++) {
        self->p[i][i] = 1e4;
    }
    self->sum    = 0.0;
    self->used_n = 0U;
}

static int rls_init(rls_t* self) {
    self->forgetting = 0.998;
    self->variance   = 2.0;  // of the innovation in codes^2
    self->drift      = 10.0;
    self->ceiling    = 60.0;
    forget(self);
    return 0;
}

static int rls_set(rls_t* self, const char* name, double value) {
    double* const field = !strcmp(name, "forgetting") ? &self->forgetting
                          : !strcmp(name, "variance") ? &self->variance
                          : !strcmp(name, "drift")    ? &self->drift
                          : !strcmp(name, "ceiling")  ? &self->ceiling
                                                      : NULL;
    if (field == NULL || !(value > 0.0)) {
        return 1;  // unknown, or out of range
    }
    *field = value;
    return 0;
}

static void rls_step(rls_t* self, const analogrig_in_t* in, analogrig_out_t* out) {
    const double phi[PARAMETERS] = { -self->y1, -self->y2, in->u, self->u1, self->u2, 1.0 };
    double       gain[PARAMETERS], innovation = in->y, scale = self->forgetting;
    self->valid_n = in->valid ? self->valid_n + 1U : 0U;
    if (self->valid_n > 2U) {
        for (int i = 0; i < PARAMETERS; i++) {
            gain[i] = 0.0;
            for (int j = 0; j < PARAMETERS; j++) {
                gain[i] += self->p[i][j] * phi[j];
            }
            innovation -= self->theta[i] * phi[i];
            scale += phi[i] * gain[i];
        }
        for (int i = 0; i < PARAMETERS; i++) {
            self->theta[i] += gain[i] / scale * innovation;
            for (int j = 0; j < PARAMETERS; j++) {
                self->p[i][j] = (self->p[i][j] - gain[i] * gain[j] / scale) / self->forgetting;
            }
        }
        out->armed      = ++self->used_n > WARM_UP_N;
        out->innovation = (float)innovation;
        self->sum += innovation * innovation * self->forgetting / scale / self->variance - self->drift;
        self->sum      = (out->armed && self->sum > 0.0) ? self->sum : 0.0;
        out->statistic = (float)self->sum;
        out->alarm     = self->sum > self->ceiling;
        if (out->alarm) {
            forget(self);
        }
    }
    for (int i = 0; i < PARAMETERS; i++) {
        out->theta[i] = (float)self->theta[i];
    }
    self->u2 = self->u1, self->u1 = in->u, self->y2 = self->y1, self->y1 = in->y;
}

ANALOGRIG_ESTIMATOR_WITH_SETTINGS(rls_t,
                                  rls_init,
                                  rls_set,
                                  rls_step,
                                  "my estimator 1.0",
                                  PARAMETERS,
                                  ANALOGRIG_STATISTIC | ANALOGRIG_INNOVATION | ANALOGRIG_ARMED);
