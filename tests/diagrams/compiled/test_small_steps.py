"""Steps with the rates of a small diagram inlined, beside the steps that serve every diagram: the bits of both."""

import numpy as np
import pytest

from loopwright.blocks import Integrator, Product, Relay, Sine, Step, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled import expanded_functions
from loopwright.diagrams.compiled.expanded_functions import write_steps

QUIET = {"progress": False, "compile": True}


def controlled():
    """A lag under a sampled controller, driven by a source that jumps within a tick."""

    @subsystem(sample_time=0.01, name="controller")
    def controller(y):
        return 3.0 * (1.0 - y)

    lag = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="lag")
    disturbance = Step(times=0.1234, values=0.5, name="disturbance")
    return Diagram("controlled", lag(controller(lag.y) + disturbance()))


def nonlinear():
    x = Integrator(initial_value=1.0, name="x")
    return Diagram("nonlinear", x(Sine(frequency=2.0, name="wind") - Product(name="square")(x.y, x.y)))


def switching():
    heat = Integrator(initial_value=0.0, name="heat")
    relay = Relay(name="relay", on_point=0.1, off_point=-0.1, on_value=-1.0, off_value=1.0)
    return Diagram("switching", heat(relay(heat.y)))


def steps_of(diagram):
    flat = diagram.simulation(step=0.01).flat
    return write_steps(flat.flow.last.fast, flat.continuous.tolist())


@pytest.mark.parametrize("solver", ["rk4", "RK23", "RK45"])
@pytest.mark.parametrize("make", [controlled, nonlinear, switching])
@pytest.mark.drawn(1)
def test_inlined_steps_have_the_bits_of_steps_for_every_diagram(make, solver, monkeypatch):
    options = {"solver": solver, "step": 0.01, **QUIET}
    assert "step_rk4" in steps_of(make())
    inlined = make().simulate(1.0, **options)
    monkeypatch.setattr(expanded_functions, "write_steps", lambda rates, where: "")
    other = make().simulate(1.0, **options)
    assert inlined.tier == other.tier == "compiled"
    assert inlined.data.tobytes() == other.data.tobytes()
    assert len(inlined.events) == len(other.events)


def test_rates_of_many_operations_are_called():
    many = [TransferFunction(numerator=1.0, denominator=[0.1 + i, 1.0], name=f"lag{i}") for i in range(9)]
    made = Diagram("many", *[lag(1.0) for lag in many])
    assert steps_of(made) == ""
    run = made.simulate(1.0, solver="RK45", rtol=1e-9, step=0.1, **QUIET)
    for i, lag in enumerate(many):
        assert run[f"{lag.name}.y"][-1] == pytest.approx(1.0 - np.exp(-run.t[-1] / (0.1 + i)), abs=1e-8)
