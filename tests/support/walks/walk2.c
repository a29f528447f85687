/* Every function of FMI 2.0 in every state, with right and wrong arguments, on the FMU that it is linked with.
 * facts.h is made from its modelDescription.xml. */
#include "fmi2Functions.h"
#include "facts.h"
#include "walk.h"

static void on_log(fmi2ComponentEnvironment e, fmi2String name, fmi2Status s, fmi2String category, fmi2String message, ...) {
    (void)e, (void)s;
    messages += strlen(name) > 0 && strlen(category) > 0 && strlen(message) > 0;
}

static const fmi2CallbackFunctions callbacks = {on_log, calloc, free, NULL, NULL}, mute = {NULL, NULL, NULL, NULL, NULL};
static interface kind;

static fmi2Component make(const char *token) {
    return fmi2Instantiate("walk", kind == EXCHANGED ? fmi2ModelExchange : fmi2CoSimulation, token, NULL, &callbacks, false, true);
}

/* Leave Event Mode. */
static int leave_events(void *i) {
    fmi2EventInfo info = {.newDiscreteStatesNeeded = fmi2True};
    for (int k = 0; info.newDiscreteStatesNeeded && k < 10; k++)
        if (fmi2NewDiscreteStates(i, &info)) return fmi2Error;
    return fmi2EnterContinuousTimeMode(i);
}

static bool reach(void *i, int state) {
    if (state == I) return true;
    if (fmi2SetupExperiment(i, false, 0.0, 0.0, false, 0.0) || fmi2EnterInitializationMode(i)) return false;
    if (state == N) return true;
    if (fmi2ExitInitializationMode(i)) return false;
    if (state == E) return true;
    if (kind == EXCHANGED && leave_events(i)) return false;
    if (state == S || state == C) return true;
    return !fmi2Terminate(i);
}

static int step(void *i) { return fmi2DoStep(i, 0.0, STEP, true); }

/* ---- variables ---- */

static double room[MOST + 1];
static int get1(void *i, long vr, size_t n) {
    fmi2ValueReference v[2] = {(fmi2ValueReference)vr, 0};
    return fmi2GetReal(i, v, n, room);
}
static int set_back(void *i, long vr, long size) {
    fmi2ValueReference v = (fmi2ValueReference)vr;
    for (long k = 0; k < size; k++) room[k] = start_of(vr, k);
    return fmi2SetReal(i, &v, (size_t)size, room);
}
#define SIZED(kind_) \
    static int get_##kind_(void *i) { return get1(i, VR_##kind_, SIZE_##kind_); } \
    static int set_##kind_(void *i) { return set_back(i, VR_##kind_, SIZE_##kind_); }
SIZED(TIME) SIZED(FIXED) SIZED(TUNABLE) SIZED(INPUT) SIZED(STATE) SIZED(OUTPUT)

static int get_unknown(void *i) { return get1(i, 99999, 1); }
static int get_huge(void *i) { return get1(i, 0xffffffffL, 1); }
static int get_none(void *i) { return fmi2GetReal(i, NULL, 0, NULL); }
static int get_null(void *i) { fmi2ValueReference v = VR_TIME; return fmi2GetReal(i, &v, 1, NULL); }
static int get_no_references(void *i) { return fmi2GetReal(i, NULL, 1, room); }
static int set_none(void *i) { return fmi2SetReal(i, NULL, 0, NULL); }
static int set_null(void *i) { fmi2ValueReference v = VR_INPUT; return fmi2SetReal(i, &v, 1, NULL); }
static int set_no_references(void *i) { room[0] = 0.0; return fmi2SetReal(i, NULL, 1, room); }
static int set_nan(void *i) { fmi2ValueReference v = VR_INPUT; room[0] = NAN; return fmi2SetReal(i, &v, 1, room); }
static int set_unknown(void *i) { fmi2ValueReference v = 99999; room[0] = 0.0; return fmi2SetReal(i, &v, 1, room); }

