/* Communication step: the chosen integrator, with its step size and its events. */
#define LW_MAX_STEPS 10000000
#define LW_PIECES 4 /* of an adaptive step, each searched for events */

#define LW_SAME_INPUT 1e-12 /* an input that has moved to a value and is then set to it is equal but for rounding */

/* Have the inputs jumped since the last step? Then an adaptive integrator starts again. */
static inline bool lw_inputs_jumped(const lw_instance *self) {
    const double *v = self->s.values;
#if LW_MOVING_INPUTS
    for (int i = 0; i < LW_N_U && self->s.moved; i++) {
        double now = v[LW_U + i], last = v[LW_HELD + i];
        if (fabs(now - last) > LW_SAME_INPUT * (fabs(now) + fabs(last))) return true;
    }
    if (self->s.moved) return false;
#endif
    return memcmp(v + LW_U, v + LW_HELD, LW_N_U * sizeof(double)) != 0;
}

static bool lw_step_too_small(lw_instance *self, double t, double h) {
    int worst = 0;
    double largest = -1.0;
    const lw_equation e = lw_equation_of(self, lw_inputs_of_step(self));
    const lw_tolerance tolerance = lw_tolerance_of(self);
    lw_rate(&e, t, self->x, self->k);
    for (int i = 0; i < LW_N_X; i++) {
        double change = fabs(self->k[i]) / lw_scale(&tolerance, i, self->x[i], self->x[i]);
        if (!isfinite(change)) change = INFINITY;
        if (change > largest) largest = change, worst = i;
    }
    size_t v = 0;
    while ((size_t)LW_X + worst >= (size_t)lw_variables[v].first + lw_variables[v].size) v++;
    return lw_fail(self, "the integrator can't continue at t = %.9g s: its step fell to %.3g s; %s (element %zu), now %.9g, changes "
                   "the most. Is there a solution beyond? Else check the inputs and parameters, or set a larger tolerance.",
                   t, h, lw_variables[v].name, (size_t)(LW_X + worst) - lw_variables[v].first, self->x[worst]);
}

/* Steps within a communication step: values that are kept from one to the next. */
typedef struct {
    lw_integrator integrator;
    double end;     /* end of the communication step, or the earlier time at which it must end */
    double segment; /* rk4: begin of the equal substeps, since the last event */
    double length;  /* rk4: length of all substeps */
    long n, i;      /* rk4: number of substeps, and of those done */
    long events;    /* that have fired */
    bool fresh;     /* after a jump: slope and step size must be found again */
    bool rejected;
} lw_run;

/* An accepted step of an adaptive integrator from self->x at t, into self->next; it ends at `to`. */
static inline bool lw_adaptive_step(lw_instance *self, lw_run *run, double t, double *to) {
    const double *u = lw_inputs_of_step(self);
    const bool implicit = run->integrator == LW_RODAS;
    const double order = implicit ? 3.0 : 4.0, left = run->end - t; /* of the estimate of the error */
    const lw_equation e = lw_equation_of(self, u);
    const double shortest = 16.0 * 2.3e-16 * fmax(fabs(t), fabs(run->end));
    if ((run->fresh || implicit) && lw_rate(&e, t, self->x, self->k))
        return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", t);
    if (run->fresh && !lw_check_finite(self, self->k, LW_DX, LW_N_X, t)) return false;
#if LW_HAS_DERIVATIVES
    if (implicit && (lw_linearize(self, t, u) || !lw_are_finite(self->jacobian, LW_N_J) || !lw_are_finite(self->slope, LW_N_X)))
        return lw_fail(self, "the Jacobian can't be evaluated at t = %.9g s. Set integrator = 1 or 2.", t);
#endif
    /* With an intermediate update, internal_step bounds the time between two requests for inputs. */
    const double longest = self->update ? self->s.values[LW_STEP] : INFINITY;
    double h = self->s.step_size;
    if (run->fresh && !(h > 0.0)) {
        const lw_tolerance tolerance = lw_tolerance_of(self);
        memcpy(self->stage, self->x, LW_N_S * sizeof(double));
        h = lw_first_step(&e, LW_N_X, implicit ? 4.0 : 5.0, &tolerance, t, left, INFINITY, self->x, self->k, self->k2, self->stage,
                          self->k3);
    }
    h = fmin(h, longest);
    run->fresh = run->rejected = false;
    for (;;) {
        bool last = h >= left * (1.0 - 1e-10);
        double used = last ? left : h, error;
        if (!last && h < shortest) return lw_step_too_small(self, t, h);
#if LW_HAS_DERIVATIVES
        error = implicit ? lw_rodas_step(self, t, used, u) : lw_dopri5_step(self, t, used, u);
#else
        error = lw_dopri5_step(self, t, used, u);
#endif
        if (error < 1.0) {
            const double next = used * lw_growth(error, order, run->rejected ? 1.0 : 5.0);
            self->s.step_size = last ? fmax(h, next) : next; /* a step that a communication point cuts says little */
            *to = last ? run->end : t + used;
            return true;
        }
        h = used * lw_shrinkage(error, order);
        run->rejected = true;
    }
}

