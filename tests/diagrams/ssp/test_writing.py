"""Diagrams of FMUs go out as SSPs by the standard's schemas, come in again with the same bits, and run in other tools."""

import zipfile

import numpy as np
import pytest
from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import ParameterSet, read_ssd, read_ssv, validate_tree
from lxml import etree

from loopwright import Coupling, Diagram, Fmu, LoopwrightError, subsystem
from loopwright.blocks import (
    Constant,
    DiscreteIntegrator,
    Gain,
    Product,
    PythonFunction,
    Ramp,
    Stack,
    UnitConversion,
)
from loopwright.diagrams import OptionError, SspFileError, experiments, read_ssp
from support.ecos import load_ecospy
from support.ssp_files import adder

H, N = 0.125, 16  # exact in binary
OTHERS = {"mode": 1, "number": 0, "flag": 0, "s": [0.0, 0.0]}
pytestmark = pytest.mark.equal_bits


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    return adder(tmp_path_factory.mktemp("adder"))


def run(diagram, **options):
    return diagram.simulate(H * N, step=H, progress=False, **options)


def assert_same(one, other, *names):
    """Assert that two runs have the same bits in some signals; by name, or a pair of names."""
    for name in names:
        a, b = (name, name) if isinstance(name, str) else name
        assert np.array_equal(one[a], other[b]), name


def check_schemas(file):
    """Hold all descriptions and parameter sets of an SSP against the standard's schemas, which FMPy has."""
    read_ssd(str(file))
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            if name.endswith(".ssv"):
                read_ssv(str(file), name)
            if name.endswith(".ssb"):
                validate_tree(etree.fromstring(archive.read(name)), "SystemStructureSignalDictionary.xsd")


def pair(fmu):
    """Return two adders in a loop with gains, an offset, a constant, and an array between them."""
    a = Fmu(fmu, name="a", start={**OTHERS, "mode": 2, "number": 3, "flag": 1, "text": "ab", "s": [1.5, 2.5]})
    b = Fmu(fmu, name="b", start={**OTHERS, "k": 0.3})
    reference = Constant(value=0.7, name="reference", unit="m/s")
    back = Gain(gain=-0.3)(b.y).named("back")
    return Diagram("pair", a(u=back + 0.125), b(u=reference, s=a.d).y.named("out"))


def test_a_diagram_goes_out_and_comes_in_with_the_same_bits(fmu, tmp_path, cache):
    diagram = pair(fmu)
    file = diagram.to_ssp(tmp_path / "pair.ssp", stop=2.0, step=H)
    check_schemas(file)
    assert (read_ssp(file).stop, read_ssp(file).step, read_ssp(file).version) == (2.0, H, "1.0")
    again = Diagram.from_ssp(file)
    assert_same(run(diagram), run(again), "a.y", "b.y", "b.d", "a.sum", "out", "back")
    assert again["a"].start["text"] == "ab"
    assert again["reference"].value == 0.7
    more = {"reference.value": -1.0}
    assert_same(run(diagram.replace(more)), run(again.replace(more)), "a.y", "b.y")
    assert diagram.to_ssp(tmp_path / "again.ssp", stop=2.0, step=H).read_bytes() == file.read_bytes()
    with zipfile.ZipFile(file) as archive:
        assert sum(name.endswith(".fmu") for name in archive.namelist()) == 1  # both components are of one file
        assert b"<osp:Algorithm>" in archive.read("SystemStructure.ssd")  # libcosim takes no declaration in it


def test_the_second_way_out_is_the_first(fmu, tmp_path, cache):
    """What was read is written with the same elements, connectors and connections."""
    first = pair(fmu).to_ssp(tmp_path / "first.ssp")
    second = Diagram.from_ssp(first).to_ssp(tmp_path / "second.ssp")
    texts = []
    for file in (first, second):
        root = etree.fromstring(zipfile.ZipFile(file).read("SystemStructure.ssd"))
        texts.append(sorted(tuple(e.items()) for e in root.iter("{*}Connection", "{*}Connector", "{*}Component")))
    assert texts[0] == texts[1]


