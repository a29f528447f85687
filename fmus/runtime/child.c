/* The other side of `remote.c`, in the process of an FMU: it waits for requests, and calls the FMU's functions.

   What is no sequence of such calls is left to Python. It comes after `newton.c` and `remote.c`. */

/* A function of an FMU by its form, with its arguments: p is a pointer, n a number of elements, d a time, b a flag. */
enum { TRANSFER_4, TRANSFER_5, STEP_INT, STEP_CHAR, STEP_3, TIME_1, VECTOR_3, MODE_1, UPDATE_2, UPDATE_7, DONE_INT, DONE_CHAR,
       SLOPES_5, WATCH_3,
       UPDATE_CHAR };
typedef int (*transfer_4)(void *, void *, size_t, void *);
typedef int (*transfer_5)(void *, void *, size_t, void *, size_t);
typedef int (*step_int)(void *, double, double, int);
typedef int (*step_char)(void *, double, double, char);
typedef int (*step_3)(void *, double, double, bool, void *, void *, void *, void *);
typedef int (*time_1)(void *, double);
typedef int (*vector_3)(void *, void *, size_t);
typedef int (*mode_1)(void *);
typedef int (*update_2)(void *, void *);
typedef int (*update_7)(void *, void *, void *, void *, void *, void *, void *);
typedef int (*done_int)(void *, int, void *, void *);
typedef int (*done_char)(void *, bool, void *, void *);
typedef int (*slopes_5)(void *, void *, size_t, void *, void *);
typedef int (*update_char)(void *, char, void *);
typedef int (*watch_3)(void *, size_t, void *);

typedef struct {
    int64_t form;
    void *function;
    void *p[7];
    uint64_t n[2];
    const double *now, *width;
    const void *flag;
} bound_call;

typedef struct {
    int64_t count;
    const bound_call *calls;
} call_sequence;

typedef struct {
    uint64_t *words;
    int64_t count;
    const call_sequence *sequences; /* without calls: Python's */
    int32_t commands, replies, ordered, watches;
    patience patience;
} server;

static inline int make_call(const bound_call *c) {
    void *const *p = c->p;
    switch (c->form) {
    case TRANSFER_4: return ((transfer_4)c->function)(p[0], p[1], c->n[0], p[2]);
    case TRANSFER_5: return ((transfer_5)c->function)(p[0], p[1], c->n[0], p[2], c->n[1]);
    case STEP_INT: return ((step_int)c->function)(p[0], *c->now, *c->width, *(const int *)c->flag);
    case STEP_CHAR: return ((step_char)c->function)(p[0], *c->now, *c->width, *(const char *)c->flag);
    case TIME_1: return ((time_1)c->function)(p[0], *c->now);
    case VECTOR_3: return ((vector_3)c->function)(p[0], p[1], c->n[0]);
    case MODE_1: return ((mode_1)c->function)(p[0]);
    case UPDATE_2: return ((update_2)c->function)(p[0], p[1]);
    case UPDATE_7: return ((update_7)c->function)(p[0], p[1], p[2], p[3], p[4], p[5], p[6]);
    case DONE_INT: return ((done_int)c->function)(p[0], *(const int *)c->flag, p[1], p[2]);
    case DONE_CHAR: return ((done_char)c->function)(p[0], *(const bool *)c->flag, p[1], p[2]);
    case SLOPES_5: return ((slopes_5)c->function)(p[0], p[1], c->n[0], p[2], p[3]);
    case UPDATE_CHAR: return ((update_char)c->function)(p[0], *(const char *)c->flag, p[1]);
    case WATCH_3: return ((watch_3)c->function)(p[0], c->n[0], p[1]);
    default:
        return ((step_3)c->function)(p[0], *c->now, *c->width, *(const bool *)c->flag, p[1], p[2], p[3], p[4]);
    }
}

/* Run a sequence up to the first call that fails; see `Child._bind_run`. */
static inline void run_sequence(const call_sequence *s, uint64_t *words) {
    uint32_t worst = 0;
    uint64_t warned = 0;
    for (int64_t i = 0; i < s->count; i++) {
        words[AT_PLACE] = (uint64_t)i;
        FENCE();
        const int status = make_call(s->calls + i);
        if (status < 0 || status > 1) {
            words[AT_STATUS] = (uint32_t)status;
            return;
        }
        if (status) {
            worst = 1;
            warned |= UINT64_C(1) << (i < MOST_BITS ? i : MOST_BITS);
        }
    }
    words[AT_PLACE] = warned;
    words[AT_STATUS] = worst;
}

#ifndef _WIN32
/* Wait for a request after number `last`; false when the parent is gone. */
static inline bool await_request(server *s, uint64_t last) {
    uint64_t *words = s->words;
    char bytes[4096];
    const bool seen = watch_word(&words[AT_REQUEST], last, s->patience.looks);
    note_watching(seen, &s->patience);
    if (seen) return true;
    bool woken = s->ordered;
    while (!woken || READ(words[AT_REQUEST]) == last) {
        WRITE(words[CHILD_SLEEPS], 1);
        FENCE();
        if (!s->ordered || READ(words[AT_REQUEST]) == last) {
            const ssize_t n = read(s->commands, bytes, sizeof bytes);
            if (n == 0 || (n < 0 && errno != EINTR)) return false;
            woken = woken || n > 0;
        }
        WRITE(words[CHILD_SLEEPS], 0);
    }
    return true;
}

/* Answer requests after number `last`, until one comes that Python is to answer: true; false when the parent is gone. */
VISIBLE bool loopwright_serve(server *s, uint64_t last) {
    uint64_t *words = s->words;
    for (;;) {
        if (!await_request(s, last)) return false;
        const uint64_t number = READ(words[AT_REQUEST]), chosen = words[AT_SEQUENCE];
        if (chosen >= (uint64_t)s->count || !s->sequences[chosen].calls) return true;
        run_sequence(s->sequences + chosen, words);
        last = number;
        WRITE(words[AT_REPLY], last);
        FENCE();
        if (!s->ordered || READ(words[PARENT_SLEEPS]))
            while (write(s->replies, "w", 1) < 0 && errno == EINTR) continue;
    }
}
#endif
