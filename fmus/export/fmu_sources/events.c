/* Events: domains of the indicators, jumps, and location of zero crossings in a step.
 *
 * An indicator has a domain, z > 0 or z <= 0. An event fires when its domain changes in the declared direction. All events
 * that fire at one instant jump at once; a jump may make further events fire at the same instant.
 *
 * Zero itself is the border. An indicator that is exactly 0 at the start is in neither domain, and so is one that the jump
 * of its own event leaves in contact: an impact, which changes continuous states and with them the motion of the indicator,
 * and leaves it on 0, or where the event found it, moving on beyond. The direction in which it leaves decides: down is falling, up is rising. A jump whose motion leads back beyond contact at once, again and
 * again, rests there; that is an error. Diagrams have this rule, too (diagrams/compiled/event_domains.py). */
#if LW_N_Z
#define LW_MAX_ITERATIONS 100
#define LW_MAX_EVENTS 10000
/* Events accumulate if one fires three times within 2^-35 of the time. Nearer ones would be lost in rounding. */
#define LW_ZENO 2.9103830456733704e-11
#define LW_ULPS 2.2204460492503131e-16
#define LW_PROBE 1e-3 /* s, over which a change of motion is looked for */
#define LW_RESTS 20 /* events in a row that lead back into contact; colliding bodies pass an impact on a few times */

/* A step of an integrator: from self->x at `from` to self->next at `to`, in between by self->dense. */
typedef struct {
    double from, to, resolution;
    const double *u;
} lw_span;

/* A step in which an event is located. */
typedef struct {
    lw_instance *self;
    const lw_span *span;
} lw_search;

static double lw_value_at(const lw_search *s, int64_t i, double t, bool *lost);

#define LW_SEARCH const lw_search
#define LW_VALUE lw_value_at
#include "crossings.c"

/* The domain of indicator i at its value z, from the present one. */
static int lw_domain(const lw_instance *self, int i, double z) {
    const lw_event_memory *events = &self->s.events;
    if (events->domain[i] != LW_BORDER) return z > 0.0 ? LW_ABOVE : LW_BELOW;
    return z > fmax(events->level[i], 0.0) ? LW_ABOVE : z < fmin(events->level[i], 0.0) ? LW_BELOW : LW_BORDER;
}

static bool lw_is_declared(int i, int domain) {
    return !lw_events[i].direction || lw_events[i].direction == (domain == LW_ABOVE ? 1 : -1);
}

/* The indicators at (t, x, u), and the events whose domains differ from the present ones in the declared direction. */
static bool lw_find_fired(lw_instance *self, double t, const double *x, const double *u, double *z, double *fired, bool *any) {
    if (lw_call(self, lw_indicator, &t, x, u, z))
        return lw_fail(self, "the event indicators can't be evaluated at t = %.9g s.", t);
    if (!lw_check_finite(self, z, LW_Z, LW_N_Z, t)) return false;
    *any = false;
    for (int i = 0; i < LW_N_Z; i++) {
        int domain = lw_domain(self, i, z[i]);
        fired[i] = domain != self->s.events.domain[i] && lw_is_declared(i, domain);
        if (fired[i] != 0.0) *any = true;
    }
    return true;
}

static void lw_set_domain(lw_instance *self, int i, int domain) {
    lw_event_memory *events = &self->s.events;
    if (events->side[i] && domain != LW_BORDER) {
        if (domain != events->side[i] - 1) events->side[i] = events->resting[i] = 0; /* it has left contact */
        else if (events->domain[i] == LW_BORDER) events->resting[i]++;
    }
    events->domain[i] = (uint8_t)domain;
}

