"""SSPs of other tools' making become diagrams: wires, units, transformations, parameters, systems within systems."""

import numpy as np
import pytest
from fmpy.ssp.simulation import simulate_ssp

from loopwright import Diagram
from loopwright.blocks import Step
from loopwright.diagrams import DoubleDriveError, OptionError, SspFileError, read_ssp
from support.ssp_files import (
    SPACES,
    adder,
    component,
    connection,
    description,
    inline,
    mapping_of,
    pack,
    set_of,
    system,
)

AS_IT_IS = ' suppressUnitConversion="true"'  # m goes to m/s as a number
LINEAR = '<ssc:LinearTransformation factor="{}" offset="{}"/>'
ENDS = ("input u Real m/s", "output y Real m")
UNITS = """<ssd:Units><ssc:Unit name="m"><ssc:BaseUnit m="1"/></ssc:Unit>
<ssc:Unit name="m/s"><ssc:BaseUnit m="1" s="-1"/></ssc:Unit>
<ssc:Unit name="mm"><ssc:BaseUnit m="1" factor="0.001"/></ssc:Unit>
<ssc:Unit name="degC"><ssc:BaseUnit K="1" offset="273.15"/></ssc:Unit>
<ssc:Unit name="K"><ssc:BaseUnit K="1"/></ssc:Unit>
<ssc:Unit name="mm/s"><ssc:BaseUnit m="1" s="-1" factor="0.001"/></ssc:Unit></ssd:Units>"""
H, N = 0.125, 16  # exact in binary


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    return adder(tmp_path_factory.mktemp("adder"))


@pytest.fixture
def write(tmp_path, fmu, cache):
    """write(root, **files) -> an SSP with the FMU and these files in it."""

    def make(root, more=UNITS, name="x.ssp", **files):
        files = {key.replace("__", "/").replace("_ss", ".ss"): text for key, text in files.items()}
        found = {"SystemStructure.ssd": description(root, more), "resources/adder.fmu": fmu, **files}
        return pack(tmp_path / name, found)

    return make


def run(file, **options):
    return Diagram.from_ssp(file, **options).simulate(H * N, step=H, progress=False)


def loop(*connections, **options):
    """Return two components whose outputs drive each other."""
    made = connections or (connection("a.y", "b.u", more=AS_IT_IS), connection("b.y", "a.u", more=AS_IT_IS))
    return system(
        "pair",
        component("a", "input u", "output y"),
        component("b", "input u", "output y"),
        connections=made,
        **options,
    )


def recurrence(of_a, of_b, b=(1.0, 1.0), k=(1.0, 1.0), start=(0.0, 0.0)):
    """Return the two outputs by hand: each adds h (k u + b), where its u is a function of the other's output."""
    y = np.zeros((N + 1, 2))
    y[0] = start
    for i in range(N):
        u = of_a(y[i, 1]), of_b(y[i, 0])
        y[i + 1] = y[i] + H * (np.array(k) * u + b)
    return y[:, 0], y[:, 1]


def assert_pair(found, expected, rtol=0.0):
    for name, values in zip(("a.y", "b.y"), expected, strict=True):
        np.testing.assert_allclose(found[name], values, rtol=rtol, atol=0.0)


def test_two_components_drive_each_other(write):
    """Two equal adders: y' = y + h (y + 1), so 1 + y grows by the factor 1 + h in every step."""
    found = run(write(loop()))
    expected = (1.0 + H) ** np.arange(N + 1) - 1.0
    assert_pair(found, (expected, expected), rtol=1e-14)


@pytest.mark.equal_bits
def test_the_same_file_has_the_same_bits_in_fmpy(write):
    """FMPy steps all components with the values of the step's beginning, too; its inputs begin with 0."""
    file = write(loop())
    theirs = simulate_ssp(file, stop_time=H * N, step_size=H)
    found = run(file)
    assert len(theirs) == N
    for name in ("a.y", "b.y"):
        assert np.array_equal(theirs[name], found[name][1:])


