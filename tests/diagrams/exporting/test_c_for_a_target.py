"""C for a target: the numbers of the run in every bit, on this machine and on a Cortex-M, without a warning."""

import itertools
import re
import shutil
import subprocess

import numpy as np
import pytest

from loopwright import Diagram, build, subsystem, to_c
from loopwright.blocks import (
    PID,
    BandLimitedNoise,
    Clock,
    Compare,
    DiscreteStateSpace,
    Gain,
    PulseTrain,
    PythonFunction,
    Relay,
    Sine,
    Step,
    Sum,
    Switch,
    TransferFunction,
)
from loopwright.diagrams import DefinitionError, OptionError
from loopwright.diagrams.exporting import open_part, open_subsystem, open_whole, target_spec
from loopwright.fmus.export import measure, run_here, unit_name, write_target
from loopwright.fmus.export.target_measure import find_bound
from support.exported_loops import Loop
from support.target_diagrams import DIAGRAMS, run_of, spec_of

TICKS = 300
EPS = float(np.finfo(np.float32).eps)


@subsystem(sample_time=0.1)
def pi(reference, level):
    """PI controller of a level."""
    return PID(kp=2.0, ki=3.0, name="pi")(reference, level).named("effort")


@pytest.fixture(scope="module")
def pi_spec():
    return target_spec(open_subsystem(pi, Diagram, "pi"), name="pi", description="PI controller of a level")


def test_a_pi_controller_has_the_numbers_of_the_closed_form(pi_spec):
    """After k ticks with the error e the integral has k steps of 0.1 s: u = (kp + ki 0.1 k) e."""
    signal, expected = {"reference": 1.0, "level": 0.25}, 0.75 * (2.0 + 0.3 * np.arange(20))
    found = run_here(write_target(pi_spec), signal, 20)["effort"]
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    single = run_here(write_target(pi_spec, number="float"), signal, 20)["effort"]
    np.testing.assert_allclose(single, expected, rtol=20 * EPS)
    assert np.any(single != found)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    "name",
    [
        "cascade",
        "tables",
        *(pytest.param(n, marks=pytest.mark.slow) for n in DIAGRAMS if n not in ("cascade", "tables")),
    ],
)
def test_the_numbers_are_those_of_the_run_in_every_bit(name):
    run, inputs = run_of(name, TICKS)
    found = run_here(write_target(spec_of(name)), inputs, TICKS)
    for signal, values in found.items():
        np.testing.assert_array_equal(values, run[signal][:TICKS])
    assert max(np.ptp(values) for values in found.values()) > 0.1


@pytest.mark.parametrize(
    "name", ["tables", *(pytest.param(n, marks=pytest.mark.slow) for n in DIAGRAMS if n != "tables")]
)
def test_with_own_functions_it_has_the_bits_of_the_loop_that_has_them(name):
    """The loop of runs and FMUs, with the same functions in place of those of math.h."""
    spec, (run, inputs) = spec_of(name), run_of(name, TICKS)
    found = run_here(write_target(spec, own_functions=True), inputs, TICKS)
    loop = Loop(spec.loop, own_functions=True)
    rows = {signal: [] for signal in found}
    for k in range(TICKS):
        for argument, values in inputs.items():
            loop[argument] = values[k]
        assert k or loop.start()
        assert loop.advance(float((k + 1) * spec.loop.base))
        for signal, row in rows.items():
            row.append(loop[signal])
    for signal, values in found.items():
        np.testing.assert_array_equal(values, rows[signal])
    if name == "path_following":
        assert any(np.any(values != run[signal][:TICKS]) for signal, values in found.items())  # math.h's are others


@pytest.mark.slow
@pytest.mark.parametrize("name", [*DIAGRAMS])
def test_single_precision_is_within_its_rounding_of_double(name):
    """Errors are some roundings of the largest number; a feedback over the run is in the test signal already."""
    _, inputs = run_of(name, TICKS)
    fine, coarse = (run_here(write_target(spec_of(name), number=n), inputs, TICKS) for n in ("double", "float"))
    for signal, values in fine.items():
        size = max(1.0, float(np.max(np.abs(values))))
        # Fig. 3 has gains of 64,000 on errors of a position of size 1
        assert np.max(np.abs(values - coarse[signal])) < (1e5 if name == "path_following" else 2e3) * EPS * size
    assert any(np.any(fine[signal] != coarse[signal]) for signal in fine)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*DIAGRAMS])
