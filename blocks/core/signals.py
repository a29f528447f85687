"""Signals and calls: wiring as values.

``block(u)`` is a `Call`: the block with its inputs. It changes nothing. A `Signal` is one output port, or a part of
one. Both can be wired on, indexed, unpacked, named, and used in ``+``, ``-`` and ``*``.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from contextvars import ContextVar
from typing import Any

import numpy as np

from .arguments import shorten
from .control_systems import as_block
from .errors import (
    LoopwrightError,
    UnknownNameError,
    WiringError,
    near,
)
from .explained_calls import explain_calls
from .operators import Operators, concatenate, has_signals, operate

recorder: ContextVar[list[Any] | None] = ContextVar("loopwright_calls", default=None)
"""Calls made while a subsystem's function runs: a call that closes a loop counts even if its result is not used."""


class Wireable(Operators["Signal"]):
    """Source of a wire: a signal, a call, or a block with one output."""

    def __getitem__(self, index: int | slice) -> Signal:
        return self._signal()[index]

    def __iter__(self) -> Iterator[Signal]:  # without it Python would index from 0 on, without end
        return iter(self._signal())

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(name for name in _outputs(self) if name.isidentifier())]

    def _ipython_key_completions_(self) -> list[str]:
        return _outputs(self)


class Wired(Wireable):
    """A signal or a call. Its values come with a run, so nothing can be decided on them while wiring."""

    __hash__ = object.__hash__

    def _decision_error(self, quantity: str, instead: str) -> WiringError:
        """Return the error of a decision that needs numbers."""
        return WiringError(
            f"{self!r} has no {quantity} while the diagram is wired: its values come with the run. {instead}",
            block=self._source_name(),
        )

    def __bool__(self) -> bool:
        raise self._decision_error(
            "truth value",
            "Write np.where(condition, then, otherwise) for if, np.minimum and np.maximum for min and max, &, | and ~ "
            "for and, or and not, and (low < u) & (u < high) for low < u < high.",
        )

    def __eq__(self, other: object) -> bool:
        if isinstance(other, int | float | np.number | np.ndarray):
            raise self._decision_error(
                "value to compare",
                "Write abs(u - value) < tolerance: a signal that varies continuously has a value at single instants.",
            )
        return self is other


@explain_calls
class Signal(Wired):
    """One output port of a block, or a part of it.

    Attributes
    ----------
    source : Block or subsystem input
        The block that makes it, or the input of the subsystem that it enters by.
    port : str
        Output port.
    index : int, slice or None
        The part of the port; None for the whole.
    wire : str or None
        Name given by `named`.
    call : Call or None
        The call that it came from; None if it was read from the block.
    """

    __slots__ = ("call", "index", "port", "source", "wire")

    def __init__(
        self, source: Any, port: str, index: int | slice | None = None, wire: str | None = None, call: Any = None
    ):
        self.source, self.port, self.index, self.wire, self.call = source, port, index, wire, call

    def _signal(self) -> Signal:
        return self

    def __getitem__(self, index: int | slice) -> Signal:
        if self.index is not None:
            raise WiringError("it is a part of a signal already; index the whole port, once.", port=self.port)
        return Signal(self.source, self.port, _as_index(index, self.port), None, self.call)

    def __iter__(self) -> Iterator[Signal]:
        who = getattr(self.source, "label", None)
        raise WiringError("this is one signal and can't be unpacked; index it, as in y[0].", block=who, port=self.port)

    def named(self, name: str) -> Signal:
        """Name the wire, which makes it a log channel and a point at which the loop can be opened.

        Use the signal that is returned from here on: it is the same port, with the name.
        """
        return Signal(self.source, self.port, self.index, check_name(name), self.call)

    def __repr__(self) -> str:
        part = "" if self.index is None else f"[{self.index}]"
        return f"<signal {getattr(self.source, 'label', self.source)}.{self.port}{part}>"


def _as_index(index: Any, port: str) -> int | slice:
    """Return an index of Python's integers, so that NumPy's integers wire and compare alike."""

    def integer(value: Any) -> int:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        return operator.index(value)

    try:
        if not isinstance(index, slice):
            return integer(index)
        return slice(*(None if i is None else integer(i) for i in (index.start, index.stop, index.step)))
    except TypeError:
        raise WiringError(
            f"found the index {index!r}; expected an integer or a slice of integers. Write y[0] or y[:2].", port=port
        ) from None


def _outputs(source: Wireable) -> list[str]:
    """Return the output names that a notebook completes; none where they can't be found: completion must not fail."""
    with suppress(LoopwrightError):
        if not isinstance(source, Signal):
            return list(getattr(source.block if isinstance(source, Call) else source, "outputs", ()))
    return []


