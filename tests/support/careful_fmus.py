"""Sources and descriptions of small FMUs whose steps are more than setting, stepping and getting."""

from support.small_fmus import values

# x' = u as long as x < 0.5; there the FMU asks for Event Mode, in which it turns round. A time event is at 0.25 s.
EVENTS = (
    """
typedef struct { double t, x, u, sign, level, tolerance, told; int mode, beats, timed, rounds, early; } instance;
void *fmi3InstantiateCoSimulation(const char *n, const char *k, const char *r, bool v, bool l, bool event, bool early) {
    instance *c = calloc(1, sizeof(instance)); c->sign = 1; c->early = early; c->mode = event ? 1 : 0; return c; }
int fmi3EnterInitializationMode(void *p, bool defined, double tol) {
    ((instance *)p)->tolerance = defined ? tol : -1; return 0; }
int fmi3EnterEventMode(void *p) { instance *c = p; if (c->mode == 1) return 3; c->mode = 1; c->rounds = 0; return 0; }
int fmi3EnterStepMode(void *p) { instance *c = p; if (c->mode != 1) return 3; c->mode = 2; return 0; }
int fmi3UpdateDiscreteStates(void *p, bool *more, bool *stop, bool *nominals, bool *v, bool *defined, double *next) {
    instance *c = p; if (c->mode != 1) return 3;
    if (!c->rounds && fabs(c->t - 0.25) < 1e-9) c->timed++;
    if (c->x > 0.5 - 1e-12) c->sign = -1;
    *more = c->rounds++ < 2; *stop = *nominals = *v = false; *defined = c->t < 0.25 - 1e-9; *next = 0.25; return 0; }
int fmi3SetClock(void *p, const unsigned vr[], size_t n, const bool v[]) {
    instance *c = p; if (c->mode != 1) return 3; c->beats += v[0]; return 0; }
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; *e = *stop = *early = false;
    if (c->mode == 1 || fabs(t - c->t) > 1e-9) return 3;
    double way = h; c->told = t;
    if (c->sign > 0 && c->x + c->u * h > 0.5 && c->mode == 2) { way = (0.5 - c->x) / c->u; *e = true; *early = way < h && c->early; }
    c->x += c->sign * c->u * way; c->t = t + way; *last = c->t; return 0; }
"""
    """
int fmi3GetFMUState(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); memcpy(*s, p, sizeof(instance)); return 0; }
int fmi3SetFMUState(void *p, void *s) { memcpy(p, s, sizeof(instance)); return 0; }
int fmi3FreeFMUState(void *p, void **s) { free(*s); *s = 0; return 0; }
"""
    + values("fmi3", "Get", "Float64", "double", {1: "c->x", 2: "c->u", 3: "c->level", 4: "c->tolerance", 5: "c->told"})
    + values("fmi3", "Get", "Int32", "int32_t", {6: "c->beats", 7: "c->timed", 9: "c->level"})
    + values("fmi3", "Set", "Float64", "double", {2: "c->u"})
    + values("fmi3", "Set", "Int32", "int32_t", {9: "if (c->mode == 2) return 3; c->level"})
)
MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="{variable}" hasEventMode="true" canGetAndSetFMUState="true"/>
<ModelVariables>
<Float64 name="x" valueReference="1" causality="output"/>
<Float64 name="u" valueReference="2" causality="input" start="0"/>
<Float64 name="seen" valueReference="3" causality="output"/>
<Float64 name="tolerance" valueReference="4" causality="output"/>
<Float64 name="told" valueReference="5" causality="output"/>
<Int32 name="beats" valueReference="6" causality="output"/><Int32 name="timed" valueReference="7" causality="output"/>
<Int32 name="level" valueReference="9" causality="input" variability="discrete" start="0"/>
{clock}</ModelVariables><ModelStructure>{outputs}</ModelStructure>"""
CLOCK = (
    '<Clock name="beat" valueReference="8" causality="input" intervalVariability="constant" intervalDecimal="0.15"/>'
)
OUTPUTS = "".join(f'<Output valueReference="{k}"/>' for k in (1, 3, 4, 5, 6, 7))

SIMPLE2 = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="{variable}" {more}/><ModelVariables>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="steps" valueReference="2" causality="output" variability="discrete"><Integer/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1"/><Unknown index="2"/></Outputs></ModelStructure>"""

