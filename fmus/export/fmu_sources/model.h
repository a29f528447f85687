/* C sources of exported FMUs: declarations of a generated model, and of an instance.
 *
 * One translation unit per FMU: the generated model.c defines the LW_ constants below, includes this header, then holds
 * the equations and tables, then includes core.c, integrators.c, events.c and stepping.c (no FMI version in them), fmi_calls.c and the
 * files of one FMI version. linear.c, fixed_step.c and embedded.c, which these include, are those of runs of diagrams
 * (fmus/runtime). Being one unit, the equations are inlined into the integrator, and all sizes are constants.
 *
 * All values of an instance are doubles in one array, in this order (every variable is an interval of the array):
 *
 *     time | parameters | inputs | continuous states | discrete states | derivatives | outputs | event indicators |
 *     internal_step, integrator, tolerance | inputs held in the last step
 */
#ifndef LW_MODEL_H
#define LW_MODEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Generated: LW_MODEL_NAME, LW_TOKEN; LW_FMI, the version; elements: LW_N_P, LW_N_U, LW_N_X (continuous states), LW_N_D (discrete states),
 * LW_N_Y; LW_N_Z events; LW_N_J nonzeros of the Jacobian; LW_N_VARIABLES; LW_HAS_DERIVATIVES; LW_SZ_ARG, LW_SZ_RES,
 * LW_SZ_IW, LW_SZ_W (work of the equations, the largest of all); LW_API, the prefix of names of FMI's functions. */
#ifndef LW_LOOP
#define LW_LOOP 0 /* 1: of a diagram, whose loop (fmus/runtime/exported.c) stands before this file; loop.c says what differs */
#endif
#ifndef LW_CLOCKS
#define LW_CLOCKS 0 /* input clocks that are offered: those of a diagram's ticks, in FMI 3.0 */
#endif
#define LW_EVENT_MODE (LW_N_Z || LW_CLOCKS) /* is there an Event Mode in Co-Simulation? */
#ifndef LW_MERGED
#define LW_MERGED 0 /* 1: merged into a diagram, which owns the instance, and copies it: nothing is allocated, see merged_plants.py */
#endif
#define LW_N_S (LW_N_X + LW_N_D) /* all states, as the equations take them */
#define LW_P 1
#define LW_U (LW_P + LW_N_P)
#define LW_X (LW_U + LW_N_U)
#define LW_D (LW_X + LW_N_X)
#define LW_DX (LW_D + LW_N_D)
#define LW_Y (LW_DX + LW_N_X)
#define LW_Z (LW_Y + LW_N_Y)
#define LW_STEP (LW_Z + LW_N_Z)
#define LW_INTEGRATOR (LW_STEP + 1)
#define LW_TOLERANCE (LW_STEP + 2)
#define LW_HELD (LW_STEP + 3)
#define LW_N_VALUES (LW_HELD + LW_N_U)
#define LW_N_UNKNOWNS (LW_N_X + LW_N_Y + LW_N_Z) /* derivatives, outputs, event indicators: from LW_DX on */
#ifndef LW_INLINE
#if defined(__GNUC__)
#define LW_INLINE static inline __attribute__((always_inline))
#else
#define LW_INLINE static inline
#endif
#endif
#define LW_AT_LEAST_1(n) ((n) > 0 ? (n) : 1)
#define LW_MOVING_INPUTS (LW_FMI == 2 && LW_N_U > 0 && !LW_LOOP) /* may inputs move within a step, by given derivatives? */
#define LW_MAX_ORDER 4                               /* of these derivatives */

/* Scratch of a state's size: on the stack for small models, else the instance's own. */
#if LW_N_S <= 64
#define LW_SCRATCH(name) double name[LW_AT_LEAST_1(LW_N_S)]
#else
#define LW_SCRATCH(name) double *const name = self->name
#endif

typedef enum {
    LW_TIME, LW_FIXED, LW_TUNABLE, LW_INPUT, LW_STATE, LW_DISCRETE, LW_DERIVATIVE, LW_OUTPUT, LW_INDICATOR
} lw_kind;

#if LW_LOOP && LW_HAS_DERIVATIVES
/* What derivatives are by: time, states, inputs, parameters, as they are in the memory. */
#define LW_LENGTH_OF(member) (sizeof ((lw_memory *)0)->member / sizeof(double))
#define LW_KNOWN_X 1
#define LW_KNOWN_W (LW_KNOWN_X + LW_LENGTH_OF(x))
#define LW_KNOWN_P (LW_KNOWN_W + LW_LENGTH_OF(w))
#define LW_N_KNOWNS (LW_KNOWN_P + LW_LENGTH_OF(p))
#endif

typedef struct {
    const char *name;
    lw_kind kind;
    bool is_output;   /* a computed output, or a state that is one */
    bool is_discrete; /* an input that changes at events only */
    uint32_t first;   /* index of its first element in the values */
    uint32_t size;
    double min, max;
} lw_variable;

typedef struct {
    const char *name;
    int direction; /* 1 rising, -1 falling, 0 both */
    double nominal;
} lw_event;

/* An equation, as CasADi generates it: reads arg, writes res; nonzero if it failed. */
typedef int lw_function(const double **arg, double **res, long long int *iw, double *w, int mem);

