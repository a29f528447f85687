/* One instant of a run with continuous states: its values from the right, the events that fire there, the tick. */

/* Reasons, after those of the loop over ticks. */
enum { SUSPENDED = HALTED + 1, ENDED, LOOK, OUTSIDE_FAILED, PILED_UP, BROKEN_OFF };
enum { STIFF = 1, EASY, STUCK }; /* signs that another method may continue: the last one is that this one can't */

/* Ticks and instants to be recorded. */
typedef struct {
    int64_t count;
    const double *times, *widths; /* times[0] is where they begin; widths in s since the tick before */
    const int32_t *kinds;
    const uint8_t *lands;         /* 0: an instant that is recorded from the dense output */
    double beyond;                /* first tick after them that is landed on */
    int64_t edges;
    const double *edge, *late;    /* discontinuities of sources; when they are seen at the time itself */
    int64_t room;                 /* rows that can be written */
    int64_t stays;                /* whether the first tick is where the run is: no plant steps to it */
} span;

typedef struct hybrid {
    loop l;
    problem p;
    watch w;
    method *methods[2]; /* one that is not stiff, and one that is for where it is */
    int64_t active, automatic, accepts, between, budget;
    int64_t inside;     /* whether an interval between two ticks has begun */
    int64_t begun, stepped;
    double t;           /* time that the states have reached */
    double to;          /* end of the step that is taken, at an event perhaps */
    double counts_as;   /* sample to which the event there belongs, a few ulps before; else infinite */
    int64_t found;
    int64_t hits, misses, easy;
    int64_t outputs;    /* entries of the log before those of the states */
    const int64_t *taken, *taken_first; /* states that a tick of each kind renews */
    double *taken_states;
    double *before;     /* states before FMUs act */
    int64_t switched;   /* a sign that another method may continue, and has to be looked at */
    double *solved;     /* values of the algebraic loops at an event */
    double looked_at;   /* step in s at which it seemed so */
    outside *o;         /* FMUs in model exchange; NULL without any */
    double jump;        /* first discontinuity of a source, or event of time of an FMU, behind the stretch's begin */
    void (*drain)(void); /* Python takes the events that have been logged; NULL: nobody does */
    int64_t coupled;    /* whether the continuous states continue within the steps of the plants */
    int64_t lost_at;    /* kind of the tick that can't be evaluated */
    double looked;      /* tick at which they have been looked at, and before which nothing changes any more */
} hybrid;

typedef struct {
    const span *s;
    double *rows;
    outcome *out;
    int64_t i, e, landing;
} progress;

/* Return the tick that is landed on next, behind the instants of the span if it is not among them. */
static inline int64_t landing_of(progress *g) {
    if (g->landing < g->i)
        for (g->landing = g->i; g->landing < g->s->count && !g->s->lands[g->landing];) g->landing++;
    return g->landing;
}

/* Move to an instant, beyond any discontinuity there. */
static inline void enter(hybrid *h, progress *g, double t) {
    problem *p = &h->p;
    const span *s = g->s;
    p->edge = p->left = INFINITY;
    while (g->e < s->edges && s->edge[g->e] < t) g->e++;
    p->at = NAN;
    if (g->e < s->edges && s->edge[g->e] == t) p->at = t, p->late = s->late[g->e];
    *h->l.t = t;
    memcpy(p->x, h->l.x, (size_t)h->l.states * sizeof(double));
    if (p->delays) {
        p->delays->middle = t + 1.0;
        put_delayed(p->delays, t, p->delays->here);
        memcpy(p->delays->trial, p->delays->here, (size_t)p->delays->outputs * sizeof(double));
    }
}

static inline void put_states(hybrid *h, const double *x) {
    for (int64_t i = 0; i < h->p.n; i++) h->l.x[h->p.where[i]] = x[i];
}

/* Move to a time of the last step, with these states. */
static inline void stand_at(hybrid *h, double t, const double *x) {
    put_states(h, x);
    *h->l.t = t;
    if (h->p.delays) put_delayed(h->p.delays, t, h->p.delays->here);
}

/* Evaluate everything at the present instant; false: the run can't continue. */
static inline bool evaluate_here(hybrid *h, int64_t kind) {
    if (evaluate(&h->l, kind) == DONE) return true;
    h->p.lost = AT_INSTANT;
    h->lost_at = kind;
    return false;
}

