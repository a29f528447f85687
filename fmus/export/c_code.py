"""C code of a model: CasADi writes the equations, this module the tables around them.

The generated ``model.c`` is the only file to compile: it includes the C sources of every FMU (``fmu_sources/``, and
the files of `loopwright.fmus.runtime` that runs of diagrams use, too), so that the compiler inlines the equations into
the integrator.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any

import casadi as ca

from ...blocks.core import DefinitionError
from ..runtime import read_sources
from .c_text import c_array
from .elementary_tables import prepare_functions, restore_functions
from .model_spec import DIRECTIONS, ModelSpec
from .variable_entries import Entry, layout

_SHARED = ("linear.c", "fixed_step.c", "embedded.c", "crossings.c")  # of loopwright.fmus.runtime
_COMMON = ("model.h", "elementary.c", "core.c", "integrators.c", "events.c", "stepping.c")
OF_FMI = {
    3: ("fmi_calls.c", "fmi3.c", "fmi3_events.c", "fmi3_refused.c"),
    2: ("fmi_calls.c", "fmi2.c", "fmi2_refused.c"),
}
"""Files with FMI's functions, by version."""
FILES = {fmi: (*_COMMON, *files) for fmi, files in OF_FMI.items()}
ORDER = {3: "FMI 3.0, 2.3, 3.2 and 4.2", 2: "FMI 2.0, 3.2.3 and 4.2.4"}

# Longest function that is expanded; beyond it, calls of shared functions keep the code small (compile time grows fast).
_SCALAR_LIMIT = 20_000
# Longest function of the rates that is inlined into every stage of the integrators; the compiler alone would call it.
_INLINE_LIMIT = 300
_INLINE = "static inline __attribute__((always_inline))"


def expand_scalar(f: ca.Function) -> ca.Function:
    """Expand ``f`` to scalar operations (three times as fast in C), if that is possible and not too long."""
    if f.is_a("SXFunction"):
        return f
    try:
        expanded = f.expand()
    except RuntimeError:  # interpolation tables, for example, have no scalar expansion
        return f
    return expanded if expanded.n_instructions() <= _SCALAR_LIMIT else f


def to_symbols(spec: ModelSpec) -> tuple[Any, Any]:
    """Return all knowns and all unknowns as columns: SX if all functions have a scalar expansion, else MX.

    Knowns are time, parameters, inputs, states; unknowns are derivatives, outputs, indicators.
    """
    sizes = [1, *(sum(v.size for v in group) for group in (spec.parameters, spec.inputs, spec.states))]
    functions = [expand_scalar(f) for f in (spec.derivative, spec.output, spec.indicators) if f is not None]
    sx = all(f.is_a("SXFunction") for f in functions)
    knowns = (ca.SX if sx else ca.MX).sym("knowns", sum(sizes))
    t, p, u, x = ca.vertsplit(knowns, [0, *(sum(sizes[: i + 1]) for i in range(4))])
    return knowns, ca.vertcat(*(_call(f, (t, x, u, p)) for f in functions))


def _call(f: ca.Function, args: Sequence[Any]) -> Any:
    shaped = [a if a.shape == f.size_in(i) else ca.reshape(a, *f.size_in(i)) for i, a in enumerate(args)]
    out = f.call(shaped, True, False)[0]
    return ca.densify(ca.reshape(out, f.numel_out(0), 1))


def _dense_function(name: str, f: ca.Function) -> ca.Function:
    """Return ``f`` by another name with a dense output, since generated code does not write structural zeros."""
    f = expand_scalar(f)
    args = f.sx_in() if f.is_a("SXFunction") else f.mx_in()
    return ca.Function(name, args, [_call(f, args)])


@dataclass(frozen=True, eq=False)
class _Functions:
    """Functions to generate, and the places of the Jacobian's nonzeros if there are derivatives."""

    functions: list[ca.Function]
    nonzeros: list[tuple[int, int]] | None = None


