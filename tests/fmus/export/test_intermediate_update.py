"""Intermediate update of FMI 3.0 Co-Simulation: the importer is asked at each internal step of doStep."""

import zipfile
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.fmus import build_fmu
from support.exported import D, K, M, bounces, bouncing_ball, counter, driven, exact, mass_spring_damper, thermostat
from support.instances import enter, fails, open_instance

RK4, DOPRI5, RODAS = INTEGRATORS = (1, 2, 3)


class Importer:
    """Called at each internal step with its time and whether it may return early; what it was told is in `calls`."""

    def __init__(self, instance, path, act=lambda item, t: None, **options):
        self.act, self.calls = act, []
        self.item = instance(path, intermediateUpdate=self._update, **options)

    def _update(self, environment, t, set_requested, get_allowed, finished, can_return, requested, until):
        self.calls.append((t, set_requested, get_allowed, finished, can_return))
        assert requested[0] is False
        try:
            wanted = self.act(self.item, t)
        except fmpy.fmi1.FMICallException:
            return  # what was refused; doStep says so too
        if wanted is not None:
            requested[0], until[0] = True, wanted

    @property
    def times(self):
        return [call[0] for call in self.calls]


@pytest.mark.parametrize("early", [False, True])
def test_times_and_flags(msd, instance, early):
    importer = Importer(instance, msd, earlyReturnAllowed=early)
    item = importer.item.initialize(internal_step=0.1, force=1.0)
    assert item.step(0.0, 0.35) == (False, False, False, 0.35)
    assert importer.times == pytest.approx([0.0875, 0.175, 0.2625, 0.35], rel=1e-15)
    assert importer.times[-1] == 0.35
    assert [call[1:] for call in importer.calls] == [(True, True, True, early)] * 3 + [(True, True, True, False)]


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_what_is_read_belongs_to_the_time(msd, instance, integrator):
    found = []

    def read(item, t):
        found.append((t, item["time"], item["position"], item["velocity"], item["acceleration"], item["der(velocity)"]))

    item = Importer(instance, msd, read).item
    item.initialize(integrator=integrator, internal_step=1e-3, tolerance=1e-11, force=5.0)
    item.step(0.0, 1.0)
    assert len(found) >= 1000
    for t, time, x, v, a, rate in found:
        assert time == t
        assert [x, v] == pytest.approx(list(exact(t, [0.1, 0.0], 5.0)), abs=1e-10)
        assert a == rate == pytest.approx((5.0 - D * v - K * x) / M, rel=1e-13, abs=1e-14)


@pytest.mark.drawn(4)
@pytest.mark.parametrize("make", [mass_spring_damper, driven, bouncing_ball, thermostat])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_reading_changes_no_bit(instance, make, integrator):
    """With an internal_step that bounds no adaptive step, runs with and without a callback are the same."""
    path = build_fmu(make())
    first = instance(path)
    importer = Importer(instance, path, lambda item, t: [item[name] for name in item.references][:0] or None)
    for item in (first, importer.item):
        item.initialize(integrator=integrator, internal_step=0.01 if integrator == RK4 else 10.0)
        for k in range(20):
            item.step(0.07 * k, 0.07)
    names = first.references
    assert [first[name] for name in names] == [importer.item[name] for name in names]
    assert len(importer.calls) >= 20


