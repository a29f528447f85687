"""Runs at the pace of a clock: the clock is a fake one, so that overruns and delays are exact numbers."""

import signal
import threading

import numpy as np
import pytest

from loopwright import Diagram, Fmu, subsystem
from loopwright.blocks import Clock, Compare, Constant, Gain, Integrator, Sine, Step, StopCondition, TransferFunction
from loopwright.diagrams import OptionError, ParameterError, SimulationError, UnknownNameError
from loopwright.fmus import mass_spring_damper
from loopwright.types import Simulation

T = 0.125


class FakeClock:
    """A clock that waits and work move; what frames take is in ``work``, by the number of the frame."""

    def __init__(self, work=None, begins=1000.0):
        self.now, self.work, self.frame = begins, work or {}, 0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        assert seconds > 0.0
        self.now += seconds

    def take(self, view):
        self.now += self.work.get(self.frame, 0.0)
        self.frame += 1


@subsystem(sample_time=T)
def loop(reference, position):
    return Gain(gain=2.0, name="kp")(reference - position).named("force")


def servo(reference):
    plant = Fmu(mass_spring_damper.build(), name="plant")
    return Diagram("servo", plant(force=loop(reference, plant.position)))


LAG = Diagram(
    "lag", TransferFunction(numerator=[1.0], denominator=[1.0, 1.0])(Constant(value=1.0, name="u")).named("y")
)


def live(diagram, duration=None, work=None, step=None, **options):
    clock = FakeClock(work)
    options = {"frame": 2 * T, "on_frame": clock.take, **options}
    options = {"clock": clock, "sleep": clock.sleep, **options}
    return diagram.simulation(step=step).run_realtime(duration, **options), clock


# --- numbers ------------------------------------------------------------------------------------------------------------


def same(run, other):
    return run.t.tolist() == other.t.tolist() and all(
        np.array_equal(run[name], other[name]) for name in ("plant.position", "force")
    )


@pytest.mark.slow
def test_a_live_run_has_the_numbers_of_a_plain_one():
    diagram = servo(Constant(value=1.0, name="target"))
    plain = diagram.simulate(10 * T, progress=False)
    for options in ({}, {"speed": 3.0}, {"frame": 1e-9}, {"work": {1: 7.0}, "catch_up": 100.0}):
        found, _ = live(diagram, 10 * T, **options)
        assert same(found.run, plain)
    found, _ = live(diagram, 10.5 * T)  # its end is between two ticks
    assert same(found.run, diagram.simulate(10.5 * T, progress=False))


def test_what_is_moved_acts_as_a_step_at_the_frame():
    times = [T, 3 * T, 5 * T]  # read at 0, 2 T and 4 T, after the samples there
    stepped = servo(Step(initial_value=1.0, times=times, values=[4.0, -2.0, 0.5], name="target"))
    values = {0.0: 4.0, 2 * T: -2.0, 4 * T: 0.5, 6 * T: 0.5}
    found, _ = live(servo(Constant(value=1.0, name="target")), 8 * T, inputs={"target": values.__getitem__})
    assert same(found.run, stepped.simulate(8 * T, progress=False))
    assert found.changes == [(t, "target.value", values[t]) for t in (0.0, 2 * T, 4 * T)]


def test_a_continuous_diagram_is_moved_between_its_ticks():
    found, _ = live(LAG, 1.0, step=T, inputs={"u": lambda t: 1.0 if t < 0.5 else 3.0})
    t = found.run.t
    middle = 1.0 - np.exp(-0.5)
    exact = np.where(t <= 0.5, 1.0 - np.exp(-t), 3.0 - (3.0 - middle) * np.exp(0.5 - t))
    assert np.abs(found.run["y"] - exact).max() < 1e-5  # the solver's relative tolerance is 1e-6


