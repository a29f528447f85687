"""The subject of a report: a diagram with the variants that are analysed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from ...blocks.core import LoopwrightError, SampleTimeError
from ..flat import WiredDiagram
from ..linearization import UnusualStart
from ..plotting import AxisUnits
from ..requirements import Requirements
from ..studies import LoopPlace, cut_places, find_places
from .pages import Texts
from .variant import Implementation, Variant, in_s, look_of
from .wires_on_loops import wires_on_loops

TEXTS = Texts(__package__, "variants")
AS_IT_IS = "as it is"
"""Title of the variant that leaves nothing out."""
LATER = 10
"""Ticks after the start that an operating point is at, where the first tick is unlike the others."""
AMPLITUDE = 1e-4
"""Size of the test signal of the injection check, relative to 1 + the size of the signal."""


SAMPLES, SOLVED, IN_MODEL_EXCHANGE = 20_000, 1_000, 400
"""Samples at most in a period of the injection check, those where a solver goes from one to the next, and those where
the solver asks a block in model exchange."""


class ReportedExperiment(Protocol):
    """An experiment, as a report's heading names it; a protocol, as the report knows no paper."""

    @property
    def letter(self) -> str:
        """Its letter."""

    @property
    def diagram(self) -> Any:
        """Its `Diagram`."""


class Basis(NamedTuple):
    """A diagram whose implementations are analysed."""

    diagram: WiredDiagram
    suffix: str = ""  # ends the keys of its variants
    lacks: str = ""  # ends their titles: what is left out of the diagram
    is_design: bool = True


class InjectionPlan(NamedTuple):
    """A test signal, and the variant that it is added to."""

    variant: Variant
    frequencies: np.ndarray  # in rad/s
    amplitude: float
    left_out: int = 0  # frequencies whose periods have more than ``samples`` samples: they would take too long
    samples: int = 0

    def shortened(self, samples: int) -> InjectionPlan:
        """Return the test signal with the frequencies whose periods have so many samples at most; at least the last."""
        w, dt = self.frequencies, self.variant.model.dt
        if not dt:  # continuous time has no samples
            return self
        kept = w[w * dt * samples >= 2 * np.pi]
        kept = kept if len(kept) else w[-1:]
        return self._replace(frequencies=kept, left_out=len(w) - len(kept), samples=samples)


def most_samples(variant: Variant) -> int:
    """Return the samples at most in a period of the injection check of a sampled variant, by the price of a tick."""
    flat = variant.diagram.flatten_like(variant.point)
    return IN_MODEL_EXCHANGE if flat.in_model_exchange else SOLVED if flat.hybrid else SAMPLES


