"""Frequency responses measured on the running diagram, by a test signal that is injected at a wire.

**Which signals.** At the wire, v is what the port puts out, d the test signal, u = v + d what all its consumers get. S
= u/d, T = −v/d, L = −v/u: the loop that `Linearization.loop` cuts at this wire, all other loops closed. All of them
are sampled where the linear model's loops are: at the ticks of the least common period of what is sampled, from the
one on at which the wire is renewed, with d held from one to the next. They are the phasors of sequences, not of what
is between the ticks: a plant's velocity read at 1 kHz holds the ripple of the controller's hold, aliased, and differs
from the velocity's fundamental by 1e-4 to 1e-3. In a diagram that is continuous throughout, d is continuous too. Where
v changes between the samples (several rates; continuous states), S and T are still what the linear model calls them,
but no loop is cut by a held signal: there is no L.

**Frequencies** are moved by less than half a sample in a window, so that whole periods fit into it.

**Procedure.** The signal is ramped in over a window. Then windows of whole periods follow, until the phasors of two of
them agree, or so many have passed. Offset and drift are taken away. The last window counts; its distance from the one
before is the estimate of its error: what has not settled yet, and noise. What is left beside the lines is the
distortion, a sign of an amplitude that leaves the linear range.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from ...blocks.core.errors import OptionError
from ..flat.evaluate import Pass
from ..flat.flat_diagram import FlatDiagram
from ..flat.functions import NONE
from ..flat.wired_diagram import WiredDiagram
from ..linearization.derivatives import find_signal
from ..linearization.loops_over_a_period import ticks_to_renewal
from ..linearization.operating_point import operating_point
from ..results.operating_point import OperatingPoint, PointOrigin
from ..results.run import Snapshot
from .injection import Experiment, injected
from .waveforms import KINDS, Part, phasors_of, plan_of, step_for

if TYPE_CHECKING:
    from ..linearization.linearize import Linearization


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A measured frequency response at a wire; how it is measured is said in this module.

    Attributes
    ----------
    wire : str
        Where the test signal was added.
    omega : (K,) ndarray
        Frequencies in rad/s, as they were measured.
    dt : float
        Seconds between two samples; 0 where everything is continuous.
    v, u, y : ndarray
        Phasors relative to those of the test signal: of what the port puts out, of what its consumers get, of the
        outputs; entry, injected entry, frequency.
    uncertainty : (K,) ndarray
        Estimated error of L relative to its size: of v relative to v, plus that of u relative to u.
    distortion : (K,) ndarray
        What v holds beside the line, relative to the line (rms); NaN for a chirp, which has all lines.
    windows : (K,) ndarray of int
        How many windows it took.
    settled : (K,) ndarray of bool
        Whether the phasors of the last two windows agreed.
    moved : float
        How far the operating point has moved in the meantime: the largest change of a block's state, or an FMU's
        output, from before the test signal to a window after its end, relative to 1 + its size.
    """

    diagram: WiredDiagram = field(repr=False)
    wire: str
    kind: str
    amplitude: float
    omega: np.ndarray
    dt: float
    v: np.ndarray = field(repr=False)
    u: np.ndarray = field(repr=False)
    y: np.ndarray = field(repr=False)
    uncertainty: np.ndarray = field(repr=False)
    distortion: np.ndarray = field(repr=False)
    windows: np.ndarray = field(repr=False)
    settled: np.ndarray = field(repr=False)
    moved: float
    held: bool
    """Whether v stays between two samples, or everything is continuous: else −v/u is not a loop that can be cut."""
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()

    @property
    def S(self) -> Any:  # noqa: N802
        """Sensitivity u/d, as `control.FrequencyResponseData`."""
        return self._data(self.u, self.inputs, "S")

    @property
    def T(self) -> Any:  # noqa: N802
        """Complementary sensitivity −v/d = 1 − S, as `control.FrequencyResponseData`."""
        return self._data(-self.v, self.inputs, "T")

    @property
    def L(self) -> Any:  # noqa: N802
        """Loop transfer function −v/u at the wire, all other loops closed, as `control.FrequencyResponseData`.

        Raises
        ------
        OptionError
            If v changes between the samples.
        """
        self._check_held()
        return self._data(self._loop(), self.inputs, "L")

    @property
    def response(self) -> Any:
        """From the test signal to the outputs, as `control.FrequencyResponseData`."""
        if not self.outputs:
            raise OptionError(
                "no outputs were measured. Name them: frequency_response(…, outputs=[…]).", block=self.diagram.name
            )
        return self._data(self.y, self.outputs, "response")

    def _check_held(self) -> None:
        if not self.held:
            raise OptionError(
                f"{self.wire!r} changes between two samples of {self.dt:g} s, while the test signal is held: −v/u is "
                "not the loop that is cut there. Take S or T, or a wire that is renewed once in this time.",
                block=self.diagram.name,
                port="wire",
            )

    def _loop(self) -> np.ndarray:
        v, u = np.moveaxis(self.v, 2, 0), np.moveaxis(self.u, 2, 0)
        return np.moveaxis(-np.linalg.solve(u.swapaxes(1, 2), v.swapaxes(1, 2)).swapaxes(1, 2), 0, 2)

    def _data(self, data: np.ndarray, outputs: tuple[str, ...], name: str) -> Any:
        from control import FrequencyResponseData

        names = {"inputs": self.inputs, "outputs": outputs}
        plain = {key: [n.replace(".", "_") for n in labels] for key, labels in names.items()}
        return FrequencyResponseData(data, self.omega, self.dt, name=f"{name}({self.wire})".replace(".", "_"), **plain)

    def deviation(self, linearization: Linearization, of: str | None = None) -> np.ndarray:
        """Return how far the measurement is from a linear model at each frequency, relative to the model.

        Parameters
        ----------
        linearization : Linearization
            Of the same diagram, at the operating point of the measurement.
        of : {"L", "S", "T"}, optional
            What is compared; matrices by their largest singular values. Without it L, or S where L is not to be had.

        Raises
        ------
        OptionError
            Another one, or a model of another sample time.
        """
        of = ("L" if self.held else "S") if of is None else of
        made = {"L": linearization.loop, "S": linearization.sensitivity, "T": linearization.complementary}
        if of not in made:
            raise OptionError(f"found of={of!r}; expected one of {', '.join(map(repr, made))}.", port="of")
        if of == "L":
            self._check_held()
        model = made[of](self.wire)
        if not math.isclose(float(model.dt), self.dt, rel_tol=1e-12):
            raise OptionError(
                f"the linear model has the sample time {float(model.dt):g} s, the measurement {self.dt:g} s. Linearize "
                "the same diagram, with the same step.",
                block=self.diagram.name,
            )
        measured = {"L": self._loop(), "S": self.u, "T": -self.v}[of]
        s = np.exp(1j * self.omega * self.dt) if self.dt else 1j * self.omega
        found = []
        for k, at in enumerate(s):
            exact = model.C @ np.linalg.solve(at * np.eye(len(model.A)) - model.A, model.B) + model.D
            found.append(np.linalg.norm(measured[:, :, k] - exact, 2) / np.linalg.norm(exact, 2))
        return np.array(found)

    def compare(self, linearization: Linearization, of: str | None = None) -> float:
        """Return the largest relative deviation from a linear model over all frequencies; see `deviation`."""
        return float(np.max(self.deviation(linearization, of)))


