"""Reading of FMU files: types that are not read are said, and files that can't be read are errors of ours."""

import random
import re
import struct
import zipfile

import pytest
from fmpy.model_description import BaseUnit
from fmpy.model_description import Unit as UnitDefinition

from loopwright.blocks import Constant, LoopwrightError, ParameterError, UnknownNameError, parse_unit
from loopwright.diagrams import Diagram
from loopwright.diagrams.cli import main
from loopwright.fmus import Fmu, FmuFileError
from loopwright.fmus.archive.unit_definitions import FmuUnits
from loopwright.fmus.models import mass_spring_damper
from loopwright.fmus.platform import native_platform
from support.small_fmus import small_fmu
from support.typed_fmus import description2, description3

COUNT = b'<Binary name="count" valueReference="9001" causality="output" variability="discrete"/>'
MODE = (
    b'<String name="mode" valueReference="9002" causality="input" variability="discrete"><Start value="off"/></String>'
)


@pytest.fixture(scope="module")
def file(cache):
    return mass_spring_damper.build()


def changed(file, path, *changes, entries=()):
    """Return a copy of an FMU with texts of its description replaced."""
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                for before, after in changes:
                    assert before in data, before
                    data = data.replace(before, after)
            new.writestr(item, data)
    return path


# --- types --------------------------------------------------------------------------------------------------------------


def test_ports_that_no_wire_carries_are_said_in_the_runs_messages(file, tmp_path):
    more = changed(file, tmp_path / "more.fmu", (b"</ModelVariables>", MODE + b"</ModelVariables>"))
    plant = Fmu(more, name="plant", start={"force": 1.0})
    run = Diagram("d", plant()).simulate(0.01, step=1e-3, progress=False)
    _, message = run.messages  # the first says that the force keeps its start value
    assert message == (
        "plant: no wire carries texts, binaries and clocks: the inputs mode (String) keep their start values"
    )
    plain = Diagram("d", Fmu(file, name="plant", start={"force": 1.0})()).simulate(0.01, step=1e-3, progress=False)
    assert len(plain.messages) == 1


def test_using_such_a_port_says_its_type(file, tmp_path):
    plant = Fmu(
        changed(file, tmp_path / "more.fmu", (b"</ModelVariables>", COUNT + MODE + b"</ModelVariables>")), name="plant"
    )
    with pytest.raises(AttributeError, match=r"plant: its output 'count' is of type Binary; expected numbers"):
        _ = plant.count
    with pytest.raises(UnknownNameError, match=r"plant: its output 'count' is of type Binary; expected numbers"):
        _ = plant["count"]
    with pytest.raises(UnknownNameError, match=r"plant: its input 'mode' is of type String; expected numbers"):
        plant(mode=Constant(value=1.0))
    with pytest.raises(
        ParameterError, match=r"plant\.start\.mode: found 1 for a variable of type String; expected a text"
    ):
        Fmu(plant.file, name="plant", start={"mode": 1})


def test_an_fmu_whose_outputs_are_all_of_other_types_is_refused(file, tmp_path):
    none = changed(
        file,
        tmp_path / "none.fmu",
        (b'causality="output"', b'causality="local"'),
        (b"</ModelVariables>", COUNT + b"</ModelVariables>"),
    )
    with pytest.raises(
        FmuFileError, match=r"^plant: found only outputs that no wire carries: count \(Binary\); expected"
    ):
        Fmu(none, name="plant")


# --- units --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "base", "expected", "complaints"),
    [
        ("N", 'kg="1" m="1" s="-2"', "N", 0),
        ("rad/s", 's="-1"', "rad/s", 0),  # the radian is left out by some tools
        ("deg", 'rad="1" factor="0.0174533"', "deg", 0),
        ("degC", 'K="1" offset="273.15"', "degC", 0),
        ("newton", 'kg="1" m="1" s="-2"', "kg.m.s-2", 0),
        ("count", "", "1", 0),
        ("m", 's="1" factor="60"', "m", 1),  # minutes
        ("h", 'kg="1" m="2" s="-1"', "kg.m2.s-1", 1),  # Planck's
        ("inch", 'm="1" factor="0.0254"', "inch", 0),
    ],
)
def test_a_unit_is_read_as_the_fmu_defines_it(name, base, expected, complaints):
    unit = BaseUnit(
        **{
            k: float(v) if "." in v or k in ("factor", "offset") else int(v)
            for k, v in re.findall(r'(\w+)="([^"]+)"', base)
        }
    )
    units = FmuUnits({name: UnitDefinition(name=name, baseUnit=unit)})
    found = units.find(name)
    assert found == expected
    if 'factor="60"' in base or name == "inch":
        assert (parse_unit(found).factor, parse_unit(found).exponents[1:3]) == (unit.factor, (unit.m, unit.s))
    assert len(units.complaints) == complaints
    assert units.find(None) is None


# --- mutations ----------------------------------------------------------------------------------------------------------


def mutate(text, rng):
    """Change a description at one to three places: attributes, elements, characters."""
    words = ["", "-1", "0", "9" * 20, "nan", "inf", "abc", "true", "1 2 3", "[1]", "x[0]", "&lt;", "2.5"]
    for _ in range(rng.randint(1, 3)):
        at = rng.choice(list(re.finditer(r'(\w+)="([^"]*)"', text)))
        element = rng.choice(list(re.finditer(r"<(\w+)[^<>]*/>", text)))
        kind, i = rng.randrange(5), rng.randrange(len(text))
        text = [
            text[: at.start()] + text[at.end() :],
            text[: at.start(2)] + rng.choice(words) + text[at.end(2) :],
            text[: element.start()] + text[element.end() :],
            text[: element.end()] + element[0] + text[element.end() :],
            text[:i] + rng.choice('<>"&x0 ') + text[i + 1 :],
        ][kind]
    return text


