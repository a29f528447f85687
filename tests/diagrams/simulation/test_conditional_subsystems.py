"""Boxes that are enabled or triggered, with an offset or a delay: at ticks, and in continuous time."""

import numpy as np
import pytest

from loopwright.blocks import (
    Clock,
    Compare,
    Constant,
    DiscreteIntegrator,
    Gain,
    Integrator,
    PulseTrain,
    Relay,
    SampleTimeError,
    ShapeError,
    Sine,
    Step,
    TransportDelay,
    UnitDelay,
    UnwiredInputError,
    WiringError,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, bouncing_ball
from support.hybrid_blocks import TIGHT, Falls, Lag, counting, decay

pytestmark = pytest.mark.both_tiers


def ideal(t0, t1):
    """Return a logic signal that is true from t0 on and false from t1 on."""
    return Step(times=(t0, t1), values=(1.0, 0.0))


def at_ticks(diagram, duration=1.0, **options):
    return diagram.simulate(duration, progress=False, **options)


# --- offset and delay -------------------------------------------------------------------------------------------------


def test_a_box_with_an_offset_acts_at_its_offset_and_every_sample_time_later():
    @subsystem(sample_time=0.1, offset=0.03)
    def box(t):
        return Gain(gain=1.0, name="g")(t)

    run = at_ticks(Diagram("d", box(Clock()).named("y")), 0.45)
    assert run.t.tolist() == [0.0, 0.03, 0.13, 0.23, 0.33, 0.43, 0.45]
    assert run["y"].tolist() == [0.0, 0.03, 0.13, 0.23, 0.33, 0.43, 0.43]


def test_before_its_first_tick_a_box_puts_out_what_it_gives_at_the_start_and_its_states_wait():
    run = at_ticks(Diagram("d", counting(0.2, offset=0.1, start=4.0)().named("n")), 0.9, step=0.1)
    assert run["n"].tolist() == [5, 5, 5, 6, 6, 7, 7, 8, 8, 9]


@pytest.mark.parametrize(("first", "second"), [(0.0, 0.05), (0.05, 0.0)])
def test_two_boxes_of_one_rate_with_different_offsets_hand_on_their_values(first, second):
    @subsystem(sample_time=0.1, offset=first, name="a")
    def a(t):
        return Gain(gain=1.0, name="g")(t)

    @subsystem(sample_time=0.1, offset=second, name="b")
    def b(u):
        return Gain(gain=1.0, name="g")(u)

    run = at_ticks(Diagram("d", b(a(Clock())).named("y")), 0.5, step=0.05)
    held_a = lambda t: np.where(t < first - 1e-9, 0.0, np.floor((t - first) / 0.1 + 1e-6) * 0.1 + first)  # noqa: E731
    held_b = lambda t: np.where(t < second - 1e-9, 0.0, np.floor((t - second) / 0.1 + 1e-6) * 0.1 + second)  # noqa: E731
    assert np.allclose(run["y"], held_a(held_b(run.t)), atol=1e-14)


def test_a_computational_delay_puts_out_what_was_computed_so_many_ticks_before():
    @subsystem(sample_time=0.1, delay=2)
    def box(t):
        return Gain(gain=1.0, name="g")(t)

    run = at_ticks(Diagram("d", box(Clock()).named("y")), 0.6)
    assert run["y"].tolist() == [0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.4]
    assert run["g.y"].tolist() == run.t.tolist()


def test_what_a_delayed_box_reads_of_its_own_outputs_is_not_delayed():
    run = at_ticks(Diagram("d", counting(0.1, delay=3)().named("late")), 0.6)
    assert run["total.y"].tolist() == [1, 2, 3, 4, 5, 6, 7]
    assert run["late"].tolist() == [1, 1, 1, 1, 2, 3, 4]


def test_a_delay_of_one_sample_in_a_loop_is_the_recursion_with_one_more_sample():
    """Y_{k+1} = a y_k + b u_{k−1}, u_k = 2 (1 − y_k)."""

    @subsystem(sample_time=0.1, delay=1)
    def control(e):
        return Gain(gain=2.0, name="g")(e)

    lag = Lag(name="lag")
    run = Diagram("loop", lag(control(1.0 - lag.y))).simulate(3.0, **TIGHT)
    a = np.exp(-0.1)
    y, u = [0.0], [2.0]
    for _ in range(30):
        before = u[-2] if len(u) > 1 else u[0]
        y.append(a * y[-1] + (1 - a) * before)
        u.append(2.0 * (1.0 - y[-1]))
    assert np.max(np.abs(run["lag.y"] - y)) < 1e-11


# --- enabled at ticks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "expected"),
    [("held", [1, 1, 1, 1, 2, 3, 3, 3, 4, 5, 6]), ("reset", [1, 1, 1, 1, 2, 3, 3, 3, 1, 2, 3])],
)
def test_an_enabled_box_acts_while_it_is_enabled_and_goes_on_or_starts_anew(mode, expected):
    enable = Step(times=(0.3, 0.6, 0.8), values=(1.0, 0.0, 1.0))
    wired = counting(0.1, enabled=mode, start=0.0)(enable=enable).named("n")
    run = at_ticks(Diagram("d", wired))
    assert run["n"].tolist() == expected  # until it is first enabled it puts out what it gives at the start: 1


