"""Dependencies of a model's unknowns on its knowns, from the sparsity of its traced equations (FMI 3.0, 2.4.8)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ...blocks.core import Layout
from .c_code import expand_scalar, to_symbols
from .model_spec import ModelSpec
from .variable_entries import Entry, layout

# Operations whose derivative is zero almost everywhere: with them, a constant derivative means no linear equation.
_STEP_LIKE = {ca.OP_FLOOR, ca.OP_CEIL, ca.OP_SIGN, ca.OP_COPYSIGN, ca.OP_FMOD, ca.OP_REMAINDER, ca.OP_IF_ELSE_ZERO}
_STEP_LIKE |= {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_AND, ca.OP_OR}


@dataclass(frozen=True)
class Dependency:
    """Dependency of an unknown on a known (FMI 3.0, 2.4.8)."""

    known: int
    kind: str


def _pairs(sparsity: Any) -> list[tuple[int, int]]:
    return list(zip(*sparsity.get_triplet(), strict=True)) if sparsity.nnz() else []


def _entry_at(entries: tuple[Entry, ...]) -> list[Entry]:
    return [e for e in entries for _ in range(e.variable.size)]


def _second_order(knowns: Any, unknowns: Any) -> dict[tuple[int, int], set[int]] | None:
    """Return the knowns on which each element (unknown, known) of the Jacobian depends; None if they can't be found."""
    try:
        f = ca.Function("f", [knowns], [unknowns]).expand()
    except RuntimeError:  # interpolation tables and the like have no scalar expansion
        return None
    if any(f.instruction_id(k) in _STEP_LIKE for k in range(f.n_instructions())):
        return None
    v = f.sx_in(0)
    jacobian = ca.jacobian(f(v), v)
    elements = ca.sparsity_cast(jacobian, ca.Sparsity.dense(jacobian.nnz(), 1))
    found: dict[tuple[int, int], set[int]] = {pair: set() for pair in _pairs(jacobian.sparsity())}
    order = list(found)
    for row, known in _pairs(ca.Function("elements", [v], [elements]).jac_sparsity(0, 0)):
        found[order[row]].add(known)
    return found


def _kind(of: Iterable[set[int] | None], at: list[Entry]) -> str:
    """Return the kind of a dependency, from the knowns on which its Jacobian's elements depend (None: not found)."""
    kinds: set[str] = set()
    for elements in of:
        if elements is None:
            return "dependent"
        kinds |= {at[i].kind for i in elements}
    if kinds - {"fixed", "tunable", "discrete"}:
        return "dependent"
    return next((kind for kind in ("discrete", "tunable", "fixed") if kind in kinds), "constant")


def dependencies(spec: ModelSpec) -> dict[int, tuple[Dependency, ...]]:
    """Return the dependencies of outputs, derivatives and event indicators on time, parameters, inputs and states.

    Returns: dependencies by the value reference of the unknown, in the order of value references.
    """
    entries = layout(spec)
    at = _entry_at(entries)
    knowns, unknowns = to_symbols(spec)
    calculated = ("derivative", "output", "indicator")
    first = next((e.first for e in entries if e.kind in calculated), 0)
    second = _second_order(knowns, unknowns)
    blocks: dict[tuple[int, int], list[set[int] | None]] = {}
    for row, column in _pairs(ca.Function("f", [knowns], [unknowns]).jac_sparsity(0, 0)):
        pair = (at[first + row].reference, at[column].reference)
        blocks.setdefault(pair, []).append(None if second is None else second.get((row, column)))
    found: dict[int, list[Dependency]] = {e.reference: [] for e in entries if e.kind in calculated}
    for unknown, known in sorted(blocks):
        found[unknown].append(Dependency(known, _kind(blocks[unknown, known], at)))
    for e in entries:
        if e.kind == "state" and e.is_output:  # a state is its own known
            found[e.reference] = [Dependency(e.reference, "constant")]
        if e.kind == "discrete" and e.is_output:  # it changes only between two iterations of an event
            found[e.reference] = []
    return {reference: tuple(items) for reference, items in found.items()}


def reinitialized_states(spec: ModelSpec) -> set[str]:
    """Return the names of the continuous states that a jump may change (FMI 3.0, 2.4.7.4: reinit)."""
    if spec.jump is None:
        return set()
    jump = expand_scalar(spec.jump)
    if not jump.is_a("SXFunction"):
        return {v.name for v in spec.continuous}
    args = jump.sx_in()
    after = ca.densify(ca.reshape(jump.call(args, True, False)[0], jump.numel_out(0), 1))
    changed = [not ca.is_equal(after[i], args[1][i], 2) for i in range(after.numel())]
    places = Layout.of({v.name: v.shape for v in spec.continuous})
    return {name for name, where in places.slices.items() if any(changed[where])}
