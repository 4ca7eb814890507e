// SPDX-License-Identifier: MIT

#include "est_fit.h"
#include "est_assert.h"
#include "est_shape.h"

#include <stddef.h>

/// Samples of a sum that have work beside adding an innovation: the first ones enter the last sum into the resonators,
/// several each. One of every four finds the region of the next four; from DRAWS_FROM on it draws its innovation.
#define ENTERED_N 8U
#define ENTERED_END (EST_FIT_LINES_N / ENTERED_N)
#define DRAWS_FROM 8U
#define DRAWS_PERIOD 4U
#define DRAWS_SLOT 2U

/// Samples of the evaluation: the lines, several each, and the regions one by one; the causes one by one; the
/// conclusion.
#define EVALUATED_N 2U
#define EVALUATED_END (ENTERED_END + EST_FIT_REGIONS_N)
#define CONCLUSION (EVALUATED_END + 5U)

/// Innovations in a block below which nothing is stated: with many missing samples the estimate is less certain, and
/// the innovations are larger.
#define ENOUGH_N 400.0F

/// Limit of an innovation in standard deviations, squared; and of one factor in its fourth power, over that limit. An
/// innovation beyond its limit that follows another has the factor FOLLOWING, by which it counts as Gaussian: an edge
/// that moved, or a change of the plant, has several.
#define CLIP 9.0F
#define OUTLIER 11.0F
#define FOLLOWING 0.33F

/// Memory of the level of y [draws].
#define LEVEL_N 128U

/// Equations after an alarm that are excluded.
#define EXCLUDED_N 60U

/// Levels of y that bound the regions, and the change over two samples beyond which y moves [spreads].
#define LEVEL_BOUND 0.7F
#define MOVES 0.05F

/// Innovations in a region, and in all regions of a block, below which they explain nothing. The third: innovations in
/// a region below which its energy is not compared.
#define REGION_MIN 4U
#define DRAWN_MIN 64U
#define ENERGY_MIN 8U

/// Limits of the statistics. DRIFT: squared mean of the innovations over its variance. LINE: power of a line over its
/// mean. REGIONS: share of the energy of the innovations that the state of the plant explains. INFORMATION: on a change
/// of the mass, see weigh_lack().
#define DRIFT 40.0F
#define LINE 22.0F
#define REGIONS 0.27F
#define INFORMATION 60.0F
#define INFORMATION_MIN 1.0e-3F

/// Limits of the statistics of noise, which two blocks share. COLOUR: variance of the sums over that of white
/// innovations. ALONG: squared correlation of successive innovations over its variance. UNEVEN: squared deviations of
/// the energies of the regions, in squared variances. TAILS: kurtosis above that of innovations that are GAUSSIAN and
/// limited. EXCESS: variance over the declared one. RISE: variance over that of the block before. STEEP: squared excess
/// of the energy where y is steep, over its variance, which is at least EVEN squared steepnesses; beside it outliers
/// count by TAILS_PART.
#define COLOUR 6.8F
#define ALONG 85.0F
#define UNEVEN 140.0F
#define GAUSSIAN 2.9F
#define TAILS 0.88F
#define EXCESS 5.0F
#define RISE 1.55F
#define STEEP 78.0F
#define TAILS_PART 0.5F
#define EVEN 0.01F

/// Part of the configured variance that is due to the resolution of the codes, and more. Rounding depends on the state
/// of the plant, and varies only where y moves.
#define RESOLUTION 0.25F

/// Evidence for noise that either block needs, as a change of the plant disturbs only one. Beside ALARMED_N alarms less
/// suffices, by the factor ALARMED for each alarm. One that was not justified counts UNJUSTIFIED_N more.
#define NOISE_EACH 0.5F
#define ALARMED 0.45F
#define ALARMED_N 3U
#define UNJUSTIFIED_N 2U

