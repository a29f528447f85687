"""The gantry of Table II as an FMU in C, of FMI 1.0 or 2.0, whose ports are scalars with names of their own.

The equations are written out in C and know nothing of Loopwright; a step is the classical Runge-Kutta step of the
plant's own build, 0.2 ms. Lengths are in m or in mm; forces are in N.
"""

from support.small_fmus import small_fmu, values

_SOURCE = """
typedef struct { double t, u[2], f[2], s[2], v[2], w; int ready; } instance;
static const double M[2] = {36.87, 21.20}, C[2] = {65.42, 37.69}, D[2] = {175.93, 62.83}, G[2] = {0.0, 9.81 * 4.41};
static double rate(instance *c, int i, double v) {
    return (c->u[i] + c->f[i] - C[i] * tanh(v / (c->w / UNIT)) - D[i] * v - G[i]) / M[i]; }
static instance *made(void) { instance *c = calloc(1, sizeof(instance)); c->w = 0.01 * UNIT;
    c->s[0] = 0.8 * UNIT; c->s[1] = 0.5 * UNIT; return c; }
static int advance(instance *c, double h) {
    int n = (int)floor(5000.0 * h + 0.5); if (n < 1) n = 1;
    double d = h / n;
    for (int i = 0; i < 2; i++) {
        double s = c->s[i] / UNIT, v = c->v[i] / UNIT;
        for (int k = 0; k < n; k++) {
            double a1 = rate(c, i, v), v2 = v + d / 2 * a1, a2 = rate(c, i, v2), v3 = v + d / 2 * a2;
            double a3 = rate(c, i, v3), v4 = v + d * a3, a4 = rate(c, i, v4);
            s += d / 6 * (v + 2 * v2 + 2 * v3 + v4); v += d / 6 * (a1 + 2 * a2 + 2 * a3 + a4);
        }
        c->s[i] = s * UNIT; c->v[i] = v * UNIT;
    }
    return 0;
}
"""
_STEPS = {
    "fmi2": """
void *fmi2Instantiate() { return made(); }
int fmi2DoStep(void *p, double t, double h, int f) { return advance(p, h); }
""",
    "fmi1": """
void *fmi1InstantiateSlave() { return made(); }
int fmi1DoStep(void *p, double t, double h, char f) { return advance(p, h); }
""",
}
NAMES = {
    "u": ("F_my", "F_mz"),
    "f": ("F_ey", "F_ez"),
    "s": ("s_Y", "s_Z"),
    "v": ("v_Y", "v_Z"),
    "a": ("a_Y", "a_Z"),
}
PORTS = {"u": "motor_force", "f": "external_force", "s": "position", "v": "velocity", "a": "acceleration"}
RENAME = {name: f"{PORTS[k]}[{i + 1}]" for k, pair in NAMES.items() for i, name in enumerate(pair)}
"""FMU's names → elements of the ports of Fig. 3."""
_UNITS = {
    "N": 'kg="1" m="1" s="-2"',
    "m": 'm="1"',
    "m/s": 'm="1" s="-1"',
    "m/s2": 'm="1" s="-2"',
    "mm": 'm="1" factor="0.001"',
    "mm/s": 'm="1" s="-1" factor="0.001"',
    "mm/s2": 'm="1" s="-2" factor="0.001"',
}


def scalar_gantry(folder, prefix="fmi2", *, length="m", names=None, name="gantry", units=None):
    """Build the FMU, and return its path.

    ``names`` are other names of its variables by those of `NAMES`, ``units`` other units by name.
    """
    names, units = names or {}, units or {}
    expressions, rows = {}, []
    unit_of = {"u": "N", "f": "N", "s": length, "v": f"{length}/s", "a": f"{length}/s2"}
    for j, (key, pair) in enumerate(NAMES.items()):
        for i, own in enumerate(pair):
            reference = 2 * j + i
            expressions[reference] = f"rate(c, {i}, c->v[{i}] / UNIT) * UNIT" if key == "a" else f"c->{key}[{i}]"
            side = "input" if key in "uf" else "output"
            start = {"u": "0", "f": "0", "s": ("0.8", "0.5")[i], "v": "0"}.get(key)
            scale = 1000.0 if length == "mm" else 1.0
            start = "" if start is None else f' start="{float(start) * scale!r}"'
            initial = ' initial="exact"' if key in "sv" and prefix == "fmi2" else ""
            rows.append(
                f'<ScalarVariable name="{names.get(own, own)}" valueReference="{reference}" causality="{side}"{initial}>'
                f'<Real unit="{units.get(own, unit_of[key])}"{start}/></ScalarVariable>'
            )
    fixed = 'causality="parameter" variability="fixed"' if prefix == "fmi2" else 'variability="parameter"'
    rows.append(
        f'<ScalarVariable name="friction_width" valueReference="20" {fixed}><Real unit="{length}/s" '
        f'start="{0.01 * (1000.0 if length == "mm" else 1.0)!r}"/></ScalarVariable>'
    )
    settable = {k: e for k, e in expressions.items() if k < 8} | {20: "c->w"}
    source = (
        _SOURCE
        + _STEPS[prefix]
        + values(prefix, "Get", "Real", "double", expressions | {20: "c->w"})
        + values(prefix, "Set", "Real", "double", settable)
    ).replace("UNIT", "1000.0" if length == "mm" else "1.0")
    if prefix == "fmi2":
        defined = "".join(f'<Unit name="{u}"><BaseUnit {base}/></Unit>' for u, base in _UNITS.items())
        outputs = "".join(f'<Unknown index="{k}"/>' for k in range(5, 11))
        text = (
            f'<CoSimulation modelIdentifier="{name}" canHandleVariableCommunicationStepSize="true"/>'
            f"<UnitDefinitions>{defined}</UnitDefinitions><ModelVariables>{''.join(rows)}</ModelVariables>"
            f"<ModelStructure><Outputs>{outputs}</Outputs></ModelStructure>"
        )
    else:
        defined = "".join(f'<BaseUnit unit="{u}"/>' for u in _UNITS)
        text = (
            f"<UnitDefinitions>{defined}</UnitDefinitions><ModelVariables>{''.join(rows)}</ModelVariables>"
            '<Implementation><CoSimulation_StandAlone><Capabilities canHandleVariableCommunicationStepSize="true"/>'
            "</CoSimulation_StandAlone></Implementation>"
        )
    return small_fmu(folder, prefix, source, text, name=name)
