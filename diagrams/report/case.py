"""What a report analyses: a diagram, its variants, and each one's linear model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import ErrorDynamics, FeedbackLinearization, Gain, Reference
from ...blocks.core.errors import LoopwrightError
from ...fmus.models.gantry import Gantry
from ..admittance.compliance_loop import control_rate
from ..admittance.shown_plant import is_discrete, show_plant
from ..flat.wired_diagram import WiredDiagram
from ..linearization.findings import UnusualStart
from ..linearization.linearize import Linearization, linearize
from ..results.operating_point import OperatingPoint
from .points import point_of

if TYPE_CHECKING:
    from ..paper.experiments import Experiment

FRICTION = "_friction"
"""How the keys of variants end that have the plant's friction, where those without it are analysed as well."""
NO_FRICTION = {"coulomb_scale": 0.0, "viscous_scale": 0.0}
AT_REST = 1e-6
LATER = 10  # ticks after the start that an operating point is at, where the first tick is unlike the others
SIDES = {"par": "v_par", "perp": "v_perp"}
COORDINATES = ("controller.eta", "controller.xi")
NAMES = {"continuous": "continuous", "sampled_d0": "sampled, no delay", "sampled_d1": "sampled, one sample of delay"}


@dataclass(eq=False)
class Variant:
    """A diagram that is analysed: itself, without sampling, with a delay, without friction.

    Attributes
    ----------
    key : str
        Its part of dotted paths, such as ``sampled_d0``.
    title : str
        What it is.
    diagram : Diagram
        The diagram.
    delay : int
        Samples of computational delay.
    problem : str
        Why it can't be analysed; empty where it can.
    """

    key: str
    title: str
    diagram: WiredDiagram
    where: Any
    delay: int = 0
    problem: str = ""
    source: WiredDiagram | None = None
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    loops: dict[tuple[str, ...], Any] = field(default_factory=dict)
    elsewhere: dict[tuple[float, float], Variant | None] = field(default_factory=dict)

    @cached_property
    def point(self) -> OperatingPoint:
        """Its operating point."""
        return point_of(self.diagram, self.where, self.source)

    @cached_property
    def model(self) -> Linearization:
        """Its linear model."""
        return linearize(self.diagram, self.point, inputs=self.inputs, outputs=self.outputs)

    def loop(self, *wires: str) -> Any:
        """Return the loop transfer function at wires, computed once."""
        if wires not in self.loops:
            self.loops[wires] = self.model.loop(*wires)
        return self.loops[wires]

    @property
    def rests(self) -> bool:
        """Whether nothing moves at its operating point; False where it can't be analysed there."""
        try:
            moves = max(self.point.residual, float(np.max(np.abs(self.model.affine), initial=0.0)))
        except LoopwrightError:
            return False
        return moves < AT_REST


