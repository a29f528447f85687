"""Revision of a diagram: a digest of all that its behaviour comes from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...blocks.core import Block
from ...fmus.fmu_block import Fmu
from ..flat import WiredDiagram


def content_hash(diagram: WiredDiagram) -> str:
    """Return a digest of a diagram's content: 64 hexadecimal digits.

    In it are the blocks with their parameters and traced equations, FMUs by the SHA-256 of their files and their start
    values, wires, and the settings of subsystems; no folder, no time, no order of definition. Diagrams that behave
    differently have different digests. The versions of the libraries are not in it.
    """
    digest = hashlib.sha256()
    for part in _parts(diagram):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()


def _parts(diagram: WiredDiagram) -> Iterator[str]:
    table, traced = diagram.structure, diagram.checked.traced
    for path, block in sorted(table.blocks.items()):
        yield f"block {path} {type(block).__module__}.{type(block).__qualname__} in {table.subsystem_of[path]}"
        yield _parameters(block)
        if path in traced and traced[path].foreign is None:
            yield str(traced[path].function.serialize())
    for (path, name), wire in sorted(table.wires.items()):
        yield f"wire {path}.{name} from {wire}"
    for path, wire in sorted(table.controls.items()):
        yield f"control {path} from {wire}"
    for path, settings in sorted(table.subsystems.items()):
        yield f"subsystem {path} {settings}"


def _parameters(block: Block) -> str:
    if isinstance(block, Fmu):
        return f"{block.description.digest} {_text(block.start)}"
    return ", ".join(f"{name} = {_text(getattr(block, name))}" for name in sorted(block.parameter_specs))


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray | float | np.floating | np.integer):
        return f"{np.shape(value)} {np.asarray(value).tolist()!r}"
    if isinstance(value, Mapping):
        return ", ".join(sorted(f"{key}: {_text(entry)}" for key, entry in value.items()))
    if isinstance(value, list | tuple):
        return f"({', '.join(map(_text, value))})"
    if hasattr(value, "parameter_specs"):
        inner = ", ".join(f"{name} = {_text(getattr(value, name))}" for name in sorted(value.parameter_specs))
        return f"{type(value).__qualname__}({inner})"
    if callable(value):
        return getattr(value, "__qualname__", type(value).__qualname__)
    return str(value)