/// A line is hum if its share of the power of the sums exceeds LINE_SHARE, and its share of the energy of the
/// innovations that of the regions by REGIONS_HUM: the response of a plant that is not linear has peaks too. Between
/// two lines, some of its power is in others; BETWEEN makes up for it. In the LOW_LINES_N lowest lines noise that jumps
/// has peaks, and LOW_SHARE applies. A line is steady if neither block has more than STEADY times the other's power,
/// and its frequency differs by no more than BESIDE [lines]. A mean is drift if its share exceeds MEAN_SHARE: noise of
/// low frequency has means too.
#define LINE_SHARE 0.66F
#define LOW_SHARE 0.79F
#define LOW_LINES_N 3U
#define BETWEEN 0.25F
#define REGIONS_HUM 2.0F
#define STEADY 2.0F
#define BESIDE 0.65F
#define MEAN_SHARE 0.85F

/// Strength of a dependence on the state of the plant from which on that is the cause of lines and of correlation; and
/// its least ratio to the variance of the sums, because coloured noise seems to depend on the state.
#define DEPENDENT 0.3F
#define DEPENDENT_COLOUR 0.06F

/// Growth of the spread of y since the first block with which a growth of the innovations is not linear, and that
/// growth.
#define GROWTH 1.5F
#define GROWN 2.5F

/// 1 + a1 + a2 below which the plant hardly moves between two samples.
#define SLOW 0.0035F

/// Inflation of the scale from which the model is known not to fit: two alarms that were not justified.
#define INFLATION_MISFIT 8.0F

/// A count as a number.
static float number(const uint32_t n) { return (float)n; }

/// a / b; 0 unless b is positive.
static float quotient(const float a, const float b) {
    float out = 0.0F;
    if (b > 0.0F) {
        out = a / b;
    }
    return out;
}

/// Improve a square root by one step of Newton's method.
static float improve_root(const float root, const float x) { return 0.5F * (root + (x / root)); }

// ---------------------------------------------        SIGNALS         ---------------------------------------------

/// Add the energy of the innovations since the last call to the present region, unless `counts` is false.
static void count_energy(est_fit_watch_t* const self, const bool counts) {
    const uint32_t n = (EST_FIT_SUM_N * self->sum_n) + self->slot + 1U - self->sums.lost_n;
    if (counts) {
        const float    energy    = self->sums.squares - self->sums.counted;
        const uint32_t energy_n  = n - self->sums.counted_n;
        const float    steepness = self->steepness * (float)energy_n;
        self->energies[self->region] += energy;
        self->energies_n[self->region] = (uint16_t)(self->energies_n[self->region] + energy_n);
        self->sums.steep += self->steepness * energy;
        self->sums.steepness += steepness;
        self->sums.steepness_squares += self->steepness * steepness;
    }
    self->sums.counted   = self->sums.squares;
    self->sums.counted_n = (uint16_t)n;
}

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
    self->steepness  = moved * moved;
    self->learnt_n   = (uint8_t)(self->learnt_n + ((self->learnt_n < LEVEL_N) ? 1U : 0U));
    const float rate = 1.0F / (float)self->learnt_n;
    self->level += rate * above;
    self->spread += rate * (est_magnitude(above) - self->spread);
}

/// Second difference of y, whitened, as the last equation predicted it [codes].
static float predicted_difference(const est_t* const estimator, const float innovation) {
    return estimator->whitener.past[0].x[0] - innovation;
}

/// Enter an innovation into the sums that are costly. After an ambiguous edge it says nothing on the state of the
/// plant.
static void draw(est_fit_watch_t* const self, const est_t* const estimator, const float z, const float innovation) {
    est_fit_sums_t* const sums  = &self->sums;
    const float           moved = predicted_difference(estimator, innovation);
    sums->moved_n++;
    sums->moved += moved * moved;
    if (estimator->ambiguity_n == 0U) {
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
    return est_max(power_at(self, self->peak + 1U), power_at(self, self->peak - 1U));
}

/// Power of the peak, which may lie between two lines.
static float peak_power(const est_fit_watch_t* const self) { return self->now[self->peak] + neighbour_power(self); }

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
    return line / number(EST_FIT_BLOCK_N);
}

// ---------------------------------------------         CAUSES         ---------------------------------------------

static float declared_variance(const est_fit_watch_t* const self) {
    return self->config->noise_estimated ? 0.0F : self->config->noise_variance;
}

/// Number of innovations in the block.
static float count_of(const est_fit_watch_t* const self) { return number(EST_FIT_BLOCK_N) - (float)self->sums.lost_n; }

