"""Experiments A to D of the paper, with every profile fixed (docs/reference/experiments.md).

>>> from loopwright import experiments
>>> experiments.path_following(delay=1).options["delay"]
1
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from ...blocks import (
    AdmittanceFilter,
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
from ...blocks.core import Grid, Sheet, ShownAsTable, brief, explain_calls
from ...fmus import Fmu
from ...fmus.models import gantry
from ..diagram import Diagram
from ..results import Run
from ..simulation import ProgressOption, RunKeywords, RunOptions, simulate
from .experiment_options import DEFAULTS, ELLIPSE, merge
from .fig3_diagram import fig3
from .fig3_wires import IMPEDANCE_PAR, IMPEDANCE_PERP, Channel, Rig, check_plant
from .hand_scene import pull_by_hand

if TYPE_CHECKING:
    from ..sweeps import Sweep
    from ..web_page import WebPage

__all__ = [
    "DEFAULTS",
    "ELLIPSE",
    "EXPERIMENTS",
    "Experiment",
    "compliance",
    "force_tracking",
    "guided_by_hand",
    "hand_guiding",
    "hand_page",
    "path_following",
]


@explain_calls
@dataclass(frozen=True)
class Experiment(ShownAsTable):
    """An experiment, ready to run; it can be pickled.

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

    def __repr__(self) -> str:
        return brief(
            f"{self.title!r}", f"{self.duration:g} s", repr(self.diagram), then=".simulate(), .diagram, .options"
        )

    def _sheet(self) -> Sheet:
        rows = ((name, value, str(value) == str(DEFAULTS.get(name))) for name, value in self.options.items())
        return Sheet(
            self.title,
            (("duration", f"{self.duration:g} s"), ("diagram", repr(self.diagram)), ("path", repr(self.path))),
            (Grid("Options", ("option", "value", "default"), tuple(rows)),),
        )

    def __post_init__(self) -> None:
        object.__setattr__(self, "options", MappingProxyType(dict(self.options)))

    def __reduce__(self) -> tuple[Any, ...]:
        return Experiment, (self.letter, self.title, self.diagram, self.duration, dict(self.options), self.path)

    def simulate(self, *, progress: ProgressOption = None, **options: Unpack[RunKeywords]) -> Run:
        """Run it to its end.

        Parameters
        ----------
        progress : bool or callable, optional
            Show a progress bar, or a function that is called with the time; see `Diagram.simulate`.
        **options
            Options of the run, such as ``record`` and ``every``; see `RunOptions`.

        Raises
        ------
        OptionError
            For an option that does not concern the run.
        SimulationError
            As in `Diagram.simulate`.
        """
        self._refuse_own(options)
        return simulate(self.diagram.wired, self.duration, RunOptions.of(options, block=self.letter), progress=progress)

    def sweep(self, parameters: Mapping[str, Any] | None, **options: Any) -> Sweep:
        """Run it to its end with many values of parameters; see `Diagram.sweep`.

        Parameters
        ----------
        parameters : mapping or None
            Values or ranges by dotted path; None with a table.
        **options
            Options of the sweep, such as ``reduce`` and ``samples``, and of its runs.

        Raises
        ------
        OptionError, UnknownNameError
            As in `Diagram.sweep`; an option of the experiment, which is given to that.
        """
        self._refuse_own(options)
        return self.diagram.sweep(parameters, self.duration, **options)

    def _refuse_own(self, options: Mapping[str, Any]) -> None:
        for name in options:
            if name in DEFAULTS:
                raise OptionError("it is no option of a run. Give it to the experiment.", block=self.letter, port=name)


def _admittance(options: Mapping[str, Any], side: int, **impedance: Any) -> AdmittanceFilter:
    limits: dict[str, Any] = {}
    for name in ("velocity_limit", "acceleration_limit"):
        limit = options[name]
        limits[name] = limit[side] if isinstance(limit, tuple) else limit
    return AdmittanceFilter(**impedance, **limits)


