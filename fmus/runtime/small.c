/* Steps of explicit methods for the equation of one small diagram, whose rates are inlined into every stage: numbers stay in
   registers that `methods.c` has in memory. The steps themselves are those of `steps.c`. It comes after `newton.c`,
   `problem.c` and the text of the diagram: N integrated ones of WIDTH states, their places PLACES, and the function
   RATES(arguments, results); INLINE makes a function one that is always inlined. */

/* What the rates see at one step besides the integrated states. */
typedef struct {
    double stop, left, at, late, x[WIDTH];
    const double *w, *p;
    int64_t rates;
} surroundings;

INLINE surroundings look_around(const problem *p) {
    surroundings s = {.stop = p->stop, .left = p->left, .at = p->at, .late = p->late};
    for (int i = 0; i < WIDTH; i++) s.x[i] = p->x[i];
    s.w = p->flow.arguments[2];
    s.p = p->flow.arguments[3];
    return s;
}

INLINE int small_rate(surroundings *s, double t, const double *x, double *f) {
    static const int places[N] = {PLACES};
    double now = t < s->stop ? t : s->stop, all[WIDTH];
    now = now > s->left ? s->left : now;
    now = now == s->at ? s->late : now;
    for (int i = 0; i < WIDTH; i++) all[i] = s->x[i];
    for (int i = 0; i < N; i++) all[places[i]] = x[i];
    const double *arguments[4] = {&now, all, s->w, s->p};
    double *results[1] = {f};
    s->rates++;
    RATES(arguments, results);
    return 0;
}

#define LW_EQUATION surroundings
#define LW_NUMBER double
#define LW_RATE(e, t, x, f) small_rate(e, t, x, f)
#define LW_INLINE INLINE
#include "steps.c"

VISIBLE int step_rk4(method *m) {
    surroundings s = look_around(m->of);
    double x[N], y[N], k1[N], k2[N], k3[N], k4[N];
    const double t = m->t, to = end_of_step(m);
    for (int i = 0; i < N; i++) x[i] = m->x[i];
    small_rate(&s, t, x, k1);
    lw_rk4(&s, N, t, to - t, to, x, k1, k2, k3, k4, y, y);
    for (int i = 0; i < N; i++) {
        m->x_old[i] = x[i];
        m->K[i] = k1[i];
        m->x[i] = y[i];
    }
    m->of->rates += s.rates;
    m->t_old = t;
    m->t = to;
    return lw_are_finite(y, N) ? PASSED : FAILED;
}

/* One step of an embedded method. Its numbers are constants, and so are all loops' ends. */
INLINE int step_small(method *m, const lw_tableau *numbers) {
    surroundings s = look_around(m->of);
    const int64_t stages = numbers->stages;
    double x[N], y[N], end[N], atol[N], K[7 * N];
    for (int i = 0; i < N; i++) {
        x[i] = m->x[i];
        K[i] = m->f[i];
        atol[i] = m->atol[i];
    }
    const bool taken = step_embedded(m, &s, N, numbers, atol, x, K, y, end);
    m->of->rates += s.rates;
    if (!taken) return FAILED;
    for (int j = 0; j < (stages + 1) * N; j++) m->K[j] = K[j];
    for (int i = 0; i < N; i++) {
        m->x_old[i] = x[i];
        m->x[i] = end[i];
        m->f[i] = K[stages * N + i];
    }
    return PASSED;
}
