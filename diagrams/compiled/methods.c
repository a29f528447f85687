/* Methods that integrate x' = f(t, x) up to the next discontinuity: explicit Runge-Kutta methods of fixed and of variable
   step. Norms, step control and dense output are those of SciPy's methods, whose coefficients come from Python; what
   differs is that a restart costs one evaluation of the rates. */

/* Put the trial to an instant; false if its algebraic loops are not solved there. */
static inline bool look(problem *p, double t, const double *x) {
    *p->t = t >= p->edge ? p->left : t == p->at ? p->late : t;
    for (int64_t i = 0; i < p->n; i++) p->x[p->where[i]] = x[i];
    if (!p->loops) return true;
    for (int64_t i = 0; i < p->loops->n; i++) p->x[p->loops->where[i]] = p->here[p->loops->where[i]];
    return solve_loops(p->loops, p->x);
}

static inline void rate(problem *p, double t, const double *x, double *f) {
    if (!p->n) return;
    p->rates++;
    if (!look(p, t < p->stop ? t : p->stop, x)) { /* a step that is shorter may have a solution */
        for (int64_t i = 0; i < p->n; i++) f[i] = NAN;
        return;
    }
    p->flow.results[0] = f;
    if (call(&p->flow))
        for (int64_t i = 0; i < p->n; i++) f[i] = NAN;
}

static double norm_of(const double *e, const double *scale, int64_t n) {
    double sum = 0.0;
    for (int64_t i = 0; i < n; i++) sum += (e[i] / scale[i]) * (e[i] / scale[i]);
    return sqrt(sum / (double)n);
}

/* Write where a method of fixed step comes to from (t, x) with the rates f, at the time `to`. */
static inline void apply(method *m, double t, const double *x, const double *f, double to, double *out) {
    problem *p = m->of;
    const int64_t n = m->n;
    const double h = to - t;
    double *k2 = m->K + n, *k3 = k2 + n, *k4 = k3 + n;
    if (m->kind == EULER) {
        for (int64_t i = 0; i < n; i++) out[i] = x[i] + h * f[i];
    } else if (m->kind != RK4) {
        for (int64_t i = 0; i < n; i++) m->y[i] = x[i] + h * f[i];
        rate(p, to, m->y, k2);
        for (int64_t i = 0; i < n; i++) out[i] = x[i] + (0.5 * h) * (f[i] + k2[i]);
    } else {
        const double middle = t + 0.5 * h;
        for (int64_t i = 0; i < n; i++) m->y[i] = x[i] + (0.5 * h) * f[i];
        rate(p, middle, m->y, k2);
        for (int64_t i = 0; i < n; i++) m->y[i] = x[i] + (0.5 * h) * k2[i];
        rate(p, middle, m->y, k3);
        for (int64_t i = 0; i < n; i++) m->y[i] = x[i] + h * k3[i];
        rate(p, to, m->y, k4);
        for (int64_t i = 0; i < n; i++) out[i] = x[i] + (h / 6) * (f[i] + 2 * (k2[i] + k3[i]) + k4[i]);
    }
}

/* Return a first step by the size of the rates, and of their change; Hairer, Nørsett, Wanner I, II.4. */
static double first_step(method *m, double order) {
    problem *p = m->of;
    const int64_t n = m->n;
    const double length = p->stop - m->t;
    double *scale = m->y, *y = m->g, *f = m->K;
    for (int64_t i = 0; i < n; i++) scale[i] = m->atol[i] + fabs(m->x[i]) * m->rtol;
    const double d0 = norm_of(m->x, scale, n), d1 = norm_of(m->f, scale, n);
    double h0 = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    if (!(h0 < length)) h0 = length;
    for (int64_t i = 0; i < n; i++) y[i] = m->x[i] + h0 * m->f[i];
    rate(p, m->t + h0, y, f);
    for (int64_t i = 0; i < n; i++) f[i] -= m->f[i];
    const double d2 = norm_of(f, scale, n) / h0, most = larger(d1, d2);
    const double h1 = d1 <= 1e-15 && d2 <= 1e-15 ? fmax(1e-6, h0 * 1e-3) : pow(0.01 / most, 1.0 / (order + 1.0));
    const double h = fmin(fmin(100.0 * h0, h1), fmin(length, m->longest));
    return isfinite(h) && isfinite(most) ? h : 1e-6 * length;
}

/* Start at (t, m->x), up to p->stop. */
static inline void restart(method *m, double t) {
    problem *p = m->of;
    m->t = m->t_old = m->start = m->mark = t;
    m->prepared = 0;
    m->done = m->segment = 0;
    m->predicts = 0;
    if (m->kind <= RK4) {
        m->count = (int64_t)ceil((p->stop - t) / m->longest * (1 - 1e-9));
        if (m->count < 1) m->count = 1;
        return;
    }
    m->sliver = p->stop - t <= 100 * ulp(larger(fabs(t), fabs(p->stop)));
    rate(p, t, m->x, m->f);
    if (m->sliver) return;
    if (isnan(m->planned))
        m->h = first_step(m, m->exponent);
    else
        m->h = smaller(m->planned, p->stop - t);
}

