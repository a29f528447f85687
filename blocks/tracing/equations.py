"""Checks of a block's equations: their arguments, and the values that they return."""

from __future__ import annotations

import functools
import inspect
import linecache
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from casadi import ArrayInterface

from ..core import Block, DefinitionError, LoopwrightError, Port, Shape, ShapeError, State, TraceError, near
from .symbols import flat_column, size
from .traced_functions import NotTracedError

_ARGUMENTS = {
    "output": ("t", "x", "u"),
    "derivative": ("t", "x", "u"),
    "update": ("t", "x", "u"),
    "guards": ("t", "x", "u"),
    "indicators": ("t", "x", "u"),
    "jump": ("t", "x", "u", "fired"),
    "initial": ("u",),
    "constants": ("T", "method"),
    "next_instant": ("t",),
}
_SAMPLED = ("output", "update", "guards")  # may take T as well


def check_definition(block: Block) -> None:
    """Refuse equations with other arguments than theirs, and ports that hide an equation."""
    cls = type(block)
    ports: dict[str, Port] = {**block.inputs, **block.states, **block.outputs, **block.events}
    for name in ports:
        hides = isinstance(inspect.getattr_static(cls, name, None), Port)  # ports made by a property hide nothing
        if hides and (name in _ARGUMENTS or hasattr(Block, name)):
            owner = "an equation" if name in _ARGUMENTS else "an attribute of every block"
            raise DefinitionError(f"a port can't be called {name!r}, the name of {owner}; rename the port.", port=name)
    for equation, names in _ARGUMENTS.items():
        function = getattr(block, equation, None)
        if function is None:
            continue
        last = ", and T where the sample time is needed" if equation in _SAMPLED else ""
        expected = f"expected {equation}(self, {', '.join(names)}){last}"
        if not callable(function):
            raise TraceError(f"its {equation} is {_describe(function)}; {expected}. Define it as a function.")
        try:
            signature = inspect.signature(function)
            given = {"T": None} if equation in (*_SAMPLED, "derivative") and "T" in signature.parameters else {}
            signature.bind(*names, **given)
        except (TypeError, ValueError):
            written = str(inspect.signature(getattr(cls, equation))).partition(" ->")[0]
            raise TraceError(f"found {equation}{written}; {expected}. Give it these arguments.") from None


def takes_update(block: Block, sampled: bool) -> bool:
    """Whether the states advance by ``update``: in a sampled subsystem, else where nothing else advances them."""
    if not hasattr(block, "update"):
        return False
    return sampled or not (hasattr(block, "derivative") or (block.events and not block.memory))


def is_only_sampled(block: Block) -> bool:
    """Whether a block has no meaning in continuous time: its states advance from sample to sample alone."""
    return takes_update(block, False) and not block.memory


def trace_error(error: Exception, block: Block, equation: str) -> TraceError:
    """Return the error of a trace that failed, with the line of the user's equations."""
    # the line is found by its file, which a notebook's cell and a script have too, and helpers of the equation share
    function: Any = inspect.unwrap(block.equation_function(equation))
    while isinstance(function, functools.partial):
        function = function.func
    if not hasattr(function, "__code__"):  # an object that can be called
        function = type(function).__call__
    file = getattr(getattr(function, "__code__", None), "co_filename", None)
    line, step = "", error.__traceback__
    while step is not None:
        if step.tb_frame.f_code.co_filename == file:
            code = linecache.getline(file, step.tb_lineno).strip()
            line = f" in line {step.tb_lineno} of {file}" + (f", {code!r}" if code else "")
        step = step.tb_next
    instead = block.untraced_twin
    if isinstance(error, NotTracedError):  # says what to write
        other = f", or take {instead}, which is not traced" if instead else ""
        return TraceError(f"its {equation} can't be traced{line}: {error}{other}.")
    text = f"its {equation} can't be traced{line}: {type(error).__name__}: {str(error).rstrip('.')}."
    if isinstance(error, AttributeError) and (known := getattr(error.obj, "_fields", ())):
        text += f" {near(str(error.name), known)}"
    if isinstance(error, NameError | ZeroDivisionError | AttributeError | KeyError | ImportError):
        advice = _own_name(error.name, block) if isinstance(error, NameError) else ""
        mistake = TraceError(f"{text} {advice or 'Correct the equation there.'}")
        mistake.is_mistake = True
        return mistake
    return TraceError(
        f"{text} Use NumPy functions of {block.traced_of}: np.where for branches, np.stack for vectors, np.sqrt and "
        f"not math.sqrt{f', or {instead}, which is not traced' if instead else ''}."
    )


