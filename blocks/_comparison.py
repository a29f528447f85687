"""NumPy's own result beside a traced one: finds the operations that trace silently wrong."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ._block import Block
from ._errors import TraceError
from ._ports import Shape
from ._symbols import bundle, with_values

NEXT, GUARDS = "next", "guards"
_POINTS = 2


def compare(
    block: Block,
    function: Any,
    names: Sequence[str],
    shapes: Mapping[str, Shape],
    starts: Mapping[str, np.ndarray],
    entries: Sequence[tuple[str, Any]],
    constants: Mapping[str, Any],
    sampled: bool,
) -> None:
    """Evaluate a traced function and the equations behind it at random points.

    Parameters
    ----------
    block : Block
        Whose equations they are.
    function : casadi.Function
        Of (t, x, one column per input, p), and of which events have fired for ``jump``.
    names : sequence of str
        What the function returns: outputs by name, `NEXT`, `GUARDS`, ``derivative``, ``indicators``, ``jump``.
    shapes, starts, entries, constants
        Shapes of the inputs, start values of the states, parameters and precomputed numbers.
    sampled : bool
        Whether the block stands in a sampled frame; the sample time is 1 s then.

    Raises
    ------
    TraceError
        If they differ.
    """
    rng = np.random.default_rng(20140)
    T = 1.0 if sampled else float("nan")
    p = np.concatenate([*(np.ravel(v) for _, v in entries), [T], *map(np.ravel, constants.values())])
    p = np.concatenate([p, np.zeros(function.numel_in(2 + len(shapes)) - p.size)])
    for _ in range(_POINTS):
        t = float(rng.uniform(0.0, 2.0))
        x = {k: v + 0.1 * rng.standard_normal(v.shape) for k, v in starts.items()}
        u = {k: rng.standard_normal(s) for k, s in shapes.items()}
        fired = {k: float(rng.integers(2)) for k in block.events}
        arguments = [t, np.concatenate([*map(np.ravel, x.values()), np.zeros(0)]), *map(np.ravel, u.values()), p]
        if "jump" in names:
            arguments.append(np.array(list(fired.values())))
        traced = {n: np.ravel(np.array(c)) for n, c in zip(names, function.call(arguments), strict=True)}
        for name, value in evaluate(block, t, x, u, T, constants, names, fired).items():
            difference = _difference(traced[name], np.ravel(np.asarray(value, dtype=float)), name)
            if difference:
                raise TraceError(
                    f"{difference} (t = {t:.3g}, x = {x}, u = {u}). An operation in it traces wrongly; avoid "
                    "math.…, float(…), masks and assignments into arrays, and build vectors with np.stack."
                )


def _difference(traced: np.ndarray, numpy: np.ndarray, name: str) -> str:
    """Return in words how two evaluations differ, or nothing."""
    if traced.size != numpy.size:
        return f"its traced equation gives {traced.size} numbers for {name!r} where NumPy gives {numpy.size}"
    with np.errstate(all="ignore"):
        close = np.abs(traced - numpy) <= 1e-9 * (1.0 + np.abs(numpy))
    wrong = ~(close | (np.isnan(traced) & np.isnan(numpy)) | (traced == numpy))
    if wrong.any():
        return f"its traced equation gives {traced[wrong][:3]} for {name!r} where NumPy gives {numpy[wrong][:3]}"
    return ""


def evaluate(
    block: Block,
    t: float,
    x: Mapping[str, Any],
    u: Mapping[str, Any],
    T: float,
    constants: Mapping[str, Any],
    names: Sequence[str],
    fired: Mapping[str, float],
) -> dict[str, Any]:
    """Evaluate a block's equations with NumPy: what of ``names`` they give, states and guards flat."""
    shadow = with_values(block, dict(constants))
    bx, bu = (bundle(k, {n: float(v) if np.ndim(v) == 0 else v for n, v in d.items()}) for k, d in (("x", x), ("u", u)))

    def call(what: str, *more: Any) -> Any:
        wants = "T" in inspect.signature(getattr(type(block), what)).parameters and np.isfinite(T)
        with np.errstate(all="ignore"):
            return getattr(shadow, what)(t, bx, bu, *more, **({"T": T} if wants else {}))

    def parts(what: str, count: int, *more: Any) -> Any:
        made = call(what, *more) if count else ()
        return (made,) if count == 1 else made

    def flat(what: str, count: int, *more: Any) -> np.ndarray:
        return np.concatenate([*(np.ravel(m) for m in parts(what, count, *more)), np.zeros(0)])

    result: dict[str, Any] = {name: x[name] for name in block.outputs if name in block.states and name in names}
    own = [name for name in block.outputs if name not in block.states]
    if own and own[0] in names:
        result.update(zip(own, parts("output", len(own)), strict=True))
    has_update = hasattr(block, "update") and (np.isfinite(T) or not hasattr(block, "derivative"))
    if NEXT in names and block.states and has_update:
        result[NEXT] = flat("update", len(block.states))
    if GUARDS in names and hasattr(block, "guards"):
        result[GUARDS] = np.array([float(v) for v in call("guards").values()])
    if "derivative" in names:
        rates = {n: np.zeros(np.shape(v)) for n, v in x.items()}
        continuous = [n for n, port in block.states.items() if not port.discrete]
        rates.update(zip(continuous, parts("derivative", len(continuous)), strict=True))
        result["derivative"] = np.concatenate([np.ravel(v) for v in rates.values()])
    if "indicators" in names:
        result["indicators"] = flat("indicators", len(block.events))
    if "jump" in names:
        result["jump"] = flat("jump", len(block.states), bundle("fired", fired))
    return result
