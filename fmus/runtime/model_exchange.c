/* FMUs in model exchange: functions of a diagram in stages, with calls of FMUs between them.

   An evaluation leaves all that an FMU keeps as it is. A look at an instant that is reached tells the FMU that a step is
   complete, or lets an event act: of its indicators, or of inputs that have jumped. Python lets those of time and of steps
   act, and does whatever C can't: it transfers values that don't fit, and evaluates blocks that are no FMU of C's.
   An FMU in its own process is asked for all calls between two copies at once: its buffers are in the memory that
   both share. It comes after `remote.c` and `loop_over_ticks.c`. */

enum { TAKE, GIVE, SET_TIME, CALL, ASK };
enum { OK, WARNING, DISCARD, LOST_PROCESS };
enum { TO_STEP, TO_EVENTS };
enum { FIRED = -1, INPUT, TIME, COMPLETE }; /* events that have acted: of indicators, inputs, time, a step */
enum { DONE_BY_PYTHON, NOT_COMPUTED, FAILED_IN_PYTHON };
enum { EVENT_ROUNDS = 100 };

typedef struct {
    int64_t kind, count;
    void *function;
    uint64_t arguments[8];  /* as they are in registers, the instance first; of a request its number */
    double *vector;         /* of a copy: entries index[0], index[1] and so on, of a type in the buffer */
    const int64_t *index;
    void *buffer;
    int64_t type;
    double low, high;
    double *warned_at;      /* time of the first warning of each call, NaN without one */
} action;

typedef struct {
    int64_t count;
    action *actions;
} sequence;

struct outside;

/* An FMU in model exchange. */
typedef struct {
    struct outside *of;
    int64_t place, states, inputs, events, first; /* first: where its states are in the vector of all */
    sequence complete, enter, update, leave;
    const uint8_t *again, *terminate, *nominals, *defined, *wants, *ends; /* its answers: flags of some bytes */
    const double *time;
    int64_t width, again_where; /* of a flag; whether it asks for another round where it is set, or where it isn't */
    double *u;                  /* inputs at the last instant that was reached */
    const double *least, *relative, *low, *high;
    const uint8_t *discrete;    /* inputs that an event alone takes over */
    double next_time;
    int64_t asks;               /* whether it wants an event at the instant that is reached */
    int64_t ended, in_event;    /* whether it asks for the end of the run, at `end` */
    double end;
    int64_t other_nominals, acted, event;
    int64_t by_python;          /* whether Python does all that C asks it for */
    bool *changed;              /* see `plant` in loop_over_ticks.c */
    remote *far;                /* its process; NULL: this one */
} exchanged;

/* All of them. */
typedef struct outside {
    int64_t count;
    exchanged *each;
    tick jump;                  /* a look at the instant that is reached */
    int64_t look;               /* a step is complete, or events act */
    int64_t lost;               /* whether Python has to do what was begun */
    int64_t failed, plant;      /* whether a call has failed: `action` of `plant`, with a status, at `at` */
    const action *action;
    int64_t call, status;       /* call: its place in the action */
    double at;
    double *log;                /* an event: time, FMU and kind, all states before and after it */
    int64_t logged, capacity;
    int64_t warned;             /* whether a call has given its first warning */
    apart *apart;               /* of FMUs in other processes */
    int (*wait)(int64_t);       /* Python waits for the late reply of an FMU; 0: it never comes, or not in time */
} outside;

/* A stage of a schedule: a traced function, or an FMU with where its values are. */
typedef struct {
    tick f;
    exchanged *fmu;             /* NULL: a traced function */
    int64_t looks;              /* whether it is a look at an instant that is reached, and no evaluation */
    sequence calls;             /* of an evaluation */
    int (*by_python)(void);     /* Python does all that it asks for */
    const double *t, *x, *u;
    double *into;
    int64_t made;
} stage_of;

