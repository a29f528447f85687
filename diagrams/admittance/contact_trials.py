"""Runs of a diagram with an environment at its plant, and the growth rates that are predicted for them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ...blocks.core import ConfirmationError, OptionError, near
from ...fmus.running import Fmu
from ..linearization import PlantEquations, copy_point, find_signal, linearize, linearize_plant
from .attached_environment import attach_environment
from .contact_limits import ContactLimit, CoupledLoop, to_rates
from .contact_parts import ContactParts
from .contact_ports import Ports
from .moored_plant import Mooring, hold_sources, library_class, moored_diagram

if TYPE_CHECKING:
    from ..flat import WiredDiagram
    from ..results import OperatingPoint

STEP = 1e-3
"""Sample time in s of the run of a continuous diagram."""
START = 2.5
"""Ticks up to which an operating point is the start."""
PRECISE = 1e-6
"""Absolute tolerance of the solver, relative to the push."""
RTOL = 1e-8
"""Relative tolerance of the solver."""
AROUND = 0.3
"""Part of a limit's frequency within which the mode of another loop is looked for."""
ON_TICK = 1e-5
"""Part of a tick within which a sample is that of the tick."""
SEARCHES = 12
"""Most linear models of a loop with a held force."""
SAME = 1e-6
"""Relative error of the limit with a held force."""


class TrialMethod(Enum):
    """Place of the environment in a run."""

    INSIDE = "the environment inside the plant"
    """In the equations of a plant of the library, in its own FMU or block."""
    SOLVER = "the environment beside the plant, in the solver"
    """A block beside a plant with equations, or beside an FMU in model exchange."""
    HELD = "the environment's force held between communication points"
    """A block beside an FMU in co-simulation: the loop has another limit, and its own linear prediction."""


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
    def entry(self) -> str | None:
        """Wire to which the environment's force is added."""

    @property
    def sample_time(self) -> float:
        """Period of the controller in s."""

    @property
    def shortest(self) -> float:
        """Shortest time between its ticks in s."""

    def loop(self, vary: str, **environment: float) -> CoupledLoop:
        """Return the loop with an environment of which one property varies."""