static float variance_of(const est_fit_watch_t* const self) { return quotient(self->sums.squares, count_of(self)); }

/// This variance, or that of the resolution if that is more.
static float resolved(const est_fit_watch_t* const self, const float variance) {
    return est_max(variance, RESOLUTION * self->config->noise_variance);
}

/// Variance to which the statistics relate: that of the innovations, or the declared one or that of the resolution if
/// these are more. The structure of innovations that are smaller than promised does no harm.
static float reference_variance(const est_fit_watch_t* const self) {
    return est_max(resolved(self, variance_of(self)), declared_variance(self));
}

/// Number of innovations in the spectrum.
static float clear_count_of(const est_fit_watch_t* const self) {
    return count_of(self) - (float)self->sums.ambiguous_n;
}

/// Energy in the spectrum at that variance.
static float clear_energy_of(const est_fit_watch_t* const self) {
    return reference_variance(self) * clear_count_of(self);
}

/// Share of the energy of the drawn innovations that is explained.
static float share_of(const est_fit_watch_t* const self, const float explained) {
    return quotient(explained, reference_variance(self) * (float)self->sums.drawn_n);
}

/// Weigh a mean that is more than a part of a broad spectrum.
static float weigh_drift(const est_fit_watch_t* const self) {
    const float sum    = self->sums.total;
    const float beyond = number(EST_FIT_SUMS_N) * (self->sums.power - clear_energy_of(self));
    const float weight = quotient(sum * sum, reference_variance(self) * count_of(self) * DRIFT);
    return ((sum * sum) > (MEAN_SHARE * beyond)) ? weight : 0.0F;
}

/// Weigh a line that is neither a harmonic of the excitation nor the peak of a broad spectrum.
static float weigh_hum(const est_fit_watch_t* const self) {
    const float power  = peak_power(self);
    const float energy = clear_energy_of(self);
    const float line   = quotient(power, energy);
    const float share  = quotient(line, 0.5F * clear_count_of(self));
    const float whole  = power + (BETWEEN * neighbour_power(self));
    const float part   = quotient(whole, (float)EST_FIT_LINES_N * (self->sums.power - energy));
    const float least  = (self->peak <= LOW_LINES_N) ? LOW_SHARE : LINE_SHARE;
    const bool  is_hum = (part > least) && (share > (REGIONS_HUM * share_of(self, self->sums.explained)));
    const float weight = line / LINE;
    return is_hum ? weight : 0.0F;
}

/// Weigh innovations that have grown with y since the first block, or that the state of the plant explains.
static float weigh_nonlinearity(const est_fit_watch_t* const self) {
    const bool  grows  = self->spread > (GROWTH * self->first_spread);
    const float growth = grows ? quotient(variance_of(self), GROWN * self->first_variance) : 0.0F;
    const float state  = (self->sums.drawn_n >= DRAWN_MIN) ? share_of(self, self->sums.repeated) : 0.0F;
    return est_max(growth, state / REGIONS);
}

/// Inflation of the scale over its limit: alarms were not justified. The dispersion of the blocks, which est_scale()
/// contains too, is no evidence of that.
static float scale_misfit(const est_t* const estimator) {
#if EST_WITH_ROBUSTNESS
    return estimator->scale.inflation / INFLATION_MISFIT;
#else
    (void)estimator;
    return 0.0F;
#endif
}

/// Weigh outliers: the kurtosis. That of fewer innovations is less certain, and counts less.
static float weigh_tails(const est_fit_watch_t* const self) {
    const float variance = variance_of(self);
    const float level    = resolved(self, variance);
    const float beyond   = self->sums.fourths - (GAUSSIAN * self->sums.squares * variance);
    return beyond / (level * level * number(EST_FIT_BLOCK_N) * TAILS);
}

