/* A diagram behind FMI: parameters, inputs, states and outputs go between the values of an instance and its memory, and
 * the loop makes the steps.
 *
 * The values are those of model.h, where all states are discrete ones: start values, which can be set before
 * initialization ends. The outputs are those of the diagram, its other signals, and states that are computed at the start.
 * Tables say where each value is in the memory: lw_places_p, lw_places_u, lw_places_d, and lw_places_y, in which -1 - i
 * is state i, and LW_LOGGED + i is entry i of w. lw_labels lists the outputs of blocks in the order of evaluation, and lw_guards what must stay positive. It
 * comes in the place of integrators.c, events.c and stepping.c. */

static void lw_put(const int32_t *places, size_t n, const double *from, double *to) {
    for (size_t i = 0; i < n; i++) to[places[i]] = from[i];
}

/* Take over parameters that have been set, and what is computed from them. */
static void lw_put_parameters(lw_instance *self) {
    lw_memory *m = &self->s.memory;
    const double *from = self->s.values + LW_P;
    bool changed = false;
    for (size_t i = 0; i < LW_N_P; i++) changed |= m->p[lw_places_p[i]] != from[i];
    if (!changed) return;
    lw_put(lw_places_p, LW_N_P, from, m->p);
    lw_renew(m);
}

/* Copy outputs from the memory. */
static void lw_take_outputs(lw_instance *self) {
    const lw_memory *m = &self->s.memory;
    double *v = self->s.values;
    for (size_t i = 0; i < LW_N_Y; i++) {
        const int32_t place = lw_places_y[i];
        v[LW_Y + i] = place < 0 ? m->x[-1 - place] : place < LW_LOGGED ? m->log[place] : m->w[place - LW_LOGGED];
    }
    self->s.have_outputs = 1;
}

/* Copy outputs and states from the memory. */
static void lw_take_values(lw_instance *self) {
    for (size_t i = 0; i < LW_N_X; i++) self->s.values[LW_X + i] = self->s.memory.x[lw_places_x[i]];
    for (size_t i = 0; i < LW_N_D; i++) self->s.values[LW_D + i] = self->s.memory.x[lw_places_d[i]];
    self->s.have_derivatives = 0;
    lw_take_outputs(self);
}

#if LW_N_MERGED
/* Say what a merged FMU has said. */
static void lw_pass_on(lw_instance *self) {
    char *said = self->s.memory.said;
    if (said[0] == LW_LOG_WARNING) lw_warn(self, "%s", said + 1);
    if (said[0] == LW_LOG_ERROR) lw_fail(self, "%s", said + 1);
    memset(said, 0, sizeof self->s.memory.said);
}
#endif

/* Say which block is to blame where everything can't be evaluated. */
static bool lw_blame(lw_instance *self) {
    lw_memory *m = &self->s.memory;
    const double t = *LW_LOOP_OF(m)->t;
#if LW_N_MERGED
    if (m->culprit > LW_N_MERGED)
        return lw_fail(self, LW_MODEL_NAME " at t = %.9g s: inputs and outputs of the FMUs in it don't agree at the start after %d "
                       "passes. Check their start values, or put a UnitDelay between them.", t, LW_MOST_PASSES);
    if (m->culprit) return lw_pass_on(self), false;
#endif
#if LW_HYBRID
    const hybrid *h = &m->hybrid;
    if (LW_N_EVENTS > 0 && m->reason == PILED_UP)
        return lw_fail(self, "%s.%s at t = %.9g s: this event fires without end, so that time doesn't go on. Declare a hysteresis, or "
                       "give the block a state of rest.", lw_events_of[h->w.culprit].block, lw_events_of[h->w.culprit].name, h->t);
    if (m->reason == BROKEN_OFF && h->p.lost != AT_INSTANT)
        return lw_fail(self, LW_MODEL_NAME " at t = %.9g s: the solver finds no step. Is there a solution beyond? Check the inputs and "
                       "parameters; a stiff diagram needs solver='Radau' when it is built.", h->t);
#endif
    int guard = lw_find_guard(m);
    if (guard >= 0)
        return lw_fail(self, "%s.%s at t = %.9g s: this guard is not positive. %s", lw_guards[guard].block, lw_guards[guard].name, t,
                       lw_guards[guard].text);
    for (size_t i = 0; i < LW_N_LABELS; i++) {
        const lw_label *label = lw_labels + i;
        for (uint32_t k = 0; k < label->size; k++)
            if (!isfinite(m->log[label->first + k]))
                return lw_fail(self, "%s.%s at t = %.9g s: found %g, expected a finite number. It is the first block that made such a "
                               "value; check the inputs and parameters.", label->block, label->port, t, m->log[label->first + k]);
    }
    return lw_fail(self, LW_MODEL_NAME " at t = %.9g s: found no values of all signals. Check the inputs and parameters; with an "
                   "algebraic loop there may be no solution.", t);
}

