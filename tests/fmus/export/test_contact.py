"""Contact in exported FMUs: reached or started at, it is contact, in both versions and all interfaces."""

import casadi as ca
import fmpy
import numpy as np
import pytest

from loopwright.fmus import build_fmu
from support.exported import G, bouncing_ball
from support.instances import fails

RESTS = "the event bounce rests in contact at t = "


def to_floor(**changes):
    """The ball, but its jump takes it to the floor."""
    jump = {"jump": lambda t, x, u, p, fired: [0.0, ca.if_else(fired[0], -p[1] * x[1], x[1])]}
    return bouncing_ball(**(jump | changes))


@pytest.fixture(scope="module", params=[3, 2], ids=["fmi3", "fmi2"])
def fmi(request):
    return request.param


@pytest.fixture(scope="module", params=[to_floor, bouncing_ball])
def path(fmi, request):
    return build_fmu(request.param(), fmi=fmi)


@pytest.mark.drawn(2)
@pytest.mark.parametrize("integrator", [1, 2, 3])
@pytest.mark.parametrize("h", [1.0, 0.01])
def test_an_inelastic_impact_rests_in_contact_and_says_so(path, instance, integrator, h):
    item = instance(path).initialize(e=0.0, integrator=integrator)

    def run():
        for k in range(round(1.0 / h)):
            item.step(k * h, h)

    with pytest.raises(fmpy.fmi1.FMICallException):
        run()
    message = item.log[-1][2]
    assert RESTS in message
    assert "state of rest" in message
    assert float(message.split("t = ")[1].split(" s")[0]) == pytest.approx(np.sqrt(2.0 / G), abs=1e-6)
    assert item["height"] >= 0.0


@pytest.mark.drawn(12)
@pytest.mark.parametrize("integrator", [1, 2, 3])
@pytest.mark.parametrize("speed", [-2.0, -0.01, 0.5])
def test_a_start_on_the_floor_is_an_impact_if_it_moves_down(path, instance, integrator, speed):
    item = instance(path).initialize(height=0.0, velocity=speed, e=0.5, integrator=integrator)
    up = -0.5 * speed if speed < 0.0 else speed
    h = 1.5 * up / G  # the first flight takes 2 up / g
    item.step(0.0, h)
    assert item["height"] == pytest.approx(up * h - G / 2 * h**2, abs=1e-10)
    assert item["velocity"] == pytest.approx(up - G * h, abs=1e-9)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("speed", [0.0, -0.5])
def test_a_start_on_the_floor_without_a_way_out_is_a_rest(path, instance, speed):
    item = instance(path).initialize(height=0.0, velocity=speed, e=0.0)
    with pytest.raises(fmpy.fmi1.FMICallException):
        item.step(0.0, 1.0)
    assert RESTS + "0 s" in item.log[-1][2] or float(item.log[-1][2].split("t = ")[1].split(" s")[0]) < 1e-6


@pytest.mark.slow
def test_an_importer_sees_an_indicator_leave_the_border(path, exchange):
    me = exchange(path).start(height=0.0, velocity=-1.0, e=0.5)
    assert me.z[0] == pytest.approx(1e-10)  # on the border, from where it can only fall
    me.set(1e-6, [-1e-6, -1.0])
    assert me.z[0] < 0.0
    assert me.event() == [(False, True)]
    assert me.x[1] == 0.5


@pytest.mark.drawn(2)
def test_an_inelastic_impact_in_model_exchange_rests(path, exchange):
    """The ball falls, is stopped, and falls again from where it is: each time an event, until that is an error."""
    me, t = exchange(path).start(e=0.0), 0.4
    me.set(t, [-1e-9, -3.0])
    assert me.event() == [(False, True)]
    for _ in range(19):
        height, velocity = me.x
        assert velocity == 0.0
        assert me.z[0] > 0.0
        t += 1e-5
        me.set(t, [height - G / 2 * 1e-10, -G * 1e-5])
        assert me.z[0] < 0.0
        assert me.event() == [(False, True)]
    me.set(t + 1e-5, [me.x[0] - G / 2 * 1e-10, -G * 1e-5])
    fails(me.item, me.event, "rests in contact")


def test_contact_is_part_of_a_saved_state(path, instance):
    first = instance(path).initialize(height=0.0, velocity=-1.0, e=0.5)
    second = first.copied_to(instance(path).initialize())
    for item in (first, second):
        item.step(0.0, 0.05)
    assert second["height"] == first["height"] == pytest.approx(0.5 * 0.05 - G / 2 * 0.05**2, abs=1e-10)
