/* FMI 2.0 for Co-Simulation and Model Exchange: the functions of fmi2Functions.h that exported FMUs support. The others: fmi2_refused.c.
 *
 * All variables are scalars of type Real, so that n value references take n values. */
#include "fmi2Functions.h"

#define LW_OK(call) ((call) ? fmi2OK : fmi2Error)
#define LW_EVALUATED(call) ((call) ? fmi2OK : lw_may_try_again(self, mode) ? fmi2Discard : fmi2Error) /* `mode`: before it */
#define LW_SELF lw_instance *self = c; if (!self) return fmi2Error

/* The logger takes a printf format (FMI 2.0, 2.1.5): a '%' of the text is written as '%%'. */
static void lw_write_fmi2(lw_instance *self, lw_category category, const char *message) {
    fmi2CallbackLogger log = (fmi2CallbackLogger)self->sink;
    char format[4096], *to = format;
    for (const char *from = message; *from && to < format + sizeof format - 2; *to++ = *from++)
        if (*from == '%') *to++ = '%';
    *to = 0;
    log(self->environment, self->name, category == LW_LOG_ERROR ? fmi2Error : fmi2Warning, lw_category_name(category), format);
}

/* ---- versions and logging (FMI 2.0, 2.1.4 and 2.1.5) ---- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories, const fmi2String categories[]) {
    LW_SELF;
    return lw_choose_categories(self, loggingOn, nCategories, categories) ? fmi2OK : fmi2Warning;
}

/* ---- life (FMI 2.0, 2.1.5 and 2.1.6) ---- */

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID, fmi2String fmuResourceLocation,
        const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean loggingOn) {
    (void)fmuResourceLocation, (void)visible;
    lw_instance *self = lw_create_named(instanceName, fmuType == fmi2ModelExchange, loggingOn);
    if (!self) return NULL;
    if (functions && functions->logger) {
        self->environment = functions->componentEnvironment;
        self->write = lw_write_fmi2;
        self->sink = (void (*)(void))functions->logger;
    }
    bool ok = lw_check_instantiation(self, instanceName, fmuGUID);
    if (ok && fmuType != fmi2CoSimulation && fmuType != fmi2ModelExchange)
        ok = lw_fail(self, "the type is %d, expected fmi2ModelExchange (0) or fmi2CoSimulation (1).", (int)fmuType);
    if (ok) return self;
    lw_destroy(self);
    return NULL;
}

void fmi2FreeInstance(fmi2Component c) { lw_destroy(c); }

fmi2Status fmi2Reset(fmi2Component c) {
    LW_SELF;
    lw_reset(self);
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real startTime,
        fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    LW_SELF;
    /* checked here so that the message names this function */
    if (!lw_initialize(self, "fmi2SetupExperiment", startTime, stopTimeDefined != fmi2False, stopTime)) return fmi2Error;
    self->s.mode = LW_INSTANTIATED;
    if (toleranceDefined) lw_suggest_tolerance(self, tolerance);
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    LW_SELF;
    return LW_OK(lw_initialize(self, "fmi2EnterInitializationMode", self->s.values[0], self->s.stop_time_defined,
                               self->s.stop_time));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    LW_SELF;
    return LW_OK(lw_start(self, "fmi2ExitInitializationMode", self->s.model_exchange ? LW_EVENT : LW_STEPPING));
}

fmi2Status fmi2Terminate(fmi2Component c) {
    LW_SELF;
    return LW_OK(lw_terminate(self));
}

/* ---- variables (FMI 2.0, 2.1.7) ---- */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
    LW_SELF;
    return LW_OK(lw_get(self, "fmi2GetReal", vr, nvr, value, nvr));
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[]) {
    LW_SELF;
    return LW_OK(lw_set(self, "fmi2SetReal", vr, nvr, value, nvr));
}

/* ---- inputs that move over the next step, by their derivatives at its start (FMI 2.0, 4.2.1) ---- */

#if LW_MOVING_INPUTS
/* Derivatives of inputs by time, for the next step only: u(t) = u + u1 (t - t0) + u2 (t - t0)^2 / 2 + ... from its start t0.
 * A later value of the input does not change them. The limits of an input apply to the values that are set. */
static bool lw_set_slopes(lw_instance *self, const char *function, const fmi2ValueReference *references, size_t n,
                          const fmi2Integer *orders, const double *values) {
    lw_mode mode = (lw_mode)self->s.mode;
    if (mode != LW_INSTANTIATED && mode != LW_INITIALIZING && !lw_in_mode(self, function, LW_STEPPING)) return false;
    if (!lw_has_lists(self, function, references, n, orders, n) || !lw_has_lists(self, function, NULL, 0, values, n)) return false;
    for (size_t i = 0; i < n; i++) {
        const lw_variable *variable = lw_variable_at(self, function, references[i], 1);
        if (!variable) return false;
        if (variable->kind != LW_INPUT || variable->is_discrete)
            return lw_fail(self, "%s: %s is no continuous input. Give derivatives of such inputs alone.", function, variable->name);
        if (orders[i] < 1 || orders[i] > LW_MAX_ORDER)
            return lw_fail(self, "%s: the order of a derivative of %s is %d, expected 1 to %d.", function, variable->name,
                           orders[i], LW_MAX_ORDER);
        if (!isfinite(values[i]))
            return lw_fail(self, "%s: derivative %d of %s was set to %g at t = %.9g s, expected a finite number. Check what "
                           "computes it.", function, orders[i], variable->name, values[i], self->s.values[0]);
        self->s.slopes[orders[i] - 1][variable->first - LW_U] = values[i];
    }
    self->s.moving = 0;
    for (int k = 0; k < LW_MAX_ORDER; k++)
        for (int i = 0; i < LW_N_U; i++)
            if (self->s.slopes[k][i] != 0.0) self->s.moving = 1;
    return true;
}
#endif

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer order[],
        const fmi2Real value[]) {
    LW_SELF;
    const char *function = "fmi2SetRealInputDerivatives";
    if (self->s.model_exchange)
        return LW_OK(lw_fail(self, "%s: this is a Model Exchange instance. Set inputs at each time by fmi2SetReal.", function));
#if LW_MOVING_INPUTS
    return LW_OK(lw_set_slopes(self, function, vr, nvr, order, value));
#else
    (void)vr, (void)order, (void)value;
    return LW_OK(!nvr || lw_fail(self, "%s: this FMU has no inputs that move within a step (canInterpolateInputs = false).", function));
#endif
}

