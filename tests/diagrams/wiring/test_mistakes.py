"""Every wiring mistake is an error when the diagram is built, and its text ends the hunt."""

import pickle
from fractions import Fraction

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    DoubleDriveError,
    Gain,
    Input,
    Integrator,
    Output,
    ParameterError,
    RateLimiter,
    SampleTimeError,
    Saturation,
    ShapeError,
    Sine,
    State,
    StateFeedback,
    Step,
    Sum,
    TraceError,
    TransportDelay,
    UnitDelay,
    UnitError,
    UnknownNameError,
    UnwiredInputError,
    WiringError,
    parameter,
)
from loopwright.diagrams import AlgebraicLoopError, Diagram, DuplicateNameError, experiments, subsystem
from loopwright.fmus import Fmu, gantry
from support.closed_form import closed_form_fmu


class Lag(Block):
    """First-order lag."""

    time_constant: float = parameter(unit="s", above=0.0)
    u = Input()
    y = State(output=True)

    def derivative(self, t, x, u):
        return (u.u - x.y) / self.time_constant


class Lead(Block):
    """One input feeds through to one of two outputs only."""

    u = Input()
    direct = Output()
    kept = Output()
    state = State()

    def output(self, t, x, u):
        return 2.0 * u.u, 3.0 * x.state

    def update(self, t, x, u):
        return u.u


def text(error):
    return str(error.value)


# --- calls ------------------------------------------------------------------------------------------------------------


def test_a_required_input_left_out_is_named_with_the_call_that_was_expected():
    with pytest.raises(UnwiredInputError) as error:
        Sum(signs="+-", name="error")(Sine(frequency=1))
    assert text(error) == "error.u2: nothing is wired to 'u2'; expected error(u1=…, u2=…)."
    assert error.value.block == "error"
    assert error.value.port == "u2"


def test_an_output_used_of_a_block_that_is_never_called():
    lag = Lag(time_constant=1, name="lag")
    with pytest.raises(
        UnwiredInputError, match=r"^lag\.u: an output of this block is used, but the block is never called"
    ):
        Diagram("d", Gain(gain=2)(lag.y))


def test_an_unknown_input_offers_near_names():
    with pytest.raises(
        UnknownNameError, match=r"it has no input 'u3'\. Did you mean 'u2' or 'u1'\?|Did you mean 'u1' or 'u2'"
    ):
        Sum(signs="+-")(u1=Constant(value=1), u3=Constant(value=1))


def test_an_input_driven_twice_in_one_call():
    with pytest.raises(DoubleDriveError, match=r"gain\.u: it is driven twice in one call"):
        Gain(gain=2)(Constant(value=1), u=Constant(value=2))


def test_a_block_called_twice_is_an_error_that_offers_replace():
    gain = Gain(gain=2, name="k")
    with pytest.raises(DoubleDriveError, match=r"k: this block is called twice in one diagram.*k\.replace\(\)"):
        Diagram("d", Sum()(gain(Constant(value=1)), gain(Constant(value=2))))


def test_the_variant_from_replace_is_another_node():
    gain = Gain(gain=2)
    diagram = Diagram("d", Sum()(gain(Constant(value=1)), gain.replace()(Constant(value=2))).named("y"))
    assert diagram.simulate(0.1, step=0.1, progress=False)["y"].tolist() == [6.0, 6.0]


def test_too_many_signals():
    with pytest.raises(WiringError, match=r"gain: 2 signals for 1 inputs \(u\)"):
        Gain(gain=1)(Constant(value=1), Constant(value=1))


def test_something_that_is_no_signal():
    with pytest.raises(
        WiringError,
        match=r"gain\.u: found 'speed'; expected a signal, a call, a block with one output, finite numbers, or a list",
    ):
        Gain(gain=1)("speed")
    with pytest.raises(WiringError, match=r"gain\.u: found nan; expected .* finite numbers"):
        Gain(gain=1)(float("nan"))


def test_a_call_with_two_outputs_is_not_one_signal():
    with pytest.raises(WiringError, match=r"lead: it has 2 outputs \(direct, kept\)"):
        Gain(gain=1)(Lead()(Constant(value=1)))


