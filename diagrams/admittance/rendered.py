"""Target and rendered admittance of one direction, and passivity by its real part.

An admittance is velocity over force, Y(jω) = V/F in m/(N s), with the velocity in m/s. Off the path, the velocity along
it is q times the rate of η (E22). The target is the admittance of the admittance filter,

    Y(s) = q s/(m s² + d s + k),

the rendered admittance is that of the whole loop of `compliance_loop`, from a force F on the tool to the velocity ṗ.

In a sampled loop F(t) = e^{jωt} acts in continuous time, and the motor force is a staircase. Y is then the fundamental
of the velocity, its part at ω itself: the mean of ṗ(t) e^{−jωt} over one sample. It follows from the steady state of
the sampled loop and the exact motion of the plant between the ticks. Y does not contain the aliases of ω.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import Array, Finding, OptionError, accepts, brief, explain_calls, kinds
from ..frequency import read_matrices, refine_sign_change
from .compliance_loop import AdmittanceLoop, hold_force
from .coupled import ROBOT, close_loop
from .port_passivity import PortPassivity

if TYPE_CHECKING:
    from control import FrequencyResponseData, StateSpace

CONTINUOUS = "Re Y(jω) ≥ 0 at all frequencies and no unstable pole is passivity of this linear model, and of it alone."
SAMPLED = (
    "Y is the fundamental of a sampled loop: Re Y(jω) < 0 disproves passivity; Re Y(jω) ≥ 0 doesn't prove it, as the "
    "aliases of a motion carry power too."
)
PERIODIC = (
    " In several rates a force of one frequency moves the contact at others, too, ω + 2πk/T over the common period T; "
    "Y is the part at ω alone."
)
OFF_PATH = (
    " Off the path the force that is conjugate to the rate of η is q F∥ (E22): driven by F∥, the admittance is not "
    "passive in motions that change q, whatever Re Y says at one point."
)
LOWEST, HIGHEST = 1e-2, 1e5
"""Ends of a scan, rad/s."""
_ROUNDED = 1e-10
"""Real part relative to |Y| below which it is rounding."""


@explain_calls
@dataclass(frozen=True, eq=False)
class Passivity:
    """Sign of the real part of a rendered admittance.

    Attributes
    ----------
    frequency : float
        First frequency in rad/s at which Re Y becomes negative; infinite if it doesn't on the scan.
    intervals : tuple of pairs of float
        Ends of the intervals of frequencies with negative Re Y, rad/s; the last may end with the scan.
    scanned : tuple of float
        Ends of the scan in rad/s; the upper one is at most the Nyquist frequency π/T of a sampled loop.
    stable : bool
        Whether the loop alone, without environment, has no pole that grows.
    caveat : str
        Meaning of the sign for this loop, and its limits.
    tolerance : float
        Relative error of the frequencies.
    findings : tuple of Finding
        Kinks and stairs of the diagram that the loop leaves out.
    port : PortPassivity, optional
        Passivity against all passive environments, with the aliases of a sampled loop; that of a `Contact`.
    """

    frequency: float
    intervals: tuple[tuple[float, float], ...]
    scanned: tuple[float, float]
    stable: bool
    caveat: str
    tolerance: float = 1e-9
    findings: tuple[Finding, ...] = ()
    port: PortPassivity | None = None

    def __repr__(self) -> str:
        first = f"Re Y < 0 from {self.frequency:.6g} rad/s" if self.intervals else "Re Y ≥ 0"
        facts = (
            first,
            f"from {self.scanned[0]:.4g} to {self.scanned[1]:.4g} rad/s",
            "" if self.stable else "unstable alone",
        )
        return brief("sign of an admittance's real part", *facts, then=".intervals, .caveat")


@accepts(loop=ROBOT, omega=kinds.numbers)
def target_admittance(loop: AdmittanceLoop, omega: Array) -> Array:
    """Return the admittance of the admittance filter, m/(N s), at frequencies in rad/s."""
    s, a = 1j * np.asarray(omega, dtype=float), loop.admittance
    return loop.scale * s / (a.mass * s * s + a.effective_damping * s + a.stiffness)


@accepts(loop=ROBOT, omega=kinds.numbers)
def rendered_admittance(loop: AdmittanceLoop, omega: Array) -> Array:
    """Return the admittance that the environment feels, m/(N s).

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    omega : float or array
        Frequencies in rad/s; those of a sampled loop lie below the Nyquist frequency π/T.

    Raises
    ------
    OptionError
        If a frequency is not positive, or not below the Nyquist frequency.
    """
    w = np.asarray(omega, dtype=float)
    top = math.pi / loop.sample_time if loop.implementation == "sampled" else math.inf
    if not np.all((w > 0.0) & (w < top)):
        raise OptionError(
            f"found frequencies from {np.min(w):g} to {np.max(w):g} rad/s; expected them positive"
            f"{f', below the Nyquist frequency {top:.6g} rad/s' if top < math.inf else ''}. Leave the others out.",
            port="omega",
        )
    if loop.implementation == "ideal":
        return _ideal_admittance(loop, w)
    return _continuous_admittance(loop, w) if loop.implementation == "continuous" else _sampled_admittance(loop, w)


@accepts(loop=ROBOT)
def rendered_system(loop: AdmittanceLoop) -> StateSpace:
    """Return the rendered admittance as a `control.StateSpace`, from the force F to the velocity ṗ.

    A sampled loop gives the discrete system from a force that is held over each sample to the velocity at the ticks.
    Its response contains the aliases; `rendered_response` gives the fundamental.
    """
    import control

    names: dict[str, Any] = {"inputs": [f"F_{loop.side}"], "outputs": [f"velocity_{loop.side}"], "name": "admittance"}
    if loop.implementation == "ideal":
        a, q, tool = loop.admittance, loop.scale, loop.tool_mass
        return control.ss(
            close_loop(loop), [[0.0], [1.0 / (a.mass + q * tool)]], [[0.0, q]], 0.0, states=["e", "e_rate"], **names
        )
    n, i = len(loop.directions), _index(loop)
    plant, K = loop.plant_matrices(), loop.controller_matrices
    B = plant.B[:, [n + i]]
    if loop.implementation == "continuous":
        D_u, D_F = plant.D[:, :n], plant.D[:, [n + i]]
        F_inv = np.linalg.inv(np.eye(n) - K.D @ D_u)
        u = F_inv @ K.D @ D_F
        B_all = np.vstack([B + plant.B[:, :n] @ u, K.B @ (D_F + D_u @ u)])
        A, dt, states = close_loop(loop), 0.0, _state_names(loop)
    else:
        dt = loop.sample_time
        held = control.sample_system(control.ss(plant.A, B, np.eye(2 * n), np.zeros((2 * n, 1))), dt, method="zoh")
        push = read_matrices(held).B
        at_once = np.zeros((3 * n, 1))
        at_once[2 * n + i] = 1.0
        # the tool's acceleration in F_meas is due to the last sample's F, which therefore is a state
        later = _drive_states(loop, np.zeros((2 * n, 1)), plant.D[:, [n + i]] - at_once)
        A = np.block([[close_loop(loop), later], [np.zeros((1, len(later) + 1))]])
        B_all = np.vstack([_drive_states(loop, push, at_once), [[1.0]]])
        states = [*_state_names(loop), f"F_{loop.side}_last"]
    C = np.zeros((1, len(A)))
    C[0, n + i] = 1.0
    return control.ss(A, B_all, C, 0.0, dt, states=states, **names)


@accepts(loop=ROBOT, omega=kinds.numbers)
def rendered_response(loop: AdmittanceLoop, omega: Array) -> FrequencyResponseData:
    """Return the rendered admittance as `control.FrequencyResponseData`; see `rendered_admittance`."""
    import control

    w = np.asarray(omega, dtype=float)
    return control.frd(rendered_admittance(loop, w), w, inputs=[f"F_{loop.side}"], outputs=[f"velocity_{loop.side}"])


@accepts(loop=ROBOT, low=kinds.number, high=kinds.number, per_decade=kinds.whole)
def passivity(
    loop: AdmittanceLoop, *, low: float = LOWEST, high: float | None = None, per_decade: int = 200
) -> Passivity:
    """Return the frequencies at which the real part of the rendered admittance is negative.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    low, high : float, optional
        Ends of the scan, rad/s; by default 0.01 rad/s and the Nyquist frequency, or 1e5 rad/s in a continuous loop.
    per_decade : int, optional
        Points of the scan in a decade.

    Raises
    ------
    OptionError
        If an end of the scan is not positive, or not below the Nyquist frequency.
    """
    sampled = loop.implementation == "sampled"
    top = (math.pi / loop.sample_time * (1.0 - 1e-9) if sampled else HIGHEST) if high is None else high
    if not 0.0 < low < top < math.inf:
        raise OptionError(
            f"found a scan from {low!r} to {top!r} rad/s; expected positive ends, the lower one first.",
            block="passivity",
            port="low",
        )
    intervals = find_negative(lambda w: rendered_admittance(loop, w), low, top, per_decade)
    poles = np.linalg.eigvals(close_loop(loop))
    stable = bool(np.all(np.abs(poles) <= 1.0 + 1e-9) if sampled else np.all(poles.real <= 1e-6))
    return Passivity(
        frequency=intervals[0][0] if intervals else math.inf,
        intervals=intervals,
        scanned=(low, top),
        stable=stable,
        caveat=(SAMPLED if sampled else CONTINUOUS) + (OFF_PATH if loop.side == "par" and loop.q != 1.0 else ""),
        findings=loop.findings,
    )


def find_negative(
    admittance: Callable[[np.ndarray], Array], low: float, high: float, per_decade: int
) -> tuple[tuple[float, float], ...]:
    """Return the intervals of frequencies in which the real part of an admittance is negative, on a scan in rad/s."""
    grid = np.geomspace(low, high, max(8, math.ceil(per_decade * math.log10(high / low)) + 1))

    def sine(w: np.ndarray | float) -> np.ndarray:
        Y = np.asarray(admittance(np.asarray(w)))
        return np.asarray(Y.real / np.abs(Y) + _ROUNDED)

    positive = sine(grid) >= 0.0

    def find_edge(i: int) -> float:
        return math.exp(
            refine_sign_change(lambda y: float(sine(math.exp(y))), *np.log(grid[i : i + 2]).tolist(), xtol=1e-13)
        )

    edges = ([] if positive[0] else [low]) + [find_edge(int(i)) for i in np.flatnonzero(positive[1:] != positive[:-1])]
    if len(edges) % 2:
        edges.append(high)
    return tuple(zip(edges[::2], edges[1::2], strict=True))


def _index(loop: AdmittanceLoop) -> int:
    return loop.directions.index(loop.side)


def _ideal_admittance(loop: AdmittanceLoop, w: np.ndarray) -> np.ndarray:
    s, a, q = 1j * w, loop.admittance, loop.scale
    return np.asarray(q * s / ((a.mass + q * loop.tool_mass) * s * s + a.effective_damping * s + a.stiffness))


def _continuous_admittance(loop: AdmittanceLoop, w: np.ndarray) -> np.ndarray:
    system = read_matrices(rendered_system(loop))
    eye = np.eye(len(system.A))
    x = np.linalg.solve(1j * w[..., None, None] * eye - system.A, system.B.astype(complex))
    return np.asarray((system.C @ x)[..., 0, 0])


def _drive_states(loop: AdmittanceLoop, push: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the input matrix of the sampled loop for F.

    ``push`` moves the plant within one sample; ``force`` is the part of F that the sensor shows at once.
    """
    n, K = len(loop.directions), loop.controller_matrices
    P = hold_force(loop.plant_matrices(), loop.sample_time, n)
    u = K.D @ force
    on_plant = np.concatenate([push, np.zeros((*push.shape[:-2], n, 1))], axis=-2)
    on_k = np.broadcast_to(K.B @ force, (*push.shape[:-2], len(K.A), 1))
    return np.concatenate([on_plant + P.B @ u, on_k], axis=-2)