def _equations(spec: ModelSpec) -> _Functions:
    functions = [_dense_function("lw_derivative", spec.derivative), _dense_function("lw_output", spec.output)]
    if spec.indicators is not None and spec.jump is not None:
        functions += [_dense_function("lw_indicator", spec.indicators), _dense_function("lw_jump", spec.jump)]
    try:
        knowns, unknowns = to_symbols(spec)
        seed, adjoint = knowns.sym("seed", knowns.numel()), knowns.sym("adjoint", unknowns.numel())
        forward = ca.densify(ca.jtimes(unknowns, knowns, seed))
        reverse = ca.densify(ca.jtimes(unknowns, knowns, adjoint, True))
        linear, nonzeros = _linear_functions(spec)
        derived = [
            ca.Function("lw_forward", [knowns, seed], [forward]),
            ca.Function("lw_reverse", [knowns, adjoint], [reverse]),
            *linear,
        ]
    except (RuntimeError, NotImplementedError):  # an operation that CasADi can't differentiate
        if spec.integrator == "rodas":
            raise DefinitionError(
                "found equations without derivatives, which the integrator rodas needs. Choose rk4 or dopri5.",
                block=spec.name,
                port="integrator",
            ) from None
        return _Functions(functions)
    return _Functions(functions + derived, nonzeros)


def _linear_functions(spec: ModelSpec) -> tuple[list[ca.Function], list[tuple[int, int]]]:
    """Return functions of the Jacobian by continuous states and time and of the indicators' rates, and its nonzeros."""
    f = expand_scalar(spec.derivative)
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    t, x, u, p = (kind.sym(name, f.numel_in(i)) for i, name in enumerate("txup"))
    dx = _call(f, (t, x, u, p))
    n = dx.numel()
    jacobian = ca.jacobian(dx, x)[:, :n]
    slope = ca.densify(ca.jtimes(dx, t, kind.ones(1)))
    sparsity = jacobian.sparsity()
    nonzeros = list(zip(*sparsity.get_triplet(), strict=True)) if sparsity.nnz() else []
    functions = [ca.Function("lw_jacobian", [t, x, u, p], [jacobian, slope])]
    if spec.indicators is not None:
        f, g = expand_scalar(spec.derivative), expand_scalar(spec.indicators)
        kind = ca.SX if f.is_a("SXFunction") and g.is_a("SXFunction") else ca.MX
        t, x, u, p = (kind.sym(name, f.numel_in(i)) for i, name in enumerate("txup"))
        z = _call(g, (t, x, u, p))
        flow = ca.vertcat(kind.ones(1), _call(f, (t, x, u, p)), kind.zeros(x.numel() - n))
        rate = ca.jtimes(z, t, flow[0]) + (ca.jtimes(z, x, flow[1:]) if x.numel() else 0)
        functions.append(ca.Function("lw_crossing", [t, x, u, p], [ca.vertcat(z, ca.densify(rate))]))
    return functions, nonzeros


def _number(value: float | None, missing: str) -> str:
    return missing if value is None else repr(float(value))


def variable_table(entries: Iterable[Entry]) -> str:
    """Return the C table of variables, see ``fmu_sources/model.h``."""
    rows = []
    for e in entries:
        low, high = _number(e.variable.minimum, "-INFINITY"), _number(e.variable.maximum, "INFINITY")
        output = "true" if e.is_output else "false"
        discrete = "true" if e.kind == "input" and e.variable.variability == "discrete" else "false"
        about = f'"{e.name}", LW_{e.kind.upper()}, {output}, {discrete}, {e.first}, {e.variable.size}'
        rows.append(f"    {{{about}, {low}, {high}}},")
    return "static const lw_variable lw_variables[LW_N_VARIABLES] = {\n" + "\n".join(rows) + "\n};\n"


def start_table(entries: Iterable[Entry]) -> str:
    """Return the C table of start values."""
    values = [v for e in entries for v in (e.variable.flat_start or [0.0] * e.variable.size)]
    return c_array("double", "lw_start_values", map(repr, values))