class Case:
    """A diagram with its variants, for the parts of a report.

    It knows nothing of the diagram but its structure. A kind of diagram that is known better has its own case: a
    subclass that overrides `bases`, `named_wires` and `excitation`.
    """

    inputs: tuple[str, ...] = ()
    """Wires at which the linear models have inputs."""
    outputs: tuple[str, ...] = ()
    """Wires that are outputs of the linear models."""

    def __init__(
        self,
        diagram: WiredDiagram,
        point: Any = None,
        experiment: ReportedExperiment | None = None,
        wires: tuple[str, ...] | None = None,
        stairs: str | None = None,
        requirements: Requirements | None = None,
    ):
        self.diagram, self.point, self.experiment, self.wires = diagram, point, experiment, wires
        self.stairs, self.requirements = stairs, requirements
        self.notes: list[str] = []
        self.keys: tuple[str, ...] = ()  # of the sections that the report is to have
        self.axes = AxisUnits()
        self.notify: Callable[[str], None] = lambda doing: None  # gets what is being done, where a section takes long
        self.variants: dict[str, Variant] = {}  # those that can't be analysed, too; the diagram as it is comes first
        own = self.own_delay()
        for basis in self.bases():
            for implementation, make in _implementations(basis.diagram, own):
                self._add(basis, implementation, make, _title(implementation, basis.lacks, own, diagram.has_clock))
        self.variants = dict(sorted(self.variants.items(), key=lambda item: not item[1].is_actual))
        if requirements is not None:
            required = self.required_signals()
            for v in self.variants.values():
                v.required, v.every_state = required, requirements.every_state

    def required_signals(self) -> tuple[str, ...]:
        """Return the wires and ports on which something is required: of steps, loops, and numbers of loops."""
        if self.requirements is None:
            return ()
        wires, extra = self.loop_wires(), self.extra_loops()
        return tuple(wires.get(name, name) for name in self.requirements.signals if name not in extra)

    def bases(self) -> Iterator[Basis]:
        """Yield the diagrams whose implementations are analysed: the diagram itself."""
        yield Basis(self.diagram)

    def named_wires(self) -> Mapping[str, str]:
        """Return the wires at which loops are looked at, by their keys in the report."""
        return wires_on_loops(self.diagram, self.wires)

    @cached_property
    def loop_places(self) -> Mapping[str, LoopPlace]:
        """The places at which these loops are cut, by their keys."""
        return find_places(self.diagram, self.named_wires(), self.requirements)

    def loop_wires(self) -> dict[str, str]:
        """Return the names of the wires that are cut in the variants, by the keys of their loops."""
        return {key: place.name for key, place in self.loop_places.items()}

    def names_of_loops(self) -> dict[str, tuple[str, ...]]:
        """Return the names that a loop at a wire has in requirements, by its key."""
        return {key: tuple(dict.fromkeys((key, place.wire, place.name))) for key, place in self.loop_places.items()}

    def sensitivity_wires(self) -> dict[str, str]:
        """Return the wires whose loops' sensitivities to parameters are reported, by their keys."""
        return dict(self.loop_wires())

    def extra_loops(self) -> tuple[str, ...]:
        """Return the keys of loops that further parts of the report add to those at the wires."""
        return ()

    def name_place(self, place: str) -> str:
        """Return the name of a point at which a loop is looked at, by its part of dotted paths."""
        return place.replace("_", " ")

    def own_delay(self) -> int | None:
        """Return the samples of computational delay that the diagram has; None where its subsystems' differ."""
        settings = self.diagram.subsystems
        delays = {settings[path].delay for path in delayed_subsystems(self.diagram)}
        return delays.pop() if len(delays) == 1 else None if delays else 0

    @property
    def actual(self) -> Variant | None:
        """The diagram as it is; None where no variant is."""
        return next((v for v in self.variants.values() if v.is_actual), None)

    @property
    def looks(self) -> dict[str, dict[str, Any]]:
        """The color and line of each variant by its key, in all figures."""
        actual = {key: look_of(key, 0) for key, v in self.variants.items() if v.is_actual}
        others = (key for key, v in self.variants.items() if not v.is_actual)
        return actual | {key: look_of(key, i) for i, key in enumerate(others, 1)}

    def judged(self) -> Iterator[Variant]:
        """Yield the variants that are held against the requirements, those that can't be analysed as well."""
        further = () if self.requirements is None else self.requirements.further_variants
        for variant in self.variants.values():
            if variant.is_actual or variant.key in further:
                yield variant

    def excitation(self, variant: Variant, wire: str) -> InjectionPlan:
        """Return the test signal of the injection check: small, and spread around the poles of the diagram."""
        # where a diagram is much slower than its samples, it is spread above the poles: a period is not that long
        dt = variant.model.dt
        w = np.abs(in_s(variant.model.poles, dt))
        fastest = np.pi / dt if dt else np.inf
        w = w[(w > 1e-6) & (w < 0.3 * fastest)]
        centre = float(np.median(w)) if len(w) else 0.03 * fastest if dt else 1.0
        lowest = max(centre / 10, 2 * np.pi / (dt * most_samples(variant))) if dt else centre / 10
        source = variant.diagram.names.get(wire)
        path = wire if source is None else f"{source.block}.{source.port}"
        value = np.ravel(variant.point.values.get(path, 0.0))
        return InjectionPlan(
            variant,
            np.geomspace(lowest, min(max(centre * 3, lowest * 3), 0.5 * fastest), 5),
            AMPLITUDE * (1.0 + float(np.max(np.abs(value), initial=0.0))),
        )

    def usable(self, *implementations: Implementation) -> Iterator[Variant]:
        """Yield the variants that can be analysed, all or those of some implementations."""
        for variant in self.variants.values():
            if not variant.problem and (not implementations or variant.implementation in implementations):
                yield variant

    def designs(self, *implementations: Implementation) -> Iterator[Variant]:
        """Yield those of the usable variants that are the design itself."""
        return (variant for variant in self.usable(*implementations) if variant.is_design)

    def _add(self, basis: Basis, implementation: Implementation, make: Callable[[], WiredDiagram], title: str) -> None:
        found = Variant(
            implementation + basis.suffix,
            title or AS_IT_IS,
            self.diagram,
            self.point,
            implementation,
            basis.is_design,
            is_actual=not title,
            source=self.diagram,
            inputs=self.inputs,
            outputs=self.outputs,
            stairs=self.stairs,
        )
        try:
            found = replace(found, diagram=cut_places(make(), tuple(self.loop_places.values())))
            if self.point is None and any(isinstance(f, UnusualStart) for f in found.model.findings):
                found = replace(found, where=LATER * found.model.dt)
            if found.model.delays is not None:
                _ = found.model.poles  # the roots of a dead time that is very long for the loop may not be had
        except LoopwrightError as error:
            sampled_only = implementation is Implementation.CONTINUOUS and isinstance(error, SampleTimeError)
            found.problem = TEXTS.line("sampled_only", block=error.block) if sampled_only else str(error)
            self.notes.append(TEXTS.line("left_out", variant=found.title, problem=found.problem))
        self.variants[found.key] = found


