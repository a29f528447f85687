from .blocks.core import Array, Call, FmuEnd, Signal, Unit
from .blocks.paths import Frame
from .diagrams.contact import (
    Contact,
    ContactAdmittance,
    ContactConfirmation,
    ContactLimit,
    ContactMap,
    ContactTrial,
    Passivity,
    PassivityReason,
    PortPassivity,
    TrialMethod,
)
from .diagrams.contract import BlockReport
from .diagrams.coupling import CouplingReport
from .diagrams.drawing import Drawing
from .diagrams.flat import FlatDiagram, Layout
from .diagrams.frequency import LinearDelays
from .diagrams.linearization import (
    ApproximateDelay,
    CoarseValues,
    FreeMotion,
    FreeMotions,
    InexactDerivatives,
    Kink,
    Linearization,
    MeanSlope,
    RefutedDerivatives,
    StepsOnly,
    ZeroSlope,
)
from .diagrams.measure import FrequencyResponse, StepResponse
from .diagrams.paper import StabilityLimit, StabilityMap
from .diagrams.report import Report
from .diagrams.requirements import Review, Verdict
from .diagrams.results import Occurrence, OperatingPoint, RunState, Snapshot, StepInfo, Stopped, TextSignal
from .diagrams.simulation import LiveRun, RunOptions, Simulation, SimulationView
from .diagrams.ssp import SspDescription
from .diagrams.studies import RunConfirmation, Sensitivities, Sensitivity, WorstCase
from .diagrams.web_page import WebPage
from .diagrams.wiring import Bus, Subsystem, SubsystemSettings, Wire
from .fmus.archive import FmuDescription, FmuFault, FmuFinding, FmuSeverity, FmuVariable
from .fmus.calls import FmuInstance, FmuState
from .fmus.checks import FmuDiagnosis, FmuTrial, FmuVerdict
from .fmus.export import ProcessorMeasurement, TargetCode, TargetMeasurement, TickFacts
from .fmus.fmu_block import FmuLinearization

__all__ = [
    "ApproximateDelay",
    "Array",
    "BlockReport",
    "Bus",
    "Call",
    "CoarseValues",
    "Contact",
    "ContactAdmittance",
    "ContactConfirmation",
    "ContactLimit",
    "ContactMap",
    "ContactTrial",
    "CouplingReport",
    "Drawing",
    "FlatDiagram",
    "FmuDescription",
    "FmuDiagnosis",
    "FmuEnd",
    "FmuFault",
    "FmuFinding",
    "FmuInstance",
    "FmuLinearization",
    "FmuSeverity",
    "FmuState",
    "FmuTrial",
    "FmuVariable",
    "FmuVerdict",
    "Frame",
    "FreeMotion",
    "FreeMotions",
    "FrequencyResponse",
    "InexactDerivatives",
    "Kink",
    "Layout",
    "LinearDelays",
    "Linearization",
    "LiveRun",
    "MeanSlope",
    "Occurrence",
    "OperatingPoint",
    "Passivity",
    "PassivityReason",
    "PortPassivity",
    "ProcessorMeasurement",
    "RefutedDerivatives",
    "Report",
    "Review",
    "RunConfirmation",
    "RunOptions",
    "RunState",
    "Sensitivities",
    "Sensitivity",
    "Signal",
    "Simulation",
    "SimulationView",
    "Snapshot",
    "SspDescription",
    "StabilityLimit",
    "StabilityMap",
    "StepInfo",
    "StepResponse",
    "StepsOnly",
    "Stopped",
    "Subsystem",
    "SubsystemSettings",
    "TargetCode",
    "TargetMeasurement",
    "TextSignal",
    "TickFacts",
    "TrialMethod",
    "Unit",
    "Verdict",
    "WebPage",
    "Wire",
    "WorstCase",
    "ZeroSlope",
]
