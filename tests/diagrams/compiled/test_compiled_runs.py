"""Runs in C: the bits of interpreted runs, the numbers of matrices, and the same words where something goes wrong."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Clock,
    Compare,
    Gain,
    GuardError,
    Lookup1D,
    Product,
    Requirement,
    Sine,
    StopCondition,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Interrupted, NonFiniteError, Run, experiments, subsystem
from loopwright.diagrams.compiled import compiled_libraries
from loopwright.fmus import Fmu, FmuRuntimeError, dc_motor
from loopwright.fmus.runtime import runtime_source
from support.both_forms import assert_same_bits
from support.random_cases import random_cases
from support.random_linear import BASE, PERIOD, Matrices, diagram, specs
from support.zoo import zoo_fmu

QUIET = {"progress": False}


def both(made, duration, **options):
    """Return both runs. Python may go through the last tick, where the run ends and no clock acts."""
    interpreted, compiled = (made.simulate(duration, compile=form, **QUIET, **options) for form in (False, True))
    assert not any(message.startswith("Interpreted") for message in compiled.messages)
    return interpreted, compiled


def sums(every=0.01, offset=0.0, name="box"):
    """A running sum of a sine, and its square."""

    @subsystem(sample_time=every, offset=offset, name=name)
    def box(u):
        before = UnitDelay(initial_value=0.0, name="sum")
        total = u + before.y
        before(total)
        return Product(name="square")(total, total)

    return box


def one_rate():
    return Diagram("one", sums()(Sine(frequency=7.0, name="source")).named("y"))


def three_rates():
    source = Sine(frequency=7.0, name="source")
    boxes = [sums(every, offset, f"box{i}")(source) for i, (every, offset) in enumerate(RATES)]
    return Diagram("three", *boxes)


RATES = ((0.02, 0.0), (0.03, 0.01), (0.05, 0.02))


def motor_loop():
    """A PI controller on a motor's FMU."""

    @subsystem(sample_time=1e-3, name="controller")
    def controller(speed):
        error = 10.0 - speed
        memory = UnitDelay(initial_value=0.0, name="integral")
        integral = memory(memory.y + 1e-3 * error)
        return 0.05 * error + 0.4 * integral

    plant = Fmu(dc_motor.build(), name="plant")
    return Diagram("loop", plant(voltage=controller(plant.speed), load_torque=0.02))


@pytest.mark.parametrize(
    "letter", [pytest.param(letter, marks=[] if letter == "C" else pytest.mark.slow) for letter in "ABCD"]
)
def test_an_experiment_of_the_paper_has_the_same_bits(letter):
    made = experiments.EXPERIMENTS[letter]().diagram
    assert_same_bits(*both(made, 2.0))


@random_cases(2, 40, specs(least=12, continuous=False))
def test_random_linear_diagrams_have_the_bits_and_the_product_of_matrices(spec):
    for _ in range(12):
        oracle = Matrices(spec)
        if oracle.growth() < 2.0:
            break
        spec = spec.scaled(0.5)
    ticks, expected = oracle.run(PERIOD)
    made = diagram(spec)
    interpreted, compiled = both(made, PERIOD * BASE, step=BASE if oracle.quiet else None)
    assert_same_bits(interpreted, compiled)
    rows = np.searchsorted(compiled.t, np.array(ticks) / 100)
    found = np.hstack([np.reshape(compiled[f"b{i}.y"], (len(compiled.t), -1)) for i in range(len(spec.nodes))])
    assert np.max(np.abs(found[rows] - expected)) < 1e-10 * max(1.0, np.max(np.abs(expected)))


def test_a_sum_is_that_of_numpy():
    run = one_rate().simulate(5.0, compile=True, **QUIET)
    assert np.array_equal(run["y"], np.cumsum(run["source.y"]) ** 2)


def test_several_rates_visit_their_ticks_only():
    interpreted, compiled = both(three_rates(), 3.0)
    assert_same_bits(interpreted, compiled)
    expected = {0} | {
        k for k in range(301) for every, offset in ((2, 0), (3, 1), (5, 2)) if k >= offset and (k - offset) % every == 0
    }
    assert np.array_equal(compiled.t, np.array(sorted(expected | {300})) / 100)
    assert_same_bits(*both(three_rates(), 3.0, step=0.005))