def test_what_is_above_one_half_enables():
    for value, acts in ((0.5, False), (0.500001, True), (-3.0, False), (7.0, True)):
        run = at_ticks(Diagram("d", counting(0.1, enabled="held")(enable=Constant(value=value)).named("n")), 0.5)
        assert run["n"][-1] == (6 if acts else 1)


def test_a_box_in_an_enabled_one_acts_only_if_both_are_enabled():
    @subsystem(sample_time=0.1, enabled="held")
    def outer(inner_enable):
        return counting(name="inner", enabled="held")(enable=inner_enable)

    run = at_ticks(Diagram("d", outer(ideal(0.2, 0.6), enable=ideal(0.4, 0.9)).named("n")))
    assert run["n"].tolist() == [1, 1, 1, 1, 1, 2, 2, 2, 2, 2, 2]


def test_a_box_of_another_rate_in_an_enabled_one_keeps_its_rate():
    @subsystem(sample_time=0.1, enabled="held")
    def outer():
        return counting(0.2, name="inner")()

    run = at_ticks(Diagram("d", outer(enable=ideal(0.3, 0.75)).named("n")), 1.0)
    # the inner one acts at 0.4 and 0.6; what it put out at the start was a first count without a tick
    assert run["n"].tolist() == [1, 1, 1, 1, 1, 1, 2, 2, 2, 2, 2]


# --- triggered at ticks -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edge", "times"), [("rising", [0.2, 0.6]), ("falling", [0.4, 0.8]), ("both", [0.2, 0.4, 0.6, 0.8])]
)
def test_a_triggered_box_in_a_sampled_one_acts_at_the_ticks_of_its_edges(edge, times):
    @subsystem(sample_time=0.1)
    def outer(t, trigger):
        @subsystem(triggered=edge)
        def sample(t):
            return Gain(gain=1.0, name="g")(t)

        return sample(t, trigger=trigger)

    trigger = Step(times=(0.2, 0.4, 0.6, 0.8), values=(1.0, 0.0, 1.0, 0.0))
    run = at_ticks(Diagram("d", outer(Clock(), trigger).named("y")))
    expected = [max([0.0] + [s for s in times if s <= t + 1e-9]) for t in run.t]
    assert np.allclose(run["y"], expected, atol=1e-15)


def test_a_trigger_that_is_true_at_the_start_is_no_edge():
    @subsystem(sample_time=0.1)
    def outer(trigger):
        return counting(name="inner", triggered="rising")(trigger=trigger)

    trigger = Step(times=(0.2, 0.5, 0.7, 0.8), values=(0.0, 1.0, 0.0, 1.0), initial_value=1.0)
    run = at_ticks(Diagram("d", outer(trigger).named("n")))
    # what it puts out at the start is a first count without a tick: 1; its first act gives 1, too
    assert run["n"].tolist() == [1] * 8 + [2] * 3


