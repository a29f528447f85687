"""Sweeps: each run is that of a single run, whoever makes it; failures are data; results have names."""

import math
from dataclasses import replace

import numpy as np
import pytest

from loopwright.blocks import (
    BandLimitedNoise,
    Block,
    Compare,
    Constant,
    Gain,
    Input,
    OptionError,
    Output,
    Ramp,
    State,
    Step,
    TransferFunction,
    UnitDelay,
    UnknownNameError,
    parameter,
)
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.sweeps import final, maximum, mean, minimum, settling_time
from loopwright.diagrams.sweeps.plan import make_plan
from loopwright.diagrams.sweeps.samples import Samples, grid
from loopwright.diagrams.sweeps.worker import Worker
from loopwright.diagrams.sweeps.workers import make_worker
from support.waiting import FAR

QUIET = {"progress": False}
INTERPRETED = {"progress": False, "compile": False, "workers": 1}
T = 0.01


def sampled_lag():
    """A lag with gain K, exactly sampled, behind a step at t = 0: y = K (1 − exp(−t/T₁))."""

    @subsystem(sample_time=T, name="box")
    def box(u):
        return TransferFunction(numerator=(2.0,), denominator=(0.5, 1.0), name="lag")(u)

    return Diagram("lag", box(Step(times=0.0, values=1.0, name="step")).named("y"))


class Start(Block):
    """A state that starts from the inputs: three times its second input."""

    factor: float = parameter(default=3.0)
    now = Input()
    first = Input()
    y = State(output=True)

    def initial(self, u):
        return self.factor * u.first

    def update(self, t, x, u):
        return 0.5 * x.y + u.now


def many_rates():
    """Three rates, gates, edges at t = 0, a derivative, and states that start from inputs."""

    @subsystem(sample_time=T, name="fast")
    def fast(u):
        start = Start(name="start")
        slope = TransferFunction(numerator=(1.0, 0.0), denominator=(0.03, 1.0), name="slope")(u)
        return start(now=slope, first=u + 0.25)

    @subsystem(sample_time=3 * T, offset=T, name="slow")
    def slow(u):
        held = UnitDelay(initial_value=0.7, name="held")
        held(0.3 * u + 0.5 * held.y)
        return held.y

    @subsystem(sample_time=2 * T, enabled="reset", name="gated")
    def gated(u):
        return Start(name="inner", factor=1.5)(now=u, first=u)

    source = Step(times=(0.0, 0.2), values=(1.0, -0.5), name="source")
    y = fast(source)
    gate = Step(times=0.1, values=1.0, name="gate")
    return Diagram("rates", gated(y, enable=gate).named("g"), slow(y).named("h"))


def assert_equals_single_runs(diagram, sweep, duration, names, **options):
    for sample, outcome in zip(sweep.samples, sweep.outcomes, strict=True):
        single = diagram.replace(sample.parameters).simulate(duration, **QUIET, **options)
        for name in names:
            assert outcome.signals[name].tobytes() == single[name].tobytes(), (sample, name)


def test_results_are_those_of_the_closed_form_for_every_gain_and_time_constant():
    gains, lags = (1.0, 2.0, -3.0), (0.2, 0.5)
    table = [{"lag.numerator": (gain,), "lag.denominator": (lag, 1.0)} for gain in gains for lag in lags]
    duration = 4.0
    found = sampled_lag().sweep(
        None,
        duration,
        samples=table,
        signals="y",
        reduce={
            "end": final("y"),
            "top": maximum("y"),
            "bottom": minimum("y"),
            "mean": mean("y"),
            "settled": settling_time("y", band=0.02),
            "late": settling_time("y", band=0.02, since=0.1),
            "mine": lambda run: [run["y"][10], run.t[10]],
        },
        **INTERPRETED,
    )
    for i, sample in enumerate(found.samples):
        (gain,), (lag, _) = sample.parameters["box.lag.numerator"], sample.parameters["box.lag.denominator"]
        exact = gain * (1.0 - np.exp(-found.t / lag))
        np.testing.assert_allclose(found["y"][i], exact, rtol=0, atol=1e-13 * abs(gain))
        end = exact[-1]
        assert found["end"][i] == pytest.approx(end, abs=1e-13 * abs(gain))
        assert (found["top"][i], found["bottom"][i]) == (max(found["y"][i]), min(found["y"][i]))
        # |K| exp(−t/T₁) − |K| exp(−tₑ/T₁) = band; a chord between samples lies within T²/8 |y''|/|y'| of the curve
        settled = -lag * math.log(0.02 / abs(gain) + math.exp(-duration / lag))
        assert found["settled"][i] == pytest.approx(settled, abs=T**2 / (8.0 * lag) * 1.05)
        assert found["late"][i] == pytest.approx(settled - 0.1, abs=T**2 / (8.0 * lag) * 1.05)
        average = gain * (1.0 - lag / duration * (1.0 - math.exp(-duration / lag)))
        assert found["mean"][i] == pytest.approx(average, abs=abs(gain) * T**2 / (12.0 * lag * duration) * 1.05)
        np.testing.assert_allclose(found["mine"][i], [gain * (1.0 - math.exp(-0.1 / lag)), 0.1], atol=1e-13 * abs(gain))
    assert not found.failures
    assert found.names == ["end", "top", "bottom", "mean", "settled", "late", "mine", "y"]


