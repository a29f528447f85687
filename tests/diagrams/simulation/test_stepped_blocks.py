"""A block that is stepped from outside and is no FMU: a run, a drawing, and the checks treat it as a plant."""

import numpy as np
import pytest

from loopwright.blocks import Gain, Ramp
from loopwright.diagrams import Diagram, OptionError, check_block, subsystem
from loopwright.diagrams.wiring.structure import stepped_blocks
from support.tanks import CALLS, Tank

pytestmark = pytest.mark.one_tier  # it counts calls


@pytest.fixture(autouse=True)
def _no_calls():
    CALLS.clear()


def closed_loop(T=0.125):
    """A level under proportional control: y⁺ = y + T (r − y)."""
    tank = Tank(area=2.0, level=1.0, name="tank")

    @subsystem(sample_time=T)
    def controller(level):
        return Gain(gain=2.0, name="gain")(3.0 - level)

    return Diagram("d", tank(u=controller(tank.y)))


def test_it_runs_as_a_plant_under_a_controller():
    diagram = closed_loop()
    run = diagram.simulate(2.0, progress=False)
    assert np.allclose(run["tank.y"], 3.0 - 2.0 * (1.0 - 0.125) ** np.arange(17), rtol=1e-14)
    assert CALLS[:-1] == [(k / 8, 0.125) for k in range(16)]
    assert CALLS[-1] == "freed"
    assert diagram.has_fmu


def test_its_steps_have_one_length_beside_continuous_blocks():
    """The difference of two times, each rounded, is not always the same; some plants refuse any other step."""
    diagram = Diagram("d", Tank(area=1.0, name="tank")(u=Ramp(slope=1.0)))
    run = diagram.simulate(2.0, step=0.1, progress=False)
    assert [h for _, h in CALLS[:-1]] == [0.1] * 20
    assert run["tank.y"][-1] == pytest.approx(0.1 * np.sum(0.1 * np.arange(20)), rel=1e-14)


def test_its_state_is_saved_and_restored():
    diagram = closed_loop()
    with diagram.simulation() as simulation:
        simulation.advance(1.0)
        half = simulation.save()
        simulation.advance(1.0)
        straight = simulation.run()["tank.y"]
        simulation.restore(half)
        simulation.advance(1.0)
        again = simulation.run()["tank.y"]
    other = diagram.simulate(1.0, start=half, progress=False)["tank.y"]
    assert straight[8:].tolist() == again.tolist() == other.tolist()


def test_one_function_lists_it_and_a_drawing_shows_it_as_a_plant():
    inner = Tank(area=1.0, name="tank")

    @subsystem
    def box(u):
        return inner(u=u)

    table = Diagram("d", box(Ramp(slope=1.0)), Gain(gain=1.0, name="tanker")(inner.y)).structure
    assert list(stepped_blocks(table)) == ["box.tank"] == list(stepped_blocks(table, "box"))
    assert list(stepped_blocks(table, "box.tank")) == ["box.tank"]
    assert stepped_blocks(table, "tanker") == stepped_blocks(table, "bo") == {}
    assert not table.is_traced("box.tank")
    drawing = closed_loop().draw().svg
    assert "<title>tank: Tank</title>" in drawing
    assert drawing.count('stroke-width="1.4"') == 1  # the double border of a plant


def test_the_contract_runs_it_without_looking_for_equations():
    assert check_block(Tank(area=2.0))


@pytest.mark.parametrize("ask", [Diagram.linearize, Diagram.trim, Diagram.operating_point])
def test_it_has_no_linear_model_and_an_error_says_what_to_do(ask):
    with pytest.raises(OptionError, match=r"^tank: found a Tank, .* no FMU: .*`opaque = True`.*frequency_response"):
        ask(closed_loop())