def test_a_linear_transformation_is_factor_times_value_plus_offset(write):
    file = write(
        loop(connection("a.y", "b.u", LINEAR.format(-0.5, 0.25), AS_IT_IS), connection("b.y", "a.u", more=AS_IT_IS))
    )
    assert_pair(run(file), recurrence(lambda y: y, lambda y: -0.5 * y + 0.25))


def test_units_of_connectors_are_converted_ahead_of_the_transformation(write):
    """The system's connector is in mm: the outputs of a are 1000 times as large there; its input is in mm/s."""
    inner = system(
        "inner",
        component("a", *ENDS),
        given=("input fed Real mm/s", "output far Real mm"),
        connections=(connection("fed", "a.u"), connection("a.y", "far")),
    )
    root = system(
        "root",
        inner,
        component("b", *ENDS),
        given=("output shown Real mm",),
        connections=(
            connection("inner.far", "b.u", LINEAR.format(2.0, 0.5), AS_IT_IS),
            connection("b.y", "inner.fed", LINEAR.format(3.0, 0.0), AS_IT_IS),
            connection("inner.far", "shown"),
        ),
    )
    found = run(write(root))
    expected = recurrence(lambda y: 0.001 * (3.0 * y), lambda y: 2.0 * (1000.0 * y) + 0.5)
    np.testing.assert_allclose(found["inner.a.y"], expected[0], rtol=1e-12)
    np.testing.assert_allclose(found["b.y"], expected[1], rtol=1e-12)
    np.testing.assert_allclose(found["shown"], 1000.0 * expected[0], rtol=1e-12)
    assert found["inner.far"].tolist() == found["shown"].tolist()


def test_a_connection_between_other_dimensions_is_an_error(write):
    root = system("root", component("a", *ENDS), component("b", *ENDS), connections=(connection("a.y", "b.u"),))
    with pytest.raises(SspFileError, match=r"a\.y → b\.u from m to m/s; expected units of one dimension"):
        Diagram.from_ssp(write(root))


def test_a_connector_in_another_unit_than_its_fmu_is_an_error(write):
    root = system("root", component("a", "output y Real mm"))
    with pytest.raises(SspFileError, match=r"a\.y: found a connector in mm, of another factor or offset than m"):
        Diagram.from_ssp(write(root))


def test_parameter_sets_of_outer_systems_take_precedence(write):
    """Four bindings set b of one component, two of them at the component: the outermost one counts, then the last."""
    sets = [inline(f"b=Real {n}") for n in (2, 3)]
    inner = system("inner", component("a", "output y", bindings="".join(sets)), bindings=inline("a.b=Real 4"))
    outer = system(
        "root",
        inner,
        component("b", "output y", bindings="".join(sets)),
        bindings=inline("inner.a.b=Real 5") + inline("inner.a.b=Real 6; nobody=Real 7"),
    )
    t = H * np.arange(N + 1)
    found = run(write(outer))
    np.testing.assert_array_equal(found["inner.a.y"], 6.0 * t)
    np.testing.assert_array_equal(found["b.y"], 3.0 * t)
    assert Diagram.from_ssp(write(inner))["a"].start["b"] == 4.0


def test_a_value_is_converted_mapped_and_transformed(write):
    """2000 mm/s are 2 m/s, and 3 · 2 + 1 = 7; other values of a mapped set have no effect."""
    mapping = f'<ssm:MappingEntry source="p.speed" target="a.b">{LINEAR.format(3, 1)}</ssm:MappingEntry>'
    mapping += '<ssm:MappingEntry source="p.k" target="a.k" suppressUnitConversion="true"/>'
    units = '<ssc:Unit name="mm/s"><ssc:BaseUnit m="1" s="-1" factor="0.001"/></ssc:Unit>'
    binding = inline("speed=Real 2000 mm/s; k=Real 0; a.k=Real 9", mapping, units, ' prefix="p."')
    root = system("root", component("a", "output y"), bindings=binding)
    diagram = Diagram.from_ssp(write(root))
    assert dict(diagram["a"].start) | {"u": 0, "s": 0} == {
        "b": 7.0,
        "k": 0.0,
        "u": 0,
        "s": 0,
        "mode": 1.0,
        "number": 0,
        "flag": 0,
    }


