"""Variables of all types on wires and as start values, and the choice of ports."""

import pickle

import fmpy
import numpy as np
import pytest

from loopwright.blocks import Block, Constant, Output, ParameterError, UnknownNameError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, FmuRuntimeError
from loopwright.types import StepsOnly
from support.typed_fmus import description2, description3, typed_fmu

EXTREMES = {
    "Float64": (-1e300, 0.1),
    "Float32": (-1.5, 0.1),
    "Int8": (-128, 127),
    "UInt8": (0, 200),
    "Int16": (-32768, 32767),
    "UInt16": (0, 65535),
    "Int32": (-(2**31), 2**31 - 1),
    "UInt32": (0, 2**32 - 1),
    "Int64": (-(2**53), 2**53),
    "UInt64": (0, 2**53),
    "Boolean": (0, 1),
    "Enumeration": (1, 3),
    "vector": (-7, 9),
    "Real": (-1e300, 0.1),
    "Integer": (-(2**31), 2**31 - 1),
}
WRONG = [
    ("u_Int8", 0.5, "found 0.5; expected an integer, as it is of type Int8"),
    ("u_Int8", 128.0, "found 128; expected -128 to 127, as it is of type Int8"),
    ("u_UInt16", -1.0, "found -1; expected 0 to 65535, as it is of type UInt16"),
    ("u_Int64", 2.0**53 + 2.0, r"found 9007199254740994; expected at most 2\*\*53 in size"),
    ("u_Boolean", 2.0, "found 2; expected 0 to 1, as it is of type Boolean"),
    ("u_Boolean", 0.5, "found 0.5; expected 0 or 1, as it is of type Boolean"),
    ("u_Enumeration", 2.0, r"found 2; expected one of its enumeration: 1 \(low\), 3 \(high\)"),
    ("u_Float32", 1e39, r"found 1e\+39; expected a number of type Float32"),
]


class Late(Block):
    """A value from 20 ms on, 1 before it."""

    value: float
    y = Output()

    def output(self, t, x, u):
        return np.where(t < 0.0195, 1.0, self.value)


@pytest.fixture(scope="module")
def folder(cache, tmp_path_factory):
    return tmp_path_factory.mktemp("typed")


@pytest.fixture(scope="module", params=[3, 2], ids=["fmi3", "fmi2"])
def fmi(request):
    return request.param


@pytest.fixture(scope="module")
def file(folder, fmi):
    return typed_fmu(folder, fmi)


@pytest.fixture(scope="module")
def file3(folder):
    return typed_fmu(folder, 3)


def rest(plant, **others):
    """Inputs that fit every port."""
    return {name: np.ones(p.shape) if p.shape else 1.0 for name, p in plant.inputs.items()} | others


# --- on wires -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", [0, 1], ids=["least", "most"])
def test_values_of_every_type_pass_through(file, end):
    plant = Fmu(file, name="plant")
    wired = list(plant.inputs)
    u = np.concatenate(
        [np.full(max(1, np.prod(plant.inputs[n].shape, dtype=int)), EXTREMES[n[2:]][end]) for n in wired]
    )
    y = np.zeros(sum(int(np.prod(p.shape)) for p in plant.outputs.values()))
    with plant.instantiate(wired, None) as one:
        one.bind(u, y)
        one.exchange()
        one.begin()
        one.step(0.0, 0.1)
        point = one.operating_point()
    want = u.copy()
    if "u_Float32" in wired:
        want[wired.index("u_Float32")] = np.float32(want[wired.index("u_Float32")])
    assert np.array_equal(y[: len(u)], want)
    assert point["inputs"]["u_vector"].tolist() == [EXTREMES["vector"][end]] * 3


@pytest.mark.slow
def test_fmpy_reads_the_same_values(folder, fmi):
    file = typed_fmu(folder, fmi, complete=True)
    start = {"u_Integer": -5, "u_Boolean": True} if fmi == 2 else {"u_Int8": -5, "u_UInt64": 7, "u_Boolean": True}
    names = ["y" + name[1:] for name in start]
    theirs = fmpy.simulate_fmu(str(file), stop_time=0.02, output_interval=0.01, start_values=start, output=names)
    whole = Fmu(file, name="plant")
    plant = whole.replace(
        start=start, ports=[*whole.inputs, *whole.outputs]
    )  # without texts and binaries, which it lacks
    run = Diagram("d", plant(**{n: v for n, v in rest(plant).items() if n not in start})).simulate(
        0.02, step=0.01, progress=False
    )
    for name in names:
        assert run[f"plant.{name}"].tolist() == [float(v) for v in theirs[name]]