def _sampled_admittance(loop: AdmittanceLoop, w: np.ndarray) -> np.ndarray:
    from scipy.linalg import expm

    n, i, T = len(loop.directions), _index(loop), loop.sample_time
    plant, K = loop.plant_matrices(), loop.controller_matrices
    x, every = 2 * n, 3 * n + 1
    # (p, ṗ), the held u and F = e^{jωt} as one system, times e^{−jωt}, and its mean over a sample
    turning = np.zeros((*w.shape, 2 * every, 2 * every), dtype=complex)
    turning[..., :x, :x] = plant.A
    turning[..., :x, x : x + n] = plant.B[:, :n]
    turning[..., :x, x + n] = plant.B[:, n + i]
    turning[..., every - 1, every - 1] = 1j * w
    turning[..., :every, :every] -= 1j * w[..., None, None] * np.eye(every)
    turning[..., :every, every:] = np.eye(every) / T
    turned = np.asarray(expm(turning * T))
    z = np.exp(1j * w * T)[..., None, None]
    push, mean = z * turned[..., :x, every - 1 : every], turned[..., :every, every:]
    shown = plant.D[:, [n + i]]
    A = close_loop(loop)
    states = np.linalg.solve(z * np.eye(len(A)) - A, _drive_states(loop, push, shown))
    y = hold_force(plant, T, n).C @ states[..., : 3 * n, :] + shown
    u = K.C @ states[..., 3 * n :, :] + K.D @ y
    now = np.concatenate([states[..., :x, :], u, np.ones((*w.shape, 1, 1))], axis=-2)
    return np.asarray((mean @ now)[..., n + i, 0])


def _state_names(loop: AdmittanceLoop) -> list[str]:
    kinds = ["p", "velocity", *(["last_force"] if loop.implementation == "sampled" else []), "integral", "e", "e_rate"]
    kinds += [f"computed_{j + 1}" for j in range(loop.delay if loop.implementation == "sampled" else 0)]
    return [f"{kind}_{side}" for kind in kinds for side in loop.directions]
