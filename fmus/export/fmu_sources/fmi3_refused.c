/* FMI 3.0: the functions that these FMUs don't support. Every symbol of the standard is exported (some importers ask for
 * all of them); each of these returns fmi3Error and logs the reason. */
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

static fmi3Status lw_refuse(lw_instance *self, const char *function, const char *why) {
    if (self) lw_fail(self, "%s: %s.", function, why);
    return fmi3Error;
}

#define LW_REFUSE(name, why, ...) fmi3Status name(__VA_ARGS__) { return lw_refuse(instance, #name, why); }

/* ---- variables of other types: there are none, so only calls with none succeed ---- */

#define LW_NO_TYPE(name, ...) \
    fmi3Status name(fmi3Instance instance, const fmi3ValueReference v[], size_t n, __VA_ARGS__) { \
        return instance && n == 0 ? fmi3OK : lw_refuse(instance, #name, "all variables of this FMU are Float64"); \
    }
#define LW_NO_NUMBERS(type) \
    LW_NO_TYPE(fmi3Get##type, fmi3##type values[], size_t nValues) \
    LW_NO_TYPE(fmi3Set##type, const fmi3##type values[], size_t nValues)

LW_NO_NUMBERS(Float32)
LW_NO_NUMBERS(Int8)
LW_NO_NUMBERS(UInt8)
LW_NO_NUMBERS(Int16)
LW_NO_NUMBERS(UInt16)
LW_NO_NUMBERS(Int32)
LW_NO_NUMBERS(UInt32)
LW_NO_NUMBERS(Int64)
LW_NO_NUMBERS(UInt64)
LW_NO_NUMBERS(Boolean)
LW_NO_NUMBERS(String)
LW_NO_TYPE(fmi3GetBinary, size_t valueSizes[], fmi3Binary values[], size_t nValues)
LW_NO_TYPE(fmi3SetBinary, const size_t valueSizes[], const fmi3Binary values[], size_t nValues)
#if !LW_CLOCKS
LW_NO_TYPE(fmi3GetClock, fmi3Clock values[])
LW_NO_TYPE(fmi3SetClock, const fmi3Clock values[])
#endif

/* ---- other interface types ---- */

static fmi3Instance lw_refuse_instance(fmi3String instanceName, fmi3Boolean loggingOn, fmi3InstanceEnvironment environment,
                                       fmi3LogMessageCallback logMessage, const char *message) {
    if (loggingOn && logMessage) logMessage(environment, fmi3Error, "logStatusError", message);
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
        fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
        fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lockPreemption,
        fmi3UnlockPreemptionCallback unlockPreemption) {
    return lw_refuse_instance(instanceName, loggingOn, instanceEnvironment, logMessage, LW_MODEL_NAME
                              ": this FMU has no Scheduled Execution. Use fmi3InstantiateCoSimulation.");
}

LW_REFUSE(fmi3ActivateModelPartition, "this FMU has no Scheduled Execution (see modelDescription.xml)", fmi3Instance instance,
          fmi3ValueReference clockReference, fmi3Float64 activationTime)

/* ---- capabilities that the model description doesn't claim ---- */

LW_REFUSE(fmi3EvaluateDiscreteStates, "providesEvaluateDiscreteStates is false; call fmi3UpdateDiscreteStates",
          fmi3Instance instance)

#define LW_NO_STRUCTURE "this FMU has no structural parameters"
LW_REFUSE(fmi3EnterConfigurationMode, LW_NO_STRUCTURE, fmi3Instance instance)
LW_REFUSE(fmi3ExitConfigurationMode, LW_NO_STRUCTURE, fmi3Instance instance)

#define LW_NO_PER_ELEMENT "dependencies are in modelDescription.xml (providesPerElementDependencies = false)"
LW_REFUSE(fmi3GetNumberOfVariableDependencies, LW_NO_PER_ELEMENT, fmi3Instance instance, fmi3ValueReference valueReference,
          size_t *nDependencies)
LW_REFUSE(fmi3GetVariableDependencies, LW_NO_PER_ELEMENT, fmi3Instance instance, fmi3ValueReference dependent,
          size_t elementIndicesOfDependent[], fmi3ValueReference independents[], size_t elementIndicesOfIndependents[],
          fmi3DependencyKind dependencyKinds[], size_t nDependencies)

LW_REFUSE(fmi3GetOutputDerivatives, "maxOutputDerivativeOrder is 0", fmi3Instance instance,
          const fmi3ValueReference valueReferences[], size_t nValueReferences, const fmi3Int32 orders[], fmi3Float64 values[],
          size_t nValues)

#if LW_CLOCKS
#define LW_NO_CLOCKS "the intervals of its clocks are constant; see modelDescription.xml"
#else
#define LW_NO_CLOCKS "this FMU has no clocks"
LW_REFUSE(fmi3GetIntervalDecimal, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n,
          fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
LW_REFUSE(fmi3GetIntervalFraction, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n,
          fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[])
LW_REFUSE(fmi3GetShiftDecimal, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n, fmi3Float64 shifts[])
LW_REFUSE(fmi3GetShiftFraction, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n,
          fmi3UInt64 counters[], fmi3UInt64 resolutions[])
#endif
LW_REFUSE(fmi3SetIntervalDecimal, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n,
          const fmi3Float64 intervals[])
LW_REFUSE(fmi3SetIntervalFraction, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n,
          const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
LW_REFUSE(fmi3SetShiftDecimal, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n,
          const fmi3Float64 shifts[])
LW_REFUSE(fmi3SetShiftFraction, LW_NO_CLOCKS, fmi3Instance instance, const fmi3ValueReference v[], size_t n,
          const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])

#if !LW_HAS_DERIVATIVES
#define LW_NO_DERIVATIVES "providesDirectionalDerivatives and providesAdjointDerivatives are false"
LW_REFUSE(fmi3GetDirectionalDerivative, LW_NO_DERIVATIVES, fmi3Instance instance, const fmi3ValueReference unknowns[],
          size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
          fmi3Float64 sensitivity[], size_t nSensitivity)
LW_REFUSE(fmi3GetAdjointDerivative, LW_NO_DERIVATIVES, fmi3Instance instance, const fmi3ValueReference unknowns[],
          size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
          fmi3Float64 sensitivity[], size_t nSensitivity)
#endif
