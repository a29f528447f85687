"""Comparison of traced equations with NumPy's own results: it finds operations that trace silently wrong.

A trace rounds to even differently, so numbers record when they are rounded.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ..core import Block, LoopwrightError, Shape, TraceError
from .equations import parts_of, takes_update
from .symbols import bundle, with_values
from .traced_functions import NotTracedError

NEXT, GUARDS = "next", "guards"
_POINTS = 2
_SPECIAL = ([0.0], [0.5, -0.5, 1.5, -2.5], [-1.0, 2.0, 0.0, -0.5])  # where functions have edges; used in turns
_NEARBY = 1e-7  # distance from a special point at which the other side of an edge is tried
_SINGULAR = (ArithmeticError, np.linalg.LinAlgError)  # raised where a trace gives inf or NaN


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
    """Evaluate a traced function and its equations at random points, and at halves, zeros and integers.

    ``names`` are those of the function's results: outputs, `NEXT`, `GUARDS`, ``derivative``, ``indicators``, ``jump``.
    """
    # a point at which NumPy can't compute (a division by zero, a singular matrix) is left out
    T = 1.0 if sampled else float("nan")
    p = np.concatenate([*(np.ravel(v) for _, v in entries), [T], *map(np.ravel, constants.values())])
    numbers_of_p = ca.DM(np.concatenate([p, np.zeros(function.numel_in(2 + len(shapes)) - p.size)]))  # converted once
    numbers = {k: np.float64(v) if np.ndim(v) == 0 else v for k, v in [*entries, *constants.items()]}
    rng = np.random.default_rng(20140)
    _refuse_rounding(block, next(_special_points(shapes, starts, block)), np.float64(T), numbers, names)

    def evaluate_with_numpy(point: Point) -> dict[str, np.ndarray]:
        try:
            found = evaluate(block, point.arguments(), np.float64(T), numbers, names)
        except _SINGULAR:
            return {}
        return {name: _numbers(value, name) for name, value in found.items()}

    for special in (False, True):
        for point in _special_points(shapes, starts, block) if special else _random_points(rng, shapes, starts, block):
            expected = evaluate_with_numpy(point)
            if not expected:
                continue
            arguments = [
                *point.columns(),
                numbers_of_p,
                *([np.array(list(point.fired.values()))] if "jump" in names else []),
            ]
            traced = {n: np.ravel(np.array(c)) for n, c in zip(names, function.call(arguments), strict=True)}
            if GUARDS in expected:  # the discretization may add guards behind those of the equations
                traced[GUARDS] = traced[GUARDS][: expected[GUARDS].size]
            for name, value in expected.items():
                difference = _difference(traced[name], value, name)
                if difference and not (special and _is_on_edge(traced[name], name, point, evaluate_with_numpy)):
                    raise TraceError(
                        f"{difference} (t = {point.t:.3g}, x = {point.x}, u = {point.u}). An operation in it traces "
                        "wrongly; avoid math.…, float(…), masks and assignments into arrays, and build vectors with "
                        "np.stack."
                    )


Columns = list[float | np.ndarray]
"""Arguments of a traced function: t, then flat vectors, or matrices of one column for each point."""
Values = dict[str, np.float64 | np.ndarray]
"""Values of states, inputs or events by name."""


@dataclass(frozen=True)
class Point:
    """Arguments at which equations are evaluated; states, inputs and events by name."""

    t: float
    x: dict[str, np.ndarray]
    u: dict[str, np.ndarray]
    fired: dict[str, float]

    def columns(self) -> Columns:
        """Return t, x and the inputs, flat, as a traced function takes them."""
        return [self.t, np.concatenate([*map(np.ravel, self.x.values()), np.zeros(0)]), *map(np.ravel, self.u.values())]

    def arguments(self) -> tuple[np.float64, Values, Values, Values]:
        """Return copies of t, x, u and fired as `evaluate` takes them."""
        # NumPy's own numbers divide by zero without raising, as a trace does
        x, u = ({n: np.float64(v) if np.ndim(v) == 0 else np.array(v) for n, v in d.items()} for d in (self.x, self.u))
        return np.float64(self.t), x, u, {n: np.float64(v) for n, v in self.fired.items()}

    def with_input(self, name: str, value: np.ndarray) -> Point:
        """Return the point with another value of one input."""
        return replace(self, u={**self.u, name: value})

    def move(self, rng: np.random.Generator) -> Point:
        """Return a point nearby."""

        def shift(value: Any) -> Any:
            return value + _NEARBY * rng.choice([-1.0, 1.0], size=np.shape(value))

        x, u = ({n: shift(v) for n, v in d.items()} for d in (self.x, self.u))
        return Point(float(shift(self.t)), x, u, self.fired)

    def __str__(self) -> str:
        x, u = ({n: np.asarray(v).tolist() for n, v in d.items()} for d in (self.x, self.u))
        return f"t = {self.t:.6g}, x = {x}, u = {u}"


def _random_points(
    rng: np.random.Generator, shapes: Mapping[str, Shape], starts: Mapping[str, np.ndarray], block: Block
) -> Iterator[Point]:
    for _ in range(_POINTS):
        t = float(rng.uniform(0.0, 2.0))
        x = {k: v + 0.1 * rng.standard_normal(v.shape) for k, v in starts.items()}
        u = {k: rng.standard_normal(s) for k, s in shapes.items()}
        yield Point(t, x, u, {k: float(rng.integers(2)) for k in block.events})


def _special_points(shapes: Mapping[str, Shape], starts: Mapping[str, np.ndarray], block: Block) -> Iterator[Point]:
    for number, values in enumerate(_SPECIAL):
        x = {k: v + np.resize(values, v.shape) for k, v in starts.items()}
        u = {k: np.resize(values, s) for k, s in shapes.items()}
        yield Point(abs(values[0]), x, u, {k: float((i + number) % 2) for i, k in enumerate(block.events)})


def _is_on_edge(traced: np.ndarray, name: str, point: Point, evaluate_with_numpy: Any) -> bool:
    """Whether NumPy gives the traced values at points nearby: at an edge, either side is right."""
    rng = np.random.default_rng(2014)
    met = np.zeros(traced.shape, dtype=bool)
    for _ in range(8):
        nearby = evaluate_with_numpy(point.move(rng)).get(name)
        if nearby is None or nearby.shape != traced.shape:
            return True
        with np.errstate(all="ignore"):
            met |= ~(np.abs(traced - nearby) > 1e-4 * (1.0 + np.abs(nearby)))
    return bool(met.all())


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        return np.ravel(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        raise TraceError(f"with numbers it gives {value!r} for {name!r}; expected numbers. Use np.stack.") from None


def _difference(traced: np.ndarray, numpy: np.ndarray, name: str) -> str:
    """Return the difference of two evaluations in words; empty if there is none."""
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
    """Evaluate equations with NumPy at (t, x, u, fired): those of ``names`` that exist, states and guards flat."""
    t, x, u, fired = at
    shadow = with_values(block, dict(numbers))
    bx, bu = bundle("x", x), bundle("u", u)

    def call(equation: str, *more: Any) -> Any:
        wants = "T" in inspect.signature(getattr(type(block), equation)).parameters and np.isfinite(T)
        try:
            with np.errstate(all="ignore"):
                return getattr(shadow, equation)(t, bx, bu, *more, **({"T": T} if wants else {}))
        except (LoopwrightError, *_SINGULAR):
            raise
        except NotTracedError as error:
            raise TraceError(f"its {equation} can be traced, but not be run with numbers: {error}.") from error
        except Exception as error:
            failure = f"{type(error).__name__}: {error}".rstrip(".")
            raise TraceError(
                f"its {equation} can be traced, but not be run with numbers: {failure}. Use "
                "NumPy functions of (t, x, u), which do both."
            ) from error

    def values(equation: str, wanted: list[str], *more: Any) -> list[Any]:
        return parts_of(call(equation, *more), wanted, equation) if wanted else []

    def flatten(equation: str, wanted: list[str], *more: Any) -> np.ndarray:
        return np.concatenate([*(_numbers(m, equation) for m in values(equation, wanted, *more)), np.zeros(0)])

    states, events = list(block.states), list(block.events)
    result: dict[str, Any] = {name: x[name] for name in block.outputs if name in block.states and name in names}
    own = [name for name in block.outputs if name not in block.states]
    if own and own[0] in names:
        result.update(zip(own, values("output", own), strict=True))
    if NEXT in names and states and takes_update(block, bool(np.isfinite(T))):
        result[NEXT] = flatten("update", states)
    if GUARDS in names and hasattr(block, "guards"):
        result[GUARDS] = np.concatenate([*(_numbers(v, k) for k, v in call("guards").items()), np.zeros(0)])
    if "derivative" in names:
        # the trace has a rate for every state, also 0 for those that only events change
        rates = {n: np.zeros(np.shape(v)) for n, v in x.items()}
        continuous = [n for n, port in block.states.items() if not port.discrete]
        rates.update(zip(continuous, values("derivative", continuous), strict=True))
        result["derivative"] = np.concatenate([_numbers(v, "derivative") for v in rates.values()])
    if "indicators" in names:
        result["indicators"] = flatten("indicators", events)
    if "jump" in names:
        result["jump"] = flatten("jump", states, bundle("fired", fired))
    return result


def _refuse_rounding(block: Block, point: Point, T: Any, numbers: Mapping[str, Any], names: Sequence[str]) -> None:
    """Refuse `np.round` and `np.rint`: they differ from a trace at halves only, which random points don't hit."""
    # errors of the equations at this point are passed over, as elsewhere, except an operation that nobody handles
    t, *given = point.arguments()
    x, u, fired, seen = ({n: watch(v) for n, v in d.items()} for d in (*given, numbers))
    with record_rounding() as rounded:
        try:
            evaluate(block, (watch(t), x, u, fired), watch(T), seen, names)
        except Exception as error:
            if isinstance(error.__cause__, NotTracedError):
                raise
    if rounded:
        raise TraceError(
            "it uses np.round or np.rint, which round halves to the even neighbour in NumPy and away from zero in a "
            "trace. Write np.floor(v + 0.5), which is the same in both."
        )


