"""Linear models of a diagram in continuous time: of one without sampling, and of the flow between two ticks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ...blocks.core import Finding, OptionError, left_of
from ...fmus.fmu_block import Derivation
from ..flat import NONE, FlatDiagram, announcers
from ..frequency import FourMatrices, LinearDelays, find_pade_limit, hold_inputs
from ..results import OperatingPoint
from ..simulation import late_progress
from .delay_channels import delay_channels
from .derivatives import LocalDerivatives
from .exchanged import noise_of
from .left_out_effects import ApproximateDelay
from .plant_models import EQUILIBRIUM, join_matrices, states_of

STAGES = (1.0, 0.6, 0.2816, 0.857, 0.0526, 0.3333, 0.6513, 0.1184, 0.25, 0.3077, 0.0789)
"""Instants within a step at which DOP853 asks for rates, as parts of the step; the end comes first."""


@dataclass
class Model:
    """Matrices A, B, C, D of a linear model, with its states, delays and findings; see `Linearization`."""

    matrices: FourMatrices
    dt: float
    states: list[str]
    affine: np.ndarray
    derivations: dict[str, Derivation] = field(default_factory=dict)
    uncertainty: float = 0.0
    memory: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    delays: LinearDelays | None = None


def differentiate_flow(local: LocalDerivatives, t: float, x1: np.ndarray, w: np.ndarray, h: float) -> FourMatrices:
    """Return the derivatives of x after the time h by x before it, by w and by d, and x after the time h.

    Only continuous states change. At an equilibrium, and everywhere where the flow is linear, the derivative is a
    matrix exponential. Elsewhere the variational equation is integrated along the motion, from one discontinuity of a
    source to the next: by DOP853 at 1e-12, or at the error of the derivatives of FMUs where that is larger.

    An FMU in model exchange may depend on time without saying so. At an equilibrium it is asked at the instants at
    which DOP853 would ask it; where rates and derivatives are the same bits at all of them, they stay.
    """
    flat, xc = local.flat, local.flat.continuous
    nc, nx, nw, m = len(xc), flat.width, len(w), local.n_inputs
    many = nx + nw + m

    def differentiate(time: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = x1.copy()
        x[xc] = state
        J = local.differentiate(NONE, time, x, w)
        rest = J["dx", "x"].copy()
        rest[:, xc] = 0.0
        return np.hstack([J["dx", "x"][:, xc], rest, J["dx", "w"], J["dx", "d"]]), J["dx"]

    start, end = x1[xc], t + h
    F, f0 = differentiate(t, start)
    final = x1.copy()
    rests = all(size_of_change(*part) <= EQUILIBRIUM for part in local.parts(f0, start))

    def stays() -> bool:
        """Return whether rates and derivatives at rest are the same over the whole time."""
        if not flat.in_model_exchange or len([*_split_at_discontinuities(flat, t, end)]) > 1:
            return False
        asked = (differentiate(min(t + part * h, left_of(end)), start) for part in STAGES)
        return all(np.array_equal(J, F) and np.array_equal(f, f0) for J, f in asked)

    still = local.stays_until(t) >= end
    if rests and (still or stays()):
        whole = np.hstack(hold_inputs(F[:, :nc], F[:, nc:], h))
        final[xc] = start + f0 * h
    elif still and local.is_linear:
        whole = np.hstack(hold_inputs(F[:, :nc], np.hstack([F[:, nc:], f0[:, None]]), h))
        whole, final[xc] = whole[:, :-1], start + whole[:, -1]
    else:
        from scipy.integrate import solve_ivp

        s = np.concatenate([start, np.hstack([np.eye(nc), np.zeros((nc, many))]).ravel()]).astype(F.dtype)
        error, noise = noise_of(local.evaluators)
        rtol, atol = np.full(s.size, 1e-12), np.full(s.size, 1e-14)
        rtol[nc:], atol[nc:] = max(1e-12, noise), 1e-14 + error * h  # a derivative's own error can't be stepped away
        with late_progress(f"linear model from t = {t:.6g} s", t, end) as notify:
            for begin, edge in _split_at_discontinuities(flat, t, end):
                left = left_of(edge) if edge < end else edge

                def rates(time: float, s: np.ndarray, left: float = left) -> np.ndarray:
                    notify(time)
                    J, dx = differentiate(min(time, left), s[:nc])
                    V = s[nc:].reshape(nc, nc + many)
                    forced = J[:, :nc] @ V
                    forced[:, nc:] += J[:, nc:]
                    return np.concatenate([dx, forced.ravel()])

                found = solve_ivp(rates, (begin, edge), s, method="DOP853", rtol=rtol, atol=atol)
                s = np.asarray(found.y)[:, -1]
        final[xc] = s[:nc]
        whole = s[nc:].reshape(nc, nc + many)
    E, Ew, Ed = (np.asarray(M, dtype=F.dtype) for M in (np.eye(nx), np.zeros((nx, nw)), np.zeros((nx, m))))
    E[np.ix_(xc, xc)] = whole[:, :nc]
    E[xc] += whole[:, nc : nc + nx]
    Ew[xc], Ed[xc] = whole[:, nc + nx : nc + nx + nw], whole[:, nc + nx + nw :]
    return E, Ew, Ed, final


def size_of_change(change: np.ndarray, state: np.ndarray) -> float:
    """Return the largest change, relative to 1 + the size of the state."""
    return float(np.max(np.abs(change) / (1.0 + np.abs(state)), initial=0.0))


def relative_error(error: float, *matrices: np.ndarray) -> float:
    """Return an error relative to the largest entry of matrices; 0 where all are zero."""
    largest = max((float(np.max(np.abs(M), initial=0.0)) for M in matrices), default=0.0)
    return error / largest if largest else 0.0


def _split_at_discontinuities(flat: FlatDiagram, t: float, end: float) -> Iterator[tuple[float, float]]:
    """Yield the parts of an interval between the discontinuities of the sources."""
    sources = announcers(flat)
    while t < end:
        edge = min([end, *(source.next_instant(t) for _, source in sources)])
        yield t, edge
        t = edge


def model_continuous(local: LocalDerivatives, at: OperatingPoint, plants: str | None, name: str) -> Model:
    """Return the model of a diagram without sampling; ``name`` is the diagram's."""
    flat, J = local.flat, local.differentiate(NONE, at.t, at.x, at.w)
    models = local.model_equations(at, plants)
    xc = flat.continuous
    Ap, Bp, Cp, Dp = (join_matrices(flat, models, which) for which in "ABCD")
    # w = Cp xp + Dp z + S l, z = Zx x + Zw w + Zd d, with l the outputs of the delays
    loop = np.eye(len(at.w)) - Dp @ J["z", "w"]
    if loop.size and not np.linalg.cond(loop) < 1e12:
        raise OptionError(
            "found a loop through the FMU's feedthrough without a unique solution; expected one. Wire an output "
            "without feedthrough, or linearize over a step, step=….",
            block=name,
        )
    channels = delay_channels(flat)
    S = np.zeros((len(at.w), len(channels)))
    S[channels.outputs, np.arange(len(channels))] = 1.0
    zx = J["z", "x"][:, xc]
    moved = (("x", Dp @ zx), ("p", Cp), ("d", Dp @ J["z", "d"]), ("l", S))
    w_of = {k: np.linalg.solve(loop, v) for k, v in moved}
    z_of = {k: J["z", "w"] @ v for k, v in w_of.items()}
    z_of["x"], z_of["d"] = z_of["x"] + zx, z_of["d"] + J["z", "d"]

    def eliminate_w(quantity: str) -> list[np.ndarray]:
        by_w = J[quantity, "w"]
        by_x, by_p, by_d, by_l = (by_w @ w_of[k] for k in "xpdl")
        return [J[quantity, "x"][:, xc] + by_x, by_p, J[quantity, "d"] + by_d, by_l]

    fx, fp, fd, fl = eliminate_w("dx")
    yx, yp, yd, yl = eliminate_w("y")
    A = np.block([[fx, fp], [Bp @ z_of["x"], Ap + Bp @ z_of["p"]]])
    B = np.vstack([fd, Bp @ z_of["d"]])
    rates = np.concatenate([J["dx"], *(m.f for m in models)])
    delays = None
    if len(channels):
        mine = {k: v[channels.inputs] for k, v in z_of.items()}
        G, Z = np.vstack([fl, Bp @ z_of["l"]]), np.hstack([mine["x"], mine["p"]])
        times = np.array([*map(float, channels.times)])
        delays = LinearDelays(channels.labels, times, G, Z, H=mine["l"], E=yl, F=mine["d"])
        off = J["z"][channels.inputs] - at.w[channels.outputs]  # still on their way
        rates = rates + G @ delays.settle(off)
    return Model(
        (A, B, np.hstack([yx, yp]), yd),
        0.0,
        flat.continuous_labels + states_of(models),
        rates,
        {m.path: m.derivation for m in models},
        max((m.uncertainty for m in models), default=0.0),
        delays=delays,
    )


def approximate_delays(model: Model, order: int) -> Model:
    """Return a model with Padé's approximation of an order in place of each delay, and a finding on each."""
    late = model.delays
    if late is None:
        return model
    A, B, C, D = model.matrices
    n, q, p = len(A), late.F.shape[1], len(late.E)
    four = late.approximate((A, B.reshape(n, q), C.reshape(p, n), D.reshape(p, q)), [order] * len(late.times))
    limit = find_pade_limit(order)
    findings = [
        ApproximateDelay(name.rpartition(".")[0], "y", "u", order, float(tau), limit / float(tau))
        for name, tau in zip(late.names, late.times, strict=True)
    ]
    states = [f"{name}.pade[{k + 1}]" for name in late.names for k in range(order)]
    return replace(
        model,
        matrices=four,
        states=[*model.states, *states],
        affine=np.append(model.affine, np.zeros(len(states))),
        findings=(*model.findings, *findings),
        delays=None,
    )
