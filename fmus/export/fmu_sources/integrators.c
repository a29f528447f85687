/* One step of each integrator, with discrete states held, and inputs too unless they move (u is NULL, see lw_inputs): rk4
 * (explicit Runge-Kutta, order 4), dopri5 (explicit, embedded order 5(4): Dormand & Prince 1980) and rodas (linearly
 * implicit, order 4(3), stiffly accurate, L-stable: Hairer & Wanner, Solving Ordinary Differential Equations II, IV.7). */
#define LW_MAX_SUBSTEPS 1e9

static inline lw_equation lw_equation_of(lw_instance *self, const double *u) {
    return (lw_equation){self, u, self->s.values + LW_P, self->iw, self->w};
}

/* The rates at (t, x), x with the discrete states; not 0 if they can't be evaluated. */
LW_INLINE int lw_inline_rate(const lw_equation *e, double t, const double *x, double *k) {
    const double *arg[LW_SZ_ARG] = {&t, x, lw_inputs(e->self, e->u, t), e->p};
    double *res[LW_SZ_RES] = {k};
    return lw_derivative(arg, res, e->iw, e->w, 0);
}

static int lw_rate(const lw_equation *e, double t, const double *x, double *k) { return lw_inline_rate(e, t, x, k); }

#define LW_EQUATION const lw_equation
#define LW_NUMBER double
#define LW_RATE lw_inline_rate
#include "fixed_step.c"
#undef LW_RATE
#define LW_RATE lw_rate
#include "embedded.c"

/* ---- rk4 ---- */

/* A step from x, in place. On the stack, the compiler keeps small models in registers. */
static int lw_rk4_step(const lw_equation *e, double t, double h, double *x) {
    lw_instance *const self = e->self;
    LW_SCRATCH(stage);
    LW_SCRATCH(k1);
    LW_SCRATCH(k2);
    LW_SCRATCH(k3);
    LW_SCRATCH(k4);
    (void)self;
    for (int i = LW_N_X; i < LW_N_S; i++) stage[i] = x[i];
    const int failed = lw_inline_rate(e, t, x, k1);
    return failed | lw_rk4(e, LW_N_X, t, h, t + h, x, k1, k2, k3, k4, stage, x);
}

/* Number of equal substeps of at most internal_step in h; negative, and logged, if too many. */
static inline long lw_substeps(lw_instance *self, double h) {
    double step = self->s.values[LW_STEP], count = ceil(h / step - 1e-9);
    if (count <= LW_MAX_SUBSTEPS) return count < 1.0 ? 1 : (long)count;
    lw_fail(self, "internal_step = %g s cuts the communication step of %g s into more than 1e9 pieces. Set a larger one.", step, h);
    return -1;
}

/* Integrate from t0 over h in n substeps into self->next; with `watch`, log the first substep that isn't finite. */
static inline bool lw_integrate(const lw_equation *e, double t0, double h, long n, bool watch) {
    lw_instance *const self = e->self;
    LW_SCRATCH(x);
    int failed = 0;
    memcpy(x, self->s.values + LW_X, LW_N_S * sizeof(double));
    for (long i = 0; i < n; i++) {
        failed |= lw_rk4_step(e, t0 + h * ((double)i / (double)n), h / (double)n, x);
        double t = t0 + h * ((double)(i + 1) / (double)n);
        if (watch && failed) return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", t);
        if (LW_N_X && watch && !lw_check_finite(self, x, LW_X, LW_N_X, t)) return false;
    }
    memcpy(self->next, x, LW_N_S * sizeof(double));
    return !failed && (!LW_N_X || lw_are_finite(x, LW_N_X));
}

#if !LW_N_Z
static inline bool lw_fixed_steps(lw_instance *self, double t, double h) {
    long n = lw_substeps(self, h);
    if (n < 0) return false;
    const double *u = lw_inputs_of_step(self);
    const lw_equation e = lw_equation_of(self, u), held = lw_equation_of(self, self->s.values + LW_U);
    const lw_equation moving = lw_equation_of(self, NULL);
    /* two calls, so that held inputs cost nothing in the loop */
    if (u ? lw_integrate(&held, t, h, n, false) : lw_integrate(&moving, t, h, n, false)) return true;
    lw_integrate(&e, t, h, n, true); /* again, to name the variable and the time */
    return false;
}
#endif

