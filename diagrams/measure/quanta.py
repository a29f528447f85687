"""Quanta of a diagram's converters and encoders: test signals that are large next to them, and what is left at rest.

A linear model has the mean slope of their stairs, which a running diagram shows only for motions of many quanta. The
quantum of a signal is its largest change where one converter's input changes by one quantum for good, with all loops
closed. A velocity by differences of an encoder, say, changes by one quantum in a sample time.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import explain_calls
from ..flat import FlatDiagram, WiredDiagram
from ..linearization import Linearization, find_signal, linearize, wire_entries
from ..results import OperatingPoint
from ..wiring import join
from .predicted_step import predict

if TYPE_CHECKING:
    from ..frequency import LoopTransfer

LEAST = 400.0
"""Quanta of a signal that a test signal moves it by at least: one of them is a quarter of a percent."""
SAMPLES = 2000
"""Samples at most over which a signal's quantum is looked for."""
LEAST_SINE = 100.0
"""Quanta of a signal that a sine moves it by at least: whole periods are averaged."""
PERIODS = 3.0
"""Periods of the lowest frequency over which a signal's quantum is looked for."""
TAIL = 0.2
"""Share of a record, at its end, in which a diagram counts as at rest."""


@explain_calls
@dataclass(frozen=True)
class Converter:
    """An input that its block follows in steps."""

    block: str
    source: str
    size: np.ndarray  # size of the steps, one for each entry of the input
    signal: str  # port that feeds the input
    entries: tuple[int, ...]  # entries of that port that reach the input

    @property
    def name(self) -> str:
        """Name of the input."""
        return join(self.block, self.source)


@explain_calls
@dataclass(frozen=True)
class Quantum:
    """Largest change of a signal by one step of one converter."""

    value: float  # in the signal's unit
    converter: str  # name of the converter's input


def find_converters(flat: FlatDiagram) -> list[Converter]:
    """Return the inputs with quanta that are wired, by path."""
    found = []
    for path, block in sorted(flat.table.blocks.items()):
        for source, parameter in block.quanta.items():
            wire = flat.table.wires.get((path, source))
            if wire is None or path not in flat.checked.traced:
                continue
            shape = flat.checked.traced[path].inputs[source]
            size = np.broadcast_to(np.asarray(getattr(block, parameter), dtype=float), shape)
            signal = join(wire.block, wire.port)
            found.append(Converter(path, source, np.ravel(size), signal, wire_entries(flat, wire)))
    return found


def find_quantum(diagram: WiredDiagram, point: OperatingPoint, signal: str, length: float) -> Quantum | None:
    """Return the quantum of a signal with one entry, within a time in s; None where no converter moves it."""
    converters = find_converters(diagram.flatten_like(point))
    if not converters:
        return None
    model = linearize(diagram, point, inputs=[c.name for c in converters], outputs=[signal])
    sizes = [(size, c.name) for c in converters for size in c.size]
    found = [Quantum(float(size * _peak(model, column, length)), name) for column, (size, name) in enumerate(sizes)]
    largest = max(found, key=lambda quantum: quantum.value)
    return largest if largest.value > 0.0 else None


def find_least_step(
    diagram: WiredDiagram, point: OperatingPoint, wire: str, signal: str, length: float
) -> tuple[float, Quantum] | None:
    """Return the height of a step at a wire that moves a signal by `LEAST` quanta, and the quantum.

    None where no converter moves the signal, or the step doesn't.
    """
    quantum = find_quantum(diagram, point, signal, length)
    if quantum is None:
        return None
    moved = _peak(linearize(diagram, point, inputs=[wire], outputs=[signal]), 0, length)
    return (LEAST * quantum.value / moved, quantum) if moved > 0.0 else None


def find_rest(
    diagram: WiredDiagram, point: OperatingPoint, wire: str, size: float, slowest: float, length: float
) -> float:
    """Return the time in s after a step from whose `TAIL` on its motion is a tenth of a quantum, by the linear model.

    ``slowest`` is the rate in 1/s of the slowest mode, ``length`` the time in s within which the step moves the
    converters' inputs most.
    """
    converters = find_converters(diagram.flatten_like(point))
    if not converters:
        return 0.0
    model = linearize(diagram, point, inputs=[wire], outputs=[c.name for c in converters])
    quanta = abs(size) * _peaks(model, 0, length) / np.concatenate([c.size for c in converters])
    return float(np.log(max(1.0, 10.0 * float(np.max(quanta)))) / (slowest * (1.0 - TAIL)))


def find_least_sine(
    diagram: WiredDiagram, point: OperatingPoint, wire: str, L: LoopTransfer, frequencies: np.ndarray
) -> tuple[float, Quantum] | None:
    """Return the amplitude of sines at a wire that move it by `LEAST_SINE` quanta everywhere, and the quantum."""
    quantum = find_quantum(diagram, point, wire, PERIODS * 2.0 * np.pi / float(np.min(frequencies)))
    if quantum is None:
        return None
    points = np.exp(1j * frequencies * L.dt) if L.dt else 1j * frequencies
    loop = np.array([complex(np.ravel(L(s))[0]) for s in points])
    moved = float(np.min(np.abs(loop / (1.0 + loop))))
    return (LEAST_SINE * quantum.value / moved, quantum) if moved > 0.0 else None


def _peak(model: Linearization, column: int, length: float) -> float:
    """Return the largest change of the output by a step of 1 at an input."""
    return float(_peaks(model, column, length)[0])


def _peaks(model: Linearization, column: int, length: float) -> np.ndarray:
    """Return the largest change of each output by a step of 1 at an input."""
    count = int(np.clip(length / model.dt, 2, SAMPLES)) if model.dt else SAMPLES
    one = replace(model, B=model.B[:, [column]], D=model.D[:, [column]], inputs=(model.inputs[column],))
    rows, _, between = predict(one, np.ones(count + 1), (model.dt or length / count) * np.arange(count + 1))
    return np.asarray(np.max(np.abs(rows), axis=0) + between)


def remaining_oscillation(change: np.ndarray, predicted: np.ndarray, size: np.ndarray) -> float:
    """Return the largest amplitude, in quanta, of a converter's inputs at the end of a record.

    What the linear model does there doesn't count; where the run doesn't follow the model, the run's own motion does.
    """
    begins = int((1.0 - TAIL) * len(change))
    spans = [np.ptp(part[begins:], axis=0) for part in (change, change - predicted)]
    return float(np.max(np.minimum(*spans) / 2.0 / size, initial=0.0))


def columns_of(labels: Iterable[str], converter: Converter, flat: FlatDiagram) -> list[int]:
    """Return the columns of a converter's entries among recorded labels."""
    every = find_signal(flat, converter.signal).labels
    known = list(labels)
    return [known.index(every[i]) for i in converter.entries]
