"""Errors that chapters of a report show are sentences: found, where, and what changes it; nothing of `expected`."""

import pytest

from loopwright.blocks import Gain, OptionError, TransferFunction
from loopwright.diagrams import Diagram, NonFiniteError, analyse, subsystem
from loopwright.diagrams.report.error_sentences import say, say_found
from loopwright.diagrams.report.sections import injection, sensitivity, step_responses

ASKED = "found a thing that fails; expected one that works. Take another thing."
RUN = NonFiniteError("found inf; expected finite values. Look at the gain.", block="plant", port="y", t=1.25)


def test_an_error_is_what_was_found_and_a_next_step():
    assert say(OptionError(ASKED, block="d")) == "Found a thing that fails. To change it: Take another thing."
    assert say(RUN) == "Found inf (plant.y, t = 1.25 s). To change it: Look at the gain."
    assert say_found(OptionError("no more memory.")) == "No more memory"
    assert say(OptionError("no more memory.")) == "No more memory."


@pytest.mark.parametrize(
    ("module", "function", "key", "error", "text"),
    [
        (
            step_responses,
            "run_step",
            "steps",
            RUN,
            "at control.u: not tried. Found inf (plant.y, t = 1.25 s). To change it: Look",
        ),
        (
            injection,
            "find_least_sine",
            "injection",
            OptionError(ASKED),
            "at control.u: not done. Found a thing that fails.",
        ),
        (sensitivity, "confirm_parameter", "sensitivity", OptionError(ASKED), "u: Found a thing that fails. To change"),
    ],
)
def test_a_chapter_says_an_error_in_sentences(module, function, key, error, text, monkeypatch):
    def fail(*arguments, **options):
        raise error

    plant = TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name="plant")

    @subsystem(sample_time=0.1)
    def control(y):
        return Gain(gain=2.0, name="k")(0.0 - y).named("u")

    diagram = Diagram("d", plant(control(plant.y)))
    monkeypatch.setattr(module, function, fail)

    def texts(sections):
        for section in sections:
            yield from section.text
            yield from texts(section.sections)

    said = " ".join(" ".join(texts(analyse(diagram, only=(key,)).sections)).split())
    assert text in said
    assert "expected" not in said
