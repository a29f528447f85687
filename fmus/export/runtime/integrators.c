/* One step of each integrator, with discrete states held, and inputs too unless they move (u is NULL, see lw_inputs): rk4
 * (explicit Runge-Kutta, order 4), dopri5 (explicit, embedded order 5(4): Dormand & Prince 1980) and rodas (linearly
 * implicit, order 4(3), stiffly accurate, L-stable: Hairer & Wanner, Solving Ordinary Differential Equations II, IV.7). */
#define LW_MAX_SUBSTEPS 1e9

/* The slope k at (t, x + h * previous slope); on the stack, the compiler keeps small models in registers. */
static inline int lw_slope(lw_instance *self, double t, const double *x, double h, const double *previous, const double *u,
                           double *k) {
    LW_SCRATCH(stage);
    const double *arg[LW_SZ_ARG] = {&t, stage, lw_inputs(self, u, t), self->s.values + LW_P};
    double *res[LW_SZ_RES] = {k};
    for (int i = 0; i < LW_N_X; i++) stage[i] = previous ? x[i] + h * previous[i] : x[i];
#if LW_N_D
    for (int i = LW_N_X; i < LW_N_S; i++) stage[i] = x[i];
#endif
    return lw_derivative(arg, res, self->iw, self->w, 0);
}

/* ---- rk4 ---- */

