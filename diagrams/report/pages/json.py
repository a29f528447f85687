"""A report's numbers as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from ....blocks.core import DefinitionError
from ...frequency import Number
from .document import Document


def to_json(report: Document) -> str:
    """Return all numbers, nested by the dots of their paths, with ``meta`` and ``requirements`` next to them.

    Every leaf is ``{"value", "unit", "tolerance", "confirmed_by"}``. JSON has no infinity: it is the text "inf" or
    "-inf", which ``float()`` reads; what does not exist (NaN) is null.
    """
    tree: dict[str, Any] = {"meta": _plain(report.meta)}
    if report.review is not None:
        tree["requirements"] = _plain(report.review.as_dict())
    for path, number in report.numbers().items():
        *way, last = path.split(".")
        place = tree
        for part in way:
            place = place.setdefault(part, {})
            if "confirmed_by" in place:
                raise DefinitionError(f"a number stands where {path!r} goes on; rename one of them.", block=path)
        if last in place:
            raise DefinitionError("two numbers stand there, or others below it; rename one of them.", block=path)
        place[last] = leaf(number)
    return json.dumps(tree, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def leaf(number: Number) -> dict[str, Any]:
    """Return a number as it is in the JSON."""
    return {key: _plain(value) for key, value in number.as_dict().items()}


def _plain(value: Any) -> Any:
    """Return a value as JSON can hold it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        if math.isnan(value):
            return None
        return value if math.isfinite(value) else str(value)
    if isinstance(value, Number):
        return leaf(value)
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [_plain(entry) for entry in (sorted(value, key=str) if isinstance(value, set | frozenset) else value)]
    return str(value)