def test_systems_within_systems_and_conversions_of_units(fmu, tmp_path, cache):
    """Two adders in a system without a rate, one of them a system deeper, and two around it."""

    @subsystem
    def deepest(fed):
        return Fmu(fmu, name="c", start=OTHERS)(u=fed * 2.0).y

    @subsystem
    def inner(fed, speed):
        return Fmu(fmu, name="a", start=OTHERS)(u=speed).y, deepest(fed)

    outer = Fmu(fmu, name="outer", start=OTHERS, convert_units=True)
    fast = UnitConversion(from_unit="mm/s", to_unit="m/s")(Constant(value=250.0, unit="mm/s", name="fast"))
    slow, deep = inner(Gain(gain=1.0)(outer.y), fast)
    twice = Gain(gain=np.array([[0.0, 2.0], [1.0, 0.0]]))(outer.d)
    root = Diagram(
        "nested",
        outer(u=Gain(gain=0.5)(slow), s=Stack(count=2)(Gain(gain=3.0)(deep), 0.25)),
        Fmu(fmu, name="last", start=OTHERS)(s=twice, u=0.0),
        deep.named("deep"),
    )
    file = root.to_ssp(tmp_path / "nested.ssp")
    check_schemas(file)
    again = Diagram.from_ssp(file)
    assert [s for s in again.subsystems if s] == ["inner", "inner.deepest"]
    assert_same(run(root), run(again), "inner.a.y", "inner.deepest.c.y", "outer.y", "outer.d", "last.d", "deep")
    flat = Diagram.from_ssp(root.to_ssp(tmp_path / "flat.ssp", flat=True))
    assert_same(run(root), run(flat), ("inner.a.y", "inner_a.y"), ("inner.deepest.c.y", "inner_deepest_c.y"), "outer.d")


def boxes(system):
    """Return the places of a system's elements, and its canvas."""
    numbers = [
        [float(e.get(key)) for key in ("x1", "y1", "x2", "y2")]
        for e in system.iterfind("{*}Elements/*/{*}ElementGeometry")
    ]
    canvas = system.find("{*}SystemGeometry")
    return numbers, [float(canvas.get(key)) for key in ("x1", "y1", "x2", "y2")]


def test_elements_have_places_that_do_not_overlap(fmu, tmp_path, cache):
    """Each element is in the canvas, none on another; inputs are on the left of an element, outputs on the right."""
    parts = [Fmu(fmu, name=name, start=OTHERS) for name in "abcd"]
    a, b, c, d = parts
    wires = Diagram("four", a(u=Gain(gain=1.0)(d.y)), b(s=a.d, u=0.0), c(s=b.d, u=0.0), d(s=a.d, u=Gain(gain=2.0)(c.y)))
    with zipfile.ZipFile(wires.to_ssp(tmp_path / "four.ssp")) as archive:
        root = etree.fromstring(archive.read("SystemStructure.ssd"))
    found, (left, low, right, high) = boxes(root.find("{*}System"))
    assert len(found) == 4
    for i, (x1, y1, x2, y2) in enumerate(found):
        assert left <= x1 < x2 <= right
        assert low <= y1 < y2 <= high
        assert not any(x1 < b[2] and b[0] < x2 and y1 < b[3] and b[1] < y2 for b in found[:i])
    for connector in root.iterfind(".//{*}Component/{*}Connectors/{*}Connector"):
        place = connector.find("{*}ConnectorGeometry")
        assert float(place.get("x")) == (connector.get("kind") == "output")
        assert 0.0 < float(place.get("y")) < 1.0


def test_fmpy_runs_a_flat_one_with_the_same_bits(fmu, tmp_path, cache):
    """FMPy takes neither transformations nor bindings: a chain without them, and its parameter sets by hand."""
    b, c = (Fmu(fmu, name=name, start={"k": k, "b": 0.1, **OTHERS}) for name, k in (("b", 0.3), ("c", 0.7)))
    diagram = Diagram("chain", b(u=Gain(gain=1.0)(c.y)), c(u=Gain(gain=1.0)(b.y)))
    file = diagram.to_ssp(tmp_path / "chain.ssp", flat=True)
    given = ParameterSet(name="all")
    for name in ("b", "c"):
        for parameter in read_ssv(str(file), f"resources/{name}.ssv").parameters:
            if parameter.type == "Real":
                parameter.name = f"{name}.{parameter.name}"
                given.parameters.append(parameter)
    theirs = simulate_ssp(str(file), stop_time=H * N, step_size=H, parameter_set=given)
    ours = run(diagram)
    for name in ("b.y", "c.y"):
        assert np.array_equal(theirs[name], ours[name][1:])


@pytest.mark.slow
def test_ecos_runs_a_flat_one_with_the_same_bits(fmu, tmp_path, cache):
    """Ecos takes transformations and parameter sets of components; Jacobi, too."""
    ecospy = load_ecospy()
    b, c = (Fmu(fmu, name=name, start={"k": k, "b": 0.1, **OTHERS, "mode": 1}) for name, k in (("b", 0.3), ("c", 0.7)))
    diagram = Diagram("chain", b(u=-0.25 * c.y + 0.5), c(u=Gain(gain=1.0)(b.y)))
    file = diagram.to_ssp(tmp_path / "chain.ssp", flat=True)
    ours = run(diagram)
    with ecospy.EcosSimulation(H, ssp_path=str(file)) as simulation:
        assert simulation.init(parameter_set="parameters"), ecospy.EcosLib.get_last_error()
        for i in range(1, N + 1):
            simulation.step()
            assert [simulation.get_real(f"{name}::y") for name in "bc"] == [ours["b.y"][i], ours["c.y"][i]]
        simulation.terminate()


