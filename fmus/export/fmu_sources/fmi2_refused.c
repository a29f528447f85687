/* FMI 2.0: the functions that these FMUs don't support. Every symbol of the standard is exported (some importers ask for
 * all of them); each of these returns an error, or fmi2Discard if that does no harm, and logs the reason. */
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

static fmi2Status lw_refuse(lw_instance *self, const char *function, const char *why) {
    if (self) lw_fail(self, "%s: %s.", function, why);
    return fmi2Error;
}

static fmi2Status lw_discard(lw_instance *self, const char *function, const char *why) {
    if (!self) return fmi2Error;
    lw_warn(self, "%s: %s.", function, why);
    return fmi2Discard;
}

#define LW_REFUSE(name, why, ...) fmi2Status name(fmi2Component c, __VA_ARGS__) { return lw_refuse(c, #name, why); }

/* ---- variables of other types: there are none, so only calls with none succeed ---- */

#define LW_NO_TYPE(type) \
    fmi2Status fmi2Get##type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2##type value[]) { \
        return c && nvr == 0 ? fmi2OK : lw_refuse(c, "fmi2Get" #type, "all variables of this FMU are Real"); \
    } \
    fmi2Status fmi2Set##type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2##type value[]) { \
        return c && nvr == 0 ? fmi2OK : lw_refuse(c, "fmi2Set" #type, "all variables of this FMU are Real"); \
    }
LW_NO_TYPE(Integer)
LW_NO_TYPE(Boolean)
LW_NO_TYPE(String)

/* ---- derivatives of outputs by time ---- */

LW_REFUSE(fmi2GetRealOutputDerivatives, "maxOutputDerivativeOrder is 0", const fmi2ValueReference vr[], size_t nvr,
          const fmi2Integer order[], fmi2Real value[])

/* ---- status of a step (FMI 2.0, 4.2.3): every step is complete when fmi2DoStep returns ---- */

#define LW_SYNCHRONOUS "every step is complete when fmi2DoStep returns (canRunAsynchronuously = false)"

fmi2Status fmi2CancelStep(fmi2Component c) { return lw_refuse(c, "fmi2CancelStep", LW_SYNCHRONOUS); }

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
    return lw_discard(c, "fmi2GetStatus", LW_SYNCHRONOUS);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    LW_SELF;
    if (s != fmi2LastSuccessfulTime) return lw_discard(c, "fmi2GetRealStatus", "the only kind of type Real is fmi2LastSuccessfulTime");
    if (!lw_has_room(self, "fmi2GetRealStatus", value)) return fmi2Error;
    *value = self->s.values[0];
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
    return lw_discard(c, "fmi2GetIntegerStatus", "there is no status of type Integer");
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    LW_SELF;
    if (s != fmi2Terminated) return lw_discard(c, "fmi2GetBooleanStatus", "the only kind of type Boolean is fmi2Terminated");
    if (!lw_has_room(self, "fmi2GetBooleanStatus", value)) return fmi2Error;
    *value = fmi2False; /* the model never ends the simulation */
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
    return lw_discard(c, "fmi2GetStringStatus", LW_SYNCHRONOUS);
}

#if !LW_HAS_DERIVATIVES
LW_REFUSE(fmi2GetDirectionalDerivative, "providesDirectionalDerivative is false", const fmi2ValueReference vUnknown_ref[],
          size_t nUnknown, const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[], fmi2Real dvUnknown[])
#endif
