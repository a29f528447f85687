"""The orders of evaluation are found once for a diagram, when it is built."""

import pytest

from loopwright.blocks import Constant, FilteredDerivative, Gain, Sine, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.wiring import evaluation_order


@pytest.fixture
def sorted_times(monkeypatch):
    calls = []
    sort = evaluation_order._sort

    def count(*args):
        calls.append(args)
        return sort(*args)

    monkeypatch.setattr(evaluation_order, "_sort", count)
    return calls


def loop(block):
    @subsystem(sample_time=1e-3)
    def controller(u):
        return Gain(gain=2.0)(block(u))

    return Diagram("ordered", controller(Sine(frequency=1.0)))


def test_a_diagram_is_sorted_once_and_not_again_for_its_runs(sorted_times):
    diagram = loop(UnitDelay(initial_value=0.0))
    diagram.simulate(0.01, progress=False)
    diagram.simulate(0.01, progress=False, step=5e-4)
    assert len(sorted_times) == 1


def test_blocks_that_start_from_their_inputs_have_an_order_of_their_own(sorted_times):
    diagram = loop(FilteredDerivative(time_constant=0.01))
    run = diagram.simulate(0.01, progress=False)
    assert len(sorted_times) == 2
    assert run["controller.filtered_derivative.y"][0] == 0.0  # it starts from the sine's value, with no jump


def test_orders_of_a_diagram_without_starting_blocks_are_one():
    at_instant, at_start = Diagram("one", Gain(gain=1.0)(Constant(value=1.0))).wired.orders
    assert at_instant is at_start