def test_settling_is_zero_within_the_band_nan_outside_at_the_end_and_reckoned_to_a_target():
    @subsystem(sample_time=0.5, name="box")
    def box(u):
        return Gain(gain=1.0, name="gain")(u)

    diagram = Diagram("ramp", box(Ramp(slope=1.0, name="ramp")).named("y"))
    found = diagram.sweep(
        {"gain.gain": (1.0, 0.1)},
        4.0,
        reduce={
            "to_three": settling_time("y", band=0.6, target=3.6),
            "never": settling_time("y", band=0.1, target=9.0),
        },
        **INTERPRETED,
    )
    np.testing.assert_allclose(found["to_three"], [3.0, np.nan])  # y = t enters 3.6 ± 0.6 at 3 s; 0.1 t never does
    assert np.isnan(found["never"]).all()
    wide = diagram.sweep({"gain.gain": (1.0,)}, 4.0, reduce={"s": settling_time("y", band=9.0)}, **INTERPRETED)
    assert wide["s"] == [0.0]
    with pytest.raises(OptionError, match=r"settling_time.band: found band=0.0; expected a distance"):
        settling_time("y", band=0.0)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.drawn(1)
def test_runs_with_several_rates_gates_and_computed_starts_are_single_runs_to_the_last_bit(compiled):
    diagram = many_rates()
    table = [
        {"start.factor": a, "source.values": b, "held.initial_value": c, "gate.times": d, "slope.denominator": e}
        for a, b, c, d, e in [
            (3.0, (1.0, -0.5), 0.7, 0.1, (0.03, 1.0)),
            (2.0, (0.3, 0.1), 0.1, 0.0, (0.05, 1.0)),
            (-1.0, (0.0, 1.0), 0.0, 0.05, (0.02, 2.0)),
            (3.0, (1.0, -0.5), 0.7, 0.1, (0.03, 1.0)),
        ]
    ]
    names = ["g", "h", "start.y", "slope.y", "held.y"]
    for workers in (1, 2):
        found = diagram.sweep(
            None, 0.5, samples=table, signals=names, workers=workers if compiled else 1, compile=compiled, **QUIET
        )
        assert not found.failures
        assert_equals_single_runs(diagram, found, 0.5, names)
        assert found["g"][0].tobytes() == found["g"][3].tobytes() != found["g"][1].tobytes()


def test_a_worker_binds_a_diagram_once_for_parameters_that_are_numbers(monkeypatch):
    from loopwright.diagrams.sweeps import worker as _worker

    made = []

    class Counted(_worker.BoundRun):
        def __init__(self, *arguments):
            made.append(self)
            super().__init__(*arguments)

    monkeypatch.setattr(_worker, "BoundRun", Counted)
    monkeypatch.setattr(_worker, "simulate", lambda *_, **__: pytest.fail("a run of its own"))
    found = many_rates().sweep({"start.factor": np.linspace(1.0, 2.0, 9)}, 0.1, signals="start.y", workers=1, **QUIET)
    assert len(made) == 1
    np.testing.assert_array_equal(found["start.y"][:, 0], 0.25 * np.linspace(1.0, 2.0, 9))  # each has its own start
    zero = many_rates().sweep({"start.factor": (0.0, 1.0, 0.0)}, 0.1, signals="g", workers=1, **QUIET)  # 0 is structure
    assert len(made) == 3
    assert not zero.failures


