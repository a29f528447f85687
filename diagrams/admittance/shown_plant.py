"""The plant of a diagram, compared with the reduced model that stands for it in `AdmittanceLoop`.

The reduced model is p̈ = G_v (u + F) + S ṗ + constant with S = ∂f_v/∂x_v: four states, no stiffness. The plant's own
linear model is put beside it, in the coordinates (position, velocity): of an FMU `Fmu.linear_model`, of a block its
traced Jacobian. Each entry must agree within the error that the linear model states for it, tenfold, as that of
differences is an estimate, and rounding. A stated error that is large beside the controller's gains shows nothing,
and is refused too.

Both are taken at the same position and velocity, with the motor force that leaves the plant without acceleration there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np

from ...blocks import PlanarModel
from ...blocks.core.errors import LoopwrightError, ParameterError
from ...fmus.running.derivation import Derivation, DerivativeMethod
from ...fmus.running.linearization import FmuLinearization
from ..linearization.operating_point import operating_point
from .planar import Slopes, slopes

if TYPE_CHECKING:
    from ..flat.wired_diagram import WiredDiagram
    from ..results.operating_point import OperatingPoint

STATES = 4
"""Position and velocity, two axes each."""
ROUNDING = 1e-12
"""What rounding may leave, relative to the natural size of an entry."""
ESTIMATED = 10.0
"""By how much a stated error may be too small: that of differences is an estimate."""
CERTAIN = 1e-4
"""Largest stated error of an entry, relative to its natural size, with which a comparison shows anything."""
_PASSES = 8
_AT = 1e-9  # how near to the point, relative to 1 + its size
_SAME_PLACE = 1e-6  # m, within which discrete states are taken to hold
_LINEARIZE = "Linearize the diagram itself in place of the reduced loop"

Linearizer = Callable[[Any, Any], FmuLinearization]


class Beside(NamedTuple):
    """Entries of the plant beside those of the reduced model, and the size that they have by nature."""

    found: np.ndarray
    expected: np.ndarray
    error: np.ndarray
    size: np.ndarray

    @property
    def agrees(self) -> bool:
        """Whether they agree within the stated error, and rounding."""
        return bool(np.all(np.abs(self.found - self.expected) <= ESTIMATED * self.error + ROUNDING * self.size))

    @property
    def certain(self) -> bool:
        """Whether the stated error is small enough to show anything."""
        return bool(np.all(ESTIMATED * self.error <= CERTAIN * self.size))


def show_plant(
    diagram: WiredDiagram,
    path: str,
    model: PlanarModel,
    *,
    rate: float,
    frame: np.ndarray | None = None,
    position: Any = None,
    velocity: Any = None,
    point: OperatingPoint | None = None,
) -> None:
    """Refuse a plant that is not shown to be a reduced model.

    Parameters
    ----------
    diagram : Diagram
        The diagram.
    path : str
        Path of its plant.
    model : PlanarModel
        The reduced model, Cartesian.
    rate : float
        Rate of the controller in 1/s, beside which errors are small or not.
    frame : ndarray, optional
        [t n], in which masses are told; the axes without it.
    position, velocity : array, optional
        Where both are linearized, in m and m/s; where the plant is without them.
    point : OperatingPoint, optional
        An instant of the diagram, from which the plant's other states are taken; its start without it.

    Raises
    ------
    ParameterError
        If the plant has no linear model, another number of states, or other entries.
    """
    try:
        linear = _at(path, _linearizer(diagram, path, point), is_discrete(diagram, path), position, velocity)
    except ParameterError:
        raise
    except LoopwrightError as error:
        raise ParameterError(
            f"found no linear model of it ({error.message.rstrip('.')}); expected one, to compare with the reduced "
            "model. Build the AdmittanceLoop by hand, if the plant is known to be rigid.",
            block=path,
        ) from error
    except (ArithmeticError, RuntimeError, NotImplementedError) as error:
        raise ParameterError(
            f"found no linear model of it ({type(error).__name__}: {error}); expected one, to compare with the reduced "
            "model. Build the AdmittanceLoop by hand, if the plant is known to be rigid.",
            block=path,
        ) from error
    place, speed = (linear.y0[_entries(linear.outputs, port)] for port in ("position", "velocity"))
    _compare(path, linear, slopes(model, place, speed), rate, np.eye(2) if frame is None else frame)


def _refuse(path: str, port: str, found: str, expected: str, then: str) -> NoReturn:
    raise ParameterError(
        f"found {found}; expected {expected}, as the reduced model has. {then}.", block=path, port=port
    )


# ---- its linear model ----


def is_discrete(diagram: WiredDiagram, path: str) -> bool:
    """Whether a plant has discrete states, which its position doesn't tell."""
    block: Any = diagram.blocks[path]
    if block.stepped:
        return any(v.variability == "discrete" and v.initial == "exact" for v in block.description.variables.values())
    return any(state.discrete for state in block.states.values())