def wave_response(t):
    """State of the mass-spring-damper at t under the force sin(3 t), from (0.1, 0): an oscillator of its own drives it."""
    A = np.array([[0, 1, 0, 0], [-K / M, -D / M, 1 / M, 0], [0, 0, 0, 3], [0, 0, -3, 0]])
    return (expm(A * t) @ [0.1, 0.0, 0.0, 1.0])[:2]


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_an_input_set_at_each_internal_step_has_order_1(msd, instance, integrator):
    """It is held until the next one, whatever the order of the integrator: the error is that of a zero-order hold."""

    def act(item, t):
        item["force"] = np.sin(3.0 * t)

    item, counts, errors = Importer(instance, msd, act).item, (100, 200, 400, 800), []
    for n in counts:
        item.fmu.reset()
        item.initialize(integrator=integrator, internal_step=1.0 / n, tolerance=1e-6, force=0.0)
        item.step(0.0, 1.0)  # what is set at its end is the input of the next one
        item.step(1.0, 1.0)
        errors.append(np.abs([item["position"], item["velocity"]] - wave_response(2.0)).max())
    fitted = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert fitted == pytest.approx(1.0, abs=0.05), errors
    assert errors[-1] < 2e-3


def test_it_is_the_same_as_short_steps(msd, instance):
    def act(item, t):
        item["force"] = np.sin(3.0 * t)

    one = Importer(instance, msd, act).item.initialize(internal_step=0.0625, force=0.0)
    one.step(0.0, 1.0)
    many = instance(msd).initialize(internal_step=0.0625)
    for k in range(16):
        many.step(0.0625 * k, 0.0625, force=np.sin(3.0 * 0.0625 * k))
    for name in ("position", "velocity", "acceleration"):
        assert one[name] == many[name]


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(("until", "last"), [(-1.0, 0.25), (0.25, 0.25), (0.3, 0.3), (2.0, 1.0), (float("nan"), 0.25)])
def test_early_return(msd, instance, integrator, until, last):
    """At once, or at the time that is wished for, if that is before the end."""

    def act(item, t):
        return until if t >= 0.25 else None

    importer = Importer(instance, msd, act, earlyReturnAllowed=True)
    item = importer.item.initialize(integrator=integrator, internal_step=1 / 64, tolerance=1e-12, force=5.0)
    if integrator != RK4:  # its internal steps needn't meet 0.25
        item.step(0.0, 0.25)
    at = 0.0 if integrator == RK4 else 0.25
    if integrator == RK4 or until in (0.3, 2.0):
        assert item.step(at, 1.0 - at) == (False, False, last < 1.0, last)
        assert importer.times[-1] == item["time"] == last
    else:
        _, _, early, last = item.step(at, 1.0 - at)
        assert early
        assert 0.25 < last == item["time"] == importer.times[-1] <= 0.25 + 1 / 64
    assert [item["position"], item["velocity"]] == pytest.approx(list(exact(last, [0.1, 0.0], 5.0)), abs=3e-8)
    if last < 1.0:
        assert item["acceleration"] == pytest.approx((5.0 - D * item["velocity"] - K * item["position"]) / M, rel=1e-13)
        importer.act = lambda item, t: None
        assert item.step(last, 1.0 - last)[2:] == (False, last + (1.0 - last))
    assert [item["position"], item["velocity"]] == pytest.approx(list(exact(1.0, [0.1, 0.0], 5.0)), abs=3e-8)


def test_early_return_has_to_be_allowed(msd, instance):
    importer = Importer(instance, msd, lambda item, t: t)
    item = importer.item.initialize(internal_step=0.25)
    assert item.step(0.0, 1.0) == (False, False, False, 1.0)
    assert len(importer.calls) == 4


@pytest.mark.parametrize("integrator", [DOPRI5, RODAS])
@pytest.mark.parametrize("jumps", [True, False])
def test_the_adaptive_step_starts_anew_where_an_input_has_jumped(instance, integrator, jumps):
    """From there on, bit by bit what a new instance does that starts there; else the step size of before goes on."""
    path = build_fmu(driven())

    def act(item, t):
        if seen and len(importer.calls) == seen[0]:
            state.append((t, item["x"], item["y"]))
            item["u"] = 1.5 if jumps else 0.3

    state, seen = [], [7]
    importer = Importer(instance, path, act)
    item = importer.item.initialize(integrator=integrator, internal_step=10.0, u=0.3)
    item.step(0.0, 1.0)
    assert len(importer.calls) > 8
    (t, x, y), after = state[0], [time for time in importer.times if time > state[0][0]]
    other = Importer(instance, path, start_time=t)
    other.item.initialize(integrator=integrator, internal_step=10.0, u=1.5 if jumps else 0.3, x=x, y=y)
    other.item.step(t, 1.0 - t)
    same = (other.times, other.item["x"], other.item["y"]) == (after, item["x"], item["y"])
    assert same == jumps


