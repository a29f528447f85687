"""The contract of a block: every block of the library keeps it, and each way of breaking it is found."""

import inspect
import math
import pickle
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import loopwright.blocks
from loopwright.blocks import (
    Block,
    DefinitionError,
    Event,
    Gain,
    GuardError,
    Input,
    OptionError,
    Output,
    PythonFunction,
    Relay,
    Requirement,
    SampleTimeError,
    Saturation,
    ShapeError,
    Sine,
    State,
    Step,
    StopCondition,
    TraceError,
    UnitDelay,
    UnitError,
    parameter,
)
from loopwright.diagrams import check_block
from loopwright.fmus import Fmu, mass_spring_damper
from support.library import CASES, is_base

PAGE = (Path(__file__).parents[3] / "docs" / "reference" / "blocks.md").read_text(encoding="utf-8")


def named(case):
    return type(case[0]).__name__


def public_blocks():
    public = {getattr(loopwright.blocks, name) for name in loopwright.blocks.__all__}
    return [cls for cls in public if isinstance(cls, type) and issubclass(cls, Block) and not is_base(cls)]


# --- the library ----------------------------------------------------------------------------------------------------------


@pytest.mark.drawn(9)
@pytest.mark.parametrize(("block", "options", "frames"), CASES, ids=[named(case) for case in CASES])
def test_the_library_keeps_the_contract(block, options, frames):
    report = check_block(block, **options)
    assert {name for name, text in report.kinds.items() if text == "checked"} == set(frames)
    assert not any(report.swallowed.values()), report  # NaN passes through
    for name, text in report.kinds.items():  # what it refuses it refuses with a reason and a next step
        assert text == "checked" or "@subsystem(sample_time=…)" in text or "put it outside" in text, (name, text)


def test_every_public_block_is_among_them():
    missing = {cls.__name__ for cls in public_blocks()} - set(map(named, CASES))
    assert not missing, f"give {missing} a line in tests/support/library.py"


def test_the_page_of_the_library_has_a_line_for_each_block_as_it_is():
    frames = {}
    for block, _, found in CASES:
        frames.setdefault(type(block), set()).update(found)
    rows = re.findall(r"(?m)^\| `(\w+)` \| (\w+) \| (.*) \|$", PAGE)
    expected = []
    for name in (row[0] for row in rows):
        cls = getattr(loopwright.blocks, name)
        where = "both" if len(frames[cls]) == 2 else next(iter(frames[cls]))
        expected.append((name, where, inspect.getdoc(cls).splitlines()[0].replace("``", "`")))
    assert rows == expected
    assert sorted(row[0] for row in rows) == sorted(cls.__name__ for cls in public_blocks())


@pytest.mark.slow
def test_the_code_of_the_page_of_the_library_runs():
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("lag keeps the contract of a block.")


# --- what is reported -----------------------------------------------------------------------------------------------------


def test_the_report_tells_what_was_checked():
    report = check_block(Relay(on_point=0.5, off_point=-0.5))
    assert report.kinds == {"sampled": "checked", "continuous": "checked"}
    assert report.feedthrough == {"sampled": {("u", "y")}, "continuous": frozenset()}
    assert report.unseen == {"sampled": frozenset(), "continuous": frozenset()}
    assert report.checks["values"] == "pickled; 5 of 5 parameters replaced"
    assert report.quiet == ()
    text = str(report)
    for part in (
        "relay keeps the contract",
        "sampled: trace: as NumPy",
        "continuous: events:",
        "sampled: run: 101 samples",
    ):
        assert part in text
    assert pickle.loads(pickle.dumps(report)) == report


def test_pairs_and_events_that_never_show_are_reported_and_no_error():
    report = check_block(Requirement("it stays small", upper=4.0))
    assert report.unseen["sampled"] == {("u", "violated"), ("u", "violated_at")}
    assert report.quiet == ("above",)
    assert "event above: never fired" in str(report)
    assert "violated depends on u in the trace, and never did" in str(report)


def test_an_opaque_block_may_depend_on_all_that_it_takes():
    report = check_block(Deaf())
    assert report.feedthrough["sampled"] == {("u", "y")}
    assert report.unseen["sampled"] == {("v", "y")}


