"""One definition, ideal and sampled: ``continuous()``, ``sampled()``, and a box's options replaced."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Block,
    Circle,
    Clock,
    Constant,
    Delay,
    EdgeDetector,
    Function,
    Gain,
    Integrator,
    LoopwrightError,
    OptionError,
    ParameterError,
    PathProjection,
    SampleTimeError,
    Saturation,
    SimulationError,
    Sine,
    State,
    StateSpace,
    Step,
    Sum,
    TransportDelay,
    UnitDelay,
    UnknownNameError,
    WiringError,
)
from loopwright.diagrams import AlgebraicLoopError, Diagram, experiments, subsystem
from support.hybrid_blocks import TIGHT, Ball, Lag, counting

A = np.array([[0.0, 1.0], [-9.0, -0.6]])
B = np.array([0.0, 9.0])


def drive(sample_time=0.02, **options):
    """Return a PI controller, sampled, around a damped oscillator."""
    plant = StateSpace(A=A, B=B, C=np.array([1.0, 0.0]), D=0.0, name="plant")

    @subsystem(sample_time=sample_time, **options)
    def control(e):
        return Gain(gain=0.2, name="kp")(e) + Gain(gain=0.8, name="ki")(Integrator(name="i")(e))

    return Diagram("drive", plant(control(Step(times=0.1, values=1.0) - plant.y)))


def ideal(t):
    """Return the plant's output with the ideal controller, from the matrix exponential; the step comes at 0.1 s."""
    closed = np.array([[0, 1, 0, 0], [-9 - 9 * 0.2, -0.6, 9 * 0.8, 9 * 0.2], [-1, 0, 0, 1], [0, 0, 0, 0.0]])
    return np.array([(expm(closed * max(s - 0.1, 0)) @ [0, 0, 0, 1])[0] for s in t])


def test_continuous_is_the_ideal_controller():
    run = drive().continuous().simulate(3.0, step=0.05, **TIGHT)
    assert np.max(np.abs(run["plant.y"] - ideal(run.t))) < 1e-11


@pytest.mark.slow
def test_the_sampled_controller_tends_to_the_ideal_one():
    errors = []
    for T in (0.02, 0.01, 0.005):
        run = drive(T).simulate(3.0, step=0.005, rtol=1e-10, atol=1e-12, progress=False)
        errors.append(np.max(np.abs(run["plant.y"] - ideal(run.t))))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(1.0, abs=0.15)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(1.0, abs=0.15)


def test_continuous_takes_away_offsets_and_computational_delays():
    run = drive(0.02, offset=0.01, delay=3).continuous().simulate(3.0, step=0.05, **TIGHT)
    assert np.max(np.abs(run["plant.y"] - ideal(run.t))) < 1e-11


def test_sampled_is_the_exact_hold_of_linear_blocks():
    """All of it at one rate: the plant's zero-order hold and the integrator's, closed by hand."""
    run = drive().sampled(0.02).simulate(3.0, progress=False)
    assert len(run.t) == 151
    phi = expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * 0.02)
    x, z, y = np.zeros(2), 0.0, []
    for k in range(151):
        y.append(x[0])
        e = (k >= 5) - x[0]
        u = 0.2 * e + 0.8 * z
        x, z = phi[:2, :2] @ x + phi[:2, 2] * u, z + 0.02 * e
    assert np.max(np.abs(run["plant.y"] - y)) < 1e-13


@pytest.mark.parametrize(
    ("method", "growth"),
    [("exact", np.exp(-0.5)), ("forward", 0.5), ("trapezoidal", (1 - 0.25) / (1 + 0.25))],
)
def test_sampled_discretizes_by_the_method_that_is_asked_for(method, growth):
    run = (
        Diagram("d", Lag(name="lag", k=5.0, start=1.0)(Constant(value=0.0)))
        .sampled(0.1, method=method)
        .simulate(1.0, progress=False)
    )
    assert np.max(np.abs(run["lag.y"] - growth ** np.arange(11))) < 1e-14


@pytest.mark.parametrize(("method", "order"), [("forward", 1), ("semi_implicit", 1), ("trapezoidal", 2)])
def test_a_method_for_blocks_that_are_not_linear_has_its_order(method, order):
    """ẏ = −y³, y(0) = 1: y = 1/√(1 + 2 t)."""

    class Cubic(Block):
        y = State(output=True, start=1.0)

        def derivative(self, t, x, u):
            return -(x.y**3)

    errors, n = [], (50, 100, 200)
    for steps in n:
        run = Diagram("d", Cubic(name="cubic")).sampled(2.0 / steps, method=method).simulate(2.0, progress=False)
        errors.append(abs(run["cubic.y"][-1] - 1 / np.sqrt(5.0)))
    assert -np.polyfit(np.log(n), np.log(errors), 1)[0] == pytest.approx(order, abs=0.2)


