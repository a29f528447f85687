"""Short texts of results: a cell of a notebook shows the kind, the facts that matter, and next steps."""

from dataclasses import replace

import numpy as np
import pytest

from loopwright.blocks import Gain, OptionError
from loopwright.diagrams import Interrupted, Requirements, check_block
from loopwright.frequency import disk_margin, gang_of_four, margins, periodic_margins, sensitivity
from support.shown_drive import drive

LONGEST = 300


def test_texts_of_a_run_say_its_samples_and_next_steps(run):
    found = repr(run)
    assert found.startswith("<run of 'drive': 101 samples from 0 to 2 s, 10 signals (named: y, u, e), interpreted; ")
    assert "run['y']" in found
    assert "), interpreted, then compiled; " in repr(replace(run, tier="both"))
    assert repr(run.at(1.0)).startswith("<instant t = 1 s of 'drive': 10 signals, 7 states; ")
    assert repr(run.final_state) == (
        "<state of a run of 'drive': t = 2 s, tick 100 of 0.02 s; diagram.simulate(…, start=state)>"
    )


def test_texts_of_results_are_short_and_say_units_or_next_steps(diagram, run):
    model = diagram.linearize()
    loop = model.loop("u")
    shown = [
        *(run, run.at(1.0), run.final_state, diagram.trim(), diagram.flatten(), diagram.flatten().log, diagram.draw()),
        *(model, loop, margins(loop), disk_margin(loop), periodic_margins(loop), gang_of_four(loop, loop)),
        *(margins(drive(ki=2.0).linearize().loop("u")), diagram.sensitivities("u", ["kp.gain"])),
        *(diagram.sensitivities("u", ["kp.gain"])[0], Requirements(ms=2.0), check_block(Gain(gain=1.0))),
        diagram.worst_case({"kp.gain": (0.1, 0.3)}, "u", count=2, starts=0),
        diagram.sweep({"kp.gain": (0.1, 0.3)}, 0.1, signals="y", progress=False, workers=1, compile=False),
    ]
    for value in shown:
        found = repr(value)
        assert len(found) <= LONGEST, found
        assert found.count("\n") < 10
        assert found.startswith("<")
        assert found.endswith(">")
        assert "array(" not in found
    assert len(loop._repr_html_()) < 3000  # a few facts: python-control's matrices grow with the states
    assert "unstable, poles" in repr(shown[13])
    assert "margins(loop)" in repr(loop)
    assert repr(margins(loop)).startswith(
        "<margins: stable, gain_margin_high 2.84646 (9.09 dB), phase_margin_deg 42.8762 deg, "
    )


def test_the_loop_is_a_state_space_still(diagram):
    loop = diagram.linearize().loop("u")
    assert "states=3" in repr(sensitivity(loop)).replace(" ", "")
    assert "A = " in str(loop)


def test_an_instant_of_a_run_is_refused_in_short_with_a_next_step(diagram, run):
    with pytest.raises(OptionError, match=r"drive.start: found <instant t = 1 s .*diagram.operating_point\(1.0\)") as e:
        diagram.simulate(1.0, start=run.at(1.0), progress=False)
    assert len(str(e.value)) < 400
    point = diagram.operating_point(1.0)
    on = diagram.simulate(1.0, start=point, progress=False)
    np.testing.assert_allclose(on["y"][-1], run["y"][-1], rtol=1e-5)


def test_an_interrupted_run_says_when_and_that_it_has_no_final_state(diagram, run):
    error = Interrupted(run)
    assert error.run.messages[-1] == (
        "This run was interrupted at t = 2 s, within a step: it has no final_state to continue from."
    )
    assert error.run.messages[-1] in repr(error.run)
    again, (same,) = error.__reduce__()
    assert len(again(same).run.messages) == len(error.run.messages)
    with pytest.raises(OptionError, match=r"interrupted or has failed \(run.messages tells when\).*run in parts"):
        diagram.simulate(1.0, start=None, progress=False)
