"""Worst cases that a TOML file asks for: ranges, a loop, and a number or requirements."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Self

from ...blocks.core import LoopwrightError, OptionError, near
from ..flat import WiredDiagram
from ..linearization import find_signal
from ..requirements import Limit, Requirements, TomlFile
from ..sweeps import Box, read_samples
from .cases import Goal, make_goal
from .loop_places import STEP
from .measures import ContactMeasure
from .varied_parameters import check_parameters, check_ranges
from .worst_case import WorstCase, find_worst_case

TABLE = "worst_case"
"""Name of the table."""
KEYS = ("ranges", "loop", "quantity", "requirements", "contact", "samples", "count", "seed", "starts", "steps", "delay")
"""Entries of the table."""
RANGE = ("low", "high", "scale")
"""Entries of a range that is a table."""


@dataclass(frozen=True)
class WorstCaseTask:
    """Search of a worst case that a TOML file asks for."""

    file: TomlFile
    ranges: Mapping[str, Any]  # or values for a grid, by the paths of parameters
    loops: tuple[str, ...]  # wires
    requirements: Requirements | None
    options: Mapping[str, Any]  # all else that `Diagram.worst_case` takes

    @classmethod
    def read(cls, source: str | os.PathLike[str] | TomlFile) -> Self:
        """Return the task of a file with a table ``[worst_case]``.

        Parameters
        ----------
        source : path or TomlFile
            File such as this one::

                [worst_case]
                loop = "u"
                quantity = "phase_margin_deg"
                count = 100
                seed = 1

                [worst_case.ranges]
                "plant.mass" = [0.9, 1.5]
                "pid.kp" = {low = 1, high = 100, scale = "log"}
        """
        file = source if isinstance(source, TomlFile) else TomlFile.read(source, TABLE)
        table = file.table(TABLE)
        if not table:
            raise file.error(
                'found no table [worst_case]; expected one. Write [worst_case], with loop = "u", and '
                "[worst_case.ranges] below."
            )
        file.check_keys(TABLE, KEYS)
        ranges, samples = dict(_flatten(file, table.get("ranges", {}))), table.get("samples", "latin")
        if isinstance(samples, int | float):
            raise file.error(
                f"found {samples!r}; expected 'latin', 'grid', or a list of samples. Write count = {samples}.",
                f"{TABLE}.samples",
            )
        if not ranges and isinstance(samples, str):
            raise file.error(
                "found no range; expected one at least. Write [worst_case.ranges], and 'plant.mass' = [0.9, 1.5] "
                "below it.",
                TABLE,
            )
        loop = table.get("loop", [])
        loops = (loop,) if isinstance(loop, str) else tuple(loop) if isinstance(loop, list) else (None,)
        if not all(isinstance(wire, str) for wire in loops):
            raise file.error(f'found {loop!r}; expected the name of a wire. Write loop = "u".', f"{TABLE}.loop")
        asked = table.get("requirements")
        limits = None if asked is None else _requirements(file, asked)
        options = {key: value for key, value in table.items() if key not in ("ranges", "loop", "requirements")}
        return cls(file, ranges, loops, limits, options)

    def check(self, diagram: WiredDiagram, requirements: Requirements | None = None) -> None:
        """Check the task against a diagram, before anything is computed."""
        flat = diagram.flatten(None if diagram.has_clock else STEP)
        for wire in self.loops:
            with _placed(self.file, f"{TABLE}.loop"):
                find_signal(flat, wire)
        samples = self.options.get("samples", "latin")
        for name, values in self.ranges.items():
            with _placed(self.file, f"{TABLE}.ranges.{name}"):
                check_parameters(diagram, [diagram.find_parameter(name)], "a worst case", blocks=True)
                if samples == "latin" and not (
                    isinstance(values, Box) or (isinstance(values, list) and len(values) == 2)
                ):
                    raise OptionError(
                        f"found {values!r}; expected a range. Write [low, high], or {{low = 1, high = 9, "
                        'scale = "log"}; or samples = "grid".'
                    )
                if samples == "latin":
                    check_ranges(diagram, {diagram.find_parameter(name): Box.of(values)})
        with _placed(self.file, TABLE):
            if "contact" in self.options:
                ContactMeasure(self.options["contact"], diagram, {})
            else:
                self._goal(diagram, requirements)
            count = self.options.get("count", 100 if samples == "latin" else None)
            read_samples(diagram, self.ranges or None, samples, count=count, seed=self.options.get("seed", 0))

    def find(
        self,
        diagram: WiredDiagram,
        requirements: Requirements | None = None,
        *,
        progress: Callable[[str], None] | None = None,
        **options: Any,
    ) -> WorstCase:
        """Return the worst case; ``options`` are those of `Diagram.worst_case`, such as ``at``.

        ``requirements`` are the report's. They are taken where the file names no number and no limits itself, and they
        limit a number of the loop. ``progress`` gets a line for every case.
        """
        self.check(diagram, requirements)
        given = {key: value for key, value in self.options.items() if key != "quantity"}
        quantity, limits = self._asked(diagram, requirements)
        with _placed(self.file, TABLE):
            return find_worst_case(
                diagram,
                self.ranges or None,
                self.loops or None,
                quantity=quantity,
                requirements=limits,
                progress=progress,
                **given,
                **options,
            )

    def _asked(
        self, diagram: WiredDiagram, requirements: Requirements | None
    ) -> tuple[str | None, Requirements | None]:
        quantity, limits = self.options.get("quantity"), self.requirements
        if "contact" in self.options:
            return quantity, limits
        if quantity is None and limits is None and requirements is not None:
            try:
                make_goal(self.loops, None, requirements, diagram.name)
            except OptionError:  # it limits nothing that a worst case is looked for
                return "disk_margin", None
            return None, requirements
        return ("disk_margin" if quantity is None and limits is None else quantity), limits

    def find_limits(
        self, diagram: WiredDiagram, requirements: Requirements | None = None
    ) -> Mapping[tuple[str, ...], Mapping[str, Limit | None]]:
        """Return the limits of the worst case by loops' wires and numbers' names; None of a number without one."""
        return {} if "contact" in self.options else self._goal(diagram, requirements).loops

    def _goal(self, diagram: WiredDiagram, requirements: Requirements | None) -> Goal:
        quantity, limits = self._asked(diagram, requirements)
        return make_goal(self.loops, quantity, limits, diagram.name)


@contextmanager
def _placed(file: TomlFile, key: str) -> Iterator[None]:
    """Name the file and the line in errors about an entry."""
    try:
        yield
    except LoopwrightError as error:
        raise file.error(error.message, f"{key}.{error.port}" if key == TABLE and error.port in KEYS else key) from None


def _flatten(file: TomlFile, given: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield ranges by the paths of their parameters: dotted keys of TOML are tables in tables."""
    if not isinstance(given, Mapping):
        raise file.error(f"found {given!r}; expected ranges by path. Write [worst_case.ranges].", f"{TABLE}.ranges")
    for key, value in given.items():
        here = f"{path}.{key}" if path else str(key)
        if not isinstance(value, Mapping):
            yield here, value
        elif _is_range(value):
            try:
                yield here, _read_range(value)
            except LoopwrightError as error:
                raise file.error(error.message, f"{TABLE}.ranges.{here}") from None
        else:
            yield from _flatten(file, value, here)


def _is_range(value: Mapping[str, Any]) -> bool:
    """Return whether a table is a range, with or without a mistake, and no parameters by their dotted keys.

    A parameter that is called as an entry of a range has a list or a table, and no number.
    """
    return any(key in RANGE and not isinstance(entry, Mapping | list) for key, entry in value.items())


def _read_range(value: Mapping[str, Any]) -> Box:
    for key in value:
        if key not in RANGE:
            raise OptionError(f"a range has no {key!r}. {near(key, RANGE)}")
    for end in RANGE[:2]:
        if end not in value:
            raise OptionError(f"found a range without {end!r}; expected both ends. Write {{low = 1, high = 9}}.")
    return Box(**value)


def _requirements(file: TomlFile, asked: Any) -> Requirements:
    key = f"{TABLE}.requirements"
    if not isinstance(asked, Mapping):
        raise file.error(f"found {asked!r}; expected limits by name. Write [{key}], and ms = 1.6 below it.", key)
    try:
        return Requirements(**asked)
    except OptionError as error:
        raise file.error_at(error, key) from None
