"""An FMU in the place of another one in a diagram: port by port, what doesn't fit, and a rename that may help."""

import re
import zipfile

import numpy as np
import pytest

from loopwright.blocks import Gain, ShapeError, UnitError, UnknownNameError, UnwiredInputError, WiringError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, gantry
from support.typed_fmus import description3, typed_fmu


@pytest.fixture(scope="module")
def file(cache):
    return gantry.build(fmi=2)


@pytest.fixture(scope="module")
def diagram(cache):
    """A gantry that holds its position, built with FMI 3.0."""
    plant = Fmu(gantry.build(), name="plant")
    return Diagram("d", plant(motor_force=Gain(name="spring", gain=-2e3)(plant.position), external_force=(0.0, 43.0)))


def edited(file, folder, *changes):
    path = folder / f"edited{len(list(folder.iterdir()))}.fmu"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                text = data.decode()
                for pattern, replacement in changes:
                    assert re.search(pattern, text), pattern
                    text = re.sub(pattern, replacement, text)
                data = text.encode()
            new.writestr(item, data)
    return path


def test_the_other_version_fits_and_gives_the_same_run(diagram, file):
    two = diagram.replace(plant=Fmu(file)).simulate(0.1, step=1e-3, progress=False)
    three = diagram.simulate(0.1, step=1e-3, progress=False)
    assert np.abs(two["plant.position"] - three["plant.position"]).max() < 1e-12


def test_other_names_are_said_with_the_rename_that_helps(diagram, file, tmp_path):
    other = edited(file, tmp_path, (r'"motor_force\[', '"F_motor['), (r'"position\[', '"pos['))
    with pytest.raises(UnknownNameError) as e:
        diagram.replace(plant=Fmu(other, name="p"))
    text = str(e.value)
    assert text.startswith(f"plant: FMU {other.name} does not fit the wires of FMU gantry.fmu:\n")
    for line in (
        "input motor_force [2] in N is missing",
        "input F_motor [2] in N is extra, and nothing is wired to it",
        "output position [2] in m is missing",
        "output pos [2] in m is extra",
    ):
        assert f"- {line}\n" in text
    rename = {"F_motor": "motor_force", "pos": "position"}
    assert text.endswith(f"Perhaps only names differ: Fmu({str(other)!r}, rename={rename!r}).")
    run = diagram.replace(plant=Fmu(other, rename=rename)).simulate(0.05, step=1e-3, progress=False)
    assert np.isfinite(run["plant.position"]).all()


def test_a_rename_that_does_not_help_is_not_suggested(diagram, file, tmp_path):
    changes = (r'"motor_force\[', '"F_motor['), (r'"velocity\[', '"motor_force[')
    with pytest.raises(WiringError, match="Wire what is extra") as e:
        diagram.replace(plant=Fmu(edited(file, tmp_path, *changes)))  # an output has the name of the missing input
    assert "rename=" not in str(e.value)
    changes = (r'"motor_force\[', '"F_motor['), (r'(?s)(name="position\[.\]".{0,300}?unit=)"m"', r'\1"mm"')
    with pytest.raises(WiringError, match="found the unit mm") as e:
        diagram.replace(plant=Fmu(edited(file, tmp_path, *changes)))
    assert "Perhaps only names differ" not in str(e.value)


def test_ports_that_could_be_each_other_are_offered_in_their_order_as_a_guess(diagram, file, tmp_path):
    """Without units and likeness, each of two inputs may be either."""
    changes = (
        (r'"motor_force\[', '"in1['),
        (r'"external_force\[', '"in2['),
        (r'unit="N"', ""),
        (r'"position\[', '"pos['),
    )
    other = edited(file, tmp_path, *changes)
    with pytest.raises(WiringError) as e:
        diagram.replace(plant=Fmu(other))
    rename = {"in1": "motor_force", "in2": "external_force", "pos": "position"}
    assert f"If only names differ, say which is which: Fmu({str(other)!r}, rename={rename!r})" in str(e.value)
    assert "a guess by order" in str(e.value)
    diagram.replace(plant=Fmu(other, rename=rename))


def test_another_unit_is_said_with_its_factor(diagram, file, tmp_path):
    other = edited(file, tmp_path, (r'(?s)(name="position\[.\]".{0,300}?unit=)"m"', r'\1"mm"'))
    with pytest.raises(
        UnitError, match=r"- output position: found the unit mm; expected m: .*by a factor of 0\.001"
    ) as e:
        diagram.replace(plant=Fmu(other))
    assert ", or give the FMU convert_units=True\n" in str(e.value)
    assert "Wire what is extra" not in str(e.value)
    diagram.replace(plant=Fmu(other, convert_units=True))


def test_another_shape_is_said(diagram, file, tmp_path):
    other = edited(file, tmp_path, (r'"external_force\[2\]"', '"third_force"'))
    with pytest.raises(WiringError) as e:
        diagram.replace(plant=Fmu(other))
    assert "- input external_force: found shape (1,); expected (2,)" in str(e.value)
    assert "- input third_force in N is extra, and nothing is wired to it" in str(e.value)
    with pytest.raises(ShapeError, match=r"^plant: .*\n- input external_force: found shape \(1,\); expected \(2,\)"):
        diagram.replace(plant=Fmu(other, start={"third_force": 0.0}))


def test_an_extra_input_needs_a_value(diagram, file, tmp_path):
    other = edited(
        file,
        tmp_path,
        (
            r'(name="friction_width".*?)causality="parameter" variability="\w+"(?: initial="exact")?',
            r'\1causality="input" variability="continuous"',
        ),
    )
    with pytest.raises(UnwiredInputError, match=r"- input friction_width.* is extra, and nothing is wired to it"):
        diagram.replace(plant=Fmu(other))
    diagram.replace(plant=Fmu(other, start={"friction_width": 0.01}))


def test_another_type_of_an_input_is_said(cache, tmp_path):
    real = typed_fmu(tmp_path, 3)
    text = description3().replace('<Int8 name="u_Int8"', '<Int8 name="u"').replace('"u_Float64"', '"u_Int8"')
    plant = Fmu(real, name="plant", ports=["u_Float64", "y_Float64"])
    wired = Diagram("d", plant(u_Float64=0.5))
    other = Fmu(typed_fmu(tmp_path, 3, text), rename={"u": "u_Float64"}, ports=["u", "y_Float64"])
    with pytest.raises(WiringError, match=r"- input u_Float64: found the type Int8; expected Float64, whose values"):
        wired.replace(plant=other)


def test_ports_that_nothing_uses_may_be_missing(diagram, file):
    few = Fmu(file, ports=["motor_force", "external_force", "position"])
    found, expected = (d.simulate(0.01, step=1e-3, progress=False) for d in (diagram.replace(plant=few), diagram))
    assert np.array_equal(found["plant.position"], expected["plant.position"])
    assert "plant.velocity" in expected.names
    assert "plant.velocity" not in found.names


def test_an_fmu_whose_file_has_gone_can_be_replaced(file, tmp_path):
    gone = edited(file, tmp_path)
    old = Fmu(gone, name="plant", start={"motor_force": 0.0, "external_force": 0.0})
    wired = Diagram("d", old())
    gone.unlink()
    run = wired.replace(plant=Fmu(file, start=old.start)).simulate(0.01, step=1e-3, progress=False)
    expected = Diagram("d", Fmu(file, name="plant", start=old.start)()).simulate(0.01, step=1e-3, progress=False)
    assert np.array_equal(run["plant.position"], expected["plant.position"])
