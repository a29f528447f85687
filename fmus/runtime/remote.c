/* FMUs in their own processes: requests and replies are words in the memory that both sides share.

   A request is posted, then its reply is watched for a while, then slept for. Whatever is out of the ordinary is left to
   Python with the request as it is: under way, or answered. It comes after `newton.c` and before `loop_over_ticks.c`. */

#ifndef _WIN32
#include <errno.h>
#include <poll.h>
#include <time.h>
#include <unistd.h>
#endif

/* Places of words, as `wire.py` has them. */
enum { AT_REQUEST = 0, AT_REPLY = 8, CHILD_SLEEPS = 16, PARENT_SLEEPS = 24, AT_SEQUENCE = 32, AT_STATUS = 33, AT_PLACE = 34, AT_MESSAGES = 40 };
enum { FEWEST = 4, RAREST = 1024, ROW = 64, PER_LOOK = 40 };
enum { MOST_BITS = 62 }; /* places of calls that have bits of their own in a word */
enum { SLICE = 50, TURN = 100 }; /* ms to sleep for a reply, and of a call, before Python has its turn */

enum { FLOAT64, FLOAT32, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64, BOOL8 };
#define EXACT 9007199254740992.0 /* size up to which a float64 holds every integer */

/* Values of one type, between the vector of the run and the memory that is shared. */
typedef struct {
    int64_t kind, count;
    const int64_t *index; /* places in the vector; NULL: the first ones */
    double *vector;
    void *shared;
    const double *low, *high; /* of inputs, limits of each value; NULL: none */
} values;

/* See `wire.Patience`; a look takes PER_LOOK ns. */
typedef struct {
    int64_t most, looks, left, pause, row;
} patience;

enum { IDLE, POSTED, ARRIVED };

typedef struct {
    uint64_t *words;
    uint64_t sequence, number;
    int32_t commands, replies; /* pipes */
    int32_t ordered;           /* false: each request and reply is announced by a byte in a pipe */
    int32_t state;
    patience patience;
    int64_t inputs, outputs;
    const values *to, *from;
} remote;

/* Steps of an FMU that are more than calls: C takes those at which nothing else is to be done. */
typedef struct {
    const double *until; /* time in s of the next event that is known ahead; before it C takes steps */
    int64_t watched, sloped;
    const double *vector;
    const int64_t *watched_index, *sloped_index;
    const double *taken;    /* values of inputs at whose changes events are */
    double *last;           /* time, then values of the inputs whose slopes are told, at the step before; NaN: none */
    double *line;           /* where the child reads lines: start, status, values, slopes; NULL: it takes slopes alone */
    double *slopes;
    const bool *event;      /* the step has ended with an event; NULL: it makes no difference */
    const int64_t *changed; /* texts have changed; NULL: none are recorded */
    double *added;          /* time that steps have added up to, NaN before the first one; NULL: they begin at the run's */
} quiet;

/* Of all such FMUs of a run: the time at which Python has its turn, in ns; 0 before the first step. */
typedef struct {
    int64_t until;
    int64_t late;
} apart;

#define READ(word) __atomic_load_n(&(word), __ATOMIC_ACQUIRE)
#define WRITE(word, value) __atomic_store_n(&(word), value, __ATOMIC_RELEASE)
#define FENCE() __atomic_thread_fence(__ATOMIC_SEQ_CST)

static inline void relax(void) {
#if defined(__x86_64__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    __asm__ volatile("yield");
#endif
}

#define EACH(type, expression)                                                                                         \
    do {                                                                                                               \
        type *at = (type *)v->shared;                                                                                  \
        for (int64_t i = 0; i < v->count; i++) {                                                                       \
            double *of = v->vector + (v->index ? v->index[i] : i);                                                     \
            expression;                                                                                                \
        }                                                                                                              \
    } while (0)