def test_sampled_leaves_boxes_with_a_rate_of_their_own_alone():
    diagram = Diagram("d", counting(0.3, "slow")().named("n"), Lag(name="lag")(Constant(value=1.0))).sampled(0.1)
    run = diagram.simulate(0.9, progress=False)
    assert run["n"].tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3, 4]
    assert np.max(np.abs(run["lag.y"] - (1 - np.exp(-run.t)))) < 1e-15


def test_there_and_back():
    diagram = drive()
    again = diagram.continuous().sampled(0.02)
    assert again.subsystems["control"].sample_time is None
    assert np.array_equal(
        again.simulate(1.0, progress=False)["plant.y"], diagram.sampled(0.02).simulate(1.0, progress=False)["plant.y"]
    )


def test_variants_change_neither_the_diagram_nor_each_other():
    diagram = drive()
    before = diagram.simulate(0.5, progress=False).data
    diagram.continuous()
    diagram.sampled(0.1, method="forward")
    assert np.array_equal(diagram.simulate(0.5, progress=False).data, before)


@pytest.mark.parametrize(
    ("changes", "more"),
    [
        ({"control.kp.gain": 1.0, "kp.gain": 2.0}, {}),
        ({"plant.D": 1.0, "D": 2.0}, {}),
        ({"kp": Gain(gain=1.0), "control.kp": Gain(gain=2.0)}, {}),
        ({"plant": StateSpace(A=A, B=B, C=B, D=0.0)}, {"plant": StateSpace(A=A, B=B, C=B, D=1.0)}),
    ],
)
def test_two_names_of_one_thing_are_refused_in_any_order(changes, more):
    for given in (changes, dict(reversed(changes.items()))):
        with pytest.raises(OptionError, match="found two names of one parameter, .*; give it once"):
            drive().replace(given, **more)


def test_a_block_and_a_parameter_of_it_are_both_taken_in_any_order():
    block = StateSpace(A=A, B=2 * B, C=np.array([0.0, 1.0]), D=0.0)
    changes = {"plant.C": [3.0, 0.0], "plant": block, "plant.A[2,1]": -4.0, "plant.A": [[0.0, 1.0], [-5.0, -1.0]]}
    for given in (changes, dict(reversed(changes.items()))):
        plant = drive().replace(given)["plant"]
        np.testing.assert_array_equal(plant.A, [[0.0, 1.0], [-4.0, -1.0]])
        np.testing.assert_array_equal(plant.B, 2 * B)
        np.testing.assert_array_equal(plant.C, [3.0, 0.0])


@pytest.mark.parametrize(
    ("change", "meant"),
    [
        (lambda: drive().replace({"CONTROL.Kp.Gain": 1.0}), "'control.kp.gain'"),
        (lambda: StateSpace(a=A, B=B, C=B, D=0.0), "'A'"),
        (lambda: drive().simulate(0.1)["PLANT.Y"], "'plant.y'"),
    ],
)
def test_a_name_in_other_letters_has_the_name_that_was_meant_first(change, meant):
    with pytest.raises(LoopwrightError, match=f"Did you mean {meant}"):
        change()


def test_what_is_no_block_in_a_blocks_place_names_the_block():
    with pytest.raises(
        WiringError, match=r"^control.kp: found 'x'; expected a block in its place.* of it: control\.kp\.gain"
    ):
        drive().replace({"kp": "x"})


def test_a_transport_delay_becomes_one_by_samples():
    late = TransportDelay(delay=0.3, name="late")
    i = Integrator(name="i")
    diagram = Diagram("d", i(1.0 - late(i.y)))
    run = diagram.sampled(0.1).simulate(2.0, progress=False)
    y = [0.0]
    for k in range(20):
        y.append(y[-1] + 0.1 * (1 - (y[k - 3] if k >= 3 else 0.0)))
    assert np.max(np.abs(run["i.y"] - y)) < 1e-14


@pytest.mark.parametrize("block", [UnitDelay(name="z"), Delay(steps=2, name="z"), EdgeDetector(name="z")])
def test_what_has_a_meaning_at_samples_only_is_refused_in_continuous_time(block):
    @subsystem(sample_time=0.1)
    def box(u):
        return block(u)

    diagram = Diagram("d", box(Clock()))
    with pytest.raises(SampleTimeError, match=r"box\.z"):
        diagram.continuous()


def test_what_jumps_is_refused_at_samples_where_it_has_no_update():
    with pytest.raises(SampleTimeError, match="ball"):
        Diagram("d", Ball(name="ball")).sampled(0.1)


def test_sampled_refuses_wrong_times_and_methods():
    with pytest.raises(SampleTimeError, match=r"a sample time of -0\.1 s; expected a positive one"):
        drive().sampled(-0.1)
    with pytest.raises((SampleTimeError, ParameterError), match="simpson"):
        drive().sampled(0.1, method="simpson")


