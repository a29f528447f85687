"""Contact of an environment with the plant of a diagram: admittance, passivity and limits of coupled stability."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ...blocks import AdmittanceFilter, ForceProjection, PathProjection
from ...blocks.core import Array, Finding, OptionError, UnknownNameError, accepts, brief, explain_calls, kinds
from ...fmus.fmu_block import Derivation
from ..linearization import check_options, operating_point
from .admittance import ContactAdmittance, compute_admittance
from .contact_loop import close_loop, join_environment
from .contact_ports import PortNames, Ports
from .coupled_parts import take_apart
from .environment import (
    A_FREQUENCY,
    check_properties,
    check_property,
    points_in_a_decade,
    read_row,
)
from .passivity import CONTINUOUS, HIGHEST, LOWEST, OFF_PATH, PERIODIC, SAMPLED, Passivity, find_negative
from .port_passivity import find_passivity
from .stability_limits import PER_DECADE, ContactLimit, ContactMap, find_limit, map_growth, read_scan
from .touched_plant import TouchedPlant

if TYPE_CHECKING:
    from ..flat import WiredDiagram
    from ..linearization import PointLike
    from ..results import OperatingPoint
    from .confirmed_limits import ContactConfirmation, TrialMethod


SIDES = ("par", "perp")
"""Directions of a path: along it and across it."""


@explain_calls
@dataclass(frozen=True, eq=False)
class Contact(TouchedPlant):
    """A point of a diagram's plant that an environment touches, linear at an operating point; `Diagram.contact`.

    The environment is a spring k_e, a damper b_e and a mass m_e along ``direction``; a tool of the mass ``tool_mass``
    lies beyond the force sensor. The plant runs in continuous time with them.

    Attributes
    ----------
    diagram : Diagram
        Diagram of the contact.
    plant : str
        Path of the plant.
    direction : ndarray
        Unit vector, in the axes of the force.
    side : str
        ``"par"`` or ``"perp"`` if the direction was given so, else "".
    sample_time : float
        Sample time of the controller in s, the common period of several rates; 0 if the diagram is continuous.
    point : OperatingPoint
        Operating point of the linear model.
    derivation : Derivation
        Method by which the plant was differentiated.
    findings : tuple of Finding
        Kinks, stairs and flat slopes that the linear model leaves out.
    """

    side: str
    filter: AdmittanceFilter | None = field(repr=False)
    scale: float
    measured: str | None = field(repr=False)

    def __repr__(self) -> str:
        along = self.side or "[" + ", ".join(f"{v:.4g}" for v in self.direction) + "]"
        facts = (
            f"plant {self.plant}",
            f"direction {along}",
            f"T = {self.sample_time:g} s" if self.sample_time else "continuous",
        )
        then = ".stability_limit(), .admittance(omega), .passivity()"
        return brief(f"contact of {self.wired.name!r}", *facts, then=then)

    @property
    def diagram(self) -> Any:
        """The `Diagram` of the contact."""
        return self.wired.facade

    @property
    def derivation(self) -> Derivation:
        """Method by which the plant was differentiated."""
        return self.parts.derivation

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Kinks, stairs and flat slopes that the linear model leaves out."""
        return self.parts.findings

    @accepts(None, omega=kinds.numbers.worded("frequencies in rad/s", "Give numbers."))
    def admittance(self, omega: Array) -> ContactAdmittance:
        """Return the admittance that the environment feels in addition to that of the diagram's filter, m/(N s).

        Parameters
        ----------
        omega : float or array
            Frequencies in rad/s; those of a sampled loop lie below the Nyquist frequency π/T. In several rates T is
            the shortest time between ticks here, and the admittance is the velocity's part at the force's frequency.

        Raises
        ------
        OptionError
            If a frequency is no number, not positive, or not below the Nyquist frequency.
        """
        w = np.asarray(omega, dtype=float)
        target = None
        if self.filter is not None:
            s, a = 1j * w, self.filter
            target = self.scale * s / (a.mass * s * s + float(a.effective_damping) * s + a.stiffness)
        return ContactAdmittance(w, compute_admittance(self.parts, self.direction, w), target, self.findings)

    def passivity(self, *, low: float = LOWEST, high: float | None = None, per_decade: int = 200) -> Passivity:
        """Return the frequencies at which the real part of the admittance is negative.

        Parameters
        ----------
        low, high : float, optional
            Ends of the scan, rad/s; by default 0.01 rad/s and the Nyquist frequency, or 1e5 rad/s in a continuous loop.
        per_decade : int, optional
            Points of the scan in a decade.

        Raises
        ------
        OptionError
            If an end of the scan is not positive, or not below the Nyquist frequency.
        """
        sign = find_sign(self, low=low, high=high, per_decade=per_decade)
        return replace(sign, port=find_passivity(self.parts, self.direction, stable=sign.stable))

    def stability_limit(
        self,
        vary: str = "stiffness",
        *,
        low: float | None = None,
        high: float | None = None,
        per_decade: int = PER_DECADE,
        **environment: float,
    ) -> ContactLimit:
        """Return the first value of one property of the environment at which the coupled loop loses its stability.

        Parameters
        ----------
        vary : {"stiffness", "damping", "mass", "tool_mass"}
            Property, in N/m, N s/m or kg.
        low, high : float, optional
            Ends of the scan.
        per_decade : int, optional
            Points of the scan in a decade, at least 30.
        **environment
            Properties that are held: ``stiffness``, ``damping``, ``mass`` (0 without them), and ``tool_mass``, the
            whole mass beyond the force sensor, which is the diagram's own without it.

        Raises
        ------
        OptionError, ParameterError
            If a property is unknown, negative or given twice, or the scan does not rise or is too coarse.
        ConfirmationError
            If python-control's interconnection of the same parts disagrees.
        """
        held = check_properties(environment, vary)
        return find_limit(self.parts, self.direction, vary, held, read_scan(vary, low, high, per_decade))

    def confirm(
        self, limit: ContactLimit, *, push: float = 1e-6, method: TrialMethod | str | None = None
    ) -> ContactConfirmation:
        """Run the nonlinear diagram at 0.97 and at 1.03 of a limit, with the environment at the plant.

        The controller is the diagram's. The growth rate of the mode is measured, and compared with the linear loop's.
        The result's ``method`` says where the environment is:

        - "inside": in the equations of a plant of the library, in its own FMU or block.
        - "solver": next to another plant with equations, or next to an FMU in model exchange. The solver
          integrates both.
        - "held": next to an FMU that has co-simulation alone. It gets the force ten times in each tick, and holds it
          between. That loop has another limit; the runs are next to that one (``tried``), and compared with its own
          linear model. This confirms the models of plant and controller, and the limit only as far as the two agree.

        Runs begin at the contact's operating point, with all sources held at their values there.

        Parameters
        ----------
        limit : ContactLimit
            Of `stability_limit`, finite and not 0.
        push : float
            Velocity in m/s with which the contact is set in motion; so small that friction and limits are linear.
        method : {"inside", "solver", "held"}, optional
            Place of the environment; the first that is possible without it.

        Returns
        -------
        ContactConfirmation
            Both growth rates, measured and predicted, and the amplitude that they hold for.

        Raises
        ------
        OptionError
            If the limit is infinite or 0, or of another contact, or the plant does not allow the method.
        ConfirmationError
            If the runs contradict the limit.
        """
        from .confirmed_limits import confirm_limit

        return confirm_limit(self, limit, push, method)

    def stability_map(
        self, x_values: Array, y_values: Array, *, x: str = "stiffness", y: str = "damping", **environment: float
    ) -> ContactMap:
        """Return the growth rate over two properties of the environment, and the limit of x at each value of y.

        Parameters
        ----------
        x_values, y_values : array
            Values of the two properties; those of x positive and rising.
        x, y : str, optional
            Properties.
        **environment
            Other properties, as `stability_limit` takes them.

        Raises
        ------
        OptionError, ParameterError
            If a property is unknown, negative or given twice, or values are not a row.
        ConfirmationError
            If python-control's interconnection of the same parts disagrees with a limit.
        """
        held = check_properties(environment, check_property(x, "x"))
        across = read_row(x_values, x, rising=True)
        check_properties({**environment, x: across.tolist()[0]}, check_property(y, "y"))
        up = read_row(y_values, y, rising=False)
        return map_growth(self.parts, self.direction, (x, across), (y, up), held)


