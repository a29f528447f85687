"""First-order hold: the line through the last two samples, in runs and in linear models."""

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, SampleTimeError, Sine
from loopwright.diagrams import Diagram, first_order_hold, subsystem

T = 0.1


@pytest.mark.parametrize("offset", [0.0, 0.03])
def test_it_continues_along_the_last_two_samples(offset):
    held = first_order_hold(Sine(frequency=1.0, name="a"), T, offset=offset)
    run = Diagram("d", held.named("y")).simulate(1.0, step=0.01, progress=False)
    after = run.t > offset - 1e-9
    t = run.t[after]
    k = np.floor((t - offset) / T + 1e-9)

    def sample(k):
        return np.where(k < 0, 0.0, np.sin(2 * np.pi * (offset + k * T)))  # just before t = 0 the sine is 0

    want = sample(k) + (sample(k) - sample(k - 1)) / T * (t - offset - k * T)
    np.testing.assert_allclose(run["y"][after], want, atol=1e-14)
    assert np.all(run["y"][~after] == 0.0)


def test_vectors_are_held_entry_by_entry():
    held = first_order_hold(np.stack([Sine(frequency=1.0), Constant(value=2.0)]), T)
    run = Diagram("d", held.named("y")).simulate(0.2, step=0.05, progress=False)
    assert run["y"][:, 1].tolist() == [2.0] * 5


def test_a_linear_model_has_its_effect_on_the_loop():
    """Integrator behind the hold: y[k + 1] = y[k] + T e[k] + T / 2 (e[k] - e[k - 1])."""

    @subsystem(sample_time=T)
    def controller(u, y):
        return Gain(gain=1.0, name="k")(u - y)

    plant = Integrator(name="plant")
    held = first_order_hold(controller(Constant(value=0.0, name="u"), plant.y), T)
    model = Diagram("d", plant(held).named("y")).linearize(inputs=["u"], outputs=["y"])
    for z in np.exp(1j * np.array([0.3, 3.0, 20.0]) * T):
        open_loop = T * (3 - 1 / z) / 2 / (z - 1)
        assert abs(model.system(z) - open_loop / (1 + open_loop)) < 1e-11
    np.testing.assert_allclose(np.sort(model.poles), np.sort(np.roots([1.0, -1.0 + 1.5 * T, -0.5 * T])), atol=1e-11)


def test_a_sample_time_is_needed():
    with pytest.raises(SampleTimeError, match=r"hold: found a sample time of 0 s"):
        first_order_hold(Sine(frequency=1.0), 0.0, name="hold")
