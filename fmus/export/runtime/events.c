/* Events: domains of the indicators, jumps, and location of zero crossings in a step.
 *
 * An indicator has a domain, z > 0 or z <= 0. An event fires when its domain changes in the declared direction. All events
 * that fire at one instant jump at once; a jump may make further events fire at the same instant. */
#if LW_N_Z
#define LW_MAX_ITERATIONS 100
#define LW_MAX_EVENTS 10000
/* Events accumulate if one fires three times within 2^-35 of the time. Nearer ones would be lost in rounding. */
#define LW_ZENO 2.9103830456733704e-11
#define LW_ULPS 2.2204460492503131e-16

/* The indicators at (t, x, u), and the events whose domains differ from the present ones in the declared direction. */
static bool lw_find_fired(lw_instance *self, double t, const double *x, const double *u, double *z, double *fired, bool *any) {
    if (lw_call(self, lw_indicator, &t, x, u, z))
        return lw_fail(self, "the event indicators can't be evaluated at t = %.9g s.", t);
    if (!lw_check_finite(self, z, LW_Z, LW_N_Z, t)) return false;
    *any = false;
    for (int i = 0; i < LW_N_Z; i++) {
        int change = (z[i] > 0.0) - (int)self->s.positive[i], direction = lw_events[i].direction;
        fired[i] = change && (!direction || change == direction);
        if (fired[i] != 0.0) *any = true;
    }
    return true;
}

static void lw_set_domains(lw_instance *self, const double *z) {
    for (int i = 0; i < LW_N_Z; i++) self->s.positive[i] = z[i] > 0.0;
}

/* Names of the events that have fired, for a message. */
static const char *lw_names_of(const double *fired, char *text, size_t size) {
    size_t n = 0;
    text[0] = 0;
    for (int i = 0; i < LW_N_Z; i++) {
        if (fired[i] == 0.0) continue;
        int written = snprintf(text + n, size - n, n ? ", %s" : "%s", lw_events[i].name);
        if (written < 0 || (size_t)written >= size - n) break;
        n += (size_t)written;
    }
    return text;
}

/* x = jump(t, x, u, p, fired), all states. */
static bool lw_apply_jump(lw_instance *self, double t, double *x, const double *u, const double *fired) {
    char names[256];
    self->arg[4] = fired;
    if (lw_call(self, lw_jump, &t, x, u, self->scratch))
        return lw_fail(self, "the jump of %s can't be evaluated at t = %.9g s.", lw_names_of(fired, names, sizeof names), t);
    if (!lw_check_finite(self, self->scratch, LW_X, LW_N_S, t)) return false;
    memcpy(x, self->scratch, LW_N_S * sizeof(double));
    return true;
}

static bool lw_too_many_iterations(lw_instance *self, double t, const double *fired) {
    char names[256];
    return lw_fail(self, "the events %s fire again and again at t = %.9g s: %d iterations at one instant. Let the jump leave "
                   "their indicators on one side.", lw_names_of(fired, names, sizeof names), t, LW_MAX_ITERATIONS);
}

/* The event iteration at one instant; `any` is true if an event has fired. */
static bool lw_iterate(lw_instance *self, double t, double *x, const double *u, bool *any) {
    double z[LW_N_Z], fired[LW_N_Z];
    bool again;
    *any = false;
    for (int n = 0;; n++) {
        if (!lw_find_fired(self, t, x, u, z, fired, &again)) return false;
        if (again && n == LW_MAX_ITERATIONS) return lw_too_many_iterations(self, t, fired);
        lw_set_domains(self, z);
        if (!again) return true;
        if (!lw_apply_jump(self, t, x, u, fired)) return false;
        *any = true;
    }
}

/* Set the domains at the end of initialization; no event fires. */
static bool lw_start_domains(lw_instance *self) {
    double *v = self->s.values;
    double z[LW_N_Z], fired[LW_N_Z];
    bool any;
    if (!lw_find_fired(self, v[0], v + LW_X, v + LW_U, z, fired, &any)) return false;
    lw_set_domains(self, z);
    self->s.have_indicators = 0;
    for (int i = 0; i < LW_N_Z; i++) self->s.last_fired[i] = self->s.last_but_one[i] = -INFINITY;
    return true;
}

