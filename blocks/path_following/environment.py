"""Environments of the robot: a hand that guides it, a spring along the path."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..core import Array, Input, Output, parameter
from .transverse import PathTracking


class HandForce(PathTracking):
    """Hand on the robot: F = F∥ t + F⊥ n, in the path's moving frame at the foot point of the position.

    Its two parts are inputs, so any source can be the hand: ``HandForce(path)(position, f_par=Pulse(…))``.
    """

    f_par = Input(unit="N", default=0.0, description="tangential part F∥")
    f_perp = Input(unit="N", default=0.0, description="transversal part F⊥")
    force = Output(shape=(2,), unit="N", description="force on the robot")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the force in the plane."""
        theta, _ = self.foot_point(x, u)
        frame = self.path.frame(theta)
        return frame.tangent * u.f_par + frame.normal * u.f_perp


class PathSpring(PathTracking):
    """One-sided spring along the path: F⊥ = −k max(ξ, 0) − k₃ max(ξ, 0)³, which presses outwards once ξ > 0 (E15)."""

    stiffness: float = parameter(default=0.0, unit="N/m", minimum=0.0, description="linear stiffness k")
    cubic_stiffness: float = parameter(default=0.0, unit="N/m3", minimum=0.0, description="cubic stiffness k₃")
    force = Output(shape=(2,), unit="N", description="force on the robot")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the force in the plane."""
        theta, _ = self.foot_point(x, u)
        frame = self.path.frame(theta)
        depth = frame.normal @ (u.position - frame.sigma)
        depth = np.where(depth < 0.0, 0.0, depth)
        return frame.normal * (-self.stiffness * depth - self.cubic_stiffness * depth**3)
