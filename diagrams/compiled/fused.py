"""A diagram with its FMUs compiled for the processor of this machine."""

from __future__ import annotations

from ...blocks.core import CompilerError, FmuError
from ...fmus.export import tune
from ...fmus.platform import is_built_here
from ..flat import WiredDiagram


def fuse(diagram: WiredDiagram) -> tuple[WiredDiagram, tuple[str, ...]]:
    """Return a diagram whose FMUs of our own are compiled for this processor, and messages about what was done.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    """
    changes, kept = dict[str, object](), list[str]()
    for path, block in diagram.blocks.items():
        description = getattr(block, "description", None)
        if description is None or not hasattr(block, "file"):
            continue
        if not is_built_here(description.digest):
            kept.append(path)
            continue
        try:
            changes[f"{path}.file"] = tune(description.file)
        except (CompilerError, FmuError) as error:
            raise error.at(block=path) from error.__cause__
    messages = [
        f"Fused: {path.removesuffix('.file')} is compiled for this processor; values differ "
        "by rounding, which some motions magnify."
        for path in changes
    ]
    messages += [f"Not fused: {path} was not built by Loopwright on this machine." for path in kept]
    return (diagram.replace(changes) if changes else diagram), tuple(messages)