@pytest.mark.slow
def test_ecos_runs_a_controller_and_its_plant_with_the_same_bits(fmu, tmp_path, cache):
    """Ecos steps all at once: so does the SSP, read again, by default."""
    ecospy = load_ecospy()
    file = controlled(fmu).to_ssp(tmp_path / "servo.ssp", flat=True, step=H)
    ours = run(Diagram.from_ssp(file))["plant.y"]
    with ecospy.EcosSimulation(H, ssp_path=str(file)) as simulation:
        assert simulation.init(parameter_set="parameters"), ecospy.EcosLib.get_last_error()
        for value in ours[1:]:
            simulation.step()
            assert simulation.get_real("plant::y") == value
        simulation.terminate()


def test_arrays_of_fmi_3_make_it_ssp_2(tmp_path, cache):
    """An array of FMI 3.0 is one connector with a dimension, and one value of a parameter set."""
    from loopwright.fmus import gantry

    file = gantry.build()
    a, b = (Fmu(file, name=name, start={"external_force": [0.5, -0.5]}) for name in "ab")
    diagram = Diagram(
        "two", a(motor_force=Constant(value=(1.0, 2.0), name="push", unit="N")), b(motor_force=a.velocity * 3.0)
    )
    written = diagram.to_ssp(tmp_path / "two.ssp")
    assert read_ssp(written).version == "2.0"
    again = Diagram.from_ssp(written)
    one, two = (d.simulate(0.1, step=0.01, progress=False) for d in (diagram, again))
    assert_same(one, two, "a.position", "b.velocity")


@subsystem(sample_time=H)
def controller(reference, y, d):
    """A PI controller of the sum of two outputs, with two outputs of its own, one of them a vector."""
    error = (reference - 0.5 * y).named("error")
    total = DiscreteIntegrator(name="total")(error)
    return (2.0 * error + 0.7 * total).named("command"), np.stack([error, 0.1 * d[1]]).named("both")


def controlled(fmu, **options):
    plant = Fmu(fmu, name="plant", start={**OTHERS, "b": 0.25})
    reference = Constant(value=0.7, name="reference")
    command, both = controller.replace(**options)(reference, plant.y, plant.d)
    return Diagram("servo", plant(u=command, s=both), both.named("both"))


@pytest.mark.slow
def test_a_sampled_controller_becomes_an_fmu_that_is_stepped_before_its_plant(fmu, tmp_path, cache):
    """The tick acts at the start of a step: a master that hands the new command on has the same bits as the diagram.

    One that steps all at once has the command a step later: it is the diagram with one sample of delay, as the plant's
    input is 0 over the first step in both.
    """
    diagram = controlled(fmu)
    file = diagram.to_ssp(tmp_path / "servo.ssp")
    check_schemas(file)
    assert dict(read_ssp(file).components) == {
        "controller": "resources/controller.fmu",
        "plant": f"resources/{fmu.name}",
    }
    again = Diagram.from_ssp(file)
    in_order = Coupling(scheme="gauss_seidel", order=tuple(read_ssp(file).components))  # the controller is first
    ours = diagram.simulate(H * N, progress=False)
    assert_same(ours, run(again, coupling=in_order), "plant.y", "plant.d", "plant.sum")
    late = run(again)["plant.y"]
    assert np.abs(late - ours["plant.y"]).max() > 0.01
    shifted = controlled(fmu, delay=1).simulate(H * N, progress=False)
    np.testing.assert_allclose(late, shifted["plant.y"], rtol=1e-13)


@pytest.mark.slow
def test_components_are_in_the_order_in_which_a_tool_steps_them(fmu, tmp_path, cache):
    """A sensor, then the controller that reads it, then the plant, then the reference, in continuous time.

    The reference is a product with the plant's output: stepped behind the plant it is that of the next instant.
    """
    sensor = subsystem(lambda level: Gain(gain=0.5)(level), sample_time=H, name="sensor")
    control = subsystem(lambda wish, seen: (wish - seen).named("command"), sample_time=H, name="control")
    plant = Fmu(fmu, name="plant", start={**OTHERS, "b": 0.25})
    wish = Product(name="wish")(Ramp(slope=0.4), plant.y)
    diagram = Diagram("loop", plant(u=control(wish, sensor(plant.y))))
    file = diagram.to_ssp(tmp_path / "loop.ssp")
    order = tuple(read_ssp(file).components)
    assert order == ("sensor", "control", "plant", "blocks")
    found = run(Diagram.from_ssp(file), coupling=Coupling(scheme="gauss_seidel", order=order))["plant.y"]
    y = np.zeros(N + 1)
    for i in range(N):
        y[i + 1] = y[i] + H * (0.4 * H * i * y[i] - 0.5 * y[i] + 0.25)
    np.testing.assert_allclose(found, y, rtol=1e-13)
    np.testing.assert_allclose(diagram.simulate(H * N, progress=False)["plant.y"], y, rtol=1e-13)


