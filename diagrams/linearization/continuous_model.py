"""Continuous linear models of diagrams without sampling."""

from __future__ import annotations

import numpy as np

from ...blocks.core import OptionError
from ..flat import NONE, FlatDiagram, WiredDiagram
from ..results import OperatingPoint
from .derivatives import LocalDerivatives
from .over_a_period import Model
from .plant_models import join_matrices, states_of


def model_continuous(
    diagram: WiredDiagram, flat: FlatDiagram, local: LocalDerivatives, at: OperatingPoint, plants: str | None
) -> Model:
    """Return the model of a diagram without sampling."""
    J = local.differentiate(NONE, at.t, at.x, at.w)
    models = local.model_equations(at, plants)
    xc = flat.continuous
    Ap, Bp, Cp, Dp = (join_matrices(flat, models, which) for which in "ABCD")
    # w = Cp xp + Dp z, z = Zx x + Zw w + Zd d
    loop = np.eye(len(at.w)) - Dp @ J["z", "w"]
    if loop.size and not np.linalg.cond(loop) < 1e12:
        raise OptionError(
            "found a loop through the FMU's feedthrough without a unique solution; expected one. Wire an output "
            "without feedthrough, or linearize over a step, step=….",
            block=diagram.name,
        )
    zx = J["z", "x"][:, xc]
    w_of = {k: np.linalg.solve(loop, v) for k, v in (("x", Dp @ zx), ("p", Cp), ("d", Dp @ J["z", "d"]))}
    z_of = {
        "x": zx + J["z", "w"] @ w_of["x"],
        "p": J["z", "w"] @ w_of["p"],
        "d": J["z", "d"] + J["z", "w"] @ w_of["d"],
    }

    def eliminate_w(quantity: str) -> list[np.ndarray]:
        by_w = J[quantity, "w"]
        return [J[quantity, "x"][:, xc] + by_w @ w_of["x"], by_w @ w_of["p"], J[quantity, "d"] + by_w @ w_of["d"]]

    fx, fp, fd = eliminate_w("dx")
    yx, yp, yd = eliminate_w("y")
    A = np.block([[fx, fp], [Bp @ z_of["x"], Ap + Bp @ z_of["p"]]])
    B = np.vstack([fd, Bp @ z_of["d"]])
    return Model(
        (A, B, np.hstack([yx, yp]), yd),
        0.0,
        flat.continuous_labels + states_of(models),
        np.concatenate([J["dx"], *(m.f for m in models)]),
        {m.path: m.derivation for m in models},
        max((m.uncertainty for m in models), default=0.0),
    )