/// Weigh noise that grows with the steepness of y, in this block and the one before: energy where y is steep, beyond
/// its share. Its variance is proportional to the squared deviations of the steepness.
static float weigh_steepness(est_fit_watch_t* const self) {
    const est_fit_sums_t* const sums      = &self->sums;
    const float                 n         = (float)sums->energy_n;
    const float                 variance  = quotient(sums->energy, n);
    const float                 steepness = quotient(sums->steepness, n);
    const float                 steep = quotient(sums->steep - (variance * sums->steepness), resolved(self, variance));
    const float                 variety = ((1.0F + EVEN) * sums->steepness_squares) - (steepness * sums->steepness);
    const float                 sum     = steep + self->last_steep;
    const float                 weight  = quotient(sum * sum, (variety + self->last_variety) * STEEP);
    const bool                  in_both = (steep > 0.0F) && (self->last_steep > 0.0F);
    self->last_steep                    = steep;
    self->last_variety                  = variety;
    return in_both ? weight : 0.0F;
}

/// Evidence for noise in the block: of correlation, of more than one variance, and of excess.
static float find_noise(const est_fit_watch_t* const self) {
    const est_fit_sums_t* const sums   = &self->sums;
    const float                 level  = reference_variance(self);
    const float                 along  = quotient(sums->along * sums->along, clear_energy_of(self) * level * ALONG);
    const float                 uneven = sums->uneven / (level * level * UNEVEN);
    const float                 excess = quotient(variance_of(self), declared_variance(self) * EXCESS);
    return est_max(est_max(along, uneven), excess);
}

/// Weigh noise over this block and the one before. Correlation over EST_FIT_SUM_N samples may be in one block alone,
/// and so may outliers without any alarm: a change of the plant has one. In the first block that states nothing yet.
static float weigh_noise(est_fit_watch_t* const self, const est_t* const estimator) {
    if (scale_misfit(estimator) > (2.0F * self->inflation)) {
        self->alarms_n = (uint16_t)(self->alarms_n + UNJUSTIFIED_N);
    }
    const float    colour   = quotient(self->sums.power, clear_energy_of(self) * COLOUR);
    const float    rise     = quotient(variance_of(self), self->last_variance * RISE);
    const float    steep    = weigh_steepness(self);
    const float    tails    = weigh_tails(self);
    const float    both     = tails + self->last_tails;
    const uint32_t alarms_n = (uint32_t)self->alarms_n + self->last_alarms_n;
    self->noise             = est_max(est_max(colour, tails), find_noise(self));
    self->last_tails        = tails;
    const float sum         = self->noise + self->last_noise + steep;
    const bool  in_both     = (self->noise >= NOISE_EACH) && (self->last_noise >= NOISE_EACH);
    const float alone       = in_both ? sum : 0.0F;
    const float shared      = (alarms_n >= ALARMED_N) ? (ALARMED * (float)alarms_n * sum) : alone;
    const bool  before      = (self->candidate == EST_MISFIT_NOISE) && (self->misfit.kind == EST_MISFIT_NONE);
    const float quiet       = (alarms_n == 0U) ? both : 0.0F;
    const float shape       = est_max(quiet, steep + (TAILS_PART * quiet));
    return est_max(est_max(colour, before ? self->last_noise : rise), est_max(shared, shape));
}

/// True iff the plant hardly moves between two samples.
static bool is_slow(const est_t* const estimator) { return estimator->theta[1] < SLOW; }  // 1 + a1 + a2

/// Weigh the lack of information on a change of the mass. It scales the second difference of y, whitened.
static float weigh_lack(const est_fit_watch_t* const self) {
    const float information = quotient(self->sums.moved, reference_variance(self) * (float)self->sums.moved_n);
    return INFORMATION / est_max(information, INFORMATION_MIN);
}

/// Weigh the cause at this place in CAUSES. The model fits as far as it is concerned unless its strength exceeds 1. A
/// slow plant may hide a change for long, but lack of excitation is no news unless alarms were false.
static float weigh_cause(est_fit_watch_t* const self, const est_t* const estimator, const uint32_t place) {
    float out = 0.0F;
    if (place == 0U) {
        out = weigh_drift(self);
    } else if (place == 1U) {
        out = weigh_nonlinearity(self);
    } else if (place == 2U) {
        out = weigh_hum(self);
    } else if (place == 3U) {
        out = weigh_noise(self, estimator);
    } else if (!is_slow(estimator) || (scale_misfit(estimator) > 1.0F)) {
        out = weigh_lack(self);
    } else {
        // hidden, but not by a misfit
    }
    return out;
}

