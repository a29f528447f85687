"""Base of all paths: a curve with the coordinates around it. Equation numbers are those of Flixeder et al. (2014).

ξ is positive to the left of the path. `Curve` has the points, the moving frame and the arc length.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..core import Array, ParameterError, PathDomainError
from ..library import piecewise, wrap
from .curve import Curve, Frame
from .nearest_point import find_nearest
from .reach import reach_table, replace_unlimited


class Path(Curve):
    """Regular planar path σ(θ), closed or open, with the geometry that path following needs.

    A subclass gives `sigma` and either `period` (a closed path) or `domain` (an open one). All the rest follows;
    override a method for which there is a closed form. An open path must continue straight beyond its ends, at the
    speed it has there::

        class Bean(Path):
            '''σ(θ) = R (cos θ + e cos 2θ, sin θ).'''

            radius: float = parameter(unit="m", above=0.0)
            bend: float = parameter(default=0.3)
            period = 2.0 * np.pi

            def sigma(self, theta, order=0):
                turn = order * np.pi / 2.0  # differentiating turns by a quarter
                y = np.cos(theta + turn) + self.bend * 2.0**order * np.cos(2.0 * theta + turn)
                return self.radius * np.stack([y, np.sin(theta + turn)])

    The path must not meet itself (its reach is almost zero there), and its σ′ must not vanish (E19).

    All methods take a parameter θ as a number, as an array of N numbers (vectors then have the shape (2, N)) or as a
    traced scalar, unless they are marked NumPy only.
    """

    # --- neighbourhood ------------------------------------------------------------------------------------------------

    @cached_property
    def _reach(self) -> tuple[np.ndarray, np.ndarray]:
        return reach_table(self)

    def reach(self, theta: Array) -> tuple[Array, Array]:
        """Return the distances along +n and −n up to which σ(θ) is the unique nearest point of the path, m.

        Along +n this is the least |Δ|²/(2 nᵀΔ) over all points σ(θ) + Δ of the path with nᵀΔ > 0, and 1/κ in the limit
        Δ → 0: the distance to the medial axis, which is never beyond the evolute. `UNLIMITED` means no limit. A
        tabulated reach is too small by at most about 2 %, never too large.
        """
        breaks, coefficients = self._reach
        if self.period is not None:
            theta = wrap(theta, 0.0, self.period)[1]
        else:
            first, last = breaks[0], breaks[-1]
            theta = np.where(theta < first, first, np.where(theta > last, last, theta))
        inverse = piecewise(breaks, coefficients, theta)
        return 1.0 / inverse[0], 1.0 / inverse[1]

    def project(self, y: Array) -> Array:
        """Return the parameter of the point of the path nearest to y, equation (4). NumPy only.

        The result is the global arg min, never a local one only. For an open path the ends are candidates.

        Parameters
        ----------
        y : array, shape (2,) or (2, N)
            Position, m.

        Returns
        -------
        float or array
            θ within one period, or within the domain.

        Raises
        ------
        ParameterError
            For a position of another shape.
        """
        y = as_positions(self, y)
        theta = np.array([find_nearest(self, column) for column in y.reshape(2, -1).T])
        return self._wrap(theta).reshape(y.shape[1:]) if y.ndim > 1 else float(self._wrap(theta)[0])

    def _wrap(self, theta: Array) -> Array:
        """Return θ within [0, period)."""
        if self.period is None:
            return theta
        theta = np.mod(theta, self.period)
        return np.where(theta >= self.period, 0.0, theta)

    def newton(self, theta: Array, y: Array, iterations: int) -> tuple[Array, Array]:
        """Improve θ towards a root of (y − σ(θ))ᵀσ′(θ) = 0, equation (6), by Newton's method.

        Parameters
        ----------
        theta : float, array or traced scalar
            Parameter from which to start.
        y : array, shape (2,) or (2, N)
            Position, m.
        iterations : int
            Number of steps; all are taken.

        Returns
        -------
        theta : float, array or traced scalar
            The improved parameter, not wrapped to one period.
        residual : float, array or traced scalar
            |Δθ| of the next step.
        """
        for _ in range(iterations):
            theta = theta + self._newton_step(theta, y)
        return theta, np.abs(self._newton_step(theta, y))

    def _newton_step(self, theta: Array, y: Array) -> Array:
        s0, s1, s2 = self.derivatives(theta, 2)
        d0, d1 = y[0] - s0[0], y[1] - s0[1]
        return (d0 * s1[0] + d1 * s1[1]) / (s1[0] * s1[0] + s1[1] * s1[1] - d0 * s2[0] - d1 * s2[1])

    # --- from path coordinates back to the plane ----------------------------------------------------------------------

    def to_plane(self, eta: Array, xi: Array) -> Array:
        """Return the position y = σ(θ) + n ξ₁ with θ = g⁻¹(η₁), the inverse of (7). NumPy only.

        Parameters
        ----------
        eta : float or array
            Arc length η₁, m.
        xi : float or array
            Distance to the left of the path ξ₁, m.

        Returns
        -------
        array, shape (2,) or (2, N)

        Raises
        ------
        PathDomainError
            If ξ₁ is at or beyond the path's reach at η₁, η₁ is beyond an end of an open path, or one is not finite.
        """
        return self._place(eta, xi)[0]

    def to_state(self, eta: Array, xi: Array) -> tuple[Array, Array]:
        """Return position y and velocity ẏ = q η₂ t + ξ₂ n, q = 1 − κ ξ₁, the inverse of (7). NumPy only.

        Parameters
        ----------
        eta : pair of float or array
            Arc length η₁, m, and its rate η₂, m/s.
        xi : pair of float or array
            Distance to the left ξ₁, m, and its rate ξ₂, m/s.

        Raises
        ------
        PathDomainError
            See `to_plane`.
        """
        position, frame = self._place(eta[0], xi[0])
        q = 1.0 - frame.curvature * xi[0]
        return position, q * eta[1] * frame.tangent + xi[1] * frame.normal

    def _place(self, eta: Array, xi: Array) -> tuple[Array, Frame]:
        eta, xi = np.broadcast_arrays(np.asarray(eta, dtype=float), np.asarray(xi, dtype=float))
        for name, given in (("eta", eta), ("xi", xi)):
            if not np.all(np.isfinite(given)):
                raise PathDomainError(
                    f"found {name} = {given[~np.isfinite(given)].flat[0]:g} m; expected finite path coordinates."
                )
        theta = self.parameter_at(eta)
        frame = self.frame(theta)
        position = frame.sigma + frame.normal * xi
        left, right = self.reach(theta)
        limit = np.where(xi >= 0.0, left, right)
        beyond = (eta < 0.0) | (eta > self.length) if self.period is None else np.zeros(eta.shape, dtype=bool)
        wrong = beyond | ~(np.abs(xi) < limit)
        if np.any(wrong):
            first = tuple(np.argwhere(wrong)[0])
            raise self._domain_error(
                eta=float(eta[first]),
                xi=float(xi[first]),
                theta=float(np.asarray(theta)[first]),
                limit=float(np.broadcast_to(limit, eta.shape)[first]),
                position=tuple(position[(slice(None), *first)].tolist()),
                beyond=bool(beyond[first]),
            )
        return position, frame

    def _domain_error(
        self, *, eta: float, xi: float, theta: float, limit: float, position: tuple[float, ...], beyond: bool
    ) -> PathDomainError:
        if beyond:
            end, by = ("end", eta - self.length) if eta > 0.0 else ("start", -eta)
            text = (
                f"found eta = {eta:.6g} m, {by:.3g} m beyond its {end}; expected 0 to {self.length:.6g} m, the length "
                f"of the open {type(self).__name__}. Stay between its ends, or lengthen the path."
            )
            limit = replace_unlimited(limit)
        else:
            side, sign = ("left", "") if xi >= 0.0 else ("right", "-")
            text = (
                f"found xi = {xi:.6g} m at eta = {eta:.6g} m (theta = {theta:.6g}); expected less than {limit:.6g} m "
                f"to the {side} of the {type(self).__name__} there: beyond the medial axis another point of it is "
                f"nearer. Stay closer to the path (xi inside {sign}{limit:.6g} m), or choose a path that bends less."
            )
        error = PathDomainError(text)
        error.position, error.theta, error.xi, error.reach = position, theta, xi, limit
        return error


def as_positions(path: Path, y: object) -> np.ndarray:
    """Return positions as an array, and refuse other shapes."""
    try:
        array = np.asarray(y, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim not in (1, 2) or len(array) != 2:
        raise ParameterError(
            f"found a position of shape {array.shape}; expected (2,), in m, or (2, N) for N of them.",
            block=type(path).__name__,
            port="project",
        )
    return array
