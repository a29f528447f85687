"""The wire of a contact's measured force behind delays, filters, gains and slower clocks."""

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import Constant, Gain, OptionError, TransferFunction
from loopwright.diagrams import Diagram, subsystem
from support.carts import Cart

M, DRAG, SHARE, T = 2.0, 60.0, 3.0, 2e-3
PORTS = {"position": "cart.position", "velocity": "cart.velocity"}


def bare_diagram(scale=None, cell=False):
    """The cart without a sensor: the drive reads the force on it, which is scaled on its way to the cart."""
    cart, hand = Cart(mass=M, name="cart"), Constant(value=0.0, unit="N", name="hand")

    @subsystem(sample_time=T)
    def drive(velocity, felt):
        return Gain(gain=SHARE, name="share")(felt) - Gain(gain=DRAG, name="drag")(velocity)

    felt = Gain(gain=1, name="cell")(hand) if cell else hand
    push = hand if scale is None else Gain(gain=scale, name="scale")(hand)
    return Diagram("cart", cart(motor=drive(cart.velocity, felt), push=push))


def diagram(sensor, delay=0, slow=T, wired=True):
    """A cart whose drive amplifies the measured force, sampled by T, and damps it; the sensor is sampled by ``slow``."""
    cart, hand = Cart(mass=M, name="cart"), Constant(value=0.0, unit="N", name="hand")
    other = hand if wired else Constant(value=0.0, unit="N", name="other")

    @subsystem(sample_time=slow, delay=delay)
    def sensors(push):
        return sensor(push).named("felt")

    @subsystem(sample_time=T)
    def drive(velocity, felt):
        return Gain(gain=SHARE, name="share")(felt) - Gain(gain=DRAG, name="drag")(velocity)

    return Diagram("cart", cart(motor=drive(cart.velocity, sensors(other)), push=hand))


def growth(k, gain=1.0, late=0, decay=0.0, slow=T):
    """Growth in 1/s over the states position, velocity, and the filter's or the delayed force."""
    A, B = np.array([[0.0, 1.0], [-k / M, 0.0]]), np.array([[0.0], [1.0 / M]])
    held = expm(T * np.block([[A, B], [np.zeros((1, 3))]]))
    columns = []
    for p, v, kept in np.eye(3):
        felt = -gain * k * p
        used = kept if late or decay else felt
        for _ in range(round(slow / T)):
            p, v, _ = held @ [p, v, SHARE * used - DRAG * v]
        columns.append([p, v, felt if late else decay * kept + (1.0 - decay) * felt])
    return math.log(np.max(np.abs(np.linalg.eigvals(np.transpose(columns))))) / slow


