"""Events in continuous time: the domains of indicators, and the events that changes of them fire.

**Domains.** An indicator z is in one of two domains, z > 0 or z ≤ 0; with a hysteresis δ it leaves the first at z ≤ −δ
and the second at z > δ. A change in the declared direction fires the event.

**Contact.** Zero itself is the border. An indicator that is exactly 0 at the start is in neither domain, and so is one
that the jump of its own event leaves in contact by an impact: the jump changes continuous states of the block, and
with them the motion of the indicator, leaves it on 0 or where the event found it, and the rates lead on beyond. The
direction in which it leaves decides: down is falling, up is rising, and that fires the event if it is declared. So a
ball that starts on the floor and moves down, or would fall, hits the floor at the start, one that moves up does not;
sin ωt rises at the start, −sin ωt falls. An indicator that comes to 0 by itself has changed its domain, and going on
from there fires nothing.

**Rest.** A jump whose motion leads back beyond contact at once, again and again, rests there. That is an error which
names the event: its block needs a state of rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatDiagram, FlatEvent
from ..solvers import AcceptedStep
from .limits import BRIEF, EventLimits
from .search import EventSearch, Many

_SAME_INSTANT = 100  # events that fire each other at one instant

_ROUNDING = 1e-13  # of an indicator near the border, relative to its values in a step
_SCATTER = (
    8.0  # rounding errors of an indicator that has just crossed zero, relative to those seen, or its values there
)
_LESS = 1.0 - 1e-6  # of its speed is left after an impact that has taken energy, by more than rounding does
_LEAST = 1e-15  # of its values in a step: rounding errors of what is computed from such values
_CLOSE = 1e-11  # of an indicator that may cross zero within ulps of the time, relative to its values in the last step
_CONTINUOUS = 1e-9  # they are at most this part of its values in the step: else it jumps there

Indicators = Callable[[float, np.ndarray], np.ndarray]


class Motion(NamedTuple):
    """The continuous states and the indicators at an instant, and its changes in one and two steps of Euler's."""

    x: np.ndarray
    z: np.ndarray
    once: np.ndarray
    twice: np.ndarray


