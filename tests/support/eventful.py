"""A strict FMU in model exchange with every kind of event, in C: it refuses calls that its mode does not allow.

    ẋ = u + k            u: continuous input, k: number of time events, one every 0.25 s
    m = n                n: discrete input (integer), which m takes over in Event Mode alone
    x⁺ = 0               after a step that ends with x > 1 (step event, if ``armed`` is set)

Its next time event, the number of events and the number of accepted steps are outputs. It asks for the end of the run
at the time event number ``last``, if that is not 0.
"""

import re

import numpy as np

from .small_fmus import small_fmu

_SOURCE = r"""
typedef struct { double t, x, u, nominal, last_event; int n, m, k, events, steps, armed, last, mode, wants; } instance;
enum { START, INIT, EVENT, CONTINUOUS };
#define MODE(...) { int ok = 0, may[] = {__VA_ARGS__}; \
    for (size_t i = 0; i < sizeof may / sizeof *may; i++) ok |= c->mode == may[i]; if (!ok) return 3; }
#if FMI == 3
#define SIZE , size_t size
typedef bool boolean;
void *fmi3InstantiateModelExchange() { instance *c = calloc(1, sizeof(instance)); c->nominal = 1.0; return c; }
#else
#define SIZE
typedef int boolean;
void *fmi2Instantiate() { instance *c = calloc(1, sizeof(instance)); c->nominal = 1.0; return c; }
#endif
int NAME(EnterInitializationMode)(void *p) { instance *c = p; MODE(START); c->mode = INIT; return 0; }
int NAME(ExitInitializationMode)(void *p) { instance *c = p; MODE(INIT); c->mode = EVENT; return 0; }
int NAME(EnterEventMode)(void *p) { instance *c = p; MODE(CONTINUOUS); c->mode = EVENT; return 0; }
int NAME(EnterContinuousTimeMode)(void *p) { instance *c = p; MODE(EVENT); c->mode = CONTINUOUS; return 0; }
int NAME(SetTime)(void *p, double t) {
    instance *c = p; MODE(EVENT, CONTINUOUS);
    if (t < c->last_event) return 3;
    c->t = t; return 0; }
int NAME(SetContinuousStates)(void *p, const double x[], size_t n) {
    instance *c = p; MODE(CONTINUOUS); c->x = x[0]; return 0; }
int NAME(GetContinuousStates)(void *p, double x[], size_t n) { instance *c = p; x[0] = c->x; return 0; }
int NAME(GetNominalsOfContinuousStates)(void *p, double x[], size_t n) {
    instance *c = p; MODE(EVENT, CONTINUOUS); x[0] = c->nominal; return 0; }
int NAME(RATES)(void *p, double dx[], size_t n) {
    instance *c = p; MODE(EVENT, CONTINUOUS); dx[0] = c->u + c->k; return 0; }
int NAME(CompletedIntegratorStep)(void *p, boolean final, boolean *event, boolean *end) {
    instance *c = p; MODE(CONTINUOUS);
    c->steps++; c->wants = c->armed && c->x > 1.0;
    *event = c->wants; *end = false; return 0; }
static int update(instance *c, boolean *end, boolean *nominals, boolean *states, double *next) {
    *nominals = *states = *end = false;
    c->events++; c->m = c->n; c->last_event = c->t;
    while (c->t >= 0.25 * (c->k + 1)) c->k++;
    if (c->wants) { c->x = 0.0; c->nominal = 5.0; c->wants = 0; *states = *nominals = true; }
    *end = c->last && c->k >= c->last; *next = 0.25 * (c->k + 1);
    return 0; }
#if FMI == 3
int fmi3UpdateDiscreteStates(void *p, bool *again, bool *end, bool *nominals, bool *states, bool *has, double *next) {
    instance *c = p; MODE(EVENT); *again = false; *has = true; return update(c, end, nominals, states, next); }
#else
typedef struct { int again, end, nominals, states, has; double next; } info;
int fmi2NewDiscreteStates(void *p, info *i) {
    instance *c = p; MODE(EVENT); i->again = 0; i->has = 1;
    return update(c, &i->end, &i->nominals, &i->states, &i->next); }
#endif
int NAME(REAL_GET)(void *p, const unsigned r[], size_t n, double v[] SIZE) {
    instance *c = p;
    for (size_t i = 0; i < n; i++) v[i] = r[i] == 1 ? c->x : r[i] == 2 ? c->u + c->k : r[i] == 3 ? c->u : c->t;
    return 0; }
int NAME(REAL_SET)(void *p, const unsigned r[], size_t n, const double v[] SIZE) {
    instance *c = p;
    for (size_t i = 0; i < n; i++) {
        if (r[i] == 3) { c->u = v[i]; continue; }
        MODE(START, INIT);
        if (r[i] == 1) c->x = v[i]; }
    return 0; }
int NAME(INT_GET)(void *p, const unsigned r[], size_t n, int v[] SIZE) {
    instance *c = p; int of[] = {c->n, c->m, c->k, c->events, c->steps, c->armed, c->last};
    for (size_t i = 0; i < n; i++) v[i] = of[r[i] - 10];
    return 0; }
int NAME(INT_SET)(void *p, const unsigned r[], size_t n, const int v[] SIZE) {
    instance *c = p;
    for (size_t i = 0; i < n; i++) {
        if (r[i] == 10) { MODE(START, INIT, EVENT); c->n = v[i]; continue; }
        MODE(START, INIT);
        if (r[i] == 15) c->armed = v[i];
        if (r[i] == 16) c->last = v[i]; }
    return 0; }
"""
_REALS = (  # name, reference, causality, variability, initial, start, derivative of
    ("x", 1, "output", "continuous", "exact", "0", None),
    ("der(x)", 2, "local", "continuous", "calculated", None, 1),
    ("u", 3, "input", "continuous", None, "0", None),
)
_INTEGERS = (
    ("n", 10, "input", "discrete", None, "0"),
    ("m", 11, "output", "discrete", "calculated", None),
    ("k", 12, "output", "discrete", "calculated", None),
    ("events", 13, "output", "discrete", "calculated", None),
    ("steps", 14, "output", "discrete", "calculated", None),
    ("armed", 15, "parameter", "fixed", "exact", "0"),
    ("last", 16, "parameter", "fixed", "exact", "0"),
)


