/* FMUs that are merged into an exported diagram: they step at their own ticks, from one to the next, with the inputs that
   they have taken there, as in a run. Without any, all this is the loop alone.

   It comes after exported.c. Generated before it: LW_N_MERGED, LW_MOST_MERGED of one, and behind the memory `lw_merged`. In the memory: `held`, the
   inputs of their present steps; `reached`, the tick that each has come to, -1 for a start between two ticks, which is at
   `begun`; `exchange`, the next tick at which one of them has come to its end; `culprit`, the number of the one that has
   failed, from 1 on; `said`, what it has said: its category, then the text. */

#if !LW_N_MERGED

static bool lw_begin(lw_memory *m, double start) { return lw_begin_loop(m, start); }
static inline void lw_take_inputs(lw_memory *m) { (void)m; }

#else

#define LW_MOST_PASSES 100
#define LW_SETTLED 1e-12 /* relative change of an output at the start that is rounding */

static inline bool lw_accuse(lw_memory *m, int plant) { return m->culprit = plant + 1, false; }

/* Return the first tick after one that is a communication point of a plant. */
static int64_t lw_next_of_plant(const lw_merged_plant *p, int64_t tick) {
    int64_t first = INT64_MAX;
    for (int i = 0; i < p->clocks; i++) {
        const int64_t every = p->due[i][0], offset = p->due[i][1];
        const int64_t next = tick < offset ? offset : offset + ((tick - offset) / every + 1) * every;
        if (next < first) first = next;
    }
    return first;
}

/* Return the first tick after one that is a communication point of any plant. */
static int64_t lw_next_exchange(int64_t tick) {
    int64_t first = INT64_MAX;
    for (int j = 0; j < LW_N_MERGED; j++) {
        const int64_t next = lw_next_of_plant(lw_merged + j, tick);
        if (next < first) first = next;
    }
    return first;
}

/* Whether the present instant is the communication point of a plant, to which it has stepped. */
static inline bool lw_is_exchanging(const lw_memory *m) { return !lw_comes_before(m->now, lw_time_of(m->exchange)); }

/* Let the plants of which the present instant is a communication point take their inputs. */
static void lw_take_inputs(lw_memory *m) {
    if (!lw_is_exchanging(m)) return;
    for (int j = 0; j < LW_N_MERGED; j++) {
        const lw_merged_plant *p = lw_merged + j;
        if (lw_next_of_plant(p, m->exchange - 1) == m->exchange)
            memcpy(m->held + p->from, m->z + p->from, (size_t)p->inputs * sizeof(double));
    }
    m->exchange = lw_next_exchange(m->exchange);
}

/* Let the plants of which the next tick of them is a communication point step to it. */
static bool lw_step_plants(lw_memory *m) {
    for (int j = 0; j < LW_N_MERGED; j++) {
        const lw_merged_plant *p = lw_merged + j;
        if (lw_next_of_plant(p, m->exchange - 1) != m->exchange) continue;
        const bool whole = m->reached[j] >= 0;
        const double t = whole ? lw_time_of(m->reached[j]) : m->begun;
        const double h = whole ? lw_time_of(m->exchange - m->reached[j]) : lw_time_of(m->exchange) - t;
        if (!p->step((char *)m + p->place, m->held + p->from, t, h, m->w + p->to)) return lw_accuse(m, j);
        m->reached[j] = m->exchange;
    }
    return true;
}

/* Outputs of the plants at the start depend on their inputs, and these on outputs: pass both on until they agree. */
static bool lw_settle_plants(lw_memory *m, double start) {
    for (int n = 0; n < LW_MOST_PASSES; n++) {
        bool settled = true;
        for (int j = 0; j < LW_N_MERGED; j++) {
            const lw_merged_plant *p = lw_merged + j;
            double y[LW_MOST_MERGED];
            memcpy(m->held + p->from, m->z + p->from, (size_t)p->inputs * sizeof(double));
            if (!p->exchange((char *)m + p->place, m->held + p->from, y)) return lw_accuse(m, j);
            for (int i = 0; i < p->outputs; i++) {
                double *w = m->w + p->to + i;
                if (!(fabs(y[i] - *w) <= LW_SETTLED * fabs(y[i]))) settled = false;
                *w = y[i];
            }
        }
        if (settled) return true;
        if (!lw_begin_loop(m, start)) return false;
    }
    return m->culprit = LW_N_MERGED + 1, false;
}

static bool lw_begin(lw_memory *m, double start) {
    m->culprit = 0;
    if (!lw_begin_loop(m, start)) return false;
    for (int j = 0; j < LW_N_MERGED; j++)
        if (!lw_merged[j].enter((char *)m + lw_merged[j].place, m->now, m->p)) return lw_accuse(m, j);
    if (!lw_settle_plants(m, start)) return false;
    const int64_t tick = (int64_t)ceil(m->now / lw_time_of(1) - LW_NEAR); /* the first one from here on */
    for (int j = 0; j < LW_N_MERGED; j++) {
        if (!lw_merged[j].start((char *)m + lw_merged[j].place)) return lw_accuse(m, j);
        m->reached[j] = lw_comes_before(m->now, lw_time_of(tick)) ? -1 : tick;
    }
    m->begun = m->now;
    m->exchange = lw_next_exchange(tick - 1);
    return true;
}

#endif

/* Go through the present instant: what happens there, with a tick that is due; plants take their inputs as they are at that tick.
   `lw_go` continues from there. */
static inline bool lw_pass(lw_memory *m) {
    m->reason = DONE;
    if (LW_HYBRID || lw_is_due(m))
        if (!lw_act(m, lw_is_due(m))) return false;
    lw_take_inputs(m);
    return lw_settle(m);
}

#if !LW_N_MERGED
static bool lw_go(lw_memory *m, double to) { return lw_go_loop(m, to); }
#else
/* Continue to a time, as `lw_go_loop`; plants of which it is a communication point have then stepped to it. */
static bool lw_go(lw_memory *m, double to) {
    bool meets;
    do {
        if (lw_is_exchanging(m) && !lw_pass(m)) return false;
        const double next = lw_time_of(m->exchange);
        meets = !lw_comes_before(to, next);
        if (!lw_go_loop(m, meets ? next : to) || (meets && !lw_step_plants(m))) return false;
    } while (lw_comes_before(m->now, to));
    return !meets || lw_settle(m); /* signals between ticks, with the plants' outputs */
}
#endif