/* The next step from self->x at t into self->next. */
static bool lw_next_step(lw_instance *self, lw_run *run, double t, double *to) {
#if LW_N_X
    if (run->integrator != LW_RK4) return lw_adaptive_step(self, run, t, to);
#endif
    if (run->fresh) {
        if (t != run->segment || LW_N_Z > 0) run->length = run->end - t;
        run->segment = t;
        run->i = 0;
        run->n = lw_substeps(self, run->length);
        run->fresh = false;
        if (run->n < 0) return false;
    }
    run->i++;
    *to = run->i == run->n ? run->end : run->segment + run->length * ((double)run->i / (double)run->n);
    /* without events as long as in lw_integrate, so that watching the step changes no bit */
    if (lw_rk4_dense_step(self, t, LW_N_Z ? *to - t : run->length / (double)run->n, lw_inputs_of_step(self)))
        return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", *to);
    return !LW_N_X || lw_check_finite(self, self->next, LW_X, LW_N_X, *to);
}

/* ---- intermediate update ---- */

/* Within a step, the values of the instance become those at t. Outputs and derivatives are computed when asked for. */
static void lw_publish(lw_instance *self, double t) {
    double *v = self->s.values;
    v[0] = t;
    memcpy(v + LW_X, self->next, LW_N_S * sizeof(double));
    lw_changed(self);
}

/* Ask the importer at t, the end of an accepted internal step (FMI 3.0, 4.2.2). It may read all variables, set continuous
 * inputs (held from t on; outputs still belong to the inputs before), and end the step early: `leave`, or run->end moves. */
static bool lw_intermediate_update(lw_instance *self, lw_run *run, double t, bool *leave) {
    const bool can_return_early = self->early_return_allowed && t < run->end;
    double until = t;
    lw_publish(self, t);
    self->s.mode = LW_INTERMEDIATE;
    bool wanted = self->update(self, t, can_return_early, &until);
    if (self->s.mode == LW_TERMINATED) return false; /* the refused call has logged the reason */
    if (self->s.mode != LW_INTERMEDIATE)
        return lw_fail(self, "the intermediate update at t = %.9g s has left its mode, as by a reset. Get and set variables "
                       "in it, nothing else.", t);
    self->s.mode = LW_STEPPING;
    *leave = can_return_early && wanted && !(until > t);
    if (can_return_early && wanted && until > t && until < run->end) {
        run->end = until;
        if (run->integrator == LW_RK4 || !LW_N_X) run->fresh = true;
    }
    return true;
}

/* ---- a communication step ---- */

