// SPDX-License-Identifier: MIT

#include "est_fit.h"
#include "est_assert.h"

#include <stddef.h>

/// Lines of the spectrum that one sample takes care of.
#define LINES_A_SAMPLE (EST_FIT_LINES_N / EST_FIT_SUM_N)

/// Regions that one sample evaluates.
#define REGIONS_A_SAMPLE (EST_FIT_REGIONS_N / (EST_FIT_SUM_N - 2U))

/// Innovations in a block below which nothing is stated, and those below which their variance is not judged: with many
/// missing samples the estimate is less certain, and the innovations are larger.
#define ENOUGH_N 240U
#define MANY_N 480U

/// Alarms in a block that only noise can raise: the estimate of a plant needs as long to settle as the next alarm.
#define STORM_N 18U

/// Limit of an innovation in mean magnitudes: 3 standard deviations of Gaussian noise. Mean square of Gaussian noise
/// over its squared mean magnitude.
#define CLIP 3.76F
#define GAUSSIAN 1.5707963F

/// Memories of the magnitude of the innovations, until the first block and afterwards, and of the level of y [samples].
#define MAGNITUDE_SETTLING_N 8.0F
#define MAGNITUDE_N 64.0F
#define LEVEL_N 512U

/// First and smallest mean magnitude of the innovations, from which it can grow [codes].
#define MAGNITUDE_MIN 1.0e-6F

/// Equations after an alarm that are excluded: half of those since the alarm before, at most these.
#define EXCLUDED_MAX 60U

/// Levels of y that bound the regions, and the change over two samples beyond which y moves [spreads].
#define LEVEL_BOUND 0.7F
#define MOVES 0.05F

/// Equations that an edge of u affects directly.
#define EDGE_EQUATIONS_N 3U

/// Limits of the statistics in est_fit_evidence_t.
#define DRIFT 64.0F
#define LINE 22.0F
#define STEPS 0.09F
#define SHIFTS 0.35F
#define EDGE_RATIO 4.0F
#define REGIONS 0.12F
#define COLOUR 0.22F
#define NOISE 2.5F
#define INFORMATION 200.0F

/// A line is hum if it exceeds the lines around by LINE_ABOVE, and its share the shares of REGIONS and COLOUR by these
/// factors: the response of a plant that is not linear, and noise that is not white, have peaks too.
#define LINE_ABOVE 2.5F
#define REGIONS_HUM 1.2F
#define COLOUR_HUM 0.4F

/// Edges that drift explain all that the state of the plant explains, and that of a plant that is not linear less than
/// this part.
#define STEPS_REGIONS 0.7F

/// Equations next to edges in a block below which their variance is not judged.
#define EDGES_MIN 12U

/// 1 + a1 + a2 below which the plant hardly moves between two samples.
#define SLOW 0.0035F

/// 0.2^2 / 2 * 100: information on a change by 20 % in 100 samples, per squared effect over the variance.
#define CHANGE_WEIGHT 2.0F

static float magnitude(const float x) { return (x < 0.0F) ? -x : x; }

static float smaller(const float a, const float b) { return (a < b) ? a : b; }

static float ratio(const float a, const float b) { return (b > 0.0F) ? (a / b) : 0.0F; }

/// Square root of 0 <= x <= 1 to 1 %, by Newton's method from above.
static float root(const float x) {
    float out = 0.5F * (1.0F + x);
    for (uint8_t i = 0U; i < 5U; i++) {
        out = 0.5F * (out + (x / out));
    }
    return out;
}

// ---------------------------------------------        SIGNALS         ---------------------------------------------

/// Whiten x by 1/C. Zeros before the first sample.
static float whiten(float* const past, const float* const c, const float x) {
    const float out = x - (c[0] * past[0]) - (c[1] * past[1]);
    past[1]         = past[0];
    past[0]         = out;
    return out;
}

/// Follow u: its edges, its whitened steps, and the effect of the mass, which is that of y'' on the equation, whitened.
static void follow_input(est_fit_watch_t* const self, const float u) {
    const float step = u - self->u[0];
    const float bend = step - (self->u[0] - self->u[1]);
    self->u[1]       = self->u[0];
    self->u[0]       = u;
    (void)whiten(self->steps, self->c, step);
    (void)whiten(self->bends[1], self->c, whiten(self->bends[0], self->c, bend));
    self->edge_age_n = (uint8_t)(self->edge_age_n + ((self->edge_age_n < UINT8_MAX) ? 1U : 0U));
    if (magnitude(step) >= self->config->edge_codes) {
        self->edge_age_n = 0U;
        self->sums.shifts += ratio(self->shift[0] * self->shift[0], self->shift[1]);
        self->shift[0] = 0.0F;
        self->shift[1] = 0.0F;
    }
}

