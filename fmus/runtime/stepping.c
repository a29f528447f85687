/* A communication step: the integrator that was chosen, with its step size and its events. */
#define LW_MAX_STEPS 10000000
#define LW_PIECES 4 /* of an adaptive step, each looked through for events */

/* Have the inputs jumped since the last step? Then an adaptive integrator starts anew. */
static bool lw_inputs_jumped(const lw_instance *self) {
    const double *v = self->s.values;
    return memcmp(v + LW_U, v + LW_HELD, LW_N_U * sizeof(double)) != 0;
}

static bool lw_step_too_small(lw_instance *self, double t, double h) {
    int worst = 0;
    double largest = -1.0;
    lw_rate(self, t, self->x, self->s.values + LW_U, self->k1);
    for (int i = 0; i < LW_N_X; i++) {
        double change = fabs(self->k1[i]) / lw_scale(self, i, self->x[i], self->x[i]);
        if (!isfinite(change)) change = INFINITY;
        if (change > largest) largest = change, worst = i;
    }
    size_t v = 0;
    while ((size_t)LW_X + worst >= (size_t)lw_variables[v].first + lw_variables[v].size) v++;
    return lw_fail(self, "the integrator can't go on at t = %.9g s: its step fell to %.3g s; %s (element %zu), now %.9g, changes "
                   "the most. Is there a solution beyond? Else check the inputs and parameters, or set a larger tolerance.",
                   t, h, lw_variables[v].name, (size_t)(LW_X + worst) - lw_variables[v].first, self->x[worst]);
}

/* Steps within a communication step: what is kept from one to the next. */
typedef struct {
    lw_integrator integrator;
    double end;     /* of the communication step */
    double segment; /* rk4: where the equal substeps began, since the last event */
    long n, i;      /* rk4: substeps in all, and done */
    bool fresh;     /* after a jump: slope and step size are to be found anew */
    bool rejected;
} lw_run;

/* An accepted step of an adaptive integrator from self->x at t, into self->next; `to` is where it ends. */
static inline bool lw_adaptive_step(lw_instance *self, lw_run *run, double t, double *to) {
    const double *u = self->s.values + LW_U;
    const bool implicit = run->integrator == LW_RODAS;
    const double exponent = implicit ? -1.0 / 4.0 : -1.0 / 5.0, left = run->end - t;
    const double shortest = 16.0 * 2.3e-16 * fmax(fabs(t), fabs(run->end));
    if ((run->fresh || implicit) && lw_rate(self, t, self->x, u, self->k1))
        return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", t);
    if (run->fresh && !lw_check_finite(self, self->k1, LW_DX, LW_N_X, t)) return false;
#if LW_HAS_DERIVATIVES
    if (implicit && (lw_linearize(self, t, u) || !lw_is_finite(self->jacobian, LW_N_J) || !lw_is_finite(self->slope, LW_N_X)))
        return lw_fail(self, "the Jacobian can't be evaluated at t = %.9g s. Set integrator = 1 or 2.", t);
#endif
    double h = self->s.step_size;
    if (run->fresh && !(h > 0.0)) h = lw_first_step(self, t, u, implicit ? 4 : 5, left);
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
        double factor = isfinite(error) ? fmax(0.2, 0.9 * pow(error, exponent)) : 0.2;
        if (error <= 1.0) {
            factor = fmin(factor, run->rejected ? 1.0 : 5.0);
            /* a step that the communication point has cut says little of the next one */
            self->s.step_size = last ? fmax(h, used * factor) : used * factor;
            *to = last ? run->end : t + used;
            return true;
        }
        h = used * factor;
        run->rejected = true;
    }
}

/* The next step from self->x at t into self->next. */
static bool lw_next_step(lw_instance *self, lw_run *run, double t, double *to) {
#if LW_N_X == 0 && !LW_N_Z
    *to = run->end;
    return true;
#else
#if LW_N_X
    if (run->integrator != LW_RK4) return lw_adaptive_step(self, run, t, to);
#endif
#if LW_N_Z
    if (run->fresh) {
        run->segment = t;
        run->i = 0;
        run->n = lw_substeps(self, run->end - t);
        run->fresh = false;
        if (run->n < 0) return false;
    }
    run->i++;
    *to = run->i == run->n ? run->end : run->segment + (run->end - run->segment) * ((double)run->i / (double)run->n);
    if (lw_rk4_step(self, t, *to - t, self->s.values + LW_U))
        return lw_fail(self, "the equations can't be evaluated at t = %.9g s.", *to);
    return lw_check_finite(self, self->next, LW_X, LW_N_X, *to);
#else
    (void)t;
    *to = run->end;
    return true;
#endif
#endif
}

/* Integrate from t to end: adaptively, or with events. The states there are in self->next afterwards, the time is in
 * `reached`. Where Event Mode is used, an event ends the step: self->event_found. */
