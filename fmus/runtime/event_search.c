/* Events between ticks: the domains of indicators, and the search for their changes within a step.

   The rules are those of diagrams/compiled/event_domains.py, which says why: an indicator leaves its domain beyond its
   hysteresis; one that has just crossed zero has some slack for rounding errors; one that comes close to zero between two
   instants is followed to where it is closest. At an indicator that is not finite the run ends. */

enum { QUIET, EVENT, LOST, PILED }; /* PILED: events pile up, and the run can't continue: */
enum { IN_CONTACT, ZENO, CHATTERS, ENDLESS, ENDLESS_OUTSIDE }; /* the last one: of FMUs in model exchange */
enum { ULPS = 16 }; /* an event within so many ulps of a tick or a sample belongs to it */
enum { HALVINGS = 40, FEW = 48, BLOCK = 63, MOST = 1024, LATEST = 9, RECENT = 500, SLIDES = 10, ROUNDS = 100, AROUND = 5 };
enum { RESTS = 20, BRIEFS = 100 }; /* events in a row that lead back into contact; impacts in a row with brief flights */

static const double CLOSE_TO_END = 1e-3, ROUNDING = 1e-13, SCATTER = 8.0, LEAST = 1e-15, CLOSE = 1e-11, CONTINUOUS = 1e-9;
static const double BRIEF = 1e-4, APART = 1e-3; /* of the spacing: a brief flight; impacts further apart are not in a row */
static const double LESS = 1.0 - 1e-6;          /* of its speed is left after an impact that has taken energy */
static const double SHRUNK = 1e-6, SLIDING_PART = 1e-9; /* of the largest interval: Zeno; of a step: a sliding mode */

typedef struct {
    int64_t m;                    /* events */
    tick indicators, jump;        /* at the trial, and at the instant that is reached */
    double *z, *open, *fired;     /* results of the indicators, argument of the jump */
    const uint8_t *rising, *falling, *hysteretic;
    const double *hysteresis;
    const int64_t *own, *own_first; /* integrated states of the event's block: own[own_first[i]] and so on */
    double spacing, finest, step; /* step: of a method of fixed step, else NaN */
    double *domain, *low, *high, *slack, *size, *rounding, *largest, *counts, *latest, *fresh;
    double *side, *stuck;         /* from where an indicator on the border is held, 1 or -1; events that led back there */
    double *briefs, *brief_at;    /* impacts in a row with brief flights after them; time of the last one */
    double *recent;               /* a ring of times at which events fired */
    uint8_t *recent_fired;        /* which did then, a row for each time */
    int64_t fired_times;
    double *log;                  /* time, event, states before and after it */
    int64_t logged, capacity;
    double *times, *seen, *gates, *domains; /* of a block of instants */
    double *x, *x_before, *now, *strict, *values, *motion, *later;
    uint8_t *fires, *following;
    const int64_t *gate, *inside, *inside_first; /* of an event that resets a subsystem: its gate, the events inside */
    const double *start;          /* domains at the start */
    int64_t sliding, switched;    /* whether events of a fixed step wait for its end; whether one has fired there */
    double *slid;                 /* when each has begun to slide for the first time, s; NaN: it has not */
    int64_t pile, culprit, piled; /* why the run can't continue, by which event, and how many times in a row */
} watch;

static inline double lowest(const watch *w, int64_t i, double domain, double slack) {
    if (domain < 0.0) return -INFINITY;
    return domain > 0.0 ? nextafter(-w->hysteresis[i], INFINITY) - slack : w->low[i] - w->rounding[i];
}

static inline double highest(const watch *w, int64_t i, double domain, double slack) {
    if (domain > 0.0) return INFINITY;
    return domain < 0.0 ? w->hysteresis[i] + slack : w->high[i] + w->rounding[i];
}

static inline double domain_of(const watch *w, int64_t i, double z, double open, double before, double slack) {
    if (!(open > 0.5)) return before;
    return z > highest(w, i, before, slack) ? 1.0 : z < lowest(w, i, before, slack) ? -1.0 : before;
}

