"""A small finite state machine."""

from __future__ import annotations

import keyword
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.block import Block
from ..core.errors import ParameterError, near
from ..core.ports import Event, Input, Output, State
from ..core.signals import Call, Signal
from ..core.values import Array, parameter
from .branching import truth


class StateMachine(Block):
    """Finite state machine: in one mode at a time, with transitions on conditions.

    ::

        machine = StateMachine(
            modes=("approach", "contact", "retract"),
            transitions={("approach", "contact"): "touch", ("contact", "retract"): "done"},
        )
        machine(touch=Compare(">")(force, 5.0), done=Compare(">")(machine.time_in_mode, 2.0))

    Its states are called modes here, since every block has states. The conditions are inputs, logic signals by their
    names. Each mode is an output as well, a logic signal by its name: 1 while the machine is in it.

    A transition is taken while its condition is true, not only when it becomes so: one that is already true when its
    mode is entered is acted on as well. Of several, the first in the order of ``transitions`` is taken.

    In a sampled frame the conditions of tick k decide the mode of tick k + 1, one transition a tick (a Moore machine):
    the outputs depend on the mode alone, and no loop through the machine is algebraic. In a continuous frame a
    transition is an event at the instant at which its condition becomes true. What its own outputs change at that
    instant is waited for: a condition that is true when its mode is entered acts right after, not at the same instant.

    Raises
    ------
    ParameterError
        Modes or conditions that are no names or share one, and transitions between what are no modes.
    ShapeError
        A condition that is no scalar, when the diagram is built.
    """

    modes: tuple[str, ...] = parameter(description="names of the modes")
    transitions: tuple[tuple[str, str, str], ...] = parameter(
        description="{(from, to): condition}, or a sequence of (from, to, condition); the first that holds is taken"
    )
    start: str | None = parameter(default=None, description="mode at the start; None is the first of modes")
    mode = Output(description="number of the mode, from 0")
    time_in_mode = Output(unit="s", description="time since it was entered")
    active = State(start=lambda block: block.modes.index(block.start or block.modes[0]), discrete=True)
    since = State(discrete=True, description="when the mode was entered, s; in a sampled frame, how many ticks ago")

    def __init__(self, **kwargs: Any):
        given = kwargs.get("transitions")
        if isinstance(given, Mapping):  # its order counts, and mappings are compared without
            kwargs["transitions"] = tuple((*k, c) if isinstance(k, tuple) else (k, c) for k, c in given.items())
        super().__init__(**kwargs)

    def check(self) -> None:
        """Refuse modes, conditions and transitions that are none."""
        _check_transitions(self)
        _check_names(self)

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The conditions, in the order of the transitions."""
        names = dict.fromkeys(row[2] for row in self.transitions)
        return {name: Input(description="condition, a logic signal", name=name) for name in names}

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """Number of the mode, time in it, and one logic signal for each."""
        own = {"mode": type(self).mode, "time_in_mode": type(self).time_in_mode}
        return own | {name: Output(description="1 while in this mode, else 0", name=name) for name in self.modes}

    @property
    def events(self) -> Mapping[str, Event]:  # type: ignore[override]
        """One for each transition."""
        made: dict[str, Event] = {}
        for i, (source, target, condition) in enumerate(self.transitions):
            name = f"{source}_to_{target}"
            name = f"{name}_{i}" if name in made else name
            made[name] = Event("rising", f"{condition}: from {source} to {target}", name=name)
        return made

    def __getattr__(self, name: str) -> Any:
        if "modes" in self.__dict__ and name in self.modes:
            return Signal(self, name)
        return super().__getattr__(name)

    def _holds(self, active: Array, source: str, u: Any, condition: str) -> Array:
        """Return the condition where the machine is in the transition's source, else 0."""
        return np.where(np.abs(active - self.modes.index(source)) < 0.5, getattr(u, condition), 0.0)

    def _next(self, active: Array, u: Any) -> Array:
        """Return the number of the next mode; NaN passes through."""
        result = active
        for source, target, condition in reversed(self.transitions):
            holds = truth(self._holds(active, source, u, condition))
            result = np.where(holds > 0.5, 1.0 * self.modes.index(target), np.where(holds <= 0.5, result, holds))
        return result

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> tuple[Array, ...]:
        """Return the mode's number, the time in it, and which it is."""
        elapsed = t - x.since if T is None else x.since * T
        numbers = range(len(self.modes))
        return x.active, elapsed, *(np.where(np.abs(x.active - i) < 0.5, 1.0, 0.0) for i in numbers)

    def update(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the mode of the next tick, and the ticks since it was entered."""
        new = self._next(x.active, u)
        return new, np.where(np.abs(new - x.active) < 0.5, x.since + 1.0, 0.0)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, ...] | Array:
        """Return, for each transition, how far its condition is above 0.5, as long as it counts.

        It is never above the time in the mode: at the instant at which a mode is entered the conditions may still be
        those of the last one, and at the start no event fires. One that is true then acts right after.
        """
        values, elapsed = [], t - x.since
        for source, _, condition in self.transitions:
            above = self._holds(x.active, source, u, condition) - 0.5
            values.append(np.where(above > elapsed, elapsed, above))
        return tuple(values) if len(values) > 1 else values[0]

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array]:
        """Return the mode after an event, and when it was entered."""
        new = self._next(x.active, u)
        return new, np.where(np.abs(new - x.active) < 0.5, x.since, t)


def _bad(machine: StateMachine, port: str, text: str) -> ParameterError:
    return ParameterError(text, block=machine.label, port=port)


def _check_transitions(machine: StateMachine) -> None:
    """Refuse modes that are no tuple of different names, and transitions that don't lead from one to another."""
    modes, transitions = machine.modes, machine.transitions
    if not isinstance(modes, tuple) or not modes or len(set(modes)) < len(modes):
        raise _bad(machine, "modes", f"found {modes!r}; expected a tuple of different names. Give each mode one.")
    if machine.start is not None and machine.start not in modes:
        raise _bad(machine, "start", f"found {machine.start!r}, which is no mode. {near(machine.start, modes)}")
    rows: tuple[Any, ...] = transitions if isinstance(transitions, tuple) and transitions else (transitions,)
    for row in rows:
        if not (isinstance(row, tuple) and len(row) == 3 and all(isinstance(part, str) for part in row)):
            text = f"found {row!r}; expected {{(from, to): condition}}, three names for each. Write it so."
            raise _bad(machine, "transitions", text)
        for name in row[:2]:
            if name not in modes:
                raise _bad(machine, "transitions", f"found {name!r}, which is no mode. {near(name, modes)}")
        if row[0] == row[1]:
            text = f"found one from {row[0]!r} to itself; expected another mode. Leave it out."
            raise _bad(machine, "transitions", text)


def _check_names(machine: StateMachine) -> None:
    """Refuse names of modes and conditions that can't be ports, or are taken."""
    taken = {"mode", "time_in_mode"}
    conditions = dict.fromkeys(condition for _, _, condition in machine.transitions)
    for port, names in (("modes", machine.modes), ("transitions", tuple(conditions))):
        for name in names:
            usable = isinstance(name, str) and name.isidentifier() and not keyword.iskeyword(name) and name[0] != "_"
            if not usable or name in taken or hasattr(StateMachine, name) or hasattr(Call, name):
                raise _bad(
                    machine,
                    port,
                    f"found the name {name!r}; expected letters, digits and underscores, another name for each mode "
                    "and condition, and none that a block or a call has already. Choose another.",
                )
            taken.add(name)
