// SPDX-License-Identifier: MIT

#include "est_fit.h"
#include "est_assert.h"
#include "est_shape.h"

#include <stddef.h>

/// Samples of a sum that have work beside adding an innovation: the first ones enter the last sum into the resonators,
/// several each. Of every four from DRAWS_FROM on, one finds the region of the next, which draws its innovation.
#define ENTERED_N 8U
#define ENTERED_END (EST_FIT_LINES_N / ENTERED_N)
#define DRAWS_FROM 8U
#define DRAWS_PERIOD 4U

/// Samples of the evaluation: the lines, several each, and the regions one by one; the causes one by one; the
/// conclusion.
#define EVALUATED_N 2U
#define EVALUATED_END (ENTERED_END + EST_FIT_REGIONS_N)
#define CAUSES_N 5U
#define CONCLUSION (EVALUATED_END + CAUSES_N)

/// Innovations in a block below which nothing is stated: with many missing samples the estimate is less certain, and
/// the innovations are larger.
#define ENOUGH_N 400.0F

/// Limit of an innovation in standard deviations, squared.
#define CLIP 9.0F

/// Innovations of a block, of which some may be lost.
static const uint16_t BLOCK_N = EST_FIT_BLOCK_N;

/// Memory of the level of y [draws].
#define LEVEL_N 128U

/// Equations after an alarm that are excluded.
#define EXCLUDED_N 60U

/// Levels of y that bound the regions, and the change over two samples beyond which y moves [spreads].
#define LEVEL_BOUND 0.7F
#define MOVES 0.05F

/// Innovations in a region, and in all regions of a block, below which they explain nothing.
#define REGION_MIN 4U
#define DRAWN_MIN 64U

/// Limits of the statistics. DRIFT: squared mean of the innovations over its variance. LINE: power of a line over its
/// mean. REGIONS: share of the energy of the innovations that
/// the state of the plant explains. COLOUR: variance of the sums over that of white innovations. KURTOSIS: of the
/// limited innovations; Gaussian ones have 2.9. EXCESS: variance over the declared one. INFORMATION: on a change of
/// the mass, see weigh_lack().
#define DRIFT 40.0F
#define LINE 22.0F
#define REGIONS 0.2F
#define COLOUR 4.0F
#define KURTOSIS 3.3F
#define EXCESS 2.5F
#define INFORMATION 60.0F
#define INFORMATION_MIN 1.0e-3F

/// A line is hum if its share of the power of the sums exceeds the first, and its share of the energy of the
/// innovations that of the regions by the second: the response of a plant that is not linear has peaks too.
#define LINE_SHARE 0.6F
#define REGIONS_HUM 2.0F

/// Growth of the spread of y since the first block with which a growth of the innovations is not linear.
#define GROWTH 1.5F

/// 1 + a1 + a2 below which the plant hardly moves between two samples.
#define SLOW 0.0035F

/// Inflation of the scale from which the model is known not to fit: two alarms that were not justified.
#define INFLATION_MISFIT 8.0F

EST_SHARED float maximum(const float a, const float b) { return (a > b) ? a : b; }

/// a / b; 0 unless b is positive.
EST_SHARED float quotient(const float a, const float b) {
    float out = 0.0F;
    if (b > 0.0F) {
        out = a / b;
    }
    return out;
}

/// Improve a square root by one step of Newton's method.
static float improve_root(const float root, const float x) { return 0.5F * (root + (x / root)); }

// ---------------------------------------------        SIGNALS         ---------------------------------------------

/// Find the region of the state of the plant before the next sample, and follow the level of y.
static void find_region(est_fit_watch_t* const self, const est_t* const estimator) {
    const float above = estimator->y[0] - self->level;
    const float moved = estimator->y[0] - estimator->y[1];
    const float bound = LEVEL_BOUND * self->spread;
    const float moves = MOVES * self->spread;
    uint32_t    stage = 0U;
    uint32_t    trend = 0U;
    stage += (above < 0.0F) ? 0U : 1U;
    trend += (moved < -moves) ? 0U : 1U;
    stage += (above < -bound) ? 0U : 1U;
    stage += (above < bound) ? 0U : 1U;
    trend += (moved < moves) ? 0U : 1U;
    self->region     = (uint8_t)((3U * stage) + trend);
    self->learnt_n   = (uint8_t)(self->learnt_n + ((self->learnt_n < LEVEL_N) ? 1U : 0U));
    const float rate = 1.0F / (float)self->learnt_n;
    self->level += rate * above;
    self->spread += rate * (est_magnitude(above) - self->spread);
}

