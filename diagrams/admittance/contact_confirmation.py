"""Confirmation of limits of coupled stability by runs of the nonlinear diagram, with the environment in it.

`contact_trials` says where the environment is in a run. A run is set in motion by a small push. The growth rate of the
mode that the limit is about is measured by its amplitude in two windows: that of the contact's velocity, demodulated
at the mode's predicted frequency.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...blocks.core import ConfirmationError, OptionError, explain_calls
from .contact_arguments import read_positive
from .contact_limits import ContactLimit
from .contact_trials import STEP, TrialMethod, Trials, TriedContact
from .growth_limits import GROWTH_AT

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
"""Largest difference of the growth rates beside a limit, absolute in 1/s and relative, of one contact."""
UNEVEN = 1e-3
"""Relative difference of the times between samples up to which they are even."""
LONGEST = 8.0
"""Longest time in s that is waited for other modes."""


@explain_calls
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
        Limit that the runs are beside: that of the contact; for a held force, that of the loop with the held force.
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


def confirm_limit(
    contact: TriedContact, limit: ContactLimit, push: float = PUSH, method: TrialMethod | str | None = None
) -> ContactConfirmation:
    """Run a contact's diagram at 0.97 and at 1.03 of a limit; see `Contact.confirm`."""
    push = _check(contact, limit, push)
    trials = Trials.of(contact, limit, method)
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


def try_limit(contact: TriedContact, limit: ContactLimit) -> ContactConfirmation:
    """Return the confirmation of a limit by the largest push that leaves the diagram linear.

    Raises
    ------
    OptionError, ConfirmationError
        As `Contact.confirm`: if the runs contradict the limit however small the push.
    """
    for push in PUSHES[:-1]:
        try:
            return confirm_limit(contact, limit, push)
        except ConfirmationError:
            continue  # friction that is linear at smaller amplitudes alone, such as bristles that hold
    return confirm_limit(contact, limit, PUSHES[-1])


def measure_growth(t: np.ndarray, signal: np.ndarray, omega: float, begin: float, window: float) -> float:
    """Return the growth rate in 1/s of a mode of frequency ω, by its amplitude in two windows one after the other.

    Parameters
    ----------
    t, signal : (N,) array
        Times in s, and the signal.
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


def _check(contact: TriedContact, limit: ContactLimit, push: float) -> float:
    """Return the push; refuse what is no limit of the contact, or has no two sides."""
    if not isinstance(limit, ContactLimit):
        raise OptionError(
            f"found {limit!r}; expected a limit of this contact. Give contact.stability_limit(…), not its value.",
            block=contact.plant,
            port="limit",
        )
    if not (math.isfinite(limit.value) and limit.value > 0.0):
        raise OptionError(
            f"found a limit of {limit.value:g} {limit.unit}; expected a finite one that is not 0, with runs on both "
            "sides of it. Take one in another environment: other values beside the one that varies.",
            block=contact.plant,
            port=limit.vary,
        )
    loop = contact.loop(limit.vary, **limit.environment)
    known = (limit.growth_below, limit.growth_above)
    found = [loop.growth_at(factor * limit.value) for factor in (1.0 - GROWTH_AT, 1.0 + GROWTH_AT)]
    if not np.allclose(found, known, rtol=OWN, atol=OWN):
        raise OptionError(
            f"found a limit of another contact: beside it the growth rates are {found[0]:.6g} and {found[1]:.6g} 1/s "
            f"here, and {known[0]:.6g} and {known[1]:.6g} 1/s there. Give one of this contact: "
            "contact.stability_limit(…).",
            block=contact.plant,
            port="limit",
        )
    return read_positive(push, "push", "velocity in m/s")


def _others_decay(trials: Trials, value: float, window: float) -> float:
    """Return the time in s until modes of about the frequency of the limit's have decayed beside it."""
    mode, rates = trials.find_mode(value), trials.find_rates(value)
    near = np.abs(np.abs(rates.imag) - abs(mode.imag)) < 8 * 2 * math.pi / window
    gaps = mode.real - rates.real[near]
    gaps = gaps[gaps > 1e-6]
    return float(min(LONGEST, max(0.1, DECAYED / float(np.min(gaps)) if len(gaps) else 0.1)))
