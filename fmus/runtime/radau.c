/* Radau IIA of order 5 with three stages, for stiff problems: E. Hairer, G. Wanner, Solving Ordinary Differential
   Equations II, IV.8. Transformations, Newton's method, norms and step control are those of SciPy's Radau, whose numbers
   come from Python; what differs is that the Jacobian and its factors are kept where a tick interrupts the steps. */

enum { NEWTON = 6 };

/* Numbers of the method, in the order in which Python writes them. */
typedef struct {
    double C[3], E[3], T[3][3], TI[3][3], P[3][3], mu, mu_re, mu_im;
} radau;

static void solve_complex(const double *lu, const int64_t *pivots, int64_t n, double *re, double *im) {
    for (int64_t k = 0; k < n; k++) {
        const double a = re[k], b = im[k];
        re[k] = re[pivots[k]], im[k] = im[pivots[k]];
        re[pivots[k]] = a, im[pivots[k]] = b;
    }
    for (int64_t i = 0; i < n; i++)
        for (int64_t j = 0; j < i; j++) {
            const double *v = lu + 2 * (i * n + j);
            const double a = v[0] * re[j] - v[1] * im[j], b = v[0] * im[j] + v[1] * re[j];
            re[i] -= a, im[i] -= b;
        }
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t j = i + 1; j < n; j++) {
            const double *v = lu + 2 * (i * n + j);
            const double a = v[0] * re[j] - v[1] * im[j], b = v[0] * im[j] + v[1] * re[j];
            re[i] -= a, im[i] -= b;
        }
        const double *d = lu + 2 * (i * n + i), size = d[0] * d[0] + d[1] * d[1];
        const double a = (re[i] * d[0] + im[i] * d[1]) / size, b = (im[i] * d[0] - re[i] * d[1]) / size;
        re[i] = a, im[i] = b;
    }
}

/* Add to ∂f/∂x what comes through the algebraic loops: −∂f/∂v (∂r/∂v)⁻¹ ∂r/∂x. */
static bool lead_through_loops(problem *p) {
    newton *s = p->loops;
    const double *by_values = p->by_loops, *mismatch = by_values + p->n * s->n;
    if (!factorize(s)) return false;
    for (int64_t j = 0; j < p->n; j++) {
        substitute(s, mismatch + j * s->n, s->column);
        for (int64_t k = 0; k < s->n; k++)
            for (int64_t i = 0; i < p->n; i++) p->slopes[j * p->n + i] -= by_values[k * p->n + i] * s->column[k];
    }
    return true;
}

/* Write the derivative of the rates by rows; false, and nothing is written, where it is not finite. */
static bool write_slope(problem *p, double t, const double *x, double *J) {
    const int64_t n = p->n;
    p->jacobians++;
    if (!look(p, t < p->stop ? t : p->stop, x)) return false;
    if (call(&p->slope)) return false;
    if (p->loops && p->by_loops && !lead_through_loops(p)) return false;
    if (!lw_are_finite(p->slopes, p->row ? p->entries : n * n)) return false;
    if (p->row) {
        memset(J, 0, n * n * sizeof(double));
        for (int64_t k = 0; k < p->entries; k++) J[p->row[k] * n + p->column[k]] = p->slopes[k];
    } else {
        for (int64_t i = 0; i < n; i++)
            for (int64_t j = 0; j < n; j++) J[i * n + j] = p->slopes[j * n + i];
    }
    return true;
}

/* Evaluate the derivative of the rates; the last finite one is kept where it is not finite. */
static bool differentiate(method *m, double t, const double *x) {
    m->slope_is_new = 1;
    if (!write_slope(m->of, t, x, m->J)) return m->has_slope;
    m->has_slope = 1;
    m->has_lu = 0;
    return true;
}

static bool make_factors(method *m, const radau *r, double h) {
    const int64_t n = m->n;
    for (int64_t i = 0; i < n * n; i++) {
        m->lu[i] = m->lu_complex[2 * i] = -m->J[i];
        m->lu_complex[2 * i + 1] = 0.0;
    }
    for (int64_t i = 0; i < n; i++) {
        m->lu[i * n + i] += r->mu / h;
        m->lu_complex[2 * (i * n + i)] += r->mu_re / h;
        m->lu_complex[2 * (i * n + i) + 1] += r->mu_im / h;
    }
    m->h_of_lu = h;
    m->has_lu = lw_factor(m->lu, m->pivots, n, 1) && lw_factor(m->lu_complex, m->pivots_complex, n, 2);
    return m->has_lu;
}