static int slopes(void *i) { fmi2ValueReference v = VR_INPUT; fmi2Integer order = 1; room[0] = 0.0; return fmi2SetRealInputDerivatives(i, &v, 1, &order, room); }
static int slopes_null(void *i) { fmi2ValueReference v = VR_INPUT; return fmi2SetRealInputDerivatives(i, &v, 1, NULL, NULL); }
static int slopes_order(void *i) { fmi2ValueReference v = VR_INPUT; fmi2Integer order = 99; room[0] = 0.0; return fmi2SetRealInputDerivatives(i, &v, 1, &order, room); }
static int slopes_of_output(void *i) { fmi2ValueReference v = VR_OUTPUT; fmi2Integer order = 1; room[0] = 0.0; return fmi2SetRealInputDerivatives(i, &v, 1, &order, room); }
static int slopes_negative(void *i) { fmi2ValueReference v = VR_INPUT; fmi2Integer order = -1; room[0] = 0.0; return fmi2SetRealInputDerivatives(i, &v, 1, &order, room); }

#define OTHER(type) \
    static int no_##type(void *i) { \
        fmi2ValueReference v = 0; \
        fmi2##type value[1] = {0}; \
        int a = fmi2Get##type(i, NULL, 0, NULL), b = fmi2Set##type(i, NULL, 0, NULL); \
        if (i && (a || b)) return fmi2OK; /* so that the row fails */ \
        int c = fmi2Get##type(i, &v, 1, value), d = fmi2Set##type(i, &v, 1, value); \
        return c && d ? fmi2Error : fmi2OK; \
    }
OTHER(Integer) OTHER(Boolean) OTHER(String)

/* ---- states ---- */

static int keep_state(void *i) {
    fmi2FMUstate state = NULL;
    int a = fmi2GetFMUstate(i, &state);
    int again = a ? a : fmi2GetFMUstate(i, &state); /* into the same one */
    int b = again ? again : fmi2SetFMUstate(i, state);
    int c = fmi2FreeFMUstate(i, &state);
    return a | b | c || state ? fmi2Error : fmi2OK;
}
static int get_state_null(void *i) { return fmi2GetFMUstate(i, NULL); }
static int set_state_null(void *i) { return fmi2SetFMUstate(i, NULL); }
static int free_state_null(void *i) { fmi2FMUstate none = NULL; return fmi2FreeFMUstate(i, NULL) | fmi2FreeFMUstate(i, &none); }
static int size_null(void *i) {
    fmi2FMUstate state = NULL;
    if (fmi2GetFMUstate(i, &state)) return fmi2Error;
    int status = fmi2SerializedFMUstateSize(i, state, NULL);
    fmi2FreeFMUstate(i, &state);
    return status;
}
static int serialized(void *i, int how) {
    fmi2FMUstate state = NULL, other = NULL;
    size_t n = 0;
    if (fmi2GetFMUstate(i, &state) || fmi2SerializedFMUstateSize(i, state, &n)) return fmi2Error;
    fmi2Byte *bytes = malloc(n + 1);
    int status = how == 5 ? fmi2SerializeFMUstate(i, NULL, bytes, n) : how == 6 ? fmi2SerializeFMUstate(i, state, NULL, n)
                 : fmi2SerializeFMUstate(i, state, bytes, how == 1 ? n - 1 : n);
    if (how == 2 && !status) bytes[n / 2] ^= 1;
    if (!status && (how == 0 || how > 1)) {
        size_t given = how == 3 ? n - 1 : how == 4 ? n + 1 : how == 7 ? 0 : n;
        if (how == 4) bytes = realloc(bytes, n + 1), bytes[n] = 0;
        status = fmi2DeSerializeFMUstate(i, how == 8 ? NULL : bytes, given, how == 9 ? NULL : &other);
        if (!status) status = fmi2SetFMUstate(i, other);
        if (other) fmi2FreeFMUstate(i, &other);
    }
    free(bytes);
    fmi2FreeFMUstate(i, &state);
    return status;
}
#define SERIALIZED(n) static int serialized_##n(void *i) { return serialized(i, n); }
SERIALIZED(0) SERIALIZED(1) SERIALIZED(2) SERIALIZED(3) SERIALIZED(4) SERIALIZED(5) SERIALIZED(6) SERIALIZED(7) SERIALIZED(8) SERIALIZED(9)

/* ---- modes ---- */

