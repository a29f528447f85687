/* An exported diagram: its loop, from one communication point to the next, in one block of memory.

   It comes after the loop's files and the diagram's own text, which defines: `lw_memory`, `lw_fill` and `lw_bind`; the seconds
   between two ticks, LW_BASE_NUMERATOR / LW_BASE_DENOMINATOR; LW_N_CLOCKS clocks, `lw_clocks`; LW_N_SETS sets of clocks that
   act together, as bits in `lw_sets`, in the order of the loop's kinds of ticks; LW_HYBRID, whether anything happens between
   ticks. Then `m->hybrid` is the loop with continuous states, else `m->loop` that over ticks.

   A tick acts at the start of a communication step, with the inputs of that step, and not at its end. So a diagram that
   samples the outputs of a plant sees those at the tick if the plant has made its step before. */

#ifndef LW_NEAR
#define LW_NEAR 1e-3 /* of the time between two ticks: a communication point within it is the tick */
#endif
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

/* Return the kind of a tick: the place of the set of clocks that act; -1: none does, or a set that there is no code for. */
static int64_t lw_kind_of(int64_t tick) {
    uint64_t acting = 0;
    for (int i = 0; i < LW_N_CLOCKS; i++)
        if (tick >= lw_clocks[i].offset && (tick - lw_clocks[i].offset) % lw_clocks[i].every == 0) acting |= UINT64_C(1) << i;
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

/* Put the time to where a run begins. */
static void lw_put_time(lw_memory *m, double start) {
    const double ticks = start / lw_time_of(1);
    m->now = *LW_LOOP_OF(m)->t = start;
    m->tick = lw_tick_from((int64_t)ceil(ticks - LW_NEAR));
    const bool acts = m->tick != INT64_MAX && !lw_comes_before(start, lw_time_of(m->tick));
    if (acts) m->now = *LW_LOOP_OF(m)->t = lw_time_of(m->tick);
}

/* Compute the numbers that depend on parameters; to be called when some of m->p have been set. */
static void lw_renew(lw_memory *m) { (void)m; }

/* Evaluate a tick of some kind; false: it can't be, and m->lost is the kind. */
static bool lw_evaluate(lw_memory *m, int64_t kind) {
    m->lost = kind;
    return evaluate(LW_LOOP_OF(m), kind) == DONE;
}

#if !LW_HYBRID

/* Evaluate everything at the start, with the parameters, inputs and states in the memory; false: it can't be. */
static bool lw_begin(lw_memory *m, double start) {
    lw_put_time(m, start);
    if (m->tick == INT64_MAX || lw_comes_before(m->now, lw_time_of(m->tick))) return true;
    return lw_evaluate(m, lw_kind_of(m->tick));
}

/* Continue to a time with the inputs in the memory: ticks from the present instant on, before that time. False: the tick
   m->tick can't be evaluated, and nothing of it is taken over. */
static bool lw_go(lw_memory *m, double to) {
    loop *l = &m->loop;
    while (lw_acts_before(m, to)) {
        *l->t = m->now = lw_time_of(m->tick);
        if (!lw_evaluate(m, lw_kind_of(m->tick))) return false;
        memcpy(l->x, l->x_next, (size_t)l->states * sizeof(double));
        m->tick = lw_tick_from(m->tick + 1);
    }
    m->now = to;
    return true;
}
#endif
