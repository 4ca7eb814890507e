/// Edges of the generator, and the steps of a data-acquisition card.

#include "engine_state.h"

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

static bool is_same(double one, double other) { return one <= other && one >= other; }

/// engine_edges() for one play; return the number of edges.
static int64_t edges_of(
    int64_t count, int64_t grid, int64_t start, int64_t stop, const double* instant, double* level, int64_t* tick) {
    int64_t edges = 0, first = 0;
    for (int64_t i = 0; i < count; i++) {
        const int64_t ideal = (int64_t)rint(instant[i]), at = ideal < 0 ? 0 : (ideal + grid - 1) / grid * grid;
        if (edges > 0 && at != tick[edges - 1]) {
            edges -= edges > 1 && is_same(level[edges - 1], level[edges - 2]) ? 1 : 0;
        } else if (edges > 0) {
            edges--;
        }
        tick[edges]  = at;
        level[edges] = level[i];
        edges++;
    }
    edges -= edges > 1 && is_same(level[edges - 1], level[edges - 2]) ? 1 : 0;
    while (edges > 0 && tick[edges - 1] >= stop) {
        edges--;
    }
    while (first < edges && tick[first] < start) {
        first++;
    }
    memmove(tick, &tick[first], (size_t)(edges - first) * sizeof tick[0]);
    memmove(level, &level[first], (size_t)(edges - first) * sizeof level[0]);
    return edges - first;
}

void engine_edges(int64_t       plays,
                  int64_t       count,
                  int64_t       grid,
                  int64_t       start,
                  int64_t       stop,
                  const double* instant,
                  double*       level,
                  int64_t*      tick,
                  int64_t*      edges) {
    for (int64_t i = 0; i < plays; i++) {
        edges[i] = edges_of(count, grid, start, stop, &instant[i * count], &level[i * count], &tick[i * count]);
    }
}

/// engine_see() of one play.
static double see(int64_t samples,
                  int     channels,
                  const double* restrict card,
                  double residual,
                  const double* restrict volts,
                  const double* restrict normal,
                  double* restrict held,
                  double* restrict seen) {
    const double *gain = card, *droop = &gain[channels], *low = &droop[channels], *lsb = &low[channels];
    const double *noise = &lsb[channels], *offset = &noise[channels];
    double        excess[4] = { 0.0 };
    for (int64_t k = 0; k < samples; k++, volts += channels, normal += channels, seen += channels) {
        for (int i = 0; i < channels; i++) {
            const double volt = held == NULL ? volts[i] : volts[i] + residual * (held[i] - volts[i]);
            if (held != NULL) {
                held[i] = volt;
            }
            seen[i] = (volt * gain[i] - droop[i] - low[i]) / lsb[i] + (normal[i] * noise[i] + offset[i]);
            excess[i & 3] += volts[i] - volts[i];
        }
    }
    return excess[0] + excess[1] + excess[2] + excess[3];
}

int engine_see(int64_t       plays,
               int64_t       samples,
               int           channels,
               const double* card,
               double        residual,
               const double* volts,
               const double* normal,
               double*       held,
               double*       seen) {
    const int64_t count  = samples * channels;
    double        excess = 0.0;
    for (int64_t i = 0; i < plays; i++, volts += count, normal += count, seen += count) {
        excess += channels == PANEL && held == NULL ? kernels_find()->see(samples, card, volts, normal, seen)
                                                    : see(samples, channels, card, residual, volts, normal, held, seen);
        held = held == NULL ? NULL : held + channels;
    }
    return isnan(excess) ? 0 : 1;
}

/// Code by successive approximation: from the highest bit down, keep a bit if the input reaches the level of the code.
static unsigned approximate(int bits, const double* levels, double seen) {
    unsigned code = 0;
    for (unsigned bit = 1U << bits >> 1; bit > 0U; bit >>= 1) {
        code |= seen >= levels[code | bit] ? bit : 0U;
    }
    return code;
}

static bool are_rising(unsigned codes, const double* levels) {
    bool rising = true;
    for (unsigned code = 2; code < codes; code++) {
        rising = rising && levels[code] >= levels[code - 1U];
    }
    return rising;
}

/// The same code from a guess, for rising levels.
static unsigned correct(unsigned code, unsigned last, const double* levels, double seen) {
    while (code < last && seen >= levels[code + 1U]) {
        code++;
    }
    while (code > 0 && seen < levels[code]) {
        code--;
    }
    return code;
}

void engine_convert(int64_t       count,
                    int           bits,
                    const double* levels,
                    unsigned      stuck_high,
                    unsigned      stuck_low,
                    const double* seen,
                    uint16_t*     codes,
                    uint8_t*      clipped) {
    const unsigned last = (1U << bits) - 1U;
    const double   most = (1.0 - 0.5 * DBL_EPSILON) * (last + 1.0);  // the next number below the end
    // To check the levels takes as long as to convert a part of as many inputs.
    const bool    rising = levels != NULL && count > last && are_rising(last + 1U, levels);
    const int64_t whole  = levels == NULL ? count / PANEL * PANEL : 0;
    kernels_find()->convert(whole, most, stuck_high, stuck_low, seen, codes, clipped);
    for (int64_t k = whole; k < count; k++) {
        const double above   = seen[k] + 0.5;
        const double below   = above < most ? above : most;
        const double limited = below > 0.0 ? below : 0.0;
        unsigned     code    = (unsigned)(int)limited;
        if (levels != NULL) {
            code = rising ? correct(code, last, levels, seen[k]) : approximate(bits, levels, seen[k]);
        }
        codes[k]   = (uint16_t)((code | stuck_high) & ~stuck_low);
        clipped[k] = (uint8_t)(limited < above) | (uint8_t)(limited > above);
    }
}

void engine_take(int64_t        samples,
                 int            channels,
                 int64_t        stride,
                 const int64_t* row,
                 double         ahead,
                 const double*  before,
                 const double*  probes,
                 const double*  late,
                 double*        out) {
    const int64_t width = 2 * (int64_t)channels;
    for (int64_t sample = 0; sample < samples; sample++, probes += stride * width) {
        for (int channel = 0; channel < channels; channel++, late++, out++) {
            const double* const now   = &probes[row[channel] * width + channel];
            const double* const early = row[channel] == 0 ? &before[channel] : now - width;
            *out                      = *now + *late * (*late < 0.0 ? *now - *early : (now[channels] - *now) / ahead);
        }
        before = &probes[(stride - 1) * width];
    }
}