def test_zeros_blocks_sample_times_and_fixed_values_may_be_swept_too():
    diagram = many_rates()
    parameters = {
        "slow.sample_time": (2 * T, 3 * T),
        "slow.offset": (0.0,),
        "start.factor": (0.0, 2.0),
        "source": (Step(times=0.0, values=2.0), Constant(value=-1.0)),
    }
    found = diagram.sweep(parameters, 0.3, signals=["h", "g"], **INTERPRETED)
    assert not found.failures
    assert_equals_single_runs(diagram, found, 0.3, ["h", "g"])
    assert len({found["h"][i].tobytes() for i in range(8)}) == 8


def test_parameters_are_read_as_results_are_one_row_for_each_sample():
    diagram = many_rates()
    first, second = Step(times=0.0, values=2.0), Constant(value=-1.0)
    parameters = {"start.factor": (0.0, 2.0), "source": (first, second)}
    found = diagram.sweep(parameters, 0.01, reduce={"end": final("h")}, **INTERPRETED)
    np.testing.assert_array_equal(found["fast.start.factor"], [0.0, 0.0, 2.0, 2.0])
    assert [*found["source"]] == [first, second, first, second]
    with pytest.raises(UnknownNameError, match=r"holds no 'start\.factor'\. .*'fast\.start\.factor'"):
        found["start.factor"]
    table = [{"source.values": (1.0, -0.5)}, {"source.values": (2.0, 0.5)}]
    found = diagram.sweep(None, 0.01, samples=table, reduce={"end": final("h")}, **INTERPRETED)
    np.testing.assert_array_equal(found["source.values"], [[1.0, -0.5], [2.0, 0.5]])


def test_a_number_among_texts_stays_a_number():
    assert grid({"limit": ("none", 1.5)}).column("limit").tolist() == ["none", 1.5]


def test_a_block_that_is_replaced_and_its_parameters_go_together():
    diagram = many_rates()
    table = [
        {"start": Start(factor=5.0), "start.factor": 2.0, "inner.factor": 1.0},
        {"start": Start(factor=5.0), "start.factor": 0.0, "inner.factor": 2.0},
    ]
    found = diagram.sweep(None, 0.3, samples=table, signals=["g", "start.y"], **INTERPRETED)
    assert not found.failures
    assert_equals_single_runs(diagram, found, 0.3, ["g", "start.y"])
    assert found["start.y"][0, 0] == 2.0 * 0.25  # the step has its value from the left at the start


class Guarded(Block):
    """Refuses inputs from a limit on."""

    limit: float = parameter(default=0.5)
    u = Input()
    y = Output()

    def output(self, t, x, u):
        return 2.0 * u.u

    def guards(self, t, x, u):
        return {"below the limit": self.limit - u.u}


def guarded():
    @subsystem(sample_time=T, name="box")
    def box(u):
        return Guarded(name="guard")(u)

    return Diagram("guarded", box(Ramp(slope=1.0, name="ramp")).named("y"))


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.drawn(1)
def test_a_run_that_fails_is_data_with_its_samples_and_harms_no_other(workers):
    diagram = guarded()
    limits = (2.0, 0.1, 3.0, 0.5, 4.0)
    found = diagram.sweep(
        {"guard.limit": limits}, 1.0, signals="y", reduce={"end": final("y")}, workers=workers, **QUIET
    )
    assert [f.index for f in found.failures] == [1, 3]
    for failure, limit in zip(found.failures, (0.1, 0.5), strict=True):
        with pytest.raises(Exception) as error:  # noqa: PT011 (its kind is compared below)
            diagram.replace({"guard.limit": limit}).simulate(1.0, **QUIET)
        assert (failure.message, failure.kind) == (str(error.value), type(error.value).__name__)
        assert failure.block == error.value.block == "box.guard"
        assert failure.t == pytest.approx(limit - T, abs=1e-9)  # the last sample below the limit
        n = len(error.value.run.t)
        assert found["y"][failure.index, :n].tobytes() == error.value.run["y"].tobytes()
        assert np.isnan(found["y"][failure.index, n:]).all()
    np.testing.assert_array_equal(found["end"], [2.0, np.nan, 2.0, np.nan, 2.0])
    np.testing.assert_array_equal(found.failed, [False, True, False, True, False])
    assert repr(found) == "<sweep of guarded: 5 samples of box.guard.limit, 2 failed>"
    data = found.dataset
    assert data["failure"].sel({"box.guard.limit": 0.1}).item() == found.failures[0].message
    assert data["failed"].values.tolist() == [False, True, False, True, False]


