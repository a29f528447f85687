"""Runs on disk whose `with` statement is left without `run`: they are ended, their files are closed."""

import numpy as np
import pytest

from loopwright.blocks import Clock
from loopwright.blocks.core.errors import OptionError
from loopwright.diagrams import Diagram, Run

CLOCK = Diagram("clock", Clock().named("t"))


def test_an_error_between_two_advances_ends_the_run_with_what_was_recorded(tmp_path):
    def leave():
        with CLOCK.simulation(step=0.25, to=tmp_path / "run") as simulation:
            simulation.advance(1.0)
            raise KeyError("mine")

    with pytest.raises(KeyError):
        leave()
    run = Run.open(tmp_path / "run")
    np.testing.assert_array_equal(run["t"], [0.0, 0.25, 0.5, 0.75, 1.0])
    assert run.messages == ("This run was cut off at t = 1 s: KeyError: 'mine'",)
    assert run.elapsed > 0.0


def test_a_run_that_is_left_in_peace_has_no_message(tmp_path):
    with CLOCK.simulation(step=0.5, to=tmp_path / "run") as simulation:
        simulation.advance(1.0)
    run = Run.open(tmp_path / "run")
    assert run.messages == ()
    np.testing.assert_array_equal(run.t, [0.0, 0.5, 1.0])


def test_after_run_the_stored_one_is_left_alone(tmp_path):
    with CLOCK.simulation(step=0.5, to=tmp_path / "run") as simulation:
        simulation.advance(1.0)
        simulation.run()
        simulation.advance(1.0)
    np.testing.assert_array_equal(Run.open(tmp_path / "run").t, [0.0, 0.5, 1.0])


def test_what_an_advance_has_made_can_be_read_while_the_run_stands(tmp_path):
    with CLOCK.simulation(step=0.5, to=tmp_path / "run") as simulation:
        simulation.advance(1.0)
        np.testing.assert_array_equal(Run.open(tmp_path / "run").t, [0.0, 0.5, 1.0])


def test_restore_forgets_what_is_on_disk(tmp_path):
    with CLOCK.simulation(step=0.5, to=tmp_path / "run") as simulation:
        start = simulation.save()
        simulation.advance(2.0)
        simulation.restore(start)
        simulation.advance(1.0)
        run = simulation.run()
    np.testing.assert_array_equal(run.t, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(Run.open(tmp_path / "run").t, [0.0, 0.5, 1.0])


def test_a_foreign_run_is_still_not_replaced(tmp_path):
    with CLOCK.simulation(step=0.5, to=tmp_path / "run") as simulation:
        simulation.advance(1.0)
    with pytest.raises(OptionError, match="a run at .* already"):
        CLOCK.simulation(step=0.5, to=tmp_path / "run")
    np.testing.assert_array_equal(Run.open(tmp_path / "run").t, [0.0, 0.5, 1.0])


def test_signals_to_record_may_come_from_a_generator():
    with CLOCK.simulation(step=0.5, record=(name for name in ["t"]), states=False) as simulation:
        simulation.advance(1.0)
        np.testing.assert_array_equal(simulation.run()["t"], [0.0, 0.5, 1.0])
        simulation.advance(0.5)
        np.testing.assert_array_equal(simulation.run()["t"], [1.5])
