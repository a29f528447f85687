/* The runtime of exported FMUs: what a generated model provides, and what an instance holds.
 *
 * One translation unit per FMU: the generated model.c defines the LW_ constants below, includes this header, then holds
 * the equations and tables, then includes core.c (no FMI version in it) and one file of FMI functions. Being one unit,
 * the equations are inlined into the integrator, and all sizes are constants.
 *
 * All values of an instance are doubles in one array, in this order (so that a value reference is an index into
 * lw_variables, and every variable an interval of the array):
 *
 *     time | parameters | inputs | states | derivatives | outputs | internal_step | inputs held in the last step
 */
#ifndef LW_MODEL_H
#define LW_MODEL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Generated: LW_MODEL_NAME, LW_TOKEN, LW_N_P, LW_N_U, LW_N_X, LW_N_Y (elements), LW_N_VARIABLES, LW_HAS_DERIVATIVES,
 * LW_SZ_ARG, LW_SZ_RES, LW_SZ_IW, LW_SZ_W (work of the equations, the largest of all). */
#define LW_P 1
#define LW_U (LW_P + LW_N_P)
#define LW_X (LW_U + LW_N_U)
#define LW_DX (LW_X + LW_N_X)
#define LW_Y (LW_DX + LW_N_X)
#define LW_STEP (LW_Y + LW_N_Y)
#define LW_HELD (LW_STEP + 1)
#define LW_N_VALUES (LW_HELD + LW_N_U)
#define LW_AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

/* Scratch of a state's size: on the stack for small models, else the instance's own. */
#if LW_N_X <= 64
#define LW_SCRATCH(name) double name[LW_AT_LEAST_1(LW_N_X)]
#else
#define LW_SCRATCH(name) double *const name = self->name
#endif

typedef enum { LW_TIME, LW_FIXED, LW_TUNABLE, LW_INPUT, LW_STATE, LW_DERIVATIVE, LW_OUTPUT } lw_kind;

typedef struct {
    const char *name;
    lw_kind kind;
    bool is_output; /* a computed output, or a state that is one */
    uint32_t first; /* index of its first element in the values */
    uint32_t size;
    double min, max;
} lw_variable;

/* An equation, as CasADi generates it: reads arg, writes res; nonzero if it failed. */
typedef int lw_function(const double **arg, double **res, long long int *iw, double *w, int mem);

typedef enum { LW_INSTANTIATED, LW_INITIALIZING, LW_STEPPING, LW_TERMINATED } lw_mode;
typedef enum { LW_LOG_WARNING = 1, LW_LOG_ERROR = 2 } lw_category;

/* What an FMU state is made of: copied and serialized as it is. */
typedef struct {
    uint64_t magic;
    int32_t mode;
    uint8_t have_outputs, have_derivatives, stop_time_defined, unused;
    double stop_time;
    double values[LW_N_VALUES];
} lw_state;

typedef struct lw_instance lw_instance;
struct lw_instance {
    lw_state s;
    /* scratch of the integrator and of the equations */
    double x[LW_AT_LEAST_1(LW_N_X)], stage[LW_AT_LEAST_1(LW_N_X)], next[LW_AT_LEAST_1(LW_N_X)];
    double k1[LW_AT_LEAST_1(LW_N_X)], k2[LW_AT_LEAST_1(LW_N_X)], k3[LW_AT_LEAST_1(LW_N_X)], k4[LW_AT_LEAST_1(LW_N_X)];
    double scratch[LW_N_VALUES];
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

#endif
