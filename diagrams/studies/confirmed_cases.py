"""Runs that confirm a worst case: a margin by a sine at its wire, an unstable loop by the growth after a step."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    LoopwrightError,
    OptionError,
    SimulationError,
    explain_calls,
)
from ..flat import WiredDiagram
from ..frequency import Margins, disk_margin, margins, mimo_disk_margin, mu_bound, realize
from ..linearization import Linearization, find_signal, hold_sources, linearize
from ..measure import StepResponse, find_least_sine, frequency_response, step_response

if TYPE_CHECKING:
    from .cases import StudyCase

AMPLITUDE = 1e-6
"""Size of a test signal, relative to 1 + that of the wire's signal."""
GROWTHS = 8.0
"""Time constants of an unstable pole over which its growth is measured."""
MANY = 20000
"""Most samples of that."""
GROWTH_AGREEMENT = 0.1
"""Relative difference of a growth that confirms an instability."""
MARGIN_AGREEMENT = 1e-2
"""Relative difference of a measured number that confirms a margin."""

LARGER = (2.0, 4.0, 8.0)
"""Factors on a sine of the least size compared with quanta, where its measurement is uncertain."""
SAME_MARGIN = 1e-3
"""Relative difference up to which a crossing has the margin that is confirmed; a measurement is judged by more."""
MOST_UNCERTAIN = 1e-2
"""Relative uncertainty of a measurement above which it confirms nothing."""


class ConfirmationKind(StrEnum):
    """Way in which a run confirms a worst case."""

    INJECTION = "injection"
    """A sine is added to the wire of the running diagram, at the frequency that decides the margin."""
    GROWTH = "growth"
    """A small step is added to the wire, and the signal grows as the unstable pole says."""
    DEPARTURE = "departure"
    """The point is not at rest, and the run leaves it at least as fast as the unstable pole says: limits that act there
    may hold the wire, so that no step grows at it."""
    CONTACT = "contact"
    """The environment is at the plant, at 0.97 and 1.03 of the limit, and the motion decays and grows as predicted."""


@explain_calls
@dataclass(frozen=True)
class RunConfirmation:
    """Confirmation of a worst case by a run of the diagram.

    Attributes
    ----------
    kind : ConfirmationKind
        Injection, growth, departure, or contact.
    wire : str
        Wire at which the test signal was added; of a contact the port at which the environment pushes.
    omega : float
        Frequency of the sine, or of the motion in contact, in rad/s; NaN of a growth.
    predicted, measured : float
        The margin, or the growth in 1/s (of a contact at 1.03 of its limit), which the linear model's response shows in
        the same time. A response that leaves all bounds has an infinite growth. Of a departure the least growth.
    agrees : bool
        Whether they agree: a margin to 1 % and ten times the measurement's own uncertainty, a growth to 10 %. A
        departure agrees if it grows as fast, less 10 %, or faster.
    uncertainty : float
        Relative uncertainty of the measurement's loop L; NaN of a growth.
    """

    kind: ConfirmationKind
    wire: str
    omega: float
    predicted: float
    measured: float
    agrees: bool
    uncertainty: float = math.nan

    @property
    def trial(self) -> str:
        """The trial in words: its kind, place and values."""
        at = "" if math.isnan(self.omega) else f" at {self.omega:.6g} rad/s"
        off = f", uncertain by {100.0 * self.uncertainty:.2g} %" if self.uncertainty >= MOST_UNCERTAIN else ""
        said = f"predicted {self.predicted:.6g}, measured {self.measured:.6g}{off}"
        return f"{self.kind.value} at {self.wire!r}{at}: {said}"

    def __str__(self) -> str:
        return f"{'confirmed' if self.agrees else 'NOT confirmed'} by {self.trial}"


def confirm_case(
    diagram: WiredDiagram, case: StudyCase, at: Any, amplitude: float | None, delay: int, options: Mapping[str, Any]
) -> RunConfirmation:
    """Return the confirmation of a case by a run; ``options`` are those of the linear models."""
    if not case.loop or delay:
        raise OptionError(
            "found a case without a loop that a run has, as it failed, or has a delay in series; expected one with "
            "delay=0 that was analysed. Look at its reason.",
            block=diagram.name,
        )
    if len(case.loop) > 1 and case.quantity:
        raise OptionError(
            f"found a loop cut at {len(case.loop)} wires at once; expected one wire, at which a run can be tested. "
            "Simulate found.diagram.",
            block=diagram.name,
        )
    point = at(diagram.facade) if callable(at) else at
    model = linearize(diagram, point, **options)
    still = hold_sources(diagram, model.point.values)  # references that move would move the point
    if still is not diagram:
        diagram, model = still, linearize(still, model.point, plants=model.plants, stairs=model.stairs)
    if case.quantity:
        return _measure_margin(diagram, model, case, amplitude)
    return _measure_growth(diagram, model, case, amplitude)


