/* The loop over ticks with continuous states between them: a method goes from one discontinuity to the next, events are
   located within its steps, samples between ticks come from its dense output.

   It goes as far as it can. Where it breaks off, `p.lost` says at which of its numbers, and Python says why. */

/* The parts of a turn of the loop are inlined into it: calls take some percent of a tick. */
#if defined(__GNUC__)
#define PART_OF_TURN static inline __attribute__((always_inline))
#else
#define PART_OF_TURN static inline
#endif

/* Begin a stretch that ends at a discontinuity, or at the next tick. */
static inline double begin_stretch(hybrid *h, progress *g, double end) {
    problem *p = &h->p;
    const span *s = g->s;
    method *m = h->methods[h->active];
    enter(h, g, h->t);
    int64_t e = g->e;
    while (e < s->edges && !is_before(h->t, s->edge[e])) e++;
    double jump = e < s->edges ? s->edge[e] : INFINITY;
    if (h->o) jump = smaller(jump, next_outside(h->o, h->t));
    h->jump = jump;
    if (p->delays) jump = smaller(jump, next_edge(p->delays, h->t));
    const double edge = is_before(jump, end) ? jump : end;
    p->edge = p->stop = edge;
    p->left = larger(h->t, left_of(edge));
    if (p->delays) p->delays->middle = 0.5 * (h->t + edge);
    for (int64_t i = 0; i < p->n; i++) m->x[i] = h->l.x[p->where[i]];
    restart(m, h->t);
    h->begun = 1;
    return edge;
}

/* Whether the run ends at the instant that has been evaluated. */
static inline bool is_at_end(const hybrid *h) { return is_stopped(&h->l) || (h->o && has_ended(h->o)); }

/* Let the method take a step, and find the first event in it. DONE, or why it goes no further. */
PART_OF_TURN int64_t take_a_step(hybrid *h, double end, int64_t *steps) {
    problem *p = &h->p;
    method *m = h->methods[h->active];
    if ((*steps)++ > h->budget) return SUSPENDED;
    if (p->delays && !has_room_for_step(p->delays)) return SUSPENDED;
    if (h->o && h->o->apart && h->o->apart->late && *steps > 1) return SUSPENDED;
    if (take_step(m) != PASSED) {
        const bool other = h->automatic && m->kind != RADAU && p->lost == IN_STEP;
        if (!other || (h->o && h->o->failed)) return break_off(h, h->t, LOST);
        h->switched = STUCK;
        h->begun = 0;
        return LOOK;
    }
    if (h->automatic) look_for_stiffness(h, m);
    h->to = m->t;
    h->counts_as = INFINITY;
    h->found = 0;
    if (h->w.m && !h->w.sliding) {
        const int where = locate(&h->w, p, m, &h->to);
        if (where == LOST) return break_off(h, h->t, LOST);
        h->found = where == EVENT;
        if (h->found && p->loops)
            for (int64_t i = 0; i < p->loops->n; i++) h->solved[i] = p->x[p->loops->where[i]];
        if (h->found && m->t == end && end - h->to <= ULPS * ulp(end)) h->to = end;
    }
    h->stepped = 1;
    return DONE;
}

/* Record the samples within the step, from its dense output, and up to its end where nothing happens there. */
PART_OF_TURN int64_t sample_step(hybrid *h, progress *g) {
    const span *s = g->s;
    method *m = h->methods[h->active];
    while (g->i < s->count && !s->lands[g->i]) {
        const double t = s->times[g->i + 1];
        if (!(t < h->to || (t == h->to && t < h->p.edge && !h->found))) break;
        if (h->found && h->to - t <= ULPS * ulp(t)) { /* the event belongs to the sample, which is taken after it */
            h->counts_as = t;
            break;
        }
        if (!has_room(h, g)) return SUSPENDED;
        interpolate(m, t, m->y);
        stand_at(h, t, m->y);
        if (!evaluate_here(h, h->between)) return break_off(h, t, LOST);
        g->out->rows = record(&h->l, t, g->rows, g->out->rows);
        g->i++;
        if (is_stopped(&h->l)) {
            h->t = t;
            h->inside = 0;
            return ENDED;
        }
    }
    return DONE;
}

/* Put the states to the end of the step, or to the event in it; blocks take over what they remember, where they are asked. */
PART_OF_TURN int64_t end_step(hybrid *h, double end) {
    problem *p = &h->p;
    method *m = h->methods[h->active];
    if (p->delays && h->to > m->t_old && !keep_pieces(p->delays, p, m, m->t_old, h->to, DEEPEST))
        return break_off(h, h->t, LOST);
    if (h->found)
        interpolate(m, h->to, m->y);
    else
        memcpy(m->y, m->x, (size_t)m->n * sizeof(double));
    stand_at(h, h->to > p->left ? p->left : h->to, m->y);
    if (h->accepts && (h->accepts == 1 || h->to < end || h->found) && !accept(h)) return break_off(h, h->to, LOST);
    return DONE;
}

/* Tell the FMUs in model exchange that the step has ended, at t, and settle the events that they have there. */
static inline int64_t end_step_of_fmus(hybrid *h, double t, double end, bool *happened) {
    int result = report_step(h);
    if (result == EVENT && !h->found) {
        *happened = true;
        result = settle(h, t, false);
        if (result < LOST && has_ended(h->o) && !accept(h)) result = LOST;
    }
    if (result >= LOST) return break_off(h, t, result);
    h->looked = t == end && !*happened && !h->l.plants && is_before(end, h->jump) ? end : NAN;
    return DONE;
}

