/* The part of the runtime that knows no FMI version: logging, variables, equations, the integrator, states.
 *
 * Functions return true when all went well; when not, they have logged why, and the instance is terminated until it is
 * reset or given back a state (FMI 3.0, 2.3.1: a function that returns fmi3Error leads to Terminated).
 */
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define LW_MAGIC UINT64_C(0x4c57303031464d55)
#define LW_MAX_SUBSTEPS 1e9

/* ---- logging ---- */

static void lw_log(lw_instance *self, lw_category category, const char *format, va_list args) {
    char text[1024], escaped[2 * sizeof text];
    if (!(self->categories & (unsigned)category) || !self->write) return;
    int n = snprintf(text, sizeof text, "%s: ", self->name ? self->name : LW_MODEL_NAME);
    if (n < 0 || (size_t)n >= sizeof text) n = 0;
    vsnprintf(text + n, sizeof text - (size_t)n, format, args);
    char *to = escaped; /* '#' marks a value reference in FMI's log messages (FMI 3.0, 2.3.1): written as '##' */
    for (const char *from = text; *from; *to++ = *from++)
        if (*from == '#') *to++ = '#';
    *to = 0;
    self->write(self, category, escaped);
}

static void lw_warn(lw_instance *self, const char *format, ...) {
    va_list args;
    va_start(args, format);
    lw_log(self, LW_LOG_WARNING, format, args);
    va_end(args);
}

static bool lw_fail(lw_instance *self, const char *format, ...) {
    va_list args;
    va_start(args, format);
    lw_log(self, LW_LOG_ERROR, format, args);
    va_end(args);
    self->s.mode = LW_TERMINATED;
    return false;
}

static const char *const lw_mode_names[] = {"Instantiated", "Initialization Mode", "Step Mode", "Terminated"};

static bool lw_in_mode(lw_instance *self, const char *function, lw_mode expected) {
    if (self->s.mode == (int32_t)expected) return true;
    return lw_fail(self, "%s was called in state %s, expected %s. Call the functions in the order of " LW_ORDER
                   ", or reset the FMU.", function, lw_mode_names[self->s.mode], lw_mode_names[expected]);
}

/* ---- equations ---- */

/* Is values[0 .. n), which are to be those from index `first` on, finite? If not, log which isn't, and when. */
static inline bool lw_is_finite(const double *values, size_t n) {
    bool finite = true;
    for (size_t i = 0; i < n; i++) finite &= isfinite(values[i]) != 0;
    return finite;
}

static bool lw_check_finite(lw_instance *self, const double *values, size_t first, size_t n, double t) {
    if (lw_is_finite(values, n)) return true;
    size_t i = 0, v = 0;
    while (isfinite(values[i])) i++;
    while (first + i >= (size_t)lw_variables[v].first + lw_variables[v].size) v++;
    return lw_fail(self, "%s (element %zu) became %g at t = %.9g s, expected a finite number. Check the inputs and "
                   "parameters; a stiff model needs a smaller internal_step.", lw_variables[v].name,
                   first + i - lw_variables[v].first, values[i], t);
}

static inline int lw_call(lw_instance *self, lw_function *f, const double *t, const double *x, const double *u, double *out) {
    self->arg[0] = t;
    self->arg[1] = x;
    self->arg[2] = u;
    self->arg[3] = self->s.values + LW_P;
    self->res[0] = out;
    return f(self->arg, self->res, self->iw, self->w, 0);
}

/* Outputs and derivatives at the last communication point: with the inputs held until then. */
static bool lw_update(lw_instance *self, uint8_t *have, lw_function *f, size_t first, size_t n) {
    double *v = self->s.values;
    if (*have || n == 0) return true;
    if (lw_call(self, f, v, v + LW_X, v + LW_HELD, self->scratch))
        return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", v[0]);
    if (!lw_check_finite(self, self->scratch, first, n, v[0])) return false;
    memcpy(v + first, self->scratch, n * sizeof(double));
    *have = 1;
    return true;
}

static bool lw_update_outputs(lw_instance *self) {
    return lw_update(self, &self->s.have_outputs, lw_output, LW_Y, LW_N_Y);
}

static bool lw_update_derivatives(lw_instance *self) {
    return lw_update(self, &self->s.have_derivatives, lw_derivative, LW_DX, LW_N_X);
}