def test_a_value_that_a_parameter_refuses_and_a_reduction_that_fails_are_data_too():
    found = sampled_lag().sweep(
        {"step.values": (1.0, 2.0)},
        0.1,
        reduce={"odd": lambda run: 1 / 0 if run["y"][-1] > 0.6 else 1.0},
        **INTERPRETED,
    )
    np.testing.assert_array_equal(found["odd"], [1.0, np.nan])
    (failure,) = found.failures
    assert failure.message.startswith("lag.odd, t = 0.1 s: the reduction 'odd' failed: ZeroDivisionError")
    noise = Diagram("noise", BandLimitedNoise(sample_time=T, name="noise").y.named("y"))
    found = noise.sweep({"noise.variance": (1.0, -1.0)}, 0.1, step=T, reduce={"end": final("y")}, **INTERPRETED)
    assert [f.kind for f in found.failures] == ["ParameterError"]
    assert "noise.variance: found -1" in found.failures[0].message
    assert math.isnan(found.end[1])


def test_an_fmu_is_reset_and_every_run_is_a_single_run(monkeypatch):
    diagram = experiments.hand_guiding().diagram
    parameters = {
        "plant.coulomb_scale": (0.5, 1.5),
        "controller.admittance_perp.stiffness": (150.0, 250.0),
        "plant.start.position": (diagram["plant"].start["position"], (0.8, 0.51)),
    }
    names = ["xi", "motor_force", "plant.position"]
    loaded = []
    monkeypatch.setattr("loopwright.fmus.calls.fmi3.Fmi3Calls.instantiate", _counted("instantiate", loaded))
    found = diagram.sweep(parameters, 0.3, signals=names, workers=1, **QUIET)
    assert len(loaded) == 1
    assert not found.failures
    for i in (0, 3, 5, 6):
        single = diagram.replace(found.samples[i].parameters).simulate(0.3, **QUIET)
        for name in names:
            assert found.outcomes[i].signals[name].tobytes() == single[name].tobytes()
    two = diagram.sweep(parameters, 0.3, signals=names, workers=2, **QUIET)
    assert all(two[name].tobytes() == found[name].tobytes() for name in names)


def _counted(name, calls):
    from loopwright.fmus.calls.fmi3 import Fmi3Calls

    original = getattr(Fmi3Calls, name)

    def counted(self, *arguments):
        calls.append(name)
        return original(self, *arguments)

    return counted


def test_the_data_set_of_a_grid_has_the_parameters_as_dimensions():
    diagram = sampled_lag()
    found = diagram.sweep(
        {"step.times": (0.0, 0.02), "step.values": (1.0, 2.0, 3.0)},
        0.05,
        signals="y",
        reduce={"end": final("y"), "two": lambda run: run["y"][:2]},
        **INTERPRETED,
    )
    data = found.dataset
    first, second = found.samples.names
    assert data["y"].dims == (first, second, "t")
    assert data["y"].shape == (2, 3, 6)
    assert data["two"].dims == (first, second, "two_dim")
    assert data["t"].attrs["units"] == "s"
    for i, sample in enumerate(found.samples):
        here = data.sel(dict(sample.parameters.items()))
        np.testing.assert_array_equal(here["y"], found["y"][i])
        assert here["end"].item() == found["end"][i]
    spread = diagram.sweep({"step.values": (1.0, 2.0)}, 0.05, samples="latin", count=4, signals="y", **INTERPRETED)
    assert spread.dataset["y"].dims == ("sample", "t")
    np.testing.assert_array_equal(spread.dataset["step.values"], [s.parameters["step.values"] for s in spread.samples])


