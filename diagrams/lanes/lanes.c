/* The loop over ticks with a vector of runs: FMUs step, the tick is evaluated, its states are taken over, a row is kept.

   It comes after vectors.h and the functions of a diagram, which are written over vectors. A run that fails is out: it
   is reported with the tick that it could not pass, and its lane continues with the numbers of another one. */


#include <float.h>

typedef struct {
    int64_t every, skip;           /* one of so many rows is kept; rows to leave out before the next one */
    int64_t columns, stops;        /* entries of the log that are kept, and those that end a run */
    const int64_t *column, *stop;
    const double *p;               /* vectors: parameters of the diagram */
    double *x, *w, *z;             /* its states, outputs and inputs of its FMUs */
    double *plant;                 /* of the FMUs: parameters, inputs and states, one after the other */
    const double *steps;           /* of the integrator of each FMU, in s, at most */
    double *last;                  /* the row with which a run has ended */
    int64_t alive[LANES];          /* -1: it continues; 0: it has ended */
    int64_t failed[LANES];         /* the tick that it could not go beyond, counted from 1; 0: none */
    int64_t stopped[LANES];        /* the tick at which it was stopped, counted from 1; 0: none */
    int64_t by[LANES];             /* the stop that ended it, by its place */
    int64_t ticks, rows;           /* that were gone through, and kept, so far */
    double *room;                  /* vectors: memory of large diagrams */
} lanes;

/* Substeps of at most `step` in h, as in fmus/export/fmu_sources/integrators.c. */
static inline int64_t substeps(double h, double step) {
    double count = ceil(h / step - 1e-9);
    return count < 1.0 ? 1 : (int64_t)count;
}

/* Keep the rows of runs that end now. */
static void keep_last(const lanes *l, mask which, const vec *log) {
    vec *last = (vec *)l->last;
    for (int64_t j = 0; j < l->columns; j++) last[j] = choose(which, log[l->column[j]], last[j]);
}

VISIBLE void loopwright_lanes(lanes *l, int64_t count, const double *times, const double *widths, const int32_t *kinds,
                              double *rows) {
    TAKE_ROOM
    vec ok[1], t[1];
    mask alive, unsolved = {0};
    memcpy(&alive, l->alive, sizeof alive);
    memcpy(x, l->x, sizeof(vec) * N_X);
    memcpy(w, l->w, sizeof(vec) * N_W);
    memcpy(z, l->z, sizeof(vec) * N_Z);
    memcpy(p, l->p, sizeof(vec) * N_P);
    PREPARE
    for (int64_t i = 0; i < count; i++) {
        STEP_STATES(times[i], times[i + 1])
        STEP_PLANTS(times[i], widths[i])
        t[0] = splat(times[i + 1]);
        EVALUATE(kinds[i])
        l->ticks++;
        vec size = splat(0.0); /* an FMU that was built here is not done with a step if one of its outputs is no number */
        for (int64_t j = 0; j < N_W; j++) size += vec_fabs(w[j]);
        mask bad = alive & (~(ok[0] != 0.0) | ~(size <= DBL_MAX) | unsolved);
        if (__builtin_expect(any(bad), 0)) {
            alive &= ~bad;
            int from = -1;
            EACH_LANE {
                if (bad[lane]) l->failed[lane] = l->ticks;
                if (alive[lane] && from < 0) from = lane;
            }
            if (from < 0) break;
            /* numbers that are no numbers would only cost time */
            for (int64_t j = 0; j < N_X; j++) x_next[j] = choose(bad, splat(x_next[j][from]), x_next[j]);
            for (int64_t j = 0; j < N_Z; j++) z[j] = choose(bad, splat(z[j][from]), z[j]);
            PLANTS_RESUME(bad, from)
        }
        memcpy(x, x_next, sizeof(vec) * N_X);
        if (l->skip) {
            l->skip--;
        } else {
            l->skip = l->every - 1;
            vec *row = (vec *)rows + l->rows++ * l->columns;
            for (int64_t j = 0; j < l->columns; j++) row[j] = log[l->column[j]];
        }
        if (l->stops) {
            const mask before = alive;
            for (int64_t j = 0; j < l->stops; j++) {
                mask ended = alive & (log[l->stop[j]] > TRUTH);
                EACH_LANE if (ended[lane]) {
                    l->stopped[lane] = l->ticks;
                    l->by[lane] = j;
                }
                alive &= ~ended;
            }
            if (any(before & ~alive)) {
                keep_last(l, before & ~alive, log);
                if (!any(alive)) break;
            }
        }
        if (i == count - 1) keep_last(l, alive, log);
    }
    memcpy(l->alive, &alive, sizeof alive);
    memcpy(l->x, x, sizeof(vec) * N_X);
    memcpy(l->w, w, sizeof(vec) * N_W);
    memcpy(l->z, z, sizeof(vec) * N_Z);
    KEEP_PLANTS
}
