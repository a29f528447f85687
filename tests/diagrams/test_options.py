"""What may be given to an experiment, in Python and on the command line, and what is said where it may not."""

import json
import math
import pickle
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import (
    Array,
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
from loopwright.diagrams import _cli, experiments
from loopwright.diagrams._cli import main
from loopwright.diagrams._options import LIMITS
from loopwright.diagrams.experiments import EXPERIMENTS, compliance, force_tracking, path_following
from loopwright.fmus import Fmu, build, gantry

PROC = Path("/proc")
LINUX = pytest.mark.skipif(not PROC.is_dir(), reason="needs a folder to which nobody can write")


def files(folder):
    return sorted(file.name for file in folder.iterdir())


# --- truth values ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["no", "off", "yes", "", 1, 0, None, 1.0])
def test_only_truth_values_are_truth_values(value):
    with pytest.raises(OptionError, match=re.escape(f"experiment D.cubic: found {value!r}; expected True or False.")):
        force_tracking(cubic=value)
    with pytest.raises(OptionError, match="experiment B.smooth_reference: found .*; expected True or False"):
        compliance(smooth_reference=value)


def test_numpys_truth_values_are_some():
    assert force_tracking(cubic=np.True_).options["cubic"] is True


@pytest.mark.parametrize(
    ("word", "meant"), [("yes", True), ("On", True), ("TRUE", True), ("no", False), ("off", False)]
)
def test_words_for_truth_on_the_command_line(word, meant):
    assert _cli._value(word) is meant


def test_a_word_that_is_no_truth_value(tmp_path, capsys):
    assert main(["run", "D", "--option", "cubic=maybe", "--out", str(tmp_path / "out")]) == 2
    assert "experiment D.cubic: found 'maybe'; expected True or False." in capsys.readouterr().err


# --- the sample time -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("letter", "value", "fits"),
    [
        ("A", 0.0003, "0.000275 or 0.0003125"),
        ("A", 7e-4, "0.0006875 or 0.000704"),
        ("C", 0.0007, "0.00064 or 0.00075"),
        ("D", 20, "9"),
        ("A", 1e-10, "1e-09"),
        ("A", Fraction(1, 3000), "0.00032 or 0.00034375"),
    ],
)
def test_a_sample_time_that_does_not_divide_the_duration(letter, value, fits):
    with pytest.raises(OptionError) as caught:
        EXPERIMENTS[letter](sample_time=value)
    message = str(caught.value)
    assert message.startswith(f"experiment {letter}.sample_time: found {value!r}; expected a whole number of nanosec")
    shown = message.rpartition("such as ")[2].removesuffix(".")
    assert shown == fits
    for text in shown.split(" or "):
        advised = EXPERIMENTS[letter](sample_time=float(text))
        assert (Fraction(str(advised.duration)) / Fraction(text)).denominator == 1


@pytest.mark.parametrize("value", ["1e-3", True, 0, -1e-3, math.nan, math.inf, None, 1j, [1e-3]])
def test_a_sample_time_that_is_no_positive_number(value):
    with pytest.raises(OptionError, match="experiment A.sample_time: found .*; expected a positive number"):
        path_following(sample_time=value)


def test_an_exact_sample_time_is_the_same_run():
    exact = path_following(sample_time=Fraction(1, 1000))
    assert exact.options == path_following().options
    assert exact.diagram.frames["controller"].sample_time == Fraction(1, 1000)


def test_a_wrong_sample_time_is_wrong_usage_and_leaves_earlier_files(tmp_path, capsys):
    (tmp_path / "A.csv").write_text("of an older run")
    assert main(["run", "A", "--out", str(tmp_path), "--option", "sample_time=0.0003"]) == 2
    assert "make the experiment's 11 s, such as 0.000275 or 0.0003125." in capsys.readouterr().err
    assert (tmp_path / "A.csv").read_text() == "of an older run"