def test_an_output_that_hides_a_nan_is_reported_and_no_error():
    report = check_block(Capped())
    assert report.swallowed == {"sampled": {("u", "y")}, "continuous": {("u", "y")}}
    assert "continuous: y is a number where u is NaN" in str(report)


def test_a_frame_that_a_block_refuses_is_reported_with_its_reason_and_an_error_where_it_is_asked_for():
    report = check_block(UnitDelay(), shapes={"u": (2,)})
    assert report.kinds["sampled"] == "checked"
    assert "put it into a @subsystem(sample_time=…)" in report.kinds["continuous"]
    with pytest.raises(SampleTimeError, match="unit_delay: a sampled block is in a continuous subsystem"):
        check_block(UnitDelay(), kinds=["continuous"])


def test_a_vector_that_would_need_an_event_for_each_entry_is_refused_by_its_frame():
    report = check_block(Relay(on_point=0.5, off_point=-0.5), shapes={"u": (2,)})
    assert report.kinds["sampled"] == "checked"
    assert "Index the signal" in report.kinds["continuous"]


@pytest.mark.slow
def test_inputs_are_ranges_or_signals():
    report = check_block(Saturation(limit=1.0), {"u": (-0.5, 0.5)})
    assert report.unseen["sampled"] == {("u", "excess")}  # it is never beyond the limit
    assert check_block(Saturation(limit=1.0), {"u": (np.zeros(3), np.ones(3))}).kinds["sampled"] == "checked"
    stopped = check_block(StopCondition(), {"u": Step(times=0.7, values=1.0)})
    assert "stopped at 0.7 s" in stopped.checks["continuous: run"]
    assert check_block(Gain(gain=2.0), {"u": Sine(frequency=2.0, unit="m")}).feedthrough["sampled"] == {("u", "y")}


def test_a_function_without_a_name_in_a_module_is_not_pickled_and_no_error():
    report = check_block(PythonFunction(lambda u: 2.0 * u))
    assert report.checks["values"].startswith("not pickled, since its function can't be")


def test_an_fmu_is_run_saved_and_restored():
    report = check_block(Fmu(mass_spring_damper.build(), name="plant"))
    assert report.kinds == {"sampled": "checked", "continuous": "checked"}
    assert report.checks["sampled: run"].endswith("restored, it is the same")
    assert "sampled: trace" not in report.checks


def test_wrong_arguments_are_errors():
    with pytest.raises(OptionError, match=r"check_block\.inputs: found 'v', which is no input of gain. Known: u"):
        check_block(Gain(gain=2.0), {"v": (0.0, 1.0)})
    with pytest.raises(OptionError, match=r"check_block\.kinds: found 'sample'; expected .* Did you mean 'sampled'"):
        check_block(Gain(gain=2.0), kinds=["sample"])
    with pytest.raises(ShapeError, match=r"gain\.u: found a range of shape \(2,\); expected \(3,\)"):
        check_block(Gain(gain=2.0), {"u": (np.zeros(2), np.ones(2))}, shapes={"u": (3,)})
    with pytest.raises(DefinitionError, match="expected a block, such as Gain"):
        check_block(Gain)


def test_a_run_that_stops_says_that_the_inputs_may_be_out_of_range():
    with pytest.raises(GuardError, match="the requirement 'it stays small' is violated") as caught:
        check_block(Requirement("it stays small", upper=1.0))
    assert "check_block(…, inputs={…})" in caught.value.__notes__[0]


# --- every rule, broken ----------------------------------------------------------------------------------------------------


class Amplifier(Block):
    """A block that keeps the contract, of which the others break one rule each."""

    gain: float = parameter(default=2.0, description="gain")
    u = Input()
    y = Output()

    def output(self, t, x, u):
        return self.gain * u.u


CALLS = []


class Counting(Amplifier):
    """Keeps something outside of itself."""

    opaque = True

    def output(self, t, x, u):
        CALLS.append(t)
        return u.u + len(CALLS)


class Keeping(Amplifier):
    """Keeps something on itself, though its results are right."""

    opaque = True

    def output(self, t, x, u):
        self.__dict__["last"] = float(u.u)
        return self.gain * u.u


