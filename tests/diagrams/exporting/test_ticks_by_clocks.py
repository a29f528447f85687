"""FMI 3.0's Event Mode: an importer makes the ticks of an exported diagram by its input clocks (2.2.9, 2.3.5, 4.2.1)."""

import ctypes
import zipfile
from xml.etree import ElementTree

import fmpy.fmi3
import fmpy.validation
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from loopwright import Fmu, build
from loopwright.blocks import Gain, Step, Sum, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import StepOptions
from support import exported_diagrams
from support.instances import open_instance

KP, KI, T = 2.0, 3.0, 0.01  # of exported_diagrams.controller


class Clocked:
    """An instance in Event Mode: the importer's own scheduler of its periodic input clocks."""

    def __init__(self, file, folder, **options):
        self.item = open_instance(file, folder, eventModeUsed=True, **options)
        self.fmu = self.item.fmu
        with zipfile.ZipFile(file) as archive:
            clocks = [c.attrib for c in ElementTree.fromstring(archive.read("modelDescription.xml")).iter("Clock")]
        self.clocks = {
            c["name"]: (int(c["valueReference"]), float(c["intervalDecimal"]), float(c.get("shiftDecimal", 0)))
            for c in clocks
        }

    def due(self, t):
        """The clocks that tick at a time, by what the description says."""
        found = []
        for reference, interval, shift in self.clocks.values():
            count = (t - shift) / interval
            if count > -1e-9 and abs(count - round(count)) < 1e-9:
                found.append(reference)
        return found

    def activate(self, t):
        due = self.due(t)
        if due:
            self.fmu.setClock(due, [True] * len(due))

    def begin(self):
        """Initialize; Event Mode follows."""
        self.item.begin()
        return self

    def leave(self):
        self.fmu.updateDiscreteStates()
        self.fmu.enterStepMode()

    def step(self, t, h):
        found = self.fmu.doStep(t, h)
        self.fmu.enterEventMode()
        return found


def closed_loop(delay, n):
    """y and u of a PI controller on 1/(s + 1) with a hold, at the ticks; with a delay u acts one tick later."""
    a = np.exp(-T)
    # x = (y, I, u of the tick before), r = 1: u = kp (r − y) + I, I⁺ = I + ki T (r − y), y⁺ = a y + (1 − a) (u or that before)
    u = np.array([-KP, 1.0, 0.0, KP])
    acting = np.array([0.0, 0.0, 1.0, 0.0]) if delay else u
    A = np.array([a * np.eye(4)[0] + (1 - a) * acting, [-KI * T, 1.0, 0.0, KI * T], u, [0.0, 0.0, 0.0, 1.0]])
    x, found = np.array([0.0, 0.0, KP * delay, 1.0]), []  # what is put out at the start acts until the first tick
    for _ in range(n):
        found.append((x[0], u @ x))
        x = A @ x
    return np.array(found)


def test_values_that_are_exchanged_at_a_tick_belong_to_that_tick(tmp_path):
    """Controller and plant get each other's values at once: in Event Mode there is no sample of delay, without there is."""
    file = build(exported_diagrams.controller, clocks=True)
    a, n = np.exp(-T), 100
    clocked = Clocked(file, tmp_path).begin()
    item, y, seen = clocked.item, 0.0, []
    for k in range(n):
        item["wanted"], item["level"] = 1.0, y
        clocked.activate(k * T)
        u = item["effort"]  # both have their values before either continues
        seen.append((y, u))
        clocked.leave()
        clocked.step(k * T, T)
        y = a * y + (1 - a) * u
    item.free()
    np.testing.assert_allclose(seen, closed_loop(0, n), rtol=1e-12)
    item, y, seen = open_instance(file, tmp_path / "steps").initialize(wanted=1.0), 0.0, []
    for k in range(n):
        item["level"] = y
        u = item["effort"]
        seen.append((y, u))
        item.step(k * T, T)
        y = a * y + (1 - a) * u
    item.free()
    np.testing.assert_allclose([y for y, _ in seen], closed_loop(1, n)[:, 0], rtol=1e-12)
    assert np.max(np.abs(closed_loop(1, n) - closed_loop(0, n))) > 5e-3


