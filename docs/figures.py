"""Make the README's figures anew: python docs/figures.py."""

import re
import sys
from contextlib import chdir
from pathlib import Path

HERE = Path(__file__).parent


def first_example() -> str:
    """Return the code that the README opens with."""
    text = (HERE.parent / "README.md").read_text(encoding="utf-8")
    return re.search(r"```python\n(.*?)```", text, re.DOTALL)[1]


def main(folder: Path) -> None:
    """Write the figures into a folder."""
    from loopwright.diagrams import experiments
    from loopwright.diagrams._figures import plot_path

    folder.mkdir(parents=True, exist_ok=True)
    with chdir(folder):
        exec(first_example(), {})  # it writes loop.png
    experiment = experiments.hand_guiding()
    plot_path(experiment, experiment.simulate(progress=False)).savefig(folder / "C_path.png", dpi=120)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE / "images")
