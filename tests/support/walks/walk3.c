/* Every function of FMI 3.0 in every state, with right and wrong arguments, on the FMU that it is linked with.
 * facts.h is made from its modelDescription.xml. */
#include "fmi3Functions.h"
#include "facts.h"
#include "walk.h"

static void on_log(fmi3InstanceEnvironment e, fmi3Status s, fmi3String category, fmi3String message) {
    (void)e, (void)s;
    messages += (int)(strlen(category) > 0) + (int)(strlen(message) > 0) > 0;
}

static interface kind;

static fmi3Instance make(const char *token) {
    if (kind == EXCHANGED) return fmi3InstantiateModelExchange("walk", token, NULL, false, true, NULL, on_log);
    return fmi3InstantiateCoSimulation("walk", token, NULL, false, true, kind == EVENTFUL, false, NULL, 0, NULL, on_log, NULL);
}

/* Activate the clocks that tick at the start, and leave Event Mode. */
static int leave_events(void *i) {
    fmi3Boolean again = true, ends, nominals, moved, defined;
    fmi3Float64 next;
    for (int k = 0; k < N_CLOCKS; k++) {
        fmi3ValueReference vr = clocks[k].reference;
        fmi3Clock on = true;
        if (clocks[k].shift == 0.0 && fmi3SetClock(i, &vr, 1, &on)) return fmi3Error;
    }
    for (int k = 0; again && k < 10; k++)
        if (fmi3UpdateDiscreteStates(i, &again, &ends, &nominals, &moved, &defined, &next)) return fmi3Error;
    return kind == EXCHANGED ? fmi3EnterContinuousTimeMode(i) : fmi3EnterStepMode(i);
}

static bool reach(void *i, int state) {
    if (state == I) return true;
    if (fmi3EnterInitializationMode(i, false, 0.0, 0.0, false, 0.0)) return false;
    if (state == N) return true;
    if (fmi3ExitInitializationMode(i)) return false;
    if (state == E) return true;
    if (kind != STEPPED && leave_events(i)) return false;
    if (state == S || state == C) return true;
    return !fmi3Terminate(i);
}

static int step(void *i) {
    fmi3Boolean event, ends, early;
    fmi3Float64 reached = -1.0;
    int status = fmi3DoStep(i, 0.0, STEP, true, &event, &ends, &early, &reached);
    if (!status && fabs(reached - STEP) > 1e-12) return fmi3Discard;
    return status;
}

/* ---- variables ---- */

static double room[MOST + 1];
static int get1(void *i, long vr, size_t n) {
    fmi3ValueReference v = (fmi3ValueReference)vr;
    return fmi3GetFloat64(i, &v, 1, room, n);
}
static int set_back(void *i, long vr, long size) {
    fmi3ValueReference v = (fmi3ValueReference)vr;
    for (long k = 0; k < size; k++) room[k] = start_of(vr, k);
    return fmi3SetFloat64(i, &v, 1, room, (size_t)size);
}
#define SIZED(kind_) \
    static int get_##kind_(void *i) { return get1(i, VR_##kind_, SIZE_##kind_); } \
    static int set_##kind_(void *i) { return set_back(i, VR_##kind_, SIZE_##kind_); }
SIZED(TIME) SIZED(FIXED) SIZED(TUNABLE) SIZED(INPUT) SIZED(STATE) SIZED(OUTPUT)

static int get_few(void *i) { return get1(i, VR_TIME, 0); }
static int get_many(void *i) { return get1(i, VR_TIME, 2); }
static int get_unknown(void *i) { return get1(i, 99999, 1); }
static int get_huge(void *i) { return get1(i, 0xffffffffL, 1); }
static int get_none(void *i) { return fmi3GetFloat64(i, NULL, 0, NULL, 0); }
static int get_null(void *i) { fmi3ValueReference v = VR_TIME; return fmi3GetFloat64(i, &v, 1, NULL, 1); }
static int get_no_references(void *i) { return fmi3GetFloat64(i, NULL, 1, room, 1); }
static int set_none(void *i) { return fmi3SetFloat64(i, NULL, 0, NULL, 0); }
static int set_null(void *i) { fmi3ValueReference v = VR_INPUT; return fmi3SetFloat64(i, &v, 1, NULL, SIZE_INPUT); }
static int set_no_references(void *i) { room[0] = 0.0; return fmi3SetFloat64(i, NULL, 1, room, 1); }
static int set_nan(void *i) { fmi3ValueReference v = VR_INPUT; room[0] = NAN; return fmi3SetFloat64(i, &v, 1, room, 1); }
static int set_unknown(void *i) { fmi3ValueReference v = 99999; room[0] = 0.0; return fmi3SetFloat64(i, &v, 1, room, 1); }