def test_an_unknown_output_offers_near_names():
    with pytest.raises(AttributeError, match=r"lead: it has no output 'dirct'\. Did you mean 'direct'\?"):
        _ = Lead()(Constant(value=1)).dirct


def test_naming_needs_one_name_for_each_output():
    with pytest.raises(WiringError, match=r"lead: 1 names for 2 outputs \(direct, kept\)"):
        Lead()(Constant(value=1)).named("a")


def test_a_block_used_as_a_signal_before_it_is_wired():
    with pytest.raises(WiringError, match=r"gain: it is used as a signal before it is wired"):
        Gain(gain=1)(Gain(gain=2))


# --- parameters -------------------------------------------------------------------------------------------------------


def test_an_unknown_parameter_offers_near_names():
    with pytest.raises(ParameterError, match=r"Lag has no parameter 'time_konstant'\. Did you mean 'time_constant'\?"):
        Lag(time_konstant=1)


@pytest.mark.parametrize("value", [0.0, -1.0])
def test_a_parameter_out_of_bounds_says_the_bound(value):
    with pytest.raises(ParameterError, match=r"expected a value above 0 in s"):
        Lag(time_constant=value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), [1.0, 2.0], "1", None])
def test_a_parameter_that_is_no_finite_number(value):
    with pytest.raises(ParameterError, match=r"Lag\.time_constant: found .*; expected"):
        Lag(time_constant=value)


def test_a_block_is_a_value():
    lag = Lag(time_constant=2, name="lag")
    assert lag == Lag(time_constant=2.0)
    assert hash(lag) == hash(Lag(time_constant=2.0))
    assert lag != lag.replace(time_constant=3)
    assert pickle.loads(pickle.dumps(Gain(gain=[1.0, 2.0]))) == Gain(gain=(1, 2))
    assert repr(lag) == "Lag(time_constant=2, name='lag')"
    with pytest.raises(ParameterError, match=r"is a value and can't be changed; use \.replace\(time_constant=…\)"):
        lag.time_constant = 3
    assert not Gain(gain=[1.0, 2.0]).gain.flags.writeable


class WithParameter(Block):
    """Has a parameter u."""

    u: float = 1.0


def test_a_parameter_and_a_port_may_not_share_a_name():
    with pytest.raises(ValueError, match=r"Clash\.u: a port and a parameter share this name"):

        class Clash(WithParameter):
            u = Input()


# --- shapes and units -------------------------------------------------------------------------------------------------


class Meter(Block):
    """Wants metres."""

    u = Input(shape=(2,), unit="m")
    y = Output(unit="m")

    def output(self, t, x, u):
        return u.u[0]


def test_a_wrong_shape_names_both_ends():
    with pytest.raises(ShapeError, match=r"^meter\.u: source\.y has shape \(3,\); expected \(2,\)"):
        Diagram("d", Meter()(Constant(value=(1, 2, 3), name="source")))


def test_an_index_out_of_range():
    with pytest.raises(
        ShapeError, match=r"gain\.u: source\.y\[4\] is out of range, counted from 1: the port has shape \(3,\)"
    ):
        Diagram("d", Gain(gain=1)(Constant(value=(1, 2, 3), name="source").y[3]))


def test_a_wrong_unit_names_both_ends_and_the_difference():
    with pytest.raises(UnitError, match=r"^meter\.u: source\.y is in N; expected in m: .*dimension"):
        Diagram("d", Meter()(Constant(value=(1, 2), unit="N", name="source")))


def test_another_scale_of_the_same_unit_says_the_factor():
    with pytest.raises(UnitError, match=r"mm.*m.*0\.001"):
        Diagram("d", Meter()(Constant(value=(1, 2), unit="mm", name="source")))


def test_a_sum_of_different_units():
    with pytest.raises(UnitError, match=r"^sum\.u2: b\.y is in m; a\.y next to it is in N"):
        Diagram("d", Sum()(Constant(value=1, unit="N", name="a"), Constant(value=1, unit="m", name="b")))


