"""Checks of the options and signals of a linear model."""

from __future__ import annotations

from ...blocks.core import OptionError, WiringError
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint
from .derivatives import LocalDerivatives, Tap
from .mean_stairs import NO_STAIRS, Stairs
from .over_a_period import find_moving


def replace_stairs(diagram: WiredDiagram, flat: FlatDiagram, at: OperatingPoint, stairs: str | None) -> Stairs:
    """Return the stairs that are replaced by their mean slopes."""
    if stairs is None:
        return NO_STAIRS
    if stairs != "gain":
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