#define OTHER(type) \
    static int no_##type(void *i) { \
        fmi3ValueReference v = 0; \
        fmi3##type value[1] = {0}; \
        int a = fmi3Get##type(i, NULL, 0, NULL, 0), b = fmi3Set##type(i, NULL, 0, NULL, 0); \
        if (i && (a || b)) return fmi3OK; /* so that the row fails */ \
        int c = fmi3Get##type(i, &v, 1, value, 1), d = fmi3Set##type(i, &v, 1, value, 1); \
        return c && d ? fmi3Error : fmi3OK; \
    }
OTHER(Float32) OTHER(Int8) OTHER(UInt8) OTHER(Int16) OTHER(UInt16) OTHER(Int32) OTHER(UInt32) OTHER(Int64) OTHER(UInt64)
OTHER(Boolean) OTHER(String)
static int no_binary(void *i) {
    fmi3ValueReference v = 0;
    size_t size = 0;
    fmi3Binary value = NULL;
    int a = fmi3GetBinary(i, &v, 1, &size, &value, 1), b = fmi3SetBinary(i, &v, 1, &size, &value, 1);
    return a && b ? fmi3Error : fmi3OK;
}

/* ---- states ---- */

static int keep_state(void *i) {
    fmi3FMUState state = NULL;
    int a = fmi3GetFMUState(i, &state);
    int again = a ? a : fmi3GetFMUState(i, &state); /* into the same one */
    int b = again ? again : fmi3SetFMUState(i, state);
    int c = fmi3FreeFMUState(i, &state);
    return a | b | c || state ? fmi3Error : fmi3OK;
}
static int get_state_null(void *i) { return fmi3GetFMUState(i, NULL); }
static int set_state_null(void *i) { return fmi3SetFMUState(i, NULL); }
static int free_state_null(void *i) { fmi3FMUState none = NULL; return fmi3FreeFMUState(i, NULL) | fmi3FreeFMUState(i, &none); }
static int size_null(void *i) {
    fmi3FMUState state = NULL;
    if (fmi3GetFMUState(i, &state)) return fmi3Error;
    int status = fmi3SerializedFMUStateSize(i, state, NULL);
    fmi3FreeFMUState(i, &state);
    return status;
}
static int serialized(void *i, int how) {
    fmi3FMUState state = NULL, other = NULL;
    size_t n = 0;
    if (fmi3GetFMUState(i, &state) || fmi3SerializedFMUStateSize(i, state, &n)) return fmi3Error;
    fmi3Byte *bytes = malloc(n + 1);
    int status = how == 5 ? fmi3SerializeFMUState(i, NULL, bytes, n) : how == 6 ? fmi3SerializeFMUState(i, state, NULL, n)
                 : fmi3SerializeFMUState(i, state, bytes, how == 1 ? n - 1 : n);
    if (how == 2 && !status) bytes[n / 2] ^= 1;
    if (!status && (how == 0 || how > 1)) {
        size_t given = how == 3 ? n - 1 : how == 4 ? n + 1 : how == 7 ? 0 : n;
        if (how == 4) bytes = realloc(bytes, n + 1), bytes[n] = 0;
        status = fmi3DeserializeFMUState(i, how == 8 ? NULL : bytes, given, how == 9 ? NULL : &other);
        if (!status) status = fmi3SetFMUState(i, other);
        if (other) fmi3FreeFMUState(i, &other);
    }
    free(bytes);
    fmi3FreeFMUState(i, &state);
    return status;
}
#define SERIALIZED(n) static int serialized_##n(void *i) { return serialized(i, n); }
SERIALIZED(0) SERIALIZED(1) SERIALIZED(2) SERIALIZED(3) SERIALIZED(4) SERIALIZED(5) SERIALIZED(6) SERIALIZED(7) SERIALIZED(8) SERIALIZED(9)

/* ---- modes ---- */

