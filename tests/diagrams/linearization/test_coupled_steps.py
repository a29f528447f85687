"""Linear models over communication steps of Gauss-Seidel and iterated coupling: the oracle is the run itself.

Everything is linear here, so that a run from rest with a step at an input, and runs from displaced masses, have the
model's response to rounding (to the tolerance of the iteration with that coupling).
"""

import numpy as np
import pytest

from loopwright.blocks import Gain, Integrator, OptionError, Step
from loopwright.diagrams import Coupling, Diagram
from support.oscillators import PULL, mass, two_masses

H = 0.01
SCHEMES = [
    "gauss_seidel",
    Coupling(scheme="gauss_seidel", order=("b", "a")),
    Coupling(scheme="iterated", tolerance=1e-13),
]
NAMES = ["in its own order", "in another order", "iterated"]


def push(name="push"):
    return Step(times=2 * H, values=1.0, name=name)


def masses_and_filter(feedback=-0.5):
    """Two masses coupled by a spring, a filter in continuous time, and the other's acceleration: direct feedthrough."""
    a, b, state = mass("a"), mass("b", mass=2.0), Integrator(name="filter")
    pull = Gain(gain=PULL, name="spring")(b.position - a.position)
    link = Gain(gain=feedback, name="link")(b.acceleration)
    return Diagram(
        "two",
        a(force=pull + push() + link - 10.0 * state.y),
        b(force=-1.0 * pull),
        state(20.0 * (b.position - state.y)),
    )


def feedthrough_loop():
    """Each mass is driven by the other's acceleration: a loop of direct feedthrough."""
    a, b = mass("a"), mass("b")
    link = Gain(gain=-0.5, name="link")(b.acceleration) + push()
    return Diagram("inertia", a(force=link), b(force=Gain(gain=-0.5, name="back")(a.acceleration)))


def response(model, count):
    """Return the outputs of a discrete model after a step of its input at tick 2."""
    x, found = np.zeros(len(model.A)), []
    for k in range(count):
        u = np.array([float(k >= 2)])
        found.append(model.C @ x + model.D @ u)
        x = model.A @ x + model.B @ u
    return np.array(found)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("coupling", SCHEMES, ids=NAMES)
@pytest.mark.parametrize("make", [masses_and_filter, feedthrough_loop])
def test_the_step_response_is_that_of_the_run(cache, make, coupling):
    if make is feedthrough_loop and coupling == SCHEMES[0]:
        coupling = Coupling(scheme="gauss_seidel", order=("a", "b"))
    diagram, signals = make(), ["a.position", "b.velocity", "b.acceleration"]
    run = diagram.simulate(0.2, step=H, coupling=coupling, rtol=1e-11, atol=1e-14, progress=False)
    model = diagram.linearize(step=H, coupling=coupling, inputs="push.y", outputs=signals)
    found = np.column_stack([run[name] for name in signals])
    np.testing.assert_allclose(response(model, len(run.t)), found, rtol=0, atol=1e-9 * np.abs(found).max())
    plain = response(diagram.linearize(step=H, inputs="push.y", outputs=signals), len(run.t))
    assert np.abs(plain - found).max() > 1e-3 * np.abs(found).max()  # another scheme is seen


@pytest.mark.drawn(1)
@pytest.mark.parametrize("coupling", SCHEMES, ids=NAMES)
def test_the_poles_are_those_of_the_map_from_tick_to_tick(cache, coupling):
    signals, columns = ["a.position", "a.velocity", "b.position", "b.velocity"], []
    diagram = two_masses()
    for k, name in enumerate(signals):
        path, state = name.split(".")
        start = {"a": {"position": 0.0, "velocity": 0.0}, "b": {"position": 0.0, "velocity": 0.0, "mass": 2.0}}
        start[path][state] = 0.1
        moved = diagram.replace({p: diagram[p].replace(start=s) for p, s in start.items()})
        run = moved.simulate(H, step=H, coupling=coupling, progress=False)
        columns.append([run[s][1] / 0.1 for s in signals])
        assert [run[s][0] for s in signals] == pytest.approx(0.1 * np.eye(4)[k])
    rest = diagram.replace({"a": diagram["a"].replace(start={"position": 0.0, "velocity": 0.0})})
    model = rest.linearize(step=H, coupling=coupling)
    poles = np.array(sorted(model.poles, key=lambda p: (round(abs(p), 12), p.imag)))[-4:]
    expected = np.linalg.eigvals(np.transpose(columns))
    for pole in expected:
        assert np.abs(poles - pole).min() < 1e-10


def test_a_trajectory_is_followed_one_after_the_other(cache):
    diagram = two_masses()
    with_motion = diagram.linearize(0.05, step=H, coupling="gauss_seidel", inputs="a.force", outputs="b.position")
    rest = diagram.replace({"a": diagram["a"].replace(start={"position": 0.0, "velocity": 0.0})})
    at_rest = rest.linearize(step=H, coupling="gauss_seidel", inputs="a.force", outputs="b.position")
    for k in range(1, 6):
        one, other = (m.C @ np.linalg.matrix_power(m.A, k) @ m.B for m in (with_motion, at_rest))
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-12)


def test_points_that_it_does_not_follow_are_refused(cache):
    diagram = two_masses()
    with pytest.raises(
        OptionError, match=r"^a\.coupling, t = 0\.05 s: .*iterated coupling at which the FMU moves .*at rest"
    ):
        diagram.linearize(0.05, step=H, coupling="iterated")
    adaptive = Coupling(scheme="gauss_seidel", error=1e-4)
    with pytest.raises(OptionError, match=r"'gauss_seidel with error=0\.0001', in which the length .*without error="):
        diagram.linearize(0.05, step=H, coupling=adaptive)
