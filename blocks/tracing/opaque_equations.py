"""Opaque equations: arbitrary Python, as functions that a trace calls.

An exception can't pass through CasADi: the last one is kept in `Foreign.failures`, and the results are NaN, at which
every run stops. To find the reason of a NaN, clear the failures, evaluate again and call `raise_failure`: an old
failure may be one that a solver got over by a shorter step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ..core import Block, Layout, LoopwrightError, Shape, ShapeError, SimulationError, TraceError
from .differences import differentiate
from .equations import parts_of
from .symbols import bundle, size, with_values, wrap


class Foreign:
    """The equations of an opaque block; ``numbers`` are the entries of p in their order, with "T" the sample time."""

    def __init__(
        self,
        block: Block,
        shapes: Mapping[str, Shape],
        starts: Mapping[str, np.ndarray],
        numbers: Sequence[tuple[str, Any]],
    ):
        self.block, self.shapes, self.starts, self.numbers = block, shapes, starts, numbers
        self.failures: list[BaseException] = []
        self.functions: dict[str, _Equation] = {}
        nominals = [np.full(v.shape, block.states[n].nominal or 1.0) for n, v in starts.items()]
        inputs = [np.full(size(s), block.inputs[n].nominal or 1.0) for n, s in shapes.items()]
        self.nominals = [np.ones(1), _join(nominals), *inputs, np.ones(sum(np.size(v) for _, v in numbers))]

    def call(self, equation: str, arguments: Sequence[Any], *, sample_time: bool) -> Any:
        """Return an equation's results as symbols, for columns t, x, the inputs, p, and the events that fire."""
        if equation not in self.functions:
            self.functions[equation] = _Equation(self, equation, self._results(equation, sample_time), sample_time)
        function = self.functions[equation]
        columns = function.call(list(arguments))
        made = {n: wrap(c, s) for (n, s), c in zip(function.results.items(), columns, strict=True)}
        if equation == "guards":
            return made
        return next(iter(made.values())) if len(made) == 1 else tuple(made.values())

    def evaluate(self, equation: str, at: Sequence[np.ndarray], *, sample_time: bool) -> Any:
        """Call an equation with numbers: flat t, x, inputs, p and fired events."""
        t, x, *rest = at
        n = len(self.shapes)
        numbers = _split(rest[n], {name: np.shape(v) for name, v in self.numbers})
        T = numbers.pop("T")
        block = with_values(self.block, numbers) if numbers else self.block
        states = bundle("x", _split(x, {name: v.shape for name, v in self.starts.items()}))
        inputs = bundle("u", {k: _reshape(v, s) for (k, s), v in zip(self.shapes.items(), rest[:n], strict=True)})
        fired = [bundle("fired", _split(v, dict.fromkeys(self.block.events, ()))) for v in rest[n + 1 :]]
        with np.errstate(all="ignore"):
            return getattr(block, equation)(
                np.float64(t[0]), states, inputs, *fired, **({"T": T} if sample_time else {})
            )

    def keep(self, failure: BaseException) -> None:
        """Keep the last failure; an interrupt is never replaced."""
        if not self.failures or isinstance(self.failures[0], Exception):
            self.failures[:] = [failure]

    def _results(self, equation: str, sample_time: bool) -> dict[str, Shape]:
        """Return name and shape of an equation's results; shapes that are not declared come from one trial call."""
        block = self.block
        states = {n: v.shape for n, v in self.starts.items()}
        declared: dict[str, Shape | None]
        if equation == "output":
            declared = {n: port.shape for n, port in block.outputs.items() if n not in states}
        elif equation == "indicators":
            declared = dict.fromkeys(block.events, ())
        elif equation == "derivative":
            declared = {n: s for n, s in states.items() if not block.states[n].discrete}
        else:
            declared = dict(states)
        if equation != "guards" and None not in declared.values():
            return {n: s for n, s in declared.items() if s is not None}
        at = [np.zeros(1), _join([*self.starts.values()]), *map(_trial_values, self.shapes.values())]
        try:
            made = self.evaluate(
                equation, [*at, _join([np.asarray(v) for _, v in self.numbers])], sample_time=sample_time
            )
        except LoopwrightError:
            raise
        except Exception as error:
            failure = f"{type(error).__name__}: {error}".rstrip(".")
            raise TraceError(
                f"its {equation} failed when it was tried with 1, 1/2, 1/3, … at each input, for the shape of its "
                f"outputs: {failure}. Correct it, or declare the outputs' shapes: it is not "
                "tried then."
            ) from error
        if equation == "guards":
            return dict.fromkeys(made, ())
        parts = parts_of(made, list(declared), equation)
        return {n: _array(v, n, equation).shape for n, v in zip(declared, parts, strict=True)}

    def flatten_results(self, equation: str, result: Any, results: Mapping[str, Shape]) -> list[np.ndarray]:
        """Return an equation's results as flat arrays, checked against the shapes expected."""
        if equation == "guards":
            result = [result[name] for name in results]
            result = result[0] if len(result) == 1 else result
        flat = []
        for (name, shape), part in zip(results.items(), parts_of(result, list(results), equation), strict=True):
            array = _array(part, name, equation)
            if array.shape != shape:
                raise ShapeError(
                    f"its {equation} gives shape {array.shape}; expected {shape}, as declared or as it gave first. "
                    "Return another one, or declare this shape.",
                    port=name,
                )
            flat.append(array.ravel())
        return flat


