"""One tick as one act of the workspace: evaluate, raise the error of who is to blame, take over the next states."""

import numpy as np
import pytest

from loopwright.blocks import Block as Base
from loopwright.blocks import Gain, GuardError, Input, Integrator, Output, Ramp, UnitDelay
from loopwright.diagrams import Diagram, NonFiniteError, subsystem
from loopwright.diagrams.simulation.workspace import Workspace

T = 0.125


class Root(Base):
    """y = √u, guarded: u must be positive."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        """Return the root."""
        return np.sqrt(u.u)

    def guards(self, t, x, u):
        """Name what must be positive."""
        return {"radicand": u.u}


@subsystem(sample_time=T)
def counting():
    """x⁺ = x + 1, and the root of 2 − x."""
    x = UnitDelay(initial_value=0.0, name="x")
    x(x.y + 1.0)
    return Root(name="root")(2.0 - x.y)


@pytest.fixture
def workspace():
    return Workspace(Diagram("d", counting()).flatten())


def entry(workspace, name="counting.root.y"):
    return workspace.log[workspace.flat.log.slices[name]].item()


def test_a_tick_takes_over_the_next_states_and_an_evaluation_does_not(workspace):
    acting = workspace.flat.acting(0)
    for _ in range(2):
        workspace.evaluate(acting)
        assert entry(workspace) == np.sqrt(2.0)
        assert workspace.here.x.tolist() == [0.0]
        assert workspace.x_next.tolist() == [1.0]
    workspace.tick(acting)
    assert workspace.here.x.tolist() == [1.0]
    workspace.tick(acting)
    assert workspace.here.x.tolist() == [2.0]
    assert entry(workspace) == 1.0


def test_a_tick_that_fails_names_who_is_to_blame_and_takes_nothing_over(workspace):
    acting = workspace.flat.acting(0)
    workspace.put(4 * T, np.array([3.0]), np.zeros(0))
    with pytest.raises(GuardError, match="'radicand'") as caught:
        workspace.tick(acting)
    assert (caught.value.block, caught.value.t) == ("counting.root", 4 * T)
    assert workspace.here.x.tolist() == [3.0]
    workspace.evaluate(acting)  # a look alone: it raises when it is asked to
    with pytest.raises(GuardError):
        workspace.check(acting)
    workspace.put(4 * T, np.array([np.nan]), np.zeros(0))
    with pytest.raises(NonFiniteError):
        workspace.tick(acting)


def test_between_ticks_a_sampled_subsystem_holds_what_it_has(workspace):
    diagram = Diagram("d", Integrator(name="area")(Gain(gain=1.0)(counting())), Ramp(slope=1.0))
    workspace = Workspace(diagram.flatten())
    workspace.tick(workspace.flat.acting(0))
    after = workspace.here.x.copy()
    workspace.tick()
    assert np.array_equal(workspace.here.x, after)


def test_each_workspace_has_parameters_of_its_own():
    diagram = Diagram("d", Gain(gain=2.0, name="gain")(Ramp(slope=1.0, initial_value=1.0, name="ramp")))
    flat = diagram.flatten(T)
    first, second = Workspace(flat), Workspace(flat)
    first.set_parameters("gain", diagram["gain"].replace(gain=5.0))
    for workspace, expected in ((first, 5.0), (second, 2.0)):
        workspace.tick()
        assert entry(workspace, "gain.y") == expected
    assert np.array_equal(flat.p, second.p, equal_nan=True)