@pytest.mark.parametrize(
    ("processor", "number"), [("cortex-m4", "double"), ("cortex-m0", "double"), ("cortex-m4", "float")]
)
def test_a_cortex_m_computes_the_bits_of_this_machine(name, processor, number):
    """With our own functions; it is compiled with warnings as errors."""
    _, inputs = run_of(name, TICKS)
    text = write_target(spec_of(name), own_functions=True, number=number)
    here, there = run_here(text, inputs, 40), measure(text, processor, inputs, 40)
    assert not there.missing
    for signal, values in here.items():
        np.testing.assert_array_equal(values, there.outputs[signal])
    assert len(there.instructions) == 40
    assert there.stack > 0
    assert there.bound is None or there.bound >= there.largest


@pytest.mark.slow
@pytest.mark.parametrize("letter", "ABCD")
def test_fig_3_runs_in_float_with_a_tolerance_of_float(letter):
    """Where the hand pulls, θ and ξ are within a micrometre of those in double; 1e-9 of a lap is finer than a float."""
    from loopwright import experiments

    diagram = experiments.EXPERIMENTS[letter]().diagram.replace({"controller.path_projection.tolerance": 1e-5})
    run = diagram.simulate(2.0, progress=False)
    spec = target_spec(open_part(diagram.wired, "controller", "fig3"), name="fig3", description="")
    inputs = {}
    for (path, argument), wire in diagram.structure.arguments.items():
        if path == "controller":
            values = run[f"{wire.block}.{wire.port}"][:2000]
            inputs[argument] = values if wire.index is None else values[:, wire.index]
    found = run_here(write_target(spec, number="float", own_functions=True), inputs, 2000)
    for signal, bound in (("theta", 1e-6), ("eta", 1e-6), ("xi", 1e-6), ("v_par", 0.1), ("v_perp", 0.01)):
        assert 0.0 < np.max(np.abs(found[signal] - run[signal][:2000])) < bound
    size = np.max(np.abs(run["motor_force"]))
    assert np.max(np.abs(found["motor_force"] - run["motor_force"][:2000])) < 0.02 * size


@pytest.mark.slow
@pytest.mark.parametrize("name", ["machine", "path_following"])
def test_a_tick_in_float_with_own_functions_has_a_bound(name):
    """Neither tables nor functions loop, and none of a library is called."""
    _, inputs = run_of(name, TICKS)
    found = measure(write_target(spec_of(name), own_functions=True, number="float"), "cortex-m4", inputs, 40)
    assert found.largest <= found.bound < 1.5 * found.largest


@pytest.mark.slow
def test_a_tick_without_branches_takes_the_instructions_of_its_bound(pi_spec):
    """On a Cortex-M4 with its unit for single precision nothing of a library is called: each tick is the bound."""
    found = measure(write_target(pi_spec, number="float"), "cortex-m4", {"reference": 1.0}, 10)
    assert {*found.instructions} == {found.bound}
    soft = measure(write_target(pi_spec, number="float"), "cortex-m0", {"reference": 1.0}, 10)
    assert soft.bound is None
    assert "library" in soft.unbounded
    assert soft.largest > 5 * found.largest