static void follow_output(est_fit_watch_t* const self, const float y) {
    self->learnt_n   = (uint16_t)(self->learnt_n + ((self->learnt_n < LEVEL_N) ? 1U : 0U));
    const float rate = 1.0F / (float)self->learnt_n;
    self->level += rate * (y - self->level);
    self->spread += rate * (magnitude(y - self->level) - self->spread);
    self->y[2] = self->y[1];
    self->y[1] = self->y[0];
    self->y[0] = y;
}

/// Region of the state of the plant before the present sample.
static uint8_t find_region(const est_fit_watch_t* const self) {
    const float level = self->y[0] - self->level;
    const float moved = self->y[0] - self->y[2];
    const float bound = LEVEL_BOUND * self->spread;
    const float moves = MOVES * self->spread;
    uint32_t    stage = (level < bound) ? 2U : 3U;
    uint32_t    trend = (moved < moves) ? 1U : 2U;
    if (level < 0.0F) {
        stage = (level < -bound) ? 0U : 1U;
    }
    if (moved < -moves) {
        trend = 0U;
    }
    return (uint8_t)((3U * stage) + trend);
}

/// Limit an innovation, and follow the magnitude of the innovations.
static float limit_innovation(est_fit_watch_t* const self, const float innovation) {
    const float most = CLIP * self->deviation;
    const float size = smaller(magnitude(innovation), most);
    self->deviation += (size - self->deviation) / ((self->settling_n > 0U) ? MAGNITUDE_SETTLING_N : MAGNITUDE_N);
    self->deviation = (self->deviation < MAGNITUDE_MIN) ? MAGNITUDE_MIN : self->deviation;
    return (innovation < 0.0F) ? -size : size;
}

static void enter_innovation(est_fit_watch_t* const self, const float z) {
    est_fit_sums_t* const sums   = &self->sums;
    const float           step   = self->steps[0];
    const float           bend   = self->bends[1][0];
    const uint8_t         region = find_region(self);
    sums->innovations_n++;
    sums->sum += z;
    sums->squares += z * z;
    for (uint8_t i = 0U; i < 4U; i++) {
        sums->lagged[i] += z * self->past[i];
    }
    if (self->edge_age_n < EDGE_EQUATIONS_N) {
        sums->edges_n++;
        sums->edges += z * z;
    }
    sums->steps[0] += z * step;
    sums->steps[1] += step * step;
    self->shift[0] += z * step;
    self->shift[1] += step * step;
    sums->excitation += bend * bend;
    sums->regions[region] += z;
    sums->regions_n[region]++;
}

// ---------------------------------------------        SPECTRUM        ---------------------------------------------

/// 2 cos(pi k / EST_FIT_LINES_N) for the first half of the lines; those of the second half are negative.
static float resonance(const uint32_t line) {
    static const float first[1U + (EST_FIT_LINES_N / 2U)] = {
        2.0F,        1.9957178F,  1.9828897F,  1.9615706F,  1.9318517F,  1.8938603F,  1.8477591F,
        1.7937455F,  1.7320508F,  1.6629392F,  1.5867067F,  1.5036796F,  1.4142136F,  1.3186916F,
        1.2175229F,  1.1111405F,  1.0F,        0.88457738F, 0.76536686F, 0.64287893F, 0.51763809F,
        0.39018064F, 0.26105238F, 0.13080626F, 0.0F,
    };
    const uint32_t half = EST_FIT_LINES_N / 2U;
    return (line <= half) ? first[line] : -first[EST_FIT_LINES_N - line];
}

/// Enter the last sum into some of the resonators (Goertzel's algorithm). `turn`: number of the sum, from 1; sample
/// `slice` of EST_FIT_SUM_N.
static void enter_lines(est_fit_watch_t* const self, const uint32_t turn, const uint32_t slice) {
    const uint32_t first = slice * LINES_A_SAMPLE;
    for (uint32_t line = first; line < (first + LINES_A_SAMPLE); line++) {
        const float now    = (turn > 1U) ? self->now[line] : 0.0F;
        const float before = (turn > 1U) ? self->before[line] : 0.0F;
        self->now[line]    = self->entered + ((resonance(line) * now) - before);
        self->before[line] = now;
    }
}