def exact(t, u):
    """Its x from 0 at times in s under a constant input, without events of steps."""
    k = np.floor(4.0 * t)
    return u * t + 0.25 * k * (k - 1) / 2 + k * (t - 0.25 * k)


def eventful_fmu(folder, fmi, *, fault="", following="0.25 * (c->k + 1)", largest=None, changes=()):
    """Build it into a folder, for a version of FMI, and return its path.

    ``fault`` is a statement in C ahead of the computation of the derivatives, such as ``if (c->t > 0.3) return 3;``.
    ``following`` is the time of its next time event, in C; ``largest`` the maximum of the input u. ``changes`` are
    further pairs of texts to be replaced in the source.
    """
    prefix = f"fmi{fmi}"
    names = {
        "RATES": "GetDerivatives" if fmi == 2 else "GetContinuousStateDerivatives",
        **{f"REAL_{v.upper()}": f"{v}{'Real' if fmi == 2 else 'Float64'}" for v in ("Get", "Set")},
        **{f"INT_{v.upper()}": f"{v}{'Integer' if fmi == 2 else 'Int32'}" for v in ("Get", "Set")},
    }
    head = f"#define FMI {fmi}\n#define PASTE(a, b) a##b\n#define NAME(end) PASTE({prefix}, end)\n"
    source = head + _SOURCE.replace("dx[0] = c->u", f"{fault} dx[0] = c->u")
    source = source.replace("*next = 0.25 * (c->k + 1)", f"*next = {following}")
    for before, after in changes:
        assert before in source
        source = source.replace(before, after)
    for key, end in names.items():
        source = source.replace(f"NAME({key})", f"{prefix}{end}")
    for end in ("EnterInitializationMode", "ExitInitializationMode"):  # small_fmu looks for the whole names
        source = source.replace(f"NAME({end})", f"{prefix}{end}")
    description = _describe2() if fmi == 2 else _describe3()
    if largest is not None:
        description, found = re.subn(r'(name="u"[^/]*?start="0")', rf'\1 max="{largest}"', description)
        assert found == 1
    return small_fmu(folder, prefix, source, description, name="eventful")


def _attributes(**given):
    return "".join(f' {key}="{value}"' for key, value in given.items() if value is not None)


def _describe2():
    places = {row[1]: i + 1 for i, row in enumerate((*_REALS, *_INTEGERS))}
    text = ""
    for kind, rows in (("Real", _REALS), ("Integer", _INTEGERS)):
        for name, reference, causality, variability, initial, start, *of in rows:
            inner = _attributes(start=start, derivative=places[of[0]] if of and of[0] else None)
            head = _attributes(
                name=name, valueReference=reference, causality=causality, variability=variability, initial=initial
            )
            text += f"<ScalarVariable{head}><{kind}{inner}/></ScalarVariable>"
    outputs = "".join(
        f'<Unknown index="{places[r[1]]}" dependencies="{places[1] if r[1] == 1 else ""}"/>'
        for r in (*_REALS, *_INTEGERS)
        if r[2] == "output"
    )
    rates = f'<Unknown index="{places[2]}" dependencies="{places[3]}"/>'
    return (
        '<ModelExchange modelIdentifier="eventful"/>'
        f"<ModelVariables>{text}</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs>"
        f"<Derivatives>{rates}</Derivatives></ModelStructure>"
    )


def _describe3():
    text = '<Float64 name="time" valueReference="4" causality="independent" variability="continuous"/>'
    for kind, rows in (("Float64", _REALS), ("Int32", _INTEGERS)):
        for name, reference, causality, variability, initial, start, *of in rows:
            head = _attributes(
                name=name,
                valueReference=reference,
                causality=causality,
                variability=variability,
                initial=initial,
                start=start,
                derivative=of[0] if of else None,
            )
            text += f"<{kind}{head}/>"
    outputs = "".join(
        f'<Output valueReference="{r[1]}" dependencies="{1 if r[1] == 1 else ""}"/>'
        for r in (*_REALS, *_INTEGERS)
        if r[2] == "output"
    )
    rates = '<ContinuousStateDerivative valueReference="2" dependencies="3"/>'
    return (
        '<ModelExchange modelIdentifier="eventful" needsCompletedIntegratorStep="true"/>'
        f"<ModelVariables>{text}</ModelVariables><ModelStructure>{outputs}{rates}</ModelStructure>"
    )