static void lw_set_domains(lw_instance *self, const double *z) {
    for (int i = 0; i < LW_N_Z; i++) lw_set_domain(self, i, lw_domain(self, i, z[i]));
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

/* ---- contact ---- */

#if LW_N_X
/* The indicators at an instant, and their changes after one and two steps along the rates. */
typedef struct {
    double z[LW_N_Z], once[LW_N_Z], twice[LW_N_Z];
} lw_motion;

/* False if they can't be evaluated. */
static bool lw_find_motion(lw_instance *self, double t, const double *x, const double *u, lw_motion *motion) {
    const lw_equation e = lw_equation_of(self, u);
    double there[LW_N_S], rates[LW_N_X];
    memcpy(there, x, sizeof there);
    if (lw_call(self, lw_indicator, &t, x, u, motion->z)) return false;
    for (int step = 0; step < 2; step++) {
        double *change = step ? motion->twice : motion->once;
        if (lw_rate(&e, t, there, rates)) return false;
        for (int i = 0; i < LW_N_X; i++) there[i] += LW_PROBE * rates[i];
        if (lw_call(self, lw_indicator, &t, there, u, change)) return false;
        for (int i = 0; i < LW_N_Z; i++) change[i] -= motion->z[i];
    }
    return true;
}
#endif

/* Put indicator i on the border. It leans to the side from where the importer sees it leave in the declared direction;
 * if both are declared, to the side from where it will come, after `ahead`. */
static void lw_set_border(lw_instance *self, int i, double z, double ahead) {
    lw_event_memory *events = &self->s.events;
    events->domain[i] = LW_BORDER;
    events->level[i] = z;
    events->lean[i] = lw_events[i].direction ? lw_events[i].direction < 0 : !(ahead > 0.0);
}

/* The jump of the events that have fired, and the border for those that it leaves in contact. */
static bool lw_jump_and_land(lw_instance *self, double t, double *x, const double *u, const double *fired) {
    lw_event_memory *events = &self->s.events;
    for (int i = 0; i < LW_N_Z; i++)
        if (fired[i] != 0.0 && events->resting[i] >= LW_RESTS)
            return lw_fail(self, "the event %s rests in contact at t = %.9g s: its jump leaves its indicator at zero, and the motion "
                           "leads it back beyond at once, %d times in a row. Give the block a state of rest: a discrete state that "
                           "the jump sets and that holds the rates, and an event that ends it.", lw_events[i].name, t, LW_RESTS);
#if LW_N_X
    lw_motion before, after;
    double old[LW_N_X];
    memcpy(old, x, sizeof old);
    const bool known = lw_find_motion(self, t, x, u, &before);
    if (!lw_apply_jump(self, t, x, u, fired)) return false;
    if (!known || !memcmp(old, x, sizeof old) || !lw_find_motion(self, t, x, u, &after)) return true;
    for (int i = 0; i < LW_N_Z; i++) {
        const double side = events->domain[i] == LW_ABOVE ? 1.0 : -1.0;
        if (fired[i] == 0.0 || !lw_is_contact(side, before.z[i], after.z[i], after.twice[i])) continue;
        if (after.once[i] == before.once[i] && !events->resting[i]) continue;
        events->side[i] = (uint8_t)(events->domain[i] + 1);
        lw_set_border(self, i, after.z[i], after.twice[i]);
    }
    return true;
#else
    return lw_apply_jump(self, t, x, u, fired);
#endif
}

/* ---- one instant ---- */

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
        if (!lw_jump_and_land(self, t, x, u, fired)) return false;
        *any = true;
    }
}

/* Set the domains at the end of initialization; no event fires. */
static bool lw_start_domains(lw_instance *self) {
    double *v = self->s.values, z[LW_N_Z], *ahead = NULL;
    memset(&self->s.events, 0, sizeof self->s.events);
    if (lw_call(self, lw_indicator, v, v + LW_X, v + LW_U, z))
        return lw_fail(self, "the event indicators can't be evaluated at t = %.9g s.", v[0]);
    if (!lw_check_finite(self, z, LW_Z, LW_N_Z, v[0])) return false;
#if LW_N_X
    lw_motion motion;
    if (lw_find_motion(self, v[0], v + LW_X, v + LW_U, &motion)) ahead = motion.twice;
#endif
    for (int i = 0; i < LW_N_Z; i++) {
        self->s.events.domain[i] = z[i] > 0.0 ? LW_ABOVE : LW_BELOW;
        if (z[i] == 0.0) lw_set_border(self, i, 0.0, ahead ? ahead[i] : 0.0);
        self->s.events.last_fired[i] = self->s.events.last_but_one[i] = -INFINITY;
    }
    self->s.have_indicators = 0;
    return true;
}

/* Record that events have been found at t; error if they accumulate there. `size` is the size of times. */
static bool lw_record(lw_instance *self, double t, double size, const double *fired) {
    for (int i = 0; i < LW_N_Z; i++) {
        if (fired[i] == 0.0) continue;
        if (!self->s.events.resting[i] && t - self->s.events.last_but_one[i] <= LW_ZENO * size)
            return lw_fail(self, "the event %s fires faster and faster: 3 times within %.3g s at t = %.9g s, expected events "
                           "apart from each other. Give the model a mode in which it rests (Zeno), or a hysteresis (chattering).",
                           lw_events[i].name, t - self->s.events.last_but_one[i], t);
        self->s.events.last_but_one[i] = self->s.events.last_fired[i];
        self->s.events.last_fired[i] = t;
    }
    return true;
}

/* ---- location of crossings in a step ---- */

