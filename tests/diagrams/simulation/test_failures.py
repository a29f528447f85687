"""A run that fails names the block, the port and the time, and keeps what it recorded."""

import zipfile

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    Ellipse,
    Function,
    Gain,
    GuardError,
    Input,
    Integrator,
    LoopwrightError,
    OptionError,
    Output,
    ParameterError,
    PathDomainError,
    PathProjection,
    Saturation,
    SimulationError,
    SmoothStep,
    Step,
    UnitDelay,
    UnknownNameError,
)
from loopwright.diagrams import Diagram, NonFiniteError, experiments, subsystem
from loopwright.fmus import Fmu, FmuFileError, FmuRuntimeError, gantry


class Root(Block):
    """A square root: NaN below zero, with a guard if asked for."""

    guarded: bool = False
    u = Input()
    y = Output()

    def output(self, t, x, u):
        return np.sqrt(u.u)

    def guards(self, t, x, u):
        return {"radicand": u.u + 1e-300} if self.guarded else {}


def ramp(rate=-1.0, start=1.0):
    """From start, falling by rate per second, sampled at 0.1 s."""

    @subsystem(sample_time=0.1)
    def falling():
        delay = UnitDelay(initial_value=start, name="level")
        delay(delay.y + 0.1 * rate)
        return delay.y.named("level")

    return falling()


def test_a_nan_stops_the_run_at_the_first_block_that_made_it():
    level = ramp()
    diagram = Diagram("d", Saturation(limit=5, name="after")(Root(name="root")(level)))
    with pytest.raises(NonFiniteError) as error:
        diagram.simulate(3.0, progress=False)
    assert str(error.value).startswith(
        "root.y, t = 1.1 s: found [nan]; expected finite numbers. This is the first block"
    )
    assert "u = -0.1" in str(error.value).replace("-0.09999999999999987", "-0.1").replace("-0.1000", "-0.1")
    assert str(error.value).endswith("Samples until then are in error.run.")
    assert (error.value.block, error.value.port, error.value.t) == ("root", "y", 1.1)
    assert len(error.value.run.t) == 11
    assert error.value.run["after.y"][:3] == pytest.approx([1.0, np.sqrt(0.9), np.sqrt(0.8)], abs=1e-15)


@pytest.mark.parametrize("solver", ["auto", "RK45"])
def test_a_solver_that_gets_no_further_names_the_block_of_the_state(solver):
    @subsystem
    def tank(u):
        level = Integrator(initial_value=1.0, name="level")
        return level(Function(lambda x, u: x * x + u, name="square")(level.y, u))

    diagram = Diagram("d", tank(Constant(value=0.0)))
    with pytest.raises(SimulationError, match=r"^tank\.level, t = 1\.0000") as error:  # ẋ = x²: infinite at t = 1
        diagram.simulate(3.0, progress=False, solver=solver)
    assert (error.value.block, error.value.state) == ("tank.level", "tank.level.y")