/// Second difference of y, whitened, as the last equation predicted it [codes].
static float predicted_difference(const est_t* const estimator, const float innovation) {
    return estimator->whitener.past[0].x[0] - innovation;
}

/// Enter an innovation into the sums that are costly. After an edge in doubt it says nothing on the state of the plant.
static void draw(est_fit_watch_t* const self, const est_t* const estimator, const float z, const float innovation) {
    est_fit_sums_t* const sums  = &self->sums;
    const float           moved = predicted_difference(estimator, innovation);
    sums->moved_n++;
    sums->moved += moved * moved;
    if (estimator->doubt_n == 0U) {
        sums->drawn_n++;
        sums->drawn += z * z;
        self->regions[self->region] += z;
        self->regions_n[self->region]++;
    }
}

/// True iff the estimator found that the position of the edges varies.
static bool edges_vary(const est_t* const estimator) {
#if EST_WITH_ROBUSTNESS
    return estimator->edges_vary;
#else
    (void)estimator;
    return false;
#endif
}

// ---------------------------------------------        SPECTRUM        ---------------------------------------------

/// 2 cos(pi k / EST_FIT_LINES_N)
static const float RESONANCE[EST_FIT_LINES_N] = {
    2.0F, 1.9615706F,   1.8477591F,   1.6629392F,  1.4142136F,  1.1111405F,  0.76536686F, 0.39018064F,
    0.0F, -0.39018064F, -0.76536686F, -1.1111405F, -1.4142136F, -1.6629392F, -1.8477591F, -1.9615706F,
};

/// Enter the last sum into a resonator (Goertzel's algorithm). In the first sum of a block it is brought to rest.
static void enter_line(est_fit_watch_t* const self, const uint32_t line) {
    if (self->sum_n == 0U) {
        self->now[line]    = 0.0F;
        self->before[line] = 0.0F;
    } else {
        const float now    = self->now[line];
        self->now[line]    = self->entered + ((RESONANCE[line] * now) - self->before[line]);
        self->before[line] = now;
    }
}

/// Replace a resonator by its power. The mean is no line.
static void evaluate_line(est_fit_watch_t* const self, const uint32_t line) {
    const float now    = self->now[line];
    const float before = self->before[line];
    self->now[line]    = (now * now) + (before * before) - ((RESONANCE[line] * now) * before);
    if ((line <= 1U) || (self->now[line] > self->now[self->peak])) {  // cppcheck F4
        self->peak = (uint8_t)line;
    }
}

/// Power of a line; 0 beyond the ends of the spectrum.
static float power_at(const est_fit_watch_t* const self, const uint32_t line) {
    return ((line >= 1U) && (line < EST_FIT_LINES_N)) ? self->now[line] : 0.0F;
}

/// Power of the larger neighbour of the peak.
static float neighbour_power(const est_fit_watch_t* const self) {
    return maximum(power_at(self, self->peak + 1U), power_at(self, self->peak - 1U));
}

/// Frequency of the line at the peak, from the powers of the peak and its larger neighbour [cycles per sample].
static float find_frequency(const est_fit_watch_t* const self) {
    const bool  upwards = power_at(self, self->peak + 1U) > power_at(self, self->peak - 1U);
    const float ratio   = quotient(neighbour_power(self), self->now[self->peak]);
    float       share   = 0.5F * (1.0F + ratio);
    for (uint8_t i = 0U; i < 4U; i++) {
        share = improve_root(share, ratio);
    }
    const float beside = share / (1.0F + share);
    const float line   = (float)self->peak + (upwards ? beside : -beside);
    return line / (float)BLOCK_N;
}

// ---------------------------------------------         CAUSES         ---------------------------------------------

static float declared_variance(const est_fit_watch_t* const self) {
    return self->config->noise_estimated ? 0.0F : self->config->noise_variance;
}

/// Number of innovations in the block.
static float count_of(const est_fit_watch_t* const self) { return (float)BLOCK_N - (float)self->sums.all.lost_n; }

