"""Requirements on the loops, step responses and other numbers of a diagram's variants."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from types import MappingProxyType
from typing import Any, ClassVar

from ...blocks.core import (
    LoopwrightError,
    OptionError,
    UnknownNameError,
    accepts,
    brief,
    explain_calls,
    kinds,
    near,
    shorten,
)
from .contact_limits import ContactLimits, read_contacts
from .verdicts import SENSES, STEP_SENSES, Limit, make_limit

EVERY_STATE = "every state"
"""Value of ``stable`` by which free motions count, too: the strict rule."""
PLACES = ("input", "output", "size", "length")
"""Entries of a step's requirement that are no limits."""


class StepLimits:
    """Limits of a response to a step that is added to a wire of the running diagram.

    Parameters
    ----------
    input : str
        Wire to whose consumers the step is added; each loop's own wire without it.
    output : str
        Wire that responds to a step at ``input``; without it the loop's own answer at the wire, as the complementary
        sensitivity T.
    size : float, optional
        Height of the step in the wire's unit. Without it, that of the source's own step at an input that a `Step` or
        another source that steps gives; else small, 1e-2 of 1 + the signal's size.
    length : float, optional
        Length of the run in s; without it some time constants of the slowest pole, and at least thrice the limits.
    **limits : float or (float, float)
        ``overshoot`` (a share of the final change), ``settling`` (s, to within 2 %), ``rise`` (s, 10 % to 90 %),
        ``peak`` (the largest size of the output's change).

    Raises
    ------
    OptionError
        An unknown name, a limit that is none, or no limit at all.
    """

    def __init__(
        self,
        input: str = "",  # noqa: A002
        output: str = "",
        size: float | None = None,
        length: float | None = None,
        **limits: Any,
    ):
        for name, text in (("input", input), ("output", output)):
            if not isinstance(text, str):
                raise OptionError(f"found {text!r}; expected the name of a wire. Give one.", port=f"step.{name}")
        for name, number in (("size", size), ("length", length)):
            if number is not None and (
                isinstance(number, bool) or not isinstance(number, int | float) or not 0 < abs(number) < math.inf
            ):
                raise OptionError(f"found {number!r}; expected a number that is not 0. Give one.", port=f"step.{name}")
        if length is not None and length < 0:
            raise OptionError(f"found {length!r}; expected a positive time in s. Give one.", port="step.length")
        for name in limits:
            if name not in STEP_SENSES:
                hint = near(name, [*STEP_SENSES, *PLACES])
                raise OptionError(f"a step response has no {name!r}. {hint}", port=f"step.{name}")
        self.input, self.output = input, output
        self.size = None if size is None else float(size)
        self.length = None if length is None else float(length)
        found = {name: make_limit(name, given, STEP_SENSES[name], f"step.{name}") for name, given in limits.items()}
        self.limits: Mapping[str, Limit] = MappingProxyType(found)
        if not found:
            raise OptionError(f"found no limit; expected some of {', '.join(STEP_SENSES)}. Give one.", port="step")

    def __repr__(self) -> str:
        ends = " → ".join(name for name in (self.input, self.output) if name)
        size = "" if self.size is None else f" of {self.size:g}"
        texts = ", ".join(f"{name} {limit}" for name, limit in self.limits.items())
        return f"step{size}{f' {ends}' if ends else ''}: {texts}"

    @classmethod
    def of(cls, given: Any) -> StepLimits:
        """Return the limits that a mapping has, or `StepLimits` themselves."""
        if isinstance(given, StepLimits):
            return given
        if not isinstance(given, Mapping):
            raise OptionError(
                f'found {given!r}; expected a mapping, such as {{"overshoot": 0.3, "settling": 0.5}}. Give one.',
                port="step",
            )
        return cls(**{str(name): value for name, value in given.items()})


