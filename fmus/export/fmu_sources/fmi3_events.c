/* FMI 3.0: Event Mode, and Model Exchange. */

/* ---- Event Mode (FMI 3.0, 2.3.5; in Co-Simulation if there are events or clocks) ---- */

static bool lw_has_event_mode(lw_instance *self, const char *function) {
    if (self->s.model_exchange || self->event_mode_used) return true;
#if LW_EVENT_MODE
    return lw_fail(self, "%s: this instance has no Event Mode. Instantiate it with eventModeUsed = fmi3True.", function);
#else
    return lw_fail(self, "%s: this FMU has no Event Mode in Co-Simulation (hasEventMode = false).", function);
#endif
}

fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    LW_SELF;
    return LW_OK(lw_has_event_mode(self, "fmi3EnterEventMode") && lw_enter_event_mode(self, "fmi3EnterEventMode"));
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
        fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
        fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime) {
    LW_SELF;
    bool again = false, moved = false;
    bool ok = lw_has_event_mode(self, "fmi3UpdateDiscreteStates")
              && lw_update_discrete_states(self, "fmi3UpdateDiscreteStates", &again, &moved);
    if (discreteStatesNeedUpdate) *discreteStatesNeedUpdate = again;
    if (terminateSimulation) *terminateSimulation = fmi3False;
    if (nominalsOfContinuousStatesChanged) *nominalsOfContinuousStatesChanged = fmi3False;
    if (valuesOfContinuousStatesChanged) *valuesOfContinuousStatesChanged = moved;
    if (nextEventTimeDefined) *nextEventTimeDefined = fmi3False;
    if (nextEventTime) *nextEventTime = 0.0;
    return LW_OK(ok);
}

fmi3Status fmi3EnterStepMode(fmi3Instance instance) {
    LW_SELF;
    if (self->s.model_exchange)
        return LW_OK(lw_fail(self, "fmi3EnterStepMode: this is a Model Exchange instance. Call fmi3EnterContinuousTimeMode."));
    return LW_OK(lw_has_event_mode(self, "fmi3EnterStepMode") && lw_leave_event_mode(self, "fmi3EnterStepMode", LW_STEPPING));
}

/* ---- clocks (FMI 3.0, 2.2.9 and 2.3.5): the ticks of a diagram, as periodic input clocks of constant intervals ---- */

#if LW_CLOCKS
/* Return the number of the clock with a value reference, those behind all variables; -1: there is none. */
static int lw_clock_of(lw_instance *self, const char *function, fmi3ValueReference reference) {
    if (reference >= LW_N_VARIABLES && reference - LW_N_VARIABLES < LW_CLOCKS) return (int)(reference - LW_N_VARIABLES);
    lw_fail(self, "%s: there is no clock with value reference %u. modelDescription.xml lists %d to %d.", function,
            (unsigned)reference, LW_N_VARIABLES, LW_N_VARIABLES + LW_CLOCKS - 1);
    return -1;
}

/* Are there values, and is each value reference that of a clock? */
static bool lw_are_clocks(lw_instance *self, const char *function, const fmi3ValueReference *references, size_t n, const void *values) {
    if (!lw_has_lists(self, function, references, n, values, n)) return false;
    for (size_t i = 0; i < n; i++)
        if (lw_clock_of(self, function, references[i]) < 0) return false;
    return true;
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        const fmi3Clock values[]) {
    LW_SELF;
    const char *function = "fmi3SetClock";
    if (!lw_has_event_mode(self, function) || !lw_in_mode(self, function, LW_EVENT)) return fmi3Error;
    if (!lw_are_clocks(self, function, valueReferences, nValueReferences, values)) return fmi3Error;
    for (size_t i = 0; i < nValueReferences; i++)
        if (!lw_set_clock(self, function, lw_clock_of(self, function, valueReferences[i]), values[i])) return fmi3Error;
    return fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences, fmi3Clock values[]) {
    LW_SELF;
    const char *function = "fmi3GetClock";
    if (!lw_has_event_mode(self, function) || !lw_in_mode(self, function, LW_EVENT)) return fmi3Error;
    if (!lw_are_clocks(self, function, valueReferences, nValueReferences, values)) return fmi3Error;
    for (size_t i = 0; i < nValueReferences; i++)
        values[i] = self->s.active >> lw_clock_of(self, function, valueReferences[i]) & 1;
    return fmi3OK;
}

/* The interval of a clock, or its shift, in ticks of the base. */
static int64_t lw_ticks_of(fmi3ValueReference reference, bool shift) {
    const int clock = (int)(reference - LW_N_VARIABLES);
    return shift ? lw_clocks[clock].offset : lw_clocks[clock].every;
}