def test_a_slider_and_a_named_wire_are_inputs():
    class Slider:
        value = 2.0

    diagram = Diagram("d", Gain(gain=1.0, name="gain")(Constant(value=0.0).named("pull")).named("y"))
    found, _ = live(diagram, 2 * T, step=T, inputs={"pull": Slider(), "gain.gain": 5.0})
    assert found.run["y"].tolist() == [0.0, 10.0, 10.0]


# --- the clock ----------------------------------------------------------------------------------------------------------


def test_it_keeps_pace_with_the_clock():
    seen = []
    clock = FakeClock()
    simulation = LAG.simulation(step=T)
    found = simulation.run_realtime(
        1.0,
        speed=0.5,
        frame=4 * T,
        clock=clock,
        sleep=clock.sleep,
        on_frame=lambda view: seen.append((clock(), view.t)),
    )
    assert seen == [(1000.0, 2 * T), (1000.5, 4 * T), (1001.0, 6 * T), (1001.5, 8 * T)]
    assert clock() == 1002.0
    assert (found.frames, found.overruns, found.slipped, found.load, found.message) == (4, 0, 0.0, 0.0, "")
    assert found.lateness.tolist() == [0.0] * 4
    assert found.ended_by == "duration"
    assert not found.is_running


def test_overruns_are_counted_and_caught_up():
    found, clock = live(LAG, 1.0, step=T, work={0: 0.125, 1: 0.375, 2: 0.0})  # frames last 0.25 s
    assert found.overruns == 1
    assert found.lateness.tolist() == [0.0, 0.0, 0.125, 0.0]
    assert clock() == 1001.0
    assert found.load == 0.5
    assert found.slipped == 0.0
    text = "The live run of 'lag' was 125 ms behind the clock at most: 1 of 4 frames took longer than they last."
    assert found.message.startswith(text)
    assert "something else held the machine up" in found.message
    assert found.run.messages[-1] == found.message


def test_a_long_delay_is_given_up_and_one_warning_says_what_to_do(monkeypatch):
    """The machine computes for 1 s in frames that last 0.25 s."""
    clock = FakeClock(work={0: 1.0, 2: 1.0})

    def advance(self, duration):
        clock.take(None)
        return computed(self, duration)

    computed = Simulation.advance
    monkeypatch.setattr(Simulation, "advance", advance)
    with pytest.warns(RuntimeWarning, match=r"was 750 ms behind the clock at most: 1 of 1 frame.*speed=0\.2") as warned:
        found, _ = live(LAG, 1.0, step=T, catch_up=0.5, clock=clock, sleep=clock.sleep, on_frame=None)
    assert len(warned) == 1
    assert found.overruns == 2
    assert found.lateness.tolist() == [0.0, 0.75, 0.0, 0.75]
    assert found.slipped == 1.5
    assert clock() == 1002.5
    assert found.load == 2.0
    assert "gave up 1.5 s of the clock: 2 of 4 frames" in found.message
    assert "speed=0.3" in found.message  # 0.7 of what it reached, 1 s in 2 s, in one digit
    assert "overruns    2, the longest by 750 ms" in str(found)


def test_slow_functions_of_the_user_are_named_and_not_the_machine():
    with pytest.warns(RuntimeWarning, match=r"Functions of inputs= and on_frame= take 400% of the time.*0%") as warned:
        found, _ = live(LAG, 1.0, step=T, work={0: 1.0, 2: 1.0}, catch_up=0.5)
    assert len(warned) == 1
    assert "take 200% of the time, and computing 0%" in found.message


def test_frames_have_whole_ticks_one_at_least():
    for frame, frames in ((1e-6, 8), (0.3, 4), (100.0, 1)):
        found, _ = live(LAG, 1.0, step=T, frame=frame)
        assert found.frames == frames


# --- ends ---------------------------------------------------------------------------------------------------------------


def test_it_is_stopped_from_outside():
    clock = FakeClock()
    options = {"clock": clock, "sleep": clock.sleep, "frame": 2 * T}
    found = LAG.simulation(step=T).run_realtime(stop=lambda: clock.now >= 1000.5, **options)
    assert (found.ended_by, found.t, found.run.t[-1]) == ("stop", 0.5, 0.5)


