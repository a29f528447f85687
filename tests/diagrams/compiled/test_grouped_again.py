"""The tests of compiled runs with continuous states once more, with every diagram as grouped code."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.mark.slow
def test_runs_with_continuous_states_are_right_as_grouped_code():
    files = [*HERE.glob("test_hybrid_*.py"), HERE / "test_stiff_runs.py"]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "--grouped"]
    free = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "LOOPWRIGHT_"))}
    done = subprocess.run(
        [*command, *map(str, sorted(files))], cwd=HERE.parents[2], env=free, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-5000:]
