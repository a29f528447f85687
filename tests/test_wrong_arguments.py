"""Wrong arguments of everything public: an error of Loopwright's own says what was found and what is expected."""

import enum
import inspect
import warnings

import numpy as np
import pytest

import loopwright
from loopwright.blocks import Block, LoopwrightError, OptionError, Value
from loopwright.diagrams import Diagram
from support.library import CASES
from support.public_calls import calls

PACKAGES = (
    loopwright.blocks,
    loopwright.diagrams,
    loopwright.fmus,
    loopwright.frequency,
    loopwright.sweeps,
    loopwright.types,
)
WRONG = {
    "None": None,
    "text": "nonsense",
    "nan": float("nan"),
    "inf": float("inf"),
    "complex": 1j,
    "true": True,
    "empty": [],
    "matrix": np.zeros((2, 3)),
    "mapping": {},
    "object": object(),
    "negative": -1,
    "zero": 0,
}
LONG = {
    ("Diagram.worst_case", "count", "None"),  # a hundred samples
    ("Simulation.run_realtime", "duration", "None"),  # until it is stopped
    ("Diagram.sweep", "workers", "None"),  # every core
    ("analyse", "only", "None"),  # every section
    ("Diagram.frequency_response", "frequencies", "true"),  # 1 rad/s
}
"""Arguments that are right, and take long."""
RESULTS = {
    "ApproximateDelay",
    "Array",
    "BlockReport",
    "Bus",
    "Call",
    "Channel",
    "CoarseValues",
    "Comparison",
    "Contact",
    "ContactAdmittance",
    "ContactConfirmation",
    "ContactLimit",
    "ContactMap",
    "ContactTrial",
    "CouplingReport",
    "DiskMargin",
    "Drawing",
    "Event",
    "Failure",
    "Fig3Diagram",
    "FlatDiagram",
    "Frame",
    "FreeMotion",
    "FreeMotions",
    "FrequencyResponse",
    "GainCrossover",
    "GangOfFour",
    "InexactDerivatives",
    "Input",
    "Kink",
    "Layout",
    "LinearDelays",
    "Linearization",
    "Margins",
    "LiveRun",
    "MeanSlope",
    "MeasuredMargins",
    "Number",
    "NyquistCount",
    "Occurrence",
    "OperatingPoint",
    "Output",
    "Passivity",
    "Path",
    "PortPassivity",
    "PeriodicMargins",
    "PhaseCrossover",
    "Plot",
    "Reduction",
    "RefutedDerivatives",
    "Report",
    "Review",
    "Rig",
    "Run",
    "RunConfirmation",
    "RunOptions",
    "RunState",
    "Sample",
    "SampledDesign",
    "Samples",
    "Section",
    "Sensitivities",
    "Sensitivity",
    "Signal",
    "Simulation",
    "SimulationView",
    "Snapshot",
    "StabilityLimit",
    "StabilityMap",
    "State",
    "StepResponse",
    "StepsOnly",
    "StepInfo",
    "Stopped",
    "Subsystem",
    "SubsystemSettings",
    "Sweep",
    "Table",
    "TextSignal",
    "Unit",
    "Value",
    "Wire",
    "WorstCase",
    "ZeroSlope",
    "FmuDescription",
    "FmuDiagnosis",
    "FmuFinding",
    "FmuInstance",
    "FmuLinearization",
    "FmuState",
    "FmuTrial",
    "FmuVariable",
    "ModelSpec",
    "ProcessorMeasurement",
    "SspDescription",
    "TargetCode",
    "TargetMeasurement",
    "TickFacts",
    "Variable",
    "AdmittanceLoop",
}
"""Classes whose objects functions return, or that are declarations; their makers are tested."""
ELSEWHERE = {
    "clear_cache": "takes none",
    "fig3": "the paper's diagram, made by the experiments",
    "parameter": "a declaration of a block's class",
}
NAMES = sorted(calls())


def is_class_of_another_kind(value):
    return issubclass(value, Exception | KeyboardInterrupt | enum.Enum | Block | Value)


def public_callables():
    found = set()
    for package in PACKAGES:
        for name in package.__all__:
            value = getattr(package, name)
            if inspect.ismodule(value) or not callable(value):
                continue
            if inspect.isclass(value) and is_class_of_another_kind(value) and value not in (loopwright.fmus.Fmu,):
                continue
            found.add(name)
    return found


def test_every_public_callable_is_called_with_wrong_arguments():
    called = {name.removeprefix("fmus.").partition(" ")[0].partition(".")[0] for name in NAMES}
    missing = public_callables() - called - RESULTS - set(ELSEWHERE)
    assert not missing, f"give {sorted(missing)} a line in tests/support/public_calls.py"


@pytest.mark.slow
def test_the_good_arguments_are_good():
    """All that need no file are called once as they are."""
    refused = {}
    for name, make in calls().items():
        function, good = make()
        if "/nowhere" in str(good) or name.startswith("fmus.build") or name == "Diagram.worst_case":
            continue
        try:
            call(function, good)
        except Exception as error:
            refused[name] = repr(error)
    assert refused == {}


def call(function, arguments):
    positional = [*arguments.pop("names")] if isinstance(arguments.get("names"), list) else []
    if "names" in arguments:
        positional = [arguments.pop("names")]
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        return function(*positional, **arguments)


