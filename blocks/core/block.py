"""The base of all blocks."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any, ClassVar, Self

import numpy as np

from .docstrings import port_section, with_section
from .errors import (
    DefinitionError,
    DoubleDriveError,
    GuardError,
    UnknownNameError,
    UnwiredInputError,
    WiringError,
    close_names,
    near,
)
from .ports import DeclaredPorts, Event, Input, Output, Port, PortUnit, State, check_port_names
from .shown import ShownMembers, documented
from .signals import (
    Call,
    Signal,
    UnknownAttributeError,
    Wireable,
    as_signal,
    check_name,
    primary_outputs,
)
from .tables import Grid, Sheet, ShownAsTable
from .values import Array, Value

SOLVED = "trapezoidal step"
"""Name of the guard of a block's trapezoidal step, which fails if Newton's steps don't solve it."""

_ABSENT = frozenset(
    {"output", "derivative", "update", "indicators", "jump", "guards", "initial", "constants", "after_start"}
)
_ABSENT |= {"inputs", "outputs", "states", "events"}


class Block(ShownAsTable, Value, Wireable, metaclass=ShownMembers):
    """A signal-flow block: parameters, ports, and equations that are written once.

    A subclass declares ports and parameters, and writes its equations as plain functions of ``(t, x, u)`` with NumPy's
    names. The same functions are run, traced, differentiated and compiled::

        class Lag(Block):
            '''First-order lag: T₁ ẏ = u − y.'''

            time_constant: float = parameter(unit="s", above=0.0)
            u = Input()
            y = State(output=True)

            def derivative(self, t, x, u):
                return (u.u - x.y) / self.time_constant

    ``x`` and ``u`` are named tuples of the states and the inputs, in the order of declaration. A function returns one
    value for one port (or state), else a tuple in the order of declaration. It must not change its arguments, nor
    depend on anything but them and the parameters. Build vectors with ``np.stack``, and branches with ``np.where``.

    A block has continuous states if it has a ``derivative``, sampled ones if it has an ``update`` alone. A continuous
    block in a sampled subsystem is discretized by the subsystem's method, unless it has its own ``update``.
    A continuous block may declare events and discrete states, which its ``jump`` changes. With an ``update`` as well it
    works in both kinds of subsystem: its events act in a continuous one, its ``update`` in a sampled one. The diagram
    itself counts as the outermost subsystem.

    All equations are optional. ``output``, ``update`` and ``guards`` may take ``T`` as a last argument: the sample time
    in s. Declared as ``T=None``, it is None in a continuous subsystem.

    Equations
    ---------
    output(t, x, u)
        The outputs that are not states.
    derivative(t, x, u)
        Time derivative of the states that are not discrete.
    indicators(t, x, u)
        One expression for each `Event`: it fires where the expression crosses zero.
    jump(t, x, u, fired)
        All states after an event; ``fired`` is a named tuple of 1 for the events that fire at this instant, 0 else.
    update(t, x, u)
        The states at the next tick.
    guards(t, x, u)
        Expressions by name that must stay positive, else the run stops with `guard_error`.
    initial(u)
        Initial states from the inputs at the start: plain Python, not traced.
    after_start(x, u, T)
        States for a block whose equations have a branch of their start, by a state or by ``t > 0``: the states after
        that branch, with which its outputs are those of the start. Plain Python, not traced; T is None in a continuous
        subsystem. Operating points take these states. Linear models take the equations just after t, so that they have
        the slopes of all later ticks. A block without such a branch doesn't have it.
    constants(T, method)
        Numbers computed from the parameters in plain Python, which the equations then read as attributes.
    next_instant(t)
        The next time strictly after t at which the outputs or their derivatives are not smooth, ``math.inf`` if there
        is none: plain Python, not traced. A solver lands there, and takes its left limits just before. A sampled
        subsystem does not call it.

    Parameters
    ----------
    name : str, optional
        Name in the diagram; without one the class name in snake case, numbered where it repeats.

    Attributes
    ----------
    parameters : mapping of str
        Value of each parameter by its name.
    inputs, outputs, states, events : mapping of str
        Declaration of each port by its name.

    Methods
    -------
    named(*names)
        Name the wires of the outputs of a block without inputs.
    replace(**changes)
        Return a variant with other parameters, or another name; it is another node.
    """

    _keywords: ClassVar[frozenset[str]] = frozenset({"name"})
    memory: ClassVar[bool] = False
    """True where the states are only a warm start for the outputs, such as a projection's last foot point."""
    opaque: ClassVar[bool] = False
    """True where the equations are not traced: any Python, called with numbers, differentiated by differences."""
    quanta: ClassVar[Mapping[str, str]] = {}
    """Inputs that outputs follow in equal steps, as of a converter or an encoder, each with the parameter that holds
    the step's size. Linear models take such a block by its mean slope; other rounding only where it is asked for."""
    same_units: ClassVar[bool | tuple[str, ...]] = False
    """True where all inputs must be in one unit, as in a sum; or the names of those that must, as of a set-point and
    a measured value."""
    units_by_entry: ClassVar[bool] = False
    """True where `output_units` gets a tuple, one unit for each entry, of each input whose shape is known."""
    converts_units: ClassVar[bool | None] = None
    """True where a wire to or from the block is converted if its ends are in different units of one dimension; False
    where the block's user could ask for that."""
    computed_from: ClassVar[frozenset[str]] = frozenset()
    """Parameters, such as a seed, that the equations see through ``constants(T, method)`` alone, which then depends
    on neither T nor the method: another value of theirs changes numbers, and no code."""
    stops: ClassVar[str | None] = None
    """Name of a scalar output that ends the run, without an error, at the first instant at which it is above 0.5."""
    transport: ClassVar[bool] = False
    """True where, in continuous time, the solver gives ``y`` as the input ``u`` a time ``delay`` ago."""
    stepped: ClassVar[bool] = False
    """True where a run steps the block from one tick to the next, as it does an FMU.

    Instead of equations it has ``instantiate(wired, stop_time, start_time=t)``, a context manager: ``wired`` names the
    inputs that the run sets, times are in s. It yields a plant, with the methods of the simulation's ``Plant``.
    """

    in_model_exchange: ClassVar[bool] = False
    """True where a run evaluates the equations by calls of the block, as those of an FMU in model exchange.

    It has continuous states that a solver integrates, and events.

    Instead of equations it has ``dependence`` and ``exchange(wired, start_time)``, a context manager: ``wired`` names
    the inputs that the run sets, times are in s. It yields the simulation's ``ModelExchangeBlock``.
    """

    inputs: ClassVar[Mapping[str, Input]] = {}
    outputs: ClassVar[Mapping[str, Output | State]] = {}
    states: ClassVar[Mapping[str, State]] = {}
    events: ClassVar[Mapping[str, Event]] = {}
    name: str | None = None
    _hint: ClassVar[str | None] = None
    traced_of: ClassVar[str] = "(t, x, u)"
    """Arguments of the equations, for messages."""
    untraced_twin: ClassVar[str] = ""
    """Name of the block that takes functions this one can't trace, for messages."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        check_port_names(cls)
        super().__init_subclass__(**kwargs)
        ports: dict[str, Port] = {}
        for base in reversed(cls.__mro__):
            for name, item in vars(base).items():
                if isinstance(item, Port):
                    ports[name] = item
                else:
                    ports.pop(name, None)
        for clash in ports.keys() & cls.parameter_specs.keys():
            raise DefinitionError("a port and a parameter share this name; rename one.", block=cls.__name__, port=clash)
        for attribute in ("inputs", "outputs", "states", "events"):
            chosen = {k: p for k, p in ports.items() if _is_kind(p, attribute)}
            if not isinstance(getattr(cls, attribute), property):  # ports that follow from the parameters
                plain = all(port.only_if is None for port in chosen.values())
                setattr(cls, attribute, chosen if plain else DeclaredPorts(chosen))
            cls.__doc__ = with_section(cls.__doc__ or "", attribute.capitalize(), port_section(chosen))
        for source, held in cls.quanta.items():
            for name, known in ((source, ports), (held, cls.parameter_specs)):
                if name not in known:
                    raise DefinitionError(
                        f"found quanta={dict(cls.quanta)!r}; expected an input, and the parameter that holds its step. "
                        f"{near(name, known)}",
                        block=cls.__name__,
                    )
        for name, port in ports.items():
            if isinstance(port.only_if, str) and not (
                port.only_if in cls.parameter_specs or hasattr(cls, port.only_if)
            ):
                conditions = [n for n in (*cls.parameter_specs, *vars(cls)) if not n.startswith("_")]
                raise DefinitionError(
                    f"found only_if={port.only_if!r}; expected a parameter or property of this block. "
                    f"{near(port.only_if, conditions)}",
                    block=cls.__name__,
                    port=name,
                )
            tracked = getattr(port, "tracks", None)
            if tracked is not None and not (tracked in ports and _is_kind(ports[tracked], "outputs")):
                raise DefinitionError(
                    f"found tracks={tracked!r}; expected an output of this block. {near(tracked, cls.outputs)}",
                    block=cls.__name__,
                    port=name,
                )
        if isinstance(cls.inputs, Mapping):
            for name, port in ports.items():
                like = getattr(port, "like", None)
                if like is not None and like not in cls.inputs:
                    raise DefinitionError(
                        f"found like={like!r}; expected an input of this block. {near(like, cls.inputs)}",
                        block=cls.__name__,
                        port=name,
                    )

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        name = kwargs.get("name")
        object.__setattr__(self, "name", None if name is None else check_name(name))
        super().__init__(*args, **kwargs)

    @property
    def label(self) -> str:
        """Name for messages and for numbering: the name given, else the class name in snake case."""
        return self.name or self._hint or re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(self).__name__).lower()

    @property
    def drawn_as(self) -> str:
        """Kind of the block as a drawing names it: its class."""
        return type(self).__name__

    @property
    def drawn_inside(self) -> str:
        """Text that a drawing shows inside the block, such as ``"K / T s + 1"``, a fraction; empty for the usual."""
        return ""

    @property
    def idle_parameters(self) -> frozenset[str]:
        """Names of the parameters that have no effect with the values of the others; a report doesn't list them."""
        return frozenset()

    @property
    def absent_states(self) -> Mapping[str, str]:
        """Reason, and a next step, for each state that other parameters give the block, and its own leave out."""
        return {}

    @property
    def starts_from_inputs(self) -> bool:
        """Whether the initial state is computed from the inputs at the start, by ``initial``."""
        return hasattr(self, "initial")

    def next_instant(self, t: float) -> float:
        """Return the next time after t at which the outputs are not smooth in time: never, unless overridden."""
        return math.inf

    def input_breaks(self) -> Mapping[str, Array]:
        """Return, by input, the values at which the outputs are not smooth, such as the breakpoints of a table.

        In a continuous subsystem, where such an input is the time (a clock, with gains and constants), a solver lands
        on them.
        """
        return {}

    def time_scale(self) -> float:
        """Return the time in s within which the outputs change by themselves, such as a tenth of a period.

        In a continuous subsystem events are looked for once in that time, and no step of a solver is longer than five
        times it. The default is infinity: no limit.
        """
        return math.inf

    def dependence(self, equation: str) -> Mapping[str, Array]:
        """Return what depends on what in a block in model exchange.

        Parameters
        ----------
        equation : str
            An output, or ``"next"`` for the rates of all states.

        Returns
        -------
        mapping of str to ndarray of bool
            By input, and by ``"t"`` and ``"x"`` for time and all states: which entries of the equation depend on which
            of these.
        """
        return {}

    def output_units(self, units: Mapping[str, PortUnit]) -> Mapping[str, PortUnit]:
        """Return the units of outputs that follow from those of the inputs, as of a product; none, unless overridden.

        It goes without saying for an output that is ``like`` an input.

        Parameters
        ----------
        units : mapping of str to unit
            Unit of each input; None where it is not known.

        Raises
        ------
        UnitError
            For units that the block does not take. Its port is the input, and its text begins with "expected".
        """
        return {}

    def replace(self, **changes: Any) -> Self:
        """Return a variant with some parameters (or the name) changed; it is another node."""
        result = type(self)(**{**self.parameters, "name": self.name, **changes})
        object.__setattr__(result, "_hint", self._hint)
        return result

    def __call__(self, *args: Any, **kwargs: Any) -> Call:
        """Wire the block: signals by position in the order of the inputs, or by keyword."""
        return Call(self, _bind(self, args, kwargs))

    def named(self, *names: str) -> Call:
        """Name the wires of the outputs of a block without inputs; see `Call.named`."""
        return self().named(*names)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in _ABSENT or name in self.parameter_specs:
            raise AttributeError(name)  # optional equations are probed with hasattr; anything else would recurse
        if isinstance(port := getattr(type(self), name, None), Port):
            return port.__get__(self)  # type: ignore[attr-defined]  # raises the port's own error: it is no signal
        if name in self.outputs:  # outputs that follow from the parameters
            return Signal(self, name)
        known = {*self.outputs, *self.parameter_specs}
        hint, close = near(name, known), close_names(name, sorted(known))
        if self.outputs and close and not any(output in close for output in self.outputs):
            hint += f" Its outputs: {', '.join(self.outputs)}."
        raise UnknownAttributeError(f"it has no output or parameter {name!r}. {hint}", block=self.label)

    def __dir__(self) -> list[str]:
        outputs = {name for name in self._ipython_key_completions_() if name.isidentifier()}
        return sorted({"name", *self.parameter_specs, *documented(type(self)), *outputs})

    def _signal(self) -> Signal:
        if any(port.default is None for port in self.inputs.values()) or len(primary_outputs(self.outputs)) != 1:
            raise _signal_error(self)
        return Signal(self, primary_outputs(self.outputs)[0])

    def __iter__(self) -> Iterator[Signal]:
        names = primary_outputs(self.outputs)
        if len(names) < 2 or any(port.default is None for port in self.inputs.values()):
            return iter(self._signal())  # one signal, or none: the error says what to do
        return iter([Signal(self, name) for name in names])

    def advise_unwired(self, ports: Collection[str]) -> str:
        """Return what else gives values to inputs without a wire, as the end of an error's text; "" if nothing."""
        return ""

    def entries_of(self, parameter: str) -> Collection[str]:
        """Return the names that entries of a mapping among its parameters may have, apart from those that it holds."""
        return ()

    def check_place(self, old: Block, wired: Collection[str], read: Collection[str]) -> None:
        """Check that the block fits the wires of another one; `Diagram.replace` calls it.

        The diagram's own checks follow in any case. A block overrides it to say more about several ports together.

        Parameters
        ----------
        old : Block
            Block that it replaces.
        wired : collection of str
            Inputs of that block that are wired.
        read : collection of str
            Outputs of that block that are wired to others, named or results of the diagram.
        """

    def __repr__(self) -> str:
        text = super().__repr__()
        return text if self.name is None else f"{text[:-1]}{', ' if text[-2] != '(' else ''}name={self.name!r})"

    def _sheet(self) -> Sheet:
        own = [(n, getattr(self, n), s.unit, s.description) for n, s in type(self).parameter_specs.items()]
        line = (type(self).__doc__ or "").strip().partition("\n")[0]
        columns = "", "unit", "shape", "description"
        kinds = (("Inputs", self.inputs), ("Outputs", self.outputs), ("States", self.states))
        return Sheet(
            type(self).__name__ + (f" {self.name!r}" if self.name else ""),
            (("", line),),
            (
                Grid("Parameters", ("", "value", "unit", "description"), tuple(own)),
                *(Grid(kind, columns, tuple(_port_row(n, p) for n, p in ports.items())) for kind, ports in kinds),
            ),
        )

    def equation_function(self, equation: str) -> Callable[..., Any]:
        """Return the function that a user wrote for an equation, for messages."""
        return getattr(type(self), equation)  # type: ignore[no-any-return]

    def guard_error(self, name: str, value: float, u: Any, y: Any, x: Any = None) -> GuardError:
        """Return the error of a failed guard; ``u``, ``y``, ``x`` are named tuples of inputs, outputs and states."""
        if name == SOLVED:
            return GuardError(
                f"its trapezoidal step is not solved: after the last Newton step a state is still about {-value:.3g} "
                "away; expected less than 1e-9 of the state. Take a smaller sample time, or another method."
            )
        return GuardError(
            f"guard {name!r} is {value:.6g}; expected a positive value. Check its inputs: "
            f"{', '.join(f'{k} = {np.asarray(v).tolist()}' for k, v in u._asdict().items())}."
        )