typedef enum { LW_RK4 = 1, LW_DOPRI5 = 2, LW_RODAS = 3 } lw_integrator;
typedef enum {
    LW_INSTANTIATED, LW_INITIALIZING, LW_STEPPING, LW_EVENT, LW_CONTINUOUS, LW_TERMINATED,
    LW_INTERMEDIATE /* within a step; no state is ever saved in it */
} lw_mode;
typedef enum { LW_LOG_WARNING = 1, LW_LOG_ERROR = 2 } lw_category;

#if LW_N_Z
#define LW_N_Z8 ((LW_N_Z + 7) / 8 * 8) /* no padding */
/* The domain of an indicator: z <= 0, z > 0, or on the border, from where the direction in which it leaves decides. */
enum { LW_BELOW, LW_ABOVE, LW_BORDER };
typedef struct {
    double last_fired[LW_N_Z], last_but_one[LW_N_Z]; /* times at which doStep has found the event */
    double level[LW_N_Z];                            /* on the border: the indicator there */
    uint8_t domain[LW_N_Z8];
    uint8_t lean[LW_N_Z8];    /* on the border: does the importer see it above zero? */
    uint8_t side[LW_N_Z8];    /* the domain in which its jump has left it in contact, plus 1; 0 for none */
    uint8_t resting[LW_N_Z8]; /* events in a row that led back into contact */
} lw_event_memory;
#endif

/* Content of an FMU state, which is copied and serialized unchanged. */
typedef struct {
    uint64_t magic;
    int32_t mode;
    uint8_t have_outputs, have_derivatives, have_indicators; /* are these up to date? */
    uint8_t model_exchange;
    uint8_t stop_time_defined, tolerance_given, iterations; /* iterations in this visit of Event Mode */
    uint8_t moving, moved; /* do the inputs move in the next step; did they in the last one? */
    uint8_t begun, unused[2]; /* of a diagram: has the start been taken over? */
    double stop_time;
    double step_size; /* of the adaptive integrators, to try next; 0: choose again */
    double values[LW_N_VALUES];
#if LW_MOVING_INPUTS
    double slopes[LW_MAX_ORDER][LW_N_U]; /* derivatives of the inputs by time at the start of the next step, from order 1 on */
#endif
#if LW_N_Z
    lw_event_memory events;
#endif
#if LW_LOOP
    uint64_t active; /* clocks that tick in this visit of Event Mode, as bits */
    lw_memory memory;
#endif
} lw_state;

typedef struct lw_instance lw_instance;
struct lw_instance {
    lw_state s;
    bool event_mode_used, early_return_allowed; /* chosen by the importer */
    bool event_found;                           /* the last step ended at an event */
    /* Intermediate update, or NULL: returns true if the step must end early, at *until or now. */
    bool (*update)(lw_instance *self, double t, bool can_return_early, double *until);
    void (*update_sink)(void);
    lw_state *before; /* with an update: the state before the step */
#if LW_LOOP && LW_HAS_DERIVATIVES
    double slopes[LW_N_SLOPES + 1], knowns[LW_N_KNOWNS], begun[LW_N_KNOWNS]; /* seeds, or products, by the entries of the memory */
#endif
#if LW_LOOP && LW_CLOCKS
    lw_memory kept; /* the memory before an evaluation in Event Mode, which comes back */
#endif
#if LW_MOVING_INPUTS
    double step_start, inputs[LW_N_U]; /* time at which the derivatives of the inputs hold; the inputs at a later time */
#endif
    /* scratch of the integrators and of the equations */
    double x[LW_AT_LEAST_1(LW_N_S)], stage[LW_AT_LEAST_1(LW_N_S)], next[LW_AT_LEAST_1(LW_N_S)];
    double k1[LW_AT_LEAST_1(LW_N_X)], k2[LW_AT_LEAST_1(LW_N_X)], k3[LW_AT_LEAST_1(LW_N_X)], k4[LW_AT_LEAST_1(LW_N_X)];
    double k[7 * LW_AT_LEAST_1(LW_N_X)];     /* slopes of the stages of an adaptive step, one after the other */
    double dense[4 * LW_AT_LEAST_1(LW_N_X)]; /* the solution within the last step, see lw_interpolate */
    double absolute[LW_AT_LEAST_1(LW_N_X)];  /* the absolute tolerance of each state */
#if LW_MERGED
    double matrix[LW_AT_LEAST_1(LW_N_MATRIX)]; /* LU factors of rodas */
#else
    double *matrix; /* the same, allocated when needed */
#endif
    int64_t pivots[LW_AT_LEAST_1(LW_N_X)];
    double jacobian[LW_AT_LEAST_1(LW_N_J)], slope[LW_AT_LEAST_1(LW_N_X)]; /* of the derivatives: by states; by time */
    double scratch[LW_N_VALUES + LW_N_Z];
    double seed[LW_N_VALUES], sensitivity[LW_N_VALUES]; /* in the order of the values */
    const double *arg[LW_SZ_ARG];
    double *res[LW_SZ_RES];
    long long int iw[LW_AT_LEAST_1(LW_SZ_IW)];
    double w[LW_AT_LEAST_1(LW_SZ_W)];
    /* logging */
    unsigned categories;
    void *environment;
    void (*write)(lw_instance *self, lw_category category, const char *message);
    void (*sink)(void);
    char *name;
};

/* The differential equation of an instance, as the integrators take it. */
typedef struct {
    lw_instance *self;
    const double *u, *p; /* inputs, NULL where they move within the step; parameters */
    long long int *iw;   /* work of the equations */
    double *w;
} lw_equation;

#endif
