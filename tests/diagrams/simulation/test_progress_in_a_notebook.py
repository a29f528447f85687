"""Progress in a notebook: plain text that changes, nothing under two seconds, and an empty line at the end."""

import IPython.display
import pytest

from loopwright.diagrams.simulation import progress


@pytest.fixture
def shown(monkeypatch):
    """Texts that a notebook shows, one after the other; `shown.time` is the clock."""

    class Shown(list):
        time = 0.0

        def update(self, content, *, raw):
            self.append(content)

    texts = Shown()

    def display(content, *, raw, display_id):
        texts.append(content)
        return texts

    monkeypatch.setattr(progress, "_in_notebook", lambda: True)
    monkeypatch.setattr(progress.time, "monotonic", lambda: texts.time)
    monkeypatch.setattr(IPython.display, "display", display)
    return texts


def test_a_long_run_is_shown_from_two_seconds_on_and_leaves_an_empty_line(shown):
    with progress.progress_bar("loop", 1.0, 5.0, True) as note:
        for shown.time, t in ((1.0, 2.0), (2.0, 3.0), (2.1, 3.2), (4.0, 4.0)):
            note(t)
    bars = ["█" * 15 + "░" * 15, "█" * 22 + "░" * 8]
    assert [list(content) for content in shown] == [["text/plain"]] * 3
    assert [content["text/plain"] for content in shown] == [
        f"loop  {bars[0]}  2.00 / 4 s  2 s",
        f"loop  {bars[1]}  3.00 / 4 s  4 s",
        "",
    ]


def test_a_short_run_leaves_nothing(shown):
    with progress.progress_bar("loop", 0.0, 1.0, True) as note:
        note(1.0)
    with progress.work_notes("loop", True) as note:
        note("margins")
    assert shown == []


def test_parts_of_a_report_are_named_and_the_line_is_emptied_after_an_error(shown):
    def analyse(note):
        shown.time = 7.0
        note("worst_case")
        raise ArithmeticError

    with pytest.raises(ArithmeticError), progress.work_notes("loop", True) as note:
        analyse(note)
    assert [content["text/plain"] for content in shown] == ["loop: worst case  7 s", ""]
