"""benchmarks/events.py says how many events a run has, and at how many instants."""

import importlib.util
from pathlib import Path

FILE = Path(__file__).parents[3] / "benchmarks/events.py"


def load_benchmark():
    spec = importlib.util.spec_from_file_location("events_benchmark", FILE)
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_events_and_their_instants_are_counted_apart():
    # a cycle of the brake: the valve closes; its torque reaches zero; the valve opens and lets the torque go, at once
    benchmark = load_benchmark()
    diagram, _, step = benchmark.antilock()
    run = diagram.simulate(0.03, step=step, progress=False)
    events, instants = benchmark.count(run)
    assert events == len(run.events) > 50
    assert abs(3 * events - 4 * instants) <= 4  # the last cycle may be cut off
    assert abs(2 * sum(event.block == "valve" for event in run.events) - events) <= 1


def test_pages_say_what_is_counted():
    root = FILE.parents[1]
    for name, words in (
        ("benchmarks/README.md", "12,900 events of an anti-lock brake"),
        ("CHANGELOG.md", "12,900 events of an anti-lock brake"),
        ("benchmarks/events.py", "12,900 events at 9,675 instants"),
        ("benchmarks/side_by_side.py", "an anti-lock brake with 12,900 events"),
    ):
        text = " ".join((root / name).read_text(encoding="utf-8").split())
        assert words in text, name
        assert "12,900 switches" not in text, name