/* Evaluate everything at the present instant between ticks; take over what blocks remember, if asked for. */
static inline bool accept(hybrid *h) {
    if (!evaluate_here(h, h->between)) return false;
    memcpy(h->l.x, h->l.x_next, (size_t)h->l.states * sizeof(double));
    memcpy(h->p.x, h->l.x, (size_t)h->l.states * sizeof(double));
    return true;
}

/* End the events of an instant: what goes into delays may have jumped. */
static inline bool end_events(hybrid *h, double t) {
    if (h->p.delays) note_edge(h->p.delays, t, 0.0);
    return accept(h);
}

static inline bool has_room(const hybrid *h, const progress *g) { return h->l.skip || g->out->rows < g->s->room; }


/* Look for signs that stability bounds an explicit method's steps, or that it would no longer; Python decides
   (diagrams/solvers/choose.py). */
static void look_for_stiffness(hybrid *h, const method *m) {
    const int64_t n = m->n, last = m->stages - 1;
    const double width = m->t - m->t_old;
    if (m->sliver) return;
    if (m->kind == RADAU) {
        double norm = 0.0;
        for (int64_t i = 0; i < n; i++) {
            double sum = 0.0;
            for (int64_t j = 0; j < n; j++)
                sum += fabs(m->J[i * n + j]) * (m->atol[j] + m->rtol * fabs(m->x[j]));
            norm = fmax(norm, sum / (m->atol[i] + m->rtol * fabs(m->x[i])));
        }
        h->easy = width * norm < 1.0 ? h->easy + 1 : 0;
        if (h->easy >= 20) h->easy = 0, h->switched = EASY, h->looked_at = width;
        return;
    }
    if (!h->hits && m->steps % 10) return;
    double change = 0.0, apart = 0.0;
    for (int64_t i = 0; i < n; i++) {
        double argument = 0.0;
        for (int64_t j = 0; j < last; j++) argument += m->A[last * m->stages + j] * m->K[j * n + i];
        const double weight = 1.0 / (m->atol[i] + m->rtol * fabs(m->x[i]));
        const double a = (m->x[i] - (m->x_old[i] + width * argument)) * weight;
        const double c = (m->K[(last + 1) * n + i] - m->K[last * n + i]) * weight;
        apart += a * a;
        change += c * c;
    }
    const double product = apart > 0.0 ? width * sqrt(change / apart) : 0.0;
    if (!(product > (m->kind == EIGHT ? 6.1 : 3.25))) {
        if (++h->misses >= 6) h->hits = h->misses = 0;
        return;
    }
    h->misses = 0;
    if (++h->hits < 15) return;
    h->hits = 0;
    h->switched = STIFF;
    h->looked_at = width;
}

/* --- events that fire ---------------------------------------------------------------------------------------------- */

static double *here_states(hybrid *h, double *x) {
    for (int64_t i = 0; i < h->p.n; i++) x[i] = h->l.x[h->p.where[i]];
    return x;
}

/* Write the indicators at an instant, and their changes in one and in two steps of Euler's method. */
static bool move_on(hybrid *h, double t, double *out) {
    watch *w = &h->w;
    problem *p = &h->p;
    method *m = h->methods[h->active];
    const int64_t n = p->n, count = w->m;
    double *x = here_states(h, w->x);
    for (int k = 0; k < 3; k++) {
        if (!indicate(w, p, t, x)) return false;
        for (int64_t i = 0; i < count; i++) out[k * count + i] = k ? w->z[i] - out[i] : w->z[i];
        if (k == 2) break;
        rate(p, t, x, m->K);
        for (int64_t i = 0; i < n; i++) x[i] += w->spacing * m->K[i];
    }
    return true;
}

/* Whether a jump has left an indicator in contact, or might have: its motion then leads on beyond. */
static bool is_contact(const watch *w, const problem *p, const double *x, const double *before, int64_t i) {
    const int64_t m = w->m;
    const double *old = w->motion, *new = w->motion + 3 * m, side = w->domain[i];
    if (!lw_is_contact(side, old[i], new[i], new[2 * m + i])) return false;
    bool moved = false;
    for (int64_t j = w->own_first[i]; j < w->own_first[i + 1]; j++) moved |= x[w->own[j]] != before[w->own[j]];
    return moved && (new[m + i] != old[m + i] || w->stuck[i] != 0.0);
}