@dataclass
class Trials:
    """Runs beside a limit, and predictions for them.

    Attributes
    ----------
    contact, limit
        As `Contact.confirm` takes them.
    method : TrialMethod
        Place of the environment.
    """

    contact: TriedContact
    limit: ContactLimit
    method: TrialMethod
    _still: WiredDiagram = field(repr=False)
    _model: PlantEquations | None = field(default=None, repr=False)
    _known: dict[float, np.ndarray] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, contact: TriedContact, limit: ContactLimit, method: TrialMethod | str | None) -> Trials:
        """Return the trials of a contact's limit.

        Raises
        ------
        OptionError
            If a method is unknown, or not possible with this plant.
        """
        chosen = _choose(contact, limit, method)
        model = None
        if chosen is not TrialMethod.INSIDE:
            model = linearize_plant(contact.diagram, contact.point, contact.plant)
        made = cls(contact, limit, chosen, hold_sources(contact.diagram, contact.point.values), model)
        stepped = contact.diagram.blocks[contact.plant].stepped and contact.sample_time > 0.0
        open_choice = method is None and chosen is TrialMethod.SOLVER and stepped
        if open_choice and made._diagram(limit.value, 0.0).loops == "solve":
            made.method = TrialMethod.HELD  # the FMU does not list its dependencies: each evaluation would be a loop
        return made

    def find_rates(self, value: float) -> np.ndarray:
        """Return the poles of the loop in 1/s that are predicted for a run."""
        if value not in self._known:
            if self.method is TrialMethod.HELD:
                made = self._diagram(value, 0.0)
                at = self._start(made) or 2.0 * self.contact.sample_time  # the first tick is its own
                model = linearize(made, at)
                self._known[value] = to_rates(replace(self.contact.parts, sample_time=model.dt), model.poles)
            else:
                loop = self.contact.loop(self.limit.vary, **self.limit.environment)
                A = loop.modes.reduce(loop.close(value).A)
                self._known[value] = to_rates(self.contact.parts, np.linalg.eigvals(A))
        return self._known[value]

    def find_mode(self, value: float) -> complex:
        """Return the pole, in 1/s, of the mode that the limit is about."""
        rates, omega = self.find_rates(value), self._fold(self.limit.frequency)
        away = np.abs(np.abs(rates.imag) - omega)
        if self.method is TrialMethod.HELD:
            close = np.flatnonzero(away <= max(AROUND * omega, 1.0))
            if not len(close):
                raise ConfirmationError(
                    f"found no mode near {omega:.4g} rad/s, at which {self.limit.vary} {self.limit.value:.6g} "
                    f"{self.limit.unit} breaks the loop, where the force is held; expected one within {AROUND:.0%}. "
                    "Take an FMU with model exchange.",
                    block=self.contact.plant,
                )
            return complex(rates[close[int(np.argmax(rates[close].real))]])
        return complex(rates[int(np.argmin(away - 1e-3 * rates.real))])

    def find_frequency(self, mode: complex) -> float:
        """Return the frequency of a mode in rad/s: of its aliases the one next to the limit's."""
        T = self.contact.sample_time
        if not T:
            return abs(mode.imag)
        turn, near = 2.0 * np.pi / T, self.limit.frequency
        found = [sign * abs(mode.imag) + turn * round((near - sign * abs(mode.imag)) / turn) for sign in (1, -1)]
        return float(min(found, key=lambda omega: abs(omega - near)))

    def _fold(self, omega: float) -> float:
        """Return the alias of a frequency of which a pole over the period tells, rad/s."""
        T = self.contact.sample_time
        return min(omega % (2.0 * np.pi / T), -omega % (2.0 * np.pi / T)) if T else omega

    def find_own_limit(self) -> float:
        """Return the limit that runs are tried beside: of a loop with a held force, that of its own linear model."""
        if self.method is not TrialMethod.HELD:
            return self.limit.value
        x = [0.97 * self.limit.value, self.limit.value]
        y = [self.find_mode(v).real for v in x]
        for _ in range(SEARCHES):
            if y[-1] == y[-2]:
                break
            step = -y[-1] * (x[-1] - x[-2]) / (y[-1] - y[-2])
            x.append(x[-1] + max(-0.5 * x[-1], min(x[-1], step)))  # no farther than to half, or to twice
            y.append(self.find_mode(x[-1]).real)
            if abs(x[-1] - x[-2]) <= SAME * x[-1]:
                return x[-1]
        raise ConfirmationError(
            f"found no limit of the loop with a held force near {self.limit.vary} {self.limit.value:.6g} "
            f"{self.limit.unit}; expected one, whose runs could be compared. Take an FMU with model exchange.",
            block=self.contact.plant,
        )

    def run(self, value: float, push: float, duration: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Return times, the velocity along the mode's direction, and the largest speed."""
        contact = self.contact
        step = contact.shortest or STEP
        made: Any = self._diagram(value, push)
        options: dict[str, Any] = {} if made.has_clock else {"step": step}
        if self.method is TrialMethod.SOLVER:
            options |= {"rtol": RTOL, "atol": PRECISE * push}
        t0 = contact.point.t if self._is_away else 0.0
        if self._is_away:
            options["start"] = self._start(made)
        name = f"{contact.plant}.{contact.ports.velocity}"
        run = made.simulate(duration + 4 * step, progress=False, record=[name], states=False, **options)
        t = np.asarray(run.t) - t0
        count = np.round(t / step)
        ticks = np.flatnonzero(np.abs(t / step - count) <= ON_TICK)
        rows = ticks[np.unique(count[ticks].astype(int), return_index=True)[1]]
        velocity = np.asarray(run[name])[rows].reshape(len(rows), -1)
        along = np.asarray(self.limit.direction or contact.direction)
        return t[rows], velocity @ along, float(np.max(np.linalg.norm(velocity, axis=1)))

    @property
    def _is_away(self) -> bool:
        """Whether the operating point is not the diagram's start."""
        return self.contact.point.t > START * float(self.contact.point.base)

    def _start(self, made: WiredDiagram) -> OperatingPoint | None:
        """Return the operating point of a diagram with an environment; None for the start."""
        return copy_point(self.contact.diagram, self.contact.point, made) if self._is_away else None

    def _diagram(self, value: float, push: float) -> WiredDiagram:
        """Return the diagram with the environment."""
        contact, still = self.contact, self._still
        environment = {**self.limit.environment, self.limit.vary: value}
        mass = environment.pop("tool_mass", None)
        tool = None if mass is None else self._on_sensor(float(mass))
        d = contact.direction
        mobility = float(d @ contact.parts.velocity @ contact.parts.force @ d)
        step = contact.sample_time or STEP
        begin = contact.point.t if self._is_away else 0.0
        mooring = Mooring(
            d, np.asarray(contact.point.values[f"{contact.plant}.{contact.ports.position}"], dtype=float),
            **{name: float(v) for name, v in environment.items()},
            kick=push / (mobility * step), kick_time=begin + step, kick_start=begin,
        )  # fmt: skip
        source = find_signal(still.flatten_like(contact.point), contact.entry) if contact.entry else None
        if self.method is TrialMethod.INSIDE:
            ports = (contact.ports.force, contact.ports.position, contact.ports.velocity)
            return moored_diagram(still, contact.plant, ports, source, mooring, tool)
        assert self._model is not None
        tick = Fraction(contact.point.base) if contact.sample_time else None
        held = self.method is TrialMethod.HELD
        return attach_environment(still, contact.ports, self._model, source, mooring, tool, tick, held=held)

    def _on_sensor(self, mass: float) -> dict[str, float]:
        """Return a tool by the path of the contact's force sensor."""
        sensor = self.contact.parts.tool.sensor
        if sensor is None:
            raise OptionError(
                "found no ForceSensor on the way of the measured force; a run with another tool mass needs one, whose "
                "measured force leaves out the tool's inertia. Put one there, or take a limit of stiffness, damping "
                "or mass.",
                block=self.contact.plant,
                port="tool_mass",
            )
        return {sensor: mass}


def _choose(contact: TriedContact, limit: ContactLimit, method: TrialMethod | str | None) -> TrialMethod:
    """Return the place of the environment: the one that is asked for, or the first that is possible."""
    block = contact.diagram.blocks[contact.plant]
    has_mass = limit.vary == "mass" or limit.environment.get("mass", 0.0) > 0.0
    equations = not block.stepped or (isinstance(block, Fmu) and block.description.model_exchange is not None)
    possible = []
    if (
        library_class(block) is not None
        and contact.direction.shape == (2,)
        and (contact.sample_time > 0.0 if block.stepped else not (has_mass or isinstance(block, Fmu)))
    ):
        # but where the environment's force would act in a circle through the tick: that of a mass, or any that an FMU
        # in model exchange states to depend on its inputs, as the environment inside may have a mass
        possible.append(TrialMethod.INSIDE)
    if equations:
        possible.append(TrialMethod.SOLVER)
    if block.stepped and contact.sample_time > 0.0:
        # a mass makes an algebraic loop through an FMU in model exchange, which costs a hundred times as much
        possible.insert(len(possible) - (equations and has_mass), TrialMethod.HELD)
    names = {one.name.lower(): one for one in TrialMethod}
    asked = names.get(method) if isinstance(method, str) else method
    if method is not None and not isinstance(asked, TrialMethod):
        raise OptionError(f"found {method!r}. {near(str(method), names)}", block=contact.plant, port="method")
    if asked is not None and asked not in possible:
        raise OptionError(
            f"found {asked.name.lower()!r}, which this plant does not allow; expected one of "
            f"{', '.join(one.name.lower() for one in possible) or 'none'}. Leave it out.",
            block=contact.plant,
            port="method",
        )
    if not possible:
        raise OptionError(
            "found a continuous diagram around an FMU without model exchange, which exchanges signals with it at the "
            "ends of steps alone; expected one that can be run as its limit is computed. Confirm a sampled one: "
            "diagram.sampled(1e-3).",
            block=contact.plant,
        )
    return asked or possible[0]
