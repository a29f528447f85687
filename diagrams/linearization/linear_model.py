"""Linearization of a diagram: the very functions that are simulated, differentiated at an operating point.

Where all is continuous, dx/dt = A x + B d with the exact Jacobians of the flow, FMUs by their linear models. Where
something is sampled, the model is discrete, over one base period or, with several rates, their least common period,
and hold and delay are exact (`over_a_period`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError, WiringError
from ...fmus.running import Derivation, DerivativeMethod
from ..flat import NONE, FlatDiagram, WiredDiagram
from ..results import OperatingPoint
from ..wiring import exact_time
from .derivatives import Parts, Signal, find_signal, steps_only
from .findings import Finding
from .loops_over_a_period import confirm_closed, loop_model, moved, period_of, ticks_to_renewal
from .operating_points import check_options, operating_point
from .over_a_period import EQUILIBRIUM, Model, discrete, moves_between
from .plant_models import continuous_models, joined, states_of


@dataclass(frozen=True, eq=False)
class Linearization:
    """A linear model of a diagram at an operating point.

    Attributes
    ----------
    A, B, C, D : ndarray
        The model's matrices, from the injected signals to the measured ones.
    dt : float
        Sample time of the model in s, 0 where it is continuous.
    states, inputs, outputs : tuple of str
        Paths of the states, names of the signals.
    point : OperatingPoint
        Where it was made.
    affine : ndarray
        What the model's states change by at the operating point itself, per second or over the period: zero at an
        equilibrium.
    derivations : mapping
        The way in which the derivative of each FMU was found, by path, as a `Derivation`; of an opaque block as well.
    uncertainty : float
        Largest estimated error of an entry of an FMU's linear model, where it was differenced; 0 where it is exact.
    memory : tuple of str
        States that are only a warm start (a projection's last foot point): their poles at z = 0 are no design poles.
    openings : tuple of str
        The wires that were cut.
    findings : tuple of Finding
        The things that the model does not follow: outputs that move in steps only, events within the period, a start
        that is unlike every later tick. Ask by class, ``isinstance(finding, StepsOnly)``; ``str(finding)`` is the text.
    plants, step
        How it was asked for; its loops are made in the same way.
    """

    diagram: WiredDiagram
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
    plants: str | None = field(default=None, repr=False)
    step: Any = field(default=None, repr=False)

    @property
    def how(self) -> dict[str, str]:
        """The texts of `derivations`, by path."""
        return {path: str(derivation) for path, derivation in self.derivations.items()}

    @property
    def notes(self) -> tuple[str, ...]:
        """The texts of `findings`."""
        return tuple(str(finding) for finding in self.findings)

    @property
    def system(self) -> Any:
        """The model as `control.StateSpace`, with the names of signals and states, underscores for dots.

        Raises
        ------
        OptionError
            Without inputs or outputs.
        """
        return self._state_space(self.C, self.D, self.diagram.name)

    def _state_space(self, C: np.ndarray, D: np.ndarray, name: str) -> Any:
        from control import StateSpace

        if not self.inputs or not self.outputs:
            raise OptionError(
                f"found {len(self.inputs)} inputs and {len(self.outputs)} outputs; expected at least one of each. Name "
                "them: linearize(…, inputs=…, outputs=…), or take a loop, .loop(…).",
                block=self.diagram.name,
            )
        # python-control takes no dots in names
        names = {
            key: [e.replace(".", "_") for e in labels]
            for key, labels in (("inputs", self.inputs), ("outputs", self.outputs), ("states", self.states))
        }
        return StateSpace(
            self.A, self.B, C, D, self.dt, name=name.replace(".", "_"), remove_useless_states=False, **names
        )

    @property
    def poles(self) -> np.ndarray:
        """Poles of the model, without those of `memory`, sorted by size."""
        keep = [i for i, name in enumerate(self.states) if name not in self.memory]
        poles = np.linalg.eigvals(self.A[np.ix_(keep, keep)]) if keep else np.zeros(0)
        return poles[np.lexsort((poles.imag, poles.real, -np.abs(poles)))]

    @property
    def is_equilibrium(self) -> bool:
        """Whether the operating point is an equilibrium."""
        return bool(np.max(np.abs(self.affine), initial=0.0) <= EQUILIBRIUM)

    def loop(self, *wires: str, lifted: bool = False) -> Any:
        """Return the loop transfer function L at a wire, all other loops closed: S = 1/(1 + L).

        The wire is cut behind the port, for all its consumers; L = −(what comes back) / (what is injected). With
        several wires, or a wire with several entries, L is the matrix of the loops cut all at once. Over a period of
        several ticks it begins where the wire is renewed. Closing L is checked to give the diagram's poles.

        Parameters
        ----------
        *wires : str
            Names of wires, paths of ports, or entries of them: ``"motor_force"``, ``"motor_force[0]"``.
        lifted : bool, default: False
            Whether a wire that is renewed several times in the model's period gets one channel for each renewal:
            ``"u@0"``, ``"u@1"``, …. A common factor of all of them is a gain in the wire.

        Returns
        -------
        control.StateSpace

        Raises
        ------
        OptionError
            In a model over a period, a wire that changes between ticks and is used there: a held injection, seen at
            ticks, is not its loop.
        WiringError
            A wire that is renewed several times in the model's period, unless ``lifted``: its loop is periodic.
        ConfirmationError
            If closing L does not give the diagram's own poles.
        """
        cut = self._at(wires, openings=wires, loop="lifted" if lifted else "one")
        return cut._state_space(-cut.C, -cut.D, f"L({', '.join(wires)})")

    def sensitivity(self, *wires: str) -> Any:
        """Return S at a wire: from what is injected there to what its consumers get, all loops closed.

        Over a period of several ticks, the injected signal is held from where the wire is renewed to the next period.
        At a wire that is renewed several times in it, this is not 1/(1 + L), as there is no L at one rate.
        """
        closed = self._at(wires)
        return closed._state_space(closed.C, closed.D + np.eye(len(closed.D)), f"S({', '.join(wires)})")

    def complementary(self, *wires: str) -> Any:
        """Return T = 1 − S at a wire."""
        closed = self._at(wires)
        return closed._state_space(-closed.C, -closed.D, f"T({', '.join(wires)})")

    def _at(self, wires: tuple[str, ...], openings: tuple[str, ...] = (), loop: str = "") -> Linearization:
        if not wires:
            raise OptionError(
                "no wire was named. Name one, such as .loop('v_perp').", block=self.diagram.name, port="wires"
            )
        more: dict[str, Any] = {"plants": self.plants, "step": self.step}
        flat = self.diagram.flatten(self.point.base)
        at, shift = self.point, 0
        if self.dt and period_of(flat) > 1:
            shift = ticks_to_renewal(flat, [find_signal(flat, w).port for w in wires], at.tick)
            at = moved(flat, at, self.plants, shift)
        made = _linearize(self.diagram, at, wires, wires, openings, loop=loop, **more)
        if loop:
            own = not shift and not self.openings
            closed = self if own else _linearize(self.diagram, at, (), (), (), **more)
            cut = Model((made.A, made.B, made.C, made.D), made.dt, [], made.affine, uncertainty=made.uncertainty)
            confirm_closed(cut, closed.A, wires, self.diagram.name)
        return made


def linearize(
    diagram: WiredDiagram,
    point: Any = None,
    *,
    inputs: str | Iterable[str] = (),
    outputs: str | Iterable[str] = (),
    openings: str | Iterable[str] = (),
    plants: str | None = None,
    **options: Any,
) -> Linearization:
    """Linearize a diagram; see `Diagram.linearize`."""
    check_options(diagram, options, "linearize")
    at = operating_point(diagram, point, options)
    diagram = diagram.replace(at.parameters) if at.parameters else diagram  # what a trim has found belongs to it
    return _linearize(diagram, at, inputs, outputs, openings, plants=plants, step=options.get("step"))


def _linearize(
    diagram: WiredDiagram,
    at: OperatingPoint,
    inputs: str | Iterable[str],
    outputs: str | Iterable[str],
    openings: str | Iterable[str],
    *,
    plants: str | None,
    step: Any,
    loop: str = "",
) -> Linearization:
    if step is not None and exact_time(step, block=diagram.name) != at.base and (diagram.has_clock or diagram.has_fmu):
        raise OptionError(
            f"found step={step!r}, but the operating point stands on ticks of {float(at.base):g} s. Make the operating "
            "point with this step, or leave the step away.",
            block=diagram.name,
            port="step",
        )
    names = [_names(n) for n in (inputs, outputs, openings)]
    flat = diagram.flatten(at.base)
    at.check_fits(flat, diagram.name)
    _refuse(flat)
    found = [[find_signal(flat, n) for n in group] for group in names]
    for signal in found[2]:
        _check_opening(flat, signal)
    parts, channels = Parts(flat, found[0], found[1], found[2]), list[str]()
    if diagram.has_clock or (diagram.has_fmu and step is not None):
        if loop:
            _check_loop(flat, parts, at)
        if loop and period_of(flat) > 1:
            model, channels = loop_model(flat, parts, at, plants, lifted=loop == "lifted")
        else:
            model = discrete(flat, parts, at, plants)
    else:
        model = _continuous(diagram, flat, parts, at, plants)
    A, B, C, D = model.matrices
    n, ins, outs = len(A), *(tuple(e for s in group for e in s.labels) for group in found[:2])
    if channels:
        ins = outs = tuple(channels)
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
        derivations={**opaque, **model.derivations},
        uncertainty=model.uncertainty,
        memory=model.memory,
        openings=tuple(names[2]),
        findings=(*steps_only(flat), *model.findings),
        plants=plants,
        step=step,
    )


def _check_loop(flat: FlatDiagram, parts: Parts, at: OperatingPoint) -> None:
    moving = moves_between(flat, parts, at)
    if moving:
        raise OptionError(
            f"{moving[0]!r} changes between ticks, and blocks in continuous time use it there, so that the loop is not "
            "closed at ticks. Take the loop at a sampled signal, of the continuous parts alone, or of "
            "diagram.continuous().",
            block=parts.inputs[0].port[0],
            port=parts.inputs[0].port[1],
        )


def _names(given: str | Iterable[str]) -> list[str]:
    return [given] if isinstance(given, str) else list(given)


def _refuse(flat: FlatDiagram) -> None:
    for path in sorted(flat.table.blocks):
        if flat.table.blocks[path].transport and path not in flat.checked.traced:
            raise WiringError(
                "a transport delay in continuous time has no finite linear model. Put it into a sampled subsystem, "
                "where it is a delay by whole samples, or take PadeDelay(delay=…, order=…) in its place.",
                block=path,
            )


def _check_opening(flat: FlatDiagram, signal: Signal) -> None:
    if signal.port in {(w.block, w.port) for w in flat.table.wires.values()}:
        return
    raise WiringError(
        f"nothing is wired to it, so there is nothing to cut at {signal.name!r}. Name a wire that closes a loop.",
        block=signal.port[0],
        port=signal.port[1],
    )


def _continuous(
    diagram: WiredDiagram, flat: FlatDiagram, parts: Parts, at: OperatingPoint, plants: str | None
) -> Model:
    """Return the model of a diagram that is continuous throughout."""
    J = parts.at(NONE, at.t, at.x, at.w)
    models = continuous_models(flat, at, plants)
    xc = flat.continuous
    Ap, Bp, Cp, Dp = (joined(flat, models, which) for which in "ABCD")
    # w = Cp xp + Dp z, z = Zx x + Zw w + Zd d
    loop = np.eye(len(at.w)) - Dp @ J["z", "w"]
    if loop.size and not np.linalg.cond(loop) < 1e12:
        raise OptionError(
            "the FMU's outputs depend on themselves through its feedthrough, and the linear loop has no unique "
            "solution. Wire an output without feedthrough, or linearize at a step, step=….",
            block=diagram.name,
        )
    zx = J["z", "x"][:, xc]
    w_of = {k: np.linalg.solve(loop, v) for k, v in (("x", Dp @ zx), ("p", Cp), ("d", Dp @ J["z", "d"]))}
    z_of = {
        "x": zx + J["z", "w"] @ w_of["x"],
        "p": J["z", "w"] @ w_of["p"],
        "d": J["z", "d"] + J["z", "w"] @ w_of["d"],
    }

    def through(what: str) -> list[np.ndarray]:
        by_w = J[what, "w"]
        return [J[what, "x"][:, xc] + by_w @ w_of["x"], by_w @ w_of["p"], J[what, "d"] + by_w @ w_of["d"]]

    fx, fp, fd = through("dx")
    yx, yp, yd = through("y")
    A = np.block([[fx, fp], [Bp @ z_of["x"], Ap + Bp @ z_of["p"]]])
    B = np.vstack([fd, Bp @ z_of["d"]])
    return Model(
        (A, B, np.hstack([yx, yp]), yd),
        0.0,
        flat.continuous_labels + states_of(models),
        np.concatenate([J["dx"], *(m.f for m in models)]),
        {m.path: m.derivation for m in models},
        max((m.uncertainty for m in models), default=0.0),
    )


def batch(
    diagram: WiredDiagram,
    points: Iterable[Any] = (None,),
    variants: Iterable[Mapping[str, Any]] = ({},),
    **options: Any,
) -> list[Linearization]:
    """Linearize at several operating points, and with several parameters; see `Diagram.linearize_batch`."""
    made, points = [], list(points)
    for changes in variants:
        point: Any = None
        try:
            variant = diagram.replace(changes) if changes else diagram
            for point in points:
                made.append(linearize(variant, point, **options))
        except LoopwrightError as error:
            error.add(f" (with {dict(changes)}, at {point!r})")
            raise
    return made
