"""Ports: declarations of a block's inputs, outputs, states and events."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, overload

import numpy as np

from .errors import DefinitionError, near
from .explained_calls import explain_calls
from .signals import Signal, UnknownAttributeError, Wireable
from .units import parse_unit

Shape = tuple[int, ...]
PortUnit = str | tuple[str, ...] | None


class Port:
    """An input, output, state or event, declared on a block's class: ``position = Input(shape=(2,), unit="m")``.

    Parameters
    ----------
    shape : tuple of int or None
        Shape of the signal, ``()`` for a scalar. None means any shape for an input, and the shape that the equations
        return for an output.
    unit : str, tuple of str or None
        Unit as FMI spells it; a tuple gives one for each entry. None: not declared, and not checked.
    description : str
        One line for people.
    nominal : float, optional
        Typical size, positive, in its unit; a solver's tolerances are relative to it.
    minimum, maximum : float, optional
        Range in its unit; an FMU refuses values outside.
    only_if : str or callable, optional
        Condition without which a block doesn't have the port: the name of a parameter or property that is true, or a
        function of the block. Without it every block of the class has the port.
    """

    def __init__(
        self,
        shape: Shape | None = (),
        unit: PortUnit = None,
        description: str = "",
        name: str = "",
        *,
        nominal: float | None = None,
        minimum: float | None = None,
        maximum: float | None = None,
        only_if: str | Callable[[Any], object] | None = None,
    ):
        self.shape, self.unit, self.description, self.name = _shape_of(shape), _unit_of(unit), description, name
        self.nominal, self.minimum, self.maximum, self.only_if = nominal, minimum, maximum, only_if
        if nominal is not None and not nominal > 0:
            raise DefinitionError(
                f"found nominal {nominal!r}; expected a positive number. Give the port's typical size."
            )

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name  # checked by check_port_names: Python would wrap an error raised here in a RuntimeError

    def _is_of(self, block: Any) -> bool:
        """Whether a block of the class has the port, with its parameters; see ``only_if``."""
        if self.only_if is None:
            return True
        return bool(getattr(block, self.only_if) if isinstance(self.only_if, str) else self.only_if(block))

    def _absence(self, block: Any) -> AttributeError:
        """Return the error of an output that a block doesn't have."""
        needs = f"{self.only_if} true" if isinstance(self.only_if, str) else "other parameters"
        return UnknownAttributeError(
            f"with these parameters it has no output {self.name!r}; expected {needs}. Give other parameters.",
            block=block.label,
        )

    def __repr__(self) -> str:
        unit = "" if self.unit is None else f", unit={self.unit!r}"
        return f"{type(self).__name__}({self.name}, shape={self.shape}{unit})"


def _shape_of(given: Any) -> Shape | None:
    """Return a declared shape as a tuple; a number is a vector's length."""
    if given is None:
        return None
    entries = (given,) if isinstance(given, int | np.integer) else given
    if isinstance(entries, tuple | list) and all(isinstance(n, int | np.integer) and n >= 0 for n in entries):
        return tuple(int(n) for n in entries)
    raise DefinitionError(
        f"found shape {given!r}; expected whole numbers, such as (3,). Give a unit by keyword: unit='m'."
    )


def _unit_of(given: Any) -> PortUnit:
    """Return a declared unit, one or a tuple of them."""
    if given is None:
        return None
    units = (given,) if isinstance(given, str) else given
    if not isinstance(units, tuple | list) or not all(isinstance(one, str) for one in units):
        raise DefinitionError(
            f"found unit {given!r}; expected a text, such as 'm', or one for each entry. Give a shape by keyword: "
            "shape=(3,)."
        )
    for one in units:
        parse_unit(one)
    return given if isinstance(given, str) else tuple(units)


def _known(kind: str, further: Mapping[str, Any], *more: str) -> dict[str, Any]:
    """Return further arguments of a port, those of every `Port`; refuse others."""
    for name in further:
        if name not in _OF_EVERY_PORT:
            raise DefinitionError(f"{kind} has no argument {name!r}. {near(name, (*more, *_OF_EVERY_PORT))}")
    return dict(further)


