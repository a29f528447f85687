"""Comparison of a diagram's plant with its reduced model in `AdmittanceLoop`.

The reduced model is p̈ = G_v (u + F) + S ṗ + constant with S = ∂f_v/∂x_v: four states, no stiffness. It is compared
with the plant's own linear model in the coordinates (position, velocity): `Fmu.linear_model` of an FMU, the traced
Jacobian of a block. Each entry must agree within ten times the error that the linear model states for it, plus
rounding; the factor is there because the error of differences is an estimate. An error that is large compared with the
controller's gains shows nothing, and the plant is refused too.

Both models are taken at the same position and velocity, under the motor force that leaves the plant without
acceleration.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn, cast

import numpy as np

from ...blocks import PlanarModel
from ...blocks.core import Array, Layout, LoopwrightError, ParameterError
from ...blocks.path_following import PlanarSlopes, planar_slopes
from ...fmus.fmu_block import FmuLinearization
from ..linearization import linearize_block, operating_point

if TYPE_CHECKING:
    from ...fmus.fmu_block import Fmu
    from ..flat import WiredDiagram
    from ..results import OperatingPoint

STATES = 4
"""Number of states of the reduced model: position and velocity, two axes each."""
ROUNDING = 1e-12
"""Error of rounding, relative to the natural size of an entry."""
ESTIMATED = 10.0
"""Factor by which a stated error may be too small: that of differences is an estimate."""
CERTAIN = 1e-4
"""Largest stated error of an entry, relative to its natural size, with which a comparison shows anything."""
_PASSES = 8
"""Passes of Newton's method."""
_AT = 1e-9
"""Distance from the point, relative to 1 + its size, at which Newton's method ends."""
_SAME_PLACE = 1e-6
"""Distance in m within which a plant's discrete states hold."""
_LINEARIZE = "Linearize the diagram itself in place of the reduced loop"

Linearizer = Callable[[np.ndarray | None, np.ndarray | None], FmuLinearization]


class EntryPair(NamedTuple):
    """Entries of the plant's linear model and of the reduced model, with the stated error and their natural size."""

    found: np.ndarray
    expected: np.ndarray
    error: np.ndarray
    size: np.ndarray

    @property
    def agrees(self) -> bool:
        """Whether they agree within the stated error and rounding."""
        return bool(np.all(np.abs(self.found - self.expected) <= ESTIMATED * self.error + ROUNDING * self.size))

    @property
    def is_certain(self) -> bool:
        """Whether the stated error is small enough to show anything."""
        return bool(np.all(ESTIMATED * self.error <= CERTAIN * self.size))


def check_plant(
    diagram: WiredDiagram,
    path: str,
    model: PlanarModel,
    *,
    rate: float,
    frame: np.ndarray | None = None,
    position: Array | None = None,
    velocity: Array | None = None,
    point: OperatingPoint | None = None,
) -> None:
    """Refuse a plant whose linear model is not that of the reduced, Cartesian model.

    ``rate`` of the controller in 1/s is the measure for errors, ``frame`` = [t n] that of masses in their texts (the
    axes without it). Both models are taken at ``position`` in m and ``velocity`` in m/s, those of the plant without
    them. ``point`` gives the plant's other states; its start without it.
    """
    try:
        linear = _linearize_at(
            path, _make_linearizer(diagram, path, point), is_discrete(diagram, path), position, velocity
        )
    except ParameterError:
        raise
    except (LoopwrightError, ArithmeticError, RuntimeError, NotImplementedError) as error:
        text = error.message.rstrip(".") if isinstance(error, LoopwrightError) else f"{type(error).__name__}: {error}"
        raise ParameterError(
            f"found no linear model ({text}); expected one to compare with the reduced model. "
            "Build the AdmittanceLoop by hand if the plant is known to be rigid.",
            block=path,
        ) from error
    place, speed = (linear.y0[_entries(linear.outputs, port)] for port in ("position", "velocity"))
    _compare(path, linear, planar_slopes(model, place, speed), rate, np.eye(2) if frame is None else frame)