class Domains:
    """The domains of all indicators, and the events that changes of them fire.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    g : callable
        ``g(t, x)``: the indicators, at a time and the continuous states.
    many : callable
        ``many(times, states)``: the indicators at several times, one row each, and which subsystems are open there.
    rates : callable
        ``rates(t, x)``: the derivative of the continuous states.
    opened : ndarray
        Written by ``g``: 1 where the subsystem around an event is open.
    time_scale : float
        Shortest time in s within which a source changes.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        g: Indicators,
        many: Many,
        rates: Indicators,
        opened: np.ndarray,
        time_scale: float = math.inf,
    ):
        n = len(flat.events)
        self.events, self.g, self._open, self._rates = flat.events, g, opened, rates
        self.spacing = min(float(flat.base), time_scale)
        """Longest time in s between two instants at which indicators are evaluated."""
        self.rising = np.array([e.direction != "falling" for e in flat.events])
        self.falling = np.array([e.direction != "rising" for e in flat.events])
        self._hysteresis = np.array([e.hysteresis for e in flat.events])
        self.has_hysteresis = self._hysteresis > 0.0
        self._gates = np.array([e.subsystem for e in flat.events], dtype=bool)
        self.domain = np.zeros(n, dtype=int)
        """1 above, −1 below, 0 on the border."""
        self._low, self._high = -self._hysteresis, self._hysteresis.copy()
        self._first = self.domain
        self._least = np.nextafter(-self._hysteresis, math.inf)
        self._size, self._rounding = np.zeros(n), np.zeros(n)
        """Distance from the border within which the direction of leaving it may be one of rounding."""
        self._slack = np.zeros(n)
        """Distance beyond zero to which an indicator that has just crossed it counts as beyond: that of rounding."""
        self._lows, self._highs = np.full((3, n), -math.inf), np.full((3, n), math.inf)
        self._columns, self._z = np.arange(n), np.zeros(n)
        self._bounds_of: np.ndarray | None = None  # the domains that these were made for last; no array of them changes
        self._bounds = self._lows[1], self._highs[1]
        self._slackens = False
        self._strict_of: np.ndarray | None = None
        self._strict: tuple[np.ndarray, np.ndarray] | None = None
        self._set_bounds()
        self.limits = EventLimits(flat.events)
        self._many, self.search = many, EventSearch(self, many, self.spacing)
        self.own = [_continuous_states(flat, e) for e in flat.events]
        """Places of the states of each event's block among the continuous ones."""
        self._moves = np.array([where.size > 0 for where in self.own], dtype=bool)

    # --- the rule ----------------------------------------------------------------------------------------------------

    def bounds(self, domain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest value of each indicator that leaves it in its domain."""
        if domain is not self._bounds_of:
            row = domain + 1
            self._bounds = self._lows[row, self._columns], self._highs[row, self._columns]
            self._bounds_of = domain
        return self._bounds

    def _without_slack(self, domain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low = np.where(domain > 0, self._least, np.where(domain < 0, -math.inf, self._lows[1]))
        return low, np.where(domain < 0, self._hysteresis, np.where(domain > 0, math.inf, self._highs[1]))

    def strict_bounds(self, domain: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return `bounds` without slack for rounding errors; None if an indicator is on the border."""
        if domain is not self._strict_of:
            self._strict = self._without_slack(domain) if domain.all() else None
            self._strict_of = domain
        return self._strict

    def _set_bounds(self) -> None:
        """Write the table of bounds, one row for each domain: below, on the border, above."""
        self._bounds_of = None
        self._slackens = any(self._slack.tolist())  # quicker than NumPy for a few
        np.subtract(self._low, self._rounding, out=self._lows[1])
        np.subtract(self._least, self._slack, out=self._lows[2])
        np.add(self._hysteresis, self._slack, out=self._highs[0])
        np.add(self._high, self._rounding, out=self._highs[1])

    def domains_of(
        self, z: np.ndarray, before: np.ndarray, bounds: tuple[np.ndarray, np.ndarray] | None = None
    ) -> np.ndarray:
        """Return the domains at the values z of the indicators, which come from the domains ``before``."""
        low, high = self.bounds(before) if bounds is None else bounds
        now = np.where(z > high, 1, np.where(z < low, -1, before))
        if min(self._open.tolist()) > 0.5:
            return now
        return np.where(self._open > 0.5, now, before)  # a closed subsystem holds them

    def domains_at(self, z: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return the domains at an instant: if events fire there, no slack hides another indicator's change.

        Two events may look at one quantity, as the two of a relay do: what one of them has crossed, the other has, too.
        """
        now = self.domains_of(z, before)
        fired = self.fires(before, now)
        if not self._slackens or not fired.any():
            return now
        strict = self.domains_of(z, before, self._without_slack(before))
        return np.where(fired | self.fires(before, strict), now, strict)

    def fires(self, before: np.ndarray, now: np.ndarray) -> np.ndarray:
        """Return which events a change of domains fires."""
        return np.asarray(((now > before) & self.rising) | ((now < before) & self.falling))

    def take(self, now: np.ndarray) -> None:
        """Take over the domains at an instant or between events."""
        self.limits.note(now)
        self.domain = now

    # --- one instant -------------------------------------------------------------------------------------------------

    def begin(self, t: float, x: np.ndarray) -> None:
        """Take the domains as they are; nothing fires."""
        z = np.array(self.g(t, x))
        on_border = (z == 0.0) & ~self._gates
        self.domain = self._first = np.where(z > 0.0, 1, np.where(on_border, 0, -1))
        self._low, self._high = -self._hysteresis, self._hysteresis.copy()
        self._slack = np.zeros_like(self._slack)
        self._set_bounds()

    def reset(self, subsystem: str) -> None:
        """Go back to the domains of the start for the blocks in a subsystem whose states have done so."""
        inside = np.array([e.path.startswith(f"{subsystem}.") and not e.subsystem for e in self.events])
        self.domain = np.where(inside, self._first, self.domain)
        self._set_bounds()

    def update(self, t: float, x: np.ndarray) -> np.ndarray:
        """Take over the domains at one instant, and return which events their changes fire."""
        self._z = np.array(self.g(t, x))
        now = self.domains_at(self._z, self.domain)
        fired = self.fires(self.domain, now)
        self.take_fired(fired, now)
        return fired

    def is_close(self) -> bool:
        """Return whether an indicator was so close to zero at the last `update` that it may cross it at once."""
        return bool(np.any((np.abs(self._z) <= _CLOSE * self._size) & (self._size > 0.0)))

    def update_ahead(self, t: float, x: np.ndarray) -> np.ndarray:
        """Take over the domains of the events that fire at an instant just after the last `update`; return them."""
        z = np.array(self.g(t, x))
        now = self.domains_of(z, self.domain)
        fired = self.fires(self.domain, now)
        if fired.any():
            self.take_fired(fired, np.where(fired, now, self.domain))
            self._slack = np.where(fired, self._slack_after(np.maximum(np.abs(z), np.abs(self._z))), self._slack)
            self._set_bounds()
        return fired

    def take_fired(self, fired: np.ndarray, now: np.ndarray) -> None:
        """Take over the domains at an instant at which events fire."""
        self.limits.note_left_border(fired, self.domain, now)
        self.take(now)

    def locate(self, step: AcceptedStep) -> tuple[float, np.ndarray] | None:
        """Return the first instant in a step at which events fire, and which; None if none does."""
        found = self.search.first_event(step)
        if found is None:
            return None
        fired = self.fires(found.before, found.now)
        self.limits.note(found.before)
        self.domain = found.before
        self.take_fired(fired, found.now)
        self._slack = np.where(fired, self._slack_after(found.values), self._slack)
        self._set_bounds()
        return found.t, fired

    def _slack_after(self, values: np.ndarray) -> np.ndarray:
        """Return the slack of indicators that have just crossed zero, from their values and rounding errors there."""
        return np.asarray(np.minimum(np.maximum(_SCATTER * values, _LEAST * self._size), _CONTINUOUS * self._size))

    @property
    def slack(self) -> np.ndarray:
        """Distance beyond zero to which an indicator that has just crossed it counts as beyond."""
        return self._slack

    def slack_of(self, scatter: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Return the slack of indicators that scatter so far about straight lines, with values up to the size."""
        return np.asarray(np.minimum(_SCATTER * scatter, _CONTINUOUS * size))

    def look_at(self, size: np.ndarray, scatter: np.ndarray | None) -> None:
        """Note the largest values of the indicators in a step that is searched, and how they scatter at its start."""
        self._size, self._rounding = size, _ROUNDING * size
        if scatter is not None:
            self._slack = np.maximum(self._slack, self.slack_of(scatter, size))
            self._set_bounds()
        elif not self.domain.all():  # of rounding there is a matter on the border only
            self._set_bounds()

    def pass_by(self, size: np.ndarray, later: np.ndarray) -> bool:
        """Take over a step in which nothing happened; return False, and take nothing, if slack is left after it.

        Parameters
        ----------
        size, later : ndarray
            Largest absolute values of the indicators in the step, and those without its start.
        """
        if (self.search.fresh or self._slackens) and not np.all((later > self._slack) & (later > _CONTINUOUS * size)):
            return False
        self._size, self._rounding = size, _ROUNDING * size
        if self._slackens:
            self._slack = np.zeros_like(self._slack)
            self._set_bounds()
        self.take(self.domain)
        return True

    def clear(self, z: np.ndarray, distance: np.ndarray, size: np.ndarray) -> np.ndarray | None:
        """Return which values are outside of the strict bounds if all slack is gone before the first one is, else None.

        Slack makes no difference then, and is taken away. Nor does it matter how values scatter where the step begins.

        Parameters
        ----------
        z, distance : ndarray
            The indicators and their absolute values, one instant a row, after the first one.
        size : ndarray
            Largest absolute values in the step.
        """
        bounds = self.strict_bounds(self.domain)
        if bounds is None:
            return None
        low, high = bounds
        out = np.asarray((z > high) | (z < low))
        first = int(out.argmax())
        row = first // out.shape[1] if out.flat[first] else len(out)
        if not row or not np.all(distance[:row].max(axis=0) > np.maximum(self._slack, _CONTINUOUS * size)):
            return None
        self._size, self._rounding, self._slack = size, _ROUNDING * size, np.zeros_like(size)
        self._set_bounds()
        return out

    def outside(self, z: np.ndarray, domain: np.ndarray) -> np.ndarray:
        """Return which values of the indicators, one instant a row, are outside of the bounds of their domains.

        One that has just crossed zero, and is far from it at an instant, has done so: no slack is left from there on.
        """
        low, high = self.bounds(domain)
        out = np.asarray((z > high) | (z < low))
        if not self._slackens:
            return out
        far = (np.abs(z) > self._slack) & (self._slack > 0.0)
        first = int(far.argmax())
        row = first // far.shape[1]
        if far.flat[first] and not out[: row + 1].any():
            self._slack = np.where(far[row], 0.0, self._slack)
            self._set_bounds()
            out[row + 1 :] = self.outside(z[row + 1 :], domain) if row + 1 < len(z) else False
        return out

    # --- contact -----------------------------------------------------------------------------------------------------

    def motion(self, t: float, x: np.ndarray, fired: np.ndarray) -> Motion | None:
        """Return what `land` compares of the instants before and after a jump; None if no block that jumps moves."""
        if not np.any(fired & self._moves):
            return None
        h = self.spacing
        once = x + h * self._rates(t, x)
        twice = once + h * self._rates(t, once)
        z, _ = self._many(np.array([t, t, t]), np.array([x, once, twice]))
        return Motion(x.copy(), z[0], z[1] - z[0], z[2] - z[0])

    def land(self, before: Motion | None, t: float, x: np.ndarray, fired: np.ndarray) -> None:
        """Put those indicators on the border that their own jumps leave in contact.

        A jump does so if it is an impact, which changes continuous states of its block and with them the motion of the
        indicator, and if the indicator is no further than where the event has found it and moves on beyond.

        Parameters
        ----------
        before : Motion or None
            `motion` before the jumps.
        t, x
            The instant after them.
        fired : ndarray
            The events that have fired.
        """
        if before is None:
            return
        after = self.motion(t, x, fired)
        assert after is not None
        for i in np.flatnonzero(fired & self._moves).tolist():
            side, own = self.domain[i], self.own[i]
            away = side * after.z[i] < 0.0 or abs(after.z[i]) > abs(before.z[i])
            if away or not side * after.twice[i] > 0.0 or np.array_equal(before.x[own], after.x[own]):
                continue
            if after.once[i] != before.once[i] or self.limits.rests(i):
                self.domain = self.domain.copy()
                self.domain[i] = 0
                self._low[i] = min(after.z[i], -self._hysteresis[i])
                self._high[i] = max(after.z[i], self._hysteresis[i])
                self._set_bounds()
                self.limits.note_contact(i, int(side))
                if _is_brief(before, after, i, int(side)):
                    self.limits.count_brief(i, t, self.spacing)

    # --- never a hang ------------------------------------------------------------------------------------------------

    def count(self, t: float, x: np.ndarray, fired: np.ndarray) -> None:
        """Note that events fired; raise if they pile up: chattering, Zeno behaviour, or a rest in contact."""
        self.search.fresh = True
        self.limits.count(t, fired, lambda: self._change(t, x))

    def chatters(self, t: float, x: np.ndarray) -> SimulationError:
        """Return the error of events that chatter at t, in s, and the continuous states x."""
        return self.limits.chatters(t, *self._change(t, x))

    def _change(self, t: float, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return a time in s, and by how much the indicators change in it."""
        h = self.spacing
        z, _ = self._many(np.array([t, t]), np.array([x, x + h * self._rates(t, x)]))
        return h, np.abs(z[1] - z[0])

    def too_many(self, t: float, fired: np.ndarray) -> SimulationError:
        """Return the error of events that fire each other at one instant for ever."""
        return self.limits.endless(t, fired, _SAME_INSTANT)

    @property
    def most(self) -> int:
        """Most rounds of events that may follow each other at one instant."""
        return _SAME_INSTANT

    def save(self) -> Any:
        """Return what is needed to go on from here."""
        domains = self.domain.copy(), self._first.copy(), self._low.copy(), self._high.copy(), self._slack.copy()
        noise = self._size.copy(), self._rounding.copy()
        return domains, noise, self.search.fresh, self.limits.save()

    def restore(self, saved: Any) -> None:
        """Go back to what `save` returned."""
        domains, noise, self.search.fresh, limits = saved
        self._size, self._rounding = (part.copy() for part in noise)
        self.domain, self._first, self._low, self._high, self._slack = (part.copy() for part in domains)
        self._set_bounds()
        self.limits.restore(limits)


def _is_brief(before: Motion, after: Motion, i: int, side: int) -> bool:
    """Return whether an impact has taken energy, and the flight after it is too brief to be told from a rest.

    It leaves with v h in one step of Euler and 2 v h − a h² in two; its flight takes 2 v/a = 2 v h/(a h²) steps.
    """
    leaving = -side * after.once[i]
    fall = 2.0 * leaving + side * after.twice[i]
    return bool(2.0 * leaving <= BRIEF * fall and abs(after.once[i]) <= _LESS * abs(before.once[i]))


def _continuous_states(flat: FlatDiagram, event: FlatEvent) -> np.ndarray:
    """Return where the states of an event's block are among the continuous ones."""
    if event.subsystem or event.path not in flat.states.slices:
        return np.zeros(0, dtype=int)
    where = flat.states.slices[event.path]
    return np.flatnonzero((flat.continuous >= where.start) & (flat.continuous < where.stop))