static inline bool fires_at(const watch *w, int64_t i, double before, double now) {
    return (now > before && w->rising[i]) || (now < before && w->falling[i]);
}

/* Take over the domains at an instant or between events: one that is back on the free side has left contact. */
static void take_over(watch *w, const double *now) {
    for (int64_t i = 0; i < w->m; i++)
        if (now[i] * w->side[i] < 0.0) w->side[i] = w->stuck[i] = 0.0;
    memcpy(w->domain, now, (size_t)w->m * sizeof(double));
}

/* Take over the domains where events fire: from the border to the side that their jump has held them from, they rest. */
static void take_fired(watch *w) {
    for (int64_t i = 0; i < w->m; i++)
        if (w->fires[i] && w->domain[i] == 0.0 && w->now[i] != 0.0 && w->now[i] == w->side[i]) w->stuck[i]++;
    take_over(w, w->now);
}

/* Evaluate the indicators; false if one in an open subsystem is not finite. */
static bool indicate(watch *w, problem *p, double t, const double *x) {
    bool known = look(p, t, x) && !call(&w->indicators);
    for (int64_t i = 0; known && i < w->m; i++) known = isfinite(w->z[i]) || !(w->open[i] > 0.5);
    if (!known) p->lost = AT_TRIAL;
    return known;
}

static bool indicate_in(watch *w, problem *p, method *m, double t) {
    interpolate(m, t, w->x);
    return indicate(w, p, t, w->x);
}

/* Write the domains at an instant from those before; where events fire, no slack hides another indicator's change. */
static bool take_domains(watch *w, const double *before, double *now, uint8_t *fires) {
    bool any = false, slackens = false;
    for (int64_t i = 0; i < w->m; i++) {
        now[i] = domain_of(w, i, w->z[i], w->open[i], before[i], w->slack[i]);
        fires[i] = fires_at(w, i, before[i], now[i]);
        any |= fires[i];
        slackens |= w->slack[i] != 0.0;
    }
    if (any && slackens)
        for (int64_t i = 0; i < w->m; i++) {
            const double strict = domain_of(w, i, w->z[i], w->open[i], before[i], 0.0);
            if (!fires[i] && !fires_at(w, i, before[i], strict)) now[i] = strict;
            fires[i] = fires_at(w, i, before[i], now[i]);
        }
    return any;
}

/* --- within a step ------------------------------------------------------------------------------------------------ */

/* Return the distance of an indicator beyond the border of its domain at a time; `level` is the border that it left. */
static double value_at(watch *w, problem *p, method *m, int64_t i, double t, bool *lost) {
    if (!indicate_in(w, p, m, t)) *lost = true;
    return w->z[i];
}

/* A step in which events are sought. */
typedef struct {
    watch *w;
    problem *p;
    method *m;
} search;

#define LW_SEARCH const search
#define LW_VALUE(s, i, t, lost) value_at((s)->w, (s)->p, (s)->m, i, t, lost)
#include "crossings.c"

/* Return how far values of an indicator around its root are from a straight line: its rounding errors. */
static double scatter_around(watch *w, problem *p, method *m, int64_t i, double t, bool *lost) {
    const double apart = lw_resolution(t, w->finest);
    double at[2 * AROUND + 1], z[2 * AROUND + 1], found = 0.0;
    int count = 0;
    for (int k = -AROUND; k <= AROUND; k++) {
        const double time = fmin(fmax(t + apart * k, m->t_old), m->t);
        if (count && !(time > at[count - 1])) continue;
        at[count] = time;
        z[count++] = value_at(w, p, m, i, time, lost);
    }
    if (count < 3) return 0.0;
    const double span = at[count - 1] - at[0], rise = z[count - 1] - z[0];
    for (int k = 1; k < count - 1; k++) found = fmax(found, fabs(z[k] - z[0] - (at[k] - at[0]) / span * rise));
    return isfinite(found) ? found : 0.0;
}

