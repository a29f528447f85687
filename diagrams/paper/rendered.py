"""Target and rendered admittance of one direction of Fig. 3.

An admittance is velocity over force, Y(jω) = V/F in m/(N s), with the velocity in m/s. Off the path, the velocity along
it is q times the rate of η (E22). The target is the admittance of the admittance filter,

    Y(s) = q s/(m s² + d s + k),

the rendered admittance is that of the whole loop, from a force F on the tool to the velocity ṗ, as `Contact.admittance`
has it: of a sampled loop the fundamental.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import Array, accepts, kinds
from ..contact import (
    LOWEST,
    SIDES,
    Passivity,
    close_loop,
    compute_admittance,
    controller_rows,
    find_sign,
    join_environment,
)
from ..frequency import hold_inputs
from .compliance_loop import AdmittanceLoop
from .coupled_stability import ROBOT

KINDS = ("p", "velocity", "last_force", "integral", "e", "e_rate", "computed", "F")
"""Names of states without direction, in their order."""

if TYPE_CHECKING:
    from control import FrequencyResponseData, StateSpace


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
    contact = loop.contact
    return compute_admittance(contact.parts, contact.direction, omega)


@accepts(loop=ROBOT)
def rendered_system(loop: AdmittanceLoop) -> StateSpace:
    """Return the rendered admittance as a `control.StateSpace`, from the force F to the velocity ṗ.

    A sampled loop gives the discrete system from a force that is held over each sample to the velocity at the ticks.
    Its response contains the aliases; `rendered_response` gives the fundamental.
    """
    import control

    parts, direction = loop.contact.parts, loop.contact.direction
    joined = join_environment(parts, direction)
    closed, n, T = close_loop(parts, joined), len(parts.plant.A), parts.sample_time
    A, labels = closed.A, _state_labels(loop)
    C = np.zeros((1, len(A)))
    C[0, :n] = direction @ parts.velocity
    if not T:
        B = closed.at_tick.copy()
        B[:n] += joined.G
        if loop.implementation == "ideal":  # its states are e = p/q and ė
            B, C = B / loop.scale, C * loop.scale
    else:
        rows, K = controller_rows(parts, joined), parts.controller
        by_u, by_force = (hold_inputs(joined.A, M, T)[1] for M in (joined.B, joined.G))

        def drive(shown: np.ndarray) -> np.ndarray:
            u = K.D @ shown
            return np.vstack([by_u @ u, u, K.B @ shown])

        at_once = np.zeros_like(rows.force)
        at_once[-len(direction) :, 0] = direction
        B = drive(at_once)
        B[:n] += by_force
        # the tool's acceleration in F_meas is due to the last sample's F, which therefore is a state
        A = np.block([[A, drive(rows.force - at_once)], [np.zeros((1, len(A) + 1))]])
        B, C = np.vstack([B, [[1.0]]]), np.hstack([C, [[0.0]]])
        labels.append(f"F_{loop.side}_last")
    order = sorted(range(len(labels)), key=lambda i: _rank(labels[i]))
    return control.ss(
        A[np.ix_(order, order)],
        B[order],
        C[:, order],
        0.0,
        T,
        states=[labels[i] for i in order],
        inputs=[f"F_{loop.side}"],
        outputs=[f"velocity_{loop.side}"],
        name="admittance",
    )


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
    return find_sign(loop.contact, low=low, high=high, per_decade=per_decade)


def _state_labels(loop: AdmittanceLoop) -> list[str]:
    """Return the names of the states of a loop: of the plant, of the last motor force, of the controller."""
    plant, controller = loop.contact.parts.states
    if loop.implementation == "ideal":
        return ["e", "e_rate"]
    last = [f"last_force_{side}" for side in loop.directions] if loop.contact.sample_time else []
    return [*map(_label, plant), *last, *map(_label, controller)]


def _label(state: str) -> str:
    """Return the name of a state in a rendered admittance, such as e_perp for controller.admittance_perp.error."""
    names = {"position": "p", "velocity": "velocity", "error": "e", "error_rate": "e_rate", "integral": "integral"}
    if found := re.fullmatch(r"plant\.(\w+)\[(\d)\]", state):
        return f"{names[found[1]]}_{SIDES[int(found[2]) - 1]}"
    if found := re.fullmatch(r"controller\.\w+_(par|perp)\.(\w+)", state):
        return f"{names[found[2]]}_{found[1]}"
    if found := re.fullmatch(r"controller\.delay_motor_force\.line\[(\d+),(\d)\]", state):
        return f"computed_{found[1]}_{SIDES[int(found[2]) - 1]}"
    return state


def _rank(label: str) -> tuple[int, str]:
    """Return the place of a state: in the order of `KINDS`, along the path before across it."""
    kind = re.split(r"_(?:\d+_)?(?:par|perp)", label)[0]
    return KINDS.index(kind) if kind in KINDS else len(KINDS), label
