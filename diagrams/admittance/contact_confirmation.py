"""Confirmation of limits of coupled stability by runs of the nonlinear diagram, with the environment in it.

A run is set in motion by a small push. The growth rate of the mode that the limit is about is measured by its amplitude
in two windows: the velocity of the contact, demodulated at the mode's predicted frequency.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ...blocks.core import ConfirmationError, OptionError
from ..linearization import find_signal
from .contact_limits import ContactLimit, CoupledLoop, to_rates
from .contact_parts import ContactParts, Ports
from .moored_plant import Mooring, hold_sources, library_class, moored_diagram

if TYPE_CHECKING:
    from ..flat import WiredDiagram
    from ..results import OperatingPoint

FACTORS = (0.97, 1.03)
"""Shares of a limit at which the diagram is run."""
STEP = 1e-3
"""Sample time in s of the run of a continuous diagram."""
PUSH = 1e-6
"""Velocity in m/s that the push gives the contact."""
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
LONGEST = 8.0
"""Longest time in s that is waited for other modes."""


class TriedContact(Protocol):
    """A contact, as its limits are tried."""

    @property
    def diagram(self) -> WiredDiagram:
        """Its diagram."""

    @property
    def plant(self) -> str:
        """Path of the plant."""

    @property
    def direction(self) -> np.ndarray:
        """Unit vector of the environment's direction."""

    @property
    def point(self) -> OperatingPoint:
        """Operating point."""

    @property
    def parts(self) -> ContactParts:
        """Plant and controller."""

    @property
    def ports(self) -> Ports:
        """Ports of the plant."""

    @property
    def measured(self) -> str | None:
        """Wire of the measured force."""

    @property
    def sample_time(self) -> float:
        """Sample time of the controller in s."""

    def loop(self, vary: str, **environment: float) -> CoupledLoop:
        """Return the loop with an environment of which one property varies."""


@dataclass(frozen=True)
class ContactTrial:
    """A run beside a limit.

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


@dataclass(frozen=True)
class ContactConfirmation:
    """Runs below and above a limit, with the environment inside the plant.

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
    """

    limit: ContactLimit
    below: ContactTrial
    above: ContactTrial
    within: float
    duration: float

    def __str__(self) -> str:
        trials = "; ".join(f"{t.measured:.4g} (predicted {t.predicted:.4g}) at {t.factor:g}" for t in self.trials)
        return (
            f"growth rates in 1/s of the nonlinear run with the environment inside the plant: {trials} of the limit; "
            f"speeds up to {max(t.fastest for t in self.trials):.2g} m/s"
        )

    @property
    def trials(self) -> tuple[ContactTrial, ContactTrial]:
        """Both runs."""
        return self.below, self.above


def confirm_limit(contact: TriedContact, limit: ContactLimit, push: float = PUSH) -> ContactConfirmation:
    """Run a contact's diagram at 0.97 and at 1.03 of a limit; see `Contact.confirm`."""
    _check(contact, limit, push)
    predicted = [_mode(contact, limit, factor * limit.value) for factor in FACTORS]
    within = WITHIN * max(abs(mode.real) for mode in predicted)
    omega = max(abs(mode.imag) for mode in predicted)
    step = contact.sample_time or STEP
    most = GROWN / max(abs(mode.real) for mode in predicted)
    window = min(max(PERIODS * 2 * math.pi / omega if omega else WINDOW, FEWEST * step), WINDOW, 0.35 * most)
    begin = max(_others_decay(contact, limit, factor * limit.value, window) for factor in FACTORS)
    begin = min(begin, max(most - 2 * window, 2 * step))
    duration = begin + 2 * window
    found = []
    for factor, mode in zip(FACTORS, predicted, strict=True):
        value = factor * limit.value
        t, speed, fastest = _run(contact, limit, value, push, duration)
        measured = measure_growth(t, speed, abs(mode.imag), begin, window)
        found.append(ContactTrial(factor, value, float(mode.real), measured, fastest))
    result = ContactConfirmation(limit, found[0], found[1], within, duration)
    if any(not abs(t.measured - t.predicted) <= within for t in found) or not found[0].measured < 0 < found[1].measured:
        raise ConfirmationError(
            f"{limit.vary} {limit.value:.6g} {limit.unit} is refuted: {result}; expected differences of at most "
            f"{within:.3g} 1/s, decay below the limit and growth above it. The linear model does not hold at this "
            f"amplitude: try a smaller push, such as push={push / 100:g}.",
            block=contact.plant,
        )
    return result


