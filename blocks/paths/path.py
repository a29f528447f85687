"""Base of all paths. Equation numbers are those of Flixeder, Glück, Böck and Kugi (2014).

Conventions: t is the unit tangent, n the unit normal (t turned by +90°), κ the signed curvature, κ_s its derivative
with respect to arc length; ξ is positive to the left of the path.
"""

from __future__ import annotations

import math
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from ..core import Array, DefinitionError, ParameterError, PathDomainError, Value, explain_calls
from ..library import piecewise, wrap
from .arc_length import integrate

UNLIMITED = 1e6
"""Reach of a path without a limit, m: a finite number, so that equations can be traced and compared."""
MOST_MINIMA = 256
"""Minima of a sampled distance that are followed; more of them are rounding errors, as at the centre of an arc."""
CROWDED = 1e9
"""Largest inverse reach in the table in 1/m, where a path meets itself."""
SLACK = 5e-4
"""Allowed relative error of the inverse reach between two nodes; it is then added to the table."""
GENEROUS = 1e-2
"""The same for an error on the safe side."""


def replace_unlimited(reach: float) -> float:
    """Return the reach, infinite in place of `UNLIMITED`, for messages."""
    return math.inf if reach >= UNLIMITED * (1.0 - 1e-9) else reach


@explain_calls
class Frame(NamedTuple):
    """Moving frame of a path at one parameter θ.

    Attributes
    ----------
    sigma : array, shape (2,)
        The point σ(θ), m.
    tangent : array, shape (2,)
        Unit tangent t = σ′/‖σ′‖.
    normal : array, shape (2,)
        Unit normal n, t turned by +90°.
    speed : float
        ‖σ′‖, m per unit of θ.
    curvature : float
        Signed curvature κ (the paper's φ′), 1/m; positive where the path turns left.
    curvature_rate : float
        κ_s, derivative of κ with respect to arc length, 1/m².
    """

    sigma: Array
    tangent: Array
    normal: Array
    speed: Array
    curvature: Array
    curvature_rate: Array