class LoopLimits:
    """Limits of a loop's numbers.

    Parameters
    ----------
    step : mapping or StepLimits, optional
        Limits of the loop's response to a step at its wire.
    variants : mapping or iterable of str, optional
        Further variants that are judged, by their keys such as ``sampled_d1``, with limits that replace these.
    to : str or iterable of str, optional
        Inputs ahead of which the loop's wire is cut, such as ``"plant.u"``: the loop at these consumers alone. An
        empty list cuts it for all. Without it a report cuts a wire that also feeds a model of the controller's own at
        the plant's input.
    **limits : float or (float, float)
        ``phase_margin_deg``, ``gain_margin_low``, ``gain_margin_high``, ``delay_margin_s``, ``delay_margin_samples``,
        ``modulus_margin``, ``disk_margin`` and ``bandwidth`` (rad/s): at least; ``ms`` and ``mt``: at most. Of the low
        gain margin: at most. Two numbers are a range.

    Raises
    ------
    OptionError
        An unknown name, or a limit that is none.
    """

    to: tuple[str, ...] | None = None

    def __init__(self, *, step: Any = None, variants: Any = None, to: Any = None, **limits: Any):
        if to is not None:
            self.to = _read_inputs(to)
        for name in limits:
            if name not in SENSES:
                hint = _instead_of(name, limits[name]) or near(name, self._names())
                raise OptionError(f"there is no requirement {name!r}. {hint}", port=name)
        found = {name: make_limit(name, given, SENSES[name]) for name, given in limits.items() if given is not None}
        self.limits: Mapping[str, Limit] = MappingProxyType(found)
        self.step = None if step is None else StepLimits.of(step)
        if self.step is not None and (self.step.input or self.step.output):
            named = "an input" if self.step.input else f"the output {self.step.output!r} without an input"
            raise OptionError(
                f"found {named}; expected neither here: a loop's own step is added at its wire, and its answer "
                "is read there. Write a step from one wire to another at the top, with both: "
                "step={'input': 'wish', 'output': 'y', …}, in a file [[step]].",
                port="step.input" if self.step.input else "step.output",
            )
        self.variants: Mapping[str, LoopLimits] = MappingProxyType(_variants(variants))

    def __repr__(self) -> str:
        texts = [f"{name} {limit}" for name, limit in self.limits.items()]
        steps = [repr(step) for step in (self.step, *getattr(self, "steps", ())) if step is not None]
        loops = [f"{wire}: {limits!r}" for wire, limits in getattr(self, "loops", {}).items()]
        more = f"variants {', '.join(self.variants)}" if self.variants else ""
        return brief(self._kind, *texts, *steps, *loops, more, then=".limits, .step, .variants")

    _kind: ClassVar[str] = "limits of a loop"

    @staticmethod
    def _names() -> tuple[str, ...]:
        return (*SENSES, "step", "variants", "to")

    @property
    def is_empty(self) -> bool:
        """Whether nothing is limited here, in no variant."""
        return not self.limits and self.step is None and all(v.is_empty for v in self.variants.values())


