"""Logic: signals that are 0 or 1, and count as true above 0.5.

`Compare` makes a logic signal of any signal. `And`, `Or`, `Not` and `Switch` have no memory: their outputs follow their
inputs at once in every subsystem, so that signals that change at one instant change together. In a continuous subsystem
the solver lands where one of their inputs crosses 0.5.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import (
    Array,
    Block,
    Event,
    Input,
    Output,
    PortUnit,
    State,
    Units,
    check_shapes,
    kinds,
    parameter,
)
from .branching import NumberedInputs, check_fits, expect_scalar, truth, unit_of_one
from .remembered_inputs import StartsAtInput

_OPERATORS = {">": (1.0, 1.0), "<": (-1.0, 1.0), "<=": (1.0, 0.0), ">=": (-1.0, 0.0)}
"""For each relation: a sign s, and the value of y where s (u₁ − u₂) is positive."""


class Compare(Block):
    """Comparison: y = 1 where u₁ > u₂ (or <, ≥, ≤), else 0, element by element; NaN passes through.

    ``Compare(">")(u, 3.0)``; without a second input it compares with zero. In a continuous subsystem y changes by an
    event at the crossing.

    Raises
    ------
    ParameterError
        For another relation than >, <, >= and <=.
    ShapeError
        For inputs of different shapes, and for vectors in a continuous subsystem, when the diagram is built.
    """

    same_units = True
    relation: str = parameter(
        kw_only=False,
        default=">",
        description="one of >, <, >= and <=",
        kind=kinds.choice(*_OPERATORS).worded(
            f"one of {', '.join(_OPERATORS)}",
            "Equality of signals that vary continuously is no event; compare their distance with a tolerance.",
        ),
    )
    u1 = Input(shape=None, description="left side, of any shape")
    u2 = Input(shape=None, default=0.0, description="right side, of the same shape or a scalar")
    y = Output(shape=None, description="1 where the relation holds, else 0")
    holds = State(like="u1", discrete=True, description="1 while it holds")
    cross = Event("both", "the two sides cross")

    def decide(self, u: Any) -> Array:
        """Return 1 where the relation holds, else 0."""
        check_shapes(u1=u.u1, u2=u.u2)
        sign, positive = _OPERATORS[self.relation]
        left, right = (u.u1, u.u2) if sign > 0 else (u.u2, u.u1)
        return np.where(left > right, positive, np.where(left <= right, 1.0 - positive, left + right))

    def initial(self, u: Any) -> Array:
        """Return the state at the start; ticks don't use it, and may have other shapes."""
        return np.resize(self.decide(u), np.shape(u.u1))

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return 1 where the relation holds, else 0."""
        return x.holds if T is None else self.decide(u)

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the state unchanged: at a tick the output follows from the inputs."""
        return x.holds

    def indicators(self, t: Array, x: Any, u: Any) -> Array:
        """Return the difference of the two sides."""
        return _OPERATORS[self.relation][0] * (expect_scalar(u.u1, "u1") - expect_scalar(u.u2, "u2"))

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> Array:
        """Return 1 where the relation holds after an event, else 0."""
        return self.decide(u)


class _Combined(NumberedInputs):
    """Base of `And` and `Or`: an event for each input, and no state."""

    y = Output(shape=None, description="1 or 0")

    @property
    def events(self) -> Mapping[str, Event]:  # type: ignore[override]
        """One event for each input."""
        return {f"change{i}": Event("both", f"u{i} crosses 0.5", name=f"change{i}") for i in range(1, self.count + 1)}

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, ...] | Array:
        """Return the distance of each input above 0.5."""
        values = tuple(expect_scalar(value, name) - 0.5 for name, value in u._asdict().items())
        return values if len(values) > 1 else values[0]

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[()]:
        """Return no states, since there are none."""
        return ()