@pytest.mark.parametrize("integrator", [DOPRI5, RODAS])
@pytest.mark.parametrize("jumps", [True, False])
def test_the_adaptive_step_starts_anew_at_a_communication_point(instance, integrator, jumps):
    path = build_fmu(driven())
    item = instance(path).initialize(integrator=integrator, u=0.3)
    item.step(0.0, 1.0)
    u = 1.5 if jumps else 0.3
    other = instance(path, start_time=1.0).initialize(integrator=integrator, u=u, x=item["x"], y=item["y"])
    item.step(1.0, 1.0, u=u)
    other.step(1.0, 1.0)
    assert ((item["x"], item["y"]) == (other["x"], other["y"])) == jumps


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_cut_run_continues_bit_identically(instance, integrator):
    path = build_fmu(driven())

    def act(item, t):
        item["u"] = np.cos(t)

    def run(item, first, last):
        for k in range(first, last):
            item.step(0.1 * k, 0.1)
        return [item[name] for name in ("time", "x", "y", "u", "der(x)")]

    items = [Importer(instance, path, act).item.initialize(integrator=integrator, internal_step=0.01) for _ in range(2)]
    whole = run(items[0], 0, 20)
    run(items[1], 0, 7)
    data = items[1].fmu.serializeFMUState(items[1].fmu.getFMUState())
    fresh = Importer(instance, path, act).item
    fresh.fmu.setFMUState(fresh.fmu.deserializeFMUState(data))
    assert run(fresh, 7, 20) == whole


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_events_inside_a_step(instance, integrator):
    """It is called at each bounce, after the jump."""
    found = []
    importer = Importer(instance, build_fmu(bouncing_ball()), lambda item, t: found.append((t, item["velocity"])))
    importer.item.initialize(integrator=integrator, internal_step=0.01)
    importer.item.step(0.0, 1.8)
    times = np.array(importer.times)
    assert (np.diff(times) >= 0.0).all()
    for when, speed in bounces(3):
        t, v = min(found, key=lambda pair, when=when: abs(pair[0] - when))
        assert t == pytest.approx(when, abs=1e-12)
        assert v == pytest.approx(speed, abs=1e-10)


