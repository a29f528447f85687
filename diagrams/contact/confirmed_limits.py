"""Confirmation of limits of coupled stability by runs of the nonlinear diagram, with the environment at its plant.

`TrialMethod` says where the environment is in a run. A run is set in motion by a small push. The growth rate of the
mode that the limit is about is measured by its amplitude in two windows: that of the contact's velocity, demodulated
at the mode's predicted frequency.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import ConfirmationError, OptionError, accepts, explain_calls, kinds, near
from ...fmus.fmu_block import Fmu
from ..linearization import PlantEquations, copy_point, find_signal, hold_sources, linearize, linearize_plant
from ..simulation import RunOptions, simulate
from .attached_environment import attach_environment
from .moored_plant import Mooring, library_class, moored_diagram
from .stability_limits import GROWTH_AT, ContactLimit, to_rates
from .touched_plant import TouchedPlant

if TYPE_CHECKING:
    from ..flat import WiredDiagram
    from ..results import OperatingPoint


STEP = 1e-3
"""Sample time in s of the run of a continuous diagram."""
START = 2.5
"""Ticks up to which an operating point is the start."""
PRECISE = 1e-6
"""Absolute tolerance of the solver, relative to the push."""
RTOL = 1e-8
"""Relative tolerance of the solver."""
AROUND = 0.3
"""Part of a limit's frequency within which the mode of another loop is looked for."""
ON_TICK = 1e-5
"""Part of a tick within which a sample is that of the tick."""
SEARCHES = 12
"""Most linear models of a loop with a held force."""
SAME = 1e-6
"""Relative error of the limit with a held force."""


class TrialMethod(Enum):
    """Place of the environment in a run."""

    INSIDE = "the environment inside the plant"
    """In the equations of a plant of the library, in its own FMU or block."""
    SOLVER = "the environment next to the plant, in the solver"
    """A block next to a plant with equations, or next to an FMU in model exchange."""
    HELD = "the environment's force held between communication points"
    """A block next to an FMU in co-simulation: the loop has another limit, and its own linear prediction."""