def test_saturation_passes_nan_on():
    class Nan(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return np.sqrt(u.u - 1.0)

    with pytest.raises(
        NonFiniteError, match=r"^nan\.y, t = 0 s.* Look at its parameters and at what is wired to it\.$"
    ):
        Diagram("d", Saturation(limit=5)(Nan()(Constant(value=0.0)))).simulate(1.0, step=0.5, progress=False)


def test_a_guard_stops_the_run_with_the_blocks_own_words():
    diagram = Diagram("d", Root(guarded=True, name="root")(ramp()))
    with pytest.raises(
        GuardError, match=r"^root, t = 1\.1 s: guard 'radicand' is -0\.1; expected a positive value.*u = -0\."
    ) as e:
        diagram.simulate(3.0, progress=False)
    assert len(e.value.run.t) == 11


def unstable():
    """A tool ten times as heavy as the virtual mass makes the sampled admittance unstable (E25)."""
    return experiments.hand_guiding(tool_mass=5.0)


@pytest.mark.slow
def test_leaving_the_domain_of_the_path_says_where_and_keeps_the_samples():
    experiment = unstable()
    with pytest.raises(PathDomainError) as error:
        experiment.simulate(progress=False)
    e = error.value
    assert e.block == "controller.path_projection"
    assert len(e.run.t) == round(e.t * 1000)
    assert e.run.t[-1] == pytest.approx(e.t - 1e-3)
    path = experiment.path
    distance = np.min(np.linalg.norm(path.sigma(np.linspace(0, 2 * np.pi, 200001)).T - np.array(e.position), axis=1))
    assert abs(abs(e.xi) - distance) < 1e-8
    assert "m has no valid path coordinates" in str(e)
    assert f"ξ = {e.xi:.6g} m" in str(e)
    assert np.all(np.isfinite(e.run.data))


def test_a_start_beyond_the_reach():
    path = Ellipse(semi_axes=(0.3, 0.15), center=(0.5, 0.5))
    with pytest.raises(PathDomainError) as error:
        path.to_plane(0.0, 0.08)
    assert error.value.reach == pytest.approx(0.075, abs=1e-9)  # b²/a
    assert "0.075" in str(error.value)


def test_an_unreachable_start_of_the_plant_is_refused_at_t_0():
    experiment = experiments.path_following()
    lost = experiment.diagram.replace({"plant.start.position": (0.5, 0.5)})  # the centre, on the medial axis
    with pytest.raises(
        PathDomainError, match=r"^controller\.path_projection, t = 0 s: position \[0\.5, 0\.5\] m"
    ) as error:
        lost.simulate(1.0, progress=False)
    assert len(error.value.run.t) == 0


def test_a_projection_can_stand_alone():
    circle = Ellipse(semi_axes=(0.2, 0.2), center=(0.0, 0.0))

    @subsystem(sample_time=0.01)
    def box(position):
        return PathProjection(circle)(position)

    class Spiral(Block):
        r = Input(shape=(3,))
        y = Output(shape=(2,), unit="m")

        def output(self, t, x, u):
            return u.r[0] * np.stack([np.cos(8 * t), np.sin(8 * t)])

    radius = SmoothStep(levels=(0.2, 0.0), start_times=(0.0,), durations=(2.0,))
    with pytest.raises(PathDomainError, match=r"q = 1 − κ ξ = 0\.0\d+ is below 0\.05|medial axis") as error:
        Diagram("d", box(Spiral()(radius))).simulate(3.0, progress=False)
    run = error.value.run
    assert np.max(np.abs(run["theta"] - 8 * run.t)) < 1e-9  # several laps, counted
    assert run["q"][-1] > 0.05


# --- plants -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def file():
    return gantry.build()


def test_a_path_that_is_no_fmu(tmp_path):
    text = tmp_path / "notes.txt"
    text.write_text("hello")
    archive = tmp_path / "empty.fmu"
    with zipfile.ZipFile(archive, "w") as z:
        z.writestr("a.txt", "a")
    broken = tmp_path / "broken.fmu"
    with zipfile.ZipFile(broken, "w") as z:
        z.writestr("modelDescription.xml", "<fmiModelDescription")
    for path, words in (
        (tmp_path / "none.fmu", r"plant: there is no file .*none\.fmu"),
        (text, r"is no FMU: it is no zip archive \(it starts with b'hello'\)"),
        (archive, r"is a zip archive without modelDescription\.xml"),
        (broken, r"modelDescription\.xml of .* is no XML: .*line 1, column 21\. Export"),
    ):
        with pytest.raises(FmuFileError, match=words):
            Fmu(path, name="plant")
        with pytest.raises(FmuFileError, match=words):
            experiments.path_following(plant=path)


def test_an_fmu_for_other_platforms_only(file, tmp_path):
    other = tmp_path / "other.fmu"
    with zipfile.ZipFile(file) as source, zipfile.ZipFile(other, "w") as target:
        for item in source.namelist():
            target.writestr(item.replace("binaries/x86_64-linux", "binaries/riscv64-linux"), source.read(item))
    with pytest.raises(FmuFileError, match=r"has no binary for this platform, .* \(it has: .*riscv64-linux"):
        Fmu(other)


def test_an_unknown_start_value_offers_near_names(file):
    with pytest.raises(
        UnknownNameError, match=r"plant\.start: the FMU has no variable 'positon'\. Did you mean 'position'"
    ):
        Fmu(file, name="plant", start={"positon": (0, 0)})


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ((np.nan, 0.5), "expected finite numbers in m"),
        ((1, 2, 3), r"expected numbers of shape \(2,\)"),
        ("left", r"expected numbers of shape \(2,\)"),
    ],
)
def test_a_bad_start_value(file, value, words):
    with pytest.raises(ParameterError, match=rf"^plant\.start\.position: found .*; {words}"):
        Fmu(file, name="plant", start={"position": value})


def test_a_start_value_out_of_the_fmus_range(file):
    with pytest.raises(ParameterError, match=r"plant\.start\.coulomb_scale: found -1; the FMU allows at least 0 in 1"):
        Fmu(file, name="plant", start={"coulomb_scale": -1})


def test_a_non_positive_mass():
    with pytest.raises(
        ParameterError, match=r"Gantry\.translational_mass: found \[7\.61, 0\.0\]; expected a value above 0 in kg"
    ):
        gantry.Gantry(translational_mass=(7.61, 0.0))


