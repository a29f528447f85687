"""The tests of compiled runs with continuous states once more, with every diagram as grouped code."""

import importlib.util
from pathlib import Path

import pytest

from loopwright.diagrams.flat import flat_diagram

HERE = Path(__file__).parent
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def grouped(monkeypatch):
    """Every diagram is compiled block by block."""
    monkeypatch.setattr(flat_diagram, "LARGEST", 0)


for _path in sorted([*HERE.glob("test_hybrid_*.py"), HERE / "test_stiff_runs.py"]):
    _spec = importlib.util.spec_from_file_location(f"grouped_{_path.stem}", _path)
    _module = importlib.util.module_from_spec(_spec)
    _spec.loader.exec_module(_module)
    for _name, _value in vars(_module).items():
        if _name.startswith("test_") and callable(_value):
            globals()[f"test_{_path.stem.removeprefix('test_')}_{_name.removeprefix('test_')}"] = _value
        elif type(_value).__name__ == "FixtureFunctionDefinition":
            globals()[f"{_name}"] = _value