@explain_calls
class Call(Wired):
    """A block with its inputs: one node of a diagram."""

    def __init__(
        self,
        block: Any,
        wires: dict[str, Signal],
        names: tuple[str | None, ...] = (),
        origin: Call | None = None,
    ):
        self.block, self.wires, self.names = block, wires, names
        self.origin = self if origin is None else origin
        if origin is None:
            calls = recorder.get()
            if calls is not None:
                calls.append(self)

    @property
    def primary(self) -> list[str]:
        """Names of the outputs that the call unpacks into, without the secondary ones."""
        return primary_outputs(self.block.outputs)

    def named(self, *names: str) -> Call:
        """Name the wires of the outputs, in order (all of them)."""
        if len(names) != len(self.primary):
            raise WiringError(
                f"{len(names)} names for {len(self.primary)} outputs ({', '.join(self.primary)}); give one each.",
                block=self.block.label,
            )
        return Call(self.block, self.wires, tuple(check_name(name) for name in names), self.origin)

    def _output(self, port: str) -> Signal:
        wire = dict(zip(self.primary, self.names, strict=False)).get(port)
        return Signal(self.block, port, None, wire, self)

    def _signal(self) -> Signal:
        if len(self.primary) != 1:
            raise WiringError(
                f"it has {len(self.primary)} outputs ({', '.join(self.primary)}), so the call is not one signal; "
                f"unpack it, or name one: …{'.' + self.primary[0] if self.primary else ''}.",
                block=self.block.label,
            )
        return self._output(self.primary[0])

    def __iter__(self) -> Iterator[Signal]:
        return iter([self._output(port) for port in self.primary])

    def __getattr__(self, name: str) -> Signal:
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self.block.outputs:
            return self._output(name)
        raise UnknownAttributeError(
            f"it has no output {name!r}. {near(name, self.block.outputs)}", block=self.block.label
        )

    def __getitem__(self, index: Any) -> Signal:
        return self._output(index) if isinstance(index, str) and index in self.block.outputs else self._signal()[index]

    def __repr__(self) -> str:
        return f"<call of {self.block.label}>"


class UnknownAttributeError(UnknownNameError, AttributeError):
    """An unknown output or parameter was read as an attribute."""


def primary_outputs(outputs: Mapping[str, Any]) -> list[str]:
    """Return the outputs of a block, by name, that a call of it unpacks into."""
    return [name for name, port in outputs.items() if not getattr(port, "secondary", False)]


def _near_name(name: Any) -> str:
    """Return a name that is allowed, as near as it can be to one that isn't."""
    made = re.sub(r"\W+", "_", name).strip("_") if isinstance(name, str) else ""
    made = f"n_{made}" if made[:1].isdigit() else made
    return made if made.isidentifier() else "v_perp"


def check_name(name: Any) -> str:
    """Return ``name`` if it can name a block or a wire."""
    if not (isinstance(name, str) and name.isidentifier()):
        raise WiringError(
            f"found the name {name!r}; expected letters, digits and underscores, with no digit first. "
            f"Take {_near_name(name)!r}."
        )
    return name


def as_signal(value: Any, *, block: str = "", port: str = "") -> Signal:
    """Return ``value`` as a signal: a signal, a call or block with one output, a number, or a list of these."""
    if isinstance(value, Wireable):
        return value._signal()
    if has_signals(value):
        return _stack(value, block, port)
    if isinstance(value, int | float | np.number | np.ndarray | list | tuple) and not isinstance(value, bool):
        with suppress(ValueError):
            constant: Signal = operate("Constant", "constant", value=value)
            return constant
    made = as_block(value, "(…)")
    raise WiringError(
        f"found {shorten(value)}; expected a signal, a call, a block with one output, finite numbers, or a list of "
        "these. " + (f"{made}." if made else _other_than(value)),
        block=block,
        port=port,
    )


def _other_than(value: Any) -> str:
    """Return the next step for what is no signal."""
    if value is None:
        return "Let the function that made it return a signal."
    if isinstance(value, bool | np.bool_):
        return f"Give {float(value):g} for a logic signal."
    if isinstance(value, str):
        with suppress(ValueError):
            return f"Leave out the quotes: {float(value):g}."
    if isinstance(value, int | float | np.number | np.ndarray | list | tuple):
        return "Give finite numbers; missing samples are to be filled first."
    return "Wire an output by its name, such as plant.y."


def _stack(values: Any, block: str, port: str) -> Signal:
    """Return the signal with the entries of signals and numbers in a row, as `np.stack` and `np.hstack` make it."""
    parts = list(values)
    if any(has_signals(part) and not isinstance(part, Wireable) for part in parts):
        raise WiringError(
            "found a list of lists with signals in it; expected one list, as a signal is a vector. Write the signals "
            "one after the other.",
            block=block,
            port=port,
        )
    made: Signal = concatenate([as_signal(part, block=block, port=port) for part in parts])
    return made
