"""Plots of the signals of a sweep: the runs of all samples over each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import OptionError, near, with_unit
from ..plotting import BLUE, COLORS, VERMILION, legend_above, limit_time, shown_figure
from .outcome import SampleOutcome
from .samples import Samples

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def plot_sweep(
    samples: Samples,
    outcomes: Sequence[SampleOutcome | None],
    units: Mapping[str, str],
    diagram_name: str,
    names: Sequence[object],
    xlim: tuple[float, float] | None,
) -> Figure:
    """Draw signals of all runs over time; see `Sweep.plot`."""
    kept = list(dict.fromkeys(name for o in outcomes if o is not None for name in o.signals))
    if not kept:
        raise OptionError(
            "no samples were kept in this sweep, so it has nothing over time to draw. Keep signals: signals=['y'].",
            block=diagram_name,
        )
    for name in names:
        if name not in kept:
            raise OptionError(f"found {name!r} to draw. {near(str(name), kept)}", block=diagram_name, port="names")
    chosen = [str(name) for name in names] or kept
    made = [(k, o.t, o) for k, o in enumerate(outcomes) if o is not None and o.t is not None and len(o.t)]
    ends = [end for _, t, _ in made for end in (t[0], t[-1])]
    shown = np.array(xlim or (min(ends, default=0.0), max(ends, default=1.0)))
    columns = [(name, entry) for name in chosen for entry in _entries(name, made)]
    with shown_figure(0.6 + 1.5 * len(columns)) as figure:
        rows: list[Axes] = list(figure.subplots(len(columns), 1, sharex=True, squeeze=False)[:, 0])
        values = _values_to_color(samples)
        scale: Any = None
        if len(made) > len(COLORS) and values is not None:
            from matplotlib.cm import ScalarMappable
            from matplotlib.colors import LogNorm, Normalize

            low, high = float(values.min()), float(values.max())
            scale = ScalarMappable((LogNorm if low > 0.0 and high > 30.0 * low else Normalize)(low, high), "viridis")
        for ax, (name, entry) in zip(rows, columns, strict=True):
            for k, t, outcome in made:
                y = np.asarray(outcome.signals[name])[(slice(None), *entry)]  # type: ignore[arg-type]
                color: Any = COLORS[k % len(COLORS)] if len(made) <= len(COLORS) else BLUE
                color = scale.to_rgba(values[k]) if scale is not None and values is not None else color
                faint = scale is None and len(made) > len(COLORS)
                ax.plot(t, y, label=_label(samples, k), color=color, alpha=0.4 if faint else 1.0)
                if outcome.failure is not None:
                    ax.plot(t[-1:], y[-1:], marker="x", color=VERMILION, markersize=6, linestyle="none")
            label = name if not entry else f"{name}[{','.join(str(i + 1) for i in entry)}]"
            ax.set_ylabel(with_unit(label, units.get(name, "1")))
            limit_time(ax, shown)
            if xlim is not None:
                ax.set_xlim(*xlim)
        failed = sum(o.failure is not None for _, _, o in made)
        if failed:
            rows[0].set_title(f"×: end of a run that failed ({failed})", loc="right", fontsize="small", color=VERMILION)
        rows[-1].set_xlabel("t [s]")
        if scale is not None:
            figure.colorbar(scale, ax=rows, label=samples.names[0])
        elif len(made) <= len(COLORS):
            legend_above(figure, rows[0])
        else:
            rows[0].set_title(f"{len(made)} runs", loc="left", fontsize="small")
        figure.align_ylabels()
    return figure


def _entries(name: str, made: Sequence[tuple[int, np.ndarray, SampleOutcome]]) -> list[tuple[int, ...]]:
    """Return the entries of a signal, one () of a number."""
    shape = next((o.signals[name].shape[1:] for _, _, o in made if name in o.signals), ())
    return list(np.ndindex(*shape)) if shape else [()]


def _values_to_color(samples: Samples) -> np.ndarray | None:
    """Return the numbers of the only parameter, which colors tell apart; None where there are several."""
    if len(samples.names) != 1:
        return None
    values = [row[0] for row in samples.rows]
    if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values) or len(set(values)) < 2:
        return None
    return np.array(values, dtype=float)


def _label(samples: Samples, k: int) -> str:
    """Return the parameters of a sample as a legend has them."""
    row = zip(samples.names, samples.rows[k], strict=True)
    return ", ".join(
        f"{name} = {value:.6g}" if isinstance(value, float) else f"{name} = {value}" for name, value in row
    )
