"""Plants of one's own under the experiments: ports, start values, and what is said where they don't fit."""

import re

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Input,
    OptionError,
    Output,
    PathDomainError,
    ShapeError,
    State,
    UnknownNameError,
    parameter,
)
from loopwright.diagrams import experiments
from loopwright.diagrams.cli.command_line import main
from loopwright.diagrams.paper.experiments import path_following
from loopwright.fmus import Fmu, build, gantry
from loopwright.types import Array


class Carriage(Block):
    """A gantry whose position is computed: a carriage and an offset."""

    offset: Array = parameter(default=(0.1, 0.2), shape=(2,), unit="m", description="where the tool is")
    at: Array = parameter(
        default=(0.8, 0.5), shape=(2,), unit="m", structural=True, description="carriage at the start"
    )
    motor_force = Input(shape=(2,), unit="N")
    external_force = Input(shape=(2,), unit="N")
    carriage = State(unit="m", start="at")
    speed = State(unit="m/s", like="motor_force")
    position = Output(shape=(2,), unit="m")
    velocity = Output(shape=(2,), unit="m/s")
    acceleration = Output(shape=(2,), unit="m/s2")

    def derivative(self, t, x, u):
        return x.speed, self.output(t, x, u)[2]

    def output(self, t, x, u):
        a = gantry.nominal.coordinate_acceleration(x.carriage, x.speed, u.motor_force, u.external_force)
        return x.carriage + self.offset, x.speed, a


class Pendulum(Block):
    """A plant of another kind."""

    torque = Input(unit="N.m")
    angle = State(unit="rad", output=True)
    position = Output(shape=(3,), unit="m")
    rate = State(unit="rad/s")

    def derivative(self, t, x, u):
        return x.rate, u.torque - np.sin(x.angle)

    def output(self, t, x, u):
        return np.stack([np.sin(x.angle), np.cos(x.angle), 0.0 * x.angle])


@pytest.fixture(scope="module")
def carriage():
    return build(Carriage(), internal_step=gantry.INTERNAL_STEP)


NEEDED = (
    "Fig. 3 needs a plant with the inputs motor_force [2] in N, external_force [2] in N, and the outputs "
    "position [2] in m, velocity [2] in m/s, acceleration [2] in m/s2; contact_force [2] in N is optional (axes y and "
    "z). This one has the inputs "
)


