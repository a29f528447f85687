"""Planar curves: their points, moving frame and arc length. Equation numbers are those of Flixeder et al. (2014).

Conventions: t is the unit tangent, n the unit normal (t turned by +90°), κ the signed curvature, κ_s its derivative
with respect to arc length.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from ..core import Array, DefinitionError, ParameterError, Value, explain_calls
from ..library import piecewise, wrap


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


class Curve(Value):
    """Regular planar curve σ(θ), closed or open; a subclass gives `sigma` and either `period` or `domain`."""

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

    # --- the value ----------------------------------------------------------------------------------------------------

    def __getstate__(self) -> dict[str, Any]:
        """Return the parameters only; tables are built again when needed."""
        return self.parameters


def check_order(curve: Curve, order: int) -> int:
    """Refuse an order of differentiation that isn't 0, 1, 2 or 3."""
    if order not in (0, 1, 2, 3):
        raise ParameterError(f"found order {order!r}; expected 0, 1, 2 or 3.", block=type(curve).__name__, port="sigma")
    return order


# --- sampling ---------------------------------------------------------------------------------------------------------


def subdivide(knots: np.ndarray) -> np.ndarray:
    """Return the knots with equally many points between each two of them, at least 64 intervals in all."""
    cells = max(4, -(-64 // (len(knots) - 1)))
    parts = [np.linspace(a, b, cells, endpoint=False) for a, b in pairwise(knots)]
    return np.append(np.concatenate(parts), knots[-1])


def _grid(curve: Curve) -> np.ndarray:
    """Return parameters whose cells turn by at most 0.05 rad and are at most length/400 long."""
    theta = subdivide(curve.knots)
    for _ in range(14):
        middle = (theta[1:] + theta[:-1]) / 2.0
        ends, mids = curve.frame(theta), curve.frame(middle)
        curvature = np.max(np.abs([ends.curvature[1:], ends.curvature[:-1], mids.curvature]), axis=0)
        size = np.max([ends.speed[1:], ends.speed[:-1], mids.speed], axis=0) * np.diff(theta)
        coarse = (size * curvature > 0.05) | (size > curve.length / 400.0)
        if not coarse.any():
            break
        theta = np.sort(np.concatenate([theta, middle[coarse]]))
    return theta


def _invert(curve: Curve, s: np.ndarray) -> np.ndarray:
    """Return the parameters at which the arc length is s, within [0, length] (Newton between brackets)."""
    theta, lengths = curve.sampling
    i = np.clip(np.searchsorted(lengths, s, side="right") - 1, 0, len(theta) - 2)
    low, high = theta[i], theta[i + 1]
    result: np.ndarray = low + (high - low) * (s - lengths[i]) / (lengths[i + 1] - lengths[i])
    for _ in range(60):
        error = curve.arc_length(result) - s
        low, high = np.where(error < 0, result, low), np.where(error > 0, result, high)
        step = result - error / np.hypot(*curve.sigma(result, 1))
        step = np.where((step < low) | (step > high), (low + high) / 2.0, step)
        moved, result = np.abs(step - result), step
        if np.all(moved <= 4e-16 * (1.0 + np.abs(result))):
            break
    return result


# --- arc length -------------------------------------------------------------------------------------------------------


_DEGREE = 12  # of the polynomials that are fitted to the speed


@lru_cache(maxsize=1)
def _fit_matrices() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes in [0, 1], and the matrices values → Chebyshev coefficients → powers of the integral from 0."""
    x = chebyshev.chebpts1(_DEGREE + 1)
    analysis = np.linalg.inv(chebyshev.chebvander(x, _DEGREE))
    integrals = np.zeros((_DEGREE + 2, _DEGREE + 1))
    for k in range(_DEGREE + 1):
        powers: np.ndarray = np.zeros(1)
        for c in chebyshev.cheb2poly(np.eye(_DEGREE + 1)[k])[::-1]:  # T_k(2 v − 1) in powers of v, exact in float64
            powers = polynomial.polyadd(polynomial.polymul(powers, [-1.0, 2.0]), [c])
        powers = polynomial.polyint(powers)[: k + 2]
        integrals[: len(powers), k] = powers
    return (x + 1.0) / 2.0, analysis, integrals


def integrate(speed: Callable[[np.ndarray], np.ndarray], knots: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return breaks, coefficients (pieces, 1, powers) and total of the integral of ``speed`` from the first knot on."""
    # intervals are halved until the Chebyshev coefficients of the speed on each have decayed to rounding errors
    nodes, analysis, integrals = _fit_matrices()
    start, width = np.asarray(knots[:-1], dtype=float), np.diff(knots)
    done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    scale = None
    for level in range(60):
        values = speed((start[:, None] + width[:, None] * nodes).ravel()).reshape(len(start), -1)
        fitted = values @ analysis.T
        if scale is None:
            scale = float(np.sum(width * fitted[:, 0]))
        tail = np.max(np.abs(fitted[:, -2:]), axis=1)
        accept = (tail <= 1e-15 * np.max(values, axis=1)) | (width * tail <= 2e-17 * scale) | (level == 59)
        done.append((start[accept], width[accept], fitted[accept]))
        start, width = start[~accept], width[~accept] / 2.0
        if not len(start):
            break
        start, width = np.concatenate([start, start + width]), np.concatenate([width, width])
    starts, widths, fits = (np.concatenate([d[i] for d in done]) for i in range(3))
    order = np.argsort(starts, kind="stable")
    starts, widths, fits = starts[order], widths[order], fits[order]
    k = np.arange(0, _DEGREE + 1, 2)
    areas = widths * (fits[:, k] @ (1.0 / (1.0 - k**2)))  # ∫ T_k over [−1, 1] is 2 / (1 − k²) for even k
    ends = np.concatenate([[0.0], np.cumsum(areas)])
    coefficients = (fits @ integrals.T) * widths[:, None] ** (1.0 - np.arange(_DEGREE + 2))
    coefficients[:, 0] = ends[:-1]
    return np.append(starts, knots[-1]), coefficients[:, None, :], float(ends[-1])