/* ---- stepping (FMI 2.0, 4.2.2) ---- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
        fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    LW_SELF;
    (void)noSetFMUStatePriorToCurrentPoint; /* nothing is buffered */
    return LW_OK(lw_check_step(self, currentCommunicationPoint, communicationStepSize)
                 && lw_step(self, currentCommunicationPoint, communicationStepSize));
}

/* ---- Model Exchange (FMI 2.0, 3.2.1 and 3.2.2) ---- */

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi2EnterEventMode", false, NULL, 0, 0) && lw_enter_event_mode(self, "fmi2EnterEventMode"));
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *eventInfo) {
    LW_SELF;
    bool again = false, moved = false;
    bool ok = lw_check_vector(self, "fmi2NewDiscreteStates", false, NULL, 0, 0)
              && lw_update_discrete_states(self, "fmi2NewDiscreteStates", &again, &moved);
    if (eventInfo) *eventInfo = (fmi2EventInfo){.newDiscreteStatesNeeded = again, .valuesOfContinuousStatesChanged = moved};
    return LW_OK(ok);
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi2EnterContinuousTimeMode", false, NULL, 0, 0)
                 && lw_leave_event_mode(self, "fmi2EnterContinuousTimeMode", LW_CONTINUOUS));
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
        fmi2Boolean *enterEventMode, fmi2Boolean *terminateSimulation) {
    LW_SELF;
    (void)noSetFMUStatePriorToCurrentPoint; /* nothing is buffered */
    if (enterEventMode) *enterEventMode = fmi2False;
    if (terminateSimulation) *terminateSimulation = fmi2False;
    return LW_OK(lw_check_vector(self, "fmi2CompletedIntegratorStep", false, NULL, 0, 0)
                 && lw_in_mode(self, "fmi2CompletedIntegratorStep", LW_CONTINUOUS));
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi2SetTime", false, NULL, 0, 0) && lw_set_time(self, "fmi2SetTime", time));
}

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi2SetContinuousStates", false, x, nx, LW_N_X)
                 && lw_set_states(self, "fmi2SetContinuousStates", x));
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi2GetContinuousStates", true, x, nx, LW_N_X) && lw_copy(x, self->s.values + LW_X, nx));
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    LW_SELF;
    int32_t mode = self->s.mode;
    if (!lw_check_vector(self, "fmi2GetDerivatives", true, derivatives, nx, LW_N_X)) return fmi2Error;
    return LW_EVALUATED(lw_update_derivatives(self) && lw_copy(derivatives, self->s.values + LW_DX, nx));
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni) {
    LW_SELF;
    int32_t mode = self->s.mode;
    if (!lw_check_vector(self, "fmi2GetEventIndicators", true, eventIndicators, ni, LW_N_Z)) return fmi2Error;
    return LW_EVALUATED(lw_update_indicators(self) && lw_copy(eventIndicators, self->s.values + LW_Z, ni));
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi2GetNominalsOfContinuousStates", true, x_nominal, nx, LW_N_X)
                 && lw_copy(x_nominal, lw_nominals, nx));
}

/* ---- states (FMI 2.0, 2.1.8) ---- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    LW_SELF;
    return LW_OK(lw_get_state(self, "fmi2GetFMUstate", FMUstate));
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    LW_SELF;
    return LW_OK(lw_accept_state(self, "fmi2SetFMUstate", FMUstate));
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    LW_SELF;
    lw_free_state(FMUstate);
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    LW_SELF;
    (void)FMUstate;
    return LW_OK(lw_get_serialized_size(self, "fmi2SerializedFMUstateSize", size));
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size) {
    LW_SELF;
    return LW_OK(lw_serialize_state(self, "fmi2SerializeFMUstate", FMUstate, serializedState, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size, fmi2FMUstate *FMUstate) {
    LW_SELF;
    return LW_OK(lw_deserialize_state(self, "fmi2DeSerializeFMUstate", serializedState, size, FMUstate));
}

/* ---- partial derivatives (FMI 2.0, 2.1.9) ---- */

#if LW_HAS_DERIVATIVES
fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
        const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[], fmi2Real dvUnknown[]) {
    LW_SELF;
    return LW_OK(lw_derive(self, "fmi2GetDirectionalDerivative", false, vUnknown_ref, nUnknown, vKnown_ref, nKnown, dvKnown,
                           nKnown, dvUnknown, nUnknown));
}
#endif
