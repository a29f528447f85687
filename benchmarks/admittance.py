"""Elasticity's cost to the admittance: limits of three robots, confirmed by runs: python benchmarks/admittance.py.

It makes the table and the figure of docs/howto/contact.md again: Fig. 3 with the impedances of Table III, sampled at
1 kHz, around the rigid gantry, the gantry with elastic screws, and the gantry with bristles; ``--figure`` names the
file.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from loopwright.diagrams import Fig3Diagram, experiments
from loopwright.fmus import gantry, gantry_elastic, gantry_stiction
from loopwright.types import Contact

PLANTS = {"rigid": gantry, "elastic": gantry_elastic, "bristles": gantry_stiction}
PUSH = {"rigid": 1e-6, "elastic": 1e-6, "bristles": 1e-8}
"""Velocity in m/s that sets a robot in motion: slow next to the friction's width, and so little that bristles hold."""
TABLE = (0.0, 10.0, 50.0)
DAMPINGS = np.linspace(0.0, 60.0, 13)
SIDES = {"par": "along the path", "perp": "across the path"}
COLORS = {"rigid": "tab:blue", "elastic": "tab:orange", "bristles": "tab:green"}


def contacts() -> Iterator[tuple[str, str, int, Contact]]:
    """Yield the contacts of all plants, in both directions, without and with a sample of delay."""
    for name, plant in PLANTS.items():
        for delay in (0, 1):
            diagram: Fig3Diagram = experiments.compliance(plant=plant.build(), delay=delay).diagram
            for side in SIDES:
                yield name, side, delay, diagram.contact(direction=side)


def print_table(found: list[tuple[str, str, int, Contact]]) -> dict[tuple[str, str, int, float], float]:
    """Print limits with the growth rates of their runs; return the limits that the runs have confirmed."""
    confirmed = {}
    print("| robot | direction | delay | environment | largest | at rad/s | growth at 0.97, 1.03, run (model) | m/s |")
    for name, side, delay, contact in found:
        cases = [("stiffness", {"damping": b}, f"k_e at b_e = {b:g} N s/m") for b in TABLE]
        for vary, held, text in [*cases, ("mass", {}, "m_e")]:
            limit = contact.stability_limit(vary, **held)
            run = contact.confirm(limit, push=PUSH[name])
            rates = ", ".join(f"{t.measured:.4g} ({t.predicted:.4g})" for t in run.trials)
            fastest = max(t.fastest for t in run.trials)
            print(
                f"| {name} | {side} | d{delay} | {text} | {limit.value:.5g} {limit.unit} | {limit.frequency:.4g} "
                f"| {rates} | {fastest:.1g} |"
            )
            if vary == "stiffness":
                confirmed[name, side, delay, held["damping"]] = limit.value
    return confirmed


def draw(
    found: list[tuple[str, str, int, Contact]], confirmed: dict[tuple[str, str, int, float], float], file: Path
) -> None:
    """Draw admittances, and limits of stiffness over the damping of the environment."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.6), layout="constrained")
    axes = figure.subplots(2, 2)
    omega = np.geomspace(0.5, 0.99 * math.pi / 1e-3, 500)
    for (side, title), (top, bottom) in zip(SIDES.items(), axes.T, strict=True):
        for name, where, delay, contact in found:
            if where != side:
                continue
            shown = contact.admittance(omega)
            if delay == 0:
                if name == "rigid" and shown.target is not None:
                    top.loglog(omega, np.abs(shown.target), "k:", label="filter")
                top.loglog(omega, np.abs(shown.rendered), color=COLORS[name], label=name)
                first = contact.passivity().frequency
                if math.isfinite(first):
                    at = np.abs(contact.admittance([first]).rendered)
                    top.loglog([first], at, "v", color=COLORS[name])
            limits = [contact.stability_limit("stiffness", damping=b).value for b in DAMPINGS]
            style = "-" if delay == 0 else "--"
            label = name if delay == 0 else f"{name}, one sample of delay"
            bottom.semilogy(DAMPINGS, limits, style, color=COLORS[name], label=label)
            points = {b: v for (n, s, d, b), v in confirmed.items() if (n, s, d) == (name, side, delay)}
            bottom.semilogy(list(points), list(points.values()), "o", color=COLORS[name], markersize=4)
        top.set(title=f"Admittance {title} (▾: Re Y < 0)", xlabel="ω [rad/s]", ylabel="|Y| [m/(N s)]")
        bottom.set(title=f"Largest stiffness {title} (●: tried)", xlabel="b_e [N s/m]", ylabel="k_e [N/m]")
        for one in (top, bottom):
            one.grid(visible=True, which="both", alpha=0.25)
    axes[0, 1].legend(fontsize=8)
    axes[1, 0].legend(fontsize=8, loc="lower right")  # of both directions
    figure.savefig(file, dpi=120)


def main() -> None:
    """Print the table, and save the figure where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--figure", type=Path, help="file of the figure, such as docs/images/elasticity.png")
    arguments = parser.parse_args()
    found = list(contacts())
    confirmed = print_table(found)
    if arguments.figure is not None:
        draw(found, confirmed, arguments.figure)


if __name__ == "__main__":
    main()