/* Return the slack of an indicator that has just crossed zero, from its values and rounding errors there. */
static inline double slack_after(const watch *w, int64_t i, double value) {
    return fmin(fmax(SCATTER * value, LEAST * w->size[i]), CONTINUOUS * w->size[i]);
}

/* Return when an indicator has just left its domain, between a and b, where it has; write how far it is on both sides. */
static double find_change(watch *w, problem *p, method *m, int64_t i, double a, double b, double domain, double *distance,
                          bool *lost) {
    const double low = lowest(w, i, domain, w->slack[i]), high = highest(w, i, domain, w->slack[i]);
    const double value_a = value_at(w, p, m, i, a, lost), value_b = value_at(w, p, m, i, b, lost);
    *distance = 0.0;
    if (!(low <= value_a && value_a <= high)) return a; /* it was taken over at a already; the step begins beyond */
    const double level = value_b > high ? high : low;
    const double t = lw_leave(&(search){w, p, m}, i, low, high, a, value_a, b, value_b, w->finest, lost);
    const double below = fmax(a, t - lw_resolution(t, w->finest));
    const double here = fabs(value_at(w, p, m, i, t, lost) - level);
    *distance = fmax(here, fabs(value_at(w, p, m, i, below, lost) - level));
    *distance = fmax(*distance, scatter_around(w, p, m, i, t, lost));
    return t;
}

/* Return when an indicator is closest to the other domain, by Brent's method (Algorithms for Minimization, 1973, 5.8). */
static double find_closest(watch *w, problem *p, method *m, int64_t i, double side, double a, double b, bool *lost) {
    const double golden = 0.5 * (3.0 - sqrt(5.0)), relative = 1.5e-8;
    double x = a + golden * (b - a), v = x, u = x, e = 0.0, d = 0.0;
    double fx = side * value_at(w, p, m, i, x, lost), fv = fx, fu = fx;
    for (int rounds = 0; rounds < 200 && !*lost; rounds++) {
        const double middle = 0.5 * (a + b), least = relative * fabs(x) + 1e-300, twice = 2.0 * least;
        if (fabs(x - middle) <= twice - 0.5 * (b - a)) break;
        bool section = true;
        if (fabs(e) > least) {
            double r = (x - u) * (fx - fv), q = (x - v) * (fx - fu), part = (x - v) * q - (x - u) * r;
            q = 2.0 * (q - r);
            if (q > 0.0) part = -part;
            q = fabs(q);
            r = e;
            e = d;
            if (fabs(part) < fabs(0.5 * q * r) && part > q * (a - x) && part < q * (b - x)) {
                d = part / q;
                const double at = x + d;
                if (at - a < twice || b - at < twice) d = x < middle ? least : -least;
                section = false;
            }
        }
        if (section) {
            e = x < middle ? b - x : a - x;
            d = golden * e;
        }
        const double at = fabs(d) >= least ? x + d : x + (d > 0.0 ? least : -least);
        const double found = side * value_at(w, p, m, i, at, lost);
        if (found <= fx) {
            if (at < x)
                b = x;
            else
                a = x;
            v = u, fv = fu;
            u = x, fu = fx;
            x = at, fx = found;
        } else {
            if (at < x)
                a = at;
            else
                b = at;
            if (found <= fu || u == x) {
                v = u, fv = fu;
                u = at, fu = found;
            } else if (found <= fv || v == x || v == u) {
                v = at, fv = found;
            }
        }
    }
    return x;
}

