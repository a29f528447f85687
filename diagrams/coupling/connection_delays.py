"""Delays of the connections from and to FMUs, listed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ...blocks.core import brief, explain_calls
from ..flat import FlatDiagram
from ..wiring import join
from .coupling_options import Coupling, Scheme
from .links import Links


class LinkKind(StrEnum):
    """Kind of a connection."""

    FMU_TO_FMU = "FMU → FMU"
    """The input of an FMU follows outputs of FMUs, directly or through blocks in continuous time."""
    BLOCK_TO_FMU = "block → FMU"
    """The input of an FMU comes from blocks alone."""
    FMU_TO_BLOCK = "FMU → block"
    """A block reads an output of an FMU."""


class HeldFrom(StrEnum):
    """Instant of the value that acts over a communication step."""

    CHANGE = "its change"
    """The source changes at communication points only, and acts from there on."""
    BEGINNING = "the beginning of the step"
    """The value at the beginning of the step."""
    END = "the end of the step"
    """The value at the end of the step."""
    MEAN = "beginning and end"
    """The mean of the values at the beginning and at the end."""


@dataclass(frozen=True)
class CoupledConnection:
    """A connection from or to an FMU, with its delay.

    ``source``, ``target``: dotted ports; the source is the block that the input is wired to, with the part of its port.
    ``kind``: FMU → FMU, block → FMU or FMU → block.
    ``follows``: for an input of an FMU: the FMUs' outputs that it follows between ticks.
    ``step``: longest communication step of the FMU that is written to or read from, in s.
    ``held``: instant of the value that acts over a communication step.
    ``steps``: communication steps from an instant to the first outputs that show the source's value at that instant; 0
    where those at the instant itself do.
    ``delay``: mean age in s of the value that acts, against the source in continuous time; negative where it is ahead.
    """

    source: str
    target: str
    kind: LinkKind
    follows: tuple[str, ...]
    step: float
    held: HeldFrom
    steps: int
    delay: float


@explain_calls
@dataclass(frozen=True)
class CouplingReport:
    """Coupling of the FMUs of a diagram: ``print(diagram.report_coupling(…))``.

    Attributes
    ----------
    scheme : Coupling
        The coupling that it is about.
    connections : tuple of CoupledConnection
        Connections from and to FMUs, by target.
    order : tuple of str
        For "gauss_seidel": paths of the FMUs in the order in which they step.
    loops : tuple of tuple of str
        Loops of direct feedthrough across FMUs: the outputs that each goes through.
    """

    scheme: Coupling
    connections: tuple[CoupledConnection, ...]
    order: tuple[str, ...]
    loops: tuple[tuple[str, ...], ...]

    def __repr__(self) -> str:
        facts = (
            str(self.scheme),
            f"{len(self.connections)} connections",
            f"{len(self.loops)} loops of feedthrough" * bool(self.loops),
        )
        return brief("coupling of FMUs", *facts, then="print(…) shows all")

    def __str__(self) -> str:
        rows = [("from", "to", "kind", "step in s", "held from", "steps", "mean delay in s")]
        rows += [
            (c.source, c.target, c.kind.value, f"{c.step:g}", c.held.value, str(c.steps), f"{c.delay:g}")
            for c in self.connections
        ]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [f"coupling: {self.scheme}"]
        lines += [f"order: {', '.join(self.order)}"] if self.order else []
        lines += ["  ".join(cell.ljust(n) for cell, n in zip(row, widths, strict=True)).rstrip() for row in rows]
        for ports in self.loops:
            solved = "solved by iteration" if self.scheme.scheme == Scheme.ITERATED else "not solved: one step late"
            lines.append(f"loop of direct feedthrough through {', '.join(ports)}: {solved}")
        return "\n".join(lines)


def report_coupling(flat: FlatDiagram, coupling: Coupling) -> CouplingReport:
    """List the delays of all connections from and to the FMUs of a diagram."""
    links = Links(flat)
    order = links.order(coupling.order) if coupling.scheme == Scheme.GAUSS_SEIDEL else ()
    found = [*_into(links, coupling, order), *_out_of(links, coupling)]
    return CouplingReport(coupling, tuple(sorted(found, key=lambda c: (c.target, c.source))), order, links.loops)


def _into(links: Links, coupling: Coupling, order: tuple[str, ...]) -> Iterator[CoupledConnection]:
    """Yield the connections to inputs of FMUs."""
    flat = links.flat
    for path in links.paths:
        for port in flat.table.blocks[path].inputs:
            where = flat.plant_inputs.slices.get(join(path, port))
            wire = flat.table.wires.get((path, port))
            if where is None or wire is None:
                continue
            by = np.atleast_1d(links.by_outputs[where].any(axis=0))
            sources = [other for other in links.paths if by[links.outputs[other]].any()]
            before = order[: order.index(path)] if order else ()
            fresh = bool(links.by_states[where].any()) or any(other in before for other in sources)
            smooth = bool(links.smooth_inputs[where].all())
            held = _held(coupling.scheme, moving=bool(links.moving[where].any()), fresh=fresh, smooth=smooth)
            step = _longest_step(flat, path)
            span = max([step, *(_longest_step(flat, other) for other in sources)])
            kind = LinkKind.FMU_TO_FMU if sources else LinkKind.BLOCK_TO_FMU
            late = {HeldFrom.BEGINNING: 0.5 * span, HeldFrom.END: -0.5 * span}.get(held, 0.0)
            if held == HeldFrom.CHANGE:
                late = _wait(flat, wire.block, step)
            shown = 0 if held in (HeldFrom.END, HeldFrom.MEAN) else 1
            yield CoupledConnection(str(wire), join(path, port), kind, _outputs(links, by), step, held, shown, late)


def _held(scheme: str, *, moving: bool, fresh: bool, smooth: bool) -> HeldFrom:
    if not moving:
        return HeldFrom.CHANGE
    if scheme == Scheme.ITERATED and smooth:
        return HeldFrom.MEAN
    return HeldFrom.END if scheme == Scheme.GAUSS_SEIDEL and fresh and smooth else HeldFrom.BEGINNING


def _out_of(links: Links, coupling: Coupling) -> Iterator[CoupledConnection]:
    """Yield the connections from outputs of FMUs to blocks."""
    flat = links.flat
    reads = [((path, port), wire) for (path, port), wire in flat.table.wires.items()]
    reads += [((path, "control"), wire) for path, wire in flat.table.controls.items()]
    for (path, port), wire in reads:
        if wire.block not in links.paths or path in links.paths:
            continue
        step = _longest_step(flat, wire.block)
        target = join(path, port)
        clock = flat.clocks.get(flat.table.subsystem_of.get(path, path))
        if clock is not None:
            held, late = HeldFrom.CHANGE, max(0.0, 0.5 * (step - float(flat.base * clock.every)))
        elif not links.felt_by_blocks[flat.plant_outputs.slices[join(wire.block, wire.port)]].any():
            held, late = HeldFrom.CHANGE, 0.0  # nothing in continuous time follows it but inputs of FMUs
        elif coupling.scheme == Scheme.ITERATED:
            held, late = HeldFrom.MEAN, 0.0
        else:
            held, late = HeldFrom.BEGINNING, 0.5 * step
        yield CoupledConnection(str(wire), target, LinkKind.FMU_TO_BLOCK, (), step, held, 0, late)


def _wait(flat: FlatDiagram, source: str, step: float) -> float:
    """Return the mean time in s that a sampled value waits for the next communication point."""
    clock = flat.clocks.get(flat.table.subsystem_of[source])
    return 0.0 if clock is None else max(0.0, 0.5 * (step - float(flat.base * clock.every)))


def _longest_step(flat: FlatDiagram, path: str) -> float:
    """Return the longest time in s between two communication points of a plant, or an upper bound of it."""
    return float(flat.base * min(clock.every for clock in flat.plant_ticks[path]))


def _outputs(links: Links, by: np.ndarray) -> tuple[str, ...]:
    return tuple(".".join(links.name_of_output(int(entry))) for entry in np.flatnonzero(by))
