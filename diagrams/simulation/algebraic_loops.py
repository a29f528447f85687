"""Algebraic loops, solved at an instant: Newton's method, and signs that a solution is not the only one.

The loops are the equations F(v) = v of the values v at their torn ports. J = ∂F/∂v − 1 is exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatDiagram, TickPattern

if TYPE_CHECKING:
    from ..compiled import NewtonOptions

TOLERANCE = 1e-9
"""Largest residual of an algebraic loop that counts as solved, relative to 1 + the size of its values."""
ROUNDING = 1e-14
"""Relative residual up to which it is solved no further."""
ITERATIONS, HALVINGS = 50, 30
"""Steps of Newton's method, and halvings of one, at most."""
SINGULAR = 1e-13
"""Least singular value of J that determines the values, relative to 1 + the loop's gain."""
_FEW = 4  # values of loops whose linear equations are solved by the operations of `newton.c`, in the same order
_ASIDE = 1e-3  # step along a direction in which J is zero, relative to 1 + the size of the values
_APART = 1e-6  # distance of two solutions, relative to 1 + their size
_STARTS = (0.0, 1.0, -1.0, 10.0, -10.0, 0.1, -0.1, 100.0, -100.0)


class LoopSolver:
    """Solves the algebraic loops at the vectors that an evaluation of them is bound to."""

    def __init__(
        self,
        names: Sequence[str],  # of each entry, such as "e.y"
        where: Sequence[int],  # entries of x that hold v
        t: np.ndarray,  # shape (1,)
        x: np.ndarray,  # v is sought in it, from the values there on
        call: Callable[[], None],  # evaluates what comes round the loops less v, and J, into r and J
        r: np.ndarray,
        J: np.ndarray,
        loops: Sequence[str],  # written port by port, for messages
    ):
        self.names, self.where, self.t, self.x, self.call, self.r = names, np.array(where), t, x, call, r
        n = len(names)
        self.J = J.reshape(n, n, order="F")
        self.loops = loops

    def solve(self, *, search: bool = False) -> None:
        """Solve them from the values in x on; at the start ``search`` begins from a few other values if that fails."""
        # A step of Newton's method that makes the residual larger is halved, and on, as long as that helps. At the
        # start no solution comes before; then the nearest one to the values in x is taken.
        before = self.x[self.where].copy()
        found = self._seek()
        if not found <= TOLERANCE and math.isfinite(found):  # a NaN that comes in is reported by who made it
            if not search:
                raise self._unsolved(found)
            others = self._search(before, ())
            if not others:
                raise self._unsolved(found, "the last solution and from a few other values")
            away = [float(np.max(np.abs(v - before))) for v in others]
            nearest = min(away) + _APART * (1.0 + min(away))  # of two that are as near, the one that is found first
            self.x[self.where] = next(v for v, distance in zip(others, away, strict=True) if distance <= nearest)
            self.call()

    def _size(self, v: np.ndarray) -> float:
        return float(np.max(np.abs(self.r)) / (1.0 + np.max(np.abs(v))))

    def _seek(self) -> float:
        """Go to a solution, and return the residual that is left, relative to 1 + the size of the values."""
        x, where, call, r = self.x, self.where, self.call, self.r
        call()
        v = x[where]
        size = _length(r)
        for _ in range(ITERATIONS):
            if not self._size(v) > ROUNDING:
                break
            try:
                direction = _eliminate(self.J, r) if len(r) <= _FEW else np.linalg.solve(self.J, r)
            except np.linalg.LinAlgError:  # the shortest step, to one of many solutions if there are any
                direction = np.linalg.lstsq(self.J, r)[0] if np.all(np.isfinite(self.J)) else np.array([math.nan])
            if not np.all(np.isfinite(direction)):
                break
            best, step = 0.0, 1.0  # the mismatch itself must shrink: relative to values that run away, any would
            for _ in range(HALVINGS):
                x[where] = v - step * direction
                call()
                now = _length(r)
                if now < size:
                    best, size = step, now
                elif best:
                    break
                if best == 1.0:
                    break
                step *= 0.5
            if best != step:
                x[where] = v - best * direction  # the best one; 0 at the level of rounding, or where it is stuck
                call()
            if not best:
                break
            v = x[where]
        return self._size(x[where])

    # --- solutions that are not the only ones -------------------------------------------------------------------------

    def check_determined(self) -> None:
        """Refuse values that the loops do not determine: neighbours in some direction solve them as well."""
        J = self.J
        gain = float(np.max(np.abs(J + np.eye(len(J))), initial=0.0))
        if not np.all(np.isfinite(J)):
            return
        if len(J) == 1:
            least, direction = abs(float(J[0, 0])), np.ones(1)
        else:
            _, sizes, rows = np.linalg.svd(J)
            least, direction = float(sizes[-1]), rows[-1]
        if least > SINGULAR * (1.0 + gain):
            return
        solution = self.x[self.where].copy()
        aside = _ASIDE * (1.0 + np.max(np.abs(solution))) * direction
        free = False
        for sign in (1.0, -1.0):  # a multiple root has no neighbours, and is determined
            self.x[self.where] = solution + sign * aside
            self.call()
            free = free or self._size(solution) <= ROUNDING * (1.0 + gain)
        self.x[self.where] = solution
        self.call()
        if free:
            raise self._undetermined(direction)

    def others(self) -> list[np.ndarray]:
        """Return other solutions, as far as Newton's method finds them from a few other values; x stays as it is."""
        solution = self.x[self.where].copy()
        try:
            return self._search(solution, (solution,))
        finally:
            self.x[self.where] = solution
            self.call()

    def _search(self, around: np.ndarray, known: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return solutions found from a few values of the size of some values; x is left at the last try."""
        found: list[np.ndarray] = []
        alternating = np.where(np.arange(len(around)) % 2, -1.0, 1.0)
        patterns = [np.ones(len(around))] + ([alternating] if len(around) > 1 else [])
        for start in (s * (1.0 + np.abs(around)) * p for p in patterns for s in _STARTS):
            self.x[self.where] = start
            try:
                left = self._seek()
            except SimulationError:  # of a block that has no value there
                continue
            v = self.x[self.where].copy()
            if left <= TOLERANCE and all(_differ(v, other) for other in (*known, *found)):
                found.append(v)
        return found

    # --- words -------------------------------------------------------------------------------------------------------

    def _error(self, text: str) -> SimulationError:
        loops = "\n".join(self.loops)
        path, _, port = self.names[0].rpartition(".")
        return SimulationError(f"{text}\n{loops}\n{_ADVICE}", block=path, port=port, t=float(self.t[0]))

    def _unsolved(self, residual: float, begun: str = "the last solution") -> SimulationError:
        return self._error(
            f"the algebraic loop was not solved: its residual is {residual:.3g}, expected at most {TOLERANCE:g}. "
            f"Newton's method, started from {begun}, got no closer; the loop may have none, or several."
        )

    def _undetermined(self, direction: np.ndarray) -> SimulationError:
        part = np.abs(direction) > 1e-6 * np.max(np.abs(direction))
        free = ", ".join(name for name, is_free in zip(self.names, part, strict=True) if is_free)
        return self._error(
            f"the algebraic loop does not determine {free}: it is singular, and values next to "
            f"{_text(self.x[self.where])} solve it as well; expected one solution."
        )

    def describe(self, others: Sequence[np.ndarray]) -> str:
        """Return the message that there are other solutions."""
        names = ", ".join(self.names)
        found = "; ".join(map(_text, others))
        return (
            f"The algebraic loop at {names} has several solutions at t = {float(self.t[0]):g} s. The run follows "
            f"{_text(self.x[self.where])}, which Newton's method found first; others are {found}. If another one is "
            "meant, solve the equations for the signal by hand, or break the loop with a UnitDelay(initial_value=…)."
        )


def _length(r: np.ndarray) -> float:
    return math.sqrt(sum([v * v for v in r.tolist()]))


def _eliminate(J: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return J⁻¹ r by Gaussian elimination, as `newton.c` does it; LinAlgError: J is singular."""
    a, b = J.tolist(), r.tolist()
    n = len(b)
    for k in range(n):
        best = max(range(k, n), key=lambda i: abs(a[i][k]))
        if a[best][k] == 0:
            raise np.linalg.LinAlgError
        a[k], a[best], b[k], b[best] = a[best], a[k], b[best], b[k]
        for i in range(k + 1, n):
            factor = a[i][k] / a[k][k]
            if factor:
                a[i] = [*a[i][: k + 1], *(v - factor * w for v, w in zip(a[i][k + 1 :], a[k][k + 1 :], strict=True))]
                b[i] -= factor * b[k]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            b[i] -= a[i][j] * b[j]
        b[i] /= a[i][i]
    return np.array(b)


_ADVICE = "Break it with a UnitDelay where a delay is real, or solve the equations for the signal by hand."


def _differ(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.max(np.abs(a - b)) > _APART * (1.0 + np.max(np.abs(b))))


def _text(values: np.ndarray) -> str:
    return f"{float(values[0]):.6g}" if len(values) == 1 else f"({', '.join(f'{float(v):.6g}' for v in values)})"


def loop_solver(
    flat: FlatDiagram,
    clocks: frozenset[TickPattern],
    t: np.ndarray,
    x: np.ndarray,
    call: Callable[[], None],
    r: np.ndarray,
    J: np.ndarray,
) -> LoopSolver:
    """Return the solver of the algebraic loops at a tick at which some clocks act; see `LoopSolver`."""
    where = flat.active_loops(clocks)
    names = {
        entry: name if stop - start == 1 else f"{name}[{entry - start + 1}]"
        for name, slot in flat.loops.slices.items()
        for start, stop in [(slot.start, slot.stop)]
        for entry in range(start, stop)
    }
    return LoopSolver([names[i] for i in where], where, t, x, call, r, J, flat.order.loops)


def newton_options(flat: FlatDiagram, clocks: frozenset[TickPattern], here: np.ndarray) -> NewtonOptions:
    """Return Newton's method in C for the algebraic loops at a tick; at the states ``here`` they must be determined."""
    from ..compiled import NewtonOptions

    def solver(
        t: np.ndarray, x: np.ndarray, call: Callable[[], None], r: np.ndarray, J: np.ndarray
    ) -> Callable[[], None]:
        loops = loop_solver(flat, clocks, t, x, call, r, J)

        def solve() -> None:
            loops.solve()
            if x is here:
                loops.check_determined()

        return solve

    return NewtonOptions(flat.active_loops(clocks), TOLERANCE, ROUNDING, SINGULAR, ITERATIONS, HALVINGS, solver)