def frequency_response(
    diagram: WiredDiagram, wire: str, frequencies: Any, *, amplitude: float, kind: str = "sine", at: Any = 0.0,
    outputs: str | Iterable[str] = (), windows: int = 40, agreement: float = 1e-6, **options: Any,
) -> FrequencyResponse:  # fmt: skip
    """Measure a frequency response; see `Diagram.frequency_response`."""
    omega = _checked(diagram, frequencies, amplitude, kind, windows)
    chosen, point, t0 = _beginning(diagram, at, dict(options))
    variant = diagram.replace(point.parameters) if point is not None and point.parameters else diagram
    discrete = diagram.has_clock or diagram.has_fmu
    if not discrete and chosen.get("step") is None and point is None:
        chosen["step"] = step_for(omega)
    flat = variant.flatten(chosen.get("step", None if point is None or diagram.has_clock else point.base))
    every = math.lcm(*(clock.every for clock in flat.distinct)) if flat.distinct else 1
    period = flat.base * every
    dt = float(period)
    if not omega[-1] * dt < np.pi:
        raise OptionError(
            f"found {omega[-1]:g} rad/s; with samples every {dt:g} s only frequencies below {np.pi / dt:g} rad/s can "
            "be told apart. Give lower frequencies, or a smaller step.",
            block=diagram.name,
            port="frequencies",
        )
    signal = find_signal(flat, wire)
    measured = [find_signal(flat, name) for name in ([outputs] if isinstance(outputs, str) else outputs)]
    if flat.hybrid:
        chosen = {"rtol": 1e-9, "atol": 1e-12, **chosen}
        if chosen.get("solver", "auto") not in ("euler", "heun", "rk4"):
            chosen.setdefault("max_step", 0.5 * np.pi / omega[-1])
    plan = list(plan_of(kind, omega, dt, amplitude))
    tick = point.tick if point is not None else round(t0 / float(flat.base))
    wait = ticks_to_renewal(flat, [signal.port], tick) if discrete and every > 1 else 0  # as for the linear model
    held = (period, ((tick + wait) % every) * flat.base) if discrete else None
    made = injected(diagram, signal, len(plan[0].waveform.amplitude), held)
    lines = np.concatenate([part.omega for part in plan])
    found = _Found(len(lines), len(signal.entries), sum(len(o.entries) for o in measured))
    for j, entry in enumerate(signal.entries):
        with Experiment(diagram, made, signal, measured, point, chosen) as experiment:
            if point is None and t0 > 0:
                experiment.simulation.advance(t0)
            if wait:
                experiment.go(wait, 1)
            before = experiment.stands()
            for i, part in enumerate(plan):
                _measure(experiment, part, entry, j, every, windows, agreement, found, i)
            experiment.play(plan[0].silence, entry, ramp=1.0)
            experiment.go(plan[0].samples, every)
            change = np.abs(experiment.stands() - before) / (1.0 + np.abs(before))
            found.moved = max(found.moved, float(np.max(change, initial=0.0)))
    labels = tuple(e for o in measured for e in o.labels)
    return FrequencyResponse(
        variant, wire, kind, float(amplitude), lines, dt if discrete else 0.0, found.v, found.u, found.y,
        found.uncertainty, found.distortion, found.windows, found.settled, found.moved,
        not discrete or (found.held and not _moves(flat, signal.port)), signal.labels, labels,
    )  # fmt: skip


