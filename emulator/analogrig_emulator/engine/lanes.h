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

/// One panel of a product with z: `low` and `high` are its halves, or `low` is all of it.
typedef struct {
    lanes_t low, high;
} KERNEL(part_t);

typedef struct {
    KERNEL(part_t) first, second, third, fourth;
} KERNEL(parts_t);

INLINE void KERNEL(add_column)(const double* column, double factor, KERNEL(part_t) * sum) {
    sum->low += *(const lanes_t*)column * factor;
    if (LANES < PANEL) {
        sum->high += *(const lanes_t*)&column[PANEL - LANES] * factor;
    }
}

/// Add one column of up to four panels. `next` elements lie between two of them.
INLINE void
KERNEL(add_columns)(int panels, ptrdiff_t next, const double* column, double factor, KERNEL(parts_t) * sum) {
    KERNEL(add_column)(column, factor, &sum->first);
    if (panels > 1) {
        KERNEL(add_column)(&column[next], factor, &sum->second);
    }
    if (panels > 2) {
        KERNEL(add_column)(&column[2 * next], factor, &sum->third);
    }
    if (panels > 3) {
        KERNEL(add_column)(&column[3 * next], factor, &sum->fourth);
    }
}

/// Products of one to four panels with z. Several sums at a time hide the latency of each.
INLINE KERNEL(parts_t) KERNEL(product)(int panels, int columns, const double* panel, const double* z) {
    const lanes_t zero       = { 0.0 };
    KERNEL(parts_t) sum      = { { zero, zero }, { zero, zero }, { zero, zero }, { zero, zero } };
    const ptrdiff_t     next = PANEL * (ptrdiff_t)columns;
    const double* const end  = &z[columns - 1];
    for (; z < end; z += 2, panel += 2 * PANEL) {
        KERNEL(add_columns)(panels, next, panel, z[0], &sum);
        KERNEL(add_columns)(panels, next, &panel[PANEL], z[1], &sum);
    }
    if (z == end) {
        KERNEL(add_columns)(panels, next, panel, z[0], &sum);
    }
    return sum;
}

INLINE void KERNEL(store)(KERNEL(part_t) part, double* out) {
    *(lanes_t*)out = part.low;
    if (LANES < PANEL) {
        *(lanes_t*)&out[PANEL - LANES] = part.high;
    }
}

INLINE void KERNEL(multiply_part)(
    int panels, int columns, const double* restrict panel, const double* restrict z, double* restrict out) {
    const KERNEL(parts_t) sum = KERNEL(product)(panels, columns, panel, z);
    KERNEL(store)(sum.first, out);
    if (panels > 1) {
        KERNEL(store)(sum.second, &out[PANEL]);
    }
    if (panels > 2) {
        KERNEL(store)(sum.third, &out[2 * PANEL]);
    }
    if (panels > 3) {
        KERNEL(store)(sum.fourth, &out[3 * PANEL]);
    }
}

TARGET static void
KERNEL(multiply)(int rows, int columns, const double* restrict panels, const double* restrict z, double* restrict out) {
    for (; rows > 3 * PANEL; rows -= 4 * PANEL, panels += 4 * PANEL * columns, out += 4 * PANEL) {
        KERNEL(multiply_part)(4, columns, panels, z, out);
    }
    if (rows > 2 * PANEL) {
        KERNEL(multiply_part)(3, columns, panels, z, out);
    } else if (rows > PANEL) {
        KERNEL(multiply_part)(2, columns, panels, z, out);
    } else if (rows > 0) {
        KERNEL(multiply_part)(1, columns, panels, z, out);
    }
}

