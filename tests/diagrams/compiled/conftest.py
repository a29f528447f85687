"""What tests of runs in C share."""

import pytest


@pytest.fixture
def all_in_c(monkeypatch):
    """Python goes through no tick, and no generated code takes over: both would have the same numbers, and hide C's."""
    from loopwright.diagrams.compiled import background
    from support.both_forms import refuse_ticks_by_python

    monkeypatch.setattr(background.BackgroundCode, "look", lambda *_: None)
    refuse_ticks_by_python(monkeypatch)
