"""Experiments A to D of the paper, with every profile fixed (docs/experiments.md).

>>> from loopwright.diagrams import experiments
>>> experiments.path_following(delay=1).options["delay"]
1
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path as File
from types import MappingProxyType
from typing import Any

import numpy as np

from ..blocks import (
    AdmittanceFilter,
    Ellipse,
    HandForce,
    OptionError,
    Path,
    PathSpring,
    Pulse,
    Reference,
    Sine,
    SmoothStep,
    Step,
)
from ..blocks._errors import near
from ..fmus import Fmu, gantry
from ._diagram import Diagram
from ._run import Run
from .fig3 import IMPEDANCE_PAR, IMPEDANCE_PERP, Channel, Rig, fig3

ELLIPSE = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
"""The path of the experiments, equation (16)."""


@dataclass(frozen=True)
class Experiment:
    """An experiment, ready to run.

    Attributes
    ----------
    letter, title : str
        The paper's letter and a title.
    diagram : Diagram
        The diagram, options applied.
    duration : float
        Seconds.
    options : mapping
        Every option with its value.
    path : Path
        The path that is followed.
    """

    letter: str
    title: str
    diagram: Diagram
    duration: float
    options: Mapping[str, Any]
    path: Path

    def simulate(self, **run_options: Any) -> Run:
        """Run it to its end.

        Parameters
        ----------
        **run_options
            What concerns the run alone: ``progress`` and ``step`` of `Diagram.simulate`.

        Raises
        ------
        OptionError
            For an option that does not concern the run.
        SimulationError
            As in `Diagram.simulate`.
        """
        for name in run_options:
            if name not in ("progress", "step"):
                hint = "Give it to the experiment." if name in DEFAULTS else near(name, ("progress", "step"))
                raise OptionError(f"it is no option of a run. {hint}", block=self.letter, port=name)
        return self.diagram.simulate(self.duration, **run_options)


DEFAULTS: Mapping[str, Any] = MappingProxyType(
    {
        "plant": None,
        "path": ELLIPSE,
        "sample_time": 1e-3,
        "coulomb_scale": 1.0,
        "viscous_scale": 1.0,
        "friction_width": 0.01,
        "tool_mass": 0.0,
        "encoder": 0.0,
        "delay": 0,
        "motor_force_limit": None,
        "velocity_limit": None,
        "acceleration_limit": None,
        "admittance_method": "exact",
    }
)
"""Options of every experiment, with their defaults.

``plant``: path of an FMU, or an `Fmu`, in place of the gantry. ``coulomb_scale``, ``viscous_scale``: factors on the
plant's friction only. ``friction_width``: w of plant and model, m/s. ``tool_mass``: kg beyond the force sensor.
``encoder``: quantum in m. ``delay``: 0 or 1 samples. ``motor_force_limit``: N, a number or one for each axis.
``velocity_limit``, ``acceleration_limit``: of the path reference, m/s and m/s², a number or one for each direction
(∥, ⊥); experiments with admittance only. ``sample_time``: s. ``admittance_method``: ``exact`` or ``semi_implicit``.
"""


def _gantry() -> File:
    return gantry.build()


def _internal_step(width: float) -> float:
    """Return a step that resolves the friction's sign change: its rate is F_c/(M w), w its width."""
    return float(gantry.INTERNAL_STEP * min(1.0, width / DEFAULTS["friction_width"]))


def _options(letter: str, given: Mapping[str, Any], **own: Any) -> dict[str, Any]:
    """Merge options with their defaults and check them."""
    known = {**DEFAULTS, **own}
    for name in given:
        if name not in known:
            raise OptionError(f"experiment {letter} has no option {name!r}. {near(name, known)}", port=name)
    options = {**known, **given}

    def refuse(name: str, expected: str) -> None:
        raise OptionError(f"found {options[name]!r}; expected {expected}.", block=f"experiment {letter}", port=name)

    for name in ("sample_time", "friction_width"):
        if not _is_number(options[name]) or options[name] <= 0:
            refuse(name, "a positive number")
    for name in ("coulomb_scale", "viscous_scale", "tool_mass", "encoder"):
        if not _is_number(options[name]) or options[name] < 0:
            refuse(name, "a number that is not negative")
    for name in ("motor_force_limit", "velocity_limit", "acceleration_limit"):
        value = options[name]
        if value is not None:
            values = np.atleast_1d(value) if np.ndim(value) or _is_number(value) else np.zeros(1)
            if values.dtype.kind not in "fi" or values.size not in (1, 2) or not np.all(values > 0):
                refuse(name, "a positive number, a pair of them, or None")
    if options["delay"] not in (0, 1) or isinstance(options["delay"], bool):
        refuse("delay", "0 or 1 samples")
    if options["admittance_method"] not in ("exact", "semi_implicit"):
        refuse("admittance_method", "'exact' or 'semi_implicit'")
    if not isinstance(options["path"], Path):
        refuse("path", "a path, such as Ellipse(…)")
    return options


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool) and bool(np.isfinite(value))


