"""Errors that a newcomer meets say what to write."""

import pickle
import re
import zipfile
from html import unescape
from types import SimpleNamespace

import numpy as np
import pytest

from loopwright import Block, Diagram, Input, Output, State, build, doctor, margins, subsystem
from loopwright.blocks import (
    PID,
    Encoder,
    Function,
    Gain,
    LoopwrightError,
    ParameterError,
    Recorded,
    SmoothStep,
    Stack,
    Step,
    TraceError,
    TransferFunction,
    TransportDelay,
    UnitConversion,
    UnitError,
    UnknownNameError,
    WiringError,
    parameter,
)
from loopwright.blocks.core import near, parse_unit
from loopwright.diagrams import DefinitionError, SspFileError
from loopwright.diagrams.exporting import make_exported
from loopwright.diagrams.sweeps.samples import grid, table
from loopwright.fmus import Fmu, FmuError, FmuFileError, dc_motor
from loopwright.fmus.fmu_block.fmu_start_values import check_value
from loopwright.sweeps import Box


@subsystem(sample_time=0.01)
def controller(reference, speed):
    return PID(kp=1.0, ki=5.0, name="pid")(r=reference, y=speed).named("u")


@pytest.fixture(scope="module")
def loop():
    motor = TransferFunction(numerator=[2.0], denominator=[0.1, 1.0], name="motor")
    reference = Step(times=0.1, values=1.0, name="reference")
    return Diagram("loop", motor(controller(reference, motor.y)).named("speed"))


NEXT_STEPS = [
    (
        lambda: Step(times=(1, 2), values=1.0),
        r"^step\.times: .* Give lists of one length, such as times=\(0\.5, 2\.0\)",
    ),
    (
        lambda: SmoothStep(levels=(0, 1), start_times=(0, 1), durations=1),
        r"levels: found 2 levels, 2 .* Give one level",
    ),
    (
        lambda: Recorded(times=(0, 1), values=(1, 2, 3)),
        r"values of shape \(3,\) for 2 times; .* Give one row of values",
    ),
    (lambda: UnitConversion(from_unit="m", to_unit="s"), r"two units of one dimension\. .* Give another unit\.$"),
    (lambda: Function(abs, arguments=("my a",)), r"arguments: found 'my a'; expected names .* Give these"),
    (lambda: Gain(gain=1, name="my gain"), r"found the name 'my gain'; .* Take 'my_gain'\."),
    (lambda: Gain(gain=1, name="2nd"), r"found the name '2nd'; .* Take 'n_2nd'\."),
    (lambda: Gain(gain=1, name="motor-größe"), r"Take 'motor_größe'\."),
    (lambda: Gain(gain=1, name="%"), r"Take 'v_perp'\."),
    (lambda: Gain(gain=1)("r"), r"gain\.u: found 'r'; .* Wire an output by its name, such as plant\.y\."),
    (lambda: Gain(gain=1)(None), r"found None; .* Let the function that made it return a signal"),
    (lambda: Gain(gain=1)("1.5"), r"found '1\.5'; .* Leave out the quotes: 1\.5\."),
    (lambda: Gain(gain=1)(np.nan), r"found nan; .* Give finite numbers"),
    (lambda: Gain(gain=1)(True), r"found True; .* Give 1 for a logic signal"),
    (lambda: Diagram("d", subsystem(lambda: ())()), r"^d: found no block .* Call blocks in the subsystem's function"),
    (lambda: Gain(gain=1)(1.0).named("u")["1"], r"found the index '1'; .* Write y\[0\] or y\[:2\]"),
    (lambda: Diagram("d", Gain(gain=[[1, 2]])(1.0)), r"found a scalar; .* takes 2 entries\. Wire a signal of as many"),
    (
        lambda: Diagram("d", 3),
        r"found 3; expected calls .* Give them after the name: Diagram\('loop', plant\(force=u\)\)",
    ),
    (lambda: subsystem(sample_time="1ms")(abs), r"sample time '1ms'; expected seconds\. Give a number"),
    (
        lambda: subsystem(sample_time=0.1, offset=0.25)(abs),
        r"offset of 0\.25 s; .* Give 0\.05, at which the later ticks",
    ),
    (lambda: subsystem(sample_time=0.1, delay=0.05)(abs), r"found delay=0\.05; .* delay in seconds is TransportDelay"),
    (lambda: subsystem(sample_time=0.1, enabled="yes")(abs), r"expected 'held' or 'reset'\. Give one of these"),
    (lambda: subsystem(lambda a, b: a)(1.0), r"nothing is wired to 'b'; .* Give a signal or a number for each"),
    (lambda: Box("a", 2.0), r"from 'a' to 2\.0; expected two numbers\. Give \(low, high\), such as"),
    (lambda: Box(2.0, 1.0), r"the lower one first\. Give \(low, high\), such as"),
    (lambda: Box([1.0, 2.0], 3.0), r"ends of shapes \(2,\) and \(\); .* Give both ends for each entry"),
    (lambda: Box.of(5.0, "k.gain"), r"^k\.gain: found 5\.0; expected a range, of two ends\. Give \(low, high\)"),
    (lambda: grid({"k.gain": 3.0}), r"^k\.gain: found 3\.0; expected a list of its values\. Give one, such as"),
    (lambda: grid(3.0), r"found 3\.0; expected parameters by name, .* Give \{'controller\.gain': \(1\.0, 2\.0\)\}"),
    (lambda: grid({"k": (1.0, np.nan)}), r"^k: found the value nan; expected finite numbers\. Leave it out"),
    (lambda: table({"a": (1.0,), "b": (1.0, 2.0)}), r"unequal length \(a: 1, b: 2\); .* Fill the shorter ones"),
    (lambda: table("a"), r"found 'a'; expected a list of samples, .* Give \[\{'controller\.gain': 2\.0\}\]"),
    (lambda: Input(nominal=-1.0), r"found nominal -1\.0; expected a positive number\. Give"),
]