def _size_at(model: Linearization, wire: str) -> float:
    source = model.wired.names.get(wire.partition("[")[0])
    path = wire if source is None else f"{source.block}.{source.port}"
    return AMPLITUDE * (1.0 + float(np.max(np.abs(model.point.values.get(path, 0.0)), initial=0.0)))


def _measure_margin(
    diagram: WiredDiagram, model: Linearization, case: StudyCase, amplitude: float | None
) -> RunConfirmation:
    """Measure L at the frequency that decides a margin, and read the margin from it.

    A sine that is not given is small, and large compared with the quanta of converters and encoders.
    """
    L, wire = model.loop(*case.loop), case.loop[0]
    omega = _deciding_frequency(L, case.quantity, case.value, diagram.name)
    larger: tuple[float, ...] = ()
    if amplitude is None:
        least = find_least_sine(diagram, model.point, wire, L, np.array([omega]))
        amplitude = max(_size_at(model, wire), 0.0 if least is None else least[0])
        larger = () if least is None else LARGER
    response = frequency_response(diagram, wire, [omega], amplitude=amplitude, at=model.point)
    for factor in larger:  # quanta of several converters add up
        if float(response.uncertainty[0]) < MOST_UNCERTAIN:
            break
        try:
            response = frequency_response(diagram, wire, [omega], amplitude=factor * amplitude, at=model.point)
        except LoopwrightError:  # beyond the diagram's range
            break
    measured = np.asarray(response.L.frdata)[:, :, 0]
    here = float(response.omega[0])
    predicted = np.asarray(L(np.exp(1j * here * L.dt) if L.dt else 1j * here)).reshape(measured.shape)
    if case.quantity == "bandwidth":
        value, expected = _read_bandwidth(L, measured, predicted, here, case.value), case.value
    else:
        value, expected = (_read_margin(M, case.quantity, here) for M in (measured, predicted))
    off = float(response.uncertainty[0])
    room = (MARGIN_AGREEMENT + 10.0 * off) * max(abs(expected), abs(case.value))
    near = math.isfinite(value) and abs(value - expected) <= room and abs(expected - case.value) <= 5.0 * room
    agrees = near and off < MOST_UNCERTAIN
    return RunConfirmation(ConfirmationKind.INJECTION, wire, here, case.value, value, agrees, off)


def _deciding_frequency(L: Any, quantity: str, value: float, name: str) -> float:
    """Return the frequency in rad/s at which a margin is decided."""
    if quantity == "disk_margin":
        made = (disk_margin if L.ninputs == 1 else mimo_disk_margin)(L)
        return _inside(made.frequency.value, L, quantity, name)
    found: Margins = margins(L)
    if quantity in ("ms", "modulus_margin"):
        return _inside(found.ms_frequency.value, L, quantity, name)
    if quantity == "mt":
        return _inside(found.mt_frequency.value, L, quantity, name)
    if quantity == "bandwidth":
        return _inside(found.bandwidth.value, L, quantity, name)
    if quantity in ("gain_margin_low", "gain_margin_high"):
        near = _nearest(((c.frequency.value, c.gain_margin.value) for c in found.phase_crossovers), value)
    elif quantity == "phase_margin_deg":
        near = _nearest(((c.frequency.value, abs(c.phase_margin_deg.value)) for c in found.gain_crossovers), value)
    else:
        lag = found.delay_margin_s.value
        near = [
            c.frequency.value
            for c in found.gain_crossovers
            if abs(np.radians(c.phase_margin_deg.value) % (2 * np.pi) / c.frequency.value - lag) <= 1e-9 * lag
        ]
    return _inside(near[0] if near else math.nan, L, quantity, name)


def _nearest(crossings: Iterable[tuple[float, float]], value: float) -> list[float]:
    """Return the frequency of the crossing whose margin is nearest to a value; none where they all are another margin.

    The value comes from another model of the same diagram: its sources moved, or its loop came from matrices alone.
    """
    found = sorted((abs(margin - value), omega) for omega, margin in crossings)
    return [omega for off, omega in found[:1] if off <= SAME_MARGIN * abs(value)]


def _inside(omega: float, L: Any, quantity: str, name: str) -> float:
    """Return a frequency at which a sine can be injected."""
    top = 0.9 * np.pi / L.dt if L.dt else math.inf
    if not 0 < omega < math.inf:
        other = "Simulate found.diagram" if quantity == "disk_margin" else "Take another number: quantity='disk_margin'"
        raise OptionError(
            f"found {quantity!r}, which is decided at {omega} rad/s; expected a frequency at which a sine can be "
            f"added. {other}.",
            block=name,
        )
    return min(omega, top)