/* A point of it, with the indicators and, if there are derivatives, their rates. */
typedef struct {
    double t;
    double z[LW_N_Z], rate[LW_N_Z];
} lw_point;

static void lw_dense_state(lw_instance *self, const lw_span *span, double t, double *x) {
    memcpy(x, t == span->to ? self->next : self->x, LW_N_S * sizeof(double));
    if (t != span->to) lw_interpolate(LW_N_X, 4, self->dense, (t - span->from) / (span->to - span->from), self->x, x);
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

static double lw_value_at(const lw_search *s, int64_t i, double t, bool *lost) {
    lw_point at;
    if (lw_evaluate(s->self, s->span, t, &at)) return at.z[i];
    *lost = true;
    return NAN;
}

/* The time at which indicator i comes into a domain, after a and not after b: as near to the crossing as times resolve. */
static bool lw_locate(lw_instance *self, const lw_span *span, int i, int domain, double a, double b, double *found) {
    const lw_event_memory *events = &self->s.events;
    const lw_search search = {self, span};
    const bool border = events->domain[i] == LW_BORDER;
    const double level = border ? events->level[i] : 0.0;
    const double low = domain == LW_ABOVE ? -INFINITY : border ? fmin(level, 0.0) : nextafter(0.0, INFINITY);
    const double high = domain == LW_ABOVE ? fmax(level, 0.0) : INFINITY;
    bool lost = false;
    const double value_a = lw_value_at(&search, i, a, &lost), value_b = lw_value_at(&search, i, b, &lost);
    const double t = lost ? b : lw_leave(&search, i, low, high, a, value_a, b, value_b, 0.0, &lost);
    *found = lost ? b : t;
    return self->s.mode != LW_TERMINATED; /* an evaluation has failed */
}

/* Is indicator i in a domain somewhere between a and b, where it is not? Its rates show whether it may; bisection finds
 * the extremum. `found` is a time in that domain, NAN if there is none. */
static bool lw_find_excursion(lw_instance *self, const lw_span *span, int i, int domain, lw_point a, lw_point b, double *found) {
    const double towards = domain == LW_ABOVE ? 1.0 : -1.0;
    *found = NAN;
    while (towards * a.rate[i] > 0.0 && towards * b.rate[i] < 0.0 && b.t - a.t > span->resolution) {
        double width = b.t - a.t, middle = a.t + width / 2.0;
        /* between its tangents, a hump stays below the higher of both */
        if (fabs(a.z[i]) > width * fabs(a.rate[i]) && fabs(b.z[i]) > width * fabs(b.rate[i])) return true;
        lw_point at;
        if (!lw_evaluate(self, span, middle, &at)) return false;
        if (lw_domain(self, i, at.z[i]) == domain) {
            *found = middle;
            return true;
        }
        if (towards * at.rate[i] > 0.0) a = at;
        else b = at;
    }
    return true;
}

/* The time of the first event between two points, else INFINITY. Changes of domain that fire no event are recorded. */
static bool lw_first_event(lw_instance *self, const lw_span *span, const lw_point *a, const lw_point *b, double *first) {
    double found[LW_N_Z], flipped[LW_N_Z];
    int other[LW_N_Z];
    *first = INFINITY;
    for (int i = 0; i < LW_N_Z; i++) {
        const int domain = self->s.events.domain[i], end = lw_domain(self, i, b->z[i]);
        const bool border = domain == LW_BORDER;
        double middle = NAN;
        found[i] = flipped[i] = INFINITY;
        /* an excursion: into the other domain, from the border to that from which it does not end in */
        other[i] = domain == LW_BELOW || (border && a->rate[i] > 0.0) ? LW_ABOVE : LW_BELOW;
        if (end != other[i] && !lw_find_excursion(self, span, i, other[i], *a, *b, &middle)) return false;
        const bool left = !isnan(middle); /* and it is back, or beyond, at b */
        if (!left) {
            if (end == domain) continue;
            other[i] = end;
            middle = b->t;
        }
        if (lw_is_declared(i, other[i])) {
            if (!lw_locate(self, span, i, other[i], a->t, middle, &found[i])) return false;
        } else if (left) { /* it left and returned */
            flipped[i] = middle;
            if (end != LW_BORDER && lw_is_declared(i, end) && !lw_locate(self, span, i, end, middle, b->t, &found[i])) return false;
        }
        *first = fmin(*first, found[i]);
    }
    for (int i = 0; i < LW_N_Z; i++)
        if (flipped[i] < *first && isfinite(*first)) lw_set_domain(self, i, other[i]);
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
        if (!lw_jump_and_land(self, v[0], x, v + LW_U, fired)) return false;
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