@pytest.mark.parametrize(("ask", "said"), NEXT_STEPS)
def test_an_everyday_mistake_ends_in_a_next_step(ask, said):
    with pytest.raises(LoopwrightError, match=said):
        ask()


def test_a_stack_of_two_says_how_to_get_four():
    signals = [Step(times=0.1, values=1.0, name=f"s{i}").y for i in range(4)]
    with pytest.raises(
        WiringError, match=r"4 signals for 2 inputs \(u1, u2\)\. Say how many there are: Stack\(count=4\)\."
    ):
        Stack()(*signals)
    assert len(Stack(count=4)(*signals).block.inputs) == 4
    with pytest.raises(WiringError, match=r"2 signals for 1 inputs \(u\)\. For one vector of them give a tuple"):
        Gain(gain=2.0)(*signals[:2])


@pytest.mark.parametrize("unit", ["m2.5/s", "m^0.5", "m^(1/2)", "m1/2", "sqrt(m)", "N/m0.5"])
def test_a_unit_with_a_fractional_power_says_so(unit):
    with pytest.raises(UnitError, match="has a power that is no whole number, .* Leave the unit out"):
        parse_unit(unit)


@pytest.mark.parametrize("unit", ["m2.s", "kg.m2", "m5/s2", "kg5/s", "N/(m.s)", "m^2.s^-1", "1/s"])
def test_products_of_whole_powers_are_read(unit):
    assert parse_unit(unit).factor == 1.0


def test_a_linear_model_says_where_plots_and_margins_are(loop):
    model = loop.linearize()
    for name in ("bode", "nyquist", "root_locus"):
        with pytest.raises(AttributeError, match=rf'Write lin\.loop\("wire"\)\.{name}\(\)'):
            getattr(model, name)
    for name in ("margins", "gain_margin"):
        with pytest.raises(AttributeError, match=r'Write margins\(lin\.loop\("wire"\)\), after from loopwright import'):
            getattr(model, name)
    assert not hasattr(model, "_repr_png_")
    with pytest.raises(AttributeError, match="a linear model has no 'affin'. Did you mean 'affine'"):
        _ = model.affin


