"""Result of an FMU's examination: a verdict in one line, findings with next steps, and the content in short."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from ...blocks.core import Grid, Sheet, ShownAsTable, brief, explain_calls
from ..archive import FmuFault, FmuFinding, FmuSeverity
from .summary import INTERFACES
from .trial import RUNS

_CONTROL = {code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0)) if chr(code) not in "\n\t"}
_CAUSALITIES = {
    "local": "local variable",
    "independent": "independent variable",
    "structuralParameter": "structural parameter",
    "calculatedParameter": "calculated parameter",
}
_MOST_OF_A_FAULT = 5
"""Findings of one kind that the text shows."""
_MOST_IN_A_TABLE = 20
"""Findings that the table of a notebook shows."""


class FmuVerdict(StrEnum):
    """Result of `doctor`."""

    RUNS = "runs here"
    EXPECTED = "should run here, but was not tried"
    NOT_HERE = "does not run here"
    FAILS = "fails here"
    REFUSED = "is refused"


@explain_calls
@dataclass(frozen=True)
class FmuTrial:
    """Trial run of an interface, in its own process.

    Parameters
    ----------
    interface : str
        Element of the description: "CoSimulation", "ModelExchange" or "ScheduledExecution".
    ran : bool
        Whether it ran without a fault.
    seconds : float
        Duration on the clock in s, with the start of the process; 0 if it was not run.
    left : str
        Reason for which it was not run; empty if it was.
    step : float, optional
        Simulated time of each of its steps in s, if it ran in co-simulation.
    """

    interface: str
    ran: bool
    seconds: float = 0.0
    left: str = ""
    step: float | None = None


@explain_calls
@dataclass(frozen=True)
class FmuDiagnosis(ShownAsTable):
    """Result of `doctor`; its text is that of ``loopwright doctor``.

    Parameters
    ----------
    file : str
        The FMU.
    verdict : FmuVerdict
        Whether it runs here.
    findings : tuple of FmuFinding
        Findings, the gravest first.
    summary : dict
        Content, as ``loopwright inspect --json`` has it, without the variables; empty if it can't be read.
    counts : dict
        Number of variables by causality.
    trials : tuple of FmuTrial
        Trial runs.
    """

    file: str
    verdict: FmuVerdict
    findings: tuple[FmuFinding, ...]
    summary: Mapping[str, Any] = field(default_factory=dict)
    counts: Mapping[str, int] = field(default_factory=dict)
    trials: tuple[FmuTrial, ...] = ()

    def __repr__(self) -> str:
        return brief(
            f"examination of {self.file!r}", self.headline.translate(_CONTROL), then="print(…) shows all, .findings"
        )

    @property
    def runs(self) -> bool:
        """Whether it runs here, or should, where it was not tried."""
        return self.verdict in (FmuVerdict.RUNS, FmuVerdict.EXPECTED)

    def of(self, severity: FmuSeverity) -> list[FmuFinding]:
        """Return the findings of a severity."""
        return [finding for finding in self.findings if finding.severity == severity]

    @property
    def headline(self) -> str:
        """The verdict in one line."""
        errors, warnings = self.of(FmuSeverity.ERROR), self.of(FmuSeverity.WARNING)
        if errors and self.runs:
            good = " and ".join(INTERFACES[trial.interface] for trial in self.trials if trial.ran)
            return f"{self.verdict} by {good} only: {_first_sentence(errors[0].found)}"
        if errors:
            more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
            return f"{self.verdict}: {_first_sentence(errors[0].found)}{more}"
        if not warnings:
            return f"{self.verdict}; nothing is wrong with it"
        return f"{self.verdict}, with {len(warnings)} warning{'s' if len(warnings) > 1 else ''}"

    def as_dict(self) -> dict[str, Any]:
        """Return all of it as dictionaries, lists, numbers and texts, for JSON."""
        return {
            "file": self.file,
            "verdict": self.verdict.name.lower(),
            "runs": self.runs,
            "headline": self.headline,
            "findings": [
                {**asdict(f), "severity": f.severity.value, "fault": f.fault.name.lower()} for f in self.findings
            ],
            "trials": [asdict(trial) for trial in self.trials],
            "variables": dict(self.counts),
            "summary": dict(self.summary),
        }

    def __str__(self) -> str:
        return "\n".join(line.translate(_CONTROL) for line in self._lines())

    def _sheet(self) -> Sheet:
        """Return it as a notebook shows it: the content by name, the findings as a table."""
        shown = tuple((str(f.severity), f.found.translate(_CONTROL), f.step.translate(_CONTROL)) for f in self.findings)
        rows, content = shown[:_MOST_IN_A_TABLE], tuple(self._content()) if self.summary else ()
        facts = tuple((label, text.translate(_CONTROL)) for label, text in content)
        grid = Grid("Findings", ("severity", "found", "next"), rows, total=len(shown))
        return Sheet(f"{self.file}: {self.headline}".translate(_CONTROL), facts, (grid,))

    def _lines(self) -> Iterator[str]:
        yield f"{self.file}: {self.headline}"
        for label, text in self._content() if self.summary else ():
            yield f"  {label:<14}{text}"
        shown = Counter[FmuFault]()
        for i, finding in enumerate(self.findings, 1):
            shown[finding.fault] += 1
            if shown[finding.fault] > _MOST_OF_A_FAULT:
                continue
            yield f"  {i}. {finding.severity}: {_indent(finding.found)}"
            yield f"     Next: {_indent(finding.step)}"
        hidden = sum(n - _MOST_OF_A_FAULT for n in shown.values() if n > _MOST_OF_A_FAULT)
        if hidden:
            yield f"  {hidden} more of these kinds are not shown; --json has them."

    def _content(self) -> Iterator[tuple[str, str]]:
        s = self.summary
        kinds = ", ".join(INTERFACES[kind] for kind in s["interfaces"]) or "no interface"
        yield "model", f"{s['model_name']}, FMI {s['fmi_version']}, {kinds}"
        yield "made by", s["generation_tool"] or "(not said)"
        held = [f"{n} {_CAUSALITIES.get(name, name)}{'s' if n > 1 else ''}" for name, n in self.counts.items()]
        n = s["continuous_states"]
        states = f"{n or 'no'} continuous state{'' if n == 1 else 's'}"
        yield "variables", f"{', '.join(held) or 'none'}; {states}"
        yield "binaries", ", ".join(s["platforms"]) or "none"
        yield "this machine", s["native"]["platform"]
        for trial in self.trials:
            name = INTERFACES[trial.interface]
            if trial.left:
                yield "not tried", f"{name}: {trial.left}"
            else:
                steps = "" if trial.step is None else f" of {trial.step:.6g} s"
                done = f"{RUNS[trial.interface]}{steps}" if trial.ran else "failed"
                yield "tried", f"{name}: {done}; took {trial.seconds:.1f} s"


def _first_sentence(text: str) -> str:
    line = " ".join(text.split())
    head = line.partition(". ")[0].rstrip(".")
    return head if len(head) < 160 else f"{head[:157]}…"


def _indent(text: str) -> str:
    return text.strip().replace("\n", "\n     ")