def test_a_set_point_in_another_unit_than_the_measured_value():
    """kp (r − y) of radians less degrees is a number, and a wrong one: the gain, which has no unit, can't show it."""
    measured, wish = Constant(value=1.0, unit="rad", name="measured"), Constant(value=30.0, unit="deg", name="wish")
    pid = PID(kp=1.0, name="pid")
    text = r"^pid\.y: measured\.y is in rad; wish\.y next to it is in deg: .*put Gain\(gain=57\.295"
    with pytest.raises(UnitError, match=text):
        Diagram("d", pid(wish, measured))
    Diagram("d", pid(Constant(value=0.5, unit="rad"), measured))
    Diagram("d", pid(0.5, measured))  # a plain number has no unit


def test_a_target_in_other_units_than_the_state():
    state, target = Constant(value=(1.0, 2.0), unit="m", name="at"), Constant(value=(30.0, 0.0), unit="mm", name="wish")
    feedback = StateFeedback(gain=(1.0, 2.0), name="feedback")
    text = r"^feedback\.target: wish\.y is in mm; at\.y next to it is in m: .*Gain\(gain=0\.001\)"
    with pytest.raises(UnitError, match=text):
        Diagram("d", feedback(state, target))
    Diagram("d", feedback(state, (0.0, 0.0)))


def test_a_unit_travels_through_blocks_that_keep_it():
    limited = Saturation(limit=1)(Constant(value=(1, 2), unit="N", name="source"))
    with pytest.raises(UnitError, match=r"saturation\.y is in N; expected in m"):
        Diagram("d", Meter()(limited))


# --- names ------------------------------------------------------------------------------------------------------------


def test_two_blocks_of_one_name():
    with pytest.raises(DuplicateNameError, match=r"^a: two blocks or subsystems are called 'a'"):
        Diagram("d", Sum()(Constant(value=1, name="a"), Constant(value=2, name="a")))


def test_two_wires_of_one_name():
    with pytest.raises(DuplicateNameError, match=r"two wires are called 'w' here: a\.y and b\.y"):
        Diagram("d", Sum()(Constant(value=1, name="a").y.named("w"), Constant(value=2, name="b").y.named("w")))


def test_unnamed_blocks_are_numbered_and_given_names_win():
    diagram = Diagram("d", Sum(signs="+++")(Constant(value=1), Constant(value=2, name="constant"), Constant(value=3)))
    assert sorted(diagram.blocks) == ["constant", "constant_2", "constant_3", "sum"]
    assert diagram["constant"].value == 2


def test_two_uses_of_one_subsystem_need_two_names():
    @subsystem(sample_time=0.1)
    def twice(u):
        return Gain(gain=2)(u)

    with pytest.raises(DuplicateNameError, match="twice"):
        Diagram("d", Sum()(twice(Constant(value=1)), twice(Constant(value=2))))
    diagram = Diagram("d", Sum()(twice(Constant(value=1)), twice.replace(name="again")(Constant(value=2))).named("y"))
    assert diagram.simulate(0.1, progress=False)["y"].tolist() == [6.0, 6.0]
    assert {"twice.gain", "again.gain"} <= set(diagram.blocks)


def test_a_name_that_stands_for_several_lists_them():
    @subsystem(sample_time=0.1)
    def a(u):
        return Gain(gain=2)(u)

    run = Diagram("d", Sum()(a(Constant(value=1)), a.replace(name="b")(Constant(value=2)))).simulate(
        0.1, progress=False
    )
    with pytest.raises(UnknownNameError, match=r"'gain\.y' stands for several signals: a\.gain\.y, b\.gain\.y"):
        run["gain.y"]
    with pytest.raises(UnknownNameError, match="Did you mean"):
        run["gian.y"]


# --- subsystems, order, loops -----------------------------------------------------------------------------------------