@pytest.mark.parametrize("ask", [lambda m: m.linearize(inputs="ref"), lambda m: m.linearize().loop("ref")])
def test_the_beginning_of_a_name_leads_to_it(loop, ask):
    with pytest.raises(UnknownNameError, match="Did you mean 'reference.y'"):
        ask(loop)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (
            lambda loop: margins("u"),
            r"found 'u'; expected the loop at a wire\. Give diagram\.linearize\(\)\.loop\('u'\)",
        ),
        (
            lambda loop: loop.simulate(0.1, progress=False).at([0.05]),
            r"found t = \[0\.05\]; expected one time in s\. Give",
        ),
        (
            lambda loop: loop.sweep({"controller.pid.kp": (1.0, 2.0)}, 0.1, reduce={"p": "speed"}),
            r"found 'speed' for 'p'; .* Give reduce=\{'p': final\('speed'\)\}",
        ),
        (
            lambda loop: loop.sweep({"controller.pid.kp": (1.0, 2.0)}, 0.1, reduce="p"),
            r"Give reduce=\{'end': final\('y'\)\}",
        ),
    ],
)
def test_a_name_in_place_of_what_it_names_says_what_to_give(loop, ask, said):
    with pytest.raises(LoopwrightError, match=said):
        ask(loop)


def test_an_input_leads_to_the_signal_that_feeds_it(loop):
    with pytest.raises(
        UnknownNameError, match=r"'u' is an input of 'motor', .* Give 'controller\.pid\.u', which feeds it"
    ):
        loop.linearize().loop("motor.u")
    with pytest.raises(UnknownNameError, match=r"'r' is an input of 'controller\.pid', .* Name the wire that feeds it"):
        _ = loop.simulate(0.1, progress=False)["pid.r"]


def test_only_beginnings_of_three_letters_are_close():
    assert near("ref", ["plant.reference", "speed"]) == "Did you mean 'plant.reference'?"
    assert near("re", ["plant.reference", "speed"]).startswith("Known:")
    assert near("xyz", ["plant.reference"]).startswith("Known:")


def test_a_subsystem_before_its_call_says_what_to_write():
    with pytest.raises(
        AttributeError, match=r"a subsystem has no 'y' before its call.* out = controller\(…\) and out\.y"
    ):
        _ = controller.y
    assert not hasattr(controller, "wired")


def test_a_wrong_version_is_found_before_anything_about_the_block():
    class Own(Block):
        k: float = parameter(default=1.0)
        u, y = Input(unit="m"), State(unit="m", output=True)

        def derivative(self, t, x, u):
            return self.k * (u.u - x.y)

    with pytest.raises(FmuError, match="found fmi=4, expected 3"):
        build(Own(), fmi=4)
    with pytest.raises(DefinitionError, match="k without a unit, where others have one"):
        build(Own())


def test_c_of_a_diagram_with_a_plant_says_the_words_to_type(loop, tmp_path):
    with pytest.raises(
        DefinitionError, match=r"outside=\['motor'\], or write .* alone: subsystem='controller'"
    ) as refused:
        loop.to_c(tmp_path / "out", number="float")
    assert not (tmp_path / "out").exists()
    assert "leave it outside" in str(refused.value)
    assert loop.to_c(tmp_path / "a", outside=["motor"]).files
    assert loop.to_c(tmp_path / "b", subsystem="controller").files


def test_an_encoder_has_no_unit_of_its_own():
    """Its quantum is in the unit of its position, rad or m."""
    assert re.search(r"quantum : float, above 0\n\s+smallest step Δ, in the position's unit", Encoder.__doc__)


def test_settings_of_subsystems_are_a_table(loop):
    """A dictionary by path all the same."""
    found = loop.subsystems
    assert [*found] == ["", "controller"]
    assert found == dict(loop.structure.subsystems)
    assert re.search(r"^controller +every 0\.01 s +reference, speed$", str(found), re.MULTILINE)
    assert "<td>every 0.01 s</td>" in found._repr_html_()
    assert repr(found["controller"]) == "<settings of controller: every 0.01 s>"
    late = loop.replace({"controller.offset": 0.002, "controller.delay": 1}).subsystems["controller"]
    assert late.rate == "every 0.01 s from 0.002 s on, delay 1"
    assert pickle.loads(pickle.dumps(found)) == found


def test_a_loop_at_a_source_is_constant_0_and_says_so(loop):
    model = loop.linearize()
    around = model.loop("u")
    assert "constant 0" in repr(model.loop("reference"))
    assert "0 at all frequencies" in model.loop("reference")._repr_html_()
    assert "constant 0" not in repr(around)
    assert "<td>2</td>" in around._repr_html_()
    assert "0 at all" not in around._repr_html_()
    late, reference = TransportDelay(delay=1.0, name="late"), Step(times=0.1, values=1.0, name="reference")
    delayed = Diagram("d", late((0.5 * (reference - late.y)).named("u"))).linearize().loop("u")
    assert "constant 0" not in repr(delayed)
    assert "<td>1</td>" in delayed._repr_html_()
    assert np.abs(delayed(1j)) == pytest.approx(0.5)


