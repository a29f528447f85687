/* Explicit Runge-Kutta methods with an estimate of their error: stages, norms, the control of the step, dense output.

   Runs of diagrams and exported FMUs use them, with LW_EQUATION and LW_RATE as fixed_step.c has them. Norms and control
   are those of E. Hairer, S. P. Nørsett, G. Wanner, Solving Ordinary Differential Equations I, II.4, as SciPy has them. */

/* The numbers of a method. */
typedef struct {
    int64_t stages;
    const double *A, *B, *C; /* A: stages × stages, row by row */
    const double *E, *E3;    /* of the error; E3: of the second estimate of an eighth-order method, else NULL */
    double order;            /* of the estimate */
} lw_tableau;

/* What is asked of the error of a step: at most 1 in units of atol + rtol · |x|, the larger |x| of both ends. */
typedef struct {
    const double *atol;
    double rtol;
} lw_tolerance;

/* A step: from t on, of the length h at most, to `to`; at most `factor` times as long may be the next one. */
typedef struct {
    double t, stop, h, least, to, factor;
    int64_t rejected;
} lw_attempt;

static inline double lw_scale(const lw_tolerance *tolerance, int64_t i, double a, double b) {
    const double size = fabs(a) > fabs(b) ? fabs(a) : fabs(b);
    return tolerance->atol[i] + size * tolerance->rtol;
}

static inline double lw_norm(int64_t n, const double *v, const double *scale) {
    double sum = 0.0;
    for (int64_t i = 0; i < n; i++) sum += (v[i] / scale[i]) * (v[i] / scale[i]);
    return sqrt(sum / (double)n);
}

/* y = x + h Σ a[j] K[j], over the first so many stages. */
LW_INLINE void lw_stage(int64_t n, const double *a, int64_t count, double h, const double *x, const double *K, double *y) {
    for (int64_t i = 0; i < n; i++) {
        double sum = 0.0;
        for (int64_t j = 0; j < count; j++)
            if (a[j] != 0.0) sum += a[j] * K[j * n + i];
        y[i] = x[i] + h * sum;
    }
}

/* Evaluate all stages of a step after the first one, K[0], and its end with the rates there, K[stages]. */
LW_INLINE int lw_stages(LW_EQUATION *e, int64_t n, const lw_tableau *method, double t, double h, double to, const double *x,
                        double *K, double *y, double *end) {
    const int64_t last = method->stages;
    int failed = 0;
    for (int64_t s = 1; s < last; s++) {
        lw_stage(n, method->A + s * last, s, h, x, K, y);
        failed |= LW_RATE(e, t + method->C[s] * h, y, K + s * n);
    }
    lw_stage(n, method->B, last, h, x, K, end);
    return failed | LW_RATE(e, to, end, K + last * n);
}

/* Return the norm of the error of a step. */
LW_INLINE double lw_error(int64_t n, const lw_tableau *method, const lw_tolerance *tolerance, double h, const double *x,
                          const double *K, const double *end) {
    const int64_t rows = method->stages + 1;
    double sum = 0.0, sum3 = 0.0;
    for (int64_t i = 0; i < n; i++) {
        const double scale = lw_scale(tolerance, i, x[i], end[i]);
        double error = 0.0, error3 = 0.0;
        for (int64_t j = 0; j < rows; j++)
            if (method->E[j] != 0.0) error += K[j * n + i] * method->E[j];
        if (method->E3)
            for (int64_t j = 0; j < rows; j++) error3 += K[j * n + i] * method->E3[j];
        error /= scale;
        error3 /= scale;
        sum += error * error;
        sum3 += error3 * error3;
    }
    if (!method->E3) return fabs(h) * sqrt(sum / (double)n);
    return sum == 0.0 && sum3 == 0.0 ? 0.0 : fabs(h) * sum / sqrt((sum + 0.01 * sum3) * (double)n);
}

/* The factor, at most `most`, by which a step grows after an error below 1 of an estimate of some order. */
static inline double lw_growth(double error, double order, double most) {
    const double tiny = order == 4.0 ? 5.9e-6 : order == 2.0 ? 7.2e-4 : 4.3e-9; /* below 0.09^(order + 1): more than 10 */
    if (error < tiny) return most;
    const double factor = 0.9 * pow(error, -1.0 / (order + 1.0));
    return factor < most ? factor : most;
}

/* The factor by which a step shrinks after an error above 1, or one that is no number. */
static inline double lw_shrinkage(double error, double order) {
    const double factor = 0.9 * pow(error, -1.0 / (order + 1.0));
    return factor > 0.2 ? factor : 0.2;
}

/* Take the longest step that the error allows; false if it is shorter than the least one. */
LW_INLINE bool lw_take_step(LW_EQUATION *e, int64_t n, const lw_tableau *method, const lw_tolerance *tolerance,
                            lw_attempt *step, const double *x, double *K, double *y, double *end) {
    bool again = false;
    for (;;) {
        if (!(step->h >= step->least)) return false;
        step->to = step->t + step->h;
        if (step->to > step->stop) step->to = step->stop;
        step->h = step->to - step->t;
        lw_stages(e, n, method, step->t, step->h, step->to, x, K, y, end);
        const double error = lw_error(n, method, tolerance, step->h, x, K, end);
        if (error < 1.0) {
            if (lw_are_finite(end, n) && lw_are_finite(K + method->stages * n, n)) {
                step->factor = lw_growth(error, method->order, again ? 1.0 : 10.0);
                return true;
            }
            step->h *= 0.25;
        } else {
            step->h *= lw_shrinkage(error, method->order);
        }
        step->rejected++;
        again = true;
    }
}

/* Return a first step by the size of the rates f at (t, x), and of their change; y and change are scratch. */
LW_INLINE double lw_first_step(LW_EQUATION *e, int64_t n, double order, const lw_tolerance *tolerance, double t,
                               double length, double longest, const double *x, const double *f, double *scale, double *y,
                               double *change) {
    for (int64_t i = 0; i < n; i++) scale[i] = lw_scale(tolerance, i, x[i], x[i]);
    const double d0 = lw_norm(n, x, scale), d1 = lw_norm(n, f, scale);
    double h0 = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    if (!(h0 < length)) h0 = length;
    for (int64_t i = 0; i < n; i++) y[i] = x[i] + h0 * f[i];
    const int failed = LW_RATE(e, t + h0, y, change);
    for (int64_t i = 0; i < n; i++) change[i] -= f[i];
    const double d2 = lw_norm(n, change, scale) / h0, most = d1 > d2 ? d1 : d2;
    const double h1 = d1 <= 1e-15 && d2 <= 1e-15 ? fmax(1e-6, h0 * 1e-3) : pow(0.01 / most, 1.0 / (order + 1.0));
    const double h = fmin(fmin(100.0 * h0, h1), fmin(length, longest));
    return !failed && isfinite(h) && isfinite(most) ? h : 1e-6 * length;
}

/* Write the states at a part u of a step, from 0 to 1: x + u (D[0] + (1 − u) (D[1] + u (D[2] + (1 − u) (D[3] + …)))). */
LW_INLINE void lw_interpolate(int64_t n, int64_t rows, const double *D, double u, const double *x, double *out) {
    for (int64_t i = 0; i < n; i++) {
        double change = 0.0;
        for (int64_t k = rows - 1; k >= 0; k--) change = (change + D[k * n + i]) * (k % 2 ? 1.0 - u : u);
        out[i] = x[i] + change;
    }
}
