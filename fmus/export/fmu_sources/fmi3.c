/* FMI 3.0: the functions of fmi3Functions.h that exported FMUs support, but those of Model Exchange and of Event Mode only
 * (fmi3_events.c). The others are in fmi3_refused.c. */
#include "fmi3Functions.h"

#define LW_OK(call) ((call) ? fmi3OK : fmi3Error)
#define LW_EVALUATED(call) ((call) ? fmi3OK : lw_may_try_again(self, mode) ? fmi3Discard : fmi3Error) /* `mode`: before it */
#define LW_SELF lw_instance *self = instance; if (!self) return fmi3Error

static void lw_write_fmi3(lw_instance *self, lw_category category, const char *message) {
    fmi3LogMessageCallback log = (fmi3LogMessageCallback)self->sink;
    log(self->environment, category == LW_LOG_ERROR ? fmi3Error : fmi3Warning, lw_category_name(category), message);
}

/* ---- versions and logging (FMI 3.0, 2.3.1) ---- */

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories, const fmi3String categories[]) {
    LW_SELF;
    return lw_choose_categories(self, loggingOn, nCategories, categories) ? fmi3OK : fmi3Warning;
}

/* ---- life (FMI 3.0, 2.3.1 to 2.3.3) ---- */

static lw_instance *lw_instantiate_fmi3(fmi3String instanceName, fmi3String instantiationToken, fmi3Boolean loggingOn,
        fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage, bool model_exchange) {
    lw_instance *self = lw_create_named(instanceName, model_exchange, loggingOn);
    if (!self) return NULL;
    self->environment = instanceEnvironment;
    self->write = logMessage ? lw_write_fmi3 : NULL;
    self->sink = (void (*)(void))logMessage;
    if (lw_check_instantiation(self, instanceName, instantiationToken)) return self;
    lw_destroy(self);
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
        fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
        fmi3LogMessageCallback logMessage) {
    (void)resourcePath, (void)visible;
    return lw_instantiate_fmi3(instanceName, instantiationToken, loggingOn, instanceEnvironment, logMessage, true);
}

/* Intermediate update at the end of an internal step (FMI 3.0, 4.2.2). Points that the standard leaves open:
 * - it is called at accepted states only, so intermediateStepFinished is always true; the last call of a step is at its
 *   end, with canReturnEarly = false; it is missing if an event returns to Event Mode, and comes after the jump if an event
 *   is handled inside doStep;
 * - all variables may be read and all continuous inputs be set, whether or not they are required intermediate variables;
 * - inputs are held until they are set again, so an input sampled in this way enters with order 1 in the internal step; those
 *   that are set at the end of the communication step hold for the next one;
 * - a step ends exactly at an earlyReturnTime beyond the present, and at once for any other. */
static bool lw_update_fmi3(lw_instance *self, double t, bool can_return_early, double *until) {
    fmi3IntermediateUpdateCallback update = (fmi3IntermediateUpdateCallback)self->update_sink;
    fmi3Boolean requested = fmi3False;
    fmi3Float64 time = t;
    update(self->environment, t, fmi3True, fmi3True, fmi3True, can_return_early, &requested, &time);
    *until = time;
    return requested;
}

static bool lw_is_intermediate(lw_instance *self, fmi3ValueReference reference) {
    if (reference < LW_N_VARIABLES) {
        const lw_variable *variable = &lw_variables[reference];
        if (variable->kind == LW_INPUT ? !variable->is_discrete : variable->is_output && variable->kind != LW_DISCRETE) return true;
        return lw_fail(self, "requiredIntermediateVariables: %s has intermediateUpdate = false in modelDescription.xml. Give "
                       "continuous inputs and outputs.", variable->name);
    }
    return lw_fail(self, "requiredIntermediateVariables: there is no variable with value reference %u. modelDescription.xml "
                   "lists 0 to %d.", (unsigned)reference, LW_N_VARIABLES - 1);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
        fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
        const fmi3ValueReference requiredIntermediateVariables[], size_t nRequiredIntermediateVariables,
        fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
        fmi3IntermediateUpdateCallback intermediateUpdate) {
    (void)resourcePath, (void)visible;
    lw_instance *self =
        lw_instantiate_fmi3(instanceName, instantiationToken, loggingOn, instanceEnvironment, logMessage, false);
    if (!self) return NULL;
    self->event_mode_used = eventModeUsed;
    self->early_return_allowed = earlyReturnAllowed;
    bool ok = true;
    if (eventModeUsed && !LW_EVENT_MODE)
        ok = lw_fail(self, "this FMU has no events, and no Event Mode. Instantiate it with eventModeUsed = fmi3False.");
    if (ok && nRequiredIntermediateVariables && !requiredIntermediateVariables)
        ok = lw_fail(self, "requiredIntermediateVariables is NULL, and nRequiredIntermediateVariables is %zu. Give as many value "
                     "references, or 0.", nRequiredIntermediateVariables);
    for (size_t i = 0; ok && i < nRequiredIntermediateVariables; i++)
        ok = lw_is_intermediate(self, requiredIntermediateVariables[i]);
    if (ok && intermediateUpdate && !LW_LOOP) {
        self->update = lw_update_fmi3;
        self->update_sink = (void (*)(void))intermediateUpdate;
        if (!(self->before = malloc(sizeof *self->before))) ok = lw_fail(self, "out of memory.");
    }
    if (ok) return self;
    lw_destroy(self);
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) { lw_destroy(instance); }