/* Take over parameters and inputs that have been set. */
static void lw_put_values(lw_instance *self) {
    lw_put_parameters(self);
    lw_put(lw_places_u, LW_N_U, self->s.values + LW_U, self->s.memory.w);
}

#if LW_CLOCKS
/* Event Mode: evaluate everything with the clocks that are active and the inputs as they are now. The importer may set other
 * inputs yet, so that states and time stay: lw_update_discrete_states takes them over. */
static bool lw_preview(lw_instance *self) {
    lw_memory *m = &self->s.memory;
    lw_put_values(self);
    memcpy(&self->kept, m, sizeof *m);
    const bool ok = lw_act(m, self->s.active) && lw_settle(m);
    if (ok) lw_take_outputs(self);
    else lw_blame(self);
    memcpy(m, &self->kept, sizeof *m);
    return ok;
}
#endif

/* Evaluate everything at the start, with the values that have been set; afterwards in Event Mode alone. */
static bool lw_update_outputs(lw_instance *self) {
    lw_memory *m = &self->s.memory;
    if (self->s.have_outputs) return true;
#if LW_CLOCKS
    if (self->s.begun && self->s.mode == LW_EVENT) return lw_preview(self);
#endif
    if (self->s.begun) return lw_take_outputs(self), true;
    lw_put_values(self);
    lw_put(lw_places_x, LW_N_X, self->s.values + LW_X, m->x);
    lw_put(lw_places_d, LW_N_D, self->s.values + LW_D, m->x);
    if (!lw_begin(m, self->s.values[0])) return lw_blame(self);
#if LW_N_MERGED
    lw_pass_on(self);
#endif
    lw_take_values(self);
    return true;
}

/* Evaluate the rates of the continuous states at the present instant. */
static bool lw_update_derivatives(lw_instance *self) {
#if LW_N_X
    lw_memory *m = &self->s.memory;
    if (self->s.have_derivatives) return true;
    if (!self->s.begun && !lw_update_outputs(self)) return false;
    if (self->s.mode == LW_EVENT) lw_put_values(self);
    if (!lw_rates_at(m, self->slopes)) return lw_fail(self, "the rates can't be evaluated at t = %.9g s.", m->now);
    for (size_t i = 0; i < LW_N_X; i++) self->scratch[i] = self->slopes[lw_places_dx[i]];
    if (!lw_check_finite(self, self->scratch, LW_DX, LW_N_X, m->now)) return false;
    memcpy(self->s.values + LW_DX, self->scratch, LW_N_X * sizeof(double));
    self->s.have_derivatives = 1;
#endif
    return (void)self, true;
}

/* ---- derivatives ---- */

#if LW_HAS_DERIVATIVES
/* The kind of tick of which derivatives are: in Event Mode that of the clocks that are active; where nothing is between ticks,
 * the tick at hand, which the next step makes first, and at the start also with something between them. Else values of
 * sampled subsystems are held: -1 where nothing is between ticks. */
static int64_t lw_kind_of_slopes(const lw_instance *self) {
    const lw_memory *m = &self->s.memory;
    bool acts = lw_is_due(m) && (!LW_HYBRID || !self->s.begun);
    if (self->s.mode == LW_EVENT) acts = self->s.active;
#if LW_HYBRID
    return acts ? lw_kind_of(m->tick) : m->hybrid.between;
#else
    return acts ? lw_kind_of(m->tick) : -1;
#endif
}

