/* Transport delays in continuous time: their inputs, kept as polynomials over the steps of the method.

   The rules are those of diagrams/compiled/transport_delays.py, which says why: no step is longer than the shortest
   delay, so that what comes out is a known function of time; each step is kept as the polynomial through the inputs at
   Chebyshev points, halved until that is as exact as the tolerance asks for; a discontinuity that goes in comes out a
   delay later, and the method lands there. The caller enlarges the memory between two calls. */

enum { NODES = 9, CHECKS = 4, DEEPEST = 10, SMOOTH = 8, NOTES = 16 };

static const double CHECKED[CHECKS] = {0.0211, 0.2671, 0.5837, 0.9113}; /* parts of a step at which it is compared */

typedef struct delays {
    int64_t n, distinct;
    const double *tau, *different;        /* of each delay; each value once, ascending */
    const int64_t *input, *output, *size; /* where each is in z and in w, and how many entries it has */
    const double *start;                  /* for each entry of z: what comes out until the delay has passed */
    const double *node, *weight;          /* Chebyshev points in [0, 1] and their barycentric weights */
    int64_t inputs, outputs;              /* entries of z and of w */
    double *here, *trial;                 /* w at the instant that is reached, and at a trial */
    tick driven;                          /* z at a trial */
    double *z, *found;                    /* its result; the polynomial's value there */
    double rtol, atol;
    double *pieces;                       /* past inputs: rows of begin, end, and z at each of the nodes */
    double *edges;                        /* discontinuities that come out: rows of time, and order of the derivative */
    int64_t count, capacity, noted, room;
    int64_t smoothed;                     /* whether a state is between any output and any input of a delay */
    double middle;                        /* an instant on the side of a discontinuity that is wanted */
} delays;

static inline bool look(problem *p, double t, const double *x);
static inline void interpolate(method *m, double t, double *out);

static inline double *piece_of(const delays *d, int64_t i) { return d->pieces + i * (2 + NODES * d->inputs); }

/* Whether the next step can be kept, however often it is halved, and the discontinuities at its end. */
static bool has_room_for_step(const delays *d) {
    return d->count + (1 << DEEPEST) < d->capacity && d->noted + NOTES * d->distinct < d->room;
}

/* Write some entries of the polynomial through samples at the nodes, at a part of its piece. */
static void evaluate_piece(const delays *d, double part, const double *samples, int64_t first, int64_t n, double *out) {
    double factors[NODES], sum = 0.0;
    for (int k = 0; k < NODES; k++) {
        const double difference = part - d->node[k];
        if (difference == 0.0) {
            memcpy(out, samples + k * d->inputs + first, (size_t)n * sizeof(double));
            return;
        }
        sum += factors[k] = d->weight[k] / difference;
    }
    for (int64_t i = 0; i < n; i++) {
        double value = 0.0;
        for (int k = 0; k < NODES; k++) value += factors[k] * samples[k * d->inputs + first + i];
        out[i] = value / sum;
    }
}

/* Write what comes out of the delays at a time into w. */
static void put_delayed(const delays *d, double t, double *w) {
    for (int64_t i = 0; i < d->n; i++) {
        const double s = t - d->tau[i], nudged = s + 1e-9 * (d->middle - d->tau[i] - s);
        int64_t low = 0, high = d->count; /* pieces that begin no later come before `low` */
        while (low < high) {
            const int64_t at = (low + high) / 2;
            if (piece_of(d, at)[0] <= nudged)
                low = at + 1;
            else
                high = at;
        }
        double *out = w + d->output[i];
        if (low) {
            const double *piece = piece_of(d, low - 1);
            evaluate_piece(d, (s - piece[0]) / (piece[1] - piece[0]), piece + 2, d->input[i], d->size[i], out);
        } else {
            memcpy(out, d->start + d->input[i], (size_t)d->size[i] * sizeof(double));
        }
    }
}