typedef struct {
    int64_t count;
    stage_of *stages;
} schedule;

typedef unsigned (*call1)(uint64_t);
typedef unsigned (*call2)(uint64_t, uint64_t);
typedef unsigned (*call3)(uint64_t, uint64_t, uint64_t);
typedef unsigned (*call4)(uint64_t, uint64_t, uint64_t, uint64_t);
typedef unsigned (*call5)(uint64_t, uint64_t, uint64_t, uint64_t, uint64_t);
typedef unsigned (*call7)(uint64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t, uint64_t);
typedef unsigned (*call_time)(uint64_t, double);

static inline unsigned call_fmu(const action *a) {
    const uint64_t *p = a->arguments;
    if (a->kind == SET_TIME) return ((call_time)a->function)(p[0], *(const double *)(uintptr_t)p[1]);
    switch (a->count) {
        case 1: return ((call1)a->function)(p[0]);
        case 2: return ((call2)a->function)(p[0], p[1]);
        case 3: return ((call3)a->function)(p[0], p[1], p[2]);
        case 4: return ((call4)a->function)(p[0], p[1], p[2], p[3]);
        case 5: return ((call5)a->function)(p[0], p[1], p[2], p[3], p[4]);
        default: return ((call7)a->function)(p[0], p[1], p[2], p[3], p[4], p[5], p[6]);
    }
}

/* Note a warning of a call. */
static inline void note_warning(exchanged *e, const action *a, int64_t call, double t) {
    if (isnan(a->warned_at[call])) a->warned_at[call] = t, e->of->warned = 1;
}

/* Let another process make the calls of an action, and wait for it. */
static unsigned ask_process(exchanged *e, const action *a, double t) {
    remote *r = e->far;
    outside *o = e->of;
    r->sequence = a->arguments[0];
    post(r);
    if (!answers(r, o->apart) && !o->wait(e->place)) return LOST_PROCESS;
    r->state = IDLE;
    look_at_clock(o->apart);
    const unsigned status = (unsigned)r->words[AT_STATUS];
    const uint64_t places = r->words[AT_PLACE]; /* of a call that has failed, or bits of those that warn */
    if (status == WARNING) {
        for (int64_t i = 0; i < a->count; i++)
            if (places >> (i < MOST_BITS ? i : MOST_BITS) & 1) note_warning(e, a, i, t);
        return OK;
    }
    o->call = status ? (int64_t)places : 0;
    return status;
}

static double given(const action *a, int64_t i) {
    switch (a->type) {
        case 1: return (double)((const float *)a->buffer)[i];
        case 2: return (double)((const int8_t *)a->buffer)[i];
        case 3: return (double)((const uint8_t *)a->buffer)[i];
        case 4: return (double)((const int16_t *)a->buffer)[i];
        case 5: return (double)((const uint16_t *)a->buffer)[i];
        case 6: return (double)((const int32_t *)a->buffer)[i];
        case 7: return (double)((const uint32_t *)a->buffer)[i];
        case 8: return (double)((const int64_t *)a->buffer)[i];
        default: return (double)((const uint64_t *)a->buffer)[i];
    }
}

/* Copy values into a buffer of another type; false if one doesn't fit, or only Python knows whether it does. */
static bool take_typed(const action *a) {
    for (int64_t i = 0; i < a->count; i++) {
        const double v = a->vector[a->index[i]];
        if (a->low > a->high) { /* one of a list: what is there has been looked up */
            if (v != given(a, i)) return false;
            continue;
        }
        if (a->type == 1) {
            if (isfinite(v) && fabs(v) > 3.4028234663852886e38) return false;
            ((float *)a->buffer)[i] = (float)v;
            continue;
        }
        if (!(v == rint(v) && v >= a->low && v <= a->high)) return false;
        switch (a->type) {
            case 2: ((int8_t *)a->buffer)[i] = (int8_t)v; break;
            case 3: ((uint8_t *)a->buffer)[i] = (uint8_t)v; break;
            case 4: ((int16_t *)a->buffer)[i] = (int16_t)v; break;
            case 5: ((uint16_t *)a->buffer)[i] = (uint16_t)v; break;
            case 6: ((int32_t *)a->buffer)[i] = (int32_t)v; break;
            case 7: ((uint32_t *)a->buffer)[i] = (uint32_t)v; break;
            case 8: ((int64_t *)a->buffer)[i] = (int64_t)v; break;
            default: ((uint64_t *)a->buffer)[i] = (uint64_t)v; break;
        }
    }
    return true;
}