def _admittance(options: Mapping[str, Any], side: int, **impedance: Any) -> AdmittanceFilter:
    limits: dict[str, Any] = {}
    for name in ("velocity_limit", "acceleration_limit"):
        if options[name] is not None:
            limits[name] = float(np.broadcast_to(np.asarray(options[name], dtype=float), (2,))[side])
    return AdmittanceFilter(**impedance, **limits)


def _build(
    letter: str,
    title: str,
    duration: float,
    options: dict[str, Any],
    start: tuple[float, float],
    par: Channel,
    perp: Channel,
    environment: Callable[[Any], Any] | None = None,
) -> Experiment:
    """Place the plant at its start, and wire Fig. 3."""
    path = options["path"]
    plant = options["plant"]
    if plant is None:
        plant = Fmu(_gantry(), name="plant")
    elif not isinstance(plant, Fmu):
        plant = Fmu(plant, name="plant")
    position = path.to_plane(*start)
    values = {"position": position}
    for name in ("coulomb_scale", "viscous_scale", "friction_width"):
        if options[name] != DEFAULTS[name] or name in plant.description.variables:
            values[name] = options[name]
    if options["plant"] is None:
        values["internal_step"] = _internal_step(options["friction_width"])
    plant = plant.replace(name="plant", start={**values, **plant.start} if options["plant"] is not None else values)
    rig = Rig(
        tool_mass=options["tool_mass"],
        encoder=options["encoder"],
        delay=options["delay"],
        motor_force_limit=options["motor_force_limit"],
        sample_time=options["sample_time"],
        admittance_method=options["admittance_method"],
    )
    model = gantry.nominal.replace(friction_width=options["friction_width"])
    diagram = fig3(plant, path, par, perp, environment=environment, model=model, rig=rig, name=title.split(":")[0])
    return Experiment(letter, title, diagram, duration, MappingProxyType(options), path)


def path_following(**options: Any) -> Experiment:
    """Return experiment A: path following without admittance.

    Starts at rest at η₁ = 0.10 m, ξ₁ = 0.01 m, off the references; then set-point changes along and across the path,
    one of them over the seam of the closed curve. 11 s.

    Parameters
    ----------
    **options
        See `DEFAULTS`.

    Raises
    ------
    OptionError
        For an unknown option, or one that is out of range.
    PathDomainError
        If the start is outside the domain of the path's coordinates.
    """
    o = _options("A", options)
    for name in ("velocity_limit", "acceleration_limit"):
        if o[name] is not None:
            raise OptionError(
                "experiment A has no admittance whose path reference could be limited; use B, C or D.",
                block="experiment A",
                port=name,
            )
    par = SmoothStep(levels=(0.12, 0.75, 1.60), start_times=(1.0, 5.5), durations=(2.0, 2.0), name="eta_d")
    perp = SmoothStep(
        levels=(0.0, -0.03, 0.03, 0.0), start_times=(4.0, 8.5, 9.5), durations=(0.5, 0.5, 0.5), name="xi_d"
    )
    return _build("A", "path_following: experiment A", 11.0, o, (0.10, 0.01), Channel(par), Channel(perp))