def _linearizer(diagram: WiredDiagram, path: str, point: OperatingPoint | None) -> Linearizer:
    """Return a function from states and inputs, None for those of the point, to the plant's linear model there."""
    block: Any = diagram.blocks[path]
    if not block.stepped:
        return _traced(diagram, path, point)
    here: Any = {} if point is None else point.plants[path]

    def linear(x: Any, u: Any) -> FmuLinearization:
        about, state = block.description, dict(here.get("state", {}))
        if x is not None:
            first = 0
            for name in about.states:
                variable = about.variables[name]
                state[name] = x[first : first + variable.size].reshape(variable.shape)
                first += variable.size
        inputs = here.get("inputs") if u is None else u
        made: FmuLinearization = block.linear_model(here.get("t", 0.0), state=state, inputs=inputs)
        return made

    return linear


def _traced(diagram: WiredDiagram, path: str, point: OperatingPoint | None) -> Linearizer:
    """Return the same for a block, by algorithmic differentiation."""
    import casadi as ca

    block, trace = diagram.blocks[path], diagram.checked.traced[path]
    if trace.foreign is not None or trace.advance not in ("derivative", "none"):
        raise ParameterError(
            f"found {type(block).__name__}, whose equations can't be differentiated in continuous time; expected a "
            f"plant with a linear model. {_LINEARIZE}.",
            block=path,
        )
    point = operating_point(diagram, None, {}) if point is None else point
    t, here = point.t, point.x[diagram.flatten(point.base).states.slices[path]]
    names = [tuple(_elements(ports)) for ports in (trace.states, trace.inputs, trace.outputs)]
    x, ports = ca.MX.sym("x", len(names[0])), [ca.MX.sym(n, int(np.prod(s))) for n, s in trace.inputs.items()]
    results = trace.function(t, x, *ports, trace.pack(block, np.inf))
    outputs, rates = results[: len(trace.outputs)], results[len(trace.outputs)]
    u, values = ca.vertcat(*ports), ca.vertcat(rates, *outputs)
    function = ca.Function("linear", [x, u], [ca.jacobian(values, ca.vertcat(x, u)), values])

    def linear(at: Any, inputs: Any) -> FmuLinearization:
        x0 = here if at is None else at
        u0 = np.zeros(len(names[1])) if inputs is None else inputs
        J, y = (np.array(v.full()) for v in function(x0, u0))
        n, y = len(x0), y[:, 0]
        exact = np.zeros(J.shape)
        return FmuLinearization(
            J[:n, :n], J[:n, n:], J[n:, :n], J[n:, n:], names[0], names[1], names[2], t, None,
            x0=x0, u0=u0, f=y[:n], y0=y[n:], derivation=Derivation(DerivativeMethod.TRACED), uncertainty=exact,
        )  # fmt: skip

    return linear


def _elements(ports: Any) -> list[str]:
    return [f"{name}[{i + 1}]" for name, shape in ports.items() for i in range(int(np.prod(shape)))]


def _entries(names: tuple[str, ...], port: str) -> list[int]:
    """Return where the two elements of a port are."""
    return [i for i, name in enumerate(names) if name.partition("[")[0] == port]


