/* Functions of many blocks: runs of equal blocks, each one loop over a table that says where their values are.

   A tick's v holds the time, then the log (outputs of plants, outputs of blocks, states before the tick), then whatever
   else a tick needs. A kind of block is a kernel: generated code, or a program of the virtual machine. It is included
   after `machine.c`. */

typedef void (*kernel)(int32_t n, const int32_t *rows, double *v, const double *p);

/* The calls of blocks in a function of the diagram. */
typedef struct {
    const int32_t *runs;           /* of each: its kernel, how many blocks, where their rows begin */
    const int32_t *rows;
    int64_t count;                 /* of runs */
    const kernel *generated;       /* the kernels as generated code; NULL: as programs */
    const block_program *programs;
    int (*python)(int64_t first, int64_t count); /* lets Python evaluate some blocks; not 0: it has failed */
} block_calls;

static int call_blocks(const block_calls *of, double *v, const double *p) {
    for (int64_t i = 0; i < of->count; i++) {
        const int32_t *run = of->runs + 3 * i, *rows = of->rows + run[2];
        if (run[0] < 0) {
            if (of->python(rows[0], run[1])) return 1;
        } else if (of->generated) {
            of->generated[run[0]](run[1], rows, v, p);
        } else {
            run_blocks(of->programs + run[0], run[1], rows, v, p);
        }
    }
    return 0;
}

typedef struct {
    block_calls calls;
    int64_t states, outside, log;   /* entries of x, of w, and of the log without the residual */
    int64_t next;                   /* where the next states are in v */
    const int32_t *inputs, *guards, *made, *taken; /* where these are in v */
    int64_t n_inputs, n_guards, n_loops;
    int64_t residual;               /* 1 where the log ends with the residual of algebraic loops */
    const int32_t *unread;          /* entries of the log that may be no finite numbers, ascending */
    int64_t n_unread;
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

static double size_but(const double *values, int64_t n, const int32_t *left_out, int64_t count) {
    double size = 0;
    int64_t from = 0;
    for (int64_t k = 0; k < count; k++) {
        size += size_of(values + from, left_out[k] - from);
        from = left_out[k] + 1;
    }
    return size + size_of(values + from, n - from);
}

VISIBLE int loopwright_grouped_tick(const double **arguments, double **results, long long *iw, double *v, int memory) {
    const group *g = (const group *)iw;
    const double *p = arguments[3];
    double *x_next = results[0], *z = results[1], *log = results[2], *ok = results[3], size = 0;
    (void)memory;
    v[0] = arguments[0][0];
    if (g->outside) memcpy(v + 1, arguments[2], (size_t)g->outside * sizeof(double));
    if (g->states) memcpy(v + 1 + g->log - g->states, arguments[1], (size_t)g->states * sizeof(double));
    if (call_blocks(&g->calls, v, p)) return 1;
    for (int64_t i = 0; i < g->n_inputs; i++) size += fabs(z[i] = v[g->inputs[i]]);
    size += size_but(v + 1, g->log, g->unread, g->n_unread) + size_of(v + g->next, g->states);
    if (g->log) memcpy(log, v + 1, (size_t)g->log * sizeof(double));
    if (g->states) memcpy(x_next, v + g->next, (size_t)g->states * sizeof(double));
    if (g->residual) {
        double apart = 0, largest = 0;
        for (int64_t i = 0; i < g->n_loops; i++) {
            const double mismatch = fabs(v[g->made[i]] - v[g->taken[i]]);
            size += mismatch; /* `fmax` hides NaN */
            apart = fmax(apart, mismatch);
            largest = fmax(largest, fabs(v[g->taken[i]]));
        }
        size += log[g->log] = apart / (1 + largest);
    }
    ok[0] = size <= DBL_MAX;
    for (int64_t i = 0; i < g->n_guards; i++)
        if (!(v[g->guards[i]] > 0)) ok[0] = 0;
    return 0;
}

/* A function between ticks of many blocks: rates, indicators, states after events.

   v holds the time, w, x, further arguments (those behind p), then whatever else it needs. */
typedef struct {
    block_calls calls;
    int64_t states, outside, more;  /* entries of x, of w, of further arguments */
    const int32_t *where;           /* where the results are in v, one after the other */
    int64_t lengths[2];             /* entries of each result */
} part;

VISIBLE int loopwright_grouped_part(const double **arguments, double **results, long long *iw, double *v, int memory) {
    const part *g = (const part *)iw;
    const double *p = arguments[3];
    const int32_t *where = g->where;
    (void)memory;
    v[0] = arguments[0][0];
    if (g->outside) memcpy(v + 1, arguments[2], (size_t)g->outside * sizeof(double));
    if (g->states) memcpy(v + 1 + g->outside, arguments[1], (size_t)g->states * sizeof(double));
    if (g->more) memcpy(v + 1 + g->outside + g->states, arguments[4], (size_t)g->more * sizeof(double));
    if (call_blocks(&g->calls, v, p)) return 1;
    for (int r = 0; r < 2; r++)
        for (int64_t i = 0; i < g->lengths[r]; i++) results[r][i] = v[*where++];
    return 0;
}
