"""Transport delays in continuous time around sampled subsystems: their linear models against closed forms and runs.

Behind a hold, a plant with the step response s(t) answers the pulse of one sample by s(t − θ) − s(t − θ − T), θ its dead
time: the sum of these samples, times z⁻ᵏ, is its transfer function, whatever part of a sample θ leaves over.
"""

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import (
    PID,
    Constant,
    Gain,
    Integrator,
    OptionError,
    Sum,
    TransferFunction,
    TransportDelay,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.frequency import margins
from support.hybrid_blocks import TIGHT, Lag

T = 0.1


def lag(gain, time_constant, name):
    return TransferFunction(numerator=[gain], denominator=[time_constant, 1.0], name=name)


def delay(tau, name):
    return TransportDelay(delay=tau, name=name)


def sampled_pi(measured, kp=1.0, ki=0.5, sample_time=T):
    @subsystem(sample_time=sample_time)
    def controller(r, y):
        return PID(kp=kp, ki=ki, name="pi")(r, y).named("u")

    return controller(Constant(value=1.0, name="ref"), measured)


def from_step_response(step_response, theta, z, terms=4000):
    """Return the transfer function in z of a plant with a step response, of s(t) from t = 0 on, and a dead time."""
    k = np.arange(terms)

    def s(t):
        late = t - theta
        return np.where(late > -1e-12, step_response(np.maximum(late, 0.0)), 0.0)

    pulse = s(k * T) - s(k * T - T)
    return (pulse[:, None] * z[None, :] ** -k[:, None]).sum(axis=0)


def one_lag(t):
    return 2.0 * (1.0 - np.exp(-t))


def two_lags(t):  # 2/((s + 1)(0.3 s + 1))
    return 2.0 * (1.0 - (np.exp(-t) - 0.3 * np.exp(-t / 0.3)) / 0.7)


def loop_of(theta, where):
    """A lag of 1 s with dead time: behind the hold, ahead of the sampler, or half of it on each side."""
    plant, before, behind = lag(2.0, 1.0, "lag"), delay(theta, "before"), delay(theta, "behind")
    if where == "before":
        return Diagram("d", plant(before(sampled_pi(plant.y))))
    if where == "behind":
        return Diagram("d", behind(plant(sampled_pi(behind.y))))
    before, behind = delay(0.4 * theta, "before"), delay(0.6 * theta, "behind")
    return Diagram("d", behind(plant(before(sampled_pi(behind.y)))))


@pytest.mark.parametrize("where", ["before", "behind", "both"])
@pytest.mark.parametrize("theta", [0.2, 0.25, 0.033, 1.2345])
@pytest.mark.drawn(2)
def test_a_lag_with_dead_time_has_the_modified_z_transform(theta, where):
    L = loop_of(theta, where).linearize().loop("u")
    none = Diagram("d", (plant := lag(2.0, 1.0, "lag"))(sampled_pi(plant.y))).linearize().loop("u")
    w = np.array([0.05, 0.7, 4.0, 17.0, 31.0])
    z = np.exp(1j * w * T)
    ratio = from_step_response(one_lag, theta, z) / from_step_response(one_lag, 0.0, z)
    assert L.dt == T
    assert np.max(np.abs(L(z) / none(z) / ratio - 1.0)) < 1e-12


@pytest.mark.parametrize(("theta", "steps"), [(0.25, 5), (17.0, 172)])
def test_no_more_is_kept_of_the_past_than_is_needed(theta, steps):
    """A delay of n + f samples of one signal is n + 1 of its samples, and 17 s are no more than 170."""
    assert loop_of(theta, "behind").linearize().loop("u").nstates == steps
    assert loop_of(theta, "before").linearize().loop("u").nstates == steps


@pytest.mark.parametrize(("theta", "high"), [(0.137, 9.0), (0.4, 6.0), (0.77, 3.0)])
@pytest.mark.drawn(1)
def test_margins_of_a_sampled_loop_with_a_dead_time_off_the_grid_are_those_of_the_closed_form(theta, high):
    """PI and two lags with dead time; crossovers by Brent's method on the sum of the pulse response."""
    first, second, late = lag(2.0, 1.0, "first"), lag(1.0, 0.3, "second"), delay(theta, "late")
    made = margins(Diagram("d", second(late(first(sampled_pi(second.y))))).linearize().loop("u"))

    def L(w):
        z = np.exp(1j * np.atleast_1d(w) * T)
        return ((1.0 + 0.5 * T / (z - 1.0)) * from_step_response(two_lags, theta, z))[0]

    crossover = brentq(lambda w: np.log(abs(L(w))), 0.3, 5.0, xtol=1e-14)
    assert made.gain_crossovers[0].frequency.value == pytest.approx(crossover, rel=1e-10)
    assert made.phase_margin_deg.value == pytest.approx(180 + np.degrees(np.angle(L(crossover))), abs=1e-9)
    w180 = brentq(lambda w: (L(w) * np.exp(1j * np.pi)).imag / abs(L(w)), crossover, high, xtol=1e-14)
    assert made.gain_margin_high.value == pytest.approx(1 / abs(L(w180)), rel=1e-9)


def test_two_ways_with_different_dead_times_add_up():
    """2/(s + 1) e^(−0.13 s) and 2/((s + 1)(0.3 s + 1)) e^(−0.41 s) in parallel, with no state twice."""
    a, b = lag(2.0, 1.0, "a"), lag(1.0, 0.3, "b")
    short, long = delay(0.13, "short"), delay(0.28, "long")
    total = Sum(signs="++", name="total")
    u = sampled_pi(total.y)
    mixed = a(short(u))
    diagram = Diagram("d", total(mixed, b(long(mixed))))
    L = diagram.linearize().loop("u")
    plain = Diagram("d", (plant := lag(2.0, 1.0, "lag"))(sampled_pi(plant.y))).linearize().loop("u")
    z = np.exp(1j * np.array([0.05, 0.7, 4.0, 17.0, 31.0]) * T)
    wanted = from_step_response(one_lag, 0.13, z) + from_step_response(two_lags, 0.41, z)
    assert np.max(np.abs(L(z) / plain(z) * from_step_response(one_lag, 0.0, z) / wanted - 1.0)) < 1e-11
    assert sum("past" not in name and "coming" not in name for name in L.state_labels) == 3


def test_an_integrating_process_keeps_one_integrator():
    """ẏ = u(t − 0.25): one pole at z = 1 beside the controller's, and the delay's at 0."""
    plant, late = Integrator(name="tank"), delay(0.25, "late")
    for made in (plant(late(sampled_pi(plant.y, ki=0.0))), late(plant(sampled_pi(late.y, ki=0.0)))):
        L = Diagram("d", made).linearize().loop("u")
        z = np.exp(1j * np.array([0.05, 0.7, 4.0, 17.0]) * T)
        # within a sample the old command acts for half of it
        wanted = z**-2 * (0.05 + 0.05 / z) / (z - 1.0)
        assert np.max(np.abs(L(z) / wanted - 1.0)) < 1e-12


def test_several_rates_and_a_delay_are_those_of_the_run():
    """A cascade of 0.1 s and 0.3 s around two lags with delays off both grids: state by state, period by period."""
    inner, outer = Lag(k=2.5, start=0.7, name="inner"), Lag(k=0.5, start=-1.3, name="outer")
    actuator, pipe = delay(0.17, "actuator"), delay(0.73, "pipe")

    @subsystem(sample_time=0.3)
    def slow(y):
        return Gain(gain=-0.8, name="k")(y).named("wish")

    @subsystem(sample_time=0.1)
    def fast(wish, x):
        return UnitDelay(initial_value=0.0, name="computing")(Gain(gain=0.5, name="k")(wish - x)).named("u")

    diagram = Diagram("d", pipe(outer(inner(actuator(fast(slow(pipe.y), inner.y))))))
    model, run = diagram.linearize(), diagram.simulate(6.0, step=0.1, **TIGHT)
    assert model.dt == pytest.approx(0.3)
    where = [model.states.index("inner.y"), model.states.index("outer.y")]
    x = np.zeros(len(model.states))
    x[where] = 0.7, -1.3
    for k in range(20):
        at = int(np.argmin(np.abs(run.t - 0.3 * k)))
        assert np.max(np.abs(x[where] - [run["inner.y"][at], run["outer.y"][at]])) < 2e-10
        x = model.A @ x
    assert np.max(np.abs(x)) > 1e-3


def test_a_loop_around_a_delay_between_ticks_is_refused_by_name():
    inner, late = lag(1.0, 1.0, "inner"), delay(0.25, "late")
    diagram = Diagram("d", inner(sampled_pi(inner.y) - late(inner.y)))
    with pytest.raises(OptionError, match=r"late: found that its output acts back on its input between ticks.*0\.25 s"):
        diagram.linearize()
