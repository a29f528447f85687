"""Models, blocks and independent solutions that several tests share."""

from pathlib import Path

TESTS = Path(__file__).parents[1]  # on the path of every process that imports `support`