/// Replace some of the resonators by their powers.
static void evaluate_lines(est_fit_watch_t* const self, const uint32_t slice) {
    const uint32_t first = slice * LINES_A_SAMPLE;
    for (uint32_t line = first; line < (first + LINES_A_SAMPLE); line++) {
        const float now    = self->now[line];
        const float before = self->before[line];
        self->now[line]    = (now * now) + (before * before) - ((resonance(line) * now) * before);
        if (line <= 1U) {
            self->peak = 1U;
        } else if (self->now[line] > self->now[self->peak]) {
            self->peak = (uint8_t)line;
        } else {
            // the peak is another line
        }
    }
}

static void evaluate_regions(est_fit_watch_t* const self, const uint32_t slice) {
    self->explained = (slice == 0U) ? 0.0F : self->explained;
    for (uint32_t i = slice * REGIONS_A_SAMPLE; (i < ((slice + 1U) * REGIONS_A_SAMPLE)) && (i < EST_FIT_REGIONS_N);
         i++) {
        const uint16_t n = self->sums.regions_n[i];
        if (n > 8U) {
            self->explained += (self->sums.regions[i] * self->sums.regions[i]) / (float)n;
        }
    }
}

/// Power of a line; 0 beyond the ends of the spectrum.
static float power_at(const est_fit_watch_t* const self, const uint32_t line) {
    return ((line >= 1U) && (line < EST_FIT_LINES_N)) ? self->now[line] : 0.0F;
}

/// Mean power of the lines around the peak, without its neighbours.
static float power_around(const est_fit_watch_t* const self) {
    float   sum = 0.0F;
    uint8_t n   = 0U;
    for (uint32_t distance = 2U; distance <= 6U; distance++) {
        const uint32_t above = self->peak + distance;
        const uint32_t below = (self->peak > distance) ? (self->peak - distance) : 0U;
        sum += power_at(self, above) + power_at(self, below);
        n = (uint8_t)(n + ((above < EST_FIT_LINES_N) ? 1U : 0U) + ((below > 0U) ? 1U : 0U));
    }
    return sum / (float)n;
}

/// Frequency of the line at the peak, from the powers of the peak and its larger neighbour [cycles per sample].
static float find_frequency(const est_fit_watch_t* const self) {
    const float above = power_at(self, self->peak + 1U);
    const float below = power_at(self, self->peak - 1U);
    const float share = root(ratio((above > below) ? above : below, self->now[self->peak]));
    const float shift = share / (1.0F + share);
    return ((float)self->peak + ((above > below) ? shift : -shift)) / (float)EST_FIT_BLOCK_N;
}

// ---------------------------------------------        VERDICT         ---------------------------------------------

/// Statistics of a block. Shares are of the energy of the innovations, or of the declared one if that is more: the
/// structure of innovations that are smaller than promised does no harm. Private.
typedef struct {
    float drift;    ///< squared mean over its variance
    float line;     ///< power of the largest line over its mean
    float hum;      ///< share of that line
    float steps;    ///< share that follows the steps of u
    float shifts;   ///< share that a shift of each edge explains
    float edges;    ///< variance next to edges over that elsewhere
    float regions;  ///< share that the state of the plant explains
    float colour;   ///< mean autocorrelation
    float noise;    ///< variance over the declared one
    float lack;     ///< reciprocal information on a change of the mass [1 / nats]
} est_fit_evidence_t;

static est_fit_evidence_t measure(const est_fit_watch_t* const self, const est_t* const estimator) {
    const est_fit_sums_t* const sums     = &self->sums;
    const float* const          lagged   = sums->lagged;
    const float                 n        = (float)sums->innovations_n;
    const float                 declared = self->config->noise_estimated ? 0.0F : self->config->noise_variance;
    const float                 least    = declared * n;
    const float                 energy   = (sums->squares > least) ? sums->squares : least;
    const float                 edges_n  = (float)sums->edges_n;
    const float                 apart    = (n - edges_n) * declared;
    const float                 rest     = sums->squares - sums->edges;
    float                       gain     = 0.0F;
    for (uint8_t i = 0U; i < self->config->nb; i++) {
        gain += est_theta(estimator, (uint8_t)(2U + i));
    }
    return (est_fit_evidence_t){
        .drift   = ratio(sums->sum * sums->sum, energy),
        .line    = ratio(self->now[self->peak], energy),
        .hum     = ratio(self->now[self->peak], 0.5F * n * energy),
        .steps   = ratio(sums->steps[0] * sums->steps[0], sums->steps[1] * energy),
        .shifts  = ratio(sums->shifts, energy),
        .edges   = ratio(sums->edges * (n - edges_n), edges_n * ((rest > apart) ? rest : apart)),
        .regions = ratio(self->explained, energy),
        .colour  = 0.25F * ratio(lagged[0] + lagged[1] + lagged[2] + lagged[3], energy),
        .noise   = ratio(sums->squares, least),
        .lack    = ratio(energy, CHANGE_WEIGHT * gain * gain * sums->excitation),
    };
}