@dataclass
class LimitTrials:
    """Runs next to a limit, and predictions for them."""

    contact: TouchedPlant
    limit: ContactLimit
    method: TrialMethod
    _still: WiredDiagram = field(repr=False)
    _model: PlantEquations | None = field(default=None, repr=False)
    _known: dict[float, np.ndarray] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, contact: TouchedPlant, limit: ContactLimit, method: TrialMethod | str | None) -> LimitTrials:
        """Return the trials of a contact's limit."""
        chosen = _choose(contact, limit, method)
        model = None
        if chosen is not TrialMethod.INSIDE:
            model = linearize_plant(contact.wired, contact.point, contact.plant)
        made = cls(contact, limit, chosen, hold_sources(contact.wired, contact.point.values), model)
        stepped = contact.wired.blocks[contact.plant].stepped and contact.sample_time > 0.0
        open_choice = method is None and chosen is TrialMethod.SOLVER and stepped
        if open_choice and made._diagram(limit.value, 0.0).loops == "solve":
            made.method = TrialMethod.HELD  # the FMU does not list its dependencies: each evaluation would be a loop
        return made

    def find_rates(self, value: float) -> np.ndarray:
        """Return the poles of the loop in 1/s that are predicted for a run."""
        if value not in self._known:
            if self.method is TrialMethod.HELD:
                made = self._diagram(value, 0.0)
                at = self._start(made) or 2.0 * self.contact.sample_time  # the first tick is its own
                model = linearize(made, at)
                self._known[value] = to_rates(replace(self.contact.parts, sample_time=model.dt), model.poles)
            else:
                loop = self.contact.loop(self.limit.vary, **self.limit.environment)
                A = loop.modes.reduce(loop.close(value).A)
                self._known[value] = to_rates(self.contact.parts, np.linalg.eigvals(A))
        return self._known[value]

    def find_mode(self, value: float) -> complex:
        """Return the pole, in 1/s, of the mode that the limit is about."""
        rates, omega = self.find_rates(value), self._fold(self.limit.frequency)
        away = np.abs(np.abs(rates.imag) - omega)
        if self.method is TrialMethod.HELD:
            close = np.flatnonzero(away <= max(AROUND * omega, 1.0))
            if not len(close):
                raise ConfirmationError(
                    f"found no mode near {omega:.4g} rad/s, at which {self.limit.vary} {self.limit.value:.6g} "
                    f"{self.limit.unit} breaks the loop, where the force is held; expected one within {AROUND:.0%}. "
                    "Take an FMU with model exchange.",
                    block=self.contact.plant,
                )
            return complex(rates[close[int(np.argmax(rates[close].real))]])
        return complex(rates[int(np.argmin(away - 1e-3 * rates.real))])

    def find_frequency(self, mode: complex) -> float:
        """Return the frequency of a mode in rad/s: of its aliases the one next to the limit's."""
        T = self.contact.sample_time
        if not T:
            return abs(mode.imag)
        turn, near = 2.0 * np.pi / T, self.limit.frequency
        found = [sign * abs(mode.imag) + turn * round((near - sign * abs(mode.imag)) / turn) for sign in (1, -1)]
        return float(min(found, key=lambda omega: abs(omega - near)))

    def _fold(self, omega: float) -> float:
        """Return the alias of a frequency that a pole over the period shows, rad/s."""
        T = self.contact.sample_time
        return min(omega % (2.0 * np.pi / T), -omega % (2.0 * np.pi / T)) if T else omega

    def find_own_limit(self) -> float:
        """Return the limit that runs are tried next to: with a held force, that of that loop's linear model."""
        if self.method is not TrialMethod.HELD:
            return self.limit.value
        x = [0.97 * self.limit.value, self.limit.value]
        y = [self.find_mode(v).real for v in x]
        for _ in range(SEARCHES):
            if y[-1] == y[-2]:
                break
            step = -y[-1] * (x[-1] - x[-2]) / (y[-1] - y[-2])
            x.append(x[-1] + max(-0.5 * x[-1], min(x[-1], step)))  # no farther than to half, or to twice
            y.append(self.find_mode(x[-1]).real)
            if abs(x[-1] - x[-2]) <= SAME * x[-1]:
                return x[-1]
        raise ConfirmationError(
            f"found no limit of the loop with a held force near {self.limit.vary} {self.limit.value:.6g} "
            f"{self.limit.unit}; expected one, whose runs could be compared. Take an FMU with model exchange.",
            block=self.contact.plant,
        )

    def run(self, value: float, push: float, duration: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return times, the velocity along the mode's direction, and the largest speed."""
        contact = self.contact
        step = contact.shortest or STEP
        made = self._diagram(value, push)
        name = f"{contact.plant}.{contact.ports.velocity}"
        options: dict[str, Any] = {"record": [name], "states": False, **({} if made.has_clock else {"step": step})}
        if self.method is TrialMethod.SOLVER:
            options |= {"rtol": RTOL, "atol": PRECISE * push}
        t0 = contact.point.t if self._is_away else 0.0
        if self._is_away:
            options["start"] = self._start(made)
        run = simulate(made, duration + 4 * step, RunOptions.of(options, block=made.name), progress=False)
        t = np.asarray(run.t) - t0
        count = np.round(t / step)
        ticks = np.flatnonzero(np.abs(t / step - count) <= ON_TICK)
        rows = ticks[np.unique(count[ticks].astype(int), return_index=True)[1]]
        velocity = np.asarray(run[name])[rows].reshape(len(rows), -1)
        along = np.asarray(self.limit.direction or contact.direction)
        return t[rows], velocity @ along, float(np.max(np.linalg.norm(velocity, axis=1)))

    @property
    def _is_away(self) -> bool:
        """Whether the operating point is not the diagram's start."""
        return self.contact.point.t > START * float(self.contact.point.base)

    def _start(self, made: WiredDiagram) -> OperatingPoint | None:
        """Return the operating point of a diagram with an environment; None for the start."""
        return copy_point(self.contact.wired, self.contact.point, made) if self._is_away else None

    def _diagram(self, value: float, push: float) -> WiredDiagram:
        """Return the diagram with the environment."""
        contact, still = self.contact, self._still
        environment = {**self.limit.environment, self.limit.vary: value}
        mass = environment.pop("tool_mass", None)
        tool = None if mass is None else self._on_sensor(float(mass))
        d = contact.direction
        mobility = float(d @ contact.parts.velocity @ contact.parts.force @ d)
        step = contact.sample_time or STEP
        begin = contact.point.t if self._is_away else 0.0
        mooring = Mooring(
            d,
            np.asarray(contact.point.values[f"{contact.plant}.{contact.ports.position}"], dtype=float),
            **{name: float(v) for name, v in environment.items()},
            kick=push / (mobility * step),
            kick_time=begin + step,
            kick_start=begin,
        )
        source = find_signal(still.flatten_like(contact.point), contact.entry) if contact.entry else None
        if source is not None and source.port[0] == contact.plant:
            raise OptionError(
                f"found {source.name!r}, which the plant measures itself; expected a sensor outside of it, to whose "
                "force that of the environment is added. Put a ForceSensor there, and name its wire: force=….",
                block=contact.plant,
            )
        if self.method is TrialMethod.INSIDE:
            ports = (contact.ports.force, contact.ports.position, contact.ports.velocity)
            return moored_diagram(still, contact.plant, ports, source, mooring, tool)
        assert self._model is not None
        tick = Fraction(contact.point.base) if contact.sample_time else None
        held = self.method is TrialMethod.HELD
        return attach_environment(still, contact.ports, self._model, source, mooring, tool, tick, held=held)

    def _on_sensor(self, mass: float) -> dict[str, float]:
        """Return a tool by the path of the contact's force sensor."""
        sensor = self.contact.parts.tool.sensor
        if sensor is None:
            raise OptionError(
                "found no ForceSensor on the way of the measured force; a run with another tool mass needs one, whose "
                "measured force leaves out the tool's inertia. Put one there, or take a limit of stiffness, damping "
                "or mass.",
                block=self.contact.plant,
                port="tool_mass",
            )
        return {sensor: mass}


def _choose(contact: TouchedPlant, limit: ContactLimit, method: TrialMethod | str | None) -> TrialMethod:
    """Return the place of the environment: the one that is asked for, or the first that is possible."""
    block = contact.wired.blocks[contact.plant]
    has_mass = limit.vary == "mass" or limit.environment.get("mass", 0.0) > 0.0
    equations = not block.stepped or (isinstance(block, Fmu) and block.description.model_exchange is not None)
    possible = []
    if (
        library_class(block) is not None
        and contact.direction.shape == (2,)
        and (contact.sample_time > 0.0 if block.stepped else not (has_mass or isinstance(block, Fmu)))
    ):
        # but where the environment's force would act in a circle through the tick: that of a mass, or any that an FMU
        # in model exchange states to depend on its inputs, as the environment inside may have a mass
        possible.append(TrialMethod.INSIDE)
    if equations:
        possible.append(TrialMethod.SOLVER)
    if block.stepped and contact.sample_time > 0.0:
        # a mass makes an algebraic loop through an FMU in model exchange, which costs a hundred times as much
        possible.insert(len(possible) - (equations and has_mass), TrialMethod.HELD)
    names = {one.name.lower(): one for one in TrialMethod}
    asked = names.get(method) if isinstance(method, str) else method
    if method is not None and not isinstance(asked, TrialMethod):
        raise OptionError(f"found {method!r}. {near(str(method), names)}", block=contact.plant, port="method")
    if asked is not None and asked not in possible:
        raise OptionError(
            f"found {asked.name.lower()!r}, which this plant does not allow; expected one of "
            f"{', '.join(one.name.lower() for one in possible) or 'none'}. Leave it out.",
            block=contact.plant,
            port="method",
        )
    if not possible:
        raise OptionError(
            "found a continuous diagram around an FMU without model exchange, which exchanges signals with it at the "
            "ends of steps alone; expected one that can be run as its limit is computed. Confirm a sampled one: "
            "diagram.sampled(1e-3).",
            block=contact.plant,
        )
    return asked or possible[0]


FACTORS = (0.97, 1.03)
"""Shares of a limit at which the diagram is run."""
PUSH = 1e-6
"""Velocity in m/s that the push gives the contact."""
PUSHES = (1e-6, 1e-8, 1e-10)
"""Velocities in m/s that are tried one after the other."""
WITHIN = 0.1
"""Largest difference of measured and predicted growth rate, relative to the larger prediction of the two runs."""
PERIODS = 40.0
"""Periods of the mode in a window."""
FEWEST = 50
"""Fewest samples in a window."""
WINDOW = 2.0
"""Longest window in s."""
GROWN = 5.0
"""Largest growth of the mode in a run, as an exponent."""
DECAYED = 9.0
"""Time that other modes have to decay, in their time constants relative to the mode's own."""
OWN = 1e-4
"""Largest difference of the growth rates next to a limit, absolute in 1/s and relative, of one contact."""
UNEVEN = 1e-3
"""Relative difference of the times between samples up to which they are even."""
LONGEST = 8.0
"""Longest time in s that is waited for other modes."""


@explain_calls
@dataclass(frozen=True)
class ContactTrial:
    """A run next to a limit.

    Attributes
    ----------
    factor, value : float
        Share of the limit, and the value of the property.
    predicted, measured : float
        Growth rate in 1/s: of the linear loop, and in the run.
    fastest : float
        Largest speed of the contact in the run, m/s: the amplitude for which this holds.
    """

    factor: float
    value: float
    predicted: float
    measured: float
    fastest: float


@explain_calls
@dataclass(frozen=True)
class ContactConfirmation:
    """Runs below and above a limit, with the environment at the plant.

    Attributes
    ----------
    limit : ContactLimit
        The limit.
    below, above : ContactTrial
        The runs.
    within : float
        Difference in 1/s of measured and predicted growth rate that was allowed.
    duration : float
        Length of the runs in s.
    method : TrialMethod
        Place of the environment in the runs.
    tried : float
        Limit that the runs are next to: that of the contact; for a held force, that of the loop with the held force.
    """

    limit: ContactLimit
    below: ContactTrial
    above: ContactTrial
    within: float
    duration: float
    method: TrialMethod = TrialMethod.INSIDE
    tried: float = math.nan

    def __str__(self) -> str:
        trials = "; ".join(f"{t.measured:.4g} (predicted {t.predicted:.4g}) at {t.factor:g}" for t in self.trials)
        of = "of the limit"
        if self.method is TrialMethod.HELD:
            of = f"of {self.tried:.6g} {self.limit.unit}, the limit that the held force has itself"
        return (
            f"growth rates in 1/s of the nonlinear run with {self.method.value}: {trials} {of}; speeds up to "
            f"{max(t.fastest for t in self.trials):.2g} m/s"
        )

    @property
    def trials(self) -> tuple[ContactTrial, ContactTrial]:
        """Both runs."""
        return self.below, self.above


@accepts(
    "{contact.plant}",
    limit=kinds.one_of_class(ContactLimit, "a limit of this contact").worded(
        step="Give contact.stability_limit(…), not its value."
    ),
    push=kinds.positive.worded("a positive velocity in m/s", "Give one."),
)
def confirm_limit(
    contact: TouchedPlant, limit: ContactLimit, push: float = PUSH, method: TrialMethod | str | None = None
) -> ContactConfirmation:
    """Run a contact's diagram at 0.97 and at 1.03 of a limit; see `Contact.confirm`."""
    push = float(push)
    _check(contact, limit)
    trials = LimitTrials.of(contact, limit, method)
    tried = trials.find_own_limit()
    values = [factor * tried for factor in FACTORS]
    predicted = [trials.find_mode(value) for value in values]
    within = WITHIN * max(abs(mode.real) for mode in predicted)
    omega = max(trials.find_frequency(mode) for mode in predicted)
    step = contact.shortest or STEP
    most = GROWN / max(abs(mode.real) for mode in predicted)
    window = min(max(PERIODS * 2 * math.pi / omega if omega else WINDOW, FEWEST * step), WINDOW, 0.35 * most)
    begin = max(_others_decay(trials, value, window) for value in values)
    begin = min(begin, max(most - 2 * window, 2 * step))
    duration = begin + 2 * window
    found = []
    for factor, value, mode in zip(FACTORS, values, predicted, strict=True):
        t, speed, fastest = trials.run(value, push, duration)
        measured = measure_growth(t, speed, trials.find_frequency(mode), begin, window)
        found.append(ContactTrial(factor, value, float(mode.real), measured, fastest))
    result = ContactConfirmation(limit, found[0], found[1], within, duration, trials.method, tried)
    coarse = ""
    if trials.method is TrialMethod.HELD:  # errors of the FMU's own solver damp or drive the motion
        coarse = ", or a finer solver of the FMU: Fmu(…, stepping=StepOptions(tolerance=1e-10))"
    if any(not abs(t.measured - t.predicted) <= within for t in found) or not found[0].measured < 0 < found[1].measured:
        raise ConfirmationError(
            f"{limit.vary} {limit.value:.6g} {limit.unit} is refuted: {result}; expected differences of at most "
            f"{within:.3g} 1/s, decay below the limit and growth above it. The linear model does not hold at this "
            f"amplitude: try a smaller push, such as push={push / 100:g}{coarse}.",
            block=contact.plant,
        )
    return result


def try_limit(contact: TouchedPlant, limit: ContactLimit) -> ContactConfirmation:
    """Return the confirmation of a limit by the largest push that leaves the diagram linear."""
    for push in PUSHES[:-1]:
        try:
            return confirm_limit(contact, limit, push)
        except ConfirmationError:
            continue  # friction that is linear at smaller amplitudes alone, such as bristles that hold
    return confirm_limit(contact, limit, PUSHES[-1])


def measure_growth(t: np.ndarray, signal: np.ndarray, omega: float, begin: float, window: float) -> float:
    """Return the growth rate in 1/s of a mode of frequency ω, by its amplitude in two windows one after the other.

    Examples
    --------
    >>> t = np.arange(0.0, 3.0, 1e-3)
    >>> round(measure_growth(t, np.exp(-0.3 * t) * np.sin(80 * t), 80.0, 0.5, 1.0), 4)
    -0.3
    """
    gaps = np.diff(t)
    if np.max(gaps) > (1.0 + UNEVEN) * np.min(gaps):
        return _measure_uneven(t, signal, omega, begin, window)
    dt = float(t[1] - t[0])
    first, length = round(begin / dt), round(window / dt)
    weight = np.hanning(length + 2)[1:-1]
    sizes = []
    for k in (first, first + length):
        part = slice(k, k + length)
        sizes.append(abs(np.sum(weight * signal[part] * np.exp(-1j * omega * t[part]))))
    return float(np.log(sizes[1] / sizes[0]) / (length * dt))


def _measure_uneven(t: np.ndarray, signal: np.ndarray, omega: float, begin: float, window: float) -> float:
    """Return the growth rate by samples at uneven times, each of which counts by the time around it."""
    turned = signal * np.exp(-1j * omega * t) * np.gradient(t)
    sizes = []
    for start in (begin, begin + window):
        share = (t - start) / window
        weight = np.where((share > 0.0) & (share < 1.0), 1.0 - np.cos(2.0 * np.pi * share), 0.0)
        sizes.append(abs(np.sum(weight * turned)))
    return float(np.log(sizes[1] / sizes[0]) / window)


def _check(contact: TouchedPlant, limit: ContactLimit) -> None:
    """Refuse the limit of another contact, and one that has no two sides."""
    if not (math.isfinite(limit.value) and limit.value > 0.0):
        raise OptionError(
            f"found a limit of {limit.value:g} {limit.unit}; expected a finite one that is not 0, with runs on both "
            "sides of it. Take one in another environment: other values besides the one that varies.",
            block=contact.plant,
            port=limit.vary,
        )
    loop = contact.loop(limit.vary, **limit.environment)
    known = (limit.growth_below, limit.growth_above)
    found = [loop.growth_at(factor * limit.value) for factor in (1.0 - GROWTH_AT, 1.0 + GROWTH_AT)]
    if not np.allclose(found, known, rtol=OWN, atol=OWN):
        raise OptionError(
            f"found a limit of another contact: next to it the growth rates are {found[0]:.6g} and {found[1]:.6g} 1/s "
            f"here, and {known[0]:.6g} and {known[1]:.6g} 1/s there. Give one of this contact: "
            "contact.stability_limit(…).",
            block=contact.plant,
            port="limit",
        )


def _others_decay(trials: LimitTrials, value: float, window: float) -> float:
    """Return the time in s until modes of about the frequency of the limit's have decayed next to it."""
    mode, rates = trials.find_mode(value), trials.find_rates(value)
    near = np.abs(np.abs(rates.imag) - abs(mode.imag)) < 8 * 2 * math.pi / window
    gaps = mode.real - rates.real[near]
    gaps = gaps[gaps > 1e-6]
    return float(min(LONGEST, max(0.1, DECAYED / float(np.min(gaps)) if len(gaps) else 0.1)))
