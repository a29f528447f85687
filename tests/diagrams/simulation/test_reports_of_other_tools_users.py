"""What users of other block-diagram and co-simulation tools report again and again: here each of it comes out right."""

import gc
import os
import pickle
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import (
    Block,
    Clock,
    Compare,
    Constant,
    DoubleDriveError,
    Event,
    Function,
    Gain,
    Hold,
    Input,
    Integrator,
    OptionError,
    Output,
    ParameterError,
    PythonFunction,
    Ramp,
    Relay,
    SimulationError,
    Sine,
    State,
    StateSpace,
    Step,
    Sum,
    Switch,
    UnitDelay,
    UnknownNameError,
    UnwiredInputError,
    WiringError,
    parameter,
)
from loopwright.diagrams import AlgebraicLoopError, Diagram, NonFiniteError, subsystem
from loopwright.fmus import Fmu, FmuError, dc_motor, mass_spring_damper
from support.hybrid_blocks import TIGHT, Crossings, Falls, Lag, Takes, counting, decay

# --- time --------------------------------------------------------------------------------------------------------------


@pytest.mark.drawn(4)
@pytest.mark.parametrize("solver", ["euler", "heun", "rk4", "RK45", "DOP853", "BDF", "CVODE_BDF", "auto"])
def test_no_solver_misses_a_sample(solver):
    """A fixed step may be longer than the time between samples, or no divisor of it."""
    diagram = Diagram("d", counting(0.03, "n", offset=0.01)().named("n"), Falls(name="f"))
    run = diagram.simulate(1.2, solver=solver, progress=False)
    acted = {0.01 + 0.03 * k for k in range(40)}
    assert all(np.min(np.abs(run.t - t)) < 1e-12 for t in acted)
    assert run["n"][-1] == 40


def test_a_clock_of_a_millisecond_reads_8_after_8000_ticks_and_is_not_beyond_8_before_the_next():
    @subsystem(sample_time=1e-3)
    def box(t):
        return t.named("now"), Compare(">", name="beyond")(t, 8.0)

    run = Diagram("clock", box(Clock())).simulate(8.002, progress=False)
    assert run["clock.y"][8000] == run.t[8000] == 8.0
    assert np.flatnonzero(run["beyond.y"]).tolist() == [8001, 8002]


def test_an_edge_of_a_source_is_one_instant_and_not_a_ramp_over_a_step():
    """Peers draw it as a slope as long as a step of the solver, and what it drives is late."""
    run = Diagram("d", Integrator(name="i")(Step(times=1.0, values=1.0).named("u"))).simulate(
        2.0, step=0.001, solver="RK45", rtol=1e-3, progress=False
    )
    assert set(run["u"]) == {0.0, 1.0}
    assert run.t[np.argmax(run["u"])] == 1.0
    assert np.max(np.abs(run["i.y"] - np.maximum(run.t - 1.0, 0.0))) < 1e-12


def test_a_pulse_between_two_steps_is_not_stepped_over():
    pulse = Step(times=(3.3, 3.30001), values=(1e5, 0.0))
    run = Diagram("d", Integrator(name="i")(pulse)).simulate(10.0, step=5.0, progress=False)
    assert run["i.y"].tolist() == pytest.approx([0.0, 1.0, 1.0], rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["DOP853", "BDF", "rk4"])
def test_an_event_with_an_empty_action_does_not_change_the_solution(solver):
    class Watched(Block):
        x = State(output=True, start=1.0)
        v = State(output=True)
        cross = Event("both")
        watched: bool = parameter(default=True, structural=True)

        @property
        def events(self):
            return {"cross": type(self).cross} if self.watched else {}

        def derivative(self, t, x, u):
            return x.v, -x.x

        def indicators(self, t, x, u):
            return x.x

        def jump(self, t, x, u, fired):
            return x.x, x.v

    options = {"step": 0.01, "solver": solver, "rtol": 1e-10, "atol": 1e-12, "progress": False}
    run = Diagram("d", Watched(name="w")).simulate(20.0, **options)
    assert len(run.events) == 6
    error = np.max(np.abs(run["w.x"] - np.cos(run.t)))
    plain = Diagram("d", Watched(name="w", watched=False)).simulate(20.0, **options)
    assert error < 3 * np.max(np.abs(plain["w.x"] - np.cos(plain.t))) + 1e-12


