/* Steps of explicit Runge-Kutta methods of a given length, from (t, x) with the rates k1 there to out, which may be x.

   Runs of diagrams, exported FMUs and vectors of runs use them. Defined before this file are LW_EQUATION, the type of a
   differential equation; LW_RATE(e, t, x, f), which writes its n rates at (t, x) to f and is not 0 where it can't; and
   LW_NUMBER, the type of a state. What x has beyond the n states that are integrated, y has too. Functions are inlined:
   where n is a constant and the arrays are local, numbers stay in registers. */

#ifndef LW_INLINE
#define LW_INLINE static inline
#endif

LW_INLINE int lw_euler(int64_t n, double h, const LW_NUMBER *x, const LW_NUMBER *k1, LW_NUMBER *out) {
    for (int64_t i = 0; i < n; i++) out[i] = x[i] + h * k1[i];
    return 0;
}

LW_INLINE int lw_heun(LW_EQUATION *e, int64_t n, double h, double to, const LW_NUMBER *x, const LW_NUMBER *k1,
                      LW_NUMBER *k2, LW_NUMBER *y, LW_NUMBER *out) {
    for (int64_t i = 0; i < n; i++) y[i] = x[i] + h * k1[i];
    const int failed = LW_RATE(e, to, y, k2);
    for (int64_t i = 0; i < n; i++) out[i] = x[i] + (0.5 * h) * (k1[i] + k2[i]);
    return failed;
}

/* The method of order 3 of Bogacki and Shampine's pair, Appl. Math. Lett. 2 (1989): no stage is at the end of the step. */
LW_INLINE int lw_rk3(LW_EQUATION *e, int64_t n, double t, double h, const LW_NUMBER *x, const LW_NUMBER *k1, LW_NUMBER *k2,
                     LW_NUMBER *k3, LW_NUMBER *y, LW_NUMBER *out) {
    for (int64_t i = 0; i < n; i++) y[i] = x[i] + (0.5 * h) * k1[i];
    int failed = LW_RATE(e, t + 0.5 * h, y, k2);
    for (int64_t i = 0; i < n; i++) y[i] = x[i] + (0.75 * h) * k2[i];
    failed |= LW_RATE(e, t + 0.75 * h, y, k3);
    for (int64_t i = 0; i < n; i++) out[i] = x[i] + (h / 9.0) * (2.0 * k1[i] + 3.0 * k2[i] + 4.0 * k3[i]);
    return failed;
}

LW_INLINE int lw_rk4(LW_EQUATION *e, int64_t n, double t, double h, double to, const LW_NUMBER *x, const LW_NUMBER *k1,
                     LW_NUMBER *k2, LW_NUMBER *k3, LW_NUMBER *k4, LW_NUMBER *y, LW_NUMBER *out) {
    const double middle = t + 0.5 * h;
    for (int64_t i = 0; i < n; i++) y[i] = x[i] + (0.5 * h) * k1[i];
    int failed = LW_RATE(e, middle, y, k2);
    for (int64_t i = 0; i < n; i++) y[i] = x[i] + (0.5 * h) * k2[i];
    failed |= LW_RATE(e, middle, y, k3);
    for (int64_t i = 0; i < n; i++) y[i] = x[i] + h * k3[i];
    failed |= LW_RATE(e, to, y, k4);
    for (int64_t i = 0; i < n; i++) out[i] = x[i] + (h / 6.0) * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
    return failed;
}

/* Take a step of the explicit method of fixed step that has so many stages; K has room for the rates of all but the first. */
LW_INLINE int lw_fixed(LW_EQUATION *e, int64_t n, int stages, double t, double h, double to, const LW_NUMBER *x,
                       const LW_NUMBER *k1, LW_NUMBER *K, LW_NUMBER *y, LW_NUMBER *out) {
    if (stages == 1) return lw_euler(n, h, x, k1, out);
    if (stages == 2) return lw_heun(e, n, h, to, x, k1, K, y, out);
    if (stages == 3) return lw_rk3(e, n, t, h, x, k1, K, K + n, y, out);
    return lw_rk4(e, n, t, h, to, x, k1, K, K + n, K + 2 * n, y, out);
}
