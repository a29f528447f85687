"""Test signals against closed forms: exact rational edges, mpmath's phases, SciPy's tables and statistics."""

import math
from fractions import Fraction

import mpmath
import numpy as np
import pytest
from scipy import signal, stats
from scipy.interpolate import interp1d

from loopwright.blocks import (
    BandLimitedNoise,
    Chirp,
    Clock,
    Constant,
    ParameterError,
    PiecewiseLinear,
    Pulse,
    PulseTrain,
    Ramp,
    Recorded,
    Reference,
    Sine,
    SmoothStep,
    Step,
)
from loopwright.blocks.core.instants import left_of
from loopwright.blocks.tracing.traced import trace
from loopwright.diagrams import Diagram, subsystem


def sampled(source, duration=2.0, step=0.01):
    """The output at every tick, and the ticks."""
    run = Diagram("sources", source.y.named("y")).simulate(duration, step=step, progress=False)
    return run.t, run["y"]


def at(source, times):
    """The traced output at any times."""
    found = trace(source, {}, sampled=False)
    p, function = found.pack(source, math.nan), found.function
    return np.array([np.ravel(np.array(function(t, [], p)[0])) for t in times]).squeeze(axis=-1)


def instants_of(source, start, end):
    found = []
    t = source.next_instant(start)
    while t <= end:
        found.append(t)
        assert source.next_instant(t) > t
        t = source.next_instant(t)
    return found


# --- clock, ramp, chirp -----------------------------------------------------------------------------------------------


def test_a_clock_tells_the_ticks_exactly():
    # 8000 ticks of 1 ms are 8 s and not 8.000000000001 s
    t, y = sampled(Clock(), 8.0, 1e-3)
    assert y.tolist() == [k / 1000 for k in range(8001)] == t.tolist()
    assert Clock().outputs["y"].unit == "s"


def test_a_ramp_rises_from_its_start_on():
    _, y = sampled(Ramp(slope=-3.0, start_time=0.5, initial_value=2.0), 1.0, 0.25)
    assert y.tolist() == [2.0, 2.0, 2.0, 1.25, 0.5]
    assert sampled(Ramp(slope=2.0), 0.5, 0.25)[1].tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize("sweep", ["linear", "logarithmic"])
def test_the_phase_of_a_chirp_is_the_integral_of_its_frequency(sweep):
    f0, f1, D, start = 0.5, 8.0, 4.0, 0.5
    source = Chirp(
        amplitude=2.0,
        start_frequency=f0,
        end_frequency=f1,
        duration=D,
        sweep=sweep,
        start_time=start,
        phase=0.3,
        bias=-1.0,
    )

    def frequency(tau):
        inside = min(max(tau, 0), D)
        return f0 + (f1 - f0) * inside / D if sweep == "linear" else f0 * mpmath.mpf(f1 / f0) ** (inside / D)

    times = np.linspace(0.0, 6.1, 28)
    turns = [mpmath.quad(frequency, [0, min(t - start, D), t - start]) if t > start else 0 for t in map(float, times)]
    want = [float(2 * mpmath.sin(2 * mpmath.pi * n + 0.3) - 1) for n in turns]
    np.testing.assert_allclose(at(source, times), want, rtol=0, atol=1e-12)


def test_chirps_are_those_of_scipy_within_their_duration():
    times = np.linspace(0.0, 3.0, 301)
    for sweep in ("linear", "logarithmic"):
        source = Chirp(start_frequency=0.2, end_frequency=5.0, duration=3.0, sweep=sweep, phase=math.pi / 2)
        want = signal.chirp(times, 0.2, 3.0, 5.0, method=sweep)
        np.testing.assert_allclose(at(source, times), want, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sweep": "quadratic"}, "found 'quadratic'; expected 'linear' or 'logarithmic'"),
        (
            {"sweep": "logarithmic", "start_frequency": 0.0},
            "found 0 and 2 Hz; expected two different frequencies above",
        ),
        (
            {"sweep": "logarithmic", "start_frequency": 2.0},
            "found 2 and 2 Hz; expected two different frequencies above",
        ),
    ],
)
def test_a_sweep_that_is_not_defined_is_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        Chirp(**{"start_frequency": 1.0, "end_frequency": 2.0, "duration": 1.0, **arguments})


