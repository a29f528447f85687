"""Linearization of a diagram: the simulated functions, differentiated at an operating point.

A diagram without sampling gives a continuous model, dx/dt = A x + B d, with the exact Jacobians of the flow and the
linear models of FMUs. Any other diagram gives a discrete model over one base period or, with several rates, over their
least common period. Hold and delay are exact (`over_a_period`).
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ...blocks.core import (
    BetweenTicksError,
    Finding,
    Grid,
    LoopwrightError,
    NonFiniteError,
    OptionError,
    Sheet,
    ShownAsTable,
    WiringError,
    accepts,
    brief,
    check_argument,
    count_of,
    enumerate_some,
    explain_calls,
    kinds,
    missing_member,
)
from ...fmus.fmu_block import Derivation, DerivativeMethod
from ..flat import NONE, FlatDiagram, TickPattern, WiredDiagram
from ..frequency import (
    NEUTRAL,
    DelayMatrices,
    LinearDelays,
    delayed_loop_class,
    delayed_system_class,
    finite_zeros,
    loop_class,
    mu_bound,
    order_key,
    plot_poles,
)
from ..results import OperatingPoint
from ..wiring import exact_time
from .cut_findings import find_cut_findings
from .delay_channels import blocks_around
from .derivatives import LocalDerivatives, find_moving
from .exchanged import derivations_at, findings_on
from .flow_model import Model, approximate_delays, model_continuous, relative_error
from .free_motions import FreeMotions, find_free_motions
from .inserted_blocks import name_inputs, split_consumers, split_inputs
from .kinks import find_kinks
from .left_out_effects import EntryTaken
from .mean_stairs import A_TREATMENT
from .operating_points import PointLike, check_options, operating_point, refine_ticks
from .over_a_period import begin_loop, confirm_loop, model_at
from .plant_models import A_WAY, EQUILIBRIUM
from .shifted_diagram import ClosedModel
from .signal_paths import SignalPaths
from .taps import Tap, find_signal

if TYPE_CHECKING:
    from control import StateSpace
    from matplotlib.figure import Figure

    from ..frequency import LoopTransfer


WAYS = {
    **dict.fromkeys(("bode", "nyquist", "nichols", "root_locus"), 'lin.loop("wire").{}(), the loop at a wire'),
    **dict.fromkeys(("pole_zero_map", "plot_poles"), "lin.pzmap()"),
    **dict.fromkeys(
        ("margins", "margin", "stability_margins", "gain_margin", "phase_margin"),
        'margins(lin.loop("wire")), after from loopwright import margins',
    ),
    **dict.fromkeys(("step_response", "step_info"), 'lin.loop("wire").step(), which closes the loop'),
    **dict.fromkeys(("pole", "eigenvalues", "damp"), "lin.poles"),
    **dict.fromkeys(("zero", "zeros"), "lin.system, whose zeros() are those from its inputs to its outputs"),
    **dict.fromkeys(("ss", "state_space", "to_ss", "tf"), "lin.system, or lin.A, lin.B, lin.C, lin.D"),
}
"""What to write for names that users of other tools look for in a linear model."""
REAL = 1e-4
"""Imaginary part, relative to the pole, below which it is shown as real. Of a multiple pole it is rounding alone."""
MOST_SHOWN, MOST_NAMES = 60, 8
"""States up to which a model's table has the poles (a few milliseconds), and names that it shows in a row."""