def test_a_closing_call_in_a_subsystem_counts_although_nobody_uses_its_result():
    @subsystem(sample_time=0.5)
    def counter(start):
        count = UnitDelay(initial_value=0.0, name="count")
        count(Sum(name="next")(count.y, start))
        return count.y

    run = Diagram("d", counter(Constant(value=1))).simulate(2.0, progress=False)
    assert run["count.y"].tolist() == [0, 1, 2, 3, 4]


def test_a_cycle_that_is_no_loop_at_port_level_is_accepted_through_a_border():
    @subsystem(sample_time=0.1)
    def inner(u):
        lead = Lead(name="lead")(u)
        return lead.direct, lead.kept

    @subsystem(sample_time=0.1)
    def outer(r):
        gain = Gain(gain=0.5, name="half")
        direct, kept = inner(gain.y)
        gain(Sum(name="s")(kept, r))
        return direct

    run = Diagram("d", outer(Constant(value=1.0)).named("y")).simulate(0.3, progress=False)
    # kept[k] = 3 s[k], half = (kept + 1)/2, s[k+1] = half, direct = 2 half: exactly 1, 2.5, 4.75, 8.125
    assert run["y"].tolist() == [1.0, 2.5, 4.75, 8.125]


def test_an_algebraic_loop_is_printed_port_by_port():
    gain = Gain(gain=0.5, name="k")
    with pytest.raises(AlgebraicLoopError) as error:
        Diagram("d", gain(Sum(name="s")(gain.y, Constant(value=1.0))))
    assert text(error).splitlines()[1:5] == [
        "  s.y is wired to k.u",
        "  k.u feeds through to k.y",
        "  k.y is wired to s.u1",
        "  s.u1 feeds through to s.y",
    ]
    assert "put a UnitDelay" in text(error)


def test_initial_values_that_wait_for_each_other_are_an_error_of_their_own():
    @subsystem(sample_time=0.1)
    def box(r):
        delay = UnitDelay(name="delay")
        delay(Sum(name="s")(delay.y, r))
        return delay.y

    with pytest.raises(AlgebraicLoopError) as error:
        Diagram("d", box(Constant(value=1.0)))
    assert text(error) == (
        "box.delay: initial values depend on each other:\n"
        "  box.s.y is wired to box.delay.u\n"
        "  box.delay.u feeds through to box.delay.y\n"
        "  box.delay.y is wired to box.s.u1\n"
        "  box.s.u1 feeds through to box.s.y\n"
        "Break the loop where a delay is real: put a UnitDelay(initial_value=…) on one of these wires."
    )


def test_a_sampled_block_in_a_continuous_frame():
    with pytest.raises(
        SampleTimeError, match=r"delay: a sampled block is in a continuous subsystem; put it into a @subsystem"
    ):
        Diagram("d", UnitDelay(initial_value=0, name="delay")(Constant(value=1)))


def test_a_block_at_samples_alone_has_no_continuous_ideal_and_can_be_replaced():
    class Ideal(Block):
        u, y = Input(), Output()

        def output(self, t, x, u):
            return u.u

    @subsystem(sample_time=0.1)
    def delayed(u):
        return 3.0 * UnitDelay(initial_value=0.0, name="delay")(UnitDelay(initial_value=0.0, name="first")(u))

    diagram = Diagram("d", delayed(Constant(value=2.0)).named("y"))
    with pytest.raises(SampleTimeError, match=r"^delayed\.(delay|first): continuous\(\) takes the sample") as refused:
        diagram.continuous()
    for words in ("UnitDelay", "the inputs u and the outputs y", "So are delayed.", "diagram.replace({'delayed."):
        assert words in str(refused.value)
    ideal = diagram.replace({"delayed.delay": Ideal(), "delayed.first": Ideal()}).continuous()
    assert not ideal.wired.has_clock
    np.testing.assert_array_equal(ideal.simulate(1.0, step=0.1, progress=False)["y"], 6.0)


