"""Modules of earlier versions: unpickling one raises an error that names the version."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED_IN = "0.2.0"
"""Version in which every file moved into a sub-package."""
_PLANTS = "bouncing_ball|dc_motor|gantry|gantry_contact|gantry_elastic|gantry_stiction|mass_spring_damper|scara"
_BEFORE = re.compile(rf"loopwright\.(blocks|fmus|diagrams)\.(_[a-z]\w*|fig3|experiments|{_PLANTS})")


class _FinderOfMovedModules:
    """Last finder of modules: it finds none, and raises an error for modules that have moved."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        found = _BEFORE.fullmatch(fullname)
        if found is None:
            return None
        raise ModuleNotFoundError(
            f"found {fullname}, a module of loopwright before {MOVED_IN}. A pickle or a saved state that names it was "
            f"made by an earlier version: open it there, or make it again. In code, import from loopwright.{found[1]}.",
            name=fullname,
        )


def explain_moved_modules() -> None:
    """Make the import of a module that has moved raise an error that says so."""
    if not any(type(finder).__name__ == _FinderOfMovedModules.__name__ for finder in sys.meta_path):
        sys.meta_path.append(_FinderOfMovedModules())
