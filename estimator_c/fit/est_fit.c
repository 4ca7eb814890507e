// SPDX-License-Identifier: MIT

#include "est_fit.h"
#include "est_assert.h"

#include <stddef.h>

/// Samples of the evaluation: the resonators, then the causes one by one, then the conclusion.
#define CAUSES_FROM 8U
#define CAUSES_N 6U

/// Lines and regions that one sample takes care of.
#define LINES_A_SAMPLE (EST_FIT_LINES_N / CAUSES_FROM)
#define REGIONS_A_SAMPLE 2U

/// Innovations in a block below which nothing is stated, and those below which their variance is not judged: with many
/// missing samples the estimate is less certain, and the innovations are larger.
#define ENOUGH_N 240U
#define MANY_N 480U

/// Alarms in a block that only noise can raise: the estimate of a plant needs as long to settle as the next alarm.
#define STORM_N 18U

/// Limit of an innovation in mean magnitudes: 3 standard deviations of Gaussian noise.
#define CLIP 3.76F

/// Memories of the magnitude of the innovations, until the first block and afterwards, and of the level of y [samples].
#define MAGNITUDE_SETTLING_N 8.0F
#define MAGNITUDE_N 64.0F
#define LEVEL_N 128U

/// First and smallest mean magnitude of the innovations, from which it can grow [codes].
#define MAGNITUDE_MIN 1.0e-6F

/// Equations after an alarm that are excluded: half of those since the alarm before, at most these.
#define EXCLUDED_MAX 60U

/// Levels of y that bound the regions, and the change over two samples beyond which y moves [spreads].
#define LEVEL_BOUND 0.7F
#define MOVES 0.05F

/// Innovations in a region below which it explains nothing.
#define REGION_MIN 4U

/// Equations that an edge of u affects directly.
#define EDGE_EQUATIONS_N 3U

/// Limits of the statistics. DRIFT: squared mean of the innovations over its variance. LINE: power of a line over its
/// mean. STEPS, SHIFTS, REGIONS: share of the energy of the innovations that follows the steps of u, that a shift of
/// each edge explains, and that the state of the plant explains. EDGE_RATIO: variance next to edges over that
/// elsewhere. COLOUR: mean autocorrelation. NOISE: variance over the declared one. INFORMATION: see weigh_lack().
#define DRIFT 64.0F
#define LINE 22.0F
#define STEPS 0.09F
#define SHIFTS 0.35F
#define EDGE_RATIO 4.0F
#define REGIONS 0.12F
#define COLOUR 0.22F
#define NOISE 2.5F
#define INFORMATION 600.0F
#define INFORMATION_MIN 1.0F

/// A line is hum if it exceeds the lines around by LINE_ABOVE, and its share those of the regions and of the colour by
/// these factors: the response of a plant that is not linear, and noise that is not white, have peaks too.
#define LINE_ABOVE 2.5F
#define REGIONS_HUM 1.2F
#define COLOUR_HUM 0.4F

/// Edges that drift explain all that the state of the plant explains, and edges that jump more. With a plant that is
/// not linear, the steps of u explain less than this part.
#define STEPS_REGIONS 0.7F

/// Growth of the spread of y since the first block with which a growth of the innovations is not linear.
#define GROWTH 1.5F

/// Equations next to edges in a block below which their variance is not judged.
#define EDGES_MIN 12U

/// 1 + a1 + a2 below which the plant hardly moves between two samples.
#define SLOW 0.0035F

/// Alarms in a block that are too many for changes of such a plant.
#define SLOW_ALARMS 1.0F

static float magnitude(const float x) { return (x < 0.0F) ? -x : x; }

static float minimum(const float a, const float b) { return (a < b) ? a : b; }

static float maximum(const float a, const float b) { return (a > b) ? a : b; }

/// a / b; 0 unless b is positive.
static float quotient(const float a, const float b) {
    float out = 0.0F;
    if (b > 0.0F) {
        out = a / b;
    }
    return out;
}

