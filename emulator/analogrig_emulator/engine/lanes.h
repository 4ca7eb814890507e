/// The inner loops for processors that handle LANES numbers at once; kernels.c includes this file for each of them. Every sum
/// has the same order, and so the same bits, at any width.

#define INLINE TARGET static inline __attribute__((always_inline))
#define JOINED(name, lanes) name##_##lanes
#define NAMED(name, lanes) JOINED(name, lanes)
#define KERNEL(name) NAMED(name, LANES)
#define lanes_t KERNEL(lanes_t)
#define mask_t KERNEL(mask_t)

typedef double lanes_t __attribute__((vector_size(LANES * sizeof(double)), aligned(sizeof(double)), may_alias));
typedef __typeof__((lanes_t){ 0.0 } > (lanes_t){ 0.0 }) mask_t;

/// Products of two panels, or of one and itself, with z: `low` and `high` are the halves of a panel, or `low` is all of it.
typedef struct {
    lanes_t low, high, next_low, next_high;
} KERNEL(products_t);

INLINE KERNEL(products_t) KERNEL(product)(int columns, const double* panel, const double* next, const double* z) {
    KERNEL(products_t) sum = { { 0.0 }, { 0.0 }, { 0.0 }, { 0.0 } };
    for (int j = 0; j < columns; j++) {
        sum.low += *(const lanes_t*)&panel[j * PANEL] * z[j];
        sum.next_low += *(const lanes_t*)&next[j * PANEL] * z[j];
        if (LANES < PANEL) {
            sum.high += *(const lanes_t*)&panel[j * PANEL + PANEL - LANES] * z[j];
            sum.next_high += *(const lanes_t*)&next[j * PANEL + PANEL - LANES] * z[j];
        }
    }
    return sum;
}

INLINE void KERNEL(store)(lanes_t low, lanes_t high, double* out) {
    *(lanes_t*)out = low;
    if (LANES < PANEL) {
        *(lanes_t*)&out[PANEL - LANES] = high;
    }
}

TARGET static void
KERNEL(multiply)(int rows, int columns, const double* restrict panels, const double* restrict z, double* restrict out) {
    int i = 0;
    for (; i + PANEL < rows; i += 2 * PANEL, panels += 2 * PANEL * columns) {
        const KERNEL(products_t) sum = KERNEL(product)(columns, panels, &panels[PANEL * columns], z);
        KERNEL(store)(sum.low, sum.high, &out[i]);
        KERNEL(store)(sum.next_low, sum.next_high, &out[i + PANEL]);
    }
    if (i < rows) {
        const KERNEL(products_t) sum = KERNEL(product)(columns, panels, panels, z);
        KERNEL(store)(sum.low, sum.high, &out[i]);
    }
}

TARGET static void KERNEL(advance)(int rows, int columns, const double* restrict panels, double* restrict z) {
    double change[PADDED(ENGINE_MAX_STATES)];
    if (rows <= PANEL) {
        const KERNEL(products_t) sum = KERNEL(product)(columns, panels, panels, z);
        KERNEL(store)(sum.low, sum.high, change);
    } else {
        KERNEL(multiply)(rows, columns, panels, z, change);
    }
    for (int i = 0; i < rows; i++) {
        z[i] += change[i];
    }
}

TARGET static void KERNEL(compose)(
    int rows, int n, int stride, const double* restrict left, const double* restrict right, double* restrict out) {
    for (int i = 0; i < rows; i++, left += stride, out += stride) {
        int j = 0;
        for (; j + LANES < stride; j += 2 * LANES) {
            lanes_t sum = { 0.0 }, next = { 0.0 };
            for (int k = 0; k < n; k++) {
                sum += left[k] * *(const lanes_t*)&right[k * stride + j];
                next += left[k] * *(const lanes_t*)&right[k * stride + j + LANES];
            }
            *(lanes_t*)&out[j]         = sum;
            *(lanes_t*)&out[j + LANES] = next;
        }
        if (j < stride) {
            lanes_t sum = { 0.0 };
            for (int k = 0; k < n; k++) {
                sum += left[k] * *(const lanes_t*)&right[k * stride + j];
            }
            *(lanes_t*)&out[j] = sum;
        }
    }
}

TARGET static void
KERNEL(add)(int count, double factor, const double* restrict from, double gain, double* restrict to) {
    for (int i = 0; i < count; i += LANES) {
        lanes_t* const lanes = (lanes_t*)&to[i];
        *lanes               = factor * *lanes + gain * *(const lanes_t*)&from[i];
    }
}