def test_a_diagram_that_is_sampled_only_runs():
    run = Diagram("count", counting(0.1)().named("n")).simulate(0.5, progress=False)
    assert run["n"].tolist() == [1, 2, 3, 4, 5, 6]


def test_a_diagram_without_any_state_runs():
    run = Diagram("sum", Sum(name="s")(Ramp(slope=1.0), 1.0).named("y")).simulate(1.0, step=0.25, progress=False)
    assert run["y"].tolist() == [1.0, 1.25, 1.5, 1.75, 2.0]


def test_sampled_parts_in_continuous_ones_hold_their_outputs():
    """A tool for linear systems alone knows one kind of time for all of a diagram."""
    plant = Lag(name="plant")

    @subsystem(sample_time=0.5)
    def box(y):
        return 1.0 - y

    run = Diagram("d", plant(box(plant.y).named("u"))).simulate(2.0, **TIGHT)
    y = [0.0]
    for _ in range(4):
        y.append(y[-1] * decay(0.5) + (1 - y[-1]) * (1 - decay(0.5)))
    assert np.max(np.abs(run["plant.y"] - y)) < 1e-11


# --- wiring ------------------------------------------------------------------------------------------------------------


def test_a_block_that_is_wired_can_not_be_forgotten():
    """There is no list of blocks: what is wired belongs to the diagram, in front of the root and behind it."""
    driver = Gain(gain=3.0, name="driver")(Constant(value=2.0))
    last = Lag(name="last")(driver)
    diagram = Diagram("d", last)
    assert set(diagram.blocks) == {"constant", "driver", "last"}
    run = diagram.simulate(1.0, step=0.5, **TIGHT)
    assert run["last.y"] == pytest.approx(6 * (1 - decay(run.t)), abs=1e-11)


def test_an_input_that_is_not_wired_is_an_error_when_the_diagram_is_built_and_not_a_zero():
    lag = Lag(name="lag")
    with pytest.raises(UnwiredInputError, match=r"^lag\.u: an output of this block is used, but the block is never"):
        Diagram("d", Gain(gain=1.0)(lag.y))
    with pytest.raises(UnwiredInputError, match=r"^sum\.u2: nothing is wired to 'u2'"):
        Sum(name="sum")(1.0)
    for call in (Lag(name="lag"), Sum(name="sum")):
        with pytest.raises(WiringError, match=r"call it first|never called"):
            Diagram("d", call)


def test_an_output_that_needs_its_input_says_so_instead_of_an_assertion():
    with pytest.raises(WiringError, match=r"^g: it is used as a signal before it is wired; call it first.*g\(u=…\)"):
        Diagram("d", Lag(name="lag")(Gain(gain=2.0, name="g")))


def test_a_wired_input_is_never_driven_again_in_silence():
    gain = Gain(gain=1.0, name="g")
    with pytest.raises(DoubleDriveError, match=r"g: this block is called twice"):
        Diagram("d", Sum()(gain(1.0), gain(2.0)))
    with pytest.raises(DoubleDriveError, match=r"g\.u: it is driven twice"):
        gain(1.0, u=2.0)


def test_an_input_of_a_box_may_feed_many():
    @subsystem(sample_time=0.1)
    def box(u):
        return Gain(gain=1.0, name="a")(u), Gain(gain=2.0, name="b")(u), Sum(name="c")(u, u)

    run = Diagram("d", box(Constant(value=3.0))).simulate(0.1, progress=False)
    assert [run[f"{n}.y"][-1] for n in "abc"] == [3.0, 6.0, 6.0]


def test_a_signal_is_wired_to_the_input_that_is_named_whatever_the_order():
    named = Switch(name="s")(otherwise=Constant(value=2.0), condition=Constant(value=1.0), then=Constant(value=1.0))
    assert list(Switch(name="s").inputs) == ["condition", "then", "otherwise"]
    assert Diagram("d", named).simulate(0.1, step=0.1, progress=False)["s.y"].tolist() == [1.0, 1.0]


def test_a_slice_takes_as_many_entries_as_python_says():
    run = Diagram("d", Gain(gain=1.0, name="g")(Constant(value=[1.0, 2.0, 3.0], name="c").y[0:2])).simulate(
        0.1, step=0.1, progress=False
    )
    assert run["g.y"].tolist() == [[1.0, 2.0]] * 2