ROLLS_BACK = (
    """
typedef struct { double t, reached, x; int steps; } instance;
int fmi2DoStep(void *p, double t, double h, int f) {  /* a step ends at 0.25 s, or before it; a discarded one spoils all */
    instance *c = p; if (fabs(t - c->t) > 1e-12) return 3;
    if (t < 0.25 - 1e-9 && t + h > 0.25 + 1e-9) { c->t = c->reached = 0.25; c->x += 100; return 2; }
    c->t = t + h; c->x += h; c->steps++; return 0; }
int fmi2GetRealStatus(void *p, int kind, double *v) { *v = ((instance *)p)->reached; return kind == 2 ? 0 : 3; }
int fmi2GetBooleanStatus(void *p, int kind, int *v) { *v = 0; return 0; }
int fmi2GetFMUstate(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); memcpy(*s, p, sizeof(instance)); return 0; }
int fmi2SetFMUstate(void *p, void *s) { memcpy(p, s, sizeof(instance)); return 0; }
int fmi2FreeFMUstate(void *p, void **s) { free(*s); *s = 0; return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->x"})
    + values("fmi2", "Get", "Integer", "int", {2: "c->steps"})
)

INTEGRATOR = (
    """
typedef struct { double t, x, u, du; } instance;
int fmi2SetRealInputDerivatives(void *p, const unsigned vr[], size_t n, const int order[], const double v[]) {
    for (size_t i = 0; i < n; i++) { if (order[i] != 1 || vr[i] != 2) return 3; ((instance *)p)->du = v[i]; } return 0; }
int fmi2DoStep(void *p, double t, double h, int f) {
    instance *c = p; c->x += h * (c->u + 0.5 * h * c->du); c->t = t + h; return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->x"})
    + values("fmi2", "Set", "Real", "double", {2: "c->u"})
)
INTEGRATOR_MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true" {more}/>
<ModelVariables><ScalarVariable name="x" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="u" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1"/></Outputs></ModelStructure>"""

# x' = u with the input at the middle of the step, or that of its start where it is not set within the step.
BETWEEN = """
typedef struct { double t, x, u[2]; void (*update)(void *, double, bool, bool, bool, bool, bool *, double *); } instance;
void *fmi3InstantiateCoSimulation(const char *n, const char *k, const char *r, bool v, bool l, bool event, bool early,
        const unsigned required[], size_t nr, void *e, void *log, void *update) {
    instance *c = calloc(1, sizeof(instance)); c->update = nr == 1 && required[0] == 2 ? update : NULL; return c; }
int fmi3SetFloat64(void *p, const unsigned vr[], size_t n, const double v[], size_t nv) {
    if (n != 1 || vr[0] != 2 || nv != 2) return 3; memcpy(((instance *)p)->u, v, 2 * sizeof(double)); return 0; }
int fmi3GetFloat64(void *p, const unsigned vr[], size_t n, double v[], size_t nv) {
    instance *c = p; for (size_t i = 0; i < n; i++) if (vr[i] == 1) *v++ = c->x; else { *v++ = c->u[0]; *v++ = c->u[1]; }
    return 0; }
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; bool asked = false; double when = 0; *e = *stop = *early = false;
    if (c->update) c->update(NULL, t + 0.5 * h, true, false, false, false, &asked, &when);
    c->x += h * (c->u[0] + c->u[1]); c->t = *last = t + h; return 0; }
"""
BETWEEN_MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"
 providesIntermediateUpdate="true"/><ModelVariables><Float64 name="x" valueReference="1" causality="output"/>
<Float64 name="u" valueReference="2" causality="input" start="0 0" intermediateUpdate="true"><Dimension start="2"/></Float64>
</ModelVariables><ModelStructure><Output valueReference="1"/></ModelStructure>"""