def _checked(diagram: WiredDiagram, frequencies: Any, amplitude: Any, kind: str, windows: Any) -> np.ndarray:
    try:
        omega = np.unique(np.atleast_1d(np.asarray(frequencies, dtype=float)))
    except (TypeError, ValueError):
        omega = np.zeros(0)
    if not (omega.size and np.all(omega > 0.0) and np.all(np.isfinite(omega))):
        raise OptionError(
            f"found {frequencies!r}; expected positive frequencies in rad/s.", block=diagram.name, port="frequencies"
        )
    if isinstance(amplitude, bool) or not isinstance(amplitude, int | float) or not 0 < amplitude < math.inf:
        raise OptionError(
            f"found {amplitude!r}; expected the largest value of the test signal, in the wire's unit.",
            block=diagram.name,
            port="amplitude",
        )
    if kind not in KINDS:
        raise OptionError(
            f"found {kind!r}; expected one of {', '.join(map(repr, KINDS))}.", block=diagram.name, port="kind"
        )
    if isinstance(windows, bool) or not isinstance(windows, int) or windows < 2:
        raise OptionError(
            f"found {windows!r}; expected a number of windows, at least 2.", block=diagram.name, port="windows"
        )
    return omega


def _beginning(
    diagram: WiredDiagram, at: Any, options: dict[str, Any]
) -> tuple[dict[str, Any], OperatingPoint | None, float]:
    """Return how to run, and where to begin: a point to be started at, or a time to run to."""
    if isinstance(at, Snapshot):
        recipe = dict(getattr(at.run, "recipe", {}) or {})
        options = {**recipe, **options}
        if "start" not in options:
            return options, None, at.t
    if isinstance(at, OperatingPoint) and at.how == PointOrigin.RUN and "start" not in options:
        return {**options, "step": options.get("step") or at.base}, None, at.t
    if at is None or (isinstance(at, int | float) and not isinstance(at, bool) and "start" not in options):
        return options, None, float(at or 0.0)
    point = operating_point(diagram, at, options)
    options.pop("start", None)
    if not diagram.has_clock and options.get("step") is None and diagram.has_fmu:
        options["step"] = point.base
    return options, point, point.t


