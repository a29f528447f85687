"""Plants in the loop in C that step less often than the run has ticks, that are no FMU, or that are coupled.

FMUs are the zoo's, y' = u, which are exact where inputs are held.
"""

from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Clock,
    Compare,
    Constant,
    Gain,
    Integrator,
    Output,
    Ramp,
    SimulationError,
    Sine,
    StopCondition,
)
from loopwright.diagrams import Coupling, Diagram, Interrupted, subsystem
from loopwright.diagrams.flat import kinds_of
from loopwright.diagrams.simulation import bound_loops, ticks_in_c
from loopwright.diagrams.simulation.algebraic_loops import newton_options
from loopwright.fmus import Fmu, FmuProcessError, FmuRuntimeError, StepOptions, build_fmu
from support.both_forms import assert_same_bits, both
from support.careful_fmus import EVENTS, MODEL, OUTPUTS
from support.exported import mass_spring_damper
from support.small_fmus import small_fmu
from support.tanks import CALLS, Tank, TankPlant
from support.typed_fmus import typed_fmu
from support.zoo import zoo_fmu

pytestmark = [pytest.mark.one_tier, pytest.mark.usefixtures("no_process_left")]
MS = Fraction(1, 1000)
FORMS = (False, "auto", True)
"""The virtual machine, the same until generated code comes, and generated code."""


@pytest.fixture(scope="module")
def folder(cache, tmp_path_factory):
    return tmp_path_factory.mktemp("plants")


def simulate(made, duration, form, **options):
    return made.simulate(float(duration), compile=form, progress=False, **options)


def in_all_forms(made, duration, *, solved=False, **options):
    """Return the run of generated code; where no solver goes between ticks, all forms have the same bits."""
    first, *others = (simulate(made, duration, form, **options) for form in FORMS)
    for other in others:
        assert other.t.tobytes() == first.t.tobytes()
        if not solved:
            assert other.data.tobytes() == first.data.tobytes()
        else:
            np.testing.assert_allclose(other.data, first.data, rtol=1e-6, atol=1e-8)
        assert other.stopped == first.stopped
        assert words(other.messages) == words(first.messages)
        assert {name: text.values for name, text in other.texts.items()} == {
            name: text.values for name, text in first.texts.items()
        }
    assert others[1].tier == "compiled"
    return others[1]


def words(messages):
    return [m for m in messages if not m.startswith(("Compiled", "Interpreted", "Fused"))]


def failures(made, duration, kind, *, solved=False, **options):
    """Return the error of each form; its text, block, time, and samples are the same."""
    found = []
    for form in FORMS:
        with pytest.raises(kind) as caught:
            made.simulate(float(duration), compile=form, progress=False, **options)
        found.append(caught.value)
    for error in found[1:]:
        assert (str(error), type(error)) == (str(found[0]), type(found[0]))
        if isinstance(error, SimulationError):
            assert (error.block, error.t) == (found[0].block, found[0].t)
            assert error.run.t.tobytes() == found[0].run.t.tobytes()
            np.testing.assert_allclose(error.run.data, found[0].run.data, rtol=1e-9 * solved, atol=0)
    return found[0]


def zoo(file, name, step=None, *, isolate=None, **options):
    return Fmu(file, name=name, isolate=isolate, stepping=StepOptions(communication_step=step, **options))


def sampled(T, name, offset=0):
    @subsystem(sample_time=T, offset=offset, name=name)
    def box(u):
        return Gain(gain=1.0, name="gain")(u)

    return box


def integral(points, stops, u, t):
    """The exact output at some times: y' = u, with u held from each communication point; at ``stops`` it steps alone."""
    ticks, y, held = sorted({*points, *stops}), [Fraction(0)], u(Fraction(0))
    for a, b in pairwise(ticks):
        held = u(a) if a in points else held
        y.append(y[-1] + held * (b - a))
    places = np.searchsorted([float(v) for v in ticks], np.asarray(t) + 1e-9, side="right") - 1
    return np.array([float(y[i]) for i in places])


def points(period, end, offset=Fraction(0)):
    """The communication points of a plant: those of a clock, and 0."""
    return [*({Fraction(0)} | {offset + k * period for k in range(int((end - offset) / period) + 1)})]


