"""Functions as blocks: functions that can be traced, and any Python callable."""

from __future__ import annotations

import inspect
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..core import (
    Array,
    Block,
    Input,
    Output,
    ParameterError,
    PortUnit,
    Shape,
    Units,
    kinds,
    parameter,
    result_unit,
    shorten,
)

_SIGNS: dict[object, str] = {np.divide: "÷", np.absolute: "|u|", np.sqrt: "√u", np.power: "u₁^u₂"}


class Function(Block):
    """NumPy-style function of the inputs, traced like the equations of every block: y = f(u₁, …).

    ``Function(np.sin)(u)``, ``Function(lambda a, b: a * b)(a, b)``. The inputs have the names of the function's
    arguments, except arguments with a default, which keep it. The inputs of a NumPy function are ``u``, or ``u1``,
    ``u2``, …; its result has the unit that follows from theirs. ``np.sin(u)`` of a signal makes such a block, ``a / b``
    makes ``Function(np.divide)``. A function that can't be traced is refused when the diagram is built;
    `PythonFunction` takes any. Two such blocks are equal if their functions are one object. The block can be pickled if
    the function can, which needs a name in a module. In a trace ``np.minimum``, ``np.maximum`` and ``np.clip`` replace
    a NaN by their other argument: write ``np.where`` instead.

    Raises
    ------
    ParameterError
        For an object that is no function, or whose arguments can't be found.
    TraceError
        For a function that can't be traced, or returns another number of values than ``results`` names, when the
        diagram is built.
    """

    function: object = parameter(
        kw_only=False,
        description="the function, of one array for each input",
        kind=kinds.function.worded("a function, such as np.sin or lambda a, b: a * b", "Give one."),
    )
    arguments: object = parameter(
        default=None, description="names of the inputs, or shapes by name; None takes the function's own names"
    )
    results: object = parameter(
        default="y",
        description="name of the output, names in the order of the tuple returned, or shapes by name",
    )

    def check(self) -> None:
        """Refuse names that can't be ports."""
        for name in self.inputs.keys() & self.outputs.keys():
            raise self._refuse("results", f"{name!r}, the name of an input too", "another name")

    traced_of = "its arguments"
    untraced_twin = "PythonFunction"

    def equation_function(self, equation: str) -> Callable[..., Any]:
        """Return the function, which is the only equation."""
        return self.function  # type: ignore[return-value]

    @property
    def label(self) -> str:
        """Name for messages and for numbering: the name given, else the function's."""
        own = getattr(self.function, "__name__", "")
        return self.name or self._hint or (own if own.isidentifier() else "function")

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """One input for each argument."""
        named = self._arguments() if self.arguments is None else self.arguments
        return {n: Input(shape, name=n) for n, shape in self._shapes("arguments", named).items()}

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """One output for each result."""
        return {n: Output(shape, name=n) for n, shape in self._shapes("results", self.results).items()}

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        return _SIGNS.get(self.function, "")

    def output(self, t: Array, x: Any, u: Any) -> Any:
        """Return the function's result."""
        return self.function(*u)  # type: ignore[operator]

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit of a NumPy function's result."""
        return dict.fromkeys(self.outputs, result_unit(self.function, units)) if len(self.outputs) == 1 else {}

    def _refuse(self, port: str, found: str, expected: str) -> ParameterError:
        return ParameterError(f"found {found}; expected {expected}. Give these.", block=self.label, port=port)

    def _arguments(self) -> list[str]:
        """Return the names of the function's arguments that have no default."""
        function: Any = self.function
        if isinstance(function, np.ufunc):
            return ["u"] if function.nin == 1 else [f"u{i + 1}" for i in range(function.nin)]
        try:
            every = inspect.signature(function).parameters.values()
        except (TypeError, ValueError):  # a function of C code
            every = {}.values()
        needed = [p for p in every if p.default is p.empty and p.kind is not p.VAR_KEYWORD]
        if not needed or any(p.kind in (p.VAR_POSITIONAL, p.KEYWORD_ONLY) for p in needed):
            raise self._refuse(
                "arguments",
                f"the function {self.label}, whose number of arguments can't be found",
                "names for the inputs, such as arguments=('a', 'b')",
            )
        return [p.name for p in needed]

    def _shapes(self, parameter: str, given: Any) -> dict[str, Shape | None]:
        """Return the names of ports with the shapes given; None for a shape that is not given."""
        if not kinds.names.holds(given) and not isinstance(given, Mapping):
            raise self._refuse(parameter, shorten(given), "names, such as ('a', 'b'), or shapes by name")
        named = given if isinstance(given, Mapping) else dict.fromkeys([given] if isinstance(given, str) else given)
        shapes: dict[str, Shape | None] = {}
        for name, shape in named.items():
            taken = hasattr(Block, str(name)) or name in type(self).parameter_specs
            if taken or not str(name).isidentifier() or str(name).startswith("_"):
                raise self._refuse(parameter, f"{name!r}", "names such as 'position', that no attribute of a block has")
            try:
                whole = (shape,) if isinstance(shape, int) else shape
                shapes[str(name)] = None if whole is None else tuple(operator.index(n) for n in whole)
            except TypeError:
                raise self._refuse(
                    parameter, f"{shape!r} as the shape of {name!r}", "one such as (3,), or () for a number"
                ) from None
        return shapes


class PythonFunction(Function):
    """Any Python callable of the inputs: y = f(u₁, …), called with NumPy's numbers and arrays.

    It may branch, loop, look things up and call foreign code. It should depend on nothing but its arguments, since a
    solver calls it more often than there are samples. Every output counts as fed through from every input. A
    linearization or an implicit step takes its derivatives by central differences. It is neither compiled nor exported
    to an FMU. An exception stops the run, as the cause of a `SimulationError` that names the block.

    ``PythonFunction(f)(a, b)`` calls ``f(a, b)``. If a result has no declared shape, f is called once, with positive
    numbers, when the diagram is built; ``PythonFunction(f, results={"y": (3,)})`` declares it. Wire a `Clock` for the
    time. The block can be pickled if the function can.

    Raises
    ------
    ParameterError
        For an object that is no function, or whose arguments can't be found.
    TraceError
        For a trial call that fails, or returns another number of values than ``results`` names, when the diagram is
        built.
    """

    opaque = True


__all__ = ["Function", "PythonFunction"]
