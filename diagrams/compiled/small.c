/* Steps of explicit methods for the equation of one small diagram, whose rates are inlined into every stage: numbers stay in
   registers that `methods.c` has in memory. It does what `methods.c` does, in the same order, and stands behind `newton.c`,
   `problem.c` and the text of the diagram: N integrated ones of WIDTH states, their places PLACES, and the function
   RATES(arguments, results); INLINE makes a function one that is always inlined. */

/* What the rates see at one step besides the integrated states. */
typedef struct {
    double stop, edge, left, at, late, x[WIDTH];
    const double *w, *p;
} surroundings;

INLINE surroundings look_around(const problem *p) {
    surroundings s = {.stop = p->stop, .edge = p->edge, .left = p->left, .at = p->at, .late = p->late};
    for (int i = 0; i < WIDTH; i++) s.x[i] = p->x[i];
    s.w = p->flow.arguments[2];
    s.p = p->flow.arguments[3];
    return s;
}

INLINE void small_rate(const surroundings *s, double t, const double *x, double *f) {
    static const int places[N] = {PLACES};
    double now = t < s->stop ? t : s->stop, all[WIDTH];
    now = now >= s->edge ? s->left : now == s->at ? s->late : now;
    for (int i = 0; i < WIDTH; i++) all[i] = s->x[i];
    for (int i = 0; i < N; i++) all[places[i]] = x[i];
    const double *arguments[4] = {&now, all, s->w, s->p};
    double *results[1] = {f};
    RATES(arguments, results);
}

VISIBLE int step_rk4(method *m) {
    problem *p = m->of;
    const surroundings s = look_around(p);
    double x[N], y[N], k1[N], k2[N], k3[N], k4[N];
    m->done++;
    const double t = m->t, to = m->done >= m->count ? p->stop : m->start + m->done * ((p->stop - m->start) / m->count);
    const double h = to - t, middle = t + 0.5 * h;
    for (int i = 0; i < N; i++) x[i] = m->x[i];
    small_rate(&s, t, x, k1);
    for (int i = 0; i < N; i++) y[i] = x[i] + (0.5 * h) * k1[i];
    small_rate(&s, middle, y, k2);
    for (int i = 0; i < N; i++) y[i] = x[i] + (0.5 * h) * k2[i];
    small_rate(&s, middle, y, k3);
    for (int i = 0; i < N; i++) y[i] = x[i] + h * k3[i];
    small_rate(&s, to, y, k4);
    for (int i = 0; i < N; i++) y[i] = x[i] + (h / 6) * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i]);
    for (int i = 0; i < N; i++) {
        m->x_old[i] = x[i];
        m->K[i] = k1[i];
        m->x[i] = y[i];
    }
    p->rates += 4;
    m->t_old = t;
    m->t = to;
    return all_finite(y, N) ? PASSED : FAILED;
}

/* One step that an embedded method with some stages accepts. Coefficients are constants, and so are all loops' ends. */
INLINE int step_embedded(method *m, int stages, const double *A, const double *B, const double *C, const double *E,
                         double order) {
    problem *p = m->of;
    const surroundings s = look_around(p);
    const double least = 10.0 * ulp(m->t), before = m->h, t = m->t, stop = p->stop, rtol = m->rtol;
    double h = m->h > m->longest ? m->longest : m->h < least ? least : m->h, factor, to, error;
    double x[N], y[N], atol[N], K[7][N];
    bool again = false;
    for (int i = 0; i < N; i++) {
        x[i] = m->x[i];
        K[0][i] = m->f[i];
        atol[i] = m->atol[i];
    }
    for (;;) {
        if (!(h >= least)) return FAILED;
        to = t + h;
        if (to > stop) to = stop;
        h = to - t;
        for (int k = 1; k <= stages; k++) {
            for (int i = 0; i < N; i++) {
                double sum = 0.0;
                for (int j = 0; j < k; j++)
                    if (k < stages ? A[k * stages + j] != 0.0 : B[j] != 0.0)
                        sum += (k < stages ? A[k * stages + j] : B[j]) * K[j][i];
                y[i] = x[i] + h * sum;
            }
            small_rate(&s, k < stages ? t + C[k] * h : to, y, K[k]);
        }
        p->rates += stages;
        double sum = 0.0;
        for (int i = 0; i < N; i++) {
            double e = 0.0;
            for (int j = 0; j <= stages; j++)
                if (E[j] != 0.0) e += K[j][i] * E[j];
            e /= atol[i] + larger(fabs(x[i]), fabs(y[i])) * rtol;
            sum += e * e;
        }
        error = fabs(h) * sqrt(sum / (double)N);
        if (error < 1.0) {
            if (all_finite(y, N) && all_finite(K[stages], N)) {
                factor = growth(error, order);
                if (again) factor = smaller(1.0, factor);
                break;
            }
            h *= 0.25;
        } else {
            factor = 0.9 * pow(error, -1.0 / (order + 1.0));
            h *= factor > 0.2 ? factor : 0.2; /* of a NaN too */
        }
        m->rejected++;
        again = true;
    }
    for (int j = 0; j <= stages; j++)
        for (int i = 0; i < N; i++) m->K[j * N + i] = K[j][i];
    for (int i = 0; i < N; i++) {
        m->x_old[i] = x[i];
        m->x[i] = y[i];
        m->f[i] = K[stages][i];
    }
    m->t_old = t;
    m->t = to;
    m->h = h * factor;
    m->planned = to == stop ? larger(before, m->h) : m->h; /* a step that was cut says little about the next */
    return PASSED;
}