/* Make a call of an FMU in this process; modes of numbers that it changes are set back before anything is computed. */
static unsigned call_guarded(const exchanged *e, const action *a) {
    if (!e->changed) return call_fmu(a);
    const uint64_t own = modes();
    const unsigned status = call_fmu(a);
    if (modes() != own) {
        set_modes(own);
        *e->changed = true;
    }
    return status;
}

/* Go through the actions of a sequence. DISCARD: the FMU can't compute it there. Anything else but OK has failed. */
static unsigned go_through(exchanged *e, const sequence *s, double t) {
    for (int64_t k = 0; k < s->count; k++) {
        action *a = s->actions + k;
        if (a->kind == TAKE) {
            if (a->type) {
                if (!take_typed(a)) return e->of->lost = 1, DISCARD + 1;
            } else {
                for (int64_t i = 0; i < a->count; i++) ((double *)a->buffer)[i] = a->vector[a->index[i]];
            }
        } else if (a->kind == GIVE) {
            if (a->type)
                for (int64_t i = 0; i < a->count; i++) {
                    const double v = a->vector[a->index[i]] = given(a, i);
                    if (a->type >= 8 && fabs(v) > 9007199254740992.0) return e->of->lost = 1, DISCARD + 1;
                }
            else
                for (int64_t i = 0; i < a->count; i++) a->vector[a->index[i]] = ((const double *)a->buffer)[i];
        } else {
            if (a->kind != ASK) e->of->call = 0;
            const unsigned status = a->kind == ASK ? ask_process(e, a, t) : call_guarded(e, a);
            if (status == OK) continue;
            if (status == WARNING) {
                note_warning(e, a, 0, t);
                continue;
            }
            e->of->plant = e->place, e->of->action = a, e->of->status = (int64_t)(int32_t)status, e->of->at = t;
            return status;
        }
    }
    return OK;
}

/* Go through a sequence that must not be discarded, and note a call that has failed. */
static bool go_through_all(exchanged *e, const sequence *s, double t) {
    if (go_through(e, s, t) == OK) return true;
    e->of->failed = !e->of->lost;
    return false;
}

static inline bool is_set(const exchanged *e, const uint8_t *flag) {
    return e->width == 1 ? *flag != 0 : *(const int32_t *)(const void *)flag != 0;
}

static inline void note_end_of(exchanged *e, double t, bool in_event) {
    if (e->ended) return;
    e->ended = 1;
    e->in_event = in_event;
    e->end = t;
}

static bool is_within(const exchanged *e, const double *u) {
    for (int64_t i = 0; i < e->inputs; i++)
        if (u[i] < e->low[i] || u[i] > e->high[i]) return false;
    return true;
}

static void complete_step(exchanged *e, double t, const double *u) {
    if (!is_within(e, u)) {
        e->of->lost = 1;
        return;
    }
    for (int64_t i = 0; i < e->inputs; i++) {
        if (!e->discrete[i])
            e->u[i] = u[i];
        else if (e->u[i] != u[i])
            e->asks = 1;
    }
    if (!e->complete.count || !go_through_all(e, &e->complete, t)) return;
    if (is_set(e, e->wants)) e->asks = 1;
    if (is_set(e, e->ends)) note_end_of(e, t, false);
}