LAG = 0.01
CASES = {
    "at once": ({"sensor": Gain(gain=1.0, name="cell")}, {}, "felt"),
    "delay": ({"sensor": Gain(gain=1.0, name="cell"), "delay": 1}, {"late": 1}, "hand.y"),
    "gain": ({"sensor": Gain(gain=0.5, name="cell")}, {"gain": 0.5}, "hand.y"),
    "filter": (
        {"sensor": TransferFunction(numerator=[1.0], denominator=[LAG, 1.0], name="cell")},
        {"decay": math.exp(-T / LAG)},
        "hand.y",
    ),
    "slow": ({"sensor": Gain(gain=1.0, name="cell"), "slow": 5 * T}, {"slow": 5 * T}, "hand.y"),
    "slow, other wire": (
        {"sensor": Gain(gain=1.0, name="cell"), "slow": 5 * T, "wired": False},
        {"slow": 5 * T},
        "felt",
    ),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.drawn(1)
def test_the_environments_force_takes_the_way_of_the_force_on_the_plant(case):
    options, expected, entry = CASES[case]
    here = diagram(**options).contact("cart.push", force="felt", direction=[1.0], **PORTS)
    assert here.entry.rpartition(".")[2] == entry.rpartition(".")[2]
    limit = here.stability_limit()
    value = brentq(lambda k: growth(k, **expected), 0.9 * limit.value, 1.1 * limit.value, xtol=1e-300, rtol=1e-13)
    assert limit.value == pytest.approx(value, rel=1e-8)
    assert limit.growth_below < 0.0 < limit.growth_above


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_such_limits_hold_in_the_run(case):
    options, expected, _ = CASES[case]
    here = diagram(**options).contact("cart.push", force="felt", direction=[1.0], **PORTS)
    found = here.confirm(here.stability_limit())
    for trial in found.trials:
        assert trial.predicted == pytest.approx(growth(trial.value, **expected), rel=1e-5)
        assert trial.measured == pytest.approx(trial.predicted, rel=0.05)


@pytest.mark.parametrize(
    ("options", "block"),
    [
        ({"sensor": Gain(gain=1.0, name="cell"), "delay": 1}, "delay"),
        ({"sensor": TransferFunction(numerator=[1.0], denominator=[LAG, 1.0], name="cell")}, "sensors.cell"),
    ],
)
def test_states_to_which_the_force_on_the_plant_does_not_lead_are_refused(options, block):
    made = diagram(wired=False, **options)
    name = "sensors.cell.y" if block == "sensors.cell" else "felt"
    with pytest.raises(OptionError, match=rf"behind the states of '.*{block}.*force=….*force=None"):
        made.contact("cart.push", force=name, direction=[1.0], **PORTS)


def test_the_wire_ahead_of_a_delay_passes_the_delay():
    made = diagram(Gain(gain=1.0, name="cell"), delay=1)
    ahead, behind = (
        made.contact("cart.push", force=name, direction=[1.0], **PORTS) for name in ("sensors.cell.y", "felt")
    )
    assert (ahead.entry, behind.entry) == ("sensors.cell.y", "hand.y")
    assert ahead.stability_limit().value == pytest.approx(behind.stability_limit().value, rel=1e-10)


def test_a_continuous_filter_of_the_force_is_on_the_way():
    cart, hand = Cart(mass=M, name="cart"), Constant(value=0.0, unit="N", name="hand")
    felt = TransferFunction(numerator=[1.0], denominator=[LAG, 1.0], name="cell")(hand).named("felt")
    drive = Gain(gain=SHARE, name="share")(felt) - Gain(gain=DRAG, name="drag")(cart.velocity)
    here = Diagram("cart", cart(motor=drive, push=hand)).contact("cart.push", force="felt", direction=[1.0], **PORTS)
    # (LAG s + 1)(M s² + DRAG s + k) + SHARE k = 0, by Routh: (M + LAG DRAG)(DRAG + LAG k) = LAG M k (1 + SHARE)
    k = (M + LAG * DRAG) * DRAG / (LAG * M * (1 + SHARE) - LAG * (M + LAG * DRAG))
    assert here.entry == "hand.y"
    assert here.stability_limit().value == pytest.approx(k, rel=1e-9)


# --- the force on the plant, measured on its own wire -------------------------------------------------------------------


def is_limit(limit):
    value = brentq(growth, 0.9 * limit.value, 1.1 * limit.value, xtol=1e-300, rtol=1e-13)
    assert limit.value == pytest.approx(value, rel=1e-8)


def test_the_force_on_the_plant_is_measured_on_its_own_wire():
    here = bare_diagram().contact("cart.push", force="hand.y", direction=[1.0], **PORTS)
    assert here.entry == "hand.y"
    limit = here.stability_limit()
    is_limit(limit)
    for trial in here.confirm(limit).trials:
        assert trial.measured == pytest.approx(growth(trial.value), rel=0.01)


def test_the_advice_for_a_force_that_leads_to_the_plant_through_a_block_can_be_followed():
    with pytest.raises(OptionError, match=r"is read by drive.share.u, scale.u; .*name='cell'.*force='cell.y'"):
        bare_diagram(scale=2.0).contact("cart.push", force="hand.y", direction=[1.0], **PORTS)
    here = bare_diagram(scale=2.0, cell=True).contact("cart.push", force="cell.y", direction=[1.0], **PORTS)
    assert here.entry == "cell.y"
    is_limit(here.stability_limit())
