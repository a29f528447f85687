"""Small FMUs in C without directional derivatives, for both interfaces: dx/dt and y as C code of x, u and t.

States are x1, x2, …, inputs u1, u2, …, outputs y1, y2, …; a co-simulation step takes 20 steps of Runge-Kutta's method.
"""

from .small_fmus import small_fmu

_SOURCE = r"""
typedef NUMBER number;
typedef struct { double t; number x[9], u[9]; int step, which; } instance;
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
static double single(double v) { volatile float s = (float)v; return s; }
static void find(instance *c, const number x[], number dx[], number y[]) {
    const number *u = c->u; double t = c->t; (void)x; (void)u; (void)t;
    switch (c->which) { EQUATIONS } }
int NAME(EnterEventMode)(void *p) { return 0; }
int NAME(EnterContinuousTimeMode)(void *p) { return 0; }
int NAME(SetTime)(void *p, double t) { ((instance *)p)->t = t; return 0; }
int NAME(SetContinuousStates)(void *p, const double x[], size_t n) {
    instance *c = p; for (size_t i = 0; i < n; i++) c->x[i] = (number)x[i];
    return 0; }
int NAME(GetContinuousStates)(void *p, double x[], size_t n) {
    instance *c = p; for (size_t i = 0; i < n; i++) x[i] = c->x[i];
    return 0; }
int NAME(GetNominalsOfContinuousStates)(void *p, double x[], size_t n) {
    for (size_t i = 0; i < n; i++) x[i] = 1.0;
    return 0; }
int NAME(RATES)(void *p, double dx[], size_t n) {
    instance *c = p; number d[9] = {0}, y[9] = {0}; find(c, c->x, d, y);
    for (size_t i = 0; i < n; i++) dx[i] = d[i];
    return 0; }
int NAME(CompletedIntegratorStep)(void *p, boolean final, boolean *event, boolean *end) {
    *event = *end = false; return 0; }
#if FMI == 3
int fmi3UpdateDiscreteStates(void *p, bool *again, bool *end, bool *nominals, bool *states, bool *has, double *next) {
    *again = *end = *nominals = *states = *has = false; return 0; }
#else
typedef struct { int again, end, nominals, states, has; double next; } info;
int fmi2NewDiscreteStates(void *p, info *i) { memset(i, 0, sizeof *i); return 0; }
#endif
int NAME(GET)(void *p, const unsigned r[], size_t n, double v[] SIZE) {
    instance *c = p; number d[9] = {0}, y[9] = {0}; find(c, c->x, d, y);
    for (size_t i = 0; i < n; i++) {
        unsigned k = r[i] % 10 - 1;
        v[i] = r[i] == 41 ? c->which : r[i] < 10 ? c->x[k] : r[i] < 20 ? d[k] : r[i] < 30 ? c->u[k] : y[k]; }
    return 0; }
int NAME(SET)(void *p, const unsigned r[], size_t n, const double v[] SIZE) {
    instance *c = p;
    for (size_t i = 0; i < n; i++)
        if (r[i] == 41) c->which = (int)v[i];
        else (r[i] < 10 ? c->x : c->u)[r[i] % 10 - 1] = (number)v[i];
    return 0; }
#if FMI == 3
int fmi3DoStep(void *p, double t, double h, bool final, bool *event, bool *end, bool *early, double *reached) {
    *event = *end = *early = false; *reached = t + h;
#else
int fmi2DoStep(void *p, double t, double h, int final) {
#endif
    instance *c = p; number y[9]; h /= 20; (void)y; CHECK
    for (int i = 0; i < 20; i++) {
        number k[4][9] = {{0}}, z[9];
        for (int s = 0; s < 4; s++) {
            double part = s == 0 ? 0.0 : s == 3 ? h : h / 2;
            c->t = t + i * h + part;
            for (int j = 0; j < STATES; j++) z[j] = (number)(c->x[j] + (s ? part * k[s - 1][j] : 0.0));
            find(c, z, k[s], y); }
        for (int j = 0; j < STATES; j++)
            c->x[j] = (number)(c->x[j] + h / 6 * (k[0][j] + 2 * k[1][j] + 2 * k[2][j] + k[3][j])); }
    c->step++; c->t = t + 20 * h; return 0; }
"""


