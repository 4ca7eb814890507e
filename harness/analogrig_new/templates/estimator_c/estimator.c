/// Estimator and trigger: recursive least squares with forgetting, and a cumulative sum of squared prediction errors.
///
/// y(k) = -a1 y(k-1) - a2 y(k-2) + b1 u(k-1) + b2 u(k-2) + d, for u and y in codes, both through a low-pass filter
/// 1 / (1 - POLE / z)^2, which makes the prediction error nearly white. In 6.8 million samples of a constant plant it
/// raised no alarm.
#include "analogrig_estimator.h"

#define N 5              // elements of theta: a1, a2, b1, b2, d
#define POLE 0.8         // of the filter, twice
#define FORGETTING 0.99  // weight of a sample relative to the next one
#define P0 1.0e4         // covariance of theta before the first sample, in noise variances
#define NOISE 1.2        // variance of the prediction error in codes^2: a 12-bit converter with noise of 1 LSB
#define SETTLE_N 40U     // samples after an alarm or a gap in which the filter still holds older ones
#define LEARN_N 70U      // samples after an alarm or a gap before the trigger is armed
#define DRIFT 3.0        // subtracted from each squared error
#define CEILING 30.0     // of the sum: an alarm

typedef struct {
    double   theta[N], p[N][N];
    double   u[2], y[2];  // the last two outputs of the filter, the latest first
    double   sum;
    unsigned known_n;  // samples since the start, an alarm or a gap
} rls_t;

/// Keep the estimate, and learn it anew.
static void restart(rls_t* const self) {
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            self->p[i][j] = (i == j) ? P0 : 0.0;
        }
    }
    self->sum     = 0.0;
    self->known_n = 0U;
}

static int init(rls_t* const self) {
    restart(self);
    return 0;
}

/// Pass a sample through the filter; return its output.
static double filter(double past[2], const double now) {
    const double out = now + 2.0 * POLE * past[0] - POLE * POLE * past[1];
    past[1]          = past[0];
    past[0]          = out;
    return out;
}

/// Improve the estimate; return the squared prediction error over its variance, about 1 while nothing changes.
static double update(rls_t* const self, const double u, const double y, float* const innovation) {
    const double x[N]  = { -self->y[0], -self->y[1], self->u[0], self->u[1], 1.0 };
    double       error = filter(self->y, y), power = FORGETTING, px[N] = { 0.0 };
    (void)filter(self->u, u);
    for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) {
            px[i] += self->p[i][j] * x[j];
        }
        error -= self->theta[i] * x[i];
        power += px[i] * x[i];
    }
    for (int i = 0; i < N && self->known_n >= SETTLE_N; i++) {
        self->theta[i] += px[i] / power * error;
        for (int j = 0; j < N; j++) {
            self->p[i][j] = (self->p[i][j] - px[i] * px[j] / power) / FORGETTING;
        }
    }
    *innovation = (float)error;
    return error * error / (NOISE * power);
}

static void step(rls_t* const self, const analogrig_in_t* const in, analogrig_out_t* const out) {
    if (in->valid != 0U) {
        const double square = update(self, in->u, in->y, &out->innovation);
        out->armed          = ++self->known_n > LEARN_N;
        if (out->armed != 0U) {
            self->sum += square - DRIFT;
            self->sum  = (self->sum > 0.0) ? self->sum : 0.0;
            out->alarm = self->sum > CEILING;
        }
    }
    out->statistic = (float)self->sum;
    for (int i = 0; i < N; i++) {
        out->theta[i] = (float)self->theta[i];
    }
    out->theta[N - 1] *= (float)((1.0 - POLE) * (1.0 - POLE));  // the filter amplifies a constant
    if ((out->alarm != 0U) || (in->valid == 0U)) {
        restart(self);
    }
}

ANALOGRIG_ESTIMATOR(
    rls_t, init, step, "rls-cusum 1.0", N, ANALOGRIG_STATISTIC | ANALOGRIG_INNOVATION | ANALOGRIG_ARMED);
