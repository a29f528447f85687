"""Orders of the coupling schemes against closed forms, loops of direct feedthrough, adaptive steps."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Block,
    Compare,
    Gain,
    Integrator,
    OptionError,
    Relay,
    SimulationError,
    StopCondition,
    TransportDelay,
    parameter,
)
from loopwright.diagrams import Coupling, Diagram, subsystem
from loopwright.diagrams.coupling import step_all
from loopwright.fmus import Fmu, StepOptions
from support.oscillators import (
    PULL,
    coupled_by_inertia,
    coupled_by_inertia_exactly,
    mass,
    mass_and_filter,
    mass_and_filter_exactly,
    two_masses,
    two_masses_exactly,
)

ORDERS = [("jacobi", 1), ("gauss_seidel", 1), ("iterated", 2)]
STEPS = (1 / 50, 1 / 100, 1 / 200)


def order_of(errors):
    """Return the orders that successive errors show where the step is halved."""
    return np.log2(np.array(errors[:-1]) / errors[1:])


def relay_and_mass():
    """A mass that a relay in continuous time pulls to and fro, by the state of a filter."""
    a, state = mass("a", 0.1), Integrator(name="filter", initial_value=0.1)
    push = Relay(on_point=0.03, off_point=-0.03, on_value=-20.0, off_value=20.0, name="relay")(state.y)
    return Diagram("relay", a(force=push), state(40.0 * (a.position - state.y)))


def largest_error(diagram, exactly, signals, **options):
    run = diagram.simulate(0.5, progress=False, **options)
    return float(np.abs(np.column_stack([run[name] for name in signals]) - exactly(run.t)).max()), run


@pytest.mark.parametrize(("scheme", "order"), ORDERS)
def test_two_masses_converge_with_the_order_of_the_scheme(cache, scheme, order):
    errors = [
        largest_error(two_masses(), two_masses_exactly, ("a.position", "b.position"), step=h, coupling=scheme)[0]
        for h in STEPS
    ]
    assert order_of(errors) == pytest.approx([order, order], abs=0.2)


@pytest.mark.parametrize(("scheme", "order"), ORDERS)
@pytest.mark.drawn(1)
def test_blocks_in_continuous_time_take_part(cache, scheme, order):
    signals = ("a.position", "filter.y")
    errors = [
        largest_error(mass_and_filter(), mass_and_filter_exactly, signals, step=h, coupling=scheme)[0] for h in STEPS
    ]
    assert order_of(errors) == pytest.approx([order, order], abs=0.25)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("scheme", "order"), ORDERS[::-1])
def test_an_fmu_in_model_exchange_beside_one_in_co_simulation(cache, monkeypatch, scheme, order):
    diagram = two_masses()
    diagram = diagram.replace({"b": diagram["b"].replace(interface="model_exchange")})
    signals = ("a.position", "b.position")
    errors = [largest_error(diagram, two_masses_exactly, signals, step=h, coupling=scheme)[0] for h in STEPS[1:]]
    assert order_of(errors) == pytest.approx([order], abs=0.2)
    if scheme == "iterated":
        info = dataclasses.replace(diagram["b"].description.exchange, can_serialize=False)
        about = dataclasses.replace(diagram["b"].description, exchange=info)
        monkeypatch.setattr(Fmu, "description", property(lambda self: about))
        with pytest.raises(OptionError, match=r"^b\.coupling: .*canSerializeFMUState"):
            diagram.simulate(0.1, step=0.01, progress=False, coupling=scheme)


class Called(Block):
    """A block of a user's that a run evaluates by calls, which is no FMU."""

    in_model_exchange = True
    inner: Block = parameter(description="what is called")
    description: str = "a text of the user's"
    inputs = property(lambda self: self.inner.inputs)
    outputs = property(lambda self: self.inner.outputs)
    states = property(lambda self: self.inner.states)
    events = property(lambda self: self.inner.events)

    def dependence(self, equation):
        return self.inner.dependence(equation)

    def exchange(self, wired, *, start_time):
        return self.inner.exchange(wired, start_time=start_time)