static float variance_of(const est_fit_watch_t* const self) { return self->sums.all.squares / count_of(self); }

/// Variance to which the statistics relate: that of the innovations, or the declared one if that is more. The
/// structure of innovations that are smaller than promised does no harm.
static float reference_variance(const est_fit_watch_t* const self) {
    return maximum(variance_of(self), declared_variance(self));
}

/// Number of innovations in the spectrum.
static float clear_count_of(const est_fit_watch_t* const self) {
    return count_of(self) - (float)self->sums.all.doubted_n;
}

/// Energy in the spectrum at that variance.
static float clear_energy_of(const est_fit_watch_t* const self) {
    return reference_variance(self) * clear_count_of(self);
}

/// Share of the energy of the drawn innovations that is explained.
static float share_of(const est_fit_watch_t* const self, const float explained) {
    return quotient(explained, reference_variance(self) * (float)self->sums.drawn_n);
}

static float weigh_drift(const est_fit_watch_t* const self) {
    const float sum = self->sums.all.clear + self->sums.all.doubted;
    return quotient(sum * sum, reference_variance(self) * count_of(self) * DRIFT);
}

/// Weigh a line that is neither a harmonic of the excitation nor the peak of a broad spectrum.
static float weigh_hum(const est_fit_watch_t* const self) {
    const float power  = self->now[self->peak] + neighbour_power(self);  // it may lie between two lines
    const float energy = clear_energy_of(self);
    const float line   = quotient(power, energy);
    const float share  = quotient(line, 0.5F * clear_count_of(self));
    const float part   = quotient(power, (float)EST_FIT_LINES_N * (self->sums.power - energy));
    const bool  is_hum = (part > LINE_SHARE) && (share > (REGIONS_HUM * share_of(self, self->sums.explained)));
    const float weight = line / LINE;
    return is_hum ? weight : 0.0F;
}

/// Weigh innovations that have grown with y since the first block, or that the state of the plant explains.
static float weigh_nonlinearity(const est_fit_watch_t* const self) {
    const bool  grows  = self->spread > (GROWTH * self->first_spread);
    const float growth = grows ? quotient(variance_of(self), EXCESS * self->first_variance) : 0.0F;
    const float state  = (self->sums.drawn_n >= DRAWN_MIN) ? share_of(self, self->sums.repeated) : 0.0F;
    return maximum(growth, state / REGIONS);
}

static float weigh_noise(const est_fit_watch_t* const self) {
    const float variance = variance_of(self);
    const float colour   = quotient(self->sums.power, clear_energy_of(self) * COLOUR);
    const float kurtosis = quotient(self->sums.all.fourths, self->sums.all.squares * variance * KURTOSIS);
    const float excess   = quotient(variance, declared_variance(self) * EXCESS);
    return maximum(maximum(colour, kurtosis), excess);
}

/// Weigh the lack of information on a change of the mass. It scales the second difference of y, whitened.
static float weigh_lack(const est_fit_watch_t* const self) {
    const float information = quotient(self->sums.moved, reference_variance(self) * (float)self->sums.moved_n);
    return INFORMATION / maximum(information, INFORMATION_MIN);
}

/// Inflation of the scale over its limit: alarms were not justified.
static float scale_misfit(const est_t* const estimator) {
    return est_scale(estimator) / (INFLATION_MISFIT * est_noise_variance(estimator));
}

/// Weigh one cause. The model fits as far as it is concerned unless its strength exceeds 1. A slow plant may hide a
/// change for long, but lack of excitation is no news unless alarms were false.
static est_misfit_t weigh_cause(const est_fit_watch_t* const self, const est_t* const estimator, const uint32_t cause) {
    const bool   slow = estimator->theta[1] < SLOW;  // 1 + a1 + a2
    est_misfit_t out  = { .kind = EST_MISFIT_NONE, .strength = 0.0F, .frequency = 0.0F };
    switch (cause) {
    case 0U:
        out.kind     = EST_MISFIT_DRIFT;
        out.strength = weigh_drift(self);
        break;
    case 1U:
        out.kind     = EST_MISFIT_NONLINEAR;
        out.strength = weigh_nonlinearity(self);
        break;
    case 2U:
        out.kind     = EST_MISFIT_HUM;
        out.strength = weigh_hum(self);
        break;
    case 3U:
        out.kind     = EST_MISFIT_NOISE;
        out.strength = weigh_noise(self);
        break;
    default:
        out.kind     = slow ? EST_MISFIT_SLOW_PLANT : EST_MISFIT_EXCITATION;
        out.strength = (slow && (scale_misfit(estimator) <= 1.0F)) ? 0.0F : weigh_lack(self);
        break;
    }
    return out;
}

