"""Records of runs that end early, and files that replace an earlier run's all together."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

from ...blocks.core import LoopwrightError, OptionError, explain_disk_errors
from ...fmus.child_processes import folder_in
from ..results import Run
from ..simulation import Interrupted


@dataclass(frozen=True)
class Record:
    """A run, as far as there is one, and why it ended early, if it did."""

    run: Run | None
    problem: str | None = None
    is_interrupted: bool = False

    @property
    def samples(self) -> int:
        """Number of samples."""
        return 0 if self.run is None else len(self.run.t)

    @property
    def exit_status(self) -> int:
        """Exit status of a command with this run alone."""
        return 130 if self.is_interrupted else int(self.problem is not None)


def record(simulate: Callable[[], Run], *, raised: tuple[type[LoopwrightError], ...] = ()) -> Record:
    """Run, and return the record, also of a run that fails or is interrupted; errors of these classes are raised."""
    try:
        return Record(simulate())
    except raised:
        raise
    except LoopwrightError as error:
        return Record(getattr(error, "run", None), str(error))
    except KeyboardInterrupt as interrupt:
        return Record(interrupt.run if isinstance(interrupt, Interrupted) else None, "interrupted", is_interrupted=True)


def make_folder(name: str) -> Path:
    """Make the folder of ``--out``, and check that files can be written there; OptionError: they can't."""
    folder = Path(name).expanduser()
    failed = f"nothing can be written to the folder {name!r}"
    with explain_disk_errors(failed, folder, "Name another folder.", OptionError, port="--out"):
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    return folder


@contextlib.contextmanager
def replace_files(folder: Path) -> Iterator[Path]:
    """Yield a new folder; at the end its files replace those of the same names in a folder, all or none."""
    with folder_in(folder, ".writing-") as new:
        yield new
        for file in sorted(new.iterdir()):
            file.replace(folder / file.name)