/* Whether an indicator may have been in the other domain between three instants, of which k is the last one. */
static bool may_dip(const watch *w, int64_t i, int64_t k) {
    const int64_t m = w->m;
    const double z0 = w->seen[(k - 2) * m + i], z1 = w->seen[(k - 1) * m + i], z2 = w->seen[k * m + i];
    if (!(fabs(z1) <= fabs(z0) && fabs(z1) <= fabs(z2)) || (z1 == z0 && z1 == z2)) return false;
    if (!w->hysteretic[i] && !((z1 > 0.0) == (z0 > 0.0) && (z1 > 0.0) == (z2 > 0.0))) return false;
    const double h0 = w->times[k - 1] - w->times[k - 2], h1 = w->times[k] - w->times[k - 1];
    const double slope0 = (z1 - z0) / h0, slope1 = (z2 - z1) / h1, bend = (slope1 - slope0) / (h0 + h1);
    const double tangent = slope0 + bend * h0, least = z1 - tangent * tangent / (4.0 * bend);
    if (!isfinite(bend) || bend == 0.0) return false;
    return !((least > 0.0) == (z1 > 0.0) && fabs(least) > 0.3 * fmax(fabs(z0), fabs(z2)));
}

/* Note a change that fires between two instants if it is the first one of its kind. */
static void note_change(watch *w, problem *p, method *m, int64_t i, double a, double b, double *first, bool *lost) {
    int64_t at = 0;
    for (int64_t k = 0; w->times[k] <= a; k++) at = k;
    const double t = find_change(w, p, m, i, a, b, w->domains[at * w->m + i], w->values + i, lost);
    w->following[i] = 1;
    *first = fmin(*first, t);
}

/* Return whether events fire among instants `k` to `n` of a block; write the first time at which some do. */
static int first_among(watch *w, problem *p, method *method, int64_t k, int64_t n, double *found) {
    const int64_t m = w->m;
    for (int64_t j = k; j < n; j++) {
        double *before = w->domains + (j - 1) * m, *now = w->domains + j * m, *z = w->seen + j * m, first = INFINITY;
        bool out = false, lost = false;
        memcpy(now, before, (size_t)m * sizeof(double));
        for (int64_t i = 0; i < m; i++)
            out |= domain_of(w, i, z[i], w->gates[j * m + i], before[i], w->slack[i]) != before[i];
        if (out) { /* as the run will see it, to the last bit */
            if (!indicate_in(w, p, method, w->times[j])) return LOST;
            memcpy(z, w->z, (size_t)m * sizeof(double));
            for (int64_t i = 0; i < m; i++) now[i] = domain_of(w, i, z[i], w->open[i], before[i], w->slack[i]);
        } else {
            for (int64_t i = 0; i < m; i++)
                if (w->slack[i] > 0.0 && fabs(z[i]) > w->slack[i]) w->slack[i] = 0.0;
        }
        memset(w->values, 0, (size_t)m * sizeof(double));
        for (int64_t i = 0; i < m; i++)
            if (fires_at(w, i, before[i], now[i]))
                note_change(w, p, method, i, w->times[j - 1], w->times[j], &first, &lost);
        for (int64_t i = 0; j >= 2 && i < m; i++) {
            const double side = w->domains[(j - 2) * m + i];
            if (side == 0.0 || side != before[i] || side != now[i] || !may_dip(w, i, j)) continue;
            const double t = find_closest(w, p, method, i, side, w->times[j - 2], w->times[j], &lost);
            if (lost || !indicate_in(w, p, method, t)) return LOST;
            const double there = domain_of(w, i, w->z[i], w->open[i], side, w->slack[i]);
            if (there != side && w->times[j - 2] < t && t < w->times[j] && fires_at(w, i, side, there))
                note_change(w, p, method, i, w->times[j - 2], t, &first, &lost);
        }
        if (lost) return LOST;
        if (first == INFINITY) continue;
        int64_t at = j - 1;
        while (at > 0 && w->times[at] > first) at--;
        if (!indicate_in(w, p, method, first)) return LOST;
        take_over(w, w->domains + at * m);
        if (!take_domains(w, w->domain, w->now, w->fires)) return LOST;
        take_fired(w);
        for (int64_t i = 0; i < m; i++)
            if (w->fires[i]) w->slack[i] = slack_after(w, i, w->values[i]);
        *found = first;
        return EVENT;
    }
    take_over(w, w->domains + (n - 1) * m);
    return QUIET;
}