@explain_calls
class Requirements(LoopLimits):
    """Requirements on a design: limits of its loops' margins, its step responses, and any other number of its report.

    The limits hold for every loop of the diagram as it is. ``loops`` has others for single loops, and ``variants`` has
    further variants that are judged, such as one with a sample of delay more.

    Parameters
    ----------
    step : mapping, `StepLimits`, or list of them, optional
        Limits of responses to a step in the running co-simulation, such as ``{"overshoot": 0.3, "settling": 0.5}``: of
        every loop at its wire; with ``input``, and ``output``, from one wire to another.
    loops : mapping of str to mapping, optional
        By a loop's wire, or its key in the report: limits that replace the general ones, as `LoopLimits`.
    variants : mapping or iterable of str, optional
        Further variants that are judged, by their keys such as ``sampled_d1``; with limits that replace the general
        ones.
    numbers : mapping of str to (float, float), optional
        Ranges of any numbers of the report, by their dotted paths.
    contact : mapping, optional
        Limits of coupled stability of the report's contacts, as `ContactLimits`: ``{"stiffness": 5e4}`` of all, and
        ``{"hand": {"stiffness": 5e4, "with": {"damping": 10}}}`` of the one with that name. A list has several.
    stable : bool or "every state"
        Whether all closed-loop poles of the diagram as it is have to be stable. A motion that nothing notices, such as
        that of an angle that nothing feeds back, doesn't count; with ``"every state"`` it does.
    **limits : float or (float, float)
        As of `LoopLimits`.

    Raises
    ------
    OptionError
        An unknown name, or a limit that is none.

    Examples
    --------
    >>> asked = Requirements(phase_margin_deg=45, loops={"u": {"ms": 1.6}}, variants=["sampled_d1"])
    >>> {name: str(limit) for name, limit in asked.limits_of(["u"], "sampled_d1").items()}
    {'phase_margin_deg': '≥ 45', 'ms': '≤ 1.6'}
    """

    _kind = "requirements"

    @accepts(
        None,
        stable=kinds.either(kinds.flag, kinds.choice(EVERY_STATE)).worded(
            "true, false or 'every state'", "Give one of them."
        ),
        loops=kinds.one_of_class(Mapping, "limits by loop").worded(
            step="Write [loops.u], and ms = 1.6 below it; in Python loops={'u': {'ms': 1.6}}."
        ),
        numbers=kinds.one_of_class(Mapping, "ranges by dotted path").worded(
            step="Write [numbers], and 'poles.sampled_d0.slowest' = [-100, -2] below it; in Python "
            "numbers={…: (-100, -2)}."
        ),
    )
    def __init__(
        self,
        *,
        step: Any = None,
        loops: Any = None,
        variants: Any = None,
        numbers: Any = None,
        contact: Any = None,
        stable: bool | str = True,
        **limits: Any,
    ):
        steps = [StepLimits.of(one) for one in (step if isinstance(step, list | tuple) else [step]) if one is not None]
        own = [one for one in steps if not one.input]
        if len(own) > 1:
            raise OptionError("found two without an input; expected one. Name the wires of the others.", port="step")
        if "to" in limits:
            raise OptionError(
                "found it for all loops; expected it for one. Write [loops.u], and to = 'plant.u' below it; in Python "
                "loops={'u': {'to': 'plant.u'}}.",
                port="to",
            )
        super().__init__(step=own[0] if own else None, variants=variants, **limits)
        self.stable = stable
        self.steps: tuple[StepLimits, ...] = tuple(one for one in steps if one.input)
        self.loops: Mapping[str, LoopLimits] = MappingProxyType(
            {str(wire): _loop_limits(given, f"loops.{wire}") for wire, given in (loops or {}).items()}
        )
        self.contacts: Mapping[str, tuple[ContactLimits, ...]] = MappingProxyType(read_contacts(contact))
        self.place: Callable[[LoopwrightError, str], LoopwrightError] | None = None
        self.numbers: Mapping[str, Limit] = MappingProxyType(
            {
                str(path): make_limit(repr(str(path)), given, None, f"numbers.{path}")
                for path, given in (numbers or {}).items()
            }
        )

    @staticmethod
    def _names() -> tuple[str, ...]:
        return (*SENSES, "step", "loops", "variants", "numbers", "contact", "stable")

    def error_at(self, error: LoopwrightError, key: str) -> LoopwrightError:
        """Return an error about an entry: with the file and the line where the requirements are those of a file."""
        if self.place is None:
            return error
        placed = self.place(error, key)
        return UnknownNameError(placed.message) if isinstance(error, UnknownNameError) else placed

    @property
    def every_state(self) -> bool:
        """Whether motions that nothing notices count as instabilities, too."""
        return isinstance(self.stable, str)  # the one text that it may be

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of wires, ports and loops on which something is required: of steps, loops and numbers."""
        ends = [name for step in self.steps for name in (step.input, step.output) if name]
        parts = [part for path in self.numbers for part in path.split(".")[1:2]]
        return tuple(dict.fromkeys((*ends, *self.loops, *parts)))

    @property
    def further_variants(self) -> tuple[str, ...]:
        """Keys of the variants that are judged along with the diagram as it is."""
        named = [*self.variants, *(key for limits in self.loops.values() for key in limits.variants)]
        return tuple(dict.fromkeys(named))

    def judges(self, names: Iterable[str], variant: str) -> bool:
        """Return whether a further variant of a loop is judged; ``names`` are the loop's key and wire."""
        return variant in self.variants or any(variant in of.variants for of in self._of_loop(names))

    def inputs_of(self, names: Iterable[str]) -> tuple[str, ...] | None:
        """Return the inputs ahead of which a loop is cut, none for all its consumers; None if nothing says it."""
        return next((limits.to for limits in self._of_loop(names) if limits.to is not None), None)

    def with_loops(self, names: Mapping[str, str]) -> Requirements:
        """Return the requirements with other names of some loops, which are cut at their places already."""
        made, loops = copy(self), dict[str, LoopLimits]()
        for name, limits in self.loops.items():
            loops[names.get(name, name)] = placed = copy(limits)
            if name in names and placed.to:
                placed.to = None
        made.loops = MappingProxyType(loops)
        return made

    def limits_of(self, names: Iterable[str], variant: str) -> dict[str, Limit]:
        """Return the limits of a loop in a variant, the special ones in place of the general ones."""
        found: dict[str, Limit] = {}
        for limits in self._layers(names, variant):
            found |= limits.limits
        return found

    def limits_named(self, names: Iterable[str], variant: str) -> dict[str, Limit]:
        """Return the limits that a loop has by its own name."""
        found: dict[str, Limit] = {}
        for limits in self._layers(names, variant, is_general=False):
            found |= limits.limits
        return found

    def limits_of_variant(self, names: Iterable[str], variant: str) -> dict[str, Limit]:
        """Return the limits that are given for a variant of a loop by the variant's own key."""
        found: dict[str, Limit] = {}
        for limits in (self, *self._of_loop(names)):
            if variant in limits.variants:
                found |= limits.variants[variant].limits
        return found

    def step_of(self, names: Iterable[str], variant: str) -> StepLimits | None:
        """Return the limits of the response to a step at a loop's own wire, None where there are none."""
        found = None
        for limits in self._layers(names, variant):
            found = found if limits.step is None else limits.step
        return found

    def step_named(self, names: Iterable[str], variant: str) -> StepLimits | None:
        """Return the limits of that response which a loop has by its own name."""
        found = None
        for limits in self._layers(names, variant, is_general=False):
            found = found if limits.step is None else limits.step
        return found

    def _of_loop(self, names: Iterable[str]) -> list[LoopLimits]:
        return [self.loops[name] for name in dict.fromkeys(names) if name in self.loops]

    def _layers(self, names: Iterable[str], variant: str, *, is_general: bool = True) -> Iterator[LoopLimits]:
        mine = self._of_loop(names)
        for limits in (self, *mine) if is_general else mine:
            yield limits
            if variant in limits.variants:
                yield limits.variants[variant]