@pytest.mark.parametrize(("port", "value", "text"), WRONG)
def test_an_input_refuses_what_is_no_value_of_its_type_with_port_and_time(file3, port, value, text):
    plant = Fmu(file3, name="plant")
    wired = Diagram("d", plant(**rest(plant, **{port: Late(value=value)})))
    with pytest.raises(FmuRuntimeError, match=rf"^plant\.{port}, t = 0\.02 s: {text}") as e:
        wired.simulate(0.05, step=0.01, progress=False)
    assert (e.value.block, e.value.port, e.value.t) == ("plant", port, 0.02)
    assert e.value.run["plant.y" + port[1:]].tolist() == [1.0, 1.0, 1.0]  # all that was right is kept


@pytest.mark.parametrize("isolate", [None, False], ids=["isolated", "in process"])
@pytest.mark.parametrize(
    ("ports", "port", "most", "value", "text"),
    [
        (["u_UInt8", "y_UInt8"], "u_UInt8", 200.0, 201.0, "found 201; expected at most 200"),
        (["u_Float64", "y_Float64"], "u_Float64", 5.0, 5.5, "found 5.5; expected 0 to 5"),
        (["u_Float64", "gain", "y_Float64"], "gain", 1e300, -1.0, "found -1; expected at least 0"),
    ],
)
def test_a_wire_refuses_what_is_out_of_the_stated_range(folder, ports, port, most, value, text, isolate):
    old = 'variability="continuous" start="0"/>'
    bounded = description3().replace(old, old.replace("start", 'min="0" max="5" start'), 1)
    plant = Fmu(typed_fmu(folder, 3, bounded), name="plant", ports=ports, isolate=isolate)
    Diagram("d", plant(**rest(plant, **{port: most}))).simulate(0.02, step=0.01, progress=False)
    wired = Diagram("d", plant(**rest(plant, **{port: Late(value=value)})))
    with pytest.raises(FmuRuntimeError, match=rf"^plant\.{port}, t = 0\.02 s: {text}\. Limit the signal"):
        wired.simulate(0.05, step=0.01, progress=False)


def test_an_integer_that_no_signal_holds_is_an_error_with_its_port(folder):
    huge = '<Int64 name="huge" valueReference="91" causality="output" variability="discrete"/>'
    text = description3(huge).replace(
        '<Output valueReference="90"/>', '<Output valueReference="90"/><Output valueReference="91"/>'
    )
    plant = Fmu(typed_fmu(folder, 3, text), name="plant")
    with pytest.raises(
        FmuRuntimeError, match=r"^plant\.huge, t = 0 s: found 9007199254740993; expected at most 2\*\*53"
    ):
        Diagram("d", plant(**rest(plant))).simulate(0.05, step=0.01, progress=False)
    chosen = plant.replace(ports=["u_Int8", "y_Int8"])
    assert Diagram("d", chosen(u_Int8=3.0)).simulate(0.02, step=0.01, progress=False)["plant.y_Int8"][-1] == 3.0


def test_arrays_of_integers_count_from_0_too(folder):
    plant = Fmu(typed_fmu(folder, 2), name="plant", start={f"u_vector[{i}]": 3 + i for i in range(3)})
    assert plant.start["u_vector"].tolist() == [3.0, 4.0, 5.0]
    one = Fmu(typed_fmu(folder, 2), name="plant", start={"u_vector[2]": 5})  # the others need a wire
    assert {name: float(v) for name, v in one.start.items()} == {"u_vector[2]": 5.0}
    assert repr(plant["y_vector[2]"]) == "<signal plant.y_vector[2]>"


@pytest.mark.parametrize("name", ["gain", "fixed"])
@pytest.mark.parametrize("isolate", [None, False], ids=["isolated", "in process"])
@pytest.mark.drawn(2)
def test_a_parameter_that_is_lost_when_initialization_ends_is_an_error(folder, name, isolate):
    place = {"gain": 30, "fixed": 31}[name]
    leave = "((instance *)p)->running = 1;"
    file = typed_fmu(folder, 3, change=(leave, f"{leave} ((instance *)p)->vFloat64[{place}] = 2.0;"))
    plant = Fmu(file, name="plant", start={name: 5.0, "u_Int8": 3}, isolate=isolate)
    text = rf"plant\.start\.{name}, t = 0 s: its start value was set to \[5\.0\], but is \[2\.0\] after its initial"
    with pytest.raises(FmuRuntimeError, match=text):
        Diagram("d", plant(**rest(plant))).simulate(0.02, step=0.01, progress=False)


