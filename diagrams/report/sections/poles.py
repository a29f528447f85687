"""Poles of the closed loops of a diagram, and those that are only memory."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ....blocks.core import enumerate_some
from ...frequency import Number, order_key, with_findings
from ..case import Case
from ..pages import Section, TableForm, Texts
from ..stability import ON_THE_LIMIT, Stability, free_motions, poles_in_s, scatter, stability_margin, why_unstable
from ..variant import Variant, in_s
from .subject import SUBJECT_TITLE

TEXTS = Texts(__package__, "poles")
POLES_TITLE = "Closed-loop poles"
MOST_SHOWN = 8
"""Poles, pairs as one, that a text names; of more it says how many there are."""
SAME = 1e-6
"""Relative distance up to which a pole is the conjugate of another one."""
REAL = 1e-9
"""Size of an imaginary part, relative to the pole, up to which it is rounding."""


POLES = TableForm(
    "Poles",
    {
        "variant": "variant",
        "poles": "count",
        "stable": "stable",
        "largest Re s": "slowest",
        "smallest Re s [1/s]": "fastest",
    },
    {"slowest": "{key}.slowest"},
)


def closed_loops(case: Case) -> Section | None:
    """Return the table of each variant's slowest and fastest poles, all loops closed; None without any states."""
    rows = []
    for v in case.usable():
        every, s = in_s(v.model.poles, v.model.dt), poles_in_s(v)
        if every.size:
            how = "eigenvalues; tolerance by perturbing the matrix"
            if v.model.delays is not None:
                how = "the argument of the characteristic function, which counts no root beyond the axis"
                if Stability.of(v) is not Stability.STABLE:
                    how = "the argument of the characteristic function, which counts the roots beyond the axis"
            chains = -np.inf if v.model.delays is None else v.model.characteristic_without(v.free).chains
            largest = Number(max(float(np.max(s.real, initial=-np.inf)), chains), "1/s", scatter(v), how)
            facts = {"count": len(every), "stable": Stability.of(v), "fastest": float(np.min(every.real))}
            facts["slowest"] = with_findings(largest, v.model.findings_on_loops)
            rows.append({"variant": v.title, "key": v.key, **facts})
    if not rows:
        return None
    title = POLES_TITLE if case.loop_wires() else TEXTS.line("no_loop")
    free = free_motions(case.usable())
    text = TEXTS.paragraphs("free", motions=[str(motion) for motion in free]) if free else ()
    return Section("poles", title, text, (POLES.fill(rows, TEXTS.line("closed_loop", limit=ON_THE_LIMIT)),))


def memory(case: Case) -> Section | None:
    """Return the text on states that are only a warm start, None where there are none."""
    states = sorted({name for v in case.usable() for name in v.model.memory})
    return Section("poles", POLES_TITLE, TEXTS.paragraphs("memory", states=states)) if states else None


def list_poles(poles: Iterable[complex], dt: float = 0.0) -> str:
    """Return poles s in 1/s as text, the slowest first; those of a sampled model are s = log(z)/T.

    A sampled pole with z < 0 lies at Im s = ±π/T. It alternates from tick to tick and has no partner, so it is written
    with its z.

    Examples
    --------
    >>> list_poles([-3 + 4j, -1, -3 - 4j])
    '-1, -3 ± 4j'
    >>> list_poles([np.log(-0.5 + 0j) / 0.1], 0.1)
    '-6.93147 + jπ/T (z = -0.5)'
    """
    values = np.asarray(list(poles), dtype=complex)
    values = values[np.isfinite(values) | np.isinf(values.real)]
    left = list(values[np.lexsort((-values.imag, np.abs(values)))])
    shown = []
    while left:
        v = complex(left.pop(0))
        if not np.isfinite(v) or abs(v.imag) <= REAL * max(abs(v), 1e-300):
            shown.append(f"{v.real:.6g}")
        elif dt and abs(abs(v.imag) - np.pi / dt) < 1e-6 / dt:
            shown.append(f"{v.real:.6g} + jπ/T (z = {-np.exp(v.real * dt):.6g})")
        else:
            near = [abs(other - v.conjugate()) for other in left]
            if near and min(near) <= SAME * abs(v):
                del left[int(np.argmin(near))]
                shown.append(f"{v.real:.6g} ± {abs(v.imag):.6g}j")
            else:
                shown.append(f"{v.real:.6g} {'+' if v.imag > 0 else '−'} {abs(v.imag):.6g}j")
    return enumerate_some(shown, MOST_SHOWN) or "none"


def unstable_first(case: Case) -> Section | None:
    """Return the text that names unstable variants and their poles, None where there are none."""
    # it is the beginning of a report: margins and other numbers of an unstable diagram mean nothing
    text = []
    for v in case.usable():
        if Stability.of(v) is Stability.UNSTABLE:
            poles = poles_in_s(v)
            beyond = poles[poles.real > stability_margin(v)]
            said = show_poles(beyond, v) if beyond.size else ""
            text.append(TEXTS.line("unstable", variant=v.title, poles=said, why=why_unstable(v)))
    return Section("subject", SUBJECT_TITLE, tuple(text)) if text else None


def show_poles(poles: np.ndarray, v: Variant) -> str:
    """Return poles in 1/s as text, the fastest growing first, a pair as one; those of a sampled model with |z|."""
    shown = []
    for s in sorted(poles, key=lambda s: (-order_key(s.real), order_key(abs(s.imag)))):
        if s.imag < -ON_THE_LIMIT * abs(s):
            continue  # the conjugate is named
        one = abs(s.imag) <= ON_THE_LIMIT * abs(s)
        text = f"{s.real:.6g}" if one else f"{s.real:.6g} ± {s.imag:.6g}j"
        dt = v.model.dt
        shown.append(text + (f" (|z| = {np.exp(s.real * dt):.6g})" if dt else ""))
    return enumerate_some(shown, MOST_SHOWN)