/// Square root of 0 <= x <= 1 to 1 %, by Newton's method from above.
static float square_root(const float x) {
    float out = 0.5F * (1.0F + x);
    for (uint8_t i = 0U; i < 5U; i++) {
        out = 0.5F * (out + (x / out));
    }
    return out;
}

// ---------------------------------------------        SIGNALS         ---------------------------------------------

/// Close the sums of the steps at an edge of u.
static void close_shift(est_fit_watch_t* const self) {
    self->sums.product += self->shift[0];
    self->sums.steps += self->shift[1];
    self->sums.shifts += quotient(self->shift[0] * self->shift[0], self->shift[1]);
    self->shift[0] = 0.0F;
    self->shift[1] = 0.0F;
}

/// Follow u: its edges, and its steps whitened by 1/C.
static void follow_input(est_fit_watch_t* const self, const float u) {
    const float step     = u - self->u;
    const float whitened = step - (self->c[0] * self->step[0]) - (self->c[1] * self->step[1]);
    self->u              = u;
    self->step[1]        = self->step[0];
    self->step[0]        = whitened;
    if (magnitude(step) >= self->config->edge_codes) {
        self->edge_age_n = 0U;
        close_shift(self);
    } else if (self->edge_age_n < EDGE_EQUATIONS_N) {
        self->edge_age_n++;
    } else {
        // the equation has no edge
    }
}

static void follow_output(est_fit_watch_t* const self, const float y) {
    self->y[2] = self->y[1];
    self->y[1] = self->y[0];
    self->y[0] = y;
}

/// Follow the level of y, at one sample of four.
static void follow_level(est_fit_watch_t* const self) {
    self->learnt_n    = (uint16_t)(self->learnt_n + ((self->learnt_n < LEVEL_N) ? 1U : 0U));
    const float rate  = 1.0F / (float)self->learnt_n;
    const float above = self->y[0] - self->level;
    self->level += rate * above;
    self->spread += rate * (magnitude(above) - self->spread);
}

/// Region of the state of the plant before the present sample.
static uint32_t find_region(const est_fit_watch_t* const self) {
    const float level = self->y[0] - self->level;
    const float moved = self->y[0] - self->y[2];
    const float bound = LEVEL_BOUND * self->spread;
    const float moves = MOVES * self->spread;
    uint32_t    stage = 0U;
    uint32_t    trend = 0U;
    stage += (level < -bound) ? 0U : 1U;
    stage += (level < 0.0F) ? 0U : 1U;
    stage += (level < bound) ? 0U : 1U;
    trend += (moved < -moves) ? 0U : 1U;
    trend += (moved < moves) ? 0U : 1U;
    return (3U * stage) + trend;
}

/// Limit an innovation, and follow the magnitude of the innovations.
static float limit_innovation(est_fit_watch_t* const self, const float innovation) {
    const float most   = minimum(CLIP * self->deviation, EST_CODE_LIMIT);
    const float size   = minimum(magnitude(innovation), most);
    const float memory = (self->settling_n > 0U) ? MAGNITUDE_SETTLING_N : MAGNITUDE_N;
    self->deviation    = maximum(self->deviation + ((size - self->deviation) / memory), MAGNITUDE_MIN);
    return (innovation < 0.0F) ? -size : size;
}

/// Enter an innovation into the sums, and every second one into those that are costly.
static void enter_innovation(est_fit_watch_t* const self, const float z) {
    est_fit_sums_t* const sums   = &self->sums;
    const float           square = z * z;
    sums->innovations_n++;
    sums->sum += z;
    sums->squares += square;
    if (self->edge_age_n < EDGE_EQUATIONS_N) {
        sums->edges_n++;
        sums->edges += square;
    }
    self->shift[0] += z * self->step[0];
    self->shift[1] += self->step[0] * self->step[0];
    if ((self->position_n % 2U) == 0U) {
        sums->lagged += z * (self->past[0] + self->past[1] + self->past[2] + self->past[3]);
    } else {
        const uint32_t region = find_region(self);
        self->regions[region] += z;
        self->regions_n[region]++;
    }
}

// ---------------------------------------------        SPECTRUM        ---------------------------------------------

