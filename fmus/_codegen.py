"""From a model to C: CasADi writes the equations, this module the tables around them.

The generated ``model.c`` is the only file to compile: it includes the runtime (``runtime/``), so that the equations are
inlined into the integrator.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any, Literal

import casadi as ca

from ..blocks._errors import DefinitionError
from ..blocks._units import rate_of
from ._spec import ModelSpec, Variable

Kind = Literal["time", "fixed", "tunable", "input", "state", "derivative", "output"]
RUNTIME = {3: ("model.h", "core.c", "fmi3.c", "fmi3_refused.c"), 2: ("model.h", "core.c", "fmi2.c", "fmi2_refused.c")}
_ORDER = {3: "FMI 3.0, 2.3 and 4.2", 2: "FMI 2.0, 2.1.6 and 4.2.4"}

# Longest function that is expanded: beyond, calls of shared functions keep the code small (compile time grows faster).
_SCALAR_LIMIT = 20_000
_STEP_DESCRIPTION = (
    "Longest step of the internal integrator (explicit Runge-Kutta, order 4); a communication step h takes "
    "ceil(h / internal_step) equal substeps, at least one"
)


@dataclass(frozen=True, eq=False)
class Entry:
    """A variable as the FMU has it: its value reference is an index into the table of variables.

    Parameters
    ----------
    reference : int
        Value reference.
    kind : str
        Which of time, fixed, tunable, input, state, derivative, output it is.
    variable : Variable
        What is known of it; of time and of derivatives only name, unit, shape and description count.
    name : str
        Its name in the FMU: ``der(x)`` for the derivative of ``x``.
    first : int
        Index of its first element in the values of an instance.
    of : int, optional
        Of a derivative: reference of its state.
    """

    reference: int
    kind: Kind
    variable: Variable
    name: str
    first: int
    of: int | None = None

    @property
    def is_output(self) -> bool:
        """Whether it is an output, computed or a state."""
        return self.variable.causality == "output" and self.kind in ("state", "output")

    @property
    def last(self) -> int:
        """One past the index of its last element."""
        return self.first + self.variable.size


def _rate(state: Variable) -> Variable:
    unit = None if state.unit is None else rate_of(state.unit)
    return Variable("der", shape=state.shape, unit=unit, description=f"Time derivative of {state.name}")


def _internal_step(spec: ModelSpec) -> Variable:
    return Variable(
        "step", "parameter", "fixed", description=_STEP_DESCRIPTION, start=spec.internal_step, unit="s", minimum=0.0
    )


def layout(spec: ModelSpec) -> tuple[Entry, ...]:
    """Give every variable its value reference and its place among the values, in the order of ``model.h``."""
    time = Variable("t", unit="s", description="Simulation time")
    rows: list[tuple[Kind, Variable, str]] = [("time", time, "time")]
    rows += [("tunable" if v.variability == "tunable" else "fixed", v, v.name) for v in spec.parameters]
    rows += [("input", v, v.name) for v in spec.inputs]
    rows += [("state", v, v.name) for v in spec.states]
    rows += [("derivative", _rate(v), f"der({v.name})") for v in spec.states]
    rows += [("output", v, v.name) for v in spec.outputs]
    rows += [("fixed", _internal_step(spec), "internal_step")]
    entries: list[Entry] = []
    first = 0
    for reference, (kind, variable, name) in enumerate(rows):
        of = reference - len(spec.states) if kind == "derivative" else None
        entries.append(Entry(reference, kind, variable, name, first, of))
        first += variable.size
    return tuple(entries)


def scalar(f: ca.Function) -> ca.Function:
    """Expand ``f`` to scalar operations (three times as fast in C) where that is possible and not too long."""
    if f.is_a("SXFunction"):
        return f
    try:
        expanded = f.expand()
    except RuntimeError:  # interpolation tables and the like have no scalar expansion
        return f
    return expanded if expanded.n_instructions() <= _SCALAR_LIMIT else f


def symbolic(spec: ModelSpec) -> tuple[Any, Any, Any]:
    """All knowns (time, parameters, inputs, states) as one column, and derivatives and outputs of them, inlined.

    SX where both functions have a scalar expansion, else MX.
    """
    sizes = [1, *(sum(v.size for v in group) for group in (spec.parameters, spec.inputs, spec.states))]
    f, g = scalar(spec.derivative), scalar(spec.output)
    sx = f.is_a("SXFunction") and g.is_a("SXFunction")
    knowns = (ca.SX if sx else ca.MX).sym("knowns", sum(sizes))
    t, p, u, x = ca.vertsplit(knowns, [0, *(sum(sizes[: i + 1]) for i in range(4))])
    return knowns, _call(f, (t, x, u, p)), _call(g, (t, x, u, p))


def _call(f: ca.Function, args: Sequence[Any]) -> Any:
    shaped = [a if a.shape == f.size_in(i) else ca.reshape(a, *f.size_in(i)) for i, a in enumerate(args)]
    out = f.call(shaped, True, False)[0]
    return ca.densify(ca.reshape(out, f.numel_out(0), 1))


def _plain(name: str, f: ca.Function) -> ca.Function:
    """Write ``f`` under our own name, with a dense output (generated code leaves structural zeros unwritten)."""
    f = scalar(f)
    args = f.sx_in() if f.is_a("SXFunction") else f.mx_in()
    return ca.Function(name, args, [_call(f, args)])


def _equations(spec: ModelSpec) -> tuple[list[ca.Function], bool]:
    """All functions to generate, and whether derivatives are among them."""
    functions = [_plain("lw_derivative", spec.derivative), _plain("lw_output", spec.output)]
    try:
        knowns, dx, y = symbolic(spec)
        unknowns = ca.vertcat(dx, y)
        seed, adjoint = knowns.sym("seed", knowns.numel()), knowns.sym("adjoint", unknowns.numel())
        forward = ca.densify(ca.jtimes(unknowns, knowns, seed))
        reverse = ca.densify(ca.jtimes(unknowns, knowns, adjoint, True))
        functions += [
            ca.Function("lw_forward", [knowns, seed], [forward]),
            ca.Function("lw_reverse", [knowns, adjoint], [reverse]),
        ]
    except (RuntimeError, NotImplementedError):  # an operation that CasADi can't differentiate
        return functions[:2], False
    return functions, True


def _number(value: float | None, missing: str) -> str:
    return missing if value is None else repr(float(value))


def _table(entries: Iterable[Entry]) -> str:
    rows = []
    for e in entries:
        low, high = _number(e.variable.minimum, "-INFINITY"), _number(e.variable.maximum, "INFINITY")
        output = "true" if e.is_output else "false"
        rows.append(f'    {{"{e.name}", LW_{e.kind.upper()}, {output}, {e.first}, {e.variable.size}, {low}, {high}}},')
    return "static const lw_variable lw_variables[LW_N_VARIABLES] = {\n" + "\n".join(rows) + "\n};\n"


def _starts(entries: Iterable[Entry]) -> str:
    values = [v for e in entries for v in (e.variable.flat_start or [0.0] * e.variable.size)]
    lines = [", ".join(map(repr, values[i : i + 8])) for i in range(0, len(values), 8)]
    return "static const double lw_start_values[] = {\n    " + ",\n    ".join(lines) + "\n};\n"


def _dimensions(
    spec: ModelSpec, token: str, functions: Sequence[ca.Function], derivatives: bool, n: int, fmi: int
) -> str:
    groups = {"P": spec.parameters, "U": spec.inputs, "X": spec.states, "Y": spec.outputs}
    lines = [f'#define LW_MODEL_NAME "{spec.name}"', f'#define LW_TOKEN "{token}"']
    lines += [f'#define LW_API "fmi{fmi}"', f'#define LW_ORDER "{_ORDER[fmi]}"']
    lines += [f"#define LW_N_{letter} {sum(v.size for v in group)}" for letter, group in groups.items()]
    lines += [f"#define LW_N_VARIABLES {n}", f"#define LW_HAS_DERIVATIVES {int(derivatives)}"]
    for what in ("arg", "res", "iw", "w"):
        lines.append(f"#define LW_SZ_{what.upper()} {max(getattr(f, f'sz_{what}')() for f in functions)}")
    return "\n".join(lines) + "\n"


def _generated(functions: Sequence[ca.Function]) -> str:
    generator = ca.CodeGenerator("eq.c", {"with_export": False, "casadi_int": "long long int"})
    for f in functions:
        generator.add(f)
    text: str = generator.dump()
    if missing := re.search(r"CASADI_MEM|_alloc_mem\(", text):
        raise DefinitionError(
            f"the equations need memory of their own ({missing[0]}), as solvers and external functions do. "
            "Write them without."
        )
    return text


def generate(spec: ModelSpec, token: str, fmi: int = 3) -> tuple[str, bool]:
    """Write ``model.c``.

    Parameters
    ----------
    spec : ModelSpec
        The model.
    token : str
        Its instantiation token (FMI 3.0, 2.3.1).
    fmi : {3, 2}
        Version whose functions it has.

    Returns
    -------
    text : str
        The C text; it includes the files of `runtime`.
    derivatives : bool
        Whether it has directional and adjoint derivatives.
    """
    entries = layout(spec)
    functions, derivatives = _equations(spec)
    parts = [
        "/* Generated by Loopwright. */\n",
        _dimensions(spec, token, functions, derivatives, len(entries), fmi),
        '#include "model.h"\n',
        "/* The equations, written by CasADi. */\n" + _generated(functions),
        "#include <math.h>\n",
        _table(entries),
        _starts(entries),
        "".join(f'#include "{name}"\n' for name in RUNTIME[fmi] if name.endswith(".c")),
    ]
    return "\n".join(parts), derivatives


@lru_cache(maxsize=2)
def runtime(fmi: int = 3) -> dict[str, str]:
    """Read the files of the C runtime for a version of FMI."""
    folder = resources.files(__package__) / "runtime"
    return {name: (folder / name).read_text(encoding="utf-8") for name in RUNTIME[fmi]}