/* Add values at their places to a vector, or take them from there. */
static void lw_spread(const int32_t *places, size_t n, const double *from, double *to) {
    for (size_t i = 0; i < n; i++) to[places[i]] += from[i];
}
static void lw_gather(const int32_t *places, size_t n, const double *from, double *to) {
    for (size_t i = 0; i < n; i++) to[i] = from[places[i]];
}

/* The product of the Jacobian, or its transpose, with a seed in the order of the values; at the start with the states that
 * are computed there. */
static bool lw_product(lw_instance *self, bool adjoint, const double *seed, double *found) {
    lw_memory *m = &self->s.memory;
    double *by = self->knowns, *y = self->slopes;
    if (!self->s.begun && !lw_update_outputs(self)) return false;
    lw_put_values(self); /* those that the next step or update takes */
    const int64_t kind = lw_kind_of_slopes(self);
    memset(by, 0, sizeof self->knowns);
    memset(y, 0, sizeof self->slopes);
    if (!adjoint) {
        by[0] = seed[0];
        lw_spread(lw_places_p, LW_N_P, seed + LW_P, by + LW_KNOWN_P);
        lw_spread(lw_places_u, LW_N_U, seed + LW_U, by + LW_KNOWN_W);
        lw_spread(lw_places_x, LW_N_X, seed + LW_X, by + LW_KNOWN_X);
        lw_spread(lw_places_d, LW_N_D, seed + LW_D, by + LW_KNOWN_X);
#if LW_HAS_START_SLOPES
        if (!self->s.begun) {
            if (!lw_forward_start(m, by, self->begun)) return false;
            memcpy(by + LW_KNOWN_X, self->begun, sizeof m->x);
        }
#endif
        if (kind >= 0 && !lw_forward_at(m, kind, by, y)) return false;
        lw_gather(lw_places_dx, LW_N_X, y + LW_FIRST_RATE, found);
        for (size_t i = 0; i < LW_N_Y; i++)
            found[LW_N_X + i] = lw_slope_places[i] < 0 ? by[LW_KNOWN_X + (-1 - lw_slope_places[i])] : y[lw_slope_places[i]];
        return true;
    }
    lw_spread(lw_places_dx, LW_N_X, seed + LW_DX, y + LW_FIRST_RATE);
    for (size_t i = 0; i < LW_N_Y; i++)
        if (lw_slope_places[i] >= 0) y[lw_slope_places[i]] += seed[LW_Y + i];
    if (kind >= 0 && !lw_reverse_at(m, kind, y, by)) return false;
    for (size_t i = 0; i < LW_N_Y; i++)
        if (lw_slope_places[i] < 0) by[LW_KNOWN_X + (-1 - lw_slope_places[i])] += seed[LW_Y + i];
#if LW_HAS_START_SLOPES
    if (!self->s.begun) {
        if (!lw_reverse_start(m, by + LW_KNOWN_X, self->begun)) return false;
        memset(by + LW_KNOWN_X, 0, sizeof m->x);
        for (size_t i = 0; i < LW_N_KNOWNS; i++) by[i] += self->begun[i];
    }
#endif
    found[0] = by[0];
    lw_gather(lw_places_p, LW_N_P, by + LW_KNOWN_P, found + LW_P);
    lw_gather(lw_places_u, LW_N_U, by + LW_KNOWN_W, found + LW_U);
    lw_gather(lw_places_x, LW_N_X, by + LW_KNOWN_X, found + LW_X);
    lw_gather(lw_places_d, LW_N_D, by + LW_KNOWN_X, found + LW_D);
    return true;
}
#endif

/* ---- Event Mode, in which the importer makes the ticks by clocks (FMI 3.0, 2.3.5) ---- */

#if LW_CLOCKS
/* Write the names of clocks, given as bits, with commas between them. */
static const char *lw_name_clocks(uint64_t clocks, char *text, size_t size) {
    size_t n = 0;
    text[0] = 0;
    for (int i = 0; i < LW_CLOCKS && n < size; i++)
        if (clocks >> i & 1) n += (size_t)snprintf(text + n, size - n, "%s%s", n ? ", " : "", lw_clock_names[i]);
    return text;
}