def _own_name(name: str | None, block: Block) -> str:
    """Return how an equation reads what it has called by its bare name, as far as the block has it."""
    owners = {"self": block.parameters, "x": block.states, "u": block.inputs}
    owner = next((owner for owner, known in owners.items() if name in known), None)
    return f"Write {owner}.{name}." if owner else ""


def _describe(value: Any) -> str:
    """Name in words the value that an equation returned."""
    if value is None:
        return "nothing"
    if fields := getattr(value, "_fields", ()):
        return f"all of {type(value).__name__} ({', '.join(fields)})"
    shape = _shape(value)
    if isinstance(value, ArrayInterface | np.ndarray | float | int | np.number):
        return f"an array of shape {shape}" if shape else "a single value"
    if isinstance(value, list | tuple | Mapping):
        keys = f" ({', '.join(map(str, value))})" if isinstance(value, Mapping) and value else ""
        return f"a {type(value).__name__} of {len(value)}{keys}"
    return f"a {type(value).__name__}" if not isinstance(value, str) else repr(value)


def _shape(value: Any) -> Shape | None:
    """Return the shape of a traced value or of numbers, None for anything else."""
    if isinstance(value, ArrayInterface):
        return tuple(value.shape)
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # symbols in a list
        return None
    return array.shape if array.dtype.kind in "biuf" else None


def parts_of(result: Any, names: list[str], equation: str) -> list[Any]:
    """Return the values of an equation, one for each name."""
    if result is None and names:
        raise TraceError(f"its {equation} returned nothing; expected {_describe_values(names)}. End it with a return.")
    if len(names) == 1:
        return [result]
    if isinstance(result, list | tuple) and len(result) == len(names):
        return list(result)
    raise TraceError(
        f"its {equation} returned {_describe(result)}; expected {_describe_values(names)}. Write return "
        f"{', '.join(names)}."
    )


def _describe_values(names: list[str]) -> str:
    return f"the value of {names[0]}" if len(names) == 1 else f"a tuple of {len(names)}: {', '.join(names)}"


def match_ports(
    result: Any, declared: Mapping[str, Shape | None], equation: str
) -> tuple[dict[str, Any], dict[str, Shape]]:
    """Return columns and shapes of the values that an equation returned, by the names of the declared ports."""
    made, shapes = {}, {}
    names = list(declared)
    for name, part in zip(names, parts_of(result, names, equation), strict=True):
        made[name], shapes[name] = _column(part, declared[name], name, equation)
    return made, shapes


def _column(part: Any, expected: Shape | None, name: str, equation: str) -> tuple[Any, Shape]:
    shape = _shape(part)
    if shape is None:
        n = len(part) if isinstance(part, list | tuple) else 0
        wanted = (
            "a number or an array" if expected is None else f"a value of shape {expected}" if expected else "one value"
        )
        if fields := getattr(part, "_fields", ()):
            step = f"Return one of them, such as {type(part).__name__}.{fields[0]}."
        elif isinstance(part, Mapping):
            step = "Return the value itself."
        elif n > 1 or (n and expected):
            step = "Build a vector with np.stack: return np.stack([…])."
        elif n:
            step = "Return the value itself, without brackets or a comma behind it."
        else:
            step = "Compute it with NumPy functions of t, x and u."
        raise TraceError(f"its {equation} returned {_describe(part)} for {name}; expected {wanted}. {step}", port=name)
    if expected is not None and shape != expected:
        if len(expected) == 1 and size(shape) == 1:
            step = f"Return a vector: np.stack([…]) of {expected[0]}."
        else:
            step = "Return another one, or declare this shape."
        raise ShapeError(f"its {equation} gives shape {shape}; expected {expected} as declared. {step}", port=name)
    flat = flat_column(part)
    if flat.numel() != size(shape):
        raise ShapeError(
            f"its {equation} gives {flat.numel()} entries for shape {shape}; index it explicitly.", port=name
        )
    return ca.densify(flat), shape