static inline int step_fixed(method *m) {
    problem *p = m->of;
    const int64_t n = m->n;
    m->done++;
    const double to = m->done >= m->count ? p->stop : m->start + m->done * ((p->stop - m->start) / m->count);
    memcpy(m->x_old, m->x, n * sizeof(double));
    rate(p, m->t, m->x_old, m->K);
    apply(m, m->t, m->x_old, m->K, to, m->x);
    m->t_old = m->t;
    m->t = to;
    return all_finite(m->x, n) ? PASSED : FAILED;
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
    return all_finite(m->x, n) ? PASSED : FAILED;
}

static inline void stage(method *m, const double *a, int64_t s, double h, const double *x, double *y) {
    const int64_t n = m->n;
    for (int64_t i = 0; i < n; i++) {
        double sum = 0.0;
        for (int64_t j = 0; j < s; j++) sum += a[j] * m->K[j * n + i];
        y[i] = x[i] + h * sum;
    }
}

/* Return the norm of the error of a step to m->g; the scale is that of both ends. */
static inline double error_of(const method *m, double h) {
    const int64_t n = m->n, rows = m->stages + 1;
    double sum = 0.0, sum3 = 0.0;
    for (int64_t i = 0; i < n; i++) {
        const double scale = m->atol[i] + larger(fabs(m->x[i]), fabs(m->g[i])) * m->rtol;
        double e = 0.0, e3 = 0.0;
        for (int64_t j = 0; j < rows; j++) e += m->K[j * n + i] * m->E[j];
        if (m->kind == EIGHT)
            for (int64_t j = 0; j < rows; j++) e3 += m->K[j * n + i] * m->E3[j];
        e /= scale;
        e3 /= scale;
        sum += e * e;
        sum3 += e3 * e3;
    }
    if (m->kind == EXPLICIT) return fabs(h) * sqrt(sum / (double)n);
    return sum == 0.0 && sum3 == 0.0 ? 0.0 : fabs(h) * sum / sqrt((sum + 0.01 * sum3) * (double)n);
}

static inline int step_explicit(method *m) {
    problem *p = m->of;
    const int64_t n = m->n, last = m->stages;
    const double least = 10.0 * ulp(m->t), before = m->h;
    double h = m->h > m->longest ? m->longest : m->h < least ? least : m->h, factor, to;
    bool again = false;
    memcpy(m->K, m->f, n * sizeof(double));
    for (;;) {
        if (!(h >= least)) return FAILED;
        to = m->t + h;
        if (to > p->stop) to = p->stop;
        h = to - m->t;
        for (int64_t s = 1; s < last; s++) {
            stage(m, m->A + s * last, s, h, m->x, m->y);
            rate(p, m->t + m->C[s] * h, m->y, m->K + s * n);
        }
        stage(m, m->B, last, h, m->x, m->g);
        rate(p, to, m->g, m->K + last * n);
        const double error = error_of(m, h);
        if (error < 1.0) {
            if (all_finite(m->g, n) && all_finite(m->K + last * n, n)) {
                factor = growth(error, m->exponent);
                if (again) factor = smaller(1.0, factor);
                break;
            }
            h *= 0.25;
        } else {
            factor = 0.9 * pow(error, -1.0 / (m->exponent + 1.0));
            h *= factor > 0.2 ? factor : 0.2; /* of a NaN too */
        }
        m->rejected++;
        again = true;
    }
    double *swap = m->x_old;
    m->x_old = m->x;
    m->x = m->g;
    m->g = swap;
    memcpy(m->f, m->K + last * n, n * sizeof(double));
    m->t_old = m->t;
    m->t = to;
    m->h = h * factor;
    m->planned = to == p->stop ? larger(before, m->h) : m->h; /* a step that was cut says little about the next */
    return PASSED;
}

static int step_radau(method *m);

/* Take one step that the error control accepts, at most to p->stop. */
static inline int take_step(method *m) {
    int result;
    m->prepared = 0;
    if (m->step && !m->sliver)
        result = m->step(m);
    else if (m->kind <= RK4)
        result = step_fixed(m);
    else if (m->sliver)
        result = step_sliver(m);
    else
        result = m->kind == RADAU ? step_radau(m) : step_explicit(m);
    if (result != PASSED) return result;
    m->steps++;
    if (m->kind > RK4 && ++m->segment % 2000 == 0) { /* so small steps that the run would never end */
        const double h = (m->t - m->mark) / 2000.0;
        m->mark = m->t;
        if (m->of->stop - m->t > 1e7 * h) return FAILED;
    }
    return PASSED;
}

/* Make the dense output of the last step. */
static void prepare(method *m) {
    problem *p = m->of;
    const int64_t n = m->n;
    const double h = m->t - m->t_old;
    m->prepared = 1;
    if (m->kind <= RK4 || m->sliver || m->kind == RADAU) return;
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
        stage(m, m->A_extra + j * rows, s, h, m->x_old, m->y);
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
    if (m->kind <= RK4) {
        apply(m, m->t_old, m->x_old, m->K, t, out);
    } else if (m->sliver) {
        for (int64_t i = 0; i < n; i++) out[i] = m->x_old[i] + (t - m->t_old) * m->K[i];
    } else {
        const double u = (t - m->t_old) / (m->t - m->t_old);
        for (int64_t i = 0; i < n; i++) {
            double change = 0.0;
            if (m->kind == EIGHT)
                for (int64_t k = 6; k >= 0; k--) change = (change + m->D[k * n + i]) * (k % 2 ? 1.0 - u : u);
            else
                for (int64_t k = m->order - 1; k >= 0; k--) change = (change + m->D[k * n + i]) * u;
            out[i] = m->x_old[i] + change;
        }
    }
}
