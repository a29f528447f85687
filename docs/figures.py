"""Make the figures of the README, of the first tutorial and of the page on sweeps again: python docs/figures.py."""

from __future__ import annotations

import re
import sys
from contextlib import chdir
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HERE = Path(__file__).parent


def first_example(page: Path) -> str:
    """Return the first code of a page."""
    text = page.read_text(encoding="utf-8")
    return re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]


def first_loop(page: Path) -> None:
    """Write the drawing and the plot of the tutorial's first loop into the working folder."""
    drawn: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)[:3]:
        exec(code, drawn)  # it writes speed_loop.svg
    drawn["figure"].savefig("first_loop.png", dpi=120)


def bode() -> Figure:
    """Return the Bode diagram of Fig. 3's loop across the path, with its margins marked."""
    from loopwright.diagrams import experiments
    from loopwright.diagrams.report.figures import AxisUnits, DrawnLoops, bode
    from loopwright.diagrams.report.variant import look_of
    from loopwright.frequency import margins

    robot = experiments.compliance().diagram
    variants = {"continuous": robot.continuous(), "sampled_d0": robot}
    variants["sampled_d1"] = robot.replace({"controller.delay": 1})
    loops = {key: variant.linearize().loop("v_perp") for key, variant in variants.items()}
    found = {key: margins(loop) for key, loop in loops.items()}
    names = {"continuous": "continuous", "sampled_d0": "1 kHz", "sampled_d1": "1 kHz, one sample of delay"}
    titles = {key: f"{name}: phase margin {found[key].phase_margin_deg.value:.1f}°" for key, name in names.items()}
    looks = {key: look_of(key, i) for i, key in enumerate(loops, 1)}
    return bode("frequency", DrawnLoops("v_perp", loops, found, titles, looks, AxisUnits())).figure


def main(folder: Path) -> None:
    """Write the figures into a folder."""
    from loopwright.diagrams import experiments
    from loopwright.diagrams.paper.experiment_figures import plot_path

    folder.mkdir(parents=True, exist_ok=True)
    with chdir(folder):
        exec(first_example(HERE.parent / "README.md"), {})  # it writes loop.png
        exec(first_example(HERE / "howto" / "sweeps.md"), {})  # sweep.png
        first_loop(HERE / "tutorial" / "first_loop.md")
    experiment = experiments.hand_guiding()
    plot_path(experiment, experiment.simulate(progress=False), is_shown=False).savefig(folder / "C_path.png", dpi=120)
    bode().savefig(folder / "frequency.png", dpi=120)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "images")
