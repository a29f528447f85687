"""Sections that don't apply don't appear, and the first page says what was not analysed, and why."""

from functools import cache

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator, Relay, Sine, StateSpace, TransferFunction
from loopwright.diagrams import Diagram, analyse, subsystem

PARTS = ("subject", "operating_points", "poles", "inner", "steps", "sensitivity", "injection", "limits")


def open_chain():
    """Return an integrator that nothing feeds back."""
    return Diagram("open", Integrator(name="x")(Gain(gain=2.0, name="k")(Constant(value=0.0, name="r"))).named("y"))


def static():
    return Diagram("static", Gain(gain=2.0, name="k")(Sine(frequency=1.0, name="s")).named("v"))


def channels():
    """Return a continuous loop with two channels, cut at u or y."""
    plant = StateSpace(A=[[-1.0, 0.2], [0.1, -2.0]], B=np.eye(2), C=[[1.0, 0.3], [0.2, 1.0]], name="plant")
    minus = Gain(gain=-1.0, name="minus")(plant.y.named("y"))
    return Diagram(
        "channels", plant(StateSpace(A=np.zeros((2, 2)), B=np.eye(2), C=np.eye(2), name="C")(minus).named("u"))
    )


MADE = {"open": open_chain, "static": static, "channels": channels}


@cache
def report(name):
    return analyse(MADE[name]())


def walk(sections):
    for section in sections:
        yield section
        yield from walk(section.sections)


def said(name):
    return " ".join(report(name).sections[0].text)


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("open", ["summary", "subject", "operating_points", "poles", "limits"]),
        ("static", ["summary", "subject", "operating_points", "limits"]),
        pytest.param(
            "channels",
            ["summary", "subject", "operating_points", "poles", "inner", "sensitivity", "limits"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_sections_that_do_not_apply_do_not_appear(name, keys):
    assert [section.key for section in report(name).sections] == keys


@pytest.mark.parametrize("name", MADE)
@pytest.mark.drawn(2)
def test_no_table_is_empty_and_no_section_has_nothing(name):
    for section in walk(report(name).sections):
        assert section.text or section.tables or section.plots or section.sections, section.key
        for table in section.tables:
            assert table.rows, table.title
            assert all(any(cell not in (None, "") for cell in row[1:]) for row in table.rows), table.title


def test_a_diagram_without_loops_has_plain_poles_and_its_first_page_says_that_there_are_no_margins():
    assert "no wire of this diagram lies on a loop" in said("open")
    assert "Step responses" not in said("open")
    assert "injection" not in said("open")
    assert next(s.title for s in report("open").sections if s.key == "poles") == "Poles"
    assert report("open").numbers()["poles.continuous.slowest"].value == -np.inf  # its one pole is a free motion's
    assert "drifts: nothing feeds it back" in said("open")


def test_the_first_page_says_why_steps_and_injection_are_missing():
    assert "a wire with several entries has no single one" in said("channels")
    assert "measures sampled loops, and the diagram has none" in said("channels")


@pytest.mark.slow
def test_a_relay_at_rest_has_no_margins_and_its_wire_is_not_said_to_have_several_entries():
    lag = TransferFunction(name="lag", numerator=[1.0], denominator=[1.0, 2.0, 1.0])

    @subsystem(sample_time=0.01)
    def switch(y):
        relay = Relay(on_point=0.1, off_point=-0.1, on_value=1.0, off_value=-1.0, name="relay")
        return relay(Constant(value=0.0, name="r") - y)

    diagram = Diagram("switched", lag(switch(lag.y).named("u")))
    assert [line for line in analyse(diagram).sections[0].text if "njection" in line] == [
        "- The injection check: the linear models were not measured."
    ]


def test_the_loop_as_it_is_is_measured_with_its_own_delay():
    lag = TransferFunction(name="lag", numerator=[1.0], denominator=[1.0, 2.0, 1.0])

    @subsystem(sample_time=0.05, delay=3)
    def controller(y):
        return 2.0 * (Constant(value=0.0, name="r") - y)

    numbers = analyse(Diagram("slow", lag(controller(lag.y).named("u"))), only=("injection",)).numbers()
    assert numbers["injection.u.sampled_own.deviation"].value < 1e-5
