"""Parts of a diagram that can't be exported, or can't be on a target: each is named by its path, with one next step."""

from __future__ import annotations

from ...blocks.core import DefinitionError
from ...fmus import Fmu
from ...fmus.export import CLOCK_LIMIT
from ..flat import FlatDiagram
from .open_diagram import OpenDiagram


def refuse(opened: OpenDiagram) -> None:
    """Refuse a diagram with parts that can't be exported.

    Raises `DefinitionError`: for the first one.
    """
    table = opened.wired.scheduled
    for path, block in table.blocks.items():
        if path == opened.outside:
            continue
        if block.transport and not table.is_sampled(table.subsystem_of[path]):
            raise DefinitionError(
                "it is a transport delay in continuous time, which keeps each step of the solver for the length of the "
                "delay: its memory has no bound, also for a constant delay, and an exported diagram has a fixed one. "
                "Put it into a sampled subsystem, @subsystem(sample_time=…), where it is a delay by whole samples.",
                block=path,
            )
        if block.opaque and not isinstance(block, Fmu):
            raise DefinitionError(
                "Python evaluates it, and nothing exported has Python inside. Write its equations with NumPy functions "
                "that can be traced, or export the part of the diagram without it.",
                block=path,
            )


def refuse_fmus(opened: OpenDiagram) -> None:
    """Refuse FMUs: a target has the plant in front of it."""
    for path, block in opened.wired.scheduled.blocks.items():
        if path != opened.outside and (block.in_model_exchange or (block.stepped and not block.transport)):
            raise DefinitionError(
                f"it is an FMU, and no target has one. Leave it outside: outside=[{path!r}].", block=path
            )


def find_continuous(opened: OpenDiagram) -> list[str]:
    """Return the paths of blocks with states in continuous time."""
    table = opened.wired.scheduled
    return [
        path
        for path, trace in opened.wired.checked.traced.items()
        if not table.is_sampled(table.subsystem_of[path]) and trace.advance == "derivative" and trace.states
    ]


def _refuse_states(opened: OpenDiagram) -> None:
    """Refuse blocks with states in continuous time."""
    for path in find_continuous(opened):
        raise DefinitionError(
            "it is in continuous time, and C in single precision has ticks alone. Take number='double', whose source "
            "has the loop of runs inside, put it into a sampled subsystem, @subsystem(sample_time=…), or leave it "
            f"outside: {_leave_out(opened)}.",
            block=path,
        )


def _leave_out(opened: OpenDiagram) -> str:
    """Return what to write, so that blocks in continuous time with states stay outside."""
    table = opened.wired.scheduled
    clocked = [path for path in table.subsystems if path and "." not in path and table.is_sampled(path)]
    alone = f", or write a sampled subsystem alone: subsystem={clocked[0]!r}" if clocked else ""
    return f"outside={find_continuous(opened)}{alone}"


def refuse_between_ticks(opened: OpenDiagram, flat: FlatDiagram) -> None:
    """Refuse what happens between ticks, and algebraic loops: nothing but ticks is on a target."""
    _refuse_states(opened)
    for event in flat.events:
        raise DefinitionError(
            f"its event {event.name!r} is between ticks, and C in single precision has ticks alone. Take "
            "number='double', whose source has the loop of runs inside, or put it into a sampled subsystem, "
            "sample_time=….",
            block=event.path,
        )
    for full in flat.loops.slices:
        path, port = flat.ports[full]
        raise DefinitionError(
            "an algebraic loop is solved by iterations, and C in single precision has none. Take number='double', "
            "whose source has the loop of runs inside, or put a UnitDelay() into the loop.",
            block=path,
            port=port,
        )
    if len(flat.distinct) > CLOCK_LIMIT:
        raise DefinitionError(
            f"found {len(flat.distinct)} sample times with their offsets; at most {CLOCK_LIMIT} are on a target. "
            "Choose fewer.",
            block=opened.wired.name,
        )