# --- enabled in continuous time ---------------------------------------------------------------------------------------


def test_a_continuous_enabled_box_integrates_only_while_it_is_enabled():
    @subsystem(enabled="held")
    def box(u):
        return Lag(name="lag")(u)

    run = Diagram(
        "d", box(Constant(value=1.0), enable=Step(times=(0.3, 0.6, 0.85), values=(1.0, 0.0, 1.0))).named("y")
    ).simulate(1.0, step=0.05, **TIGHT)
    open_for = np.clip(run.t - 0.3, 0, 0.3) + np.clip(run.t - 0.85, 0, None)
    assert np.max(np.abs(run["y"] - (1 - decay(open_for)))) < 1e-12
    assert [(e.t, e.block, e.event) for e in run.events] == [(t, "box", "enable") for t in (0.3, 0.6, 0.85)]


def test_a_continuous_box_that_is_reset_starts_anew_at_each_opening():
    @subsystem(enabled="reset")
    def box(u):
        return Lag(name="lag", start=2.0)(u)

    enable = Step(times=(0.3, 0.6, 0.85), values=(1.0, 0.0, 1.0))
    run = Diagram("d", box(Constant(value=0.0), enable=enable).named("y")).simulate(1.0, step=0.05, **TIGHT)
    since = np.where(run.t < 0.85, np.clip(run.t - 0.3, 0, 0.3), run.t - 0.85)
    assert np.max(np.abs(run["y"] - 2 * decay(since))) < 4e-12


def test_a_box_opens_at_a_zero_crossing_between_ticks():
    @subsystem(enabled="held")
    def box(u):
        return Integrator(name="i")(u)

    wired = box(Constant(value=1.0), enable=Compare(">", name="c")(Sine(frequency=1.0), 0.5)).named("y")
    run = Diagram("d", wired).simulate(1.0, step=0.1, **TIGHT)
    assert run["y"][-1] == pytest.approx(1 / 3, abs=1e-12)  # from 1/12 to 5/12
    assert [e.t for e in run.events if e.block == "box"] == pytest.approx([1 / 12, 5 / 12], abs=1e-14)


def test_a_comparison_in_a_box_that_was_closed_is_right_again_when_it_opens():
    @subsystem(enabled="held")
    def box(u):
        return Compare(">", name="c")(u, 0.5)

    enable = Step(times=(0.3, 0.8), values=(0.0, 1.0), initial_value=1.0)
    run = Diagram("d", box(Clock(), enable=enable).named("y")).simulate(1.0, step=0.1, progress=False)
    assert run["y"].tolist() == [0.0] * 8 + [1.0] * 3
    assert [(e.t, e.block) for e in run.events] == [(0.3, "box"), (0.8, "box"), (0.8, "box.c")]


def test_a_relay_in_a_box_that_is_reset_starts_from_its_start_and_looks_at_its_input():
    @subsystem(enabled="reset")
    def box(u):
        return Relay(name="relay", on_point=0.4, off_point=0.2)(u)

    enable = Step(times=(0.5, 0.8), values=(0.0, 1.0), initial_value=1.0)
    run = Diagram("d", box(Clock(), enable=enable).named("y")).simulate(1.0, step=0.05, progress=False)
    assert np.array_equal(run["y"], np.where(run.t > 0.4 - 1e-9, 1.0, 0.0))  # at 0.4 from the right


def test_an_inner_box_follows_its_own_signal_whatever_happened_while_the_outer_one_was_closed():
    @subsystem(enabled="held")
    def inner(u):
        return Gain(gain=1.0, name="g")(u)

    @subsystem(enabled="held")
    def outer(u, e):
        return inner(u, enable=e)

    inner_enable = Step(times=(0.3, 0.7), values=(0.0, 1.0), initial_value=1.0)
    outer_enable = Step(times=(0.2, 0.45), values=(0.0, 1.0), initial_value=1.0)
    run = Diagram("d", outer(Clock(), inner_enable, enable=outer_enable).named("y")).simulate(
        1.0, step=0.05, progress=False
    )
    opened = (run.t <= 0.2) | (run.t >= 0.7)
    assert np.array_equal(run["y"][opened], run.t[opened])
    assert len(set(run["y"][(run.t > 0.2) & (run.t < 0.45)])) == 1
    assert len(set(run["y"][(run.t >= 0.45) & (run.t < 0.7)])) == 1