static bool has_jumped(const exchanged *e, const double *u) {
    for (int64_t i = 0; i < e->inputs; i++)
        if (fabs(u[i] - e->u[i]) > fmax(e->least[i], e->relative[i] * fabs(u[i]))) return true;
    return false;
}

/* Let an event of an input act that has jumped; the states after it are written. */
static void let_act(exchanged *e, double t, const double *u, double *into) {
    bool nominals = false;
    int rounds = 1;
    if (!go_through_all(e, &e->enter, t)) return;
    e->acted = 1;
    memcpy(e->u, u, (size_t)e->inputs * sizeof(double));
    for (;; rounds++) {
        nominals |= is_set(e, e->nominals);
        if (is_set(e, e->terminate)) note_end_of(e, t, true);
        if (is_set(e, e->again) != e->again_where) break;
        if (rounds == EVENT_ROUNDS) break;
        if (!go_through_all(e, &e->update, t)) return;
    }
    e->next_time = is_set(e, e->defined) ? *e->time : INFINITY;
    if (rounds == EVENT_ROUNDS || isnan(e->next_time)) {
        e->of->failed = 1, e->of->plant = e->place, e->of->action = NULL, e->of->status = 0, e->of->at = t;
        return;
    }
    (void)into; /* the last copy of the sequence writes there */
    if (go_through_all(e, &e->leave, t) && nominals) e->other_nominals = 1;
}

/* Let Python do what a stage asks for; it keeps an error until C has returned. */
static int ask_python(const stage_of *g) {
    outside *o = g->fmu->of;
    o->lost = 0;
    const int result = g->by_python();
    if (result == FAILED_IN_PYTHON) o->failed = 1, o->plant = g->fmu->place, o->action = NULL, o->status = 0, o->at = *g->t;
    return result;
}

/* Look at an instant that is reached. Behind the inputs is 1 for each event that fires. */
static void look_at(const stage_of *g) {
    exchanged *e = g->fmu;
    outside *o = e->of;
    bool fires = false;
    for (int64_t i = 0; i < e->states; i++) g->into[i] = g->x[i];
    if (e->by_python) {
        ask_python(g);
        return;
    }
    for (int64_t i = 0; i < e->events; i++) fires |= g->u[e->inputs + i] != 0.0;
    if (o->look == TO_STEP)
        complete_step(e, *g->t, g->u);
    else if (!fires && (*g->t >= e->next_time || e->asks))
        o->lost = 1;
    else if (fires || has_jumped(e, g->u)) {
        e->event = fires ? FIRED : INPUT;
        if (is_within(e, g->u))
            let_act(e, *g->t, g->u, g->into);
        else
            o->lost = 1;
        if (fires) e->asks = 0;
    }
    if (o->lost) ask_python(g);
}

static void evaluate_fmu(stage_of *g) {
    const bool python = g->fmu->by_python;
    const unsigned status = python ? OK : go_through(g->fmu, &g->calls, *g->t);
    if (python || g->fmu->of->lost) {
        if (ask_python(g) == DONE_BY_PYTHON) return;
    } else {
        if (status == OK) return;
        if (status != DISCARD) g->fmu->of->failed = 1;
    }
    for (int64_t i = 0; i < g->made; i++) g->into[i] = NAN;
}

/* Evaluate a function in stages; the last one writes the results. */
VISIBLE int loopwright_stages(const double **arguments, double **results, long long *iw, double *w, int memory) {
    const schedule *s = (const schedule *)iw;
    (void)arguments, (void)w, (void)memory;
    for (int64_t k = 0; k < s->count; k++) {
        stage_of *g = s->stages + k;
        if (!g->fmu) {
            if (g->f.evaluate(g->f.arguments, k + 1 < s->count ? g->f.results : results, g->f.iw, g->f.w, 0)) return 1;
            continue;
        }
        exchanged *e = g->fmu;
        if (e->of->failed) return 1;
        if (g->looks)
            look_at(g);
        else
            evaluate_fmu(g);
        if (e->of->failed) return 1;
    }
    return 0;
}