def _plant(letter: str, options: Mapping[str, Any], given: Collection[str], position: Any) -> Fmu:
    """Return the plant at the experiment's start, with the options that are its own.

    A plant of one's own keeps what its ``start`` says, and what nobody has given.
    """
    own = options["plant"] is not None
    plant = options["plant"] if own else gantry.build()
    plant = plant.replace(name="plant") if isinstance(plant, Fmu) else Fmu(plant, name="plant")
    check_plant(plant)
    variables = plant.description.variables
    place = plant.output_variables["position"].name
    start: dict[str, Any] = {}
    if variables[place].start is not None:
        start |= plant.start_of("position", position, "m")
    elif not plant.start:
        raise OptionError(
            f"its {place} is computed and can't be set to ({position[0]:g}, {position[1]:g}) m, where experiment "
            f"{letter} starts. Give the plant with its own start values that place it there: "
            "plant=Fmu(file, start={…}).",
            block=f"experiment {letter}",
            port="plant",
        )
    for name, unit in (("coulomb_scale", "1"), ("viscous_scale", "1"), ("friction_width", "m/s")):
        if own and (name not in given or (name not in variables and options[name] == DEFAULTS[name])):
            continue
        if name not in variables:
            raise OptionError(
                f"the plant has no parameter {name!r}, found {options[name]:g} for it. Leave the option out, or give "
                "the plant such a parameter.",
                block=f"experiment {letter}",
                port=name,
            )
        entry = plant.start_of(name, options[name], unit)
        value = float(entry[name])
        # a converted number may differ in its last bits from the same one that was written in the FMU's unit
        if name in plant.start and not math.isclose(float(plant.start[name]), value, rel_tol=1e-12):
            unit = f" {variables[name].unit}" if variables[name].unit not in (None, "1") else ""
            raise OptionError(
                f"found {value:g}{unit}, and {float(plant.start[name]):g}{unit} in the plant's start values; give it "
                "once.",
                block=f"experiment {letter}",
                port=name,
            )
        start |= entry
    if not own:
        # it resolves the friction's sign change, whose rate is F_c/(M w), w its width
        width = options["friction_width"] / DEFAULTS["friction_width"]
        start["internal_step"] = float(gantry.INTERNAL_STEP * min(1.0, width))
    return plant.replace(start={**start, **plant.start})


def _build(
    letter: str,
    name: str,
    duration: float,
    options: dict[str, Any],
    start: tuple[float, float],
    par: Channel,
    perp: Channel,
    environment: Callable[[Any], Any] | None = None,
    *,
    given: Collection[str],
) -> Experiment:
    """Place the plant at its start, and wire Fig. 3."""
    path = options["path"]
    plant = _plant(letter, options, given, path.to_plane(*start))
    rig = Rig(
        tool_mass=options["tool_mass"],
        encoder=options["encoder"],
        delay=options["delay"],
        motor_force_limit=options["motor_force_limit"],
        sample_time=options["sample_time"],
        admittance_method=options["admittance_method"],
    )
    model = gantry.nominal.replace(friction_width=options["friction_width"])
    diagram = fig3(plant, path, par, perp, environment=environment, model=model, rig=rig, name=name)
    return Experiment(letter, f"{name}: experiment {letter}", diagram, duration, options, path)


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
    o = merge("A", 11.0, options)
    for name in ("velocity_limit", "acceleration_limit"):
        if o[name] is not None:
            raise OptionError(
                "experiment A has no admittance whose path reference could be limited; use B, C or D.",
                block="experiment A",
                port=name,
            )
    par = SmoothStep(levels=(0.12, 0.75, 1.60), start_times=(1.0, 5.5), durations=(2.0, 2.0), unit="m", name="eta_d")
    perp = SmoothStep(
        levels=(0.0, -0.03, 0.03, 0.0), start_times=(4.0, 8.5, 9.5), durations=(0.5, 0.5, 0.5), unit="m", name="xi_d"
    )
    return _build("A", "path_following", 11.0, o, (0.10, 0.01), Channel(par), Channel(perp), given=options)


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
    o = merge("B", 15.0, {**options, "smooth_reference": smooth_reference}, smooth_reference=False)
    reference: Any = Reference(0.0, unit="m", name="eta_d")
    offset: Any = Step(times=1.0, values=0.3, unit="m", name="set_point")
    if smooth_reference:
        reference, offset = (
            SmoothStep(levels=(0.0, 0.3), start_times=(1.0,), durations=(1.0,), unit="m", name="eta_d"),
            None,
        )
    par = Channel(
        reference,
        _admittance(o, 0, **IMPEDANCE_PAR),
        Step(times=(7.0, 11.0), values=(2.0, -2.0), unit="N", name="desired_force_par"),
        offset,
    )
    perp = Channel(
        Reference(0.0, unit="m", name="xi_d"),
        _admittance(o, 1, **IMPEDANCE_PERP),
        Step(times=(4.0, 11.0), values=(5.0, -5.0), unit="N", name="desired_force_perp"),
    )
    return _build("B", "compliance", 15.0, o, (0.0, 0.0), par, perp, given=options)


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
    o = merge("C", 12.0, options)
    f_par = (
        Pulse(start_time=0.5, end_time=1.5, amplitude=1.5, unit="N")
        + Pulse(start_time=2.5, end_time=3.5, amplitude=-1.5, unit="N")
        + Pulse(start_time=8.5, end_time=9.7, amplitude=1.5, unit="N")
    )
    f_perp = (
        Pulse(start_time=0.5, end_time=4.5, amplitude=0.3, unit="N") * Sine(frequency=1.0, unit="1")
        + Pulse(start_time=5.0, end_time=6.0, amplitude=6.0, unit="N")
        + Pulse(start_time=6.5, end_time=7.5, amplitude=-6.0, unit="N")
        + Pulse(start_time=8.5, end_time=9.7, amplitude=-6.0, unit="N")
    )
    path = o["path"]

    def hand(position: Any) -> Any:
        return HandForce(path, name="hand")(position, f_par=f_par, f_perp=f_perp)

    return _build("C", "hand_guiding", 12.0, o, (0.2, 0.0), *_free_along(o), hand, given=options)


