/* Methods that integrate x' = f(t, x) up to the next discontinuity: explicit Runge-Kutta methods of fixed and of variable
   step. Norms, step control and dense output are those of SciPy's methods, whose coefficients come from Python; what
   differs is that a restart costs one evaluation of the rates.

   A method of another library takes its steps itself, by a callback, with the rates from here. Its dense output is a
   polynomial from the start of the step, as that of an explicit method: x_old + sum of D[k] u^(k + 1) for k < order. */

/* Put the trial to an instant; false if its algebraic loops are not solved there. */
static inline bool look(problem *p, double t, const double *x) {
    const double seen = t > p->left ? p->left : t; /* a step may end a rounding error before the edge */
    *p->t = seen == p->at ? p->late : seen;
    for (int64_t i = 0; i < p->n; i++) p->x[p->where[i]] = x[i];
    if (p->delays) put_delayed(p->delays, *p->t, p->delays->trial);
    if (!p->loops) return true;
    for (int64_t i = 0; i < p->loops->n; i++) p->x[p->loops->where[i]] = p->here[p->loops->where[i]];
    return solve_loops(p->loops, p->x);
}

static inline void rate(problem *p, double t, const double *x, double *f) {
    if (!p->n) return;
    p->rates++;
    p->flow.results[0] = f;
    if (!look(p, t < p->stop ? t : p->stop, x) || call(&p->flow)) /* a step that is shorter may have a solution */
        for (int64_t i = 0; i < p->n; i++) f[i] = NAN;
    if (p->noting && !lw_are_finite(f, p->n)) {
        p->beyond_t = t;
        memcpy(p->beyond, x, (size_t)p->n * sizeof(double));
    }
}

#define LW_EQUATION problem
#define LW_NUMBER double
#define LW_RATE(e, t, x, f) (rate(e, t, x, f), 0)
#include "steps.c"

/* Write where a method of fixed step comes to from (t, x) with the rates f, at the time `to`. */
static inline void apply(method *m, double t, const double *x, const double *f, double to, double *out) {
    problem *p = m->of;
    const int64_t n = m->n;
    const int stages = m->kind == FIXED_STEP ? (int)m->stages : 2; /* others cross a few ulps by Heun's method */
    lw_fixed(p, n, stages, t, to - t, to, x, f, m->K + n, m->y, out);
}

/* Start at (t, m->x), up to p->stop. */
static inline void restart(method *m, double t) {
    problem *p = m->of;
    m->t = m->t_old = m->start = m->mark = t;
    m->prepared = 0;
    m->done = m->segment = 0;
    m->predicts = 0;
    if (m->kind == FIXED_STEP) {
        m->count = (int64_t)ceil((p->stop - t) / m->longest * (1 - 1e-9));
        if (m->count < 1) m->count = 1;
        return;
    }
    m->sliver = p->stop - t <= 100 * ulp(larger(fabs(t), fabs(p->stop)));
    m->begins = 1;
    if (m->kind == LIBRARY && !m->sliver) return;
    rate(p, t, m->x, m->f);
    if (m->sliver) return;
    if (isnan(m->planned))
        m->h = lw_first_step(p, m->n, m->exponent, &(lw_tolerance){m->atol, m->rtol}, t, p->stop - t, m->longest, m->x, m->f,
                             m->y, m->g, m->K);
    else
        m->h = smaller(m->planned, p->stop - t);
}

static inline int step_fixed(method *m) {
    problem *p = m->of;
    const int64_t n = m->n;
    const double to = end_of_step(m);
    memcpy(m->x_old, m->x, n * sizeof(double));
    rate(p, m->t, m->x_old, m->K);
    apply(m, m->t, m->x_old, m->K, to, m->x);
    m->t_old = m->t;
    m->t = to;
    return lw_are_finite(m->x, n) ? PASSED : FAILED;
}

/* Cross an interval of a few ulps by one step of Heun's method. */
static int step_sliver(method *m) {
    problem *p = m->of;
    const int64_t n = m->n;
    memcpy(m->x_old, m->x, n * sizeof(double));
    memcpy(m->K, m->f, n * sizeof(double));
    apply(m, m->t, m->x_old, m->f, p->stop, m->x);
    m->t_old = m->t;
    m->t = p->stop;
    return lw_are_finite(m->x, n) ? PASSED : FAILED;
}

static inline int step_explicit(method *m) {
    const int64_t n = m->n;
    const lw_tableau numbers = {m->stages, m->A, m->B, m->C, m->E, m->kind == EIGHT ? m->E3 : NULL, m->exponent};
    memcpy(m->K, m->f, n * sizeof(double));
    if (!step_embedded(m, m->of, n, &numbers, m->atol, m->x, m->K, m->y, m->g)) return FAILED;
    double *swap = m->x_old;
    m->x_old = m->x;
    m->x = m->g;
    m->g = swap;
    memcpy(m->f, m->K + m->stages * n, n * sizeof(double));
    return PASSED;
}

