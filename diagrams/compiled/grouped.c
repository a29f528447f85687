/* A tick of many blocks: runs of equal blocks, each one loop over a table that says where their values stand.

   v holds the time, then the log (outputs of plants, outputs of blocks, states before the tick), then whatever else a
   tick needs. Above this text stand the kernels, one for each kind of block, and their table. */

typedef struct {
    const int32_t *runs; /* of each: its kernel, how many blocks, where their rows begin */
    const int32_t *rows;
    int64_t count;                  /* of runs */
    int64_t states, outside, log;   /* entries of x, of w, and of the log without the residual */
    int64_t next;                   /* where the next states stand in v */
    const int32_t *inputs, *guards, *made, *taken; /* where these stand in v */
    int64_t n_inputs, n_guards, n_loops;
    int64_t residual;               /* 1 where the log ends with the residual of algebraic loops */
    int (*python)(int64_t call);    /* lets Python evaluate a block; not 0: it has failed */
} group;

static double size_of(const double *values, int64_t n) {
    double a = 0, b = 0, c = 0, d = 0;
    int64_t i = 0;
    for (; i + 3 < n; i += 4) {
        a += fabs(values[i]);
        b += fabs(values[i + 1]);
        c += fabs(values[i + 2]);
        d += fabs(values[i + 3]);
    }
    for (; i < n; i++) a += fabs(values[i]);
    return (a + b) + (c + d);
}

VISIBLE int grouped(const double **arguments, double **results, long long *iw, double *v, int memory) {
    const group *g = (const group *)iw;
    const double *p = arguments[3];
    double *x_next = results[0], *z = results[1], *log = results[2], *ok = results[3], size = 0;
    (void)memory;
    v[0] = arguments[0][0];
    if (g->outside) memcpy(v + 1, arguments[2], (size_t)g->outside * sizeof(double));
    if (g->states) memcpy(v + 1 + g->log - g->states, arguments[1], (size_t)g->states * sizeof(double));
    for (int64_t i = 0; i < g->count; i++) {
        const int32_t *run = g->runs + 3 * i, *row = g->rows + run[2];
        if (run[0] < 0) {
            for (int32_t k = 0; k < run[1]; k++)
                if (g->python(row[k])) return 1;
        } else {
            kernels[run[0]](run[1], row, v, p);
        }
    }
    for (int64_t i = 0; i < g->n_inputs; i++) size += fabs(z[i] = v[g->inputs[i]]);
    size += size_of(v + 1, g->log) + size_of(v + g->next, g->states);
    if (g->log) memcpy(log, v + 1, (size_t)g->log * sizeof(double));
    if (g->states) memcpy(x_next, v + g->next, (size_t)g->states * sizeof(double));
    if (g->residual) {
        double apart = 0, largest = 0;
        for (int64_t i = 0; i < g->n_loops; i++) {
            apart = fmax(apart, fabs(v[g->made[i]] - v[g->taken[i]]));
            largest = fmax(largest, fabs(v[g->taken[i]]));
        }
        size += log[g->log] = apart / (1 + largest);
    }
    ok[0] = size <= DBL_MAX;
    for (int64_t i = 0; i < g->n_guards; i++)
        if (!(v[g->guards[i]] > 0)) ok[0] = 0;
    return 0;
}
