/* The loop over ticks: FMUs step, the diagram's tick is evaluated, its states are taken over, a sample is recorded.

   It knows no diagram: a tick is a function pointer with the addresses of its arguments and results. On anything out of
   the ordinary it returns at that tick; Python, which has the same numbers before it, says what has happened. It comes
   after `newton.c` and `remote.c`. */

typedef int (*set_or_get2)(void *instance, const uint32_t *references, size_t count, double *values);
typedef int (*set_or_get3)(void *instance, const uint32_t *references, size_t count, double *values, size_t size);
typedef int (*do_step1)(void *instance, double now, double width, char is_new);
typedef int (*do_step2)(void *instance, double now, double width, int final);
typedef int (*do_step3)(void *instance, double now, double width, bool final, bool *event, bool *terminate, bool *early,
                        double *reached);

typedef struct {
    void *function; /* NULL: no such ports */
    const uint32_t *references;
    size_t count;
    double *values;
    size_t size;
} transfer;

/* An FMU, in this process or in another one; flags are event, terminate, early return, and one that is never set. */
typedef struct {
    int32_t version;
    void *instance;
    void *step;
    transfer inputs, outputs;
    double *now, *width;
    const void *final;
    bool *flags;
    double *reached;
    bool *changed; /* set where it changes modes of the processor, which are set back; NULL: it is known not to */
    remote *far;   /* its process; NULL: this one */
    int (*by_python)(int64_t place, double now, double width); /* Python takes its steps; NULL: C does */
    const quiet *quiet; /* ... but for those in which nothing is out of the ordinary; NULL: none */
} plant;

/* Steps of FMUs that don't all step at every tick: a row for each tick of a call, with an entry for each FMU. */
typedef struct {
    const double *begins, *widths; /* of the step that ends at the tick, in s; width 0: none does */
    const uint8_t *holds;          /* whether the FMU takes the tick's inputs, and holds them to its next one */
    const int64_t *inputs;         /* of each FMU: where its inputs begin and end */
} own_steps;

typedef struct {
    int64_t kinds, plants, states, row, stops, every;
    const tick *ticks;
    const plant *fmus;
    double *t, *x;
    const double *x_next, *log, *ok;
    const int64_t *columns; /* entries of the log that are recorded; NULL: the first ones */
    const int64_t *stop;    /* entries of the log that end the run where they are true */
    double truth;           /* a condition is true above it */
    double near;            /* distance from the end of a step, in steps, within which a time is that end */
    int64_t skip;           /* samples to leave out before the next one that is kept */
    newton *loops;          /* of each kind of tick; NULL: no algebraic loops */
    apart *apart;           /* of FMUs in other processes, or stepped by Python; NULL: there are none */
    const double *z;        /* inputs of all FMUs as they are now */
    double *held;           /* ... and as they are held between ticks; NULL: these are the same */
    int64_t inputs;         /* number of both */
    const own_steps *own;   /* NULL: every FMU steps at every tick */
} loop;

enum { DONE, FMU_FAILED, FMU_FLAGS, NOT_OK, STOPPED, HALTED };
enum { INPUTS, STEP, OUTPUTS, UNDER_WAY, REFUSED, TAKEN_BY_PYTHON }; /* of an FMU in another process; of a step by Python */

/* A fused loop is in one unit with the code of its ticks, and of FMUs; then these are no calls by address. */
#ifndef CALL_TICK
#define CALL_TICK(l, kind) call((l)->ticks + (kind))
#endif
#ifndef STEP_FUSED /* false: nothing is done, and the FMU's own functions are called */
#define STEP_FUSED(j, p, now, width) false
#endif
#define STEP_ARGUMENTS(p, to, n_to, from, n_from) \
    (p)->instance, to, n_to, (p)->inputs.values, SIZE(p, inputs), from, n_from, (p)->outputs.values, SIZE(p, outputs)
#define SIZE(p, of) ((p)->version < 3 ? (p)->of.count : (p)->of.size)

typedef struct {
    int64_t ticks, rows; /* that were gone through, and recorded */
    int64_t reason, plant, stage, status;
} outcome;

/* Modes of floating-point numbers: rounding and traps, without the flags of past exceptions. */
#if defined(__x86_64__)
static inline uint64_t modes(void) {
    uint16_t x87;
    __asm__ volatile("fnstcw %0" : "=m"(x87));
    return (uint64_t)x87 << 32 | (__builtin_ia32_stmxcsr() & ~0x3fu);
}
static inline void set_modes(uint64_t m) {
    const uint16_t x87 = (uint16_t)(m >> 32);
    __asm__ volatile("fnclex\n\tfldcw %0" : : "m"(x87)); /* an exception that waits would come now */
    __builtin_ia32_ldmxcsr((uint32_t)m);
}
#elif defined(__aarch64__)
static inline uint64_t modes(void) {
    uint64_t m;
    __asm__ volatile("mrs %0, fpcr" : "=r"(m));
    return m;
}
static inline void set_modes(uint64_t m) { __asm__ volatile("msr fpcr, %0" : : "r"(m)); }
#else
static inline uint64_t modes(void) { return 0; }
static inline void set_modes(uint64_t m) { (void)m; }
#endif