def _at(path: str, linear: Linearizer, discrete: bool, position: Any, velocity: Any) -> FmuLinearization:
    """Return the linear model at a position and a velocity, by Newton's method over states and motor force."""
    m = linear(None, None)
    if len(m.states) != STATES:
        names = ", ".join(dict.fromkeys(name.partition("[")[0] for name in m.states))
        _refuse(
            path,
            "",
            f"{len(m.states)} states ({names or 'none that it shows'})",
            f"{STATES}, position and velocity in two axes",
            _LINEARIZE,
        )
    rows = _entries(m.outputs, "position") + _entries(m.outputs, "velocity")
    force = _entries(m.inputs, "motor_force")
    wanted = [m.y0[rows][:2] if position is None else position, m.y0[rows][2:] if velocity is None else velocity]
    target = np.concatenate([np.asarray(v, dtype=float) for v in wanted])
    if discrete and np.max(np.abs(target - m.y0[rows])[:2]) > _SAME_PLACE:
        raise ParameterError(
            f"found the position {m.y0[rows][:2].tolist()} m, and discrete states that hold there; expected "
            f"{target[:2].tolist()} m, where the loop is reduced. Start the diagram there, or give the point of the "
            "path at which it is: eta=…, xi=….",
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
        J = np.block([[T, m.D[np.ix_(rows, force)]], [T[2:] @ m.A, T[2:] @ m.B[:, force]]])
        try:
            step = np.linalg.solve(J, np.concatenate([off, moving]))
        except np.linalg.LinAlgError:
            break
        u = m.u0.copy()
        u[force] += step[STATES:]
        m = linear(m.x0 + step[:STATES], u)
    _refuse(
        path,
        "",
        "no states and motor force with which it stays",
        f"a plant that can be at {target[:2].tolist()} m, with {target[2:].tolist()} m/s",
        _LINEARIZE,
    )


# ---- the comparison ----


def _compare(path: str, m: FmuLinearization, model: Slopes, rate: float, E: np.ndarray) -> None:
    """Refuse a linear model with other entries than the reduced one's."""
    parts = _beside(m, model, rate)
    M = _masses(E, model.G_v)
    for port, part in parts.items():
        if not part.certain:
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
            found = _masses(E, parts[port].found)
            then = "Give the plant as it is, with plant=…, or its parameters to the FMU"
            _refuse(path, port, f"the mass {_told(found, 'kg')}", _told(M, "kg"), then)
    inertia = np.linalg.inv(model.G_v)

    def force(entries: np.ndarray) -> np.ndarray:
        return np.asarray(-E.T @ inertia @ entries @ E)

    if not parts["position"].agrees:
        found = force(parts["position"].found)
        _refuse(path, "position", f"the stiffness {_told(found, 'N/m')}", "none", _LINEARIZE)
    if not parts["friction"].agrees:
        found, expected = (force(v) for v in (parts["friction"].found, parts["friction"].expected))
        then = "Give the plant's friction with plant=…, or the same to both"
        _refuse(path, "velocity", f"the friction slope {_told(found, 'N s/m')}", _told(expected, "N s/m"), then)
    if not parts["acceleration"].agrees:
        _refuse(path, "acceleration", "an output that is not the rate of its velocity", "that rate itself", _LINEARIZE)
    if "contact_force" in parts and not parts["contact_force"].agrees:
        _refuse(path, "contact_force", "a force that changes with motion or forces", "a constant one", _LINEARIZE)


def _beside(m: FmuLinearization, model: Slopes, rate: float) -> dict[str, Beside]:
    """Return what is compared, by the port that it concerns, in the coordinates (position, velocity)."""
    n = len(m.states)
    outputs = {port: _entries(m.outputs, port) for port in ("position", "velocity", "acceleration", "contact_force")}
    u, F = (_entries(m.inputs, port) for port in ("motor_force", "external_force"))
    both, rows = u + F, outputs["position"] + outputs["velocity"]
    U = m.uncertainty
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

    def read(port: str) -> tuple[np.ndarray, np.ndarray]:
        at = outputs[port]
        C = m.C[at] @ Ti
        off = U[n:, :n][at] @ np.abs(Ti) + np.abs(C) @ U_T @ np.abs(Ti)
        return np.hstack([C, m.D[np.ix_(at, both)]]), np.hstack([off, U[n:, n:][np.ix_(at, both)]])

    def through(port: str, C: np.ndarray, D: np.ndarray, natural: np.ndarray) -> Beside:
        found, off = read(port)
        return Beside(found, np.hstack([C, D]), off, natural)

    GG, none = np.hstack([G, G]), np.zeros((2, 4))
    states, forces = size(rate, 1.0), size(g / rate, g / rate)
    parts = {
        "velocity": Beside(
            np.hstack([A[:2], B[:2], m.D[np.ix_(outputs["velocity"], both)]]),
            np.hstack([zero, eye, none, none]),
            np.hstack([U_A[:2], U_B[:2], U[n:, n:][np.ix_(outputs["velocity"], both)]]),
            np.hstack([states + rounded[:2], forces, forces]),
        ),
        "motor_force": Beside(B[2:, :2], G, U_B[2:, :2], size(g)),
        "external_force": Beside(B[2:, 2:], G, U_B[2:, 2:], size(g)),
        "position": Beside(A[2:, :2], zero, U_A[2:, :2], size(rate**2) + rounded[2:, :2]),
        "friction": Beside(A[2:, 2:], S, U_A[2:, 2:], size(fast) + rounded[2:, 2:]),
        "acceleration": through("acceleration", np.hstack([zero, S]), GG, size(rate**2, fast, g, g)),
    }
    if outputs["contact_force"]:
        natural = size(rate**2 / g, rate / g, 1.0, 1.0)
        parts["contact_force"] = through("contact_force", none, none, natural)
    return parts


def _masses(E: np.ndarray, G: np.ndarray) -> np.ndarray:
    """Return the inertia of G_v in a frame; infinite where nothing moves."""
    inner = E.T @ G @ E
    return np.linalg.inv(inner) if np.linalg.det(inner) else np.full((2, 2), np.inf)


def _told(X: np.ndarray, unit: str) -> str:
    """Return a matrix in the frame of the path as text: its diagonal where it is diagonal."""
    X = np.where(np.abs(X) <= ROUNDING * np.max(np.abs(X)), 0.0, X)
    if abs(X[0, 1]) + abs(X[1, 0]) > 1e-9 * np.max(np.abs(X)):
        return f"[[{X[0, 0]:.6g}, {X[0, 1]:.6g}], [{X[1, 0]:.6g}, {X[1, 1]:.6g}]] {unit} along and across the path"
    return f"{X[0, 0]:.6g} {unit} along and {X[1, 1]:.6g} {unit} across the path"