def test_what_has_no_effect_is_a_warning(write):
    """A mapping that reads what its set hasn't, and a unit without a definition, which isn't converted."""
    mapping = '<ssm:MappingEntry source="sped" target="a.b"/><ssm:MappingEntry source="k" target="a.k"/>'
    root = system("root", component("a", "output y"), bindings=inline("speed=Real 2; k=Real 3 furlong", mapping))
    words = r"SSP 'x\.ssp': the unit 'furlong' has no definition.*mapping of the root system reads 'sped'.*'a\.b' keeps"
    with pytest.warns(RuntimeWarning, match=words):
        diagram = Diagram.from_ssp(write(root))
    assert diagram["a"].start["k"] == 3.0


def test_sets_and_mappings_in_files_and_values_of_all_types(write):
    """A text, an item of an enumeration by its name, a Boolean, and an output's start value."""
    values = set_of("name=String four; how=Enumeration fast; on=Boolean true; y=Real 2", spaces=f" {SPACES}")
    entries = [("name", "text"), ("how", "mode"), ("on", "flag"), ("y", "y")]
    mapping = "".join(f'<ssm:MappingEntry source="{a}" target="{b}"/>' for a, b in entries)
    binding = (
        '<ssd:ParameterBinding source="resources/values.ssv"><ssd:ParameterMapping source="resources/names.ssm"/>'
        "</ssd:ParameterBinding>"
    )
    root = system("root", component("a", "output sum Integer", "output y", bindings=binding))
    file = write(root, resources__values_ssv=values, resources__names_ssm=mapping_of(mapping, f" {SPACES}"))
    found = run(file)
    assert found["a.sum"].tolist() == [4000 + 100 + 40] * (N + 1)  # four letters, on, item 4
    assert found["a.y"][0] == 2.0
    assert Diagram.from_ssp(file)["a"].start["text"] == "four"


def test_a_parameter_of_a_system_goes_to_its_components(write):
    inner = system(
        "inner",
        component("a", "parameter b Real m/s", "output y"),
        given=("parameter rate Real mm/s",),
        connections=(connection("rate", "a.b"),),
    )
    root = system("root", inner, bindings=inline("inner.rate=Real 500"))
    np.testing.assert_allclose(run(write(root))["inner.a.y"], 0.5 * H * np.arange(N + 1), rtol=1e-15)


def test_an_input_of_the_root_is_a_constant_that_another_source_replaces(write):
    root = system(
        "root",
        component("a", *ENDS),
        given=("input u Real mm/s",),
        connections=(connection("u", "a.u"),),
        bindings=inline("u=Real 500"),
    )
    file, t = write(root), H * np.arange(N + 1)
    np.testing.assert_allclose(run(file)["a.y"], 1.5 * t, rtol=1e-14)
    np.testing.assert_allclose(run(file, inputs={"u": 1000.0})["a.y"], 2.0 * t, rtol=1e-14)
    other = Diagram.from_ssp(file).replace(u=Step(values=1000.0, times=1.0, unit="mm/s"))
    found = other.simulate(H * N, step=H, progress=False)
    np.testing.assert_allclose(found["a.y"], t + np.maximum(t - 1.0, 0.0), rtol=1e-14)
    with pytest.raises(OptionError, match=r"no input 'v'. Did you mean|no input 'v'. Known: u"):
        Diagram.from_ssp(file, inputs={"v": 1.0})


def test_an_input_without_a_value_has_the_start_values_of_what_it_drives(write):
    def root(second):
        return system(
            "root",
            component("a", *ENDS),
            component("b", *ENDS, bindings=inline(f"u=Real {second}")),
            given=("input u",),
            connections=(connection("u", "a.u"), connection("u", "b.u")),
        )

    assert Diagram.from_ssp(write(root(0)))["u"].value == 0.0
    with pytest.raises(SspFileError, match=r"a\.u \(start value 0\) and b\.u \(3\); expected one value"):
        Diagram.from_ssp(write(root(3)))
    assert Diagram.from_ssp(write(root(3)), inputs={"u": 2.0})["u"].value == 2.0


