/* Common to all FMI versions: logging, variables, equations, derivatives, modes, states.
 *
 * Functions return true on success. Otherwise they have logged the reason, and the instance is terminated until it is
 * reset or a state is restored (in FMI, a function that returns an error leads to Terminated).
 */
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if !LW_LOOP
#include "linear.c"
#endif

#define LW_MAGIC UINT64_C(0x4c57303032464d55)
#define LW_MIN_TOLERANCE 1e-14
#define LW_MAX_TOLERANCE 1e-1

/* ---- logging ---- */

static void lw_write_log(lw_instance *self, lw_category category, const char *format, va_list args) {
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
    lw_write_log(self, LW_LOG_WARNING, format, args);
    va_end(args);
}

static bool lw_fail(lw_instance *self, const char *format, ...) {
    va_list args;
    va_start(args, format);
    lw_write_log(self, LW_LOG_ERROR, format, args);
    va_end(args);
    self->s.mode = LW_TERMINATED;
    return false;
}

static const char *const lw_mode_names[] = {"Instantiated", "Initialization Mode", "Step Mode", "Event Mode",
                                            "Continuous-Time Mode", "Terminated", "Intermediate Update Mode"};

static bool lw_in_mode(lw_instance *self, const char *function, lw_mode expected) {
    if (self->s.mode == (int32_t)expected) return true;
    return lw_fail(self, "%s was called in state %s, expected %s. Call the functions in the order of " LW_ORDER
                   ", or reset the FMU.", function, lw_mode_names[self->s.mode], lw_mode_names[expected]);
}

/* Was the call given room for its result? */
static bool lw_has_room(lw_instance *self, const char *function, const void *room) {
    return room || lw_fail(self, "%s: the pointer to the result is NULL. Give one.", function);
}

/* Are there as many value references, and as many values, as the call says? */
static bool lw_has_lists(lw_instance *self, const char *function, const void *references, size_t n, const void *values, size_t size) {
    if ((references || !n) && (values || !size)) return true;
    return lw_fail(self, "%s: the pointer to the %s is NULL. Give %zu, or 0 as their number.", function,
                   references || !n ? "values" : "value references", references || !n ? size : n);
}

/* May values be read: once initialization has begun, also in Terminated (FMI 3.0, 2.3.8; FMI 2.0, 3.2.3)? */
static bool lw_is_readable(lw_instance *self) {
    return self->s.mode == LW_INITIALIZING || self->s.mode == LW_TERMINATED;
}

/* Is it in one of Step Mode, Event Mode, Continuous-Time Mode? */
static bool lw_is_initialized(lw_instance *self, const char *function) {
    if (self->s.mode > LW_INITIALIZING && self->s.mode < LW_TERMINATED) return true;
    return lw_in_mode(self, function, self->s.model_exchange ? LW_CONTINUOUS : LW_STEPPING);
}

/* ---- equations ---- */

/* Are values[0 .. n), those from index `first` on, finite? If not, log the element and the time. */
static bool lw_check_finite(lw_instance *self, const double *values, size_t first, size_t n, double t) {
    if (lw_are_finite(values, (int64_t)n)) return true;
    size_t i = 0, v = 0;
    while (isfinite(values[i])) i++;
    while (first + i >= (size_t)lw_variables[v].first + lw_variables[v].size) v++;
    return lw_fail(self, "%s (element %zu) became %g at t = %.9g s, expected a finite number. Check the inputs and "
                   "parameters; a stiff model needs a smaller internal_step, or integrator = 3.", lw_variables[v].name,
                   first + i - lw_variables[v].first, values[i], t);
}

#if LW_LOOP
static bool lw_update_outputs(lw_instance *self);
static bool lw_update_derivatives(lw_instance *self);
#if LW_HAS_DERIVATIVES
static bool lw_product(lw_instance *self, bool adjoint, const double *seed, double *found);
#endif
static bool lw_update_indicators(lw_instance *self) { return (void)self, true; }
#else
/* The inputs at t: u, held over the step, or if u is NULL those that move by their derivatives since its start. */
static inline const double *lw_inputs(lw_instance *self, const double *u, double t) {
#if LW_MOVING_INPUTS
    if (!u) {
        const double since = t - self->step_start;
        for (int i = 0; i < LW_N_U; i++) {
            double sum = 0.0;
            for (int k = LW_MAX_ORDER; k > 0; k--) sum = since / k * (self->s.slopes[k - 1][i] + sum);
            self->inputs[i] = self->s.values[LW_U + i] + sum;
        }
        return self->inputs;
    }
#else
    (void)self, (void)t;
#endif
    return u;
}