/// Test one cause, unless the block has too few innovations or an earlier cause is found. The first one beyond its
/// limit counts; until then, the strongest one.
static void test_cause(est_fit_watch_t* const self, const est_t* const estimator, const uint32_t cause) {
    const bool enough = (count_of(self) >= ENOUGH_N) && (self->sums.all.squares > 0.0F);
    if (enough && (self->found.strength <= 1.0F)) {
        const est_misfit_t weighed = weigh_cause(self, estimator, cause);
        if (weighed.strength > self->found.strength) {
            self->found = weighed;
        }
    }
}

// ---------------------------------------------         BLOCKS         ---------------------------------------------

static void begin_block(est_fit_watch_t* const self) {
    self->sums  = (est_fit_sums_t){ .power = 0.0F };
    self->found = (est_misfit_t){ .kind = EST_MISFIT_NONE };
    self->sum_n = 0U;
}

/// True iff the peak of the spectrum is where it was in the block before, or beside it.
static bool is_steady(const est_fit_watch_t* const self) {
    return (self->peak <= (self->last_peak + 1U)) && (self->last_peak <= (self->peak + 1U));
}

/// Complete what was found. A line that is elsewhere in the next block is noise. If the scale is inflated, the model
/// does not fit, whatever the cause.
static void complete(est_fit_watch_t* const self, const float inflation) {
    est_misfit_t* const found = &self->found;
    if ((found->strength <= 1.0F) && (inflation <= 1.0F)) {
        *found = (est_misfit_t){ .kind = EST_MISFIT_NONE };
    } else {
        found->strength = maximum(found->strength, inflation);
    }
    if ((found->kind == EST_MISFIT_HUM) && (self->candidate == EST_MISFIT_HUM) && !is_steady(self)) {
        found->kind = EST_MISFIT_NOISE;
    }
    if (found->kind == EST_MISFIT_HUM) {
        found->frequency = find_frequency(self);
    }
}

/// State what was found if the block before agrees that there is a misfit or none, or if the evidence suffices.
static void conclude(est_fit_watch_t* const self, const est_t* const estimator) {
    const float inflation = scale_misfit(estimator);
    complete(self, inflation);
    const est_misfit_t found    = self->found;
    const bool         again    = (found.kind == EST_MISFIT_NONE) == (self->candidate == EST_MISFIT_NONE);
    const bool         compared = found.kind == EST_MISFIT_NONLINEAR;  // with the block before
    if (!edges_vary(estimator) && (again || compared || (inflation > 1.0F))) {
        self->misfit = found;
    }
    self->candidate = found.kind;
    self->last_peak = self->peak;
    if (self->first_variance <= 0.0F) {
        self->first_variance = variance_of(self);
        self->first_spread   = self->spread;
    }
}

/// Add the energy that a region explains beyond chance, and clear it for the next block.
static void evaluate_region(est_fit_watch_t* const self, const uint32_t region) {
    const uint8_t n    = self->regions_n[region];
    const float   mean = (n >= REGION_MIN) ? (self->regions[region] / (float)n) : 0.0F;
    self->sums.explained += (self->regions[region] * mean) - (self->sums.drawn / (float)self->sums.drawn_n);
    self->sums.repeated += self->regions[region] * self->means[region];
    self->means[region]     = mean;
    self->regions[region]   = 0.0F;
    self->regions_n[region] = 0U;
}

/// Do the share of the evaluation that falls to one of the samples after the block.
static void evaluate(est_fit_watch_t* const self, const est_t* const estimator, const uint32_t slot) {
    if (slot < ENTERED_END) {
        return;  // MISRA D4
    }
    if (slot < EVALUATED_END) {
        const uint32_t turn = slot - ENTERED_END;
        for (uint32_t line = EVALUATED_N * turn; (line < (EVALUATED_N * (turn + 1U))) && (line < EST_FIT_LINES_N);
             line++) {
            evaluate_line(self, line);
        }
        evaluate_region(self, turn);
    } else if (slot < CONCLUSION) {
        test_cause(self, estimator, slot - EVALUATED_END);
    } else if (slot == CONCLUSION) {
        conclude(self, estimator);
    } else {
        // the evaluation is complete
    }
}