@explain_calls
@dataclass(frozen=True, eq=False)
class Linearization(ShownAsTable):
    """A linear model of a diagram at an operating point.

    Attributes
    ----------
    diagram : Diagram
        Diagram of the model.
    A, B, C, D : ndarray
        Matrices of the model, from the injected signals to the measured ones.
    dt : float
        Sample time of the model in s, 0 of a continuous model.
    states, inputs, outputs : tuple of str
        Paths of the states, names of the signals.
    point : OperatingPoint
        Operating point of the model.
    affine : ndarray
        Change of the states at the operating point itself, per second or over the period: zero at an equilibrium.
    derivations : mapping
        Method by which each FMU and each opaque block was differentiated, by path, as a `Derivation`.
    uncertainty : float
        Largest estimated error of an entry of an FMU's linear model; 0 if all are exact, NaN if one is not known
        (`InexactDerivatives` with a ``gap`` of NaN).
    memory : tuple of str
        States that only start a search, such as a projection's last foot point: their poles at z = 0 are no design
        poles.
    openings : tuple of str
        Wires that were cut.
    findings : tuple of Finding
        Effects that the model leaves out: stairs and relays (`StepsOnly`), kinks and jumps at the point (`Kink`),
        slopes of zero where the nominal range is not flat (`ZeroSlope`), events within the period, a start that is
        unlike every later tick. Select by class, ``isinstance(finding, Kink)``; ``str(finding)`` is the text. A loop
        has those that lie on it as its attribute ``findings``, and so has every number that is made from it.
    carried : tuple of Finding
        Those of the findings that limit the numbers between the model's inputs and outputs.
    plants : str or None
        Method for FMUs that was asked for; the loops of this model use it too.
    step : float, Fraction or None
        Communication step that was asked for; the loops of this model use it too.
    stairs : str or None
        Treatment of stairs that was asked for; the loops of this model use it too.
    delays : LinearDelays or None
        Transport delays of a continuous model, which are closed around the matrices: ``A`` to ``D`` are those of the
        rest, and `system` and the loops are `DelayedSystem`. In a sampled model the past is a part of the states.
    pade : int
        Order of Padé's approximations of the delays, 0 where they are exact; the loops of this model use it too.
    """

    if not TYPE_CHECKING:  # a type checker knows all members

        def __getattr__(self, name):
            raise missing_member(self, name, "a linear model", {key: way.format(key) for key, way in WAYS.items()})

    wired: WiredDiagram = field(repr=False)
    A: np.ndarray = field(repr=False)
    B: np.ndarray = field(repr=False)
    C: np.ndarray = field(repr=False)
    D: np.ndarray = field(repr=False)
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    point: OperatingPoint
    affine: np.ndarray = field(repr=False)
    derivations: Mapping[str, Derivation] = field(default_factory=dict)
    uncertainty: float = 0.0
    memory: tuple[str, ...] = ()
    openings: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    carried: tuple[Finding, ...] = ()
    plants: str | None = field(default=None, repr=False)
    step: float | Fraction | None = field(default=None, repr=False)
    stairs: str | None = field(default=None, repr=False)
    delays: LinearDelays | None = None
    pade: int = field(default=0, repr=False)

    def __repr__(self) -> str:
        facts = [f"T = {self.dt:g} s" if self.dt else "continuous", count_of(len(self.states), "state")]
        facts += [count_of(len(self.delays.times), "delay")] if self.delays else []
        return brief(f"linear model of {self.wired.name!r}", *facts, then="model.loop('wire'), .A, .findings")

    def _sheet(self) -> Sheet:
        point, T = self.point, self.dt
        grids, notes = [], []
        if self.delays:
            notes.append(f"It has {count_of(len(self.delays.times), 'delay')}, so infinitely many poles: model.poles.")
        elif len(self.states) > MOST_SHOWN:
            notes.append(f"It has {len(self.states)} states: model.poles.")
        else:
            columns = "pole", "frequency in rad/s", "damping", *(("size",) if T else ())
            grids.append(Grid(f"Poles in the {'z' if T else 's'} plane", columns, tuple(_pole_rows(self.poles, T))))
        moves = "" if math.isnan(point.residual) else f", residual {point.residual:.3g}"
        return Sheet(
            f"linear model of {self.wired.name!r}",
            (
                ("time", f"sampled, T = {T:.9g} s" if T else "continuous"),
                ("inputs", enumerate_some(self.inputs, MOST_NAMES)),
                ("outputs", enumerate_some(self.outputs, MOST_NAMES)),
                ("states", f"{len(self.states)}: {enumerate_some(self.states, MOST_NAMES)}" if self.states else "none"),
                ("operating point", f"t = {point.t:.9g} s{moves}{f' by {point.largest}' if point.largest else ''}"),
                ("cut at", enumerate_some(self.openings, MOST_NAMES)),
            ),
            tuple(grids),
            (*notes, *map(str, self.findings)),
        )

    @property
    def diagram(self) -> Any:
        """The `Diagram` of the model."""
        return self.wired.facade

    @property
    def how(self) -> dict[str, str]:
        """Texts of `derivations`, by path."""
        return {path: str(derivation) for path, derivation in self.derivations.items()}

    @property
    def notes(self) -> tuple[str, ...]:
        """Texts of `findings`."""
        return tuple(str(finding) for finding in self.findings)

    @property
    def system(self) -> StateSpace:
        """The model as `control.StateSpace`, with the names of signals and states, underscores for dots.

        Raises
        ------
        OptionError
            If the model has no inputs or no outputs.
        """
        return self._state_space(self.C, self.D, self.wired.name)

    def _state_space(
        self, C: np.ndarray, D: np.ndarray, name: str, kind: type[StateSpace] | None = None, *, sign: float = 1.0
    ) -> Any:
        from control import StateSpace

        if not self.inputs or not self.outputs:
            raise OptionError(
                f"found {len(self.inputs)} inputs and {len(self.outputs)} outputs; expected at least one of each. Name "
                "them: linearize(…, inputs=…, outputs=…), or take a loop, .loop(…).",
                block=self.wired.name,
            )
        # python-control refuses dots in names
        names = {
            key: [e.replace(".", "_") for e in labels]
            for key, labels in (("inputs", self.inputs), ("outputs", self.outputs), ("states", self.states))
        }
        name = name.replace(".", "_")
        if self.delays:
            late = replace(self.delays, E=sign * self.delays.E)
            rest = StateSpace(*late.join((self.A, self.B, C, D)), 0, remove_useless_states=False)
            ports = {"inputs": names["inputs"], "outputs": names["outputs"]}
            make = delayed_system_class() if kind is None else delayed_loop_class()
            system: Any = make(rest, late.times, late.names, name=name, **ports)
        else:
            system = (kind or StateSpace)(
                self.A, self.B, C, D, self.dt, name=name, remove_useless_states=False, **names
            )
        system.inexactness = relative_error(self.uncertainty, self.A, self.B, C, D)
        system.findings = self.carried
        taken = (finding for finding in self.findings if isinstance(finding, EntryTaken))
        system.notes = tuple(map(str, dict.fromkeys((*self.carried, *taken))))
        return system

    def refuse_delays(self, what: str) -> None:
        """Refuse a use of the matrices alone, which ``what`` names.

        Raises
        ------
        OptionError
            If the model is continuous and has delays.
        """
        if self.delays is not None:
            raise OptionError(
                f"found a transport delay in a continuous diagram, which {what} can't take; expected a model that is "
                "its matrices alone. Take PadeDelay(delay=…, order=…) in its place.",
                block=self.delays.names[0].rpartition(".")[0],
            )

    @cached_property
    def characteristic(self) -> DelayMatrices:
        """The characteristic function of a continuous model, whose roots are its poles; without memory."""
        keep = [i for i, name in enumerate(self.states) if name not in self.memory]
        late = self.delays
        if late is not None:
            late = replace(late, G=late.G[keep], Z=late.Z[:, keep])
        return DelayMatrices.of(self.A[np.ix_(keep, keep)], late)

    @property
    def neutral_blocks(self) -> tuple[str, ...]:
        """Blocks on the ways around dead times that have no state and a gain of 1 or more, sorted by path; see `poles`.

        Through them signals of all frequencies come back as large as they were: a lag in one of these ways ends that.
        It is empty where the gain is below 1, and of a sampled model.
        """
        if self.delays is None:
            return ()
        H, found = self.delays.H, set[str]()
        for places in self.characteristic.cycles:
            if mu_bound(H[np.ix_(places, places)].astype(complex)) >= NEUTRAL:
                found |= {self.delays.names[i].rpartition(".")[0] for i in places}
        return blocks_around(self.wired.flatten_like(self.point), found) if found else ()

    def characteristic_without(self, free: FreeMotions) -> DelayMatrices:
        """Return the characteristic function without the roots of some free motions, of a continuous model."""
        late = self.delays
        if not free or late is None:
            return self.characteristic
        late = replace(late, G=free.reduce_inputs(late.G), Z=free.reduce_outputs(late.Z))
        return DelayMatrices.of(free.reduce(self.A), late)

    @cached_property
    def findings_on_loops(self) -> tuple[Finding, ...]:
        """Those of the findings that limit numbers about all loops together, such as the poles."""
        flat = self.wired.flatten_like(self.point)
        return SignalPaths(flat, [find_signal(flat, wire).port for wire in self.openings]).on_loops(self.findings)

    @property
    def poles(self) -> np.ndarray:
        """Poles of the model without those of `memory`, the largest first.

        With delays in a loop there are infinitely many: the rightmost are given, the rightmost first, and all beyond
        the limit of stability are among them.
        """
        if self.delays:
            return np.array(self.characteristic.poles())
        keep = [i for i, name in enumerate(self.states) if name not in self.memory]
        return _sorted_poles(self.A[np.ix_(keep, keep)])

    def pzmap(self) -> Figure:
        """Return the poles in the s plane, or in the z plane with the unit circle, without those of `memory`.

        Zeros are drawn where the model has as many inputs as outputs, and no delays. Thin lines have equal damping
        ratios and natural frequencies. With delays there are infinitely many poles, of which the rightmost are drawn.
        """
        square = len(self.inputs) == len(self.outputs) > 0 and self.delays is None
        zeros = finite_zeros(self.system) if square else None
        return plot_poles(self.poles, zeros, self.dt, f"poles of {self.wired.name}", are_all=self.delays is None)

    @accepts(None, required=kinds.names)
    def free_motions(self, required: str | Iterable[str] = ()) -> FreeMotions:
        """Return the motions that nothing notices, such as that of an angle that nothing feeds back.

        Such a motion has a pole at s = 0, or z = 1, and is no instability: no derivative, no wire on a loop, no event
        and no required signal changes along it, at any distance and at any instant of the period.

        Parameters
        ----------
        required : str or iterable of str
            Wires and ports on which something is required: a motion that changes one of them is not free.

        Returns
        -------
        FreeMotions
            The motions, and the coordinates in which A falls apart into them and the rest.

        Raises
        ------
        UnknownNameError
            If there is no such wire or port.
        """
        names = tuple(dict.fromkeys(_as_list(required)))
        if names not in self._free:
            own = {f.name: getattr(self, f.name) for f in fields(ClosedModel)}
            self._free[names] = find_free_motions(ClosedModel(**own), names)
        return self._free[names]

    @cached_property
    def _free(self) -> dict[tuple[str, ...], FreeMotions]:
        return {}

    def poles_without(self, free: FreeMotions) -> np.ndarray:
        """Return the poles without those of some free motions, as `poles` does."""
        if self.delays is not None:
            return np.array(self.characteristic_without(free).poles())
        return _sorted_poles(free.reduce(self.A)) if free else self.poles

    @property
    def is_equilibrium(self) -> bool:
        """Whether the operating point is an equilibrium."""
        return bool(np.max(np.abs(self.affine), initial=0.0) <= EQUILIBRIUM)

    @accepts(None, slow=kinds.choice("closed", "open").worded(step="Choose one of them.", found=kinds.by_name))
    def loop(
        self,
        *wires: str,
        to: str | Iterable[str] = (),
        lifted: bool = False,
        slow: Literal["closed", "open"] = "closed",
    ) -> LoopTransfer:
        """Return the loop transfer function L at a wire, all other loops closed: S = 1/(1 + L).

        The wire is cut behind the port, for all consumers: L = −(returning signal)/(injected signal). With several
        wires, or a wire with several entries, L is the matrix of all loops cut at once. Over a period of several ticks,
        L begins at the tick at which the wire is renewed. The closed L is compared with the diagram's poles.

        Parameters
        ----------
        *wires : str
            Names of wires, paths of ports, or entries of them: ``"motor_force"``, ``"motor_force[1]"``.
        to : str or iterable of str
            Inputs of blocks, ``"tank.valve"``: the wire is cut ahead of these consumers only.
        lifted : bool, default: False
            Whether a wire that is renewed several times in the model's period gets one channel for each renewal:
            ``"u@0"``, ``"u@1"``, …. A factor common to all of them is a gain in the wire: see `periodic_margins`.
        slow : {"closed", "open"}
            Whether the loops of subsystems that are sampled slower than the wire are closed. Open, these subsystems
            hold their outputs and states, and L is that of the inner loop at the wire's own rate.

        Returns
        -------
        LoopTransfer
            L, a `control.StateSpace` with the names of the wires as inputs and outputs. It plots itself: ``bode``,
            ``nyquist``, ``nichols``, ``step``, ``gang_of_four``. Its ``findings`` limit it; its ``notes`` are their
            texts, and which entry was taken where one was asked for.

        Raises
        ------
        OptionError
            If no wire is named, there is no such ``slow``, or no clock behind the wire or its readers.
        BetweenTicksError
            In a discrete model, if a wire changes between ticks and acts there: it has no loop at ticks.
        UnknownNameError, WiringError
            If there is no input of ``to``, or it is fed by another wire.
        PeriodicLoopError
            If a wire is renewed several times in the model's period, unless ``lifted``: its loop is periodic.
        ConfirmationError
            If the closed L does not have the diagram's poles.
        """
        made: LoopTransfer
        if to:
            model, port = self._ahead_of(wires, to)
            made = model.loop(*port, lifted=lifted, slow=slow)
            name = f"L({', '.join(wires)} to {', '.join(_as_list(to))})"
            made.name = name.replace(".", "_")  # python-control refuses dots in names
            made.place = f"{', '.join(wires)} → {', '.join(_as_list(to))}"
            return made
        cut = self._make_at(wires, openings=wires, loop="lifted" if lifted else "one", slow=slow)
        made = cut._state_space(-cut.C, -cut.D, f"L({', '.join(wires)})", loop_class(), sign=-1.0)
        made.linearization, made.wires = self, wires
        return made

    def sensitivity(self, *wires: str, to: str | Iterable[str] = ()) -> StateSpace:
        """Return S at a wire, from the injected signal to that of the consumers, with all loops closed.

        With inputs of blocks in ``to``, these consumers alone get the injected signal, as of `loop`.

        Over a period of several ticks, the injected signal is held from the tick at which the wire is renewed, for a
        whole period. S of a wire that is renewed several times in the period is not 1/(1 + L): there is no L at one
        rate.
        """
        model, wires = self._ahead_of(wires, to)
        closed = model._make_at(wires)
        return closed._state_space(closed.C, closed.D + np.eye(len(closed.D)), f"S({', '.join(wires)})")

    def complementary(self, *wires: str, to: str | Iterable[str] = ()) -> StateSpace:
        """Return T = 1 − S at a wire; with ``to`` ahead of these consumers, as `sensitivity`."""
        model, wires = self._ahead_of(wires, to)
        closed = model._make_at(wires)
        return closed._state_space(-closed.C, -closed.D, f"T({', '.join(wires)})", sign=-1.0)

    def _ahead_of(self, wires: tuple[str, ...], to: str | Iterable[str]) -> tuple[Linearization, tuple[str, ...]]:
        """Return the model of the diagram with a block ahead of some consumers of a wire, and that block's port."""
        if not to:
            return self, wires
        diagram, point, port = split_consumers(self.wired, self.point, wires, _as_list(to))
        return replace(self, wired=diagram, point=point), (port,)

    def _make_at(
        self, wires: tuple[str, ...], openings: tuple[str, ...] = (), loop: str = "", slow: str = "closed"
    ) -> Linearization:
        """Return the model at these wires; ``loop`` is "one", "lifted", or "" for the closed loops."""
        if not wires:
            raise OptionError(
                "found no name of a wire; expected one. Name it: .loop('v_perp').",
                block=self.wired.name,
                port="wires",
            )
        flat = self.wired.flatten_like(self.point)
        ports = [find_signal(flat, w).port for w in wires]
        closed = LocalDerivatives.at(flat, self.point)
        at, frozen = begin_loop(closed, self.point, ports, self.plants, slow, self.wired.name, moves=bool(self.dt))
        how: dict[str, Any] = {"plants": self.plants, "step": self.step, "stairs": self.stairs, "pade": self.pade}
        how |= {"frozen": frozen, "findings": self.findings}
        made = _linearize(self.wired, at, wires, wires, openings, loop=loop, **how)
        if loop:
            own = at is self.point and not self.openings and not frozen
            whole = self if own else _linearize(self.wired, at, (), (), (), **how)
            known = 0.0 if math.isnan(made.uncertainty) else made.uncertainty
            cut = Model((made.A, made.B, made.C, made.D), made.dt, [], made.affine, uncertainty=known)
            cut.delays = made.delays
            confirm_loop(cut, whole.A, wires, self.wired.name, whole.delays)
        return made