static int enter_init(void *i) { return fmi3EnterInitializationMode(i, true, 1e-6, 0.0, true, 10.0); }
static int enter_init_nan(void *i) { return fmi3EnterInitializationMode(i, false, 0.0, NAN, false, 0.0); }
static int enter_init_past(void *i) { return fmi3EnterInitializationMode(i, false, 0.0, 1.0, true, 0.0); }
static int exit_init(void *i) { return fmi3ExitInitializationMode(i); }
static int enter_event(void *i) { return fmi3EnterEventMode(i); }
static int update(void *i) {
    fmi3Boolean a, b, c, d, e;
    fmi3Float64 t;
    return fmi3UpdateDiscreteStates(i, &a, &b, &c, &d, &e, &t);
}
static int update_null(void *i) { return fmi3UpdateDiscreteStates(i, NULL, NULL, NULL, NULL, NULL, NULL); }
static int evaluate_discrete(void *i) { return fmi3EvaluateDiscreteStates(i); }
static int enter_step(void *i) { return fmi3EnterStepMode(i); }
static int enter_continuous(void *i) { return fmi3EnterContinuousTimeMode(i); }
static int terminate(void *i) { return fmi3Terminate(i); }
static int reset(void *i) { return fmi3Reset(i); }
static int enter_configuration(void *i) { return fmi3EnterConfigurationMode(i); }
static int exit_configuration(void *i) { return fmi3ExitConfigurationMode(i); }
static int debug(void *i) {
    fmi3String names[] = {"logStatusError", "logStatusWarning"};
    return fmi3SetDebugLogging(i, true, 2, names) | fmi3SetDebugLogging(i, true, 0, NULL) | fmi3SetDebugLogging(i, false, 0, NULL);
}
static int debug_unknown(void *i) {
    fmi3String names[] = {"none of these", NULL};
    return fmi3SetDebugLogging(i, true, 2, names);
}
static int step_back(void *i) { return fmi3DoStep(i, 5.0, STEP, true, NULL, NULL, NULL, NULL); }
static int step_nan(void *i) { return fmi3DoStep(i, 0.0, NAN, true, NULL, NULL, NULL, NULL); }
static int step_zero(void *i) { return fmi3DoStep(i, 0.0, 0.0, true, NULL, NULL, NULL, NULL); }
static int step_null(void *i) { return fmi3DoStep(i, 0.0, STEP, true, NULL, NULL, NULL, NULL); }

/* ---- Model Exchange ---- */

static double x[MOST + 1];
static int get_x(void *i) { return fmi3GetContinuousStates(i, x, N_X); }
static int get_x_few(void *i) { return fmi3GetContinuousStates(i, x, N_X + 1); }
static int get_x_null(void *i) { return fmi3GetContinuousStates(i, NULL, N_X); }
static int get_dx(void *i) { return fmi3GetContinuousStateDerivatives(i, x, N_X); }
static int get_dx_null(void *i) { return fmi3GetContinuousStateDerivatives(i, NULL, N_X); }
static int get_z(void *i) { return fmi3GetEventIndicators(i, x, N_Z); }
static int get_nominals(void *i) { return fmi3GetNominalsOfContinuousStates(i, x, N_X); }
static int set_x(void *i) { memset(x, 0, sizeof x); return fmi3SetContinuousStates(i, x, N_X); }
static int set_x_nan(void *i) { x[0] = NAN; return fmi3SetContinuousStates(i, x, N_X); }
static int set_x_null(void *i) { return fmi3SetContinuousStates(i, NULL, N_X); }
static int set_time(void *i) { return fmi3SetTime(i, 0.001); }
static int set_time_nan(void *i) { return fmi3SetTime(i, NAN); }
static int completed(void *i) { fmi3Boolean a, b; return fmi3CompletedIntegratorStep(i, true, &a, &b); }
static int completed_null(void *i) { return fmi3CompletedIntegratorStep(i, true, NULL, NULL); }
static int number_of_x(void *i) { size_t n = 99; int s = fmi3GetNumberOfContinuousStates(i, &n); return s ? s : n == N_X ? fmi3OK : fmi3Discard; }
static int number_of_z(void *i) { size_t n = 99; int s = fmi3GetNumberOfEventIndicators(i, &n); return s ? s : n == N_Z ? fmi3OK : fmi3Discard; }
static int number_null(void *i) { return fmi3GetNumberOfContinuousStates(i, NULL); }

