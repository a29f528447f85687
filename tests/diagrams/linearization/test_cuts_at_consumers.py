"""Loops cut at one consumer of a wire, and cuts that separate a controller from its own tracking."""

import control
import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    DefinitionError,
    Function,
    Gain,
    Input,
    Integrator,
    OptionError,
    Output,
    Saturation,
    Sum,
    TransferFunction,
    UnknownNameError,
    WiringError,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization import CutFromTracking, InertConsumer
from loopwright.frequency import margins

KP, KI = 3.0, 2.0
PLANT = [1.0], [4.0, 5.0, 1.0]
T = 0.05


def level(sample_time=None):
    """A level loop: a PI controller that tracks the true opening of a valve."""
    tank = TransferFunction(numerator=PLANT[0], denominator=PLANT[1], name="tank")
    valve = Saturation(limit=4.0, name="valve")

    def controller(r, y):
        pid = PID(kp=KP, ki=KI, tracking=True, tracking_time=0.5, name="pid")
        return valve(pid(r, y, valve.y).named("u")).y

    box = controller if sample_time is None else subsystem(sample_time=sample_time)(controller)
    return Diagram("level", tank(box(Constant(value=0.0, name="r"), tank.y).named("opening")))


def by_hand(sample_time=None):
    """Return the phase margin of P C with python-control."""
    plant, pi = control.tf(*PLANT), control.tf([KP, KI], [1.0, 0.0])
    if sample_time is not None:
        plant = control.sample_system(control.ss(plant), sample_time, method="zoh")
        pi = control.tf([KP, KI * sample_time - KP], [1.0, -1.0], sample_time)
    if sample_time is None:
        return control.margin(plant * pi)[1]
    return control.stability_margins(plant * pi, method="frd")[1]  # its polynomials are ill-conditioned


@pytest.mark.parametrize("sample_time", [None, T])
@pytest.mark.drawn(1)
def test_the_loop_to_the_plant_alone_leaves_the_tracking_closed(sample_time):
    model = level(sample_time).linearize()
    one = margins(model.loop("opening", to="tank.u"))
    assert one.phase_margin_deg.value == pytest.approx(by_hand(sample_time), abs=1e-6)
    assert one.findings == ()
    names = dict(level(sample_time).names)
    box = names["opening"].block.rpartition(".")[0]
    for wire in ("opening", "u"):
        whole = margins(model.loop(wire))
        assert whole.phase_margin_deg.value == np.inf  # another question: the controller with its own tracking
        (finding,) = whole.findings
        assert isinstance(finding, CutFromTracking)
        path = f"{box}.pid".strip(".")
        assert (finding.block, finding.port, finding.output) == (path, "actual", "u")
        assert (finding.offered, finding.to) == ("opening", ("tank.u",))
        assert whole.phase_margin_deg.findings == (finding,)
        assert str(finding).endswith("For the loop without it take loop('opening', to='tank.u').")


def test_a_cut_behind_the_plant_leaves_the_tracking_alone():
    model = level().linearize()
    found = margins(model.loop("tank.y"))
    assert found.findings == ()
    assert found.phase_margin_deg.value == pytest.approx(by_hand(), abs=1e-6)
    to = margins(model.loop("tank.y", to="pid.y"))
    assert to.phase_margin_deg.value == pytest.approx(by_hand(), abs=1e-6)


@pytest.mark.slow
def test_a_report_cuts_at_the_plant_and_leaves_the_tracking_closed():
    margin = level().report(only=("inner",)).numbers()["inner.opening.continuous.phase_margin_deg"]
    assert margin.value == pytest.approx(by_hand(), abs=1e-6)
    assert margin.findings == ()


def two_ways():
    """x' = −2 x − 3 f(x), both ways from one wire."""
    x = Integrator(name="x")
    wire = x.y.named("wire")
    ways = Sum(signs="--", name="sum")(Gain(gain=2.0, name="a")(wire), Gain(gain=3.0, name="b")(wire))
    return Diagram("two", x(ways))


def test_a_cut_at_one_of_several_consumers_leaves_the_others_closed():
    model = two_ways().linearize()
    s = 0.7j
    assert model.loop("wire")(s) == pytest.approx(5.0 / s)
    assert model.loop("wire", to="a.u")(s) == pytest.approx(2.0 / (s + 3.0))
    assert model.loop("wire", to=["b.u"])(s) == pytest.approx(3.0 / (s + 2.0))
    assert model.loop("wire", to=["a.u", "b.u"])(s) == pytest.approx(5.0 / s)


def test_parts_of_a_vector_go_to_their_consumers():
    x = Integrator(initial_value=np.zeros(2), name="x")

    @subsystem(sample_time=T)
    def box(x):
        return Function(lambda a, b: np.stack([-2.0 * a, -4.0 * b]), name="f")(x[0], x[1])

    model = Diagram("d", x(box(x.y).named("u"))).linearize()
    z = np.exp(0.4j)
    assert model.loop("x.y[2]", to="box.f.b")(z) == pytest.approx(4.0 * T / (z - 1.0), rel=1e-12)
    assert model.loop("u", to="x.u")(z) == pytest.approx(model.loop("u")(z), rel=1e-12)


def test_a_consumer_from_which_nothing_follows_is_named():
    x = Integrator(name="x")
    wire = x.y.named("wire")
    product = Function(lambda u, v: u * v, name="product")(wire, Constant(value=0.0, name="off"))
    d = Diagram("d", x(Sum(signs="--", name="sum")(Gain(gain=2.0, name="a")(wire), product)))
    L = d.linearize().loop("wire")
    assert L.findings == (InertConsumer("wire", "product", "u", ("a.u",)),)
    assert L(1.0j) == pytest.approx(2.0 / 1.0j)


def test_mistakes_name_what_was_found_and_a_next_step():
    model = two_ways().linearize()
    with pytest.raises(UnknownNameError, match=r"there is no input 'a.y'"):
        model.loop("wire", to="a.y")
    with pytest.raises(
        WiringError, match=r"^x\.u: found sum\.y wired to it; expected 'wire'.*its consumers: a\.u, b\.u"
    ):
        model.loop("wire", to="x")  # its only input
    with pytest.raises(OptionError, match="found 2 wires with to=…; expected one"):
        model.loop("wire", "sum.y", to="a.u")
    with pytest.raises(DefinitionError, match="found tracks='v'; expected an output of this block"):

        class Wrong(Block):
            """Tracks nothing."""

            u = Input()
            actual = Input(tracks="v")
            y = Output()


def test_a_loop_ahead_of_a_consumer_is_shown_with_the_names_that_were_asked_for():
    loop = level(T).linearize().loop("opening", to="tank.u")
    assert repr(loop).startswith("<loop at opening → tank.u: ")
    assert "loop at opening → tank.u" in loop._repr_html_()