def _pole_rows(poles: Iterable[complex], T: float) -> Iterator[tuple[object, ...]]:
    """Yield a row of a table for each real pole and each pair, with frequency and damping in continuous time."""
    found = [complex(p) for p in poles]
    found = [p if abs(p.imag) > REAL * abs(p) else complex(p.real, 0.0) for p in found if p.imag >= -REAL * abs(p)]
    for p in sorted(found, key=lambda p: (-order_key(abs(p)), order_key(p.real))):
        s = p if not T else cmath.log(p) / T if p else None
        turns = s is not None and abs(s) > 0.0 and math.isfinite(abs(s))
        text = f"{p.real + 0.0:.4g} ± {p.imag:.4g}j" if p.imag else f"{p.real + 0.0:.4g}"
        speed = () if s is None or not turns else (float(f"{abs(s):.4g}"), float(f"{-s.real / abs(s) + 0.0:.4g}"))
        yield text, *(speed or (None, None)), *((float(f"{abs(p):.6g}"),) if T else ())


def _sorted_poles(A: np.ndarray) -> np.ndarray:
    """Return the eigenvalues of a matrix, the largest first."""
    poles = np.linalg.eigvals(A) if A.size else np.zeros(0)
    return poles[np.lexsort((poles.imag, poles.real, -np.abs(poles)))]