def test_a_misspelt_port_offers_near_names(file):
    plant = Fmu(file, name="plant")
    with pytest.raises(AttributeError, match=r"plant: it has no output 'positon'\. Did you mean 'position'\?"):
        _ = plant.positon
    with pytest.raises(UnknownNameError, match=r"plant: it has no input 'motor_forces'\. Did you mean 'motor_force'"):
        plant(motor_forces=Constant(value=(0, 0)))


def test_ports_by_index_and_by_another_name(file):
    free = {"motor_force": (0, 0), "external_force": (0, 0), "coulomb_scale": 0, "viscous_scale": 0}
    plant = Fmu(file, name="plant", rename={"position": "y"}, start=free)
    assert plant["y"].port == "y"
    run = Diagram("d", plant()).simulate(0.01, step=1e-3, progress=False)
    assert run["y"][-1, 1] - 0.5 == pytest.approx(-0.5 * 9.81 * 4.41 / 21.2 * 1e-4, rel=1e-9)  # falls: −g m_t/M t²/2
    with pytest.raises(UnknownNameError, match="rename"):
        Fmu(file, rename={"positon": "y"})


def test_an_fmu_that_fails_in_a_step_is_named_with_its_own_log_and_keeps_the_run(file):
    push = Step(times=0.005, values=1e300, unit="N")  # finite, but not over a mass of 1e-10 kg
    light = {"external_force": (0, 0), "translational_mass": (1e-10, 1.0), "equivalent_mass": (0, 1)}
    plant = Fmu(file, name="plant", start=light)
    force = Gain(gain=(1.0, 0.0))(push)
    with pytest.raises(
        FmuRuntimeError, match=r"^plant, t = 0\.005 s: .* failed with fmi3Error\. The FMU says: .*"
    ) as error:
        Diagram("d", plant(motor_force=force)).simulate(0.01, step=1e-3, progress=False)
    assert len(error.value.run.t) == 6  # up to and including the tick whose step failed
    assert error.value.run["step.y"][-1] == 1e300


# --- options ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"delai": 1}, r"delai: experiment A has no option 'delai'\. Did you mean 'delay'\?"),
        ({"delay": 2}, r"experiment A\.delay: found 2; expected 0 or 1 samples"),
        ({"tool_mass": -1}, r"tool_mass: found -1; expected a number that is not negative"),
        ({"sample_time": 0}, r"sample_time: found 0; expected a positive number"),
        ({"motor_force_limit": (1, 2, 3)}, r"motor_force_limit: found \(1, 2, 3\); expected a positive number, a pair"),
        ({"motor_force_limit": "much"}, r"motor_force_limit: found 'much'"),
        ({"friction_width": float("nan")}, r"friction_width: found nan"),
        ({"encoder": True}, r"encoder: found True"),
        ({"path": "ellipse"}, r"path: found 'ellipse'; expected a path"),
        ({"velocity_limit": 1.0}, r"experiment A has no admittance"),
        ({"admittance_method": "euler"}, r"expected 'exact' or 'semi_implicit'"),
    ],
)
def test_wrong_options(options, words):
    with pytest.raises(OptionError, match=words):
        experiments.path_following(**options)


def test_options_of_the_run_and_of_the_experiment_are_kept_apart():
    experiment = experiments.path_following()
    with pytest.raises(OptionError, match=r"A\.delay: it is no option of a run\. Give it to the experiment"):
        experiment.simulate(delay=1)
    with pytest.raises(OptionError, match="it has no argument"):
        experiment.simulate(progres=False)


@pytest.mark.parametrize(("duration", "words"), [(0, "positive"), (-1, "positive")])
def test_a_wrong_duration(duration, words):
    with pytest.raises(OptionError, match=words):
        experiments.path_following().diagram.simulate(duration, progress=False)


def test_a_time_outside_of_the_run():
    run = experiments.path_following().diagram.simulate(0.1, progress=False)
    with pytest.raises(OptionError, match=r"found t = 5; the run holds 0 s to 0\.1 s"):
        run.at(5)
    assert run.at(0.05).tick == 50
    assert run.at(0.05)["eta"] == pytest.approx(run["eta"][50])


def test_every_error_is_one_of_ours_and_can_be_pickled():
    import pickle

    with pytest.raises(LoopwrightError) as error:
        unstable().simulate(progress=False)
    error.value.run = None
    again = pickle.loads(pickle.dumps(error.value))
    assert str(again) == str(error.value)
    assert (again.block, again.t, again.reach) == (error.value.block, error.value.t, error.value.reach)


def test_values_too_large_to_sum_name_the_largest():
    level = Gain(gain=(1.7e308, 1.7e308), name="huge")(Step(times=0.2, values=1.0))
    with pytest.raises(NonFiniteError, match=r"^huge\.y, t = 0\.2 s: found 1\.7e\+308.*overflow"):
        Diagram("d", level).simulate(1.0, step=0.1, progress=False)
