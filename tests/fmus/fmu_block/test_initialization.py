"""FMUs in a diagram: their start, names with dots, what can't be exported, what is left behind."""

import os
import zipfile

import casadi as ca
import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    DefinitionError,
    Input,
    Output,
    ParameterError,
    SimulationError,
    State,
    parameter,
)
from loopwright.diagrams import Diagram, NonFiniteError
from loopwright.fmus import Fmu, FmuFileError, ModelSpec, Variable, build, build_fmu, gantry


class Through(Block):
    """y = gain u beside a decay: an output that follows the input at once."""

    gain: float = parameter(default=2.0, unit="1")
    u = Input(unit="N")
    y = Output(unit="N")
    x = State(unit="m", start=1.0, output=True)

    def output(self, t, x, u):
        return self.gain * u.u + 0.0 * x.x

    def derivative(self, t, x, u):
        return -x.x


@pytest.fixture(scope="module")
def through(cache):
    return build(Through())


@pytest.mark.slow
def test_the_first_outputs_are_those_under_the_first_inputs(through):
    run = Diagram("d", Fmu(through, name="plant")(u=3.0)).simulate(0.3, step=0.1, progress=False)
    assert run["plant.y"].tolist() == [6.0, 6.0, 6.0, 6.0]


def test_a_resting_gantry_does_not_fall_at_the_start(cache):
    plant = Fmu(gantry.build(), name="plant")
    weight = 9.81 * 4.41
    run = Diagram("d", plant(motor_force=(0.0, weight), external_force=(0.0, 0.0))).simulate(
        2e-3, step=1e-3, progress=False
    )
    assert np.abs(run["plant.acceleration"]).max() < 1e-14


def test_inputs_that_hang_on_outputs_at_the_start_settle(through):
    # y = 2 u with u = 0.25 y + 3: y = 12 at the start; afterwards u is made from the y of the last step, which is 2 u
    plant = Fmu(through, name="plant")
    run = Diagram("d", plant(u=0.25 * plant.y + Constant(value=3.0, unit="N"))).simulate(0.2, step=0.1, progress=False)
    assert np.allclose(run["plant.y"], 12.0, rtol=1e-12)


def test_inputs_that_never_settle_at_the_start_are_told(through):
    plant = Fmu(through, name="plant")
    diagram = Diagram("d", plant(u=0.5 * plant.y + Constant(value=3.0, unit="N")))  # y = 2 u = y + 6
    with pytest.raises(
        SimulationError, match=r"plant\.u, t = 0 s: its value at the start depends on the FMU's own"
    ) as e:
        diagram.simulate(0.2, step=0.1, progress=False)
    assert len(e.value.run.t) == 0


def test_inputs_that_grow_twofold_with_each_pass_are_found_at_the_start(through):
    plant = Fmu(through, name="plant")
    run = Diagram("d", plant(u=-1.0 * plant.y + Constant(value=3.0, unit="N"))).simulate(0.2, step=0.1, progress=False)
    assert run["plant.y"][0] == pytest.approx(2.0, rel=1e-12)  # y = 2 u, u = 3 - y


def test_a_start_that_is_no_number_names_its_block(through):
    class Root(Block):
        u = Input()
        y = Output(unit="N")

        def output(self, t, x, u):
            return np.sqrt(u.u)

    with pytest.raises(NonFiniteError, match=r"root\.y, t = 0 s: found \[nan\]"):
        Diagram("d", Fmu(through, name="plant")(u=Root()(-1.0))).simulate(0.1, step=0.1, progress=False)


@pytest.fixture(scope="module")
def dotted(cache):
    t, x, u, p = (ca.MX.sym(name, n) for name, n in (("t", 1), ("x", 1), ("u", 1), ("p", 0)))
    return build_fmu(
        ModelSpec(
            name="dotted",
            description="",
            inputs=(Variable("axis.tau", "input"),),
            outputs=(),
            parameters=(),
            states=(Variable("axis.phi", "output", start=1.0, state=True),),
            derivative=ca.Function("f", [t, x, u, p], [u]),
            output=ca.Function("g", [t, x, u, p], [ca.MX(0, 1)]),
        )
    )


@pytest.mark.slow
def test_ports_with_dots_in_their_names_run(dotted):
    plant = Fmu(dotted, name="plant")
    run = Diagram("d", plant(**{"axis.tau": -2.0 * plant["axis.phi"]})).simulate(0.03, step=0.01, progress=False)
    assert np.allclose(run["plant.axis.phi"], 0.98 ** np.arange(4), rtol=1e-14)  # x' = -2 x_k, held for 10 ms
    assert run.at(0.02)["axis.phi"] == pytest.approx(0.98**2, rel=1e-14)


def test_a_library_that_does_not_load_leaves_the_folder_as_it_was(tmp_path, through, monkeypatch):
    bad = tmp_path / "bad.fmu"
    with zipfile.ZipFile(through) as old, zipfile.ZipFile(bad, "w") as new:
        for item in old.namelist():
            new.writestr(item, b"no library" if item.startswith("binaries/") else old.read(item))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FmuFileError, match="can't be loaded"):
        Diagram("d", Fmu(bad, name="plant")(u=1.0)).simulate(0.1, step=0.1, progress=False)
    assert os.getcwd() == str(tmp_path)


class Limited(Through):
    """A model with a guard."""

    def guards(self, t, x, u):
        return {"positive": x.x}


class Computed(Through):
    """A model that starts from its input."""

    def initial(self, u):
        return u.u


class Mixed(Through):
    """A model with units per entry."""

    z = State(unit=("m", "m/s"), start=(0.0, 0.0))

    def derivative(self, t, x, u):
        return -x.x, -x.z


class Half(Through):
    """A model with a port without a unit."""

    z = State()

    def derivative(self, t, x, u):
        return -x.x, -x.z


@pytest.mark.parametrize(
    ("block", "text"),
    [
        (Limited(), r"limited: it has guards\(…\), but an FMU has no guards"),
        (Computed(), r"computed: it has initial\(…\), but an FMU's states have fixed start values"),
        (Mixed(), r"mixed\.z: found several units, m, m/s; a variable of an FMU has one"),
        (Half(), r"half: z without a unit, where others have one. Give unit=, '1' for no dimension"),
    ],
)
def test_what_an_fmu_would_leave_out_is_refused(block, text):
    with pytest.raises(DefinitionError, match=text):
        build(block)


def test_defaults_and_open_bounds_are_exported(uncompiled):
    class Steep(Block):
        slope: float = parameter(default=6.0, above=5.0, unit="1")
        u = Input(default=4.0, unit="1", maximum=9.0)
        y = State(unit="1", output=True, minimum=-1.0)

        def derivative(self, t, x, u):
            return self.slope * (u.u - x.y)

    file = build(Steep())
    variables = Fmu(file).description.variables
    assert variables["u"].start == 4.0
    assert (variables["u"].maximum, variables["y"].minimum) == (9.0, -1.0)
    with pytest.raises(ParameterError, match=r"start\.slope: found 5\.0; the FMU allows at least 5"):
        Fmu(file, start={"slope": 5.0})