/* ---- clocks, derivatives, what is not supported ---- */

static fmi3ValueReference clock0 = N_CLOCKS ? VR_CLOCK : 0;
static int get_clock(void *i) { fmi3Clock on = true; int s = fmi3GetClock(i, &clock0, 1, &on); return s ? s : on ? fmi3Discard : fmi3OK; }
static int get_clock_null(void *i) { return fmi3GetClock(i, &clock0, 1, NULL); }
static int set_clock(void *i) { fmi3Clock on = true; return fmi3SetClock(i, &clock0, 1, &on); }
static int set_clock_null(void *i) { return fmi3SetClock(i, NULL, 1, NULL); }
static int set_clock_unknown(void *i) { fmi3Clock on = true; fmi3ValueReference v = 99999; return fmi3SetClock(i, &v, 1, &on); }
static int set_clock_variable(void *i) { fmi3Clock on = true; fmi3ValueReference v = VR_TIME; return fmi3SetClock(i, &v, 1, &on); }
static int interval(void *i) {
    double t, shift;
    fmi3UInt64 n, d, m, e;
    fmi3IntervalQualifier q;
    int s = fmi3GetIntervalDecimal(i, &clock0, 1, &t, &q);
    s = s ? s : fmi3GetIntervalFraction(i, &clock0, 1, &n, &d, &q);
    s = s ? s : fmi3GetShiftDecimal(i, &clock0, 1, &shift);
    s = s ? s : fmi3GetShiftFraction(i, &clock0, 1, &m, &e);
    return s ? s : t == (double)n / (double)d && shift == (double)m / (double)e ? fmi3OK : fmi3Discard;
}
static int interval_null(void *i) {
    fmi3UInt64 n;
    int a = fmi3GetIntervalDecimal(i, &clock0, 1, NULL, NULL), b = fmi3GetIntervalFraction(i, &clock0, 1, &n, NULL, NULL);
    int c = fmi3GetShiftDecimal(i, &clock0, 1, NULL), d = fmi3GetShiftFraction(i, &clock0, 1, &n, NULL);
    return a && b && c && d ? fmi3Error : fmi3OK;
}
static int set_interval(void *i) {
    double t = 1.0;
    fmi3UInt64 n = 1;
    int a = fmi3SetIntervalDecimal(i, &clock0, 1, &t), b = fmi3SetIntervalFraction(i, &clock0, 1, &n, &n);
    int c = fmi3SetShiftDecimal(i, &clock0, 1, &t), d = fmi3SetShiftFraction(i, &clock0, 1, &n, &n);
    return a && b && c && d ? fmi3Error : fmi3OK;
}
static int derivative_of(void *i, bool adjoint, long known, long n_known, long unknown, long n_unknown, double *seed, size_t n, double *out, size_t m) {
    (void)n_known, (void)n_unknown;
    fmi3ValueReference k = (fmi3ValueReference)known, u = (fmi3ValueReference)unknown;
    return (adjoint ? fmi3GetAdjointDerivative : fmi3GetDirectionalDerivative)(i, &u, 1, &k, 1, seed, n, out, m);
}
#define DERIVED(name, adjoint, k, u, seed, n, out, m) \
    static int name(void *i) { for (int j = 0; j < MOST; j++) room[j] = 1.0; return derivative_of(i, adjoint, k, 0, u, 0, seed, n, out, m); }
