"""Buses: mappings of signals, which subsystems take and return."""

from __future__ import annotations

from collections.abc import ItemsView, Iterator, KeysView, Mapping, ValuesView
from typing import Any

from ...blocks.core import (
    DuplicateNameError,
    Signal,
    UnknownAttributeError,
    UnknownNameError,
    Wireable,
    WiringError,
    as_signal,
    check_name,
    enumerate_some,
    explain_calls,
    near,
)


@explain_calls
class Bus(Wireable):
    """Signals by name, as a subsystem takes and returns them: ``bus["speed"]`` or ``bus.speed``.

    A subsystem whose function returns a mapping returns a bus, and an argument that is given one arrives in the
    function as a bus. Signals of a bus may be buses themselves: ``bus["axis"]["speed"]``. A bus never changes;
    ``{**bus, "force": f}`` is one with a signal more, or another one. A bus of one signal is taken for the signal.

    Raises
    ------
    UnknownNameError
        For a signal that it doesn't have; the message has near names.
    """

    def __init__(self, signals: Mapping[str, Any], owner: str):
        self._signals, self._owner = dict(signals), owner

    def keys(self) -> KeysView[str]:
        """Return the names."""
        return self._signals.keys()

    def values(self) -> ValuesView[Any]:
        """Return the signals, or buses."""
        return self._signals.values()

    def items(self) -> ItemsView[str, Any]:
        """Return names and signals, or buses."""
        return self._signals.items()

    def get(self, name: str, default: Any = None) -> Any:
        """Return a signal, or the default where the bus has none of this name."""
        return self._signals.get(name, default)

    def __iter__(self) -> Iterator[Any]:
        return iter(self._signals)

    def __len__(self) -> int:
        return len(self._signals)

    def __contains__(self, name: object) -> bool:
        return name in self._signals

    def __getitem__(self, name: Any) -> Any:
        if name in self._signals:
            return self._signals[name]
        raise UnknownNameError(f"the bus has no signal {name!r}. {near(str(name), self._signals)}", block=self._owner)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name in self._signals:
            return self._signals[name]
        text = f"the bus has no signal {name!r}. {near(name, self._signals)}"
        raise UnknownAttributeError(text, block=self._owner)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *self._signals]

    def _ipython_key_completions_(self) -> list[str]:
        return list(self._signals)

    def _signal(self) -> Signal:
        (name, first), *others = self._signals.items()
        if others:
            raise WiringError(
                f"found a bus of {len(self)} signals ({enumerate_some(list(self._signals))}); expected one signal. "
                f"Take one, as in bus[{name!r}].",
                block=self._owner,
            )
        return as_signal(first)

    def __repr__(self) -> str:
        return f"<bus of {', '.join(self._signals)}>"


def is_bus(value: object) -> bool:
    """Return whether a value is a bus: a mapping of signals."""
    return isinstance(value, Bus | Mapping)


def flatten(bus: Any, owner: str, port: str) -> dict[tuple[str, ...], Signal]:
    """Return the signals of a bus by the names that lead to each."""
    found: dict[tuple[str, ...], Signal] = {}
    for name, value in bus.items():
        try:
            check_name(name)
        except WiringError as error:
            raise error.at(block=owner, port=port) from None
        if is_bus(value):
            found |= {(name, *rest): signal for rest, signal in flatten(value, owner, port).items()}
        else:
            found[(name,)] = as_signal(value, block=owner, port=f"{port}.{name}" if port else name)
    if not found:
        raise WiringError("found a bus without signals; expected one or more. Give it some.", block=owner, port=port)
    return found


def name_ports(
    paths: Mapping[tuple[str, ...], Any], owner: str, port: str, taken: Mapping[str, Any]
) -> dict[tuple[str, ...], str]:
    """Return the port of a subsystem for each signal of a bus: its names, joined, after the bus's if it is taken."""
    made: dict[tuple[str, ...], str] = {}
    for path in paths:
        name = "_".join(path)
        name = f"{port}_{name}" if name in taken and port else name
        if name in taken or name in made.values():
            raise DuplicateNameError(
                f"two signals are called {name!r} here, one of them {' → '.join(path)} of a bus. Rename one.",
                block=owner,
                port=name,
            )
        made[path] = name
    return made


def nest(signals: Mapping[tuple[str, ...], Any], owner: str) -> Bus:
    """Return the bus of signals by the names that lead to each."""
    inner: dict[str, Any] = {}
    for path, signal in signals.items():
        if len(path) == 1:
            inner[path[0]] = signal
        else:
            inner.setdefault(path[0], {})[path[1:]] = signal
    return Bus({name: nest(part, owner) if isinstance(part, dict) else part for name, part in inner.items()}, owner)


__all__ = ["Bus", "flatten", "is_bus", "name_ports", "nest"]
