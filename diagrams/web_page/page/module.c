/* A diagram with its FMUs as a WebAssembly module: the page writes parameters, and takes rows of samples.

   It comes after the exported diagram and its FMUs. Generated before it: LW_N_COLUMNS and `lw_read_row`, which reads a sample;
   LW_N_PLANTS, LW_PLANTS, what is in their table, and LW_MOST_OUTPUTS, the largest number of outputs of one; LW_N_TUNED
   and LW_TUNED, the parameters of plants that the page moves. A plant steps at its own ticks, before the diagram's tick there, as in a run. */

#define LW_SEEN(name) __attribute__((export_name(#name)))
#define LW_N_ROWS 1024 /* of a call, at most */
#define LW_MOST_PASSES 100
#define LW_SETTLED 1e-12 /* relative change of an output at the start that is rounding */

typedef struct {
    bool (*enter)(double start), (*exchange)(const double *u, double *y), (*start)(void);
    bool (*step)(const double *u, double t, double h, double *y);
    bool (*tune)(uint32_t reference, size_t element, double value);
    int inputs, outputs; /* numbers of elements */
    const int *from;     /* entries of the log that the inputs are */
    int to;              /* first entry of w that the outputs are */
    double *held;        /* the inputs of the step that it is in */
    int clocks;
    const int64_t (*due)[2]; /* ticks at which it steps: every so many, from an offset on */
} lw_plant_of_page;

typedef struct {
    int plant;
    uint32_t reference;
    size_t element;
    double value;
    bool is_set;
} lw_tuned_of_page;

static const lw_plant_of_page lw_plants[LW_N_PLANTS + 1] = {LW_PLANTS{0}};
static lw_tuned_of_page lw_tuned[LW_N_TUNED + 1] = {LW_TUNED{0}};
static double lw_page_rows[LW_N_ROWS][LW_N_COLUMNS + 1];
static int64_t lw_page_reached[LW_N_PLANTS + 1]; /* the tick that each plant has come to */
static int64_t lw_page_failed_plant, lw_page_tick;
static bool lw_page_has_failed;

static bool lw_page_is_due(const lw_plant_of_page *p, int64_t tick) {
    for (int i = 0; i < p->clocks; i++)
        if (tick >= p->due[i][1] && (tick - p->due[i][1]) % p->due[i][0] == 0) return true;
    return false;
}

static void lw_page_take_inputs(const lw_plant_of_page *p) {
    for (int i = 0; i < p->inputs; i++) p->held[i] = lw_page_memory.log[p->from[i]];
}

static bool lw_page_put(const lw_tuned_of_page *one) {
    return lw_plants[one->plant].tune(one->reference, one->element, one->value) || (lw_page_failed_plant = one->plant, false);
}

/* Outputs of the plants at the start depend on their inputs, and these on outputs: both until they agree. */
static bool lw_page_start_plants(void) {
    for (int j = 0; j < LW_N_PLANTS; j++)
        if (!lw_plants[j].enter(0.0)) return lw_page_failed_plant = j, false;
    for (int k = 0; k < LW_N_TUNED; k++)
        if (lw_tuned[k].is_set && !lw_page_put(lw_tuned + k)) return false;
    bool settled = false;
    for (int n = 0; n < LW_MOST_PASSES && !settled; n++) {
        settled = true;
        for (int j = 0; j < LW_N_PLANTS; j++) {
            const lw_plant_of_page *p = lw_plants + j;
            double y[LW_MOST_OUTPUTS];
            lw_page_take_inputs(p);
            if (!p->exchange(p->held, y)) return lw_page_failed_plant = j, false;
            for (int i = 0; i < p->outputs; i++) {
                double *w = lw_page_memory.w + p->to + i;
                if (!(fabs(y[i] - *w) <= LW_SETTLED * fabs(y[i]))) settled = false;
                *w = y[i];
            }
        }
        if (!settled && !lw_begin(&lw_page_memory, 0.0)) return false;
    }
    for (int j = 0; j < LW_N_PLANTS; j++) {
        if (!lw_plants[j].start()) return lw_page_failed_plant = j, false;
        lw_page_reached[j] = 0;
    }
    return true;
}

