"""A plant with states that no output shows."""

from loopwright.blocks import Block, Input, State, parameter


class Hidden(Block):
    """A speed with a PI-controlled lag, and more states inside that no output shows."""

    growth: float = parameter(default=0.0)
    frequency: float = parameter(default=0.0)
    u = Input()
    y = State(output=True)
    angle = State()
    a = State()
    b = State()

    def derivative(self, t, x, u):
        return (
            u.u - x.y,
            x.y,
            self.growth * x.a + self.frequency * x.b,
            self.growth * x.b - self.frequency * x.a,
        )