static inline int move(const plant *p, const transfer *of) {
    if (p->version < 3)
        return ((set_or_get2)of->function)(p->instance, of->references, of->count, of->values);
    return ((set_or_get3)of->function)(p->instance, of->references, of->count, of->values, of->size);
}

static inline int step(const plant *p) {
    if (p->version == 1) return ((do_step1)p->step)(p->instance, *p->now, *p->width, 1);
    if (p->version == 2) return ((do_step2)p->step)(p->instance, *p->now, *p->width, *(const int *)p->final);
    return ((do_step3)p->step)(p->instance, *p->now, *p->width, *(const bool *)p->final, p->flags, p->flags + 1,
                               p->flags + 2, p->reached);
}

/* Set back the modes of the processor that a call of an FMU has changed, before anything else is computed. */
static inline void set_back(const plant *p, uint64_t own) {
    if (p->changed && modes() != own) {
        set_modes(own);
        *p->changed = true;
    }
}

/* Step one FMU; return DONE, or why it can't continue. */
static inline int64_t step_plant(const plant *p, double now, double width, uint64_t own, outcome *out) {
    unsigned status = 0; /* Python reports a warning, and what is worse; a negative one is no success */
    out->stage = INPUTS;
    if (p->inputs.function) status = (unsigned)move(p, &p->inputs);
    set_back(p, own);
    if (status > 0) return out->status = (int)status, FMU_FAILED;
    *p->now = now;
    *p->width = width;
    out->stage = STEP;
    status = (unsigned)step(p);
    set_back(p, own);
    if (status > 0) return out->status = (int)status, FMU_FAILED;
    return (p->flags[1] | p->flags[2]) ? FMU_FLAGS : DONE; /* a flag for an event is for event mode alone */
}

static inline int64_t read_plant(const plant *p, double now, double width, double near, outcome *out) {
    unsigned status; /* a negative one is no success */
    /* before FMI 3.0 there is no reached time: to compare what is no number would set off traps of the FMU */
    if (p->version > 2 && fabs(*p->reached - now - width) > width * near) return FMU_FLAGS;
    out->stage = OUTPUTS;
    if (p->outputs.function && (status = (unsigned)move(p, &p->outputs)) > 0) return out->status = (int)status, FMU_FAILED;
    return DONE;
}

/* Whether C takes the next step of an FMU in another process. */
static inline bool is_for_c(const plant *p, double now, double width) {
    return p->far && (!p->by_python || is_quiet(p->quiet, now, width));
}

/* A step in s; of width 0 where there is none. */
typedef struct {
    double now, width;
} stride;

/* Return the step of FMU j to the end of tick i, which is `whole`. */
static inline stride stride_of(const loop *l, int64_t i, int64_t j, stride whole) {
    if (!l->own) return whole;
    const int64_t k = i * l->plants + j;
    return (stride){l->own->begins[k], l->own->widths[k]};
}

/* Let the FMUs in other processes begin their steps, all of them or none. */
static inline int64_t begin_apart(const loop *l, int64_t i, stride whole, outcome *out) {
    for (int64_t j = 0; j < l->plants; j++) {
        const plant *p = l->fmus + j;
        const stride s = stride_of(l, i, j, whole);
        if (s.width != 0.0 && is_for_c(p, s.now, s.width) && !fill_all(p->far)) {
            out->plant = j;
            out->stage = REFUSED;
            return out->status = 0, FMU_FAILED;
        }
    }
    for (int64_t j = 0; j < l->plants; j++) {
        const plant *p = l->fmus + j;
        const stride s = stride_of(l, i, j, whole);
        if (s.width == 0.0 || !is_for_c(p, s.now, s.width)) continue;
        *p->now = begin_step(p->quiet, s.now, s.width);
        *p->width = p->by_python ? s.now + s.width - s.now : s.width; /* parts of a step end where others begin */
        if (p->quiet) tell_slopes(p->quiet, s.now);
        post(p->far);
    }
    return DONE;
}

/* Wait for the end of such a step; where it is out of the ordinary, Python ends it. */
static inline int64_t end_apart(const loop *l, const plant *p, double width, outcome *out) {
    if (take_reply(p->far, l->apart) && !(p->flags[1] | p->flags[2]) &&
        !(fabs(*p->reached - *p->now - width) > width * l->near) && !(p->quiet && has_ended_loud(p->quiet)) &&
        spread_all(p->far))
        return look_at_clock(l->apart), DONE;
    out->stage = UNDER_WAY;
    return out->status = 0, FMU_FAILED;
}