/* Let the plants that are due at a tick step to it. */
static bool lw_page_step_plants(int64_t tick) {
    for (int j = 0; j < LW_N_PLANTS; j++) {
        const lw_plant_of_page *p = lw_plants + j;
        if (!lw_page_is_due(p, tick)) continue;
        if (!p->step(p->held, lw_time_of(lw_page_reached[j]), lw_time_of(tick - lw_page_reached[j]), lw_page_memory.w + p->to))
            return lw_page_failed_plant = j, false;
        lw_page_reached[j] = tick;
    }
    return true;
}

/* The start values of everything; the page may then change parameters. */
LW_SEEN(fill) void lw_page_fill(void) {
    lw_fill(&lw_page_memory);
    lw_bind(&lw_page_memory);
    for (int k = 0; k < LW_N_TUNED; k++) lw_tuned[k].is_set = false;
}

LW_SEEN(parameters) double *lw_page_parameters(void) { return lw_page_memory.p; }
LW_SEEN(samples) double *lw_page_samples(void) { return &lw_page_rows[0][0]; }
LW_SEEN(signals) const double *lw_page_signals(void) { return lw_page_memory.log; }
LW_SEEN(plant) int lw_page_plant(void) { return (int)lw_page_failed_plant; }
LW_SEEN(renew) void lw_page_renew(void) { lw_renew(&lw_page_memory); }

/* Whether the last call has come to where it can't continue: because of a plant, or if `plant` is -1 of the diagram. */
LW_SEEN(failed) int lw_page_failed(void) { return lw_page_has_failed; }

/* Set a parameter of a plant: from the next step on, or after `fill` from the start on. */
LW_SEEN(tune) void lw_page_tune(int number, double value, int begun) {
    lw_tuned[number].value = value;
    lw_tuned[number].is_set = true;
    if (begun && !lw_page_has_failed) lw_page_has_failed = !lw_page_put(lw_tuned + number);
}

/* Why the diagram can't continue: the number of the guard that is not positive, or -1: there is none. */
LW_SEEN(guard) int lw_page_guard(void) { return lw_find_guard(&lw_page_memory); }

/* The number of the event that fires without end, LW_N_EVENTS where the solver finds no step, or -1: neither. */
LW_SEEN(event) int lw_page_event(void) {
#if LW_HYBRID
    if (lw_page_memory.reason == PILED_UP && LW_N_EVENTS) return (int)lw_page_memory.hybrid.w.culprit;
    if (lw_page_memory.reason == BROKEN_OFF && lw_page_memory.hybrid.p.lost != AT_INSTANT) return LW_N_EVENTS;
#endif
    return -1;
}

/* Begin at t = 0, after `fill` and `renew`. */
LW_SEEN(begin) void lw_page_begin(void) {
    lw_page_failed_plant = -1;
    lw_page_tick = 0;
    lw_page_has_failed = !lw_begin(&lw_page_memory, 0.0) || !lw_page_start_plants();
}

/* Go through one tick into a row, and to the next one; false: it can't, and `wrote` says whether the row is whole. */
static bool lw_page_take_tick(double *row, bool *wrote) {
    lw_memory *m = &lw_page_memory;
    const int64_t tick = lw_page_tick;
    row[0] = lw_time_of(tick);
    if (!lw_go(m, lw_time_of(tick + !LW_HYBRID))) return *wrote = false; /* the tick, and nothing after it */
    lw_read_row(row + 1);
    *wrote = true;
    for (int j = 0; j < LW_N_PLANTS; j++)
        if (lw_page_is_due(lw_plants + j, tick)) lw_page_take_inputs(lw_plants + j);
    lw_page_tick = LW_N_CLOCKS ? m->tick : tick + 1;
    return (!LW_HYBRID || lw_go(m, lw_time_of(lw_page_tick))) && lw_page_step_plants(lw_page_tick);
}

/* Go through so many ticks, up to a time; returns the number of samples. */
LW_SEEN(run) int lw_page_run(int count, double until) {
    int n = 0;
    lw_page_failed_plant = -1;
    while (n < count && n < LW_N_ROWS && !lw_page_has_failed && lw_time_of(lw_page_tick) <= until) {
        bool wrote;
        lw_page_has_failed = !lw_page_take_tick(lw_page_rows[n], &wrote);
        n += wrote;
    }
    return n;
}