_OF_EVERY_PORT = ("nominal", "minimum", "maximum", "only_if")
_TAKEN = frozenset({"name", "inputs", "outputs", "states", "events", "replace", "parameters", "stepped"})
_TAKEN |= {"drawn_as", "drawn_inside"}


def check_port_names(cls: type) -> None:
    """Refuse ports of a class whose names have another meaning already."""
    for name in (n for n, item in vars(cls).items() if isinstance(item, Port)):
        if name == "T":
            why, step = "in equations T is the sample time in s", "another name, such as temperature or T_1"
        elif name in _TAKEN:
            why, step = "every block has an attribute of that name", f"another name, such as {name}_1"
        elif name.startswith("_"):
            why, step = "names that begin with an underscore are private", f"{name.strip('_') or 'another name'}"
        else:
            continue
        raise DefinitionError(f"a port can't be called {name!r}: {why}. Take {step}.", block=cls.__name__, port=name)


class DeclaredPorts:
    """The ports of one kind that a class declares: all of them, read on the class; on a block those that it has."""

    def __init__(self, declared: Mapping[str, Any]):
        self.declared = declared

    def __get__(self, block: Any, owner: type | None = None) -> Mapping[str, Any]:
        if block is None:
            return self.declared
        return {name: port for name, port in self.declared.items() if port._is_of(block)}


@explain_calls
class Input(Port):
    """An input. With ``default`` it may stay unwired. Its further arguments are those of `Port`.

    Parameters
    ----------
    tracks : str, optional
        Name of the block's own output whose true value comes back at this input, as for anti-windup by tracking. A loop
        that is cut between the two says so.
    models_plant : bool
        Whether a model of the plant in this block, such as an observer's, gets the plant's input here. Loops at the
        wire are then cut ahead of the plant, and not here.
    at_start_only : bool
        Whether the block takes it at its first instant alone, as an encoder does the true velocity. No loop of a linear
        model leads through it.
    """

    def __init__(
        self,
        shape: Shape | None = (),
        unit: PortUnit = None,
        description: str = "",
        *,
        default: Any = None,
        tracks: str | None = None,
        models_plant: bool = False,
        at_start_only: bool = False,
        name: str = "",
        **further: Any,
    ):
        further = _known(
            "Input", further, "shape", "unit", "description", "default", "tracks", "models_plant", "at_start_only"
        )
        super().__init__(shape, unit, description, name, **further)
        self.tracks, self.models_plant, self.at_start_only = tracks, models_plant, at_start_only
        self.default = None if default is None else np.asarray(default, dtype=float)

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self
        raise AttributeError(
            f"{self.name!r} is an input of {instance!r} and can't be read; wire it by calling the block, and read it "
            f"in an equation as u.{self.name}"
        )


@lru_cache(maxsize=64)
def _numbered(count: int) -> Mapping[str, Input]:
    return {f"u{i}": Input(shape=None, name=f"u{i}") for i in range(1, count + 1)}


def number_inputs(count: int) -> dict[str, Input]:
    """Return the inputs ``u1``, ``u2``, … of any shape; blocks with as many share them."""
    return dict(_numbered(count))


@explain_calls
class Output(Port):
    """An output; read on a block it is a `Signal`.

    Parameters
    ----------
    like : str, optional
        Name of the input whose unit it takes over. A shape that is not given follows from the equations: a sum of a
        scalar and a vector is a vector.
    secondary : bool, optional
        True for an output that is read by name only (``saturation.excess``). It is recorded like any other, but a call
        of the block neither unpacks into it nor means it.
    """

    def __init__(
        self,
        shape: Shape | None = (),
        unit: PortUnit = None,
        description: str = "",
        *,
        like: str | None = None,
        secondary: bool = False,
        name: str = "",
        **further: Any,
    ):
        further = _known("Output", further, "shape", "unit", "description", "like", "secondary")
        super().__init__(None if like and shape == () else shape, unit, description, name, **further)
        self.like, self.secondary = like, secondary

    @overload
    def __get__(self, instance: None, owner: type) -> Output: ...
    @overload
    def __get__(self, instance: Wireable, owner: type | None = None) -> Signal: ...
    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self
        if not self._is_of(instance):
            raise self._absence(instance)
        return Signal(instance, self.name)