static int setup(void *i) { return fmi2SetupExperiment(i, true, 1e-6, 0.0, true, 10.0); }
static int setup_nan(void *i) { return fmi2SetupExperiment(i, false, 0.0, NAN, false, 0.0); }
static int setup_past(void *i) { return fmi2SetupExperiment(i, false, 0.0, 1.0, true, 0.0); }
static int enter_init(void *i) { return fmi2EnterInitializationMode(i); }
static int exit_init(void *i) { return fmi2ExitInitializationMode(i); }
static int enter_event(void *i) { return fmi2EnterEventMode(i); }
static int update(void *i) { fmi2EventInfo info; return fmi2NewDiscreteStates(i, &info); }
static int update_null(void *i) { return fmi2NewDiscreteStates(i, NULL); }
static int enter_continuous(void *i) { return fmi2EnterContinuousTimeMode(i); }
static int terminate(void *i) { return fmi2Terminate(i); }
static int reset(void *i) { return fmi2Reset(i); }
static int debug(void *i) {
    fmi2String names[] = {"logStatusError", "logStatusWarning"};
    return fmi2SetDebugLogging(i, true, 2, names) | fmi2SetDebugLogging(i, true, 0, NULL) | fmi2SetDebugLogging(i, false, 0, NULL);
}
static int debug_unknown(void *i) {
    fmi2String names[] = {"none of these", NULL};
    return fmi2SetDebugLogging(i, true, 2, names);
}
static int step_back(void *i) { return fmi2DoStep(i, 5.0, STEP, true); }
static int step_nan(void *i) { return fmi2DoStep(i, 0.0, NAN, true); }
static int step_zero(void *i) { return fmi2DoStep(i, 0.0, 0.0, true); }
static int cancel(void *i) { return fmi2CancelStep(i); }
static int status_of(void *i) {
    fmi2Real t = -1.0;
    fmi2Boolean ends = fmi2True;
    int a = fmi2GetRealStatus(i, fmi2LastSuccessfulTime, &t), b = fmi2GetBooleanStatus(i, fmi2Terminated, &ends);
    return a | b || t < 0.0 || ends ? fmi2Error : fmi2OK;
}
static int status_null(void *i) { return fmi2GetRealStatus(i, fmi2LastSuccessfulTime, NULL) && fmi2GetBooleanStatus(i, fmi2Terminated, NULL) ? fmi2Error : fmi2OK; }
static int status_others(void *i) {
    fmi2Status s;
    fmi2Integer n;
    fmi2String text;
    fmi2Real t;
    int a = fmi2GetStatus(i, fmi2DoStepStatus, &s), b = fmi2GetIntegerStatus(i, fmi2DoStepStatus, &n);
    int c = fmi2GetStringStatus(i, fmi2PendingStatus, &text), d = fmi2GetRealStatus(i, fmi2PendingStatus, &t);
    return a && b && c && d ? fmi2Error : fmi2OK;
}
static int output_slopes(void *i) { fmi2ValueReference v = VR_OUTPUT; fmi2Integer order = 1; return fmi2GetRealOutputDerivatives(i, &v, 1, &order, room); }

/* ---- Model Exchange ---- */

static double x[MOST + 1];
static int get_x(void *i) { return fmi2GetContinuousStates(i, x, N_X); }
static int get_x_few(void *i) { return fmi2GetContinuousStates(i, x, N_X + 1); }
static int get_x_null(void *i) { return fmi2GetContinuousStates(i, NULL, N_X); }
static int get_dx(void *i) { return fmi2GetDerivatives(i, x, N_X); }
static int get_dx_null(void *i) { return fmi2GetDerivatives(i, NULL, N_X); }
static int get_z(void *i) { return fmi2GetEventIndicators(i, x, N_Z); }
static int get_nominals(void *i) { return fmi2GetNominalsOfContinuousStates(i, x, N_X); }
static int set_x(void *i) { memset(x, 0, sizeof x); return fmi2SetContinuousStates(i, x, N_X); }
static int set_x_nan(void *i) { x[0] = NAN; return fmi2SetContinuousStates(i, x, N_X); }
static int set_x_null(void *i) { return fmi2SetContinuousStates(i, NULL, N_X); }
static int set_time(void *i) { return fmi2SetTime(i, 0.001); }
static int set_time_nan(void *i) { return fmi2SetTime(i, NAN); }
static int completed(void *i) { fmi2Boolean a, b; return fmi2CompletedIntegratorStep(i, true, &a, &b); }
static int completed_null(void *i) { return fmi2CompletedIntegratorStep(i, true, NULL, NULL); }
/* ---- derivatives ---- */