def _refuse(path: str, port: str, found: str, expected: str, then: str) -> NoReturn:
    raise ParameterError(f"found {found}; expected {expected}, as in the reduced model. {then}.", block=path, port=port)


# ---- the plant's linear model ----


def is_discrete(diagram: WiredDiagram, path: str) -> bool:
    """Whether a plant has discrete states, which do not follow from its position."""
    block = diagram.blocks[path]
    if block.stepped or block.in_model_exchange:
        variables = cast("Fmu", block).description.variables.values()
        return any(v.variability == "discrete" and v.initial == "exact" for v in variables)
    return any(state.discrete for state in block.states.values())


def _make_linearizer(diagram: WiredDiagram, path: str, point: OperatingPoint | None) -> Linearizer:
    """Return a function from states and inputs, None for those of the point, to the plant's linear model."""
    if not (diagram.blocks[path].stepped or diagram.blocks[path].in_model_exchange):
        return _make_traced_linearizer(diagram, path, point)
    block = cast("Fmu", diagram.blocks[path])
    here: Mapping[str, Any] = {} if point is None else {**point.plants, **point.exchanged}[path]

    def linearize(x: np.ndarray | None, u: np.ndarray | None) -> FmuLinearization:
        about, state = block.description, dict(here.get("state", {}))
        if x is not None:
            state |= about.layout(about.states).split(x)
        inputs = here.get("inputs") if u is None else u
        return block.linear_model(here.get("t", 0.0), state=state, inputs=inputs)

    return linearize


def _make_traced_linearizer(diagram: WiredDiagram, path: str, point: OperatingPoint | None) -> Linearizer:
    """Return the linearizer of a block with equations, by algorithmic differentiation."""
    block, trace = diagram.blocks[path], diagram.checked.traced[path]
    if trace.foreign is not None or trace.advance not in ("derivative", "none"):
        raise ParameterError(
            f"found {type(block).__name__}, whose equations have no derivatives in continuous time; expected a plant "
            f"with a linear model. {_LINEARIZE}.",
            block=path,
        )
    point = operating_point(diagram, None, {}) if point is None else point
    t, here = point.t, point.x[diagram.flatten_like(point).states.slices[path]]
    many = Layout.of(trace.inputs).total

    def linearize(x: np.ndarray | None, u: np.ndarray | None) -> FmuLinearization:
        return linearize_block(block, trace, t, here if x is None else x, np.zeros(many) if u is None else u)

    return linearize


def _entries(names: tuple[str, ...], port: str) -> list[int]:
    """Return the indices of the two elements of a port."""
    return [i for i, name in enumerate(names) if name.partition("[")[0] == port]