def linearize(
    diagram: WiredDiagram,
    point: PointLike = None,
    /,
    *,
    inputs: str | Iterable[str] = (),
    outputs: str | Iterable[str] = (),
    openings: str | Iterable[str] = (),
    plants: str | None = None,
    stairs: str | None = None,
    delays: Literal["exact", "pade"] = "exact",
    order: int = 5,
    **options: Any,
) -> Linearization:
    """Linearize a diagram; see `Diagram.linearize`."""
    check_argument(delays, kinds.choice("exact", "pade"), "delays", "linearize")
    check_argument(order, kinds.integer(1), "order", "linearize")
    for name, asked, kind in (("plants", plants, A_WAY), ("stairs", stairs, A_TREATMENT)):
        if asked is not None:
            check_argument(asked, kind, name, diagram.name)
    check_options(options, "linearize")
    at = operating_point(diagram, point, options)
    if delays == "pade" and _is_discrete(diagram, options.get("step")):
        raise OptionError(
            "found 'pade' for a sampled model, which is rational as it is: the past of its delays is a part of the "
            "states. Expected 'exact'. Leave delays out, or take diagram.continuous().",
            block=diagram.name,
            port="delays",
        )
    _refuse_lost(diagram, at)
    diagram = diagram.replace(at.parameters) if at.parameters else diagram  # parameters that a trim has found
    given = [_as_list(names) for names in (inputs, outputs, openings)]
    diagram, at, ports = split_inputs(diagram, at, itertools.chain(*given))
    places = [[ports.get(name, name) for name in names] for names in given]
    how: dict[str, Any] = {"plants": plants, "stairs": stairs, "pade": order if delays == "pade" else 0}
    made = _linearize(diagram, at, *places, step=options.get("step"), **how)
    return replace(made, inputs=name_inputs(made.inputs, ports), outputs=name_inputs(made.outputs, ports))