/* Write the inputs at a time of the last step. */
static bool find_inputs(delays *d, problem *p, method *m, double t, double *out) {
    interpolate(m, t, m->y);
    if (!look(p, t, m->y) || call(&d->driven)) return p->lost = AT_TRIAL, false;
    if (out != d->z) memcpy(out, d->z, (size_t)d->inputs * sizeof(double));
    return true;
}

/* Whether the polynomial through samples from a to b is as exact as the tolerance asks for; false in `known`: lost. */
static bool is_exact(delays *d, problem *p, method *m, double a, double b, const double *samples, bool *known) {
    for (int k = 0; k < CHECKS; k++) {
        if (!find_inputs(d, p, m, a + (b - a) * CHECKED[k], d->z)) return *known = false;
        evaluate_piece(d, CHECKED[k], samples, 0, d->inputs, d->found);
        for (int64_t i = 0; i < d->inputs; i++) {
            double size = 0.0;
            for (int j = 0; j < NODES; j++) size = fmax(size, fabs(samples[j * d->inputs + i]));
            const double allowed = fmax(0.1 * (d->atol + d->rtol * size), 1e-13 * size);
            if (fabs(d->found[i] - d->z[i]) > allowed) return false;
        }
    }
    return true;
}

/* Keep the inputs from a to b, within the last step, in pieces; false where an input can't be evaluated. */
static bool keep_pieces(delays *d, problem *p, method *m, double a, double b, int deepest) {
    double *piece = piece_of(d, d->count), *samples = piece + 2;
    bool known = true;
    piece[0] = a;
    piece[1] = b;
    for (int k = 0; k < NODES; k++)
        if (!find_inputs(d, p, m, k == NODES - 1 ? b : a + (b - a) * d->node[k], samples + k * d->inputs)) return false;
    const double middle = 0.5 * (a + b);
    if (!deepest || !(a < middle && middle < b) || is_exact(d, p, m, a, b, samples, &known)) {
        d->count++;
        return true;
    }
    return known && keep_pieces(d, p, m, a, middle, deepest - 1) && keep_pieces(d, p, m, middle, b, deepest - 1);
}

/* --- discontinuities ---------------------------------------------------------------------------------------------- */

/* Note a discontinuity of the inputs at t, or of their derivative of some order; one instant is noted once. */
static void note_edge(delays *d, double t, double order) {
    for (int64_t j = 0; j < d->distinct; j++) {
        const double at = t + d->different[j];
        int64_t i = 0;
        while (i < d->noted && d->edges[2 * i] < at) i++;
        int64_t near = -1;
        for (int64_t k = i > 0 ? i - 1 : 0; near < 0 && k <= i && k < d->noted; k++)
            if (!is_before(d->edges[2 * k], at) && !is_before(at, d->edges[2 * k])) near = k;
        if (near >= 0) {
            d->edges[2 * near + 1] = fmin(d->edges[2 * near + 1], order);
            continue;
        }
        memmove(d->edges + 2 * (i + 1), d->edges + 2 * i, (size_t)(d->noted - i) * 2 * sizeof(double));
        d->edges[2 * i] = at;
        d->edges[2 * i + 1] = order;
        d->noted++;
    }
}

/* Forget the discontinuities up to a time; return the least order among them. */
static double pass_edges(delays *d, double t) {
    int64_t passed = 0;
    double order = INFINITY;
    for (; passed < d->noted && !is_before(t, d->edges[2 * passed]); passed++)
        order = fmin(order, d->edges[2 * passed + 1]);
    d->noted -= passed;
    if (passed) memmove(d->edges, d->edges + 2 * passed, (size_t)d->noted * 2 * sizeof(double));
    return order;
}

/* Return the next time after t at which a discontinuity comes out. */
static double next_edge(delays *d, double t) {
    pass_edges(d, t);
    return d->noted ? d->edges[0] : INFINITY;
}

/* Note a discontinuity at t, of a source or out of a delay: it goes into the delays. */
static void note_reached(delays *d, double t, bool from_source) {
    const double order = fmin(from_source ? 0.0 : INFINITY, pass_edges(d, t) + (double)d->smoothed);
    if (order < SMOOTH) note_edge(d, t, order);
}