@pytest.mark.slow
@pytest.mark.parametrize("name", [*DIAGRAMS])
@pytest.mark.parametrize("number", ["double", "float"])
def test_compilers_and_cppcheck_have_nothing_to_say(name, number, tmp_path):
    for own in (False, True):
        text = write_target(spec_of(name), number=number, own_functions=own)
        for file, content in text.files.items():
            (tmp_path / file).write_text(content, encoding="utf-8")
        compiler = shutil.which("gcc")
        assert compiler, "no gcc was found. Install it: apt-get install gcc"
        warnings = ["-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-pedantic", "-Werror"]
        sources = [f"{name}.c", f"{name}_example.c"]
        command = [compiler, "-std=c99", "-O2", *warnings, "-o", "example", *sources, "-lm"]
        subprocess.run(command, cwd=tmp_path, check=True)
        subprocess.run(["./example"], cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)
        if own and name == "path_following":
            continue  # half a minute, for functions that other diagrams call, too
        checker = shutil.which("cppcheck")
        assert checker, "no cppcheck was found. Install it: apt-get install cppcheck"
        command = [checker, "-q", "--std=c99", "--enable=warning,style,performance,portability", "--error-exitcode=1"]
        subprocess.run([*command, "--suppress=missingIncludeSystem", *sources], cwd=tmp_path, check=True)


_SET = """#include "pi.h"
#include <stdio.h>
int main(void) {
    pi one, other;
    pi_init(&one);
    pi_init(&other);
    const bool set = pi_set(&one, PI_PARAMETER_PI_KP, 0u, 5.0);
    const bool in = pi_set(&one, PI_INPUT_REFERENCE, 0u, 2.0);
    const bool far = pi_set(&one, PI_INPUT_REFERENCE, 1u, 2.0);
    const bool out = pi_set(&one, PI_OUTPUT_EFFORT, 0u, 2.0);
    other.inputs.reference = 2.0;
    const pi_status a = pi_tick(&one), b = pi_tick(&other);
    pi saved = one;
    one.inputs.level = 1.0 / 0.0;
    const pi_status c = pi_tick(&one);
    double effort = 0.0;
    const bool got = pi_get(&one, PI_OUTPUT_EFFORT, 0u, &effort);
    pi_tick(&saved);
    printf("%d%d%d%d %d%d%d%d %g %g %g\\n", set, in, far, out, a, b, c, got, effort, other.outputs.effort,
           saved.outputs.effort);
    return 0;
}
"""


@pytest.mark.slow
def test_variables_by_name_instances_and_a_tick_that_fails(pi_spec, tmp_path):
    """kp = 5 and error 2: 10, in the other instance 4; a number that isn't finite changes nothing; a copy goes on."""
    for file, content in write_target(pi_spec).files.items():
        (tmp_path / file).write_text(content, encoding="utf-8")
    (tmp_path / "main.c").write_text(_SET)
    subprocess.run(["gcc", "-std=c99", "-o", "main", "pi.c", "main.c", "-lm"], cwd=tmp_path, check=True)
    said = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert said.split() == ["1100", "0011", "10", "4", "10.6"]


_FROM_A_POINT = """#include "pi.h"
#include <stdio.h>
int main(void) {
    pi c;
    double reference, level;
    pi_init(&c);
    c.states.pi_integral = INTEGRAL;
    while (scanf("%la %la", &reference, &level) == 2) {
        c.inputs.reference = reference;
        c.inputs.level = level;
        if (pi_tick(&c) != PI_OK) {
            return 1;
        }
        printf("%a\\n", c.outputs.effort);
    }
    return 0;
}
"""


@pytest.mark.slow
def test_with_the_states_of_an_operating_point_it_has_the_bits_of_the_run_from_there(tmp_path):
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 2.0], name="plant")
    wish = Step(times=0.5, values=1.0, initial_value=0.3, name="wish")
    loop = Diagram("loop", plant(pi(wish, plant.y)))
    point = loop.trim()
    integral = float(point.states["pi.pi.integral"])
    assert integral == pytest.approx(0.6, abs=1e-8)  # 2 · 0.3 hold the level
    run = loop.simulate(3.0, start=point, progress=False)
    loop.to_c(tmp_path, subsystem="pi")
    (tmp_path / "main.c").write_text(_FROM_A_POINT.replace("INTEGRAL", integral.hex()), encoding="utf-8")
    subprocess.run(["gcc", "-std=c99", "-o", "main", "pi.c", "main.c", "-lm"], cwd=tmp_path, check=True)
    rows = zip(run["wish.y"][:30], run["plant.y"][:30], strict=True)
    given = "".join(f"{float(r).hex()} {float(y).hex()}\n" for r, y in rows)
    said = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True, input=given).stdout
    assert [float.fromhex(line) for line in said.split()] == run["effort"][:30].tolist()