/* Note why the run can't continue. */
static int pile_up(watch *w, int64_t pile, int64_t culprit, int64_t times) {
    w->pile = pile;
    w->culprit = culprit;
    w->piled = times;
    return PILED;
}

/* Whether an impact has taken energy, and the flight after it is too brief to be told from a rest: it leaves with v h in
   one step of Euler's method and 2 v h - a h^2 in two; its flight takes 2 v/a = 2 v h/(a h^2) steps. */
static bool is_brief(const watch *w, int64_t i) {
    const double *old = w->motion, *new = w->motion + 3 * w->m, side = w->domain[i];
    const double leaving = -side * new[w->m + i], fall = 2.0 * leaving + side * new[2 * w->m + i];
    return 2.0 * leaving <= BRIEF * fall && fabs(new[w->m + i]) <= LESS * fabs(old[w->m + i]);
}

/* Put an indicator on the border that a jump has left it at. PILED: its flights have become ever briefer, to a rest. */
static int land_on(watch *w, int64_t i, double t) {
    const double z = w->motion[3 * w->m + i];
    const bool brief = is_brief(w, i);
    w->side[i] = w->domain[i];
    w->domain[i] = 0.0;
    w->low[i] = fmin(z, -w->hysteresis[i]);
    w->high[i] = fmax(z, w->hysteresis[i]);
    if (!brief) return EVENT;
    const bool in_a_row = w->brief_at[i] <= t && t <= w->brief_at[i] + APART * w->spacing;
    w->briefs[i] = in_a_row ? w->briefs[i] + 1.0 : 1.0;
    w->brief_at[i] = t;
    return w->briefs[i] >= BRIEFS ? pile_up(w, IN_CONTACT, i, (int64_t)w->briefs[i]) : EVENT;
}

/* Note that an event fires. PILED: it rests in contact, or its intervals shrink by one ratio (Zeno behaviour). */
static int count_event(watch *w, int64_t i, double t) {
    double *latest = w->latest + LATEST * i;
    int64_t count = (int64_t)w->counts[i];
    if (w->stuck[i] >= RESTS) return pile_up(w, IN_CONTACT, i, RESTS);
    if (count) w->largest[i] = fmax(w->largest[i], t - latest[count - 1]);
    if (count == LATEST)
        memmove(latest, latest + 1, (LATEST - 1) * sizeof(double));
    else
        w->counts[i] = (double)++count;
    latest[count - 1] = t;
    if (count < LATEST || t - latest[LATEST - 2] > SHRUNK * w->largest[i]) return EVENT;
    for (int k = 1; k < LATEST; k++) {
        const double span = latest[k] - latest[k - 1];
        if (!(span > 1e3 * ulp(t))) return EVENT;
        if (k > 1 && !(span < 1.5 * (latest[k - 1] - latest[k - 2]))) return EVENT; /* but for what the solver adds */
    }
    const double part = (t - latest[LATEST - 2]) / (latest[1] - latest[0]);
    return pow(part, 1.0 / (LATEST - 2)) < 0.9999 ? pile_up(w, ZENO, i, LATEST) : EVENT;
}

/* Return the event that has fired most at the latest instants. */
static int64_t most_of(const watch *w, int64_t instants) {
    int64_t found = 0, most = -1;
    for (int64_t i = 0; i < w->m; i++) {
        int64_t count = 0;
        for (int64_t k = w->fired_times - instants; k < w->fired_times; k++)
            count += w->recent_fired[(k % RECENT) * w->m + i];
        if (count > most) most = count, found = i;
    }
    return found;
}

/* Note an instant at which events fire. PILED: they chatter. */
static int count_instant(watch *w, double t) {
    memcpy(w->recent_fired + w->fired_times % RECENT * w->m, w->fires, (size_t)w->m);
    w->recent[w->fired_times++ % RECENT] = t;
    if (w->fired_times < RECENT || !(t - w->recent[w->fired_times % RECENT] < 1e-8 * (1.0 + fabs(t)))) return EVENT;
    return pile_up(w, CHATTERS, most_of(w, RECENT), RECENT);
}

