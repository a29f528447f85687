"""Tools beyond force sensors, where a diagram has several: one is that of the contact, or none is."""

import pytest

from loopwright.blocks import Block, Constant, ForceSensor, Gain, Input, OptionError, Output, State
from loopwright.diagrams import Diagram

M, DRAG, LAG, SHARE, OTHER, OTHER_TOOL = 2.0, 60.0, 0.01, -0.5, 0.2, 0.4
PORTS = {"position": "plate.position", "velocity": "plate.velocity", "direction": [0.6, 0.8]}


class Plate(Block):
    motor = Input(shape=(2,), unit="N")
    push = Input(shape=(2,), unit="N")
    position = State(shape=(2,), unit="m", start=(0.0, 0.0), output=True)
    velocity = State(shape=(2,), unit="m/s", start=(0.0, 0.0), output=True)
    acceleration = Output(shape=(2,), unit="m/s2")

    def derivative(self, t, x, u):
        return x.velocity, (u.motor + u.push) / M

    def output(self, t, x, u):
        return (u.motor + u.push) / M


class Lag(Block):
    u = Input(shape=(2,), unit="N")
    y = State(shape=(2,), unit="N", start=(0.0, 0.0), output=True)

    def derivative(self, t, x, u):
        return (u.u - x.y) / LAG


def diagram(tool=0.1, other_feels=False, turned=False, share=SHARE):
    """A plate whose drive takes two sensors; the other one is on a wire of its own, or on that of the force, too."""
    plate, hand = Plate(name="plate"), Constant(value=(0.0, 0.0), unit="N", name="hand")
    still = hand if other_feels else Constant(value=(0.0, 0.0), unit="N", name="still")
    acceleration = Gain(gain=-1.0, name="turned")(plate.acceleration) if turned else plate.acceleration
    felt = ForceSensor(name="sensor", tool_mass=tool)(hand, acceleration).named("felt")
    more = ForceSensor(name="other", tool_mass=OTHER_TOOL)(still, plate.acceleration)
    wanted = Gain(gain=share, name="share")(felt) + Gain(gain=OTHER, name="other_share")(more)
    lag = Lag(name="lag")(wanted)
    return Diagram("plate", plate(motor=lag.y - Gain(gain=DRAG, name="drag")(plate.velocity), push=hand))


def routh(k, tool, share=SHARE, other=0.0):
    """(LAG s + 1)(M s² + DRAG s + k) + share (tool s² + k) + OTHER OTHER_TOOL s² + other k: positive where it is stable."""
    return second(tool, share) * (DRAG + LAG * k) - LAG * M * (1.0 + share + other) * k


def second(tool, share=SHARE):
    return M + LAG * DRAG + share * tool + OTHER * OTHER_TOOL


def test_another_tool_is_that_of_the_contacts_sensor_alone():
    here = diagram().contact("plate.push", force="felt", **PORTS)
    assert here.parts.tool.sensor == "sensor"
    k = 3e4
    limit = here.stability_limit("tool_mass", stiffness=k)
    expected = (M + LAG * DRAG + OTHER * OTHER_TOOL - LAG * M * (1.0 + SHARE) * k / (DRAG + LAG * k)) / -SHARE
    assert limit.value == pytest.approx(expected, rel=1e-9)
    assert abs(routh(k, expected)) < 1e-9 * k
    found = here.confirm(limit)  # it was refuted: the run gave the other sensor that tool, too
    assert found.below.measured < 0.0 < found.above.measured


@pytest.mark.parametrize("seed", [7, 14])
def test_a_drift_across_grows_by_no_rounding(seed, disturbance):
    with disturbance.on(seed):  # the pole of the position across, 0, came out as 4e-14: the limit was 0
        limit = diagram().contact("plate.push", force="felt", **PORTS).stability_limit("tool_mass", stiffness=3e4)
    expected = (second(0.0) - LAG * M * (1.0 + SHARE) * 3e4 / (DRAG + LAG * 3e4)) / -SHARE
    assert limit.value == pytest.approx(expected, rel=1e-9)


def test_a_force_that_two_sensors_feel_acts_on_both():
    here = diagram(other_feels=True, share=2.0).contact("plate.push", force="felt", **PORTS)
    assert here.entry == "hand.y"
    limit = here.stability_limit()
    value = second(0.1, 2.0) * DRAG / (LAG * (M * (3.0 + OTHER) - second(0.1, 2.0)))
    assert abs(routh(value, 0.1, 2.0, OTHER)) < 1e-9 * value
    assert limit.value == pytest.approx(value, rel=1e-9)
    found = here.confirm(limit)
    assert found.below.measured < 0.0 < found.above.measured
    with pytest.raises(OptionError, match=r"sensor.tool_mass: found another way from 'hand.y' .*'sensor.tool_mass'"):
        here.stability_limit("tool_mass")


def test_a_tool_whose_acceleration_is_not_the_plants_is_not_varied():
    here = diagram(turned=True).contact("plate.push", force="felt", **PORTS)
    with pytest.raises(OptionError, match=r"its acceleration is not that of plate.velocity; .*sensor.tool_mass"):
        here.stability_limit("stiffness", tool_mass=0.2)
    assert here.stability_limit("stiffness").value > 0.0


def test_a_wire_of_two_sensors_does_not_tell_whose_tool_it_is():
    made = diagram(other_feels=True).contact("plate.push", force="hand.y", **PORTS)
    with pytest.raises(OptionError, match=r"found the force sensors 'other', 'sensor' on the ways of 'hand.y'"):
        made.stability_limit("tool_mass")