fmi3Status fmi3Reset(fmi3Instance instance) {
    LW_SELF;
    if (self->s.mode == LW_INTERMEDIATE) return LW_OK(lw_fail(self, "fmi3Reset was called in Intermediate Update Mode. "
                                                              "Call it when the step has ended."));
    lw_reset(self);
    return fmi3OK;
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
        fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    LW_SELF;
    if (!lw_initialize(self, "fmi3EnterInitializationMode", startTime, stopTimeDefined, stopTime)) return fmi3Error;
    if (toleranceDefined) lw_suggest_tolerance(self, tolerance);
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    LW_SELF;
    bool events = self->s.model_exchange || self->event_mode_used;
    return LW_OK(lw_start(self, "fmi3ExitInitializationMode", events ? LW_EVENT : LW_STEPPING));
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    LW_SELF;
    return LW_OK(lw_terminate(self));
}

/* ---- variables (FMI 3.0, 2.2.6.2) ---- */

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Float64 values[], size_t nValues) {
    LW_SELF;
    return LW_OK(lw_get(self, "fmi3GetFloat64", valueReferences, nValueReferences, values, nValues));
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Float64 values[], size_t nValues) {
    LW_SELF;
    return LW_OK(lw_set(self, "fmi3SetFloat64", valueReferences, nValueReferences, values, nValues));
}

/* ---- stepping (FMI 3.0, 4.2.1) ---- */

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
        fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
        fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    LW_SELF;
    (void)noSetFMUStatePriorToCurrentPoint; /* nothing is buffered */
    double end = currentCommunicationPoint + communicationStepSize;
    bool ok = lw_check_step(self, currentCommunicationPoint, communicationStepSize)
              && lw_step(self, currentCommunicationPoint, communicationStepSize);
    if (eventHandlingNeeded) *eventHandlingNeeded = ok && self->event_found;
    if (terminateSimulation) *terminateSimulation = fmi3False;
    if (earlyReturn) *earlyReturn = ok && self->s.values[0] < end;
    if (lastSuccessfulTime) *lastSuccessfulTime = self->s.values[0];
    return LW_OK(ok);
}

/* ---- states (FMI 3.0, 2.2.6.4) ---- */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    LW_SELF;
    return LW_OK(lw_get_state(self, "fmi3GetFMUState", FMUState));
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    LW_SELF;
    return LW_OK(lw_accept_state(self, "fmi3SetFMUState", FMUState));
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    LW_SELF;
    lw_free_state(FMUState);
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    LW_SELF;
    (void)FMUState;
    return LW_OK(lw_get_serialized_size(self, "fmi3SerializedFMUStateSize", size));
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[], size_t size) {
    LW_SELF;
    return LW_OK(lw_serialize_state(self, "fmi3SerializeFMUState", FMUState, serializedState, size));
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[], size_t size, fmi3FMUState *FMUState) {
    LW_SELF;
    return LW_OK(lw_deserialize_state(self, "fmi3DeserializeFMUState", serializedState, size, FMUState));
}

/* ---- partial derivatives (FMI 3.0, 2.2.11) ---- */

#if LW_HAS_DERIVATIVES
fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[],
        size_t nSensitivity) {
    LW_SELF;
    return LW_OK(lw_derive(self, "fmi3GetDirectionalDerivative", false, unknowns, nUnknowns, knowns, nKnowns, seed, nSeed,
                           sensitivity, nSensitivity));
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
        const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[],
        size_t nSensitivity) {
    LW_SELF;
    return LW_OK(lw_derive(self, "fmi3GetAdjointDerivative", true, unknowns, nUnknowns, knowns, nKnowns, seed, nSeed,
                           sensitivity, nSensitivity));
}
#endif
