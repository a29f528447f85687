/* Vectors and square matrices, which are stored row by row. Runs of diagrams and exported FMUs use them. */

static inline bool lw_are_finite(const double *x, int64_t n) {
    double sum = 0.0;
    for (int64_t i = 0; i < n; i++) sum += 0.0 * x[i];
    return sum == 0.0;
}

/* Write the factors L and U of a matrix in its place, with partial pivoting; entries are pairs if `pairs` is 2. */
static bool lw_factor(double *a, int64_t *pivots, int64_t n, int pairs) {
    for (int64_t k = 0; k < n; k++) {
        int64_t pivot = k;
        double largest = 0.0;
        for (int64_t i = k; i < n; i++) {
            const double *v = a + (i * n + k) * pairs, size = fabs(v[0]) + (pairs == 2 ? fabs(v[1]) : 0.0);
            if (size > largest) largest = size, pivot = i;
        }
        pivots[k] = pivot;
        if (!(largest > 0.0) || !isfinite(largest)) return false;
        if (pivot != k)
            for (int64_t j = 0; j < n * pairs; j++) {
                const double swap = a[k * n * pairs + j];
                a[k * n * pairs + j] = a[pivot * n * pairs + j];
                a[pivot * n * pairs + j] = swap;
            }
        const double *d = a + (k * n + k) * pairs;
        for (int64_t i = k + 1; i < n; i++) {
            double *row = a + i * n * pairs, *v = row + k * pairs;
            const double *top = a + k * n * pairs;
            if (pairs == 1) {
                if (v[0] == 0.0) continue;
                v[0] /= d[0];
                for (int64_t j = k + 1; j < n; j++) row[j] -= v[0] * top[j];
            } else {
                if (v[0] == 0.0 && v[1] == 0.0) continue;
                const double size = d[0] * d[0] + d[1] * d[1];
                const double re = (v[0] * d[0] + v[1] * d[1]) / size, im = (v[1] * d[0] - v[0] * d[1]) / size;
                v[0] = re, v[1] = im;
                for (int64_t j = k + 1; j < n; j++) {
                    row[2 * j] -= re * top[2 * j] - im * top[2 * j + 1];
                    row[2 * j + 1] -= re * top[2 * j + 1] + im * top[2 * j];
                }
            }
        }
    }
    return true;
}

/* Solve with the factors: b becomes the solution. */
static void lw_solve(const double *lu, const int64_t *pivots, int64_t n, double *b) {
    for (int64_t k = 0; k < n; k++) {
        const double swap = b[k];
        b[k] = b[pivots[k]];
        b[pivots[k]] = swap;
    }
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < i; j++) b[i] -= lu[i * n + j] * b[j];
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t j = i + 1; j < n; j++) b[i] -= lu[i * n + j] * b[j];
        b[i] /= lu[i * n + i];
    }
}