@pytest.mark.slow
def test_fig_3_goes_out_and_comes_back(tmp_path, cache):
    """Experiment C: sensors, controller, gantry and sources as four FMUs; sources add up their time differently."""
    diagram = experiments.EXPERIMENTS["C"]().diagram
    file = diagram.to_ssp(tmp_path / "fig3.ssp", step=1e-3)
    about = read_ssp(file)
    assert tuple(about.components) == ("sensors", "controller", "plant", "blocks")
    in_order = Coupling(scheme="gauss_seidel", order=tuple(about.components))
    ours = diagram.simulate(1.0, progress=False)
    found = Diagram.from_ssp(file).simulate(1.0, step=about.step, coupling=in_order, progress=False)
    np.testing.assert_allclose(found["plant.position"], ours["plant.position"], rtol=0.0, atol=1e-14)
    assert np.ptp(ours["plant.position"][:, 0]) > 0.01  # it moves


@pytest.mark.slow
def test_a_sampled_gain_is_no_transformation(fmu, tmp_path, cache):
    """It holds its output for two steps of the plant, so it becomes an FMU; y grows by h (k u + b) with u held.

    Its input and its output are both called y, and become two variables.
    """
    sampled = subsystem(lambda y: Gain(gain=-0.5, name="p")(y), sample_time=2 * H, name="controller")
    plant = Fmu(fmu, name="plant", start={**OTHERS, "b": 1.0})
    diagram = Diagram("d", plant(u=sampled(plant.y)))
    file = diagram.to_ssp(tmp_path / "d.ssp")
    assert sorted(read_ssp(file).components) == ["controller", "plant"]
    in_order = Coupling(scheme="gauss_seidel", order=("controller", "plant"))
    found = run(Diagram.from_ssp(file), coupling=in_order)
    y = np.zeros(N + 1)
    for i in range(N):
        u = -0.5 * y[i - i % 2]
        y[i + 1] = y[i] + H * (u + 1.0)
    np.testing.assert_array_equal(found["plant.y"], y)


@pytest.mark.slow
def test_blocks_between_fmus_become_one_component(fmu, tmp_path, cache):
    """A product of two FMUs' outputs is no transformation of one; it is stepped with them and takes one step more."""
    clock = subsystem(lambda: Constant(value=1.0)(), sample_time=H, name="clock")
    a, b = (Fmu(fmu, name=name, start={**OTHERS, "k": k}) for name, k in (("a", 0.5), ("b", 0.2)))
    mixed = Product(name="mixed")(a.y, b.y)
    diagram = Diagram("two", a(u=Gain(gain=-0.5)(mixed)), b(u=clock()), mixed.named("mixed"))
    file = diagram.to_ssp(tmp_path / "two.ssp")
    check_schemas(file)
    assert sorted(read_ssp(file).components) == ["a", "b", "blocks"]  # a constant of a clock is a value
    found = run(Diagram.from_ssp(file))
    y = np.zeros((N + 1, 2))
    for i in range(N):  # the product is one step old: the blocks have stepped with the values of the step before
        mixed = y[max(i - 1, 0)].prod() if i else 0.0
        y[i + 1] = y[i] + H * (np.array([0.5 * -0.5 * mixed, 0.2]) + 1.0)
    np.testing.assert_allclose(found["b.y"], y[:, 1], rtol=1e-13)
    np.testing.assert_allclose(found["a.y"], y[:, 0], rtol=1e-13)


def test_a_part_that_cant_be_exported_is_named(fmu, tmp_path, cache):
    """A Python function has no C."""
    own = PythonFunction(lambda u: 2.0 * u, name="own")
    stepped = subsystem(lambda y: own(y), sample_time=H, name="python")
    plant = Fmu(fmu, name="a", start=OTHERS)
    diagram = Diagram("d", plant(u=stepped(plant.y)))
    with pytest.raises(LoopwrightError, match="own"):
        diagram.to_ssp(tmp_path / "x.ssp")
    assert not (tmp_path / "x.ssp").exists()


def test_a_file_of_another_ending_is_refused(fmu, tmp_path, cache):
    diagram = pair(fmu)
    with pytest.raises(OptionError, match=r"name it x\.ssp"):
        diagram.to_ssp(tmp_path / "x.zip")
    with pytest.raises(OptionError, match="stop=0"):
        diagram.to_ssp(tmp_path / "x.ssp", stop=0)
    with pytest.raises(SspFileError, match="no FMU in it"):
        Diagram("d", Gain(gain=2.0)(1.0)).to_ssp(tmp_path / "x.ssp")
