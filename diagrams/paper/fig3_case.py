"""The variants of a diagram of Fig. 3: at rest, without its own delay, with and without the plant's friction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, cast
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks import (
    Constant,
    ErrorDynamics,
    FeedbackLinearization,
    Gain,
    Path,
    PlanarModel,
    Reference,
    Step,
    UnitDelay,
)
from ...blocks.core import LoopwrightError, OptionError
from ...fmus.fmu_block import Fmu
from ...fmus.models import Gantry
from ..flat import WiredDiagram
from ..report import IN_MODEL_EXCHANGE, Basis, Case, Implementation, InjectionPlan, Texts, Variant, point_of
from ..results import OperatingPoint
from .compliance_loop import control_rate
from .reduced_loops import FRICTION, NO_FRICTION, ReducedLoops
from .shown_plant import check_plant, is_discrete

TEXTS = Texts(__package__, "subject")
PLANT = "plant"
SIDES = {"par": "v_par", "perp": "v_perp"}
"""The virtual input of each direction."""
COORDINATES = ("controller.eta", "controller.xi")
REFERENCES = ("eta_d", "xi_d")
DISTURBANCES = ("set_point", "desired_force_par", "desired_force_perp")
FREQUENCIES = np.geomspace(1.0, 150.0, 9)
"""Frequencies of the injection check in rad/s."""
AMPLITUDE = 1e-4
"""Amplitude of the injection check in m/s²."""


def has_parts(diagram: WiredDiagram) -> bool:
    """Return whether a diagram has the parts of Fig. 3 that its report is about."""
    blocks = diagram.blocks
    inner = all(isinstance(blocks.get(f"controller.pid_{side}"), ErrorDynamics) for side in SIDES)
    return inner and isinstance(blocks.get("controller.feedback_linearization"), FeedbackLinearization)


def linearization_of(diagram: WiredDiagram) -> FeedbackLinearization:
    """Return the feedback linearization of a diagram."""
    return cast(FeedbackLinearization, diagram["controller.feedback_linearization"])


class Fig3Case(Case):
    """A diagram of Fig. 3 with its variants."""

    inputs = tuple(f"controller.{name}" for name in SIDES.values())
    outputs = COORDINATES

    # --- the variants -------------------------------------------------------------------------------------------------

    def bases(self) -> Iterator[Basis]:
        """Yield the design, without friction, and the diagram with it; the diagram alone where it has none."""
        if self.smooth is None:
            yield Basis(self.base)
        else:
            yield Basis(self.smooth, lacks=TEXTS.line("without_friction"))
            yield Basis(self.base, FRICTION, is_design=False)

    def own_delay(self) -> int | None:
        """Return the samples of delay that the controller has: one where its computation is a unit delay."""
        own, kept = (of.blocks.get("controller.computation") for of in (self.diagram, self.base))
        if type(own) is type(kept):  # there is none, or it could not be taken out
            return super().own_delay()
        return 1 if isinstance(own, UnitDelay) else None

    @cached_property
    def base(self) -> WiredDiagram:
        """The diagram without its own delay, at rest."""
        return self._resting(self._without_delay())

    @cached_property
    def smooth(self) -> WiredDiagram | None:
        """The base without friction in plant and model; None where there is none, or it can't be taken out."""
        if self.plant_model is None:
            if self.plant is not None and set(NO_FRICTION) <= set(self.plant.description.variables):
                self.notes.append(TEXTS.line("friction_left_in"))
            return None
        changes: dict[str, Any] = {f"{PLANT}.start.{name}": 0.0 for name in NO_FRICTION}
        changes["controller.feedback_linearization.model"] = self.model.replace(**NO_FRICTION)
        found = self.base.replace(changes)
        return found if self._is_plant(self.plant_model.replace(**NO_FRICTION), found) else None

    @property
    def has_friction(self) -> bool:
        """Whether variants with and without the plant's friction differ."""
        return any(not variant.is_design for variant in self.variants.values())

    def _without_delay(self) -> WiredDiagram:
        """Return the diagram without its computational delay, as far as that is known."""
        if "controller.computation" not in self.diagram.blocks:
            return self.diagram
        try:
            return self.diagram.replace({"controller.computation": Gain(gain=1.0, name="computation")})
        except LoopwrightError as error:
            self.notes.append(TEXTS.line("own_delay", problem=error.message))
            return self.diagram

    def _resting(self, base: WiredDiagram) -> WiredDiagram:
        """Return the diagram at rest where its references begin, where it starts elsewhere and no point was given."""
        if self.point is not None:
            return base
        here = Variant("", "", base, None, Implementation.SAMPLED)
        if here.rests:
            return base
        try:
            first = [float(np.ravel(here.point.values[f"{name}.y"])[0]) for name in REFERENCES]
            found = base.replace(self._placed(*first))
        except (LoopwrightError, KeyError):
            return base
        if not Variant("", "", found, None, Implementation.SAMPLED).rests:
            return base
        self.notes.append(TEXTS.line("starts_elsewhere", eta=first[0], xi=first[1]))
        return found

    def _placed(self, eta: float, xi: float) -> dict[str, Any]:
        """Return the change of the diagram that starts its plant at a point off the path, η and ξ in m."""
        position = self.path.to_plane(eta, xi)
        start = {"position": position} if self.plant is None else self.plant.start_of("position", position, "m")
        return {f"{PLANT}.start.{name}": value for name, value in start.items()}

    # --- the plant ----------------------------------------------------------------------------------------------------

    @property
    def model(self) -> PlanarModel:
        """The model that the feedback linearization inverts."""
        return linearization_of(self.diagram).model

    @property
    def path(self) -> Path:
        """The path that is followed."""
        return linearization_of(self.diagram).path

    @property
    def plant(self) -> Fmu | None:
        """The plant; None where it is no FMU."""
        block = self.diagram.blocks.get(PLANT)
        return block if isinstance(block, Fmu) else None

    @property
    def has_events(self) -> bool:
        """Whether the plant has discrete states, such as contact."""
        return PLANT in self.diagram.blocks and is_discrete(self.diagram, PLANT)

    @cached_property
    def plant_model(self) -> Gantry | None:
        """The plant as the model that the admittance is reduced with, None where it is not shown to be such a gantry.

        Names of parameters promise nothing: the plant's own linear model is compared with the model that they make.
        """
        if self.plant is None or not isinstance(self.model, Gantry):
            return None
        variables = self.plant.description.variables
        if not {"coulomb_friction", "translational_mass", "equivalent_mass", "coulomb_scale"} <= set(variables):
            return None
        names = [n for n in self.model.parameter_specs if n in variables and not n.startswith("start_")]
        values = {n: self.plant.start.get(n, variables[n].start) for n in names}
        try:
            found = self.model.replace(**{n: v for n, v in values.items() if v is not None})
            point = point_of(self.base, self.point, self.diagram)
        except LoopwrightError:
            return None
        return found if self._is_plant(found, self.base, point) else None

    def _is_plant(self, model: Gantry, diagram: WiredDiagram, point: OperatingPoint | None = None) -> bool:
        """Return whether the plant of a variant is shown to be a model, where and as fast as it is."""
        pids = [cast(ErrorDynamics, self.diagram.blocks[f"controller.pid_{side}"]) for side in SIDES]
        try:
            check_plant(diagram, PLANT, model, rate=min(map(control_rate, pids)), point=point)
        except LoopwrightError:
            return False
        return True

    @cached_property
    def reduced(self) -> ReducedLoops | LoopwrightError | None:
        """The reduced loops, or the error why there are none; None without both admittances, or an analysed variant."""
        where = next(self.designs(Implementation.CONTINUOUS, Implementation.SAMPLED), None)
        if where is None or any(f"controller.admittance_{side}" not in self.diagram.blocks for side in SIDES):
            return None
        try:
            return ReducedLoops.of(self.base, self.smooth, self.plant_model, self.path, self._base_point(where))
        except LoopwrightError as error:
            return error

    def _base_point(self, where: Variant) -> OperatingPoint:
        """Return the operating point of a variant as one of the base; one without clocks has other states."""
        try:
            where.point.check_fits(self.base.flatten_like(where.point), self.base.name)
        except OptionError:
            return point_of(self.base, where.point, where.diagram)
        return where.point

    # --- where it is looked at ----------------------------------------------------------------------------------------

    def named_wires(self) -> Mapping[str, str]:
        """Return the virtual inputs."""
        return {side: f"controller.{name}" for side, name in SIDES.items()}

    def sensitivity_wires(self) -> dict[str, str]:
        """Return the virtual inputs, and both motor forces at once, whose margin is the weakest."""
        return {**self.loop_wires(), "motor_force": "motor_force"}

    def extra_loops(self) -> tuple[str, ...]:
        """Return the loop at both motor forces."""
        return ("motor_force",)

    def excitation(self, variant: Variant, wire: str) -> InjectionPlan:
        """Return the test signal, for a variant whose references are held, so that it stays where it is."""
        if variant not in self._held:
            self._held[variant] = self._hold_references(variant)
        plan = InjectionPlan(self._held[variant], FREQUENCIES, AMPLITUDE)
        asks_plants = bool(variant.diagram.flatten_like(variant.point).in_model_exchange)
        return plan.shortened(IN_MODEL_EXCHANGE) if asks_plants else plan

    @cached_property
    def _held(self) -> WeakKeyDictionary[Variant, Variant]:
        return WeakKeyDictionary()

    def _hold_references(self, variant: Variant) -> Variant:
        changes: dict[str, Any] = {
            path: Constant(value=0.0, unit=block.unit, name=path)
            for path, block in variant.diagram.blocks.items()
            if path in DISTURBANCES and isinstance(block, Step)
        }
        for name in REFERENCES:
            if f"{name}.y" in variant.point.values:
                changes[name] = Reference(float(np.ravel(variant.point.values[f"{name}.y"])[0]), unit="m", name=name)
        return variant.with_parameters(changes)

    @cached_property
    def _elsewhere(self) -> WeakKeyDictionary[Variant, dict[tuple[float, float], Variant | None]]:
        return WeakKeyDictionary()

    def at(self, variant: Variant, eta: float, xi: float) -> Variant | None:
        """Return a variant at rest at another point off the path, made once; None where it is not at rest there."""
        known = self._elsewhere.setdefault(variant, {})
        if (eta, xi) not in known:
            changes = self._placed(eta, xi)
            for name, value in zip(REFERENCES, (eta, xi), strict=True):
                changes[name] = Reference(value, unit="m", name=name)
            try:
                found = variant.with_parameters(changes, 0.0)
            except LoopwrightError:
                known[eta, xi] = None
            else:
                known[eta, xi] = found if found.rests else None
        return known[eta, xi]

    def name_place(self, place: str) -> str:
        """Return the name of a point off the path, by its part of dotted paths."""
        found = {key: f"η = {1000 * eta:.0f} mm, ξ = {1000 * xi:.0f} mm" for key, eta, xi in self.places()}
        return found.get(place) or super().name_place(place)

    def places(self) -> list[tuple[str, float, float]]:
        """Return points off the path, η and ξ in m, with the names they have in dotted paths."""
        length = self.path.length
        made = []
        for share, xi in ((0.0, 0.0), (0.0, -0.02), (0.15, 0.0), (0.15, 0.02), (0.35, -0.02), (0.35, 0.0)):
            eta = round(share * length, 3)
            made.append((f"eta_{1000 * eta:.0f}mm_xi_{1000 * xi:.0f}mm", eta, xi))
        return made