def test_entries_of_arrays_are_wired_one_by_one_or_as_a_whole(write):
    names = [f"{kind} {name}[{i}]" for kind, name in (("input", "s"), ("output", "d")) for i in (1, 2)]
    three = [component(name, *names, "output y") for name in ("a", "b", "c")]
    bindings = inline("a.s[1]=Real 3;a.s[2]=Real 5;c.s[2]=Real 7")
    root = system(
        "root",
        *three,
        bindings=bindings,
        connections=(*(connection(f"a.d[{i}]", f"b.s[{i}]") for i in (1, 2)), connection("a.y", "c.s[1]")),
    )
    diagram = Diagram.from_ssp(write(root))
    assert str(diagram.wires["b", "s"]) == "a.d"
    found = diagram.simulate(H * N, step=H, progress=False)
    assert found["a.d"][-1].tolist() == [6.0, 10.0]
    assert found["b.d"][-1].tolist() == [12.0, 20.0]
    assert found["c.d"][-1].tolist() == [2.0 * H * (N - 1), 14.0]  # its input is held over the last step


def test_entries_of_an_array_in_another_order_are_no_whole(write):
    names = [f"{kind} {name}[{i}]" for kind, name in (("input", "s"), ("output", "d")) for i in (1, 2)]
    root = system(
        "root",
        component("a", *names, bindings=inline("s[1]=Real 3;s[2]=Real 5")),
        component("b", *names),
        connections=(connection("a.d[1]", "b.s[2]"), connection("a.d[2]", "b.s[1]")),
    )
    assert run(write(root))["b.d"][-1].tolist() == [20.0, 12.0]


def test_start_values_go_through_transformations_forwards_and_backwards(write):
    """A parameter of the system: 4 · 3 + 0.5. An input without a value: the start value 3 of what 2 u + 1 drives."""
    root = system(
        "root",
        component("a", "input u", "parameter b", "output y", bindings=inline("u=Real 3")),
        given=("input u", "parameter rate"),
        connections=(
            connection("rate", "a.b", LINEAR.format(4, 0.5)),
            connection("u", "a.u", LINEAR.format(2, 1)),
        ),
        bindings=inline("rate=Real 3"),
    )
    diagram = Diagram.from_ssp(write(root))
    assert diagram["a"].start["b"] == 12.5
    assert diagram["u"].value == 1.0
    assert diagram.simulate(H, step=H, progress=False)["a.y"][-1] == H * (3.0 + 12.5)


def test_whole_numbers_pass_through_a_table(write):
    """An integer of 100 becomes 3, then an item of an enumeration by its number; numbers without an entry stay."""
    table = (
        '<ssc:IntegerMappingTransformation><ssc:MapEntry source="10" target="3"/>'
        '<ssc:MapEntry source="99" target="0"/></ssc:IntegerMappingTransformation>'
    )
    root = system(
        "root",
        component("a", "output sum Integer"),
        component("b", "input number Integer", "output sum"),
        connections=(connection("a.sum", "b.number", table),),
    )
    found = run(write(root))
    assert found["a.sum"][-1] == 10
    assert found["b.sum"][-1] == 10 + 3
    wrong = table.replace('"99"', '"ten"')
    with pytest.raises(SspFileError, match="in a mapping of type integer"):
        Diagram.from_ssp(
            write(
                system(
                    "root",
                    component("a", "output sum"),
                    component("b", "input number"),
                    connections=(connection("a.sum", "b.number", wrong),),
                )
            )
        )


