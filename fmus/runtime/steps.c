/* Times and lengths of the steps of a method: from where it is to the end of the next step. The rates and the states may
   be in memory (methods.c) or in registers (small.c). */

#include "fixed_step.c"
#include "embedded.c"

/* Return the time at which the next step of a method of fixed step ends. */
static inline double end_of_step(method *m) {
    const double stop = m->of->stop;
    m->done++;
    return m->done >= m->count ? stop : m->start + m->done * ((stop - m->start) / m->count);
}

/* Take a step from x, with the rates K[0] there, to `end`; false if the error control accepts none. */
LW_INLINE bool step_embedded(method *m, LW_EQUATION *e, int64_t n, const lw_tableau *numbers, const double *atol,
                             const double *x, double *K, double *y, double *end) {
    const lw_tolerance tolerance = {atol, m->rtol};
    const double least = 10.0 * ulp(m->t), before = m->h;
    lw_attempt step = {.t = m->t, .stop = m->of->stop, .least = least};
    step.h = m->h > m->longest ? m->longest : m->h < least ? least : m->h;
    const bool taken = lw_take_step(e, n, numbers, &tolerance, &step, x, K, y, end);
    m->rejected += step.rejected;
    if (!taken) return false;
    m->t_old = m->t;
    m->t = step.to;
    m->h = step.h * step.factor;
    m->planned = step.to == step.stop ? larger(before, m->h) : m->h; /* a step that was cut says little about the next */
    return true;
}