/* Let the events of a fixed step wait for its end from here on if a few have just followed each other at once. */
static void look_for_sliding(watch *w) {
    if (isnan(w->step) || w->fired_times < SLIDES) return;
    const double last = w->recent[(w->fired_times - 1) % RECENT], first = w->recent[(w->fired_times - SLIDES) % RECENT];
    if (last - first > SLIDING_PART * w->step) return;
    for (int64_t i = 0; i < w->m; i++)
        if (w->stuck[i] != 0.0) return;
    const int64_t event = most_of(w, SLIDES);
    w->sliding = 1;
    if (isnan(w->slid[event])) w->slid[event] = last;
}

/* Let the domains of a subsystem's events start again where it has just been enabled and its states do so. */
static void reset_domains(const hybrid *h, watch *w, int64_t i) {
    if (w->gate[i] < 0 || !(h->l.x[w->gate[i]] > 0.5)) return;
    for (int64_t j = w->inside_first[i]; j < w->inside_first[i + 1]; j++) w->domain[w->inside[j]] = w->start[w->inside[j]];
}

/* Note events of FMUs' own that have acted at t: all of them but those of inputs that have changed no state. */
static void log_outside(hybrid *h, double t, const double *before) {
    outside *o = h->o;
    const int64_t width = h->l.states;
    for (int64_t j = 0; j < o->count; j++) {
        const exchanged *e = o->each + j;
        const bool same = !memcmp(before + e->first, h->l.x + e->first, (size_t)e->states * sizeof(double));
        if (!e->acted || e->event == FIRED || (e->event == INPUT && same)) continue;
        if (o->logged == o->capacity) h->drain();
        double *row = o->log + o->logged++ * (2 + 2 * width);
        row[0] = t;
        row[1] = (double)(j + o->count * e->event);
        memcpy(row + 2, before, (size_t)width * sizeof(double));
        memcpy(row + 2 + width, h->l.x, (size_t)width * sizeof(double));
    }
}

/* Let FMUs see an instant that is reached, at which events in w->fired fire; the states after it are taken over. */
static bool see(hybrid *h, double t, int64_t look, bool *acted) {
    outside *o = h->o;
    const size_t size = (size_t)h->l.states * sizeof(double);
    h->p.lost = AT_INSTANT;
    h->lost_at = h->between;
    o->look = look;
    *acted = false;
    for (int64_t j = 0; j < o->count; j++) o->each[j].acted = 0;
    if (o->failed || (h->p.loops && !solve_loops(h->l.loops + h->between, h->l.x))) return false; /* states may have jumped */
    memcpy(h->before, h->l.x, size);
    if (call(&o->jump)) return false;
    memcpy(h->l.x, h->l.x_next, size);
    memcpy(h->p.x, h->l.x, size);
    for (int64_t j = 0; j < o->count; j++) *acted |= o->each[j].acted;
    if (*acted) log_outside(h, t, h->before);
    return true;
}

static void fire_none(hybrid *h) {
    for (int64_t i = 0; i < h->w.m; i++) h->w.fired[i] = 0.0;
}

/* Let events of FMUs' own act, until there are none. */
static int look_outside(hybrid *h, double t) {
    fire_none(h);
    for (int round = 0; round < ROUNDS; round++) {
        bool acted;
        if (!see(h, t, TO_EVENTS, &acted)) return LOST;
        if (!acted) return round ? EVENT : QUIET;
    }
    for (int64_t j = 0; j < h->o->count; j++)
        if (h->o->each[j].acted) return pile_up(&h->w, ENDLESS_OUTSIDE, j, ROUNDS);
    return LOST; /* not reached */
}

/* Note the events that fire at t, with the states before them. */
static void log_before(hybrid *h, double t) {
    watch *w = &h->w;
    const int64_t width = h->l.states, row = 2 + 2 * width;
    int64_t count = 0;
    for (int64_t i = 0; i < w->m; i++) count += w->fires[i];
    if (w->logged + count > w->capacity) {
        if (h->drain)
            h->drain();
        else
            w->logged = 0; /* nobody takes them */
    }
    double *log = w->log + w->logged * row;
    for (int64_t i = 0; i < w->m; i++) {
        if (!w->fires[i]) continue;
        log[0] = t;
        log[1] = (double)i;
        memcpy(log + 2, h->l.x, (size_t)width * sizeof(double));
        log += row;
    }
}

