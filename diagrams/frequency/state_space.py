"""Matrices of python-control's systems. python-control has no types, so its systems are read and made here."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from control import StateSpace, TransferFunction

    LinearSystem: TypeAlias = StateSpace | TransferFunction


class Matrices(NamedTuple):
    """State space ẋ = A x + B u, y = C x + D u, or x⁺ = A x + B u of a sampled system.

    ``dt`` is the sample time in s, 0 of a continuous system; None or True where python-control leaves it open.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float | None

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return int(self.D.shape[1])

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return len(self.D)


def read_matrices(system: LinearSystem) -> Matrices:
    """Return the matrices of a system of python-control; a transfer function is realized first."""
    import control

    made = control.ss(system)
    A, B, C, D = (np.asarray(getattr(made, name), dtype=float) for name in "ABCD")
    return Matrices(A, B, C, D, made.dt)


def make_state_space(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, dt: float | None) -> StateSpace:
    """Return a system of python-control with these matrices."""
    import control

    return control.ss(A, B, C, D, dt)
