/* Compiled functions with their vectors, and algebraic loops by Newton's method, as an interpreted run solves them.

   A loop that is not solved, is not determined, or meets a value that is not finite is left to Python. */

#ifndef _POSIX_C_SOURCE
#define _POSIX_C_SOURCE 200809L /* of the system: clock_gettime and poll */
#endif
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifdef _WIN32
#define VISIBLE __declspec(dllexport)
#else
#define VISIBLE __attribute__((visibility("default")))
#endif

typedef int (*tick_function)(const double **arguments, double **results, long long *iw, double *w, int memory);

/* A tick at which some clocks act. */
typedef struct {
    tick_function evaluate;
    const double **arguments;
    double **results;
    long long *iw;
    double *w;
} tick;

static inline int call(const tick *f) { return f->evaluate(f->arguments, f->results, f->iw, f->w, 0); }

/* The algebraic loops at such a tick: r is what comes round less v, J its derivative by v, column by column. */
typedef struct {
    int64_t n; /* 0: no loops */
    tick equations;
    const int64_t *where; /* entries of x that hold v */
    const double *r, *J;
    double *v, *before, *direction, *column, *lu; /* lu: n × n, row by row */
    int64_t *rows;
    double tolerance, rounding, singular;
    int64_t iterations, halvings;
} newton;

static double largest(const double *values, int64_t n) {
    double found = 0;
    for (int64_t i = 0; i < n; i++) found = fmax(found, fabs(values[i]));
    return found;
}

static double length(const double *values, int64_t n) {
    double sum = 0;
    for (int64_t i = 0; i < n; i++) sum += values[i] * values[i];
    return sqrt(sum);
}

static bool are_finite(const double *values, int64_t n) {
    for (int64_t i = 0; i < n; i++)
        if (!isfinite(values[i])) return false;
    return true;
}

/* Factorize J with partial pivoting; false if a pivot is zero. */
static bool factorize(newton *s) {
    int64_t n = s->n;
    double *a = s->lu;
    for (int64_t i = 0; i < n; i++) {
        s->rows[i] = i;
        for (int64_t j = 0; j < n; j++) a[i * n + j] = s->J[j * n + i];
    }
    for (int64_t k = 0; k < n; k++) {
        int64_t best = k;
        for (int64_t i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > fabs(a[best * n + k])) best = i;
        if (a[best * n + k] == 0) return false;
        if (best != k) {
            int64_t row = s->rows[k];
            s->rows[k] = s->rows[best];
            s->rows[best] = row;
            for (int64_t j = 0; j < n; j++) {
                double value = a[k * n + j];
                a[k * n + j] = a[best * n + j];
                a[best * n + j] = value;
            }
        }
        for (int64_t i = k + 1; i < n; i++) {
            double factor = a[i * n + k] /= a[k * n + k];
            if (factor != 0)
                for (int64_t j = k + 1; j < n; j++) a[i * n + j] -= factor * a[k * n + j];
        }
    }
    return true;
}

/* Solve with the factors: made = J^-1 given. */
static void substitute(const newton *s, const double *given, double *made) {
    int64_t n = s->n;
    for (int64_t i = 0; i < n; i++) {
        made[i] = given[s->rows[i]];
        for (int64_t j = 0; j < i; j++)
            if (s->lu[i * n + j] != 0) made[i] -= s->lu[i * n + j] * made[j];
    }
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t j = i + 1; j < n; j++) made[i] -= s->lu[i * n + j] * made[j];
        made[i] /= s->lu[i * n + i];
    }
}

/* Whether J is surely regular: the least singular value is at least 1 over the Frobenius norm of the inverse. */
static bool is_determined(newton *s) {
    int64_t n = s->n;
    double gain = 0, sum = 0;
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++) gain = fmax(gain, fabs(s->J[j * n + i] + (i == j)));
    if (n == 1) return fabs(s->J[0]) > s->singular * (1 + gain);
    if (!factorize(s)) return false;
    for (int64_t k = 0; k < n; k++) {
        for (int64_t i = 0; i < n; i++) s->column[i] = i == k;
        substitute(s, s->column, s->direction);
        for (int64_t i = 0; i < n; i++) sum += s->direction[i] * s->direction[i];
    }
    return 1 / sqrt(sum) > s->singular * (1 + gain);
}

static bool evaluate_loops(const newton *s) {
    return !call(&s->equations) && are_finite(s->r, s->n) && are_finite(s->J, s->n * s->n);
}

/* Solve the loops from the values in x on, as `LoopSolver` does; false: Python is to do it. */
static bool solve_loops(newton *s, double *x) {
    int64_t n = s->n;
    for (int64_t i = 0; i < n; i++) s->before[i] = s->v[i] = x[s->where[i]];
    if (!evaluate_loops(s)) return false;
    double size = length(s->r, n);
    for (int64_t k = 0; k < s->iterations; k++) {
        if (!(largest(s->r, n) / (1 + largest(s->v, n)) > s->rounding)) break;
        if (!factorize(s)) return false;
        substitute(s, s->r, s->direction);
        if (!are_finite(s->direction, n)) return false;
        double best = 0, step = 1;
        for (int64_t j = 0; j < s->halvings; j++) {
            for (int64_t i = 0; i < n; i++) x[s->where[i]] = s->v[i] - step * s->direction[i];
            if (!evaluate_loops(s)) return false;
            double now = length(s->r, n);
            if (now < size) {
                best = step;
                size = now;
            } else if (best != 0) {
                break;
            }
            if (best == 1) break;
            step *= 0.5;
        }
        if (best != step) {
            for (int64_t i = 0; i < n; i++) x[s->where[i]] = s->v[i] - best * s->direction[i];
            if (!evaluate_loops(s)) return false;
        }
        if (best == 0) break;
        for (int64_t i = 0; i < n; i++) s->v[i] = x[s->where[i]];
    }
    for (int64_t i = 0; i < n; i++) s->v[i] = x[s->where[i]];
    return largest(s->r, n) / (1 + largest(s->v, n)) <= s->tolerance && is_determined(s);
}

static void undo_loops(const newton *s, double *x) {
    for (int64_t i = 0; i < s->n; i++) x[s->where[i]] = s->before[i];
}