static inline int lw_rk4(lw_instance *self, double t, double h, const double *u, double *x) {
    LW_SCRATCH(k1);
    LW_SCRATCH(k2);
    LW_SCRATCH(k3);
    LW_SCRATCH(k4);
    int failed = lw_slope(self, t, x, 0.0, NULL, u, k1);
    failed |= lw_slope(self, t + h / 2.0, x, h / 2.0, k1, u, k2);
    failed |= lw_slope(self, t + h / 2.0, x, h / 2.0, k2, u, k3);
    failed |= lw_slope(self, t + h, x, h, k3, u, k4);
    for (int i = 0; i < LW_N_X; i++) x[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    return failed;
}

/* Number of equal substeps of at most internal_step in h; negative, and logged, if too many. */
static inline long lw_substeps(lw_instance *self, double h) {
    double step = self->s.values[LW_STEP], count = ceil(h / step - 1e-9);
    if (count <= LW_MAX_SUBSTEPS) return count < 1.0 ? 1 : (long)count;
    lw_fail(self, "internal_step = %g s cuts the communication step of %g s into more than 1e9 pieces. Set a larger one.", step, h);
    return -1;
}

#if !LW_N_Z
/* Integrate from t0 over h in n substeps into self->next; with `watch`, log the first substep that isn't finite. */
static inline bool lw_integrate(lw_instance *self, double t0, double h, long n, const double *u, bool watch) {
    LW_SCRATCH(x);
    int failed = 0;
    memcpy(x, self->s.values + LW_X, LW_N_S * sizeof(double));
    for (long i = 0; i < n; i++) {
        failed |= lw_rk4(self, t0 + h * ((double)i / (double)n), h / (double)n, u, x);
        double t = t0 + h * ((double)(i + 1) / (double)n);
        if (watch && failed) return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", t);
        if (LW_N_X && watch && !lw_check_finite(self, x, LW_X, LW_N_X, t)) return false;
    }
    memcpy(self->next, x, LW_N_S * sizeof(double));
    return !failed && (!LW_N_X || lw_is_finite(x, LW_N_X));
}

static inline bool lw_fixed_steps(lw_instance *self, double t, double h) {
    long n = lw_substeps(self, h);
    if (n < 0) return false;
    const double *u = lw_inputs_of_step(self);
    /* two calls, so that held inputs cost nothing in the loop */
    if (u ? lw_integrate(self, t, h, n, self->s.values + LW_U, false) : lw_integrate(self, t, h, n, NULL, false)) return true;
    lw_integrate(self, t, h, n, u, true); /* again, to name the variable and the time */
    return false;
}
#endif

/* ---- common part of the adaptive integrators ----
 *
 * A step goes from self->x at t to self->next at t + h. The solution in between, needed for events, is
 * x + theta (d0 + (1 - theta) (d1 + theta (d2 + (1 - theta) d3))), theta from 0 to 1, d in self->dense. */

static inline int lw_rate(lw_instance *self, double t, const double *x, const double *u, double *k) {
    return lw_slope(self, t, x, 0.0, NULL, u, k);
}

static double lw_scale(lw_instance *self, int i, double a, double b) {
    return self->s.values[LW_TOLERANCE] * (lw_nominals[i] + fmax(fabs(a), fabs(b)));
}

/* Root mean square of v, each element in units of its tolerance. */
static double lw_norm(lw_instance *self, const double *v, const double *x, const double *next) {
    double sum = 0.0;
    for (int i = 0; i < LW_N_X; i++) {
        double ratio = v[i] / lw_scale(self, i, x[i], next[i]);
        sum += ratio * ratio;
    }
    return sqrt(sum / LW_AT_LEAST_1(LW_N_X));
}

/* A first step size from slope and curvature at the start (Hairer, Norsett & Wanner, II.4); k1 is the slope there. */
static double lw_first_step(lw_instance *self, double t, const double *u, int order, double longest) {
    double d0 = lw_norm(self, self->x, self->x, self->x), d1 = lw_norm(self, self->k1, self->x, self->x);
    double h = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    h = fmin(h, longest);
    if (lw_slope(self, t + h, self->x, h, self->k1, u, self->k2)) return h;
    for (int i = 0; i < LW_N_X; i++) self->k2[i] -= self->k1[i];
    double d2 = lw_norm(self, self->k2, self->x, self->x) / h;
    double largest = fmax(d1, d2);
    double second = largest <= 1e-15 ? fmax(1e-6, h * 1e-3) : pow(0.01 / largest, 1.0 / (order + 1));
    return fmin(fmin(100.0 * h, isfinite(second) ? second : h), longest);
}

/* next = x + h * (c0 k1 + c1 k2 + ...). */
static void lw_combine(lw_instance *self, double h, const double *c, int n, double *next) {
    const double *const k[] = {self->k1, self->k2, self->k3, self->k4, self->k5, self->k6, self->k7};
    for (int i = 0; i < LW_N_X; i++) {
        double sum = 0.0;
        for (int j = 0; j < n; j++) sum += c[j] * k[j][i];
        next[i] = self->x[i] + h * sum;
    }
}

/* ---- rk4 step by step, for events with the cubic Hermite interpolant ---- */

static int lw_rk4_step(lw_instance *self, double t, double h, const double *u) {
    double *const x = self->x, *const next = self->next;
    memcpy(next, x, LW_N_S * sizeof(double));
    int failed = lw_rk4(self, t, h, u, next);
#if LW_N_Z
    failed |= lw_rate(self, t, x, u, self->k1) | lw_rate(self, t + h, next, u, self->k7);
    for (int i = 0; i < LW_N_X; i++) {
        double d0 = next[i] - x[i], d1 = h * self->k1[i] - d0;
        self->dense[0][i] = d0;
        self->dense[1][i] = d1;
        self->dense[2][i] = d0 - h * self->k7[i] - d1;
        self->dense[3][i] = 0.0;
    }
#endif
    return failed;
}

/* ---- dopri5: k1 is given; after an accepted step, k7 is the slope at its end. Returns the error, 1 is the tolerance ---- */

static double lw_dopri5_step(lw_instance *self, double t, double h, const double *u) {
    static const double c[5] = {1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0};
    static const double a[5][5] = {
        {1.0 / 5},
        {3.0 / 40, 9.0 / 40},
        {44.0 / 45, -56.0 / 15, 32.0 / 9},
        {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
        {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    };
    static const double b[6] = {35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84};
    static const double e[7] = {71.0 / 57600, 0.0, -71.0 / 16695, 71.0 / 1920, -17253.0 / 339200, 22.0 / 525, -1.0 / 40};
    double *const k[7] = {self->k1, self->k2, self->k3, self->k4, self->k5, self->k6, self->k7};
    double *const next = self->next;
    int failed = 0;
    memcpy(next, self->x, LW_N_S * sizeof(double));
    for (int s = 0; s < 5; s++) {
        lw_combine(self, h, a[s], s + 1, next);
        failed |= lw_rate(self, t + c[s] * h, next, u, k[s + 1]);
    }
    lw_combine(self, h, b, 6, next);
    failed |= lw_rate(self, t + h, next, u, self->k7);
    for (int i = 0; i < LW_N_X; i++) {
        double error = 0.0;
        for (int j = 0; j < 7; j++) error += e[j] * k[j][i];
        self->stage[i] = h * error;
    }
    double error = lw_norm(self, self->stage, self->x, next);
#if LW_N_Z
    static const double d[7] = {-12715105075.0 / 11282082432, 0.0, 87487479700.0 / 32700410799, -10690763975.0 / 1880347072,
                                701980252875.0 / 199316789632, -1453857185.0 / 822651844, 69997945.0 / 29380423};
    for (int i = 0; i < LW_N_X; i++) {
        double d0 = next[i] - self->x[i], d1 = h * self->k1[i] - d0, d3 = 0.0;
        for (int j = 0; j < 7; j++) d3 += d[j] * k[j][i];
        self->dense[0][i] = d0;
        self->dense[1][i] = d1;
        self->dense[2][i] = d0 - h * self->k7[i] - d1;
        self->dense[3][i] = h * d3;
    }
#endif
    return failed || !isfinite(error) || !lw_is_finite(self->k7, LW_N_X) ? INFINITY : error;
}

/* ---- rodas ---- */

#if LW_HAS_DERIVATIVES
#define LW_MATRIX(i, j) m[(size_t)(i) * LW_N_X + (j)]

#if LW_MOVING_INPUTS
/* Write the rate of the unknowns at (t, x) due to moving inputs into self->scratch. */
static int lw_along_inputs(lw_instance *self, double t, const double *x) {
    double *knowns = self->sensitivity, *seed = self->seed, since = t - self->step_start;
    memcpy(knowns, self->s.values, LW_DX * sizeof(double));
    memcpy(knowns + LW_U, lw_inputs(self, NULL, t), LW_N_U * sizeof(double));
    memcpy(knowns + LW_X, x, LW_N_S * sizeof(double));
    knowns[0] = t;
    memset(seed, 0, LW_DX * sizeof(double));
    for (int i = 0; i < LW_N_U; i++) {
        double sum = 0.0;
        for (int k = LW_MAX_ORDER; k > 1; k--) sum = since / (k - 1) * (self->s.slopes[k - 1][i] + sum);
        seed[LW_U + i] = self->s.slopes[0][i] + sum;
    }
    self->arg[0] = knowns;
    self->arg[1] = seed;
    self->res[0] = self->scratch;
    return lw_forward(self->arg, self->res, self->iw, self->w, 0);
}
#endif

/* Evaluate the Jacobian of the derivatives by the continuous states (its nonzeros), and the slope by time. */
static int lw_linearize(lw_instance *self, double t, const double *u) {
    self->arg[0] = &t;
    self->arg[1] = self->x;
    self->arg[2] = lw_inputs(self, u, t);
    self->arg[3] = self->s.values + LW_P;
    self->res[0] = self->jacobian;
    self->res[1] = self->slope;
    int failed = lw_jacobian(self->arg, self->res, self->iw, self->w, 0);
#if LW_MOVING_INPUTS
    if (!u) {
        failed |= lw_along_inputs(self, t, self->x);
        for (int i = 0; i < LW_N_X; i++) self->slope[i] += self->scratch[i];
    }
#endif
    return failed;
}

/* Factorize diagonal * I - J, with row pivoting; nonzero if it is singular. */
static int lw_factorize(lw_instance *self, double diagonal) {
    double *const m = self->matrix, *const pivots = m + (size_t)LW_N_X * LW_N_X;
    memset(m, 0, (size_t)LW_N_X * LW_N_X * sizeof(double));
    for (int k = 0; k < LW_N_J; k++) LW_MATRIX(lw_jacobian_rows[k], lw_jacobian_columns[k]) = -self->jacobian[k];
    for (int i = 0; i < LW_N_X; i++) LW_MATRIX(i, i) += diagonal;
    for (int j = 0; j < LW_N_X; j++) {
        int pivot = j;
        for (int i = j + 1; i < LW_N_X; i++)
            if (fabs(LW_MATRIX(i, j)) > fabs(LW_MATRIX(pivot, j))) pivot = i;
        pivots[j] = pivot;
        if (!(fabs(LW_MATRIX(pivot, j)) > 0.0)) return 1; /* singular, or not a number */
        for (int l = 0; l < LW_N_X && pivot != j; l++) {
            double swapped = LW_MATRIX(j, l);
            LW_MATRIX(j, l) = LW_MATRIX(pivot, l);
            LW_MATRIX(pivot, l) = swapped;
        }
        for (int i = j + 1; i < LW_N_X; i++) {
            double factor = LW_MATRIX(i, j) /= LW_MATRIX(j, j);
            if (factor == 0.0) continue;
            for (int l = j + 1; l < LW_N_X; l++) LW_MATRIX(i, l) -= factor * LW_MATRIX(j, l);
        }
    }
    return 0;
}

static void lw_solve(lw_instance *self, double *b) {
    const double *const m = self->matrix, *const pivots = m + (size_t)LW_N_X * LW_N_X;
    for (int i = 0; i < LW_N_X; i++) { /* whole rows were exchanged, so all exchanges come first */
        int pivot = (int)pivots[i];
        double swapped = b[i];
        b[i] = b[pivot];
        b[pivot] = swapped;
    }
    for (int i = 0; i < LW_N_X; i++)
        for (int j = 0; j < i; j++) b[i] -= LW_MATRIX(i, j) * b[j];
    for (int i = LW_N_X - 1; i >= 0; i--) {
        for (int j = i + 1; j < LW_N_X; j++) b[i] -= LW_MATRIX(i, j) * b[j];
        b[i] /= LW_MATRIX(i, i);
    }
}

/* A step with the Jacobian of its start, which lw_linearize has evaluated. Returns the error, 1 is the tolerance. */
static double lw_rodas_step(lw_instance *self, double t, double h, const double *u) {
    static const double gamma = 0.25;
    static const double time[6] = {0.0, 0.386, 0.21, 0.63, 1.0, 1.0};
    static const double d[6] = {0.25, -0.1043, 0.1035, -0.03620000000000023, 0.0, 0.0};
    static const double a[6][5] = {
        {0.0},
        {1.544},
        {0.9466785280815826, 0.2557011698983284},
        {3.314825187068521, 2.896124015972201, 0.9986419139977817},
        {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950},
        {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0},
    };
    static const double c[6][5] = {
        {0.0},
        {-5.6688},
        {-2.430093356833875, -0.2063599157091915},
        {-0.1073529058151375, -9.594562251023355, -20.47028614809616},
        {7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160},
        {8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054},
    };
    double *const k[6] = {self->k1, self->k2, self->k3, self->k4, self->k5, self->k6};
    double *const next = self->next;
    if (lw_factorize(self, 1.0 / (h * gamma))) return INFINITY;
    memcpy(next, self->x, LW_N_S * sizeof(double));
    int failed = 0;
    for (int s = 0; s < 6; s++) {
        lw_combine(self, 1.0, a[s], s, next);
        failed |= lw_rate(self, t + time[s] * h, next, u, k[s]);
        for (int i = 0; i < LW_N_X; i++) {
            double sum = 0.0;
            for (int j = 0; j < s; j++) sum += c[s][j] * k[j][i];
            k[s][i] += sum / h + h * d[s] * self->slope[i];
        }
        lw_solve(self, k[s]);
    }
    for (int i = 0; i < LW_N_X; i++) next[i] += self->k6[i];
    double error = lw_norm(self, self->k6, self->x, next);
#if LW_N_Z
    static const double d1[5] = {10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662};
    static const double d2[5] = {-0.6762803392806898, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872};
    for (int i = 0; i < LW_N_X; i++) {
        self->dense[0][i] = next[i] - self->x[i];
        self->dense[1][i] = self->dense[2][i] = self->dense[3][i] = 0.0;
        for (int j = 0; j < 5; j++) {
            self->dense[1][i] += d1[j] * k[j][i];
            self->dense[2][i] += d2[j] * k[j][i];
        }
    }
#endif
    return failed || !isfinite(error) ? INFINITY : error;
}

static bool lw_need_matrix(lw_instance *self) {
    if (!self->matrix && !(self->matrix = malloc(((size_t)LW_N_X + 1) * LW_AT_LEAST_1(LW_N_X) * sizeof(double))))
        return lw_fail(self, "out of memory for the Jacobian of %d states. Set integrator = 1 or 2.", LW_N_X);
    return true;
}
#endif