class And(_Combined):
    """Logical and: y = 1 where all inputs are true (above 0.5), else 0, element by element; NaN passes through.

    The inputs are logic signals; send a continuous signal through `Compare` first.

    Raises
    ------
    ShapeError
        For inputs of different shapes, and for vectors in a continuous subsystem, when the diagram is built.
    """

    _hint = "logical_and"

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the product of the inputs' truths."""
        return self.fold(u._replace(**{k: truth(v) for k, v in u._asdict().items()}), lambda a, b: a * b)


class Or(_Combined):
    """Logical or: y = 1 where any input is true (above 0.5), else 0, element by element; NaN passes through.

    The inputs are logic signals; send a continuous signal through `Compare` first.

    Raises
    ------
    ShapeError
        For inputs of different shapes, and for vectors in a continuous subsystem, when the diagram is built.
    """

    _hint = "logical_or"

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return 1 less the product of the inputs' complements."""
        return 1.0 - self.fold(u._replace(**{k: 1.0 - truth(v) for k, v in u._asdict().items()}), lambda a, b: a * b)


class Not(Block):
    """Logical not: y = 0 where u is true (above 0.5), else 1, element by element; NaN passes through.

    Raises
    ------
    ShapeError
        For a vector in a continuous subsystem, when the diagram is built.
    """

    _hint = "logical_not"
    u = Input(shape=None, description="logic signal, of any shape")
    y = Output(shape=None, description="1 or 0")
    change = Event("both", "the input crosses 0.5")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the complement."""
        return 1.0 - truth(u.u)

    def indicators(self, t: Array, x: Any, u: Any) -> Array:
        """Return the distance of the input above 0.5."""
        return expect_scalar(u.u, "u") - 0.5

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[()]:
        """Return no states, since there are none."""
        return ()


class Switch(Block):
    """Switch: y = ``then`` where the condition is true (above 0.5), else ``otherwise``; a NaN condition passes through.

    The condition is a logic signal, one for all elements or one for each; send a continuous signal through `Compare`
    first. The other branch does not matter, even if it is NaN.

    Raises
    ------
    ShapeError
        For inputs of different shapes, and for a vector as condition in a continuous subsystem, when the diagram is
        built.
    """

    same_units = ("then", "otherwise")
    condition = Input(shape=None, description="logic signal")
    then = Input(shape=None, description="output while the condition is true, of any shape")
    otherwise = Input(shape=None, description="output while it is not, of the same shape or a scalar")
    y = Output(shape=None, description="one of the two")
    change = Event("both", "the condition crosses 0.5")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the branch that the condition chooses."""
        check_shapes(then=u.then, otherwise=u.otherwise, condition=u.condition)
        other = np.where(u.condition <= 0.5, u.otherwise, u.condition)
        return np.where(u.condition > 0.5, u.then, other)

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit that both branches have."""
        return {"y": unit_of_one(units["then"], units["otherwise"])}

    def indicators(self, t: Array, x: Any, u: Any) -> Array:
        """Return the distance of the condition above 0.5."""
        return expect_scalar(u.condition, "condition") - 0.5

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[()]:
        """Return no states, since there are none."""
        return ()


class EdgeDetector(StartsAtInput, Block):
    """Edge detector of a sampled subsystem: y[k] = 1 at the tick at which u becomes true, else 0.

    With ``edge="falling"`` y is 1 at the tick at which u becomes false, with ``"both"`` at either. The first tick
    compares with ``initial_value``; without it there is no edge. An edge has no duration in continuous time: use a
    `Latch`, a `Counter` or a `StateMachine` there.

    Raises
    ------
    ParameterError
        For another edge than these.
    SampleTimeError
        In a continuous subsystem, when the diagram is built.
    """

    edge: str = parameter(
        default="rising",
        description="'rising', 'falling' or 'both'",
        kind=kinds.choice("rising", "falling", "both"),
    )
    initial_value: Array | None = parameter(default=None, description="u before the start; None: u just before t = 0")
    u = Input(shape=None, description="logic signal, of any shape")
    y = Output(shape=None, description="1 at an edge, else 0")
    last = State(start="initial_value", like="u", description="u at the last tick")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return 1 where there is an edge, else 0."""
        now, before = truth(u.u), truth(x.last)
        rising, falling = now * (1.0 - before), before * (1.0 - now)
        return rising if self.edge == "rising" else falling if self.edge == "falling" else rising + falling

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the input."""
        return u.u


class Latch(Block):
    """Latch: y becomes 1 while ``set`` is true, 0 while ``reset`` is, and else stays. ``reset`` wins over ``set``.

    The output follows at once, in a continuous subsystem too.

    Raises
    ------
    ShapeError
        For inputs of different shapes, and for vectors in a continuous subsystem, when the diagram is built.
    """

    initial_value: float = parameter(default=0.0, description="1 to start set, 0 to start reset")
    set = Input(shape=None, description="logic signal that sets it, of any shape")
    reset = Input(shape=None, default=0.0, description="logic signal that resets it")
    y = Output(shape=None, description="1 while set, else 0")
    kept = State(start="initial_value", like="set", discrete=True, description="1 while set")
    sets = Event("both", "set crosses 0.5")
    resets = Event("both", "reset crosses 0.5")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return 1 where the latch is set, else 0."""
        check_fits(u.reset, "reset", u.set, "set")
        reset = truth(u.reset)
        return (1.0 - reset) * np.where(u.set > 0.5, 1.0, np.where(u.set <= 0.5, truth(x.kept), u.set))

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Keep the output."""
        return self.output(t, x, u)

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the distances of the inputs above 0.5."""
        return expect_scalar(u.set, "set") - 0.5, expect_scalar(u.reset, "reset") - 0.5

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> Array:
        """Keep the output: that of the inputs as they were before they crossed 0.5, then that of the inputs now."""
        set_now, reset_now = truth(u.set), truth(u.reset)
        was_set = np.where(fired.sets > 0.5, 1.0 - set_now, set_now)
        was_reset = np.where(fired.resets > 0.5, 1.0 - reset_now, reset_now)
        before = (1.0 - was_reset) * np.where(was_set > 0.5, 1.0, truth(x.kept))
        return (1.0 - reset_now) * np.where(set_now > 0.5, 1.0, before)