@pytest.mark.parametrize("count", [100, pytest.param(10000, marks=pytest.mark.slow)])
def test_mutated_descriptions_are_read_or_refused_by_errors_of_ours(tmp_path, count):
    rng, found = random.Random(7), {True: 0, False: 0}
    for k in range(count):
        text = mutate(rng.choice([description2(), description3()]), rng)
        path = tmp_path / f"{k}.fmu"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", text)
            for folder in dict.fromkeys(("linux64", "x86_64-linux", native_platform())):
                archive.writestr(f"binaries/{folder}/typed{k}.so", b"")
        try:
            plant = Fmu(path, name="plant")
            assert repr(plant)
            assert len(plant.inputs) + len(plant.outputs) >= 0
            found[True] += 1
        except LoopwrightError:
            found[False] += 1
        path.unlink()
    assert min(found.values()) > count // 10


# --- versions -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [b"3.9", b"3.0-beta.5", b"31.0", b"9.9"])
def test_another_version_in_the_description_is_refused(file, tmp_path, version):
    other = changed(file, tmp_path / "other.fmu", (b'fmiVersion="3.0"', b'fmiVersion="' + version + b'"'))
    with pytest.raises(FmuFileError, match=r"FMI|can't be read"):
        Fmu(other)


def test_a_patch_of_fmi_3_0_is_read(file, tmp_path):
    patched = Fmu(changed(file, tmp_path / "patch.fmu", (b'fmiVersion="3.0"', b'fmiVersion="3.0.2"')))
    assert list(patched.outputs) == list(Fmu(file).outputs)


def test_a_library_of_another_version_is_refused(file, monkeypatch):
    monkeypatch.setattr("loopwright.fmus.calls.fmi3.Fmi3Calls.version", lambda self: "9.9")
    plant = Fmu(file, name="plant", start={"force": 1.0})
    with pytest.raises(
        FmuFileError, match=r"^plant.*: the library of .* says that it is of FMI '9\.9' .*expected '3\.0'"
    ):
        Diagram("d", plant()).simulate(0.01, step=1e-3, progress=False)


# --- files that can't be read -------------------------------------------------------------------------------------------


def encrypted(path):
    """Set the flag of an encrypted file in both headers."""
    data = bytearray(path.read_bytes())
    for magic, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.index(magic) + offset
        struct.pack_into("<H", data, at, struct.unpack_from("<H", data, at)[0] | 1)
    path.write_bytes(data)


def damaged(path):
    """Damage the compressed text itself."""
    data = bytearray(path.read_bytes())
    at = 30 + len("modelDescription.xml")
    data[at : at + 40] = b"\xff" * 40
    path.write_bytes(data)


def of_unknown_compression(path):
    data = bytearray(path.read_bytes())
    for magic, offset in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        struct.pack_into("<H", data, data.index(magic) + offset, 99)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("break_it", "text"),
    [(encrypted, "encrypted"), (damaged, "damaged zip archive"), (of_unknown_compression, "compression method 99")],
)
def test_archives_that_cannot_be_read(tmp_path, capsys, break_it, text):
    path = tmp_path / "broken.fmu"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", "<fmiModelDescription" + 1000 * " abc")
    break_it(path)
    with pytest.raises(FmuFileError, match=text):
        Fmu(path)
    for command in ("inspect", "validate"):
        assert main([command, str(path)]) == 1
        assert "Traceback" not in "".join(capsys.readouterr())


def test_a_description_that_does_not_fit_into_memory(tmp_path, monkeypatch, capsys):
    path = tmp_path / "large.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", "<a/>")

    def open_(self, name):
        raise MemoryError

    monkeypatch.setattr(zipfile.ZipFile, "open", open_)
    with pytest.raises(FmuFileError, match="does not fit into memory"):
        Fmu(path)
    assert main(["inspect", str(path)]) == 1
    assert "does not fit into memory" in capsys.readouterr().err


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    path = tmp_path / "secret.fmu"
    path.write_bytes(b"PK")

    def read_bytes(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "read_bytes", read_bytes)
    with pytest.raises(FmuFileError, match=r"can't be read: there is no permission to use "):
        Fmu(path)


@pytest.mark.parametrize("index", [0, -1])
@pytest.mark.parametrize("place", ["index", "dependencies"])
def test_an_index_below_one_in_the_model_structure_is_told_and_not_taken_from_the_end(tmp_path, cache, index, place):
    """Taken for the last variable, the parameter ``last``, the output would have no feedthrough from u."""
    unknown = f'<Unknown index="2" dependencies="{index}"/>'
    if place == "index":
        unknown = f'<Unknown index="2" dependencies="1"/><Unknown index="{index}" dependencies="1"/>'
    model = f"""<CoSimulation modelIdentifier="small"/><ModelVariables>
<ScalarVariable name="u" valueReference="1" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="last" valueReference="3" causality="parameter" variability="fixed"><Real start="0"/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs>{unknown}</Outputs></ModelStructure>"""
    path = small_fmu(tmp_path, "fmi2", "typedef struct { double t; } instance;", model)
    about = Fmu(path).description
    assert any(str(index) in complaint and "exist" in complaint for complaint in about.complaints), about.complaints
    known = about.dependencies["Float64", 2]
    assert known is None or known == {("Float64", 1)}
    assert ("Float64", 3) not in about.dependencies
