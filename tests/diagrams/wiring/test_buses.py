"""Buses: subsystems that take and return mappings of signals; `Demux` and `Mux`."""

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Constant,
    Demux,
    Gain,
    Input,
    Integrator,
    Mux,
    Output,
    ParameterError,
    ShapeError,
    Stack,
    Step,
    UnitError,
    UnknownNameError,
    WiringError,
)
from loopwright.diagrams import Diagram, DuplicateNameError, subsystem


@subsystem
def plant(bus):
    """A mass, 0.5 kg: its speed and its position."""
    speed = Integrator(name="speed")(2.0 * (bus["force"] + bus["wind"]))
    position = Integrator(name="position")(speed)
    return {"speed": speed, "axis": {"position": position.named("place"), "force": bus.force}}


@subsystem(sample_time=0.01)
def controller(goal, measured):
    error = goal - measured["axis"]["position"]
    return {"force": 4.0 * error - 3.0 * measured.speed, "error": error}


def closed():
    position = Gain(gain=1.0, name="back")
    moving = plant({"force": position.y, "wind": Step(times=0.5, values=0.1, name="wind")})
    made = controller(Constant(value=1.0, name="goal"), moving)
    return Diagram("drive", position(made.force), made["error"].named("error"), moving["axis"]["position"])


def test_a_loop_of_buses_is_that_of_single_signals():
    @subsystem
    def plain(force, wind):
        speed = Integrator(name="speed")(2.0 * (force + wind))
        return speed, Integrator(name="position")(speed).named("place")

    @subsystem(sample_time=0.01)
    def pd(goal, speed, position):
        error = goal - position
        return 4.0 * error - 3.0 * speed, error

    back = Gain(gain=1.0, name="back")
    speed, position = plain(back.y, Step(times=0.5, values=0.1, name="wind"))
    force, error = pd(Constant(value=1.0, name="goal"), speed, position)
    single = Diagram("drive", back(force), error.named("error"))
    for name in ("error", "plant.place"):
        runs = [d.simulate(2.0, progress=False) for d in (closed(), single)]
        assert runs[0][name].tolist() == runs[1][name.replace("plant", "plain")].tolist()
    models = [d.linearize(inputs=["wind.y"], outputs=["error"]).system for d in (closed(), single)]
    assert np.array_equal(models[0].A, models[1].A)


def test_ports_have_the_names_of_the_signals():
    diagram = closed()
    assert diagram.wired.structure.subsystems["plant"].inputs == ("force", "wind")
    assert diagram.wired.structure.subsystems["plant"].outputs == ("speed", "axis_position", "axis_force")
    assert diagram.wired.structure.subsystems["controller"].inputs == ("goal", "speed", "axis_position", "axis_force")
    assert "axis_position" in diagram._repr_svg_()
    assert closed().simulate(0.1, record=["plant.place"], progress=False)["plant.place"].shape == (11,)


def test_a_name_that_is_taken_comes_after_its_bus():
    @subsystem
    def both(force, first, second):
        return first.force + second.force + force

    a, b, c = (Constant(value=v, name=n) for v, n in ((1.0, "a"), (20.0, "b"), (300.0, "c")))
    diagram = Diagram("d", both(c, {"force": a}, {"force": b}).named("y"))
    assert diagram.wired.structure.subsystems["both"].inputs == ("force", "first_force", "second_force")
    assert diagram.simulate(0.1, step=0.1, progress=False)["y"][-1] == 321.0


def test_a_bus_is_a_mapping():
    seen = []

    @subsystem
    def look(bus):
        seen.append(bus)
        return {**bus, "force": 2.0 * bus["force"]}

    out = look({"force": Constant(value=1.0), "speed": Constant(value=2.0)})
    (bus,) = seen
    assert (list(bus), len(bus), "speed" in bus, bus.get("place")) == (["force", "speed"], 2, True, None)
    assert repr(bus) == "<bus of force, speed>"
    assert {"force", "speed"} <= set(dir(bus))
    run = Diagram("d", Stack()(u1=out["force"], u2={**out}["speed"])).simulate(0.1, step=0.1, progress=False)
    assert run["stack.y"][-1].tolist() == [2.0, 2.0]
    again = Diagram("d", look.replace(name="again")(look({"force": Constant(value=1.0)})).bus)
    assert len(again.wired.structure.subsystems) == 3