@pytest.mark.slow
def test_a_sampled_box_in_a_continuous_enabled_one_acts_at_its_ticks_while_that_is_open():
    @subsystem(enabled="held")
    def outer():
        return counting(0.1, name="inner")()

    wired = outer(enable=Step(times=(0.25, 0.65), values=(1.0, 0.0))).named("n")
    run = Diagram("d", wired).simulate(1.0, progress=False)
    assert run.t.tolist() == [k / 10 for k in range(11)]
    assert run["n"].tolist() == [1, 1, 1, 1, 2, 3, 4, 4, 4, 4, 4]


# --- triggered in continuous time -------------------------------------------------------------------------------------


@pytest.mark.drawn(2)
@pytest.mark.parametrize(
    ("edge", "first", "apart"), [("rising", 0.0, 0.5), ("falling", 0.25, 0.5), ("both", 0.0, 0.25)]
)
def test_a_triggered_box_in_continuous_time_samples_at_the_crossing(edge, first, apart):
    @subsystem(triggered=edge)
    def sample(u):
        return Gain(gain=1.0, name="g")(u)

    trigger = Sine(frequency=2.0, phase=-0.8, bias=0.5)
    diagram = Diagram("d", sample(Clock(), trigger=trigger).named("y"), Falls(name="f"))
    run = diagram.simulate(2.0, step=0.04, progress=False)
    instants = np.arange(0.8 / (4 * np.pi) + first, 2.0, apart)
    assert [e.t for e in run.events] == pytest.approx(instants.tolist(), abs=2e-15)
    assert {(e.block, e.event) for e in run.events} == {("sample", "trigger")}
    held = [max([0.0, *instants[instants <= t]]) for t in run.t]
    assert np.allclose(run["y"], held, rtol=0, atol=2e-15)