# --- steps of their own ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.parametrize(
    "isolate", [(), ("slow", "late"), ("slow", "other", "late", "fast")], ids=["here", "some", "all"]
)
@pytest.mark.parametrize("end", [26 * MS, Fraction(263, 10) * MS])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_each_plant_steps_at_its_own_ticks_with_inputs_held_from_there(folder, fmi, end, isolate, solved):
    """Inputs are t, 2 t, -t and 3 t at the plant's last tick; the run ends within steps of three of the plants."""
    file = zoo_fmu(folder, fmi)
    slow, other, late, fast = (
        zoo(file, name, step, isolate=name in isolate)
        for name, step in (("slow", 4 * MS), ("other", 3 * MS), ("late", None), ("fast", None))
    )
    t = Clock(name="clock")
    made = Diagram(
        "d",
        slow(u=t),
        other(u=Gain(gain=2.0, name="twice")(t)),
        late(u=Gain(gain=-1.0, name="minus")(sampled(5 * MS, "late_box", 2 * MS)(t))),
        fast(u=sampled(MS, "fast_box")(Gain(gain=3.0, name="thrice")(t))),
        *([Integrator(name="aside")(t)] if solved else []),
    )
    run = in_all_forms(made, end, solved=solved)
    own = {"slow": (1, 4, 0), "other": (2, 3, 0), "late": (-1, 5, 2), "fast": (3, 1, 0)}
    for name, (factor, period, offset) in own.items():
        ticks = points(period * MS, end, offset * MS)
        expected = integral(ticks, {end}, lambda a, factor=factor: factor * a, run.t)
        np.testing.assert_allclose(run[f"{name}.y"], expected, rtol=0, atol=1e-15)
    if solved:
        np.testing.assert_allclose(run["aside.y"], run.t**2 / 2, rtol=0, atol=1e-12)


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.drawn(1)
def test_a_plant_of_one_step_length_stays_behind_the_end(folder, monkeypatch, solved):
    monkeypatch.setattr(Fmu, "variable_step", property(lambda self: self.name == "other"))
    file, t = zoo_fmu(folder, 3), Clock(name="clock")
    even, other = zoo(file, "even", 4 * MS), zoo(file, "other", 4 * MS)
    aside = [Integrator(name="aside")(t)] if solved else []
    made = Diagram("d", even(u=t), other(u=t), sampled(MS, "box")(t), *aside)
    run = in_all_forms(made, 10 * MS, solved=solved)
    for name in ("even", "other"):
        stops = {10 * MS} if name == "other" else ()
        expected = integral(points(4 * MS, 10 * MS), stops, lambda a: a, run.t)
        np.testing.assert_allclose(run[f"{name}.y"], expected, rtol=0, atol=1e-15)
    assert run["other.y"][-1] - run["even.y"][-1] == pytest.approx(16e-6, abs=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.drawn
def test_saved_between_two_steps_of_a_plant_it_goes_on_in_every_form(folder, solved, isolate):
    mass = build_fmu(mass_spring_damper())
    slow = Fmu(mass, name="slow", isolate=isolate, stepping=StepOptions(communication_step=4 * MS))
    t = Sine(name="wave", frequency=20.0)
    aside = [Integrator(name="aside")(t)] if solved else []
    made = Diagram("d", slow(force=t), sampled(MS, "box")(t), *aside)
    whole = simulate(made, 0.03, False)
    for first in FORMS:
        with made.simulation(compile=first) as simulation:
            simulation.advance(0.011)
            assert dict(simulation.reached) == {"slow": 11}  # pieces of a run end its steps
            simulation.advance(0.003)
            half = simulation.save()
            simulation.advance(0.016)
            rest = simulation.run()
        for second in FORMS:
            again = made.simulate(0.016, start=half, compile=second, progress=False)
            if solved:
                np.testing.assert_allclose(again.data, rest.data[-len(again.t) :], rtol=1e-6, atol=1e-9)
            else:
                assert again.data.tobytes() == rest.data[-len(again.t) :].tobytes()
        assert rest["slow.position"][-1] == pytest.approx(whole["slow.position"][-1], rel=1e-2)


@pytest.mark.parametrize("form", FORMS)
def test_a_plant_that_takes_whole_steps_is_saved_on_its_way(folder, monkeypatch, form):
    """Its inputs are those of 4 ms, and it has not come to 7 ms, when the state is saved there."""
    monkeypatch.setattr(Fmu, "variable_step", property(lambda self: False))
    monkeypatch.setattr(Fmu, "can_save", property(lambda self: True))
    mass, t = build_fmu(mass_spring_damper()), Sine(name="wave", frequency=20.0)
    slow = Fmu(mass, name="slow", stepping=StepOptions(communication_step=4 * MS))
    made = Diagram("d", slow(force=t), sampled(MS, "box")(t))
    whole = simulate(made, 0.03, False)
    with made.simulation(compile=form) as simulation:
        simulation.advance(0.007)
        assert dict(simulation.reached) == {"slow": 4}
        half = simulation.save()
    again = made.simulate(0.023, start=half, compile=form, progress=False)
    assert again.data.tobytes() == whole.data[-len(again.t) :].tobytes()


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.parametrize("fault", ["step error", "step discard", "get error", "step segfault", "step fatal"])
@pytest.mark.drawn(2)
def test_an_error_has_the_time_and_the_width_of_the_plant_s_own_step(folder, fault, solved, isolate):
    """The step from 60 ms over 20 ms fails, between ticks of 1 ms; the fast plant has gone on to 79 ms.

    The outputs behind the step from 40 ms can't be read.
    """
    isolate = isolate or "segfault" in fault
    slow = zoo(zoo_fmu(folder, 3, f"{fault} 0.05"), "slow", 20 * MS, isolate=isolate)
    fast = zoo(zoo_fmu(folder, 3), "fast", isolate=isolate)
    t = Clock(name="clock")
    aside = [Integrator(name="aside")(t)] if solved else []
    made = Diagram("d", slow(u=t), fast(u=sampled(MS, "box")(t)), *aside)
    error = failures(made, 0.1, (FmuRuntimeError, FmuProcessError), solved=solved)
    assert error.block == "slow"
    assert error.t == pytest.approx(0.04 if "get" in fault else 0.06, abs=1e-12)
    if fault in ("step error", "step discard", "step fatal"):
        assert "from t = 0.06 s by 0.02 s" in str(error)
    end = 59 * MS if "get" in fault else 79 * MS
    assert error.run.t[-1] == pytest.approx(float(end), abs=1e-12)
    expected = integral(points(MS, end), (), lambda a: a, [float(end)])
    np.testing.assert_allclose(error.run["fast.y"][-1:], expected, rtol=0, atol=1e-15)


def test_an_input_that_does_not_fit_is_refused_before_any_step_begins(folder):
    """From 30 ms on it is no whole number; the isolated plant looks at it at 40 ms, and the other one has stepped."""

    class Late(Block):
        y = Output()

        def output(self, t, x, u):
            return np.where(t < 0.0295, 1.0, 0.5)

    whole = Fmu(typed_fmu(folder, 3), name="slow", isolate=True)
    slow = whole.replace(ports=["u_Int8", "y_Int8"], stepping=StepOptions(communication_step=20 * MS))
    fast = zoo(zoo_fmu(folder, 3), "fast", isolate=True)
    made = Diagram("d", slow(u_Int8=Late(name="late")), fast(u=sampled(MS, "box")(Clock(name="clock"))))
    error = failures(made, 0.1, FmuRuntimeError)
    assert (error.block, error.port) == ("slow", "u_Int8")
    assert error.t == pytest.approx(0.04, abs=1e-12)


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.drawn(1)
def test_a_stop_condition_on_a_slow_output_ends_the_run_at_its_tick(folder, solved):
    """y is the sum of 16 k · 1e-6 at 4 k ms: above 1e-4 at 20 ms for the first time."""
    slow, t = zoo(zoo_fmu(folder, 3), "slow", 4 * MS), Clock(name="clock")
    aside = [Integrator(name="aside")(t)] if solved else []
    stop = StopCondition(name="enough")(Compare(relation=">", name="above")(slow.y, 1e-4))
    made = Diagram("d", slow(u=t), sampled(MS, "box")(t), stop, *aside)
    run = in_all_forms(made, 0.1, solved=solved)
    assert run.stopped.t == pytest.approx(0.02, abs=1e-12)
    assert run["slow.y"][-1] == pytest.approx(16e-5, abs=1e-15)


@pytest.mark.parametrize("rollback", [False, True])
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.drawn(1)
def test_events_within_longer_steps(folder, isolate, rollback):
    """x' = u turns round at 0.5, within the step from 0.45 s; the fast tick beside it makes no difference."""
    file = small_fmu(folder, "fmi3", EVENTS, MODEL.format(clock="", outputs=OUTPUTS, variable="true"))
    step = Fraction(9, 100)
    stepping = StepOptions(event_mode=True, early_return=True, rollback=rollback, communication_step=step)
    plant = Fmu(file, name="plant", isolate=isolate, stepping=stepping)
    level = sampled(Fraction(1, 100), "box")(Constant(value=0.0, name="zero"))
    run = in_all_forms(Diagram("d", plant(u=Constant(value=1.0), level=level)), 1.0)
    t = np.where(run.t == 1.0, 1.0, np.floor(run.t / float(step) + 1e-9) * float(step))
    assert run["plant.x"] == pytest.approx(np.where(t < 0.5, t, 1.0 - t), abs=1e-12)
    assert run["plant.timed"][-1] == 1.0


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.drawn(1)
def test_a_run_goes_on_behind_steps_that_python_has_looked_at(folder, solved, isolate):
    """From 50 ms on every step of the slow plant warns: its inputs and the next step are as without that."""
    slow = zoo(zoo_fmu(folder, 3, "step warning 0.05"), "slow", 4 * MS, isolate=isolate)
    wide, t = zoo(zoo_fmu(folder, 3), "wide", 6 * MS, isolate=isolate), Clock(name="clock")
    aside = [Integrator(name="aside")(t)] if solved else []
    made = Diagram("d", slow(u=t), wide(u=t), sampled(MS, "box")(t), *aside)
    run = in_all_forms(made, 98 * MS, solved=solved)
    for name, period in (("slow", 4), ("wide", 6)):
        expected = integral(points(period * MS, 98 * MS), {98 * MS}, lambda a: a, run.t)
        np.testing.assert_allclose(run[f"{name}.y"], expected, rtol=0, atol=1e-14)
    assert [m for m in run.messages if "warning" in m]


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.drawn(1)
def test_a_run_goes_on_behind_ticks_that_python_has_evaluated(folder, monkeypatch, solved):
    """C's method for the algebraic loop, x = t - x, gives up at once."""

    def none(*arguments):
        return replace(newton_options(*arguments), iterations=0, tolerance=-1.0)

    monkeypatch.setattr(bound_loops, "newton_options", none)

    @subsystem(sample_time=MS)
    def box(t):
        half = Gain(gain=1.0, name="half")
        loop = t - half.y
        half(loop)
        return loop

    slow, other, t = zoo(zoo_fmu(folder, 3), "slow", 4 * MS), zoo(zoo_fmu(folder, 3), "other", 6 * MS), Clock(name="c")
    aside = [Integrator(name="aside")(t)] if solved else []
    made = Diagram("d", slow(u=box(t)), other(u=t), *aside, loops="solve")
    run = in_all_forms(made, 98 * MS, solved=solved)
    for name, period, factor in (("slow", 4, Fraction(1, 2)), ("other", 6, 1)):
        ticks = points(period * MS, 98 * MS)
        expected = integral(ticks, {98 * MS}, lambda a, factor=factor: factor * a, run.t)
        np.testing.assert_allclose(run[f"{name}.y"], expected, rtol=0, atol=1e-14)
    bad = zoo(zoo_fmu(folder, 3, "step error 0.05"), "slow", 4 * MS)
    error = failures(made.replace(slow=bad), 0.1, FmuRuntimeError, solved=solved)
    assert "from t = 0.052 s by 0.004 s" in str(error)


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.drawn(1)
def test_rare_sets_of_clocks_are_python_s_and_the_steps_go_on(folder, monkeypatch, solved):
    """There is no code for the ticks at which both boxes act."""
    monkeypatch.setattr(ticks_in_c, "kinds_of", lambda *a, **o: [k for k in kinds_of(*a, **o) if len(k) < 2])
    t = Clock(name="clock")
    slow, other = zoo(zoo_fmu(folder, 3), "slow", 4 * MS), zoo(zoo_fmu(folder, 3), "other", 6 * MS)
    aside = [Integrator(name="aside")(t)] if solved else []
    made = Diagram("d", slow(u=t), other(u=sampled(MS, "box")(t)), sampled(3 * MS, "second")(t), *aside)
    run = in_all_forms(made, 50 * MS, solved=solved)
    for name, period in (("slow", 4), ("other", 6)):
        expected = integral(points(period * MS, 50 * MS), {50 * MS}, lambda a: a, run.t)
        np.testing.assert_allclose(run[f"{name}.y"], expected, rtol=0, atol=1e-14)


def test_c_evaluates_ticks_at_which_a_plant_alone_steps(folder):
    """A plant has ticks each 4 ms, and a subsystem each 6 ms."""
    t = Clock(name="clock")
    made = Diagram("d", zoo(zoo_fmu(folder, 3), "slow", 4 * MS)(u=t), sampled(6 * MS, "box")(t))
    one, two = both(made, 0.12)
    assert_same_bits(one, two)
    np.testing.assert_allclose(two["slow.y"], integral(points(4 * MS, 120 * MS), (), lambda a: a, two.t), atol=1e-14)


def test_isolated_plants_whose_ticks_meet_step_at_the_same_time(folder, meeting):
    """Each step waits until the other FMU is in its own: both step at 4, 8, … ms, beside ticks of 1 ms."""
    file, t = zoo_fmu(folder, 3, "step meet"), Clock(name="clock")
    a, b = (zoo(file, name, 4 * MS, isolate=True) for name in "ab")
    made = Diagram("d", a(u=t), b(u=t), sampled(MS, "box")(t))
    run = simulate(made, 0.02, True)
    assert meeting.count == 10
    np.testing.assert_allclose(run["a.y"], integral(points(4 * MS, 20 * MS), (), lambda k: k, run.t), atol=1e-15)


@pytest.mark.slow
def test_fused_plants_step_at_their_own_ticks(cache):
    slow = Fmu(build_fmu(mass_spring_damper()), name="slow", stepping=StepOptions(communication_step=4 * MS))
    fast = Fmu(build_fmu(mass_spring_damper()), name="fast")
    t = Sine(name="wave", frequency=20.0)
    made = Diagram("d", slow(force=t), fast(force=sampled(MS, "box")(t)))
    one, two = simulate(made, 0.03, False), simulate(made, 0.03, True, fuse=True)
    assert "the equations of slow are in the loop" in " ".join(two.messages)
    np.testing.assert_allclose(two.data, one.data, rtol=1e-10, atol=1e-13)
    held = one["slow.position"][np.searchsorted(one.t, np.floor(one.t[:-1] / 0.004 + 1e-9) * 0.004 - 1e-9)]
    np.testing.assert_allclose(two["slow.position"][:-1], held, rtol=1e-10, atol=1e-13)


# --- plants that are no FMU --------------------------------------------------------------------------------------------


class SlowTank(Tank):
    """Steps each 4 ms."""

    stepping = StepOptions(communication_step=4 * MS)


class FaultyTank(Tank):
    """Its step from 6 ms on fails; it steps each 2 ms."""

    stepping = StepOptions(communication_step=2 * MS)
    error: object

    @contextmanager
    def instantiate(self, wired, stop_time, *, start_time=0.0):
        """Yield a plant whose step fails."""
        plant = TankPlant(self, wired)
        step = plant.step

        def fail(t, h):
            if t > 0.005:
                raise self.error
            step(t, h)

        plant.step = fail
        yield plant


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.drawn(2)
def test_plants_of_python_step_beside_fmus(folder, solved, isolate):
    """The slow tank takes whole steps alone: it stays at 8 ms where the run ends at 10 ms."""
    t = Ramp(slope=1.0, name="ramp")
    tank, slow = Tank(area=2.0, name="tank"), SlowTank(area=1.0, name="slow")
    fast = zoo(zoo_fmu(folder, 3), "fast", isolate=isolate)
    aside = [Integrator(name="aside")(t)] if solved else []
    made = Diagram("d", tank(u=sampled(MS, "box")(t)), slow(u=t), fast(u=tank.y), *aside)
    CALLS.clear()
    run = in_all_forms(made, 10 * MS, solved=solved)
    of_one_run = [(k / 1000, 0.001) for k in range(10)] + [(0.0, 0.004), (0.004, 0.004)]
    assert sorted(call for call in CALLS if call != "freed") == sorted(3 * of_one_run)
    half = integral(points(MS, 10 * MS), (), lambda a: a / 2, run.t)
    np.testing.assert_allclose(run["tank.y"], half, rtol=0, atol=1e-15)
    whole = integral(points(4 * MS, 10 * MS), (), lambda a: a, run.t)
    np.testing.assert_allclose(run["slow.y"], whole, rtol=0, atol=1e-15)
    held = np.concatenate([[0.0], 1e-3 * np.cumsum(half[:-1])])
    np.testing.assert_allclose(run["fast.y"], held, rtol=0, atol=1e-15)


@pytest.mark.parametrize("solved", [False, True], ids=["ticks", "solver"])
@pytest.mark.parametrize("error", [SimulationError("it leaks."), ValueError("no number")], ids=["ours", "any"])
@pytest.mark.drawn(1)
def test_what_a_plant_of_python_raises_ends_the_run(folder, solved, error):
    t = Ramp(slope=1.0, name="ramp")
    aside = [Integrator(name="aside")(t)] if solved else []
    fast = zoo(zoo_fmu(folder, 3), "fast", isolate=True)
    made = Diagram("d", FaultyTank(area=1.0, error=error, name="tank")(u=t), fast(u=sampled(MS, "box")(t)), *aside)
    for form in FORMS:
        with made.simulation(compile=form) as simulation:
            with pytest.raises(type(error), match=r"it leaks|no number") as caught:
                simulation.advance(0.02)
            assert simulation.t == pytest.approx(0.007, abs=1e-12)
            run = caught.value.run if isinstance(error, SimulationError) else simulation.run(final=False)
        assert run.t == pytest.approx(np.arange(8) * 1e-3, abs=1e-12)
        expected = integral(points(MS, 7 * MS), (), lambda a: a, run.t)
        np.testing.assert_allclose(run["fast.y"], expected, rtol=0, atol=1e-15)
        if isinstance(error, SimulationError):
            assert caught.value.t == pytest.approx(0.008, abs=1e-12)


def test_ctrl_c_within_a_step_of_python_keeps_what_was_recorded():
    tank = FaultyTank(area=1.0, error=KeyboardInterrupt(), name="tank")
    made = Diagram("d", tank(u=Ramp(slope=1.0, name="ramp")), sampled(MS, "box")(Clock(name="clock")))
    for form in FORMS:
        with pytest.raises(Interrupted) as caught:
            made.simulate(0.02, compile=form, progress=False)
        assert caught.value.run.t == pytest.approx(np.arange(8) * 1e-3, abs=1e-12)


def test_a_plant_of_python_is_saved_and_goes_on_in_every_form():
    tank, t = SlowTank(area=1.0, name="slow"), Sine(name="wave", frequency=20.0)
    made = Diagram("d", tank(u=t), sampled(MS, "box")(t))
    whole = simulate(made, 0.03, False)
    for first in FORMS:
        with made.simulation(compile=first) as simulation:
            simulation.advance(0.007)
            assert dict(simulation.reached) == {"slow": 4}
            half = simulation.save()
        for second in FORMS:
            again = made.simulate(0.023, start=half, compile=second, progress=False)
            assert again.data.tobytes() == whole.data[-len(again.t) :].tobytes()


# --- other couplings ---------------------------------------------------------------------------------------------------

SCHEMES = ["gauss_seidel", "iterated", Coupling(scheme="jacobi", error=1e-6), Coupling(scheme="iterated", error=1e-6)]
NAMES = ["gauss_seidel", "iterated", "adaptive", "iterated_adaptive"]


def chain(file, *more, isolate=None, fault=None):
    """a' = 1000 times the tick of a sampled clock, b' = a."""
    a, b = zoo(file, "a", isolate=isolate), zoo(fault or file, "b", isolate=isolate)
    clock = Gain(gain=1000.0, name="thousand")(Clock(name="clock"))
    return Diagram("d", b(u=a(u=sampled(10 * MS, "box", 5 * MS)(clock)).y), *more)


@pytest.mark.parametrize("isolate", [True, False])
@pytest.mark.parametrize("coupling", SCHEMES, ids=NAMES)
@pytest.mark.slow
def test_coupled_plants_step_in_c_s_loop(folder, coupling, isolate):
    """Ticks are at 0, 5, 15, 25, … ms and the end. b gets a of the step's end, or the mean of both ends.

    By its description y may follow u at once: iterated, y comes of a step with the end's input, and the state doesn't.
    """
    made, end = chain(zoo_fmu(folder, 3), isolate=isolate), 100 * MS
    run = in_all_forms(made, end, coupling=coupling)
    expected = integral(points(10 * MS, end, 5 * MS), {end}, lambda k: 1000 * k, run.t)
    np.testing.assert_allclose(run["a.y"], expected, rtol=0, atol=1e-13)
    a, h = expected, np.diff(run.t)
    exact = np.r_[0.0, np.cumsum(h * (a[1:] + a[:-1]) / 2)]
    if coupling == "gauss_seidel":
        np.testing.assert_allclose(run["b.y"], np.r_[0.0, np.cumsum(h * a[1:])], rtol=0, atol=1e-13)
    elif coupling == "iterated":
        np.testing.assert_allclose(run["b.y"], np.r_[0.0, exact[:-1] + h * a[1:]], rtol=0, atol=1e-13)
    elif coupling == SCHEMES[2]:  # two halves of a step, each with a of its beginning
        np.testing.assert_allclose(run["b.y"], np.r_[0.0, np.cumsum(h / 4 * (3 * a[:-1] + a[1:]))], rtol=0, atol=1e-13)
    else:
        np.testing.assert_allclose(run["b.y"], exact, rtol=0, atol=2e-4)
    assert [m for m in run.messages if m.startswith("coupling ")]


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("coupling", SCHEMES[:3], ids=NAMES[:3])
@pytest.mark.parametrize("fault", ["step error", "step segfault"])
@pytest.mark.drawn(1)
def test_an_error_in_a_coupled_step_is_told_as_ever(folder, coupling, isolate, fault):
    isolate = isolate or "segfault" in fault
    made = chain(zoo_fmu(folder, 3), isolate=isolate, fault=zoo_fmu(folder, 3, f"{fault} 0.05"))
    error = failures(made, 0.1, (FmuRuntimeError, FmuProcessError), coupling=coupling)
    assert error.block == "b"


def test_an_iteration_that_does_not_converge_is_told_as_ever(folder):
    a, b = (zoo(zoo_fmu(folder, 3), name) for name in "ab")
    made = Diagram("d", a(u=1.0 - b.y), b(u=a.y), sampled(10 * MS, "box")(a.y))
    error = failures(made, 0.1, SimulationError, coupling=Coupling(scheme="iterated", passes=2, tolerance=1e-15))
    assert "does not converge: after 2 passes" in str(error)


@pytest.mark.parametrize("coupling", SCHEMES[:3], ids=NAMES[:3])
@pytest.mark.drawn(1)
def test_coupled_plants_are_saved_and_go_on_in_every_form(cache, coupling):
    file = build_fmu(mass_spring_damper())
    left, right = Fmu(file, name="left", start={"position": 0.1}), Fmu(file, name="right")
    pull = Gain(gain=30.0, name="pull")(left.position)
    made = Diagram("d", right(force=pull), left(force=sampled(10 * MS, "box")(right.position)))
    whole = simulate(made, 0.2, False, coupling=coupling)
    for first in FORMS:
        with made.simulation(compile=first, coupling=coupling) as simulation:
            simulation.advance(0.1)
            half = simulation.save()
            simulation.advance(0.1)
            assert simulation.run().data.tobytes() == whole.data.tobytes()
        for second in FORMS:
            again = made.simulate(0.1, start=half, compile=second, coupling=coupling, progress=False)
            assert again.data.tobytes() == whole.data[-len(again.t) :].tobytes()


@pytest.mark.drawn(1)
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("coupling", SCHEMES, ids=NAMES)
def test_coupled_plants_step_beside_continuous_states(folder, coupling, compiled):
    """The continuous states go on within the steps, as the scheme asks for; they have no wire to the plants."""
    ramp = Integrator(name="aside")(Clock(name="other"))
    made, alone = (chain(zoo_fmu(folder, 3), *more, isolate=False) for more in ([ramp], []))
    end = 100 * MS
    run = made.simulate(end, coupling=coupling, compile=compiled, rtol=1e-9, atol=1e-12, progress=False)
    assert run.tier == ("compiled" if compiled else "interpreted")
    np.testing.assert_allclose(run["aside.y"], run.t**2 / 2, rtol=0.0, atol=1e-12)
    reference = alone.simulate(end, coupling=coupling, progress=False)
    where = np.searchsorted(run.t, reference.t - 1e-12)
    for name in ("a.y", "b.y"):
        np.testing.assert_allclose(run[name][where], reference[name], rtol=0.0, atol=1e-13)
