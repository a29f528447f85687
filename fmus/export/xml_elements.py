"""XML as text: elements with their attributes, and those that descriptions of all kinds have."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterable, Mapping
from functools import lru_cache
from xml.sax.saxutils import quoteattr

from ...blocks.core import BASE_UNITS, parse_unit


@lru_cache(maxsize=1)
def package_version() -> str:
    """Return the version of this package; ``0`` if it is not installed."""
    try:
        return importlib.metadata.version("loopwright")
    except importlib.metadata.PackageNotFoundError:
        return "0"


def element(tag: str, attributes: Mapping[str, object], children: Iterable[str] = ()) -> str:
    """Return an element, with its attributes but those that are None."""
    text = "".join(f" {name}={quoteattr(_text(value))}" for name, value in attributes.items() if value is not None)
    inner = [f"  {line}" for child in children for line in child.splitlines()]
    return "\n".join([f"<{tag}{text}>", *inner, f"</{tag}>"]) if inner else f"<{tag}{text}/>"


def document(tag: str, attributes: Mapping[str, object], children: Iterable[str]) -> str:
    """Return a document with one element."""
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{element(tag, attributes, children)}\n'


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def unit_element(text: str) -> str:
    """Return the definition of a unit by base units."""
    unit = parse_unit(text)
    base: dict[str, object] = {name: n for name, n in zip(BASE_UNITS, unit.exponents, strict=True) if n}
    if unit.factor != 1:
        base["factor"] = unit.factor
    if unit.offset:
        base["offset"] = unit.offset
    return element("Unit", {"name": text}, [element("BaseUnit", base)])