/* Record that events have been found at t; error if they accumulate there. `size` is the size of times. */
static bool lw_record(lw_instance *self, double t, double size, const double *fired) {
    for (int i = 0; i < LW_N_Z; i++) {
        if (fired[i] == 0.0) continue;
        if (t - self->s.last_but_one[i] <= LW_ZENO * size)
            return lw_fail(self, "the event %s fires faster and faster: 3 times within %.3g s at t = %.9g s, expected events "
                           "apart from each other. Give the model a mode in which it rests (Zeno), or a hysteresis (chattering).",
                           lw_events[i].name, t - self->s.last_but_one[i], t);
        self->s.last_but_one[i] = self->s.last_fired[i];
        self->s.last_fired[i] = t;
    }
    return true;
}

/* ---- location of crossings in a step ---- */

/* A step of an integrator: from self->x at `from` to self->next at `to`, in between by self->dense. */
typedef struct {
    double from, to, resolution;
    const double *u;
} lw_span;

/* A point of it, with the indicators and, if there are derivatives, their rates. */
typedef struct {
    double t;
    double z[LW_N_Z], rate[LW_N_Z];
} lw_point;

static void lw_dense_state(lw_instance *self, const lw_span *span, double t, double *x) {
    double theta = (t - span->from) / (span->to - span->from), rest = 1.0 - theta;
    if (t == span->to) {
        memcpy(x, self->next, LW_N_S * sizeof(double));
        return;
    }
    for (int i = 0; i < LW_N_X; i++) {
        double inner = self->dense[1][i] + theta * (self->dense[2][i] + rest * self->dense[3][i]);
        x[i] = self->x[i] + theta * (self->dense[0][i] + rest * inner);
    }
    for (int i = LW_N_X; i < LW_N_S; i++) x[i] = self->x[i];
}

static bool lw_evaluate(lw_instance *self, const lw_span *span, double t, lw_point *at) {
    at->t = t;
    lw_dense_state(self, span, t, self->stage);
#if LW_HAS_DERIVATIVES
    int failed = lw_call(self, lw_crossing, &t, self->stage, span->u, self->scratch);
    memcpy(at->z, self->scratch, sizeof at->z);
    memcpy(at->rate, self->scratch + LW_N_Z, sizeof at->rate);
#if LW_MOVING_INPUTS
    if (!span->u) {
        failed |= lw_along_inputs(self, t, self->stage);
        for (int i = 0; i < LW_N_Z; i++) at->rate[i] += self->scratch[LW_N_X + LW_N_Y + i];
    }
#endif
#else
    int failed = lw_call(self, lw_indicator, &t, self->stage, span->u, self->scratch);
    memcpy(at->z, self->scratch, sizeof at->z);
    memset(at->rate, 0, sizeof at->rate);
#endif
    return failed ? lw_fail(self, "the event indicators can't be evaluated at t = %.9g s.", t)
                  : lw_check_finite(self, at->z, LW_Z, LW_N_Z, t);
}

/* The time at which indicator i becomes `positive`, after a and not after b: as near to the crossing as times resolve. */
static bool lw_locate(lw_instance *self, const lw_span *span, int i, bool positive, double a, double b, double *found) {
    lw_point at;
    while (b - a > span->resolution) {
        double middle = a + (b - a) / 2.0;
        if (middle <= a || middle >= b) break;
        if (!lw_evaluate(self, span, middle, &at)) return false;
        if ((at.z[i] > 0.0) == positive) b = middle;
        else a = middle;
    }
    *found = b;
    return true;
}

/* Does indicator i, with the same domain at a and b, leave it in between? Its rates show whether it may; bisection finds
 * the extremum. `found` is a time in the other domain, NAN if there is none. */
static bool lw_find_excursion(lw_instance *self, const lw_span *span, int i, lw_point a, lw_point b, double *found) {
    bool positive = self->s.positive[i];
    double towards = positive ? -1.0 : 1.0;
    *found = NAN;
    while (towards * a.rate[i] > 0.0 && towards * b.rate[i] < 0.0 && b.t - a.t > span->resolution) {
        double width = b.t - a.t, middle = a.t + width / 2.0;
        /* between its tangents, a hump stays below the higher of both */
        if (fabs(a.z[i]) > width * fabs(a.rate[i]) && fabs(b.z[i]) > width * fabs(b.rate[i])) return true;
        lw_point at;
        if (!lw_evaluate(self, span, middle, &at)) return false;
        if ((at.z[i] > 0.0) != positive) {
            *found = middle;
            return true;
        }
        if (towards * at.rate[i] > 0.0) a = at;
        else b = at;
    }
    return true;
}