def test_a_triggered_counter_counts_edges_in_continuous_time():
    pulses = PulseTrain(period=0.1, duty=0.3, delay=0.05)
    wired = counting(name="c", triggered="rising")(trigger=pulses).named("n")
    run = Diagram("d", wired).simulate(1.0, step=0.01, progress=False)
    assert run["n"].tolist() == [max(1, (k + 5) // 10) for k in range(101)]
    assert [e.t for e in run.events] == [(2 * k + 1) / 20 for k in range(10)]


# --- what can't stand there -------------------------------------------------------------------------------------------


def test_an_fmu_in_an_enabled_box_is_refused(uncompiled):
    ball = Fmu(bouncing_ball.build(), name="ball")

    @subsystem(enabled="held")
    def box():
        return ball.height

    with pytest.raises(
        WiringError,
        match=r"box\.ball: a block that is stepped, such as an FMU, can't be in a subsystem that is enabled \(box\)",
    ):
        Diagram("d", box(enable=Constant(value=1.0)))


def test_a_transport_delay_in_an_enabled_box_is_refused():
    @subsystem(enabled="held")
    def box(u):
        return TransportDelay(delay=0.1, name="late")(u)

    with pytest.raises(WiringError, match=r"box\.late: a transport delay can't be in a subsystem that is enabled"):
        Diagram("d", box(Clock(), enable=Constant(value=1.0)))


def test_a_box_with_a_rate_of_its_own_in_a_triggered_box_is_refused():
    @subsystem(triggered="rising")
    def outer(u):
        @subsystem(sample_time=0.1)
        def inner(u):
            return UnitDelay(name="z")(u)

        return inner(u)

    with pytest.raises(SampleTimeError, match=r"inner has its own sample time inside the triggered subsystem outer"):
        Diagram("d", outer(Clock(), trigger=Sine(frequency=1.0)))


@pytest.mark.parametrize("block", [lambda: Integrator(name="i"), lambda: DiscreteIntegrator(name="i")])
def test_what_needs_a_sample_time_is_refused_in_a_triggered_box(block):
    @subsystem(triggered="rising")
    def box(u):
        return block()(u)

    with pytest.raises(
        SampleTimeError, match=r"box\.i: it needs a sample time, and the triggered subsystem box has none"
    ):
        Diagram("d", box(Clock(), trigger=Sine(frequency=1.0)))


def test_what_controls_a_box_is_a_number():
    with pytest.raises(ShapeError, match=r"counter\.enable: .* has shape \(2,\); expected a logic signal"):
        Diagram("d", counting(0.1, enabled="held")(enable=Constant(value=(1.0, 2.0))))


def test_a_box_that_is_not_told_when_to_act_is_refused():
    with pytest.raises(UnwiredInputError, match="nothing is wired to 'enable'"):
        counting(0.1, enabled="held")()
    with pytest.raises(UnwiredInputError, match="nothing is wired to 'trigger'"):
        counting(triggered="rising")()


def test_wrong_words_and_both_at_once_are_refused():
    with pytest.raises(WiringError, match=r"found enabled='sometimes'; expected 'held' or 'reset'"):
        counting(0.1, enabled="sometimes")
    with pytest.raises(WiringError, match=r"found triggered='up'; expected 'rising' or 'falling' or 'both'"):
        counting(triggered="up")
    with pytest.raises(WiringError, match="both enabled and triggered"):
        counting(0.1, enabled="held", triggered="rising")


def test_offsets_and_delays_without_a_sample_time_or_out_of_range_are_refused():
    with pytest.raises(SampleTimeError, match="it has an offset but no sample time"):
        counting(offset=0.1)
    with pytest.raises(SampleTimeError, match=r"an offset of 0\.2 s; expected less than the sample time, 0\.2 s"):
        counting(0.2, offset=0.2)
    with pytest.raises(SampleTimeError, match="it has a delay but no sample time"):
        counting(delay=1)
    with pytest.raises(SampleTimeError, match=r"found delay=0\.5; expected a whole number"):
        counting(0.1, delay=0.5)
    with pytest.raises(SampleTimeError, match=r"its offset 0\.03 s is no multiple of the step 0\.02 s"):
        Diagram("d", counting(0.1, offset=0.03)()).simulate(1.0, step=0.02, progress=False)


def test_a_box_that_is_reset_keeps_its_states_until_it_opens_again():
    @subsystem(enabled="reset")
    def box(u):
        return Lag(name="lag", start=2.0)(u)

    enable = Step(times=(0.5, 0.8), values=(0.0, 1.0), initial_value=1.0)
    run = Diagram("d", box(Constant(value=0.0), enable=enable)).simulate(1.0, step=0.1, **TIGHT)
    states = np.array([run.at(t).state[0] for t in (0.4, 0.5, 0.7, 0.8)])
    assert states == pytest.approx([2 * np.exp(-0.4), 2 * np.exp(-0.5), 2 * np.exp(-0.5), 2.0], abs=1e-11)


def test_an_edge_that_came_while_the_box_around_was_closed_acts_when_that_opens():
    """At ticks as in continuous time: what a closed box remembers is what was when it closed."""

    @subsystem(triggered="rising")
    def inner(t):
        return Gain(gain=1.0, name="g")(t)

    trigger = Step(times=(0.2, 0.45, 0.5, 0.8), values=(1.0, 0.0, 1.0, 0.0))
    enable = Step(times=(0.1, 0.3, 0.4, 0.9), values=(0.0, 1.0, 0.0, 1.0), initial_value=1.0)
    # closed over [0.1, 0.3) and [0.4, 0.9): the edge at 0.2 acts at 0.3, that at 0.5 is over by 0.9
    for options in ({"sample_time": 0.05}, {}):

        @subsystem(enabled="held", **options)
        def outer(t, trigger):
            return inner(t, trigger=trigger)

        wired = outer(Clock(), trigger, enable=enable).named("y")
        run = Diagram("d", counting(0.05, "beside")(), wired).simulate(1.0, progress=False)
        assert np.array_equal(run["y"], np.where(run.t < 0.3, 0.0, 0.3))