/* The argument u within a step. */
static inline const double *lw_inputs_of_step(const lw_instance *self) {
#if LW_MOVING_INPUTS
    if (self->s.moving) return NULL;
#endif
    return self->s.values + LW_U;
}

static inline int lw_call(lw_instance *self, lw_function *f, const double *t, const double *x, const double *u, double *out) {
    self->arg[0] = t;
    self->arg[1] = x;
    self->arg[2] = lw_inputs(self, u, *t);
    self->arg[3] = self->s.values + LW_P;
    self->res[0] = out;
    return f(self->arg, self->res, self->iw, self->w, 0);
}

/* Outputs and derivatives at the last communication point, with the inputs held until then. */
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

/* lw_derivative may be declared always_inline, which no call through a pointer can be. */
static int lw_derivative_called(const double **arg, double **res, long long int *iw, double *w, int mem) {
    return lw_derivative(arg, res, iw, w, mem);
}

static bool lw_update_derivatives(lw_instance *self) {
    return lw_update(self, &self->s.have_derivatives, lw_derivative_called, LW_DX, LW_N_X);
}

#if LW_N_Z
/* The importer sees z with a hysteresis around 0. It stops near the crossing, on either side. The jump must then happen
 * once, and no indicator may be 0 when it restarts (FMI 3.0, 3.2.1; FMI 2.0.5, 3.2.2). */
#define LW_HYSTERESIS 1e-10

static bool lw_update_indicators(lw_instance *self) {
    uint8_t have = self->s.have_indicators;
    if (!lw_update(self, &self->s.have_indicators, lw_indicator, LW_Z, LW_N_Z)) return false;
    const lw_event_memory *events = &self->s.events;
    for (size_t i = 0; i < LW_N_Z && !have; i++) {
        const bool border = events->domain[i] == LW_BORDER, above = border ? events->lean[i] : events->domain[i] == LW_ABOVE;
        self->s.values[LW_Z + i] += (above ? LW_HYSTERESIS : -LW_HYSTERESIS) * lw_events[i].nominal;
        if (border) self->s.values[LW_Z + i] -= events->level[i];
    }
    return true;
}
#else
static bool lw_update_indicators(lw_instance *self) {
    (void)self;
    return true;
}
#endif
#endif

/* Mark outputs, derivatives and event indicators as out of date. */
static void lw_changed(lw_instance *self) {
    self->s.have_outputs = self->s.have_derivatives = self->s.have_indicators = 0;
    memcpy(self->s.values + LW_HELD, self->s.values + LW_U, LW_N_U * sizeof(double));
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
    if (!lw_has_lists(self, function, references, n, values, left)) return false;
    for (size_t i = 0; i < n; i++) {
        if (!(variable = lw_variable_at(self, function, references[i], left))) return false;
        lw_kind kind = variable->kind;
        if (self->s.mode == LW_INSTANTIATED && kind >= LW_DERIVATIVE)
            return lw_fail(self, "%s: %s is calculated, and has no value before initialization. Call "
                           LW_API "EnterInitializationMode first.", function, variable->name);
        if (kind == LW_OUTPUT && !lw_update_outputs(self)) return false;
        if (kind == LW_DERIVATIVE && !lw_update_derivatives(self)) return false;
        if (kind == LW_INDICATOR && !lw_update_indicators(self)) return false;
        memcpy(values, self->s.values + variable->first, variable->size * sizeof(double));
        values += variable->size;
        left -= variable->size;
    }
    return lw_all_used(self, function, variable, left);
}

