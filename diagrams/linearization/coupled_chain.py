"""Linear models of a communication step in which inputs of FMUs follow outputs: of Gauss-Seidel and iterated coupling.

A step leads from the state just before a tick to the one before the next tick. ``x`` are the states of blocks, ``p``
those of the FMUs, ``z`` the inputs that have acted on the FMUs' outputs ``w``. Derivatives are by that state and by the
injected signals, side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ...blocks.core import OptionError, left_of
from ..coupling import Links, Scheme, passes_slopes
from ..flat import NONE
from ..results import OperatingPoint
from .derivatives import LocalDerivatives
from .plant_models import PlantModel, join_matrices

_RESTS = 1e-9
"""Largest change of a value over a step at rest, relative to 1 + its size."""


@dataclass
class LinearStep:
    """A communication step about its operating point: derivatives of states, inputs and outputs, with their values."""

    x: np.ndarray  # derivatives of the states of blocks after the flow, one row for each entry
    z: np.ndarray  # of the inputs that act
    w: np.ndarray  # of the outputs before the step, and then of those after it
    p: np.ndarray  # of the FMUs' states
    t: float  # in s
    end: float
    x_end: np.ndarray  # states of blocks after the flow
    w_here: np.ndarray  # outputs before the step
    z_here: np.ndarray  # inputs at the tick
    p_places: dict[str, slice]  # rows of each FMU's states, by path


@dataclass(frozen=True)
class CoupledChain:
    """Communication steps of one scheme, linearized."""

    local: LocalDerivatives
    links: Links
    order: tuple[str, ...]  # in which the FMUs step one after the other; empty for iterated coupling

    @property
    def straight(self) -> np.ndarray:
        """Outputs that iterated coupling takes from a step with the inputs at its end, shape (outputs,)."""
        if self.order:
            return np.zeros(len(self.links.direct), dtype=bool)
        return np.asarray((self.links.direct & self.links.moving[None, :]).any(axis=1))

    def go(
        self,
        step: LinearStep,
        model: Callable[[str, np.ndarray], PlantModel],
        flow_by_w: np.ndarray,
    ) -> dict[str, PlantModel]:
        """Take a step: ``step`` holds what follows; return the models of the FMUs' steps.

        ``step.x`` and ``step.z`` come with held outputs, ``step.p`` are the FMUs' states before it. ``flow_by_w`` is
        the derivative of the blocks' states after the flow by the outputs that are held over it.
        """
        return self._go_in_order(step, model) if self.order else self._iterate(step, model, flow_by_w)

    def _go_in_order(self, step: LinearStep, model: Callable[[str, np.ndarray], PlantModel]) -> dict[str, PlantModel]:
        """Step the FMUs one after the other; an input follows the outputs of those that have stepped already."""
        w, z, made = step.w_here.copy(), step.z_here.copy(), dict[str, PlantModel]()
        renewed = self.links.renewed_inputs(self.order)
        for path in self.order:
            rows = renewed[path]
            if rows.size:
                J = self.local.differentiate(NONE, left_of(step.end), step.x_end, w)
                z = z.astype(np.result_type(z, J["z"]))
                z[rows] = J["z"][rows]
                step.z[rows] = (J["z", "x"] @ step.x + J["z", "w"] @ step.w)[rows]
                step.z[rows, step.z.shape[1] - self.local.n_inputs :] += J["z", "d"][rows]
            m = made[path] = model(path, z)
            states, inputs = step.p_places[path], step.z[m.inputs]
            own = step.p[states]
            step.w[m.outputs] = m.y_by_states @ own + m.y_by_inputs @ inputs
            step.p[states] = m.A @ own + m.B @ inputs
            w = w.astype(np.result_type(w, m.y_next))
            w[m.outputs] = m.y_next
        return made

    def _iterate(
        self, step: LinearStep, model: Callable[[str, np.ndarray], PlantModel], flow_by_w: np.ndarray
    ) -> dict[str, PlantModel]:
        """Solve for the outputs at the end of the step, of which the inputs and the flow take the mean."""
        links, n_d = self.links, self.local.n_inputs
        J = self.local.differentiate(NONE, left_of(step.end), step.x_end, step.w_here)
        made = {path: model(path, step.z_here) for path in links.paths}
        self._check_rest(step, made, J["z"])
        S, H = (np.diag(part.astype(float)) for part in (links.moving & links.smooth_inputs, links.smooth_outputs))
        models = [made[path] for path in step.p_places]
        A, B = (join_matrices(self.local.flat, models, which) for which in "AB")
        ends = [replace(m, C=m.y_by_states, D=m.y_by_inputs) for m in models]
        C, D = (join_matrices(self.local.flat, ends, which) for which in "CD")
        R = np.diag(self.straight.astype(float))
        x0 = step.x - 0.5 * flow_by_w @ H @ step.w  # and + 0.5 flow_by_w H w, with w at the end
        x1 = 0.5 * flow_by_w @ H
        last0, last1 = S @ J["z", "x"] @ x0 + step.z - S @ step.z, S @ (J["z", "x"] @ x1 + J["z", "w"])
        last0[:, last0.shape[1] - n_d :] += S @ J["z", "d"]
        mean0, mean1 = step.z + 0.5 * S @ (last0 - step.z), 0.5 * S @ last1
        one, into = np.eye(len(step.w)), np.eye(len(step.w)) - R
        loop = one - R @ D @ last1 - into @ D @ mean1
        if len(loop) and not np.linalg.cond(loop) < 1e12:
            raise OptionError(
                "found a loop through the FMUs' feedthrough without a unique solution; expected one, which iterated "
                "coupling finds. Wire an output without feedthrough, or linearize at a point of a run with coupling "
                "'jacobi'.",
                block=links.paths[0],
                port="coupling",
            )
        w1 = np.linalg.solve(loop, C @ step.p + R @ D @ last0 + into @ D @ mean0)
        step.x, step.z = x0 + x1 @ w1, mean0 + mean1 @ w1
        step.p, step.w = A @ step.p + B @ step.z, w1
        return made

    def check_ticks(self, holds: bool) -> None:
        """Refuse FMUs of which one does not step at a tick, as where the clock that it is wired to is held."""
        if holds:
            raise OptionError(
                "found an FMU that does not step at every tick, with a coupling whose inputs follow outputs within a "
                "step; expected FMUs that step together. Linearize at a point of a run with coupling 'jacobi'.",
                block=self.links.paths[0],
                port="coupling",
            )

    def _check_rest(self, step: LinearStep, made: dict[str, PlantModel], z_end: np.ndarray) -> None:
        """Refuse a point at which something moves: an iteration is linearized where it has nothing to do."""
        moved = {path: [m.f - m.x0, m.y_next - step.w_here[m.outputs]] for path, m in made.items()}
        where = {path: np.arange(len(z_end))[self.links.inputs[path]] for path in made}
        for path, rows in where.items():
            moved[path].append(((z_end - step.z_here) * self.links.moving)[rows])
        sizes = {path: np.concatenate([np.abs(part) for part in parts]) for path, parts in moved.items()}
        worst = max(sizes, key=lambda path: float(sizes[path].max(initial=0.0)))
        change, size = float(sizes[worst].max(initial=0.0)), 1.0 + float(np.abs(step.w_here).max(initial=0.0))
        if change > _RESTS * size:
            raise OptionError(
                f"found an operating point of a run with iterated coupling at which the FMU moves by {change:.3g} in a "
                "communication step; expected one at rest. Linearize at rest, or at a point of a run with coupling "
                "'gauss_seidel' or 'jacobi'.",
                block=worst,
                port="coupling",
                t=step.t,
            )


def coupling_at(local: LocalDerivatives, at: OperatingPoint) -> CoupledChain | None:
    """Return the steps of the coupling of the run at a point; None where inputs are held from a step's beginning.

    The default coupling holds them. Where every input comes from sampled subsystems, every scheme does.
    """
    links = Links(local.flat)
    for path, inputs in links.inputs.items():
        if inputs.stop > inputs.start and passes_slopes(local.flat.table.blocks[path]):
            raise OptionError(
                "found input_derivatives among its options: its inputs are ramps over a communication step; expected "
                "held inputs, which a linear model over communication steps has. Linearize the diagram with "
                f"replace({{{path!r}: …}}), the FMU without this option.",
                block=path,
                port="stepping",
            )
    found = [path for path in links.paths if links.moving[links.inputs[path]].any()]
    if not at.coupling or not (found or links.felt.any()):
        return None
    if at.coupling not in [scheme.value for scheme in Scheme]:
        raise OptionError(
            f"found an operating point of a run with coupling {at.coupling!r}, in which the length of a communication "
            "step depends on the motion; expected steps from tick to tick, which a linear model over communication "
            "steps follows. Linearize at a point of a run without error=, or, without sampled subsystems, in "
            "continuous time: linearize(t) without step=, which all couplings approach with shorter steps.",
            block=(found or [*links.paths])[0],
            port="coupling",
        )
    one_by_one = at.coupling == Scheme.GAUSS_SEIDEL
    return CoupledChain(local, links, (at.coupling_order or links.order(())) if one_by_one else ())