def test_a_block_that_needs_more_in_continuous_time_says_that_its_sample_time_was_taken():
    @subsystem(sample_time=0.1)
    def limited(u):
        return RateLimiter(rising=1.0, name="rate")(u)

    diagram = Diagram("d", limited(Constant(value=2.0)))
    words = r"^limited\.rate\.time_constant: continuous\(\) takes the sample times away: found none; expected a lag"
    with pytest.raises(SampleTimeError, match=words):
        diagram.continuous()
    assert not diagram.replace({"rate.time_constant": 0.01}).continuous().wired.has_clock


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0, "positive"),
        (-1e-3, "positive"),
        ("fast", "expected seconds"),
        (True, "expected seconds"),
        (1e-10, "multiple of 1 ns"),
    ],
)
def test_a_bad_sample_time(value, words):
    with pytest.raises(SampleTimeError, match=words):
        subsystem(sample_time=value)(lambda u: Gain(gain=1)(u))


def test_a_float_sample_time_is_its_shortest_decimal():
    @subsystem(sample_time=0.0007)
    def box(u):
        return Gain(gain=1)(u)

    assert box.sample_time == Fraction(7, 10000)


def test_without_a_clock_the_step_that_an_fmu_suggests_is_named(tmp_path):
    """An exported controller of 0.4 ms beside blocks in continuous time; 1e-3 would have given its inputs late."""
    file = closed_form_fmu(
        tmp_path,
        3,
        "dx[0] = u[0] - x[0]; y[0] = x[0];",
        description=[("<ModelVariables>", '<DefaultExperiment stepSize="4e-4"/><ModelVariables>')],
    )
    plant = Fmu(file, name="plant")
    with pytest.raises(SampleTimeError, match=r"step=0\.0004\), which an FMU's default experiment has"):
        Diagram("d", Integrator()(plant(u1=1.0))).simulate(1.0, progress=False)


def test_no_clock_at_all():
    diagram = Diagram("d", Gain(gain=1)(Constant(value=1)))
    assert len(diagram.simulate(1.0, progress=False).t) == 1001
    with pytest.raises(SampleTimeError, match=r"^d: no subsystem has a sample time.*step=1e-3"):
        diagram.simulation()
    with pytest.raises(SampleTimeError, match=r"^d: no subsystem has a sample time.*step=1e-3"):
        diagram.simulate(1.0, solver="rk4", progress=False)