/* Let the jumps of the events in w->fired act. */
static bool jump(hybrid *h, double at) {
    problem *p = &h->p;
    bool acted;
    if (h->o) return see(h, at, TO_EVENTS, &acted);
    p->lost = AT_INSTANT;
    h->lost_at = h->between;
    if ((p->loops && !solve_loops(h->l.loops + h->between, h->l.x)) || call(&h->w.jump)) return false;
    memcpy(h->l.x, h->l.x_next, (size_t)h->l.states * sizeof(double));
    memcpy(p->x, h->l.x, (size_t)h->l.states * sizeof(double));
    return true;
}

/* Let the events in w->fires fire at t, and those that they make fire; jumps are evaluated at `at`, a few ulps later
   perhaps. LOST or PILED: the run can't continue. */
static int fire(hybrid *h, double t, double at) {
    watch *w = &h->w;
    problem *p = &h->p;
    const int64_t width = h->l.states, row = 2 + 2 * width;
    for (int round = 0; round < ROUNDS; round++) {
        bool moves = false;
        for (int64_t i = 0; i < w->m; i++) {
            w->fired[i] = w->fires[i];
            moves |= w->fires[i] && w->own_first[i] < w->own_first[i + 1];
        }
        memcpy(w->following, w->fires, (size_t)w->m);
        here_states(h, w->x_before);
        if (moves && !move_on(h, at, w->motion)) return LOST;
        log_before(h, t);
        if (!jump(h, at)) return LOST;
        *w->fresh = 1.0;
        for (int64_t i = 0; i < w->m; i++) {
            if (!w->fires[i]) continue;
            memcpy(w->log + w->logged++ * row + 2 + width, h->l.x, (size_t)width * sizeof(double));
            reset_domains(h, w, i);
        }
        for (int64_t i = 0; i < w->m; i++)
            if (w->fires[i] && count_event(w, i, t) == PILED) return PILED;
        if (count_instant(w, t) == PILED) return PILED;
        if (moves) {
            if (!move_on(h, at, w->motion + 3 * w->m)) return LOST;
            here_states(h, w->x);
            for (int64_t i = 0; i < w->m; i++)
                if (w->fires[i] && is_contact(w, p, w->x, w->x_before, i) && land_on(w, i, at) == PILED) return PILED;
        }
        if (!indicate(w, p, at, here_states(h, w->x))) return LOST;
        bool again = take_domains(w, w->domain, w->now, w->fires);
        take_fired(w);
        if (!again && h->o) {
            const int outside = look_outside(h, at);
            if (outside >= LOST) return outside;
            if (outside == EVENT) {
                if (!indicate(w, p, at, here_states(h, w->x))) return LOST;
                again = take_domains(w, w->domain, w->now, w->fires);
                take_fired(w);
            }
        }
        if (!again) return end_events(h, t) ? EVENT : LOST;
    }
    for (int64_t i = 0; i < w->m; i++)
        if (w->fires[i]) return pile_up(w, ENDLESS, i, ROUNDS);
    return LOST; /* not reached */
}

/* Fire at a tick what changes its domain within a few ulps of time. */
static int fire_ahead(hybrid *h, double t) {
    watch *w = &h->w;
    problem *p = &h->p;
    method *m = h->methods[h->active];
    bool near = false, any = false;
    for (int64_t i = 0; i < w->m; i++) near |= w->size[i] > 0.0 && fabs(w->later[i]) <= CLOSE * w->size[i];
    if (!near || !(t > 0.0)) return QUIET;
    const double later = t + ULPS * ulp(t);
    double *x = here_states(h, w->x);
    rate(p, t, x, m->K);
    for (int64_t i = 0; i < p->n; i++) x[i] += (later - t) * m->K[i];
    if (!indicate(w, p, later, x)) return LOST;
    for (int64_t i = 0; i < w->m; i++) {
        w->now[i] = domain_of(w, i, w->z[i], w->open[i], w->domain[i], w->slack[i]);
        any |= w->fires[i] = fires_at(w, i, w->domain[i], w->now[i]);
    }
    if (!any) return QUIET;
    for (int64_t i = 0; i < w->m; i++) {
        if (w->fires[i])
            w->slack[i] = slack_after(w, i, fmax(fabs(w->z[i]), fabs(w->later[i])));
        else
            w->now[i] = w->domain[i];
    }
    take_fired(w);
    *h->l.t = later;
    put_states(h, x);
    memcpy(p->x, h->l.x, (size_t)h->l.states * sizeof(double));
    const int result = fire(h, t, later);
    *h->l.t = t;
    return result;
}

