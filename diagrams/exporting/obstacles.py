"""What of a diagram can't be exported: each is named by its path, with one next step."""

from __future__ import annotations

from ...blocks.core import DefinitionError
from ...fmus import Fmu
from .open_diagram import OpenDiagram


def refuse(opened: OpenDiagram) -> None:
    """Refuse a diagram with parts that can't be exported.

    Raises `DefinitionError`: for the first one.
    """
    table = opened.wired.scheduled
    for path, block in table.blocks.items():
        if path == opened.outside:
            continue
        shown = opened.shown(path)
        if block.transport and not table.is_sampled(table.subsystem_of[path]):
            raise DefinitionError(
                "it is a transport delay in continuous time, which keeps each step of the solver for the length of the "
                "delay: its memory has no bound, also for a constant delay, and an exported diagram has a fixed one. "
                "Put it into a sampled subsystem, @subsystem(sample_time=…), where it is a delay by whole samples.",
                block=shown,
            )
        if block.opaque and not isinstance(block, Fmu):
            raise DefinitionError(
                "Python evaluates it, and nothing exported has Python inside. Write its equations with NumPy functions "
                "that can be traced, or export the part of the diagram without it.",
                block=shown,
            )