TARGET static void
KERNEL(sum)(int rows, int stride, int terms, const double* restrict term, double part, double* restrict z) {
    for (int i = 0; i < rows; i += LANES) {
        lanes_t sum = { 0.0 };
        for (int k = terms - 1; k >= 0; k--) {
            sum = (sum + *(const lanes_t*)&term[k * stride + i]) * part;
        }
        *(lanes_t*)&z[i] += sum;
    }
}

/// Part of look() for one group of lanes. w1: arguments at the end of the step.
INLINE void KERNEL(judge)(const engine_t* self, int k, lanes_t w1, double growth, mask_t* inside, mask_t* near) {
    const lanes_t zero    = { 0.0 };
    const mask_t  no_sign = ~(mask_t)-zero;
    const lanes_t w0 = *(const lanes_t*)&self->w[k], before = *(const lanes_t*)&self->w_before[k];
    const lanes_t lower = *(const lanes_t*)&self->lower[k], upper = *(const lanes_t*)&self->upper[k];
    const lanes_t change   = (lanes_t)((mask_t)(w1 - w0) & no_sign);
    const lanes_t expected = (lanes_t)((mask_t)(w0 - before) & no_sign) * growth;
    const lanes_t both = w0 + w1, far = 3.0 * change, fast = change + 2.0 * expected;
    *inside &= (w1 >= lower) & (w1 <= upper);
    *near |= (both + far > 2.0 * upper) | (both - far < 2.0 * lower);
    *near |= (both + fast > 2.0 * upper) | (both - fast < 2.0 * lower);
    *(lanes_t*)&self->w_there[k] = w1;
}

INLINE judgement_t KERNEL(look_once)(
    const engine_t* self, int columns, const double* restrict panels, const double* restrict z, double growth) {
    const lanes_t zero   = { 0.0 };
    mask_t        inside = zero <= zero, near = zero > zero;
    int           k = 0;
    for (; k + PANEL < self->kinks; k += 2 * PANEL, panels += 2 * PANEL * columns) {
        const KERNEL(products_t) sum = KERNEL(product)(columns, panels, &panels[PANEL * columns], z);
        KERNEL(judge)(self, k, sum.low, growth, &inside, &near);
        KERNEL(judge)(self, k + PANEL, sum.next_low, growth, &inside, &near);
        if (LANES < PANEL) {
            KERNEL(judge)(self, k + PANEL - LANES, sum.high, growth, &inside, &near);
            KERNEL(judge)(self, k + 2 * PANEL - LANES, sum.next_high, growth, &inside, &near);
        }
    }
    if (k < self->kinks) {
        const KERNEL(products_t) sum = KERNEL(product)(columns, panels, panels, z);
        KERNEL(judge)(self, k, sum.low, growth, &inside, &near);
        if (LANES < PANEL) {
            KERNEL(judge)(self, k + PANEL - LANES, sum.high, growth, &inside, &near);
        }
    }
    int64_t all = -1, any = 0;
    for (int i = 0; i < LANES; i++) {
        all &= inside[i];
        any |= near[i];
    }
    return all == 0 ? CROSSED : any != 0 ? NEAR : CLEAR;
}

TARGET static judgement_t
KERNEL(look)(engine_t* self, int columns, const double* panels, const double* z, double growth) {
    return KERNEL(look_once)(self, columns, panels, z, growth);
}

TARGET static judgement_t KERNEL(look_on)(engine_t* self, int64_t tick) {
    const int     columns = self->columns, base = self->mode->base, elements = PANEL_ELEMENTS(self->kinks, columns);
    const double* looks = &self->mode->looks[(self->look - base) * elements];
    for (; self->clear < tick && self->look <= self->mode->top; looks += elements) {
        const int         since     = self->look - base;
        const double      growth    = since < 2 ? (double)since : 2.0;
        const judgement_t judgement = KERNEL(look_once)(self, columns, looks, self->origin_z, growth);
        self->counts.steps++;
        if (judgement != CLEAR) {
            return judgement;
        }
        step_accept(self, self->origin + (INT64_C(1) << self->look) - self->clear);
        self->look++;
    }
    return CLEAR;
}

static const kernels_t KERNEL(kernels) = { KERNEL(multiply), KERNEL(advance), KERNEL(compose), KERNEL(add),
                                           KERNEL(sum),      KERNEL(look),    KERNEL(look_on) };

#undef INLINE
#undef JOINED
#undef NAMED
#undef KERNEL
#undef lanes_t
#undef mask_t
#undef TARGET
#undef LANES
