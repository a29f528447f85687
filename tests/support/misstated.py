"""An FMU whose statements about itself are wrong: a mass on a spring and a damper, in C, for both interfaces.

    ẋ = v,  v̇ = −k x − d v + u,  a = v̇,  k = 100 1/s², d = 1 1/s

Its parameter ``e`` is the relative error of its directional derivatives; with ``rough`` it has another sign at each
call. Pairs of texts change its source or its description.
"""

import numpy as np

from .small_fmus import small_fmu

K, D = 100.0, 1.0
A, B = np.array([[0.0, 1.0], [-K, -D]]), np.array([[0.0], [1.0]])

_SOURCE = r"""
typedef struct { double t, x, v, u, e, rough; unsigned seed; } instance;
#if FMI == 3
#define SIZE , size_t size
typedef bool boolean;
void *fmi3InstantiateModelExchange() { return calloc(1, sizeof(instance)); }
void *fmi3InstantiateCoSimulation() { return calloc(1, sizeof(instance)); }
#else
#define SIZE
typedef int boolean;
void *fmi2Instantiate() { return calloc(1, sizeof(instance)); }
#endif
int NAME(EnterEventMode)(void *p) { return 0; }
int NAME(EnterContinuousTimeMode)(void *p) { return 0; }
int NAME(SetTime)(void *p, double t) { ((instance *)p)->t = t; return 0; }
int NAME(SetContinuousStates)(void *p, const double x[], size_t n) {
    instance *c = p; c->x = x[0]; c->v = x[1]; return 0; }
int NAME(GetContinuousStates)(void *p, double x[], size_t n) { instance *c = p; x[0] = c->x; x[1] = c->v; return 0; }
int NAME(GetNominalsOfContinuousStates)(void *p, double x[], size_t n) { x[0] = x[1] = 1.0; return 0; }
static double rate(instance *c, double x, double v) { return -100.0 * x - v + c->u; }
int NAME(RATES)(void *p, double dx[], size_t n) {
    instance *c = p; dx[0] = c->v; dx[1] = rate(c, c->x, c->v); return 0; }
int NAME(CompletedIntegratorStep)(void *p, boolean final, boolean *event, boolean *end) {
    *event = *end = false; return 0; }
#if FMI == 3
int fmi3UpdateDiscreteStates(void *p, bool *again, bool *end, bool *nominals, bool *states, bool *has, double *next) {
    *again = *end = *nominals = *states = *has = false; return 0; }
#else
typedef struct { int again, end, nominals, states, has; double next; } info;
int fmi2NewDiscreteStates(void *p, info *i) { memset(i, 0, sizeof *i); return 0; }
#endif
static double *at(instance *c, unsigned r) {
    static double made;
    switch (r) {
    case 1: return &c->x; case 2: case 3: return &c->v; case 5: return &c->u; case 7: return &c->e;
    case 8: return &c->rough; default: made = rate(c, c->x, c->v); return &made; } }
int NAME(GET)(void *p, const unsigned r[], size_t n, double v[] SIZE) {
    for (size_t i = 0; i < n; i++) v[i] = *at(p, r[i]);
    return 0; }
int NAME(SET)(void *p, const unsigned r[], size_t n, const double v[] SIZE) {
    for (size_t i = 0; i < n; i++) *at(p, r[i]) = v[i];
    return 0; }
#if FMI == 3
int fmi3DoStep(void *p, double t, double h, bool final, bool *event, bool *end, bool *early, double *reached) {
    *event = *end = *early = false; *reached = t + h;
#else
int fmi2DoStep(void *p, double t, double h, int final) {
#endif
    instance *c = p; h /= 100;
    for (int i = 0; i < 100; i++) {
        double a = c->v, b = rate(c, c->x, c->v);
        double a2 = c->v + h / 2 * b, b2 = rate(c, c->x + h / 2 * a, a2);
        double a3 = c->v + h / 2 * b2, b3 = rate(c, c->x + h / 2 * a2, a3);
        double a4 = c->v + h * b3, b4 = rate(c, c->x + h * a3, a4);
        c->x += h / 6 * (a + 2 * a2 + 2 * a3 + a4); c->v += h / 6 * (b + 2 * b2 + 2 * b3 + b4); }
    c->t = t + 100 * h; return 0; }
#if FMI == 3
int fmi3GetDirectionalDerivative(void *p, const unsigned f[], size_t n, const unsigned by[], size_t m,
    const double seed[], size_t ns, double d[], size_t nd) {
#else
int fmi2GetDirectionalDerivative(void *p, const unsigned f[], size_t n, const unsigned by[], size_t m,
    const double seed[], double d[]) {
#endif
    instance *c = p; double x = 0.0, v = 0.0, u = 0.0;
    for (size_t k = 0; k < m; k++) *(by[k] == 1 ? &x : by[k] == 2 ? &v : &u) += seed[k];
    for (size_t i = 0; i < n; i++) {
        double e = c->e; c->seed = 1664525u * c->seed + 1013904223u;
        if (c->rough) e *= c->seed / 2147483648.0 - 1.0;
        d[i] = (1.0 + e) * (f[i] == 1 ? x : f[i] == 2 || f[i] == 3 ? v : -100.0 * x - v + u); }
    return 0; }
"""
_REALS = (  # name, reference, causality, variability, initial, start, derivative of
    ("x", 1, "output", "continuous", "exact", "0", None),
    ("v", 2, "output", "continuous", "exact", "0", None),
    ("der(x)", 3, "local", "continuous", "calculated", None, 1),
    ("der(v)", 4, "local", "continuous", "calculated", None, 2),
    ("u", 5, "input", "continuous", None, "0", None),
    ("a", 6, "output", "continuous", "calculated", None, None),
    ("e", 7, "parameter", "fixed", "exact", "0", None),
    ("rough", 8, "parameter", "fixed", "exact", "0", None),
)
_SAVES = ' canHandleVariableCommunicationStepSize="true"'