@accepts(None, low=A_FREQUENCY, high=A_FREQUENCY, per_decade=points_in_a_decade(1))
def find_sign(contact: Contact, *, low: float, high: float | None = None, per_decade: int) -> Passivity:
    """Return the frequencies at which the real part of an admittance is negative; see `Contact.passivity`."""
    T = contact.parts.shortest
    nyquist = math.pi / T if T else math.inf
    top = (nyquist * (1.0 - 1e-9) if T else HIGHEST) if high is None else float(high)
    low, per_decade = float(low), int(per_decade)
    if not low < top < nyquist:
        raise OptionError(
            f"found a scan from {low:g} to {top:g} rad/s; expected it to rise"
            f"{f', below the Nyquist frequency {nyquist:.6g} rad/s' if T else ''}. Give other ends.",
            port="low",
        )
    intervals = find_negative(lambda w: compute_admittance(contact.parts, contact.direction, w), low, top, per_decade)
    poles = np.linalg.eigvals(close_loop(contact.parts, join_environment(contact.parts, contact.direction)).A)
    stable = bool(np.all(np.abs(poles) <= 1.0 + 1e-6) if T else np.all(poles.real <= 1e-4))
    off_path = contact.side == "par" and abs(contact.scale - 1.0) > 1e-9
    return Passivity(
        frequency=intervals[0][0] if intervals else math.inf,
        intervals=intervals,
        scanned=(low, top),
        stable=stable,
        caveat=(SAMPLED if T else CONTINUOUS)
        + (PERIODIC if contact.parts.ticks else "")
        + (OFF_PATH if off_path else ""),
        findings=contact.findings,
    )


