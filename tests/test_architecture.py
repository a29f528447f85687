"""The architecture: arrows between sub-packages and files, public names, and the page that tells of them."""

import ast
import importlib
import re
import runpy
from collections import defaultdict
from functools import cache
from inspect import isclass
from pathlib import Path

import pytest

import loopwright
from loopwright.blocks.core import errors
from support.sources import ROOMS, ROOT, SOURCES, find_nodes

PAGE = ROOT / "docs" / "explanation" / "architecture.md"
FILES = [path.relative_to(ROOT) for path in SOURCES]
STUBS = sorted(
    p.relative_to(ROOT) for room in ROOMS for p in (ROOT / room).rglob("*.pyi")
)  # names that are loaded when they are used


def place_of(path):
    """Name the sub-package that a file belongs to; a file that stands in a room itself is a place of its own."""
    parts = Path(path).with_suffix("").parts
    return parts[0] if parts[1:] == ("__init__",) else "/".join(parts[:2])


@cache
def imports():
    """List every relative import, lazy ones and those for annotations too: file, line, imported file, imported name."""
    found = []
    for file in (*FILES, *STUBS):
        path = file.with_suffix(".py")
        for node in find_nodes(ROOT / file, ast.Import, ast.ImportFrom):
            if isinstance(node, ast.Import):
                assert not any(a.name.startswith("loopwright") for a in node.names), f"{path}: rooms import relatively"
            if not isinstance(node, ast.ImportFrom):
                continue
            assert not (node.module or "").startswith("loopwright"), f"{path}: rooms import relatively"
            if not node.level:
                continue
            package = path.parts[:-1] if path.parts[0] != "front" else ()
            base = (*package[: len(package) - node.level + 1], *(node.module or "").split("."))
            base = Path(*[part for part in base if part])
            for name in (a.name for a in node.names):
                candidates = (
                    base / f"{name}.py",
                    base / name / "__init__.py",
                    base.with_suffix(".py") if base.name else base,
                    base / "__init__.py",
                    Path("front", f"{base.name or name}.py"),
                )
                target = next(c for c in candidates if (ROOT / c).is_file())
                found.append((path, node.lineno, target, name))
    return found


