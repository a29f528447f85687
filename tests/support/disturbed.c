/* Disturbs matrices as rounding might; `disturbed.py` says by how much and why. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Finds the powers of 2 that balance a square matrix of sizes, as LAPACK's dgebal does: rows and columns of like norms. */
static void balance(double *a, long n, double *scale) {
    for (long i = 0; i < n; i++) scale[i] = 1.0;
    for (int pass = 0, changed = 1; changed && pass < 100; pass++) {
        changed = 0;
        for (long i = 0; i < n; i++) {
            double c = 0.0, r = 0.0, f = 1.0;
            for (long j = 0; j < n; j++) {
                c += a[j * n + i] * a[j * n + i];
                r += a[i * n + j] * a[i * n + j];
            }
            c = sqrt(c), r = sqrt(r);
            if (!(c > 0.0 && r > 0.0 && c < 1e150 && r < 1e150)) continue;
            double sum = c + r;
            while (c < r / 2.0 && f < 1e140) f *= 2.0, c *= 2.0, r /= 2.0;
            while (c / 2.0 >= r && f > 1e-140) f /= 2.0, c /= 2.0, r *= 2.0;
            if (c + r >= 0.95 * sum) continue;
            changed = 1;
            scale[i] *= f;
            for (long j = 0; j < n; j++) a[j * n + i] *= f;
            for (long j = 0; j < n; j++) a[i * n + j] /= f;
        }
    }
}

/* Finds the entries between which powers of a matrix lead. */
static void connect(const double *a, long n, unsigned char *on) {
    for (long i = 0; i < n * n; i++) on[i] = a[i] > 0.0;
    for (long k = 0; k < n; k++)
        for (long i = 0; i < n; i++)
            if (on[i * n + k])
                for (long j = 0; j < n; j++) on[i * n + j] |= on[k * n + j];
}

/* Gives the largest size in the row or in the column of each entry, whichever is less. */
static void least(const double *a, long rows, long columns, double *of_row, double *of_column) {
    for (long j = 0; j < columns; j++) of_column[j] = 0.0;
    for (long i = 0; i < rows; i++) {
        of_row[i] = 0.0;
        for (long j = 0; j < columns; j++) {
            double x = a[i * columns + j];
            if (x > of_row[i]) of_row[i] = x;
            if (x > of_column[j]) of_column[j] = x;
        }
    }
}

/* Adds disturbances to `count` matrices (or vectors: rows 0) one after the other, and returns how many numbers of the pool
   it has used; -1, with nothing changed, where one of their numbers isn't finite. `parts` is 2 for complex numbers. */
EXPORT long disturb(double *values, long count, long rows, long columns, long parts, long normwise,
                    const double *pool, long pooled, long place) {
    long is_vector = rows == 0, n = (is_vector ? 1 : rows) * columns, used = 0, is_square = !is_vector && rows == columns;
    for (long i = 0; i < count * n * parts; i++)
        if (!isfinite(values[i])) return -1;
    int symmetric = is_square;
    for (long m = 0; m < count && symmetric; m++)
        for (long i = 0; i < rows && symmetric; i++)
            for (long j = i; j < columns && symmetric; j++)
                for (long part = 0; part < parts; part++) {
                    double one = values[((m * rows + i) * columns + j) * parts + part];
                    double other = values[((m * rows + j) * columns + i) * parts + part];
                    if (one != (part ? -other : other)) symmetric = 0;
                }
    double *work = malloc(sizeof(double) * (size_t)(5 * n + 3 * (rows + columns)));
    unsigned char *on = malloc((size_t)n);
    if (!work || !on) abort();
    double *sizes = work, *largest = work + n, *balanced = work + 2 * n, *change = work + 3 * n, *factor = work + 4 * n;
    double *scale = work + 5 * n, *row = scale + rows, *column = row + rows, *row2 = column + columns, *column2 = row2 + rows;
    long at = place;
    for (long part = 0; part < parts; part++) {
        double turn = part ? -1.0 : 1.0;
        int is_balanced = 1, is_full = 1, is_zero = 1;
        memset(largest, 0, sizeof(double) * (size_t)n);
        for (long m = 0; m < count; m++)
            for (long i = 0; i < n; i++) {
                double x = fabs(values[(m * n + i) * parts + part]);
                if (x > largest[i]) largest[i] = x;
            }
        for (long i = 0; i < n; i++) is_zero &= largest[i] == 0.0;
        if (is_zero) continue; /* such as the imaginary parts of a real right side */
        if (is_square && !normwise) { /* one balance for a stack */
            memcpy(balanced, largest, sizeof(double) * (size_t)n);
            balance(balanced, rows, scale);
            for (long r = 0; r < rows; r++) {
                is_balanced &= scale[r] == scale[0];
                for (long c = 0; c < columns; c++) factor[r * columns + c] = scale[c] / scale[r];
            }
            for (long i = 0; i < n; i++) is_full &= largest[i] > 0.0;
            if (!is_full) connect(largest, rows, on);
        }
        for (long m = 0; m < count; m++) {
            double *x = values + m * n * parts + part, norm = 0.0;
            for (long i = 0; i < n; i++) {
                sizes[i] = fabs(x[i * parts]);
                norm += sizes[i] * sizes[i];
                change[i] = pool[at];
                if (++at == pooled) at = 0;
            }
            used += n;
            norm = sqrt(norm / (double)n);
            if (!normwise && !is_vector) {
                least(sizes, rows, columns, row, column);
                if (is_square && !is_balanced) {
                    for (long i = 0; i < n; i++) balanced[i] = sizes[i] * factor[i];
                    least(balanced, rows, columns, row2, column2);
                }
            }
            for (long r = 0, i = 0; i < n; r++)
                for (long c = 0; c < columns; c++, i++) {
                    double size = normwise ? norm : sizes[i], d = change[i];
                    if (!normwise && !is_vector) {
                        size = row[r] < column[c] ? row[r] : column[c];
                        if (is_square && !is_balanced) { /* a NaN of overflowed factors is left out */
                            double other = (row2[r] < column2[c] ? row2[r] : column2[c]) * factor[c * columns + r];
                            if (other < size) size = other;
                        }
                        if (is_square ? !is_full && !on[i] : sizes[i] == 0.0) size = 0.0;
                    }
                    if (symmetric) d = 0.5 * (d + turn * change[c * columns + r]);
                    x[i * parts] += d * size;
                }
        }
    }
    free(work);
    free(on);
    return used;
}