def test_two_rates_hold_between_their_ticks_and_never_drift():
    def ticks(name):
        def count(one):
            delay = UnitDelay(initial_value=0.0, name="n")
            delay(Sum(name="next")(delay.y, one))
            return delay.y

        count.__name__ = name
        return count

    a = subsystem(sample_time=1e-3)(ticks("a"))(Constant(value=1.0))
    b = subsystem(sample_time=0.7e-3)(ticks("b"))(Constant(value=1.0))
    diagram = Diagram("d", a.named("a"), b.named("b"))
    run = diagram.simulate(2.1, step=1e-4, progress=False)
    k = np.arange(len(run.t))
    assert diagram.flatten().base == Fraction(1, 10000)
    assert np.array_equal(run["a"], k // 10)
    assert np.array_equal(run["b"], k // 7)
    assert np.array_equal(run.t, k / 10000)
    sparse = diagram.simulate(2.1, progress=False)
    visited = (k % 10 == 0) | (k % 7 == 0)
    assert np.array_equal(sparse.t, run.t[visited])
    assert np.array_equal(sparse["a"], run["a"][visited])
    assert np.array_equal(sparse["b"], run["b"][visited])


def test_signals_in_sums_products_and_quotients():
    a, b = Constant(value=(6.0, 8.0), name="a"), Constant(value=(1.0, 2.0), name="b")
    y = (-(a - b) * b + 2 * a / 4 + np.array([10.0, 20.0]) - np.ones(2) * a[1]).named("y")
    run = Diagram("d", y).simulate(0.1, step=0.1, progress=False)
    assert run["y"][-1].tolist() == [0.0, 4.0]
    with pytest.raises(ShapeError, match=r"Apply a matrix as K @ signal"):
        _ = a.y * np.eye(2)


def test_a_change_at_t0_acts_at_the_first_tick_at_or_after_t0():
    run = Diagram("d", Step(times=(0.3, 0.65), values=(1, 2)).y.named("y")).simulate(0.8, step=0.1, progress=False)
    assert run["y"].tolist() == [0, 0, 0, 1, 1, 1, 1, 2, 2]


def test_results_do_not_depend_on_the_order_of_definition():
    def build(swap):
        a, b = Sine(frequency=1.3, name="a"), Sine(frequency=0.7, name="b")
        left, right = Gain(gain=0.3, name="l")(a), Gain(gain=0.7, name="r")(b)
        product = (lambda: Sum(name="s")(left, right))()
        extra = Gain(gain=3.0, name="x")(product)
        return Diagram("d", product, extra) if swap else Diagram("d", extra, product, right, left)

    one, two = (build(swap).simulate(1.0, step=0.01, progress=False) for swap in (False, True))
    assert one.layout.slices == two.layout.slices
    assert np.array_equal(one.data, two.data)


def test_a_linear_block_in_a_sampled_frame_is_exact():
    @subsystem(sample_time=0.25)
    def box(u):
        return Lag(time_constant=0.5, name="lag")(u)

    run = Diagram("d", box(Constant(value=1.0)).named("y")).simulate(2.0, progress=False)
    assert np.max(np.abs(run["y"] - (1 - np.exp(-run.t / 0.5)))) < 1e-14


class Circling(Block):
    """Two states that drive each other, each with a rate that is not linear."""

    first = State(start=1.0, output=True)
    second = State(start=0.5, output=True)

    def derivative(self, t, x, u):
        return -x.second * np.abs(x.second), x.first * np.abs(x.first)


def circling(method):
    """The recurrence by hand, in ticks of a quarter of a second."""
    a, b, rows = 1.0, 0.5, []
    for _ in range(9):
        rows.append((a, b))
        new = b + 0.25 * a * abs(a)  # both start from the old first state
        used = new if method == "semi_implicit" else b
        a, b = a - 0.25 * used * abs(used), new
    return np.array(rows)


@pytest.mark.parametrize("method", ["forward", "semi_implicit"])
def test_euler_methods_by_name(method):
    @subsystem(sample_time=0.25, method=method)
    def box():
        return Circling(name="c")()

    run = Diagram("d", *box()).simulate(2.0, progress=False)
    got = np.stack([run["c.first"], run["c.second"]], axis=1)
    np.testing.assert_allclose(got, circling(method), rtol=0, atol=1e-14)
    assert np.abs(circling("forward") - circling("semi_implicit")).max() > 0.1


def test_a_whole_diagram_can_be_pickled():
    @subsystem(sample_time=0.25)
    def box(u):
        return Lag(time_constant=0.5, name="lag")(u)

    diagram = Diagram("d", box(Constant(value=1.0)).named("y"))
    again = pickle.loads(pickle.dumps(diagram))
    assert np.array_equal(again.simulate(1.0, progress=False).data, diagram.simulate(1.0, progress=False).data)


# --- replace ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def lagged():
    @subsystem(sample_time=0.25)
    def box(u):
        return Lag(time_constant=0.5, name="lag")(u)

    return Diagram("d", box(Constant(value=1.0, name="one")).named("y"))


def test_replace_reaches_parameters_rates_and_blocks_by_path(lagged):
    def last(diagram):
        return diagram.simulate(1.0, progress=False)["y"][-1]

    assert last(lagged.replace({"box.lag.time_constant": 1.0})) == pytest.approx(1 - np.exp(-1), abs=1e-14)
    assert last(lagged.replace(time_constant=1.0)) == pytest.approx(1 - np.exp(-1), abs=1e-14)
    assert last(lagged.replace(one=Constant(value=2.0))) == pytest.approx(2 * (1 - np.exp(-2)), abs=1e-14)
    faster = lagged.replace({"box.sample_time": 0.125}).simulate(1.0, progress=False)
    assert len(faster.t) == 9
    assert faster["y"][-1] == pytest.approx(1 - np.exp(-2), abs=1e-14)
    assert last(lagged) == pytest.approx(1 - np.exp(-2), abs=1e-14)  # unchanged


def test_replace_with_an_unknown_name_offers_near_ones(lagged):
    with pytest.raises(UnknownNameError, match=r"nothing is called 'time_konstant' .*"):
        lagged.replace(time_konstant=1.0)
    with pytest.raises(UnknownNameError, match=r"no parameter 'time_konst'.*time_constant"):
        lagged.replace({"box.lag.time_konst": 1.0})


def test_a_block_in_place_of_a_subsystem_is_told_that_it_is_one(lagged):
    with pytest.raises(UnknownNameError, match=r"'box' is a subsystem, .*Replace a block in it \(box\.lag\)"):
        lagged.replace(box=Lag(time_constant=1.0))


def test_replacing_a_block_by_one_that_does_not_fit_the_wires(lagged):
    with pytest.raises(WiringError, match="box.lag|one"):
        lagged.replace(one=Constant(value=(1.0, 2.0)))


# --- equations that don't trace ---------------------------------------------------------------------------------------


def test_an_equation_that_cannot_be_traced_says_the_line():
    import math

    class Bad(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return math.sin(u.u)

    with pytest.raises(
        TraceError, match=r"bad: its output can't be traced in line \d+ of .*test_mistakes\.py.*np\.sin for math\.sin"
    ):
        Diagram("d", Bad()(Constant(value=1.0)))


def test_an_equation_that_traces_wrongly_is_found_by_comparison_with_numpy():
    class Halves(Block):
        u = Input(shape=(4,))
        y = Output(shape=(4,))

        def output(self, t, x, u):
            return np.round(np.floor(u.u) + 0.5)  # NumPy rounds halves to even, the trace away from zero

    with pytest.raises(TraceError, match=r"halves: it uses np\.round or np\.rint, .* Write np\.floor\(v \+ 0\.5\)"):
        Diagram("d", Halves()(Constant(value=(1.0, 2.0, 3.0, 4.0))))


def test_an_equation_that_traces_to_another_shape_is_found():
    class Tiled(Block):
        u = Input(shape=(4,))
        y = Output(shape=None)

        def output(self, t, x, u):
            return np.tile(u.u, (2, 1))[0]

    with pytest.raises(TraceError, match=r"tiled: its traced equation gives 1 numbers for 'y' where NumPy gives 4"):
        Diagram("d", Tiled()(Constant(value=(1.0, 2.0, 3.0, 4.0))))


def test_an_equation_of_another_shape_than_declared():
    class Wide(Block):
        u = Input()
        y = Output()

        def output(self, t, x, u):
            return np.stack([u.u, u.u])

    with pytest.raises(ShapeError, match=r"wide\.y: its output gives shape \(2,\); expected \(\)"):
        Diagram("d", Wide()(Constant(value=1.0)))


def test_a_name_given_outside_a_box_belongs_to_where_it_is_given():
    @subsystem(sample_time=0.1)
    def split(u):
        return Gain(gain=1.0)(u), Gain(gain=2.0)(u)

    left, right = split(Constant(value=1.0)).named("left", "right")
    assert sorted(Diagram("d", left, right).names) == ["left", "right"]


def test_a_part_that_is_not_there_is_refused_on_a_named_wire():
    with pytest.raises(
        ShapeError, match=r"constant\.y\[6\] is out of range, counted from 1: the port has shape \(2,\)"
    ):
        Diagram("d", Constant(value=(1.0, 2.0)).y[5].named("a"))


def test_a_parameter_that_is_a_block_itself_is_replaced_by_its_path():
    diagram = experiments.path_following().diagram
    light = gantry.nominal.replace(coulomb_scale=0.0)
    changed = diagram.replace({"feedback_linearization.model": light})
    assert changed["feedback_linearization"].model == light
    assert list(changed.blocks) == list(diagram.blocks)


def test_the_delay_of_a_block_is_found_by_its_short_name():
    diagram = Diagram("d", TransportDelay(delay=0.5, name="late")(Constant(value=1.0)))
    assert diagram.replace(delay=0.25)["late"].delay == 0.25
