"""Diagrams with other numbers share the functions of their origin, and run as diagrams that were made anew."""

import math

import pytest

from loopwright.blocks import Gain, Integrator, Pulse, Relay, Sine, Step, TransferFunction
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.flat import flat_functions
from loopwright.fmus import StepOptions

QUIET = {"progress": False}


def thermostat():
    """A relay with hysteresis around a lag, a pulse that it lands on, and a sampled filter behind."""

    @subsystem(sample_time=0.05, name="filter")
    def filtered(u):
        return TransferFunction(numerator=(1.0,), denominator=(0.2, 1.0), name="smooth")(u)

    room = Integrator(name="room", initial_value=1.0)
    relay = Relay(on_point=0.1, off_point=-0.1, name="relay")
    heat = relay(0.5 - Gain(gain=1.0, name="sensor")(room.y))
    door = Pulse(start_time=0.6, end_time=0.9, rise_time=0.02, amplitude=-1.5, name="door")
    wind = Sine(frequency=3.0, amplitude=0.2, name="wind")
    closed = room(2.0 * heat - room.y + door + wind)
    return Diagram(
        "thermostat", closed, filtered(room.y).named("y"), Step(times=0.31, values=1.0, name="step").y.named("s")
    )


CHANGES = {
    "relay.on_point": 0.05,
    "relay.off_point": -0.15,
    "room.initial_value": 0.4,
    "door.start_time": 0.71,
    "wind.frequency": 4.0,
    "filter.smooth.denominator": (0.3, 1.0),
    "step.times": 0.555,
}


def made_anew(diagram):
    """Give the diagram without the functions of another one that it may share."""
    return type(diagram)._of(diagram.name, diagram.structure, diagram.loops)


def renumbered(diagram, changes):
    blocks = {}
    other = made_anew(diagram.replace(changes))
    for path, block in diagram.wired.scheduled.blocks.items():
        if other.wired.scheduled.blocks[path] != block:
            blocks[path] = other.wired.scheduled.blocks[path]
    return diagram.of_wired(diagram.wired.renumbered(blocks)), other


def assert_equal_runs(first, second):
    assert first.t.tobytes() == second.t.tobytes()
    assert first.data.tobytes() == second.data.tobytes()
    assert list(first.events) == list(second.events)


@pytest.mark.drawn(2)
@pytest.mark.parametrize("options", [{}, {"solver": "rk4", "step": 0.01}, {"compile": True}], ids=str)
def test_runs_with_events_and_jumps_are_those_of_a_diagram_that_was_made_anew(options):
    diagram = thermostat()
    before = diagram.simulate(2.0, **QUIET, **options)
    variant, other = renumbered(diagram, CHANGES)
    run = variant.simulate(2.0, **QUIET, **options)
    assert_equal_runs(run, other.simulate(2.0, **QUIET, **options))
    assert run.data.tobytes() != before.data.tobytes()
    assert len(run.events) > 4
    assert_equal_runs(before, diagram.simulate(2.0, **QUIET, **options))  # the origin stays as it was


def test_functions_are_traced_once(monkeypatch):
    diagram = thermostat()
    diagram.simulate(0.2, **QUIET)
    for name in ("trace_tick", "trace_between"):
        monkeypatch.setattr(flat_functions, name, lambda *_, **__: pytest.fail("traced again"))
    variant, _ = renumbered(diagram, CHANGES)
    variant.simulate(0.2, **QUIET)
    again = variant.of_wired(variant.wired.renumbered({"room": variant["room"].replace(initial_value=0.9)}))
    assert again.simulate(0.2, **QUIET)["room.y"][0] == 0.9
    assert again.flatten().origin is diagram.flatten()
    assert again["relay"].on_point == 0.05