def test_a_plant_of_another_kind(tmp_path, capsys, uncompiled):
    pendulum = build(Pendulum())
    assert main(["run", "A", "--plant", str(pendulum), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        "loopwright: error: plant: it has no input 'motor_force', no input 'external_force', no output 'velocity', no "
        f"output 'acceleration'. {NEEDED}torque, and the outputs "
    )
    assert "give it the expected one, in Python: Fmu(file, rename={'name in the FMU': 'position'})." in error
    assert not (tmp_path / "out").exists()
    with pytest.raises(UnknownNameError, match="plant: it has no input 'motor_force'"):
        path_following(plant=pendulum)


def test_a_port_of_another_shape(uncompiled):
    class Volume(Pendulum):
        """Ports with the right names."""

        motor_force = Input(shape=(2,), unit="N")
        external_force = Input(shape=(2,), unit="N")
        velocity = Output(shape=(2,), unit="m/s")
        acceleration = Output(shape=(2,), unit="m/s2")

        def output(self, t, x, u):
            return super().output(t, x, u), u.motor_force, u.external_force

    with pytest.raises(ShapeError, match=re.escape(f"plant: it has 'position' of shape (3,). {NEEDED}")):
        path_following(plant=build(Volume()))


@pytest.mark.slow
def test_ports_of_other_names_are_renamed(runs):
    class Robot(gantry.Gantry):
        """The gantry with one output of another name."""

        place = Output(shape=(2,), unit="m")

        def output(self, t, x, u):
            return super().output(t, x, u), x.position

    file = build(Robot(), internal_step=gantry.INTERNAL_STEP)
    plant = Fmu(file, rename={"position": "state", "place": "position"}, start={"position": (0.5, 0.6)})
    assert plant.outputs["position"].shape == (2,)
    run = path_following(plant=plant).diagram.simulate(0.01, progress=False)
    np.testing.assert_array_equal(run["position"][0], (0.5, 0.6))


@pytest.mark.slow
def test_a_start_value_follows_the_new_name(runs):
    class Placed(Block):
        """The gantry, its position called p."""

        motor_force = Input(shape=(2,), unit="N")
        external_force = Input(shape=(2,), unit="N")
        p = State(unit="m", like="motor_force", output=True)
        velocity = State(unit="m/s", like="motor_force", output=True)
        acceleration = Output(shape=(2,), unit="m/s2")

        def derivative(self, t, x, u):
            return x.velocity, self.output(t, x, u)

        def output(self, t, x, u):
            return gantry.nominal.coordinate_acceleration(x.p, x.velocity, u.motor_force, u.external_force)

    plant = Fmu(build(Placed(), internal_step=gantry.INTERNAL_STEP), rename={"p": "position"})
    _, want = runs("A")
    run = path_following(plant=plant).simulate(progress=False)
    np.testing.assert_allclose(run["position"], want["position"], atol=1e-12)


@pytest.mark.slow
def test_a_position_that_can_not_be_set(carriage, runs):
    with pytest.raises(OptionError) as caught:
        path_following(plant=carriage)
    position = experiments.ELLIPSE.to_plane(0.10, 0.01)
    assert str(caught.value) == (
        f"experiment A.plant: its position is computed and can't be set to ({position[0]:g}, {position[1]:g}) m, where "
        "experiment A starts. Give the plant with its own start values that place it there: "
        "plant=Fmu(file, start={…})."
    )
    start = {"carriage": np.subtract(position, (0.1, 0.2))}
    run = path_following(plant=Fmu(carriage, start=start)).simulate(progress=False)
    np.testing.assert_allclose(run["position"], runs("A")[1]["position"], atol=1e-11)
    with pytest.raises(PathDomainError, match="t = 0 s"):
        path_following(plant=Fmu(carriage, start={"carriage": (0.4, 0.3)})).simulate(progress=False)


def test_a_plants_own_values_stay_unless_an_option_is_given(uncompiled):
    file = gantry.build(gantry.nominal.replace(coulomb_scale=1.5))
    plant = path_following(plant=file).diagram["plant"]
    assert set(plant.start) == {"position"}
    plant = path_following(plant=Fmu(file, start={"gravity": 0.0}), coulomb_scale=1, viscous_scale=2).diagram["plant"]
    assert {n: float(v) for n, v in plant.start.items() if n != "position"} == {
        "coulomb_scale": 1.0,
        "viscous_scale": 2.0,
        "gravity": 0.0,
    }


def test_an_option_that_the_plants_start_values_contradict():
    plant = Fmu(gantry.build(), start={"coulomb_scale": 1.0})
    with pytest.raises(OptionError) as caught:
        path_following(plant=plant, coulomb_scale=2.0)
    assert str(caught.value) == (
        "experiment A.coulomb_scale: found 2, and 1 in the plant's start values; give it once."
    )
    assert float(path_following(plant=plant, coulomb_scale=1).diagram["plant"].start["coulomb_scale"]) == 1.0


@pytest.mark.slow
def test_an_option_that_the_plant_does_not_have(carriage):
    plant = Fmu(carriage, start={"carriage": (0.7, 0.3)})
    with pytest.raises(
        OptionError, match="experiment A.coulomb_scale: the plant has no parameter 'coulomb_scale', found"
    ):
        path_following(plant=plant, coulomb_scale=2)
    assert "coulomb_scale" not in path_following(plant=plant, coulomb_scale=1.0).diagram["plant"].start


def test_a_folder_is_no_plant(tmp_path, capsys):
    assert main(["run", "A", "--plant", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert (
        f"experiment A.plant: {str(tmp_path)!r} is a folder; expected an FMU, a file that ends in .fmu. Name the file."
        in capsys.readouterr().err
    )