def test_samples_of_runs_that_end_apart_or_step_apart_are_filled_up_with_nan():
    @subsystem(sample_time=T, name="box")
    def box(u):
        return Gain(gain=1.0, name="gain")(u)

    diagram = Diagram("rates", box(Ramp(slope=1.0, name="ramp")).named("y"))
    found = diagram.sweep({"box.sample_time": (0.01, 0.02)}, 0.1, signals="y", **INTERPRETED)
    assert found.t.shape == (2, 11)
    np.testing.assert_allclose(found.t[1, :6], np.arange(6) * 0.02)
    assert np.isnan(found["y"][1, 6:]).all()
    assert found.dataset["t"].dims == ("box.sample_time", "step")
    np.testing.assert_allclose(found.end, [0.1, 0.1])


def test_seeds_belong_to_samples_and_not_to_workers():
    @subsystem(sample_time=T, name="box")
    def box(u):
        return Gain(gain=1.0, name="gain")(u)

    noise = BandLimitedNoise(sample_time=T, name="noise")
    diagram = Diagram("noisy", box(noise.y).named("y"))
    sweep = {
        "parameters": {"gain.gain": (1.0, 1.0, 2.0)},
        "duration": 0.2,
        "signals": "y",
        "seeds": "noise.seed",
        "compile": True,
    }
    one = diagram.sweep(**sweep, workers=1, **QUIET)
    two = diagram.sweep(**sweep, workers=2, **QUIET)
    other = diagram.sweep(**sweep, workers=1, seed=1, **QUIET)
    assert not one.failures
    assert one["y"].tobytes() == two["y"].tobytes() != other["y"].tobytes()
    assert not np.array_equal(one["y"][0], one["y"][1])  # the parameters are equal, the seeds are not
    longer = diagram.sweep(**{**sweep, "parameters": {"gain.gain": (1.0, 1.0, 2.0, 3.0)}}, workers=1, **QUIET)
    assert longer["y"][:3].tobytes() == one["y"].tobytes()


class Dice(Block):
    """A number that depends on a seed, which is fixed in its equations."""

    seed: int = parameter(default=0)
    y = Output()

    def output(self, t, x, u):
        return 0.1 * (self.seed % 1009) + 0.0 * t


def gained(source):
    @subsystem(sample_time=T, name="box")
    def box(u):
        return Gain(gain=0.731, name="gain")(u)

    return Diagram("noisy", box(source).named("y"))


def test_a_seed_that_is_fixed_in_the_code_compiles_nothing_by_default(monkeypatch):
    from loopwright.diagrams.compiled import diagram_code

    monkeypatch.setattr(diagram_code, "load_compiled", lambda *_: pytest.fail("it compiles"))
    diagram = gained(Dice(name="dice").y)
    found = diagram.sweep({"gain.gain": (1.0, 1.0)}, 0.1, seeds="dice.seed", signals="y", workers=1, **QUIET)
    assert not found.failures
    assert not np.array_equal(found["y"][0], found["y"][1])