# --- numbers and limits ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize(
    "value", [[[300], [200, 1]], (1, 2, 3), [], "300", (300, "1"), 0, (1, -1), True, (1, math.nan)]
)
def test_limits_that_are_none(name, value):
    with pytest.raises(
        OptionError, match=re.escape(f"experiment B.{name}: found {value!r}; expected a positive number")
    ):
        compliance(**{name: value})


@pytest.mark.parametrize("value", [np.array([0, 1]), [0], "1", 2, True, None, 0.5])
def test_delays_that_are_none(value):
    with pytest.raises(OptionError, match=r"experiment A.delay: found .*; expected 0 or 1 samples"):
        path_following(delay=value)


@pytest.mark.parametrize("value", [np.array([1.0]), 10**400, 1j, "0", None, True])
def test_numbers_that_are_none(value):
    with pytest.raises(OptionError, match="experiment A.tool_mass: found .*; expected a number that is not negative"):
        path_following(tool_mass=value)


@pytest.mark.parametrize(
    ("value", "kept"),
    [
        (0.2, 0.2),
        (np.float64(0.2), 0.2),
        (math.inf, None),
        (None, None),
        ((None, math.inf), None),
        ((0.2, None), (0.2, None)),
        ([0.2, math.inf], (0.2, None)),
        (np.array([0.2, 0.1]), (0.2, 0.1)),
        ((0.2,), (0.2, 0.2)),
    ],
)
def test_limits_in_one_form(value, kept):
    options = dict.fromkeys(LIMITS, value)
    experiment = compliance(**options)
    assert [experiment.options[name] for name in LIMITS] == [kept] * 3
    sides = kept if isinstance(kept, tuple) else (kept, kept)
    for side, limit in zip(("par", "perp"), sides, strict=True):
        admittance = experiment.diagram[f"admittance_{side}"]
        assert (admittance.velocity_limit, admittance.acceleration_limit) == (limit, limit)
    assert ("controller.saturation" in experiment.diagram.blocks) == (kept is not None)


def test_a_force_limit_on_one_axis_leaves_the_other_alone(runs):
    _, free = runs("A")
    _, run = runs("A", motor_force_limit=(300, math.inf))
    y, z = np.abs(run["motor_force"]).max(axis=0)
    assert y == 300.0 < np.abs(free["motor_force"][:, 0]).max()
    assert z > 1000.0
    _, same = runs("A", motor_force_limit=(300, None))
    assert np.array_equal(same.data, run.data)


def test_a_velocity_limit_on_one_direction_leaves_the_other_alone(runs):
    _, free = runs("B")
    _, run = runs("B", velocity_limit=(0.2, None))
    assert np.abs(run["eta_p"][:, 1]).max() <= 0.2 + 1e-12
    assert np.abs(free["eta_p"][:, 1]).max() > 0.3
    np.testing.assert_allclose(run["xi_p"], free["xi_p"], atol=1e-12)


def test_an_unlimited_limit_is_none_where_there_is_nothing_to_limit():
    assert path_following(velocity_limit=math.inf).options["velocity_limit"] is None


# --- plants ----------------------------------------------------------------------------------------------------------


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


@pytest.fixture(scope="module")
def pendulum():
    return build(Pendulum())


NEEDED = (
    "Fig. 3 needs a plant with the inputs motor_force [2] in N, external_force [2] in N, and the outputs "
    "position [2] in m, velocity [2] in m/s, acceleration [2] in m/s2; contact_force [2] in N is optional (axes y and "
    "z). This one has the inputs "
)


def test_a_plant_of_another_kind(pendulum, tmp_path, capsys):
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


def test_a_port_of_another_shape(pendulum):
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


def test_a_position_that_can_not_be_set(carriage, runs):
    with pytest.raises(OptionError) as caught:
        path_following(plant=carriage)
    position = experiments.ELLIPSE.to_plane(0.10, 0.01)
    assert str(caught.value) == (
        f"experiment A.plant: its position is computed and can't be set to ({position[0]:g}, {position[1]:g}) m, where "
        "experiment A starts. Give the plant with start values of its own that place it there: "
        "plant=Fmu(file, start={…})."
    )
    start = {"carriage": np.subtract(position, (0.1, 0.2))}
    run = path_following(plant=Fmu(carriage, start=start)).simulate(progress=False)
    np.testing.assert_allclose(run["position"], runs("A")[1]["position"], atol=1e-11)
    with pytest.raises(PathDomainError, match="t = 0 s"):
        path_following(plant=Fmu(carriage, start={"carriage": (0.4, 0.3)})).simulate(progress=False)