DERIVED(directional, false, VR_INPUT, VR_OUTPUT, room, SIZE_INPUT, x, SIZE_OUTPUT)
DERIVED(adjoint, true, VR_INPUT, VR_OUTPUT, room, SIZE_OUTPUT, x, SIZE_INPUT)
DERIVED(directional_few, false, VR_INPUT, VR_OUTPUT, room, SIZE_INPUT - 1, x, SIZE_OUTPUT)
DERIVED(directional_many, false, VR_INPUT, VR_OUTPUT, room, SIZE_INPUT, x, SIZE_OUTPUT + 1)
DERIVED(directional_wrong, false, VR_OUTPUT, VR_INPUT, room, SIZE_OUTPUT, x, SIZE_INPUT)
DERIVED(directional_unknown, false, 99999, VR_OUTPUT, room, 1, x, SIZE_OUTPUT)
DERIVED(directional_null, false, VR_INPUT, VR_OUTPUT, NULL, SIZE_INPUT, x, SIZE_OUTPUT)
DERIVED(adjoint_null, true, VR_INPUT, VR_OUTPUT, room, SIZE_OUTPUT, NULL, SIZE_INPUT)
static int directional_none(void *i) { return fmi3GetDirectionalDerivative(i, NULL, 1, NULL, 1, room, 1, x, 1); }
static int unsupported(void *i) {
    size_t n = 0, m = 0;
    fmi3ValueReference v = 0;
    fmi3DependencyKind k;
    fmi3Int32 order = 1;
    int a = fmi3GetNumberOfVariableDependencies(i, 0, &n), b = fmi3GetVariableDependencies(i, 0, &n, &v, &m, &k, 1);
    int c = fmi3GetOutputDerivatives(i, &v, 1, &order, room, 1), d = fmi3ActivateModelPartition(i, 0, 0.0);
    return a && b && c && d ? fmi3Error : fmi3OK;
}