# --- pulse trains -----------------------------------------------------------------------------------------------------


def test_every_edge_of_a_pulse_train_belongs_to_its_tick():
    # 0.3 < 3 * 0.1 in floating point: the tick at 0.3 is the fourth edge all the same
    t, y = sampled(PulseTrain(period=0.1, duty=0.5, amplitude=3.0, base=-1.0), 100.0, 0.01)
    want = [2.0 if k % 10 < 5 else -1.0 for k in range(len(t))]
    assert y.tolist() == want


@pytest.mark.parametrize("period", ["0.1", "0.0007", "0.3", "7", "0.123456789"])
@pytest.mark.parametrize("number", [0, 3, 10**4, 10**9, 10**12 + 7])
def test_edges_do_not_drift(period, number):
    exact, delay, duty = Fraction(period), Fraction("0.05"), Fraction("0.25")
    source = PulseTrain(period=float(period), delay=0.05, duty=0.25)
    up, down = (float(delay + (number + part) * exact) for part in (0, duty))
    slack = 4e-15 * down
    if slack > 0.01 * float(exact):
        pytest.skip("the period is not told apart from rounding at this time")
    assert at(source, [up, up + slack, down - slack, down, down + slack]).tolist() == [1, 1, 1, 0, 0]
    assert number == 0 or at(source, [up - slack]).tolist() == [0]
    assert source.next_instant(up - slack) == up
    assert source.next_instant(up) == down  # what comes next, to the last bit of its decimals


def test_a_pulse_train_starts_after_its_delay():
    _, y = sampled(PulseTrain(period=0.2, duty=0.5, delay=0.3), 0.8, 0.05)
    assert y.tolist() == [0] * 6 + [1, 1, 0, 0, 1, 1, 0, 0, 1, 1, 0]
    assert instants_of(PulseTrain(period=0.2, delay=0.3), -1.0, 0.75) == [0.3, 0.4, 0.5, 0.6, 0.7]


def test_a_pulse_without_an_end_is_refused():
    with pytest.raises(ParameterError, match=r"duty: found 1; expected a part of the period below 1"):
        PulseTrain(period=1.0, duty=1.0)


# --- tables -----------------------------------------------------------------------------------------------------------


TIMES = np.array([-0.5, 0.2, 0.3, 0.85, 1.0, 1.6])
VALUES = np.random.default_rng(5).standard_normal((6, 3))


def test_lines_go_through_the_points_and_rest_beyond_them():
    source = PiecewiseLinear(times=TIMES, values=VALUES[:, 0])
    times = [*TIMES, *np.linspace(-2.0, 3.0, 101)]
    np.testing.assert_allclose(at(source, times), np.interp(times, TIMES, VALUES[:, 0]), rtol=0, atol=1e-15)
    assert at(source, TIMES).tolist() == VALUES[:, 0].tolist()  # the points themselves, to the last bit


def test_values_may_be_vectors():
    run = Diagram("table", PiecewiseLinear(times=TIMES, values=VALUES, name="s")).simulate(
        2.0, step=0.05, progress=False
    )
    want = np.stack([np.interp(run.t, TIMES, column) for column in VALUES.T], axis=1)
    np.testing.assert_allclose(run["s.y"], want, rtol=0, atol=1e-14)


def test_recorded_data_are_interpolated_or_held():
    times = np.concatenate([TIMES, np.linspace(-0.5, 1.6, 200), TIMES[1:] * (1.0 - 1e-14)])
    for kind in ("linear", "previous"):
        want = interp1d(TIMES, VALUES[:, 1], kind=kind)(times)
        found = at(Recorded(times=TIMES, values=VALUES[:, 1], interpolation=kind), times)
        np.testing.assert_allclose(found, want, rtol=0, atol=1e-14)
        beyond = at(Recorded(times=TIMES, values=VALUES[:, 1], interpolation=kind), [-9.0, 1e4])
        assert beyond.tolist() == [VALUES[0, 1], VALUES[-1, 1]]