def _linearize_at(
    path: str, linearize: Linearizer, discrete: bool, position: Array | None, velocity: Array | None
) -> FmuLinearization:
    """Return the linear model at a position and a velocity, found by Newton's method over states and motor force."""
    m = linearize(None, None)
    if len(m.states) != STATES:
        names = ", ".join(dict.fromkeys(name.partition("[")[0] for name in m.states))
        _refuse(
            path,
            "",
            f"{len(m.states)} states ({names or 'none that it shows'})",
            f"{STATES}, position and velocity of two axes",
            _LINEARIZE,
        )
    rows = _entries(m.outputs, "position") + _entries(m.outputs, "velocity")
    force = _entries(m.inputs, "motor_force")
    wanted = [m.y0[rows][:2] if position is None else position, m.y0[rows][2:] if velocity is None else velocity]
    target = np.concatenate([np.asarray(v, dtype=float) for v in wanted])
    if discrete and np.max(np.abs(target - m.y0[rows])[:2]) > _SAME_PLACE:
        raise ParameterError(
            f"found the position {m.y0[rows][:2].tolist()} m, with discrete states that hold only there; expected "
            f"{target[:2].tolist()} m, the point of the loop. Start the diagram there, or give its point of the path: "
            "eta=…, xi=….",
            block=path,
            port="position",
        )
    for _ in range(_PASSES):
        T = m.C[rows]
        off, moving = target - m.y0[rows], -(T @ m.f)[2:]
        if np.all(np.abs(off) <= _AT * (1.0 + np.abs(target))) and np.all(
            np.abs(moving) <= _AT * (1.0 + np.max(np.abs(m.u0)))
        ):
            return m
        # position and velocity as wanted, and no acceleration: as many equations as states and motor forces
        J = np.block([[T, m.D[np.ix_(rows, force)]], [T[2:] @ m.A, T[2:] @ m.B[:, force]]])
        try:
            step = np.linalg.solve(J, np.concatenate([off, moving]))
        except np.linalg.LinAlgError:
            break
        u = m.u0.copy()
        u[force] += step[STATES:]
        m = linearize(m.x0 + step[:STATES], u)
    _refuse(
        path,
        "",
        "no states and motor force without acceleration",
        f"some at {target[:2].tolist()} m with {target[2:].tolist()} m/s",
        _LINEARIZE,
    )


# ---- the comparison ----


def _compare(path: str, m: FmuLinearization, model: PlanarSlopes, rate: float, E: np.ndarray) -> None:
    """Refuse a linear model whose entries are not those of the reduced model."""
    parts = _pair_entries(m, model, rate)
    M = _inertia_of(E, model.G_v)
    for port, part in parts.items():
        if not part.is_certain:
            _refuse(
                path,
                port,
                f"a linear model ({m.how}) that is uncertain by {np.max(part.error):.3g}",
                f"at most {CERTAIN * np.min(part.size):.3g}",
                "Take an FMU with directional derivatives",
            )
    if not parts["velocity"].agrees:
        _refuse(path, "velocity", "an output that is not the rate of its position", "that rate itself", _LINEARIZE)
    for port in ("motor_force", "external_force"):
        if not parts[port].agrees:
            found = _inertia_of(E, parts[port].found)
            then = "Give the plant as it is, with plant=…, or its parameters to the FMU"
            _refuse(path, port, f"the mass {_describe(found, 'kg')}", _describe(M, "kg"), then)
    inertia = np.linalg.inv(model.G_v)

    def force(entries: np.ndarray) -> np.ndarray:
        return np.asarray(-E.T @ inertia @ entries @ E)

    if not parts["position"].agrees:
        found = force(parts["position"].found)
        _refuse(path, "position", f"the stiffness {_describe(found, 'N/m')}", "none", _LINEARIZE)
    if not parts["friction"].agrees:
        found, expected = (force(v) for v in (parts["friction"].found, parts["friction"].expected))
        then = "Give the plant's friction with plant=…, or the same to both"
        _refuse(path, "velocity", f"the friction slope {_describe(found, 'N s/m')}", _describe(expected, "N s/m"), then)
    if not parts["acceleration"].agrees:
        _refuse(path, "acceleration", "an output that is not the rate of its velocity", "that rate itself", _LINEARIZE)
    if "contact_force" in parts and not parts["contact_force"].agrees:
        _refuse(path, "contact_force", "a force that changes with motion or forces", "a constant one", _LINEARIZE)