class Overwriting(Amplifier):
    """Changes its argument."""

    opaque = True
    u = Input(shape=(2,))
    y = Output(shape=(2,))

    def output(self, t, x, u):
        value = u.u
        value += 1.0
        return value


class Preset(Amplifier):
    """A parameter that can't be replaced."""

    def __init__(self, **parameters):
        super().__init__(**{**parameters, "gain": 2.0})


class Forgetful(Amplifier):
    """Equal only to itself."""

    def __eq__(self, other):
        return self is other

    __hash__ = object.__hash__


class Laden(Amplifier):
    """Carries what can't be pickled."""

    def __init__(self, **parameters):
        super().__init__(**parameters)
        self.__dict__["handle"] = lambda: None


class Partial(Amplifier):
    """Loses an attribute when it is pickled."""

    def __init__(self, **parameters):
        super().__init__(**parameters)
        self.__dict__["table"] = (1.0, 2.0)

    def __getstate__(self):
        return {k: v for k, v in self.__dict__.items() if k != "table"}


class TooManyUnits(Amplifier):
    """Three units for two entries."""

    u = Input(shape=(2,), unit=("m", "m/s", "m/s2"))
    y = Output(shape=(2,))


class Misnamed(Amplifier):
    """A port that calls itself otherwise."""

    @property
    def inputs(self):
        return {"u": Input(name="v")}


class Orphan(Amplifier):
    """An output in the unit of an input that is not there."""

    @property
    def outputs(self):
        return {"y": Output(like="w", name="y")}


class Clipped(Amplifier):
    """Another shape than declared."""

    y = Output(shape=(2,))


class Sometimes(Amplifier):
    """Another shape, with numbers in a part of its range only."""

    opaque = True

    def output(self, t, x, u):
        return self.gain * u.u if u.u < 2.0 else np.stack([u.u, u.u])


class Typed(Amplifier):
    """Another result with numbers than with symbols, above what a trace looks at."""

    def output(self, t, x, u):
        return self.gain * u.u + (1.0 if isinstance(u.u, float) and u.u > 40.0 else 0.0)


class Capped(Amplifier):
    """Gives a number where its input is none."""

    def output(self, t, x, u):
        return np.where(u.u < 1.0, u.u, 1.0)


class Deaf(Amplifier):
    """Does not use one of its inputs, and is not traced."""

    v = Input()
    opaque = True

    def output(self, t, x, u):
        return self.gain * u.u


class Rooted(Amplifier):
    """√(u² + u⁴), which is |u| near zero, times u: smooth, but its trace has no derivative there."""

    def output(self, t, x, u):
        return u.u * np.sqrt(u.u * u.u + u.u**4)


class Dotted(Amplifier):
    """u, of which the trace has the derivative 0 at zero."""

    def output(self, t, x, u):
        return np.where(u.u == 0.0, 0.0, u.u)


class Branching(Amplifier):
    """A sign, without an event."""

    def output(self, t, x, u):
        return np.where(u.u > 0.3, 1.0, 0.0)


class Dragging(Block):
    """Coulomb friction, without an event."""

    force = Input()
    speed = State(output=True, start=0.1)

    def derivative(self, t, x, u):
        return u.force - np.where(x.speed > 0.0, 1.0, -1.0)


class Sudden(Block):
    """A step that nobody is told of."""

    y = Output()

    def output(self, t, x, u):
        return np.where(t >= 0.37, 1.0, 0.0)


class Bent(Block):
    """A kink that nobody is told of."""

    y = Output()

    def output(self, t, x, u):
        return np.where(t >= 0.37, t - 0.37, 0.0)


class Pushed(Block):
    """A rate that jumps, of which nobody is told."""

    y = State(output=True)

    def derivative(self, t, x, u):
        return np.where(t >= 0.37, 1.0, 0.0) - x.y


class Standing(Sudden):
    """Announces the same instant again and again."""

    def next_instant(self, t):
        return 0.37


class Skipping(Sudden):
    """Announces an instant from the start, and forgets it."""

    def next_instant(self, t):
        return 0.37 if t == 0.0 else math.inf


class Flapping(Block):
    """A jump that its own indicator undoes."""

    u = Input()
    y = State(discrete=True, output=True)
    up = Event("both")

    def indicators(self, t, x, u):
        return (u.u - 0.3) * (1.0 - 2.0 * x.y)

    def jump(self, t, x, u, fired):
        return 1.0 - x.y