def compliance(*, smooth_reference: bool = False, **options: Any) -> Experiment:
    """Return experiment B: path following and compliance in free space, driven by set-points and desired forces.

    At 1 s a tangential set-point of 0.3 m, at 4 s F⊥^d = 5 N, at 7 s F∥^d = 2 N, at 11 s both change sign. 15 s.

    Parameters
    ----------
    smooth_reference : bool
        Give the change along the path as a smooth reference with its derivatives, 1 s long, instead of a set-point:
        it is then followed exactly, and the impedance does not show (E27).
    **options
        See `DEFAULTS`.

    Raises
    ------
    OptionError, PathDomainError
        As in `path_following`.
    """
    o = _options("B", {**options, "smooth_reference": smooth_reference}, smooth_reference=False)
    reference: Any = Reference(0.0, name="eta_d")
    offset: Any = Step(times=1.0, values=0.3, unit="m", name="set_point")
    if smooth_reference:
        reference, offset = SmoothStep(levels=(0.0, 0.3), start_times=(1.0,), durations=(1.0,), name="eta_d"), None
    par = Channel(
        reference,
        _admittance(o, 0, **IMPEDANCE_PAR),
        Step(times=(7.0, 11.0), values=(2.0, -2.0), unit="N", name="desired_force_par"),
        offset,
    )
    perp = Channel(
        Reference(0.0, name="xi_d"),
        _admittance(o, 1, **IMPEDANCE_PERP),
        Step(times=(4.0, 11.0), values=(5.0, -5.0), unit="N", name="desired_force_perp"),
    )
    return _build("B", "compliance: experiment B", 15.0, o, (0.0, 0.0), par, perp)


def hand_guiding(**options: Any) -> Experiment:
    """Return experiment C: a hand guides the robot, which is free along the path (k∥ = 0) and a spring across it. 12 s.

    Parameters
    ----------
    **options
        See `DEFAULTS`.

    Raises
    ------
    OptionError, PathDomainError
        As in `path_following`.
    """
    o = _options("C", options)
    f_par = (
        Pulse(start_time=0.5, end_time=1.5, amplitude=1.5)
        + Pulse(start_time=2.5, end_time=3.5, amplitude=-1.5)
        + Pulse(start_time=8.5, end_time=9.7, amplitude=1.5)
    )
    f_perp = (
        Pulse(start_time=0.5, end_time=4.5, amplitude=0.3) * Sine(frequency=1.0)
        + Pulse(start_time=5.0, end_time=6.0, amplitude=6.0)
        + Pulse(start_time=6.5, end_time=7.5, amplitude=-6.0)
        + Pulse(start_time=8.5, end_time=9.7, amplitude=-6.0)
    )
    par = Channel(
        Reference(0.2, name="eta_d"), _admittance(o, 0, mass=0.5, stiffness=0.0, damping=_damping(IMPEDANCE_PAR))
    )
    perp = Channel(Reference(0.0, name="xi_d"), _admittance(o, 1, **IMPEDANCE_PERP))
    path = o["path"]

    def hand(position: Any) -> Any:
        return HandForce(path, name="hand")(position, f_par=f_par, f_perp=f_perp)

    return _build("C", "hand_guiding: experiment C", 12.0, o, (0.2, 0.0), par, perp, hand)


def force_tracking(*, cubic: bool = False, **options: Any) -> Experiment:
    """Return experiment D: pressing with 5 N outwards against a spring along the path, while moving along it. 9 s.

    Parameters
    ----------
    cubic : bool
        Variant D′: a cubic spring with the same force at 5 mm.
    **options
        See `DEFAULTS`.

    Raises
    ------
    OptionError, PathDomainError
        As in `path_following`.
    """
    o = _options("D", {**options, "cubic": cubic}, cubic=False)
    par = Channel(
        SmoothStep(levels=(0.2, 1.0), start_times=(3.0,), durations=(3.0,), name="eta_d"),
        _admittance(o, 0, **IMPEDANCE_PAR),
    )
    perp = Channel(
        Reference(0.0, name="xi_d"),
        _admittance(o, 1, mass=2.0, stiffness=0.0, damping=_damping(IMPEDANCE_PERP)),
        Step(times=0.5, values=-5.0, unit="N", name="desired_force_perp"),
    )
    path = o["path"]
    law: dict[str, Any] = {"cubic_stiffness": 5.0 / 0.005**3} if cubic else {"stiffness": 1000.0}

    def spring(position: Any) -> Any:
        return PathSpring(path, **law, name="spring")(position)

    return _build("D", "force_tracking: experiment D", 9.0, o, (0.2, 0.0), par, perp, spring)


def _damping(impedance: Mapping[str, float]) -> float:
    """Return d = 2 ζ √(m k), (E7), which is kept when k is set to zero (E8)."""
    return 2.0 * impedance["damping_ratio"] * float(np.sqrt(impedance["mass"] * impedance["stiffness"]))


EXPERIMENTS: Mapping[str, Callable[..., Experiment]] = MappingProxyType(
    {"A": path_following, "B": compliance, "C": hand_guiding, "D": force_tracking}
)
"""The experiments by their letter."""