@pytest.mark.drawn(40)
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_argument_ends_in_an_error_of_our_own_or_a_result(name, wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, good = calls()[name]()
    foreign = {}
    for argument in good:
        if (name, argument, wrong) in LONG:
            continue
        try:
            call(function, {**good, argument: WRONG[wrong]})
        except LoopwrightError:
            continue
        except Exception as error:
            foreign[argument] = repr(error)
    assert foreign == {}


@pytest.mark.drawn(20)
@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("block", [case[0] for case in CASES], ids=[type(case[0]).__name__ for case in CASES])
def test_a_wrong_parameter_of_a_block_ends_in_an_error_of_our_own_or_a_block(block, wrong):
    foreign = {}
    for name in block.parameters:
        try:
            assert type(block.replace(**{name: WRONG[wrong]})) is type(block)
        except LoopwrightError:
            continue
        except Exception as error:
            foreign[name] = repr(error)
    assert foreign == {}


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (
            lambda d: loopwright.frequency.margins(d.linearize().loop("u"), delay="2"),
            r"margins.delay: found '2'; expected",
        ),
        (lambda d: loopwright.sweeps.maximum("y", since=None), r"maximum.since: found None; expected a number"),
        (
            lambda d: loopwright.frequency.read_frequency_data(True),
            r"read_frequency_data.file: found True; expected a path",
        ),
        (lambda d: d.to_c("/nowhere", outside=3), r"^to_c.outside: found 3; expected a name, or a list of names"),
        (lambda d: d.to_ssp(3), r"^drive.path: found 3; expected a path"),
        (lambda d: loopwright.build(d, start=3), r"^build.start: found 3; expected"),
        (lambda d: d.sensitivities("u", 3), r"parameters: found 3; expected a name, or a list of names"),
        (lambda d: d.trim(tolerance="small"), r"drive.tolerance: found 'small'; expected a number"),
        (lambda d: d.simulate(0.1, states="no", progress=False), r"drive.states: found 'no'; expected True or False"),
        (lambda d: d.draw(subsystem="contrl"), r"no subsystem 'contrl'. Did you mean 'control'"),
        (lambda d: d.sweep({"kp.gain": (1.0,)}, 0.1, signals=3), r"signals: found 3; expected a name, or a list"),
        (
            lambda d: loopwright.frequency.place(np.eye(2), [[1.0], [1.0]], None),
            r"place.poles: found None; expected a list",
        ),
    ],
)
def test_an_error_tells_who_found_what_and_expected_what(ask, message):
    from support.public_calls import drive

    with pytest.raises(OptionError, match=message):
        ask(drive())


@pytest.mark.parametrize(
    ("name", "argument", "misspelt", "right"),
    [
        ("Diagram.simulate", "solver", "RK54", "RK45"),
        ("Diagram.simulate", "coupling", "jacoby", "jacobi"),
        ("Diagram.simulate", "start_exchange", "agre", "agree"),
        ("Diagram.simulate", "compile", "atuo", "auto"),
        ("Diagram.simulate", "record", ["yy"], "'y'"),
        ("Diagram.replace", "changes", {"kp.gian": 1.0}, "gain"),
        ("Diagram.sampled", "method", "exakt", "exact"),
        ("Diagram.linearize", "inputs", ["uu"], "'u'"),
        ("Diagram.linearize", "plants", "equation", "equations"),
        ("Diagram.linearize", "stairs", "gian", "gain"),
        ("Diagram.trim", "free", ["kp.gian"], "gain"),
        ("Diagram.trim", "targets", {"yy": 0.0}, "'y'"),
        ("Diagram.sweep", "samples", "latim", "latin"),
        ("Diagram.sweep", "signals", ["yy"], "'y'"),
        ("Diagram.sensitivities", "parameters", ["kp.gian"], "gain"),
        ("Diagram.worst_case", "quantity", "disc_margin", "disk_margin"),
        ("Diagram.draw", "subsystem", "contrl", "control"),
        ("Linearization.loop", "wire", "uu", "'u'"),
        ("Sensitivities.of", "quantity", "mss", "ms"),
        ("WorstCase.plot", "parameters", ["kp.gian"], "control.kp.gain"),
        ("sampled_gains", "integral", "forwrd", "forward"),
        ("loop_at", "where", "inpt", "input"),
        ("stability_limit", "over", "stifness", "stiffness"),
        ("Box", "scale", "lgo", "log"),
        ("Coupling", "scheme", "gauss", "gauss_seidel"),
        ("Requirements", "step", {"overshot": 0.1}, "overshoot"),
        ("check_block", "kinds", ["sampeld"], "sampled"),
        ("hold", "method", "exct", "exact"),
        ("fmus.model_spec", "integrator", "rk5", "rk4"),
    ],
)
def test_a_misspelt_text_is_told_with_the_right_one(name, argument, misspelt, right):
    function, good = calls()[name]()
    with pytest.raises(LoopwrightError, match=right):
        call(function, {**good, argument: misspelt})


def test_a_drawing_of_a_subsystem_counts_the_blocks_in_it(monkeypatch):
    """Beyond some number of blocks subsystems are drawn closed: of those that are drawn."""
    from loopwright.diagrams.drawing import diagram_picture
    from support.public_calls import drive

    monkeypatch.setattr(diagram_picture, "MANY", 5)  # the diagram has 7 blocks, its subsystem 4
    assert isinstance(drive(), Diagram)
    assert diagram_picture.find_closed(drive().structure, "", None, diagram="d") == {"control"}
    assert diagram_picture.find_closed(drive().structure, "control", None, diagram="d") == set()
