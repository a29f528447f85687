"""Entries in names count from 1, wherever a name of a signal is text; Python's indices count from 0."""

import io

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, StateSpace, Sum, UnitDelay, UnknownNameError
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.linearization import EntryTaken

RAMPS = (1.0, 2.0, 3.0)


def three():
    """Three signals, 10, 20 and 30, with a loop around each that has its own gain: 0.1, 0.2, 0.3."""

    @subsystem(sample_time=0.1)
    def controller(r):
        e = Sum(signs="+-", name="e")
        late = UnitDelay(initial_value=np.zeros(3), name="late")
        return e(r, late(Gain(gain=np.diag([0.1, 0.2, 0.3]), name="g")(e.y))).named("motor_force")

    return Diagram("three", controller(Constant(value=(10.0, 20.0, 30.0))))


@pytest.fixture(scope="module")
def run():
    return three().simulate(0.5, progress=False)


def test_a_run_takes_an_entry_by_name(run):
    for i in range(3):
        assert np.array_equal(run[f"motor_force[{i + 1}]"], run["motor_force"][:, i])
        assert run[f"controller.e.y[{i + 1}]"][0] == 10.0 * (i + 1)
        assert run.at(0.0)[f"motor_force[{i + 1}]"] == 10.0 * (i + 1)
    assert "motor_force[3]" in run
    assert "motor_force[0]" not in run
    for name in ("motor_force[0]", "motor_force[4]", "motor_force[1,1]"):
        with pytest.raises(
            UnknownNameError, match=r"no entry \[.*\]; expected one within its shape \(3,\), counted from 1"
        ):
            run[name]
    with pytest.raises(UnknownNameError, match="stands for several|no signal 'forse'"):
        run["forse[1]"]


def test_plots_and_tables_take_an_entry_and_name_it_alike(run):
    figure = run.plot("motor_force[2]", "motor_force")
    assert figure.axes[0].get_ylabel() == "motor_force[2]"
    assert np.array_equal(figure.axes[0].lines[0].get_ydata(), run["motor_force"][:, 1])
    assert [t.get_text() for t in figure.axes[1].get_legend().get_texts()] == [f"motor_force[{i}]" for i in (1, 2, 3)]
    text = io.StringIO()
    run.to_csv(text, "motor_force", "motor_force[3]")
    text.seek(0)
    assert text.readline().strip() == "t,motor_force[1],motor_force[2],motor_force[3]"
    text = io.StringIO()
    run.to_csv(text, "motor_force[3]")
    text.seek(0)
    assert text.readline().strip() == "t,motor_force[3]"


def test_a_selection_to_record_takes_an_entry():
    run = three().simulate(0.5, record=["motor_force[2]"], progress=False)
    assert run["motor_force[2]"][0] == 20.0
    assert "motor_force[1]" not in run
    with pytest.raises(UnknownNameError, match="was not recorded"):
        run["motor_force"]


def test_columns_of_a_matrix_are_counted_row_by_row_and_by_row_and_column():
    run = Diagram("d", Constant(value=[[1.0, 2.0], [3.0, 4.0]], name="m")).simulate(0.1, step=0.1, progress=False)
    assert [run[f"m.y[{i}]"][0] for i in (1, 2, 3, 4)] == [1, 2, 3, 4]
    assert [run[f"m.y[{i},{j}]"][0] for i in (1, 2) for j in (1, 2)] == [1, 2, 3, 4]


@pytest.mark.parametrize("i", [1, 2, 3])
@pytest.mark.drawn(1)
def test_the_loop_at_an_entry_is_that_of_the_entry(i):
    """L = g / z, with g = i / 10, computed by hand."""
    L = three().linearize().loop(f"motor_force[{i}]")
    assert L.input_labels == [f"controller_motor_force[{i}]"]
    assert complex(L(2.0)) == pytest.approx(i / 20, rel=1e-12)


def test_a_wire_of_one_entry_and_a_text_about_a_part_agree_with_it():
    plant = StateSpace(A=-np.eye(2), B=np.eye(2), C=np.eye(2), name="plant")
    wired = plant(Constant(value=(1.0, 2.0)))
    diagram = Diagram("d", Gain(gain=1.0)(wired.y[1].named("second")))
    assert str(diagram.names["second"]) == "plant.y[2]"
    assert ">[2]</text>" in diagram.draw().svg
    run = diagram.simulate(0.1, step=0.1, progress=False)
    assert np.array_equal(run["second"], run["plant.y[2]"])
    assert diagram.linearize(outputs="plant.y").states == ("plant.x[1]", "plant.x[2]")


def test_a_model_says_which_entry_was_taken():
    model = three().linearize(inputs="motor_force[1]", outputs="motor_force")
    (finding,) = [f for f in model.findings if isinstance(f, EntryTaken)]
    assert (finding.name, finding.entry) == ("motor_force", (1,))
    assert str(finding) in model.notes
    assert "called motor_force[0] here" in str(finding)
    assert str(finding) in three().linearize().loop("motor_force[1]").notes
    assert three().linearize().loop("motor_force").notes == ()
    assert not [f for f in three().linearize(outputs="motor_force").findings if isinstance(f, EntryTaken)]