def test_signals_go_through_a_dictionary_from_one_system_to_another(write):
    """The entry is in mm, and in m at the reference in the inner system."""
    entries = '<ssb:DictionaryEntry name="s"><ssc:Real unit="mm"/></ssb:DictionaryEntry>'
    units = '<ssb:Units><ssc:Unit name="mm"><ssc:BaseUnit m="1" factor="0.001"/></ssc:Unit></ssb:Units>'
    text = f'<ssb:SignalDictionary version="1.0" {SPACES}>{entries}{units}</ssb:SignalDictionary>'
    reference = (
        '<ssd:SignalDictionaryReference name="bus" dictionary="signals"><ssd:Connectors>'
        '<ssd:Connector name="s" kind="inout"/></ssd:Connectors></ssd:SignalDictionaryReference>'
    )
    inner = system(
        "inner",
        component("b", "input u", "output y"),
        reference,
        connections=(connection("bus.s", "b.u", more=AS_IT_IS),),
    )
    root = system(
        "root",
        component("a", *ENDS),
        reference,
        inner,
        connections=(connection("bus.s", "a.y"),),
        more='<ssd:SignalDictionaries><ssd:SignalDictionary name="signals" source="resources/x.ssb"/>'
        "</ssd:SignalDictionaries>",
    )
    found = run(write(root, resources__x_ssb=text))
    a, b = recurrence(lambda y: 0.0, lambda y: 1000.0 * y)
    np.testing.assert_allclose(found["a.y"], a, rtol=1e-14)
    np.testing.assert_allclose(found["inner.b.y"], b, rtol=1e-12)


def test_local_variables_are_read_where_they_are_connected(write):
    root = system(
        "root",
        component("a", "local local", "output y"),
        component("b", "input u", "output y"),
        connections=(connection("a.local", "b.u", more=AS_IT_IS),),
    )
    found = run(write(root))
    t = H * np.arange(N + 1)
    local = np.concatenate([[0.0], 3.0 * t[:-1]])  # three times the output ahead of the step
    np.testing.assert_allclose(found["b.y"], np.concatenate([[0.0], np.cumsum(H * (local[:-1] + 1.0))]), rtol=1e-14)


def test_names_that_are_no_identifiers_get_others(write):
    root = system(
        "root of all",
        component("1st part", *ENDS),
        component("1st-part", *ENDS),
        given=("output out.y",),
        connections=(connection("1st part.y", "out.y"),),
    )
    # a connection's end is "element.connector" here: the dot in the name of the connector belongs to it
    root = root.replace('endElement="out" endConnector="y"', 'endConnector="out.y"')
    diagram = Diagram.from_ssp(write(root))
    assert sorted(diagram.blocks) == ["_1st_part", "_1st_part_2"]
    assert list(diagram.names) == ["out_y"]
    assert diagram.name == "root_of_all"


def test_systems_of_other_files_and_of_other_places_in_the_file(write, tmp_path, fmu):
    """One inner system, by an SSP in the SSP, by a description next to it, and by its place in this description."""
    inside = system(
        "inside",
        component("a", "output y"),
        given=("output y", "parameter b"),
        attributes=' id="here"',
        connections=(connection("a.y", "y"),),
        bindings=inline("a.b=Real 2"),
    )
    packed = write(inside, name="inner.ssp").read_bytes()
    kinds = ("source", "resources/inner.ssp"), ("other", "resources/inner.ssd"), ("own", "#here")
    parts = [
        component(name, "output y", source=source, bindings=inline("a.b=Real 3") if name == "own" else "")
        for name, source in kinds
    ]
    root = system("root", inside, *parts, given=("output y",), connections=(connection("own.y", "y"),))
    other = description(inside.replace("resources/adder.fmu", "adder.fmu"))
    file = write(root, resources__inner_ssp=packed, resources__inner_ssd=other)
    found, t = run(file), H * np.arange(N + 1)
    for name, slope in (("inside", 2.0), ("source", 2.0), ("other", 2.0), ("own", 3.0)):
        np.testing.assert_array_equal(found[f"{name}.y"], slope * t)
    np.testing.assert_array_equal(found["y"], 3.0 * t)


def test_a_system_within_itself_is_an_error(write):
    root = system("root", system("inner", component("again", source="#x"), attributes=' id="x"'))
    with pytest.raises(SspFileError, match="refers to itself"):
        Diagram.from_ssp(write(root))


def test_variants_are_chosen_by_file_or_by_name(write):
    other = description(system("root", component("c", "output y")), name="the other")
    file = write(loop(), VarB_ssd=other)
    assert "a" in Diagram.from_ssp(file).blocks
    for variant in ("VarB.ssd", "the other"):
        assert list(Diagram.from_ssp(file, variant).blocks) == ["c"]
    found = read_ssp(file)
    assert found.variants == ("SystemStructure.ssd", "VarB.ssd")
    with pytest.raises(SspFileError, match=r"no variant 'VarC.ssd'; expected one of .* Did you mean 'VarB.ssd'"):
        Diagram.from_ssp(file, "VarC.ssd")


