"""A slow, plain simulation of a diagram, for tests alone: NumPy and SciPy, and nothing of Loopwright.

A diagram is a list of `Part`, each with its equations as functions of numbers. `ReferenceLoop` goes from one exact instant
(a `Fraction`) to the next with DOP853 at 1e-12, finds events by Brent's method, and does at an instant what
docs/explanation/time.md says under "At one instant". Where rounding would decide what happens, it raises `DelicateError`.
"""

from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np
from scipy.integrate import DOP853, solve_ivp
from scipy.optimize import brentq, root

TIGHT = {"rtol": 1e-12, "atol": 1e-14}
EQUAL = 1e-12  # s: times that are closer count as one
ZONE = 1e-9  # an indicator that is closer to its border is there
LEAST_SLOPE = 1e-2  # 1/s: of an indicator at its crossing
LONGEST, PARTS_OF_A_STEP = 0.04, 8  # s: of a step; instants in it at which indicators are looked at
MOST_ROUNDS, MOST_EVENTS = 20, 500


class DelicateError(Exception):
    """Rounding decides what happens, or events pile up: two right simulations may differ."""


@dataclass
class Part:
    """A block as plain equations of (t, x, z, u), which are a number and three tuples.

    Attributes
    ----------
    name, ports : str, tuple of str
        Its signals are ``name.port``.
    inputs : tuple of str
        Signals that it reads.
    out : callable
        (t, x, z, u) → its outputs. Of a source z is the number of its ``breaks`` that have passed.
    x, z : tuple of float
        Continuous states and all others at the start; ``start`` computes both from the inputs just before t = 0.
    rate, update : callable, optional
        (t, x, z, u) → the rates of x; the next z at a tick.
    direct : bool
        Whether its outputs need its inputs at the same instant.
    clock : tuple of Fraction, optional
        Period and offset; without one, the part is continuous.
    plant : tuple of clocks, optional
        It is stepped from tick to tick of these clocks, with inputs and outputs held in between.
    events : tuple of (str, int, float)
        Name, direction (1 rising, −1 falling, 0 both) and hysteresis for each of its ``indicators``.
    jump : callable
        (t, x, z, u, fired) → x and z after events; fired has 1 for those that rose, −1 for those that fell, else 0.
    kinks : callable, optional
        (t, x, z, u) → numbers at whose zeros its outputs or rates have a kink.
    margins : callable, optional
        (t, x, z, u) → numbers whose signs it branches on at a tick.
    breaks : tuple of Fraction
        Times at which the output of a source is not smooth.
    """

    name: str
    out: Callable[..., Any]
    ports: tuple[str, ...] = ("y",)
    inputs: tuple[str, ...] = ()
    x: tuple[float, ...] = ()
    z: tuple[float, ...] = ()
    start: Callable[..., Any] | None = None
    rate: Callable[..., Any] | None = None
    update: Callable[..., Any] | None = None
    direct: bool = True
    clock: tuple[Fraction, Fraction] | None = None
    plant: tuple[tuple[Fraction, Fraction], ...] = ()
    events: tuple[tuple[str, int, float], ...] = ()
    indicators: Callable[..., Any] | None = None
    jump: Callable[..., Any] | None = None
    kinks: Callable[..., Any] | None = None
    margins: Callable[..., Any] | None = None
    breaks: tuple[Fraction, ...] = ()

    @cached_property
    def signals(self):
        return [f"{self.name}.{port}" for port in self.ports]

    @property
    def clocks(self):
        return self.plant or ((self.clock,) if self.clock else ())


@dataclass
class Record:
    """What a run has recorded: exact times, signals by name, events as (time, part, event)."""

    t: list[Fraction] = field(default_factory=list)
    values: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    events: list[tuple[float, str, str]] = field(default_factory=list)


