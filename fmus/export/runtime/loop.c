/* A diagram behind FMI: parameters, inputs, states and outputs go between the values of an instance and its memory, and
 * the loop makes the steps.
 *
 * The values are those of model.h, where all states are discrete ones: start values, which can be set before
 * initialization ends. The outputs are those of the diagram, its other signals, and states that are computed at the start.
 * Tables say where each value is in the memory: lw_places_p, lw_places_u, lw_places_d, and lw_places_y, in which -1 - i
 * is state i. lw_labels lists the outputs of blocks in the order of evaluation, and lw_guards what must stay positive. It
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

/* Copy outputs and states from the memory. */
static void lw_take_values(lw_instance *self) {
    const lw_memory *m = &self->s.memory;
    double *v = self->s.values;
    for (size_t i = 0; i < LW_N_D; i++) v[LW_D + i] = m->x[lw_places_d[i]];
    for (size_t i = 0; i < LW_N_Y; i++) v[LW_Y + i] = lw_places_y[i] < 0 ? m->x[-1 - lw_places_y[i]] : m->log[lw_places_y[i]];
    self->s.have_outputs = 1;
}

/* Say which block is to blame where everything can't be evaluated. */
static bool lw_blame(lw_instance *self) {
    lw_memory *m = &self->s.memory;
    const double t = *LW_LOOP_OF(m)->t;
#if LW_HYBRID
    const hybrid *h = &m->hybrid;
    if (m->reason == PILED_UP && LW_N_EVENTS)
        return lw_fail(self, "%s.%s at t = %.9g s: this event fires without end, so that time doesn't go on. Declare a hysteresis, or "
                       "give the block a state of rest.", lw_events_of[h->w.culprit].block, lw_events_of[h->w.culprit].name, h->t);
    if (m->reason == BROKEN_OFF && h->p.lost != AT_INSTANT)
        return lw_fail(self, LW_MODEL_NAME " at t = %.9g s: the solver finds no step. Is there a solution beyond? Check the inputs and "
                       "parameters; a stiff diagram needs solver='Radau' when it is built.", h->t);
#endif
    int guard = lw_find_guard(m);
    if (guard >= 0)
        return lw_fail(self, "%s.%s at t = %.9g s: this guard is not positive. The block's equations are not valid there; look up "
                       "its inputs.", lw_guards[guard].block, lw_guards[guard].name, t);
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

/* Evaluate everything at the start, with the values that have been set. */
static bool lw_update_outputs(lw_instance *self) {
    lw_memory *m = &self->s.memory;
    if (self->s.have_outputs) return true;
    lw_put_parameters(self);
    lw_put(lw_places_u, LW_N_U, self->s.values + LW_U, m->w);
    lw_put(lw_places_d, LW_N_D, self->s.values + LW_D, m->x);
    if (!lw_begin(m, self->s.values[0])) return lw_blame(self);
    lw_take_values(self);
    return true;
}

static bool lw_enter_event_mode(lw_instance *self, const char *function) { return lw_in_mode(self, function, LW_STEPPING); }

static bool lw_update_discrete_states(lw_instance *self, const char *function, bool *again, bool *moved) {
    return (void)again, (void)moved, lw_in_mode(self, function, LW_EVENT);
}

static bool lw_leave_event_mode(lw_instance *self, const char *function, lw_mode next) {
    return (void)next, lw_in_mode(self, function, LW_EVENT);
}

#if LW_ON_TICKS
/* Is a communication point a tick? */
static bool lw_is_tick(double t) {
    const double ticks = t / lw_time_of(1);
    return fabs(ticks - floor(ticks + 0.5)) <= LW_NEAR;
}
#endif

/* Step from t over h: ticks from t on and before t + h act. */
static bool lw_step(lw_instance *self, double t, double h) {
    lw_memory *m = &self->s.memory;
#if LW_ON_TICKS
    if (!lw_is_tick(t) || !lw_is_tick(t + h))
        return lw_fail(self, "the communication step of %g s from t = %.9g s doesn't fit: this FMU was built for steps from tick to "
                       "tick, which come every %g s. Take a multiple of that.", h, t, lw_time_of(1));
#endif
    lw_put_parameters(self);
    lw_put(lw_places_u, LW_N_U, self->s.values + LW_U, m->w);
    if (!lw_go(m, t + h)) return lw_blame(self);
    self->s.values[0] = t + h;
    lw_take_values(self);
    return true;
}
