/* An exported diagram: its loop, from one communication point to the next, in one block of memory. `exported_plants.c` puts
   the FMUs that are merged into it around this.

   It comes after the loop's files and the diagram's own text, which defines: `lw_memory`, `lw_fill` and `lw_bind`; the seconds
   between two ticks, LW_BASE_NUMERATOR / LW_BASE_DENOMINATOR; LW_N_CLOCKS clocks, `lw_clocks`; LW_N_SETS sets of clocks that
   act together, as bits in `lw_sets`, in the order of the loop's kinds of ticks; LW_HYBRID, whether anything happens between
   ticks; LW_HAS_START and `lw_compute_start`; `lw_renew`. Then `m->hybrid` is the loop with continuous states, else `m->loop` that over ticks.

   A tick acts at the start of a communication step, with the inputs of that step, and not at its end. So a diagram that
   samples the outputs of a plant sees those at the tick if the plant has made its step before. */

#ifndef LW_NEAR
#define LW_NEAR 1e-3 /* of the time between two ticks: a communication point within it is the tick */
#endif
enum { LW_START_PASSES = 5 }; /* with algebraic loops: states that begin with their values, which depend on these */
#if LW_HYBRID
#define LW_LOOP_OF(m) (&(m)->hybrid.l)
#else
#define LW_LOOP_OF(m) (&(m)->loop)
#endif

/* The time of a tick, or the length of so many, in s: the double that is nearest as long as they are integers of 53 bits. */
static inline double lw_time_of(int64_t tick) {
    return (double)(tick * LW_BASE_NUMERATOR) / (double)LW_BASE_DENOMINATOR;
}

/* Whether a time comes before another one, and is not the same but for rounding. */
static inline bool lw_comes_before(double a, double b) { return a < b - LW_NEAR * lw_time_of(1); }

/* Return the clocks that act at a tick, as bits. */
static uint64_t lw_acting_at(int64_t tick) {
    uint64_t acting = 0;
    for (int i = 0; i < LW_N_CLOCKS; i++)
        if (tick >= lw_clocks[i].offset && (tick - lw_clocks[i].offset) % lw_clocks[i].every == 0) acting |= UINT64_C(1) << i;
    return acting;
}

/* Return the kind of a tick: the place of the set of clocks that act; -1: none does, or a set that there is no code for. */
static int64_t lw_kind_of(int64_t tick) {
    const uint64_t acting = lw_acting_at(tick);
    for (int i = 0; i < LW_N_SETS; i++)
        if (lw_sets[i] == acting) return i;
    return -1;
}

/* Return the first tick from one on at which a clock acts; without clocks none ever does. */
static int64_t lw_tick_from(int64_t tick) {
    int64_t first = INT64_MAX;
    for (int i = 0; i < LW_N_CLOCKS; i++) {
        const int64_t since = tick - lw_clocks[i].offset, every = lw_clocks[i].every;
        const int64_t next = since <= 0 ? lw_clocks[i].offset : lw_clocks[i].offset + (since + every - 1) / every * every;
        if (next < first) first = next;
    }
    return first;
}

/* Whether a clock acts at the present instant or before the next one, at the time `to`. */
static inline bool lw_acts_before(const lw_memory *m, double to) {
    return m->tick != INT64_MAX && lw_comes_before(lw_time_of(m->tick), to);
}

/* Whether a tick is due at the present instant. */
static inline bool lw_is_due(const lw_memory *m) { return m->tick != INT64_MAX && !lw_comes_before(m->now, lw_time_of(m->tick)); }

/* Put the time to where a run begins. */
static void lw_put_time(lw_memory *m, double start) {
    const double ticks = start / lw_time_of(1);
    m->now = *LW_LOOP_OF(m)->t = start;
    m->tick = lw_tick_from((int64_t)ceil(ticks - LW_NEAR));
    if (lw_is_due(m)) m->now = *LW_LOOP_OF(m)->t = lw_time_of(m->tick);
}

/* Evaluate a tick of some kind; false: it can't be, and m->lost is the kind. */
static bool lw_evaluate(lw_memory *m, int64_t kind) {
    m->lost = kind;
    return evaluate(LW_LOOP_OF(m), kind) == DONE;
}