def _moves(flat: FlatDiagram, port: tuple[str, str]) -> bool:
    """Whether a signal follows continuous states, or time, between two ticks."""
    t, x, w, p = flat.symbols()
    column = Pass(flat, NONE, t, x, w, p).run().values.get(port)  # none: it is held, and nothing asks for it
    if not isinstance(column, ca.MX):
        return False
    by_x = ca.jacobian(column, x)[:, flat.continuous.tolist()] if flat.continuous.size else ca.MX(0, 1)
    return bool(by_x.nnz() or ca.depends_on(column, t))


class _Found:
    """What was measured, by line."""

    def __init__(self, lines: int, n: int, outputs: int):
        self.v, self.u = np.zeros((n, n, lines), complex), np.zeros((n, n, lines), complex)
        self.y = np.zeros((outputs, n, lines), complex)
        self.uncertainty, self.distortion = np.zeros(lines), np.zeros(lines)
        self.windows, self.settled = np.zeros(lines, int), np.ones(lines, bool)
        self.moved, self.held = 0.0, True


def _measure(
    experiment: Experiment, part: Part, entry: int, j: int, every: int, windows: int, agreement: float,
    found: _Found, i: int,
) -> None:  # fmt: skip
    """Play a part of the test signal until two windows agree; write down the phasors of the last one."""
    n = part.samples
    experiment.play(part.waveform, entry, ramp=n * every * float(experiment.flat.base))
    experiment.go(n, every)
    last, error, count = None, np.full(len(part.lines), np.inf), 0
    while count < windows and not np.all(error <= agreement):
        v, u, y = experiment.record(n, every)
        here, rest = phasors_of(part, np.hstack([v, u, y]))
        count, m = count + 1, v.shape[1]
        if last is not None:
            error = np.zeros(len(part.lines))
            for columns, data in ((slice(0, m), v), (slice(m, 2 * m), u)):
                size = np.linalg.norm(here[:, columns], axis=1)
                change = np.linalg.norm((here - last)[:, columns], axis=1) + np.finfo(float).eps * np.max(np.abs(data))
                error += change / np.where(size > 0.0, size, 1.0)
        last = here
    assert last is not None
    found.held &= experiment.held
    where = slice(i, i + 1) if found.v.shape[2] > len(part.lines) else slice(None)
    d = last[:, m + j] - last[:, j]  # u − v at the entry where it was added
    scaled = (last / d[:, None]).T
    found.v[:, j, where], found.u[:, j, where], found.y[:, j, where] = scaled[:m], scaled[m : 2 * m], scaled[2 * m :]
    found.uncertainty[where] = np.maximum(found.uncertainty[where], error)
    found.distortion[where] = np.maximum(found.distortion[where], rest)
    found.windows[where] = np.maximum(found.windows[where], count)
    found.settled[where] &= error <= agreement
