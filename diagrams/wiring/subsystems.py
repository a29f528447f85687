"""Subsystems: functions of signals that are used in a diagram like blocks."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, KeysView, Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

from ...blocks.core import (
    Call,
    DoubleDriveError,
    Grid,
    Sheet,
    ShownAsTable,
    Signal,
    UnknownAttributeError,
    UnknownNameError,
    UnwiredInputError,
    Wireable,
    WiringError,
    as_signal,
    check_name,
    explain_calls,
    near,
    offer_elsewhere,
    recorder,
)
from .buses import Bus, flatten, is_bus, name_ports, nest
from .subsystem_settings import CONTROL_INPUTS, SubsystemSettings


class SubsystemInput:
    """The inside of a subsystem's input, in place of the signal that is wired to it outside."""

    def __init__(self, call: SubsystemCall, port: str):
        self.call, self.port = call, port
        self.label, self.outputs = port, (port,)


class SubsystemKeywords(TypedDict, total=False):
    """Keywords of `subsystem`."""

    sample_time: float | Fraction | None
    method: str | None
    name: str | None
    offset: float | Fraction
    delay: int
    enabled: str | None
    triggered: str | None


@explain_calls
class Subsystem(ShownAsTable):
    """A function of signals that is used in a diagram like a block; made by `subsystem`, called like a block."""

    def __init__(self, function: Callable[..., object], **keywords: Unpack[SubsystemKeywords]):
        self.function, self._keywords = function, keywords
        own = str(getattr(function, "__name__", ""))  # a functools.partial has none, a lambda no identifier
        self.name = check_name(keywords.get("name") or (own if own.isidentifier() else "subsystem"))
        own_settings = {key: value for key, value in keywords.items() if key != "name"}
        self.settings = SubsystemSettings.of(self.name, **own_settings)  # type: ignore[arg-type]
        self.sample_time, self.method = self.settings.sample_time, self.settings.method
        self.offset, self.delay = self.settings.offset, self.settings.delay
        self.control, self.when = self.settings.control, self.settings.when
        self.control_input = CONTROL_INPUTS[self.control]
        every = inspect.signature(function).parameters.values()
        self.parameters = [p for p in every if p.kind is not inspect.Parameter.VAR_KEYWORD]
        self.open_ended = len(self.parameters) < len(every)
        self.__doc__, self.__name__ = function.__doc__, self.name

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(self, name):
            if name.startswith("_") or "name" not in vars(self):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            raise UnknownAttributeError(
                f"a subsystem has no {name!r} before its call, which makes its outputs. Write {self.name}(…), which "
                f"returns them, or out = {self.name}(…) and out.{name}; into a loop lead a block's port, such as "
                "plant.y, which there is before the block's call."
            )

    def replace(self, **changes: Unpack[SubsystemKeywords]) -> Subsystem:
        """Return a variant; the keywords are those of `subsystem`.

        Raises
        ------
        UnknownNameError
            For any other name.
        """
        for key in changes:
            if key not in SubsystemKeywords.__annotations__:
                raise UnknownNameError(
                    f"a subsystem has no {key!r}. {near(key, SubsystemKeywords.__annotations__)}", block=self.name
                )
        options: SubsystemKeywords = {**self._keywords, **changes}
        return Subsystem(self.function, **options)

    def __call__(self, *args: object, **kwargs: object) -> SubsystemCall:
        """Wire the subsystem: run the function on signals that stand for its inputs."""
        names = [p.name for p in self.parameters]
        if self.control_input and self.control_input not in names:
            names.append(self.control_input)
        if len(args) > len(names):
            raise WiringError(
                f"found {len(args)} signals for {len(names)} inputs ({', '.join(names)}); give one each.",
                block=self.name,
            )
        given = dict(zip(names, args, strict=False))
        for key, value in kwargs.items():
            if key not in names and not self.open_ended:
                raise UnknownNameError(f"it has no input {key!r}. {near(key, names)}", block=self.name)
            if key in given:
                raise DoubleDriveError(
                    "it is driven twice in one call, by position and by keyword; give it once.",
                    block=self.name,
                    port=key,
                )
            given[key] = value
        optional = {p.name for p in self.parameters if p.default is not inspect.Parameter.empty}
        missing = [name for name in names if name not in given and name not in optional - {self.control_input}]
        if missing:
            raise UnwiredInputError(
                f"nothing is wired to {', '.join(map(repr, missing))}; expected {self.name}({', '.join(names)}). Give "
                "a signal or a number for each.",
                block=self.name,
                port=missing[0],
            )
        buses: dict[str, dict[tuple[str, ...], str]] = {}
        plain = {k: v for k, v in given.items() if not _is_given_as_bus(v)}
        wires = {k: as_signal(v, block=self.name, port=k) for k, v in plain.items()}
        for key in (k for k in given if k not in plain):
            value = given[key]
            signals = flatten(value.bus if isinstance(value, SubsystemCall) else value, self.name, key)
            buses[key] = name_ports(signals, self.name, key, {**given, **wires})
            wires |= {port: signals[path] for path, port in buses[key].items()}
        return SubsystemCall(self, wires, buses)

    def _sheet(self) -> Sheet:
        line = (self.function.__doc__ or "").strip().partition("\n")[0]
        return Sheet(f"subsystem {self.name!r}", (("", line), *self._facts()))

    def _facts(self) -> tuple[tuple[str, Any], ...]:
        """Return its inputs and settings by name, as far as they are its own."""
        given = [p.name if p.default is p.empty else f"{p.name} (optional)" for p in self.parameters]
        rate = "" if self.sample_time is None else f"{float(self.sample_time):g} s"
        return (
            ("inputs", ", ".join([*given, *([self.control_input] if self.control_input else [])])),
            ("sample time", rate),
            ("offset", f"{float(self.offset):g} s" if self.offset else ""),
            ("delay", f"{self.delay} samples" if self.delay else ""),
            ("method", self.method),
            (self.control, self.when),
        )

    def __repr__(self) -> str:
        rate = "" if self.sample_time is None else f", sample_time={float(self.sample_time):g}"
        return f"<subsystem {self.name}({', '.join(p.name for p in self.parameters)}){rate}>"


