"""Events of exported FMUs inside doStep; models whose events are none."""

from dataclasses import replace

import casadi as ca
import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from loopwright.blocks.core.errors import DefinitionError, ParameterError
from loopwright.fmus import Variable, build_fmu
from loopwright.fmus.export.model_spec import EventSpec
from support.exported import E, G, ball, bouncing_ball, counter, heating, mass_spring_damper, relay, thermostat

INTEGRATORS = (1, 2, 3)


@pytest.fixture(scope="module")
def ball_fmu(cache):
    return build_fmu(bouncing_ball())


@pytest.fixture(scope="module")
def thermostat_fmu(cache):
    return build_fmu(thermostat())


# ---- inside doStep ----


@pytest.mark.parametrize("make", [bouncing_ball, thermostat])
def test_valid(make):
    assert validate_fmu(str(build_fmu(make()))) == []


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("h", [2.2, 0.55, 0.01])
def test_bounces_are_those_of_the_closed_form(ball_fmu, instance, integrator, h):
    item = instance(ball_fmu).initialize(integrator=integrator)
    for k in range(round(2.2 / h)):
        item.step(k * h, h)
        height, velocity = ball((k + 1) * h)
        assert item["height"] == pytest.approx(height, abs=1e-11)
        assert item["velocity"] == pytest.approx(velocity, abs=1e-11)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("h", [20.0, 0.1])
def test_a_hysteresis_against_its_closed_form(thermostat_fmu, instance, integrator, h):
    """The switch is a discrete state; the error is the integrator's, over ten events."""
    item = instance(thermostat_fmu).initialize(integrator=integrator, internal_step=0.01, tolerance=1e-12)
    for k in range(round(20.0 / h)):
        item.step(k * h, h)
        temperature, on = heating((k + 1) * h)
        assert item["temperature"] == pytest.approx(temperature, abs=1e-9)
        assert (item["on"], item["power"]) == (on, 3.0 * on + 5.0)


def test_the_order_of_rk4_survives_events(thermostat_fmu, instance):
    """Events are located in the cubic interpolant, as exact as the method."""
    item, steps, errors = instance(thermostat_fmu), 2.0 ** -np.arange(1, 5), []
    for step in steps:
        item.fmu.reset()
        item.initialize(internal_step=step)
        item.step(0.0, 20.0)
        errors.append(abs(item["temperature"] - heating(20.0)[0]))
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(4.0, abs=0.3), errors


@pytest.mark.parametrize("integrator", [2, 3])
def test_the_error_across_events_follows_the_tolerance(thermostat_fmu, instance, integrator):
    item = instance(thermostat_fmu)
    for tolerance in (1e-5, 1e-7, 1e-9):
        item.fmu.reset()
        item.initialize(integrator=integrator, tolerance=tolerance)
        item.step(0.0, 20.0)
        assert item["temperature"] == pytest.approx(heating(20.0)[0], abs=100.0 * tolerance)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_zeno_is_an_error_that_names_the_event(ball_fmu, instance, integrator):
    item = instance(ball_fmu).initialize(integrator=integrator)
    item.step(0.0, 1.0)
    before = [item[name] for name in ("time", "height", "velocity", "bounce.indicator")]
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(1.0, 5.0)
    message = item.log[-1][2]
    assert "the event bounce fires faster and faster" in message or "the event bounce rests in contact" in message
    limit = np.sqrt(2.0 / G) * (1.0 + 2.0 * E / (1.0 - E))
    assert float(message.split("t = ")[1].split(" s")[0]) == pytest.approx(limit, abs=1e-8)
    assert [item[name] for name in ("time", "height", "velocity", "bounce.indicator")] == before


@pytest.mark.parametrize("e", [0.1, 0.3, 0.9])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_no_ball_falls_through_the_floor(ball_fmu, instance, integrator, e):
    """Rounding must not lose a bounce before the bounces are too near for time to tell them apart."""
    item = instance(ball_fmu).initialize(integrator=integrator, e=e)
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 20.0)
    message = item.log[-1][2]
    assert "the event bounce fires faster and faster" in message or "the event bounce rests in contact" in message