def _pair_entries(m: FmuLinearization, model: PlanarSlopes, rate: float) -> dict[str, EntryPair]:
    """Return the entries to compare, by the port that they concern, in the coordinates (position, velocity)."""
    n = len(m.states)
    outputs = {port: _entries(m.outputs, port) for port in ("position", "velocity", "acceleration", "contact_force")}
    u, F = (_entries(m.inputs, port) for port in ("motor_force", "external_force"))
    both, rows = u + F, outputs["position"] + outputs["velocity"]
    U = np.nan_to_num(m.uncertainty)
    # The FMU's states may be any: its outputs position and velocity are the coordinates. Uncertainties go along,
    # as the largest that the products can have.
    T, U_T = m.C[rows], U[n:, :n][rows]
    Ti = np.linalg.inv(T)
    A, B = T @ m.A @ Ti, T @ m.B[:, both]
    U_A = np.abs(T) @ U[:n, :n] @ np.abs(Ti) + U_T @ np.abs(m.A @ Ti) + np.abs(A) @ U_T @ np.abs(Ti)
    U_B = np.abs(T) @ U[:n, n:][:, both] + U_T @ np.abs(m.B[:, both])
    rounded = np.abs(T) @ np.abs(m.A) @ np.abs(Ti)
    G, S = model.G_v, model.slope
    eye, zero, g = np.eye(2), np.zeros((2, 2)), np.max(np.abs(G))
    fast = rate + np.max(np.abs(S))

    def size(*values: float) -> np.ndarray:
        return np.hstack([np.full((2, 2), v) for v in values])

    def read_output(port: str) -> tuple[np.ndarray, np.ndarray]:
        at = outputs[port]
        C = m.C[at] @ Ti
        off = U[n:, :n][at] @ np.abs(Ti) + np.abs(C) @ U_T @ np.abs(Ti)
        return np.hstack([C, m.D[np.ix_(at, both)]]), np.hstack([off, U[n:, n:][np.ix_(at, both)]])

    def pair_output(port: str, C: np.ndarray, D: np.ndarray, natural: np.ndarray) -> EntryPair:
        found, off = read_output(port)
        return EntryPair(found, np.hstack([C, D]), off, natural)

    # Natural sizes of the entries, for motions about as fast as the rate: rounding is judged by them.
    GG, none = np.hstack([G, G]), np.zeros((2, 4))
    states, forces = size(rate, 1.0), size(g / rate, g / rate)
    parts = {
        "velocity": EntryPair(
            np.hstack([A[:2], B[:2], m.D[np.ix_(outputs["velocity"], both)]]),
            np.hstack([zero, eye, none, none]),
            np.hstack([U_A[:2], U_B[:2], U[n:, n:][np.ix_(outputs["velocity"], both)]]),
            np.hstack([states + rounded[:2], forces, forces]),
        ),
        "motor_force": EntryPair(B[2:, :2], G, U_B[2:, :2], size(g)),
        "external_force": EntryPair(B[2:, 2:], G, U_B[2:, 2:], size(g)),
        "position": EntryPair(A[2:, :2], zero, U_A[2:, :2], size(rate**2) + rounded[2:, :2]),
        "friction": EntryPair(A[2:, 2:], S, U_A[2:, 2:], size(fast) + rounded[2:, 2:]),
        "acceleration": pair_output("acceleration", np.hstack([zero, S]), GG, size(rate**2, fast, g, g)),
    }
    if outputs["contact_force"]:
        natural = size(rate**2 / g, rate / g, 1.0, 1.0)
        parts["contact_force"] = pair_output("contact_force", none, none, natural)
    return parts


def _inertia_of(E: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Return the inertia of G_v in a frame; infinite if G_v is singular."""
    inner = E.T @ G @ E
    return np.linalg.inv(inner) if np.linalg.det(inner) else np.full((2, 2), np.inf)


def _describe(X: np.ndarray, unit: str) -> str:
    """Return the text of a matrix in the frame of the path: its diagonal if the rest is zero."""
    X = np.where(np.abs(X) <= ROUNDING * np.max(np.abs(X)), 0.0, X)
    if abs(X[0, 1]) + abs(X[1, 0]) > 1e-9 * np.max(np.abs(X)):
        return f"[[{X[0, 0]:.6g}, {X[0, 1]:.6g}], [{X[1, 0]:.6g}, {X[1, 1]:.6g}]] {unit} along and across the path"
    return f"{X[0, 0]:.6g} {unit} along and {X[1, 1]:.6g} {unit} across the path"