/* Compute the states and the held outputs at the start; false: an algebraic loop is not solved, or it can't be done. */
static bool lw_find_start(lw_memory *m) {
    loop *l = LW_LOOP_OF(m);
    newton *loops = LW_START_KIND >= 0 && l->loops ? l->loops + LW_START_KIND : NULL;
    m->lost = LW_START_KIND;
    for (int pass = 0; pass < (loops ? LW_START_PASSES : 1); pass++) {
        if (loops && loops->n && !solve_loops(loops, l->x)) return false;
#if LW_HAS_START
        if (!lw_compute_start(m)) return false;
        memcpy(l->x, m->x_next, (size_t)l->states * sizeof(double));
#endif
    }
    return true;
}

#if !LW_HYBRID

/* Evaluate everything at the start, with the parameters, inputs and states in the memory; false: it can't be. */
static bool lw_begin_loop(lw_memory *m, double start) {
    lw_put_time(m, start);
    if (!lw_find_start(m)) return false;
    return !lw_is_due(m) || lw_evaluate(m, lw_kind_of(m->tick));
}

/* Go through the present instant with the inputs in the memory, and with the tick that is due there where `acts`. */
static bool lw_act(lw_memory *m, bool acts) {
    loop *l = &m->loop;
    if (!acts) return true;
    *l->t = m->now = lw_time_of(m->tick);
    if (!lw_evaluate(m, lw_kind_of(m->tick))) return false;
    memcpy(l->x, l->x_next, (size_t)l->states * sizeof(double));
    m->tick = lw_tick_from(m->tick + 1);
    return true;
}

/* Continue to a time with the inputs in the memory: ticks from the present instant on, before that time. False: the tick
   m->tick can't be evaluated, and nothing of it is taken over. */
static bool lw_go_loop(lw_memory *m, double to) {
    while (lw_acts_before(m, to))
        if (!lw_act(m, true)) return false;
    m->now = to;
    return true;
}

/* Evaluate everything at the present instant, after what happens there: nothing is between ticks. */
static inline bool lw_settle(lw_memory *m) { return (void)m, true; }
#else

/* Write the discontinuities of sources after t, up to and with `end`, in order; where there is no room for all of them, the
   stretch ends at the last one that is written. `late` is when each is seen. Return the end. */
static double lw_find_edges(lw_memory *m, double t, double end, int64_t *count) {
    int64_t n = 0;
    for (double from = t;;) {
        double next = INFINITY, late = INFINITY;
        for (int64_t i = 0; i < LW_N_EDGES; i++)
            if (lw_edges[i].t > from && lw_edges[i].t < next) next = lw_edges[i].t, late = lw_edges[i].late;
        for (int64_t i = 0; i < LW_N_PERIODIC; i++) {
            const double start = lw_periodic[i].t, period = lw_periodic[i].period;
            double k = from < start ? 0.0 : floor((from - start) / period);
            double at = start + k * period;
            while (!is_before(from, at)) at = start + ++k * period;
            if (at < next) next = late = at;
        }
        if (!(next <= end)) break;
        m->edge[n] = next;
        m->late[n++] = late;
        if (n == LW_ROOM_FOR_EDGES) {
            end = next;
            break;
        }
        from = next;
    }
    *count = n;
    return end;
}

static bool lw_note_lost(lw_memory *m, const outcome *out) {
    const hybrid *h = &m->hybrid;
    m->reason = out->reason;
    m->lost = h->p.lost == AT_INSTANT ? h->lost_at : h->between;
    m->now = h->t;
    return false;
}

/* Go through the instant that is reached, with the events there and a tick of some kind. */
static bool lw_land(lw_memory *m, double t, int64_t kind) {
    hybrid *h = &m->hybrid;
    const double times[2] = {t, t}, width = 0.0;
    const int32_t kinds = (int32_t)kind;
    const uint8_t lands = 1;
    double row[1];
    outcome out = {0};
    span s = {.count = 1, .times = times, .widths = &width, .kinds = &kinds, .lands = &lands, .beyond = t, .stays = 1};
    for (int64_t i = 0; i < LW_N_EDGES; i++) /* a source that is seen at a time just after */
        if (lw_edges[i].t == t) m->edge[0] = t, m->late[0] = lw_edges[i].late, s.edges = 1;
    s.edge = m->edge;
    s.late = m->late;
    h->l.skip = INT64_MAX;
    h->inside = 0;
    h->t = t;
    h->w.logged = 0;
    loopwright_go(h, &s, row, &out);
    return out.reason == DONE ? true : lw_note_lost(m, &out);
}