def test_equal_names_in_two_boxes_connect_nothing_and_add_nothing_up():
    @subsystem(sample_time=0.1)
    def one():
        return Gain(gain=1.0, name="g")(Constant(value=1.0, name="u")).named("y")

    @subsystem(sample_time=0.1)
    def two():
        return Gain(gain=1.0, name="g")(Constant(value=5.0, name="u")).named("y")

    run = Diagram("d", one(), two()).simulate(0.1, progress=False)
    assert (run["one.y"][0], run["two.y"][0]) == (1.0, 5.0)


def test_a_name_that_is_mistyped_is_an_error_with_what_it_may_mean():
    diagram = Diagram("d", Lag(name="plant")(Constant(value=1.0)).named("speed"))
    run = diagram.simulate(0.1, step=0.1, progress=False)
    with pytest.raises(UnknownNameError, match=r"'sped'.*Did you mean.*'speed'"):
        run["sped"]
    with pytest.raises(UnknownNameError, match=r"plont.*Did you mean.*plant"):
        diagram.replace({"plont.k": 2.0})
    with pytest.raises(ParameterError, match=r"Lag has no parameter 'kk'.*Did you mean 'k'"):
        Lag(kk=2.0)
    with pytest.raises(OptionError, match=r"DOP835.*DOP853"):
        diagram.simulate(0.1, solver="DOP835", progress=False)