@subsystem(sample_time=0.02)
def slow_rate(v):
    """Sum of what it has read."""
    total, before = Sum(signs="++"), UnitDelay(initial_value=0.0)
    made = total(v, before.y)
    before(made)
    return made


@subsystem(sample_time=0.01, offset=0.005)
def fast_rate(v):
    return Gain(gain=2.0)(v)


@subsystem
def rates(u):
    """Two rates, of which one begins later, and their sum."""
    return Sum(signs="++")(slow_rate(u).named("total"), fast_rate(u).named("doubled")).named("both")


@pytest.mark.slow
def test_clocks_have_the_intervals_and_shifts_of_the_subsystems(tmp_path):
    file = build(rates, clocks=True)
    assert fmpy.validation.validate_fmu(str(file)) == []
    clocked = Clocked(file, tmp_path).begin()
    assert sorted(c[1:] for c in clocked.clocks.values()) == [(0.01, 0.005), (0.02, 0.0)]
    variables = {v.name: v for v in clocked.item.description.modelVariables}
    about = {name: v.description for name, v in variables.items() if v.type == "Clock"}
    assert sorted(about.values()) == ["Ticks of fast_rate", "Ticks of slow_rate"]
    (state,) = [v for v in variables.values() if v.causality == "local" and v.initial == "exact"]
    assert [about[c.name] for c in state.clocks] == ["Ticks of slow_rate"]
    references = [c[0] for c in clocked.clocks.values()]
    vr = (ctypes.c_uint32 * 2)(*references)
    intervals, shifts, qualifiers = (ctypes.c_double * 2)(), (ctypes.c_double * 2)(), (ctypes.c_int * 2)()
    counters, resolutions = (ctypes.c_uint64 * 2)(), (ctypes.c_uint64 * 2)()
    clocked.fmu.getIntervalDecimal(vr, intervals, qualifiers)
    clocked.fmu.getShiftDecimal(vr, shifts)
    assert list(zip(intervals, shifts, strict=True)) == [c[1:] for c in clocked.clocks.values()]
    assert list(qualifiers) == [1, 1]  # fmi3IntervalUnchanged
    clocked.fmu.getIntervalFraction(vr, counters, resolutions, qualifiers)
    assert [n / d for n, d in zip(counters, resolutions, strict=True)] == list(intervals)
    clocked.fmu.getShiftFraction(vr, counters, resolutions)
    assert [n / d for n, d in zip(counters, resolutions, strict=True)] == list(shifts)
    clocked.item.free()