def guards_of(result: Any) -> dict[str, Any]:
    """Return the guards' scalar columns by name."""
    if not isinstance(result, Mapping) or not all(isinstance(name, str) for name in result):
        raise TraceError(
            f"its guards returned {_describe(result)}; expected a dictionary of expressions by name, which must stay "
            "positive, such as {'margin': 1.0 - x.y}. Return one."
        )
    made = {}
    for name, value in result.items():
        shape = _shape(value)
        if shape != ():
            raise ShapeError(
                f"its guard {name!r} is {_describe(value)}; expected a scalar. Take np.min of it, or name each entry."
            )
        made[name] = flat_column(value)
    return made


def start_values(block: Block, shapes: Mapping[str, Shape]) -> dict[str, np.ndarray]:
    """Return the start value of every state, for inputs of the given shapes."""
    values = {}
    for name, port in block.states.items():
        if port.like is not None and port.like not in shapes:
            raise DefinitionError(
                f"found like={port.like!r}; expected an input: {', '.join(shapes) or 'there are none'}. Name one, "
                "or give shape=….",
                port=name,
            )
        if isinstance(port.start, str) and port.start not in block.parameters and not hasattr(block, port.start):
            known = ", ".join(block.parameters) or "there are none"
            raise DefinitionError(
                f"found start={port.start!r}; expected a number or the name of a parameter: {known}. Give "
                "one of these, or start=0.0.",
                port=name,
            )
        try:
            values[name] = port.start_value(block, shapes)
        except LoopwrightError:
            raise
        except (TypeError, ValueError) as error:
            given = getattr(block, port.start, None) if isinstance(port.start, str) else port.start
            shape = _shape(given)
            wanted = port.own_shape if port.like is None else shapes[port.like]
            if wanted is None or shape is None:
                raise DefinitionError(
                    f"found start={given!r} ({error}); expected numbers. Give a number, a vector or a parameter.",
                    port=name,
                ) from error
            raise ShapeError(
                f"found a start value of shape {shape}; expected a number, or shape {wanted} as "
                f"{'it is declared' if port.like is None else f'the input {port.like!r} has'}. Give one of these.",
                port=port.start if isinstance(port.start, str) else name,
            ) from error
    return values


def start_shapes(block: Block) -> list[Shape]:
    """Return the shapes of the start values as they are written, before any is broadcast to an input's shape."""
    shapes = []
    for port in block.states.values():
        alone = State(start=port.start, shape=port.own_shape)
        shapes.append(tuple(alone.start_value(block, {}).shape))
    return shapes


def initial_state(block: Any, states: Mapping[str, Shape], u: Any) -> np.ndarray:
    """Return the state that ``initial`` computes from the inputs ``u``, flat."""
    return _flat_states(block.initial(u), states, "initial")


def state_after_start(block: Any, states: Mapping[str, Shape], x: Any, u: Any, T: float | None) -> np.ndarray:
    """Return the state that ``after_start`` gives, flat; ``T`` is the sample time in s, None in continuous time."""
    return _flat_states(block.after_start(x, u, T), states, "after_start") if states else np.zeros(0)


def _flat_states(made: Any, states: Mapping[str, Shape], equation: str) -> np.ndarray:
    names = list(states)
    columns = [np.zeros(0)]
    for name, part in zip(names, parts_of(made, names, equation), strict=True):
        shape = _shape(part)
        if shape is None:
            raise TraceError(
                f"its {equation} returned {_describe(part)} for {name}; expected numbers. Return "
                "numbers of the state's shape.",
                port=name,
            )
        if size(shape) != size(states[name]):
            raise ShapeError(
                f"its {equation} gives shape {shape}; expected {states[name]}, as the state has. Return that shape, or "
                "declare State(shape=…).",
                port=name,
            )
        columns.append(np.ravel(np.asarray(part, dtype=float)))
    return np.concatenate(columns)