/* Take notes of the largest values in a block, and of rounding errors where a step begins behind an event. Slack counts
   up to where an indicator is far from zero, in `first_among`: until there a dip back across zero may be one of rounding. */
static void note_sizes(watch *w, int64_t n, bool begins) {
    const int64_t m = w->m, third = HALVINGS / 3;
    for (int64_t i = 0; i < m; i++) {
        double largest = 0.0;
        for (int64_t j = 0; j < n; j++) largest = fmax(largest, fabs(w->seen[j * m + i]));
        w->size[i] = largest;
        w->rounding[i] = ROUNDING * largest;
    }
    if (!begins || n <= third + 1) return;
    for (int64_t i = 0; i < m; i++) {
        double scatter = 0.0;
        const double z0 = w->seen[i], rise = w->seen[third * m + i] - z0, span = w->times[third] - w->times[0];
        for (int64_t j = 1; j < third; j++)
            scatter = fmax(scatter, fabs(w->seen[j * m + i] - z0 - (w->times[j] - w->times[0]) / span * rise));
        w->slack[i] = fmax(w->slack[i], fmin(SCATTER * scatter, CONTINUOUS * w->size[i]));
    }
}

/* Find the first instant in the last step at which events fire: they are in w->fires then, the domains are new. */
static int locate(watch *w, problem *p, method *method, double *found) {
    const double a = method->t_old, b = method->t;
    const int64_t m = w->m, parts = (int64_t)fmax(4.0, ceil((b - a) / w->spacing));
    const double h = (b - a) / (double)parts;
    double head[HALVINGS + 2];
    int64_t heads = 1, begun = 0, done = 1;
    const bool fresh = *w->fresh != 0.0;
    head[0] = a;
    if (fresh) {
        for (int k = HALVINGS; k > 0; k--) {
            const double t = a + h * ldexp(1.0, -k);
            if (t > head[heads - 1]) head[heads++] = t;
        }
    } else if (a + h * CLOSE_TO_END > a) {
        head[heads++] = a + h * CLOSE_TO_END;
    }
    const int64_t total = heads + parts + 1;
    int64_t width = BLOCK; /* few where an indicator is on the border: its rounding is that of values close by */
    for (int64_t i = 0; i < m; i++)
        if (w->domain[i] == 0.0) width = FEW;
    while (done < total) { /* a block of instants, from the two before them on */
        const int64_t first = done >= 2 ? done - 2 : 0, end = done + width < total ? done + width : total;
        for (int64_t j = 0, k = first; k < end; j++, k++) {
            const int64_t part = k - heads + 1;
            w->times[j] = k < heads ? head[k] : part < parts ? a + h * (double)part : part == parts ? b - CLOSE_TO_END * h : b;
            if (begun && j < 2) continue; /* moved there below */
            if (!indicate_in(w, p, method, w->times[j])) return LOST;
            memcpy(w->seen + j * m, w->z, (size_t)m * sizeof(double));
            memcpy(w->gates + j * m, w->open, (size_t)m * sizeof(double));
        }
        const int64_t n = end - first, k = done - first;
        if (!begun)
            for (int64_t j = 0; j < k; j++) memcpy(w->domains + j * m, w->domain, (size_t)m * sizeof(double));
        note_sizes(w, n, fresh && !begun);
        const int result = first_among(w, p, method, k, n, found);
        if (result != QUIET) return result;
        if (end < total) {
            for (int64_t j = 0; j < 2; j++) {
                memcpy(w->seen + j * m, w->seen + (n - 2 + j) * m, (size_t)m * sizeof(double));
                memcpy(w->gates + j * m, w->gates + (n - 2 + j) * m, (size_t)m * sizeof(double));
                memcpy(w->domains + j * m, w->domains + (n - 2 + j) * m, (size_t)m * sizeof(double));
            }
            begun = 1;
        }
        done = end;
        width = width < MOST / 2 ? 2 * width : MOST;
    }
    *w->fresh = 0.0;
    return QUIET;
}
