"""Finite state machine."""

from __future__ import annotations

import keyword
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import Array, Block, Call, Event, Input, Kind, Output, ParameterError, Signal, State, near, parameter
from .branching import truth


class StateMachine(Block):
    """Finite state machine: one mode at a time, with transitions on conditions.

    ::

        machine = StateMachine(
            modes=("approach", "contact", "retract"),
            transitions={("approach", "contact"): "touch", ("contact", "retract"): "done"},
        )
        machine(touch=Compare(">")(force, 5.0), done=Compare(">")(machine.time_in_mode, 2.0))

    Its states are called modes, since every block has states. Each condition is an input, a logic signal of that name.
    Each mode is an output, a logic signal of that name: 1 while the machine is in the mode.

    A transition is taken while its condition is true, not only when it becomes true: a condition that is already true
    when the mode is entered counts as well. Of several, the first in the order of ``transitions`` is taken.

    In a sampled subsystem the conditions of tick k decide the mode of tick k + 1, one transition a tick (a Moore
    machine): the outputs depend on the mode alone, and no loop through the machine is algebraic. In a continuous
    subsystem a transition is an event at the instant at which its condition becomes true. The conditions of the new
    mode count after that instant, when they have followed the machine's own outputs.

    Raises
    ------
    ParameterError
        For modes or conditions that are no names or share one, and for transitions from or to something else than
        modes.
    ShapeError
        For a condition that is no scalar, when the diagram is built.
    """

    modes: tuple[str, ...] = parameter(
        description="names of the modes",
        kind=Kind(
            "a tuple of different names",
            lambda modes: isinstance(modes, tuple) and bool(modes) and len(set(modes)) == len(modes),
            "Give each mode one.",
        ),
    )
    transitions: tuple[tuple[str, str, str], ...] = parameter(
        description="{(from, to): condition}, or a sequence of (from, to, condition); the first that holds is taken"
    )
    start: str | None = parameter(default=None, description="mode at the start; None is the first of modes")
    mode = Output(description="number of the mode, from 0")
    time_in_mode = Output(unit="s", description="time since the mode was entered")
    active = State(start=lambda block: block.modes.index(block.start or block.modes[0]), discrete=True)
    since = State(discrete=True, description="time of entering the mode, s; in a sampled subsystem, ticks since then")

    def __init__(self, **kwargs: Any):
        given = kwargs.get("transitions")
        if isinstance(given, Mapping):  # the order counts, which == ignores in mappings
            kwargs["transitions"] = tuple((*k, c) if isinstance(k, tuple) else (k, c) for k, c in given.items())
        super().__init__(**kwargs)

    def check(self) -> None:
        """Refuse wrong modes, conditions and transitions."""
        if self.start is not None and self.start not in self.modes:
            raise ParameterError(
                f"found {self.start!r}, which is no mode. {near(self.start, self.modes)}", port="start"
            )
        given: Any = self.transitions
        rows: tuple[Any, ...] = given if isinstance(given, tuple) and given else (given,)
        for row in rows:
            if not (isinstance(row, tuple) and len(row) == 3 and all(isinstance(part, str) for part in row)):
                text = f"found {row!r}; expected {{(from, to): condition}}, three names for each. Write them so."
                raise ParameterError(text, port="transitions")
            for name in row[:2]:
                if name not in self.modes:
                    text = f"found {name!r}, which is no mode. {near(name, self.modes)}"
                    raise ParameterError(text, port="transitions")
            if row[0] == row[1]:
                text = f"found one from {row[0]!r} to itself; expected another mode. Leave it out."
                raise ParameterError(text, port="transitions")
        # modes are outputs and conditions inputs: each name has to be a port's, and to mean one thing
        taken = {"mode", "time_in_mode"}
        for port, names in (("modes", self.modes), ("transitions", tuple(self.inputs))):
            for name in names:
                usable = isinstance(name, str) and name.isidentifier() and not keyword.iskeyword(name)
                if not usable or name[0] == "_" or name in taken or hasattr(StateMachine, name) or hasattr(Call, name):
                    raise ParameterError(
                        f"found the name {name!r}; expected letters, digits and underscores, another name for each "
                        "mode and condition, and none that a block or a call has already. Choose another.",
                        port=port,
                    )
                taken.add(name)

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The conditions, in the order of the transitions."""
        names = dict.fromkeys(row[2] for row in self.transitions)
        return {name: Input(description="condition, a logic signal", name=name) for name in names}

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """``mode``, ``time_in_mode``, and one logic signal for each mode."""
        own = {"mode": type(self).mode, "time_in_mode": type(self).time_in_mode}
        return own | {name: Output(description="1 while in this mode, else 0", name=name) for name in self.modes}

    @property
    def events(self) -> Mapping[str, Event]:  # type: ignore[override]
        """One event for each transition."""
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
        """Return the condition if the machine is in the transition's source, else 0."""
        return np.where(np.abs(active - self.modes.index(source)) < 0.5, getattr(u, condition), 0.0)

    def _next_mode(self, active: Array, u: Any) -> Array:
        """Return the number of the next mode; NaN passes through."""
        result = active
        for source, target, condition in reversed(self.transitions):
            holds = truth(self._holds(active, source, u, condition))
            result = np.where(holds > 0.5, 1.0 * self.modes.index(target), np.where(holds <= 0.5, result, holds))
        return result

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> tuple[Array, ...]:
        """Return the mode's number, the time in it, and 1 for it, 0 for the others."""
        elapsed = t - x.since if T is None else x.since * T
        numbers = range(len(self.modes))
        return x.active, elapsed, *(np.where(np.abs(x.active - i) < 0.5, 1.0, 0.0) for i in numbers)

    def update(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the mode at the next tick, and the ticks since it was entered."""
        new = self._next_mode(x.active, u)
        return new, np.where(np.abs(new - x.active) < 0.5, x.since + 1.0, 0.0)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, ...] | Array:
        """Return, for each transition from the active mode, the distance of its condition above 0.5.

        It is at most the time in the mode. At the instant at which a mode is entered the conditions may still be those
        of the last one, and at the start no event fires; a condition that is true then acts right after.
        """
        values, elapsed = [], t - x.since
        for source, _, condition in self.transitions:
            above = self._holds(x.active, source, u, condition) - 0.5
            values.append(np.where(above > elapsed, elapsed, above))
        return tuple(values) if len(values) > 1 else values[0]

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array]:
        """Return the mode after an event, and the time at which it was entered."""
        new = self._next_mode(x.active, u)
        return new, np.where(np.abs(new - x.active) < 0.5, x.since, t)
