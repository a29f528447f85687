"""The library that lays out pages for print, and draws them as pixels: PlutoPrint, an extra."""

from __future__ import annotations

from typing import Any

from ...blocks.core import OptionError


def printer(wanted: str, instead: str, port: str) -> Any:
    """Return the library; ``wanted`` and ``instead`` say in the error what needs it and what does without."""
    try:
        import plutoprint
    except ImportError as error:
        raise OptionError(
            f'{wanted} needs PlutoPrint, which is not installed. Install it: pip install "loopwright[pdf]"; or '
            f"{instead}.",
            port=port,
        ) from error
    return plutoprint