#define D (HAS_DERIVATIVES ? E | S | C : NONE)
#define WITH(flag, mask) ((flag) ? (mask) : NONE)
static const row table[] = {
    /* call                                    Co-Simulation            Model Exchange       either */
    {"enterInitializationMode", enter_init,    I,                       I,                   NONE},
    {"enterInitializationMode(NaN)", enter_init_nan, NONE,              NONE,                NONE},
    {"enterInitializationMode(past)", enter_init_past, NONE,            NONE,                NONE},
    {"exitInitializationMode", exit_init,      N,                       N,                   NONE},
    {"enterEventMode", enter_event,            S,                       C,                   NONE},
    {"updateDiscreteStates", update,           E,                       E,                   NONE},
    {"updateDiscreteStates(NULL)", update_null, E,                      E,                   NONE},
    {"evaluateDiscreteStates", evaluate_discrete, NONE,                 NONE,                NONE},
    {"enterStepMode", enter_step,              E,                       NONE,                NONE},
    {"enterContinuousTimeMode", enter_continuous, NONE,                 E,                   NONE},
    {"terminate", terminate,                   E | S,                   E | C,               NONE},
    {"reset", reset,                           ALL,                     ALL,                 NONE},
    {"enterConfigurationMode", enter_configuration, NONE,               NONE,                NONE},
    {"exitConfigurationMode", exit_configuration, NONE,                 NONE,                NONE},
    {"setDebugLogging", debug,                 ALL,                     ALL,                 NONE},
    {"setDebugLogging(unknown)", debug_unknown, NONE,                   NONE,                NONE},
    {"doStep", step,                           S,                       NONE,                NONE},
    {"doStep(NULL)", step_null,                S,                       NONE,                NONE},
    {"doStep(elsewhere)", step_back,           NONE,                    NONE,                NONE},
    {"doStep(NaN)", step_nan,                  NONE,                    NONE,                NONE},
    {"doStep(0)", step_zero,                   NONE,                    NONE,                NONE},
    {"getFloat64(time)", get_TIME,             N | E | S | T,           N | E | C | T,       I},
    {"getFloat64(fixed)", get_FIXED,           N | E | S | T,           N | E | C | T,       I},
    {"getFloat64(tunable)", get_TUNABLE,       N | E | S | T,           N | E | C | T,       I},
    {"getFloat64(input)", get_INPUT,           N | E | S | T,           N | E | C | T,       I},
    {"getFloat64(state)", get_STATE,           N | E | S | T,           N | E | C | T,       I},
    {"getFloat64(output)", get_OUTPUT,         N | E | S | T,           N | E | C | T,       WITH(OUTPUT_IS_STATE, I)},
    {"getFloat64(few)", get_few,               NONE,                    NONE,                NONE},
    {"getFloat64(many)", get_many,             NONE,                    NONE,                NONE},
    {"getFloat64(unknown)", get_unknown,       NONE,                    NONE,                NONE},
    {"getFloat64(huge)", get_huge,             NONE,                    NONE,                NONE},
    {"getFloat64(none)", get_none,             ALL,                     ALL,                 NONE},
    {"getFloat64(NULL)", get_null,             NONE,                    NONE,                NONE},
    {"getFloat64(no references)", get_no_references, NONE,              NONE,                NONE},
    {"setFloat64(time)", set_TIME,             NONE,                    NONE,                NONE},
    {"setFloat64(fixed)", set_FIXED,           I | N,                   I | N,               NONE},
    {"setFloat64(tunable)", set_TUNABLE,       I | N | E | S,           I | N | E,           NONE},
    {"setFloat64(input)", set_INPUT,           I | N | E | S,           I | N | E | C,       NONE},
    {"setFloat64(state)", set_STATE,           I | N,                   I | N,               WITH(EXCHANGEABLE, E | C)},
    {"setFloat64(output)", set_OUTPUT,         NONE,                    NONE,                WITH(OUTPUT_IS_STATE, ALL)},
    {"setFloat64(none)", set_none,             ALL,                     ALL,                 NONE},
    {"setFloat64(NULL)", set_null,             NONE,                    NONE,                NONE},
    {"setFloat64(no references)", set_no_references, NONE,              NONE,                NONE},
    {"setFloat64(NaN)", set_nan,               NONE,                    NONE,                NONE},
    {"setFloat64(unknown)", set_unknown,       NONE,                    NONE,                NONE},
    {"Float32", no_Float32, NONE, NONE, NONE}, {"Int8", no_Int8, NONE, NONE, NONE}, {"UInt8", no_UInt8, NONE, NONE, NONE},
    {"Int16", no_Int16, NONE, NONE, NONE}, {"UInt16", no_UInt16, NONE, NONE, NONE}, {"Int32", no_Int32, NONE, NONE, NONE},
    {"UInt32", no_UInt32, NONE, NONE, NONE}, {"Int64", no_Int64, NONE, NONE, NONE}, {"UInt64", no_UInt64, NONE, NONE, NONE},
    {"Boolean", no_Boolean, NONE, NONE, NONE}, {"String", no_String, NONE, NONE, NONE}, {"Binary", no_binary, NONE, NONE, NONE},
    {"getFMUState, setFMUState, freeFMUState", keep_state, ALL,         ALL,                 NONE},
    {"getFMUState(NULL)", get_state_null,      NONE,                    NONE,                NONE},
    {"setFMUState(NULL)", set_state_null,      NONE,                    NONE,                NONE},
    {"freeFMUState(NULL)", free_state_null,    ALL,                     ALL,                 NONE},
    {"serializedFMUStateSize(NULL)", size_null, NONE,                   NONE,                NONE},
    {"serialized state", serialized_0,         ALL,                     ALL,                 NONE},
    {"serializeFMUState(few)", serialized_1,   NONE,                    NONE,                NONE},
    {"deserializeFMUState(changed)", serialized_2, NONE,                NONE,                NONE},
    {"deserializeFMUState(few)", serialized_3, NONE,                    NONE,                NONE},
    {"deserializeFMUState(many)", serialized_4, NONE,                   NONE,                NONE},
    {"serializeFMUState(no state)", serialized_5, NONE,                 NONE,                NONE},
    {"serializeFMUState(no bytes)", serialized_6, NONE,                 NONE,                NONE},
    {"deserializeFMUState(0)", serialized_7,   NONE,                    NONE,                NONE},
    {"deserializeFMUState(NULL)", serialized_8, NONE,                   NONE,                NONE},
    {"deserializeFMUState(no state)", serialized_9, NONE,               NONE,                NONE},
    {"getContinuousStates", get_x,             NONE,                    N | E | C | T,       NONE},
    {"getContinuousStates(few)", get_x_few,    NONE,                    NONE,                NONE},
    {"getContinuousStates(NULL)", get_x_null,  NONE,                    WITH(!N_X, N | E | C | T), NONE},
    {"getContinuousStateDerivatives", get_dx,  NONE,                    N | E | C | T,       NONE},
    {"getContinuousStateDerivatives(NULL)", get_dx_null, NONE,          WITH(!N_X, N | E | C | T), NONE},
    {"getEventIndicators", get_z,              NONE,                    N | E | C | T,       NONE},
    {"getNominalsOfContinuousStates", get_nominals, NONE,               N | E | C | T,       I},
    {"setContinuousStates", set_x,             NONE,                    C,                   NONE},
    {"setContinuousStates(NaN)", set_x_nan,    NONE,                    WITH(!N_X, C),       NONE},
    {"setContinuousStates(NULL)", set_x_null,  NONE,                    WITH(!N_X, C),       NONE},
    {"setTime", set_time,                      NONE,                    C,                   E},
    {"setTime(NaN)", set_time_nan,             NONE,                    NONE,                NONE},
    {"completedIntegratorStep", completed,     NONE,                    C,                   NONE},
    {"completedIntegratorStep(NULL)", completed_null, NONE,             C,                   NONE},
    {"getNumberOfContinuousStates", number_of_x, NONE,                  ALL,                 NONE},
    {"getNumberOfEventIndicators", number_of_z, NONE,                   ALL,                 NONE},
    {"getNumberOfContinuousStates(NULL)", number_null, NONE,            NONE,                NONE},
    {"getClock", get_clock,                    WITH(N_CLOCKS, E),       NONE,                NONE},
    {"getClock(NULL)", get_clock_null,         NONE,                    NONE,                NONE},
    {"setClock", set_clock,                    WITH(N_CLOCKS && DUE_AT_START, E), NONE,      NONE},
    {"setClock(NULL)", set_clock_null,         NONE,                    NONE,                NONE},
    {"setClock(unknown)", set_clock_unknown,   NONE,                    NONE,                NONE},
    {"setClock(variable)", set_clock_variable, NONE,                    NONE,                NONE},
    {"getInterval, getShift", interval,        WITH(N_CLOCKS, N | E),   NONE,                NONE},
    {"getInterval, getShift(NULL)", interval_null, NONE,                NONE,                NONE},
    {"setInterval, setShift", set_interval,    NONE,                    NONE,                NONE},
    {"getDirectionalDerivative", directional,  D & ~C,                  D & ~S,              N | T},
    {"getAdjointDerivative", adjoint,          D & ~C,                  D & ~S,              N | T},
    {"getDirectionalDerivative(few)", directional_few, NONE,            NONE,                NONE},
    {"getDirectionalDerivative(many)", directional_many, NONE,          NONE,                NONE},
    {"getDirectionalDerivative(wrong)", directional_wrong, NONE,        NONE,                NONE},
    {"getDirectionalDerivative(unknown)", directional_unknown, NONE,    NONE,                NONE},
    {"getDirectionalDerivative(NULL)", directional_null, NONE,          NONE,                NONE},
    {"getAdjointDerivative(NULL)", adjoint_null, NONE,                  NONE,                NONE},
    {"getDirectionalDerivative(no references)", directional_none, NONE, NONE,                NONE},
    {"what is not supported", unsupported,     NONE,                    NONE,                NONE},
};