@pytest.mark.parametrize(
    "options", [{"every": 7}, {"record": ["y"]}, {"states": False}, {"every": 3, "record": ["source"]}]
)
def test_what_is_recorded_is_the_same(options):
    """Every tick, or every seventh, and the last one."""
    interpreted, compiled = both(one_rate(), 12.34, **options)
    assert_same_bits(interpreted, compiled)
    ticks = np.unique([*range(0, 1235, options.get("every", 1)), 1234])
    assert np.array_equal(compiled.t, ticks / 100)
    u = np.sin(14.0 * np.pi * np.arange(1235) / 100)
    name, expected = ("source.y", u) if options.get("record") == ["source"] else ("y", np.cumsum(u) ** 2)
    assert np.max(np.abs(compiled[name] - expected[ticks])) < 1e-10


def test_a_run_to_disk_is_the_same(tmp_path):
    interpreted = one_rate().simulate(30.0, every=2, **QUIET)
    compiled = one_rate().simulate(30.0, every=2, to=tmp_path / "run", compile=True, **QUIET)
    assert_same_bits(interpreted, Run.open(tmp_path / "run"))
    assert_same_bits(interpreted, compiled)


def exact_motor(n):
    """The speed of that motor at n ticks after the start, by the exponential of a matrix."""
    R, L, K, J, b = 1.2, 2e-3, 0.05, 2e-5, 1e-5
    motor = np.array([[-R / L, -K / L, 1.0 / L, 0.0], [K / J, -b / J, 0.0, -1.0 / J], [0.0] * 4, [0.0] * 4])
    step, x, integral, found = expm(1e-3 * motor)[:2], np.zeros(2), 0.0, []
    for _ in range(n + 1):
        found.append(x[1])
        error = 10.0 - x[1]
        x, integral = step @ [*x, 0.05 * error + 0.4 * integral, 0.02], integral + 1e-3 * error
    return np.array(found)


def test_a_run_goes_on_is_saved_and_branches_between_both_forms():
    made = motor_loop()
    whole = made.simulate(0.4, **QUIET)
    assert np.max(np.abs(whole["plant.speed"] - exact_motor(400))) < 1e-5
    with made.simulation(compile=True) as simulation:
        simulation.advance(0.1)
        simulation.advance(0.1)
        half = simulation.save()
        simulation.advance(0.2)
        assert_same_bits(whole, simulation.run())
        simulation.restore(half)
        simulation.advance(0.2)
        assert simulation.run().data.tobytes() == whole.data[200:].tobytes()
    assert made.simulate(0.2, start=half, **QUIET).data.tobytes() == whole.data[200:].tobytes()
    interpreted = made.simulate(0.2, **QUIET).final_state
    assert made.simulate(0.2, start=interpreted, compile=True, **QUIET).data.tobytes() == whole.data[200:].tobytes()


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_fmu_in_the_loop_is_that_of_the_matrix_exponential_with_the_same_bits(fmi):
    """To 1e-5 of 10 rad/s: the FMU's own steps of 0.1 ms, see tests/diagrams/compiled/test_fused_runs.py."""
    made = motor_loop().replace(plant=Fmu(dc_motor.build(fmi=fmi), name="plant"))
    interpreted, compiled = both(made, 1.0)
    assert_same_bits(interpreted, compiled)
    assert np.max(np.abs(compiled["plant.speed"] - exact_motor(1000))) < 1e-5


def test_a_stop_condition_ends_it_at_its_tick():
    @subsystem(sample_time=0.1)
    def box(t):
        return StopCondition(name="stop")(Compare(">")(t, 0.4321))

    @subsystem(sample_time=0.1)
    def clock():
        return Gain(gain=1.0)(Clock())

    interpreted, compiled = both(Diagram("d", box(clock())), 1.0)
    assert_same_bits(interpreted, compiled)
    assert compiled.stopped.t == 0.5


def failing(block, error, made, duration=1.0):
    runs = []
    for form in (False, True):
        with pytest.raises(error) as caught:
            made.simulate(duration, compile=form, **QUIET)
        assert block is None or caught.value.block == block
        runs.append((str(caught.value), caught.value.run))
    assert runs[0][0] == runs[1][0]
    assert_same_bits(runs[0][1], runs[1][1])
    return runs[1]