_HIDING = (
    ("made = rate(c, c->x, c->v); return &made;", "made = r == 9 ? 3.0 * c->x : rate(c, c->x, c->v); return &made;"),
    ("v = 0.0, u = 0.0;", "v = 0.0, u = 0.0; for (size_t i = 0; i < n; i++) if (f[i] == 1 || f[i] == 9) return 3;"),
    ("{ return calloc(1, sizeof(instance)); }", "{ instance *c = calloc(1, sizeof(instance)); c->x = 0.1; return c; }"),
)


def misstated_fmu(folder, fmi, changes=(), *, hides_state=False):
    """Build it into a folder, for a version of FMI, and return its path.

    With ``hides_state`` x is a local variable that starts at 0.1, without an exact start value, and so is w = 3 x;
    directional derivatives of local variables are an error, as in the FMUs of Dymola.
    """
    prefix = f"fmi{fmi}"
    names = {
        "RATES": "GetDerivatives" if fmi == 2 else "GetContinuousStateDerivatives",
        **{v.upper(): f"{v}{'Real' if fmi == 2 else 'Float64'}" for v in ("Get", "Set")},
    }
    source = f"#define FMI {fmi}\n#define PASTE(a, b) a##b\n#define NAME(end) PASTE({prefix}, end)\n" + _SOURCE
    for key, end in names.items():
        source = source.replace(f"NAME({key})", f"{prefix}{end}")
    reals = _REALS
    if hides_state:
        hidden = ("x", 1, "local", "continuous", "calculated", None, None)
        reals = (hidden, *_REALS[1:], ("w", 9, "local", "continuous", "calculated", None, None))
        for before, after in _HIDING:
            assert before in source
            source = source.replace(before, after)
    description = (_describe2 if fmi == 2 else _describe3)(reals)
    if hides_state:
        description = description.replace(
            f'<{"Unknown index" if fmi == 2 else "Output valueReference"}="1" dependencies="1"/>', ""
        )
    for before, after in changes:
        assert (before in source) + (before in description) == 1, before
        source, description = source.replace(before, after), description.replace(before, after)
    return small_fmu(folder, prefix, source, description)


def _attributes(initial, start, derivative):
    found = f' start="{start}"' if start is not None else ""
    return found, f' initial="{initial}"' if initial else "", f' derivative="{derivative}"' if derivative else ""


def _describe3(reals):
    rows = []
    for name, reference, causality, variability, initial, start, derivative in reals:
        start, initial, derivative = _attributes(initial, start, derivative)
        rows.append(
            f'<Float64 name="{name}" valueReference="{reference}" causality="{causality}" variability="{variability}"'
            f"{initial}{start}{derivative}/>"
        )
    return (
        '<ModelExchange modelIdentifier="small" providesDirectionalDerivatives="true"/>'
        f'<CoSimulation modelIdentifier="small" providesDirectionalDerivatives="true"{_SAVES}/>'
        f'<ModelVariables><Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>'
        f"{''.join(rows)}</ModelVariables><ModelStructure>"
        '<Output valueReference="1" dependencies="1"/><Output valueReference="2" dependencies="2"/>'
        '<Output valueReference="6" dependencies="1 2 5"/>'
        '<ContinuousStateDerivative valueReference="3" dependencies="2"/>'
        '<ContinuousStateDerivative valueReference="4" dependencies="1 2 5"/>'
        "</ModelStructure>"
    )


def _describe2(reals):
    rows = []
    for name, reference, causality, variability, initial, start, derivative in reals:
        start, initial, derivative = _attributes(initial, start, derivative)
        rows.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
            f'variability="{variability}"{initial}><Real{start}{derivative}/></ScalarVariable>'
        )
    return (
        '<ModelExchange modelIdentifier="small" providesDirectionalDerivative="true"/>'
        f'<CoSimulation modelIdentifier="small" providesDirectionalDerivative="true"{_SAVES}/>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables><ModelStructure><Outputs>"
        '<Unknown index="1" dependencies="1"/><Unknown index="2" dependencies="2"/>'
        '<Unknown index="6" dependencies="1 2 5"/></Outputs><Derivatives>'
        '<Unknown index="3" dependencies="2"/><Unknown index="4" dependencies="1 2 5"/>'
        "</Derivatives></ModelStructure>"
    )