static bool lw_advance(lw_instance *self, double t, double end, double *reached) {
    lw_run run = {.integrator = (lw_integrator)self->s.values[LW_INTEGRATOR], .end = end, .fresh = true};
    memcpy(self->x, self->s.values + LW_X, LW_N_S * sizeof(double));
    memcpy(self->next, self->x, LW_N_S * sizeof(double));
    if (lw_inputs_jumped(self)) self->s.step_size = 0.0;
#if LW_HAS_DERIVATIVES
    if (run.integrator == LW_RODAS && !lw_need_matrix(self)) return false;
#endif
#if LW_N_Z
    double z[LW_N_Z], fired[LW_N_Z];
    const double *u = self->s.values + LW_U;
    bool any;
    long count = 0;
    if (!lw_find_fired(self, t, self->x, u, z, fired, &any)) return false; /* the inputs may have jumped */
    if (any && self->event_mode_used && self->early_return_allowed) {
        self->event_found = true;
        *reached = t;
        return true;
    }
    if (!lw_iterate(self, t, self->x, u, &any)) return false;
    if (any) self->s.step_size = 0.0;
    memcpy(self->next, self->x, LW_N_S * sizeof(double));
#endif
    for (long steps = 0; t < end; steps++) {
        double to = end;
        if (run.integrator != LW_RK4 && steps == LW_MAX_STEPS)
            return lw_fail(self, "the integrator has taken %d steps up to t = %.9g s. A stiff model needs integrator = 3; else take "
                           "shorter communication steps, or a larger tolerance.", LW_MAX_STEPS, t);
        if (!lw_next_step(self, &run, t, &to)) return false;
#if LW_N_Z
        lw_span span = {t, to, LW_ULPS * fmax(fabs(t), fabs(to)), u};
        double first;
        if (!lw_scan(self, &span, run.integrator == LW_RK4 ? 1 : LW_PIECES, &first)) return false;
        if (isfinite(first)) {
            lw_dense_state(self, &span, first, self->stage);
            memcpy(self->x, self->stage, LW_N_S * sizeof(double));
            t = first;
            if (!lw_find_fired(self, t, self->x, u, z, fired, &any) || !lw_record(self, t, fmax(fabs(t), fabs(end)), fired)) return false;
            run.fresh = true;
            self->s.step_size = 0.0;
            self->event_found = any && self->event_mode_used && (self->early_return_allowed || t == end);
            if (self->event_found) {
                memcpy(self->next, self->x, LW_N_S * sizeof(double));
                break;
            }
            if (++count > LW_MAX_EVENTS) {
                char names[256];
                return lw_fail(self, "more than %d events within one communication step, the last %s at t = %.9g s. Take shorter "
                               "steps, or give the model a hysteresis.", LW_MAX_EVENTS, lw_names_of(fired, names, sizeof names), t);
            }
            if (!lw_iterate(self, t, self->x, u, &any)) return false;
            memcpy(self->next, self->x, LW_N_S * sizeof(double));
            continue;
        }
#endif
        memcpy(self->x, self->next, LW_N_S * sizeof(double));
        if (run.integrator == LW_DOPRI5) memcpy(self->k1, self->k7, LW_N_X * sizeof(double));
        t = to;
    }
    *reached = t;
    return true;
}

static bool lw_try_step(lw_instance *self, double t, double h) {
    double *v = self->s.values, end = t + h;
#if LW_N_Z
    if (!lw_advance(self, t, end, &end)) return false;
#else
    if (v[LW_INTEGRATOR] == LW_RK4 || !LW_N_X) {
        if (!lw_fixed_steps(self, t, h)) return false;
    } else if (!lw_advance(self, t, end, &end)) return false;
#endif
    if (LW_N_Y) {
        if (lw_call(self, lw_output, &end, self->next, v + LW_U, self->scratch))
            return lw_fail(self, "the outputs can't be evaluated at t = %.9g s.", end);
        if (!lw_check_finite(self, self->scratch, LW_Y, LW_N_Y, end)) return false;
    }
    memcpy(v + LW_Y, self->scratch, LW_N_Y * sizeof(double));
    memcpy(v + LW_X, self->next, LW_N_S * sizeof(double));
    memcpy(v + LW_HELD, v + LW_U, LW_N_U * sizeof(double));
    v[0] = end;
    self->s.have_outputs = 1;
    self->s.have_derivatives = self->s.have_indicators = 0;
    return true;
}

/* Step from t over h, or to the first event (self->event_found; the time is then values[0]). When it fails, nothing has
 * changed: time, states, domains and outputs are those before it. */
static bool lw_step(lw_instance *self, double t, double h) {
    double step_size = self->s.step_size;
#if LW_N_Z
    double last_fired[LW_N_Z], last_but_one[LW_N_Z];
    uint8_t positive[sizeof self->s.positive];
    memcpy(last_fired, self->s.last_fired, sizeof last_fired);
    memcpy(last_but_one, self->s.last_but_one, sizeof last_but_one);
    memcpy(positive, self->s.positive, sizeof positive);
#endif
    self->event_found = false;
    if (lw_try_step(self, t, h)) return true;
    self->event_found = false;
    self->s.step_size = step_size;
#if LW_N_Z
    memcpy(self->s.last_fired, last_fired, sizeof last_fired);
    memcpy(self->s.last_but_one, last_but_one, sizeof last_but_one);
    memcpy(self->s.positive, positive, sizeof positive);
#endif
    return false;
}