/// Test one cause. The first one beyond its limit counts; until then, the strongest one.
static void test_cause(est_fit_watch_t* const self, const est_t* const estimator, const uint32_t place) {
    static const est_misfit_kind_t CAUSES[] = {
        EST_MISFIT_DRIFT, EST_MISFIT_NONLINEAR, EST_MISFIT_HUM, EST_MISFIT_NOISE, EST_MISFIT_EXCITATION,
    };
    const float strength = weigh_cause(self, estimator, place);
    if ((self->found.strength <= 1.0F) && (strength > self->found.strength)) {
        self->found.kind     = CAUSES[place];
        self->found.strength = strength;
    }
}

// ---------------------------------------------         BLOCKS         ---------------------------------------------

static void begin_block(est_fit_watch_t* const self) {
    self->sums  = (est_fit_sums_t){ .lost_n = 0U };
    self->found = (est_misfit_t){ .kind = EST_MISFIT_NONE };
    self->sum_n = 0U;
}

/// True iff the line is that of the block before, and its power is comparable.
static bool is_steady(const est_fit_watch_t* const self) {
    const float power = peak_power(self);
    const float moved = est_magnitude(self->found.frequency - self->last_frequency);
    return ((moved * number(EST_FIT_BLOCK_N)) <= BESIDE) && (power <= (STEADY * self->last_power)) &&
           (self->last_power <= (STEADY * power));
}

/// True iff a line or a mean was found where the block before had noise, but not the same line or a mean.
static bool is_unsteady(const est_fit_watch_t* const self) {
    const est_misfit_kind_t kind = self->found.kind;
    const bool              line = kind == EST_MISFIT_HUM;
    const bool              same = (self->last_kind == kind) && (!line || is_steady(self));
    return (line || (kind == EST_MISFIT_DRIFT)) && (self->last_noise >= NOISE_EACH) && !same;
}

/// True iff the innovations depend on the state of the plant, though less than EST_MISFIT_NONLINEAR alone needs.
static bool is_dependent(const est_fit_watch_t* const self) {
    const float colour = quotient(self->sums.power, clear_energy_of(self));
    return weigh_nonlinearity(self) > est_max(DEPENDENT, DEPENDENT_COLOUR * colour);
}

/// Complete what was found. A line or a mean that is another in the next block is noise. Lines and correlation that
/// depend on the state of the plant are no disturbance. If the scale is inflated, the model does not fit, whatever the
/// cause.
static void complete(est_fit_watch_t* const self, const est_t* const estimator) {
    const float         inflation = scale_misfit(estimator);
    est_misfit_t* const found     = &self->found;
    if ((found->strength <= 1.0F) && (inflation <= 1.0F)) {
        *found = (est_misfit_t){ .kind = EST_MISFIT_NONE };
    } else {
        found->strength = est_max(found->strength, inflation);
    }
    if (found->kind == EST_MISFIT_HUM) {
        found->frequency = find_frequency(self);
    }
    const est_misfit_kind_t kind = found->kind;
    if (is_unsteady(self)) {
        found->kind = EST_MISFIT_NOISE;
    }
    self->last_frequency = found->frequency;
    self->last_kind      = kind;
    if (((found->kind == EST_MISFIT_HUM) || (found->kind == EST_MISFIT_NOISE)) && is_dependent(self)) {
        found->kind = EST_MISFIT_NONLINEAR;
    }
    if (found->kind != EST_MISFIT_HUM) {
        found->frequency = 0.0F;
    }
    if ((found->kind == EST_MISFIT_EXCITATION) && is_slow(estimator)) {
        found->kind = EST_MISFIT_SLOW_PLANT;
    }
}

/// Keep what the next block is compared with.
static void keep_block(est_fit_watch_t* const self, const est_t* const estimator) {
    self->candidate     = self->found.kind;
    self->last_power    = peak_power(self);
    self->last_variance = variance_of(self);
    self->last_noise    = self->noise;
    self->last_alarms_n = self->alarms_n;
    self->inflation     = scale_misfit(estimator);
    self->noise         = 0.0F;
    self->alarms_n      = 0U;
    if (!(self->first_variance > 0.0F)) {
        self->first_variance = self->last_variance;
        self->first_spread   = self->spread;
    }
}