@pytest.mark.slow
def test_every_rate_ticks_at_its_own_instants(tmp_path):
    """The input is the time: the sum is that of the multiples of 0.02 s, the product twice the last (k + 1/2) 0.01 s."""
    clocked = Clocked(build(rates, clocks=True), tmp_path).begin()
    item, h = clocked.item, 0.005
    for k in range(100):
        t = k * h
        item["u"] = t
        clocked.activate(t)
        clocked.leave()
        assert item["total"] == pytest.approx(sum(0.02 * i for i in range(k // 4 + 1)), rel=1e-13)
        assert item["doubled"] == pytest.approx(2.0 * (t if k % 2 else max(t - h, 0.0)), rel=1e-13)
        clocked.step(t, h)
    item.free()


@pytest.mark.slow
def test_what_is_read_in_event_mode_is_not_taken_over_before_the_update(tmp_path):
    """An importer solves an algebraic loop by setting and reading; I grows by the last error alone."""
    clocked = Clocked(build(exported_diagrams.controller, clocks=True), tmp_path).begin()
    item = clocked.item
    item["wanted"] = 1.0
    clocked.activate(0.0)
    for level in (0.7, -3.0, 0.4):
        item["level"] = level
        assert item["effort"] == pytest.approx(KP * (1.0 - level), rel=1e-15)
        assert item["pid.integral"] == 0.0
    clocked.leave()
    assert item["pid.integral"] == pytest.approx(KI * T * 0.6, rel=1e-15)
    assert item["effort"] == pytest.approx(KP * 0.6, rel=1e-15)  # held
    item["level"] = 0.0  # a change between ticks does nothing
    clocked.step(0.0, 0.004)
    assert item["effort"] == pytest.approx(KP * 0.6, rel=1e-15)
    item.free()


@pytest.mark.slow
def test_a_saved_state_has_what_was_activated(tmp_path):
    clocked = Clocked(build(exported_diagrams.controller, clocks=True), tmp_path).begin()
    item = clocked.item
    item["wanted"] = 1.0
    clocked.activate(0.0)
    state = item.fmu.getFMUState()
    clocked.leave()
    first = item["pid.integral"]
    clocked.step(0.0, T)
    item.fmu.setFMUState(state)
    item.fmu.freeFMUState(state)
    assert item.fmu.getClock([clocked.clocks["clock"][0]]) == [True]
    clocked.leave()
    assert item["pid.integral"] == first == pytest.approx(KI * T, rel=1e-15)
    clocked.step(0.0, T)
    assert item.fmu.getClock([clocked.clocks["clock"][0]]) == [False]
    item.free()


def loop_with_plant():
    """A sampled controller with its plant, which is integrated."""
    plant = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="plant")

    @subsystem
    def whole(wanted):
        return plant(exported_diagrams.controller(wanted, plant.y)).named("level")

    return whole


@pytest.mark.slow
def test_ticks_by_clocks_are_those_within_the_fmu(tmp_path):
    """The plant is inside, so that the order of exchange can't matter: the loop in closed form, both ways."""
    file = build(loop_with_plant(), tolerance=1e-10, clocks=True)
    clocked = Clocked(file, tmp_path).begin()
    plain = open_instance(file, tmp_path / "plain").initialize(wanted=1.0)
    item, expected = clocked.item, closed_loop(0, 60)
    item["wanted"] = 1.0
    for k in range(60):
        clocked.activate(k * T)
        clocked.leave()
        assert item["level"] == pytest.approx(expected[k, 0], rel=1e-8, abs=1e-12)
        assert item["controller.effort"] == pytest.approx(expected[k, 1], rel=1e-8)
        clocked.step(k * T, T)
        plain.step(k * T, T)
        assert item["level"] == plain["level"]
    item.free()
    plain.free()


@pytest.mark.slow
def test_a_jump_of_an_input_is_seen_in_event_mode(tmp_path):
    """A diagram with continuous states, whose output follows its input directly: y = x + 3 u, and x = 1 − e^(−t)."""

    @subsystem
    def direct(u):
        held = subsystem(sample_time=0.1, name="held")(lambda v: Gain(gain=1.0)(v))(u)
        x = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="lag")(held)
        return Sum(signs="++")(x, Gain(gain=3.0)(u)).named("y")

    clocked = Clocked(build(direct, clocks=True), tmp_path).begin()
    item = clocked.item
    item["u"] = 1.0
    clocked.activate(0.0)
    clocked.leave()
    clocked.step(0.0, 0.05)
    for u in (1.0, -2.0):
        item["u"] = u
        assert item["y"] == pytest.approx(1.0 - np.exp(-0.05) + 3.0 * u, rel=1e-6)
    clocked.leave()
    item["u"] = 1.0
    clocked.step(0.05, 0.05)
    assert item["y"] == pytest.approx(1.0 - np.exp(-0.1) + 3.0, rel=1e-6)
    item.free()


@pytest.mark.slow
def test_a_step_beyond_a_tick_ends_there_or_is_refused(tmp_path):
    file = build(exported_diagrams.controller, clocks=True)
    clocked = Clocked(file, tmp_path, earlyReturnAllowed=True).begin()
    clocked.activate(0.0)
    clocked.leave()
    assert clocked.step(0.0, 0.025) == (True, False, True, 0.01)  # event handling is needed, no end, early return
    clocked.activate(0.01)
    clocked.leave()
    assert clocked.step(0.01, 0.01) == (False, False, False, 0.02)
    clocked.item.free()
    clocked = Clocked(file, tmp_path / "none").begin()
    clocked.activate(0.0)
    clocked.leave()
    with pytest.raises(FMICallException):
        clocked.fmu.doStep(0.0, 0.025)
    found = clocked.item.log[-1][2]
    assert "passes the tick at 0.01 s of clock" in found
    assert "eventModeUsed = fmi3False" in found
    clocked.item.free()


@pytest.mark.slow
def test_activations_that_do_not_fit_are_named(tmp_path):
    clocked = Clocked(build(rates, clocks=True), tmp_path).begin()
    item, references = clocked.item, {c[1]: c[0] for c in clocked.clocks.values()}

    def refused(call, *parts):
        with pytest.raises(FMICallException):
            call()
        for part in parts:
            assert part in item.log[-1][2]
        item.fmu.reset()
        clocked.begin()

    refused(lambda: item.fmu.setClock([references[0.01]], [True]), "activated at t = 0 s", "next at 0.005 s")
    refused(lambda: item.fmu.setClock([0], [True]), "no clock with value reference 0")
    item.fmu.setClock([references[0.02]], [True])
    refused(lambda: item.fmu.setClock([references[0.02]], [False]), "can't be deactivated")
    item.fmu.setClock([references[0.02]], [True])
    refused(item.fmu.enterStepMode, "clocks are active")
    item.fmu.setClock([references[0.02]], [True])
    item.fmu.updateDiscreteStates()
    refused(lambda: item.fmu.setClock([references[0.02]], [True]), "next at 0.02 s")
    item.free()
    three = subsystem(
        lambda u: Sum(signs="++")(slow_rate(u), subsystem(sample_time=0.04, name="c")(lambda v: Gain(gain=1.0)(v))(u))
    )
    clocked = Clocked(build(three, name="three", clocks=True), tmp_path / "three").begin()
    item, references = clocked.item, {c[1]: c[0] for c in clocked.clocks.values()}
    item.fmu.setClock([references[0.04]], [True])
    refused(item.fmu.updateDiscreteStates, "are not active: clock_1", "one tick together")
    item.free()


@pytest.mark.slow
def test_without_clocks_there_is_no_event_mode(tmp_path):
    for options in ({"fmi": 2, "clocks": True}, {}):
        about = fmpy.read_model_description(str(build(exported_diagrams.controller, **options)))
        assert not [v for v in about.modelVariables if v.type == "Clock"]
        assert not getattr(about.coSimulation, "hasEventMode", False)
    plain = build(exported_diagrams.controller)
    with pytest.raises(Exception, match="instantiate"):
        open_instance(plain, tmp_path, eventModeUsed=True)


@pytest.mark.slow
@pytest.mark.parametrize("event_mode", [None, True])
def test_here_ticks_are_where_the_diagram_says(event_mode):
    """With the clocks of Event Mode and without, with the inputs of the instant; what is read comes a step later."""
    fmu = Fmu(build(rates, clocks=True), name="fmu", stepping=StepOptions(event_mode=event_mode))
    run = Diagram("here", fmu(u=Step(times=0.1, values=1.0))).simulate(0.3, step=0.005, progress=False)
    expected = np.cumsum(np.where(np.arange(61) % 4 == 0, run.t >= 0.1 - 1e-9, 0.0))
    np.testing.assert_allclose(run["fmu.both"][1:], expected[:-1] + np.where(run.t[:-1] > 0.1, 2.0, 0.0), atol=1e-12)