/* After whatever has happened, a reset leads back to a sound instance. */
static bool recovers(void *i) {
    if (fmi3Reset(i) || !reach(i, kind == EXCHANGED ? C : S)) return false;
    if (kind != EXCHANGED && step(i)) return false;
    return !get1(i, VR_OUTPUT, SIZE_OUTPUT) && isfinite(room[0]) && !fmi3Terminate(i);
}

static void walk_table(const int *states) {
    for (const int *s = states; *s; s++)
        for (size_t k = 0; k < sizeof table / sizeof *table; k++) {
            const row *r = table + k;
            if (skips(r->name)) continue;
            void *i = make(TOKEN);
            if (!i || !reach(i, *s)) {
                expect(false, "not reached", r->name, kind, *s);
                fmi3FreeInstance(i);
                continue;
            }
            int allowed = kind == EXCHANGED ? r->exchanged : r->stepped;
            if (kind == STEPPED && r->call == enter_event) allowed = NONE;
            int status = r->call(i);
            bool must = allowed & *s, may = r->either & *s;
            if (must) expect(status == fmi3OK, "refused", r->name, kind, *s);
            else if (!may) expect(status != fmi3OK, "accepted", r->name, kind, *s);
            expect(recovers(i), "no recovery", r->name, kind, *s);
            expect(r->call(NULL) != fmi3OK, "accepted without an instance", r->name, kind, *s);
            fmi3FreeInstance(i);
        }
}

