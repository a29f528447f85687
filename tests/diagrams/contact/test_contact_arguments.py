"""Wrong arguments of a contact and its methods: errors that say what was found and expected."""

import math
from dataclasses import replace

import pytest

from loopwright.blocks import LoopwrightError, OptionError, ParameterError
from loopwright.blocks.core.errors import UnknownNameError
from support.carts import cart_contact, cart_diagram

PORTS = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt"}
NO_NUMBERS = ("a", None, 1j, [1.0, 2.0], [[1.0], [1.0, 2.0]], {"a": 1}, True, math.nan, -1.0, math.inf)


class Thing:
    """Something that is no number; its name has no address, so that all workers name the tests alike."""

    def __repr__(self):
        return "a thing"


@pytest.mark.parametrize(
    "value",
    [None, "x", [math.nan], [0.0], [], ["a"], [1.0, 0.0], [1j], {"a": 1}, Thing(), True, [[1], [1, 2]], [math.inf]],
    ids=repr,
)
@pytest.mark.drawn(4)
def test_a_direction_is_a_vector(value):
    with pytest.raises(OptionError, match="direction: found .*; expected .*vector"):
        cart_diagram().contact("cart.push", direction=value, **PORTS)


@pytest.mark.parametrize("name", ["port", "position", "velocity", "force"])
@pytest.mark.parametrize("value", [3, [], "nowhere"])
def test_names_of_ports_are_texts(name, value):
    arguments = {"port": "cart.push", "direction": [1.0], **PORTS, name: value}
    with pytest.raises(UnknownNameError):
        cart_diagram().contact(**arguments)


@pytest.mark.parametrize("value", NO_NUMBERS, ids=repr)
def test_properties_are_single_numbers(value):
    here = cart_contact()
    for held in ("damping", "mass", "tool_mass"):
        with pytest.raises(ParameterError, match=f"environment.{held}: found .*; expected one finite number in "):
            here.stability_limit(**{held: value})
    with pytest.raises(ParameterError, match="expected one finite number"):
        here.loop("stiffness", damping=value)
    with pytest.raises(ParameterError, match="expected one finite number"):
        here.stability_map([1.0, 2.0], [1.0], mass=value)


@pytest.mark.parametrize("value", ["a", 1j, [1.0, 2.0], True, math.nan, -1.0, math.inf, 0.0], ids=repr)
def test_ends_of_a_scan_are_positive_numbers(value):
    here = cart_contact()
    for call in (here.stability_limit, here.passivity):
        for name in ("low", "high"):
            with pytest.raises(OptionError, match=f"{name}: found .*; expected a positive "):
                call(**{name: value})
    with pytest.raises(OptionError, match="found a scan from 10"):
        here.passivity(low=10.0, high=1.0)
    with pytest.raises(OptionError, match=r"found a scan from 10"):
        here.stability_limit(low=10.0, high=1.0)


@pytest.mark.parametrize("value", ["a", None, 1j, [40], True, math.nan, -1, math.inf, 0, 30.5], ids=repr)
def test_points_in_a_decade_are_a_whole_number(value):
    for call in (cart_contact().stability_limit, cart_contact().passivity):
        with pytest.raises(OptionError, match="per_decade: found .* points in a decade; expected at least"):
            call(per_decade=value)


@pytest.mark.parametrize("value", [3, None, ["stiffness"], "spring", 1.0], ids=repr)
def test_properties_have_names(value):
    here = cart_contact()
    calls = [
        lambda: here.stability_limit(value),
        lambda: here.loop(value),
        lambda: here.stability_map([1.0, 2.0], [1.0], x=value),
        lambda: here.stability_map([1.0, 2.0], [1.0], y=value),
    ]
    for call in calls:
        with pytest.raises(OptionError, match="an environment has no "):
            call()


@pytest.mark.parametrize(
    "value", ["a", None, 3.0, [], [[1.0, 2.0]], [1.0, math.nan], [1.0, math.inf], [1j], [Thing()]], ids=repr
)
def test_values_of_a_map_are_rows(value):
    with pytest.raises(OptionError, match=r"stiffness: found .*; expected a row of finite values in N/m"):
        cart_contact().stability_map(value, [1.0])
    with pytest.raises(OptionError, match=r"damping: found .*; expected a row of finite values in N.s/m"):
        cart_contact().stability_map([1.0, 2.0], value)
    with pytest.raises(OptionError, match="expected none that is negative"):
        cart_contact().stability_map([1.0, 2.0], [-1.0])
    with pytest.raises(OptionError, match="expected positive ones that rise, two at least"):
        cart_contact().stability_map([1.0], [1.0])


@pytest.mark.parametrize("value", ["a", None, 1j, math.nan, -1.0, 0.0, [Thing()], math.inf], ids=repr)
def test_frequencies_are_positive_numbers(value):
    with pytest.raises(OptionError, match="omega: found .*; expected "):
        cart_contact().admittance(value)


@pytest.mark.parametrize(
    ("omega", "said"), [(3.0, "1 frequency"), ([1.0], "1 frequency"), ([1.0, 2.0], "2 frequencies")]
)
def test_an_admittance_says_at_how_many_frequencies_it_is(omega, said):
    assert said in repr(cart_contact().admittance(omega))


def test_a_limit_that_is_confirmed_is_one_of_the_contact():
    here = cart_contact()
    limit = here.stability_limit()
    for value in (3, None, "100", limit.number, limit.value, [limit]):
        with pytest.raises(OptionError, match=r"cart.limit: found .*; expected a limit of this contact"):
            here.confirm(value)
    with pytest.raises(OptionError, match="expected a finite one that is not 0"):
        here.confirm(replace(limit, value=math.inf))
    changed = cart_diagram().replace({"share.gain": 3.0}).contact("cart.push", direction=[1.0], **PORTS)
    with pytest.raises(OptionError, match="found a limit of another contact: next to it the growth rates are"):
        changed.confirm(limit)
    for push in ("a", None, math.nan, -1.0, 0.0, [1.0], math.inf):
        with pytest.raises(OptionError, match="push: found .*; expected a positive velocity in m/s"):
            here.confirm(limit, push=push)
    for method in (3, "insde", ["inside"]):
        with pytest.raises(LoopwrightError, match="method: found "):
            here.confirm(limit, method=method)


def test_position_and_velocity_are_those_of_the_ports_block_unless_others_are_named():
    names = {key: name for key, name in PORTS.items() if key not in ("position", "velocity")}
    here = cart_diagram().contact("cart.push", direction=[1.0], **names)
    assert (here.ports.position, here.ports.velocity) == ("position", "velocity")
    assert here.stability_limit().value == pytest.approx(cart_contact().stability_limit().value, rel=1e-12)


def test_a_diagram_that_knows_no_port_asks_for_its_name():
    with pytest.raises(UnknownNameError, match="found no port at which the environment pushes.*port='robot.force'"):
        cart_diagram().contact(direction=[1.0], **PORTS)