def test_a_users_block_in_model_exchange_beside_an_fmu_in_co_simulation(cache):
    diagram = two_masses()
    called = Called(inner=diagram["b"].replace(interface="model_exchange"), name="b")
    diagram = diagram.replace({"b": called})
    signals = ("a.position", "b.position")
    errors = [largest_error(diagram, two_masses_exactly, signals, step=h, coupling="iterated")[0] for h in STEPS[1:]]
    assert order_of(errors) == pytest.approx([2], abs=0.2)
    with pytest.raises(OptionError, match="^b: found a Called, .* no FMU"):
        diagram.linearize()


@pytest.mark.parametrize("share", [0.5, 0.9, 1.5])  # plain repetition diverges from 1 on
@pytest.mark.slow
def test_iteration_solves_a_loop_of_direct_feedthrough_between_two_fmus(cache, share):
    signals = ("a.position", "b.position", "a.acceleration", "b.acceleration")
    errors = [
        largest_error(
            coupled_by_inertia(share),
            lambda t: coupled_by_inertia_exactly(share, t),
            signals,
            step=h,
            coupling="iterated",
        )[0]
        for h in (1 / 400, 1 / 800)
    ]
    assert order_of(errors) == pytest.approx([2.0], abs=0.25)
    assert errors[0] < 0.05 * np.abs(coupled_by_inertia_exactly(share, np.linspace(0, 0.5, 50))).max()


def test_a_loop_of_direct_feedthrough_is_told_where_it_is_not_solved(cache):
    run = coupled_by_inertia(0.5).simulate(0.01, step=1e-3, progress=False)
    (message,) = run.messages
    assert "a.acceleration, b.acceleration" in message
    assert "coupling='iterated'" in message
    assert not two_masses().simulate(0.01, step=1e-3, progress=False).messages


@pytest.mark.parametrize("scheme", ["jacobi", "gauss_seidel", "iterated"])
@pytest.mark.drawn(1)
def test_adaptive_steps_follow_the_allowed_error(cache, scheme):
    found = []
    for error in (1e-3, 1e-4):
        off, run = largest_error(
            two_masses(),
            two_masses_exactly,
            ("a.position", "b.position"),
            step=0.05,
            coupling=Coupling(scheme=scheme, error=error),
        )
        steps = int(run.messages[0].split(": ")[1].split()[0])
        found.append((off, steps))
        assert len(run.t) == 11  # samples stay where they are
    order = dict(ORDERS)[scheme]
    (coarse, few), (fine, many) = found
    assert fine < coarse * 10 ** (-order / (order + 1)) * 2.0  # the error of a step goes with h^(order + 1)
    assert many == pytest.approx(few * 10 ** (1 / (order + 1)), rel=0.5)
    assert fine < 100 * 1e-4


@pytest.mark.drawn(1)
@pytest.mark.parametrize("coupling", ["gauss_seidel", "iterated", Coupling(error=1e-6)], ids=str)
def test_an_fmu_under_a_sampled_controller_needs_no_coupling(cache, monkeypatch, coupling):
    monkeypatch.setattr(Fmu, "can_save", property(lambda self: False))
    plant = mass("a", 0.1)

    @subsystem(sample_time=0.01)
    def controller(y):
        return Gain(gain=-PULL, name="gain")(y)

    diagram = Diagram("d", plant(force=controller(plant.position)))
    runs = [diagram.simulate(0.5, progress=False, coupling=c) for c in ("jacobi", coupling)]
    assert runs[0]["a.position"].tolist() == runs[1]["a.position"].tolist()
    assert not runs[1].messages
    diagram.linearize(runs[1].at(0.2))  # the same model for all of them


def test_the_default_is_jacobi_to_the_last_bit(cache):
    runs = [two_masses().simulate(0.2, step=0.01, progress=False, **o) for o in ({}, {"coupling": "jacobi"})]
    assert np.array_equal(runs[0]["a.position"], runs[1]["a.position"])


@pytest.mark.drawn(1)
@pytest.mark.parametrize("coupling", [Coupling(scheme="iterated", error=1e-4), "gauss_seidel", "iterated"], ids=str)
def test_a_run_goes_on_from_a_saved_state(cache, coupling):
    with mass_and_filter().simulation(step=0.02, coupling=coupling) as simulation:
        simulation.advance(0.2)
        half = simulation.save()
        simulation.advance(0.2)
        straight = simulation.run()
    again = mass_and_filter().simulate(0.2, step=0.02, start=half, progress=False, coupling=coupling)
    assert again["a.position"].tolist() == straight["a.position"][10:].tolist()
    assert again["filter.y"].tolist() == straight["filter.y"][10:].tolist()