# --- rounding ---------------------------------------------------------------------------------------------------------


_noticed: ContextVar[list[str] | None] = ContextVar("loopwright_rounding", default=None)


@contextmanager
def record_rounding() -> Iterator[list[str]]:
    """Collect the names of rounding functions that are applied to watched numbers within the context."""
    found: list[str] = []
    token = _noticed.set(found)
    try:
        yield found
    finally:
        _noticed.reset(token)


class Watched(np.ndarray):
    """An array that is watched; so is everything that is computed from it."""

    def __array_ufunc__(self, ufunc: Any, method: Any, *inputs: Any, **kwargs: Any) -> Any:
        found = _noticed.get()
        if found is not None and ufunc is np.rint:  # np.round and np.around call it
            found.append(ufunc.__name__)
        # All are plain arrays now, also in where=, and the method of a plain array asks no operand: nothing comes back.
        plain, options = _unwatch(inputs), _unwatch(kwargs)
        made = super().__array_ufunc__(ufunc, method, *plain, **options)
        if made is NotImplemented and not any(_is_foreign(v) for v in plain):  # else the operand of that class is asked
            raise NotTracedError(
                f"NumPy {np.__version__} hands np.{ufunc.__name__} back. Write it in sums, products and np.where"
            )
        return watch(made)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return watch(super().__array_function__(func, types, args, kwargs))

    def __getitem__(self, key: Any) -> Any:
        return watch(np.asarray(self)[key])

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))


def _unwatch(value: Any) -> Any:
    """Return NumPy's own arrays for watched ones, also in tuples, lists and dictionaries."""
    if isinstance(value, Watched):
        return value.view(np.ndarray)
    if type(value) in (tuple, list):
        return type(value)(map(_unwatch, value))
    return {k: _unwatch(v) for k, v in value.items()} if type(value) is dict else value


def _is_foreign(value: Any) -> bool:
    """Whether a value's class computes NumPy's functions itself."""
    return not isinstance(value, np.ndarray | np.generic) and hasattr(value, "__array_ufunc__")


def watch(value: Any) -> Any:
    """Return numbers as a `Watched` array, anything else as it is."""
    if type(value) in (tuple, list):
        return type(value)(map(watch, value))
    return np.asarray(value).view(Watched) if isinstance(value, np.ndarray | np.number | np.bool_ | float) else value
