/* Events within a step: when an indicator leaves its domain, and what a jump leaves in contact.

   Runs of diagrams and exported FMUs use them. Defined before this file are LW_SEARCH, the type of a step in which events are
   sought, and LW_VALUE(s, i, t, lost), the value of indicator i at a time in it, which sets *lost where there is none. */

/* The distance between times that are told apart. */
static inline double lw_resolution(double t, double finest) {
    return fmax(4.0 * (nextafter(fabs(t), INFINITY) - fabs(t)), finest);
}

/* Return an instant at or just behind where an indicator is at a level, on the side of b; Chandrupatla (1997). */
static double lw_find_root(LW_SEARCH *s, int64_t i, double level, double a, double fa, double b, double fb, double resolution,
                           bool *lost) {
    if (fabs(b - a) <= resolution) return b; /* a step within it could lead out of the interval */
    const bool up = fa < 0.0;
    double part = fa / (fa - fb), x1 = a, f1 = fa, x2 = b, f2 = fb, x3, f3, least = 0.5 * resolution / fabs(b - a);
    for (int rounds = 0; rounds < 1000 && !*lost; rounds++) {
        part = fmin(fmax(part, least), 1.0 - least);
        const double x = x1 + part * (x2 - x1), fx = LW_VALUE(s, i, x, lost) - level;
        if ((up ? fx >= 0.0 : fx <= 0.0) == (up ? f1 >= 0.0 : f1 <= 0.0)) {
            x3 = x1, f3 = f1;
        } else {
            x3 = x2, f3 = f2;
            x2 = x1, f2 = f1;
        }
        x1 = x, f1 = fx;
        least = 0.5 * resolution / fabs(x2 - x1);
        if (!(least < 0.5)) return (up ? f1 >= 0.0 : f1 <= 0.0) ? x1 : x2;
        const double xi = (x1 - x2) / (x3 - x2), phi = f3 != f2 ? (f1 - f2) / (f3 - f2) : 2.0;
        if (phi * phi < xi && (1.0 - phi) * (1.0 - phi) < 1.0 - xi)
            part = f1 / (f2 - f1) * f3 / (f2 - f3) + (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2);
        else
            part = 0.5;
    }
    *lost = true;
    return b;
}

/* Return when an indicator, in its domain from low to high at a, is just outside of it, not after b, where it is. */
static double lw_leave(LW_SEARCH *s, int64_t i, double low, double high, double a, double value_a, double b, double value_b,
                       double finest, bool *lost) {
    const double level = value_b > high ? high : low, za = value_a - level, zb = value_b - level;
    double t = b, value;
    if (za == 0.0 || !(za * zb < 0.0)) {
        while (t - a > lw_resolution(t, finest) && !*lost) {
            const double middle = 0.5 * (a + t);
            value = LW_VALUE(s, i, middle, lost);
            if (low <= value && value <= high)
                a = middle;
            else
                t = middle;
        }
        return t;
    }
    t = lw_find_root(s, i, level, a, za, b, zb, lw_resolution(fmax(fabs(a), fabs(b)), finest), lost);
    double ahead = fmax(0.25 * lw_resolution(t, 0.0), finest);
    while (t < b && !*lost) {
        value = LW_VALUE(s, i, t, lost);
        if (!(low <= value && value <= high)) break;
        t = fmin(b, t + ahead);
        ahead *= 2;
    }
    return t;
}

/* Whether an indicator is in contact after its event: its jump leaves it on zero, or no further from there than the event
   found it, on the side to which it had crossed; its motion, over two steps of Euler's method, leads on beyond. */
static inline bool lw_is_contact(double side, double before, double after, double twice) {
    return !(side * after < 0.0 || fabs(after) > fabs(before)) && side * twice > 0.0;
}
