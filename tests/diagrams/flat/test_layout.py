"""Layouts of a flattened diagram: down to the single state."""

import numpy as np

from loopwright.blocks import Block, Constant, Input, Integrator, State, UnitDelay, parameter
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.flat.flat_layout import StateLayout
from loopwright.types import Array


class Mixed(Block):
    """Two states of different shapes; the second one is integrated, too."""

    gain: Array = parameter(default=np.eye(2), shape=(2, 2), description="G")
    first: Array = parameter(default=((1.0, 2.0), (3.0, 4.0)), shape=(2, 2), description="X at the start")
    u = Input(shape=(2,))
    speed = State()
    matrix = State(output=True, start="first")

    def derivative(self, t, x, u):
        """Return the rates."""
        return u.u[0], self.gain @ x.matrix


def test_states_are_found_by_block_and_name():
    layout = StateLayout.of_blocks({"a": {"p": (), "q": (2,)}, "b": {}, "c.d": {"r": (2, 2)}}, offset=5)
    assert layout.slices == {"a": slice(5, 8), "b": slice(8, 8), "c.d": slice(8, 12)}
    assert layout.shapes == {"a": (3,), "b": (0,), "c.d": (4,)}
    assert layout.of_block["a"].slices["q"] == slice(6, 8)
    assert layout.of_block["c.d"].shapes == {"r": (2, 2)}
    assert layout.total == 7
    assert layout.each.slices == {"a.p": slice(5, 6), "a.q": slice(6, 8), "c.d.r": slice(8, 12)}
    assert layout.labels == ["a.p", "a.q[1]", "a.q[2]", "c.d.r[1,1]", "c.d.r[1,2]", "c.d.r[2,1]", "c.d.r[2,2]"]


def test_every_entry_of_a_flattened_diagram_has_a_name():
    @subsystem(sample_time=0.1)
    def sampled(y):
        return UnitDelay(initial_value=7.0, name="past")(y)

    mixed = Mixed(name="mixed")(Constant(value=(1.0, 2.0)))
    diagram = Diagram("d", sampled(Integrator(name="sum", initial_value=np.zeros(2))(mixed.matrix[1])), mixed)
    flat = diagram.flatten()
    names = [f"mixed.matrix[{i},{j}]" for i in (1, 2) for j in (1, 2)]
    assert flat.labels == [
        *("mixed.speed", *names, "sampled.past.last[1]", "sampled.past.last[2]", "sum.y[1]", "sum.y[2]"),
        *("held(sampled.past.y[1])", "held(sampled.past.y[2])"),
    ]
    start = dict(zip(flat.labels, flat.x0, strict=True))
    assert [start[n] for n in names] == [1.0, 2.0, 3.0, 4.0]
    assert start["sampled.past.last[1]"] == 7.0
    assert flat.continuous_labels == ["mixed.speed", *names, "sum.y[1]", "sum.y[2]"]
    assert flat.states.of_block["mixed"].split(flat.x0)["matrix"].tolist() == [[1.0, 2.0], [3.0, 4.0]]