def test_a_state_that_an_fmu_computes_at_the_start_is_called_a_state():
    def find(name):
        return SimpleNamespace(causality="local", start=None, variability="continuous")

    description = SimpleNamespace(
        other={}, variables={"s": 0, "v": 0}, elements={}, spelled={}, states={"s": "der(s)"}, find=find
    )
    with pytest.raises(ParameterError, match=r"^fmu\.start\.s: found a state without a start value .* it initializes"):
        check_value(description, "s", 1.0, "fmu")
    with pytest.raises(ParameterError, match=r"^fmu\.start\.v: found a variable that is computed"):
        check_value(description, "v", 1.0, "fmu")


class Bare(Block):
    """A block whose output is whatever a function of (self, x, u) returns."""

    returned: object
    gain: float = 2.0
    u, y = Input(), Output()
    level = State(shape=(2,))

    def derivative(self, t, x, u):
        return -x.level

    def output(self, t, x, u):
        return self.returned(self, x, u)


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        (lambda self, x, u: gain * u.u, r"NameError: name 'gain' is not defined\. Write self\.gain\."),  # noqa: F821
        (lambda self, x, u: level[0], r"name 'level' is not defined\. Write x\.level\."),  # noqa: F821
        (lambda self, x, u: foo, r"name 'foo' is not defined\. Correct the equation there\."),  # noqa: F821
        (lambda self, x, u: x, r"returned all of x \(level\) for y; .* Return one of them, such as x\.level\."),
    ],
)
def test_a_bare_name_in_an_equation_says_where_it_is(returned, said):
    with pytest.raises(TraceError, match=said):
        Diagram("d", Bare(returned=returned)(1.0))


def test_an_fmu_and_an_ssp_lead_to_what_reads_them(tmp_path):
    for name, within in (("plant.fmu", "modelDescription.xml"), ("system.ssp", "SystemStructure.ssd")):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.writestr(within, "<a/>")
    with pytest.raises(
        SspFileError, match=r"plant\.fmu' has no description; .* It is an FMU: write Fmu\('.*plant\.fmu'\)"
    ):
        Diagram.from_ssp(tmp_path / "plant.fmu")
    with pytest.raises(FmuFileError, match=r"so it is no FMU\. It is an SSP: Diagram\.from_ssp reads it"):
        Fmu(tmp_path / "system.ssp")


def test_the_range_of_a_start_value_that_is_above_0_says_so():
    with pytest.raises(ParameterError, match=r"found -1\.0; the FMU allows numbers above 0 in Ohm\. Give a value in"):
        Fmu(dc_motor.build(), start={"resistance": -1.0})
    for text, step in (("100 Ohm", "Give it in Ohm, without the unit"), ("1.5", "Leave out the quotes")):
        with pytest.raises(ParameterError, match=rf"found '{text}'; expected a number, no text\. {step}"):
            Fmu(dc_motor.build(), start={"resistance": text})


def test_an_examination_of_an_fmu_is_a_table_in_a_notebook():
    found = doctor("absent.fmu")
    html = found._repr_html_()
    assert "absent.fmu: is refused" in html
    assert html.count("<tr>") == 1 + len(found.findings)
    assert found.findings[0].step in unescape(html)
    assert str(found).startswith("absent.fmu: is refused")


def test_a_dead_time_leaves_in_a_sampled_subsystem():
    lag = TransferFunction(numerator=[1.0], denominator=[5.0, 1.0], name="lag")
    dead, step = TransportDelay(delay=7.3, name="dead"), Step(times=1.0, values=1.0, name="step")

    def pipe(u):
        return dead(u).named("late")

    with pytest.raises(DefinitionError, match=r"dead: .* also for a constant delay.*Put it into .*sample_time="):
        make_exported(Diagram("d", lag(pipe(step))))
    sampled = Diagram("d", lag(subsystem(sample_time=0.1)(pipe)(step)))
    assert make_exported(sampled).clocks == ((1, 0),)
    run = sampled.simulate(10.0, progress=False)
    assert run.t[np.argmax(run["late"] > 0.5)] == pytest.approx(8.3, abs=1e-12)