class Undefined(Block):
    """An indicator that is no number everywhere."""

    u = Input()
    y = State(discrete=True, output=True)
    up = Event("rising")

    def indicators(self, t, x, u):
        return np.log(u.u)

    def jump(self, t, x, u, fired):
        return 1.0 + 0.0 * x.y


class Unguarded(Amplifier):
    """A guard without an error of its own."""

    def guards(self, t, x, u):
        return {"small": 10.0 - u.u}

    def guard_error(self, name, value, u, y, x=None):
        return f"{name} is {value}"


class Starting(Amplifier):
    """Passes its input at the start, and later the difference of two: after_start with a fault each."""

    last = State()
    running = State()

    def output(self, t, x, u):
        return np.where(x.running > 0.5, u.u - x.last, u.u)

    def update(self, t, x, u):
        return u.u, 1.0 + 0.0 * t

    def after_start(self, x, u, T):
        return np.where(x.running > 0.5, x.last, 0.0), np.ones(())


class WronglyStarting(Starting):
    """Its outputs after the start are others."""

    def after_start(self, x, u, T):
        return np.where(x.running > 0.5, x.last, u.u - 7.0), np.ones(())


class StartingAgain(Starting):
    """Leaves its start twice."""

    def after_start(self, x, u, T):
        return x.last + 1.0, np.ones(())


class StartingNowhere(Starting):
    """Divides by what is not there."""

    def after_start(self, x, u, T):
        return np.float64(np.nan), np.ones(())


class StartingShort(Starting):
    """Forgets a state."""

    def after_start(self, x, u, T):
        return np.ones(())


class StartingByTime(Starting):
    """Needs a sample time, where there is none."""

    def derivative(self, t, x, u):
        return 0.0 * u.u, 0.0 * u.u

    def after_start(self, x, u, T):
        return np.where(x.running > 0.5, x.last, 0.0 * T), np.ones(())


SEEN = set()


class Remembering(Amplifier):
    """Behaves otherwise at a tick that it has seen; between ticks, where equations are looked at, it is pure."""

    opaque = True

    def output(self, t, x, u):
        tick = round(float(t) / 0.01)
        if 50 < tick < 100 and abs(t - tick * 0.01) < 1e-12 and not np.any(u.u == 0.0):
            again = tick in SEEN and float(u.u) in SEEN
            SEEN.update({tick, float(u.u)})
            return self.gain * u.u + again
        return self.gain * u.u