/* ---- the integrator: explicit Runge-Kutta of order 4, fixed step, inputs held ---- */

/* The slope k at (t, x + h * previous slope); on the stack, the compiler keeps small models in registers. */
static inline int lw_slope(lw_instance *self, double t, const double *x, double h, const double *previous, const double *u,
                           double *k) {
    LW_SCRATCH(stage);
    const double *arg[LW_SZ_ARG] = {&t, stage, u, self->s.values + LW_P};
    double *res[LW_SZ_RES] = {k};
    for (int i = 0; i < LW_N_X; i++) stage[i] = previous ? x[i] + h * previous[i] : x[i];
    return lw_derivative(arg, res, self->iw, self->w, 0);
}

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

/* Integrate from t0 over h in n substeps into self->next; with `watch`, log the first substep that isn't finite. */
static bool lw_integrate(lw_instance *self, double t0, double h, long n, bool watch) {
    const double *u = self->s.values + LW_U;
    LW_SCRATCH(x);
    int failed = 0;
    memcpy(x, self->s.values + LW_X, LW_N_X * sizeof(double));
    for (long i = 0; i < n; i++) {
        failed |= lw_rk4(self, t0 + h * ((double)i / (double)n), h / (double)n, u, x);
        double t = t0 + h * ((double)(i + 1) / (double)n);
        if (watch && failed) return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", t);
        if (watch && !lw_check_finite(self, x, LW_X, LW_N_X, t)) return false;
    }
    memcpy(self->next, x, LW_N_X * sizeof(double));
    return !failed && lw_is_finite(x, LW_N_X);
}

/* Step from t over h. When it fails, nothing has changed: time, states and outputs are those before it. */
static bool lw_step(lw_instance *self, double t, double h) {
    double *v = self->s.values, end = t + h, count = ceil(h / v[LW_STEP] - 1e-9);
    if (!(count <= LW_MAX_SUBSTEPS))
        return lw_fail(self, "internal_step = %g s cuts the communication step of %g s into more than 1e9 pieces. Set a "
                       "larger one.", v[LW_STEP], h);
    long n = count < 1.0 ? 1 : (long)count;
    if (!lw_integrate(self, t, h, n, false)) {
        lw_integrate(self, t, h, n, true); /* again, to name the variable and the time */
        return false;
    }
    if (LW_N_Y) {
        if (lw_call(self, lw_output, &end, self->next, v + LW_U, self->scratch))
            return lw_fail(self, "the outputs can't be evaluated at t = %.9g s.", end);
        if (!lw_check_finite(self, self->scratch, LW_Y, LW_N_Y, end)) return false;
    }
    memcpy(v + LW_Y, self->scratch, LW_N_Y * sizeof(double));
    memcpy(v + LW_X, self->next, LW_N_X * sizeof(double));
    memcpy(v + LW_HELD, v + LW_U, LW_N_U * sizeof(double));
    v[0] = end;
    self->s.have_outputs = 1;
    self->s.have_derivatives = 0;
    return true;
}

/* ---- variables ---- */

static const lw_variable *lw_variable_at(lw_instance *self, const char *function, uint32_t reference, size_t left) {
    if (reference >= LW_N_VARIABLES) {
        lw_fail(self, "%s: there is no Float64 variable with value reference %u. modelDescription.xml lists 0 to %d.", function,
                (unsigned)reference, LW_N_VARIABLES - 1);
        return NULL;
    }
    const lw_variable *variable = &lw_variables[reference];
    if (variable->size <= left) return variable;
    lw_fail(self, "%s: %s takes %u value(s), but %zu are left. Give nValues = the sum of all sizes.", function,
            variable->name, (unsigned)variable->size, left);
    return NULL;
}

static bool lw_all_used(lw_instance *self, const char *function, const lw_variable *last, size_t left) {
    if (!left) return true;
    return lw_fail(self, "%s: %zu value(s) are left over after %s. Give nValues = the sum of all sizes.", function, left,
                   last ? last->name : "no variable");
}