static float larger(const float a, const float b) { return (a > b) ? a : b; }

/// Evidence for a line that is neither a harmonic of the excitation nor the peak of a broad spectrum, over its limit.
static float weigh_hum(const est_fit_watch_t* const self, const est_fit_evidence_t* const found) {
    const bool stands_out = self->now[self->peak] > (LINE_ABOVE * power_around(self));
    const bool is_apart = (found->hum > (REGIONS_HUM * found->regions)) && (found->hum > (COLOUR_HUM * found->colour));
    return (stands_out && is_apart) ? (found->line / LINE) : 0.0F;
}

/// Evidence that the effect of the edges of u varies, over its limit. u must have edges that are apart.
static float weigh_edges(const est_fit_watch_t* const self, const est_fit_evidence_t* const found) {
    const uint32_t edges_n = self->sums.edges_n;
    if ((edges_n < EDGES_MIN) || ((edges_n * 4U) > self->sums.innovations_n)) {
        return 0.0F;  // MISRA D4
    }
    const float steps = (found->steps > (STEPS_REGIONS * found->regions)) ? (found->steps / STEPS) : 0.0F;
    const float other = larger(found->shifts / SHIFTS, found->edges / EDGE_RATIO);
    return larger(steps, (found->regions > REGIONS) ? 0.0F : other);
}

/// Evidence for noise other than declared, over its limit.
static float weigh_noise(const est_fit_watch_t* const self, const est_fit_evidence_t* const found) {
    const float excess = (self->sums.innovations_n >= MANY_N) ? (found->noise / NOISE) : 0.0F;
    return larger(found->colour / COLOUR, excess);
}

/// True iff the plant hardly moves between two samples.
static bool is_slow(const est_t* const estimator) {
    return (1.0F + est_theta(estimator, 0U) + est_theta(estimator, 1U)) < SLOW;
}

/// Name the cause of the misfit in a block with enough innovations: the first in the order of est_misfit_kind_t whose
/// evidence exceeds its limit.
static est_misfit_t name_cause(const est_fit_watch_t* const self, const est_t* const estimator) {
    const est_fit_evidence_t found   = measure(self, estimator);
    const bool               slow    = is_slow(estimator);
    const est_misfit_t       order[] = {
              { EST_MISFIT_DRIFT, found.drift / DRIFT, 0.0F },
              { EST_MISFIT_HUM, weigh_hum(self, &found), find_frequency(self) },
              { slow ? EST_MISFIT_SLOW_PLANT : EST_MISFIT_EDGES, weigh_edges(self, &found), 0.0F },
              { slow ? EST_MISFIT_SLOW_PLANT : EST_MISFIT_NONLINEAR, found.regions / REGIONS, 0.0F },
              { slow ? EST_MISFIT_SLOW_PLANT : EST_MISFIT_NOISE, weigh_noise(self, &found), 0.0F },
              { EST_MISFIT_EXCITATION, found.lack * INFORMATION, 0.0F },
    };
    for (uint8_t i = 0U; i < (sizeof(order) / sizeof(order[0])); i++) {
        if (order[i].strength > 1.0F) {
            return order[i];  // MISRA D4
        }
    }
    return (est_misfit_t){ .kind = EST_MISFIT_NONE };
}

/// Judge a block. With alarms in quick succession the estimate never settles, and the innovations show nothing else.
static est_misfit_t judge(const est_fit_watch_t* const self, const est_t* const estimator) {
    const est_fit_sums_t* const sums = &self->sums;
    if (sums->alarms_n >= STORM_N) {
        return (est_misfit_t){ .kind     = EST_MISFIT_NOISE,
                               .strength = (float)sums->alarms_n / (float)STORM_N };  // MISRA D4
    }
    if ((sums->innovations_n < ENOUGH_N) || !(sums->squares > 0.0F)) {
        return (est_misfit_t){ .kind = EST_MISFIT_NONE };  // MISRA D4
    }
    return name_cause(self, estimator);
}