class _Foreign(ca.Callback):
    """A CasADi function of flat columns that Python evaluates."""

    def __init__(self, name: str, inputs: Sequence[Any], outputs: Sequence[Any], options: Mapping[str, Any]):
        ca.Callback.__init__(self)
        self._inputs, self._outputs = inputs, outputs
        self.construct(name, dict(options))

    def get_n_in(self) -> int:
        return len(self._inputs)

    def get_n_out(self) -> int:
        return len(self._outputs)

    def get_sparsity_in(self, i: int) -> Any:
        return self._inputs[i]

    def get_sparsity_out(self, i: int) -> Any:
        return self._outputs[i]

    def has_eval_buffer(self) -> bool:
        return True


class _Equation(_Foreign):
    """One equation of an opaque block."""

    def __init__(self, foreign: Foreign, equation: str, results: dict[str, Shape], sample_time: bool):
        self.foreign, self.equation, self.results, self.sample_time = foreign, equation, results, sample_time
        self.kept: list[Any] = []
        self.nominals = [*foreign.nominals, *([np.ones(len(foreign.block.events))] if equation == "jump" else [])]
        columns = [ca.Sparsity.dense(len(v), 1) for v in self.nominals]
        super().__init__(equation, columns, [ca.Sparsity.dense(size(s), 1) for s in results.values()], {})

    def at(self, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the results at flat arguments; those of a call that fails are NaN."""
        foreign = self.foreign
        try:
            made = foreign.evaluate(self.equation, [v.copy() for v in arguments], sample_time=self.sample_time)
            return foreign.flatten_results(self.equation, made, self.results)
        except BaseException as error:
            foreign.keep(_failure(error, self.equation, foreign, arguments))
            return [np.full(size(s), np.nan) for s in self.results.values()]

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        made = self.at([_read(v) for v in arguments])
        for buffer, values in zip(results, made, strict=True):
            if buffer is not None and values.size:
                np.frombuffer(buffer)[:] = values
        return 0

    def has_jacobian(self) -> bool:
        return True

    def get_jacobian(self, name: str, inames: Any, onames: Any, options: Mapping[str, Any]) -> Any:
        self.kept.append(_Differences(self, name, options))
        return self.kept[-1]


class _Differences(_Foreign):
    """Jacobian of an equation: differences whose steps are relative to a value, or its nominal one if larger."""

    def __init__(self, equation: _Equation, name: str, options: Mapping[str, Any]):
        self.equation = equation
        self.columns = [len(v) for v in equation.nominals]
        rows = [size(s) for s in equation.results.values()]
        inputs = [*equation._inputs, *(ca.Sparsity(n, 1) for n in rows)]
        super().__init__(name, inputs, [ca.Sparsity.dense(n, m) for n in rows for m in self.columns], options)

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        point = [_read(v).copy() for v in arguments[: len(self.columns)]]
        count = len(self.columns)
        for j, (values, nominal) in enumerate(zip(point, self.equation.nominals, strict=True)):
            wanted = [(i, buffer) for i, buffer in enumerate(results[j::count]) if buffer is not None and len(buffer)]
            if not wanted:
                continue
            slopes = [self._slope(point, values, k, nominal[k]) for k in range(len(values))]
            for i, buffer in wanted:
                np.frombuffer(buffer)[:] = np.concatenate([column[i] for column in slopes])
        return 0

    def _slope(self, point: list[np.ndarray], values: np.ndarray, k: int, nominal: float) -> list[np.ndarray]:
        """Return the derivative of every result with respect to one entry."""
        middle = values[k]
        if not np.isfinite(middle):  # the sample time, in a continuous subsystem
            return [np.zeros(size(s)) for s in self.equation.results.values()]

        def move(to: float) -> list[np.ndarray]:
            values[k] = to
            return self.equation.at(point)

        found = differentiate(move, middle, max(abs(middle), nominal))
        values[k] = middle
        return found


def raise_failure(failures: list[BaseException], path: str) -> None:
    """Raise the exception that was kept, if there is one, and forget it."""
    if failures:
        last = failures.pop()
        raise last.at(block=path) if isinstance(last, LoopwrightError) else last


def _failure(error: BaseException, equation: str, foreign: Foreign, arguments: Sequence[np.ndarray]) -> BaseException:
    """Return the error for an exception in a user's equation."""
    if not isinstance(error, Exception):
        return error  # an interrupt
    t = float(arguments[0][0])
    if isinstance(error, SimulationError):
        return error.at(t=t)
    inputs = zip(foreign.shapes.items(), arguments[2:], strict=False)
    shown = ", ".join(f"{name} = {_reshape(v, s).tolist()}" for (name, s), v in inputs)
    text = (
        str(error) if isinstance(error, LoopwrightError) else f"its {equation} failed: {type(error).__name__}: {error}."
    )
    explained = SimulationError(f"{text} Its inputs then: {shown or 'none'}. Correct the function.", t=t)
    explained.port = getattr(error, "port", None)
    explained.__cause__ = error
    return explained


def _read(buffer: Any) -> np.ndarray:
    return np.zeros(0) if buffer is None or not len(buffer) else np.frombuffer(buffer)


def _trial_values(shape: Shape) -> np.ndarray:
    """Return values that most functions accept: positive, different, none large; a matrix of them can be inverted."""
    result: np.ndarray = 1.0 / np.arange(1.0, size(shape) + 1.0)
    return result


def _join(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *map(np.ravel, arrays)])


def _reshape(flat: np.ndarray, shape: Shape) -> Any:
    return np.float64(flat[0]) if shape == () else flat.reshape(shape)


def _split(flat: np.ndarray, shapes: Mapping[str, Shape]) -> dict[str, Any]:
    return {name: _reshape(flat[where], shapes[name]) for name, where in Layout.of(shapes).slices.items()}


def _array(value: Any, name: str, equation: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise TraceError(
            f"its {equation} returned a {type(value).__name__} for {name}; expected numbers. Return a number or an "
            "array.",
            port=name,
        ) from None