def test_a_plants_own_values_stay_unless_an_option_is_given():
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


# --- what an experiment is -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("letter", EXPERIMENTS)
def test_an_experiment_can_be_pickled(letter, runs):
    experiment, run = runs(letter)
    again = pickle.loads(pickle.dumps(experiment))
    assert again.options == experiment.options
    assert (again.letter, again.title, again.duration, again.path) == (
        *(letter, experiment.title, experiment.duration, experiment.path),
    )
    with pytest.raises(TypeError):
        again.options["delay"] = 1
    assert np.array_equal(again.simulate(progress=False).data, run.data)


@pytest.mark.parametrize("letter", EXPERIMENTS)
def test_references_have_units(letter, runs):
    _, run = runs(letter)
    for name in ("eta_p", "xi_p", "eta_d.y", "xi_d.y"):
        assert run.unit(name) == ("m", "m/s", "m/s2")
    assert run.plot("eta_p").axes[0].get_legend().get_texts()[0].get_text() == "eta_p[1] [m]"


# --- the command line ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "letters"),
    [
        ([], "ABCD"),
        (["AB"], "AB"),
        (["A,B"], "AB"),
        (["b,", "a"], "BA"),
        (["D", "CD", "d"], "DC"),
    ],
)
def test_letters(given, letters):
    assert _cli._letters(given) == list(letters)


@pytest.mark.parametrize(
    ("given", "named"), [("AE", "AE"), ("A,EF", "EF"), ("", ""), ("path_following", "path_following")]
)
def test_letters_that_are_none(given, named, capsys):
    assert main(["run", given]) == 2
    assert f"error: there is no experiment {named!r}. Known: A, B, C, D.\n" in capsys.readouterr().err


def test_options_of_several_experiments(capsys):
    shares = _cli._share("AB", {"velocity_limit": 1.0})
    assert shares == {"A": {}, "B": {"velocity_limit": 1.0}}
    assert capsys.readouterr().err == "A: without velocity_limit, which only B, C and D have.\n"


def test_a_path_is_for_python(capsys):
    assert main(["run", "A", "--option", "path=circle"]) == 2
    assert (
        "--option path: a path can't be given on the command line; take Python: "
        "loopwright.diagrams.experiments.path_following(path=…).simulate()."
    ) in capsys.readouterr().err
    assert main(["run", "A", "--option", "pth=circle"]) == 2
    assert "'path'" not in capsys.readouterr().err


@LINUX
def test_a_folder_to_which_nothing_can_be_written_is_noticed_before_the_run(capsys, monkeypatch):
    monkeypatch.setattr(experiments.Experiment, "simulate", lambda self: pytest.fail("it ran"))
    assert main(["run", "A", "--out", "/proc"]) == 2
    assert "--out: nothing can be written to the folder '/proc': " in capsys.readouterr().err


def test_help_tells_the_exit_statuses_and_what_becomes_of_files(capsys):
    assert main(["run", "--help"]) == 0
    text = capsys.readouterr().out
    assert "  130  interrupted (Ctrl-C); what was recorded until then is written" in text
    assert "one that recorded nothing writes nothing, and an earlier run's files stay." in text
    assert "path=" not in text


def test_never_is_told_apart_from_not_applicable_after_a_failure(tmp_path):
    assert main(["run", "B", "--out", str(tmp_path), "--option", "tool_mass=5"]) == 1
    content = json.loads((tmp_path / "B.json").read_text(encoding="utf-8"))
    assert content["never"] == []
    assert content["error"].startswith("controller.path_projection, t = 0.02")
    assert files(tmp_path)[:2] == ["B.csv", "B.json"]