def test_one_sample_is_a_constant():
    assert at(Recorded(times=[3.0], values=[7.0]), [0.0, 3.0, 9.0]).tolist() == [7.0] * 3


def test_a_table_of_many_samples_stays_fast():
    times = np.arange(20000) / 1000.0
    _, y = sampled(Recorded(times=times, values=np.sin(times)), 5.0, 1e-3)
    assert y.tolist() == np.sin(times)[:5001].tolist()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"times": (0.0, 1.0, 1.0), "values": (1.0, 2.0, 3.0)}, r"times: found times .*; expected a list of rising"),
        ({"times": 0.0, "values": 1.0}, "expected a list of rising times"),
        (
            {"times": (0.0, 1.0), "values": (1.0, 2.0, 3.0)},
            r"values of shape \(3,\) for 2 times; expected shape \(2,\)",
        ),
        ({"times": (0.0, 1.0), "values": np.zeros((2, 2, 2))}, r"values of shape \(2, 2, 2\) for 2 times"),
        ({"times": (0.0, 1.0), "values": (1.0, 2.0), "interpolation": "cubic"}, "found 'cubic'; expected 'linear' or"),
    ],
)
def test_wrong_tables_are_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        Recorded(**arguments)


# --- noise ------------------------------------------------------------------------------------------------------------


N = 200_000
NOISE = BandLimitedNoise(sample_time=0.01)


def values_of(source, first=0, n=N):
    """The values themselves, by NumPy; the trace is compared with them below."""
    return source.output((first + np.arange(n) + 0.5) * source.sample_time, None, None)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("seed", [0, 1, 2014])
@pytest.mark.parametrize("first", [0, 10**9])
def test_noise_is_normal_and_white(seed, first):
    y = values_of(NOISE.replace(seed=seed), first)
    assert stats.kstest(y, "norm").pvalue > 1e-3
    assert abs(stats.kurtosis(y)) < 4.0 * math.sqrt(24 / N)
    for lag in (1, 2, 3, 10, 100, 4096):
        assert abs(np.mean(y[:-lag] * y[lag:])) < 4.0 / math.sqrt(N)
        assert abs(np.corrcoef(y[:-lag] ** 2, y[lag:] ** 2)[0, 1]) < 4.0 / math.sqrt(N)
    power = np.abs(np.fft.rfft(y)[1:-1]) ** 2 / N  # of white noise: independent, exponential, mean 1
    assert stats.kstest(power, "expon").pvalue > 1e-3


def test_seeds_give_independent_noise():
    y = [values_of(NOISE.replace(seed=seed)) for seed in range(3)]
    assert np.abs(np.corrcoef(y) - np.eye(3)).max() < 4.0 / math.sqrt(N)


@pytest.mark.slow
def test_noise_has_its_variance_mean_and_density():
    source = BandLimitedNoise.from_density(density=0.04, sample_time=0.005, mean=3.0, seed=4)
    y = values_of(source)
    assert y.mean() == pytest.approx(3.0, abs=4.0 * math.sqrt(8.0 / N))
    assert y.var() == pytest.approx(8.0, rel=4.0 * math.sqrt(2.0 / N))
    fine = np.repeat(y, 10) - 3.0  # what is held, sampled ten times as fast
    f, density = signal.welch(fine, 10 / 0.005, nperseg=20000, return_onesided=False)
    for low, high in ((0.5, 10.0), (30.0, 50.0), (90.0, 110.0)):
        band = (f > low) & (f < high)
        want = np.mean(0.04 * np.sinc(f[band] * 0.005) ** 2)
        assert np.mean(density[band]) == pytest.approx(want, rel=0.1)


