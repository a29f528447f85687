"""A report of an unstable diagram says so first, with the poles, and measures nothing that does not settle."""

import time

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, SimulationError, TransferFunction
from loopwright.diagrams import Diagram, analyse, subsystem
from loopwright.diagrams.report import Case
from loopwright.diagrams.report.sections.poles import unstable_first
from loopwright.diagrams.report.stability import Stability

pytestmark = pytest.mark.usefixtures("without_drawings")

K, T = 200.0, 0.01


def servo(gain=K, sample_time=T, reference=0.0):
    """Return 4/(s(s + 2)) behind a sampled gain."""
    plant = TransferFunction(numerator=[4.0], denominator=[1.0, 2.0, 0.0], name="plant")

    @subsystem(sample_time=sample_time)
    def controller(y):
        return Gain(gain=gain, name="gain")(Constant(value=reference) - y)

    return Diagram("servo", plant(controller(plant.y).named("u")))


def poles_by_hand(gain=K):
    """Return the closed loop's poles z: the plant behind a hold, its matrix exponential written out."""
    e = np.exp(-2 * T)
    A, B = np.array([[1, (1 - e) / 2], [0, e]]), 4 * np.array([[(T - (1 - e) / 2) / 2], [(1 - e) / 2]])
    return np.linalg.eigvals(A - gain * B @ [[1, 0]])


@pytest.fixture(scope="module")
def report():
    begin = time.process_time()
    made = analyse(servo())
    assert time.process_time() - begin < 20  # it took 80 s, and then failed
    return made


def test_the_report_of_an_unstable_sampled_loop_is_made_and_begins_with_the_poles(report):
    z = max(poles_by_hand(), key=np.imag)
    s = np.log(z) / T
    first = report.sections[0].text[0]
    assert first.startswith("Unstable: as it is.")
    assert f"{s.real:.6g} ± {s.imag:.6g}j (|z| = {abs(z):.6g})" in first


def test_its_loop_says_the_same_and_its_numbers_are_there(report):
    numbers = report.numbers()
    assert numbers["inner.u.sampled_d0.stable"].value == 0.0
    assert numbers["inner.u.continuous.stable"].value == 1.0
    s = np.log(max(poles_by_hand(), key=np.imag)) / T
    (inner,) = (section for section in report.sections if section.key == "inner")
    assert any(f"{s.real:.6g} ± {s.imag:.6g}j" in text for text in inner.sections[0].text)


def test_nothing_is_injected_into_an_unstable_loop(report):
    (injection,) = (section for section in report.sections if section.key == "injection")
    assert not injection.numbers
    assert all("not stable" in text for text in injection.text)


@pytest.mark.slow
def test_a_measurement_of_an_unstable_loop_ends_where_the_signals_have_grown():
    with pytest.raises(SimulationError, match=r"controller.gain.y, t = .*grown to .*not stable") as caught:
        servo().frequency_response("u", [30.0], amplitude=1e-3)
    # from 1e-3 to 1e9 times as much at the rate of the unstable pole, and at most one window of 64 samples more
    rate = np.log(np.abs(poles_by_hand()).max()) / T
    assert caught.value.t < 3 * np.log(1e9) / rate


def test_a_stable_diagram_has_no_such_beginning():
    case = Case(servo(gain=20.0).wired)
    assert [Stability.of(v) for v in case.usable()] == [Stability.STABLE] * 3
    assert np.abs(poles_by_hand(20.0)).max() < 1
    assert unstable_first(case) is None