/* Let a library take a step. */
static int step_of_library(method *m) {
    const double t = m->t;
    memcpy(m->x_old, m->x, m->n * sizeof(double));
    const int result = m->library(m->begins ? BEGIN : STEP_ON);
    m->begins = 0;
    m->t_old = t;
    return result;
}

static int step_radau(method *m);

/* Take one step that the error control accepts, at most to p->stop. */
static inline int take_step(method *m) {
    int result;
    m->prepared = 0;
    if (m->step && !m->sliver)
        result = m->step(m);
    else if (m->kind == FIXED_STEP)
        result = step_fixed(m);
    else if (m->sliver)
        result = step_sliver(m);
    else if (m->kind == LIBRARY)
        result = step_of_library(m);
    else
        result = m->kind == RADAU ? step_radau(m) : step_explicit(m);
    if (result != PASSED) {
        if (m->of->lost != IN_SLOPE) m->of->lost = IN_STEP;
        return result;
    }
    m->steps++;
    if (m->kind != FIXED_STEP && ++m->segment % 2000 == 0) { /* so small steps that the run would never end */
        const double h = (m->t - m->mark) / 2000.0;
        m->mark = m->t;
        if (m->of->stop - m->t > 1e7 * h) return m->of->lost = IN_PROGRESS, m->of->beyond_t = h, FAILED;
    }
    return PASSED;
}

/* Take a step that has failed once more, as short as can be, and note the last trial at which a rate is not finite. */
static void note_beyond(method *m) {
    problem *p = m->of;
    int (*own)(struct method *) = m->step;
    p->beyond_t = NAN;
    if (m->kind == LIBRARY) return;
    if (m->kind == FIXED_STEP || m->sliver) { /* the step has been taken, to states that are not finite */
        memcpy(m->x, m->x_old, (size_t)m->n * sizeof(double));
        m->t = m->t_old;
        m->done--;
    } else {
        m->h = 10.0 * ulp(m->t);
    }
    m->step = NULL;
    p->noting = 1;
    take_step(m);
    p->noting = 0;
    m->step = own;
}

/* Make the dense output of the last step. */
static void prepare(method *m) {
    problem *p = m->of;
    const int64_t n = m->n;
    const double h = m->t - m->t_old;
    m->prepared = 1;
    if (m->kind == FIXED_STEP || m->sliver || m->kind == RADAU) return;
    if (m->kind == LIBRARY) {
        m->library(EXPAND);
        return;
    }
    if (m->kind == EXPLICIT) {
        for (int64_t k = 0; k < m->order; k++)
            for (int64_t i = 0; i < n; i++) {
                double sum = 0.0;
                for (int64_t s = 0; s <= m->stages; s++) sum += m->K[s * n + i] * m->P[s * m->order + k];
                m->D[k * n + i] = h * sum;
            }
        return;
    }
    const int64_t rows = m->stages + 1 + m->extra;
    for (int64_t s = m->stages + 1; s < rows; s++) {
        const int64_t j = s - m->stages - 1;
        lw_stage(n, m->A_extra + j * rows, s, h, m->x_old, m->K, m->y);
        rate(p, m->t_old + m->C_extra[j] * h, m->y, m->K + s * n);
    }
    for (int64_t i = 0; i < n; i++) {
        const double change = m->x[i] - m->x_old[i], f = m->K[i];
        m->D[i] = change;
        m->D[n + i] = h * f - change;
        m->D[2 * n + i] = 2 * change - h * (m->f[i] + f);
        for (int64_t k = 3; k < 7; k++) {
            double sum = 0.0;
            for (int64_t s = 0; s < rows; s++) sum += m->P[(k - 3) * rows + s] * m->K[s * n + i];
            m->D[k * n + i] = h * sum;
        }
    }
}

/* Write the states at a time of the last step. */
static inline void interpolate(method *m, double t, double *out) {
    const int64_t n = m->n;
    if (t == m->t) {
        memcpy(out, m->x, n * sizeof(double));
        return;
    }
    if (!m->prepared) prepare(m);
    if (m->kind == FIXED_STEP) {
        apply(m, m->t_old, m->x_old, m->K, t, out);
    } else if (m->sliver) {
        for (int64_t i = 0; i < n; i++) out[i] = m->x_old[i] + (t - m->t_old) * m->K[i];
    } else {
        const double u = (t - m->t_old) / (m->t - m->t_old);
        if (m->kind == EIGHT) {
            lw_interpolate(n, 7, m->D, u, m->x_old, out);
            return;
        }
        for (int64_t i = 0; i < n; i++) {
            double change = 0.0;
            for (int64_t k = m->order - 1; k >= 0; k--) change = (change + m->D[k * n + i]) * u;
            out[i] = m->x_old[i] + change;
        }
    }
}

/* --- for methods of other libraries ------------------------------------------------------------------------------- */

VISIBLE void loopwright_rates(problem *p, double t, const double *x, double *f) { rate(p, t, x, f); }