_DECIBELS = ("gain_margin_db", "gm_db", "gain_margin_high_db")
_FACTORS = ("gain_margin", "gm", "amplitude_margin")
_OF_STEPS = {name: name for name in STEP_SENSES} | {
    **dict.fromkeys(("settling_time", "ts"), "settling"),
    **dict.fromkeys(("rise_time", "tr"), "rise"),
}


def _instead_of(name: str, given: Any) -> str:
    """Return what to write for words of textbooks and other tools that are no limits of a loop; "" for others."""
    if name in _OF_STEPS:
        return f"It is one of a step response: step={{{_OF_STEPS[name]!r}: {shorten(given)}}}."
    if name in _DECIBELS and kinds.is_real(given):
        return f"Gain margins are factors: write gain_margin_high={10.0 ** (given / 20.0):.4g}, which is {given:g} dB."
    if name in _DECIBELS + _FACTORS:
        return (
            "Gain margins are factors: write gain_margin_high=2.0, which is 6 dB, and gain_margin_low=0.5 for the one "
            "to lower gains."
        )
    return ""


def _read_inputs(given: Any) -> tuple[str, ...]:
    named = (given,) if isinstance(given, str) else given
    if not isinstance(named, list | tuple) or not all(isinstance(name, str) and name for name in named):
        raise OptionError(f"found {given!r}; expected inputs of blocks. Give one, such as 'plant.u'.", port="to")
    return tuple(named)


def _variants(given: Any) -> dict[str, LoopLimits]:
    if given is None:
        return {}
    if isinstance(given, str):
        return {given: LoopLimits()}
    if isinstance(given, Mapping):
        found = {str(key): _loop_limits(limits, f"variants.{key}") for key, limits in given.items()}
        for key, limits in found.items():
            if limits.to is not None:
                raise OptionError(
                    "found it for a variant; expected it for a loop, whose variants are all cut at one place. Write it "
                    "in [loops.NAME].",
                    port=f"variants.{key}.to",
                )
        return found
    if isinstance(given, Iterable):
        keys = list(given)
        if all(isinstance(key, str) for key in keys):
            return {key: LoopLimits() for key in keys}
    raise OptionError(
        f"found {given!r}; expected keys of variants. Give a list of them, such as ['sampled_d1'].", port="variants"
    )


def _loop_limits(given: Any, port: str) -> LoopLimits:
    if type(given) is LoopLimits:
        return given
    if not isinstance(given, Mapping):
        raise OptionError(
            f"found {given!r}; expected limits by name. Write [{port}], and ms = 1.6 below it; in Python "
            "{'ms': 1.6}.",
            port=port,
        )
    try:
        return LoopLimits(**{str(name): limit for name, limit in given.items()})
    except OptionError as error:
        raise OptionError(error.message, port=f"{port}.{error.port}" if error.port else port) from None


def write_requirements(value: Any) -> str:
    """Return what to write in place of a mapping of limits, or of anything else that is no `Requirements`."""
    limits = "phase_margin_deg=45"
    if isinstance(value, Mapping) and value and all(isinstance(key, str) and key.isidentifier() for key in value):
        limits = ", ".join(f"{key}={shorten(limit)}" for key, limit in value.items())
    return f"Write requirements=Requirements({limits}), after from loopwright import Requirements."


REQUIREMENTS = kinds.one_of_class(Requirements, "Requirements(…)").worded(step=write_requirements)
"""Kind of an argument that takes requirements."""
