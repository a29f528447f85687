"""Linearization of a diagram: the very functions that are simulated, differentiated at an operating point.

Where all is continuous, dx/dt = A x + B d with the exact Jacobians of the flow, FMUs by their linear models. Where
something is sampled, the model is discrete, over one base period or, with several rates, their least common period: a
tick is the derivative of the tick's function, the time to the next one that of the flow over it (a matrix exponential at
an equilibrium, else the variational equation along the motion), an FMU's that of its step. So hold and delay are exact.

The state of a discrete model is that of all blocks and FMUs just before a tick, and for an FMU the inputs that still act
on its outputs: a co-simulation FMU's outputs are those at the end of its last step.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from ..blocks._errors import LoopwrightError, OptionError, WiringError
from ._flat import FlatDiagram
from ._linear_parts import Parts, Signal, find_signal
from ._operating_point import OperatingPoint, capture, names_of_states, operating_point
from ._plant_models import PlantModel, continuous_models, step_models

if TYPE_CHECKING:
    from ._diagram import Diagram

EQUILIBRIUM = 1e-9
"""Up to this residual an operating point counts as an equilibrium."""


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
        What the model's states change by at the operating point itself, per second or per period: zero at an equilibrium.
    how : mapping
        How the derivative of each FMU was found, by path.
    uncertainty : float
        Largest estimated error of an entry of an FMU's linear model, where it was differenced; 0 where it is exact.
    memory : tuple of str
        States that are only a warm start (a projection's last foot point): their poles at z = 0 are no design poles.
    openings : tuple of str
        The wires that were cut.
    """

    diagram: Diagram
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
    how: Mapping[str, str] = field(default_factory=dict)
    uncertainty: float = 0.0
    memory: tuple[str, ...] = ()
    openings: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict, repr=False)

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
        return StateSpace(self.A, self.B, C, D, self.dt, name=name, remove_useless_states=False, **names)

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

    def loop(self, *wires: str) -> Any:
        """Return the loop transfer function L at a wire, all other loops closed: S = 1/(1 + L).

        The wire is cut behind the port, for all its consumers; L = −(what comes back) / (what is injected). With several
        wires, or a wire with several entries, L is the matrix of the loops cut all at once.

        Parameters
        ----------
        *wires : str
            Names of wires, or paths of ports.

        Returns
        -------
        control.StateSpace
        """
        cut = linearize(self.diagram, self.point, inputs=wires, outputs=wires, openings=wires, **self.options)
        return cut._state_space(-cut.C, -cut.D, f"L({', '.join(wires)})")

    def sensitivity(self, *wires: str) -> Any:
        """Return S at a wire: from what is injected there to what its consumers get, all loops closed."""
        closed = linearize(self.diagram, self.point, inputs=wires, outputs=wires, **self.options)
        return closed._state_space(closed.C, closed.D + np.eye(len(closed.D)), f"S({', '.join(wires)})")

    def complementary(self, *wires: str) -> Any:
        """Return T = 1 − S at a wire."""
        closed = linearize(self.diagram, self.point, inputs=wires, outputs=wires, **self.options)
        return closed._state_space(-closed.C, -closed.D, f"T({', '.join(wires)})")


def linearize(
    diagram: Diagram,
    point: Any = None,
    *,
    inputs: str | Iterable[str] = (),
    outputs: str | Iterable[str] = (),
    openings: str | Iterable[str] = (),
    plants: str | None = None,
    **options: Any,
) -> Linearization:
    """Linearize a diagram; see `Diagram.linearize`."""
    chosen = {"step": options.pop("step", None), **options}
    at = operating_point(diagram, point, chosen)
    names = [_names(n) for n in (inputs, outputs, openings)]
    discrete = _is_discrete(diagram, chosen.get("step"))
    flat = diagram.flatten(at.base)
    _refuse(flat, diagram)
    found = [[find_signal(flat, n) for n in group] for group in names]
    for signal in found[2]:
        _check_opening(flat, signal)
    parts = Parts(flat, *found, at.values)
    make = _discrete if discrete else _continuous
    (A, B, C, D), dt, states, affine, how, uncertainty, memory = make(diagram, flat, parts, at, plants, chosen)
    kept = {"plants": plants, **chosen}
    n, ins, outs = len(A), *(tuple(e for s in group for e in s.labels) for group in found[:2])
    shaped = A, B.reshape(n, len(ins)), C.reshape(len(outs), n), D.reshape(len(outs), len(ins))
    return Linearization(diagram, *shaped, dt, tuple(states), ins, outs, at, affine, how, uncertainty, memory, tuple(names[2]), kept)


