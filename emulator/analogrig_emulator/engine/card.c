/// The steps of a data-acquisition card that depend on the sample before or on a table.

#include "engine.h"

void engine_hold(int64_t samples, int channels, double residual, const double* volts, double* held, double* out) {
    for (int64_t k = 0; k < samples; k++, volts += channels, out += channels) {
        for (int i = 0; i < channels; i++) {
            held[i] = volts[i] + residual * (held[i] - volts[i]);
            out[i]  = held[i];
        }
    }
}

void engine_approximate(int64_t count, int bits, const double* levels, const double* seen, uint16_t* codes) {
    for (int64_t k = 0; k < count; k++) {
        unsigned code = 0;
        for (unsigned bit = 1U << bits >> 1; bit > 0U; bit >>= 1) {
            code |= seen[k] >= levels[code | bit] ? bit : 0U;
        }
        codes[k] = (uint16_t)code;
    }
}

void engine_interpolate(int64_t       samples,
                        int           channels,
                        int64_t       stride,
                        const double* before,
                        const double* probes,
                        const double* late,
                        double*       out) {
    for (int64_t sample = 0; sample < samples; sample++, probes += stride * channels) {
        for (int channel = 0; channel < channels; channel++, late++, out++) {
            int64_t row = (int64_t)*late;
            row -= (double)row > *late ? 1 : 0;
            const double part  = *late - (double)row;
            const double early = row < 0 ? before[channel] : probes[row * channels + channel];
            *out               = part > 0.0 ? early + part * (probes[(row + 1) * channels + channel] - early) : early;
        }
        before = &probes[(stride - 1) * channels];
    }
}
