"""A small FMU of FMI 2.0 in C with an output that is NaN from x > 0.25 on, beside the output x; both interfaces.

ẋ = u, so that with u = 1: x = t; ``lost`` is 1, then NaN.
"""

from support.small_fmus import small_fmu, values

SOURCE = """
typedef struct { double t, u, x; } instance;
typedef struct { int again, end, nominals, states, has; double next; } info;
int fmi2DoStep(void *p, double t, double h, int f) { instance *c = p; c->x += h * c->u; return 0; }
int fmi2EnterEventMode(void *p) { return 0; }
int fmi2EnterContinuousTimeMode(void *p) { return 0; }
int fmi2SetTime(void *p, double t) { return 0; }
int fmi2NewDiscreteStates(void *p, info *i) { memset(i, 0, sizeof *i); return 0; }
int fmi2CompletedIntegratorStep(void *p, int final, int *event, int *end) { *event = *end = 0; return 0; }
int fmi2SetContinuousStates(void *p, const double x[], size_t n) { ((instance *)p)->x = x[0]; return 0; }
int fmi2GetContinuousStates(void *p, double x[], size_t n) { x[0] = ((instance *)p)->x; return 0; }
int fmi2GetNominalsOfContinuousStates(void *p, double x[], size_t n) { x[0] = 1.0; return 0; }
int fmi2GetEventIndicators(void *p, double z[], size_t n) { return 0; }
int fmi2GetDerivatives(void *p, double dx[], size_t n) { dx[0] = ((instance *)p)->u; return 0; }
int fmi2GetFMUstate(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); memcpy(*s, p, sizeof(instance)); return 0; }
int fmi2SetFMUstate(void *p, void *s) { memcpy(p, s, sizeof(instance)); return 0; }
int fmi2FreeFMUstate(void *p, void **s) { free(*s); *s = 0; return 0; }
"""
LIMIT = 0.25
MODEL = """<ModelExchange modelIdentifier="small"/>
<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUstate="true"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="1" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" causality="output" initial="exact"><Real start="0"/></ScalarVariable>
<ScalarVariable name="lost" valueReference="3" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="4"><Real derivative="2"/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="2" dependencies="2"/><Unknown index="3" dependencies="2"/>
</Outputs><Derivatives><Unknown index="4" dependencies="1"/></Derivatives></ModelStructure>"""


def lost_output(folder, value="NAN"):
    """Build the FMU, and return its path; ``value`` is what its output becomes, in C."""
    read = {1: "c->u", 2: "c->x", 3: f"c->x > {LIMIT} + 1e-9 ? {value} : 1.0", 4: "c->u"}
    source = SOURCE + "".join(
        values("fmi2", verb, "Real", "double", {k: e for k, e in read.items() if verb == "Get" or k < 3})
        for verb in ("Get", "Set")
    )
    return small_fmu(folder, "fmi2", source, MODEL)
