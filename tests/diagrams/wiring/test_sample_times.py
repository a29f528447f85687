"""Sample times: decimals, fractions and floats that stand for fractions; FMUs step where something acts."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Clock, Constant, Counter, Gain, PulseTrain, SampleTimeError, TransportDelay, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu
from loopwright.fmus.models import mass_spring_damper
from support.counted import counted_steps


def sampled(time, function=lambda u: UnitDelay(initial_value=0.0)(u), **options):
    return subsystem(sample_time=time, **options)(function)


@pytest.mark.parametrize(
    ("given", "exact"),
    [
        (1 / 3, Fraction(1, 3)),
        (1 / 30, Fraction(1, 30)),
        (1 / 60, Fraction(1, 60)),
        (1 / 44100, Fraction(1, 44100)),
        (2 / 3, Fraction(2, 3)),
        (22 / 7, Fraction(22, 7)),
        (0.0007, Fraction(7, 10000)),
        (1e-9, Fraction(1, 10**9)),
        (0.333333333, Fraction(333333333, 10**9)),  # a multiple of 1 ns stays one
        (Fraction(1, 7 * 10**9), Fraction(1, 7 * 10**9)),  # a fraction is taken as it is
        (np.float64(1 / 3), Fraction(1, 3)),
        (2, Fraction(2)),
    ],
)
def test_a_sample_time_is_read_exactly(given, exact):
    assert sampled(given).sample_time == exact


@pytest.mark.parametrize("value", [np.pi / 1e3, 0.1 + 0.2, np.sqrt(2) / 100, 1e-10])
def test_a_float_that_stands_for_nothing_is_refused_with_the_way_out(value):
    with pytest.raises(SampleTimeError, match=r"neither a multiple of 1 ns nor a fraction .* Give a Fraction"):
        sampled(value)


def test_thirds_of_a_second_do_not_drift():
    run = Diagram("d", sampled(1 / 3)(Clock())).simulate(1000.0, progress=False)
    assert len(run.t) == 3001
    assert run.t[-1] == 1000.0
    assert np.array_equal(run.t, np.array([float(Fraction(k, 3)) for k in range(3001)]))


def test_offsets_pulses_and_delays_are_read_alike():
    run = Diagram("d", sampled(1.0, offset=1 / 3)(Clock())).simulate(5.0, progress=False)
    assert run.t[1] == 1 / 3
    edges = sampled(1 / 30, lambda u: Counter()(u))(PulseTrain(period=1 / 3))
    run = Diagram("d", edges).simulate(100.0, progress=False)
    assert run["counter.y"][-1] == 301  # one at 0, and one at each third up to 100 s
    late = sampled(1 / 30, lambda u: TransportDelay(delay=1 / 3)(u))
    run = Diagram("d", late(Clock())).simulate(2.0, progress=False)
    assert run["transport_delay.y"][-1] == pytest.approx(2.0 - 1 / 3, abs=1e-12)


def test_two_rates_without_a_convenient_base():
    """1/44100 s beside 1 ms: their base is 1/441000 s; what is visited are their own ticks."""
    diagram = Diagram("d", sampled(1 / 44100, name="fast")(Clock()), sampled(1e-3, name="slow")(Clock()))
    run = diagram.simulate(0.01, progress=False)
    assert len(run.t) == 441 + 1 + 10 - 1  # both at 0 and at 10 ms


# --- FMUs ---------------------------------------------------------------------------------------------------------------


def oscillator():
    return Fmu(mass_spring_damper.build(), name="plant")


def exact(force, times):
    """Return the positions of the library's oscillator under a constant force."""
    p = mass_spring_damper.MassSpringDamper()
    A = np.array([[0, 1], [-p.stiffness / p.mass, -p.damping / p.mass]])
    x0 = np.array([p.start_position, p.start_velocity])
    rest = np.array([force / p.stiffness, 0.0])
    return np.array([(expm(A * t) @ (x0 - rest) + rest)[0] for t in times])


@pytest.mark.one_tier
def test_an_fmu_steps_where_a_subsystem_acts_and_not_at_the_base(cache, monkeypatch):
    plant = oscillator()
    steps = counted_steps(monkeypatch)

    @subsystem(sample_time=1 / 44100)
    def fast(y):
        return Gain(gain=0.0, name="none")(y)

    @subsystem(sample_time=1e-3)
    def slow(u):
        return Gain(gain=1.0, name="one")(u)

    diagram = Diagram("d", plant(force=slow(Constant(value=3.0)) + fast(plant.position)))
    run = diagram.simulate(0.05, progress=False)
    assert len(steps) == 2205 + 50 - 5  # at the base there were 22050
    assert sum(h for _, h in steps) == pytest.approx(0.05, rel=1e-12)
    assert run["plant.position"] == pytest.approx(exact(3.0, run.t), abs=1e-9)


@pytest.mark.one_tier
def test_an_fmu_that_takes_steps_of_one_length_steps_at_the_base(cache, monkeypatch):
    plant = oscillator()
    monkeypatch.setattr(Fmu, "variable_step", property(lambda self: False))
    steps = counted_steps(monkeypatch)
    a, b = sampled(1e-3, lambda u: Gain(gain=1.0)(u), name="a"), sampled(0.7e-3, name="b")
    run = Diagram("d", plant(force=a(plant.position)), b(plant.position)).simulate(7e-3, progress=False)
    assert len(steps) == 70
    (message,) = run.messages
    assert message.startswith("plant: takes steps of one length only")
    assert "0.0001 s, 7 times finer than the fastest subsystem" in message


@pytest.mark.slow
def test_a_linear_model_over_uneven_ticks_is_that_of_the_run(cache):
    """A is the product of the exact transitions over the ticks of a period, by hand."""
    plant = oscillator()
    hold, gain = sampled(1e-3, name="a"), sampled(0.7e-3, lambda u: Gain(gain=-50.0)(u), name="b")
    diagram = Diagram("d", plant(force=gain(plant.position)), hold(plant.position))
    model = diagram.linearize()
    p = mass_spring_damper.MassSpringDamper()
    A = np.array([[0, 1, 0], [-p.stiffness / p.mass, -p.damping / p.mass, 1 / p.mass], [0, 0, 0]])
    P = np.eye(3)
    for k in range(10):  # the force is renewed every 0.7 ms
        P[2] = -50.0 * P[0] if k else [-50.0, 0, 0]
        P = expm(A * 0.7e-3) @ P
    assert model.dt == pytest.approx(7e-3, rel=1e-12)
    expected = np.linalg.eigvals(P[:2, :2])
    found = [z for z in model.poles if abs(z) > 1e-6]
    assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), abs=1e-8)
