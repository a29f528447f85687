"""How long a measurement runs: as short as it settles, and no longer than its noise allows."""

import numpy as np
import pytest

from loopwright.blocks import BandLimitedNoise, Constant, DiscreteIntegrator, Gain, Integrator, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.measure.injection import SAMPLES, plan_signal
from loopwright.diagrams.measure.measurement import Measurement, measure_part
from loopwright.diagrams.report import Case
from loopwright.diagrams.report.case import SAMPLES as LONGEST
from loopwright.diagrams.report.case import SOLVED, InjectionPlan


class Windows:
    """A run whose response is 1, and an error that is different in each window."""

    def __init__(self, part, errors, size=1.0):
        self.part, self.errors, self.size, self.played = part, iter(errors), size, 0
        self.held = True
        self.flat = type("Flat", (), {"base": 0.01})()

    def play(self, *arguments, **options):
        """Play nothing."""

    def go(self, count, every):
        """Go on."""

    def record(self, n, every):
        self.played += 1
        d = np.sin(self.part.omega[0] * 0.01 * np.arange(n + 1))[:, None]
        v = d * (1.0 + next(self.errors))
        return v, v + d, np.zeros((n + 1, 0))


def measured(errors, windows=40):
    (part,) = plan_signal("sine", np.array([2.0]), 0.01, 1.0)
    run, found = Windows(part, errors), Measurement(1, 1, 0)
    measure_part(run, part, 0, 0, 1, windows, 1e-6, found, 0)
    return run.played, found


def test_a_window_has_one_period_where_that_is_enough_samples():
    slow, fast = plan_signal("sine", np.array([0.3, 20.0]), 0.01, 1.0)
    assert slow.samples == pytest.approx(2 * np.pi / 0.3 / 0.01, abs=1)
    assert fast.samples >= SAMPLES
    assert fast.samples * 0.01 * fast.omega[0] / (2 * np.pi) == pytest.approx(round(fast.samples * 0.2 / (2 * np.pi)))


def test_it_ends_where_two_windows_agree():
    played, found = measured([0.1 * 0.01**k for k in range(40)])
    assert played == 5
    assert found.settled[0]


def test_a_slow_decay_is_waited_for():
    played, found = measured([0.1 * 0.7**k for k in range(60)])
    assert 25 < played < 40
    assert found.settled[0]


def test_noise_is_not_waited_for_and_is_in_the_uncertainty():
    noise = 1e-4 * np.random.default_rng(3).standard_normal(40)
    played, found = measured(noise)
    assert played < 12
    assert found.settled[0]
    assert np.std(noise) / 3 < found.uncertainty[0] < 10 * np.std(noise)


def test_noise_that_swamps_a_line_is_not_settled():
    _, found = measured(np.random.default_rng(3).standard_normal(40))
    assert not found.settled[0]


class NoisyWindows(Windows):
    """A run with v = d and white noise of a standard deviation in it, and u = v + d."""

    def __init__(self, part, deviation, seed):
        super().__init__(part, ())
        self.deviation, self.rng = deviation, np.random.default_rng(seed)

    def record(self, n, every):
        self.played += 1
        d = np.sin(self.part.omega[0] * 0.01 * np.arange(n + 1))[:, None]
        v = d + self.deviation * self.rng.standard_normal((n + 1, 1))
        return v, v + d, np.zeros((n + 1, 0))


@pytest.mark.parametrize("deviation", [1e-4, 1e-2])
@pytest.mark.slow
def test_the_noise_in_an_uncertainty_covers_the_true_value_in_its_share_of_draws(deviation):
    """The share is 95 %, of v; that of L is more, as the errors of v and u add up, which are one noise."""
    (part,) = plan_signal("sine", np.array([20.0]), 0.01, 1.0)
    draws, covered, settled, sizes = 200, np.zeros(3), 0, []
    for seed in range(draws):
        run, found = NoisyWindows(part, deviation, seed), Measurement(1, 1, 0)
        measure_part(run, part, 0, 0, 1, 40, 1e-6, found, 0)
        v, u = found.v.item(), found.u.item()
        covered[0] += abs(v - 1.0) <= found.noise[0, 0] * abs(v)
        covered[1] += abs(u - 2.0) <= found.noise[1, 0] * abs(u)
        covered[2] += abs((v / u) / 0.5 - 1.0) <= found.uncertainty[0]
        settled += found.settled[0]
        sizes.append(found.uncertainty[0])
    share = covered / draws
    assert settled == draws
    assert np.all(np.abs(share[:2] - 0.95) < 0.04)  # 2.6 standard deviations of 200 draws
    assert share[2] >= 0.95
    # a phasor of n samples has the deviation 2 σ/√n, and the mean of some windows less
    assert np.median(sizes) < 3 * 1.5 * 2 * deviation / np.sqrt(part.samples)


