"""Every run of every quick test in both forms, by collection: a folder of tests that is new is among them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[2]
FOLDERS = sorted(
    folder
    for folder in (*(TESTS / "diagrams").iterdir(), *(TESTS / "blocks").iterdir(), *(TESTS / "fmus").iterdir())
    if folder.is_dir() and any(folder.glob("test_*.py")) and folder != Path(__file__).parent
)
NO_TESTS = 5  # pytest's code


@pytest.mark.slow
@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: f"{folder.parent.name}-{folder.name}")
def test_runs_of_a_folder_agree_in_both_forms(folder):
    """`support.tiers` states the classes in which bits differ, and their bounds."""
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "--both-tiers", str(folder)]
    free = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "LOOPWRIGHT_"))}
    done = subprocess.run(command, cwd=TESTS.parent, env=free, capture_output=True, text=True, check=False)
    assert done.returncode in (0, NO_TESTS), done.stdout[-5000:]
