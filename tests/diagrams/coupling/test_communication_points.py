"""Ticks to which FMUs step: those of the subsystems that they are wired to, in a run and in its linear model."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Clock, Gain, Integrator, OptionError, ParameterError, SampleTimeError, Sine
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, StepOptions, mass_spring_damper
from support.counted import counted_steps

pytestmark = pytest.mark.one_tier  # it counts calls

P = mass_spring_damper.MassSpringDamper()
A = np.array([[0.0, 1.0], [-P.stiffness / P.mass, -P.damping / P.mass]])
B = np.array([0.0, 1.0 / P.mass])
START = np.array([0.1, 0.0])
K = 30.0


def step_matrix(h, gain):
    """Return the transition of (position, velocity) over a step in which the force gain · position is held."""
    big = np.zeros((3, 3))
    big[:2, :2], big[:2, 2] = A, B
    whole = expm(big * h)
    return whole[:2, :2] + np.outer(whole[:2, 2], [gain, 0.0])


def sampled(T, name, **options):
    @subsystem(sample_time=T, name=name, **options)
    def box(u):
        return Gain(gain=1.0, name="gain")(u)

    return box


def plant(**options):
    return Fmu(mass_spring_damper.build(), name="plant", start={"position": START[0], "velocity": START[1]}, **options)


def spring(T, *others, stepped=None):
    """A mass that a spring of the diagram, a gain in continuous time, pulls back; it is read each T seconds."""
    mass = plant() if stepped is None else stepped
    return Diagram(
        "d", mass(force=Gain(gain=-K, name="spring")(mass.position)), sampled(T, "reader")(mass.position), *others
    )


@pytest.fixture
def steps(monkeypatch):
    """Steps of all FMUs, as (t, h)."""
    return counted_steps(monkeypatch)


def one_step_only(monkeypatch):
    monkeypatch.setattr(Fmu, "variable_step", property(lambda self: False))


@pytest.mark.parametrize("between", [False, True], ids=["ticks", "solver"])
@pytest.mark.parametrize("even", [False, True], ids=["any", "even"])
@pytest.mark.drawn(1)
def test_a_fast_subsystem_that_has_nothing_to_do_with_an_fmu_leaves_its_steps(cache, steps, monkeypatch, between, even):
    if even:
        one_step_only(monkeypatch)
    more = [Integrator(name="aside")(Clock())] if between else []
    alone = spring(0.02, *more).simulate(0.2, progress=False)
    expected = list(steps)
    steps.clear()
    run = spring(0.02, *more, sampled(0.003, "fast")(Clock())).simulate(0.2, progress=False)
    assert len(expected) == 10
    assert steps == expected
    t, position = run.t, run["plant.position"]
    powers = [np.linalg.matrix_power(step_matrix(0.02, -K), k) @ START for k in range(11)]
    assert alone["plant.position"][np.isin(alone.t, np.arange(11) / 50)] == pytest.approx(
        [x[0] for x in powers], rel=1e-9, abs=1e-10
    )
    last = np.searchsorted(np.arange(11) / 50, t, side="right") - 1  # held between its communication points
    assert position == pytest.approx([powers[k][0] for k in last], rel=1e-9, abs=1e-10)
    assert not run.messages


def test_a_source_that_both_read_makes_no_link(cache, steps):
    mass, wave = plant(), Sine(frequency=1.0, name="wave")
    Diagram("d", mass(force=wave), sampled(0.02, "reader")(mass.position), sampled(0.003, "fast")(wave)).simulate(
        0.1, progress=False
    )
    assert len(steps) == 5


def test_blocks_in_continuous_time_and_other_fmus_are_passed_through(cache, steps):
    a, b = plant().replace(name="a"), plant().replace(name="b")
    force = sampled(0.01, "controller")(Gain(gain=2.0, name="through")(a.position))
    diagram = Diagram(
        "d", a(force=0.0), b(force=Gain(gain=K, name="link")(a.position)), sampled(0.025, "reader")(b.position), force
    )
    diagram.simulate(0.1, progress=False)
    assert len(steps) == 2 * (10 + 4 - 2)  # both at the ticks of both subsystems


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("options", "h"), [({}, 0.002), ({"step": 0.001}, 0.001)], ids=["own", "asked"])
def test_run_and_linear_model_step_an_fmu_at_the_same_ticks(cache, steps, options, h):
    """The base of 2 ms and 3 ms is 1 ms; a ``step`` of 1 ms asks for communication points at all ticks."""
    diagram = spring(0.002, sampled(0.003, "other")(Clock()))
    run = diagram.simulate(0.006, progress=False, **options)
    count = round(0.006 / h)
    assert [round(t / h) for t, _ in steps] == list(range(count))
    expected = np.linalg.matrix_power(step_matrix(h, -K), count)
    assert run["plant.position"][-1] == pytest.approx((expected @ START)[0], rel=1e-9, abs=1e-10)
    model = diagram.linearize(**options)
    found = np.sort_complex([z for z in model.poles if abs(z) > 1e-9])
    assert model.dt == pytest.approx(0.006)
    assert found == pytest.approx(np.sort_complex(np.linalg.eigvals(expected)), abs=1e-9)
    assert abs(np.linalg.det(step_matrix(0.002, -K)) ** 3 - np.linalg.det(step_matrix(0.001, -K)) ** 6) > 1e-6


def test_a_run_that_goes_on_in_pieces_or_from_a_saved_state_is_one_run(cache, steps, monkeypatch):
    diagram = spring(0.02, sampled(0.003, "fast")(Clock()))
    straight = diagram.simulate(0.12, progress=False)
    with diagram.simulation() as simulation:
        simulation.advance(0.051)  # between two steps of the FMU, at a tick of the other subsystem
        half = simulation.save()
        simulation.advance(0.069)
        rest = simulation.run()
    again = diagram.simulate(0.069, start=half, progress=False)
    assert again["plant.position"].tolist() == rest["plant.position"][-len(again.t) :].tolist()
    assert rest["plant.position"][-1] == pytest.approx(straight["plant.position"][-1], rel=1e-9, abs=1e-10)
    one_step_only(monkeypatch)
    steps.clear()
    with diagram.simulation() as simulation:
        simulation.advance(0.051)
        half = simulation.save()
        simulation.advance(0.069)
    assert {h for _, h in steps} == {0.02}
    again = diagram.simulate(0.069, start=half, progress=False)
    assert again["plant.position"][-1] == straight["plant.position"][-1]


def test_an_fmu_of_one_step_length_goes_by_its_own_base_and_says_so(cache, steps, monkeypatch):
    one_step_only(monkeypatch)
    mass = plant()
    others = [sampled(0.006, "b")(mass.position), sampled(0.001, "fast")(Clock())]
    run = Diagram("d", mass(force=0.0), sampled(0.004, "a")(mass.position), *others).simulate(0.024, progress=False)
    assert [h for _, h in steps] == [0.002] * 12
    assert not run.messages  # the fastest subsystem acts more often


def test_an_fmu_in_a_sampled_subsystem_steps_at_its_ticks(cache, steps):
    inner = plant()

    @subsystem(sample_time=0.02)
    def box(force):
        inner(force=force)
        return inner.position

    Diagram("d", box(0.0), sampled(0.003, "fast")(Clock())).simulate(0.1, progress=False)
    assert len(steps) == 5


# --- communication steps of their own -----------------------------------------------------------------------------------


def own(h):
    return plant(stepping=StepOptions(communication_step=h))


def integral_control(stepped, *more):
    """A mass that a fast controller pulls to zero, by the integral of the position that it sees."""

    @subsystem(sample_time=1e-3)
    def controller(position):
        return Gain(gain=-200.0, name="gain")(Integrator(name="integral")(position))

    return Diagram("d", stepped(force=controller(stepped.position)), *more)


@pytest.mark.parametrize("between", [False, True], ids=["ticks", "solver"])
def test_an_fmu_has_a_communication_step_of_its_own(cache, steps, between):
    """Over its 4 ms the controller adds up the held position four times; the force is that of the FMU's own ticks."""
    more = [Integrator(name="aside")(Clock())] if between else []
    diagram = integral_control(own(4e-3), *more)
    run = diagram.simulate(0.04, progress=False)
    assert [round(t / 4e-3) for t, _ in steps] == list(range(10))
    big = np.zeros((3, 3))
    big[:2, :2], big[:2, 2] = A, B
    whole = expm(big * 4e-3)
    M = np.eye(3)
    M[:2, :2], M[:2, 2], M[2, 0] = whole[:2, :2], -200.0 * whole[:2, 2], 4e-3
    expected = [np.linalg.matrix_power(M, k) @ [*START, 0.0] for k in range(11)]
    assert run["plant.position"] == pytest.approx([expected[k // 4][0] for k in range(41)], rel=1e-9, abs=1e-10)
    if not between:
        model = diagram.linearize()
        assert model.dt == pytest.approx(4e-3)
        found = [z for z in model.poles if abs(z) > 1e-9]
        assert np.sort_complex(found) == pytest.approx(np.sort_complex(np.linalg.eigvals(M)), abs=1e-9)
        seen = diagram.linearize(inputs="plant.force", outputs="controller.integral.y")
        assert [z for z in seen.poles if abs(z) > 1e-9] == pytest.approx(found, abs=1e-9)


def test_a_linear_model_holds_the_outputs_of_an_fmu_between_its_steps(cache):
    """The acceleration that the controller sees is that under the force of the last step, not of the one that goes on."""
    mass = own(4e-3)

    @subsystem(sample_time=1e-3)
    def controller(acceleration):
        return Gain(gain=-200.0, name="gain")(Integrator(name="integral")(acceleration))

    diagram = Diagram("d", mass(force=controller(mass.acceleration)))
    big = np.zeros((3, 3))
    big[:2, :2], big[:2, 2] = A, B
    whole = expm(big * 4e-3)
    M = np.zeros((4, 4))  # position, velocity, integral, force of the last step
    M[:2, :2], M[:2, 2], M[3, 2] = whole[:2, :2], -200.0 * whole[:2, 2], -200.0
    M[2] = 4e-3 * np.array([*A[1], 0.0, B[1]])
    M[2, 2] = 1.0
    found = [z for z in diagram.linearize().poles if abs(z) > 1e-9]
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(np.linalg.eigvals(M)), abs=1e-9)


def test_an_own_communication_step_is_a_clock_and_must_fit_the_others(cache, steps):
    alone = own(0.01)
    run = Diagram("d", alone(force=0.0)).simulate(0.1, progress=False)
    assert len(run.t) == 11
    assert len(steps) == 10
    two = Diagram("d", own(0.02).replace(name="a")(force=0.0), own(0.03).replace(name="b")(force=0.0))
    assert two.flatten().base == Fraction(1, 100)
    with pytest.raises(SampleTimeError, match=r"a: its communication step 0\.02 s is no multiple of the step 0\.015 s"):
        two.flatten(0.015)
    with pytest.raises(ParameterError, match="expected seconds, positive"):
        StepOptions(communication_step=-1.0)
    with pytest.raises(OptionError, match="plant has its own communication points, fewer than the run has ticks"):
        spring(0.01, stepped=own(0.02)).simulate(0.1, progress=False, coupling="gauss_seidel")


def test_delays_of_an_fmu_with_a_longer_communication_step(cache):
    found = {c.target: c for c in integral_control(own(4e-3)).report_coupling().connections}
    assert found["plant.force"].step == found["controller.integral.u"].step == 4e-3
    assert found["plant.force"].delay == found["controller.integral.u"].delay == pytest.approx(1.5e-3)  # 0, 1, 2, 3 ms


def test_a_point_between_two_steps_of_an_fmu_of_one_length_is_refused(cache, monkeypatch):
    one_step_only(monkeypatch)
    diagram = spring(0.02, sampled(0.003, "fast")(Clock()))
    with pytest.raises(
        OptionError, match=r"^plant\.operating point, t = 0\.051 s: .* point at 0\.04 s to that at 0\.06 s"
    ):
        diagram.linearize(0.051)
    assert diagram.operating_point(0.06).plants["plant"]["t"] == pytest.approx(0.06)
    monkeypatch.undo()  # any other steps to the point
    assert diagram.operating_point(0.051).plants["plant"]["t"] == pytest.approx(0.051)