def test_a_guard_that_fails_says_the_same_and_keeps_the_same():
    @subsystem(sample_time=0.01)
    def box(u):
        return Requirement(requirement="below 0.9", name="limit")(Compare("<")(u, 0.9))

    _, run = failing("box.limit", GuardError, Diagram("d", box(Sine(frequency=1.0))))
    assert run.t[-1] == pytest.approx(np.arcsin(0.9) / (2 * np.pi), abs=0.01)


@pytest.mark.parametrize("fault", ["step discard 0.05", "set error 0.05", "get error 0.05"])
def test_an_fmu_that_fails_says_the_same_and_keeps_the_same(fault, tmp_path):
    @subsystem(sample_time=0.01)
    def box():
        return Gain(gain=1.0)(Clock())

    plant = Fmu(zoo_fmu(tmp_path, 3, fault), isolate=False, name="plant")
    _, run = failing("plant", FmuRuntimeError, Diagram("d", plant(u=box())))
    assert run.t[-1] == pytest.approx(0.05, abs=0.011)


def test_a_value_that_is_not_finite_says_the_same_and_keeps_the_same():
    @subsystem(sample_time=0.01)
    def box():
        total = UnitDelay(name="total", initial_value=1.0)
        return total(1e10 * total.y)

    _, run = failing(None, NonFiniteError, Diagram("d", box()))
    assert run["box.total.y"][-1] == pytest.approx(1e290, rel=1e-12)


def test_tables_are_compiled_and_may_differ_in_signs_of_zeros():
    @subsystem(sample_time=0.01)
    def box(u):
        return Lookup1D(breakpoints=[-1.0, 0.0, 0.5, 1.0], values=[2.0, -1.0, 0.0, 3.0], name="table")(u)

    interpreted, compiled = both(Diagram("d", box(Sine(frequency=1.0)).named("y")), 2.0)
    assert np.array_equal(interpreted.data, compiled.data)
    source = np.sin(2.0 * np.pi * compiled.t)
    assert np.max(np.abs(compiled["y"] - np.interp(source, [-1.0, 0.0, 0.5, 1.0], [2.0, -1.0, 0.0, 3.0]))) < 1e-13
    assert "signs of zeros" in " ".join(compiled.messages)


@pytest.fixture
def fresh():
    """No library that this process has loaded counts."""
    compiled_libraries.load_compiled.cache_clear()


def test_a_run_without_a_compiler_is_interpreted_and_says_so(monkeypatch, fresh):
    monkeypatch.setenv("LOOPWRIGHT_CC", "no-such-compiler")
    run = one_rate().simulate(1.0, compile=True, **QUIET)
    assert [m for m in run.messages if "no-such-compiler" in m]
    assert_same_bits(one_rate().simulate(1.0, **QUIET), run)


def test_ctrl_c_keeps_what_was_recorded():
    seen = []

    def interrupt(t):
        seen.append(t)
        if t > 5.0:
            raise KeyboardInterrupt

    with one_rate().simulation(compile=True) as simulation, pytest.raises(Interrupted) as caught:
        simulation.advance(100000.0, progress=interrupt)
    assert caught.value.run.t[-1] == seen[-1]
    assert_same_bits(one_rate().simulate(float(seen[-1]), **QUIET), caught.value.run)


@pytest.mark.skipif("os.name != 'posix'", reason="owners and modes are those of POSIX")
def test_a_folder_that_others_can_write_is_not_trusted(tmp_path, monkeypatch, fresh):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path))
    folder = tmp_path / "compiled"
    folder.mkdir()
    (left := folder / f"{'0' * 40}.so").touch()
    folder.chmod(0o777)
    assert_same_bits(*both(one_rate(), 1.0))
    assert folder.stat().st_mode & 0o777 == 0o700
    assert not left.exists()


def test_a_library_that_was_cut_off_is_compiled_again(tmp_path, monkeypatch, fresh):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path))
    source = runtime_source()
    library = compiled_libraries._library_of(source)
    compiled_libraries.load_compiled(source)
    part = library.read_bytes()[: library.stat().st_size // 2]
    library.unlink()  # it is loaded, and must not change under this process
    library.write_bytes(part)
    assert not compiled_libraries.is_kept(source)
    compiled_libraries.load_compiled.cache_clear()
    assert compiled_libraries.load_compiled(source)["loopwright_run"].__name__ == "loopwright_run"
    assert library.stat().st_size > len(part)
    assert compiled_libraries.is_kept(source)
