/* A differential equation and a method that integrates it, as numbers; and what steps of all methods use. */

/* The differential equation: its functions read `x`, the vector of all states, with the integrated ones at `where`. */
typedef struct {
    int64_t n, width;
    const int64_t *where;
    tick flow, slope;        /* the rates at (t, x), and their derivative by the integrated states */
    double *t, *x, *slopes;
    int64_t entries;         /* of the slope that may not be 0, which are in slopes; else all of them are, by columns */
    const int64_t *row, *column;
    double stop;             /* rates are evaluated no later */
    double edge, left;       /* up to the discontinuity `edge` sources are seen at the time `left` before it at most */
    double at, late;         /* at the time `at` they are seen at the time `late`, just after it */
    newton *loops;           /* algebraic loops of a trial, with values among the states; NULL: none */
    const double *here;      /* states of the instant that is reached, from which the loops are sought */
    double *by_loops;        /* of the slope: ∂f/∂v, then ∂r/∂x, for loops with the values v and r(x, v) = 0 */
    struct delays *delays;   /* transport delays; NULL: none */
    int64_t rates, jacobians;
    int64_t lost;            /* where a run can't continue */
    int64_t noting;          /* whether a trial is noted at which a rate is not finite */
    double beyond_t, *beyond; /* the last such trial: its time, NaN without one, and its states; IN_PROGRESS: mean step, s */
} problem;

/* What can't be done: a step of the method; steps that lead on; the derivative of the rates at a step's begin; a value at
   the trial; everything at the instant that is reached. */
enum { NOWHERE, IN_STEP, IN_PROGRESS, IN_SLOPE, AT_TRIAL, AT_INSTANT };

enum { FIXED_STEP, EXPLICIT, EIGHT, RADAU, LIBRARY }; /* LIBRARY: one of another library's, by a callback */
enum { PASSED, FAILED };
enum { BEGIN, STEP_ON, EXPAND }; /* calls of a library's method: begin and take a step, take one, write dense output */

typedef struct method {
    int64_t kind, n, stages, order, extra; /* order: of the dense output; extra: stages for it */
    const double *A, *B, *C, *E, *E3, *P, *A_extra, *C_extra, *atol;
    double rtol, longest, exponent; /* longest: step in s; exponent: of the error in the step control */
    problem *of;
    double planned;                 /* step that would be taken next, s; NaN: none is known */
    double t, t_old, h, start;
    int64_t count, done, steps, rejected, segment;
    double mark;
    int32_t sliver, prepared;
    double *x, *x_old, *f, *y, *g, *K, *D; /* D: dense output, a row for each power */
    double *J, *lu, *lu_complex, *Z, *W, *F, *error, *scale;
    int64_t *pivots, *pivots_complex;
    double h_of_lu, h_before, error_before, tolerance;
    int32_t has_lu, has_slope, slope_is_new, predicts;
    int (*step)(struct method *m); /* a step of this method for this equation alone; NULL: none was made */
    int (*library)(int32_t wanted); /* of a library's method; writes t and x of the step, or order and D */
    int32_t begins;                 /* whether its next step is the first one from (t, x) to the stop */
} method;

static const double TOLERANCE = 4.0 * 2.220446049250313e-16; /* of a time; see blocks/core/instants.py */

/* The distance to the next number further from zero, the larger and the smaller one of two: without libm's calls. */
static inline double ulp(double t) {
    const double size = fabs(t);
    uint64_t bits;
    double next;
    memcpy(&bits, &size, sizeof bits);
    bits++;
    memcpy(&next, &bits, sizeof next);
    return next - size;
}

static inline double larger(double a, double b) { return a > b ? a : b; }
static inline double smaller(double a, double b) { return a < b ? a : b; }
static inline double left_of(double t) { return t - 4.0 * TOLERANCE * fabs(t); }
static inline bool is_before(double a, double b) { return b < INFINITY ? a < b - 2.0 * TOLERANCE * fabs(b) : a < b; }