class SubsystemCall(ShownAsTable, Wireable):
    """A subsystem with its inputs, and the calls that its function made."""

    def __init__(
        self, subsystem: Subsystem, wires: dict[str, Signal], buses: dict[str, dict[tuple[str, ...], str]] | None = None
    ):
        self.subsystem, self.wires, self.label = subsystem, wires, subsystem.name
        self.bus: Bus | None = None
        calls: list[Call | SubsystemCall] = []
        token = recorder.set(calls)
        try:
            own = {p.name for p in subsystem.parameters}
            inside = [k for k in wires if k in own or k != subsystem.control_input]
            arguments: dict[str, Signal | Bus] = {k: Signal(SubsystemInput(self, k), k) for k in inside}
            for name, ports in (buses or {}).items():
                arguments[name] = nest({path: arguments.pop(port) for path, port in ports.items()}, self.label)
            result = subsystem.function(**arguments)
        finally:
            recorder.reset(token)
        self.calls = calls
        self.results = self._name_results(result)
        self.outputs = list(self.results)
        outer = recorder.get()
        if outer is not None:
            outer.append(self)

    def _name_results(self, result: object) -> dict[str, Signal]:
        if result is None:
            raise WiringError(
                "its function returns nothing. End it with return and its outputs, such as return u; with return () if "
                "it has none, as one that only records or stops a run.",
                block=self.label,
            )
        if isinstance(result, Mapping) and not result:
            return {}
        if is_bus(result):
            signals = flatten(result, self.label, "")
            ports = name_ports(signals, self.label, "", {})
            self.bus = nest({path: Signal(self, port, None, None, self) for path, port in ports.items()}, self.label)
            return {ports[path]: signal for path, signal in signals.items()}
        if isinstance(result, Call) and len(result.primary) != 1:
            result = tuple(result)
        parts = result if isinstance(result, tuple | list) else (result,)
        named: dict[str, Signal] = {}
        for part in parts:
            signal = as_signal(part, block=self.label)
            base = name = signal.wire or signal.port
            count = 2
            while name in named:
                name, count = f"{base}_{count}", count + 1
            named[name] = signal
        return named

    def __repr__(self) -> str:
        return f"<call of {self.label}>"

    def _sheet(self) -> Sheet:
        wired = tuple((name, repr(signal)) for name, signal in self.wires.items())
        made = tuple((name, repr(signal)) for name, signal in self.results.items())
        return Sheet(
            f"call of the subsystem {self.label!r}",
            self.subsystem._facts()[1:],
            (Grid("Inputs", ("input", "wired to"), wired), Grid("Outputs", ("output", "from"), made)),
        )

    def _signal(self) -> Signal:
        if not self.results:
            raise WiringError(
                "it has no outputs: its function ends with return (). Return signals there to use them.",
                block=self.label,
            )
        if len(self.results) != 1:
            raise WiringError(
                f"it has {len(self.results)} outputs ({', '.join(self.results) or 'none'}); unpack the call, or name "
                f"one.",
                block=self.label,
            )
        return Signal(self, self.outputs[0], None, None, self)

    def __iter__(self) -> Iterator[Signal]:
        return iter([Signal(self, port, None, None, self) for port in self.outputs])

    def named(self, *names: str) -> Signal | tuple[Signal, ...]:
        """Name the wires of the outputs, in order (all of them)."""
        if len(names) != len(self.outputs):
            raise WiringError(f"{len(names)} names for {len(self.outputs)} outputs; give one each.", block=self.label)
        signals = tuple(s.named(n) for s, n in zip(self, names, strict=True))
        return signals[0] if len(signals) == 1 else signals

    def __getattr__(self, name: str) -> Signal:
        if name.startswith("_") or "outputs" not in self.__dict__:
            raise AttributeError(name)
        if self.bus is not None and name in self.bus:
            part: Signal = self.bus[name]
            return part
        if name in self.outputs:
            return Signal(self, name, None, None, self)
        raise UnknownAttributeError(f"it has no output {name!r}. {near(name, self.outputs)}", block=self.label)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, str):
            return getattr(self, index) if index in self.outputs or self.bus is None else self.bus[index]
        return self._signal()[index]

    def keys(self) -> KeysView[str]:
        """Return the names of the outputs, so that ``{**call}`` is a bus of them."""
        return dict.fromkeys(self.outputs if self.bus is None else self.bus.keys()).keys()


