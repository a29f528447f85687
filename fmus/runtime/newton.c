/* Compiled functions with their vectors, and algebraic loops by Newton's method.

   Python helps with a loop that is not solved, is not surely determined, or meets a value that is not finite. */

#ifndef _POSIX_C_SOURCE
#define _POSIX_C_SOURCE 200809L /* of the system: clock_gettime and poll */
#endif
#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifndef VISIBLE /* of functions that are found in the library; static where nothing outside of the unit calls them */
#ifdef _WIN32
#define VISIBLE __declspec(dllexport)
#else
#define VISIBLE __attribute__((visibility("default")))
#endif
#endif

#include "linear.c"

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
    int (*help)(void); /* Python solves the loops, from the values before; 0: it can't. NULL: there is no help */
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

/* Factorize J; false if it is singular. */
static bool factorize(newton *s) {
    const int64_t n = s->n;
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < n; j++) s->lu[i * n + j] = s->J[j * n + i];
    return lw_factor(s->lu, s->rows, n, 1);
}

/* Solve with the factors: made = J^-1 given. */
static void substitute(const newton *s, const double *given, double *made) {
    memcpy(made, given, (size_t)s->n * sizeof(double));
    lw_solve(s->lu, s->rows, s->n, made);
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
    return !call(&s->equations) && lw_are_finite(s->r, s->n) && lw_are_finite(s->J, s->n * s->n);
}

/* Solve the loops from the values in x on, as `LoopSolver` does; false where that fails. */
static bool seek_loops(newton *s, double *x) {
    int64_t n = s->n;
    for (int64_t i = 0; i < n; i++) s->before[i] = s->v[i] = x[s->where[i]];
    if (!evaluate_loops(s)) return false;
    double size = length(s->r, n);
    for (int64_t k = 0; k < s->iterations; k++) {
        if (!(largest(s->r, n) / (1 + largest(s->v, n)) > s->rounding)) break;
        if (!factorize(s)) return false;
        substitute(s, s->r, s->direction);
        if (!lw_are_finite(s->direction, n)) return false;
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

static bool solve_loops(newton *s, double *x) { return seek_loops(s, x) || (s->help && s->help()); }

/* For Python, which helps. */
VISIBLE void loopwright_evaluate_loops(newton *s) { call(&s->equations); }

static void undo_loops(const newton *s, double *x) {
    for (int64_t i = 0; i < s->n; i++) x[s->where[i]] = s->before[i];
}