@pytest.fixture
def ctrl_c():
    """Let Ctrl-C interrupt: a background job begins with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_ends_it_after_a_frame_and_nothing_is_lost():
    def interrupt(view):
        if view.t == 0.5:
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    found, _ = live(LAG, step=T, on_frame=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    assert (found.ended_by, found.run.t[-1]) == ("Ctrl-C", 0.5)
    assert found.run.final_state.t == 0.5
    assert "it was stopped by Ctrl-C" in str(found)


@pytest.mark.usefixtures("ctrl_c")
def test_a_second_ctrl_c_interrupts_at_once():
    def interrupt(view):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        live(LAG, step=T, on_frame=interrupt)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_stop_condition_ends_it():
    x = Integrator(name="x")(Constant(value=1.0))
    found, _ = live(Diagram("d", StopCondition(name="end")(Compare(">")(x, 0.3))), step=T)
    assert found.ended_by == "end"
    assert found.t == pytest.approx(0.3, abs=1e-9)


def test_it_runs_in_the_background_until_it_is_stopped():
    reached, clock = threading.Event(), FakeClock()

    def look(view):
        if view.t >= 2.0:
            reached.set()
            clock.work = {}

    found = LAG.simulation(step=T).run_realtime(background=True, clock=clock, sleep=clock.sleep, on_frame=look)
    assert reached.wait(30.0)
    with pytest.raises(OptionError, match=r"expected one that has ended\. Call stop\(\)"):
        _ = found.run
    found.stop()
    assert found.wait(30.0) is found
    assert found.ended_by == "stop"
    assert found.run.t[-1] == found.t >= 2.0


def test_an_open_simulation_continues_afterwards():
    with LAG.simulation(step=T) as simulation:
        clock = FakeClock()
        simulation.run_realtime(0.5, clock=clock, sleep=clock.sleep)
        simulation.advance(0.5)
        assert simulation.t == 1.0
        assert simulation.run().t[0] == 0.5 + T  # `run_realtime` has the samples before


# --- errors -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"inputs": {"uu": 1.0}}, UnknownNameError, "Did you mean"),
        ({"inputs": {"y": 1.0}}, UnknownNameError, "a wire that comes out of transfer_function.*expected a Constant"),
        ({"inputs": {"u": "fast"}}, OptionError, "expected a function of the time, a slider or a number"),
        ({"inputs": {"u": lambda t: 1 / t}}, SimulationError, "the function given for 'u' failed: ZeroDivisionError"),
        ({"inputs": {"u": lambda t: [1.0, 2.0]}}, ParameterError, "its equations change"),
        ({"speed": 0.0}, OptionError, "positive"),
        ({"catch_up": -1.0}, OptionError, "0 s or more"),
    ],
)
def test_mistakes_are_refused(options, error, words):
    with pytest.raises(error, match=words):
        live(LAG, 1.0, step=T, **options)


@pytest.mark.parametrize("start", [{}, {"mass": 1.0}], ids=["none", "given"])
def test_parameters_of_an_fmu_are_refused_with_the_way_out(start):
    diagram = servo(Constant(value=1.0)).replace({"plant.start": start})
    with pytest.raises(
        UnknownNameError, match=r"of plant, Fmu, .* no parameters in a run.*replace\(\{'plant.start.mass': …"
    ):
        live(diagram, 1.0, inputs={"plant.mass": 2.0})
    assert diagram.replace({"plant.start.mass": 2.0})["plant"].start["mass"] == 2.0


def test_an_error_in_the_background_is_raised_by_wait():
    found = LAG.simulation(step=T).run_realtime(background=True, inputs={"u": lambda t: 1 / t})
    with pytest.raises(SimulationError, match="ZeroDivisionError"):
        found.wait(30.0)
    assert "failed" in repr(found)
    assert "ZeroDivisionError" in str(found)


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        ({"inputs": {"u": lambda t: 1.0 if t < 0.5 else float("nan")}}, r"u\.value, t = 0\.5 s: what is given.*nan"),
        ({"inputs": {"u": lambda t: 1.0 if t < 0.5 else 1 / 0}}, r"u\.value, t = 0\.5 s: the function given for 'u'"),
        ({"on_frame": lambda view: 1 / (view.t - 0.5)}, r"lag\.on_frame, t = 0\.5 s: .*on_frame failed: ZeroDiv"),
    ],
)
def test_what_was_recorded_until_an_error_is_kept(broken, words):
    with pytest.raises(SimulationError, match=words) as caught:
        live(LAG, 1.0, step=T, **broken)
    kept = caught.value.run
    assert kept.t.tolist() == [0.0, 0.125, 0.25, 0.375, 0.5]
    np.testing.assert_allclose(kept["y"], 1.0 - np.exp(-kept.t), atol=1e-6)
    behind, _ = live(LAG, 1.0, step=T, background=True, **broken)
    with pytest.raises(SimulationError):
        behind.wait(30.0)
    assert behind.run["y"].tolist() == kept["y"].tolist()


def test_a_simulation_has_one_driver():
    """Two threads in one simulation mixed the samples of both."""
    simulation = LAG.simulation(step=T)
    found = simulation.run_realtime(background=True, speed=10.0)
    calls = (lambda: simulation.run_realtime(1.0), lambda: simulation.advance(1.0), simulation.run, simulation.save)
    for call in calls:
        with pytest.raises(OptionError, match=r"a live run in the background drives this simulation.*stop\(\)"):
            call()
    found.stop()
    run = found.wait(30.0).run
    np.testing.assert_allclose(run["y"], 1.0 - np.exp(-run.t), atol=1e-6)


# --- sources in continuous time whose parameters change in a run ----------------------------------------------------------


def test_a_source_with_other_times_is_planned_again():
    """A step that is moved to 0.7 s is landed on: x is its integral, exactly."""
    diagram = Diagram("d", Integrator(name="x")(Step(times=0.5, values=1.0, name="step")))
    with diagram.simulation(step=0.25) as simulation:
        simulation.advance(0.25)
        simulation.set_parameters("step", diagram["step"].replace(times=0.7, values=4.0))
        simulation.advance(0.75)
        assert simulation.run()["x.y"].tolist() == pytest.approx([0.0, 0.0, 0.0, 0.2, 1.2], abs=1e-14)


def test_a_comparison_with_a_clock_is_planned_again():
    """The threshold moves from 5 s to 0.7 s: the solver lands on that, or x would be off by a part of a step."""
    late = Compare(">")(Clock(), Constant(value=5.0, name="threshold"))
    diagram = Diagram("d", Integrator(name="x")(Gain(gain=1.0)(late)))
    with diagram.simulation(step=0.25) as simulation:
        simulation.advance(0.25)
        simulation.set_parameters("threshold", diagram["threshold"].replace(value=0.7))
        simulation.advance(0.75)
        assert simulation.run()["x.y"].tolist() == pytest.approx([0.0, 0.0, 0.0, 0.05, 0.3], abs=1e-14)


def test_the_amplitude_of_a_sine_changes_and_its_frequency_is_refused():
    diagram = Diagram("d", Integrator(name="x")(Sine(frequency=1.0, name="wave")))
    with diagram.simulation(step=0.25) as simulation:
        simulation.set_parameters("wave", diagram["wave"].replace(amplitude=2.0))
        with pytest.raises(ParameterError, match="longest step follows from how fast it changes"):
            simulation.set_parameters("wave", diagram["wave"].replace(frequency=2.0))
        simulation.advance(0.5)
        assert simulation.run()["x.y"][-1] == pytest.approx(2.0 / np.pi, rel=1e-5)