/* Continue between ticks, up to a time. */
static bool lw_flow(lw_memory *m, double t, double to) {
    hybrid *h = &m->hybrid;
    const double width = to - t;
    const int32_t kind = (int32_t)h->between;
    const uint8_t lands = 1;
    double row[1];
    outcome out = {0};
    h->inside = 0;
    h->t = t;
    while (h->t < to) {
        int64_t edges;
        const double end = lw_find_edges(m, h->t, to, &edges), times[2] = {h->t, end};
        const span s = {.count = 1, .times = times, .widths = &width, .kinds = &kind, .lands = &lands, .beyond = end,
                        .edges = edges, .edge = m->edge, .late = m->late};
        h->l.skip = INT64_MAX;
        loopwright_go_between(h, &s, row, &out);
        if (out.reason == SUSPENDED || (out.reason == DONE && h->t < to)) {
            if (out.reason == DONE) h->inside = 0;
            continue;
        }
        if (out.reason != DONE) return lw_note_lost(m, &out);
    }
    return true;
}

/* Take the domains of the events where everything begins. */
static bool lw_begin_events(lw_memory *m) {
#if LW_N_EVENTS
    hybrid *h = &m->hybrid;
    watch *w = &h->w;
    double *x = here_states(h, w->x);
    memcpy(h->p.x, h->l.x, (size_t)h->l.states * sizeof(double));
    h->p.edge = h->p.left = INFINITY;
    h->p.at = NAN;
    if (!indicate(w, &h->p, m->now, x)) return false;
    for (int64_t i = 0; i < LW_N_EVENTS; i++) {
        const double z = w->z[i];
        w->domain[i] = z > 0.0 ? 1.0 : z == 0.0 && !lw_events_of[i].subsystem ? 0.0 : -1.0;
        ((double *)w->start)[i] = w->domain[i];
        w->slack[i] = 0.0;
        w->low[i] = -w->hysteresis[i];
        w->high[i] = w->hysteresis[i];
    }
#if LW_HAS_LEFT
    double both[2 * LW_N_EVENTS];
    if (!lw_compute_left(m, both)) return false;
    for (int64_t i = 0; i < LW_N_EVENTS; i++)
        if (both[i] != both[LW_N_EVENTS + i] && isfinite(both[i])) w->domain[i] = both[i] > 0.0 ? 1.0 : -1.0;
#endif
#endif
    return (void)m, true;
}

static bool lw_begin_loop(lw_memory *m, double start) {
    hybrid *h = &m->hybrid;
    lw_put_time(m, start);
    m->reason = DONE;
    if (!lw_find_start(m)) return false;
    memcpy(h->p.x, h->l.x, (size_t)h->l.states * sizeof(double));
    if (!lw_begin_events(m)) return m->lost = h->between, false;
    return lw_evaluate(m, lw_is_due(m) ? lw_kind_of(m->tick) : h->between);
}

/* Go through the present instant with the inputs in the memory: events of inputs that have jumped, and the tick that is due
   there where `acts`. `lw_settle` evaluates everything then. */
static bool lw_act(lw_memory *m, bool acts) {
    if (acts) m->now = lw_time_of(m->tick);
    if (!lw_land(m, m->now, acts ? lw_kind_of(m->tick) : m->hybrid.between)) return false;
    if (acts) m->tick = lw_tick_from(m->tick + 1);
    return true;
}

/* Evaluate everything at the present instant, after what happens there. */
static bool lw_settle(lw_memory *m) {
    *m->hybrid.l.t = m->now;
    return lw_evaluate(m, m->hybrid.between);
}

/* Continue to a time with the inputs in the memory. What is at the present instant comes first: events of inputs that have
   jumped, and a tick; ticks up to that time follow, but not one at it. */
static bool lw_go_loop(lw_memory *m, double to) {
    const double ticks = to / lw_time_of(1), nearest = floor(ticks + 0.5);
    if (LW_N_CLOCKS && fabs(ticks - nearest) <= LW_NEAR) to = lw_time_of((int64_t)nearest); /* as a run has it */
    m->reason = DONE;
    for (bool first = true;; first = false) {
        const bool acts = lw_is_due(m);
        if (!first && !acts) break;
        if (!lw_act(m, acts)) return false;
        const double next = lw_acts_before(m, to) ? lw_time_of(m->tick) : to;
        if (next > m->now && !lw_flow(m, m->now, next)) return false;
        m->now = next;
        if (!(next < to)) break;
    }
    return lw_settle(m);
}
#endif