@explain_calls
class State(Port):
    """A state: continuous with a `derivative`, sampled with an `update`.

    Parameters
    ----------
    shape : tuple of int, optional
        Shape of the state; without it the start value sets it.
    start : float, array_like, str or callable
        Start value, a number for all entries or one for each. A string names the parameter that holds it; a callable
        computes it from the block.
    like : str, optional
        Name of the input whose shape the state takes.
    output : bool, optional
        True when the state is an output as well, under the same name.
    discrete : bool, optional
        True for a state that is constant between events: only ``jump`` changes it.
    """

    def __init__(
        self,
        unit: PortUnit = None,
        description: str = "",
        *,
        shape: Shape | None = None,
        start: float | Any | str | Callable[[Any], Any] = 0.0,
        like: str | None = None,
        output: bool = False,
        discrete: bool = False,
        name: str = "",
        **further: Any,
    ):
        further = _known("State", further, "unit", "description", "shape", "start", "like", "output", "discrete")
        super().__init__(None, unit, description, name, **further)
        if shape is not None and like is not None:
            raise DefinitionError(
                f"found shape={shape!r} and like={like!r}; expected one of them. Leave out the one that doesn't hold."
            )
        self.start, self.like, self.output, self.discrete = start, like, output, discrete
        self.own_shape = _shape_of(shape)

    def start_value(self, block: object, shapes: Mapping[str, Shape]) -> np.ndarray:
        """Return the start value for ``block``, with inputs of the given shapes, as a float64 array."""
        start = self.start
        if isinstance(start, str):
            start = getattr(block, start)
        elif callable(start):
            start = start(block)
        value = np.asarray(0.0 if start is None else start, dtype=float)
        shape = shapes[self.like] if self.like else self.own_shape
        if shape is None or value.shape == shape:
            return value.copy()
        return np.array(np.broadcast_to(value, shape))

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self
        if self.output and self._is_of(instance):
            return Signal(instance, self.name)
        if self.output:
            raise self._absence(instance)
        raise AttributeError(f"{self.name!r} is a state of {instance!r}: it lives in the run, not on the block.")


@explain_calls
class Event(Port):
    """An event of a continuous block: one of its ``indicators`` crosses zero in a direction.

    An indicator is in one of two domains, z > 0 or z ≤ 0. A change of domain in the declared direction fires the event,
    and the block's ``jump`` gives the states after it. No event fires at the start, whatever the domains are. One that
    is exactly 0 at the start, or that its own event's jump leaves in contact, is in neither: the direction in which it
    leaves 0 fires the event if it is the declared one.

    Parameters
    ----------
    direction : {"both", "rising", "falling"}
        Rising is from z ≤ 0 to z > 0.
    description : str
        One line for people.
    nominal : float
        Typical size of the indicator, positive; "close to zero" is relative to it.
    hysteresis : float
        Distance beyond zero, in the indicator's unit, at which the event fires; it ends chattering. It is used in
        diagrams; an exported FMU has its own.
    only_if : str or callable, optional
        Condition without which a block doesn't have the event, as of a `Port`.
    """

    def __init__(
        self,
        direction: str = "both",
        description: str = "",
        *,
        nominal: float = 1.0,
        hysteresis: float = 0.0,
        name: str = "",
        only_if: str | Callable[[Any], object] | None = None,
    ):
        super().__init__((), None, description, name, nominal=float(nominal), only_if=only_if)
        self.hysteresis = float(hysteresis)
        if not self.hysteresis >= 0.0:
            raise DefinitionError(f"found hysteresis {hysteresis!r}; expected a number of zero or more. Give one.")
        if direction not in ("both", "rising", "falling"):
            raise DefinitionError(
                f"found direction {direction!r}; expected 'both', 'rising' or 'falling'. Give one of these."
            )
        self.direction = direction

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self
        raise AttributeError(f"{self.name!r} is an event of {instance!r}: it happens in a run, and can't be read.")