# --- start values -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("u_Enumeration", "hig", r"found 'hig'; expected an item .*1 for 'low', 3 for 'high'\. Did you mean 'high'"),
        ("u_Boolean", "true", "found 'true'; expected True or False"),
        ("u_Float64", "1", "found '1'; expected a number, no text"),
        ("u_vector", ["1", "2", "3"], r"expected numbers of shape \(3,\), no text"),
    ],
)
def test_a_text_is_no_start_value_of_a_number(file3, name, value, text):
    with pytest.raises(ParameterError, match=rf"start\.{name}: .*{text}"):
        Fmu(file3, name="plant", start={name: value})


def test_start_values_of_every_type_arrive(file, fmi):
    whole = "u_Integer" if fmi == 2 else "u_Int32"
    start = {whole: -4, "u_Boolean": True, "u_Enumeration": "high", "u_vector": (1, 2, 3), "path": "a longer text"}
    plant = Fmu(file, name="plant", start=start)
    run = Diagram("d", plant(**{n: v for n, v in rest(plant).items() if n not in start})).simulate(
        0.01, step=0.01, progress=False
    )
    assert run["plant.y_Boolean"].tolist() == [1.0, 1.0]
    assert run["plant.y_Enumeration"].tolist() == [3.0, 3.0]
    assert run["plant.y" + whole[1:]].tolist() == [-4.0, -4.0]
    assert run["plant.y_vector"].tolist() == [[1.0, 2.0, 3.0]] * 2
    assert run["plant.length"].tolist() == [len("a longer text")] * 2


FORGETS = (
    "fmi2EnterInitializationMode() { return 0; }",
    "fmi2EnterInitializationMode(void *p) { ((instance *)p)->vReal[30] = 2.5; return 0; }",
)
IGNORES = ("if (!c->running) follow(c);", "c->vReal[30] = 2.5; if (!c->running) follow(c);")


def test_parameters_that_initialization_drops_are_set_in_it(folder):
    plant = Fmu(typed_fmu(folder, 2, change=FORGETS), name="plant", start={"gain": 7.0}, ports=["inner"])
    assert Diagram("d", plant()).simulate(0.01, step=0.01, progress=False)["plant.inner"].tolist() == [7.0, 7.0]


def test_a_start_value_that_the_fmu_does_not_keep_is_an_error(folder):
    plant = Fmu(typed_fmu(folder, 2, change=IGNORES), name="plant", start={"gain": 7.0}, ports=["inner"])
    with pytest.raises(
        FmuRuntimeError, match=r"^plant\.start\.gain.*: its start value was set to \[7\.0\], but is \[2\.5\]"
    ):
        Diagram("d", plant()).simulate(0.01, step=0.01, progress=False)


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("u_Int8", 0.5, "found 0.5; expected an integer, as it is of type Int8"),
        ("u_UInt8", 201, "found 201; the FMU allows at most 200"),
        ("u_Int64", 2**53 + 1, r"found 9007199254740993; expected at most 2\*\*53 in size"),
        ("u_UInt64", -1, "found -1; expected 0 to 18446744073709551615"),
        ("u_UInt8", 256, "found 256; expected 0 to 255, as it is of type UInt8"),
        ("u_Boolean", 3, "found 3; expected 0 to 1"),
        ("u_Enumeration", "middle", "found 'middle'; expected an item"),
        ("u_Enumeration", 2, "found 2; expected one of its enumeration"),
        ("path", 3, "found 3 for a variable of type String; expected a text"),
        ("blob", b"x", "found an output of type Binary, which the FMU computes"),
        ("tick", 1, "found 1 for a triggered clock, which ticks in a run alone"),
        ("gain", -1.0, r"found -1\.0; the FMU allows at least 0"),
    ],
)
def test_wrong_start_values_are_refused(file3, name, value, text):
    with pytest.raises(ParameterError, match=rf"^plant\.start\.{name}: {text}"):
        Fmu(file3, name="plant", start={name: value})


def test_names_are_looked_up_among_texts_too(file3):
    with pytest.raises(UnknownNameError, match="pathh.*path"):
        Fmu(file3, name="plant", start={"pathh": "x"})