static bool lw_get(lw_instance *self, const char *function, const uint32_t *references, size_t n, double *values, size_t left) {
    const lw_variable *variable = NULL;
    for (size_t i = 0; i < n; i++) {
        if (!(variable = lw_variable_at(self, function, references[i], left))) return false;
        lw_kind kind = variable->kind;
        if (self->s.mode == LW_INSTANTIATED && (kind == LW_OUTPUT || kind == LW_DERIVATIVE))
            return lw_fail(self, "%s: %s is calculated, and has no value before initialization. Call "
                           LW_API "EnterInitializationMode first.", function, variable->name);
        if (kind == LW_OUTPUT && !lw_update_outputs(self)) return false;
        if (kind == LW_DERIVATIVE && !lw_update_derivatives(self)) return false;
        memcpy(values, self->s.values + variable->first, variable->size * sizeof(double));
        values += variable->size;
        left -= variable->size;
    }
    return lw_all_used(self, function, variable, left);
}

/* May it be set now (FMI 3.0, 2.3 and 4.2)? NULL, or why not. */
static const char *lw_why_not_set(lw_mode mode, lw_kind kind) {
    if (kind == LW_TIME) return "is the independent variable; " LW_API "DoStep advances it";
    if (kind == LW_OUTPUT || kind == LW_DERIVATIVE) return "is calculated";
    if (mode == LW_TERMINATED) return "can't be set in state Terminated; reset the FMU, or set an FMU state first";
    if (mode != LW_STEPPING) return NULL;
    if (kind == LW_FIXED) return "is a fixed parameter; set it before " LW_API "ExitInitializationMode";
    if (kind == LW_STATE) return "is a state; set its start value before " LW_API "ExitInitializationMode";
    return NULL;
}

static bool lw_check_set(lw_instance *self, const char *function, const lw_variable *variable, const double *values) {
    const char *why = lw_why_not_set((lw_mode)self->s.mode, variable->kind);
    if (why) return lw_fail(self, "%s: %s %s (t = %.9g s).", function, variable->name, why, self->s.values[0]);
    for (uint32_t k = 0; k < variable->size; k++) {
        if (!isfinite(values[k]))
            return lw_fail(self, "%s: %s (element %u) was set to %g at t = %.9g s, expected a finite number. Check what "
                           "computes it.", function, variable->name, (unsigned)k, values[k], self->s.values[0]);
        if (values[k] < variable->min || values[k] > variable->max)
            return lw_fail(self, "%s: %s (element %u) was set to %g at t = %.9g s, expected a value from %g to %g.", function,
                           variable->name, (unsigned)k, values[k], self->s.values[0], variable->min, variable->max);
        if (variable->first == LW_STEP && !(values[k] > 0))
            return lw_fail(self, "%s: internal_step was set to %g s, expected a positive number.", function, values[k]);
    }
    return true;
}

static bool lw_set(lw_instance *self, const char *function, const uint32_t *references, size_t n, const double *values, size_t left) {
    const lw_variable *variable = NULL;
    for (size_t i = 0; i < n; i++) {
        if (!(variable = lw_variable_at(self, function, references[i], left))) return false;
        if (!lw_check_set(self, function, variable, values)) return false;
        /* In Step Mode, what is read until the next step belongs to the end of the last one. */
        if (self->s.mode == LW_STEPPING && variable->kind == LW_TUNABLE && !lw_update_derivatives(self)) return false;
        memcpy(self->s.values + variable->first, values, variable->size * sizeof(double));
        if (self->s.mode != LW_STEPPING) {
            self->s.have_outputs = self->s.have_derivatives = 0;
            memcpy(self->s.values + LW_HELD, self->s.values + LW_U, LW_N_U * sizeof(double));
        }
        values += variable->size;
        left -= variable->size;
    }
    return lw_all_used(self, function, variable, left);
}

/* ---- derivatives: of outputs and state derivatives, by the knowns, at the current values ---- */

#if LW_HAS_DERIVATIVES
static bool lw_check_unknown(lw_instance *self, const char *function, const lw_variable *variable) {
    if (variable->is_output || variable->kind == LW_DERIVATIVE) return true;
    return lw_fail(self, "%s: %s is no unknown. Ask for outputs and derivatives of states.", function, variable->name);
}

