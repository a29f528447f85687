"""Diagrams that are exported in tests: one that is sampled, one with continuous states and events."""

from loopwright.blocks import PID, Gain, Relay, Sine, Step, Sum, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, mass_spring_damper


@subsystem(sample_time=0.01)
def controller(wanted, level):
    """PI."""
    return PID(kp=2.0, ki=3.0)(wanted, level).named("effort")


def sampled():
    """Two rates, a delay, limits; all of it sampled."""

    @subsystem(sample_time=0.02)
    def outer(wanted, y):
        return PID(kp=1.0, ki=4.0)(wanted, y).named("inner_wanted")

    @subsystem(sample_time=0.005)
    def inner(wanted):
        before = UnitDelay(initial_value=0.0, name="before")
        made = PID(kp=0.5, ki=3.0, kd=0.01, filter_time=0.02, lower=-1, upper=1)(wanted, before.y)
        before(made)
        return made.named("u")

    @subsystem(sample_time=0.005)
    def wanted():
        return Sum(signs="++")(Step(times=0.1, values=1.0), Sine(frequency=2.0))

    made = outer(wanted(), Sine(frequency=1.0))
    return Diagram("sampled_loops", inner(made).named("out")).sampled(0.005)


def continuous():
    """A thermostat."""
    room = TransferFunction(numerator=[0.3], denominator=[1.0, 0.1], name="room")
    relay = Relay(on_point=2.0, off_point=1.0, on_value=0.0, off_value=10.0, name="relay")
    return Diagram("room", room(relay(room.y).named("heat")).named("warmth"))


def diagrams():
    """Return both."""
    return sampled(), continuous()


def mass_at_two_rates():
    """Two subsystems, at 2 and 3 ms; the mass between them, as an FMU of our own, steps at the ticks of both."""

    @subsystem(sample_time=0.002)
    def twos(y):
        return Gain(gain=-0.5)(y).named("force")

    @subsystem(sample_time=0.003)
    def threes(v):
        return Gain(gain=0.5)(v).named("v")

    plant = Fmu(mass_spring_damper.build(fmi=2), name="plant")
    return Diagram("rates", plant(force=twos(plant.position) + 1.0), threes(plant.velocity))
