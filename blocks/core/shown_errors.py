"""Errors as IPython shows them: the lines of the user's own code and the message, without the frames of this package.

IPython asks an exception for its traceback by ``_render_traceback_`` (its *Custom exceptions*), so nothing of the front
end is changed for other exceptions. ``%tb Verbose`` shows every frame of the last error.
"""

from __future__ import annotations

import copy
import os
import sys
import sysconfig
import traceback
from collections.abc import Iterator
from types import FrameType, TracebackType
from typing import Any

PACKAGE = __name__.partition(".")[0]
WHOLE_MODES = ("Verbose", "Docs")
"""Modes of ``%xmode`` that show all frames."""


def render(error: BaseException) -> list[str]:
    """Return the traceback that IPython prints for an error, as texts in their order."""
    shell = _shell()
    if shell is None:
        return traceback.format_exception(error)
    formatter = shell.InteractiveTB
    if formatter.mode in WHOLE_MODES:
        return _format(formatter, error, error.__traceback__)
    kept, hidden = own_frames(error.__traceback__)
    lines = _format(formatter, _alone(error), kept)
    for cause in _causes(error):
        kept, more = own_frames(cause.__traceback__)
        hidden += more
        if kept is not None:
            lines += ["", "Caused by:", *_format(formatter, _alone(cause), kept, tb_offset=0)]
    if hidden:
        lines.append(f"\n{hidden} {'frame is' if hidden == 1 else 'frames are'} hidden; %tb Verbose shows all.")
    return lines


def own_frames(trace: TracebackType | None) -> tuple[TracebackType | None, int]:
    """Return a traceback without this package's frames and those of libraries below them, and their number."""
    found: list[TracebackType] = []
    hidden, below = 0, False
    while trace is not None:
        mine = _is_of_package(trace.tb_frame)
        below = below or mine
        if mine or (below and _is_of_library(trace.tb_frame)):
            hidden += 1
        else:
            found.append(trace)
        trace = trace.tb_next
    kept: TracebackType | None = None
    for one in reversed(found):
        kept = TracebackType(kept, one.tb_frame, one.tb_lasti, one.tb_lineno)
    return kept, hidden


def _shell() -> Any:
    """Return IPython's shell where this process has one; nothing is imported for it."""
    module = sys.modules.get("IPython")
    return None if module is None else module.get_ipython()


def _format(formatter: Any, error: BaseException, trace: TracebackType | None, **options: Any) -> list[str]:
    return list(formatter.structured_traceback(type(error), error, trace, **options))


def _alone(error: BaseException) -> BaseException:
    """Return a copy of an error without the errors that caused it, or the error where it can't be copied."""
    try:
        alone = copy.copy(error)
    except Exception:  # the constructor of somebody's exception may ask for anything
        return error
    alone.__cause__ = None  # which suppresses the context, too
    return alone


def _causes(error: BaseException) -> Iterator[BaseException]:
    seen = {id(error)}
    while True:
        cause = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
        if cause is None or id(cause) in seen:
            return
        seen.add(id(cause))
        yield cause
        error = cause


def _is_of_package(frame: FrameType) -> bool:
    return str(frame.f_globals.get("__name__", "")).partition(".")[0] == PACKAGE


def _is_of_library(frame: FrameType) -> bool:
    """Return whether a frame is one of Python's own library or of an installed package."""
    path = frame.f_code.co_filename
    folders = (sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    return path.startswith("<frozen") or any(path.startswith(folder + os.sep) for folder in folders if folder)