def test_functions_that_a_variant_asks_for_first_belong_to_all(monkeypatch):
    diagram = thermostat()
    variant, _ = renumbered(diagram, CHANGES)
    variant.simulate(0.2, **QUIET)
    for name in ("trace_tick", "trace_between"):
        monkeypatch.setattr(flat_functions, name, lambda *_, **__: pytest.fail("traced again"))
    diagram.simulate(0.2, **QUIET)


def test_a_variant_of_an_fmu_runs_is_linearized_and_replaced_as_any_diagram():
    diagram = experiments.path_following().diagram
    variant, other = renumbered(diagram, {"plant.start.coulomb_scale": 2.0, "controller.pid_par.a0": 7000.0})
    assert_equal_runs(variant.simulate(0.1, **QUIET), other.simulate(0.1, **QUIET))
    assert variant.structure == other.structure
    assert (
        variant.replace({"controller.pid_par.a0": 8000.0}).structure
        == other.replace({"controller.pid_par.a0": 8000.0}).structure
    )


def shares(diagram, other):
    step = None if diagram.has_clock else 0.1
    return other.flatten(step).origin is diagram.flatten(step).origin


def test_a_replaced_diagram_shares_functions_where_numbers_alone_differ():
    diagram = thermostat()
    variant = diagram.replace(CHANGES)
    assert shares(diagram, variant)
    assert shares(diagram, variant.replace({"relay.on_point": 0.2}))
    for options in ({}, {"compile": True}):
        assert_equal_runs(
            variant.simulate(1.0, **QUIET, **options), made_anew(variant).simulate(1.0, **QUIET, **options)
        )
    L, anew = (d.linearize(0.0).A for d in (variant, made_anew(variant)))
    assert L.tobytes() == anew.tobytes()


@pytest.mark.drawn(3)
@pytest.mark.parametrize(
    "change",
    [
        {"wind.amplitude": 0.0},  # an exact zero is structure of the trace
        {"filter.sample_time": 0.1},
        {"filter.delay": 1},
        {"filter.smooth.denominator": (0.1, 0.3, 1.0)},
        {"sensor": Gain(gain=2.0, name="other")},
    ],
    ids=str,
)
def test_other_structure_has_functions_of_its_own(change):
    diagram = thermostat()
    other = diagram.replace(change)
    renamed = "sensor" in change
    assert shares(diagram, other) is renamed  # names of blocks in functions are their paths
    assert_equal_runs(other.simulate(0.4, **QUIET), made_anew(other).simulate(0.4, **QUIET))


def test_variants_of_other_structure_share_functions_among_themselves():
    diagram = thermostat()
    first, second = (diagram.replace({"wind.amplitude": 0.0, "relay.on_point": on}) for on in (0.05, 0.2))
    assert not shares(diagram, first)
    assert shares(first, second)


def test_blocks_of_users_share_nothing():
    """Their equations may read what has changed since, such as a constant of their module."""
    factor = [1.0]

    class Law(Gain):
        def output(self, t, x, u):
            return factor[0] * self.gain * u.u

    x = Integrator(name="x", initial_value=1.0)
    diagram = Diagram("law", x(Law(gain=-1.0, name="law")(x.y)))
    diagram.simulate(0.1, **QUIET)
    factor[0] = 2.0
    other = diagram.replace({"x.initial_value": 2.0})
    assert not shares(diagram, other)
    assert other.simulate(1.0, **QUIET)["x.y"][-1] == pytest.approx(2.0 * math.exp(-2.0), rel=1e-6)


def test_a_replaced_start_value_of_an_fmu_shares_functions():
    diagram = experiments.path_following().diagram
    other = diagram.replace({"plant.start.coulomb_scale": 2.0})
    assert shares(diagram, other)
    assert_equal_runs(other.simulate(0.1, **QUIET), made_anew(other).simulate(0.1, **QUIET))
    asked = diagram.replace({"plant": diagram["plant"].replace(stepping=StepOptions(communication_step=1e-3))})
    assert not shares(diagram, asked)