static bool lw_is_declared(int i, bool positive) {
    return !lw_events[i].direction || lw_events[i].direction == (positive ? 1 : -1);
}

/* The time of the first event between two points, else INFINITY. Changes of domain that fire no event are recorded. */
static bool lw_first_event(lw_instance *self, const lw_span *span, const lw_point *a, const lw_point *b, double *first) {
    double found[LW_N_Z], flipped[LW_N_Z];
    *first = INFINITY;
    for (int i = 0; i < LW_N_Z; i++) {
        bool positive = self->s.positive[i], crossed = (b->z[i] > 0.0) != positive;
        double middle = b->t;
        found[i] = flipped[i] = INFINITY;
        if (!crossed && !lw_find_excursion(self, span, i, *a, *b, &middle)) return false;
        if (isnan(middle)) continue;
        if (lw_is_declared(i, !positive)) {
            if (!lw_locate(self, span, i, !positive, a->t, middle, &found[i])) return false;
        } else if (!crossed) { /* it left and returned */
            flipped[i] = middle;
            if (lw_is_declared(i, positive) && !lw_locate(self, span, i, positive, middle, b->t, &found[i])) return false;
        }
        *first = fmin(*first, found[i]);
    }
    for (int i = 0; i < LW_N_Z; i++)
        if (flipped[i] < *first && isfinite(*first)) self->s.positive[i] = !self->s.positive[i];
    return true;
}

/* The time of the first event of a step, else INFINITY. `pieces` is the number of parts that are searched. */
static bool lw_scan(lw_instance *self, const lw_span *span, int pieces, double *first) {
    lw_point a, b;
    if (!lw_evaluate(self, span, span->from, &a)) return false;
    for (int k = 1; k <= pieces; k++) {
        double t = k == pieces ? span->to : span->from + (span->to - span->from) * k / pieces;
        if (!lw_evaluate(self, span, t, &b) || !lw_first_event(self, span, &a, &b, first)) return false;
        if (isfinite(*first)) return true;
        lw_set_domains(self, b.z);
        a = b;
    }
    return true;
}
#endif

/* ---- Event Mode ---- */

static inline bool lw_enter_event_mode(lw_instance *self, const char *function) {
    if (!lw_in_mode(self, function, self->s.model_exchange ? LW_CONTINUOUS : LW_STEPPING)) return false;
    self->s.mode = LW_EVENT;
    self->s.iterations = 0;
    self->s.step_size = 0.0;
    lw_changed(self); /* outputs follow the inputs now */
    return true;
}

/* One event iteration: jump if events fire now; `again` if more will fire, `moved` if a continuous state has changed. */
static inline bool lw_update_discrete_states(lw_instance *self, const char *function, bool *again, bool *moved) {
    *again = *moved = false;
    if (!lw_in_mode(self, function, LW_EVENT)) return false;
#if LW_N_Z
    double *v = self->s.values, *x = v + LW_X, z[LW_N_Z], fired[LW_N_Z], old[LW_AT_LEAST_1(LW_N_X)];
    memcpy(old, x, LW_N_X * sizeof(double));
    bool any;
    if (!lw_find_fired(self, v[0], x, v + LW_U, z, fired, &any)) return false;
    if (any && self->s.iterations == LW_MAX_ITERATIONS) return lw_too_many_iterations(self, v[0], fired);
    lw_set_domains(self, z);
    if (any) {
        self->s.iterations++;
        if (!lw_apply_jump(self, v[0], x, v + LW_U, fired)) return false;
        *moved = memcmp(old, x, LW_N_X * sizeof(double)) != 0;
        self->s.step_size = 0.0;
        if (!lw_find_fired(self, v[0], x, v + LW_U, z, fired, again)) return false;
        if (!*again) lw_set_domains(self, z);
    }
    lw_changed(self);
#endif
    return true;
}

/* Leave Event Mode for `next`. */
static inline bool lw_leave_event_mode(lw_instance *self, const char *function, lw_mode next) {
    if (!lw_in_mode(self, function, LW_EVENT) || !lw_update_outputs(self)) return false;
    self->s.mode = next;
    return true;
}