def _port_row(name: str, port: Port) -> tuple[Any, ...]:
    """Return the row of a port in a table: any shape and a scalar's are left out."""
    units = port.unit if isinstance(port.unit, tuple) else (port.unit or "",)
    unit = units[0] if len(set(units)) == 1 else ", ".join(units)
    return name, unit, " × ".join(map(str, port.shape or ())), port.description


def _is_kind(port: Port, attribute: str) -> bool:
    """Whether a port belongs among a class's inputs, outputs, states or events."""
    if attribute == "outputs":
        return isinstance(port, Output) or (isinstance(port, State) and port.output)
    return isinstance(port, {"inputs": Input, "states": State, "events": Event}[attribute])


def _bind(block: Block, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Signal]:
    """Match the arguments of a call with the block's inputs."""
    inputs, who = block.inputs, block.label
    if len(args) > len(inputs):
        step = f" For one vector of them give a tuple: {who}((…, …))." if len(inputs) == 1 else ""
        if "count" in block.parameters:  # as many inputs as the parameter says
            step = f" Say how many there are: {type(block).__name__}(count={len(args)})."
        raise WiringError(
            f"{len(args)} signals for {len(inputs)} inputs ({', '.join(inputs) or 'none'}).{step}", block=who
        )
    required = [name for name, port in inputs.items() if port.default is None and name not in kwargs]
    # Signals by position go to the inputs in their order. As many signals as there are inputs without a default go to
    # these, wherever the others are.
    given = dict(zip(required if len(args) == len(required) else inputs, args, strict=False))
    for name, value in kwargs.items():
        if name not in inputs:
            raise UnknownNameError(f"it has no input {name!r}. {near(name, inputs)}", block=who)
        if name in given:
            raise DoubleDriveError(
                "it is driven twice in one call, by position and by keyword. Give it once.", block=who, port=name
            )
        given[name] = value
    missing = [name for name, port in inputs.items() if name not in given and port.default is None]
    if missing:
        raise UnwiredInputError(
            f"nothing is wired to {', '.join(repr(m) for m in missing)}; expected {block.label}"
            f"({', '.join(f'{name}=…' for name, port in inputs.items() if port.default is None or name in given)})."
            f"{block.advise_unwired(missing)}",
            block=who,
            port=missing[0],
        )
    return {name: as_signal(value, block=who, port=name) for name, value in given.items()}


def _signal_error(block: Block) -> WiringError:
    """Return the error of a block that is used as a signal and has inputs, or not exactly one output."""
    outputs = ", ".join(primary_outputs(block.outputs)) or "none"
    needed = [name for name, port in block.inputs.items() if port.default is None]
    if needed:
        return WiringError(
            f"it is used as a signal before it is wired; call it first, or name an output ({outputs}): "
            f"{block.label}({', '.join(f'{n}=…' for n in needed)}).",
            block=block.label,
        )
    found, step = len(primary_outputs(block.outputs)), "Name one." if block.outputs else "Declare one."
    return WiringError(f"found {found} outputs ({outputs}); expected one, as a signal. {step}", block=block.label)
