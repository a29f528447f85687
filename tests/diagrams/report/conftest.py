"""Pages of reports without the time that their figures take, for tests that look at something else."""

from weakref import WeakKeyDictionary

import pytest

from loopwright.diagrams.report.pages import svg


@pytest.fixture
def without_drawings(monkeypatch):
    """Figures of pages are empty: for tests of texts, tables and verdicts."""
    monkeypatch.setattr(svg, "_drawn", lambda figure: '<svg width="10pt" height="10pt"></svg>')


_DRAWN = WeakKeyDictionary()


@pytest.fixture
def drawn_once(monkeypatch):
    """A figure is drawn once for all pages that show it in one size: for tests that don't change figures."""
    draw = svg._drawn

    def drawn(figure):
        kept, size = _DRAWN.setdefault(figure, {}), tuple(figure.get_size_inches())
        if size not in kept:
            kept[size] = draw(figure)
        return kept[size]

    monkeypatch.setattr(svg, "_drawn", drawn)