#define FOR_KIND(PUT)                                                                                                  \
    switch (v->kind) {                                                                                                 \
    case FLOAT64: EACH(double, PUT(double)); break;                                                                    \
    case FLOAT32: EACH(float, PUT(float)); break;                                                                      \
    case INT8: EACH(int8_t, PUT(int8_t)); break;                                                                       \
    case UINT8: EACH(uint8_t, PUT(uint8_t)); break;                                                                    \
    case INT16: EACH(int16_t, PUT(int16_t)); break;                                                                    \
    case UINT16: EACH(uint16_t, PUT(uint16_t)); break;                                                                 \
    case INT32: EACH(int32_t, PUT(int32_t)); break;                                                                    \
    case UINT32: EACH(uint32_t, PUT(uint32_t)); break;                                                                 \
    case INT64: EACH(int64_t, PUT(int64_t)); break;                                                                    \
    case UINT64: EACH(uint64_t, PUT(uint64_t)); break;                                                                 \
    default: EACH(uint8_t, PUT(bool)); break;                                                                          \
    }
#define TAKE(type) at[i] = (type)*of
#define GIVE(type) *of = (double)(type)at[i]

/* Copy inputs to the shared memory; false where a value doesn't surely fit, and nothing is said about it here. */
static inline bool fill(const values *v) {
    if (v->kind == FLOAT64 && !v->index && !v->low) {
        memcpy(v->shared, v->vector, (size_t)v->count * sizeof(double));
        return true;
    }
    for (int64_t i = 0; v->low && i < v->count; i++) {
        const double x = v->vector[v->index ? v->index[i] : i];
        if (x < v->low[i] || x > v->high[i]) return false;
        if (v->kind > FLOAT32 && !(x == rint(x))) return false;
    }
    FOR_KIND(TAKE)
    return true;
}

/* Copy outputs from the shared memory; false where the vector can't hold one. */
static inline bool spread(const values *v) {
    if (v->kind == FLOAT64 && !v->index) {
        memcpy(v->vector, v->shared, (size_t)v->count * sizeof(double));
        return true;
    }
    if (v->kind == INT64)
        for (int64_t i = 0; i < v->count; i++) {
            const int64_t x = ((const int64_t *)v->shared)[i];
            if (x > (int64_t)EXACT || x < -(int64_t)EXACT) return false;
        }
    if (v->kind == UINT64)
        for (int64_t i = 0; i < v->count; i++)
            if (((const uint64_t *)v->shared)[i] > (uint64_t)EXACT) return false;
    FOR_KIND(GIVE)
    return true;
}

#ifdef _WIN32 /* such FMUs are never given to C there */
static inline int64_t nanoseconds(void) { return 0; }
static inline void post(remote *r) { (void)r; }
static inline bool answers(remote *r, apart *a) { return (void)r, (void)a, false; }
#else
static inline int64_t nanoseconds(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
}

/* Watch a word while it has a value, for the time of so many looks; return whether it has changed. */
static inline bool watch_word(const uint64_t *word, uint64_t value, int64_t looks) {
    if (!looks) return false;
    for (int n = 0; n < 64; n++) {
        if (READ(*word) != value) return true;
        relax();
    }
    const int64_t end = nanoseconds() + looks * PER_LOOK;
    do
        for (int n = 0; n < 16; n++) {
            if (READ(*word) != value) return true;
            relax();
        }
    while (nanoseconds() < end);
    return false;
}

/* Note whether watching was right: where it was in vain it is tried again after ever longer pauses, which only a long
   row of successes makes short again: on one core a reply now and then comes while one watches. */
static inline void note_watching(bool right, patience *p) {
    if (right) {
        if (++p->row >= ROW) p->pause = FEWEST;
        return;
    }
    p->row = 0;
    if (p->looks) {
        p->looks = 0;
        p->left = p->pause;
        p->pause = 2 * p->pause < RAREST ? 2 * p->pause : RAREST;
    } else if (--p->left <= 0)
        p->looks = p->most;
}

/* Let the child begin; a pipe that is closed shows while its reply is waited for. */
static inline void post(remote *r) {
    uint64_t *words = r->words;
    words[AT_SEQUENCE] = r->sequence;
    WRITE(words[AT_REQUEST], ++r->number);
    r->state = POSTED;
    FENCE();
    if (!r->ordered || READ(words[CHILD_SLEEPS]))
        while (write(r->commands, "w", 1) < 0 && errno == EINTR) continue;
}

