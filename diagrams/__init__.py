"""Diagrams: wiring, scheduling, simulation; the diagram of Fig. 3 and its experiments; the command line."""

from . import experiments
from ._contract import BlockReport, check_block
from ._diagram import Diagram
from ._flat import FlatDiagram
from ._layout import Layout
from ._run import Run, Snapshot
from ._simulation import Simulation
from ._state import RunState
from ._stored import Occurrence, Stopped
from ._structure import Frame, Wire
from ._subsystem import Subsystem, subsystem
from .fig3 import fig3

__all__ = [
    "BlockReport",
    "Diagram",
    "FlatDiagram",
    "Frame",
    "Layout",
    "Occurrence",
    "Run",
    "RunState",
    "Simulation",
    "Snapshot",
    "Stopped",
    "Subsystem",
    "Wire",
    "check_block",
    "experiments",
    "fig3",
    "subsystem",
]