static bool lw_set_clock(lw_instance *self, const char *function, int clock, bool active) {
    const lw_memory *m = &self->s.memory;
    const uint64_t bit = UINT64_C(1) << clock;
    if (!active && self->s.active & bit)
        return lw_fail(self, "%s: %s is active at t = %.9g s, and can't be deactivated (canBeDeactivated = false).", function,
                       lw_clock_names[clock], m->now);
    if (!active) return true;
    if (!lw_is_due(m) || !(lw_acting_at(m->tick) & bit)) {
        int64_t next = m->tick;
        while (!(lw_acting_at(next) & bit)) next = lw_tick_from(next + 1);
        return lw_fail(self, "%s: %s was activated at t = %.9g s, but it ticks next at %.9g s. Its ticks count from t = 0, and "
                       "each comes once. Activate it there.", function, lw_clock_names[clock], m->now, lw_time_of(next));
    }
    self->s.active |= bit;
    self->s.have_outputs = 0;
    return true;
}

/* Take over a value of the importer's: has it activated all clocks of a tick, or none? */
static bool lw_check_active(lw_instance *self, const char *function) {
    char text[256];
    const uint64_t missing = self->s.active ? lw_acting_at(self->s.memory.tick) & ~self->s.active : 0;
    if (!missing) return true;
    return lw_fail(self, "%s: these clocks tick at t = %.9g s, too, and are not active: %s. They make one tick together: activate "
                   "all of them before the update.", function, self->s.memory.now, lw_name_clocks(missing, text, sizeof text));
}
#endif

static bool lw_enter_event_mode(lw_instance *self, const char *function) {
    if (!lw_in_mode(self, function, LW_STEPPING)) return false;
    self->s.mode = LW_EVENT;
    return true;
}

static bool lw_update_discrete_states(lw_instance *self, const char *function, bool *again, bool *moved) {
    (void)again, (void)moved; /* all of an instant happens at once, and states are no variables of the importer's */
    if (!lw_in_mode(self, function, LW_EVENT)) return false;
#if LW_CLOCKS
    lw_memory *m = &self->s.memory;
    if (!lw_check_active(self, function)) return false;
    lw_put_values(self);
    if (!lw_act(m, self->s.active) || !lw_settle(m)) return lw_blame(self);
    self->s.active = 0;
    lw_take_values(self);
#endif
    return true;
}

static bool lw_leave_event_mode(lw_instance *self, const char *function, lw_mode next) {
    if (!lw_in_mode(self, function, LW_EVENT)) return false;
    if (self->s.active)
        return lw_fail(self, "%s: clocks are active. Call " LW_API "UpdateDiscreteStates first.", function);
    self->s.mode = next;
    return true;
}

#if LW_ON_TICKS
/* Is a communication point a tick? */
static bool lw_is_tick(double t) {
    const double ticks = t / lw_time_of(1);
    return fabs(ticks - floor(ticks + 0.5)) <= LW_NEAR;
}
#endif

/* Step from t over h: ticks from t on and before t + h act, but where the importer makes the ticks by clocks. */
static bool lw_step(lw_instance *self, double t, double h) {
    lw_memory *m = &self->s.memory;
    self->event_found = false;
#if LW_ON_TICKS
    if (!lw_is_tick(t) || !lw_is_tick(t + h))
        return lw_fail(self, "the communication step of %g s from t = %.9g s doesn't fit: this FMU was built for steps from tick to "
                       "tick, which come every %g s. Take a multiple of that.", h, t, lw_time_of(1));
#endif
    double end = t + h;
#if LW_CLOCKS
    char text[256];
    if (self->event_mode_used && lw_acts_before(m, end)) {
        if (lw_is_due(m) || !self->early_return_allowed)
            return lw_fail(self, "the step from t = %.9g s to %.9g s passes the tick at %.9g s of %s. End a step there, and activate "
                           "it by fmi3SetClock in Event Mode; with eventModeUsed = fmi3False the FMU makes its ticks itself.", t, end,
                           lw_time_of(m->tick), lw_name_clocks(lw_acting_at(m->tick), text, sizeof text));
        end = lw_time_of(m->tick);
        self->event_found = true;
    }
#endif
    lw_put_values(self);
    if (!lw_go(m, end)) return lw_blame(self);
#if LW_N_MERGED
    lw_pass_on(self);
#endif
    self->s.values[0] = end;
    lw_take_values(self);
    return true;
}