/* ---- common part of the adaptive integrators ----
 *
 * A step goes from self->x at t to self->next at t + h. The solution in between, needed for events, is
 * x + theta (d0 + (1 - theta) (d1 + theta (d2 + (1 - theta) d3))), theta from 0 to 1, d in self->dense. */

/* The error that the parameter tolerance allows. */
static lw_tolerance lw_tolerance_of(lw_instance *self) {
    const double relative = self->s.values[LW_TOLERANCE];
    for (int i = 0; i < LW_N_X; i++) self->absolute[i] = relative * lw_nominals[i];
    return (lw_tolerance){self->absolute, relative};
}

/* ---- rk4 step by step, for events with the cubic Hermite interpolant ---- */

static int lw_rk4_dense_step(lw_instance *self, double t, double h, const double *u) {
    const lw_equation e = lw_equation_of(self, u);
    double *const x = self->x, *const next = self->next;
    memcpy(next, x, LW_N_S * sizeof(double));
    int failed = lw_rk4_step(&e, t, h, next);
#if LW_N_Z
    double *const first = self->k, *const last = self->k + LW_N_X, *const d = self->dense;
    failed |= lw_rate(&e, t, x, first) | lw_rate(&e, t + h, next, last);
    for (int i = 0; i < LW_N_X; i++) {
        d[i] = next[i] - x[i];
        d[LW_N_X + i] = h * first[i] - d[i];
        d[2 * LW_N_X + i] = d[i] - h * last[i] - d[LW_N_X + i];
        d[3 * LW_N_X + i] = 0.0;
    }
#endif
    return failed;
}

/* ---- dopri5: the first slope is given; after an accepted step, the seventh is that at its end. Returns the error, 1 is the tolerance ---- */

static double lw_dopri5_step(lw_instance *self, double t, double h, const double *u) {
    static const double a[6 * 6] = {
        0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        1.0 / 5, 0.0, 0.0, 0.0, 0.0, 0.0,
        3.0 / 40, 9.0 / 40, 0.0, 0.0, 0.0, 0.0,
        44.0 / 45, -56.0 / 15, 32.0 / 9, 0.0, 0.0, 0.0,
        19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729, 0.0, 0.0,
        9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656, 0.0,
    };
    static const double b[6] = {35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84};
    static const double c[6] = {0.0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0};
    static const double e[7] = {-71.0 / 57600, 0.0, 71.0 / 16695, -71.0 / 1920, 17253.0 / 339200, -22.0 / 525, 1.0 / 40};
    static const lw_tableau numbers = {.stages = 6, .A = a, .B = b, .C = c, .E = e, .order = 4.0};
    const lw_equation equation = lw_equation_of(self, u);
    const lw_tolerance tolerance = lw_tolerance_of(self);
    double *const next = self->next, *const stage = self->stage, *const k = self->k, *const end = k + 6 * LW_N_X;
    memcpy(next, self->x, LW_N_S * sizeof(double));
    memcpy(stage, self->x, LW_N_S * sizeof(double));
    const int failed = lw_stages(&equation, LW_N_X, &numbers, t, h, t + h, self->x, k, stage, next);
    const double error = lw_error(LW_N_X, &numbers, &tolerance, h, self->x, k, next);
#if LW_N_Z
    static const double d[7] = {-12715105075.0 / 11282082432, 0.0, 87487479700.0 / 32700410799, -10690763975.0 / 1880347072,
                                701980252875.0 / 199316789632, -1453857185.0 / 822651844, 69997945.0 / 29380423};
    for (int i = 0; i < LW_N_X; i++) {
        double d0 = next[i] - self->x[i], d1 = h * k[i] - d0, d3 = 0.0;
        for (int j = 0; j < 7; j++) d3 += d[j] * k[j * LW_N_X + i];
        self->dense[i] = d0;
        self->dense[LW_N_X + i] = d1;
        self->dense[2 * LW_N_X + i] = d0 - h * end[i] - d1;
        self->dense[3 * LW_N_X + i] = h * d3;
    }
#endif
    return failed || !isfinite(error) || !lw_are_finite(end, LW_N_X) ? INFINITY : error;
}

