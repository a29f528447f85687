"""Checks of the options and signals of a linear model."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ...blocks.core import NonFiniteError, OptionError, WiringError, check_argument, kinds
from ..coupling import Links, Scheme, tells_slopes
from ..flat import NONE, FlatDiagram, WiredDiagram
from ..results import OperatingPoint
from .coupled_chain import CoupledChain
from .derivatives import LocalDerivatives, Tap
from .mean_stairs import NO_STAIRS, Stairs


def as_list(given: str | Iterable[str]) -> list[str]:
    """Return a name, or several, as a list."""
    check_argument(given, kinds.names, "inputs, outputs and openings", "linearize")
    return [given] if isinstance(given, str) else list(given)


def check_slopes(slopes: np.ndarray) -> np.ndarray:
    """Return the derivatives of a trim's equations; refuse those that are not finite.

    Raises
    ------
    NonFiniteError
        Such a derivative, as that of a root at 0.
    """
    if not np.isfinite(slopes).all():
        raise NonFiniteError(
            "trim: found a derivative of the diagram's equations that is not finite; expected finite numbers, and a "
            "root has none at 0. Begin elsewhere: at= another time, or with other initial states."
        )
    return slopes


def replace_stairs(diagram: WiredDiagram, flat: FlatDiagram, at: OperatingPoint, stairs: str | None) -> Stairs:
    """Return the stairs that are replaced by their mean slopes."""
    if stairs is None:
        return NO_STAIRS
    if not isinstance(stairs, str) or stairs != "gain":
        raise OptionError(
            f'found stairs={stairs!r}; expected "gain", which takes stairs as their mean slope, or None. Choose one.',
            block=diagram.name,
            port="stairs",
        )
    return Stairs.of(flat, at)


def check_loop(flat: FlatDiagram, local: LocalDerivatives, at: OperatingPoint) -> None:
    """Refuse the loop of a wire that changes between ticks and acts there."""
    moving = find_moving(flat, local, at)
    if moving:
        raise OptionError(
            f"{moving[0]!r} changes between ticks, and blocks in continuous time use it there; expected a loop that is "
            "closed at ticks. Take the loop at a sampled signal, or that of diagram.continuous().",
            block=local.inputs[0].port[0],
            port=local.inputs[0].port[1],
        )


def refuse_transport_delays(flat: FlatDiagram) -> None:
    """Refuse a diagram with transport delays in continuous time."""
    for path in sorted(flat.table.blocks):
        if flat.table.blocks[path].transport and path not in flat.checked.traced:
            raise WiringError(
                "found a transport delay in continuous time, which has no finite linear model; expected none. Put it "
                "into a sampled subsystem, where it is a delay of whole samples, or take PadeDelay(delay=…, order=…).",
                block=path,
            )


def check_opening(flat: FlatDiagram, signal: Tap) -> None:
    """Refuse to cut a port without consumers."""
    if signal.port in {(w.block, w.port) for w in flat.table.wires.values()}:
        return
    raise WiringError(
        f"found nothing wired to it; expected a wire to cut at {signal.name!r}. Name a wire that closes a loop.",
        block=signal.port[0],
        port=signal.port[1],
    )


def check_coupling(flat: FlatDiagram, local: LocalDerivatives, at: OperatingPoint) -> CoupledChain | None:
    """Return the steps of the coupling of the run at a point; None where inputs are held from a step's beginning.

    The default coupling holds them. Where every input comes from sampled subsystems, every scheme does.

    Raises
    ------
    OptionError
        If the run takes adaptive communication steps, or tells an FMU slopes.
    """
    for path, inputs in Links(flat).inputs.items():
        if inputs.stop > inputs.start and tells_slopes(flat.table.blocks[path]):
            raise OptionError(
                "found input_derivatives among its options: its inputs are ramps over a communication step; expected "
                "held inputs, which a linear model over communication steps has. Linearize the diagram with "
                f"replace({{{path!r}: …}}), the FMU without this option.",
                block=path,
                port="stepping",
            )
    links = Links(flat)
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
    return CoupledChain(flat, local, links, (at.coupling_order or links.order(())) if one_by_one else ())


def find_moving(flat: FlatDiagram, local: LocalDerivatives, at: OperatingPoint) -> tuple[str, ...]:
    """Return the names of injected signals that change between ticks and that continuous blocks use there."""
    if not flat.continuous.size:
        return ()
    by_d = local.differentiate(NONE, at.t, at.x, at.w)["dx", "d"]
    injected = zip(local.inputs, local.injected, strict=True)
    return tuple(signal.name for signal, where in injected if np.any(by_d[:, where]) and is_moving(flat, signal))


def is_moving(flat: FlatDiagram, signal: Tap) -> bool:
    """Whether a signal follows continuous states between two ticks."""
    return bool(flat.output(signal.port).depends("y", "x")[:, flat.continuous].any())