/* Let the events fire that were found at a time, and count as being at t. */
PART_OF_TURN int64_t fire_found(hybrid *h, double t, double at) {
    problem *p = &h->p;
    if (p->loops) /* as the indicators saw them */
        for (int64_t i = 0; i < p->loops->n; i++) h->l.x[p->loops->where[i]] = h->solved[i];
    const int result = fire(h, t, at);
    *h->l.t = t;
    if (result >= LOST) return break_off(h, t, result);
    look_for_sliding(&h->w);
    return DONE;
}

/* Go beyond a discontinuity of a source at t, with the events that it makes. */
static inline int64_t pass_discontinuity(hybrid *h, progress *g, double t, bool *happened) {
    enter(h, g, t);
    if (h->w.m || h->o) {
        const int result = settle(h, t, false);
        if (result >= LOST) return break_off(h, t, result);
        *happened |= result == EVENT;
    }
    return evaluate_here(h, h->between) ? DONE : break_off(h, t, LOST);
}

/* Record the instant t that has been reached, if it is a sample, or the run ends there; DONE: it continues. */
PART_OF_TURN int64_t sample_instant(hybrid *h, progress *g, double t, double end, bool happened) {
    const span *s = g->s;
    const bool is_sample = g->i < s->count && !s->lands[g->i] && s->times[g->i + 1] == t && t < end;
    if (!is_sample && !(happened && is_at_end(h))) return DONE;
    g->out->rows = record(&h->l, t, g->rows, g->out->rows);
    g->i += is_sample;
    if (!is_at_end(h)) return DONE;
    h->inside = 0;
    return ENDED;
}

/* Continue to the next tick that is landed on; DONE: it is reached. Each turn is one step of the method: it ends at an event,
   at a discontinuity, at the tick, or where the method has come to. Whoever breaks it off may call it again: `begun` and
   `stepped` say what has been done. */
static inline int64_t go_between(hybrid *h, progress *g, int64_t *steps) {
    const span *s = g->s;
    problem *p = &h->p;
    const int64_t landing = landing_of(g);
    const double end = landing < s->count ? s->times[landing + 1] : s->beyond;
    int64_t reason;
    while (h->t < end) {
        if (!h->begun) begin_stretch(h, g, end);
        const double edge = p->edge;
        method *m = h->methods[h->active];
        if (!h->stepped && (reason = take_a_step(h, end, steps)) != DONE) return reason;
        if ((reason = sample_step(h, g)) != DONE) return reason;
        if (g->i == s->count && landing == s->count) return SUSPENDED;
        if (!has_room(h, g)) return SUSPENDED; /* the instant itself may be a sample */
        if ((reason = end_step(h, end)) != DONE) return reason;
        /* What happens at the instant: FMUs and events first, then a discontinuity of a source. */
        const double at = h->to, t = h->found && h->counts_as < at ? h->counts_as : at;
        bool happened = h->found;
        if (h->o && (reason = end_step_of_fmus(h, t, end, &happened)) != DONE) return reason;
        h->stepped = 0;
        if (h->found && (reason = fire_found(h, t, at)) != DONE) return reason;
        h->t = t;
        if (t == edge && p->delays) note_reached(p->delays, t, !is_before(t, h->jump));
        if (t == edge && edge < end && (reason = pass_discontinuity(h, g, t, &happened)) != DONE) return reason;
        if (t == edge || happened) h->begun = 0;
        if (!h->begun && (happened || t < end)) m->has_slope = 0;
        if ((reason = sample_instant(h, g, t, end, happened)) != DONE) return reason;
        if (h->switched) return LOOK;
        if (h->o && has_other_nominals(h->o)) return SUSPENDED;
    }
    return DONE;
}

/* Go through ticks and the instants between them, as far as it goes. */
VISIBLE void loopwright_go(hybrid *h, const span *s, double *rows, outcome *out) {
    progress g = {s, rows, out, 0, 0, -1};
    int64_t steps = 0;
    out->rows = 0;
    out->reason = DONE;
    while (g.i < s->count) {
        if (is_halted(&h->l)) {
            out->reason = HALTED;
            break;
        }
        if (!h->inside) {
            h->inside = 1;
            h->begun = h->stepped = 0;
            h->w.sliding = h->w.sliding && h->w.switched; /* events are located again if none has fired at the end */
            h->w.switched = 0;
        }
        if (!h->coupled && (out->reason = go_between(h, &g, &steps)) != DONE) break;
        if (!has_room(h, &g)) {
            out->reason = SUSPENDED;
            break;
        }
        if ((out->reason = land(h, &g)) != DONE) break;
    }
    out->ticks = g.i;
}

/* Continue to an instant before any tick there, within a step of the plants; the span ends there. */
VISIBLE void loopwright_go_between(hybrid *h, const span *s, double *rows, outcome *out) {
    progress g = {s, rows, out, 0, 0, -1};
    int64_t steps = 0;
    out->ticks = out->rows = 0;
    if (!h->inside) {
        h->inside = 1;
        h->begun = h->stepped = 0;
    }
    out->reason = go_between(h, &g, &steps);
}

/* Note at which trial of a step that has failed a rate is not finite; see `problem`. */
VISIBLE void loopwright_note_beyond(hybrid *h) { note_beyond(h->methods[h->active]); }