static int directional(void *i) {
    fmi2ValueReference k = VR_INPUT, u = VR_OUTPUT;
    room[0] = 1.0;
    return fmi2GetDirectionalDerivative(i, &u, 1, &k, 1, room, x);
}
static int directional_wrong(void *i) { fmi2ValueReference k = VR_OUTPUT, u = VR_INPUT; return fmi2GetDirectionalDerivative(i, &u, 1, &k, 1, room, x); }
static int directional_unknown(void *i) { fmi2ValueReference k = 99999, u = VR_OUTPUT; return fmi2GetDirectionalDerivative(i, &u, 1, &k, 1, room, x); }
static int directional_null(void *i) { fmi2ValueReference k = VR_INPUT, u = VR_OUTPUT; return fmi2GetDirectionalDerivative(i, &u, 1, &k, 1, NULL, x); }
static int directional_nowhere(void *i) { fmi2ValueReference k = VR_INPUT, u = VR_OUTPUT; return fmi2GetDirectionalDerivative(i, &u, 1, &k, 1, room, NULL); }
static int directional_none(void *i) { return fmi2GetDirectionalDerivative(i, NULL, 1, NULL, 1, room, x); }

#define D (HAS_DERIVATIVES ? E | S | C : NONE)
#define WITH(flag, mask) ((flag) ? (mask) : NONE)
static const row table[] = {
    /* call                                    Co-Simulation            Model Exchange       either */
    {"enterInitializationMode", enter_init,    I,                       I,                   NONE},
    {"setupExperiment", setup,                 I,                       I,                   NONE},
    {"setupExperiment(NaN)", setup_nan,        NONE,                    NONE,                NONE},
    {"setupExperiment(past)", setup_past,      NONE,                    NONE,                NONE},
    {"exitInitializationMode", exit_init,      N,                       N,                   NONE},
    {"enterEventMode", enter_event,            NONE,                      C,                   NONE},
    {"newDiscreteStates", update,           NONE,                    E,                   NONE},
    {"newDiscreteStates(NULL)", update_null, NONE,                   E,                   NONE},
    {"enterContinuousTimeMode", enter_continuous, NONE,                 E,                   NONE},
    {"terminate", terminate,                   E | S,                   E | C,               NONE},
    {"reset", reset,                           ALL,                     ALL,                 NONE},
    {"setDebugLogging", debug,                 ALL,                     ALL,                 NONE},
    {"setDebugLogging(unknown)", debug_unknown, NONE,                   NONE,                NONE},
    {"doStep", step,                           S,                       NONE,                NONE},
    {"cancelStep", cancel,                     NONE,                    NONE,                NONE},
    {"getRealStatus, getBooleanStatus", status_of, S,                   NONE,                I | N | E | C | T},
    {"getRealStatus, getBooleanStatus(NULL)", status_null, NONE,        NONE,                NONE},
    {"getStatus and others", status_others,    NONE,                    NONE,                NONE},
    {"getRealOutputDerivatives", output_slopes, NONE,                   NONE,                NONE},
    {"doStep(elsewhere)", step_back,           NONE,                    NONE,                NONE},
    {"doStep(NaN)", step_nan,                  NONE,                    NONE,                NONE},
    {"doStep(0)", step_zero,                   NONE,                    NONE,                NONE},
    {"getReal(time)", get_TIME,             N | E | S | T,           N | E | C | T,       I},
    {"getReal(fixed)", get_FIXED,           N | E | S | T,           N | E | C | T,       I},
    {"getReal(tunable)", get_TUNABLE,       N | E | S | T,           N | E | C | T,       I},
    {"getReal(input)", get_INPUT,           N | E | S | T,           N | E | C | T,       I},
    {"getReal(state)", get_STATE,           N | E | S | T,           N | E | C | T,       I},
    {"getReal(output)", get_OUTPUT,         N | E | S | T,           N | E | C | T,       WITH(OUTPUT_IS_STATE, I)},
    {"getReal(unknown)", get_unknown,       NONE,                    NONE,                NONE},
    {"getReal(huge)", get_huge,             NONE,                    NONE,                NONE},
    {"getReal(none)", get_none,             ALL,                     ALL,                 NONE},
    {"getReal(NULL)", get_null,             NONE,                    NONE,                NONE},
    {"getReal(no references)", get_no_references, NONE,              NONE,                NONE},
    {"setReal(time)", set_TIME,             NONE,                    NONE,                NONE},
    {"setReal(fixed)", set_FIXED,           I | N,                   I | N,               NONE},
    {"setReal(tunable)", set_TUNABLE,       I | N | E | S,           I | N | E,           NONE},
    {"setReal(input)", set_INPUT,           I | N | E | S,           I | N | E | C,       NONE},
    {"setReal(state)", set_STATE,           I | N,                   I | N,               WITH(EXCHANGEABLE, E | C)},
    {"setReal(output)", set_OUTPUT,         NONE,                    NONE,                WITH(OUTPUT_IS_STATE, ALL)},
    {"setReal(none)", set_none,             ALL,                     ALL,                 NONE},
    {"setReal(NULL)", set_null,             NONE,                    NONE,                NONE},
    {"setReal(no references)", set_no_references, NONE,              NONE,                NONE},
    {"setReal(NaN)", set_nan,               NONE,                    NONE,                NONE},
    {"setReal(unknown)", set_unknown,       NONE,                    NONE,                NONE},
    {"Integer", no_Integer, NONE, NONE, NONE}, {"Boolean", no_Boolean, NONE, NONE, NONE}, {"String", no_String, NONE, NONE, NONE},
    {"setRealInputDerivatives(input)", slopes, WITH(INTERPOLATES, I | N | S),   NONE,            NONE},
    {"setRealInputDerivatives(input, NULL)", slopes_null, NONE,         NONE,                NONE},
    {"setRealInputDerivatives(input, order)", slopes_order, NONE,       NONE,                NONE},
    {"setRealInputDerivatives(input, -1)", slopes_negative, NONE,       NONE,                NONE},
    {"setRealInputDerivatives(output)", slopes_of_output, NONE,         NONE,                NONE},
    {"getFMUstate, setFMUstate, freeFMUstate", keep_state, ALL,         ALL,                 NONE},
    {"getFMUstate(NULL)", get_state_null,      NONE,                    NONE,                NONE},
    {"setFMUstate(NULL)", set_state_null,      NONE,                    NONE,                NONE},
    {"freeFMUstate(NULL)", free_state_null,    ALL,                     ALL,                 NONE},
    {"serializedFMUstateSize(NULL)", size_null, NONE,                   NONE,                NONE},
    {"serialized state", serialized_0,         ALL,                     ALL,                 NONE},
    {"serializeFMUstate(few)", serialized_1,   NONE,                    NONE,                NONE},
    {"deserializeFMUstate(changed)", serialized_2, NONE,                NONE,                NONE},
    {"deserializeFMUstate(few)", serialized_3, NONE,                    NONE,                NONE},
    {"deserializeFMUstate(many)", serialized_4, NONE,                   NONE,                NONE},
    {"serializeFMUstate(no state)", serialized_5, NONE,                 NONE,                NONE},
    {"serializeFMUstate(no bytes)", serialized_6, NONE,                 NONE,                NONE},
    {"deserializeFMUstate(0)", serialized_7,   NONE,                    NONE,                NONE},
    {"deserializeFMUstate(NULL)", serialized_8, NONE,                   NONE,                NONE},
    {"deserializeFMUstate(no state)", serialized_9, NONE,               NONE,                NONE},
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
    {"getDirectionalDerivative", directional,  D & ~C,                  D & ~S,              N | T},
    {"getDirectionalDerivative(wrong)", directional_wrong, NONE,        NONE,                NONE},
    {"getDirectionalDerivative(unknown)", directional_unknown, NONE,    NONE,                NONE},
    {"getDirectionalDerivative(NULL)", directional_null, NONE,          NONE,                NONE},
    {"getDirectionalDerivative(nowhere)", directional_nowhere, NONE,    NONE,                NONE},
    {"getDirectionalDerivative(no references)", directional_none, NONE, NONE,                NONE},
};