/// State what two blocks in succession agree on.
static void conclude(est_fit_watch_t* const self, const est_misfit_t found) {
    if (found.kind == self->candidate) {
        self->misfit = found;
    }
    self->candidate = found.kind;
}

// ---------------------------------------------          API           ---------------------------------------------

static void begin_block(est_fit_watch_t* const self) {
    self->sums       = (est_fit_sums_t){ .sum = 0.0F };
    self->shift[0]   = 0.0F;
    self->shift[1]   = 0.0F;
    self->pending    = 0.0F;
    self->position_n = 0U;
}

/// Advance by one sample: enter the innovation into the spectrum, and do the share of the work that falls to it.
static void advance(est_fit_watch_t* const self, const est_t* const estimator, const float z) {
    const uint32_t slice = self->position_n % EST_FIT_SUM_N;
    const uint32_t turn  = self->position_n / EST_FIT_SUM_N;
    if (turn > 0U) {
        enter_lines(self, turn, slice);
    }
    if (self->position_n >= EST_FIT_BLOCK_N) {
        evaluate_lines(self, slice);
        evaluate_regions(self, slice);
    }
    self->pending += z;
    self->position_n++;
    if (slice == (EST_FIT_SUM_N - 1U)) {
        self->entered = self->pending;
        self->pending = 0.0F;
    }
    if (self->position_n == (EST_FIT_BLOCK_N + EST_FIT_SUM_N)) {
        conclude(self, judge(self, estimator));
        begin_block(self);
    }
}

/// Innovation for the statistics; 0 if there is none, or if it is excluded. After an alarm the estimate settles.
static float take_innovation(est_fit_watch_t* const self, const est_step_t step) {
    float z = 0.0F;
    if ((step.status == EST_UPDATED) && (self->excluded_n > 0U)) {
        self->excluded_n--;
    } else if (step.status == EST_UPDATED) {
        z = limit_innovation(self, step.innovation);
        if ((self->settling_n == 0U) && (self->position_n < EST_FIT_BLOCK_N)) {
            enter_innovation(self, z);
        }
    } else {
        // no equation
    }
    if (step.status == EST_UPDATED) {
        self->since_n = (uint16_t)(self->since_n + ((self->since_n < UINT16_MAX) ? 1U : 0U));
    }
    for (uint8_t i = 3U; i > 0U; i--) {
        self->past[i] = self->past[i - 1U];
    }
    self->past[0] = z;
    return z;
}

static void enter_alarm(est_fit_watch_t* const self) {
    const uint16_t half_n = self->since_n / 2U;
    self->excluded_n      = (uint8_t)((half_n < EXCLUDED_MAX) ? half_n : EXCLUDED_MAX);
    self->since_n         = 0U;
    self->sums.alarms_n++;
}

bool est_fit_init(est_fit_watch_t* const self, const est_config_t* const config) {
    EST_ASSERT((self != NULL) && (config != NULL));
    *self           = (est_fit_watch_t){ .config = config, .settling_n = EST_FIT_SETTLING_N, .edge_age_n = UINT8_MAX };
    self->deviation = MAGNITUDE_MIN;
    return config->na == 2U;
}

void est_fit_enter(est_fit_watch_t* const self,
                   const est_t* const     estimator,
                   const est_sample_t     sample,
                   const est_step_t       step) {
    EST_ASSERT((self != NULL) && (estimator != NULL));
    const bool known = (step.status == EST_UPDATED) || (step.status == EST_GATHERING);
    if ((self->position_n % EST_FIT_SUM_N) == 0U) {
        self->c[0] = est_prefilter(estimator, 0U);
        self->c[1] = est_prefilter(estimator, 1U);
    }
    follow_input(self, known ? sample.u : self->u[0]);
    const float z = take_innovation(self, step);
    if (known) {
        follow_output(self, sample.y);
    }
    if (step.alarm) {
        enter_alarm(self);
    }
    if (self->settling_n == 0U) {
        advance(self, estimator, z);
    } else if (step.status == EST_UPDATED) {
        self->settling_n--;
        begin_block(self);
    } else {
        // the estimate has not moved
    }
}

est_misfit_t est_fit_misfit(const est_fit_watch_t* const self) {
    EST_ASSERT(self != NULL);
    return self->misfit;
}
