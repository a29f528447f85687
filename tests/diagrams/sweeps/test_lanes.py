"""Sweeps side by side in vector lanes: near single runs to a stated bound, with failures that harm nobody."""

import warnings

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    Gain,
    Input,
    Integrator,
    OptionError,
    Output,
    Sine,
    UnitDelay,
)
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.sweeps import final, lane_worker, maximum, mean, minimum, settling_time
from loopwright.diagrams.sweeps.bound_run import BoundRun
from loopwright.diagrams.sweeps.lane_worker import DIFFER
from loopwright.diagrams.sweeps.plan import make_plan
from loopwright.diagrams.sweeps.samples import Sample
from loopwright.diagrams.sweeps.workers import make_worker
from loopwright.fmus import Fmu
from loopwright.fmus.models import bouncing_ball
from support.lanes import QUIET, STEP, T, loop, noisy, three_plants

LANES = 4
NEAR = 1e-12
"""Difference of a run in a lane from a single one, of the largest value: some thousand roundings of a stable loop."""
PAPER = 1e-10
"""The difference that docs/howto/sweeps.md states for the experiments of the paper, whose friction is steep near rest."""


def exact_states(gain, lag, kp, ticks):
    """x at ticks: a step of the integrator of order 4 of a linear equation is known in closed form."""
    z = -STEP / lag
    growth = (1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24) ** round(T / STEP)
    x = [0.0]
    for _ in range(ticks):
        x.append(growth * x[-1] + (1 - growth) * gain * kp * (1.0 - x[-1]))
    return np.array(x)


def assert_near_single_runs(diagram, found, duration, names, *, bound=NEAR, **options):
    for sample, outcome in zip(found.samples, found.outcomes, strict=True):
        single = diagram.replace(sample.parameters).simulate(duration, **QUIET, **options)
        assert np.array_equal(outcome.t, single.t)
        assert outcome.end == single.t[-1]
        assert outcome.stopped == ("" if single.stopped is None else single.stopped.block)
        for name in names:
            largest = max(np.abs(single[name]).max(), 1e-3)
            assert outcome.signals[name].shape == single[name].shape
            assert np.abs(outcome.signals[name] - single[name]).max() <= bound * largest, (sample, name)


def ran_in_lanes(found):
    return DIFFER in found.messages and not any("Not side by side" in text for text in found.messages)


def test_runs_are_those_of_the_closed_form_with_other_parameters_in_every_lane():
    gains, lags, factors = (0.5, 1.0, 2.0), (0.1, 0.3), (1.0, 2.0)  # 12 runs in vectors of 4, and 2 left over
    table = [{"plant.gain": g, "plant.lag": lag, "kp.gain": k} for g in gains for lag in lags for k in factors] + [
        {"plant.gain": 0.7, "plant.lag": 0.2, "kp.gain": 1.5},
        {"plant.gain": 0.9, "plant.lag": 0.25, "kp.gain": 0.5},
    ]
    reduce = {
        "end": final("x"),
        "top": maximum("x"),
        "bottom": minimum("u"),
        "mean": mean("x"),
        "settled": settling_time("x", band=0.02),
        "late": settling_time("x", band=0.02, since=0.1),
        "mine": lambda run: [run["x"][10], run.t[10]],
    }
    found = loop().sweep(
        None, 1.0, samples=table, signals=["x", "mixed", "shifted"], reduce=reduce, lanes=LANES, **QUIET
    )
    assert ran_in_lanes(found)
    assert DIFFER.endswith("differ from those of single runs by rounding, which some motions magnify.")
    assert not found.failures
    for i, sample in enumerate(table):
        x = exact_states(sample["plant.gain"], sample["plant.lag"], sample["kp.gain"], 100)
        np.testing.assert_allclose(found["x"][i], x, rtol=0, atol=1e-13)
        np.testing.assert_allclose(found["mixed"][i][1:], 2 * x[1:] + sample["kp.gain"] * (1 - x[:-1]), atol=1e-12)
        np.testing.assert_allclose(found["shifted"][i], x + 1.0, rtol=0, atol=1e-13)
        assert found["end"][i] == found["x"][i][-1]
        assert found["top"][i] == found["x"][i].max()
        assert found["bottom"][i] == pytest.approx(sample["kp.gain"] * (1 - x.max()), abs=1e-12)
        assert found["mean"][i] == pytest.approx(np.trapezoid(x, dx=T), abs=1e-12)
        assert found["mine"][i] == pytest.approx([x[10], 0.1], abs=1e-13)
    single = loop().sweep(None, 1.0, samples=table, reduce=reduce, **QUIET)
    assert not any(DIFFER in text for text in single.messages)
    for name in reduce:
        np.testing.assert_allclose(found[name], single[name], rtol=1e-11, atol=1e-12)