def test_the_files_name_what_an_engineer_looks_for(tmp_path):
    code = to_c(pi, tmp_path, number="float")
    header, source, _, report = (file.read_text(encoding="utf-8") for file in code.files)
    assert "PI controller of a level." in header
    assert "#define PI_PERIOD 0.1f" in header
    assert "pi_real reference;" in header
    assert "pi_real pi_kp;" in header
    assert "/* pi (PID) */" in source
    for forbidden in ("malloc", "double ", "while (", "for ("):
        assert forbidden not in source.partition("#include")[2]
    assert "Tick 0: every 0.1 s" in report
    assert "Not measured" in report
    assert code.bytes_of["states"] == 4
    assert code.ticks[0].inputs == ("reference", "level")


def test_an_output_is_called_as_its_wire_inside_else_as_the_one_outside_else_as_its_port(tmp_path):
    @subsystem(sample_time=0.1)
    def controller(r):
        effort = PID(kp=2.0, name="pid")(r, 1.0)
        return effort, Gain(gain=2.0, name="twice")(effort).named("doubled"), Gain(gain=3.0, name="thrice")(effort)

    voltage, outer, rest = controller(Step(times=0.1, values=1.0, name="r"))
    loop = Diagram("loop", voltage.named("voltage"), outer.named("outside"), rest)
    header = loop.to_c(tmp_path, subsystem="controller").files[0].read_text(encoding="utf-8")
    outputs = header.partition("/** Outputs:")[2].partition("} controller_outputs;")[0]
    assert re.findall(r"controller_real (\w+);", outputs) == ["voltage", "doubled", "y"]


REFUSED = {
    "continuous": (
        lambda: Diagram(
            "loop", TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="lag")(Step(times=0.1, values=1.0))
        ),
        "lag",
    ),
    "no ticks": (lambda: Diagram("loop", Gain(gain=2.0, name="twice")(Step(times=0.1, values=1.0))), "loop"),
}


@pytest.mark.parametrize(
    "export",
    [
        lambda loop, controller, path: loop.to_c(path, subsystem="controller"),
        lambda loop, controller, path: to_c(controller, path),
        lambda loop, controller, path: build(loop, subsystem="controller"),
    ],
)
def test_a_block_that_cannot_leave_is_named_by_its_whole_path(export, tmp_path):
    @subsystem(sample_time=0.1)
    def controller(r):
        return PythonFunction(float, arguments=("u",), name="mdead")(r)

    loop = Diagram("loop", controller(Step(times=0.1, values=1.0)))
    with pytest.raises(DefinitionError, match=r"^controller\.mdead: Python evaluates it"):
        export(loop, controller, tmp_path)


@pytest.mark.parametrize("reason", [*REFUSED])
def test_what_cannot_be_on_a_target_is_named_before_anything_is_written(reason, tmp_path):
    make, path = REFUSED[reason]
    with pytest.raises(DefinitionError, match=rf"^{path}.*sample") as refused:
        make().to_c(tmp_path / "out")
    assert "sample_time=" in str(refused.value)
    assert not (tmp_path / "out").exists()


# --- with the loop of runs inside ---------------------------------------------------------------------------------------


def solved():
    """A sampled subsystem with an algebraic loop: y = u - y/2, so that y = 2/3 u."""
    error, half = Sum(signs="+-", name="error"), Gain(gain=0.5, name="half")

    @subsystem(sample_time=0.01)
    def controller(u):
        return error(u, half(error.y)).named("y")

    return Diagram("solved", controller(Sine(frequency=1.0, name="u")), loops="solve")


def between():
    """A sampled PI with its plant in continuous time, and a relay, whose events lie between ticks."""
    plant = TransferFunction(numerator=[1.0], denominator=[0.1, 1.0], name="plant")

    @subsystem(sample_time=0.01)
    def controller(wanted, level):
        return PID(kp=2.0, ki=8.0, lower=-3.0, upper=3.0, name="pid")(wanted, level).named("effort")

    on = Relay(on_point=0.5, off_point=0.3, name="relay")(plant.y).named("on")
    return Diagram("between", plant(controller(Step(times=0.1, values=1.0, name="wanted"), plant.y)).named("y"), on)