def test_the_order_of_gauss_seidel_is_that_of_feedthrough_or_the_one_that_is_given(cache):
    first = two_masses().simulate(
        0.1, step=0.01, progress=False, coupling=Coupling(scheme="gauss_seidel", order=("a", "b"))
    )
    other = two_masses().simulate(
        0.1, step=0.01, progress=False, coupling=Coupling(scheme="gauss_seidel", order=("b", "a"))
    )
    default = two_masses().simulate(0.1, step=0.01, progress=False, coupling="gauss_seidel")
    assert default["a.position"].tolist() == first["a.position"].tolist() != other["a.position"].tolist()


@pytest.mark.parametrize(
    ("text", "coupling"),
    [
        (r"two\.coupling: .*found scheme='gauss'\. Did you mean 'gauss_seidel'", "gauss"),
        ("found 3; expected 'jacobi', 'gauss_seidel', 'iterated' or a Coupling", 3),
        (r"found order=\('a', 'c'\)", Coupling(scheme="gauss_seidel", order=("a", "c"))),
        (r"found order=\('a',\); expected each of a, b once", Coupling(scheme="gauss_seidel", order=("a",))),
    ],
)
def test_a_coupling_that_does_not_fit_is_refused(cache, text, coupling):
    with pytest.raises(OptionError, match=text):
        two_masses().simulate(0.1, step=0.01, progress=False, coupling=coupling)


@pytest.mark.parametrize(
    "options",
    [{"scheme": "seidel"}, {"tolerance": 0.0}, {"error": -1.0}, {"passes": 1}, {"order": ("a",)}, {"shortest": np.nan}],
    ids=lambda o: next(iter(o)),
)
def test_options_of_a_coupling_are_checked(options):
    with pytest.raises(OptionError, match=next(iter(options))):
        Coupling(**options)


def test_an_fmu_that_can_not_go_back_is_named(cache, monkeypatch):
    monkeypatch.setattr(Fmu, "can_save", property(lambda self: False))
    with pytest.raises(OptionError, match=r"^a\.coupling: found coupling 'iterated', .*canGetAndSetFMUState"):
        two_masses().simulate(0.1, step=0.01, progress=False, coupling="iterated")
    two_masses().simulate(0.1, step=0.01, progress=False, coupling="gauss_seidel")
    monkeypatch.undo()
    monkeypatch.setattr(Fmu, "variable_step", property(lambda self: False))
    with pytest.raises(OptionError, match=r"adaptive communication steps.*canHandleVariableCommunicationStepSize"):
        two_masses().simulate(0.1, step=0.01, progress=False, coupling=Coupling(error=1e-3))


def test_an_iteration_that_does_not_converge_says_where_and_by_how_much(cache):
    coupling = Coupling(scheme="iterated", passes=2, tolerance=1e-12)
    with pytest.raises(
        SimulationError, match=r"does not converge: after 2 passes .* still changes by .* of its size"
    ) as e:
        two_masses().simulate(0.1, step=0.02, progress=False, coupling=coupling)
    assert (e.value.block, e.value.port, e.value.t) == ("a", "position", 0.0)
    assert e.value.run is not None


def test_a_step_that_gets_too_short_says_so(cache):
    with pytest.raises(SimulationError, match=r"the step would be .* s; expected at least 0\.01 s \(shortest\)") as e:
        two_masses().simulate(0.1, step=0.02, progress=False, coupling=Coupling(error=1e-9, shortest=0.01))
    assert e.value.t == 0.0


