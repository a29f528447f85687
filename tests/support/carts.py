"""A cart whose drive lags behind the force that it shows."""

from functools import cache

from loopwright.blocks import Block, Constant, Gain, Input, State, TransferFunction, parameter
from loopwright.diagrams import Diagram

M, TAU, SHARE, DRAG = 3.0, 0.02, 4.0, 8.0
"""Mass in kg, lag in s, share of the measured force that the drive adds, drag in N s/m."""


class Cart(Block):
    mass: float = parameter(default=M, unit="kg")
    motor = Input(unit="N")
    push = Input(unit="N")
    position = State(unit="m", start=0.0, output=True)
    velocity = State(unit="m/s", start=0.0, output=True)

    def derivative(self, t, x, u):
        return x.velocity, (u.motor + u.push) / self.mass


def cart_diagram(cart=None, share=SHARE):
    cart = Cart(name="cart") if cart is None else cart
    hand = Constant(value=0.0, unit="N", name="hand")
    felt = Gain(gain=1.0, name="sensor")(hand).named("felt")
    lag = TransferFunction(numerator=(1.0,), denominator=(TAU, 1.0), name="drive")
    wanted = Gain(gain=share, name="share")(felt) - Gain(gain=DRAG, name="drag")(cart.velocity)
    return Diagram("cart", cart(motor=lag(wanted), push=hand))


@cache
def cart_contact():
    ports = {"position": "cart.position", "velocity": "cart.velocity", "force": "felt"}
    return cart_diagram().contact("cart.push", direction=[1.0], **ports)