/// 2 cos(pi k / EST_FIT_LINES_N)
static const float RESONANCE[EST_FIT_LINES_N] = {
    2.0F,  1.9828897F,  1.9318517F,  1.8477591F,  1.7320508F,  1.5867067F,   1.4142136F,   1.2175229F,
    1.0F,  0.76536686F, 0.51763809F, 0.26105238F, 0.0F,        -0.26105238F, -0.51763809F, -0.76536686F,
    -1.0F, -1.2175229F, -1.4142136F, -1.5867067F, -1.7320508F, -1.8477591F,  -1.9318517F,  -1.9828897F,
};

/// Enter the last sum into some of the resonators (Goertzel's algorithm). The first sum finds them at rest.
static void enter_lines(est_fit_watch_t* const self, const bool is_first, const uint32_t slice) {
    const uint32_t begin = slice * LINES_A_SAMPLE;
    for (uint32_t line = begin; line < (begin + LINES_A_SAMPLE); line++) {
        const float now    = is_first ? 0.0F : self->now[line];
        const float before = is_first ? 0.0F : self->before[line];
        self->now[line]    = self->entered + ((RESONANCE[line] * now) - before);
        self->before[line] = now;
    }
}

/// Replace some of the resonators by their powers. The mean is no line.
static void evaluate_lines(est_fit_watch_t* const self, const uint32_t slice) {
    const uint32_t begin = slice * LINES_A_SAMPLE;
    self->peak           = (slice == 0U) ? 1U : self->peak;
    for (uint32_t line = begin; line < (begin + LINES_A_SAMPLE); line++) {
        const float now    = self->now[line];
        const float before = self->before[line];
        self->now[line]    = (now * now) + (before * before) - ((RESONANCE[line] * now) * before);
        if ((line > 1U) && (self->now[line] > self->now[self->peak])) {
            self->peak = (uint8_t)line;
        }
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

/// Mean power of the lines around the peak, without its neighbours.
static float power_around(const est_fit_watch_t* const self) {
    float    sum = 0.0F;
    uint32_t n   = 0U;
    for (uint32_t distance = 2U; distance <= 6U; distance++) {
        const uint32_t above = self->peak + distance;
        const uint32_t below = (self->peak > distance) ? (self->peak - distance) : 0U;
        sum += power_at(self, above) + power_at(self, below);
        n += (above < EST_FIT_LINES_N) ? 1U : 0U;
        n += (below > 0U) ? 1U : 0U;
    }
    return sum / (float)n;
}

/// Frequency of the line at the peak, from the powers of the peak and its larger neighbour [cycles per sample].
static float find_frequency(const est_fit_watch_t* const self) {
    const bool  upwards = power_at(self, self->peak + 1U) > power_at(self, self->peak - 1U);
    const float towards = upwards ? 1.0F : -1.0F;
    const float share   = square_root(quotient(neighbour_power(self), self->now[self->peak]));
    const float line    = (float)self->peak + (towards * (share / (1.0F + share)));
    const float block_n = (2.0F * (float)EST_FIT_LINES_N) * (float)EST_FIT_SUM_N;
    return line / block_n;
}

// ---------------------------------------------         CAUSES         ---------------------------------------------

static float declared_variance(const est_fit_watch_t* const self) {
    return self->config->noise_estimated ? 0.0F : self->config->noise_variance;
}

/// Energy of which the statistics are shares: that of the innovations, or the declared one if that is more. The
/// structure of innovations that are smaller than promised does no harm.
static float energy_of(const est_fit_watch_t* const self) {
    return maximum(self->sums.squares, declared_variance(self) * (float)self->sums.innovations_n);
}

/// Share of the energy that the state of the plant explains.
static float regions_share(const est_fit_watch_t* const self) {
    return quotient(2.0F * self->sums.explained, energy_of(self));
}

/// Mean autocorrelation at the lags 1 to 4.
static float colour_of(const est_fit_watch_t* const self) {
    return quotient(0.5F * self->sums.lagged, energy_of(self));
}

static float weigh_drift(const est_fit_watch_t* const self) {
    return quotient(self->sums.sum * self->sums.sum, energy_of(self) * DRIFT);
}

/// Weigh a line that is neither a harmonic of the excitation nor the peak of a broad spectrum.
static float weigh_hum(const est_fit_watch_t* const self) {
    const float power    = self->now[self->peak] + neighbour_power(self);  // it may lie between two lines
    const float line     = quotient(power, energy_of(self));
    const float share    = quotient(line, 0.5F * (float)self->sums.innovations_n);
    const bool  is_apart = (share > (REGIONS_HUM * regions_share(self))) && (share > (COLOUR_HUM * colour_of(self)));
    const float above    = quotient(self->now[self->peak], LINE_ABOVE * power_around(self));
    return is_apart ? minimum(line / LINE, above) : 0.0F;
}

/// Variance next to edges over that elsewhere.
static float edge_ratio(const est_fit_watch_t* const self) {
    const float edges_n  = (float)self->sums.edges_n;
    const float others_n = (float)self->sums.innovations_n - edges_n;
    const float others   = maximum(self->sums.squares - self->sums.edges, others_n * declared_variance(self));
    return quotient(self->sums.edges * others_n, edges_n * others);
}

/// Weigh edges whose effect varies. Only edges that are apart are judged.
static float weigh_edges(const est_fit_watch_t* const self) {
    const est_fit_sums_t* const sums = &self->sums;
    if ((sums->edges_n < EDGES_MIN) || (((uint32_t)sums->edges_n * 4U) > sums->innovations_n)) {
        return 0.0F;  // MISRA D4
    }
    const float energy  = energy_of(self);
    const float regions = regions_share(self);
    const float steps   = quotient(sums->product * sums->product, sums->steps * energy);
    const float shifts  = quotient(sums->shifts, energy);
    const float next    = (regions > REGIONS) ? 0.0F : quotient(edge_ratio(self), EDGE_RATIO);
    const float drifts  = (steps > (STEPS_REGIONS * regions)) ? quotient(steps, STEPS) : 0.0F;
    const float jumps   = (shifts > regions) ? quotient(shifts, SHIFTS) : 0.0F;
    return maximum(next, maximum(drifts, jumps));
}

static float variance_of(const est_fit_watch_t* const self) {
    return self->sums.squares / (float)self->sums.innovations_n;
}

/// Weigh innovations that have grown with y since the first block, or that the state of the plant explains.
static float weigh_nonlinearity(const est_fit_watch_t* const self) {
    const bool  grows  = (self->first_variance > 0.0F) && (self->spread > (GROWTH * self->first_spread));
    const float before = maximum(self->first_variance, declared_variance(self));
    const float growth = grows ? quotient(variance_of(self), NOISE * before) : 0.0F;
    return maximum(growth, regions_share(self) / REGIONS);
}

static float weigh_noise(const est_fit_watch_t* const self) {
    const float n      = (float)self->sums.innovations_n;
    const float excess = quotient(self->sums.squares, n * declared_variance(self) * NOISE);
    return maximum(colour_of(self) / COLOUR, (self->sums.innovations_n >= MANY_N) ? excess : 0.0F);
}

/// 1 + a1 + a2.
static float stiffness(const est_t* const estimator) {
    return 1.0F + est_theta(estimator, 0U) + est_theta(estimator, 1U);
}

/// Weigh the lack of information on a change of the mass. Its effect on y is that of the steps of u, whitened twice: up
/// to a constant, the energy of the steps whitened once over 1 + a1 + a2. Below the limit, changes by 20 % are missed.
static float weigh_lack(const est_fit_watch_t* const self, const est_t* const estimator) {
    float gain = 0.0F;
    for (uint8_t i = 0U; i < self->config->nb; i++) {
        gain += est_theta(estimator, (uint8_t)(2U + i));
    }
    const float information = quotient(2.0F * gain * gain * self->sums.steps, energy_of(self) * stiffness(estimator));
    return INFORMATION / maximum(information, INFORMATION_MIN);
}

/// Weigh one cause, in the order of est_misfit_kind_t. The model fits as far as it is concerned unless its strength
/// exceeds 1.
static est_misfit_t weigh_cause(const est_fit_watch_t* const self, const est_t* const estimator, const uint32_t cause) {
    const bool   slow = stiffness(estimator) < SLOW;
    est_misfit_t out  = { .kind = EST_MISFIT_NONE, .strength = 0.0F, .frequency = 0.0F };
    switch (cause) {
    case 0U:
        out.kind     = EST_MISFIT_DRIFT;
        out.strength = weigh_drift(self);
        break;
    case 1U:
        out.kind     = EST_MISFIT_HUM;
        out.strength = weigh_hum(self);
        break;
    case 2U:
        out.kind     = slow ? EST_MISFIT_SLOW_PLANT : EST_MISFIT_EDGES;
        out.strength = weigh_edges(self);
        break;
    case 3U:
        out.kind     = slow ? EST_MISFIT_SLOW_PLANT : EST_MISFIT_NONLINEAR;
        out.strength = weigh_nonlinearity(self);
        break;
    case 4U:
        out.kind     = slow ? EST_MISFIT_SLOW_PLANT : EST_MISFIT_NOISE;
        out.strength = weigh_noise(self);
        if (slow) {
            out.strength = maximum(out.strength, (float)self->sums.alarms_n / SLOW_ALARMS);
        }
        break;
    default:
        out.kind     = EST_MISFIT_EXCITATION;
        out.strength = weigh_lack(self, estimator);
        break;
    }
    return out;
}

/// Begin the search for the cause. With alarms in quick succession the estimate never settles, and the innovations show
/// nothing else.
static void begin_search(est_fit_watch_t* const self) {
    close_shift(self);
    self->found = (est_misfit_t){ .kind = EST_MISFIT_NONE };
    if (self->sums.alarms_n >= STORM_N) {
        self->found.kind     = EST_MISFIT_NOISE;
        self->found.strength = (float)self->sums.alarms_n / (float)STORM_N;
    }
}

/// Test one cause, unless the block has too few innovations or an earlier cause is found.
static void test_cause(est_fit_watch_t* const self, const est_t* const estimator, const uint32_t cause) {
    const bool enough = (self->sums.innovations_n >= ENOUGH_N) && (self->sums.squares > 0.0F);
    if (enough && (self->found.kind == EST_MISFIT_NONE)) {
        const est_misfit_t weighed = weigh_cause(self, estimator, cause);
        if (weighed.strength > 1.0F) {
            self->found = weighed;
        }
    }
}

// ---------------------------------------------         BLOCKS         ---------------------------------------------

static void begin_block(est_fit_watch_t* const self) {
    self->sums       = (est_fit_sums_t){ .sum = 0.0F };
    self->shift[0]   = 0.0F;
    self->shift[1]   = 0.0F;
    self->pending    = 0.0F;
    self->position_n = 0U;
}

/// State what two blocks in succession agree on.
static void conclude(est_fit_watch_t* const self) {
    if (self->found.kind == EST_MISFIT_HUM) {
        self->found.frequency = find_frequency(self);
    }
    if (self->found.kind == self->candidate) {
        self->misfit = self->found;
    }
    self->candidate = self->found.kind;
    if ((self->first_variance <= 0.0F) && (self->sums.innovations_n >= ENOUGH_N)) {
        self->first_variance = variance_of(self);
        self->first_spread   = self->spread;
    }
    begin_block(self);
}

/// Evaluate some of the regions, and clear them for the next block.
static void evaluate_regions(est_fit_watch_t* const self, const uint32_t slice) {
    const uint32_t begin = slice * REGIONS_A_SAMPLE;
    for (uint32_t i = begin; (i < (begin + REGIONS_A_SAMPLE)) && (i < EST_FIT_REGIONS_N); i++) {
        if (self->regions_n[i] >= REGION_MIN) {
            self->sums.explained += (self->regions[i] * self->regions[i]) / (float)self->regions_n[i];
        }
        self->regions[i]   = 0.0F;
        self->regions_n[i] = 0U;
    }
}

/// Do the share of the evaluation that falls to one of the samples after the block.
static void evaluate(est_fit_watch_t* const self, const est_t* const estimator, const uint32_t slice) {
    if (slice < CAUSES_FROM) {
        evaluate_lines(self, slice);
        evaluate_regions(self, slice);
    } else if (slice == CAUSES_FROM) {
        begin_search(self);
    } else if (slice <= (CAUSES_FROM + CAUSES_N)) {
        test_cause(self, estimator, slice - CAUSES_FROM - 1U);
    } else {
        conclude(self);
    }
}

/// Do the share of the work that falls to one of the EST_FIT_SUM_N samples of a sum.
static void advance(est_fit_watch_t* const self, const est_t* const estimator, const float z) {
    const uint32_t slice = self->position_n % EST_FIT_SUM_N;
    const uint32_t sum_n = self->position_n / EST_FIT_SUM_N;
    self->position_n++;
    self->pending += z;
    if ((slice < CAUSES_FROM) && (sum_n > 0U)) {
        enter_lines(self, sum_n == 1U, slice);
    }
    if ((slice % 4U) == 3U) {
        follow_level(self);
    }
    if (slice == (EST_FIT_SUM_N - 1U)) {
        self->entered = self->pending;
        self->pending = 0.0F;
        self->c[0]    = est_prefilter(estimator, 0U);
        self->c[1]    = est_prefilter(estimator, 1U);
    }
    if (sum_n >= (EST_FIT_BLOCK_N / EST_FIT_SUM_N)) {
        evaluate(self, estimator, slice);
    }
}

// ---------------------------------------------          API           ---------------------------------------------

/// Innovation for the statistics; 0 if there is none, or if it is excluded because the estimate settles.
static float take_innovation(est_fit_watch_t* const self, const est_step_t step) {
    if (step.status != EST_UPDATED) {
        return 0.0F;  // MISRA D4
    }
    self->since_n = (uint16_t)(self->since_n + ((self->since_n < UINT16_MAX) ? 1U : 0U));
    if (self->excluded_n > 0U) {
        self->excluded_n--;
        return 0.0F;  // MISRA D4
    }
    const float z = limit_innovation(self, step.innovation);
    if ((self->settling_n == 0U) && (self->position_n < EST_FIT_BLOCK_N)) {
        enter_innovation(self, z);
    }
    return z;
}

static void enter_alarm(est_fit_watch_t* const self) {
    const uint32_t half_n = self->since_n / 2U;
    self->excluded_n      = (uint8_t)((half_n < EXCLUDED_MAX) ? half_n : EXCLUDED_MAX);
    self->since_n         = 0U;
    self->sums.alarms_n++;
}

bool est_fit_init(est_fit_watch_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != NULL) && (config != NULL));
    *self            = (est_fit_watch_t){ .config = config, .settling_n = EST_FIT_SETTLING_N };
    self->edge_age_n = EDGE_EQUATIONS_N;
    self->deviation  = MAGNITUDE_MIN;
    return config->na == 2U;
}

void est_fit_enter(est_fit_watch_t* const self,
                   const est_t* const     estimator,
                   const est_sample_t     sample,
                   const est_step_t       step) {
    EST_ASSERT((self != NULL) && (estimator != NULL));
    const bool known = (step.status == EST_UPDATED) || (step.status == EST_GATHERING);
    follow_input(self, known ? sample.u : self->u);
    const float z = take_innovation(self, step);
    for (uint8_t i = 3U; i > 0U; i--) {
        self->past[i] = self->past[i - 1U];
    }
    self->past[0] = z;
    if (known) {
        follow_output(self, sample.y);
    }
    if (step.alarm) {
        enter_alarm(self);
    }
    advance(self, estimator, z);
    if (self->settling_n > 0U) {
        self->settling_n = (uint16_t)(self->settling_n - ((step.status == EST_UPDATED) ? 1U : 0U));
        self->position_n %= EST_FIT_SUM_N;
        if (self->settling_n == 0U) {
            begin_block(self);
        }
    }
}

est_misfit_t est_fit_misfit(const est_fit_watch_t* const self) {
    EST_ASSERT(self != NULL);
    return self->misfit;
}