def test_chattering_is_an_error(instance):
    item = instance(build_fmu(relay())).initialize(width=0.0)
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 1.0)
    assert "fires faster and faster" in item.log[-1][2]
    assert "t = 0.5 s" in item.log[-1][2]


def test_too_many_events_are_an_error(instance):
    """4e4 reversals a second: 10000 of them after 0.25 s."""
    item = instance(build_fmu(relay())).initialize(width=1.25e-5, integrator=2, x=0.0)
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 1.0)
    message = item.log[-1][2]
    assert "more than 10000 events within one communication step, the last " in message
    assert float(message.split("t = ")[1].split(" s")[0]) == pytest.approx(0.25, abs=1e-4)
    item.fmu.reset()
    item.initialize(width=1.25e-5, integrator=2, x=0.0)
    for k in range(5):  # in shorter steps it goes on
        item.step(0.1 * k, 0.1)
    assert abs(item["x"]) <= 1.25e-5


def test_an_input_that_jumps_fires_at_the_communication_point(instance):
    """Each change of domain counts, in the declared direction alone: units, tens and hundreds of n."""
    spec = counter(
        lambda t, x, u, p, fired: [x[0], x[1] + fired[0] + 10.0 * fired[1] + 100.0 * fired[2]],
        z=lambda t, x, u, p: [x[0] + u[0] - 1.0] * 3,
        events=(EventSpec("reached", "both"), EventSpec("risen", "rising"), EventSpec("fallen", "falling")),
    )
    item = instance(build_fmu(spec)).initialize()
    found = []
    for k, u in enumerate((2.0, 3.0, 0.0, 2.0)):
        item.step(float(k), 1.0, u=u)
        found.append(item["n"])
    assert found == [11, 11, 112, 123]


def test_initialization_fires_nothing(instance):
    spec = counter(lambda t, x, u, p, fired: [x[0], x[1] + fired[0]])
    item = instance(build_fmu(spec)).initialize(u=5.0)
    item.step(0.0, 1.0)
    assert item["n"] == 0.0


@pytest.mark.slow
def test_a_jump_may_fire_again_and_events_at_one_instant_fire_at_once(instance):
    """The first jump lifts x over the second threshold: 10 n + m counts both events, in two iterations."""
    spec = counter(
        lambda t, x, u, p, fired: [x[0] + fired[0], 10.0 * x[1] + fired[0] + 2.0 * fired[1] + 4.0 * fired[2]],
        z=lambda t, x, u, p: [u[0] - 1.0, x[0] - 0.5, u[0] - 1.0],
        events=(EventSpec("input"), EventSpec("state"), EventSpec("twin", "rising")),
    )
    item = instance(build_fmu(spec)).initialize()
    item.step(0.0, 1.0, u=2.0)
    assert (item["x"], item["n"]) == (1.0, 52.0)  # input and twin (5), then the state that the jump has moved (2)


def wrong_jumps():
    """Each jump moves x to the other side, or, with v = 1, makes n no number."""

    def jump(t, x, u, p, fired):
        other = ca.if_else(ca.logic_and(fired[0], u[1] == 0), ca.if_else(x[0] + u[0] > 1, -10.0, 10.0), x[0])
        return [other, x[1] / (1.0 - fired[0] * u[1])]

    return counter(jump)


def test_an_endless_iteration_is_an_error(instance):
    item = instance(build_fmu(wrong_jumps())).initialize()
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 1.0, u=2.0)
    assert "the events reached fire again and again at t = 0 s: 100 iterations at one instant" in item.log[-1][2]
    assert (item["x"], item["n"], item["time"]) == (0.0, 0.0, 0.0)


def test_a_jump_to_no_number_is_an_error(instance):
    item = instance(build_fmu(wrong_jumps())).initialize(v=1.0)
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 1.0, u=2.0)
    assert "n (element 0) became" in item.log[-1][2]
    assert item["reached.indicator"] == pytest.approx(-1.0 - 1e-10, rel=0, abs=1e-12)  # its domain too is as before


