"""FMUs in model exchange that compute when they are asked, and not always all that they are asked for.

They keep the derivatives and outputs that they computed last, and a flag that says whether a setter was called since.

- ``"equations"``: the getter of the derivatives computes these alone, and clears the flag, so that outputs that are read
  after it are those of an earlier point. The getter of values computes everything, if the flag says so.
- ``"comparing"``: the same, and a setter raises the flag only where it changes a value.
- ``"derivatives"``: the getter of the derivatives computes everything; that of values computes nothing.
"""

from .closed_form import closed_form_fmu

_FIELDS = ("int step, which; } instance;", "int step, which, dirty; number d[9], y[9]; } instance;")
_MADE = "{ return calloc(1, sizeof(instance)); }"
_FRESH = "{ instance *c = calloc(1, sizeof(instance)); c->dirty = 1; return c; }"
_RATES = (
    "instance *c = p; number d[9] = {0}, y[9] = {0}; find(c, c->x, d, y);\n    for (size_t i = 0; i < n; i++) dx[i] = d[i];",
    "instance *c = p; number *d = c->d; settle(c, {});\n    for (size_t i = 0; i < n; i++) dx[i] = d[i];",
)
_GET = (
    "instance *c = p; number d[9] = {0}, y[9] = {0}; find(c, c->x, d, y);\n    for (size_t i = 0; i < n; i++) {",
    "instance *c = p; number *d = c->d, *y = c->y; {}\n    for (size_t i = 0; i < n; i++) {",
)
_SETTLE = """static void settle(instance *c, bool all) {
    number y[9] = {0};
    if (c->dirty) find(c, c->x, c->d, all ? c->y : y);
    c->dirty = 0; }
"""
_NOTED = """static void note(instance *c, number *at, double v) { if (ALWAYS || *at != v) c->dirty = 1; *at = v; }
"""


def lazy_fmu(folder, fmi, kind, equations, *, source=(), **options):
    """Build one of a kind into a folder; ``source`` changes the code, the rest is for `closed_form_fmu`."""
    first, last = _SETTLE, "settle(c, true);"
    whole = "false"
    if kind == "derivatives":
        whole, last = "true", ""
    noted = _NOTED.replace("ALWAYS", "0" if kind == "comparing" else "1")
    changes = [
        _FIELDS,
        (_MADE, _FRESH),
        (_RATES[0], _RATES[1].replace("{}", whole)),
        (_GET[0], _GET[1].replace("{}", last)),
        ("int NAME(EnterEventMode)", f"{first}{noted}int NAME(EnterEventMode)"),
        ("((instance *)p)->t = t; return 0; }", "note(p, &((instance *)p)->t, t); return 0; }"),
        ("c->x[i] = (number)x[i];", "note(c, &c->x[i], x[i]);"),
        (
            "(r[i] < 10 ? c->x : c->u)[r[i] % 10 - 1] = (number)v[i];",
            "note(c, &(r[i] < 10 ? c->x : c->u)[r[i] % 10 - 1], v[i]);",
        ),
        *source,
    ]
    return closed_form_fmu(folder, fmi, equations, changes=changes, **options)