@pytest.mark.drawn(1)
def test_ports_of_integers_have_no_derivatives(file):
    plant = Fmu(file, name="plant", isolate=False)
    real = next(iter(plant.inputs))
    point = {"inputs": rest(plant, **{real: 0.5})}
    model = plant.step_difference(0.01, **point)
    u, y = [*model.inputs].index(real), [*model.outputs].index("y" + real[1:])
    want = np.zeros(model.D.shape)
    want[y, u] = 1.0
    if "u_Float32" in plant.inputs:
        k = [*model.inputs].index("u_Float32")
        want[[*model.outputs].index("y_Float32"), k] = model.D[[*model.outputs].index("y_Float32"), k]
    assert np.abs(model.D - want).max() < 1e-9


@pytest.mark.slow
def test_a_diagram_says_which_inputs_of_integers_are_left_out_of_its_model(file):
    plant = Fmu(file, name="plant", isolate=False)
    real = next(iter(plant.inputs))
    whole = "u_Integer" if "u_Integer" in plant.inputs else "u_Int32"
    held = {n: v for n, v in rest(plant).items() if n not in (real, whole)}
    plant = plant.replace(start=held)
    wired = plant(**{real: 0.5 * plant["y" + real[1:]], whole: Constant(value=2.0).y})
    found = Diagram("d", wired).linearize(step=0.01).findings
    assert {f.source for f in found if isinstance(f, StepsOnly) and f.port == "y" + real[1:]} == {whole}


# --- ports --------------------------------------------------------------------------------------------------------------


def test_a_tunable_parameter_changes_in_a_run_and_a_local_variable_is_read(file):
    plant = Fmu(file, name="plant", ports=["gain", "inner", "y_vector"])
    assert [*plant.inputs] == ["gain"]
    assert [*plant.outputs] == ["y_vector", "inner"]
    run = Diagram("d", plant(gain=Late(value=4.0))).simulate(0.05, step=0.01, progress=False)
    assert run["plant.inner"].tolist() == [1.0, 1.0, 1.0, 4.0, 4.0, 4.0]  # set at 20 ms, seen a step later
    assert Diagram("d", plant()).simulate(0.01, step=0.01, progress=False)["plant.inner"][-1] == 2.5


@pytest.mark.parametrize(
    ("ports", "error", "text"),
    [
        (["fixed"], ParameterError, "found 'fixed', a fixed parameter; expected an input, an output, a local"),
        (
            ["path"],
            ParameterError,
            "found 'path', a parameter of type String, which no wire carries; expected a number",
        ),
        (["y_Int88"], UnknownNameError, r"the FMU has no variable 'y_Int88'.*y_Int8"),
        ("y_Int8", ParameterError, "found 'y_Int8'; expected a list of names"),
    ],
)
def test_wrong_ports_are_refused(file3, ports, error, text):
    with pytest.raises(error, match=rf"^plant\.ports: {text}"):
        Fmu(file3, name="plant", ports=ports)


def test_a_block_with_chosen_ports_is_a_value(file3):
    plant = Fmu(file3, name="plant", ports=["u_Int8", "y_Int8"], rename={"u_Int8": "u"}, start={"path": "x"})
    assert pickle.loads(pickle.dumps(plant)) == plant == plant.replace()
    assert plant != plant.replace(ports=None)
    assert [*plant.inputs] == ["u"]
    with pytest.raises(ParameterError, match=r"^plant\.rename: found {'u_Int8': 3}; expected two names"):
        plant.replace(rename={"u_Int8": 3})


def test_variables_that_no_wire_carries_are_said(file3):
    plant = Fmu(file3, name="plant")
    assert dict(plant.left_out) == {"path": "String", "blob": "Binary", "tick": "Clock"}
    assert "without ports for path (String), blob (Binary), tick (triggered Clock)" in repr(plant)
    run = Diagram("d", plant(**rest(plant))).simulate(0.01, step=0.01, progress=False)
    assert run.messages == (
        "plant: the clocks tick (triggered Clock) never tick: the FMU has no Event Mode (hasEventMode)",
        "plant: blob (Binary) is not recorded: the library has no fmi3GetBinary",
    )


def test_a_description_that_breaks_a_rule_runs_and_is_told(folder):
    text = description2().replace("<InitialUnknowns>", "<InitialUnknowns dependencies=''>")
    plant = Fmu(typed_fmu(folder, 2, text), name="plant")
    (message,) = Diagram("d", plant(**rest(plant))).simulate(0.01, step=0.01, progress=False).messages
    assert message.startswith("plant: its description breaks the standard: ")
    twice = description2().replace('name="fixed"', 'name="gain"')
    with pytest.raises(Exception, match="has two variables 'gain'"):
        Fmu(typed_fmu(folder, 2, twice))