def test_noise_is_a_function_of_time_alone():
    t, y = sampled(NOISE, 3.0, 0.01)
    assert np.array_equal(y, at(NOISE, t))
    assert y == pytest.approx(values_of(NOISE, n=301), abs=1e-15)  # every tick has its own value: none is missed

    @subsystem(sample_time=0.03)
    def box(u):
        return (1.0 * u).named("sampled")

    run = Diagram("rates", box(NOISE.y)).simulate(3.0, step=0.01, progress=False)
    assert np.array_equal(run["sampled"][::3], y[::3])


# --- instants ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("source", "want"),
    [
        (Constant(value=1.0), []),
        (Reference(1.0), []),
        (Sine(frequency=1.0), []),
        (Clock(), []),
        (Ramp(slope=1.0, start_time=0.4), [0.4]),
        (Step(times=(0.1, 0.35), values=(1.0, 2.0)), [0.1, 0.35]),
        (Step(times=0.2, values=1.0), [0.2]),
        (SmoothStep(levels=(0, 1, 2), start_times=(0.1, 1.0), durations=(0.5, 0.25)), [0.1, 0.6, 1.0, 1.25]),
        (Pulse(start_time=0.25, end_time=1.5, amplitude=1.0, rise_time=0.5), [0.25, 0.75, 1.0, 1.5]),
        (Chirp(start_frequency=1.0, end_frequency=2.0, duration=1.0, start_time=0.5), [0.5, 1.5]),
        (PiecewiseLinear(times=(0.1, 0.2, 0.3, 0.5, 0.7), values=(0, 1, 2, 4, 4)), [0.1, 0.5]),
        (Recorded(times=(0.1, 0.2, 0.3), values=(0, 1, 2), interpolation="previous"), [0.1, 0.2, 0.3]),
        (BandLimitedNoise(sample_time=0.3), [0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 1.8]),
        (PulseTrain(period=0.7, duty=0.4), [0.0, 0.28, 0.7, 0.98, 1.4, 1.68]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_sources_say_where_they_are_not_smooth(source, want):
    found = instants_of(source, -1.0, 2.0)
    assert found == [pytest.approx(t, abs=1e-15) for t in want]
    assert isinstance(source.next_instant(5.0), float)


@pytest.mark.parametrize("period", [0.1, 0.0007, 0.3])
def test_instants_of_what_repeats_are_the_ticks_themselves(period):
    exact = Fraction(repr(period))
    found = instants_of(BandLimitedNoise(sample_time=period), 1e4, 1e4 + 100 * period)
    first = math.floor(Fraction(10**4) / exact) + 1
    assert found[:99] == [float((first + k) * exact) for k in range(99)]


def test_the_output_at_an_instant_is_already_the_new_one_and_left_of_it_the_old_one():
    source = BandLimitedNoise(sample_time=0.0007)
    assert 0.0 < 5.0 - left_of(5.0) < 2e-14
    for t in instants_of(source, 5.0, 5.05):
        before, here, after = at(source, [left_of(t), t, t + 1e-6])
        assert here == after != before
    train = PulseTrain(period=0.1, duty=0.3, delay=0.05)
    for k in (1, 3, 7, 10**4, 10**9 + 1):
        t = train.next_instant(0.05 + k * 0.1 - 0.01)
        assert at(train, [left_of(t), t]).tolist() == [0.0, 1.0]
        t = train.next_instant(t)
        assert at(train, [left_of(t), t]).tolist() == [1.0, 0.0]


@pytest.mark.parametrize("frame", [True, False], ids=["sampled", "continuous"])
def test_every_source_stands_in_both_kinds_of_frames(frame):
    for source in (
        Clock(),
        Ramp(slope=1.0),
        Chirp(start_frequency=1.0, end_frequency=2.0, duration=1.0),
        PulseTrain(period=1.0),
        PiecewiseLinear(times=TIMES, values=VALUES),
        Recorded(times=TIMES, values=VALUES),
        NOISE,
    ):
        assert trace(source, {}, sampled=frame).advance == "none"
        assert source.replace(name="other") == source