def _read_bandwidth(L: Any, measured: np.ndarray, predicted: np.ndarray, omega: float, value: float) -> float:
    """Return the bandwidth with a measured L: compared with the model's, |T| falls as the model's does."""
    T, there = (abs(complex(M[0, 0]) / (1.0 + complex(M[0, 0]))) for M in (measured, predicted))
    w = omega * np.array([0.999, 1.001])
    ends = np.ravel(L(np.exp(1j * w * L.dt) if L.dt else 1j * w))
    falls = float(np.diff(np.log(np.abs(ends / (1.0 + ends))))[0] / np.log(w[1] / w[0]))
    return value * math.exp(-math.log(T / there) / falls) if T and there and falls else math.nan


def _read_margin(L: np.ndarray, quantity: str, omega: float) -> float:
    """Return a margin from L at the frequency that decides it."""
    S = np.linalg.inv(np.eye(len(L)) + L)
    one = complex(L[0, 0])
    if quantity == "disk_margin":
        return 1 / mu_bound(S - 0.5 * np.eye(len(L)))
    lag = float(np.angle(-one) % (2 * np.pi))
    values = {
        "ms": abs(S[0, 0]),
        "modulus_margin": 1 / abs(S[0, 0]),
        "mt": abs(1 - S[0, 0]),
        "phase_margin_deg": abs(float(np.degrees(np.angle(-one)))),
        "delay_margin_s": lag / omega,
    }
    if quantity in ("gain_margin_low", "gain_margin_high"):
        return float(-1 / one.real)
    return float(values.get(quantity, math.nan))


def _find_unstable_wire(model: Linearization, wires: tuple[str, ...]) -> str:
    """Return an entry of a wire whose own loop has the unstable poles: those of another loop are hidden in a loop."""
    flat = model.wired.flatten_like(model.point)
    for name in (*wires, *model.wired.names):
        for label in find_signal(flat, name).labels:
            try:
                r = realize(model.loop(label))
            except LoopwrightError:
                continue
            if r.order and not r.is_stable():
                return label
    return find_signal(flat, wires[0]).labels[0]


def _measure_growth(
    diagram: WiredDiagram, model: Linearization, case: StudyCase, amplitude: float | None
) -> RunConfirmation:
    """Add a small step to the wire, and measure how the signal grows over time constants of the unstable pole."""
    wire, dt = _find_unstable_wire(model, case.loop), model.dt
    size = _size_at(model, wire) if amplitude is None else amplitude
    length = GROWTHS / max(case.growth, 1e-12)
    if dt:
        length = min(max(length, 40 * dt), MANY * dt)
    try:
        found = step_response(diagram, wire, size=size, length=length, at=model.point, stairs=model.stairs)
    except SimulationError:
        return RunConfirmation(ConfirmationKind.GROWTH, wire, math.nan, case.growth, math.inf, agrees=True)
    measured = _read_growth(found.v, found.t)
    expected = case.growth if found.prediction is None else _read_growth(found.prediction[:, 0], found.t)
    agrees = 0.0 < measured < math.inf and abs(measured - expected) <= GROWTH_AGREEMENT * abs(expected)
    if not agrees and not model.is_equilibrium:
        departure = _measure_departure(diagram, model, wire, size, length)
        if departure >= (1.0 - GROWTH_AGREEMENT) * case.growth:
            return RunConfirmation(ConfirmationKind.DEPARTURE, wire, math.nan, case.growth, departure, agrees=True)
    return RunConfirmation(ConfirmationKind.GROWTH, wire, math.nan, expected, measured, agrees)


def _measure_departure(diagram: WiredDiagram, model: Linearization, wire: str, size: float, length: float) -> float:
    """Return the growth in 1/s of the run's distance from its point, by its largest one in all and in half the time.

    The distance is that of the blocks with states, relative to 1 + their values. A ramp is no growth: its distance
    doubles in the second half of eight time constants, where a mode's grows fiftyfold.
    """
    blocks = diagram.blocks
    moving = (path for path, b in blocks.items() if b.states or b.stepped or b.in_model_exchange)
    names = [f"{path}.{port}" for path in moving for port in blocks[path].outputs]

    def respond(length: float) -> StepResponse:
        at, stairs = model.point, model.stairs
        return step_response(diagram, wire, size=size, length=length, at=at, outputs=names, stairs=stairs)

    try:
        half, whole = respond(0.5 * length), respond(length)
    except SimulationError:  # it has left all bounds
        return math.inf
    if not 0.0 < half.moved < whole.moved < math.inf:
        return -math.inf
    return math.log(whole.moved / half.moved) / float(whole.t[-1] - half.t[-1])


def _read_growth(v: np.ndarray, t: np.ndarray) -> float:
    """Return the growth in 1/s of a signal from the second to the last quarter of its time."""
    half = len(v) // 2
    first, last = (float(np.max(np.abs(v[k + half // 2 : k + half]), initial=0.0)) for k in (0, len(v) - half))
    return float(math.log(last / first) / (t[len(v) - half] - t[0])) if first > 0 and last > 0 else -math.inf
