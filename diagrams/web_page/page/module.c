/* A diagram with its FMUs as a WebAssembly module: the page writes parameters, and takes rows of samples.

   It comes after the exported diagram, in which its FMUs are merged. Generated before it: LW_N_COLUMNS and `lw_read_row`, which
   reads a sample. */

#define LW_SEEN(name) __attribute__((export_name(#name)))
#define LW_N_ROWS 1024 /* of a call, at most */

static double lw_page_rows[LW_N_ROWS][LW_N_COLUMNS + 1];
static int64_t lw_page_tick;
static bool lw_page_has_failed;

/* The start values of everything; the page may then change parameters. */
LW_SEEN(fill) void lw_page_fill(void) {
    lw_fill(&lw_page_memory);
    lw_bind(&lw_page_memory);
}

LW_SEEN(parameters) double *lw_page_parameters(void) { return lw_page_memory.p; }
LW_SEEN(samples) double *lw_page_samples(void) { return &lw_page_rows[0][0]; }
LW_SEEN(signals) const double *lw_page_signals(void) { return lw_page_memory.log; }
LW_SEEN(renew) void lw_page_renew(void) { lw_renew(&lw_page_memory); }

/* The number of the plant because of which the last call has come to where it can't continue; -1: it is none. */
LW_SEEN(plant) int lw_page_plant(void) {
#if LW_N_MERGED
    if (lw_page_memory.culprit <= LW_N_MERGED) return (int)lw_page_memory.culprit - 1;
#endif
    return -1;
}

/* Whether the last call has come to where it can't continue. */
LW_SEEN(failed) int lw_page_failed(void) { return lw_page_has_failed; }

/* Why the diagram can't continue: the number of the guard that is not positive, or -1: there is none. */
LW_SEEN(guard) int lw_page_guard(void) { return lw_find_guard(&lw_page_memory); }

/* The number of the event that fires without end, LW_N_EVENTS where the solver finds no step, or -1: neither. */
LW_SEEN(event) int lw_page_event(void) {
#if LW_HYBRID
    if (LW_N_EVENTS > 0 && lw_page_memory.reason == PILED_UP) return (int)lw_page_memory.hybrid.w.culprit;
    if (lw_page_memory.reason == BROKEN_OFF && lw_page_memory.hybrid.p.lost != AT_INSTANT) return LW_N_EVENTS;
#endif
    return -1;
}

/* Begin at t = 0, after `fill` and `renew`. */
LW_SEEN(begin) void lw_page_begin(void) {
    lw_page_tick = 0;
    lw_page_has_failed = !lw_begin(&lw_page_memory, 0.0);
}

/* Go through one tick into a row, and to the next one; false: it can't, and `wrote` says whether the row is whole. */
static bool lw_page_take_tick(double *row, bool *wrote) {
    lw_memory *m = &lw_page_memory;
    const int64_t tick = lw_page_tick;
    row[0] = lw_time_of(tick);
    if (!lw_pass(m)) return *wrote = false;
    lw_read_row(row + 1);
    *wrote = true;
    lw_page_tick = LW_N_CLOCKS ? m->tick : tick + 1;
    return lw_go(m, lw_time_of(lw_page_tick));
}

/* Go through so many ticks, up to a time; returns the number of samples. */
LW_SEEN(run) int lw_page_run(int count, double until) {
    int n = 0;
    while (n < count && n < LW_N_ROWS && !lw_page_has_failed && lw_time_of(lw_page_tick) <= until) {
        bool wrote;
        lw_page_has_failed = !lw_page_take_tick(lw_page_rows[n], &wrote);
        n += wrote;
    }
    return n;
}