#if LW_N_Z
/* Inputs may have jumped at t; events that fire by that come first. `event` is true if they are left to Event Mode. */
static bool lw_meet_inputs(lw_instance *self, double t, const double *u, bool *event) {
    double z[LW_N_Z], fired[LW_N_Z];
    bool any;
    if (!lw_find_fired(self, t, self->x, u, z, fired, &any)) return false;
    *event = any && self->event_mode_used && self->early_return_allowed;
    if (*event) return true;
    if (!lw_iterate(self, t, self->x, u, &any)) return false;
    if (any) self->s.step_size = 0.0;
    memcpy(self->next, self->x, LW_N_S * sizeof(double));
    return true;
}

/* Let events fire at t, the first time in a step at which an indicator leaves its domain; the run continues from there. In
 * Event Mode they are the importer's: self->event_found. */
static bool lw_meet_event(lw_instance *self, lw_run *run, const lw_span *span, double t) {
    double z[LW_N_Z], fired[LW_N_Z];
    bool any;
    lw_dense_state(self, span, t, self->stage);
    memcpy(self->x, self->stage, LW_N_S * sizeof(double));
    if (!lw_find_fired(self, t, self->x, span->u, z, fired, &any)
        || !lw_record(self, t, fmax(fabs(t), fabs(run->end)), fired)) return false;
    run->fresh = true;
    self->s.step_size = 0.0;
    self->event_found = any && self->event_mode_used && (self->early_return_allowed || t == run->end);
    memcpy(self->next, self->x, LW_N_S * sizeof(double));
    if (self->event_found) return true;
    if (++run->events > LW_MAX_EVENTS) {
        char names[256];
        return lw_fail(self, "more than %d events within one communication step, the last %s at t = %.9g s. Take shorter "
                       "steps, or give the model a hysteresis.", LW_MAX_EVENTS, lw_names_of(fired, names, sizeof names), t);
    }
    if (!lw_iterate(self, t, self->x, span->u, &any)) return false;
    memcpy(self->next, self->x, LW_N_S * sizeof(double));
    return true;
}
#endif

/* Continue at t with the inputs that the importer has set there, as after a jump; see lw_intermediate_update for `leave`. */
static bool lw_take_inputs(lw_instance *self, lw_run *run, double t, bool *leave) {
    self->s.step_size = 0.0;
    if (run->integrator != LW_RK4 && LW_N_X > 0) run->fresh = true;
#if LW_N_Z
    if (!lw_meet_inputs(self, t, lw_inputs_of_step(self), &self->event_found)) return false;
    *leave = self->event_found;
#else
    (void)t, (void)leave;
#endif
    return true;
}

/* Integrate from t over h to end: adaptively, with events, or with an intermediate update. Afterwards self->next holds the
 * states at the end and `end` the time. If Event Mode is used, an event ends the step: self->event_found. */