/* Let Python take a step of an FMU; return whether it has to continue from there. */
static inline bool step_by_python(const loop *l, const plant *p, double now, double width, outcome *out) {
    if (p->by_python(out->plant, now, width)) {
        out->stage = TAKEN_BY_PYTHON;
        out->status = 0;
        return true;
    }
    look_at_clock(l->apart);
    return false;
}

/* Step the FMUs to the end of tick i, one after the other; those in other processes step meanwhile. */
static inline int64_t step_plants(const loop *l, int64_t i, double now, double width, outcome *out) {
    const stride whole = {now, width};
    if (l->apart) {
        const int64_t reason = begin_apart(l, i, whole, out);
        if (reason != DONE) return reason;
    }
    for (int64_t j = 0; j < l->plants; j++) {
        const plant *p = l->fmus + j;
        const stride s = stride_of(l, i, j, whole);
        int64_t reason;
        if (s.width == 0.0) continue;
        out->plant = j;
        if (STEP_FUSED(j, p, s.now, s.width)) continue;
        if (p->far && p->far->state != IDLE) {
            if ((reason = end_apart(l, p, s.width, out)) != DONE) return reason;
            continue;
        }
        if (p->by_python) {
            if (step_by_python(l, p, s.now, s.width, out)) return FMU_FAILED;
            continue;
        }
        const uint64_t own = p->changed ? modes() : 0;
        if ((reason = step_plant(p, s.now, s.width, own, out)) == DONE)
            reason = read_plant(p, s.now, s.width, l->near, out);
        set_back(p, own);
        if (reason != DONE) return reason;
    }
    return DONE;
}

/* Let the FMUs that have come to the end of tick i hold their inputs from there on. */
static inline void hold_inputs(const loop *l, int64_t i) {
    if (!l->held) return;
    if (!l->own) {
        memcpy(l->held, l->z, (size_t)l->inputs * sizeof(double));
        return;
    }
    for (int64_t j = 0; j < l->plants; j++)
        if (l->own->holds[i * l->plants + j])
            for (int64_t k = l->own->inputs[2 * j]; k < l->own->inputs[2 * j + 1]; k++) l->held[k] = l->z[k];
}

/* Evaluate a tick at which clocks of some kind act; return DONE, or why its results are not to be taken over. */
static inline int64_t evaluate(const loop *l, int64_t kind) {
    newton *loops = l->loops ? l->loops + kind : NULL;
    if (!loops || !loops->n) return CALL_TICK(l, kind) || l->ok[0] == 0.0 ? NOT_OK : DONE;
    if (solve_loops(loops, l->x) && !CALL_TICK(l, kind) && l->ok[0] != 0.0) return DONE;
    undo_loops(loops, l->x); /* Python begins where this has begun */
    return NOT_OK;
}

/* Record a sample if it is one that is kept: into the row after the `written` ones; return how many are then. */
static inline int64_t record(loop *l, double t, double *rows, int64_t written) {
    if (l->skip) {
        l->skip--;
        return written;
    }
    l->skip = l->every - 1;
    double *row = rows + written * (l->row + 1);
    row[0] = t;
    if (l->columns)
        for (int64_t j = 0; j < l->row; j++) row[1 + j] = l->log[l->columns[j]];
    else
        memcpy(row + 1, l->log, (size_t)l->row * sizeof(double));
    return written + 1;
}

/* Whether Python is to have its turn before the next tick. */
static inline bool is_halted(const loop *l) { return l->apart && l->apart->late; }

static inline bool is_stopped(const loop *l) {
    for (int64_t j = 0; j < l->stops; j++)
        if (l->log[l->stop[j]] > l->truth) return true;
    return false;
}

/* Go through ticks, one after the other; times[i] is where tick i begins, times[i + 1] where it ends. */
VISIBLE void loopwright_run(loop *l, int64_t count, const double *times, const double *widths, const int32_t *kinds,
                            double *rows, outcome *out) {
    int64_t i;
    out->rows = 0;
    out->reason = DONE;
    for (i = 0; i < count; i++) {
        if (is_halted(l)) {
            out->reason = HALTED;
            break;
        }
        if ((out->reason = step_plants(l, i, times[i], widths[i], out)) != DONE) break;
        *l->t = times[i + 1];
        if ((out->reason = evaluate(l, kinds[i])) != DONE) break;
        memcpy(l->x, l->x_next, (size_t)l->states * sizeof(double));
        hold_inputs(l, i);
        out->rows = record(l, times[i + 1], rows, out->rows);
        if (is_stopped(l)) {
            out->reason = STOPPED;
            i++;
            break;
        }
    }
    out->ticks = i;
}
