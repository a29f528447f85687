"""Diagrams: wiring, scheduling, simulation; linearization and margins; Fig. 3 and its experiments; the command line."""

from ..blocks.core.layout import Layout
from .admittance.compliance_loop import AdmittanceLoop
from .admittance.coupled import crossing_frequency, growth_rate, poles
from .admittance.rendered import (
    Passivity,
    passivity,
    rendered_admittance,
    rendered_response,
    rendered_system,
    target_admittance,
)
from .admittance.stability_limits import (
    StabilityLimit,
    StabilityMap,
    rule_of_thumb,
    stability_limit,
    stability_map,
    stiffness_limits,
)
from .contract.check_block import BlockReport, check_block
from .diagram import Diagram
from .document.model import Plot, Section, Table
from .document.report import Report
from .drawing.svg import Drawing
from .flat.flat_diagram import FlatDiagram
from .frequency.disk import DiskMargin, disk_margin, loop_at, mimo_disk_margin
from .frequency.margins import GainCrossover, Margins, PhaseCrossover, margins
from .frequency.number import Number
from .frequency.nyquist import NyquistCount, nyquist_count
from .frequency.pole_placement import SampledDesign, place, sampled_gains, sampled_poles
from .frequency.python_control import Comparison, compare_with_control
from .frequency.sensitivities import (
    GangOfFour,
    complementary,
    delayed_hold,
    delayed_hold_margin,
    gang_of_four,
    sensitivity,
)
from .linearization.linearize import Linearization
from .measure.frequency_response import FrequencyResponse
from .paper import experiments
from .paper.fig3 import Fig3Diagram, fig3
from .paper.wires import Channel, Rig
from .report.analyse import analyse
from .results.operating_point import OperatingPoint
from .results.run import Run, Snapshot
from .results.saved_state import RunState
from .results.stored import Occurrence, Stopped
from .simulation.run_options import RunOptions
from .simulation.simulation import Simulation
from .simulation.view import SimulationView
from .wiring.structure import SubsystemSettings, Wire
from .wiring.subsystem import Subsystem, subsystem

__all__ = [
    "AdmittanceLoop",
    "BlockReport",
    "Channel",
    "Comparison",
    "Diagram",
    "DiskMargin",
    "Drawing",
    "Fig3Diagram",
    "FlatDiagram",
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
    "Rig",
    "Run",
    "RunOptions",
    "RunState",
    "SampledDesign",
    "Section",
    "Simulation",
    "SimulationView",
    "Snapshot",
    "StabilityLimit",
    "StabilityMap",
    "Stopped",
    "Subsystem",
    "SubsystemSettings",
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