def measure_growth(t: np.ndarray, signal: np.ndarray, omega: float, begin: float, window: float) -> float:
    """Return the growth rate in 1/s of a mode of frequency ω, by its amplitude in two windows one after the other.

    Parameters
    ----------
    t, signal : (N,) array
        Equally spaced times in s, and the signal.
    omega : float
        Frequency of the mode in rad/s.
    begin, window : float
        Beginning of the first window, and length of both, in s.

    Examples
    --------
    >>> t = np.arange(0.0, 3.0, 1e-3)
    >>> round(measure_growth(t, np.exp(-0.3 * t) * np.sin(80 * t), 80.0, 0.5, 1.0), 4)
    -0.3
    """
    dt = float(t[1] - t[0])
    first, length = round(begin / dt), round(window / dt)
    weight = np.hanning(length + 2)[1:-1]
    sizes = []
    for k in (first, first + length):
        part = slice(k, k + length)
        sizes.append(abs(np.sum(weight * signal[part] * np.exp(-1j * omega * t[part]))))
    return float(np.log(sizes[1] / sizes[0]) / (length * dt))


def _check(contact: TriedContact, limit: ContactLimit, push: float) -> None:
    if not (math.isfinite(limit.value) and limit.value > 0.0):
        raise OptionError(
            f"found a limit of {limit.value:g} {limit.unit}; expected a finite one that is not 0. There is nothing to "
            "run on both sides of.",
            block=contact.plant,
            port=limit.vary,
        )
    if not 0.0 < push < math.inf:
        raise OptionError(f"found {push!r}; expected a positive velocity in m/s. Give one.", port="push")
    if library_class(contact.diagram.blocks[contact.plant]) is None:
        raise OptionError(
            "found a plant that is none of the library's; expected one, whose equations the environment can be put "
            "into. Compare with a run of your own, with the environment as blocks.",
            block=contact.plant,
        )
    if not contact.sample_time and contact.diagram.blocks[contact.plant].stepped:
        raise OptionError(
            "found a continuous diagram around an FMU, which exchanges signals with it at the ends of steps alone; "
            "expected one that can be run as its limit is computed. Confirm a sampled one: diagram.sampled(1e-3).",
            block=contact.plant,
        )
    if contact.point.t > START * float(contact.point.base):
        raise OptionError(
            f"found a contact at t = {contact.point.t:g} s; expected one at the start, from which the runs with the "
            "environment begin. Start the diagram at rest there: diagram.replace({'plant.start.position': …}).",
            block=contact.plant,
            port="at",
            t=contact.point.t,
        )


START = 2.5
"""Ticks up to which an operating point is the start."""


def _mode(contact: TriedContact, limit: ContactLimit, value: float) -> complex:
    """Return the pole, in 1/s, of the mode that a limit is about."""
    rates = _rates(contact, limit, value)
    return complex(rates[int(np.argmin(np.abs(np.abs(rates.imag) - limit.frequency) - 1e-3 * rates.real))])


def _rates(contact: TriedContact, limit: ContactLimit, value: float) -> np.ndarray:
    loop = contact.loop(limit.vary, **limit.environment)
    return to_rates(contact.parts, np.linalg.eigvals(loop.modes.reduce(loop.close(value).A)))


def _others_decay(contact: TriedContact, limit: ContactLimit, value: float, window: float) -> float:
    """Return the time in s until modes of about the frequency of the limit's have decayed beside it."""
    mode = _mode(contact, limit, value)
    rates = _rates(contact, limit, value)
    near = np.abs(np.abs(rates.imag) - abs(mode.imag)) < 8 * 2 * math.pi / window
    gaps = mode.real - rates.real[near]
    gaps = gaps[gaps > 1e-6]
    return float(min(LONGEST, max(0.1, DECAYED / float(np.min(gaps)) if len(gaps) else 0.1)))


def _run(
    contact: TriedContact, limit: ContactLimit, value: float, push: float, duration: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return times, the velocity along the mode's direction, and the largest speed."""
    environment = {**limit.environment, limit.vary: value}
    tool = environment.pop("tool_mass", None)
    mobility = float(contact.direction @ contact.parts.velocity @ contact.parts.force @ contact.direction)
    step = contact.sample_time or STEP
    mooring = Mooring(
        contact.direction, np.asarray(contact.point.values[f"{contact.plant}.{contact.ports.position}"], dtype=float),
        **{name: float(v) for name, v in environment.items()}, kick=push / (mobility * step), kick_time=step,
    )  # fmt: skip
    ports = (contact.ports.force, contact.ports.position, contact.ports.velocity)
    still = hold_sources(contact.diagram, contact.point.values)
    source = find_signal(still.flatten_like(contact.point), contact.measured) if contact.measured else None
    made: Any = moored_diagram(still, contact.plant, ports, source, mooring, tool)
    options: dict[str, Any] = {} if made.has_clock else {"step": step}
    name = f"{contact.plant}.{contact.ports.velocity}"
    run = made.simulate(duration + 4 * step, progress=False, record=[name], states=False, **options)
    t = np.asarray(run.t)
    rows = np.unique(np.round(t / step).astype(int), return_index=True)[1]
    velocity = np.asarray(run[name])[rows]
    along = np.asarray(limit.direction or contact.direction)
    return t[rows], velocity @ along, float(np.max(np.linalg.norm(velocity, axis=1)))