@pytest.mark.slow
def test_errors_of_users_do_not_vanish_with_pythons_assertions():
    code = """
        from loopwright.blocks import Gain, Sum, UnwiredInputError
        from loopwright.diagrams import Diagram
        assert False, "-O takes assertions out"
        try:
            Diagram("d", Gain(gain=1.0)(Sum(name="s").y))
        except UnwiredInputError as error:
            print(error)
    """
    done = subprocess.run(
        [sys.executable, "-O", "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ,
    )
    assert done.stdout.startswith("s.u1: an output of this block is used, but the block is never called")


# --- loops -------------------------------------------------------------------------------------------------------------


def test_a_cycle_of_boxes_that_is_none_of_ports_is_no_algebraic_loop():
    """One path of the box integrates, the other one is direct; the direct one is not in the cycle."""

    @subsystem
    def box(a, b):
        return Integrator(name="slow")(a), Gain(gain=2.0, name="fast")(b)

    feedback = Gain(gain=-1.0, name="feedback")
    slow, fast = box(feedback.y, Constant(value=3.0))
    run = Diagram("d", feedback(Sum(name="sum")(slow, fast))).simulate(1.0, step=0.1, **TIGHT)
    assert np.max(np.abs(run["slow.y"] - 6 * (decay(run.t) - 1))) < 1e-10


def test_feedthrough_is_that_of_the_equations_and_not_assumed_for_safety():
    class Crossed(Block):
        """Each output takes one of the inputs."""

        a = Input()
        b = Input()
        first = Output()
        second = Output()

        def output(self, t, x, u):
            return 2.0 * u.a, 3.0 * u.b

    crossed = Crossed(name="c")
    run = Diagram("d", crossed(a=Constant(value=1.0), b=crossed.first)).simulate(0.1, step=0.1, progress=False)
    assert run["c.second"].tolist() == [6.0, 6.0]


def test_a_parameter_d_of_zero_is_no_feedthrough_and_another_one_is():
    def loop(D):
        plant = StateSpace(A=[[-1.0]], B=[1.0], C=[1.0], D=D, name="plant")
        return Diagram("d", plant(Gain(gain=-1.0, name="k")(plant.y)))

    assert loop(0.0).simulate(0.1, step=0.1, progress=False)["plant.y"].tolist() == [0.0, 0.0]
    with pytest.raises(AlgebraicLoopError):
        loop(0.5)
    direct = StateSpace(A=[[-1.0]], B=[1.0], C=[1.0], D=0.5, name="plant")
    run = Diagram("d", direct(Constant(value=1.0))).simulate(1.0, step=0.1, **TIGHT)
    assert np.max(np.abs(run["plant.y"] - (1.5 - decay(run.t)))) < 1e-11


def test_an_algebraic_loop_is_told_port_by_port_through_borders():
    gain, total = Gain(gain=0.5, name="k"), Sum(name="total")

    @subsystem
    def box(u):
        return gain(u)

    with pytest.raises(AlgebraicLoopError) as caught:
        Diagram("d", total(box(total.y), 1.0))
    for text in ("box.k.u", "box.k.y", "total.u1", "total.y", "wired to", "feeds through to"):
        assert text in str(caught.value)


@pytest.mark.parametrize("sampled", [True, False])
def test_a_nan_is_told_as_a_nan_and_not_as_an_algebraic_loop(sampled):
    def root():
        return Function(np.sqrt, name="root")(Ramp(slope=-1.0, initial_value=0.05))

    box = subsystem(sample_time=0.01 if sampled else None, name="box")(root)
    behind = Gain(gain=1.0, name="behind")
    diagram = Diagram("d", behind(box()), Falls(name="f"))
    with pytest.raises(NonFiniteError, match=r"^box\.root\.y, t = 0\.0\d+ s: found \[nan\]") as caught:
        diagram.simulate(1.0, step=0.01, progress=False)
    assert "loop" not in str(caught.value)
    assert caught.value.block == "box.root"
    assert 0.04 < caught.value.run.t[-1] <= 0.05


def test_a_function_is_never_called_with_inputs_that_nothing_has_computed():
    """Tools that sort by trial call it with zeros first, where it may not be defined."""
    seen = []

    def inverse(u):
        seen.append(float(u))
        return 1.0 / u

    chain = PythonFunction(inverse, results={"y": ()}, name="f")(Gain(gain=2.0, name="g")(Constant(value=2.0)))
    run = Diagram("d", Lag(name="lag")(chain)).simulate(1.0, step=0.5, progress=False)
    assert run["f.y"].tolist() == [0.25] * 3
    assert set(seen) == {4.0}


def test_a_loop_that_can_not_be_solved_is_an_error_and_not_a_wrong_result():
    square = Function(lambda u: u**2 + 1.0, name="square")
    with pytest.raises(SimulationError, match=r"square|loop"):  # y = y² + 1 has no real solution
        Diagram("d", square(square.y), loops="solve").simulate(1.0, step=0.5, progress=False)


def test_a_loop_that_is_solved_tells_its_residual():
    total = Sum(name="s")
    run = Diagram("d", total(Gain(gain=-3.0, name="k")(total.y), Clock()), loops="solve").simulate(
        1.0, step=0.1, progress=False
    )
    assert np.max(np.abs(run["s.y"] - run.t / 4)) < 1e-14
    assert len(run.residual) == len(run.t)
    assert np.max(run.residual) < 1e-14


def test_a_loop_of_logic_and_numbers_is_printed_by_its_ports():
    compare, switch = Compare(">", name="c"), Switch(name="s")

    @subsystem(sample_time=0.1)
    def box():
        return switch(compare(switch.y, 0.5), 0.0, 1.0)

    with pytest.raises(AlgebraicLoopError, match=r"box\.c\.u1") as caught:
        Diagram("d", box())
    assert "box.s.condition" in str(caught.value)


def test_a_relay_in_continuous_time_breaks_its_loop_by_its_state():
    plant, relay = Lag(name="plant"), Relay(on_point=-0.4, off_point=-0.6, name="relay")
    run = Diagram("d", plant(relay(Gain(gain=-1.0)(plant.y)))).simulate(10.0, step=0.1, **TIGHT)
    assert len(run.events) > 5
    assert np.all((run["plant.y"][run.t > 2.0] > 0.4 - 1e-9) & (run["plant.y"] < 0.6 + 1e-9)[run.t > 2.0])


# --- blocks and runs ---------------------------------------------------------------------------------------------------


def test_a_run_leaves_nothing_on_a_block():
    block = Lag(name="lag", start=1.0)
    before = {**vars(block)}
    diagram = Diagram("d", block(Constant(value=0.0)))
    first = diagram.simulate(1.0, step=0.1, progress=False)
    assert vars(block) == before
    second = diagram.simulate(1.0, step=0.1, progress=False)
    assert np.array_equal(first.data, second.data)
    assert Diagram("other", block(Constant(value=0.0))).simulate(1.0, step=0.1, progress=False)["lag.y"][0] == 1.0


def test_blocks_have_no_hidden_meaning_in_python():
    """Peers let len(block) mean feedthrough and bool(block) mean active, so `if block:` surprises."""
    gain = Gain(gain=0.0)
    assert bool(gain)
    with pytest.raises(TypeError):
        len(gain)
    with pytest.raises(ParameterError, match=r"a Gain is a value and can't be changed; use \.replace\(gain=…\)"):
        gain.gain = 2.0
    assert Gain(gain=1.0) == Gain(gain=1.0)


def test_what_is_recorded_changes_no_bit_of_the_solution():
    """A scope that is added must not add steps, or take a diagram's derivatives away."""

    def diagram():
        return Diagram("d", Crossings(name="c")(Lag(name="lag")(Sine(frequency=1.0, phase=0.3))))

    options = {"step": 0.01, "progress": False}
    whole = diagram().simulate(5.0, **options)
    some = diagram().simulate(5.0, record=["lag.y"], states=False, every=7, **options)
    assert [e.t for e in whole.events] == [e.t for e in some.events]
    assert np.array_equal(np.append(whole["lag.y"][:-1:7], whole["lag.y"][-1]), some["lag.y"])


def test_every_output_is_recorded_unless_told_otherwise():
    run = Diagram("d", Lag(name="lag")(Gain(gain=2.0, name="g")(1.0))).simulate(0.1, step=0.1, progress=False)
    assert {"lag.y", "g.y", "constant.y"} <= set(run.names)


def test_a_run_can_be_saved_on_the_way_and_continued():
    @subsystem(sample_time=0.1)
    def box(y):
        return UnitDelay(initial_value=0.0)(Gain(gain=0.5)(y))

    plant = Lag(name="plant")
    diagram = Diagram("d", plant(1.0 - box(plant.y)))
    straight = diagram.simulate(2.0, progress=False)
    half = diagram.simulate(1.0, progress=False)
    rest = diagram.simulate(1.0, start=pickle.loads(pickle.dumps(half.final_state)), progress=False)
    assert np.array_equal(rest["plant.y"], straight["plant.y"][straight.t >= 1.0])


@pytest.mark.slow
def test_a_diagram_can_be_run_many_times_without_growth():
    diagram = Diagram("d", Lag(name="lag")(Sine(frequency=1.0)))
    for _ in range(3):
        diagram.simulate(0.1, step=0.05, progress=False)
    gc.collect()
    before = len(gc.get_objects())
    for _ in range(30):
        diagram.simulate(0.1, step=0.05, progress=False)
    gc.collect()
    assert len(gc.get_objects()) - before < 30  # less than one object for each run


def test_a_step_that_fails_is_named_and_what_was_recorded_is_kept():
    def fails(u):
        if u > 0.45:
            raise ValueError("foreign code fails")
        return u

    @subsystem(sample_time=0.1)
    def box(t):
        return PythonFunction(fails, results={"y": ()}, name="foreign")(t).named("y")

    with pytest.raises(SimulationError, match=r"^box\.foreign.*t = 0\.5 s.*foreign code fails") as caught:
        Diagram("d", box(Clock())).simulate(1.0, progress=False)
    assert caught.value.run["y"].tolist() == [0.0, 0.1, 0.2, 0.3, 0.4]


@pytest.mark.slow
def test_the_result_of_a_loose_tolerance_is_as_good_as_that_tolerance_with_sampled_parts_too():
    """Default tolerances that differ from function to function give answers that disagree."""

    def pendulum():
        v, x = Integrator(initial_value=0.0, name="v"), Integrator(initial_value=1.0, name="x")
        return v(-1.0 * Function(np.sin, name="sine")(x.y)), x(v.y)

    exact = solve_ivp(lambda t, s: [-np.sin(s[1]), s[0]], (0, 10), [0.0, 1.0], method="DOP853", rtol=1e-12, atol=1e-13)
    for extra in ((), (counting(0.37)(),)):
        for solver in ("auto", "RK45", "DOP853", "LSODA", "BDF", "CVODE_Adams"):
            run = Diagram("p", *pendulum(), *extra).simulate(10.0, solver=solver, step=0.01, progress=False)
            assert run["x.y"][-1] == pytest.approx(exact.y[1, -1], abs=1e-3), solver


def test_events_that_come_at_once_all_act():
    trigger = Compare(">=", name="trigger")(Clock(), 0.5)
    taken = [Takes(name=f"take{k}")(Constant(value=float(k)), trigger) for k in range(1, 4)]
    run = Diagram("d", *taken).simulate(1.0, step=0.1, progress=False)
    assert [run[f"take{k}.y"][-1] for k in range(1, 4)] == [1.0, 2.0, 3.0]


# --- FMUs --------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spring():
    return mass_spring_damper.build()


def test_two_fmus_in_one_diagram_share_nothing(spring):
    """Port maps and start values that are kept on a class mix up the instances."""
    stiff = Fmu(spring, name="stiff", start={"stiffness": 400.0, "damping": 0.0})
    soft = Fmu(spring, name="soft", start={"damping": 0.0})
    motor = Fmu(dc_motor.build(), name="motor")
    calls = stiff(force=0.0), soft(force=0.0), motor(voltage=0.0, load_torque=0.0)
    run = Diagram("two", *calls).simulate(1.0, step=0.01, progress=False)
    assert np.max(np.abs(run["soft.position"] - 0.1 * np.cos(10 * run.t))) < 1e-6
    assert np.max(np.abs(run["stiff.position"] - 0.1 * np.cos(20 * run.t))) < 1e-6
    assert set(motor.outputs).isdisjoint(soft.outputs)
    alone = Diagram("one", Fmu(spring, name="soft", start={"damping": 0.0})(force=0.0)).simulate(
        1.0, step=0.01, progress=False
    )
    assert np.array_equal(alone["soft.position"], run["soft.position"])


def test_start_values_hold_in_every_run_and_unknown_ones_are_refused(spring):
    diagram = Diagram("d", Fmu(spring, name="m", start={"position": 0.3})(force=0.0))
    assert [diagram.simulate(0.1, step=0.01, progress=False)["m.position"][0] for _ in range(3)] == [0.3] * 3
    with pytest.raises((FmuError, UnknownNameError), match=r"stifness.*Did you mean.*'stiffness'"):
        Fmu(spring, name="m", start={"stifness": 1.0})


@pytest.mark.slow
def test_an_fmu_is_loaded_over_and_over_in_one_process(spring):
    diagram = Diagram("d", Fmu(spring, name="m")(force=0.0))
    count = len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0
    results = {diagram.simulate(0.02, step=0.01, progress=False)["m.position"].tobytes() for _ in range(60)}
    assert len(results) == 1
    if count:
        assert len(os.listdir("/proc/self/fd")) <= count + 3


def test_the_delay_between_coupled_fmus_is_that_of_a_step_and_shrinks_with_it(spring):
    """Two masses, each pulled by a spring towards the other, coupled once a step: the error is of first order."""

    def distance(h):
        a = Fmu(spring, name="a", start={"position": 0.1, "stiffness": 50.0, "damping": 1.0})
        b = Fmu(spring, name="b", start={"position": -0.05, "stiffness": 50.0, "damping": 1.0})
        pull = Gain(gain=30.0, name="pull")(b.position - a.position)
        run = Diagram("d", a(force=pull), b(force=-1.0 * pull)).simulate(1.0, step=h, progress=False)
        return run["a.position"][-1]

    def rates(t, s):
        x, v, y, w = s
        f = 30.0 * (y - x)
        return [v, f - v - 50 * x, w, -f - w - 50 * y]

    exact = solve_ivp(rates, (0, 1), [0.1, 0.0, -0.05, 0.0], method="DOP853", rtol=1e-12, atol=1e-14).y[0, -1]
    errors = [abs(distance(h) - exact) for h in (0.01, 0.005, 0.0025)]
    assert -np.polyfit([0, 1, 2], np.log2(errors), 1)[0] == pytest.approx(1.0, abs=0.2)


def test_an_fmu_samples_every_step_and_a_hold_behind_it_only_its_own_ticks(spring):
    m = Fmu(spring, name="m", start={"damping": 0.0})

    @subsystem(sample_time=0.02)
    def slow(u):
        return Hold()(u).named("held")

    run = Diagram("d", m(force=0.0), slow(m.position)).simulate(0.1, step=0.01, progress=False)
    assert len(run.t) == 11
    assert np.array_equal(run["held"], run["m.position"][[0, 0, 2, 2, 4, 4, 6, 6, 8, 8, 10]])