/* ---- rodas ---- */

#if LW_HAS_DERIVATIVES
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

/* Factorize diagonal * I - J; false if it is singular. */
static bool lw_factorize(lw_instance *self, double diagonal) {
    double *const m = self->matrix;
    memset(m, 0, (size_t)LW_N_X * LW_N_X * sizeof(double));
    for (int k = 0; k < LW_N_J; k++) m[(size_t)lw_jacobian_rows[k] * LW_N_X + (size_t)lw_jacobian_columns[k]] = -self->jacobian[k];
    for (int i = 0; i < LW_N_X; i++) m[(size_t)i * (LW_N_X + 1)] += diagonal;
    return lw_factor(m, self->pivots, LW_N_X, 1);
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
    const lw_equation e = lw_equation_of(self, u);
    const lw_tolerance tolerance = lw_tolerance_of(self);
    double *const next = self->next, *const k = self->k, *const last = k + 5 * LW_N_X;
    if (!lw_factorize(self, 1.0 / (h * gamma))) return INFINITY;
    memcpy(next, self->x, LW_N_S * sizeof(double));
    int failed = 0;
    for (int s = 0; s < 6; s++) {
        double *const stage = k + s * LW_N_X;
        lw_stage(LW_N_X, a[s], s, 1.0, self->x, k, next);
        failed |= lw_rate(&e, t + time[s] * h, next, stage);
        for (int i = 0; i < LW_N_X; i++) {
            double sum = 0.0;
            for (int j = 0; j < s; j++) sum += c[s][j] * k[j * LW_N_X + i];
            stage[i] += sum / h + h * d[s] * self->slope[i];
        }
        lw_solve(self->matrix, self->pivots, LW_N_X, stage);
    }
    for (int i = 0; i < LW_N_X; i++) next[i] += last[i];
    for (int i = 0; i < LW_N_X; i++) self->stage[i] = lw_scale(&tolerance, i, self->x[i], next[i]);
    double error = lw_norm(LW_N_X, last, self->stage);
#if LW_N_Z
    static const double d1[5] = {10.12623508344586, -7.487995877610167, -34.80091861555747, -7.992771707568823, 1.025137723295662};
    static const double d2[5] = {-0.6762803392806898, 6.087714651680015, 16.43084320892478, 24.76722511418386, -6.594389125716872};
    for (int i = 0; i < LW_N_X; i++) {
        double second = 0.0, third = 0.0;
        for (int j = 0; j < 5; j++) {
            second += d1[j] * k[j * LW_N_X + i];
            third += d2[j] * k[j * LW_N_X + i];
        }
        self->dense[i] = next[i] - self->x[i];
        self->dense[LW_N_X + i] = second;
        self->dense[2 * LW_N_X + i] = third;
        self->dense[3 * LW_N_X + i] = 0.0;
    }
#endif
    return failed || !isfinite(error) ? INFINITY : error;
}

#if LW_MERGED
static bool lw_need_matrix(lw_instance *self) {
    return LW_N_MATRIX > 0 || lw_fail(self, "integrator = 3 needs memory that it was not given. Start with it.");
}
#else
static bool lw_need_matrix(lw_instance *self) {
    if (self->matrix) return true;
    self->matrix = malloc((size_t)LW_N_X * LW_AT_LEAST_1(LW_N_X) * sizeof(double));
    return self->matrix || lw_fail(self, "out of memory for the Jacobian of %d states. Set integrator = 1 or 2.", LW_N_X);
}
#endif
#endif