def test_slopes_of_inputs_make_the_default_second_order_and_go_with_no_other_scheme(cache):
    diagram = two_masses(fmi=2)
    told = {path: diagram[path].replace(stepping=StepOptions(input_derivatives=True)) for path in ("a", "b")}
    diagram = diagram.replace(told)
    signals = ("a.position", "b.position")
    errors = [largest_error(diagram, two_masses_exactly, signals, step=h)[0] for h in STEPS[1:]]
    assert order_of(errors) == pytest.approx([2.0], abs=0.2)
    for scheme in ("gauss_seidel", "iterated"):  # of first order with them
        with pytest.raises(OptionError, match=r"^a\.coupling: found input_derivatives with coupling"):
            diagram.simulate(0.1, step=0.01, progress=False, coupling=scheme)
    with pytest.raises(OptionError, match=r"^a\.stepping: found input_derivatives .* inputs are ramps"):
        diagram.linearize(step=0.01)
    assert len(diagram.linearize().poles) == 4  # in continuous time nothing is held


def test_a_linear_model_over_steps_is_that_of_the_default_coupling(cache):
    """Both masses go a step with the force of its beginning: the transition is written down by hand."""
    h, M = 0.02, np.zeros((4, 4))
    for first, m, sign in ((0, 1.0, 1.0), (2, 2.0, -1.0)):
        big = np.zeros((3, 3))
        big[:2] = [[0.0, 1.0, 0.0], [-100.0 / m, -1.0 / m, 1.0 / m]]
        whole = expm(big * h)
        M[first : first + 2, first : first + 2] = whole[:2, :2]
        M[first : first + 2] += np.outer(whole[:2, 2], sign * PULL * np.array([-1.0, 0.0, 1.0, 0.0]))
    model = two_masses().linearize(step=h)
    found = np.sort_complex([z for z in model.poles if abs(z) > 1e-9])
    assert found == pytest.approx(np.sort_complex(np.linalg.eigvals(M)), abs=1e-9)
    run = two_masses().simulate(0.2, step=h, progress=False)
    expected = [np.linalg.matrix_power(M, k) @ [0.1, 0.0, 0.0, 0.0] for k in range(11)]
    assert run["b.position"] == pytest.approx([x[2] for x in expected], rel=1e-6, abs=1e-10)


def test_fmus_of_fmi_2_and_3_are_coupled_alike(cache):
    runs = [two_masses(fmi).simulate(0.1, step=0.01, progress=False, coupling="iterated") for fmi in (2, 3)]
    assert runs[0]["a.position"] == pytest.approx(runs[1]["a.position"], rel=1e-12)


def test_a_linear_model_over_steps_takes_the_coupling_of_its_point(cache):
    diagram = two_masses()
    run = diagram.simulate(0.1, step=0.01, progress=False, coupling="gauss_seidel")
    ahead, again = run.at(0.05), diagram.operating_point(0.05, step=0.01, coupling="gauss_seidel")
    one, other = (diagram.linearize(point, step=0.01).poles for point in (ahead, again))
    assert one == pytest.approx(other, abs=1e-12)
    plain = diagram.linearize(diagram.operating_point(0.05, step=0.01), step=0.01).poles
    assert np.abs(plain[:, None] - one[None, :]).min(axis=0).max() > 1e-5
    free = diagram.linearize(run.at(0.05))  # in continuous time: no coupling acts
    assert len(free.poles) == 4


# --- FMUs in processes of their own ----------------------------------------------------------------------------------------


@pytest.mark.drawn(1)
@pytest.mark.parametrize("coupling", ["iterated", "jacobi", "gauss_seidel"])
def test_fmus_in_processes_of_their_own_give_the_bits_of_those_in_this_one(cache, coupling):
    apart = two_masses().replace(
        {"a": two_masses()["a"].replace(isolate=True), "b": two_masses()["b"].replace(isolate=True)}
    )
    here, there = (d.simulate(0.1, step=0.01, progress=False, coupling=coupling) for d in (two_masses(), apart))
    assert here["a.position"].tolist() == there["a.position"].tolist()
    assert here["b.velocity"].tolist() == there["b.velocity"].tolist()


class Apart:
    """A plant in a process of its own, as its calls look from here."""

    class fmi:  # noqa: N801
        in_process = False

    def __init__(self, name, calls, fails=""):
        self.name, self.calls, self.fails = name, calls, fails

    def start_step(self, t, h):
        self.calls.append(f"start {self.name}")
        if self.fails == "start":
            raise SimulationError("no", block=self.name)

    def finish_step(self):
        self.calls.append(f"finish {self.name}")
        if self.fails == "finish":
            raise SimulationError("no", block=self.name)


