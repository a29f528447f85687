"""The tests of events once more, with generated code in every run."""

import importlib.util
from pathlib import Path

import pytest

from loopwright.diagrams.simulation import run_options

EVENTS = Path(__file__).parent.parent / "events"
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def in_c(monkeypatch):
    """Runs have generated code where there can be some."""
    make = run_options.RunOptions.__init__

    def made(self, *arguments, **options):
        make(self, *arguments, **{"compile": True, **options})

    monkeypatch.setattr(run_options.RunOptions, "__init__", made)


for _path in sorted(EVENTS.glob("test_*.py")):
    _spec = importlib.util.spec_from_file_location(f"compiled_{_path.stem}", _path)
    _module = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(_module)
    for _name, _value in vars(_module).items():
        if _name.startswith("test_") and callable(_value):
            globals()[f"test_{_path.stem.removeprefix('test_')}_{_name.removeprefix('test_')}"] = _value
        elif type(_value).__name__ == "FixtureFunctionDefinition" or hasattr(_value, "_pytestfixturefunction"):
            globals()[_name] = _value
