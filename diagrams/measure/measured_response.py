"""Frequency responses measured on the running diagram, with a test signal injected at a wire.

**Signals.** At the wire, v is the port's signal, d the test signal, and u = v + d the signal of all consumers. Then
S = u/d, T = −v/d and L = −v/u: the loop that `Linearization.loop` cuts at this wire, with all other loops closed.

All signals are sampled at the same ticks as the linear model's loops: once in the least common period of all sample
times, from the tick on at which the wire is renewed. d is held from one sample to the next. The phasors are those of
the sequences. Between the ticks a signal differs: a plant's velocity read at 1 kHz contains the aliased ripple of the
controller's hold, and differs from the velocity's fundamental by 1e-4 to 1e-3. In a diagram without sampling, d is
continuous too.

Where v changes between the samples (several rates, continuous states), S and T still agree with the linear model. But
a held signal then cuts no loop: there is no L.

**Frequencies** are changed by less than half a sample in a window, so that whole periods fit into it.

**Procedure.** The signal is ramped in over a window. Windows of whole periods follow, until the phasors of two of them
agree, their distance is noise (it has stopped falling), or the largest number of windows is reached. Offset and drift
are subtracted. The last window gives the result; where the distance is noise, the mean of the windows since then.
The rest next to the lines is the distortion, a sign of an amplitude that leaves the linear range.

**Uncertainty.** Three estimates are added up:

- the distance of the last two windows: settling; where it is noise, what the scatter of the windows makes of their mean
  in 95 % of all measurements;
- twice the distance to a second measurement, beyond the noise of both, with half the amplitude, the frequencies in
  reverse order, and a solver tolerance ten times smaller: nonlinearity, drift, and the solver's error;
- the movement of the operating point from before the test signal to after it, less a uniform drift such as that of an
  angle at constant speed, and less what noise that was seen explains. A movement of more than 1e-3 refutes the
  measurement: the uncertainty is infinite.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import OptionError, accepts, brief, count_of, explain_calls, kinds
from ..flat import WiredDiagram
from ..linearization import (
    PointLike,
    carry_point,
    cut_to,
    find_signal,
)
from ..solvers import FIXED
from .beginning import EXACT, find_beginning, find_continuous_beginning
from .between_samples import moves_between
from .injection import KINDS, InjectionRun, Part, SamplesAtWire, choose_step, inject_signal, plan_signal
from .measurement import Measurement, measure_part, refine_tolerances

if TYPE_CHECKING:
    from control import FrequencyResponseData

    from ..linearization import Linearization

HALF = 0.5
"""Factor of the amplitude in the second measurement."""
GROWN = 1e9
"""Growth of a signal, relative to the test signal and to the states before it, that no stable loop makes."""


@explain_calls
@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """A measured frequency response at a wire; this module describes the measurement.

    Attributes
    ----------
    diagram : Diagram
        Diagram that was measured.
    wire : str
        Wire to which the test signal was added.
    kind : str
        Kind of the test signal.
    amplitude : float
        Largest value of the test signal.
    omega : (K,) ndarray
        Measured frequencies in rad/s.
    dt : float
        Seconds between two samples; 0 in a diagram without sampling.
    v, u, y : ndarray
        Phasors of the port's signal, of its consumers' signal and of the outputs, relative to those of the test signal;
        the axes are entry, injected entry and frequency.
    uncertainty : (K,) ndarray
        Estimated relative error of L, that of v plus that of u, with what a second amplitude and the movement of the
        operating point show; infinite where the operating point has moved.
    distortion : (K,) ndarray
        Rms of the rest of v next to the line, relative to the line; NaN for a chirp, which has all lines.
    windows : (K,) ndarray of int
        Number of windows.
    settled : (K,) ndarray of bool
        Whether the phasors of the last two windows agreed, or differ by noise that leaves an error of at most 10 %, at
        an operating point that has not moved.
    moved : float
        Drift of the operating point: the largest change of a block's state or an FMU's output, from before the test
        signal to a window after its end, relative to 1 + its size.
    to : tuple of str
        Inputs of blocks that alone got the test signal; empty where all consumers of the wire did.
    """

    wired: WiredDiagram = field(repr=False)
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
    """Whether v is constant between two samples, or nothing is sampled; if not, −v/u is no loop."""
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    to: tuple[str, ...] = ()

    def __repr__(self) -> str:
        w = self.omega
        facts = (
            count_of(w.size, "frequency"),
            f"{w.min():.4g} to {w.max():.4g} rad/s" if w.size else "",
            f"{int(self.settled.sum())} settled",
        )
        return brief(f"measured frequency response at {self.wire!r}", *facts, then=".L, .S, .T, measured_margins(…)")

    @property
    def diagram(self) -> Any:
        """The `Diagram` that was measured."""
        return self.wired.facade

    @property
    def S(self) -> FrequencyResponseData:  # noqa: N802
        """Sensitivity u/d, as `control.FrequencyResponseData`."""
        return self._data(self.u, self.inputs, "S")

    @property
    def T(self) -> FrequencyResponseData:  # noqa: N802
        """Complementary sensitivity −v/d = 1 − S, as `control.FrequencyResponseData`."""
        return self._data(-self.v, self.inputs, "T")

    @property
    def L(self) -> FrequencyResponseData:  # noqa: N802
        """Loop transfer function −v/u at the wire, all other loops closed, as `control.FrequencyResponseData`.

        Raises
        ------
        OptionError
            If v changes between the samples.
        """
        self._check_held()
        return self._data(self._loop(), self.inputs, "L")

    @property
    def response(self) -> FrequencyResponseData:
        """Response from the test signal to the outputs, as `control.FrequencyResponseData`.

        Raises
        ------
        OptionError
            If no outputs were measured.
        """
        if not self.outputs:
            raise OptionError(
                "found no measured outputs; expected some. Name them: frequency_response(…, outputs=[…]).",
                block=self.wired.name,
            )
        return self._data(self.y, self.outputs, "response")

    def _check_held(self) -> None:
        if not self.held:
            raise OptionError(
                f"found that {self.wire!r} changes between two samples of {self.dt:g} s; expected a signal that is "
                "constant between them, as the test signal is: −v/u is no loop. Take S or T, or a wire that is "
                "renewed once in this time.",
                block=self.wired.name,
                port="wire",
            )

    def _loop(self) -> np.ndarray:
        v, u = np.moveaxis(self.v, 2, 0), np.moveaxis(self.u, 2, 0)
        return np.moveaxis(-np.linalg.solve(u.swapaxes(1, 2), v.swapaxes(1, 2)).swapaxes(1, 2), 0, 2)

    def _data(self, data: np.ndarray, outputs: tuple[str, ...], name: str) -> FrequencyResponseData:
        from control import FrequencyResponseData

        names = {"inputs": self.inputs, "outputs": outputs}
        plain = {key: [n.replace(".", "_") for n in labels] for key, labels in names.items()}
        return FrequencyResponseData(data, self.omega, self.dt, name=f"{name}({self.wire})".replace(".", "_"), **plain)

    @accepts(None, of=kinds.one_of("L", "S", "T").worded(found=kinds.by_name))
    def deviation(self, linearization: Linearization, of: str | None = None) -> np.ndarray:
        """Return the deviation of the measurement from a linear model at each frequency, relative to the model.

        Parameters
        ----------
        linearization : Linearization
            Linear model of the same diagram, at the operating point of the measurement.
        of : {"L", "S", "T"}, optional
            Function to compare, by the largest singular value of the difference. Without it L, or S if there is no L.

        Returns
        -------
        (K,) ndarray
            Relative deviation at each frequency.

        Raises
        ------
        OptionError
            If there is no such function, or the model has another sample time.
        """
        of = ("L" if self.held else "S") if of is None else of
        made = {"L": linearization.loop, "S": linearization.sensitivity, "T": linearization.complementary}
        if of == "L":
            self._check_held()
        model = made[of](self.wire, to=self.to)
        dt = float(model.dt)
        if not math.isclose(dt, self.dt, rel_tol=1e-12):
            raise OptionError(
                f"found a linear model with the sample time {dt:g} s; expected that of the measurement, {self.dt:g} s. "
                "Linearize the same diagram, with the same step.",
                block=self.wired.name,
            )
        measured = {"L": self._loop(), "S": self.u, "T": -self.v}[of]
        s = np.exp(1j * self.omega * self.dt) if self.dt else 1j * self.omega
        found = []
        for k, at in enumerate(s):
            exact = np.asarray(model(at, squeeze=False)).reshape(model.noutputs, model.ninputs)
            off, size = np.linalg.norm(measured[:, :, k] - exact, 2), np.linalg.norm(exact, 2)
            found.append(off / size if size else np.inf if off else 0.0)
        return np.array(found)

    def compare(self, linearization: Linearization, of: str | None = None) -> float:
        """Return the largest relative deviation from a linear model over all frequencies; see `deviation`."""
        return float(np.max(self.deviation(linearization, of)))


@accepts(
    "{diagram.name}",
    frequencies=kinds.frequencies,
    amplitude=kinds.positive.worded(
        "a positive number, the largest value of the test signal in the wire's unit", "Give one."
    ),
    kind=kinds.one_of(*KINDS),
    to=kinds.names,
    windows=kinds.integer(2).worded("a whole number of windows, at least 2", "Give one."),
)
def frequency_response(
    diagram: WiredDiagram,
    wire: str,
    frequencies: ArrayLike,
    *,
    amplitude: float,
    kind: str = "sine",
    at: PointLike = 0.0,
    outputs: str | Iterable[str] = (),
    to: str | Iterable[str] = (),
    windows: int = 40,
    agreement: float = 1e-6,
    confirm: bool = True,
    **options: Any,
) -> FrequencyResponse:
    """Measure a frequency response; see `Diagram.frequency_response`."""
    consumers, whole, cut = ((to,) if isinstance(to, str) else tuple(to)), diagram, wire
    if consumers:
        diagram, cut = cut_to(diagram, wire, consumers)
        at = carry_point(whole, at, diagram)
    omega, amplitude = np.unique(np.atleast_1d(np.asarray(frequencies, dtype=float))), float(amplitude)
    discrete = diagram.has_clock or diagram.has_fmu
    if discrete:
        chosen, point, t0 = find_beginning(diagram, at, dict(options))
    else:
        chosen, point, t0 = find_continuous_beginning(diagram, at, dict(options), choose_step(omega))
    variant = diagram.replace(point.parameters) if point is not None and point.parameters else diagram
    flat = variant.flatten(chosen.get("step", None if point is None or diagram.has_clock else point.base))
    signal = find_signal(flat, cut)
    tick = point.tick if point is not None else round(t0 / float(flat.base))
    samples = SamplesAtWire.of(flat, signal, tick) if discrete else SamplesAtWire(1, flat.base)
    dt = float(samples.period)
    if not omega[-1] * dt < np.pi:
        raise OptionError(
            f"found {omega[-1]:g} rad/s; expected less than {np.pi / dt:g} rad/s, as there is a sample every {dt:g} s. "
            "Give lower frequencies, or a smaller step.",
            block=diagram.name,
            port="frequencies",
        )
    measured = [find_signal(flat, name) for name in ([outputs] if isinstance(outputs, str) else outputs)]
    if flat.hybrid:
        chosen = {**EXACT, **chosen}
        if chosen.get("solver", "auto") not in FIXED:
            chosen.setdefault("max_step", 0.5 * np.pi / omega[-1])
    plan = list(plan_signal(kind, omega, dt, amplitude))
    made = inject_signal(diagram, signal, len(plan[0].waveform.amplitude), samples.held)
    lines = np.concatenate([part.omega for part in plan])

    def measure(plan: Sequence[Part], order: Iterable[int], chosen: Mapping[str, Any], amplitude: float) -> Measurement:
        found = Measurement(len(lines), len(signal.entries), sum(len(o.entries) for o in measured))
        for j, entry in enumerate(signal.entries):
            with InjectionRun(diagram, made, signal, measured, t0 if point is None else point, chosen) as run:
                if samples.wait:
                    run.go(samples.wait, 1)
                before, began = run.read_states(), run.t
                found.largest = GROWN * max(amplitude, float(np.max(np.abs(before), initial=0.0)))
                for i in order:
                    measure_part(run, plan[i], entry, j, samples.every, windows, agreement, found, i)
                run.play(plan[0].silence, entry, ramp=1.0)
                run.go(plan[0].samples, samples.every)
                found.note_movement(run, before, began, plan[0].samples, samples.every)
        return found

    found = measure(plan, range(len(plan)), chosen, float(amplitude))
    if confirm:
        less = [replace(p, waveform=replace(p.waveform, amplitude=HALF * p.waveform.amplitude)) for p in plan]
        found.compare(
            measure(less, range(len(plan) - 1, -1, -1), refine_tolerances(flat, chosen), HALF * float(amplitude))
        )
    found.refute_moved()
    labels = tuple(e for o in measured for e in o.labels)
    shown = variant  # the diagram as it was given, without the cut
    if consumers:
        shown = whole.replace(point.parameters) if point is not None and point.parameters else whole
    return FrequencyResponse(
        shown,
        wire,
        kind,
        float(amplitude),
        lines,
        dt if discrete else 0.0,
        found.v,
        found.u,
        found.y,
        found.uncertainty,
        found.distortion,
        found.windows,
        found.settled,
        found.moved,
        not discrete or (found.held and not moves_between(flat, signal.port)),
        signal.labels,
        labels,
        consumers,
    )
