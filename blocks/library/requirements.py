"""Requirements on a run, and conditions that end it."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import Array, Block, Event, GuardError, Input, Output, ParameterError, State, kinds, parameter
from .branching import expect_scalar, truth


class StopCondition(Block):
    """Stop condition: the run ends, without an error, at the first instant at which u is true (above 0.5).

    In a continuous subsystem that instant is an event, in a sampled one a tick. Send a continuous signal through
    `Compare` first.
    """

    stops = "stopped"
    u = Input(description="logic signal that ends the run")
    stopped = Output(description="1 from the end of the run on, 0 before")
    met = State(discrete=True, description="1 once u was true")
    reach = Event("rising", "the condition becomes true")

    def initial(self, u: Any) -> Array:
        """Return 1 if the condition is true at the start, else 0."""
        return truth(np.asarray(u.u))

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return 1 if the run ends, else 0."""
        return x.met if T is None else truth(u.u)

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the condition."""
        return truth(u.u)

    def indicators(self, t: Array, x: Any, u: Any) -> Array:
        """Return the distance of u above 0.5."""
        return u.u - 0.5

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> Array:
        """Return 1 if the condition has been true, else 0."""
        return np.where(fired.reach > 0.5, 1.0, x.met)


class Requirement(Block):
    """Requirement on a signal, checked while the diagram runs, with the time of its first violation.

    ::

        Requirement("the contact force stays below 50 N", upper=50.0)(force)
        Requirement("the robot is at rest when it is released", on_violation="record")(holds)

    With ``lower`` or ``upper`` every entry of u must stay within these bounds, which it may reach. Without both, u is a
    logic signal that must stay true (above 0.5).

    With ``on_violation="error"`` a violation stops the run, with an error that names the requirement, the block, the
    time and the value. With ``"record"`` the run continues: ``violated`` is 1 from the first violation on, and
    ``violated_at`` is its time. In a continuous subsystem that time is found as an event.

    Raises
    ------
    GuardError
        In a run, when the requirement is violated.
    ParameterError
        For an empty text, another ``on_violation``, and bounds that cross.
    ShapeError
        For a vector in a continuous subsystem, when the diagram is built.
    """

    requirement: str = parameter(
        kw_only=False,
        description="the requirement in words",
        kind=kinds.text.where(str.strip).worded(
            "the requirement in words, for the report of its violation", "Write it.", kinds.alone("no text")
        ),
    )
    lower: float | None = parameter(default=None, description="smallest value allowed")
    upper: float | None = parameter(default=None, description="largest value allowed")
    on_violation: str = parameter(
        default="error",
        description="'error' stops the run, 'record' lets it continue",
        kind=kinds.choice("error", "record"),
    )
    u = Input(shape=None, description="a quantity, or a logic signal that must stay true")
    violated = Output(description="1 from the first violation on, 0 before")
    violated_at = Output(unit="s", description="time of the first violation, −1 before")
    broken = State(discrete=True, description="1 from the first violation on")
    when = State(unit="s", start=-1.0, discrete=True, description="time of the first violation, −1 before")
    below = Event(
        "rising",
        "the signal falls below its lower bound, or a logic signal becomes false",
        only_if=lambda block: block.lower is not None or block.upper is None,
    )
    above = Event("rising", "the signal rises above its upper bound", only_if=lambda block: block.upper is not None)

    def check(self) -> None:
        """Refuse bounds that cross."""
        if self.lower is not None and self.upper is not None and self.lower > self.upper:
            text = f"found lower={self.lower:g} above upper={self.upper:g}; expected it at or below. Exchange them."
            raise ParameterError(text, port="lower")

    def margins(self, u: Array) -> tuple[Array, ...]:
        """Return the distances of u below and above its bounds, one for each event; negative within."""
        if self.lower is None and self.upper is None:
            return (0.5 - u,)
        low = () if self.lower is None else (self.lower - u,)
        return low if self.upper is None else (*low, u - self.upper)

    def excess(self, u: Array) -> Array:
        """Return the sum of all violations, zero if there is none; NaN passes through."""
        if self.lower is None and self.upper is None:
            return np.sum(1.0 - truth(u))
        return sum(np.sum(np.where(m > 0.0, m, np.where(m <= 0.0, 0.0, m))) for m in self.margins(u))

    def initial(self, u: Any) -> tuple[Array, Array]:
        """Return 1 if it is violated at the start, else 0, and the time 0 or −1."""
        broken = float(self.excess(np.asarray(u.u)) > 0.0)
        return np.asarray(broken), np.asarray(broken - 1.0)

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> tuple[Array, Array]:
        """Return 1 if it has been violated, else 0, and the time."""
        if T is None:
            return x.broken, x.when
        now = self.excess(u.u)
        broken = np.where(x.broken > 0.5, 1.0, np.where(now > 0.0, 1.0, now))
        return broken, np.where(x.broken > 0.5, x.when, np.where(now > 0.0, t, now - 1.0))

    def update(self, t: Array, x: Any, u: Any, T: Array = None) -> tuple[Array, Array]:
        """Keep both."""
        return self.output(t, x, u, T)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, ...] | Array:
        """Return the distances of u below and above its bounds."""
        values = self.margins(expect_scalar(u.u, "u"))
        return values if len(values) > 1 else values[0]

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array]:
        """Return both after an event."""
        now = sum(fired) > 0.5
        return np.where(now, 1.0, x.broken), np.where(x.broken > 0.5, x.when, np.where(now, t, x.when))

    def guards(self, t: Array, x: Any, u: Any) -> dict[str, Array]:
        """Return the guard, if a violation is an error."""
        if self.on_violation == "record":
            return {}
        excess = self.excess(u.u)
        return {"requirement": np.where(excess > 0.0, -excess, 1.0 + excess)}

    def guard_error(self, name: str, value: float, u: Any, y: Any, x: Any = None) -> GuardError:
        """Return the error that names the requirement and the value."""
        found = np.asarray(u.u).tolist()
        bounds = [f"at least {self.lower:g}"] if self.lower is not None else []
        bounds += [f"at most {self.upper:g}"] if self.upper is not None else []
        expected = " and ".join(bounds) or "true (above 0.5)"
        return GuardError(
            f"the requirement {self.requirement!r} is violated: found u = {found}; expected {expected}. Look at what "
            "led to it in error.run, or give on_violation='record' to let the run continue."
        )