class ReferenceLoop:
    """One run: ``samples`` are the exact times that are recorded, the last one is its end.

    Times that are further than ``apart`` from one another, in s, have an order that every right simulation finds.
    """

    def __init__(self, parts, samples, apart=1e-8):
        self.parts, self.samples, self.apart = parts, sorted(samples), apart
        last = self.samples[-1]
        self.ticks = defaultdict(set)
        for part in parts:
            for period, offset in part.clocks:
                for k in range(int((last - offset) / period) + 1 if last >= offset else 0):
                    self.ticks[offset + k * period].add(part.name)
            if part.plant:  # they go to the end, wherever that is
                self.ticks[last].add(part.name)
        edges = {b for part in parts for b in part.breaks if 0 < b <= last}
        self.stops = sorted((set(self.ticks) | edges | set(self.samples)) - {Fraction(0)})
        self.watching = [part for part in parts if part.events and not part.clocks]
        self.watched = [(part, i) for part in self.watching for i in range(len(part.events))]
        self.z = {part.name: tuple(part.z) for part in parts}
        self.x = {part.name: tuple(part.x) for part in parts}
        self.integrated = [part for part in parts if part.x and not part.clocks]
        self.held, self.guess, self.plans, self.passed = {}, {}, {}, {}
        self.fresh = set()  # parts that have jumped since their indicators were looked at last
        # indicators that their own part's jump has left at a border
        self.resting = np.zeros(len(self.watched), dtype=bool)
        self.record = Record()

    # --- signals at an instant -----------------------------------------------------------------------------------------

    def enter(self, t, *, right=True):
        """Let the sources have their values from the right of an exact time, or from the left."""
        bisect = bisect_right if right else bisect_left
        self.passed = {part.name: bisect(part.breaks, t) for part in self.parts if part.breaks}

    def plan(self, acting):
        """Return which parts are evaluated before algebraic loops, in them and after them, and the signals to be found."""
        if acting not in self.plans:
            waiting = [p for p in self.parts if not p.plant and (p.clock is None or p.name in acting)]
            known = {s for p in self.parts if p not in waiting for s in p.signals}
            maker = {s: p for p in waiting for s in p.signals}
            order, guessed = [], []
            while waiting:
                ready = next((p for p in waiting if not p.direct or known.issuperset(p.inputs)), None)
                if ready is None:  # go backwards until a part comes again: it is in a loop
                    ready, seen = waiting[0], set()
                    while ready.name not in seen:
                        seen.add(ready.name)
                        ready = maker[next(s for s in ready.inputs if s not in known)]
                    guessed.append(ready)
                else:
                    waiting.remove(ready)
                    order.append(ready)
                known.update(ready.signals)
            unknown = [s for p in guessed for s in p.signals]
            after, leads = set(unknown), set(unknown)  # signals that follow from them, and to them
            for p in order:
                after.update(p.signals if p.direct and after.intersection(p.inputs) else ())
            for p in reversed(order):
                leads.update(p.inputs if p.direct and leads.intersection(p.signals) else ())
            of = [(bool(after.intersection(p.signals)), bool(leads.intersection(p.signals))) for p in order]
            self.plans[acting] = (
                [p for p, (a, _) in zip(order, of, strict=True) if not a],
                [p for p, (a, b) in zip(order, of, strict=True) if a and b],
                [p for p, (a, b) in zip(order, of, strict=True) if a and not b],
                unknown,
            )
        return self.plans[acting]

    def evaluate(self, t, x, acting=frozenset()):
        """Return all signals by name; sampled parts are evaluated if they are acting, else they are held."""
        before, loop, behind, unknown = self.plan(acting)
        found = dict(self.held)

        def go(parts):
            for p in parts:
                z = self.passed[p.name] if p.breaks else self.z[p.name]
                made = p.out(t, x[p.name], z, tuple(found.get(s) for s in p.inputs))  # None: known later, not needed
                if len(p.signals) == 1:
                    found[p.signals[0]] = made
                else:
                    found.update(zip(p.signals, made, strict=True))

        def residual(values):
            found.update(zip(unknown, values, strict=True))
            go(loop)
            return [found[s] - v for s, v in zip(unknown, values, strict=True)]

        go(before)
        if unknown:
            values = root(residual, self.guess.get(acting, np.zeros(len(unknown))), tol=1e-14).x
            rest = residual(values)
            for _ in range(100):  # the loops of the tests contract
                if np.max(np.abs(rest)) < 1e-15:
                    break
                rest = residual(values := np.add(values, rest))
            if np.max(np.abs(rest)) > 1e-13:
                raise DelicateError(f"the algebraic loop of {unknown} is not solved at {t}")
            self.guess[acting] = values
        go(behind)
        return found

    def arguments(self, part, t, x, signals):
        return t, x[part.name], self.z[part.name], tuple(signals[s] for s in part.inputs)

    # --- the run -------------------------------------------------------------------------------------------------------

    def run(self):
        """Go from the start to the last sample."""
        self.begin()
        t = Fraction(0)
        self.land(t)
        for stop in self.stops:
            self.integrate(float(t), float(stop), stop in self.ticks)
            self.step_plants(stop)
            t = stop
            self.land(t)
        return self.record

    def begin(self):
        """Find initial states and first outputs; nothing fires."""
        zero = Fraction(0)
        everything = frozenset(p.name for p in self.parts if p.clock)
        self.enter(zero, right=False)
        for p in self.parts:
            if p.plant:
                self.held.update(zip(p.signals, as_tuple(p.out(0.0, p.x, p.z, None)), strict=True))
        for _ in range(len(self.parts) + 1):  # a value passes one part more each time
            before = dict(self.x), dict(self.z)
            signals = self.evaluate(0.0, self.x, everything)
            for p in self.parts:
                if p.start is not None:
                    self.x[p.name], self.z[p.name] = p.start(tuple(signals[s] for s in p.inputs))
        if before != (self.x, self.z):
            raise DelicateError("initial states depend on themselves")
        if any(zero in p.breaks for p in self.parts) and any(p.start and self.reads_itself(p) for p in self.parts):
            raise DelicateError("an initial state depends on itself, and a source jumps: there are several solutions")
        self.enter(zero)
        first = self.evaluate(0.0, self.x, everything)
        self.held.update({s: signals[s] for p in self.parts if p.clock for s in p.signals})
        self.enter(zero, right=False)
        values = self.indicate(0.0, self.x)
        self.domains = np.where(values > 0.0, 1, np.where(values == 0.0, 0, -1))
        self.held.update({s: first[s] for p in self.parts if p.clock for s in p.signals})
        self.inputs = {}

    def reads_itself(self, part):
        """Whether a part's initial state depends on its own outputs, through those that follow their inputs at once."""
        maker, found, waiting = {s: p for p in self.parts for s in p.signals}, set(), [part]
        while waiting:
            for p in (maker[s] for s in waiting.pop().inputs):
                if p is part:
                    return True
                if p.name not in found and (p.direct or p.start) and not p.plant:
                    found.add(p.name)
                    waiting.append(p)
        return False

    def land(self, exact):
        """Do what happens at an exact instant: events, the tick, events, a sample, the inputs of plants."""
        t, acting = float(exact), frozenset(self.ticks.get(exact, ()))
        self.enter(exact)
        self.moved = set()  # parts that have jumped here: what they leave at a border stays there
        self.settle(t, ahead=bool(acting))
        if acting:
            self.tick(t, acting)
            self.settle(t)
        signals = self.evaluate(t, self.x)
        if exact in self.samples:
            self.record.t.append(exact)
            for name, value in signals.items():
                self.record.values[name].append(float(value))
        for p in self.parts:
            if p.plant and (p.name in acting or not exact):
                self.inputs[p.name] = exact, tuple(signals[s] for s in p.inputs)

    def tick(self, t, acting):
        """Evaluate everything once; the next states and the held outputs take effect together."""
        signals = self.evaluate(t, self.x, acting)
        after = {}
        for p in self.parts:
            if p.clock is None or p.name not in acting:
                continue
            arguments = self.arguments(p, t, self.x, signals)
            if p.margins is not None and any(0.0 < abs(m) < 10 * self.apart for m in as_tuple(p.margins(*arguments))):
                raise DelicateError(f"{p.name} branches on a number that is nearly zero at {t}")
            if p.update is not None:
                after[p.name] = tuple(p.update(*arguments))
        self.held.update({s: signals[s] for p in self.parts if p.clock and p.name in acting for s in p.signals})
        self.z.update(after)

    def step_plants(self, exact):
        """Step the plants that have a tick: with the inputs that they were given at their last one."""
        fresh = {}
        for p in self.parts:
            if p.plant and p.name in self.ticks.get(exact, ()):
                begun, u = self.inputs[p.name]
                span = float(begun), float(exact)
                made = solve_ivp(lambda t, x, p=p, u=u: p.rate(t, x, p.z, u), span, self.x[p.name], "DOP853", **TIGHT)
                self.x[p.name] = tuple(made.y[:, -1])
                fresh.update(zip(p.signals, as_tuple(p.out(float(exact), self.x[p.name], p.z, None)), strict=True))
        self.held.update(fresh)

    # --- events at an instant ------------------------------------------------------------------------------------------

    def indicate(self, t, x, signals=None):
        """Return all indicators."""
        signals = self.evaluate(t, x) if signals is None else signals
        each = (as_tuple(p.indicators(*self.arguments(p, t, x, signals))) for p in self.watching)
        return np.array([value for values in each for value in values], dtype=float)

    def distances(self, values):
        """Return how far inside its domain each indicator is: z > 0, z ≤ 0, each with its hysteresis, or 0 at the start."""
        hysteresis = np.array([p.events[i][2] for p, i in self.watched])
        inside = np.where(self.domains > 0, values, -values)
        return hysteresis + np.where(self.domains == 0, -np.abs(values), inside)

    def has_left(self, distances):
        """Whether indicators have left their domains: z = 0 belongs to the lower one."""
        return np.where(self.domains > 0, distances <= 0.0, distances < 0.0)

    def fires(self, left):
        """Let indicators leave their domains; return which of them fire their events."""
        directions = np.array([p.events[i][1] for p, i in self.watched])
        now = np.where(self.domains == 0, np.sign(self.values), -self.domains)
        self.domains = np.where(left, now, self.domains).astype(int)
        return left & ((directions == 0) | (directions == now))

    def settle(self, t, *, left=None, ahead=False):
        """Fire what has changed its domain, all of it together, until nothing has; ``left`` is known to have."""
        if not self.watched:
            return
        for _ in range(MOST_ROUNDS):
            if left is None:
                left = self.left_at(t, ahead=ahead and t > 0.0)
            fired = self.fires(left)
            if not np.any(fired):
                return
            self.fire(t, fired)
            left = None
        raise DelicateError(f"events go on and on at {t}")

    def left_at(self, t, *, ahead):
        """Which indicators have left their domains; ahead: or do so within a few roundings of a tick, as they belong."""
        self.values = self.indicate(t, self.x)
        distances = self.distances(self.values)
        left = self.has_left(distances)
        own = np.array([p.name in self.moved for p, _ in self.watched])
        jumped = np.array([p.name in self.fresh for p, _ in self.watched])
        near = np.abs(distances) < ZONE
        self.resting = np.where(jumped, near, self.resting & near)
        self.fresh = set()
        left &= ~(self.resting & own)
        unsure = left & (np.abs(distances) < ZONE) & (distances != 0.0)
        if ahead:
            soon, later = self.gone(t, EQUAL), self.gone(t, self.apart)
            if np.any((soon & ~left | unsure) & ~later & ~own) or np.any(later & ~soon & ~own):
                raise DelicateError(f"an event is close to the tick at {t}")
            return left | soon & ~own
        if np.any(unsure):
            raise DelicateError(f"an indicator comes nearly to zero at {t}")
        return left

    def gone(self, t, span):
        """Which indicators have left their domains a little later."""
        return self.has_left(self.distances(self.indicate(t + span, self.moved_on(t, span))))

    def fire(self, t, fired):
        """Let events jump; each sees the instant before all of them."""
        signals, after = self.evaluate(t, self.x), {}
        for p in self.watching:
            own = tuple(
                int(d) if f else 0 for f, d, (q, _) in zip(fired, self.domains, self.watched, strict=True) if q is p
            )
            if not any(own):
                continue
            self.moved.add(p.name)
            self.fresh.add(p.name)
            self.record.events += [(t, p.name, p.events[i][0]) for i, f in enumerate(own) if f]
            if p.jump is not None:
                after[p.name] = p.jump(*self.arguments(p, t, self.x, signals), own)
        if len(self.record.events) > MOST_EVENTS:
            raise DelicateError(f"events pile up until {t}")
        for name, (x, z) in after.items():
            self.x[name], self.z[name] = tuple(x), tuple(z)

    # --- between instants ----------------------------------------------------------------------------------------------

    def rates(self, t, x):
        signals = self.evaluate(t, x)
        return {p.name: as_tuple(p.rate(*self.arguments(p, t, x, signals))) for p in self.integrated}

    def pack(self, x):
        return np.array([v for p in self.integrated for v in x[p.name]], dtype=float)

    def unpack(self, values):
        x, i = {**self.x}, 0
        values = values.tolist()
        for p in self.integrated:
            x[p.name] = values[i : i + len(p.x)]
            i += len(p.x)
        return x

    def slope(self, t, values):
        rates = self.rates(t, self.unpack(values))
        return np.array([v for p in self.integrated for v in rates[p.name]] or [0.0])

    def integrate(self, t, end, is_tick):
        """Go to ``end``, where nothing happens yet, through the events on the way."""
        if not self.integrated and not self.watched:
            return
        while t < end:
            self.leave_start(t)
            found = self.find(t, end)
            if found is None:
                return
            begun, (t, left) = t, found
            if end - t <= EQUAL and is_tick:
                return  # it belongs to the tick, which finds it again
            if end - t < self.apart or t - begun < self.apart:
                raise DelicateError(f"an event at {t} is close to {end} or {begun}")
            self.moved = set()
            self.settle(t, left=left)

    def leave_start(self, t):
        """Fire the events of indicators that have been 0 since the start, and leave it now, by their direction."""
        if not np.any(self.domains == 0):
            return
        soon = 1e-7
        self.values = self.indicate(t + soon, self.moved_on(t, soon))
        beyond = np.abs(self.values) - np.array([p.events[i][2] for p, i in self.watched])
        left = (self.domains == 0) & (beyond > LEAST_SLOPE * soon)
        if np.any(left):
            self.moved = set()
            self.settle(t, left=left)

    def moved_on(self, t, span):
        """Return the continuous states a little later."""
        rates, x = self.rates(t, self.x), {**self.x}
        for p in self.integrated:
            x[p.name] = tuple(np.add(self.x[p.name], span * np.array(rates[p.name])))
        return x

    def find(self, t, end):
        """Integrate until an event; return its time and which indicators leave their domains; None at ``end``."""
        begin, armed, last = t, None, None
        while begin < end:
            values = self.pack(self.x)
            solver = DOP853(self.slope, begin, values if len(values) else np.zeros(1), end, max_step=LONGEST, **TIGHT)
            changed = None
            while solver.status == "running" and changed is None:
                x_old = solver.y.copy()
                message = solver.step()
                if solver.status == "failed":
                    raise DelicateError(message)
                armed, last, changed = self.look(solver.dense_output(), solver.t_old, solver.t, armed, last)
            if changed is None:
                self.x = self.unpack(solver.y)
                return None
            begin, left = self.approach(solver.t_old, x_old, solver.t, changed)
            if np.any(left):
                return begin, left
            armed = last = None  # a kink: the integration begins anew
        return None

    def all_distances(self, t, values):
        """Return the distances of indicators inside their domains, then the kinks."""
        x = self.unpack(values)
        signals = self.evaluate(t, x)
        kinks = [k for p in self.parts if p.kinks for k in as_tuple(p.kinks(*self.arguments(p, t, x, signals)))]
        inside = self.distances(self.indicate(t, x, signals)) if self.watched else np.zeros(0)
        return np.concatenate([inside, kinks])

    def look(self, dense, a, b, armed, last):
        """Look for changes within a step; ``last`` are the distances of the last instant but one of the step before.

        Return which indicators are away from their borders, the next ``last``, and what changes first: a bracket with
        the numbers of the indicators, or of the kinks behind them.
        """
        if not self.watched and not any(p.kinks for p in self.parts):
            return armed, None, None
        times = np.linspace(a, b, PARTS_OF_A_STEP + 1)
        table = np.array([self.all_distances(t, dense(t)) for t in times])
        m = len(self.watched)
        if armed is None:
            armed = np.abs(table[0]) > ZONE
        if last is not None and armed[:m].any():
            for i in np.nonzero(armed[:m])[0]:
                self.check_near_miss((last[i], table[0, i], table[1, i]), a)
        first = None
        for i in range(table.shape[1]):
            column = table[:, i]
            if i < m and self.domains[i] == 0 and np.min(column) < -ZONE:
                raise DelicateError(f"{self.watched[i][0].name} leaves zero, where it has started")
            for j in range(1, len(times)):
                if not armed[i]:
                    if abs(column[j]) <= ZONE:
                        continue
                    armed[i] = True
                    if i < m and column[j] < 0.0:
                        self.leave_silently(i, times[j])
                        table[:, i] *= -1.0
                    continue
                if (i < m and column[j] < 0.0) or (i >= m and column[j] * column[j - 1] < 0.0):
                    if first is None or j < first[0]:
                        first = j, set()
                    if j == first[0]:
                        first[1].add(i)
                    break
                if i < m and 0 < j < len(times) - 1:
                    self.check_near_miss(column[j - 1 : j + 2], times[j])
        if first is None:
            return armed, table[-2], None
        return armed, None, (times[first[0] - 1], times[first[0]], first[1])

    def leave_silently(self, i, t):
        """An indicator that has stood at its border goes to the other side."""
        left = np.zeros(len(self.watched), dtype=bool)
        left[i] = True
        if self.fires(left)[i]:
            raise DelicateError(f"{self.watched[i][0].name} leaves zero at {t}")

    @staticmethod
    def check_near_miss(three, t):
        """Refuse an indicator that turns just before its border: the lowest point of a parabola through three values."""
        before, here, after = three
        curve = before - 2.0 * here + after
        if here <= min(before, after) and curve > 0.0 and here - (after - before) ** 2 / (8.0 * curve) < 1e-6:
            raise DelicateError(f"an indicator nearly crosses zero at {t}")

    def approach(self, t_old, x_old, t_new, changed):
        """Return the time of a change, exactly, with the states there, and which indicators leave their domains.

        The dense output of a step is less exact than its ends: a short last step leads there.
        """
        low, high, which = changed
        made = solve_ivp(self.slope, (t_old, high), x_old, "DOP853", dense_output=True, **TIGHT)
        width = high - low
        roots = {}
        for i in which:
            at_low, at_high = (self.all_distances(t, made.sol(t))[i] for t in (low, high))
            if not at_low * at_high < 0.0:
                raise DelicateError(f"an indicator is nearly zero at {low}")
            roots[i] = brentq(lambda t, i=i: self.all_distances(t, made.sol(t))[i], low, high, xtol=1e-15, rtol=1e-15)
        near = min(roots.values())
        begin, beyond = max(t_old, near - 1e-3 * width), near + 1e-3 * width
        x = x_old
        if begin > t_old:
            x = solve_ivp(self.slope, (t_old, begin), x_old, "DOP853", **TIGHT).y[:, -1]
        made = solve_ivp(self.slope, (begin, beyond), x, "DOP853", dense_output=True, **TIGHT)

        def value(t, i):
            return self.all_distances(t, made.sol(t))[i]

        for i in which:
            if value(begin, i) * value(beyond, i) < 0.0:
                roots[i] = brentq(value, begin, beyond, (i,), xtol=1e-15, rtol=1e-15)
        found = min(roots.values())
        m, left = len(self.watched), np.zeros(len(self.watched), dtype=bool)
        for i, t in roots.items():
            if i >= m:
                continue
            if t - found <= EQUAL:
                left[i] = True
            elif t - found < self.apart:
                raise DelicateError(f"two events at {found}, one just behind the other")
        for i in np.nonzero(left)[0]:
            if abs(value(begin, i) - value(beyond, i)) < LEAST_SLOPE * (beyond - begin):
                raise DelicateError(f"an indicator crosses zero slowly at {found}")
        self.x = self.unpack(made.sol(found))
        return found, left


def as_tuple(values):
    return tuple(values) if isinstance(values, tuple | list) else (values,)
