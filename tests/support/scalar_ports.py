"""A small FMU of FMI 2.0 in C whose ports are scalars with names of their own: two tanks that fill and leak.

    ẋ_i = −k x_i + u_i,  k = 2 1/s, so that with a held u_i: x_i = u_i/k + (x_i(0) − u_i/k) e^(−k t)

The outputs are the levels ``low`` and ``high``, and ``sum_of``, both together. A step is exact. It has model exchange,
too, where states and derivatives are ``low``, ``high`` and ``der(low)``, ``der(high)``.
"""

import numpy as np

from support.small_fmus import small_fmu, values

RATE = 2.0
SOURCE = """
typedef struct { double t, u[2], x[2]; } instance;
typedef struct { int again, end, nominals, states, has; double next; } info;
void *fmi2Instantiate() { instance *c = calloc(1, sizeof(instance)); c->x[0] = 0.5; c->x[1] = 0.25; return c; }
int fmi2Reset(void *p) { instance *c = p; memset(c, 0, sizeof *c); c->x[0] = 0.5; c->x[1] = 0.25; return 0; }
int fmi2DoStep(void *p, double t, double h, int f) { instance *c = p;
    for (int i = 0; i < 2; i++) { double e = c->u[i] / 2.0; c->x[i] = e + (c->x[i] - e) * exp(-2.0 * h); }
    return 0; }
int fmi2EnterEventMode(void *p) { return 0; }
int fmi2EnterContinuousTimeMode(void *p) { return 0; }
int fmi2SetTime(void *p, double t) { return 0; }
int fmi2NewDiscreteStates(void *p, info *i) { memset(i, 0, sizeof *i); return 0; }
int fmi2CompletedIntegratorStep(void *p, int final, int *event, int *end) { *event = *end = 0; return 0; }
int fmi2SetContinuousStates(void *p, const double x[], size_t n) { instance *c = p; c->x[0] = x[0]; c->x[1] = x[1]; return 0; }
int fmi2GetContinuousStates(void *p, double x[], size_t n) { instance *c = p; x[0] = c->x[0]; x[1] = c->x[1]; return 0; }
int fmi2GetNominalsOfContinuousStates(void *p, double x[], size_t n) { x[0] = x[1] = 1.0; return 0; }
int fmi2GetEventIndicators(void *p, double z[], size_t n) { return 0; }
static double rate(instance *c, int i) { return -2.0 * c->x[i] + c->u[i]; }
int fmi2GetDerivatives(void *p, double dx[], size_t n) { dx[0] = rate(p, 0); dx[1] = rate(p, 1); return 0; }
"""
READ = {
    1: "c->u[0]",
    2: "c->u[1]",
    3: "c->x[0]",
    4: "c->x[1]",
    5: "c->x[0] + c->x[1]",
    6: "rate(c, 0)",
    7: "rate(c, 1)",
}
RENAME = {"inflow": "flow[1]", "pump": "flow[2]", "low": "level[1]", "high": "level[2]"}
"""FMU's names → elements of two ports."""
ROWS = {
    "inflow": (1, 'causality="input"', '<Real unit="m3/s" start="0"/>'),
    "pump": (2, 'causality="input"', '<Real unit="m3/s" start="0"/>'),
    "low": (3, 'causality="output" initial="exact"', '<Real unit="m3" start="0.5" min="-9"/>'),
    "high": (4, 'causality="output" initial="exact"', '<Real unit="m3" start="0.25" max="9"/>'),
    "sum_of": (5, 'causality="output"', '<Real unit="m3"/>'),
    "der(low)": (6, "", '<Real derivative="3"/>'),
    "der(high)": (7, "", '<Real derivative="4"/>'),
}


def scalar_ports(folder, **rows):
    """Build the FMU, with other causalities and types of some of its variables by name."""
    variables = "".join(
        f'<ScalarVariable name="{name}" valueReference="{k}" {rows.get(name, (causality, inner))[0]}>'
        f"{rows.get(name, (causality, inner))[1]}</ScalarVariable>"
        for name, (k, causality, inner) in ROWS.items()
    )
    text = (
        '<ModelExchange modelIdentifier="small"/>'
        '<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><UnitDefinitions>'
        '<Unit name="m3"><BaseUnit m="3"/></Unit><Unit name="m3/s"><BaseUnit m="3" s="-1"/></Unit></UnitDefinitions>'
        f"<ModelVariables>{variables}</ModelVariables><ModelStructure><Outputs>"
        '<Unknown index="3" dependencies="3"/><Unknown index="4" dependencies="4"/><Unknown index="5" dependencies="3 4"/>'
        '</Outputs><Derivatives><Unknown index="6" dependencies="1 3"/><Unknown index="7" dependencies="2 4"/>'
        "</Derivatives></ModelStructure>"
    )
    source = SOURCE + "".join(
        values("fmi2", verb, suffix, type_, {k: e for k, e in READ.items() if verb == "Get" or k < 5})
        for verb in ("Get", "Set")
        for suffix, type_ in (("Real", "double"), ("Integer", "int"))
    )
    return small_fmu(folder, "fmi2", source, text)


def levels(t, flow, start=(0.5, 0.25)):
    """Return the levels (n, 2) at times t with held flows."""
    end = np.asarray(flow) / RATE
    return end + (np.asarray(start) - end) * np.exp(-RATE * np.asarray(t))[:, None]
