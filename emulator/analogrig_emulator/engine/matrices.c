#include "engine_state.h"

/// Smallest pivot, as a part of the largest element with which its column began. Smaller ones are rounding errors.
#define PIVOT_TOLERANCE 1e-13

void panels_pack(int rows, int columns, int stride, const double* matrix, double* panels) {
    static const double none[2 * MAX_STRIDE] = { 0.0 };
    for (int i = 0; i < rows; i += PANEL) {
        const double* row[PANEL];
        for (int k = 0; k < PANEL; k++) {
            row[k] = i + k < rows ? &matrix[(i + k) * stride] : none;
        }
        for (int j = 0; j < columns; j++, panels += PANEL) {
            panels[0] = row[0][j];
            panels[1] = row[1][j];
            panels[2] = row[2][j];
            panels[3] = row[3][j];
        }
    }
}

void panels_unpack(int rows, int columns, int stride, const double* panels, double* matrix) {
    for (int i = 0; i < rows; i++) {
        for (int j = 0; j < columns; j++) {
            matrix[i * stride + j] = panels[((i / PANEL) * columns + j) * PANEL + i % PANEL];
        }
    }
}

void series_pack(int rows, int columns, int stride, const double* term, int k, int count, double* terms) {
    for (int i = 0; i < rows; i += PANEL) {
        const int height = rows - i < PANEL ? rows - i : PANEL;
        panels_pack(height, columns, stride, &term[i * stride], &terms[(i * count + k * PANEL) * columns]);
    }
}

void series_sum(const kernels_t* kernels, int rows, int count, const double* terms, double part, double* z) {
    double power[TERMS], change[PADDED(ENGINE_MAX_STATES)];
    power[0] = part;
    for (int k = 1; k < count; k++) {
        power[k] = power[k - 1] * part;
    }
    kernels->multiply(rows, count, terms, power, change);
    for (int i = 0; i < rows; i++) {
        z[i] += change[i];
    }
}

double matrix_norm(int n, int stride, const double* a) {
    double largest = 0.0;
    for (int i = 0; i < n; i++) {
        double sum = 0.0;
        for (int j = 0; j < n; j++) {
            sum += fabs(a[i * stride + j]);
        }
        largest = sum > largest ? sum : largest;
    }
    return largest;
}

void matrix_multiply(int n, const double* left, const double* right, bool transpose_left, double* out) {
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < n; j++) {
            double sum = 0.0;
            for (int k = 0; k < n; k++) {
                sum += left[transpose_left ? k * n + i : i * n + k] * right[k * n + j];
            }
            out[i * n + j] = sum;
        }
    }
}

static void swap_rows(int columns, double* matrix, int i, int j) {
    for (int k = 0; k < columns; k++) {
        const double kept       = matrix[i * columns + k];
        matrix[i * columns + k] = matrix[j * columns + k];
        matrix[j * columns + k] = kept;
    }
}

static int largest_in_column(int n, const double* a, int column, int first) {
    int best = first;
    for (int i = first + 1; i < n; i++) {
        if (fabs(a[i * n + column]) > fabs(a[best * n + column])) {
            best = i;
        }
    }
    return best;
}

static void eliminate(int n, int columns, double* a, double* b, int pivot, int row) {
    const double factor = a[row * n + pivot] / a[pivot * n + pivot];
    if (fabs(factor) > 0.0) {
        for (int j = pivot; j < n; j++) {
            a[row * n + j] -= factor * a[pivot * n + j];
        }
        for (int j = 0; j < columns; j++) {
            b[row * columns + j] -= factor * b[pivot * columns + j];
        }
    }
}

static void substitute_back(int n, int columns, const double* a, double* b) {
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) {
            const double factor = a[i * n + k];
            for (int j = 0; j < columns; j++) {
                b[i * columns + j] -= factor * b[k * columns + j];
            }
        }
        for (int j = 0; j < columns; j++) {
            b[i * columns + j] /= a[i * n + i];
        }
    }
}

int engine_solve(int n, int columns, double* a, double* b) {
    double least[ENGINE_MAX_UNKNOWNS];
    if (n > ENGINE_MAX_UNKNOWNS) {
        return ENGINE_MAX_UNKNOWNS;
    }
    for (int j = 0; j < n; j++) {
        least[j] = PIVOT_TOLERANCE * fabs(a[largest_in_column(n, a, j, 0) * n + j]);
    }
    for (int pivot = 0; pivot < n; pivot++) {
        const int best = largest_in_column(n, a, pivot, pivot);
        if (!(fabs(a[best * n + pivot]) > least[pivot])) {
            return pivot;
        }
        swap_rows(n, a, pivot, best);
        swap_rows(columns, b, pivot, best);
        for (int row = pivot + 1; row < n; row++) {
            eliminate(n, columns, a, b, pivot, row);
        }
    }
    substitute_back(n, columns, a, b);
    return -1;
}

bool matrix_is_positive(int n, double* a) {
    double least[ENGINE_MAX_KINKS];
    bool   positive = true;
    for (int j = 0; j < n; j++) {
        least[j] = PIVOT_TOLERANCE * fabs(a[largest_in_column(n, a, j, 0) * n + j]);
    }
    for (int pivot = 0; pivot < n; pivot++) {
        const int best = largest_in_column(n, a, pivot, pivot);
        if (!(fabs(a[best * n + pivot]) > least[pivot])) {
            return false;
        }
        if (best != pivot) {
            swap_rows(n, a, pivot, best);
            positive = !positive;
        }
        positive = positive == (a[pivot * n + pivot] > 0.0);
        for (int row = pivot + 1; row < n; row++) {
            eliminate(n, 0, a, NULL, pivot, row);
        }
    }
    return positive;
}