def test_the_number_of_lanes_and_of_threads_and_the_neighbours_change_no_bit():
    rng = np.random.default_rng(4)
    table = [{"plant.gain": g, "plant.bend": b} for g, b in rng.uniform(0.5, 1.5, (11, 2))]
    ends = [
        loop().sweep(None, 0.5, samples=samples, reduce={"end": final("x")}, lanes=LANES, workers=workers, **QUIET)[
            "end"
        ]
        for samples, workers in ((table, 1), (table, 3), (table[::-1], 1), (table[3:5], 1))
    ]
    assert ends[0].tobytes() == ends[1].tobytes() == ends[2][::-1].tobytes()
    assert ends[0][3:5].tobytes() == ends[3].tobytes()


def test_a_run_that_fails_says_what_a_single_one_says_and_harms_no_other():
    table = [{"plant.bend": b} for b in (0.0, 0.3, -9.0, 0.1, 0.2)]  # of −9 the state grows without bound
    diagram = loop()
    found = diagram.sweep(None, 2.0, samples=table, signals="x", reduce={"end": final("x")}, lanes=LANES, **QUIET)
    alone = diagram.sweep(None, 2.0, samples=table, signals="x", reduce={"end": final("x")}, **QUIET)
    assert [(f.index, f.kind, f.message, f.t) for f in found.failures] == [
        (f.index, f.kind, f.message, f.t) for f in alone.failures
    ]
    (failure,) = found.failures
    assert failure.index == 2
    assert "became" in failure.message
    assert found.outcomes[2].signals["x"].tobytes() == alone.outcomes[2].signals["x"].tobytes()
    others = [0, 1, 3, 4]
    np.testing.assert_allclose(found["x"][others], alone["x"][others], rtol=NEAR, atol=NEAR)
    without = diagram.sweep(None, 2.0, samples=[table[i] for i in others], signals="x", lanes=LANES, **QUIET)
    assert found["x"][others].tobytes() == without["x"].tobytes()


def test_all_runs_of_a_vector_may_fail_and_values_that_are_refused_are_failures():
    table = [{"plant.bend": b} for b in (-8.0, -9.0, -10.0, -11.0, "much", 0.1)]
    found = loop().sweep(None, 2.0, samples=table, reduce={"end": final("x")}, lanes=LANES, **QUIET)
    assert found.failed.tolist() == [True] * 5 + [False]


@pytest.mark.parametrize("every", [1, 7])
def test_runs_that_stop_end_at_their_own_ticks_and_rates_are_kept(every):
    table = [{"plant.gain": g, "kp.gain": k} for g in (0.6, 0.8, 1.1) for k in (0.5, 2.0)]
    diagram = loop(stops=True, slow=3)
    found = diagram.sweep(None, 0.37, samples=table, signals=["x", "k"], lanes=LANES, every=every, **QUIET)
    assert ran_in_lanes(found)
    assert len({*found.end.tolist()}) > 2
    assert_near_single_runs(diagram, found, 0.37, ["x", "k"], every=every)


def test_runs_of_other_structure_or_other_steps_go_side_by_side_with_their_like():
    table = [
        {"plant.internal_step": h, "kp.gain": k, "plant.gain": g}
        for h in (STEP, 5e-3)
        for k in (0.0, 2.0)
        for g in (1.0, 1.2, 1.4)
    ]
    diagram = loop()
    found = diagram.sweep(None, 0.2, samples=table, signals="x", lanes=LANES, **QUIET)
    assert ran_in_lanes(found)
    assert_near_single_runs(diagram, found, 0.2, ["x"])