@pytest.mark.slow
def test_a_loop_that_a_computational_delay_breaks_is_solved_in_continuous_time():
    e = Sum(signs="+-", name="e")

    @subsystem(sample_time=0.1, delay=1)
    def box(u):
        return Gain(gain=0.5, name="g")(u)

    diagram = Diagram("d", e(Constant(value=1.0), box(e.y)), loops="solve")
    start = 2 / 3  # what was computed first is its own input, at the start
    assert diagram.simulate(0.3, progress=False)["e.y"] == pytest.approx([start] * 4)
    assert diagram.continuous().simulate(0.1, step=0.1, progress=False)["e.y"] == pytest.approx([2 / 3, 2 / 3])
    with pytest.raises(AlgebraicLoopError, match=r"box\.delay_y: initial values depend on each other"):
        Diagram("d", e(Constant(value=1.0), box(e.y)))
    divergent = diagram.replace({"g.gain": -1.0})
    with pytest.raises(SimulationError, match=r"box\.delay_y.*its initial state depends on itself, and is not found"):
        divergent.simulate(0.3, progress=False)


@pytest.mark.slow
def test_the_papers_controller_in_continuous_time_beside_the_fmu_is_near_the_sampled_one():
    """The ideal controller, its projection solved at every evaluation; the plant steps once a millisecond."""
    diagram = experiments.path_following().diagram
    sampled = diagram.simulate(3.0, progress=False)
    run = diagram.continuous().simulate(3.0, step=1e-3, progress=False)
    assert np.array_equal(run.t, sampled.t)
    for name in ("eta", "xi"):
        assert np.max(np.abs(run[name] - sampled[name])) < 0.02 * np.max(np.abs(sampled[name]))


def test_a_continuous_diagram_with_an_fmu_needs_a_step():
    with pytest.raises(SampleTimeError, match=r"no subsystem has a sample time.*step=0\.001"):
        experiments.path_following().diagram.continuous().simulate(0.1, progress=False)


def test_functions_of_signals_are_the_same_in_both():
    diagram = Diagram("d", Function(np.tanh, name="tanh")(Sine(frequency=1.0)).named("y"))
    smooth = diagram.simulate(1.0, step=0.1, progress=False)
    assert np.array_equal(diagram.sampled(0.1).simulate(1.0, progress=False)["y"], smooth["y"])


def test_a_projection_in_continuous_time_follows_however_smooth_the_rest_is():
    position = Function(lambda t: 0.6 * np.stack([np.cos(3.0 * t), np.sin(3.0 * t)]))(Clock())
    theta = PathProjection(Circle(radius=0.5))(position).named("theta")
    run = Diagram("d", Integrator()(theta)).simulate(10.0, progress=False)
    assert np.abs(run["theta"] - 3.0 * run.t).max() < 1e-12 * 30.0  # nearly five laps, counted


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("kp", r"'kp' is a block, Gain; expected a parameter of it: control\.kp\.gain\."),
        (
            "control",
            r"'control' is a subsystem; expected a parameter of a block in it \(.*control\.kp.*control\.sample_time",
        ),
        (
            "u",
            r"'u' is a wire, from control\.kp_plus_ki\.y; expected a parameter of a block, such as its own: control\.kp_plus_ki\.signs",
        ),
    ],
)
def test_a_name_of_something_else_than_a_parameter_says_so_and_names_parameters(name, said):
    from support.public_calls import drive

    with pytest.raises(UnknownNameError, match=said):
        drive().trim(free=[name])
    if name != "kp":  # a block may be replaced as a whole
        with pytest.raises(UnknownNameError, match=said):
            drive().replace({name: 1.0})


def test_a_sweep_over_the_numbers_of_a_whole_block_is_refused_before_it_runs():
    from support.public_calls import drive

    with pytest.raises(WiringError, match=r"control\.kp: found 0\.1; expected a block in its place.*control\.kp\.gain"):
        drive().sweep({"kp": (0.1, 0.2)}, 0.1, signals="y")
    with pytest.raises(WiringError, match=r"control\.kp: .*control\.kp\.gain"):
        drive().worst_case({"kp": (0.1, 0.2)}, "u", count=2, starts=0)


@pytest.mark.parametrize("names", [("s.lower", "s.upper"), ("s.upper", "s.lower")])
def test_parameters_of_one_block_fit_together_and_need_not_one_by_one(names):
    """Limits of -1 and 1 become 2 and 3; with the lower one alone they would be refused."""
    diagram = Diagram("limited", Saturation(lower=-1.0, upper=1.0, name="s")(Constant(value=9.0, name="c")).named("y"))
    new = {"s.lower": 2.0, "s.upper": 3.0}
    changed = diagram.replace({name: new[name] for name in names})["s"]
    assert (changed.lower, changed.upper) == (2.0, 3.0)
    with pytest.raises(ParameterError, match="found lower=4 and upper=3"):
        diagram.replace({"s.lower": 4.0, "s.upper": 3.0})
    rows = [{name: new[name] for name in names}]
    found = diagram.sweep(None, 0.1, samples=rows, signals="y", workers=1, progress=False)
    assert not found.failures
    assert np.all(found["y"] == 3.0)