def test_a_description_tells_what_is_in_the_file(write):
    more = (
        '<ssd:DefaultExperiment startTime="0" stopTime="2.5"><ssd:Annotations><ssc:Annotation '
        'type="com.opensimulationplatform"><osp:Algorithm xmlns:osp="http://opensimulationplatform.com/SSP/'
        'OSPAnnotations"><osp:FixedStepAlgorithm baseStepSize="0.01"/></osp:Algorithm></ssc:Annotation>'
        "</ssd:Annotations></ssd:DefaultExperiment>"
    )
    root = system(
        "root", component("a", *ENDS), given=("input u Real mm/s", "output y"), connections=(connection("u", "a.u"),)
    )
    found = read_ssp(write(root, UNITS + more))
    assert (found.stop, found.step, found.version, found.name) == (2.5, 0.01, "1.0", "test")
    assert dict(found.components) == {"a": "resources/adder.fmu"}
    assert (dict(found.inputs), dict(found.outputs)) == ({"u": "mm/s"}, {"y": None})
    assert "stop         2.5 s" in str(found)


@pytest.mark.parametrize(
    ("root", "match"),
    [
        (system("r", component("a", "output y"), connections=(connection("a.x", "a.y"),)), "no connector 'x'"),
        (system("r", component("a", "output y"), connections=(connection("c.x", "a.y"),)), "no element 'c'"),
        (system("r", component("a", "output y"), connections=(connection("x", "a.y"),)), "system has no connector 'x'"),
        (loop(connection("a.y", "b.y")), "of kinds output and output"),
        (system("r", component("a", "output z"), connections=()), "no component|$^"),
        (system("r", component("a", more=' type="text/x-modelica"')), "type 'text/x-modelica'"),
        (system("r", component("a").replace(' source="resources/adder.fmu"', "")), "without a source"),
        (system("r", component("a", source="http://x/y.fmu")), "scheme 'http:'"),
        (system("r", component("a", source="../y.fmu")), "points out of the package"),
        (system("r", component("a", source="resources/z.fmu")), "not there; .* Did you mean 'resources/adder.fmu'"),
        (system("r", component("a"), component("a")), "two elements 'a'"),
        (system("r", component("a", "output y", "output y")), "two connectors 'y'"),
        (system("r", component("a", more=' implementation="ScheduledExecution"')), "ScheduledExecution"),
        (system("r", component("a", "output y").replace("<ssc:Real/>", "<ssc:Real/><ssd:Clock/>")), "element 'Clock'"),
        (system("r", component("a", bindings=inline("k=Real one"))), "value 'one' of the parameter 'k'"),
        (system("r", component("a", bindings=inline("b=Real 1 K"))), "in K for a variable in m/s"),
        (
            system("r", component("a", "input u"), connections=(connection("a.u", "a.u", more=' startIndices="1"'),)),
            "startIndices='1'",
        ),
        (
            system(
                "r",
                component("a", "output sum"),
                component("b", "parameter b"),
                connections=(connection("a.sum", "b.b"),),
            ),
            "to a parameter",
        ),
        (
            system(
                "r",
                component("a", "parameter text String"),
                component("b", "input u"),
                connections=(connection("a.text", "b.u"),),
            ),
            "of kinds parameter and input",
        ),
    ],
)
def test_what_does_not_fit_is_named(write, root, match):
    if match.startswith("no component"):
        assert read_ssp(write(root))
        return
    with pytest.raises(SspFileError, match=match) as caught:
        Diagram.from_ssp(write(root))
    assert str(caught.value).endswith((".", "?"))


def test_two_connections_of_one_input_are_an_error(write):
    with pytest.raises(
        DoubleDriveError, match=r"b\.u: found two connections that drive it, a\.y → b\.u and b\.y → b\.u"
    ):
        Diagram.from_ssp(write(loop(connection("a.y", "b.u"), connection("b.y", "b.u"))))
