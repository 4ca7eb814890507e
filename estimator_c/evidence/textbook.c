// SPDX-License-Identifier: MIT
/// Textbook recursive least squares for an ARX model with delay 1: regressor, prediction and update, without checks,
/// prefilter or trigger. The reference for the cost of the estimator (see cost.py). -DTEXTBOOK_N is the number of
/// parameters, half of them a's. The order is an argument, as in a library.

#include "subject.h"

#ifndef TEXTBOOK_N
#define TEXTBOOK_N 4U
#endif

#define P0 1.0e-4F  ///< a larger value makes the covariance form diverge in float32
#define FORGETTING 0.99F

typedef struct {
    float theta[TEXTBOOK_N];
    float phi[TEXTBOOK_N];
    float p[TEXTBOOK_N][TEXTBOOK_N];  ///< covariance; or U above the diagonal and D on it
} textbook_t;

const bool subject_drifts = false;

static textbook_t       state;
static volatile uint8_t order_n = TEXTBOOK_N / 2U;

/// Replace the oldest pair of samples by the newest.
static void shift(textbook_t* const self, const uint8_t order, const float u, const float y) {
    for (uint8_t i = (uint8_t)(order - 1U); i > 0U; i--) {
        self->phi[i]         = self->phi[i - 1U];
        self->phi[order + i] = self->phi[order + i - 1U];
    }
    self->phi[0]     = -y;
    self->phi[order] = u;
}

static float innovation(const textbook_t* const self, const uint8_t n, const float y) {
    float out = y;
    for (uint8_t i = 0U; i < n; i++) {
        out -= self->phi[i] * self->theta[i];
    }
    return out;
}

/// Ljung and Soderstrom, "Theory and Practice of Recursive Identification" (1983), equation 2.16, on the full matrix.
static void update_covariance(textbook_t* const self, const uint8_t n, const float e) {
    float gain[TEXTBOOK_N];
    float variance = FORGETTING;
    for (uint8_t i = 0U; i < n; i++) {
        gain[i] = 0.0F;
        for (uint8_t j = 0U; j < n; j++) {
            gain[i] += self->p[i][j] * self->phi[j];
        }
        variance += self->phi[i] * gain[i];
    }
    const float inverse = 1.0F / variance;
    for (uint8_t i = 0U; i < n; i++) {
        const float scaled = gain[i] * inverse;
        self->theta[i] += scaled * e;
        for (uint8_t j = 0U; j < n; j++) {
            self->p[i][j] = (self->p[i][j] - (scaled * gain[j])) * (1.0F / FORGETTING);
        }
    }
}

/// Bierman, "Factorization Methods for Discrete Sequential Estimation" (1977), section V.3.
static void update_factors(textbook_t* const self, const uint8_t n, const float e) {
    float gain[TEXTBOOK_N];
    float alpha = FORGETTING;
    for (uint8_t j = 0U; j < n; j++) {
        float f = self->phi[j];
        for (uint8_t i = 0U; i < j; i++) {
            f += self->p[i][j] * self->phi[i];
        }
        const float before = alpha;
        const float v      = self->p[j][j] * f;
        alpha += f * v;
        self->p[j][j] *= before / (alpha * FORGETTING);
        const float lambda = -f / before;
        gain[j]            = v;
        for (uint8_t i = 0U; i < j; i++) {
            const float u = self->p[i][j];
            self->p[i][j] = u + (gain[i] * lambda);
            gain[i] += v * u;
        }
    }
    for (uint8_t i = 0U; i < n; i++) {
        self->theta[i] += gain[i] * (e / alpha);
    }
}

/// The counted step.
__attribute__((noinline)) void
textbook_step(textbook_t* const self, const uint8_t order, const float u, const float y) {
    const uint8_t n = (uint8_t)(2U * order);
    const float   e = innovation(self, n, y);
#ifdef TEXTBOOK_FACTORS
    update_factors(self, n, e);
    (void)update_covariance;
#else
    update_covariance(self, n, e);
    (void)update_factors;
#endif
    shift(self, order, u, y);
}

SUBJECT void subject_begin(void) {
    for (uint8_t i = 0U; i < TEXTBOOK_N; i++) {
        state.p[i][i] = P0;
    }
}

SUBJECT void subject_enter(const float u, const float y, const bool valid) {
    (void)valid;  // missing samples are not supported
    textbook_step(&state, order_n, u, y);
}

/// Check that the static gain of the model is close to that of the plant: 0.6, or 0.82 after the change.
SUBJECT uint32_t subject_judge(void) {
    float a = 1.0F;
    float b = 0.0F;
    for (uint8_t i = 0U; i < (TEXTBOOK_N / 2U); i++) {
        a += state.theta[i];
        b += state.theta[(TEXTBOOK_N / 2U) + i];
    }
    return ((b > (0.5F * a)) && (b < a)) ? 0U : 1U;
}