class Path(Value):
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

    # --- given by a subclass ------------------------------------------------------------------------------------------

    def sigma(self, theta: Array, order: int = 0) -> Array:
        """Return the point σ(θ), m, or its derivative of the given order (0 to 3) with respect to θ.

        Parameters
        ----------
        theta : float, array or traced scalar
            Path parameter.
        order : int, optional
            Order of the derivative, 0 to 3.

        Returns
        -------
        array, shape (2,) or (2, N)
        """
        raise self._undefined_error("sigma(theta, order)")

    @property
    def period(self) -> float | None:
        """Period of a closed path in θ; None for an open one."""
        return None

    @property
    def domain(self) -> tuple[float, float] | None:
        """First and last θ of an open path; None for a closed one."""
        return None

    @property
    def knots(self) -> np.ndarray:
        """Parameters between which σ is smooth, including the ends."""
        if self.period is not None:
            return np.array([0.0, self.period])
        if self.domain is None:
            raise self._undefined_error("period and no domain")
        return np.array(self.domain)

    def _undefined_error(self, member: str) -> DefinitionError:
        return DefinitionError(f"found no {member}; expected a path to define it. Write it.", block=type(self).__name__)

    @cached_property
    def closed(self) -> bool:
        """Whether the path is a closed curve."""
        return self.period is not None

    # --- geometry -----------------------------------------------------------------------------------------------------

    def derivatives(self, theta: Array, highest: int = 3) -> tuple[Array, ...]:
        """Return σ(θ) and its derivatives up to the order ``highest``."""
        return tuple(self.sigma(theta, order) for order in range(highest + 1))

    def frame(self, theta: Array) -> Frame:
        """Return the moving frame at θ.

        t = σ′/‖σ′‖, n = R t, κ = (x′y″ − y′x″)/‖σ′‖³ and
        κ_s = [(x′y‴ − y′x‴) ‖σ′‖² − 3 (x′y″ − y′x″) σ′ᵀσ″]/‖σ′‖⁶ (κ is φ′ below equation (8)).
        """
        s0, s1, s2, s3 = self.derivatives(theta, 3)
        squared = s1[0] * s1[0] + s1[1] * s1[1]
        speed = np.sqrt(squared)
        tangent = s1 / speed
        turning = s1[0] * s2[1] - s1[1] * s2[0]
        change = s1[0] * s3[1] - s1[1] * s3[0]
        stretch = s1[0] * s2[0] + s1[1] * s2[1]
        return Frame(
            sigma=s0,
            tangent=tangent,
            normal=np.stack([-tangent[1], tangent[0]]),
            speed=speed,
            curvature=turning / (squared * speed),
            curvature_rate=(change * squared - 3.0 * turning * stretch) / (squared * squared * squared),
        )

    # --- arc length ---------------------------------------------------------------------------------------------------

    @cached_property
    def _arc(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Breaks, coefficients and total of the tabulated arc length, including an open path's continuations."""
        breaks, coefficients, total = integrate(lambda theta: np.hypot(*self.sigma(theta, 1)), self.knots)
        if self.period is None:
            span = breaks[-1] - breaks[0]
            v0, v1 = np.hypot(*self.sigma(breaks[[0, -1]], 1))
            ends = np.zeros((2, 1, coefficients.shape[2]))
            ends[:, 0, :2] = [[-v0 * span, v0], [total, v1]]
            breaks = np.concatenate([[breaks[0] - span], breaks, [breaks[-1] + span]])
            coefficients = np.concatenate([ends[:1], coefficients, ends[1:]])
        return breaks, coefficients, total

    @property
    def length(self) -> float:
        """Length of the whole path, m."""
        return self._arc[2]

    def arc_length(self, theta: Array) -> Array:
        """Return the arc length η₁ = g(θ) = ∫ ‖σ′‖ dθ from the path's start, equation (5), m.

        Laps count: η₁(θ + period) = η₁(θ) + length.
        """
        breaks, coefficients, total = self._arc
        if self.period is None:
            return piecewise(breaks, coefficients, theta)[0]
        lap, rest = wrap(theta, 0.0, self.period)
        return lap * total + piecewise(breaks, coefficients, rest)[0]

    def parameter_at(self, s: Array) -> Array:
        """Return the parameter θ at the arc length s, the inverse of `arc_length`; laps count. NumPy only.

        Parameters
        ----------
        s : float or array
            Arc length η₁, m.
        """
        s = np.asarray(s, dtype=float)
        if self.period is not None:
            lap, rest = wrap(s, 0.0, self.length)
            theta = _invert(self, rest) + lap * self.period
        else:
            inside = np.clip(s, 0.0, self.length)
            theta = _invert(self, inside)
            theta = theta + (s - inside) / np.hypot(*self.sigma(theta, 1))
        return theta if theta.ndim else float(theta)

    @cached_property
    def sampling(self) -> tuple[np.ndarray, np.ndarray]:
        """Parameters dense enough for searches to start from, including the ends, and their arc lengths."""
        theta = _grid(self)
        lengths = np.asarray(self.arc_length(theta))
        lengths[-1] = self.length
        return theta, lengths

    @cached_property
    def sampled(self) -> np.ndarray:
        """Points at the parameters of `sampling`, shape (2, N)."""
        return np.asarray(self.sigma(self.sampling[0]))

    # --- neighbourhood ------------------------------------------------------------------------------------------------

    @cached_property
    def _reach(self) -> tuple[np.ndarray, np.ndarray]:
        return _reach_table(self)

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
        theta = np.array([_find_nearest(self, column) for column in y.reshape(2, -1).T])
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

    # --- the value ----------------------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """Return the parameters only; tables are built again when needed."""
        return self.parameters


def check_order(path: Path, order: int) -> int:
    """Refuse an order of differentiation that isn't 0, 1, 2 or 3."""
    if order not in (0, 1, 2, 3):
        raise ParameterError(f"found order {order!r}; expected 0, 1, 2 or 3.", block=type(path).__name__, port="sigma")
    return order


# --- sampling and searches --------------------------------------------------------------------------------------------


def _subdivide(knots: np.ndarray) -> np.ndarray:
    """Return the knots with equally many points between each two of them, at least 64 intervals in all."""
    cells = max(4, -(-64 // (len(knots) - 1)))
    parts = [np.linspace(a, b, cells, endpoint=False) for a, b in pairwise(knots)]
    return np.append(np.concatenate(parts), knots[-1])


def _grid(path: Path) -> np.ndarray:
    """Return path parameters whose cells turn by at most 0.05 rad and are at most length/400 long."""
    theta = _subdivide(path.knots)
    for _ in range(14):
        middle = (theta[1:] + theta[:-1]) / 2.0
        ends, mids = path.frame(theta), path.frame(middle)
        curvature = np.max(np.abs([ends.curvature[1:], ends.curvature[:-1], mids.curvature]), axis=0)
        size = np.max([ends.speed[1:], ends.speed[:-1], mids.speed], axis=0) * np.diff(theta)
        coarse = (size * curvature > 0.05) | (size > path.length / 400.0)
        if not coarse.any():
            break
        theta = np.sort(np.concatenate([theta, middle[coarse]]))
    return theta


def _invert(path: Path, s: np.ndarray) -> np.ndarray:
    """Return the parameters at which the arc length is s, within [0, length] (Newton between brackets)."""
    theta, lengths = path.sampling
    i = np.clip(np.searchsorted(lengths, s, side="right") - 1, 0, len(theta) - 2)
    low, high = theta[i], theta[i + 1]
    result: np.ndarray = low + (high - low) * (s - lengths[i]) / (lengths[i + 1] - lengths[i])
    for _ in range(60):
        error = path.arc_length(result) - s
        low, high = np.where(error < 0, result, low), np.where(error > 0, result, high)
        step = result - error / np.hypot(*path.sigma(result, 1))
        step = np.where((step < low) | (step > high), (low + high) / 2.0, step)
        moved, result = np.abs(step - result), step
        if np.all(moved <= 4e-16 * (1.0 + np.abs(result))):
            break
    return result


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


def _find_nearest(path: Path, y: np.ndarray) -> float:
    """Return the parameter of the point of the path nearest to y, among all of it."""
    # Around every dip of the sampled distance that may be the least, three cells to both sides are resampled 16 times
    # as finely, twice, since two minima may share a cell near a cusp of the evolute. The dips left are polished by
    # Newton steps within their brackets, and the best is returned.
    if not np.all(np.isfinite(y)):
        return float("nan")
    theta, lengths = path.sampling
    squared = np.sum((path.sampled - y[:, None]) ** 2, axis=0)
    bound = (np.sqrt(np.min(squared)) + np.max(np.diff(lengths))) ** 2
    ends = [theta[0], theta[-1]] if path.period is None else []
    if path.period is not None:
        theta = np.concatenate([theta[-4:-1] - path.period, theta, theta[1:4] + path.period])
        squared = np.concatenate([squared[-4:-1], squared, squared[1:4]])
    i = np.flatnonzero(_dips(squared) & (squared <= bound))
    low, high = theta[np.maximum(i - 3, 0)], theta[np.minimum(i + 3, len(theta) - 1)]
    for margin in (3, 1):
        fine = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 97)
        d = np.sum((path.sigma(fine) - y[:, None, None]) ** 2, axis=0)
        row, column = np.nonzero(_dips(d))
        best = np.argsort(d[row, column], kind="stable")[:MOST_MINIMA]
        row, column = row[best], column[best]
        low, high = fine[row, np.maximum(column - margin, 0)], fine[row, np.minimum(column + margin, 96)]
    candidates = _polish(path, y, low, high)
    for end in ends:
        candidates = np.where(np.abs(candidates - end) <= 1e-15 * (theta[-1] - theta[0]), end, candidates)
    candidates = np.concatenate([ends, candidates])
    distance = np.sum((path.sigma(candidates) - y[:, None]) ** 2, axis=0)
    return float(candidates[np.argmin(distance)])


def _dips(values: np.ndarray) -> np.ndarray:
    """Return a mask of the values that are no larger than their neighbours along the last axis."""
    padded = np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 1)], constant_values=np.inf)
    dips: np.ndarray = (values <= padded[..., :-2]) & (values <= padded[..., 2:])
    return dips