def _tables(spec: ModelSpec, nonzeros: list[tuple[int, int]] | None) -> Iterable[str]:
    """Yield the C tables of nominal values of continuous states, of events, and of the Jacobian's nonzeros."""
    nominals = [1.0 if v.nominal is None else float(v.nominal) for v in spec.continuous for _ in range(v.size)]
    yield c_array("double", "lw_nominals", map(repr, nominals))
    if spec.events:
        rows = [f'{{"{e.name}", {DIRECTIONS[e.direction]}, {float(e.nominal)!r}}}' for e in spec.events]
        yield c_array("lw_event", "lw_events", rows)
    if nonzeros is not None:
        yield c_array("int", "lw_jacobian_rows", (row for row, _ in nonzeros))
        yield c_array("int", "lw_jacobian_columns", (column for _, column in nonzeros))


def _dimensions(spec: ModelSpec, token: str, equations: _Functions, n: int, fmi: int) -> str:
    groups = {"P": spec.parameters, "U": spec.inputs, "X": spec.continuous, "D": spec.discrete, "Y": spec.outputs}
    nonzeros = equations.nonzeros
    lines = [f'#define LW_MODEL_NAME "{spec.name}"', f'#define LW_TOKEN "{token}"']
    lines += [f'#define LW_API "fmi{fmi}"', f"#define LW_FMI {fmi}", f'#define LW_ORDER "{ORDER[fmi]}"']
    lines += [f"#define LW_N_{letter} {sum(v.size for v in group)}" for letter, group in groups.items()]
    lines += [f"#define LW_N_Z {len(spec.events)}", f"#define LW_N_J {len(nonzeros or ())}"]
    lines += [f"#define LW_N_VARIABLES {n}", f"#define LW_HAS_DERIVATIVES {int(nonzeros is not None)}"]
    for kind in ("arg", "res", "iw", "w"):
        lines.append(f"#define LW_SZ_{kind.upper()} {max(getattr(f, f'sz_{kind}')() for f in equations.functions)}")
    return "\n".join(lines) + "\n"


def _generate_equations(functions: Sequence[ca.Function]) -> str:
    generator = ca.CodeGenerator("eq.c", {"with_export": False, "casadi_int": "long long int"})
    for f in functions:
        generator.add(f)
    text: str = generator.dump()
    rates = functions[0]
    if rates.is_a("SXFunction") and rates.n_instructions() <= _INLINE_LIMIT:
        for declared in ("static int casadi_f0(", f"int {rates.name()}("):
            text = text.replace(f"\n{declared}", f"\n{_INLINE} int {declared.partition('int ')[2]}")
    if missing := re.search(r"CASADI_MEM|_alloc_mem\(", text):
        raise DefinitionError(
            f"found equations that need memory of their own ({missing[0]}), as solvers and external functions do. "
            "Write them without."
        )
    return text


def generate(spec: ModelSpec, token: str, fmi: int = 3) -> tuple[str, bool]:
    """Return the text of ``model.c``.

    ``token``: the instantiation token (FMI 3.0, 2.3.1).
    Returns: the C text; it includes the files of `read_fmu_sources`.
    Returns: whether there are directional and adjoint derivatives.
    """
    entries = layout(spec)
    equations = _equations(spec)
    written = _generate_equations(equations.functions)
    parts = [
        "/* Generated by Loopwright. */\n",
        _dimensions(spec, token, equations, len(entries), fmi),
        '#include "model.h"\n',
        prepare_functions(written) + "/* The equations, written by CasADi. */\n" + written + restore_functions(),
        "#include <math.h>\n",
        variable_table(entries),
        start_table(entries),
        *_tables(spec, equations.nonzeros),
        "".join(f'#include "{name}"\n' for name in FILES[fmi][2:]),
    ]
    return "\n".join(parts), equations.nonzeros is not None


@lru_cache(maxsize=2)
def read_fmu_sources(fmi: int = 3) -> dict[str, str]:
    """Return the texts of the C sources of an FMU for a version of FMI, by name."""
    folder = resources.files(__package__) / "fmu_sources"
    own = {name: (folder / name).read_text(encoding="utf-8") for name in FILES[fmi]}
    return own | {name: f"{read_sources(name)}\n" for name in _SHARED}