def make_contact(
    diagram: WiredDiagram,
    names: PortNames,
    direction: str | Sequence[float] | np.ndarray,
    at: PointLike,
    options: Mapping[str, Any],
) -> Contact:
    """Return the contact of a diagram; see `Diagram.contact`."""
    force = names.force
    taken = {name: options[name] for name in ("stairs", "step") if name in options}
    options = {name: value for name, value in options.items() if name != "stairs"}
    check_options(options, "contact")
    point = operating_point(diagram, at, options)
    diagram = diagram.replace(point.parameters) if point.parameters else diagram  # parameters that a trim has found
    ports = Ports.find(diagram, diagram.flatten_like(point), names)
    parts, unusual = take_apart(diagram, ports, force, point, taken)
    if unusual:  # a block treats its first tick in another way; at rest, the next tick has the same states
        count = round(parts.sample_time / float(point.base))
        point = _move_on(point, count, float(point.base * count))
        parts, _ = take_apart(diagram, ports, force, point, taken)
    unit, side, scale = _find_direction(diagram, point, ports, direction, parts.force.shape[1])
    return Contact(
        diagram, ports, unit, point, parts, side, _find_filter(diagram, side, len(unit)), scale, measured=force
    )


def _move_on(point: OperatingPoint, count: int, h: float) -> OperatingPoint:
    """Return the operating point some ticks and seconds later, of a diagram that rests."""
    plants = {path: {**plant, "t": plant["t"] + h} for path, plant in point.plants.items()}
    return replace(point, t=point.t + h, tick=point.tick + count, plants=plants)


def _find_direction(
    diagram: WiredDiagram, point: OperatingPoint, ports: Ports, direction: Any, many: int
) -> tuple[np.ndarray, str, float]:
    """Return the unit vector, its side, and the metres of motion per unit of the path's coordinate."""
    where: dict[str, Any] = {"block": ports.plant, "port": "direction"}
    if isinstance(direction, str):
        if direction not in SIDES:
            raise OptionError(f"found {direction!r}; expected 'par', 'perp' or a vector. Give one of them.", **where)
        found = [(path, block) for path, block in diagram.blocks.items() if isinstance(block, PathProjection)]
        if len(found) != 1 or many != 2:
            raise UnknownNameError(
                f"found {len(found)} projections onto a path and a force with {many} entries; expected one, and two "
                f"entries, for {direction!r}. Give a vector in the axes of the force: direction=(1.0, 0.0).",
                **where,
            )
        path, block = found[0]
        frame = block.path.frame(float(np.ravel(point.values[f"{path}.theta"])[0]))
        if direction == "perp":
            return np.asarray(frame.normal, dtype=float), direction, 1.0
        place = np.asarray(point.values[f"{ports.plant}.{ports.position}"], dtype=float)
        q = 1.0 - float(frame.curvature) * float(frame.normal @ (place - frame.sigma))
        return np.asarray(frame.tangent, dtype=float), direction, q
    vector = np.atleast_1d(np.asarray(direction, dtype=float)) if kinds.numbers.holds(direction) else np.zeros(0)
    length = float(np.linalg.norm(vector))
    if vector.shape != (many,) or not 0.0 < length < math.inf:
        raise OptionError(
            f"found {direction!r}; expected a vector of {many} finite entries that is not zero. Give one in the axes "
            "of the force.",
            **where,
        )
    return vector / length, "", 1.0


def _find_filter(diagram: WiredDiagram, side: str, many: int) -> AdmittanceFilter | None:
    """Return the admittance filter of the force's part in a direction, or the only one of a scalar force."""
    filters = [path for path, block in diagram.blocks.items() if isinstance(block, AdmittanceFilter)]
    wires = diagram.structure.wires
    if side:
        filters = [
            path
            for path in filters
            if (wire := wires.get((path, "force"))) is not None
            and isinstance(diagram.blocks[wire.block], ForceProjection)
            and wire.port == f"f_{side}"
        ]
    elif many != 1:
        return None
    return cast(AdmittanceFilter, diagram.blocks[filters[0]]) if len(filters) == 1 else None