def _title(implementation: Implementation, lacks: str, own: int | None, has_clock: bool) -> str:
    """Return the title of a variant by what it leaves out or adds; empty for the diagram as it is."""
    said = []
    if implementation is Implementation.CONTINUOUS and has_clock:
        said.append(TEXTS.line("without_sampling"))
    elif implementation is not Implementation.CONTINUOUS and implementation is not Implementation.OWN:
        delay = implementation.delay
        if delay != own:
            said.append(TEXTS.line("with_delay", samples=delay, own=own))
    return ", ".join([*said, *([lacks] if lacks else [])])


def _implementations(
    diagram: WiredDiagram, own: int | None
) -> Iterator[tuple[Implementation, Callable[[], WiredDiagram]]]:
    """Yield the implementations of a diagram, with what makes each."""
    if not diagram.has_clock:
        yield Implementation.CONTINUOUS, lambda: diagram
        return
    if diagram.is_continuous or diagram.has_fmu:
        yield Implementation.CONTINUOUS, diagram.continuous
    subsystems = delayed_subsystems(diagram)
    if not subsystems:
        yield Implementation.SAMPLED, lambda: diagram
        return
    if own not in (0, 1):
        yield Implementation.OWN, lambda: diagram
    for kind in (Implementation.SAMPLED, Implementation.DELAYED):
        yield kind, lambda n=kind.delay: diagram.replace({f"{subsystem}.delay": n for subsystem in subsystems})  # type: ignore[misc]


def delayed_subsystems(diagram: WiredDiagram) -> list[str]:
    """Return the sampled subsystems that act on what is continuous: a delay of the computation is a delay of theirs."""
    table = diagram.structure
    found: set[str] = set()
    for (block, _), wire in table.wires.items():
        clock = table.clock(table.subsystem_of[wire.block])
        if clock is not None and clock.path and table.clock(table.subsystem_of[block]) is None:
            found.add(clock.path)
    return sorted(found)