def guided_by_hand(**options: Any) -> Experiment:
    """Return experiment C with a hand that is moved from outside, in place of its profile of forces. 12 s.

    The hand pulls the tool by a spring, with at most 8 N, while ``hand_grip`` is 1. It is at ``hand_position``. Both
    are constants, which `Simulation.run_realtime` and a page move.

    Parameters
    ----------
    **options
        See `DEFAULTS`.

    Raises
    ------
    OptionError, PathDomainError
        As in `path_following`.
    """
    o = merge("C", 12.0, options)
    path, start = o["path"], (0.2, 0.0)

    def hand(position: Any) -> Any:
        return pull_by_hand(position, path.to_plane(*start))

    return _build("C", "guided_by_hand", 12.0, o, start, *_free_along(o), hand, given=options)


def _free_along(options: Mapping[str, Any]) -> tuple[Channel, Channel]:
    """Return the channels of experiment C: free along the path, a spring across it."""
    free = _admittance(options, 0, mass=0.5, stiffness=0.0, damping=_damping(IMPEDANCE_PAR))
    par = Channel(Reference(0.2, unit="m", name="eta_d"), free)
    return par, Channel(Reference(0.0, unit="m", name="xi_d"), _admittance(options, 1, **IMPEDANCE_PERP))


def hand_page(path: str | os.PathLike[str] | None = None, **options: Any) -> WebPage:
    """Return experiment C as a page: the gantry, which the pointer pulls, and Table III as sliders.

    Parameters
    ----------
    path : path, optional
        File to write, ``.html``.
    **options
        See `DEFAULTS`.

    Raises
    ------
    OptionError, PathDomainError, CompilerError
        As in `path_following`; as in `Diagram.to_html`.
    """
    from ..web_page import PageText, make_page
    from .hand_scene import ABOUT, HEADINGS, LABELS, PLOTS, TABLE_III, gantry_scene

    made = guided_by_hand(**options)
    return make_page(
        made.diagram.wired,
        made.diagram.drawn_facts(),
        path,
        inputs=(),
        sliders=TABLE_III,
        plots=PLOTS,
        text=PageText("A robot that is guided by hand", ABOUT),
        labels=LABELS,
        headings=HEADINGS,
        scene=gantry_scene(made.path),
    )


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
    o = merge("D", 9.0, {**options, "cubic": cubic}, cubic=False)
    par = Channel(
        SmoothStep(levels=(0.2, 1.0), start_times=(3.0,), durations=(3.0,), unit="m", name="eta_d"),
        _admittance(o, 0, **IMPEDANCE_PAR),
    )
    perp = Channel(
        Reference(0.0, unit="m", name="xi_d"),
        _admittance(o, 1, mass=2.0, stiffness=0.0, damping=_damping(IMPEDANCE_PERP)),
        Step(times=0.5, values=-5.0, unit="N", name="desired_force_perp"),
    )
    path = o["path"]
    law: dict[str, Any] = {"cubic_stiffness": 5.0 / 0.005**3} if cubic else {"stiffness": 1000.0}

    def spring(position: Any) -> Any:
        return PathSpring(path, **law, name="spring")(position)

    return _build("D", "force_tracking", 9.0, o, (0.2, 0.0), par, perp, spring, given=options)


def _damping(impedance: Mapping[str, float]) -> float:
    """Return d = 2 ζ √(m k), (E7), which is kept when k is set to zero (E8)."""
    return 2.0 * impedance["damping_ratio"] * float(np.sqrt(impedance["mass"] * impedance["stiffness"]))


EXPERIMENTS: Mapping[str, Callable[..., Experiment]] = MappingProxyType(
    {"A": path_following, "B": compliance, "C": hand_guiding, "D": force_tracking}
)
"""The experiments by their letter."""
