"""Projects of working engineers: requirements, and the verdict on each that a calculation without the package gives."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

VARIANTS = ("as it is", "breaking", "harmless")
AT_MOST = {"ms", "mt", "gain_margin_low", "overshoot", "settling", "rise", "peak"}
"""Quantities of which one number is the most that is allowed."""
APART = 0.05
"""Least distance of a number from its limit, as a part of the limit: a verdict must not hang on the third digit."""


@dataclass(frozen=True)
class Project:
    """A design with its requirements.

    Attributes
    ----------
    asked : mapping
        Arguments of `Requirements`, with limits by loop and steps with input and output.
    by_hand : callable
        From the changes of a variant to its numbers: ``{"force: phase_margin_deg": 75.5}``.
    breaking, harmless : mapping
        A change that breaks ``broken``, and one that breaks nothing.
    broken : tuple of str
        The requirements that the breaking change turns. The first one is the one that it is named for.
    """

    asked: Mapping[str, Any]
    by_hand: Callable[..., Mapping[str, float]]
    breaking: Mapping[str, Any]
    harmless: Mapping[str, Any]
    broken: tuple[str, ...]
    as_it_is: Mapping[str, Any] = field(default_factory=dict)

    def change(self, variant):
        """Return the change of parameters that makes a variant."""
        return {"as it is": self.as_it_is, "breaking": self.breaking, "harmless": self.harmless}[variant]

    def verdicts(self, variant):
        """Return the written verdict on every requirement of a variant: whether it is met."""
        broken = self.broken if variant == "breaking" else ()
        assert set(broken) <= set(self.limits())
        return {name: name not in broken for name in self.limits()}

    def limits(self):
        """Return every limit as ``{"force: ms": 1.5}``, those of steps as ``{"wanted to angle: overshoot": 0.1}``."""
        found = {f"{wire}: {name}": value for wire, of in self.asked["loops"].items() for name, value in of.items()}
        for step in self.asked["step"]:
            for name in AT_MOST & set(step):
                found[f"{step['input']} to {step['output']}: {name}"] = step[name]
        return found


def check_by_hand(project, variant):
    """Assert that the hand calculation gives the written verdicts, with all numbers well away from their limits."""
    numbers = project.by_hand(**project.change(variant))
    for name, met in project.verdicts(variant).items():
        limit, number = project.limits()[name], numbers[name]
        room = limit - number if name.rpartition(" ")[2] in AT_MOST else number - limit
        assert (room > 0) == met, f"{name}: {number:.4g} against {limit:.4g}"
        assert abs(room) > APART * limit, f"{name}: {number:.4g} is too near to {limit:.4g}"
    return numbers


def of(where, numbers):
    """Return numbers with the name of their loop or step ahead of them."""
    return {f"{where}: {name}": value for name, value in numbers.items()}