static bool lw_advance(lw_instance *self, double t, double h, double *end) {
    lw_run run = {.integrator = (lw_integrator)self->s.values[LW_INTEGRATOR], .end = *end, .fresh = true};
    run.segment = t;
    run.length = h;
    memcpy(self->x, self->s.values + LW_X, LW_N_S * sizeof(double));
    memcpy(self->next, self->x, LW_N_S * sizeof(double));
    if (lw_inputs_jumped(self)) self->s.step_size = 0.0;
#if LW_HAS_DERIVATIVES
    if (run.integrator == LW_RODAS && !lw_need_matrix(self)) return false;
#endif
    bool leave = false;
#if LW_N_Z
    const double *u = lw_inputs_of_step(self);
    if (!lw_meet_inputs(self, t, u, &self->event_found)) return false;
    leave = self->event_found;
#endif
    for (long steps = 0; t < run.end && !leave; steps++) {
        double to = run.end, first = INFINITY; /* the time of its first event */
        if (run.integrator != LW_RK4 && steps == LW_MAX_STEPS)
            return lw_fail(self, "the integrator has taken %d steps up to t = %.9g s. A stiff model needs integrator = 3; else take "
                           "shorter communication steps, or a larger tolerance.", LW_MAX_STEPS, t);
        if (!lw_next_step(self, &run, t, &to)) return false;
#if LW_N_Z
        const lw_span span = {t, to, LW_ULPS * fmax(fabs(t), fabs(to)), u};
        if (!lw_scan(self, &span, run.integrator == LW_RK4 ? 1 : LW_PIECES, &first)) return false;
        if (isfinite(first)) {
            t = first;
            if (!lw_meet_event(self, &run, &span, t)) return false;
            if (self->event_found) break;
        }
#endif
        if (!isfinite(first)) { /* the whole step is accepted */
            memcpy(self->x, self->next, LW_N_S * sizeof(double));
            if (run.integrator == LW_DOPRI5) memcpy(self->k, self->k + 6 * LW_N_X, LW_N_X * sizeof(double));
            t = to;
        }
        if (!self->update) continue;
        if (!lw_intermediate_update(self, &run, t, &leave)) return false;
        if (leave || t >= run.end || !lw_inputs_jumped(self)) continue; /* inputs set at the end belong to the next step */
        if (!lw_take_inputs(self, &run, t, &leave)) return false;
    }
    *end = t;
    return true;
}

static inline bool lw_try_step(lw_instance *self, double t, double h) {
    double *v = self->s.values, end = t + h;
    if (self->update) { /* time, states and held inputs are those of the last update */
        if (!lw_advance(self, t, h, &end)) return false;
        if (self->event_found) lw_publish(self, end);
        return lw_update_outputs(self);
    }
#if LW_N_Z
    if (!lw_advance(self, t, h, &end)) return false;
#else
    if (v[LW_INTEGRATOR] == LW_RK4 || !LW_N_X) {
        if (!lw_fixed_steps(self, t, h)) return false;
    } else if (!lw_advance(self, t, h, &end)) return false;
#endif
    const double *u = lw_inputs_of_step(self);
    if (LW_N_Y) {
        if (lw_call(self, lw_output, &end, self->next, u, self->scratch))
            return lw_fail(self, "the outputs can't be evaluated at t = %.9g s.", end);
        if (!lw_check_finite(self, self->scratch, LW_Y, LW_N_Y, end)) return false;
    }
    memcpy(v + LW_Y, self->scratch, LW_N_Y * sizeof(double));
    memcpy(v + LW_X, self->next, LW_N_S * sizeof(double));
#if LW_MOVING_INPUTS
    /* Derivatives hold for one step (FMI 2.0.5, 4.2.1). An input that is not set then keeps the value that it reached. */
    self->s.moved = self->s.moving;
    if (!u) {
        memcpy(v + LW_U, lw_inputs(self, NULL, end), LW_N_U * sizeof(double));
        memset(self->s.slopes, 0, sizeof self->s.slopes);
        self->s.moving = 0;
    }
#endif
    memcpy(v + LW_HELD, v + LW_U, LW_N_U * sizeof(double));
    v[0] = end;
    self->s.have_outputs = 1;
    self->s.have_derivatives = self->s.have_indicators = 0;
    return true;
}

/* Step from t over h, or to the first event (self->event_found; the time is then values[0]). A failure changes nothing:
 * time, states, domains and outputs are those before the step. */
static inline bool lw_step(lw_instance *self, double t, double h) {
    double step_size = self->s.step_size;
#if LW_N_Z
    const lw_event_memory events = self->s.events;
#endif
    self->event_found = false;
#if LW_MOVING_INPUTS
    self->step_start = t;
#endif
    if (self->update) *self->before = self->s;
    if (lw_try_step(self, t, h)) return true;
    self->event_found = false;
    if (self->update) {
        self->s = *self->before;
        self->s.mode = LW_TERMINATED;
    }
    self->s.step_size = step_size;
#if LW_N_Z
    self->s.events = events;
#endif
    return false;
}