/* After whatever has happened, a reset leads back to a sound instance. */
static bool recovers(void *i) {
    if (fmi2Reset(i) || !reach(i, kind == EXCHANGED ? C : S)) return false;
    if (kind != EXCHANGED && step(i)) return false;
    return !get1(i, VR_OUTPUT, SIZE_OUTPUT) && isfinite(room[0]) && !fmi2Terminate(i);
}

static void walk_table(const int *states) {
    for (const int *s = states; *s; s++)
        for (size_t k = 0; k < sizeof table / sizeof *table; k++) {
            const row *r = table + k;
            if (skips(r->name)) continue;
            void *i = make(TOKEN);
            if (!i || !reach(i, *s)) {
                expect(false, "not reached", r->name, kind, *s);
                fmi2FreeInstance(i);
                continue;
            }
            int allowed = kind == EXCHANGED ? r->exchanged : r->stepped;
            int status = r->call(i);
            bool must = allowed & *s, may = r->either & *s;
            if (must) expect(status == fmi2OK, "refused", r->name, kind, *s);
            else if (!may) expect(status != fmi2OK, "accepted", r->name, kind, *s);
            expect(recovers(i), "no recovery", r->name, kind, *s);
            expect(r->call(NULL) != fmi2OK, "accepted without an instance", r->name, kind, *s);
            fmi2FreeInstance(i);
        }
}