BROKEN = {
    Counting: (DefinitionError, "counting: purity: its output gives other values when it is called again"),
    Keeping: (DefinitionError, "keeping: purity: its attribute 'last' was changed by its equations"),
    Overwriting: (DefinitionError, r"overwriting\.u: purity: its output changes its argument 'u' from"),
    Preset: (DefinitionError, r"preset\.gain: values: replace\(gain=2\.5\) gave .*, equal to the block"),
    Forgetful: (DefinitionError, r"forgetful: values: replace\(\) without changes gave .* not equal"),
    Laden: (DefinitionError, r"laden: values: it can't be pickled .* Define its class at the top of a module"),
    Partial: (DefinitionError, r"partial: values: pickled and read back it is .* expected"),
    TooManyUnits: (UnitError, r"too_many_units\.u: units: found 3 units for shape \(2,\); expected one for each"),
    Misnamed: (DefinitionError, r"misnamed\.u: ports: it is under 'u' and calls itself 'v'"),
    Orphan: (DefinitionError, r"orphan\.y: ports: found like='w'; expected an input: u"),
    Clipped: (ShapeError, r"clipped\.y: its output gives shape \(\); expected \(2,\) as declared"),
    Sometimes: (ShapeError, r"sometimes\.y: shapes: with numbers its output has shape \(2,\)"),
    Typed: (TraceError, "typed: trace: in a sampled subsystem its traced y is .* where NumPy gives"),
    Rooted: (DefinitionError, r"rooted: derivatives: .* of y\[1\] by u\[1\] is nan where differences give"),
    Dotted: (DefinitionError, r"dotted: derivatives: .* of y\[1\] by u\[1\] is 0 where differences give 1"),
    Branching: (DefinitionError, r"branching: events: .* jump at .*'u': \[0\.3\]} and no indicator crosses zero there"),
    Dragging: (DefinitionError, r"dragging: events: in a continuous subsystem its outputs or derivatives jump"),
    Sudden: (DefinitionError, r"sudden: next_instant: its outputs, or their rates, jump at t = 0\.37 s"),
    Bent: (DefinitionError, r"bent: next_instant: its outputs, or their rates, jump at t = 0\.37 s"),
    Pushed: (DefinitionError, r"pushed: next_instant: its outputs, or their rates, jump at t = 0\.37 s"),
    Standing: (DefinitionError, r"standing: next_instant: next_instant\(0\.37\) gave 0\.37; expected a later time"),
    Skipping: (DefinitionError, r"skipping: next_instant: next_instant\(0\.0\) gave 0\.37, but next_instant\(0\.185\)"),
    Flapping: (DefinitionError, r"flapping: events: at t = .* its events keep firing \(up\), 100 times"),
    Undefined: (DefinitionError, r"undefined\.up: events: its indicator is \[nan\]"),
    Unguarded: (DefinitionError, r"unguarded: guards: guard_error gave 'small is -1\.0'"),
    WronglyStarting: (DefinitionError, r"wrongly_starting: after_start: with the states .* its outputs are .*expected"),
    StartingAgain: (DefinitionError, r"starting_again: after_start: from its own states .* it gave .*; expected"),
    StartingNowhere: (DefinitionError, r"starting_nowhere: after_start: it gave \[nan, 1\.0\].*; expected finite"),
    StartingShort: (DefinitionError, r"starting_short: after_start: .*; expected"),
    StartingByTime: (DefinitionError, r"starting_by_time: after_start: its after_start.* failed with T = None"),
    Remembering: (DefinitionError, r"remembering: runs: in a sampled subsystem a run that was saved at t = 0\.5 s"),
}
OPTIONS = {Typed: {"inputs": {"u": (-50.0, 50.0)}}}


@pytest.mark.parametrize("cls", BROKEN, ids=lambda cls: cls.__name__)
def test_a_broken_rule_is_named(cls):
    kind, text = BROKEN[cls]
    with np.errstate(all="ignore"), pytest.raises(kind, match=text) as caught:
        check_block(cls(), **OPTIONS.get(cls, {}))
    assert type(caught.value) is kind
    if re.search(r": (purity|values|ports|units|shapes|trace|derivatives|events|next_instant|guards|runs): ", text):
        assert "; expected " in str(caught.value)
        assert str(caught.value).endswith(".")  # the next step


def test_a_branch_of_the_start_is_checked():
    report = check_block(Starting(), kinds=["sampled"])
    assert report.checks["sampled: after_start"] == "2 states, at 6 points"
    assert "after_start" not in " ".join(check_block(Gain(gain=2.0)).checks)


def test_what_the_broken_ones_are_made_from_keeps_the_contract():
    assert set(check_block(Amplifier()).kinds.values()) == {"checked"}


def test_a_dependency_that_the_trace_does_not_show_is_found(monkeypatch):
    import loopwright.diagrams.contract.contract as contract

    made = contract.trace

    def blind(*arguments, **options):
        found = made(*arguments, **options)
        found.depends["y"] = frozenset()
        return found

    monkeypatch.setattr(contract, "trace", blind)
    with pytest.raises(
        DefinitionError, match=r"amplifier\.y: feedthrough: .* the output 'y' changes with the input 'u'"
    ):
        check_block(Amplifier())


class Gear(Block):
    """J ω̇ = N M."""

    N: float = parameter(default=30.0)
    J: float = parameter(default=1.0, unit="kg.m2")
    M = Input(unit="N.m", shape=())
    w = State(unit="rad/s", output=True)

    def derivative(self, t, x, u):
        return self.N * u.M / self.J


def test_the_report_names_variables_without_a_unit_that_an_export_refuses():
    with pytest.raises(DefinitionError, match="N without a unit, where others have one"):
        loopwright.fmus.build(Gear(name="gear"))
    assert check_block(Gear()).checks["units"] == "as an FMU it needs one for N, too: unit='1' for no dimension"
    assert "units" not in check_block(Saturation(limit=1.0)).checks