/* May the variable be set now (FMI 3.0, 2.3, 3.2 and 4.2; FMI 2.0.5, 3.2.3 and 4.2.4)? NULL, or the reason. */
static const char *lw_why_not_set(lw_instance *self, const lw_variable *variable) {
    lw_mode mode = (lw_mode)self->s.mode;
    lw_kind kind = variable->kind;
    if (kind == LW_TIME && self->s.model_exchange) return "is the independent variable; " LW_API "SetTime sets it";
    if (kind == LW_TIME) return "is the independent variable; " LW_API "DoStep advances it";
    if (kind >= LW_DERIVATIVE) return "is calculated";
    if (mode == LW_TERMINATED) return "can't be set in state Terminated; reset the FMU, or set an FMU state first";
    if (mode == LW_INSTANTIATED || mode == LW_INITIALIZING) return NULL;
    if (kind == LW_FIXED) return "is a fixed parameter; set it before " LW_API "ExitInitializationMode";
    if (kind == LW_STATE && (mode == LW_EVENT || mode == LW_CONTINUOUS) && self->s.model_exchange)
        return NULL; /* some importers of Model Exchange set states as variables, which equals SetContinuousStates */
    if (kind == LW_STATE || kind == LW_DISCRETE) return "is a state; set its start value before " LW_API "ExitInitializationMode";
    if (mode == LW_INTERMEDIATE && kind == LW_TUNABLE) return "is a tunable parameter; set it between two steps";
    if (mode == LW_INTERMEDIATE && variable->is_discrete) return "is a discrete input; set it between two steps";
    if (mode == LW_CONTINUOUS && kind == LW_TUNABLE) return "is a tunable parameter; set it in Event Mode";
    if (mode == LW_CONTINUOUS && variable->is_discrete) return "is a discrete input; set it in Event Mode";
    return NULL;
}

static bool lw_check_set(lw_instance *self, const char *function, const lw_variable *variable, const double *values) {
    const char *why = lw_why_not_set(self, variable);
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
        if (variable->first == LW_INTEGRATOR && values[k] != LW_RK4 && values[k] != LW_DOPRI5 && values[k] != LW_RODAS)
            return lw_fail(self, "%s: integrator was set to %g, expected 1 (rk4), 2 (dopri5) or 3 (rodas).", function, values[k]);
        if (variable->first == LW_INTEGRATOR && values[k] == LW_RODAS && !LW_HAS_DERIVATIVES)
            return lw_fail(self, "%s: integrator was set to 3 (rodas), but these equations have no derivatives. Set 1 or 2.", function);
    }
    return true;
}

static bool lw_set(lw_instance *self, const char *function, const uint32_t *references, size_t n, const double *values, size_t left) {
    const lw_variable *variable = NULL;
    if (!lw_has_lists(self, function, references, n, values, left)) return false;
    for (size_t i = 0; i < n; i++) {
        if (!(variable = lw_variable_at(self, function, references[i], left))) return false;
        if (!lw_check_set(self, function, variable, values)) return false;
        if (self->s.mode == LW_STEPPING && variable->kind == LW_TUNABLE) {
            /* In Step Mode, values that are read until the next step belong to the end of the last one. */
            if (!lw_update_derivatives(self) || !lw_update_indicators(self)) return false;
            self->s.step_size = 0.0;
        }
        memcpy(self->s.values + variable->first, values, variable->size * sizeof(double));
        if (self->s.mode != LW_STEPPING && self->s.mode != LW_INTERMEDIATE) lw_changed(self);
        if (variable->first == LW_TOLERANCE) self->s.tolerance_given = 1;
        values += variable->size;
        left -= variable->size;
    }
    return lw_all_used(self, function, variable, left);
}

/* Model Exchange: the importer sets time and continuous states. The stop time is no bound: solvers evaluate beyond it. */
static inline bool lw_set_time(lw_instance *self, const char *function, double t) {
    if (!isfinite(t)) return lw_fail(self, "%s: time was set to %g s, expected a finite number.", function, t);
    if (t == self->s.values[0]) return true;
    self->s.values[0] = t;
    lw_changed(self);
    return true;
}

static inline bool lw_set_states(lw_instance *self, const char *function, const double *x) {
    if (!lw_in_mode(self, function, LW_CONTINUOUS) || !lw_check_finite(self, x, LW_X, LW_N_X, self->s.values[0])) return false;
    if (LW_N_X) memcpy(self->s.values + LW_X, x, LW_N_X * sizeof(double));
    lw_changed(self);
    return true;
}

