/* A tick of many blocks over vectors: runs of equal blocks, each one loop over a table that says where their values are.

   v holds the time, then the log (outputs of plants, outputs of blocks, states before the tick), then whatever else a
   tick needs, as in fmus/runtime/grouped.c. Above this text are the kernels and their table. */

#include <float.h>

typedef struct {
    const int32_t *runs, *rows;                     /* of each run: its kernel, how many blocks, where its rows begin */
    const int32_t *inputs, *guards, *made, *taken;  /* where these are in v */
    int32_t count, log, next, n_guards, n_loops, residual;
} lane_group;

static void go_over_groups(const lane_group *g, const vec *t, const vec *x, const vec *w, const vec *p, vec *v,
                           vec *x_next, vec *z, vec *log, vec *ok) {
    vec size = splat(0.0);
    v[0] = t[0];
    memcpy(v + 1, w, sizeof(vec) * N_W);
    memcpy(v + 1 + g->log - N_X, x, sizeof(vec) * N_X);
    for (int32_t i = 0; i < g->count; i++) {
        const int32_t *run = g->runs + 3 * i;
        lane_kernels[run[0]](run[1], g->rows + run[2], v, p);
    }
    for (int32_t i = 0; i < N_Z; i++) {
        z[i] = v[g->inputs[i]];
        size += vec_fabs(z[i]);
    }
    for (int32_t i = 0; i < g->log; i++) {
        log[i] = v[1 + i];
        size += vec_fabs(log[i]);
    }
    for (int32_t i = 0; i < N_X; i++) {
        x_next[i] = v[g->next + i];
        size += vec_fabs(x_next[i]);
    }
    if (g->residual) {
        vec apart = splat(0.0), largest = splat(0.0);
        for (int32_t i = 0; i < g->n_loops; i++) {
            const vec mismatch = vec_fabs(v[g->made[i]] - v[g->taken[i]]);
            size += mismatch; /* a maximum hides NaN */
            apart = vec_fmax(apart, mismatch);
            largest = vec_fmax(largest, vec_fabs(v[g->taken[i]]));
        }
        log[g->log] = apart / (1.0 + largest);
        size += log[g->log];
    }
    mask good = size <= DBL_MAX;
    for (int32_t i = 0; i < g->n_guards; i++) good &= v[g->guards[i]] > 0.0;
    ok[0] = one_where(good);
}