static bool lw_check_known(lw_instance *self, const char *function, const lw_variable *variable) {
    bool initializing = self->s.mode == LW_INITIALIZING;
    lw_kind kind = variable->kind;
    if (kind == LW_TIME || kind == LW_INPUT || kind == LW_STATE || kind == LW_TUNABLE || (kind == LW_FIXED && initializing)) return true;
    return lw_fail(self, "%s: %s is no known in %s. Give inputs, states, tunable parameters or time%s.", function,
                   variable->name, lw_mode_names[self->s.mode], initializing ? ", or fixed parameters" : "");
}

/* Go over n references, moving their elements between `values` and the interval of each in `table`. */
static bool lw_transfer(lw_instance *self, const char *function, const uint32_t *references, size_t n, bool unknowns,
                        const double *from, double *to, double *table, size_t left) {
    const lw_variable *variable = NULL;
    for (size_t i = 0; i < n; i++) {
        if (!(variable = lw_variable_at(self, function, references[i], left))) return false;
        if (!(unknowns ? lw_check_unknown : lw_check_known)(self, function, variable)) return false;
        for (uint32_t k = 0; k < variable->size; k++) {
            if (from) table[variable->first + k] += *from++;
            else *to++ = table[variable->first + k];
        }
        left -= variable->size;
    }
    return lw_all_used(self, function, variable, left);
}

static bool lw_derive(lw_instance *self, const char *function, bool adjoint, const uint32_t *unknowns, size_t n_unknowns,
                      const uint32_t *knowns, size_t n_knowns, const double *seed, size_t n_seed, double *sensitivity,
                      size_t n_sensitivity) {
    double *in = self->seed, *out = self->sensitivity;
    size_t n_in = adjoint ? n_unknowns : n_knowns, n_out = adjoint ? n_knowns : n_unknowns;
    if (self->s.mode != LW_INITIALIZING && self->s.mode != LW_STEPPING)
        return lw_in_mode(self, function, LW_STEPPING);
    memset(in, 0, sizeof self->seed);
    if (!lw_transfer(self, function, adjoint ? unknowns : knowns, n_in, adjoint, seed, NULL, in, n_seed)) return false;
    memcpy(out, in, sizeof self->seed); /* a state that is an output depends on itself */
    if (!adjoint) memset(out + LW_DX, 0, (LW_N_X + LW_N_Y) * sizeof(double));
    self->arg[0] = self->s.values;
    self->arg[1] = adjoint ? in + LW_DX : in;
    self->res[0] = self->scratch;
    if ((adjoint ? lw_reverse : lw_forward)(self->arg, self->res, self->iw, self->w, 0))
        return lw_fail(self, "%s: the derivatives can't be evaluated at t = %.9g s.", function, self->s.values[0]);
    size_t first = adjoint ? 0 : LW_DX, n = adjoint ? LW_DX : LW_N_X + LW_N_Y;
    for (size_t i = 0; i < n; i++) out[first + i] += self->scratch[i];
    return lw_transfer(self, function, adjoint ? knowns : unknowns, n_out, !adjoint, NULL, sensitivity, out, n_sensitivity);
}
#endif

/* ---- life ---- */

static void lw_reset(lw_instance *self) {
    memset(&self->s, 0, sizeof self->s);
    self->s.magic = LW_MAGIC;
    self->s.mode = LW_INSTANTIATED;
    memcpy(self->s.values, lw_start_values, sizeof lw_start_values);
    memcpy(self->s.values + LW_HELD, self->s.values + LW_U, LW_N_U * sizeof(double));
}

static lw_instance *lw_create(const char *name, size_t length) {
    lw_instance *self = calloc(1, sizeof *self);
    if (!self) return NULL;
    if (!(self->name = malloc(length + 1))) {
        free(self);
        return NULL;
    }
    memcpy(self->name, name, length);
    self->name[length] = 0;
    lw_reset(self);
    return self;
}

static void lw_destroy(lw_instance *self) {
    if (!self) return;
    free(self->name);
    free(self);
}

/* A state from outside: is it one of this very FMU? */
static bool lw_accept_state(lw_instance *self, const char *function, const lw_state *state) {
    if (state->magic == LW_MAGIC && state->mode >= LW_INSTANTIATED && state->mode <= LW_TERMINATED) {
        self->s = *state;
        return true;
    }
    return lw_fail(self, "%s: this is no state of this FMU. Give one that it has made itself.", function);
}