def test_a_bus_of_one_signal_stands_for_it():
    @subsystem
    def named(u):
        return {"y": u + 1.0}

    run = Diagram("d", named.replace(name="again")(named(Constant(value=1.0))).y.named("z")).simulate(
        0.1, step=0.1, progress=False
    )
    assert run["z"][-1] == 3.0


@pytest.mark.parametrize(
    ("wrong", "error", "text"),
    [
        (lambda bus: bus["sped"], UnknownNameError, r"box: the bus has no signal 'sped'\. Did you mean 'speed'"),
        (lambda bus: bus.sped, UnknownNameError, r"box: the bus has no signal 'sped'\. Did you mean 'speed'"),
        (lambda bus: Gain(gain=1.0)(bus), WiringError, r"found a bus of 2 signals \(speed, force\).*bus\['speed'\]"),
        (lambda bus: bus + 1.0, WiringError, r"found a bus of 2 signals"),
        (lambda bus: {"a": {}}, WiringError, r"box: found a bus without signals"),
        (lambda bus: {"a b": bus.speed}, WiringError, r"box: found the name 'a b'; expected letters"),
        (lambda bus: {"a": {"b": bus.speed}, "a_b": bus.force}, DuplicateNameError, r"two signals are called 'a_b'"),
        (lambda bus: {"a": "speed"}, WiringError, r"box\.a: found 'speed'; expected a signal"),
    ],
)
def test_mistakes_are_named(wrong, error, text):
    def box(bus):
        return wrong(bus)

    with pytest.raises(error, match=text):
        subsystem(box)({"speed": Constant(value=1.0), "force": Constant(value=2.0)})


def test_a_subsystem_may_put_nothing_out():
    @subsystem
    def box(u):
        Gain(gain=2.0, name="inner")(u)
        return {}

    run = Diagram("d", box(Constant(value=1.0))).simulate(0.1, step=0.1, progress=False)
    assert run["inner"][-1] == 2.0


# --- mux and demux -----------------------------------------------------------------------------------------------------


class Twist(Block):
    """Two units."""

    u = Input()
    y = Output(shape=(3,), unit=("m/s", "m/s", "rad/s"))

    def output(self, t, x, u):
        return np.stack([u.u, 2.0 * u.u, 3.0 * u.u])


def test_a_demux_takes_a_vector_apart_and_a_mux_joins_its_parts():
    twist = Twist()(1.0)
    velocity, rate = Demux((2, 1))(twist)
    demux = Demux(3, name="three")
    run = Diagram("d", Mux()(rate, velocity).named("y"), rate.named("rate"), demux(twist), demux.y3.named("last"))
    run = run.simulate(0.1, step=0.1, progress=False)
    assert run["y"][-1].tolist() == [3.0, 1.0, 2.0]
    assert (run.unit("rate"), run.unit("three.y2")) == ("rad/s", "m/s")
    assert run["last"][-1] == 3.0
    assert Mux is Stack


def test_parts_have_their_units():
    class Length(Block):
        """An input in m."""

        u = Input(unit="m")
        y = Output()

        def output(self, t, x, u):
            return u.u

    with pytest.raises(UnitError, match=r"demux\.y3 is in rad/s; expected in m"):
        Diagram("d", Length()(Demux(3)(Twist()(1.0)).y3))


@pytest.mark.parametrize("sizes", [0, (), (1, 0), 2.5, "ab", True, (1, 1.5)])
def test_sizes_are_whole_numbers(sizes):
    with pytest.raises(ParameterError, match=r"sizes: found .*; expected the number of scalars, such as 3"):
        Demux(sizes)


def test_another_vector_is_refused():
    with pytest.raises(ShapeError, match=r"demux\.u: found shape \(3,\); expected a vector of 2 entries"):
        Diagram("d", Demux(2)(Twist()(1.0)))
