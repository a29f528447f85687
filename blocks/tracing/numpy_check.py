"""NumPy's own result beside a traced one: finds the operations that trace silently wrong."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..core.block import Block
from ..core.errors import LoopwrightError, TraceError
from ..core.ports import Shape
from .equations import parts_of, takes_update
from .rounding import watched, watching
from .symbols import bundle, with_values

NEXT, GUARDS = "next", "guards"
_POINTS = 2
_SPECIAL = ([0.0], [0.5, -0.5, 1.5, -2.5], [-1.0, 2.0, 0.0, -0.5])  # where functions have edges, in turns
_NEARBY = 1e-7  # how far from a special point another side of an edge is looked for
_SINGULAR = (ArithmeticError, np.linalg.LinAlgError)  # NumPy and Python raise where a trace gives inf or NaN


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
    """Evaluate a traced function and the equations behind it at random points, and at halves, zeros and integers.

    What NumPy can't compute at a point (a division by zero, a singular matrix) is not compared there.

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
        If they differ, or if the equations round to even, which a trace does not.
    """
    T = 1.0 if sampled else float("nan")
    p = np.concatenate([*(np.ravel(v) for _, v in entries), [T], *map(np.ravel, constants.values())])
    p = np.concatenate([p, np.zeros(function.numel_in(2 + len(shapes)) - p.size)])
    numbers = {k: np.float64(v) if np.ndim(v) == 0 else v for k, v in [*entries, *constants.items()]}
    rng = np.random.default_rng(20140)
    _refuse_rounding(block, next(_special_points(shapes, starts, block)), np.float64(T), numbers, names)

    def numpy_at(point: _Point) -> dict[str, np.ndarray]:
        try:
            found = evaluate(block, point.arguments(), np.float64(T), numbers, names)
        except _SINGULAR:
            return {}
        return {name: _numbers(value, name) for name, value in found.items()}

    for special in (False, True):
        for point in _special_points(shapes, starts, block) if special else _random_points(rng, shapes, starts, block):
            expected = numpy_at(point)
            if not expected:
                continue
            arguments = [*point.flat(), p, *([np.array(list(point.fired.values()))] if "jump" in names else [])]
            traced = {n: np.ravel(np.array(c)) for n, c in zip(names, function.call(arguments), strict=True)}
            if GUARDS in expected:  # behind those of the equations may stand the discretization's own
                traced[GUARDS] = traced[GUARDS][: expected[GUARDS].size]
            for name, value in expected.items():
                difference = _difference(traced[name], value, name)
                if difference and not (special and _on_an_edge(traced[name], name, point, numpy_at)):
                    raise TraceError(
                        f"{difference} (t = {point.t:.3g}, x = {point.x}, u = {point.u}). An operation in it traces "
                        "wrongly; avoid math.…, float(…), masks and assignments into arrays, and build vectors with "
                        "np.stack."
                    )


class _Point:
    """Arguments at which equations are evaluated."""

    def __init__(self, t: float, x: dict[str, np.ndarray], u: dict[str, np.ndarray], fired: dict[str, float]):
        self.t, self.x, self.u, self.fired = t, x, u, fired

    def flat(self) -> list[Any]:
        """Return t, x and the inputs as a traced function takes them."""
        return [self.t, np.concatenate([*map(np.ravel, self.x.values()), np.zeros(0)]), *map(np.ravel, self.u.values())]

    def arguments(self) -> tuple[Any, dict[str, Any], dict[str, Any], dict[str, Any]]:
        """Return them as `evaluate` takes them; NumPy's own numbers divide by zero without raising."""
        x, u = ({n: np.float64(v) if np.ndim(v) == 0 else v for n, v in d.items()} for d in (self.x, self.u))
        return np.float64(self.t), x, u, {n: np.float64(v) for n, v in self.fired.items()}

    def moved(self, rng: np.random.Generator) -> _Point:
        """Return a point nearby."""

        def move(value: Any) -> Any:
            return value + _NEARBY * rng.choice([-1.0, 1.0], size=np.shape(value))

        x, u = ({n: move(v) for n, v in d.items()} for d in (self.x, self.u))
        return _Point(float(move(self.t)), x, u, self.fired)


def _random_points(
    rng: np.random.Generator, shapes: Mapping[str, Shape], starts: Mapping[str, np.ndarray], block: Block
) -> Iterator[_Point]:
    for _ in range(_POINTS):
        t = float(rng.uniform(0.0, 2.0))
        x = {k: v + 0.1 * rng.standard_normal(v.shape) for k, v in starts.items()}
        u = {k: rng.standard_normal(s) for k, s in shapes.items()}
        yield _Point(t, x, u, {k: float(rng.integers(2)) for k in block.events})