class Case:
    """A diagram with its variants, for the sections of a report.

    Parameters
    ----------
    diagram : Diagram
        What is analysed.
    point : OperatingPoint, Snapshot or float, optional
        Where; the start without it.
    experiment : Experiment, optional
        Where the diagram comes from.
    wires : tuple of str, optional
        Wires at which loops are looked at, instead of all named ones on loops.
    """

    def __init__(
        self, diagram: WiredDiagram, point: Any = None, experiment: Experiment | None = None, wires: Any = None
    ):
        self.diagram, self.point, self.experiment = diagram, point, experiment
        self.wires: tuple[str, ...] | None = wires
        self.notes: list[str] = []
        self.variants: dict[str, Variant] = {}
        self.base = self._resting(self._without_delay())
        self.smooth = self._smooth(self.base)
        for plain, suffix, title in self._plants(self.base, self.smooth):
            for key, variant, delay in self._implementations(plain):
                name = key + suffix
                self._add(name, NAMES[key] + title, variant, delay)

    @property
    def is_fig3(self) -> bool:
        """Whether the diagram has the parts of Fig. 3 that its own sections are about."""
        blocks = self.diagram.blocks
        inner = all(isinstance(blocks.get(f"controller.pid_{s}"), ErrorDynamics) for s in SIDES)
        return inner and isinstance(blocks.get("controller.feedback_linearization"), FeedbackLinearization)

    @property
    def has_friction(self) -> bool:
        """Whether variants with and without the plant's friction are told apart."""
        return any(key.endswith(FRICTION) for key in self.variants)

    @property
    def has_events(self) -> bool:
        """Whether the plant has discrete states, such as contact."""
        return "plant" in self.diagram.blocks and is_discrete(self.diagram, "plant")

    @property
    def model(self) -> Any:
        """The model that the feedback linearization inverts."""
        block: Any = self.diagram["controller.feedback_linearization"]
        return block.model

    @property
    def path(self) -> Any:
        """The path of Fig. 3."""
        block: Any = self.diagram["controller.feedback_linearization"]
        return block.path

    @cached_property
    def plant_model(self) -> Any:
        """The plant as the model that the admittance is reduced with, None where it is not shown to be such a gantry.

        Its parameters are read from the FMU by their names. Names promise nothing, so that the plant's own linear model
        is compared with the model that they make.
        """
        plant: Any = self.diagram.blocks.get("plant")
        if not self.is_fig3 or not isinstance(self.model, Gantry) or not hasattr(plant, "description"):
            return None
        variables = plant.description.variables
        if not {"coulomb_friction", "translational_mass", "equivalent_mass", "coulomb_scale"} <= set(variables):
            return None
        names = [n for n in self.model.parameter_specs if n in variables and not n.startswith("start_")]
        values = {n: plant.start.get(n, variables[n].start) for n in names}
        try:
            found = self.model.replace(**{n: v for n, v in values.items() if v is not None})
            point = point_of(self.base, self.point, self.diagram)
        except LoopwrightError:
            return None
        return found if self._is_plant(found, self.base, point) else None

    def _is_plant(self, model: Any, diagram: WiredDiagram, point: OperatingPoint | None = None) -> bool:
        """Return whether the plant of a variant is shown to be a model, where and as fast as it is."""
        pids: Any = [self.diagram.blocks[f"controller.pid_{s}"] for s in SIDES]
        try:
            show_plant(diagram, "plant", model, rate=min(map(control_rate, pids)), point=point)
        except LoopwrightError:
            return False
        return True

    def usable(self, *keys: str) -> Iterator[Variant]:
        """Yield the variants that can be analysed, all or those with given keys."""
        for key, variant in self.variants.items():
            if not variant.problem and (not keys or key in keys):
                yield variant

    def at(self, variant: Variant, eta: float, xi: float) -> Variant | None:
        """Return a variant of Fig. 3 at rest at another point beside the path; None where it is not at rest there."""
        if (eta, xi) not in variant.elsewhere:
            position = self.path.to_plane(eta, xi)
            changes: dict[str, Any] = {"plant.start.position": position}
            for name, value in (("eta_d", eta), ("xi_d", xi)):
                changes[name] = Reference(value, unit="m", name=name)
            try:
                found: Variant | None = with_parameters(variant, changes, 0.0)
            except LoopwrightError:
                found = None
            if found is not None and not found.rests:
                found = None
            variant.elsewhere[eta, xi] = found
        return variant.elsewhere[eta, xi]

    def _plants(self, base: WiredDiagram, smooth: WiredDiagram | None) -> Iterator[tuple[WiredDiagram, str, str]]:
        if smooth is None:
            yield base, "", ""
        else:
            yield smooth, "", ""
            yield base, FRICTION, ", with friction"

    def _smooth(self, base: WiredDiagram) -> WiredDiagram | None:
        """Return Fig. 3 without friction in plant and model, None where there is none, or it can't be taken out."""
        if self.plant_model is None:
            plant: Any = self.diagram.blocks.get("plant")
            if self.is_fig3 and hasattr(plant, "description") and set(NO_FRICTION) <= set(plant.description.variables):
                self.notes.append(
                    "The plant is not shown to be the gantry, so that its friction is left in: all keys without "
                    "_friction are the diagram's as it is."
                )
            return None
        rough = any(getattr(m, "friction", None) is not None for m in (self.model,))
        if not rough:
            return None
        changes: dict[str, Any] = {f"plant.start.{name}": 0.0 for name in NO_FRICTION}
        changes["controller.feedback_linearization.model"] = self.model.replace(**NO_FRICTION)
        found = base.replace(changes)
        return found if self._is_plant(self.plant_model.replace(**NO_FRICTION), found) else None

    def _without_delay(self) -> WiredDiagram:
        """Return the diagram without its computational delay, as far as that is known."""
        if "controller.computation" not in self.diagram.blocks or not self.is_fig3:
            return self.diagram
        try:
            return self.diagram.replace({"controller.computation": Gain(gain=1.0, name="computation")})
        except LoopwrightError as error:
            self.notes.append(f"Its own delay could not be taken out: {error.message}")
            return self.diagram

    def _resting(self, base: WiredDiagram) -> WiredDiagram:
        """Return Fig. 3 at rest where its references begin, where it starts elsewhere and no point was given."""
        if not self.is_fig3 or self.point is not None:
            return base
        here = Variant("", "", base, None)
        if here.rests:
            return base
        try:
            first = [float(np.ravel(here.point.values[f"{name}.y"])[0]) for name in ("eta_d", "xi_d")]
            found = base.replace({"plant.start.position": self.path.to_plane(*first)})
        except (LoopwrightError, KeyError):
            return base
        if not Variant("", "", found, None).rests:
            return base
        self.notes.append(
            "It starts off its references, and moves. It is analysed at rest where they begin: "
            f"η = {first[0]:.6g} m, ξ = {first[1]:.6g} m."
        )
        return found

    def _implementations(self, plain: WiredDiagram) -> Iterator[tuple[str, Any, int]]:
        if not plain.has_clock:
            yield "continuous", plain, 0
            return
        if plain.is_continuous or plain.has_fmu:
            yield "continuous", _tried(plain.continuous), 0
        boxes = delayed_boxes(plain)
        if not boxes:
            yield "sampled_d0", plain, 0
            return
        for n in (0, 1):
            yield f"sampled_d{n}", _tried(lambda n=n: plain.replace({f"{b}.delay": n for b in boxes})), n

    def _add(self, key: str, title: str, diagram: Any, delay: int) -> None:
        problem = ""
        if isinstance(diagram, LoopwrightError):
            diagram, problem = self.diagram, str(diagram)
        wires: dict[str, Any] = {}
        if self.is_fig3:
            wires = {"inputs": tuple(f"controller.{v}" for v in SIDES.values()), "outputs": COORDINATES}
        variant = Variant(key, title, diagram, self.point, delay, problem, self.diagram, **wires)
        if not problem:
            try:
                later = self.point is None and any(isinstance(f, UnusualStart) for f in variant.model.findings)
                if later:
                    at = LATER * variant.model.dt
                    variant = Variant(key, title, diagram, at, delay, problem, self.diagram, **wires)
                _ = variant.model
            except LoopwrightError as error:
                variant.problem = str(error)
        self.variants[key] = variant
        if variant.problem:
            self.notes.append(f"The variant “{title}” is left out: {variant.problem}")


def _tried(make: Any) -> Any:
    try:
        return make()
    except LoopwrightError as error:
        return error


def delayed_boxes(diagram: WiredDiagram) -> list[str]:
    """Return the sampled subsystems that act on what is continuous: a delay of the computation is a delay of theirs."""
    table = diagram.structure
    found: set[str] = set()
    for (block, _), wire in table.wires.items():
        clock = table.clock(table.frame_of[wire.block])
        if clock is not None and clock.path and table.clock(table.frame_of[block]) is None:
            found.add(clock.path)
    return sorted(found)


def in_s(poles: Any, dt: float) -> np.ndarray:
    """Return poles in 1/s; of those of a sampled model, z, without those at z = 0: memory, or a delay."""
    values = np.asarray(poles, dtype=complex)
    return np.asarray(np.log(values[np.abs(values) > 1e-12]) / dt if dt else values)


def with_parameters(variant: Variant, changes: Mapping[str, Any], where: Any = ...) -> Variant:
    """Return a variant with other parameters, at its own operating point."""
    at = variant.where if where is ... else where
    found = variant.diagram.replace(changes)
    kept = {name: getattr(variant, name) for name in ("delay", "source", "inputs", "outputs")}
    return Variant(variant.key, variant.title, found, at, **kept)