def touch():
    """z = u - (t - 1)^2: above zero for a short time only, within one step."""
    return counter(
        lambda t, x, u, p, fired: [x[0], x[1] + fired[0]],
        z=lambda t, x, u, p: [u[0] - (t - 1.0) ** 2],
        events=(EventSpec("reached", "falling"),),
    )


@pytest.mark.drawn(1)
@pytest.mark.parametrize("integrator", [2, 3])
@pytest.mark.parametrize(("height", "expected"), [(1e-2, 1), (1e-8, 1), (1e-12, 1), (-1e-12, 0)])
def test_a_short_excursion_is_not_missed(instance, integrator, height, expected):
    item = instance(build_fmu(touch())).initialize(integrator=integrator, u=height)
    item.step(0.0, 3.1)
    assert item["n"] == expected


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_run_that_is_cut_between_events_continues_bit_identically(thermostat_fmu, instance, integrator):
    def on(item, n):
        for k in range(n, n + 30):
            item.step(k * 0.5, 0.5, ambient=float(k % 7))
        return [item[name] for name in ("time", "temperature", "on", "power", "too_warm.indicator")]

    item = instance(thermostat_fmu).initialize(integrator=integrator, internal_step=0.05)
    on(item, 0)
    state = item.fmu.getFMUState()
    data = item.fmu.serializeFMUState(state)
    item.fmu.freeFMUState(state)
    expected = on(item, 30)
    fresh = instance(thermostat_fmu)
    state = fresh.fmu.deserializeFMUState(data)
    fresh.fmu.setFMUState(state)
    fresh.fmu.freeFMUState(state)
    assert on(fresh, 30) == expected


def test_a_tunable_parameter_acts_between_steps(ball_fmu, instance):
    item = instance(ball_fmu).initialize(integrator=2)
    item.step(0.0, 0.2)
    item.step(0.2, 0.6, e=0.5)
    assert [item["height"], item["velocity"]] == pytest.approx(list(ball(0.8, 0.5)), abs=1e-12)


# ---- models that are no such ----


@pytest.mark.parametrize(
    ("make", "error", "parts"),
    [
        (lambda: EventSpec("a b"), DefinitionError, ["event name 'a b'"]),
        (lambda: EventSpec("a", "up"), DefinitionError, ["the event a has direction 'up'", "both, rising, falling"]),
        (lambda: EventSpec("a", nominal=0.0), ParameterError, ["the event a has nominal 0.0"]),
        (lambda: Variable("x", nominal=-1.0), ParameterError, ["x has nominal -1.0, expected a positive number"]),
        (lambda: Variable("y", "output", "discrete"), DefinitionError, ["y is discrete, but neither input nor state"]),
        (lambda: Variable("tolerance"), DefinitionError, ["'tolerance' is reserved"]),
        (lambda: replace(bouncing_ball(), events=()), DefinitionError, ["found indicators and jump, but no events"]),
        (
            lambda: bouncing_ball(events=(EventSpec("a"), EventSpec("b"))),
            DefinitionError,
            ["bouncing_ball.indicators", "column of 2"],
        ),
        (lambda: replace(bouncing_ball(), jump=None), DefinitionError, ["bouncing_ball.jump", "(t, x, u, p, fired)"]),
        (
            lambda: replace(thermostat(), states=thermostat().states[::-1]),
            DefinitionError,
            ["the states on, temperature", "the discrete ones (on) after all others"],
        ),
        (
            lambda: replace(
                mass_spring_damper(),
                states=(
                    *mass_spring_damper().states,
                    Variable("d", "local", "discrete", unit="1", start=0, state=True),
                ),
            ),
            DefinitionError,
            ["found discrete states, but no events"],
        ),
        (
            lambda: replace(
                bouncing_ball(),
                events=(EventSpec("bounce"),),
                outputs=(Variable("bounce.indicator", "output", unit="m"),),
                output=bouncing_ball().indicators,
            ),
            DefinitionError,
            ["'bounce.indicator' names 2 variables"],
        ),
    ],
)
def test_bad_models_are_refused(make, error, parts):
    with pytest.raises(error) as caught:
        make()
    for part in parts:
        assert part in str(caught.value)