/* ---- derivatives: of outputs and state derivatives, by the knowns, at the current values ---- */

#if LW_HAS_DERIVATIVES
static bool lw_check_unknown(lw_instance *self, const char *function, const lw_variable *variable) {
    if (variable->is_output || variable->kind == LW_DERIVATIVE || variable->kind == LW_INDICATOR) return true;
    return lw_fail(self, "%s: %s is no unknown. Ask for outputs and derivatives of states.", function, variable->name);
}

static bool lw_check_known(lw_instance *self, const char *function, const lw_variable *variable) {
    bool initializing = self->s.mode == LW_INITIALIZING;
    lw_kind kind = variable->kind;
    if (kind == LW_TIME || kind == LW_INPUT || kind == LW_STATE || kind == LW_TUNABLE) return true;
    if ((initializing || LW_LOOP) && (kind == LW_FIXED || kind == LW_DISCRETE)) return true;
    return lw_fail(self, "%s: %s is no known in %s. Give inputs, states, tunable parameters or time%s.", function,
                   variable->name, lw_mode_names[self->s.mode], initializing ? ", or fixed parameters" : "");
}

/* Copy the elements of n references between `values` and the interval of each in `table`. */
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

#if !LW_LOOP
/* The product of the Jacobian, or its transpose, with a seed in the order of the values. */
static bool lw_product(lw_instance *self, bool adjoint, const double *seed, double *found) {
    self->arg[0] = self->s.values;
    self->arg[1] = adjoint ? seed + LW_DX : seed;
    self->res[0] = found;
    return !(adjoint ? lw_reverse : lw_forward)(self->arg, self->res, self->iw, self->w, 0);
}
#endif

static bool lw_derive(lw_instance *self, const char *function, bool adjoint, const uint32_t *unknowns, size_t n_unknowns,
                      const uint32_t *knowns, size_t n_knowns, const double *seed, size_t n_seed, double *sensitivity,
                      size_t n_sensitivity) {
    double *in = self->seed, *out = self->sensitivity;
    size_t n_in = adjoint ? n_unknowns : n_knowns, n_out = adjoint ? n_knowns : n_unknowns;
    bool between = self->s.mode == LW_INITIALIZING || self->s.mode == LW_INTERMEDIATE;
    if (!between && !lw_is_initialized(self, function)) return false;
    if (!lw_has_lists(self, function, unknowns, n_unknowns, sensitivity, n_sensitivity)) return false;
    if (!lw_has_lists(self, function, knowns, n_knowns, seed, n_seed)) return false;
    memset(in, 0, sizeof self->seed);
    if (!lw_transfer(self, function, adjoint ? unknowns : knowns, n_in, adjoint, seed, NULL, in, n_seed)) return false;
    memcpy(out, in, sizeof self->seed); /* a state that is an output depends on itself */
    if (!adjoint) memset(out + LW_DX, 0, LW_N_UNKNOWNS * sizeof(double));
    if (!lw_product(self, adjoint, in, self->scratch))
        return lw_fail(self, "%s: the derivatives can't be evaluated at t = %.9g s.", function, self->s.values[0]);
    size_t first = adjoint ? 0 : LW_DX, n = adjoint ? LW_DX : LW_N_UNKNOWNS;
    for (size_t i = 0; i < n; i++) out[first + i] += self->scratch[i];
    return lw_transfer(self, function, adjoint ? knowns : unknowns, n_out, !adjoint, NULL, sensitivity, out, n_sensitivity);
}
#endif

/* ---- life ---- */

static void lw_reset(lw_instance *self) {
    uint8_t model_exchange = self->s.model_exchange;
    memset(&self->s, 0, sizeof self->s);
    self->s.magic = LW_MAGIC;
    self->s.mode = LW_INSTANTIATED;
    self->s.model_exchange = model_exchange;
    memcpy(self->s.values, lw_start_values, sizeof lw_start_values);
#if LW_LOOP
    lw_fill(&self->s.memory);
    lw_bind(&self->s.memory);
#endif
    lw_changed(self);
}