/* Solve the equations of the stages by simplified Newton iterations from m->Z on; return whether they converge. */
static bool solve_stages(method *m, const radau *r, double h, int *iterations, double *speed) {
    problem *p = m->of;
    const int64_t n = m->n;
    double *Z = m->Z, *W = m->W, *F = m->F, before = NAN;
    for (int a = 0; a < 3; a++)
        for (int64_t i = 0; i < n; i++)
            W[a * n + i] = r->TI[a][0] * Z[i] + r->TI[a][1] * Z[n + i] + r->TI[a][2] * Z[2 * n + i];
    *speed = NAN;
    for (int k = 0; k < NEWTON; k++) {
        *iterations = k + 1;
        for (int a = 0; a < 3; a++) {
            for (int64_t i = 0; i < n; i++) m->y[i] = m->x[i] + Z[a * n + i];
            rate(p, m->t + h * r->C[a], m->y, F + a * n);
        }
        if (!lw_are_finite(F, 3 * n)) return false;
        for (int64_t i = 0; i < n; i++) {
            const double f0 = F[i], f1 = F[n + i], f2 = F[2 * n + i], w1 = W[n + i], w2 = W[2 * n + i];
            F[i] = r->TI[0][0] * f0 + r->TI[0][1] * f1 + r->TI[0][2] * f2 - r->mu / h * W[i];
            F[n + i] = r->TI[1][0] * f0 + r->TI[1][1] * f1 + r->TI[1][2] * f2 - (r->mu_re * w1 - r->mu_im * w2) / h;
            F[2 * n + i] = r->TI[2][0] * f0 + r->TI[2][1] * f1 + r->TI[2][2] * f2 - (r->mu_re * w2 + r->mu_im * w1) / h;
        }
        lw_solve(m->lu, m->pivots, n, F);
        solve_complex(m->lu_complex, m->pivots_complex, n, F + n, F + 2 * n);
        double sum = 0.0;
        for (int64_t j = 0; j < 3 * n; j++) sum += (F[j] / m->scale[j % n]) * (F[j] / m->scale[j % n]);
        const double change = sqrt(sum / (3.0 * (double)n));
        if (!isnan(before)) *speed = change / before;
        if (!isfinite(change)) return false;
        if (*speed >= 1.0 || (!isnan(*speed) && pow(*speed, NEWTON - k) / (1.0 - *speed) * change > m->tolerance))
            return false;
        for (int64_t j = 0; j < 3 * n; j++) W[j] += F[j];
        for (int a = 0; a < 3; a++)
            for (int64_t i = 0; i < n; i++)
                Z[a * n + i] = r->T[a][0] * W[i] + r->T[a][1] * W[n + i] + r->T[a][2] * W[2 * n + i];
        if (change == 0.0 || (!isnan(*speed) && *speed / (1.0 - *speed) * change < m->tolerance)) return true;
        before = change;
    }
    return false;
}

/* Write the stages that the last step leads to. */
static void predict_stages(method *m, const radau *r, double h) {
    const int64_t n = m->n;
    for (int a = 0; a < 3; a++)
        for (int64_t i = 0; i < n; i++) {
            double change = 0.0;
            if (m->predicts) {
                const double u = (m->t + h * r->C[a] - m->t_old) / (m->t - m->t_old);
                for (int k = 2; k >= 0; k--) change = (change + m->D[k * n + i]) * u;
                change += m->x_old[i] - m->x[i];
            }
            m->Z[a * n + i] = change;
        }
}

static double predict_factor(double h, double h_before, double error, double error_before) {
    double multiplier = 1.0;
    if (!isnan(h_before) && !isnan(error_before) && error != 0.0)
        multiplier = h / h_before * pow(error_before / error, 0.25);
    return fmin(1.0, multiplier) * pow(error, -0.25);
}

