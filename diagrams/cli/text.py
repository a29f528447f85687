"""Output of the command line, as the terminal can show it or as JSON, and files that are named on it."""

from __future__ import annotations

import json
import math
import re
import sys
from pathlib import Path
from typing import IO, Any

import numpy as np

from ...blocks.core import OptionError, explain_disk_errors

_PLAIN = str.maketrans(
    {"η": "eta", "ξ": "xi", "θ": "theta", "σ": "sigma", "κ": "kappa", "ζ": "zeta", "∥": "_par", "⊥": "_perp", "²": "2"}
    | {
        "…": "...",
        "\u202f": " ",
        "×": "*",
        "·": "*",
        "−": "-",
        "→": "->",
        "∞": "inf",
        "√": "sqrt",
        "—": "-",
        "–": "-",
        "’": "'",
        "′": "'",
        "✓": "ok",
    }
)
_POWERS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def say(text: str, stream: IO[str] | None = None) -> None:
    """Print a line, at once; on standard output without a stream."""
    stream = stream or sys.stdout
    print(fit(text, stream), file=stream, flush=True)


def say_json(content: Any) -> None:
    """Print a content as JSON, in ASCII, which any terminal can show."""
    print(json.dumps(content, indent=2, default=str))


def finite_or_none(value: Any) -> Any:
    """Return a number, or an array as lists, with None where it is not finite: JSON has no other word."""
    if np.ndim(value):
        return [finite_or_none(one) for one in value]
    return float(value) if math.isfinite(value) else None


def size_text(n: int) -> str:
    """Return a number of bytes as text."""
    return f"{n / 1e6:.2f} MB" if n >= 1e6 else f"{n / 1e3:.1f} kB"


def fit(text: str, stream: IO[str]) -> str:
    """Return the text in characters that the stream can print."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        text = re.sub("(?<=10)[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+", lambda power: f"^{power[0].translate(_POWERS)}", text)
        return text.translate(_PLAIN).encode(encoding, "replace").decode(encoding)
    return text


def check_file(name: str) -> Path:
    """Return the path of an FMU that is named on the command line; OptionError: there is no such file."""
    path = Path(name).expanduser()
    with explain_disk_errors("it can't be read", path, "Give another file.", OptionError, block=str(path)):
        is_file = path.is_file()
    if not is_file:
        found = "is a folder" if path.is_dir() else "there is no such file"
        raise OptionError(f"{found}; expected an FMU. Check the path.", block=str(path))
    return path