TARGET static void KERNEL(advance)(int rows, int columns, const double* restrict panels, double* restrict z) {
    double change[PADDED(ENGINE_MAX_STATES)];
    if (rows <= PANEL) {
        KERNEL(multiply_part)(1, columns, panels, z, change);
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

/// Converter inputs of PANEL channels without a memory. Return NaN if a voltage is not finite, else 0.
TARGET static double
KERNEL(see)(int64_t samples, const double* card, const double* volts, const double* normals, double* seen) {
    double excess = 0.0;
    for (int i = 0; i < PANEL; i += LANES) {
        const lanes_t gain = *(const lanes_t*)&card[i], droop = *(const lanes_t*)&card[PANEL + i];
        const lanes_t low = *(const lanes_t*)&card[2 * PANEL + i], lsb = *(const lanes_t*)&card[3 * PANEL + i];
        const lanes_t noise = *(const lanes_t*)&card[4 * PANEL + i], offset = *(const lanes_t*)&card[5 * PANEL + i];
        lanes_t       sum = { 0.0 };
        for (int64_t k = i; k < PANEL * samples; k += PANEL) {
            const lanes_t volt  = *(const lanes_t*)&volts[k];
            *(lanes_t*)&seen[k] = (volt * gain - droop - low) / lsb + (*(const lanes_t*)&normals[k] * noise + offset);
            sum += volt - volt;
        }
        for (int j = 0; j < LANES; j++) {
            excess += sum[j];
        }
    }
    return excess;
}

/// Codes 0 to `most` of an ideal converter, with `most` a little below their number; count is a multiple of PANEL.
TARGET static void KERNEL(convert)(int64_t       count,
                                   double        most,
                                   unsigned      stuck_high,
                                   unsigned      stuck_low,
                                   const double* seen,
                                   uint16_t*     codes,
                                   uint8_t*      clipped) {
    typedef int32_t  numbers_t __attribute__((vector_size(LANES * sizeof(int32_t))));
    typedef uint16_t codes_t
        __attribute__((vector_size(LANES * sizeof(uint16_t)), aligned(sizeof(uint16_t)), may_alias));
    typedef uint8_t flags_t __attribute__((vector_size(LANES), aligned(1), may_alias));
    const lanes_t   zero = { 0.0 };
    for (int64_t k = 0; k < count; k += LANES) {
        const lanes_t   above = *(const lanes_t*)&seen[k] + 0.5, end = zero + most;
        const mask_t    within  = above < most;
        const lanes_t   below   = (lanes_t)(((mask_t)above & within) | ((mask_t)end & ~within));
        const lanes_t   limited = (lanes_t)((mask_t)below & (below > 0.0));
        const numbers_t code    = (__builtin_convertvector(limited, numbers_t) | (int)stuck_high) & ~(int)stuck_low;
        *(codes_t*)&codes[k]    = __builtin_convertvector(code, codes_t);
        *(flags_t*)&clipped[k]  = __builtin_convertvector((limited < above) | (limited > above), flags_t) & 1;
    }
}

INLINE bool KERNEL(is_any)(mask_t mask) {
    return LANES == 2 ? (mask[0] | mask[1]) != 0 : (mask[0] | mask[1] | mask[LANES - 2] | mask[LANES - 1]) != 0;
}

/// Value of a polynomial.
INLINE lanes_t KERNEL(evaluate)(const double* coefficients, int degree, lanes_t at) {
    const lanes_t zero  = { 0.0 };
    lanes_t       value = zero + coefficients[degree];
    for (int k = degree - 1; k >= 0; k--) {
        value = value * at + coefficients[k];
    }
    return value;
}

TARGET static double KERNEL(apply)(const law_t* law, const double* arguments, const double* driven, double* values) {
    double change[PANEL], most = 0.0;
    for (int i = 0; i < PANEL; i += LANES) {
        const lanes_t p = *(const lanes_t*)&arguments[i], q = *(const lanes_t*)&arguments[PANEL + i];
        lanes_t       x = KERNEL(evaluate)(law->factors.x, law->x_degree, p);
        const lanes_t y = KERNEL(evaluate)(law->factors.y, law->y_degree, q);
        for (int j = 0; j < LANES && law->kind == ENGINE_ROOT; j++) {
            x[j] = x[j] > 0.0 ? sqrt(x[j]) : 0.0;
        }
        const lanes_t value   = (law->kind == ENGINE_QUOTIENT ? x / y : x * y) + *(const lanes_t*)&driven[i];
        *(lanes_t*)&change[i] = value - *(const lanes_t*)&values[i];
        *(lanes_t*)&values[i] = value;
    }
    for (int i = 0; i < PANEL; i++) {
        const double size = fabs(change[i]);
        most              = size <= most ? most : isfinite(size) ? size : (double)INFINITY;
    }
    return most;
}

/// Part of look() for one group of lanes. w1: arguments at the end of the step.
INLINE void KERNEL(judge_lanes)(const engine_t* self, int k, lanes_t w1, double growth, mask_t* inside, mask_t* near) {
    const lanes_t zero    = { 0.0 };
    const mask_t  no_sign = ~(mask_t)-zero;
    const lanes_t w0 = *(const lanes_t*)&self->w[k], before = *(const lanes_t*)&self->w_before[k];
    const lanes_t lower = *(const lanes_t*)&self->lower[k], upper = *(const lanes_t*)&self->upper[k];
    const lanes_t change   = (lanes_t)((mask_t)(w1 - w0) & no_sign);
    const lanes_t expected = (lanes_t)((mask_t)(w0 - before) & no_sign) * growth;
    const lanes_t both = w0 + w1, far = 3.0 * change, fast = change + 2.0 * expected;
    const mask_t  farther = far > fast;
    const lanes_t stray   = (lanes_t)(((mask_t)far & farther) | ((mask_t)fast & ~farther));
    *inside &= (w1 >= lower) & (w1 <= upper);
    *near |= (both + stray > 2.0 * upper) | (both - stray < 2.0 * lower);
    *(lanes_t*)&self->w_there[k] = w1;
}

INLINE void KERNEL(judge)(const engine_t* self, int k, KERNEL(part_t) w1, double growth, mask_t* inside, mask_t* near) {
    KERNEL(judge_lanes)(self, k, w1.low, growth, inside, near);
    if (LANES < PANEL) {
        KERNEL(judge_lanes)(self, k + PANEL - LANES, w1.high, growth, inside, near);
    }
}

/// Part of look() for one to four panels from kink k on.
INLINE void KERNEL(look_part)(const engine_t* self,
                              int             panels,
                              int             columns,
                              int             k,
                              const double* restrict panel,
                              const double* restrict z,
                              double  growth,
                              mask_t* inside,
                              mask_t* near) {
    const KERNEL(parts_t) sum = KERNEL(product)(panels, columns, panel, z);
    KERNEL(judge)(self, k, sum.first, growth, inside, near);
    if (panels > 1) {
        KERNEL(judge)(self, k + PANEL, sum.second, growth, inside, near);
    }
    if (panels > 2) {
        KERNEL(judge)(self, k + 2 * PANEL, sum.third, growth, inside, near);
    }
    if (panels > 3) {
        KERNEL(judge)(self, k + 3 * PANEL, sum.fourth, growth, inside, near);
    }
}

INLINE judgement_t KERNEL(look_once)(
    const engine_t* self, int columns, const double* restrict panels, const double* restrict z, double growth) {
    const lanes_t zero   = { 0.0 };
    mask_t        inside = zero <= zero, near = zero > zero;
    int           k = 0;
    for (; k + 3 * PANEL < self->kinks; k += 4 * PANEL, panels += 4 * PANEL * columns) {
        KERNEL(look_part)(self, 4, columns, k, panels, z, growth, &inside, &near);
    }
    if (k + 2 * PANEL < self->kinks) {
        KERNEL(look_part)(self, 3, columns, k, panels, z, growth, &inside, &near);
    } else if (k + PANEL < self->kinks) {
        KERNEL(look_part)(self, 2, columns, k, panels, z, growth, &inside, &near);
    } else if (k < self->kinks) {
        KERNEL(look_part)(self, 1, columns, k, panels, z, growth, &inside, &near);
    }
    return !KERNEL(is_any)(near | ~inside) ? CLEAR : KERNEL(is_any)(~inside) ? CROSSED : NEAR;
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

static const kernels_t KERNEL(kernels) = { KERNEL(multiply), KERNEL(advance), KERNEL(compose),
                                           KERNEL(add),      KERNEL(apply),   KERNEL(look),
                                           KERNEL(look_on),  KERNEL(see),     KERNEL(convert) };

#undef INLINE
#undef JOINED
#undef NAMED
#undef KERNEL
#undef lanes_t
#undef mask_t
#undef TARGET
#undef LANES