/* Return the norm of the error at m->g, of which m->error is solved for. */
static double weigh_error(method *m) {
    const lw_tolerance tolerance = {m->atol, m->rtol};
    for (int64_t i = 0; i < m->n; i++) m->scale[i] = lw_scale(&tolerance, i, m->x[i], m->g[i]);
    return lw_norm(m->n, m->error, m->scale);
}

static int step_radau(method *m) {
    problem *p = m->of;
    const radau *r = (const radau *)m->A;
    const int64_t n = m->n;
    const double least = 10.0 * ulp(m->t), before = m->h;
    double h = m->h, h_before = m->predicts ? m->h_before : NAN, error_before = m->predicts ? m->error_before : NAN;
    double to, error, safety, speed = NAN, factor;
    int iterations = 0;
    bool rejected = false;
    if (h > m->longest || h < least) {
        h = h > m->longest ? m->longest : least;
        h_before = error_before = NAN;
    }
    if (!m->has_slope && !differentiate(m, m->t, m->x)) return p->lost = IN_SLOPE, FAILED;
    for (;;) {
        if (!(h >= least)) return FAILED;
        to = m->t + h;
        if (to > p->stop) to = p->stop;
        h = to - m->t;
        for (int64_t i = 0; i < n; i++) m->scale[i] = m->atol[i] + fabs(m->x[i]) * m->rtol;
        bool converged = false;
        while (!converged) {
            if (!m->has_lu || m->h_of_lu != h)
                if (!make_factors(m, r, h)) break;
            predict_stages(m, r, h);
            converged = solve_stages(m, r, h, &iterations, &speed);
            if (converged) break;
            if (m->slope_is_new) break;
            if (!differentiate(m, m->t, m->x)) return FAILED;
        }
        if (!converged) {
            h *= 0.5;
            m->has_lu = 0;
            m->rejected++;
            continue;
        }
        for (int64_t i = 0; i < n; i++) {
            m->g[i] = m->x[i] + m->Z[2 * n + i];
            m->K[i] = (r->E[0] * m->Z[i] + r->E[1] * m->Z[n + i] + r->E[2] * m->Z[2 * n + i]) / h;
            m->error[i] = m->f[i] + m->K[i];
        }
        lw_solve(m->lu, m->pivots, n, m->error);
        error = weigh_error(m);
        safety = 0.9 * (2 * NEWTON + 1) / (2 * NEWTON + iterations);
        if (rejected && error > 1.0) {
            for (int64_t i = 0; i < n; i++) m->y[i] = m->x[i] + m->error[i];
            rate(p, m->t, m->y, m->error);
            for (int64_t i = 0; i < n; i++) m->error[i] += m->K[i];
            lw_solve(m->lu, m->pivots, n, m->error);
            error = weigh_error(m);
        }
        if (error <= 1.0) {
            rate(p, to, m->g, m->K);
            if (lw_are_finite(m->g, n) && lw_are_finite(m->K, n)) break;
            h *= 0.25;
        } else {
            factor = safety * predict_factor(h, h_before, error, error_before);
            h *= factor > 0.2 ? factor : 0.2;
        }
        m->has_lu = 0;
        m->rejected++;
        rejected = true;
    }
    const bool again = iterations > 2 && speed > 1e-3;
    factor = fmin(10.0, safety * predict_factor(h, h_before, error, error_before));
    if (!again && factor < 1.2) factor = 1.0;
    m->h_before = before;
    m->error_before = error;
    double *swap = m->x_old;
    m->x_old = m->x;
    m->x = m->g;
    m->g = swap;
    memcpy(m->f, m->K, n * sizeof(double));
    m->t_old = m->t;
    m->t = to;
    m->h = h * factor;
    m->planned = to == p->stop ? fmax(before, m->h) : m->h;
    m->predicts = 1;
    for (int k = 0; k < 3; k++)
        for (int64_t i = 0; i < n; i++)
            m->D[k * n + i] = r->P[0][k] * m->Z[i] + r->P[1][k] * m->Z[n + i] + r->P[2][k] * m->Z[2 * n + i];
    m->slope_is_new = 0;
    if (again && !differentiate(m, to, m->x)) return FAILED;
    return PASSED;
}

/* For methods of other libraries; see loopwright_rates. */
VISIBLE int loopwright_slope(problem *p, double t, const double *x, double *J) { return write_slope(p, t, x, J); }