def linearize_within(
    diagram: WiredDiagram,
    point: OperatingPoint,
    parts: int,
    *,
    inputs: Iterable[str],
    outputs: Iterable[str],
    stairs: str | None = None,
) -> Linearization:
    """Return the model over the period of all clocks, with its outputs at all ticks and between them.

    Outputs are read at the beginning of each of so many ``parts`` of the time from one tick to the next; FMUs step by
    each. Inputs are held over the period; the outputs are those of the first instant, then those of the next one, ….
    """
    return _linearize(
        diagram,
        refine_ticks(diagram, point, parts),
        inputs,
        outputs,
        (),
        plants=None,
        step=None,
        stairs=stairs,
        read_each=True,
    )


def find_flow_poles(diagram: WiredDiagram, point: OperatingPoint) -> np.ndarray:
    """Return the poles in 1/s of what moves on between two ticks, with everything sampled held."""
    between = refine_ticks(diagram, point, 2)  # with ticks at which nothing acts, x holds all that is held there
    local = LocalDerivatives.at(diagram.flatten_like(between), between)
    return _sorted_poles(model_continuous(local, between, None, diagram.name).matrices[0])


def _is_discrete(diagram: WiredDiagram, step: float | Fraction | None) -> bool:
    """Return whether a linear model goes from one tick to the next."""
    return diagram.has_clock or (diagram.has_fmu and step is not None)