def test_all_steps_begin_before_one_is_waited_for():
    calls = []
    step_all([Apart("a", calls), Apart("b", calls)], 0.0, 0.1)
    assert calls == ["start a", "start b", "finish a", "finish b"]


@pytest.mark.parametrize(
    ("fails", "calls_made"),
    [
        (("finish", ""), ["start a", "start b", "finish a", "finish b"]),
        (("", "start"), ["start a", "start b", "finish a"]),
    ],
)
def test_a_step_that_has_begun_is_ended_where_another_one_fails(fails, calls_made):
    calls = []
    with pytest.raises(SimulationError, match="no"):
        step_all([Apart("a", calls, fails[0]), Apart("b", calls, fails[1])], 0.0, 0.1)
    assert calls == calls_made


# --- events, stops and delays within a step ------------------------------------------------------------------------------


@pytest.mark.slow
def test_events_within_a_repeated_step_happen_once(cache):
    """The relay switches within steps, by whose jump every scheme is of first order there; shorter steps find it."""
    fine = relay_and_mass().simulate(0.5, step=1e-3, progress=False, coupling="iterated")
    told = relay_and_mass().simulate(0.5, step=1e-3, progress=False)
    assert len(told.events) == len(fine.events) == 2
    for coupling, off in (("iterated", 0.02), (Coupling(scheme="iterated", error=1e-4), 0.002)):
        run = relay_and_mass().simulate(0.5, step=1e-2, progress=False, coupling=coupling)
        assert [e.event for e in run.events] == [e.event for e in fine.events]
        assert [e.t for e in run.events] == pytest.approx([e.t for e in fine.events], abs=off)


@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    "coupling", ["iterated", "jacobi", "gauss_seidel", Coupling(scheme="iterated", error=1e-4)], ids=str
)
def test_a_stop_condition_between_two_ticks_ends_the_run_in_any_coupling(cache, coupling):
    a, state = mass("a", 0.1), Integrator(name="filter")
    stop = StopCondition(name="stop")(Compare(relation=">", name="above")(state.y, 0.05))
    diagram = Diagram("d", a(force=-PULL * state.y), state(20.0 * (a.position - state.y)), stop)
    run = diagram.simulate(1.0, step=0.01, progress=False, coupling=coupling)
    assert run.stopped is not None
    times = np.linspace(0.0, 0.2, 20001)
    expected = times[np.argmax(mass_and_filter_exactly(times)[:, 1] > 0.05)]
    assert run.stopped.t == pytest.approx(expected, abs=0.01)
    assert run.t[-1] == run.stopped.t


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "order"), ORDERS[::-1])
def test_a_transport_delay_between_two_fmus_keeps_the_order(cache, scheme, order):
    """The second mass feels the first one, which nothing drives, 0.1 s later."""
    a, b = mass("a", 0.1), mass("b")
    late = TransportDelay(delay=0.1, name="late")(a.position)
    diagram = Diagram("d", a(force=0.0), b(force=Gain(gain=PULL, name="spring")(late)))
    both = np.zeros((4, 4))
    both[:2, :2] = both[2:, 2:] = np.array([[0.0, 1.0], [-100.0, -1.0]])
    both[3, 0] = PULL

    def exactly(times):
        return np.array([(expm(both * max(0.0, t - 0.1)) @ [0.1, 0.0, 0.0, 0.0])[2:3] for t in times])

    errors = [largest_error(diagram, exactly, ("b.position",), step=h, coupling=scheme)[0] for h in STEPS[1:]]
    assert order_of(errors) == pytest.approx([order], abs=0.3)


def test_states_that_were_gone_back_to_are_freed(cache, monkeypatch):
    from loopwright.fmus.calls import FmuInstance

    counts, restore = [], FmuInstance.restore
    monkeypatch.setattr(
        FmuInstance, "restore", lambda self, state: (counts.append(len(self.states.kept)), restore(self, state))[1]
    )
    two_masses().simulate(0.2, step=0.01, progress=False, coupling=Coupling(scheme="iterated", error=1e-5))
    assert len(counts) > 100
    assert max(counts) <= 4
