"""The model structure of an FMU in model exchange, held against what its values follow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ...blocks.core import FmuRuntimeError, Wanted, elements
from ..archive import FmuVariable, ModelExchangeInfo
from .loaded_fmu import LoadedFmu

_MOVED, _SAME = 1e-4, 1e-8
"""Relative distance by which states and inputs are moved, and change of a value that is none."""
_MOST_PATTERNS, _MOST_NOTES = 50, 5
"""Patterns of dependencies that are checked, and notes on values that change by themselves."""
_CHECKED: dict[tuple[str, float, bytes, bytes], Sequence[str]] = {}
_MOST_CHECKED = 10_000
"""Points at which the model structure of an FMU has been checked in this process: its digest, t, x and u, with notes on
what was found there; and how many are kept."""


def is_smooth(variable: FmuVariable) -> bool:
    """Whether an input may be set in Continuous-Time Mode: a real number that is not discrete."""
    return variable.type in ("Float64", "Float32") and variable.variability == "continuous"


def check_structure(
    fmu: LoadedFmu,
    exchange: ModelExchangeInfo,
    places: Mapping[str, slice],
    evaluation: Callable[[Wanted], Callable[[float, np.ndarray, np.ndarray], np.ndarray]],
    t: float,
    x: np.ndarray,
    u: np.ndarray,
) -> None:
    """Refuse a model structure that leaves out what outputs or derivatives follow; once for each point of an FMU.

    FMUs that Loopwright has built are right. An input may act in some mode only, so every start is looked at. The order
    of evaluation and linear models rest on it. Everything that some values should not follow is moved.

    Values that differ between evaluations at one point, such as a processor time, follow nothing: that is noted.

    ``places`` are those of all inputs in u, by port; ``evaluation`` takes what is wanted, and returns its values as a
    function of t, x and u, with all smooth inputs set.
    """
    about = fmu.description
    key = about.digest, t, x.tobytes(), u.tobytes()
    if key in _CHECKED:
        for text in _CHECKED[key]:
            fmu.add_note(text)
        return
    if fmu.is_built_here or fmu.setup.dependencies == "all" or (x.size and not about.states):
        return
    # values by rows, and what they may follow by columns: states first, then smooth inputs, as in a model's x and u
    ports = [p for p, v in fmu.setup.output_variables.items() if v.type == "Float64" and is_smooth(v)]
    rows = [fmu.setup.output_variables[p] for p in ports]
    rows += [about.find(name) for name in about.states.values()]
    columns: list[tuple[FmuVariable, str | None]] = [(about.find(name), None) for name in about.states]
    columns += [(v, port) for port, v in fmu.inputs.items() if is_smooth(v)]
    if not rows or not columns:
        return
    declared = np.block([[exchange.pattern(of, v) for v, _ in columns] for of in rows])
    evaluate = evaluation(Wanted(tuple(ports), bool(about.states)))

    def values(moved: np.ndarray) -> np.ndarray:
        inputs, first = u.copy(), x.size
        for v, port in columns:
            if port is not None:
                inputs[places[port]] = moved[first : first + v.size]
                first += v.size
        return evaluate(t, moved[: x.size], inputs).copy()

    # everything is moved a little from the point itself, where the FMU can be evaluated for certain
    start = np.concatenate([x, *(u[places[port]] for _, port in columns if port is not None)])
    step = _choose_steps([v for v, _ in columns], start)
    names, knowns = (
        [label for v in of for label in elements(v.name, v.shape)] for of in (rows, [v for v, _ in columns])
    )
    undeclared, drift = _find_undeclared(declared, values, start, step)
    if undeclared is not None:
        row, k, change = undeclared
        raise FmuRuntimeError(
            f"its model structure says that {names[row]!r} does not depend on {knowns[k]!r}; found a change of "
            f"{change:.3g} where that moves by {step[k]:.3g}. The order of evaluation would be wrong. Take "
            "interface='co_simulation' if it is offered, or dependencies='all', by which everything may depend on "
            "everything, and report it to its makers.",
            block=fmu.setup.label,
            t=t,
        )
    notes = [
        f"{names[row]!r} changes by itself: it differs by {drift[row]:.3g} between evaluations at one time, with "
        "the same states and inputs, as a processor time or a random number does. Runs with it are not repeatable "
        "where it is read, and its dependencies can't be checked"
        for row in np.flatnonzero(drift)[:_MOST_NOTES]
    ]
    for text in notes:
        fmu.add_note(text)
    if len(_CHECKED) >= _MOST_CHECKED:
        _CHECKED.clear()
    _CHECKED[key] = notes


def _choose_steps(variables: Sequence[FmuVariable], start: np.ndarray) -> np.ndarray:
    """Return the distance by which each element is moved from a start, within its limits; 0 without room."""
    nominals, low, high = (
        np.concatenate([np.ravel(part) for part in parts])
        for parts in zip(*((v.nominals, *v.limits) for v in variables), strict=True)
    )
    step = _MOVED * np.maximum(np.abs(start), nominals) * np.random.default_rng(0).uniform(0.5, 1.0, start.size)
    return np.where(start + step <= high, step, np.where(start - step >= low, -step, 0.0))


def _find_undeclared(
    declared: np.ndarray, values: Callable[[np.ndarray], np.ndarray], start: np.ndarray, step: np.ndarray
) -> tuple[tuple[int, int, float] | None, np.ndarray]:
    """Return a value, an argument and the change for a dependency that isn't declared, or None; then drifts.

    A drift is the distance of a value from an earlier one at the same arguments, 0 where there is none to speak of.
    """
    base, again, whole = values(start), values(start), np.abs(values(start + step))
    least, drift = _SAME * (np.abs(base) + whole), np.abs(again - base)
    for pattern in np.unique(declared, axis=0)[:_MOST_PATTERNS]:
        mine, free = np.all(declared == pattern, axis=1), ~pattern & (step != 0.0)
        if not free.any():
            continue
        off = mine & (np.abs(values(np.where(free, start + step, start)) - base) > least)
        if off.any():  # a value that grows by itself, in steps of a clock, may have waited for just this moment
            drift = np.fmax(drift, np.abs(values(start) - base))
        off &= ~(drift > least)
        if not off.any():
            continue
        row = int(np.flatnonzero(off)[0])
        alone = (np.where(np.arange(start.size) == k, start + step, start) for k in np.flatnonzero(free))
        sizes = [abs(values(moved)[row] - base[row]) for moved in alone]
        values(start)
        return (row, int(np.flatnonzero(free)[int(np.argmax(sizes))]), max(sizes)), drift
    values(start)
    return None, np.where(drift > least, drift, 0.0)