/* Sleep until the reply is there; false if it has not come in time, or never will. */
static bool sleep_for_reply(remote *r, apart *a) {
    uint64_t *words = r->words;
    const int64_t end = nanoseconds() + SLICE * INT64_C(1000000);
    int64_t left = SLICE;
    bool woken = r->ordered;
    char bytes[4096];
    WRITE(words[PARENT_SLEEPS], 1);
    FENCE();
    while (!woken || READ(words[AT_REPLY]) != r->number) {
        struct pollfd pipe = {r->replies, POLLIN, 0};
        const int found = left > 0 ? poll(&pipe, 1, (int)left) : 0;
        if (found > 0) {
            if (read(r->replies, bytes, sizeof bytes) <= 0) break;
            woken = true;
        } else if (found < 0 && errno == EINTR)
            a->late = 1; /* Ctrl-C, perhaps: Python looks after this tick */
        else
            break;
        left = (end - nanoseconds()) / 1000000;
    }
    WRITE(words[PARENT_SLEEPS], 0);
    return woken && READ(words[AT_REPLY]) == r->number;
}

/* Wait for a reply. */
static inline bool answers(remote *r, apart *a) {
    const bool seen = watch_word(&r->words[AT_REPLY], r->number - 1, r->patience.looks);
    note_watching(seen, &r->patience);
    return (seen && READ(r->words[AT_REPLY]) == r->number) || sleep_for_reply(r, a);
}
#endif

static inline bool fill_all(const remote *r) {
    for (int64_t i = 0; i < r->inputs; i++)
        if (!fill(r->to + i)) return false;
    return true;
}

enum { LINE_START, LINE_STATUS, LINE_VALUES };
#define ROUNDED 1e-9 /* part of a step within which two times are one, as `step_failures.py` has it */

/* Whether a step has no events before it, within it or at its end, as far as that is known ahead. */
static inline bool is_quiet(const quiet *q, double now, double width) {
    if (!q || !(*q->until > now + width + ROUNDED * width)) return false;
    for (int64_t i = 0; i < q->watched; i++)
        if (q->vector[q->watched_index[i]] != q->taken[i]) return false;
    return true;
}

/* Return where a step begins; where times are added up, add it. */
static inline double begin_step(const quiet *q, double now, double width) {
    if (!q || !q->added) return now;
    const double start = isnan(*q->added) ? now : *q->added;
    *q->added = start + width;
    return start;
}

/* Tell the slopes of inputs, from the differences to the step before. */
static inline void tell_slopes(const quiet *q, double now) {
    if (!q->sloped) return;
    const bool known = now > q->last[0];
    const double width = now - q->last[0];
    if (q->line) q->line[LINE_START] = now;
    for (int64_t i = 0; i < q->sloped; i++) {
        const double u = q->vector[q->sloped_index[i]];
        q->slopes[i] = known ? (u - q->last[1 + i]) / width : 0.0;
        if (q->line) q->line[LINE_VALUES + i] = u;
        q->last[1 + i] = u;
    }
    q->last[0] = now;
}

/* Whether Python has to look at a step that has ended. */
static inline bool has_ended_loud(const quiet *q) {
    return (q->event && *q->event) || (q->line && q->line[LINE_STATUS] > 1.0) || (q->changed && *q->changed);
}

/* Take the reply to a step; false if Python must look at it. */
static inline bool take_reply(remote *r, apart *a) {
    if (!answers(r, a)) return false;
    r->state = ARRIVED;
    return !r->words[AT_MESSAGES] && !r->words[AT_STATUS];
}

static inline bool spread_all(remote *r) {
    for (int64_t i = 0; i < r->outputs; i++)
        if (!spread(r->from + i)) return false;
    r->state = IDLE;
    return true;
}

/* Note the time after a step: a call is over before Python has waited long for its turn. */
static inline void look_at_clock(apart *a) {
    const int64_t now = nanoseconds();
    if (!a->until) a->until = now + TURN * INT64_C(1000000);
    if (now >= a->until) a->late = 1;
}