_COPIED = """#include "{name}.h"
#include <stdio.h>
int main(void) {{
    static {name} c, kept;
    {name}_init(&c);
    for (int k = 0; k < 60; k++) {{
        if (k == 20) kept = c;
        if (k == 30) {{ /* an instance elsewhere makes the ticks from 20 on again, and goes on */
            for (int j = 20; j < 30; j++) {name}_tick(&kept);
            c = kept;
            {name}_init(&kept);
        }}
        {sets}
        if ({name}_tick(&c) != {upper}_OK) return 1;
        double value;
        {gets}
        puts("");
    }}
    return 0;
}}
"""


@pytest.mark.slow
@pytest.mark.parametrize("make", [solved, between])
def test_with_the_loop_of_runs_it_has_the_bits_of_rk4(make, tmp_path):
    diagram = make()
    run = diagram.simulate(0.6, solver="rk4", step=0.01, progress=False)
    code = diagram.to_c(tmp_path)
    prefix = code.name.upper()
    gets = "".join(
        f'{code.name}_get(&c, {prefix}_OUTPUT_{name.upper().replace(".", "_")}, 0u, &value); printf("%.17g ", value);'
        for name in (one.variable.name for one in code._spec.outputs)
    )
    (tmp_path / "main.c").write_text(_COPIED.format(name=code.name, upper=prefix, sets="", gets=gets))
    warnings = ["-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
    command = ["gcc", "-std=c99", "-O1", *warnings, "-o", "main", f"{code.name}.c", "main.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    said = subprocess.run(["./main"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    found = np.array([line.split() for line in said.splitlines()], dtype=float)
    for i, name in enumerate(one.variable.name for one in code._spec.outputs):
        sampled = code._spec.outputs[i].sampled
        expected = run[name][:60] if sampled else run[name][1:]
        # Newton's method begins with the last solution, and the loop evaluates at the end of each period, too
        np.testing.assert_allclose(found[:, i], expected, rtol=0.0, atol=4e-16 if make is solved else 0.0)
        assert np.ptp(expected) > 0.1
    if make is solved:
        np.testing.assert_allclose(found[:, 0], 2 / 3 * run["u.y"][:60], rtol=0.0, atol=1e-12)
    assert f"{prefix}_BYTES {code.bytes_of['struct']}" in code.files[0].read_text(encoding="utf-8")
    with pytest.raises(OptionError, match="sampled diagrams alone"):
        code.measure()


@pytest.mark.parametrize(("make", "path"), [(solved, "controller.error.y"), (between, "plant")])
def test_single_precision_has_ticks_alone(make, path, tmp_path):
    with pytest.raises(DefinitionError, match=rf"^{path}: .*number='double'"):
        make().to_c(tmp_path / "out", number="float")
    assert not (tmp_path / "out").exists()


def test_options_that_do_not_fit_are_named(tmp_path):
    with pytest.raises(OptionError, match="expected a C identifier, such as 'my_pi'"):
        to_c(pi, tmp_path, name="my pi")
    with pytest.raises(OptionError, match="Leave them out"):
        to_c(pi, tmp_path, subsystem="pi")
    code = to_c(pi, tmp_path)
    with pytest.raises(OptionError, match="there is no input 'levle'. Did you mean 'level'"):
        code.measure({"levle": 1.0})
    code = to_c(pi, tmp_path)
    with pytest.raises(OptionError, match=r"ticks: found 0; expected a positive integer"):
        code.measure(ticks=0)
    with pytest.raises(OptionError, match="found 'fast' for the input 'reference'; expected numbers"):
        code.measure({"reference": "fast"})


def spec_of_function(function, name="ctl", **options):
    sub = subsystem(sample_time=0.1, name=name, **options)(function)
    return target_spec(open_subsystem(sub, Diagram, name), name=unit_name(name), description="")


def test_an_input_that_is_an_output_is_passed_on_at_each_tick():
    """With an offset, there are ticks of 0.05 s at which nothing else happens."""
    values = np.arange(1.0, 7.0)
    for options in ({}, {"offset": 0.05}):
        spec = spec_of_function(lambda u: (u.named("same"), (3.0 * u).named("triple")), **options)
        found = run_here(write_target(spec), {"u": values}, 6)
        np.testing.assert_array_equal(found["same"], values)
        held = values if not options else [3.0, 2.0, 2.0, 4.0, 4.0, 6.0]
        np.testing.assert_array_equal(found["triple"][1:], 3.0 * np.array(held[1:]))


def test_names_of_c_and_names_that_differ_in_case_alone_compile():
    """All of it in one source: a subsystem called choose, inputs NAN and EOF, outputs p and P."""

    def choose(NAN, EOF):
        chosen = Switch(name="is")(Compare(">", name="above")(NAN, 0.0), NAN, EOF)
        return (2.0 * chosen).named("p"), (3.0 * chosen).named("P"), np.sin(EOF).named("sin")

    text = write_target(spec_of_function(choose, "choose"))
    assert text.name == "choose_"
    found = run_here(text, {"NAN": 0.5, "EOF": 0.25}, 1)
    assert (found["p"][0], found["P"][0], found["sin"][0]) == (1.0, 1.5, np.sin(0.25))
    assert [unit_name(n) for n in ("exp", "expf", "uint8_t", "math", "table_0", "my name", "1")] == [
        "exp_",
        "expf_",
        "uint8_t_",
        "math_",
        "table_0_",
        "my_name",
        "n1",
    ]


def test_sources_of_time_are_exact_in_single_precision():
    """Noise is made of integers of 48 bits, and pulses have edges at ticks: a float of the time has neither."""

    def waves(u):
        noise = BandLimitedNoise(sample_time=0.3, variance=2.0, seed=5, name="noise").y.named("noisy")
        pulses = PulseTrain(amplitude=1.0, period=0.7, duty=3 / 7, delay=0.1, name="pulses")
        return noise, pulses.y.named("pulsed"), Sine(frequency=0.3, name="wave").y.named("wavy"), (u * 2.0).named("v")

    found = run_here(write_target(spec_of_function(waves), number="float"), {}, 400)
    k = np.arange(400)
    np.testing.assert_array_equal(found["pulsed"], (k >= 1) & ((k - 1) % 7 < 3))
    np.testing.assert_allclose(found["wavy"], np.sin(0.06 * np.pi * k), atol=2 * EPS)
    exact = BandLimitedNoise(sample_time=0.3, variance=2.0, seed=5, name="noise")
    run = Diagram("noise", exact.y.named("noisy")).simulate(40.0, step=0.1, progress=False)
    np.testing.assert_allclose(found["noisy"], run["noisy"][:400], rtol=EPS)


CLOCKS = {
    "slow, then fast": [(10, 0), (1, 0)],
    "fast, then slow": [(1, 0), (10, 0)],
    "ticks without any": [(2, 0), (3, 0)],
    "three": [(1, 0), (4, 0), (6, 1)],
    "offsets": [(4, 0), (4, 2), (6, 3)],
    "never at once": [(2, 0), (2, 1)],
    "one, and an offset": [(3, 2)],
    "one": [(1, 0)],
}
OUTSIDE = {"no source": ("clock", "pulses"), "one source": ("pulses",), "two sources": ()}
QUICK = (("slow, then fast", "one source"), ("ticks without any", "two sources"), ("three", "no source"))


@pytest.mark.drawn(2)
@pytest.mark.parametrize(
    ("rates", "inside"),
    [
        pytest.param(r, i, marks=() if (r, i) in QUICK else pytest.mark.slow)
        for r, i in itertools.product(CLOCKS, OUTSIDE)
    ],
)
def test_each_tick_runs_the_subsystems_that_are_due(rates, inside):
    """Sums of integers, against a loop of plain Python; sources in continuous time are in the C, or are its inputs."""
    clocks, count, first = CLOCKS[rates], 40, 1.0

    def chain(*sources):
        y = first
        for i, (every, offset) in enumerate(clocks):

            def add(before, u, i=i, dt=float(every)):
                total = DiscreteStateSpace(A=[[1.0]], B=[1.0], C=[1.0], D=1.0, dt=dt, name="sum")
                return total(before + u).named(f"y{i}")

            y = subsystem(sample_time=float(every), offset=float(offset), name=f"s{i}")(add)(y, sources[i % 2])
        return y

    now = Clock(name="clock").y.named("seconds")
    pulses = PulseTrain(amplitude=5.0, period=7.0, duty=3 / 7, delay=2.0, name="pulses").y.named("pulsed")
    diagram = Diagram("d", (3.0 * chain(now, pulses)).named("thrice"), now, pulses)
    opened = open_whole(diagram.wired, OUTSIDE[inside], "d")

    k = np.arange(count, dtype=float)
    u = k, 5.0 * ((k >= 2) & ((k - 2) % 7 < 3))
    sums, held, expected = [0.0] * len(clocks), [0.0] * len(clocks), np.zeros((count, len(clocks)))
    for tick in range(count):
        before = first
        for i, (every, offset) in enumerate(clocks):
            if tick >= offset and (tick - offset) % every == 0:
                sums[i] += before + u[i % 2][tick]
                held[i] = sums[i]
            before = held[i]
        expected[tick] = held

    text = write_target(target_spec(opened, name="d", description=""))
    found = run_here(text, {name: u[name == "pulses"] for name in OUTSIDE[inside]}, count)
    begin = max(offset for _, offset in clocks)  # before its first tick a subsystem holds what it has at the start
    for i in range(len(clocks)):
        np.testing.assert_array_equal(found[f"s{i}.y{i}"][begin:], expected[begin:, i])
    np.testing.assert_array_equal(found["thrice"][begin:], 3.0 * expected[begin:, -1])
    for name, values in zip(("seconds", "pulsed"), u, strict=True):
        if name in found or inside == "two sources":
            np.testing.assert_array_equal(found[name], values)
    for tick in text.ticks:  # the report names the subsystems whose sums are in it
        acting = {one for one in tick.subsystems if one.startswith("s")}
        assert {block.partition(".")[0] for block in tick.blocks if block.startswith("s")} == acting


def test_sets_of_clocks_that_act_together_after_a_million_ticks_are_refused():
    """Periods of 997, 1009 and 1013 ticks, prime to each other: all three meet once in a billion ticks."""

    def diagram(*periods):
        value = Clock(name="clock").y
        for i, period in enumerate(periods):
            one = subsystem(sample_time=period, offset=float(i), name=f"s{i}")(lambda u: 2.0 * u)
            value = one(value)
        return Diagram("d", value.named("last"))

    with pytest.raises(DefinitionError, match=r"^d: its sample times act together again only after more than a mill"):
        target_spec(open_whole(diagram(997.0, 1009.0, 1013.0).wired, (), "d"), name="d", description="")
    spec = target_spec(open_whole(diagram(97.0, 101.0).wired, (), "d"), name="d", description="")
    assert sorted(tick.acting for tick in spec.ticks) == [0, 1, 2, 3]


def test_a_bound_counts_each_instruction_and_each_call_once():
    assembly = """
\t.type\tinner,%function
inner:
\tadds\tr0, #1
\tbx\tlr
\t.size\tinner, .-inner
\t.type\touter,%function
outer:
\tpush\t{r4, lr}
\tbl\tinner
\tbne\t.LBB1_2
\tbl\tinner
.LBB1_2:
\tpop\t{r4, pc}
\t.size\touter, .-outer
\t.type\tlooping,%function
looping:
.LBB2_1:
\tsubs\tr0, #1
\tbne\t.LBB2_1
\tbx\tlr
\t.size\tlooping, .-looping
"""
    assert find_bound(assembly, "outer") == (5 + 2 * 2, "")
    assert find_bound(assembly, "looping") == (None, "looping has a loop")
    assert find_bound("\t.type\ta,%function\na:\n\tb\tsinf\n\t.size\ta, .-a\n", "a")[0] is None