def _names(given: str | Iterable[str]) -> list[str]:
    return [given] if isinstance(given, str) else list(given)


def _is_discrete(diagram: Diagram, step: Any) -> bool:
    return diagram.has_clock or (diagram.has_fmu and step is not None)


def _refuse(flat: FlatDiagram, diagram: Diagram) -> None:
    for path in sorted(flat.table.blocks):
        if flat.table.blocks[path].transport and path not in flat.checked.traced:
            raise WiringError(
                "a transport delay in continuous time has no finite linear model. Put it into a sampled subsystem, where it "
                "is a delay by whole samples, or take PadeDelay(delay=…, order=…) in its place.",
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


def _memory(flat: FlatDiagram, names: list[str]) -> tuple[str, ...]:
    found = []
    for path, where in flat.states.slices.items():
        if flat.table.blocks[path].memory:
            found += names[where]
    return tuple(found)


# --- continuous ------------------------------------------------------------------------------------------------------


def _continuous(
    diagram: Diagram, flat: FlatDiagram, parts: Parts, at: OperatingPoint, plants: str | None, options: Any
) -> Any:
    """Return the model of a diagram that is continuous throughout."""
    J = parts.at(None, at.t, at.x, at.w)
    models = continuous_models(flat, at, plants)
    xc = flat.continuous
    Ap, Bp, Cp, Dp = (_joined(flat, models, which) for which in "ABCD")
    n_p = len(Ap)
    # w = Cp xp + Dp z, z = Zx x + Zw w + Zd d
    loop = np.eye(len(at.w)) - Dp @ J["z", "w"]
    try:
        solved = np.linalg.inv(loop)
    except np.linalg.LinAlgError:
        raise OptionError(
            "the FMU's outputs depend on themselves through its feedthrough, and the linear loop has no unique solution. "
            "Wire an output without feedthrough, or linearize at a step, step=….",
            block=diagram.name,
        ) from None
    zx = J["z", "x"][:, xc]
    w_of = {"x": solved @ (Dp @ zx), "p": solved @ Cp, "d": solved @ (Dp @ J["z", "d"])}
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
    states = [names_of_states(flat)[i] for i in xc] + _plant_states(models)
    matrices = A, B, np.hstack([yx, yp]), yd
    affine = np.concatenate([J["dx"], *(m.f for m in models)]) if n_p or len(xc) else np.zeros(0)
    return matrices, 0.0, states, affine, {m.path: m.how for m in models}, max((m.uncertainty for m in models), default=0.0), ()


def _joined(flat: FlatDiagram, models: Sequence[PlantModel], which: str) -> np.ndarray:
    """Return one matrix of all FMUs side by side: rows and columns as x_p, z and w are ordered."""
    n = sum(len(m.A) for m in models)
    shape = {
        "A": (n, n),
        "B": (n, flat.plant_inputs.total),
        "C": (flat.plant_outputs.total, n),
        "D": (flat.plant_outputs.total, flat.plant_inputs.total),
    }[which]
    M, row = np.zeros(shape), 0
    for m in models:
        own = slice(row, row + len(m.A))
        row += len(m.A)
        rows, columns = {"A": (own, own), "B": (own, m.inputs), "C": (m.outputs, own), "D": (m.outputs, m.inputs)}[which]
        M[np.ix_(_list(rows), _list(columns))] = getattr(m, which)
    return M


def _list(entries: Any) -> list[int]:
    return list(range(entries.start, entries.stop)) if isinstance(entries, slice) else list(entries)


def _plant_states(models: Sequence[PlantModel]) -> list[str]:
    return [name for m in models for name in m.states]


# --- discrete --------------------------------------------------------------------------------------------------------


def _discrete(
    diagram: Diagram, flat: FlatDiagram, parts: Parts, at: OperatingPoint, plants: str | None, options: Any
) -> Any:
    """Return the model over the least common period of all clocks."""
    period = _period(flat)
    points = [at] if period == 1 else _following(diagram, at, period, options)
    total: tuple[np.ndarray, np.ndarray] | None = None
    C = D = np.zeros((0, 0))
    how: dict[str, str] = {}
    uncertainty = 0.0
    first: Any = None
    for here in points:
        M, N, c, d, info = _one_period(flat, parts, here, plants)
        how |= info["how"]
        uncertainty = max(uncertainty, info["uncertainty"])
        if total is None:
            total, C, D, first = (M, N), c, d, info
        else:
            total = (M @ total[0], M @ total[1] + N)
    assert total is not None
    A, B = total
    affine = _affine(flat, points[-1], info)
    keep = _reachable(A, C, first["states"], flat)
    labels = [first["states"][i] for i in keep]
    A, B, C = A[np.ix_(keep, keep)], B[keep], C[:, keep]
    memory = tuple(m for m in _memory(flat, names_of_states(flat)) if m in labels)
    return (A, B, C, D), float(flat.base * period), labels, affine[keep], how, uncertainty, memory


def _period(flat: FlatDiagram) -> int:
    return math.lcm(*(clock.every for clock in flat.distinct)) if flat.distinct else 1


def _following(diagram: Diagram, at: OperatingPoint, count: int, options: Any) -> list[OperatingPoint]:
    """Return the operating points of a least common period, from ``at`` on."""
    from ._simulation import Simulation

    if at.how != "run":
        return [_shifted(at, i) for i in range(count)]
    given = {**options, "step": at.base}
    points = []
    with Simulation(diagram, **given) as simulation:
        if at.t > 0:
            simulation.advance(at.t)
        points.append(capture(simulation))
        for _ in range(count - 1):
            simulation.advance(float(at.base))
            points.append(capture(simulation))
    return points


def _shifted(at: OperatingPoint, i: int) -> OperatingPoint:
    from dataclasses import replace

    return replace(at, tick=at.tick + i, t=at.t + i * float(at.base))


def _one_period(flat: FlatDiagram, parts: Parts, at: OperatingPoint, plants: str | None) -> Any:
    """Return the derivative of the way from just before one tick to just before the next one.

    States: x of the diagram, states of the FMUs, inputs of the FMUs since the last tick.
    """
    h = float(flat.base)
    nx, nz, nw = flat.width, flat.plant_inputs.total, flat.plant_outputs.total
    models = step_models(flat, at, h, plants)
    Ap, Bp, Cp, Dp = (_joined(flat, models, which) for which in "ABCD")
    n_p, m = len(Ap), parts.n_inputs
    n = nx + n_p + nz
    tick = parts.at(flat.acting(at.tick), at.t, at.x, at.w)
    W = np.zeros((nw, n))  # the FMUs' outputs before the tick
    W[:, nx : nx + n_p], W[:, nx + n_p :] = Cp, Dp
    X = np.zeros((nx, n))
    X[:, :nx] = np.eye(nx)

    def after(what: str) -> tuple[np.ndarray, np.ndarray]:
        return tick[what, "x"] @ X + tick[what, "w"] @ W, tick[what, "d"]

    x_of, x_by_d = after("x")
    z_of, z_by_d = after("z")
    y_of, y_by_d = after("y")
    if flat.continuous.size:
        x1 = at.x.copy()
        x1[:] = tick["x"]
        E, Ew, Ed = transition(flat, parts, at, x1, h)
        x_of, x_by_d = E @ x_of + Ew @ W, E @ x_by_d + Ed
    M, N = np.zeros((n, n)), np.zeros((n, m))
    M[:nx], N[:nx] = x_of, x_by_d
    P = np.zeros((n_p, n))
    P[:, nx : nx + n_p] = Ap
    M[nx : nx + n_p], N[nx : nx + n_p] = P + Bp @ z_of, Bp @ z_by_d
    M[nx + n_p :], N[nx + n_p :] = z_of, z_by_d
    names = names_of_states(flat) + _plant_states(models) + [f"held({e})" for e in _input_names(flat)]
    info = {
        "states": names,
        "how": {model.path: model.how for model in models},
        "uncertainty": max((model.uncertainty for model in models), default=0.0),
        "x_next": tick["x"],
        "z": tick["z"],
        "models": models,
    }
    return M, N, y_of, y_by_d, info


def _input_names(flat: FlatDiagram) -> list[str]:
    from ._operating_point import elements

    return [e for name, shape in flat.plant_inputs.shapes.items() for e in elements(name, shape)]


def transition(
    flat: FlatDiagram, parts: Parts, at: OperatingPoint, x1: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivative of x after the time h by x at its beginning, by w and by d, all but the continuous states held.

    At an equilibrium of the continuous states it is a matrix exponential; elsewhere the variational equation is
    integrated along the motion (DOP853 at 1e-11).
    """
    from scipy.linalg import expm

    xc = flat.continuous
    nc, nx, nw, m = len(xc), flat.width, len(at.w), parts.n_inputs
    t = at.t

    def slopes(time: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = x1.copy()
        x[xc] = state
        J = parts.at(None, time, x, at.w)
        rest = J["dx", "x"].copy()
        rest[:, xc] = 0.0
        return np.hstack([J["dx", "x"][:, xc], rest, J["dx", "w"], J["dx", "d"]]), J["dx"]

    start = x1[xc]
    F, f0 = slopes(t, start)
    many = nx + nw + m
    if np.max(np.abs(f0) / (1.0 + np.abs(start)), initial=0.0) <= EQUILIBRIUM:
        big = np.zeros((nc + many, nc + many))
        big[:nc] = F
        whole = expm(big * h)[:nc]
    else:
        from scipy.integrate import solve_ivp

        def rates(time: float, s: np.ndarray) -> np.ndarray:
            J, dx = slopes(time, s[:nc])
            V = s[nc:].reshape(nc, nc + many)
            forced = J[:, :nc] @ V
            forced[:, nc:] += J[:, nc:]
            return np.concatenate([dx, forced.ravel()])

        V0 = np.hstack([np.eye(nc), np.zeros((nc, many))])
        s0 = np.concatenate([start, V0.ravel()])
        found = solve_ivp(rates, (t, t + h), s0, method="DOP853", rtol=1e-11, atol=1e-13)
        whole = found.y[nc:, -1].reshape(nc, nc + many)
    E, Ew, Ed = np.eye(nx), np.zeros((nx, nw)), np.zeros((nx, m))
    E[np.ix_(xc, xc)] = whole[:, :nc]
    rest = whole[:, nc : nc + nx]
    E[xc] += rest
    Ew[xc], Ed[xc] = whole[:, nc + nx : nc + nx + nw], whole[:, nc + nx + nw :]
    return E, Ew, Ed


def _affine(flat: FlatDiagram, last: OperatingPoint, info: Any) -> np.ndarray:
    """Return by how much the model's states change over the first tick at the operating point itself."""
    changes = [info["x_next"] - last.x]
    rates = np.ravel(np.array(flat.flow(last.t, last.x, last.w, flat.p))) if flat.continuous.size else np.zeros(0)
    changes[0][flat.continuous] = rates * float(flat.base)
    for model in info["models"]:
        changes.append(model.f - model.x0)
    changes.append(np.zeros(flat.plant_inputs.total))
    return np.concatenate(changes)


def _reachable(A: np.ndarray, C: np.ndarray, names: list[str], flat: FlatDiagram) -> list[int]:
    """Return the states that act on anything: all but those that only record, such as what is held since a tick.

    States of blocks and FMUs stay, whatever they act on.
    """
    own = set(range(flat.states.total))
    plants = set(range(flat.width, len(names) - flat.plant_inputs.total))
    keep = list(range(len(A)))
    while True:
        gone = [
            j
            for j in keep
            if j not in own | plants and not np.any(A[np.ix_([i for i in keep if i != j], [j])]) and not np.any(C[:, j])
        ]
        if not gone:
            return keep
        keep = [j for j in keep if j not in gone]


def batch(
    diagram: Diagram, points: Iterable[Any] = (None,), variants: Iterable[Mapping[str, Any]] = ({},), **options: Any
) -> list[Linearization]:
    """Linearize at several operating points, and with several parameters; see `Diagram.linearize_batch`."""
    made = []
    for changes in variants:
        variant = diagram.replace(changes) if changes else diagram
        for point in points:
            try:
                made.append(linearize(variant, point, **options))
            except LoopwrightError as error:
                error.message = f"{error.message} (with {dict(changes)}, at {point!r})"
                raise
    return made