def test_a_seed_of_noise_is_a_number_of_the_run_and_one_code_serves_all():
    diagram = gained(BandLimitedNoise(sample_time=T, name="noise").y)
    plan = make_plan(diagram.wired, 0.2, ["y"], None, "noise.seed", {})
    samples = Samples(("box.gain.gain",), ((1.0,), (1.0,), (2.0,)), None, 7)
    with make_worker(plan) as worker:
        found = [worker.run(sample) for sample in samples]
        assert len(worker._bound) == 1
        assert next(iter(worker._bound.values())).is_compiled
    for sample, outcome in zip(samples, found, strict=True):
        single = diagram.replace(plan.parameters_of(sample)).simulate(0.2, compile=False, **QUIET)
        assert outcome.signals["y"].tobytes() == single["y"].tobytes()
    assert not np.array_equal(found[0].signals["y"], found[1].signals["y"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, r"lag: a sweep keeps what it is asked for, and nothing was asked for. Give signals="),
        ({"signals": "z"}, r"no signal 'z' was recorded"),
        ({"reduce": {"end": final("z")}}, r"no signal 'z' was recorded"),
        ({"reduce": {"end": "y"}}, r"lag.reduce: found 'y' for 'end'; expected final\(signal\)"),
        ({"reduce": [final("y")]}, r"lag: found reduce=.*expected reductions by name"),
        ({"reduce": {"y": final("y")}, "signals": "y"}, r"found 'y' among signals and reductions"),
        ({"reduce": {"failed": final("y")}}, r"lag.reduce: found a reduction called 'failed'"),
        ({"reduce": {"step.values": final("y")}}, r"lag.reduce: found a reduction called 'step.values'"),
        ({"signals": "y", "seeds": "step.values"}, r"lag.seeds: found 'step.values' among the parameters and in seeds"),
        ({"signals": "y", "workers": 0}, r"found workers=0; expected a positive integer"),
        ({"signals": "y", "evry": 2}, r"Diagram.sweep: it has no argument 'evry'. Did you mean 'every'"),
        ({"signals": "y", "client": "tcp://there"}, r"lag.client: found client='tcp://there'; expected a distributed"),
        ({"signals": "y", "seeds": "noise.seed"}, r"nothing is called 'noise.seed'"),
        ({"signals": "y", "record": ["step"]}, r"lag.record: found a choice without 'y', which signals= or reduce="),
        ({"signals": "y", "reduce": {"end": final("step.y")}, "record": ["y"]}, r"lag.record: .* without 'step.y'"),
        ({"signals": "y", "record": []}, r"lag.record: .* leave record= out"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_first_run(options, message, monkeypatch):
    monkeypatch.setattr(Worker, "run", lambda *_: pytest.fail("it ran"))
    with pytest.raises((OptionError, UnknownNameError), match=message):
        sampled_lag().sweep({"step.values": (1.0, 2.0)}, 0.1, **QUIET, **options)


def test_a_signal_called_as_the_times_are_is_kept_by_its_path():
    diagram = Diagram("d", Ramp(slope=1.0, name="ramp")().named("t"))
    with pytest.raises(OptionError, match=r"^d\.signals: found a signal called 't'; .* by the path of its port"):
        diagram.sweep({"ramp.slope": (1.0, 2.0)}, 0.1, signals="t", step=0.1, progress=False)
    found = diagram.sweep({"ramp.slope": (1.0, 2.0)}, 0.1, signals="ramp.y", step=0.1, **INTERPRETED)
    np.testing.assert_allclose(found.dataset["ramp.y"], [[0.0, 0.1], [0.0, 0.2]], rtol=1e-15)


def test_samples_that_fill_the_memory_are_refused():
    with pytest.raises(OptionError, match=r"lag.signals: found 1000 samples .* GiB.*reduce="):
        sampled_lag().sweep({"step.values": np.arange(1e3)}, 1e4, signals="y", **QUIET)


def test_an_error_of_a_thread_ends_the_sweep_and_all_threads(monkeypatch):
    import threading

    before = threading.active_count()
    run, calls, failing, failed = Worker.run, [], [], threading.Event()

    def fail(self, sample, tell=lambda t: None):
        calls.append(sample.index)
        if sample.index == 3:
            failing.append(threading.current_thread())
            failed.set()
            raise ZeroDivisionError("a mistake in the sweep itself")
        if sample.index > 3:  # the other thread's, which was handed out before the failure
            assert failed.wait(FAR)
            failing[0].join(FAR)
        return run(self, sample, tell)

    monkeypatch.setattr(Worker, "run", fail)
    with pytest.raises(ZeroDivisionError):
        sampled_lag().sweep({"step.values": np.arange(1.0, 200.0)}, 0.1, signals="y", workers=2, **QUIET)
    assert threading.active_count() == before
    assert sorted(calls) in ([0, 1, 2, 3], [0, 1, 2, 3, 4])


def test_an_experiment_is_swept_to_its_end():
    experiment = replace(experiments.hand_guiding(), duration=0.05)
    found = experiment.sweep({"plant.coulomb_scale": (1.0, 2.0)}, signals="xi", every=10, workers=1, **QUIET)
    np.testing.assert_allclose(found.t, [0.0, 0.01, 0.02, 0.03, 0.04, 0.05])
    with pytest.raises(OptionError, match=r"C.tool_mass: it is no option of a run. Give it to the experiment"):
        experiment.sweep({"plant.coulomb_scale": (1.0, 2.0)}, signals="xi", tool_mass=1.0)


def test_messages_of_runs_are_told_once(monkeypatch):
    from loopwright.fmus.calls.loaded_fmu import LoadedFmu

    begin = LoadedFmu.begin

    def warn(self):
        self.add_note(f"stiffness {self._starts.given['coulomb_scale']:g} is odd")
        begin(self)

    monkeypatch.setattr(LoadedFmu, "begin", warn)
    diagram = experiments.hand_guiding().diagram
    found = diagram.sweep({"plant.coulomb_scale": (2.0, 3.0, 2.0)}, 0.01, signals="xi", workers=1, **QUIET)
    told = [message for message in found.messages if message.endswith("is odd")]
    single = diagram.replace({"plant.start.coulomb_scale": 3.0}).simulate(0.01, **QUIET)
    assert found.outcomes[1].messages[-1] == single.messages[-1]
    assert [message.rpartition("stiffness ")[2] for message in told] == ["2 is odd", "3 is odd"]


def test_an_fmu_that_has_asked_for_the_end_is_asked_anew_in_the_next_run(monkeypatch):
    from loopwright.diagrams.sweeps.bound_run import BoundRun

    run, seen = BoundRun.run, []

    def spy(self, numbers, tell):
        made = run(self, numbers, tell)
        seen.append(made.t[-1])
        self.engine.plants["plant"].ends_run = True  # as its flag leaves it
        return made

    monkeypatch.setattr(BoundRun, "run", spy)
    diagram = experiments.hand_guiding().diagram
    found = diagram.sweep({"plant.coulomb_scale": (1.0, 1.5)}, 0.01, signals="xi", workers=1, **QUIET)
    assert seen == [0.01, 0.01]
    assert not found.failures
    assert found.outcomes[1].stopped == ""


def test_a_reduction_that_returns_nothing_is_a_failure():
    found = sampled_lag().sweep({"step.values": (1.0,)}, 0.1, reduce={"none": lambda run: None}, **QUIET)
    assert "it returned None" in found.failures[0].message
    assert np.array_equal(found["none"], [math.nan], equal_nan=True)  # as where another run did not fail
    assert np.isnan(found.dataset["none"]).all()


@pytest.mark.parametrize("how", [{"workers": 1}, {"workers": 2}, {"workers": 1, "compile": False}])
@pytest.mark.drawn(1)
def test_fused_runs_have_the_bits_of_fused_single_runs(how):
    experiment = experiments.hand_guiding()
    single = experiment.simulate(fuse=True, compile=how.get("compile", True), **QUIET)
    found = experiment.sweep({"plant.coulomb_scale": (1.0, 0.5)}, signals="plant.position", fuse=True, **how, **QUIET)
    if how.get("compile", True):  # the plant alone may be fused without another bit
        assert not np.array_equal(single["plant.position"], experiment.simulate(**QUIET)["plant.position"])
    assert np.array_equal(found["plant.position"][0], single["plant.position"])
    assert any("Fused: plant" in message for message in found.messages)


def test_texts_are_coordinates_as_they_are():
    compared = Diagram("c", Compare(relation=">", name="cmp")(Constant(value=1.0), Constant(value=2.0)).named("y"))
    found = compared.sweep({"cmp.relation": [">", "<"]}, 0.1, reduce={"end": final("y")}, progress=False)
    assert [float(found.dataset["end"].sel({"cmp.relation": relation})) for relation in (">", "<")] == [0.0, 1.0]


def test_numbers_of_runs_in_several_units_have_no_unit_and_are_named():
    """A sweep over plants, of which one counts in rpm: each run has the numbers of a single one."""
    slopes = [Ramp(slope=1.0, unit=unit, name="ramp") for unit in ("rad/s", "rpm")]
    diagram = Diagram("d", slopes[0].named("speed"))
    found = diagram.sweep(
        {"ramp": slopes}, 1.0, step=0.5, signals="speed", reduce={"end": final("speed")}, **INTERPRETED
    )
    np.testing.assert_array_equal(found["end"], [1.0, 1.0])
    assert found.units == {}
    assert "speed: found rad/s, rpm; its numbers are in the unit of their run" in str(found)
    assert "units" not in found.dataset["speed"].attrs
    alike = diagram.sweep({"ramp": slopes[:1]}, 1.0, step=0.5, signals="speed", **INTERPRETED)
    assert alike.units == {"speed": "rad/s"}
    assert "its numbers" not in str(alike)