def noisy_loop(variance, seed):
    """L = 3 T/(z − 1) with T = 0.01 s, and noise in what the controller reads."""
    lag, noise = Integrator(name="lag"), BandLimitedNoise(variance=variance, sample_time=0.01, seed=seed, name="noise")

    @subsystem(sample_time=0.01)
    def controller(y, n):
        return Gain(gain=3.0, name="gain")(0.0 - y - n).named("u")

    return Diagram("noisy", lag(controller(lag.y, noise.y)))


@pytest.mark.parametrize("variance", [1e-8, 1e-4])
@pytest.mark.slow
def test_a_loop_with_noise_settles_with_an_uncertainty_that_holds(variance):
    for seed in (1, 2):
        found = noisy_loop(variance, seed).frequency_response("u", [8.0], amplitude=1.0)
        L = 0.03 / (np.exp(0.01j * found.omega) - 1)
        off = abs(found.L.frdata[0, 0] / L - 1)
        assert found.settled.all()
        assert np.all(off <= found.uncertainty)
        assert np.all(found.uncertainty < 100 * np.sqrt(variance) / np.sqrt(256))


def sampled(tau, T, held):
    """A loop of an integrator on a clock; its plant is continuous, or all of it is sampled."""

    @subsystem(sample_time=T)
    def controller(y):
        return DiscreteIntegrator(name="integral")((Constant(value=0.0, name="r") - y) / tau)

    @subsystem(sample_time=T)
    def both(unused):
        integral = DiscreteIntegrator(name="integral")
        return integral(((Constant(value=0.0, name="r") - integral.y) / tau).named("u"))

    if held:
        return Diagram("d", both(Constant(value=0.0, name="nothing")))
    plant = TransferFunction(numerator=[1.0], denominator=[0.2 * tau, 1.0], name="plant")
    return Diagram("d", plant(controller(plant.y).named("u")))


@pytest.mark.parametrize(("held", "most"), [(False, SOLVED), (True, LONGEST)])
def test_a_report_adds_no_sine_that_takes_for_ever(held, most):
    """A loop that is a million times slower than its samples: periods have a bounded number of them."""
    case = Case(sampled(1000.0, 0.001, held).wired)
    variant = case.variants["sampled_d0"]
    frequencies = case.excitation(variant, next(iter(case.loop_wires().values()))).frequencies
    assert len(frequencies) == 5
    assert 2 * np.pi / frequencies[0] / 0.001 <= most * (1 + 1e-12)
    assert frequencies[-1] < 0.5 * np.pi / 0.001 * (1 + 1e-12)
    assert frequencies[-1] > 2 * frequencies[0]


def test_a_loop_as_fast_as_its_samples_is_measured_around_its_poles():
    case = Case(sampled(0.05, 0.01, True).wired)
    variant = case.variants["sampled_d0"]
    frequencies = case.excitation(variant, next(iter(case.loop_wires().values()))).frequencies
    pole = -np.log(1 - 0.01 / 0.05) / 0.01
    assert frequencies[0] == pytest.approx(pole / 10, rel=1e-6)


def test_frequencies_that_are_left_out_are_counted():
    variant = Case(sampled(0.05, 0.01, True).wired).variants["sampled_d0"]
    plan = InjectionPlan(variant, np.array([0.1, 1.0, 2 * np.pi / (400 * 0.01), 10.0, 100.0]), 1e-4)
    kept = plan.shortened(400)
    assert kept.frequencies.tolist() == plan.frequencies[2:].tolist()
    assert (kept.left_out, kept.samples) == (2, 400)
    assert plan.shortened(10**6).left_out == 0
    assert plan.shortened(1).frequencies.tolist() == [100.0]  # the highest one stays
