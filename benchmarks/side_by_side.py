"""All that is compared with others, in one run: python benchmarks/side_by_side.py [--quick].

The hand-written C of Fig. 3 beside interpreted, compiled and fused runs, with its counts of instructions (valgrind);
sampled and continuous loops in both forms; sweeps over threads and lanes; an anti-lock brake with 12,900 events;
and the tools of others. Each is a benchmark of its own, which prints its ratios and their spread. With --quick sweeps
are shorter, and instructions are not counted. The program ends with status 1 if one of them does.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent


def main() -> int:
    """Run all of them, one after the other."""
    quick = "--quick" in sys.argv[1:]
    runs = [
        ["handwritten.py", *([] if quick else ["--instructions"])],
        ["compiled.py"],
        ["sweep.py", "50" if quick else "1000"],
        ["events.py", "antilock", "compiled"],
        ["peers.py"],
    ]
    failed = []
    for name, *arguments in runs:
        print(f"\n=== {' '.join((name, *arguments))}", flush=True)
        if subprocess.run([sys.executable, FOLDER / name, *arguments], check=False).returncode:
            failed.append(name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
