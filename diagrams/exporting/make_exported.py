"""What is exported of a diagram, of a subsystem in it, or of a subsystem by itself."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping
from typing import Any

from ...blocks.core import OptionError, accepts, kinds
from ...fmus.export import LoopSpec
from ..flat import WiredDiagram, find_movable
from ..wiring import Subsystem, SubsystemCall
from .loop_of_diagram import loop_spec
from .open_diagram import OpenDiagram, choose_outputs, let_move, open_part, open_subsystem, open_whole, start_at


def make_exported(
    model: object,
    *,
    name: str | None = None,
    subsystem: str | None = None,
    outside: Iterable[str] = (),
    outputs: Iterable[str] | None = None,
    start: Mapping[str, Any] | None = None,
    **options: Any,
) -> LoopSpec | None:
    """Return what is exported of a diagram or a subsystem; None for anything else.

    ``name``: its name; without one, the diagram's or the subsystem's.
    ``subsystem``: path of the subsystem of a diagram that is exported; without it, the diagram.
    ``outside``: paths of blocks of a diagram that are not exported; see `open_whole`.
    """
    found = open_model(model, name=name, subsystem=subsystem, outside=outside, outputs=outputs)
    if found is None:
        return None
    label, opened, about = found
    base = {"step_size": float(opened.wired.flatten().base)} if opened.wired.has_base else {}
    chosen = {**base, **{key: value for key, value in options.items() if value is not None}}
    opened = start_at(opened, start or {})
    opened = let_move(opened, find_movable(opened.wired))
    return loop_spec(opened, name=label, description=about, differentiated=True, **chosen)


@accepts("build", subsystem=kinds.text.or_none(), outside=kinds.names, outputs=kinds.names.or_none())
def open_model(
    model: object,
    *,
    name: str | None,
    subsystem: str | None,
    outside: Iterable[str],
    outputs: Iterable[str] | None,
) -> tuple[str, OpenDiagram, str] | None:
    """Return the name of what is exported, with its inputs and outputs, and a line about it; None for anything else.

    Raises `OptionError`: for arguments that don't fit together.
    """
    if isinstance(model, SubsystemCall):
        model = model.subsystem
    names = (outside,) if isinstance(outside, str) else tuple(outside)
    about = ""
    opened: OpenDiagram
    if isinstance(model, Subsystem):
        label = name or name_of(model)
        if subsystem is not None or names:
            raise OptionError(
                "subsystem= and outside= choose a part of a diagram; this is a subsystem by itself. Leave them out.",
                block=label,
            )
        about = inspect.cleandoc(model.__doc__ or "").partition("\n")[0]
        opened = open_subsystem(model, object, label)
    else:
        wired = getattr(model, "wired", None)
        if not isinstance(wired, WiredDiagram):
            return None
        if subsystem is not None and names:
            raise OptionError(
                "found subsystem= and outside=; expected one of them. Give one.", block=wired.name, port="outside"
            )
        label = name or name_of(model, subsystem)
        opened = open_whole(wired, names, label) if subsystem is None else open_part(wired, subsystem, label)
    chosen = (outputs,) if isinstance(outputs, str) else outputs
    return label, choose_outputs(opened, None if chosen is None else tuple(chosen)), about


def name_of(model: Any, subsystem: str | None = None) -> str:
    """Return the name of the FMU of a diagram or subsystem without another one."""
    if subsystem is not None:
        return _identifier(subsystem.rpartition(".")[2])
    return _identifier(model.wired.name if hasattr(model, "wired") else model.name)


def _identifier(name: str) -> str:
    found = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"_{found}" if found[:1].isdigit() or not found else found