/// State what was found if the block before agrees that there is a misfit or none, or if the evidence suffices. That
/// of non-linearity and of noise is of two blocks already.
static void conclude(est_fit_watch_t* const self, const est_t* const estimator) {
    complete(self, estimator);
    const est_misfit_t found = self->found;
    const bool         again = (found.kind == EST_MISFIT_NONE) == (self->candidate == EST_MISFIT_NONE);
    const bool         compared =
        (self->first_variance > 0.0F) && ((found.kind == EST_MISFIT_NONLINEAR) || (found.kind == EST_MISFIT_NOISE));
    if (!edges_vary(estimator) && (again || compared || (scale_misfit(estimator) > 1.0F))) {
        self->misfit = found;
    }
    keep_block(self, estimator);
}

/// True iff the block has enough innovations to state anything.
static bool is_enough(const est_fit_watch_t* const self) {
    return (count_of(self) >= ENOUGH_N) && (self->sums.squares > 0.0F);
}

/// Add the energy that a region explains beyond chance, and how its variance deviates; clear it for the next block.
static void evaluate_region(est_fit_watch_t* const self, const uint32_t region) {
    const float energies_n = (float)self->energies_n[region];
    const float deviation  = self->energies[region] - (energies_n * variance_of(self));
    if (self->energies_n[region] >= ENERGY_MIN) {
        self->sums.uneven += (deviation * deviation) / energies_n;
    }
    self->sums.energy += self->energies[region];
    self->sums.energy_n      = (uint16_t)(self->sums.energy_n + self->energies_n[region]);
    self->energies[region]   = 0.0F;
    self->energies_n[region] = 0U;
    const uint8_t n          = self->regions_n[region];
    const float   mean       = ((n >= REGION_MIN) && is_enough(self)) ? (self->regions[region] / (float)n) : 0.0F;
    self->sums.explained += (self->regions[region] * mean) - quotient(self->sums.drawn, (float)self->sums.drawn_n);
    self->sums.repeated += self->regions[region] * self->means[region];
    self->means[region]     = mean;
    self->regions[region]   = 0.0F;
    self->regions_n[region] = 0U;
}

/// Do the share of the evaluation that falls to one of the samples after the block.
static void evaluate(est_fit_watch_t* const self, const est_t* const estimator, const uint32_t slot) {
    if ((slot >= ENTERED_END) && (slot < EVALUATED_END)) {
        const uint32_t part = slot - ENTERED_END;
        for (uint32_t line = EVALUATED_N * part; (line < (EVALUATED_N * (part + 1U))) && (line < EST_FIT_LINES_N);
             line++) {
            evaluate_line(self, line);
        }
        evaluate_region(self, part);
    } else if ((slot < ENTERED_END) || (slot > CONCLUSION) || !is_enough(self)) {
        // the last sum is not in the lines yet, the evaluation is complete, or there is nothing to state
    } else if (slot < CONCLUSION) {
        test_cause(self, estimator, slot - EVALUATED_END);
    } else {
        conclude(self, estimator);
    }
}

/// Close a sum of the innovations: enter it into the block, and follow the noise.
static void close_sum(est_fit_watch_t* const self, const est_t* const estimator) {
    self->entered = self->sum;
    self->limit   = improve_root(self->limit, CLIP * est_noise_variance(estimator));
    self->sums.power += self->sum * self->sum;
    self->sums.total += self->sum;
    self->sum        = 0.0F;
    self->beyond_end = 0U;
    self->sum_n++;
    if (edges_vary(estimator)) {
        self->misfit = (est_misfit_t){ .kind = EST_MISFIT_EDGES, .strength = 1.0F };
    }
}

/// True iff the innovation counts.
static bool is_used(const est_fit_watch_t* const self, const est_step_t step) {
    return ((step.status == EST_UPDATED) || (step.status == EST_OUTLIER)) && (self->excluded_n == 0U);
}