/// Close a sum of the innovations: enter it into the block, and follow the noise.
static void close_sum(est_fit_watch_t* const self, const est_t* const estimator) {
    est_fit_moments_t* const all = &self->sums.all;
    self->entered                = self->pending.clear;
    self->limit                  = improve_root(self->limit, CLIP * est_noise_variance(estimator));
    if (self->settling_n > 0U) {
        self->settling_n--;
    } else {
        all->clear += self->pending.clear;
        all->doubted += self->pending.doubted;
        all->squares += self->pending.squares;
        all->fourths += self->pending.fourths;
        all->lost_n    = (uint16_t)(all->lost_n + self->pending.lost_n);
        all->doubted_n = (uint16_t)(all->doubted_n + self->pending.doubted_n);
        self->sums.power += self->entered * self->entered;
        self->sum_n++;
    }
    if (edges_vary(estimator)) {
        self->misfit = (est_misfit_t){ .kind = EST_MISFIT_EDGES, .strength = 1.0F };
    }
}

/// Find the region of the next sample, or draw the innovation of this one: two of DRAWS_PERIOD samples.
static void
work_on_draws(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step, const float z) {
    if ((self->slot % DRAWS_PERIOD) == 0U) {
        if ((step.status == EST_UPDATED) || (step.status == EST_GATHERING)) {
            find_region(self, estimator);
        }
    } else if ((step.status == EST_UPDATED) && (self->excluded_n == 0U) && (self->settling_n == 0U)) {
        draw(self, estimator, z, step.innovation);
    } else {
        // nothing to draw
    }
}

/// Do the part of the work that falls to this sample of a sum.
static void work(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step, const float z) {
    const uint32_t slot = self->slot;
    const bool     full = self->sum_n >= EST_FIT_SUMS_N;
    if (slot < ENTERED_END) {
        for (uint32_t i = 0U; i < ENTERED_N; i++) {
            enter_line(self, (ENTERED_N * slot) + i);
        }
    }
    if (full) {
        evaluate(self, estimator, slot);
    } else if ((slot >= DRAWS_FROM) && ((slot % DRAWS_PERIOD) < 2U)) {
        work_on_draws(self, estimator, step, z);
    } else {
        // only lines have work
    }
    if (slot < (EST_FIT_SUM_N - 1U)) {
        self->slot = (uint8_t)(slot + 1U);
        return;  // MISRA D4
    }
    self->slot = 0U;
    if (full) {
        begin_block(self);
    } else {
        close_sum(self, estimator);
    }
    self->pending = (est_fit_moments_t){ .clear = 0.0F };
}

// ---------------------------------------------          API           ---------------------------------------------

bool est_fit_init(est_fit_watch_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != NULL) && (config != NULL));
    *self       = (est_fit_watch_t){ .config = config, .settling_n = EST_FIT_SETTLING_N };
    self->limit = CLIP * config->noise_variance;
    return config->na == 2U;
}

void est_fit_enter(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step) {
    EST_ASSERT((self != NULL) && (estimator != NULL));
    float z = 0.0F;
    if ((step.status == EST_UPDATED) && (self->excluded_n == 0U)) {
        z = step.innovation;
        if (!(est_magnitude(z) <= self->limit)) {
            z = (z < 0.0F) ? -self->limit : self->limit;
        }
        const float square = z * z;
        self->pending.squares += square;
        self->pending.fourths += square * square;
        if (estimator->doubt_n == 0U) {
            self->pending.clear += z;
        } else {
            self->pending.doubted += z;
            self->pending.doubted_n++;
        }
    } else {
        self->pending.lost_n++;
        self->excluded_n = (uint8_t)(self->excluded_n - ((self->excluded_n > 0U) ? 1U : 0U));
    }
    if (step.alarm) {
        self->excluded_n = EXCLUDED_N;
    }
    work(self, estimator, step, z);
}

est_misfit_t est_fit_misfit(const est_fit_watch_t* const self) {
    EST_ASSERT(self != NULL);
    return self->misfit;
}