#if !LW_MERGED
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
    free(self->matrix);
    free(self->before);
    free(self->name);
    free(self);
}

/* ---- saved states ---- */

/* Serialized: the token, then the state as it is in memory (same machine type), then its checksum. */
#define LW_SERIALIZED (sizeof LW_TOKEN + sizeof(lw_state) + sizeof(uint64_t))

/* FNV-1a, 64 bits. */
static uint64_t lw_checksum(const void *bytes, size_t size) {
    uint64_t sum = 14695981039346656037u;
    for (size_t i = 0; i < size; i++) sum = (sum ^ ((const unsigned char *)bytes)[i]) * 1099511628211u;
    return sum;
}

static bool lw_between_steps(lw_instance *self, const char *function) {
    if (self->s.mode != LW_INTERMEDIATE) return true;
    return lw_fail(self, "%s was called in Intermediate Update Mode. Call it when the step has ended.", function);
}

/* Copy `from` to *state, which is allocated if it is NULL. */
static bool lw_copy_state(lw_instance *self, const char *function, const void *from, void **state) {
    lw_state *copy = *state ? *state : malloc(sizeof *copy);
    if (!copy) return lw_fail(self, "%s: out of memory.", function);
    memcpy(copy, from, sizeof *copy);
#if LW_LOOP
    lw_unbind(&copy->memory); /* its pointers lead into an instance */
#endif
    *state = copy;
    return true;
}

static bool lw_get_state(lw_instance *self, const char *function, void **state) {
    return lw_has_room(self, function, state) && lw_between_steps(self, function)
           && lw_copy_state(self, function, &self->s, state);
}

/* Does a state from outside belong to this FMU, and to this interface type? */
static bool lw_accept_state(lw_instance *self, const char *function, const lw_state *state) {
    if (!state) return lw_fail(self, "%s: the state is NULL. Get one first.", function);
    if (state->magic != LW_MAGIC || state->mode < LW_INSTANTIATED || state->mode > LW_TERMINATED)
        return lw_fail(self, "%s: this is no state of this FMU. Give one that it has made itself.", function);
    if (!lw_between_steps(self, function)) return false;
    if (state->model_exchange != self->s.model_exchange)
        return lw_fail(self, "%s: this is the state of a %s instance. Give one of the same interface type.", function,
                       state->model_exchange ? "Model Exchange" : "Co-Simulation");
    self->s = *state;
#if LW_LOOP
    lw_bind(&self->s.memory);
#endif
    return true;
}

static bool lw_serialize_state(lw_instance *self, const char *function, const lw_state *state, void *bytes, size_t size) {
    if (!state || !bytes || size < LW_SERIALIZED)
        return lw_fail(self, "%s: %s. Ask for the size of the serialized state first.", function,
                       !state ? "the state is NULL" : bytes ? "too few bytes" : "there are no bytes to write to");
    const uint64_t sum = lw_checksum(state, sizeof *state);
    memcpy(bytes, LW_TOKEN, sizeof LW_TOKEN);
    memcpy((char *)bytes + sizeof LW_TOKEN, state, sizeof *state);
    memcpy((char *)bytes + sizeof LW_TOKEN + sizeof *state, &sum, sizeof sum);
    return true;
}

static bool lw_deserialize_state(lw_instance *self, const char *function, const void *bytes, size_t size, void **state) {
    void *fresh = NULL; /* *state may be anything: only an output here */
    uint64_t sum;
    if (!lw_has_room(self, function, state)) return false;
    if (!bytes || size != LW_SERIALIZED || memcmp(bytes, LW_TOKEN, sizeof LW_TOKEN))
        return lw_fail(self, "%s: these %zu bytes are no state of this FMU (%zu bytes that begin with its "
                       "token). Give what it has serialized itself.", function, size, LW_SERIALIZED);
    memcpy(&sum, (const char *)bytes + size - sizeof sum, sizeof sum);
    if (sum != lw_checksum((const char *)bytes + sizeof LW_TOKEN, sizeof(lw_state)))
        return lw_fail(self, "%s: the checksum of these bytes is wrong: they have changed since they were serialized. Give the "
                       "bytes as they were.", function);
    if (!lw_copy_state(self, function, (const char *)bytes + sizeof LW_TOKEN, &fresh)) return false;
    *state = fresh;
    return true;
}