def _is_given_as_bus(value: object) -> bool:
    """Whether an argument is a bus: a mapping, or a call of a subsystem that returns one."""
    return is_bus(value) or (isinstance(value, SubsystemCall) and value.bus is not None)


@overload
def subsystem(function: Callable[..., object], /) -> Subsystem: ...
@overload
def subsystem(
    *,
    sample_time: float | Fraction | None = None,
    method: str | None = None,
    name: str | None = None,
    offset: float | Fraction = 0,
    delay: int = 0,
    enabled: str | None = None,
    triggered: str | None = None,
) -> Callable[[Callable[..., object]], Subsystem]: ...
@explain_calls
@offer_elsewhere(
    **dict.fromkeys(("dt", "h", "Ts", "T", "period", "rate", "step", "sampletime"), "sample_time=… (seconds)"),
    phase="offset=… (seconds)",
)
def subsystem(
    function: Callable[..., object] | None = None,
    /,
    *,
    sample_time: float | Fraction | None = None,
    method: str | None = None,
    name: str | None = None,
    offset: float | Fraction = 0,
    delay: int = 0,
    enabled: str | None = None,
    triggered: str | None = None,
) -> Subsystem | Callable[[Callable[..., object]], Subsystem]:
    """Make a subsystem of a function of signals.

    An argument may be a bus, a mapping of signals by name, and so may the result: each signal is a port of the
    subsystem. A function without outputs ends with ``return ()``.

    Parameters
    ----------
    sample_time : float or Fraction, optional
        Sample time in s. Inputs are sampled at its ticks, outputs held between them, continuous blocks inside
        discretized. A Fraction is taken exactly. A float that is a multiple of 1 ns is that decimal, another the
        fraction with a denominator up to 10⁶ that it is when rounded, such as 1/3 or 1/44100. Without one, the sample
        time of the surroundings holds.
    method : {"exact", "forward", "semi_implicit", "trapezoidal"}
        Discretization of continuous blocks inside. ``exact`` is the zero-order hold for blocks that are linear in
        their states, forward Euler for others. ``trapezoidal`` is of second order; where a block is not linear,
        Newton's method solves each step, and the run stops at a step that it does not solve. See
        `loopwright.hold`. Without one, the method of the surroundings holds, or ``exact``. Each block is
        discretized by itself, with its inputs held over the sample. So several `Integrator` blocks in a row are
        forward Euler between them whatever the method; put them into one block, such as a `StateSpace`, for the method
        to act on the whole. For the same reason ``trapezoidal`` is not Tustin's method, ``c2d(…, "bilinear")``, which
        averages the inputs too.
    name : str, optional
        Name of the subsystem; without one, the function's.
    offset : float or Fraction
        Time of the first tick in s, less than the sample time. Until then the outputs have their values of t = 0.
    delay : int
        Computational delay in samples: an output leaves the subsystem that many ticks after it was computed. In the
        first ticks the first computed value leaves it.
    enabled : {"held", "reset"}, optional
        Gives the subsystem one more input, ``enable``. It acts only while that is true (above 0.5), and holds its
        outputs and states else; with "reset" the states start again when it is enabled again. With a sample time the
        input counts at its own ticks, and subsystems of other rates inside go by the last of them.
    triggered : {"rising", "falling", "both"}, optional
        Gives the subsystem one more input, ``trigger``. It acts only at the instants at which that becomes true
        (rising), false (falling), or either, and holds its outputs between. Blocks inside have no sample time.

    Raises
    ------
    SampleTimeError
        A sample time that is not positive, or a float that is no such number; an unknown method; an offset or a delay
        without a sample time.
    WiringError
        Another word for ``enabled`` or ``triggered``, or both.

    Examples
    --------
    >>> from loopwright.blocks import Gain
    >>> @subsystem(sample_time=1e-3)
    ... def controller(error):
    ...     return Gain(gain=2)(error)
    >>> controller
    <subsystem controller(error), sample_time=0.001>
    """
    if function is not None and not callable(function):
        raise WiringError(
            f"found {function!r}; expected a function, or keywords: @subsystem(sample_time={function!r})."
        )

    def decorate(f: Callable[..., object]) -> Subsystem:
        return Subsystem(
            f,
            sample_time=sample_time,
            method=method,
            name=name,
            offset=offset,
            delay=delay,
            enabled=enabled,
            triggered=triggered,
        )

    return decorate if function is None else decorate(function)