def event_by_input(instance, integrator, **options):
    """The input jumps over the threshold at the internal step at 0.5."""

    def act(item, t):
        if t >= 0.5 and not item["u"]:
            item["u"] = 3.0

    spec = counter(lambda t, x, u, p, fired: [t, x[1] + 1.0], z=lambda t, x, u, p: [u[0] - 1.0])
    return Importer(instance, build_fmu(spec), act, **options)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_an_input_set_in_between_fires_events_at_once(instance, integrator):
    importer = event_by_input(instance, integrator)
    item = importer.item.initialize(integrator=integrator, internal_step=0.25)
    assert item.step(0.0, 1.0) == (False, False, False, 1.0)
    assert item["n"] == 1.0
    assert item["x"] == next(t for t in importer.times if t >= 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_an_input_set_in_between_returns_to_event_mode(instance, integrator):
    importer = event_by_input(instance, integrator, eventModeUsed=True, earlyReturnAllowed=True)
    enter(importer.item, integrator=integrator, internal_step=0.25)
    needed, terminate, early, last = importer.item.step(0.0, 1.0)
    assert (needed, terminate, early) == (True, False, True)
    assert last == importer.item["time"] == importer.times[-1] >= 0.5
    assert importer.item["n"] == 0.0
    importer.item.fmu.enterEventMode()
    importer.item.fmu.updateDiscreteStates()
    assert (importer.item["n"], importer.item["x"]) == (1.0, last)
    importer.item.fmu.enterStepMode()
    assert importer.item.step(last, 1.0 - last)[:3] == (False, False, False)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda item, t: item.fmu.doStep(t, 0.1), "fmi3DoStep was called in state Intermediate Update Mode"),
        (lambda item, t: item.fmu.getFMUState(), "fmi3GetFMUState was called in Intermediate Update Mode"),
        (lambda item, t: item.fmu.reset(), "fmi3Reset was called in Intermediate Update Mode"),
        (lambda item, t: item.fmu.terminate(), "fmi3Terminate was called in state Intermediate Update Mode"),
        (lambda item, t: item.__setitem__("damping", 1.0), "damping is a tunable parameter; set it between two steps"),
        (lambda item, t: item.__setitem__("position", 1.0), "position is a state"),
        (lambda item, t: item.__setitem__("force", float("nan")), "force (element 0) was set to nan"),
    ],
)
def test_what_is_refused_ends_the_step(msd, instance, act, message):
    """The step fails and leaves the state before it; the importer may set a state and go on."""
    importer = Importer(instance, msd)
    item = importer.item.initialize(internal_step=0.25, force=2.0)
    item.step(0.0, 1.0)
    before = [item[name] for name in item.references]
    state = item.fmu.getFMUState()
    importer.act = lambda item, t: act(item, t) if t > 1.25 else item.__setitem__("force", 9.0)
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(1.0, 1.0)
    told = [text for _, _, text in item.log if "is coarse beside the fastest mode" not in text]
    assert [text for text in told if message in text], item.log
    assert len(told) == 1
    assert importer.times[-1] == 1.5
    assert [item[name] for name in item.references] == before
    fails(item, lambda: item.step(1.0, 1.0), "called in state Terminated")
    item.fmu.setFMUState(state)
    importer.act = lambda item, t: None
    assert item.step(1.0, 1.0) == (False, False, False, 2.0)
    assert [item["position"], item["velocity"]] == pytest.approx(list(exact(2.0, [0.1, 0.0], 2.0)), abs=5e-4)


def test_discrete_inputs_are_set_between_steps(instance):
    importer = Importer(instance, build_fmu(thermostat()), lambda item, t: item.__setitem__("set_point", 22.0))
    importer.item.initialize()
    with pytest.raises(fmpy.fmi1.FMICallException):
        importer.item.step(0.0, 1.0)
    assert "set_point is a discrete input; set it between two steps" in importer.item.log[-1][2]


def test_directional_derivatives_in_between(msd, instance):
    found = []
    importer = Importer(instance, msd, lambda item, t: found.append(item.directional("acceleration", "force", [1.0])))
    importer.item.initialize().step(0.0, 0.01)
    assert found[0] == [1.0 / M]


def test_the_model_description_says_so(instance, tmp_path):
    path = build_fmu(thermostat())
    description = fmpy.read_model_description(str(path))
    assert description.coSimulation.providesIntermediateUpdate is True
    assert description.coSimulation.canReturnEarlyAfterIntermediateUpdate is True
    with zipfile.ZipFile(path) as archive:  # FMPy leaves this attribute out
        variables = ElementTree.fromstring(archive.read("modelDescription.xml")).find("ModelVariables")
    flagged = {v.get("name"): int(v.get("valueReference")) for v in variables if v.get("intermediateUpdate") == "true"}
    assert set(flagged) == {"ambient", "temperature", "power"}
    item = instance(path, requiredIntermediateVariables=list(flagged.values()))
    for reference in (item.references["set_point"], item.references["on"], 999):
        with pytest.raises(Exception, match="Failed to instantiate"):
            open_instance(path, tmp_path / f"refused-{reference}", requiredIntermediateVariables=[reference])