/// Draw the innovation of this sample, count the energy of the last ones, and find the region of the next ones.
static void
work_on_regions(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step, const float z) {
    if (is_used(self, step) && (step.status == EST_UPDATED) && (self->slot >= DRAWS_FROM)) {
        draw(self, estimator, z, step.innovation);
    }
    // an edge of a generator that drifts leaves a response to it
    count_energy(self, estimator->settled && (estimator->ambiguity_n == 0U));
    if ((step.status == EST_UPDATED) || (step.status == EST_GATHERING)) {
        find_region(self, estimator);
    }
}

/// Limit an innovation beyond its limit. It counts as an outlier if nothing else explains it: no innovation before it,
/// no ambiguous edge, no slip, and no gap of late.
static float limit_innovation(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step) {
    const float limit   = self->limit * self->limit;
    const float square  = step.innovation * step.innovation;
    const bool  judged  = (estimator->ambiguity_n == 0U) && estimator->settled && estimator->known;
    const bool  follows = (self->slot > 0U) && (self->slot == self->beyond_end);
    float       factor  = limit;
    if (follows) {
        factor = FOLLOWING * limit;
    } else if (judged || step.alarm) {
        const float most = OUTLIER * limit;
        factor           = (square < most) ? square : most;
    } else {
        // no more than its limit
    }
    self->beyond_end = (uint8_t)(self->slot + 1U);
    self->sums.fourths += limit * (factor - limit);
    return (step.innovation < 0.0F) ? -self->limit : self->limit;
}

/// Enter an innovation into the sums. Return it, limited.
static float add_innovation(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step) {
    est_fit_sums_t* const sums = &self->sums;
    float                 z    = step.innovation;
    if (!(est_magnitude(z) <= self->limit)) {
        z = limit_innovation(self, estimator, step);
    }
    const float square = z * z;
    sums->squares += square;
    sums->fourths += square * square;
    if (estimator->ambiguity_n == 0U) {
        self->sum += z;
        sums->along += z * self->last;
        self->last = z;
    } else {
        sums->total += z;
        sums->ambiguous_n++;
    }
    return z;
}

/// Enter the last sum into some of the lines, if that falls to this sample of a sum.
static void work_on_lines(est_fit_watch_t* const self) {
    if (self->slot < ENTERED_END) {
        for (uint32_t i = 0U; i < ENTERED_N; i++) {
            enter_line(self, (ENTERED_N * self->slot) + i);
        }
    }
}

/// Enter a sample of the block.
static void enter_sample(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step) {
    float z = 0.0F;
    if (is_used(self, step)) {
        z = add_innovation(self, estimator, step);
    } else {
        self->sums.lost_n++;
    }
    if ((self->slot % DRAWS_PERIOD) == DRAWS_SLOT) {
        work_on_regions(self, estimator, step, z);
    }
}

// ---------------------------------------------          API           ---------------------------------------------

bool est_fit_init(est_fit_watch_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != NULL) && (config != NULL));
    *self             = (est_fit_watch_t){ .config = config, .sum_n = EST_FIT_SUMS_N - EST_FIT_SETTLING_N };
    self->sums.lost_n = (uint16_t)(EST_FIT_SUM_N * self->sum_n);
    self->limit       = CLIP * config->noise_variance;
    self->inflation   = 1.0F / INFLATION_MISFIT;
    return config->na == 2U;
}

void est_fit_enter(est_fit_watch_t* const self, const est_t* const estimator, const est_step_t step) {
    EST_ASSERT((self != NULL) && (estimator != NULL));
    const bool full = self->sum_n >= EST_FIT_SUMS_N;
    work_on_lines(self);
    if (full) {
        evaluate(self, estimator, self->slot);
    } else {
        enter_sample(self, estimator, step);
    }
    if (self->excluded_n > 0U) {
        self->excluded_n--;
    }
    if (step.alarm) {
        self->excluded_n = EXCLUDED_N;
        self->alarms_n++;
    }
    if (self->slot < (EST_FIT_SUM_N - 1U)) {
        self->slot++;
        return;
    }
    self->slot = 0U;
    if (full) {
        begin_block(self);
    } else {
        close_sum(self, estimator);
    }
}

est_misfit_t est_fit_misfit(const est_fit_watch_t* const self) {
    EST_ASSERT(self != NULL);
    return self->misfit;
}