def _special_points(shapes: Mapping[str, Shape], starts: Mapping[str, np.ndarray], block: Block) -> Iterator[_Point]:
    for number, values in enumerate(_SPECIAL):
        x = {k: v + np.resize(values, v.shape) for k, v in starts.items()}
        u = {k: np.resize(values, s) for k, s in shapes.items()}
        yield _Point(abs(values[0]), x, u, {k: float((i + number) % 2) for i, k in enumerate(block.events)})


def _on_an_edge(traced: np.ndarray, name: str, point: _Point, numpy_at: Any) -> bool:
    """Whether NumPy gives the traced values beside the point: a jump may be on either side of its own edge."""
    rng = np.random.default_rng(2014)
    met = np.zeros(traced.shape, dtype=bool)
    for _ in range(8):
        beside = numpy_at(point.moved(rng)).get(name)
        if beside is None or beside.shape != traced.shape:
            return True
        with np.errstate(all="ignore"):
            met |= ~(np.abs(traced - beside) > 1e-4 * (1.0 + np.abs(beside)))
    return bool(met.all())


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        return np.ravel(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        raise TraceError(f"with numbers it gives {value!r} for {name!r}; expected numbers. Use np.stack.") from None


def _difference(traced: np.ndarray, numpy: np.ndarray, name: str) -> str:
    """Return in words how two evaluations differ, or nothing."""
    if traced.size != numpy.size:
        return f"its traced equation gives {traced.size} numbers for {name!r} where NumPy gives {numpy.size}"
    with np.errstate(all="ignore"):
        close = np.abs(traced - numpy) <= 1e-9 * (1.0 + np.abs(numpy))
    wrong = np.isfinite(numpy) & ~close
    if wrong.any():
        return f"its traced equation gives {traced[wrong][:3]} for {name!r} where NumPy gives {numpy[wrong][:3]}"
    return ""


def evaluate(
    block: Block,
    at: tuple[Any, Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]],
    T: Any,
    numbers: Mapping[str, Any],
    names: Sequence[str],
) -> dict[str, Any]:
    """Evaluate equations with NumPy at (t, x, u, fired): what of ``names`` they give, states and guards flat."""
    t, x, u, fired = at
    shadow = with_values(block, dict(numbers))
    bx, bu = bundle("x", x), bundle("u", u)

    def call(what: str, *more: Any) -> Any:
        wants = "T" in inspect.signature(getattr(type(block), what)).parameters and np.isfinite(T)
        try:
            with np.errstate(all="ignore"):
                return getattr(shadow, what)(t, bx, bu, *more, **({"T": T} if wants else {}))
        except (LoopwrightError, *_SINGULAR):
            raise
        except Exception as error:
            raise TraceError(
                f"its {what} can be traced, but not be run with numbers: {type(error).__name__}: {error}. Use NumPy "
                "functions of (t, x, u), which do both."
            ) from error

    def parts(what: str, wanted: list[str], *more: Any) -> list[Any]:
        return parts_of(call(what, *more), wanted, what) if wanted else []

    def flat(what: str, wanted: list[str], *more: Any) -> np.ndarray:
        return np.concatenate([*(_numbers(m, what) for m in parts(what, wanted, *more)), np.zeros(0)])

    states, events = list(block.states), list(block.events)
    result: dict[str, Any] = {name: x[name] for name in block.outputs if name in block.states and name in names}
    own = [name for name in block.outputs if name not in block.states]
    if own and own[0] in names:
        result.update(zip(own, parts("output", own), strict=True))
    if NEXT in names and states and takes_update(block, bool(np.isfinite(T))):
        result[NEXT] = flat("update", states)
    if GUARDS in names and hasattr(block, "guards"):
        result[GUARDS] = np.concatenate([*(_numbers(v, k) for k, v in call("guards").items()), np.zeros(0)])
    if "derivative" in names:
        rates = {n: np.zeros(np.shape(v)) for n, v in x.items()}
        continuous = [n for n, port in block.states.items() if not port.discrete]
        rates.update(zip(continuous, parts("derivative", continuous), strict=True))
        result["derivative"] = np.concatenate([_numbers(v, "derivative") for v in rates.values()])
    if "indicators" in names:
        result["indicators"] = flat("indicators", events)
    if "jump" in names:
        result["jump"] = flat("jump", states, bundle("fired", fired))
    return result


def _refuse_rounding(block: Block, point: _Point, T: Any, numbers: Mapping[str, Any], names: Sequence[str]) -> None:
    """Refuse `np.round` and `np.rint`: they differ from a trace at halves only, where no random point looks."""
    t, x, u, fired = point.arguments()
    x, u, fired, seen = ({n: watched(v) for n, v in d.items()} for d in (x, u, fired, numbers))
    with watching() as rounded, contextlib.suppress(Exception):
        evaluate(block, (watched(t), x, u, fired), watched(T), seen, names)
    if rounded:
        raise TraceError(
            "it uses np.round or np.rint, which round halves to the even neighbour in NumPy and away from zero in a "
            "trace. Write np.floor(v + 0.5), which is the same in both."
        )