/* A state that is saved in one state of the walk is restored in each other one, there and in another instance. */
static void walk_states(const int *states) {
    for (const int *a = states; *a; a++)
        for (const int *b = states; *b; b++) {
            void *one = make(TOKEN), *two = make(TOKEN);
            fmi3FMUState state = NULL;
            bool ok = reach(one, *a) && reach(two, *b) && !fmi3GetFMUState(one, &state) && !fmi3SetFMUState(two, state);
            expect(ok, "a state is not restored", "setFMUState", kind, *b);
            bool goes = *a == I ? !enter_init(two) : *a == N ? !exit_init(two) : *a == E ? !leave_events(two)
                        : *a == S ? !step(two) : *a == C ? !get_dx(two) : !get1(two, VR_OUTPUT, SIZE_OUTPUT);
            expect(goes, "it doesn't continue from a state", "setFMUState", kind, *a);
            expect(recovers(two), "no recovery", "setFMUState", kind, *b);
            fmi3FreeFMUState(one, &state);
            fmi3FreeInstance(one);
            fmi3FreeInstance(two);
        }
}

static void walk_instances(void) {
    fmi3ValueReference vr[] = {VR_OUTPUT, 99999};
    expect(!make("wrong"), "a wrong token", "instantiate", kind, I);
    expect(!make(NULL), "no token", "instantiate", kind, I);
    expect(!fmi3InstantiateCoSimulation(NULL, TOKEN, NULL, false, true, false, false, NULL, 0, NULL, on_log, NULL), "no name", "instantiate", kind, I);
    expect(!fmi3InstantiateCoSimulation(" ", TOKEN, NULL, false, true, false, false, NULL, 0, NULL, on_log, NULL), "an empty name", "instantiate", kind, I);
    expect(!fmi3InstantiateCoSimulation("i", TOKEN, NULL, false, true, false, false, NULL, 3, NULL, on_log, NULL), "no variables", "instantiate", kind, I);
    expect(!fmi3InstantiateCoSimulation("i", TOKEN, NULL, false, true, false, false, vr + 1, 1, NULL, on_log, NULL), "a wrong variable", "instantiate", kind, I);
    expect(!fmi3InstantiateScheduledExecution("i", TOKEN, NULL, false, true, NULL, on_log, NULL, NULL, NULL), "scheduled", "instantiate", kind, I);
    if (!HAS_EVENT_MODE)
        expect(!fmi3InstantiateCoSimulation("i", TOKEN, NULL, false, true, true, false, NULL, 0, NULL, on_log, NULL), "Event Mode", "instantiate", kind, I);
    if (!EXCHANGEABLE)
        expect(!fmi3InstantiateModelExchange("i", TOKEN, NULL, false, true, NULL, on_log), "Model Exchange", "instantiate", kind, I);
    expect(!strcmp(fmi3GetVersion(), "3.0"), "another version", "getVersion", kind, I);
    fmi3FreeInstance(NULL);
    kind = STEPPED;
    void *silent = fmi3InstantiateCoSimulation("silent", TOKEN, NULL, false, true, false, false, NULL, 0, NULL, NULL, NULL);
    expect(silent && get_unknown(silent), "no callback", "getFloat64", kind, I);
    fmi3FreeInstance(silent);
    void *one = make(TOKEN), *two = make(TOKEN), *bad = make(TOKEN);
    double first[MOST];
    expect(reach(one, S) && reach(two, S) && reach(bad, S), "not reached", "instances", kind, S);
    expect(!step(one) && !get_OUTPUT(one), "no step", "instances", kind, S);
    memcpy(first, room, sizeof first);
    expect(step_nan(bad), "accepted", "instances", kind, S);
    expect(!step(two) && !get_OUTPUT(two), "no step", "instances", kind, S);
    expect(!memcmp(first, room, SIZE_OUTPUT * sizeof(double)), "instances differ", "instances", kind, S);
    fmi3FreeInstance(bad);
    fmi3FreeInstance(one);
    expect(!get_OUTPUT(two), "gone with another one", "instances", kind, S);
    fmi3FreeInstance(two);
}

int main(void) {
    static const int stepped[] = {I, N, S, T, 0}, eventful[] = {I, N, E, S, T, 0}, exchanged[] = {I, N, E, C, T, 0};
    kind = STEPPED, walk_table(stepped), walk_states(stepped);
    if (HAS_EVENT_MODE) kind = EVENTFUL, walk_table(eventful), walk_states(eventful);
    if (EXCHANGEABLE) kind = EXCHANGED, walk_table(exchanged), walk_states(exchanged);
    walk_instances();
    printf("%d checks, %d messages, %d failures\n", calls, messages, failures);
    return failures != 0;
}