#endif

/* ---- initialization ---- */

static inline bool lw_initialize(lw_instance *self, const char *function, double start, bool stop_defined, double stop) {
    if (!lw_in_mode(self, function, LW_INSTANTIATED)) return false;
    if (!isfinite(start) || (stop_defined && !(stop >= start)))
        return lw_fail(self, "%s: startTime is %g s, stopTime is %g s, expected finite times in this order.", function, start, stop);
    self->s.values[0] = start;
    self->s.stop_time_defined = stop_defined;
    self->s.stop_time = stop_defined ? stop : 0.0;
    self->s.mode = LW_INITIALIZING;
    lw_changed(self);
    return true;
}

/* The relative tolerance that the importer asks for, unless the parameter has been set. */
static inline void lw_suggest_tolerance(lw_instance *self, double tolerance) {
    if (isfinite(tolerance) && tolerance > 0.0 && !self->s.tolerance_given)
        self->s.values[LW_TOLERANCE] = fmin(fmax(tolerance, LW_MIN_TOLERANCE), LW_MAX_TOLERANCE);
}

#if LW_N_Z
static bool lw_start_domains(lw_instance *self);
#endif

#if LW_HAS_DERIVATIVES && LW_N_X && !LW_LOOP
#define LW_COARSE 0.5      /* steps of rk4 in time constants of the fastest mode: above, it is off by 5e-4 of that mode in each */
#define LW_ITERATIONS 64   /* of the power method, whose growth in the second half is the size of the largest eigenvalue */

/* Warn if rk4's step is coarse beside the fastest mode at the values of the instance. */
static void lw_compare_step(lw_instance *self) {
    const double *v = self->s.values;
    LW_SCRATCH(x);
    LW_SCRATCH(stage);
    double growth = 0.0;
    if (self->s.model_exchange || v[LW_INTEGRATOR] != LW_RK4) return;
    self->arg[0] = v;
    self->arg[1] = v + LW_X;
    self->arg[2] = v + LW_U;
    self->arg[3] = v + LW_P;
    self->res[0] = self->jacobian;
    self->res[1] = self->slope;
    if (lw_jacobian(self->arg, self->res, self->iw, self->w, 0) || !lw_are_finite(self->jacobian, LW_N_J)) return;
    for (int i = 0; i < LW_N_X; i++) x[i] = 1.0 + 0.37 * ((i * 7) % 11);
    for (int k = 0; k < LW_ITERATIONS; k++) {
        double size = 0.0;
        for (int i = 0; i < LW_N_X; i++) stage[i] = 0.0;
        for (int j = 0; j < LW_N_J; j++) stage[lw_jacobian_rows[j]] += self->jacobian[j] * x[lw_jacobian_columns[j]];
        for (int i = 0; i < LW_N_X; i++) size = fmax(size, fabs(stage[i]));
        if (!(size > 0.0) || !isfinite(size)) return;
        for (int i = 0; i < LW_N_X; i++) x[i] = stage[i] / size;
        if (k >= LW_ITERATIONS / 2) growth += log(size);
    }
    const double fastest = exp(growth / (LW_ITERATIONS / 2));
    if (fastest * v[LW_STEP] > LW_COARSE)
        lw_warn(self, "internal_step = %.3g s is coarse beside the fastest mode at t = %.9g s, about %.2g 1/s: set it to %.1g s, or "
                "integrator = 3.", v[LW_STEP], v[0], fastest, 0.1 / fastest);
}
#endif

/* Enter `next`: Step Mode, or Event Mode if it is used. */
static inline bool lw_start(lw_instance *self, const char *function, lw_mode next) {
    if (!lw_in_mode(self, function, LW_INITIALIZING) || !lw_update_outputs(self)) return false;
#if LW_N_Z
    if (!lw_start_domains(self)) return false;
#endif
    self->s.begun = 1;
#if LW_HAS_DERIVATIVES && LW_N_X && !LW_LOOP
    lw_compare_step(self);
#endif
    self->s.mode = next;
    return true;
}
