"""``python -m loopwright``, and the command ``loopwright``: the command line."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line and return the exit status; an interrupt while it is loaded ends it without a traceback."""
    try:
        from .diagrams.cli import main as command_line

        return command_line()
    except KeyboardInterrupt:
        print("loopwright: interrupted.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    raise SystemExit(main())