/* Fire what has changed its domain at an instant; ahead: at a tick, to which events belong that are a few ulps later. */
static int settle(hybrid *h, double t, bool ahead) {
    watch *w = &h->w;
    const bool known = ahead && h->looked == t;
    int result = QUIET;
    h->looked = NAN;
    for (int round = 0; round < 2; round++) {
        if (w->m) {
            if (!indicate(w, &h->p, t, here_states(h, w->x))) return LOST;
            memcpy(w->later, w->z, (size_t)w->m * sizeof(double));
            const bool any = take_domains(w, w->domain, w->now, w->fires);
            take_fired(w);
            if (any) {
                w->switched = 1;
                if ((result = fire(h, t, t)) >= LOST || !ahead) return result;
                if (!indicate(w, &h->p, t, here_states(h, w->x))) return LOST;
                memcpy(w->later, w->z, (size_t)w->m * sizeof(double));
            }
        }
        if (round) return end_events(h, t) ? EVENT : LOST;
        const int later = w->m && ahead ? fire_ahead(h, t) : QUIET;
        if (later >= LOST) return later;
        if (later == EVENT) result = EVENT;
        if (!h->o || (known && result == QUIET)) return result;
        const int outside = look_outside(h, t);
        if (outside != EVENT) return outside >= LOST ? outside : result;
    }
    return LOST; /* not reached */
}

/* --- a tick -------------------------------------------------------------------------------------------------------- */

/* The run can't continue from the present instant: Python says why. */
static int64_t break_off(hybrid *h, double t, int result) {
    h->t = t;
    return result == PILED ? PILED_UP : h->o && h->o->failed ? OUTSIDE_FAILED : BROKEN_OFF;
}

/* Tell FMUs that a step is complete; EVENT: one wants an event there, or the end of the run. */
static int report_step(hybrid *h) {
    bool acted;
    fire_none(h);
    if (!see(h, *h->l.t, TO_STEP, &acted)) return LOST;
    for (int64_t j = 0; j < h->o->count; j++)
        if (h->o->each[j].asks || h->o->each[j].ended) return EVENT;
    return QUIET;
}

/* Go through a tick that the continuous states have reached: FMUs, events before and after it, a sample. */
static inline int64_t land(hybrid *h, progress *g) {
    const span *s = g->s;
    loop *l = &h->l;
    const int64_t i = g->i, kind = s->kinds[i];
    const double t = s->times[i + 1];
    if (!s->stays || i) {
        const int64_t reason = step_plants(l, i, s->times[i], s->widths[i], g->out);
        if (reason != DONE) return h->inside = 0, reason;
    }
    enter(h, g, t);
    if (h->w.m || (h->o && kind != h->between)) {
        const int result = settle(h, t, true);
        if (result >= LOST) return break_off(h, t, result);
    }
    if (!evaluate_here(h, kind)) return break_off(h, t, LOST);
    memcpy(l->x, l->x_next, (size_t)l->states * sizeof(double));
    if (h->p.delays && (kind != h->between || l->plants)) note_edge(h->p.delays, t, 0.0); /* held signals have jumped */
    if (h->w.m || h->o) {
        enter(h, g, t);
        double *states = (double *)l->log + h->outputs;
        memcpy(h->taken_states, states, (size_t)l->states * sizeof(double));
        const int result = settle(h, t, false);
        if (result >= LOST) return break_off(h, t, result);
        if (result == EVENT)
            for (int64_t j = h->taken_first[kind]; j < h->taken_first[kind + 1]; j++)
                states[h->taken[j]] = h->taken_states[h->taken[j]];
    }
    h->inside = 0;
    hold_inputs(l, i);
    g->out->rows = record(l, t, g->rows, g->out->rows);
    g->i++;
    return is_stopped(l) || (h->o && (has_ended(h->o) || has_other_nominals(h->o))) ? STOPPED : DONE;
}