/* Return the first event of time after t. */
static inline double next_outside(const outside *o, double t) {
    double first = INFINITY;
    for (int64_t j = 0; j < o->count; j++)
        if (o->each[j].next_time > t && o->each[j].next_time < first) first = o->each[j].next_time;
    return first;
}

/* Whether an FMU asks for the end of the run. */
static inline bool has_ended(const outside *o) {
    for (int64_t j = 0; j < o->count; j++)
        if (o->each[j].ended) return true;
    return false;
}

/* Whether an FMU has other nominal values: Python makes tolerances of them. */
static inline bool has_other_nominals(const outside *o) {
    for (int64_t j = 0; j < o->count; j++)
        if (o->each[j].other_nominals) return true;
    return false;
}

/* The derivative of the rates by differences: columns without a common row are moved together. */
typedef struct {
    const tick *rates;
    newton *loops;                  /* algebraic loops, which are solved wherever the states are moved to; NULL: none */
    double *x, *dx, *before, *step, *values; /* values: of the loops, where the states have not been moved */
    const double *typical;          /* sizes of the states, below which steps don't become smaller */
    int64_t n, colors;
    const int64_t *where;           /* of each column: its entry of x */
    const int32_t *first, *columns; /* of each color: where its columns begin */
    const int32_t *rows_first, *rows; /* of each column: where its rows begin */
} slopes_of;

static inline void keep_loops(const newton *s, const double *x, double *values) {
    for (int64_t i = 0; i < s->n; i++) values[i] = x[s->where[i]];
}

static inline void put_loops(const newton *s, const double *values, double *x) {
    for (int64_t i = 0; i < s->n; i++) x[s->where[i]] = values[i];
}

VISIBLE int loopwright_slopes(const double **arguments, double **results, long long *iw, double *w, int memory) {
    const slopes_of *g = (const slopes_of *)iw;
    const tick *f = g->rates;
    double *out = results[0];
    (void)arguments, (void)w;
    if (f->evaluate(f->arguments, f->results, f->iw, f->w, memory)) return 1;
    memcpy(g->before, g->dx, (size_t)g->n * sizeof(double));
    if (g->loops) keep_loops(g->loops, g->x, g->values);
    for (int64_t c = 0; c < g->colors; c++) {
        for (int32_t k = g->first[c]; k < g->first[c + 1]; k++) {
            double *x = g->x + g->where[g->columns[k]];
            volatile double moved = *x + 1.5e-8 * fmax(fabs(*x), g->typical[g->columns[k]]);
            g->step[k] = *x;
            *x = moved;
        }
        const int failed = (g->loops && !solve_loops(g->loops, g->x)) ||
                           f->evaluate(f->arguments, f->results, f->iw, f->w, memory);
        for (int32_t k = g->first[c]; k < g->first[c + 1]; k++) {
            const int32_t j = g->columns[k];
            double *x = g->x + g->where[j];
            const double h = *x - g->step[k];
            *x = g->step[k];
            for (int32_t i = g->rows_first[j]; i < g->rows_first[j + 1]; i++)
                out[i] = (g->dx[g->rows[i]] - g->before[g->rows[i]]) / h;
        }
        if (g->loops) put_loops(g->loops, g->values, g->x);
        if (failed) return 1;
    }
    return 0;
}

/* The mismatch of algebraic loops, and its derivative by their values. */
VISIBLE int loopwright_equations(const double **arguments, double **results, long long *iw, double *w, int memory) {
    const slopes_of *g = (const slopes_of *)iw;
    double *into[] = {results[1]};
    if (loopwright_slopes(arguments, into, iw, w, memory)) return 1;
    memcpy(results[0], g->before, (size_t)g->n * sizeof(double));
    return 0;
}