static bool lw_may_ask(lw_instance *self, const char *function, const fmi3ValueReference *references, size_t n, const void *values) {
    if (self->s.mode != LW_INITIALIZING && self->s.mode != LW_EVENT && !lw_in_mode(self, function, LW_EVENT)) return false;
    return lw_are_clocks(self, function, references, n, values);
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                  fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]) {
    LW_SELF;
    const char *function = "fmi3GetIntervalDecimal";
    if (!lw_may_ask(self, function, valueReferences, nValueReferences, intervals)) return fmi3Error;
    if (nValueReferences && !lw_has_room(self, function, qualifiers)) return fmi3Error;
    for (size_t i = 0; i < nValueReferences; i++) {
        intervals[i] = lw_time_of(lw_ticks_of(valueReferences[i], false));
        qualifiers[i] = fmi3IntervalUnchanged;
    }
    return fmi3OK;
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                   fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]) {
    LW_SELF;
    const char *function = "fmi3GetIntervalFraction";
    if (!lw_may_ask(self, function, valueReferences, nValueReferences, counters)) return fmi3Error;
    if (nValueReferences && (!lw_has_room(self, function, resolutions) || !lw_has_room(self, function, qualifiers))) return fmi3Error;
    for (size_t i = 0; i < nValueReferences; i++) {
        counters[i] = (fmi3UInt64)(lw_ticks_of(valueReferences[i], false) * LW_BASE_NUMERATOR);
        resolutions[i] = (fmi3UInt64)LW_BASE_DENOMINATOR;
        qualifiers[i] = fmi3IntervalUnchanged;
    }
    return fmi3OK;
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                               fmi3Float64 shifts[]) {
    LW_SELF;
    if (!lw_may_ask(self, "fmi3GetShiftDecimal", valueReferences, nValueReferences, shifts)) return fmi3Error;
    for (size_t i = 0; i < nValueReferences; i++) shifts[i] = lw_time_of(lw_ticks_of(valueReferences[i], true));
    return fmi3OK;
}

fmi3Status fmi3GetShiftFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                                fmi3UInt64 counters[], fmi3UInt64 resolutions[]) {
    LW_SELF;
    const char *function = "fmi3GetShiftFraction";
    if (!lw_may_ask(self, function, valueReferences, nValueReferences, counters)) return fmi3Error;
    if (nValueReferences && !lw_has_room(self, function, resolutions)) return fmi3Error;
    for (size_t i = 0; i < nValueReferences; i++) {
        counters[i] = (fmi3UInt64)(lw_ticks_of(valueReferences[i], true) * LW_BASE_NUMERATOR);
        resolutions[i] = (fmi3UInt64)LW_BASE_DENOMINATOR;
    }
    return fmi3OK;
}
#endif

/* ---- Model Exchange (FMI 3.0, 3.2) ---- */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    LW_SELF;
    const char *function = "fmi3EnterContinuousTimeMode";
    return LW_OK(lw_is_model_exchange(self, function) && lw_leave_event_mode(self, function, LW_CONTINUOUS));
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
        fmi3Boolean *enterEventMode, fmi3Boolean *terminateSimulation) {
    LW_SELF;
    (void)noSetFMUStatePriorToCurrentPoint; /* nothing is buffered */
    if (enterEventMode) *enterEventMode = fmi3False;
    if (terminateSimulation) *terminateSimulation = fmi3False;
    return LW_OK(lw_is_model_exchange(self, "fmi3CompletedIntegratorStep")
                 && lw_in_mode(self, "fmi3CompletedIntegratorStep", LW_CONTINUOUS));
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi3SetTime", false, NULL, 0, 0) && lw_set_time(self, "fmi3SetTime", time));
}

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 continuousStates[], size_t nContinuousStates) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi3SetContinuousStates", false, continuousStates, nContinuousStates, LW_N_X)
                 && lw_set_states(self, "fmi3SetContinuousStates", continuousStates));
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[], size_t nContinuousStates) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi3GetContinuousStates", true, continuousStates, nContinuousStates, LW_N_X)
                 && lw_copy(continuousStates, self->s.values + LW_X, LW_N_X));
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[], size_t nContinuousStates) {
    LW_SELF;
    int32_t mode = self->s.mode;
    if (!lw_check_vector(self, "fmi3GetContinuousStateDerivatives", true, derivatives, nContinuousStates, LW_N_X)) return fmi3Error;
    return LW_EVALUATED(lw_update_derivatives(self) && lw_copy(derivatives, self->s.values + LW_DX, LW_N_X));
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[], size_t nEventIndicators) {
    LW_SELF;
    int32_t mode = self->s.mode;
    if (!lw_check_vector(self, "fmi3GetEventIndicators", true, eventIndicators, nEventIndicators, LW_N_Z)) return fmi3Error;
    return LW_EVALUATED(lw_update_indicators(self) && lw_copy(eventIndicators, self->s.values + LW_Z, LW_N_Z));
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t nContinuousStates) {
    LW_SELF;
    return LW_OK(lw_check_vector(self, "fmi3GetNominalsOfContinuousStates", true, nominals, nContinuousStates, LW_N_X)
                 && lw_copy(nominals, lw_nominals, LW_N_X));
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates) {
    LW_SELF;
    if (!lw_is_model_exchange(self, "fmi3GetNumberOfContinuousStates")) return fmi3Error;
    if (!lw_has_room(self, "fmi3GetNumberOfContinuousStates", nContinuousStates)) return fmi3Error;
    *nContinuousStates = LW_N_X;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators) {
    LW_SELF;
    if (!lw_is_model_exchange(self, "fmi3GetNumberOfEventIndicators")) return fmi3Error;
    if (!lw_has_room(self, "fmi3GetNumberOfEventIndicators", nEventIndicators)) return fmi3Error;
    *nEventIndicators = LW_N_Z;
    return fmi3OK;
}