class Counter(Block):
    """Counter of the times at which u became true, since the start or since ``reset`` was last true.

    A u that is true at the start is not counted, unless it comes from a source that jumps at t = 0. At a tick the edge
    of that tick is counted already.

    Raises
    ------
    ShapeError
        For inputs of different shapes, and for vectors in a continuous subsystem, when the diagram is built.
    """

    u = Input(shape=None, description="logic signal, of any shape")
    reset = Input(shape=None, default=0.0, description="logic signal that holds the count at zero while it is true")
    y = Output(shape=None, description="the count")
    counted = State(like="u", discrete=True, description="the count so far")
    last = State(like="u", discrete=True, description="u at the last tick")
    edge = Event("rising", "the signal becomes true")
    clear = Event("rising", "the reset becomes true")

    def initial(self, u: Any) -> tuple[Array, Array]:
        """Return zero, and the input just before t = 0 as the last one."""
        return np.zeros(np.shape(u.u)), u.u

    def output(self, t: Array, x: Any, u: Any, T: Array = None) -> Array:
        """Return the count."""
        check_fits(u.reset, "reset", u.u, "u")
        added = 0.0 if T is None else truth(u.u) * (1.0 - truth(x.last))
        return (1.0 - truth(u.reset)) * (x.counted + added)

    def update(self, t: Array, x: Any, u: Any, T: Array = None) -> tuple[Array, Array]:
        """Keep the count and the input."""
        return self.output(t, x, u, T), u.u

    def indicators(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the distances of the inputs above 0.5."""
        return expect_scalar(u.u, "u") - 0.5, expect_scalar(u.reset, "reset") - 0.5

    def jump(self, t: Array, x: Any, u: Any, fired: Any) -> tuple[Array, Array]:
        """Return the count after an event."""
        return (1.0 - truth(u.reset)) * (x.counted + fired.edge), x.last