/* A state that is saved in one state of the walk is restored in each other one, there and in another instance. */
static void walk_states(const int *states) {
    for (const int *a = states; *a; a++)
        for (const int *b = states; *b; b++) {
            void *one = make(TOKEN), *two = make(TOKEN);
            fmi2FMUstate state = NULL;
            bool ok = reach(one, *a) && reach(two, *b) && !fmi2GetFMUstate(one, &state) && !fmi2SetFMUstate(two, state);
            expect(ok, "a state is not restored", "setFMUstate", kind, *b);
            bool goes = *a == I ? !enter_init(two) : *a == N ? !exit_init(two) : *a == E ? !leave_events(two)
                        : *a == S ? !step(two) : *a == C ? !get_dx(two) : !get1(two, VR_OUTPUT, SIZE_OUTPUT);
            expect(goes, "it doesn't continue from a state", "setFMUstate", kind, *a);
            expect(recovers(two), "no recovery", "setFMUstate", kind, *b);
            fmi2FreeFMUstate(one, &state);
            fmi2FreeInstance(one);
            fmi2FreeInstance(two);
        }
}

static void walk_instances(void) {
    kind = STEPPED;
    expect(!make("wrong"), "a wrong token", "instantiate", kind, I);
    expect(!make(NULL), "no token", "instantiate", kind, I);
    expect(!fmi2Instantiate(NULL, fmi2CoSimulation, TOKEN, NULL, &callbacks, false, true), "no name", "instantiate", kind, I);
    expect(!fmi2Instantiate(" ", fmi2CoSimulation, TOKEN, NULL, &callbacks, false, true), "an empty name", "instantiate", kind, I);
    expect(!fmi2Instantiate("i", (fmi2Type)7, TOKEN, NULL, &callbacks, false, true), "a wrong type", "instantiate", kind, I);
    if (!EXCHANGEABLE)
        expect(!fmi2Instantiate("i", fmi2ModelExchange, TOKEN, NULL, &callbacks, false, true), "Model Exchange", "instantiate", kind, I);
    expect(!strcmp(fmi2GetVersion(), "2.0") && !strcmp(fmi2GetTypesPlatform(), "default"), "another version", "getVersion", kind, I);
    fmi2FreeInstance(NULL);
    void *silent = fmi2Instantiate("silent", fmi2CoSimulation, TOKEN, NULL, &mute, false, true);
    expect(silent && get_unknown(silent), "no callback", "getReal", kind, I);
    fmi2FreeInstance(silent);
    silent = fmi2Instantiate("silent", fmi2CoSimulation, TOKEN, NULL, NULL, false, true);
    expect(silent && get_unknown(silent), "no callbacks", "getReal", kind, I);
    fmi2FreeInstance(silent);
    void *one = make(TOKEN), *two = make(TOKEN), *bad = make(TOKEN);
    double first[MOST];
    expect(reach(one, S) && reach(two, S) && reach(bad, S), "not reached", "instances", kind, S);
    expect(!step(one) && !get_OUTPUT(one), "no step", "instances", kind, S);
    memcpy(first, room, sizeof first);
    expect(step_nan(bad), "accepted", "instances", kind, S);
    expect(!step(two) && !get_OUTPUT(two), "no step", "instances", kind, S);
    expect(!memcmp(first, room, SIZE_OUTPUT * sizeof(double)), "instances differ", "instances", kind, S);
    fmi2FreeInstance(bad);
    fmi2FreeInstance(one);
    expect(!get_OUTPUT(two), "gone with another one", "instances", kind, S);
    fmi2FreeInstance(two);
}

int main(void) {
    static const int stepped[] = {I, N, S, T, 0}, exchanged[] = {I, N, E, C, T, 0};
    kind = STEPPED, walk_table(stepped), walk_states(stepped);
    if (EXCHANGEABLE) kind = EXCHANGED, walk_table(exchanged), walk_states(exchanged);
    walk_instances();
    printf("%d checks, %d messages, %d failures\n", calls, messages, failures);
    return failures != 0;
}