def _polish(path: Path, y: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the rising roots of (σ − y)ᵀσ′ between brackets, by Newton steps, or halving if one would leave them."""
    theta: np.ndarray = (low + high) / 2.0
    for _ in range(60):
        s0, s1, s2 = path.derivatives(theta, 2)
        d = s0 - y[:, None]
        slope, curve = np.sum(d * s1, axis=0), np.sum(s1 * s1 + d * s2, axis=0)
        low, high = np.where(slope < 0, theta, low), np.where(slope > 0, theta, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = theta - slope / curve
        step = np.where((curve > 0) & (step >= low) & (step <= high), step, (low + high) / 2.0)
        step = np.where(slope == 0, theta, step)
        moved, theta = np.abs(step - theta), step
        if np.all(moved <= 2e-16 * (1.0 + np.abs(theta))):
            break
    return theta


# --- reach ------------------------------------------------------------------------------------------------------------


class _Contact:
    """Curvature of the circle that touches the path at θ and passes through its point at φ: 2 nᵀΔ/|Δ|²."""

    def __init__(self, path: Path):
        self.path = path
        self.near = 1e-4 * path.length / np.pi
        theta, _ = path.sampling
        points = path.sampled
        if path.period is not None:  # one more cell at both ends gives every maximum two neighbours
            theta = np.concatenate([[theta[-2] - path.period], theta, [theta[1] + path.period]])
            points = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
        self.phi, self.points = theta, points

    def curvature(self, theta: np.ndarray, phi: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the curvature for θ (M,), φ (M, P) and σ(φ) (2, M, P); near θ its series, κ + κ_s Δs/3."""
        frame = self.path.frame(theta)
        apart = phi - theta[:, None]
        if self.path.period is not None:
            apart = apart - self.path.period * np.round(apart / self.path.period)
        s = frame.speed[:, None] * apart
        d = points - frame.sigma[:, :, None]
        squared = np.sum(d * d, axis=0)
        across = 2.0 * np.sum(frame.normal[:, :, None] * d, axis=0)
        close = np.abs(s) < self.near
        series = frame.curvature[:, None] + frame.curvature_rate[:, None] * s / 3.0
        far = across / np.maximum(squared, np.maximum(np.abs(across) / CROWDED, 1e-300))
        result: np.ndarray = np.where(close, series, far)
        return result

    def inverse_reach(self, theta: np.ndarray) -> np.ndarray:
        """Return the largest contact curvature at each θ, left and right: shape (M, 2)."""
        return np.concatenate([self._maxima(part) for part in np.array_split(theta, 1 + len(theta) // 256)])

    def _maxima(self, theta: np.ndarray) -> np.ndarray:
        if not len(theta):
            return np.zeros((0, 2))
        points = np.broadcast_to(self.points[:, None, :], (2, len(theta), len(self.phi)))
        table = self.curvature(theta, np.broadcast_to(self.phi, points.shape[1:]), points)
        own = self.path.frame(theta).curvature
        sides = []
        for sign in (1.0, -1.0):
            best = np.maximum(np.max(sign * table, axis=1), sign * own)
            peaks = np.where(
                (sign * table[:, 1:-1] >= sign * table[:, :-2]) & (sign * table[:, 1:-1] >= sign * table[:, 2:]),
                sign * table[:, 1:-1],
                -np.inf,
            )
            for _ in range(2):  # the two highest peaks of the samples, made exact
                column = np.argmax(peaks, axis=1)
                peaks[np.arange(len(theta)), column] = -np.inf
                best = np.maximum(best, self._peak(theta, self.phi[column], self.phi[column + 2], sign))
            sides.append(np.clip(best, 1.0 / UNLIMITED, CROWDED))
        return np.stack(sides, axis=1)

    def _peak(self, theta: np.ndarray, low: np.ndarray, high: np.ndarray, sign: float) -> np.ndarray:
        """Return the maximum over φ between two brackets (golden section)."""
        golden = (np.sqrt(5.0) - 1.0) / 2.0

        def value(phi: np.ndarray) -> np.ndarray:
            return sign * self.curvature(theta, phi[:, None], self.path.sigma(phi)[:, :, None])[:, 0]

        a, b = high - golden * (high - low), low + golden * (high - low)
        fa, fb = value(a), value(b)
        for _ in range(30):
            left = fa >= fb
            low, high = np.where(left, low, a), np.where(left, b, high)
            new = np.where(left, high - golden * (high - low), low + golden * (high - low))
            f = value(new)
            a, b, fa, fb = np.where(left, new, b), np.where(left, a, new), np.where(left, f, fb), np.where(left, fa, f)
        best: np.ndarray = np.maximum(fa, fb)
        return best


def _reach_table(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return breaks and coefficients (pieces, 2, 2) of the inverse reach, left and right, linear between the nodes."""
    # The inverse reach is a maximum of smooth functions, so at its kinks straight lines lie above it, on the safe side.
    # Intervals are cut in three until the line is near enough at both thirds; then the slack is added everywhere.
    contact = _Contact(path)
    flat = 0.15 / path.length  # errors below it don't matter: the reach is then many times the path's size
    theta = _subdivide(path.knots)
    values = contact.inverse_reach(theta)
    open_ = np.ones(len(theta) - 1, dtype=bool)  # intervals still to examine
    for _ in range(8):
        index = np.flatnonzero(open_)
        thirds, exact, bad = [], [], np.zeros(len(index), dtype=bool)
        for part in (1.0 / 3.0, 2.0 / 3.0):
            thirds.append(theta[index] + part * (theta[index + 1] - theta[index]))
            exact.append(contact.inverse_reach(thirds[-1]))
            excess = exact[-1] - (values[index] + part * (values[index + 1] - values[index]))
            scale = np.maximum(exact[-1], flat)
            bad |= np.any((excess > SLACK * scale) | (excess < -GENEROUS * scale), axis=1)
        if not bad.any():
            break
        place = np.repeat(index[bad] + 1, 2)
        theta = np.insert(theta, place, np.stack(thirds, axis=1)[bad].ravel())
        values = np.insert(values, place, np.stack(exact, axis=1)[bad].reshape(-1, 2), axis=0)
        first = index[bad] + 2 * np.arange(bad.sum())
        open_ = np.zeros(len(theta) - 1, dtype=bool)
        open_[np.concatenate([first, first + 1, first + 2])] = True
    values = np.where(values > 1.0 / UNLIMITED, values + 2.0 * SLACK * np.maximum(values, flat), values)
    slope = np.diff(values, axis=0) / np.diff(theta)[:, None]
    return theta, np.stack([values[:-1], slope], axis=2)
