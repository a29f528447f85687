"""Diagrams: wiring, scheduling, simulation; linearization and margins; Fig. 3 and its experiments; the command line."""

from . import experiments
from ._admittance import (
    Passivity,
    passivity,
    rendered_admittance,
    rendered_response,
    rendered_system,
    target_admittance,
)
from ._admittance_loop import AdmittanceLoop
from ._contract import BlockReport, check_block
from ._control_values import Comparison, compare_with_control
from ._coupled import crossing_frequency, growth_rate, poles
from ._diagram import Diagram
from ._disk import DiskMargin, disk_margin, loop_at, mimo_disk_margin
from ._drawing import Drawing
from ._flat import FlatDiagram
from ._frequency_response import FrequencyResponse
from ._layout import Layout
from ._linearize import Linearization
from ._margins import GainCrossover, Margins, PhaseCrossover, margins
from ._number import Number
from ._nyquist import NyquistCount, nyquist_count
from ._operating_point import OperatingPoint
from ._placement import SampledDesign, place, sampled_gains, sampled_poles
from ._report_analysis import analyse
from ._report_model import Plot, Report, Section, Table
from ._run import Run, Snapshot
from ._sensitivities import (
    GangOfFour,
    complementary,
    delayed_hold,
    delayed_hold_margin,
    gang_of_four,
    sensitivity,
)
from ._simulation import Simulation
from ._stability_limits import (
    StabilityLimit,
    StabilityMap,
    rule_of_thumb,
    stability_limit,
    stability_map,
    stiffness_limits,
)
from ._state import RunState
from ._stored import Occurrence, Stopped
from ._structure import Frame, Wire
from ._subsystem import Subsystem, subsystem
from .fig3 import fig3

__all__ = [
    "AdmittanceLoop",
    "BlockReport",
    "Comparison",
    "Diagram",
    "DiskMargin",
    "Drawing",
    "FlatDiagram",
    "Frame",
    "FrequencyResponse",
    "GainCrossover",
    "GangOfFour",
    "Layout",
    "Linearization",
    "Margins",
    "Number",
    "NyquistCount",
    "Occurrence",
    "OperatingPoint",
    "Passivity",
    "PhaseCrossover",
    "Plot",
    "Report",
    "Run",
    "RunState",
    "SampledDesign",
    "Section",
    "Simulation",
    "Snapshot",
    "StabilityLimit",
    "StabilityMap",
    "Stopped",
    "Subsystem",
    "Table",
    "Wire",
    "analyse",
    "check_block",
    "compare_with_control",
    "complementary",
    "crossing_frequency",
    "delayed_hold",
    "delayed_hold_margin",
    "disk_margin",
    "experiments",
    "fig3",
    "gang_of_four",
    "growth_rate",
    "loop_at",
    "margins",
    "mimo_disk_margin",
    "nyquist_count",
    "passivity",
    "place",
    "poles",
    "rendered_admittance",
    "rendered_response",
    "rendered_system",
    "rule_of_thumb",
    "sampled_gains",
    "sampled_poles",
    "sensitivity",
    "stability_limit",
    "stability_map",
    "stiffness_limits",
    "subsystem",
    "target_admittance",
]