def _refuse_lost(diagram: WiredDiagram, at: OperatingPoint) -> None:
    """Refuse a point at which an FMU's output is no number: a run may have one that nothing reads, a model may not."""
    flat = diagram.flatten_like(at)
    for name in flat.unread:
        if name in at.values and not np.all(np.isfinite(at.values[name])):
            path, port = flat.ports[name]
            raise NonFiniteError(
                f"found {np.ravel(at.values[name]).tolist()}; expected finite numbers, as a linear model has a row for "
                "each output. Choose the FMU's ports without this one: ports=[…].",
                block=path,
                port=port,
                t=at.t,
            )


def _linearize(
    diagram: WiredDiagram,
    at: OperatingPoint,
    inputs: str | Iterable[str],
    outputs: str | Iterable[str],
    openings: str | Iterable[str],
    *,
    plants: str | None,
    step: float | Fraction | None,
    stairs: str | None = None,
    pade: int = 0,
    loop: str = "",
    frozen: frozenset[TickPattern] = NONE,
    findings: tuple[Finding, ...] | None = None,
    read_each: bool = False,
) -> Linearization:
    if step is not None and exact_time(step, block=diagram.name) != at.base and (diagram.has_clock or diagram.has_fmu):
        raise OptionError(
            f"found step={step!r}; expected {float(at.base):g} s, the ticks of the operating point. Make the operating "
            "point with this step, or leave the step out.",
            block=diagram.name,
            port="step",
        )
    if step is not None and not at.asked:
        at = replace(at, asked=True)
    names = [_as_list(n) for n in (inputs, outputs, openings)]
    flat = diagram.flatten_like(at)
    at.check_fits(flat, diagram.name)
    found = [[find_signal(flat, n) for n in group] for group in names]
    for signal in found[2]:
        _check_opening(flat, signal)
    local = LocalDerivatives.at(flat, at, found[0], found[1], found[2], stairs)
    discrete = _is_discrete(diagram, step)
    if discrete and loop:
        _check_loop(local, at)
    model, channels = model_at(
        local, at, plants, diagram.name, discrete=discrete, loop=loop, frozen=frozen, read_each=read_each
    )
    model = approximate_delays(model, pade) if pade else model
    A, B, C, D = model.matrices
    n, ins, outs = len(A), *(tuple(e for s in group for e in s.labels) for group in found[:2])
    if channels:
        ins = outs = tuple(channels)
    if read_each:
        outs = tuple(f"{e}@{k}" for k in range(len(C) // max(1, len(outs))) for e in outs)
    known = local.stairs.replace_findings(find_kinks(flat, at)) if findings is None else findings
    entries = (EntryTaken(s.name, s.entry) for group in found for s in group if s.entry)
    methods, error = derivations_at(flat, at, model.derivations)
    every = tuple(dict.fromkeys((*known, *model.findings, *findings_on(methods), *at.free, *entries)))
    # of all findings, those on the way from the inputs to the outputs go with a loop that is made of the model
    ways = SignalPaths(flat, [s.port for s in found[2]])
    carried = ways.between(every, *([s.port for s in group] for group in found[:2]))
    carried += find_cut_findings(flat, at, [s.port for s in found[2]], carried) if loop else ()
    is_unknown = any(math.isnan(derivation.gap) for derivation in methods.values())
    opaque = {p: Derivation(DerivativeMethod.BLOCK_DIFFERENCES) for p, b in flat.table.blocks.items() if b.opaque}
    return Linearization(
        diagram,
        A,
        B.reshape(n, len(ins)),
        C.reshape(len(outs), n),
        D.reshape(len(outs), len(ins)),
        dt=model.dt,
        states=tuple(model.states),
        inputs=ins,
        outputs=outs,
        point=at,
        affine=model.affine,
        derivations={**opaque, **methods},
        uncertainty=math.nan if is_unknown else max(model.uncertainty, error),
        memory=model.memory,
        openings=tuple(names[2]),
        findings=tuple(dict.fromkeys((*every, *carried))),
        carried=carried,
        plants=plants,
        step=step,
        stairs=stairs,
        delays=model.delays,
        pade=pade,
    )


@accepts(points=kinds.several, variants=kinds.several)
def linearize_batch(
    diagram: WiredDiagram,
    points: Iterable[PointLike] = (None,),
    variants: Iterable[Mapping[str, Any]] = ({},),
    **options: Any,
) -> list[Linearization]:
    """Linearize at several operating points, and with several parameters; see `Diagram.linearize_batch`."""
    made, points = [], list(points)
    for changes in variants:
        point: PointLike = None
        try:
            variant = diagram if isinstance(changes, dict) and not changes else diagram.replace(changes)
            for point in points:
                made.append(linearize(variant, point, **options))
        except LoopwrightError as error:
            error.add(f" (with {changes}, at {point!r})")
            raise
    return made


# --- checks ----------------------------------------------------------------------------------------------------------


def _as_list(given: str | Iterable[str]) -> list[str]:
    """Return a name, or several, as a list."""
    check_argument(given, kinds.names, "inputs, outputs and openings", "linearize")
    return [given] if isinstance(given, str) else list(given)


def _check_loop(local: LocalDerivatives, at: OperatingPoint) -> None:
    """Refuse the loop of a wire that changes between ticks and acts there."""
    moving = find_moving(local, at)
    if moving:
        raise BetweenTicksError(
            f"{moving[0]!r} changes between ticks, and blocks in continuous time use it there; expected a loop that is "
            "closed at ticks. Take the loop at a sampled signal, or that of diagram.continuous().",
            block=local.inputs[0].port[0],
            port=local.inputs[0].port[1],
        )


def _check_opening(flat: FlatDiagram, signal: Tap) -> None:
    """Refuse to cut a port without consumers."""
    if signal.port in {(w.block, w.port) for w in flat.table.wires.values()}:
        return
    raise WiringError(
        f"found nothing wired to it; expected a wire to cut at {signal.name!r}. Name a wire that closes a loop.",
        block=signal.port[0],
        port=signal.port[1],
    )