class Odd(Block):
    """Twice its input, evaluated by Python."""

    opaque = True
    u = Input()
    y = Output()

    def output(self, t, x, u):
        return 2.0 * u.u


def notes(diagram, table, duration=0.1, **options):
    """Return why runs don't go side by side; they have the bits of a sweep without lanes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = diagram.sweep(None, duration, samples=table, signals="x", lanes=LANES, workers=1, **QUIET, **options)
    assert not found.failures
    bare = diagram.sweep(None, duration, samples=table, signals="x", workers=1, **QUIET, **options)
    assert found["x"].tobytes() == bare["x"].tobytes()
    (text,) = (text for text in found.messages if text.startswith("Not side by side in vector lanes: "))
    assert DIFFER not in found.messages
    return text


def test_runs_that_cannot_go_side_by_side_go_by_themselves_and_say_why():
    table = [{"kp.gain": 1.0}, {"kp.gain": 1.5}]
    assert "don't go from tick to tick in C" in notes(loop(), table, compile=False)
    assert "plant chooses the steps of its integrator, and lanes need" in notes(
        loop(), [{**row, "plant.integrator": 2} for row in table]
    )
    assert "more than 10000 substeps" in notes(loop(), [{**row, "plant.internal_step": 1e-8} for row in table], 0.01)
    assert "box.odd is evaluated by Python" in notes(loop(more=lambda u: Odd(name="odd")(u)), table)
    assert "whole number of ticks" in notes(loop(), table, 0.105)
    rates = Diagram(
        "rates", Gain(gain=1.0, name="kp")(Integrator(name="held")(Constant(value=1.0, name="one"))).named("x")
    )
    assert "it has continuous states, those of held, and each run would choose its steps" in notes(rates, table, step=T)


def test_why_each_run_needs_a_set_up_of_its_own_is_told():
    table = [{"kp.gain": 1.0}, {"kp.gain": 1.5}]
    isolated = loop()
    isolated = isolated.replace({"plant": isolated["plant"].replace(isolate=True)})
    assert "plant was not built by Loopwright on this machine, or runs in its own process" in notes(isolated, table)
    assert "they continue from a state" in notes(loop(), table, start=loop().operating_point(0.05))


@pytest.mark.parametrize(("kind", "port"), [("triggered", "trigger"), ("enabled", "enable")])
def test_a_subsystem_that_acts_between_ticks_is_named(kind, port):
    mode = {"triggered": "rising", "enabled": "held"}[kind]
    latch = subsystem(name="latch", **{kind: mode})(lambda u: Gain(gain=1.0, name="kp")(u))
    wave = Sine(frequency=30.0, name="wave")
    diagram = Diagram("events", latch(wave, **{port: wave}).named("x"))
    text = notes(diagram, [{"kp.gain": 1.0}, {"kp.gain": 1.5}], step=T)
    assert "latch is a subsystem that is enabled or triggered in continuous time" in text
    assert "sample_time" in text


def test_lanes_are_a_number_that_processors_have():
    for wrong in (3, 0, "all", 4.5):
        with pytest.raises(OptionError, match=r"found lanes=.*; expected True for 8 runs side by side, 2, 4, 8, 16"):
            loop().sweep({"kp.gain": (1.0,)}, 0.1, signals="x", lanes=wrong, **QUIET)


def test_results_in_lanes_are_stored_apart_from_those_of_single_runs(tmp_path):
    values = [0.5, 0.7, 0.9, 1.1, 1.3]

    def run(values, **options):
        return loop().sweep(
            {"kp.gain": values}, 0.1, reduce={"end": final("x")}, to=tmp_path / "kept", **QUIET, **options
        )

    first = run(values[:3], lanes=LANES)
    again = run(values, lanes=2)  # how many there are changes no bit
    assert (first.reused, again.reused) == (0, 3)
    assert again["end"][:3].tobytes() == first["end"].tobytes()
    assert DIFFER in again.messages
    with pytest.raises(OptionError, match="differs from this one"):
        run(values)


@pytest.mark.slow
def test_several_plants_with_vectors_of_ports_run_in_one_loop():
    diagram = three_plants()
    rng = np.random.default_rng(8)
    table = [
        {"arm_gain.gain[1,1]": a, "mass_spring_damper.stiffness": k, "dc_motor.resistance": r}
        for a, k, r in rng.uniform((2.0, 5.0, 0.5), (4.0, 20.0, 2.0), (6, 3))
    ]
    found = diagram.sweep(None, 0.4, samples=table, signals=["tip", "angle", "a"], lanes=LANES, **QUIET)
    assert ran_in_lanes(found)
    assert np.ptp(found["tip"][:, -1], axis=0).min() > 1e-6
    assert_near_single_runs(diagram, found, 0.4, ["tip", "angle", "a"])


def test_fmus_with_events_go_by_themselves():
    ball = Fmu(bouncing_ball.build(), name="ball")
    diagram = Diagram("ball", ball(), subsystem(sample_time=T, name="box")(lambda x: 2.0 * x)(ball.height).named("y"))
    found = diagram.sweep({"ball.height": (1.0, 2.0)}, 0.1, signals="y", lanes=LANES, workers=1, **QUIET)
    assert "Not side by side in vector lanes: ball: it has events." in found.messages
    assert not found.failures


@pytest.mark.slow
@pytest.mark.parametrize("make", [experiments.path_following, experiments.hand_guiding, experiments.force_tracking])
def test_experiments_are_near_single_runs_whatever_their_friction_and_their_gains(make):
    experiment = make()
    ranges = {"plant.coulomb_scale": (0.5, 1.5), "plant.viscous_scale": (0.5, 1.5), "pid_perp.a1": (4000.0, 6000.0)}
    names = ["xi", "eta", "motor_force", "position"]
    options = {"samples": "latin", "count": 9, "signals": names, "workers": 1, **QUIET}
    found, alone = experiment.sweep(ranges, lanes=8, **options), experiment.sweep(ranges, **options)
    assert ran_in_lanes(found)
    assert not found.failures
    for name in names:
        assert np.abs(found[name] - alone[name]).max() <= PAPER * np.abs(alone[name]).max(), name


def test_runs_whose_samples_would_fill_the_memory_go_by_themselves(monkeypatch):
    monkeypatch.setattr(lane_worker, "machine_memory", lambda: 10_000)
    found = loop().sweep({"kp.gain": (1.0, 2.0)}, 1.0, reduce={"end": lambda run: run["x"][-1]}, lanes=LANES, **QUIET)
    assert any("the samples of 4 runs at a time would take" in text for text in found.messages)
    assert DIFFER not in found.messages


def test_what_the_start_of_a_run_has_told_belongs_to_that_run(monkeypatch):
    told = BoundRun.begin

    def begin(bound, numbers):
        told(bound, numbers)
        gain = np.nansum(bound.engine.workspace.here.p)
        bound.engine.workspace.messages = (f"begun with {gain:.6g}",)

    monkeypatch.setattr(BoundRun, "begin", begin)
    samples = [{"kp.gain": gain} for gain in (1.0, 1.5, 3.0)]
    options = {"start_exchange": "once", "workers": 1}  # such runs are started one by one
    found = loop().sweep(None, 0.1, samples=samples, reduce={"end": final("x")}, lanes=LANES, **options, **QUIET)
    texts = [outcome.messages for outcome in found.outcomes]
    assert [len(text) for text in texts] == [2, 2, 2]
    assert len({text[0] for text in texts}) == 3


def test_rates_that_rarely_meet_and_an_end_at_which_none_acts():
    """y(n) = 0.5 y(n − 1) + k sin(t) at two rates, 20 and 30 ms, over 0.25 s: at its end neither acts."""

    def counted(name, every):
        @subsystem(sample_time=every * T, name=name)
        def box(u):
            kept = UnitDelay(initial_value=0.0, name="kept")
            kept(0.5 * kept.y + u)
            return kept.y

        return box

    u = Gain(gain=1.0, name="k")(Sine(frequency=1.0, name="sine"))
    diagram = Diagram("rates", counted("two", 2)(u).named("y2"), counted("three", 3)(u).named("y3"))
    gains = (0.5, 1.0, 3.0)
    found = diagram.sweep({"k.gain": gains}, 0.25, signals=["y2", "y3"], lanes=LANES, workers=1, **QUIET)
    assert ran_in_lanes(found)
    for name, every in (("y2", 2), ("y3", 3)):
        for values, t, gain in zip(found[name], [o.t for o in found.outcomes], gains, strict=True):
            y, wanted, k = 0.0, [], 0
            for now in np.round(t / T).astype(int):
                while k * every <= now:
                    held, y = y, 0.5 * y + gain * np.sin(2 * np.pi * k * every * T)
                    k += 1
                wanted.append(held)
            np.testing.assert_allclose(values, wanted, rtol=0, atol=1e-13)
    assert found.outcomes[0].t[-1] == 0.25


def test_noise_has_the_seed_of_each_sample_in_its_lane():
    diagram = noisy()
    options = {"signals": ["x", "u", "k"], "seeds": "noise.seed", "seed": 3, **QUIET}
    found = diagram.sweep({"kp.gain": [1.5] * 6 + [2.0]}, 0.3, lanes=LANES, workers=1, **options)
    assert ran_in_lanes(found)
    assert len({*found["x"][:, -1].tolist()}) == 7
    alone = diagram.sweep({"kp.gain": [1.5] * 6 + [2.0]}, 0.3, compile=False, workers=1, **options)
    for name in options["signals"]:
        largest = np.abs(alone[name]).max()
        assert np.abs(found[name] - alone[name]).max() <= NEAR * largest, name
    threads = diagram.sweep({"kp.gain": [1.5] * 6 + [2.0]}, 0.3, lanes=LANES, workers=2, **options)
    assert threads["x"].tobytes() == found["x"].tobytes()


def test_a_sweep_in_lanes_that_was_interrupted_goes_on_with_what_is_missing(tmp_path, monkeypatch):
    table = [{"kp.gain": g, "plant.gain": 1.0 + g} for g in np.linspace(0.5, 1.5, 11)]
    options = {"signals": "x", "lanes": LANES, "workers": 1, **QUIET}
    whole = loop().sweep(None, 0.2, samples=table, **options)
    judge, judged = lane_worker.LaneWorker._judge, []

    def interrupt(worker, sample, make):
        judged.append(sample.index)
        if len(judged) == 6:
            raise KeyboardInterrupt
        return judge(worker, sample, make)

    monkeypatch.setattr(lane_worker.LaneWorker, "_judge", interrupt)
    with pytest.raises(KeyboardInterrupt):
        loop().sweep(None, 0.2, samples=table, to=tmp_path / "kept", **options)
    again = loop().sweep(None, 0.2, samples=table, to=tmp_path / "kept", **options)
    assert again.reused == 5
    assert judged[6:] == [*range(5, 11)]  # no run that was kept is made again
    assert again["x"].tobytes() == whole["x"].tobytes()  # other neighbours in their lanes change no bit
    assert ran_in_lanes(again)


def test_a_first_sample_that_is_refused_leaves_the_others_side_by_side_in_threads():
    table = [{"kp.gain": g} for g in ("much", 1.0, 1.5, 2.0)]
    found = loop().sweep(None, 0.1, samples=table, signals="x", lanes=LANES, workers=2, **QUIET)
    assert found.failed.tolist() == [True, False, False, False]
    assert ran_in_lanes(found)
    alone = loop().sweep(None, 0.1, samples=table, signals="x", lanes=LANES, workers=1, **QUIET)
    assert found["x"][1:].tobytes() == alone["x"][1:].tobytes()


class EndedError(Exception):
    """Raised to end a sweep."""


def test_a_sweep_that_is_ended_ends_within_a_chunk_of_ticks():
    plan = make_plan(loop().wired, 1000.0, ["x"], None, (), {}, lanes=LANES)
    told = []

    def tell(t):
        told.append(t)
        raise EndedError

    with make_worker(plan) as worker, pytest.raises(EndedError):
        list(worker.run_all([Sample(i, {"box.kp.gain": 1.0 + i}, 0) for i in range(4)], tell))
    assert len(told) == 1
    assert told[0] < 200.0