def closed_form_fmu(
    folder,
    fmi,
    equations,
    states=1,
    inputs=1,
    outputs=1,
    *,
    number="double",
    attributes="",
    of_input="continuous",
    dependencies=None,
    check="",
    name="small",
    changes=(),
    description=(),
):
    """Build it into a folder, for a version of FMI, and return its path.

    Parameters
    ----------
    equations : str or sequence of str
        C code that writes ``dx`` and ``y`` from ``x``, ``u`` and ``t``; ``single(v)`` rounds to single precision. The
        parameter ``which`` chooses one of several.
    number : str
        C type of all it computes with.
    attributes : str
        More attributes of its co-simulation.
    of_input : str
        Variability of the inputs.
    dependencies : mapping of str to str, optional
        Dependencies of ``"dx1"``, …, ``"y1"``, … as names, ``"x1 u1"``; of the others none are stated.
    check : str
        C code at the beginning of a step.
    changes, description : sequence of (str, str)
        Texts of the source, and of the description, and what stands in for them.
    """
    prefix = f"fmi{fmi}"
    several = [equations] if isinstance(equations, str) else equations
    equations = " ".join(f"case {k}: {{ {text} break; }}" for k, text in enumerate(several))
    source = f"#define FMI {fmi}\n#define STATES {states}\n#define PASTE(a, b) a##b\n#define NAME(end) PASTE({prefix}, end)\n"
    source += _SOURCE.replace("NUMBER", number).replace("EQUATIONS", equations).replace("CHECK", check)
    for before, after in changes:
        assert before in source, before
        source = source.replace(before, after)
    names = {
        "RATES": "GetDerivatives" if fmi == 2 else "GetContinuousStateDerivatives",
        **{v.upper(): f"{v}{'Real' if fmi == 2 else 'Float64'}" for v in ("Get", "Set")},
    }
    for key, end in names.items():
        source = source.replace(f"NAME({key})", f"{prefix}{end}")
    for end in ("EnterEventMode", "EnterContinuousTimeMode", "SetTime", "SetContinuousStates", "GetContinuousStates"):
        source = source.replace(f"NAME({end})", f"{prefix}{end}")
    reals = [(f"x{i}", i, "local", "continuous", "exact", "0", None) for i in range(1, states + 1)]
    reals += [(f"der(x{i})", 10 + i, "local", "continuous", "calculated", None, i) for i in range(1, states + 1)]
    reals += [(f"u{i}", 20 + i, "input", of_input, None, "0", None) for i in range(1, inputs + 1)]
    reals += [(f"y{i}", 30 + i, "output", "continuous", "calculated", None, None) for i in range(1, outputs + 1)]
    reals.append(("which", 41, "parameter", "fixed", "exact", "0", None))
    text = (_describe2 if fmi == 2 else _describe3)(reals, attributes, dependencies or {})
    for before, after in description:
        assert before in text, before
        text = text.replace(before, after)
    return small_fmu(folder, prefix, source, text, name=name)


def _unknowns(reals, dependencies, tag_of):
    index = {name: k for k, (name, *_) in enumerate(reals, 1)}
    reference = {name: number for name, number, *_ in reals}
    made = {"y": [], "d": []}
    for name, *_ in reals:
        if reference[name] // 10 not in (1, 3):
            continue
        key = f"d{name[4:-1]}" if name[0] == "d" else name
        stated = dependencies.get(key)
        of = index if tag_of == 2 else reference
        more = "" if stated is None else f' dependencies="{" ".join(str(of[n]) for n in stated.split())}"'
        where = f'index="{index[name]}"' if tag_of == 2 else f'valueReference="{reference[name]}"'
        tag = "Unknown" if tag_of == 2 else "Output" if name[0] == "y" else "ContinuousStateDerivative"
        made[name[0]].append(f"<{tag} {where}{more}/>")
    return "".join(made["y"]), "".join(made["d"])


def _describe3(reals, attributes, dependencies):
    rows = []
    for name, reference, causality, variability, initial, start, derivative in reals:
        more = f' initial="{initial}"' * bool(initial) + f' start="{start}"' * (start is not None)
        more += f' derivative="{derivative}"' * bool(derivative)
        rows.append(
            f'<Float64 name="{name}" valueReference="{reference}" causality="{causality}" variability="{variability}"'
            f"{more}/>"
        )
    outputs, rates = _unknowns(reals, dependencies, 3)
    return (
        '<ModelExchange modelIdentifier="small"/>'
        f'<CoSimulation modelIdentifier="small"{attributes}/>'
        '<ModelVariables><Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>'
        f"{''.join(rows)}</ModelVariables><ModelStructure>{outputs}{rates}</ModelStructure>"
    )


def _describe2(reals, attributes, dependencies):
    rows = []
    index = {reference: k for k, (_, reference, *_) in enumerate(reals, 1)}
    for name, reference, causality, variability, initial, start, derivative in reals:
        more = f' start="{start}"' * (start is not None) + f' derivative="{index.get(derivative)}"' * bool(derivative)
        rows.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
            f'variability="{variability}"'
            + f' initial="{initial}"' * bool(initial)
            + f"><Real{more}/></ScalarVariable>"
        )
    outputs, rates = _unknowns(reals, dependencies, 2)
    return (
        '<ModelExchange modelIdentifier="small"/>'
        f'<CoSimulation modelIdentifier="small"{attributes}/>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs>"
        f"<Derivatives>{rates}</Derivatives></ModelStructure>"
    )