@cache
def table():
    """Read the table of the page: place → the places that it may import."""
    rows = re.findall(r"^\| `([\w/.]+)` \|[^|]*\| ([^|]*) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    names = [name.removesuffix(".py") for name, _ in rows]
    allowed = {}
    for (name, cell), key in zip(rows, names, strict=True):
        room = key.split("/")[0]
        found = set()
        for word in re.findall(r"`([\w/.]+)`|(all above)", cell):
            if word[1]:
                found |= {n for n in names[: names.index(key)] if n.split("/")[0] == room}
            elif word[0] in ROOMS:
                found |= {word[0], *(n for n in names if n.startswith(f"{word[0]}/"))}
            else:
                full = word[0].removesuffix(".py")
                found.add(full if "/" in full else f"{room}/{full}")
        assert found <= {*names, *ROOMS}, f"{name}: {found - set(names)} are in no row"
        allowed[key] = found
    return allowed


def test_the_table_has_a_row_for_every_place():
    places = {place_of(path) for path in FILES} - set(ROOMS)
    assert places == set(table())


def test_imports_run_along_the_arrows_of_the_table():
    wrong = []
    for path, line, target, name in imports():
        here, there = place_of(path), place_of(target)
        if here in ROOMS or here == there:  # the front door of a room opens on all of it
            continue
        if there not in table()[here]:
            wrong.append(f"{path}:{line}: {here} imports {name} of {there}")
    assert not wrong, "\n".join(wrong)


def test_every_arrow_of_the_table_is_used():
    """An arrow that nobody needs is an invitation; arrows to a whole room, or to all above, are not counted."""
    used = defaultdict(set)
    for path, _, target, _ in imports():
        used[place_of(path)].add(place_of(target))
    text = PAGE.read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w/.]+)` \|[^|]*\| ([^|]*) \|$", text, re.MULTILINE)
    idle = []
    for name, cell in rows:
        key = name.removesuffix(".py")
        for word in re.findall(r"`([\w/.]+)`", cell):
            full = (
                word.removesuffix(".py")
                if "/" in word or word in ROOMS
                else f"{key.split('/')[0]}/{word.removesuffix('.py')}"
            )
            if word not in ROOMS and full not in used[key]:
                idle.append(f"{key} never imports {full}")
    assert not idle, "\n".join(idle)


def circle(arrows):
    """Return the nodes of a circle, or an empty list."""
    state, stack = {}, []

    def visit(node):
        state[node] = "open"
        stack.append(node)
        for following in sorted(arrows.get(node, ())):
            if state.get(following) == "open":
                return stack[stack.index(following) :]
            if following not in state and (found := visit(following)):
                return found
        stack.pop()
        state[node] = "done"
        return []

    for node in sorted(arrows):
        if node not in state and (found := visit(node)):
            return found
    return []


def arrows(key):
    found = defaultdict(set)
    for path, _, target, _ in imports():
        here, there = key(path), key(target)
        if here != there:
            found[here].add(there)
    return found


def test_no_circle_among_sub_packages():
    assert circle(arrows(place_of)) == []


def test_no_circle_among_files():
    assert circle(arrows(str)) == []


def test_the_search_for_circles_finds_one():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c"]
    assert circle({"a": {"b", "c"}, "b": {"c"}}) == []


def test_no_constant_of_a_file_is_given_twice():
    """Functions read the last value, also those above it: two files that were joined had their own constants."""
    wrong = []
    for path in SOURCES:
        (module,) = find_nodes(path, ast.Module)
        statements = (node for node in module.body if isinstance(node, ast.Assign))
        names = [name.id for node in statements for part in node.targets for name in ast.walk(part) if is_stored(name)]
        wrong += [f"{path.relative_to(ROOT)}: {name}" for name in sorted(set(names)) if names.count(name) > 1]
    assert not wrong, "\n".join(wrong)


def is_stored(node):
    return isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)


def test_neighbours_import_from_the_sub_package_and_nothing_private():
    wrong = []
    for path, line, target, name in imports():
        if place_of(path) == place_of(target):
            continue
        if re.match("_[^_]", name):
            wrong.append(f"{path}:{line}: {name} is private to {target}")
        if len(target.parts) > 2 and target.name != "__init__.py" and target.stem != name:
            wrong.append(f"{path}:{line}: imports from {target}, and not from {place_of(target)}")
    assert not wrong, "\n".join(wrong)


def test_the_pages_name_what_exists():
    text = "\n".join((PAGE.parent / name).read_text(encoding="utf-8") for name in (PAGE.name, "time.md", "paper.md"))
    named = set(re.findall(r"`((?:blocks|fmus|diagrams|front|tests|docs|benchmarks|notebooks)/[\w/.-]*)`", text))
    assert len(named) > 30
    assert not [name for name in named if not (ROOT / name).exists() and not (ROOT / f"{name}.py").exists()]
    calls = re.findall(r"`([\w/]+\.py)`:? `([\w.]+)`", text)
    assert len(calls) > 15
    for file, function in calls:
        found = set()
        for node in find_nodes(ROOT / file, ast.ClassDef, ast.FunctionDef):
            if isinstance(node, ast.ClassDef):
                found |= {f"{node.name}.{n.name}" for n in node.body if isinstance(n, ast.FunctionDef)} | {node.name}
            else:
                found.add(node.name)
        assert function in found, f"{file} has no {function}"


# --- public names -------------------------------------------------------------------------------------------------------

PUBLIC = {
    "loopwright": """
        Block Coupling Diagram Event Fmu Input LoopwrightError Output Requirements Run SimulationError State StepOptions
        __version__ analyse blocks build check_block diagrams disk_margin doctor experiments fig3 fmus frequency hold
        margins parameter place read_description subsystem sweeps to_c types
    """,
    "loopwright.blocks": """
        AdmittanceFilter And Backlash BandLimitedNoise Block Butterworth Chirp Circle Clock Compare Constant Counter
        CubicSpline DeadZone DefinitionError Delay Demux DiscreteIntegrator DiscreteObserver DiscreteStateSpace
        DiscreteTransferFunction DiscreteZeroPoleGain DoubleDriveError EdgeDetector Ellipse Encoder ErrorDynamics Event
        FIR FeedbackLinearization FilteredDerivative ForceProjection ForceSensor Function Gain GuardError HandForce
        HandProfile Hold IIR Input Integrator Latch LeadLag LimitedIntegrator Line Lookup1D Lookup2D LoopwrightError
        Maximum Minimum MovingAverage Mux Not Notch Observer OptionError Or Output PID PT1 PT2 PadeDelay ParameterError
        Path PathDomainError PathProjection PathSpring PathTracking PiecewiseLinear PlanarModel Power Product Pulse
        PulseTrain PythonFunction Quantizer Ramp RateLimiter Recorded Reference Relay Requirement ResettableIntegrator
        SampleTimeError Saturation Sawtooth ShapeError SimulationError Sine SmoothStep SpringDamper Stack State
        StateFeedback StateMachine StateSpace Step StopCondition Sum Switch TraceError TransferFunction TransportDelay
        TransverseTransform Triangle UnitConversion UnitDelay UnitError UnknownNameError UnwiredInputError Value
        VariableDelay Wall WiringError ZeroPoleGain hold parameter parse_unit
    """,
    "loopwright.fmus": """
        ArchiveLimits CompilerError DefinitionError DiskError Fmu FmuError FmuFileError FmuProcessError FmuRuntimeError
        Isolation ModelSpec OptionError ParameterError StepOptions StepTime UnitError UnknownNameError Variable bouncing_ball build
        build_fmu build_python clear_cache dc_motor doctor gantry gantry_contact gantry_elastic gantry_stiction
        mass_spring_damper model_spec read_description scara tune
    """,
    "loopwright.diagrams": """
        AdmittanceLoop AlgebraicLoopError BetweenTicksError Channel CompilerError ConfirmationError Coupling
        DefinitionError Diagram DiskError DoubleDriveError DuplicateNameError Fig3Diagram FmuError FmuRuntimeError
        Interrupted NonFiniteError OptionError ParameterError PeriodicLoopError Plot Requirements Rig Run
        SampleTimeError Section ShapeError SimulationError SspFileError Table UnitError UnknownNameError
        UnwiredInputError WiringError analyse check_block confirm_sensitivity crossing_frequency experiments fig3 first_order_hold growth_rate passivity
        poles read_ssp rendered_admittance rendered_response rendered_system rule_of_thumb stability_limit stability_map
        stiffness_limits subsystem target_admittance to_c
    """,
    "loopwright.frequency": """
        Comparison ConfirmationError DiskMargin GainCrossover GangOfFour Margins MeasuredMargins Number NyquistCount
        OptionError ParameterError PeriodicMargins PhaseCrossover SampledDesign compare_with_control complementary
        delayed_hold delayed_hold_margin disk_margin gang_of_four loop_at margins measured_margins mimo_disk_margin
        nyquist_count periodic_margins place read_frequency_data sampled_gains sampled_poles sensitivity
    """,
    "loopwright.sweeps": """
        Box Failure InterruptedSweep OptionError Reduction Sample Samples SimulationError Sweep UnknownNameError final
        maximum mean minimum settling_time
    """,
    "loopwright.types": """
        ApproximateDelay Array BlockReport Bus Call CoarseValues Contact ContactAdmittance ContactConfirmation ContactLimit
        ContactMap ContactTrial CouplingReport Drawing FlatDiagram FmuDescription FmuDiagnosis FmuEnd FmuFault
        FmuFinding FmuInstance FmuLinearization FmuSeverity FmuState FmuTrial FmuVariable FmuVerdict Frame FreeMotion
        FreeMotions FrequencyResponse InexactDerivatives Kink Layout LinearDelays Linearization LiveRun MeanSlope Occurrence
        OperatingPoint Passivity PassivityReason PortPassivity ProcessorMeasurement RefutedDerivatives Report Review RunConfirmation
        RunOptions RunState Sensitivities Sensitivity Signal Simulation SimulationView Snapshot SspDescription StabilityLimit
        StabilityMap StepInfo StepResponse StepsOnly Stopped Subsystem SubsystemSettings TargetCode TargetMeasurement TextSignal TickFacts TrialMethod Unit Verdict WebPage
        Wire WorstCase ZeroSlope
    """,
}


@pytest.mark.parametrize("package", PUBLIC)
def test_public_names_are_those_that_users_know(package):
    """A name that goes, comes or changes stands in the changelog, and then here."""
    module = importlib.import_module(package)
    assert module.__all__ == PUBLIC[package].split()
    assert all(hasattr(module, name) for name in module.__all__)
    stub = ast.parse(Path(module.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    assert module.__all__ == ast.literal_eval(stub.body[-1].value)  # what type checkers see


def test_the_table_of_sizes_has_every_sub_package_and_counts_its_lines():
    sizes = runpy.run_path(str(ROOT / "docs" / "sizes.py"))
    assert {str(file.parent) for file in FILES} <= {str(folder.relative_to(ROOT)) for folder in sizes["list_folders"]()}
    rows = sizes["table"](("fmus/models", "install"))
    assert set(rows) == {"fmus/models", "install", "all"}
    files, python, code, c, names = rows["fmus/models"]
    texts = [p.read_text(encoding="utf-8") for p in (ROOT / "fmus" / "models").iterdir() if p.suffix in {".py", ".pyi"}]
    assert (files, python, c) == (len(texts), sum(text.count("\n") for text in texts), 0)
    assert 0 < code < python - 200
    assert names == len(importlib.import_module("loopwright.fmus.models").__all__)
    assert rows["all"][1] == sum(row[1] for name, row in rows.items() if name != "all")
    assert (
        sizes["count_code"]('"""Text."""\n\n# why\nx = """a\nb"""\n\n\ndef f():\n    """Text."""\n    return x\n') == 4
    )


FOLDERS = {"blocks": "blocks", "fmus": "fmus", "diagrams": "diagrams"}
FOLDERS |= {"frequency": "diagrams/frequency", "sweeps": "diagrams/sweeps"}


@pytest.mark.parametrize("package", FOLDERS)
def test_an_error_is_importable_where_it_is_raised(package):
    known = {name for name, value in vars(errors).items() if isclass(value)} - {"LoopwrightError"}
    files = [path for path in SOURCES if (ROOT / FOLDERS[package]) in path.parents]
    calls = [node.func for path in files for node in find_nodes(path, ast.Call)]
    raised = {called.id for called in calls if isinstance(called, ast.Name)} & known
    assert raised
    assert raised <= set(getattr(loopwright, package).__all__)
