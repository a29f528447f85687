"""The pages for users: the README's code, the pages under docs/ and the notebooks run, and say what is so."""

import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import types
import zipfile
from contextlib import chdir, nullcontext, redirect_stdout
from pathlib import Path
from xml.etree import ElementTree as ET

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

import loopwright.fmus
from loopwright.diagrams import Run
from loopwright.diagrams.cli import main

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
QUICK = ["09_state_feedback", "12_checked_by_hand"]  # the cheapest notebooks: the code of these runs in the quick set


def blocks_of_code(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def run_page(page, folder):
    """Run the code of a page of docs/ in a folder, as one module, and return the names that it leaves.

    What its runs have recorded are numbers.
    """
    module = types.ModuleType("page")
    scope = vars(module)
    with chdir(folder), pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "page", module)  # blocks of a page are pickled by their module's name
        for snippet in blocks_of_code((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")):
            exec(snippet, scope)
    plt.close("all")
    runs = {name: made for name, made in scope.items() if isinstance(made, Run)}
    for name, run in runs.items():
        for signal in run.names:
            assert run[signal].dtype.kind not in "fc" or np.isfinite(run[signal]).all(), (
                f"{page}.md: {name}[{signal!r}]"
            )
    return scope


def run_commands(text, folder):
    """Run the lines of a page's shell code that are commands of an installed package: its first one as a process."""
    lines = [line for part in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in part.splitlines()]
    commands = [shlex.split(line, comments=True) for line in lines if line.startswith(("loopwright ", "fmpy "))]
    assert len(commands) >= 3
    for i, (program, *arguments) in enumerate(commands):
        if i and program == "loopwright":
            with chdir(folder):
                assert main(arguments) == 0, arguments
            continue
        found = shutil.which(program, path=os.path.dirname(sys.executable))
        done = subprocess.run(
            [found, *arguments], cwd=folder, capture_output=True, text=True, check=False, env=os.environ
        )
        assert done.returncode == 0, f"{program} {arguments}: {done.stdout}{done.stderr}"


@pytest.mark.slow
def test_a_script_of_the_readmes_code_shows_no_warnings(tmp_path):
    (tmp_path / "script.py").write_text("\n".join(blocks_of_code((ROOT / "README.md").read_text(encoding="utf-8"))))
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"} | {"MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr


def test_the_readme_opens_with_a_closed_loop_in_ten_lines_that_runs(tmp_path):
    first, *more = blocks_of_code((ROOT / "README.md").read_text(encoding="utf-8"))
    lines = [line for line in first.splitlines() if line.strip()]
    assert len(lines) <= 10
    scope = {}
    with chdir(tmp_path):
        exec(first, scope)
        assert (tmp_path / "loop.png").read_bytes().startswith(b"\x89PNG")
        assert isinstance(scope["run"].plot("position"), matplotlib.figure.Figure)  # which a notebook shows
        for snippet in more:
            exec(snippet, scope)
    run_commands((ROOT / "README.md").read_text(encoding="utf-8"), tmp_path)


def as_in_a_table(value):
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.6g}"


def rows_of_a_table(text):
    """Yield the names in the first column of a page's tables, and the other cells."""
    for name, cells in re.findall(r"^\| `([\w.]+)` \|(.*)\|$", text, re.MULTILINE):
        yield name, [c.strip() for c in re.split(r"(?<!\\)\|", cells)]


@pytest.mark.slow
def test_the_page_on_frequencies_runs_and_its_numbers_are_those_it_gives(tmp_path):
    text = (ROOT / "docs" / "howto" / "frequency.md").read_text(encoding="utf-8")
    scope = run_page("howto/frequency", tmp_path)
    rows = [*rows_of_a_table(text)]
    assert len(rows) > 10
    for name, told in rows:
        made = [
            getattr(scope["disks" if hasattr(scope["disks"][v], name) else "found"][v], name)
            for v in ("continuous", "sampled_d0", "sampled_d1")
        ]
        assert told[-3:] == [as_in_a_table(float(v)) for v in made], name


@pytest.mark.slow
def test_the_page_on_contacts_runs_and_its_numbers_are_those_it_gives(tmp_path):
    text = (ROOT / "docs" / "howto" / "contact.md").read_text(encoding="utf-8")
    scope = run_page("howto/contact", tmp_path)
    rows = [(name, told) for name, told in rows_of_a_table(text) if name in scope["limits"]]
    assert len(rows) == 5
    for name, told in rows:
        limit = scope["limits"][name]
        assert told == [as_in_a_table(limit.value), as_in_a_table(limit.rule_of_thumb)], name
    assert f"here {scope['sign'].frequency:.3f} rad/s" in text


QUICK_PAGES = {"explanation/coupling", "howto/algebraic_loop", "tutorial/first_loop"}
TESTED_ELSEWHERE = {
    "howto/contact",  # above
    "howto/export",  # below
    "howto/frequency",
    "reference/blocks",  # tests/diagrams/contract
    "reference/fmus",  # tests/fmus/fmu_block
}
PAGES = sorted(
    page.relative_to(ROOT / "docs").with_suffix("").as_posix()
    for page in (ROOT / "docs").rglob("*.md")
    if blocks_of_code(page.read_text(encoding="utf-8"))
)


def test_the_quick_and_the_special_pages_exist():
    assert {*PAGES} > QUICK_PAGES | TESTED_ELSEWHERE
    assert len(PAGES) > 20


@pytest.mark.parametrize(
    "page",
    [
        page if page in QUICK_PAGES else pytest.param(page, marks=pytest.mark.slow)
        for page in PAGES
        if page not in TESTED_ELSEWHERE
    ],
)
def test_the_page_runs(cache, tmp_path, page):
    run_page(page, tmp_path)


@pytest.mark.slow
def test_the_page_on_export_runs(tmp_path):
    text = (ROOT / "docs" / "howto" / "export.md").read_text(encoding="utf-8")
    model, *more = blocks_of_code(text)
    (tmp_path / "thermostat.py").write_text(model, encoding="utf-8")
    (tmp_path / "page.py").write_text("\n".join(more), encoding="utf-8")  # in a process, as a file
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True, check=False, env=os.environ
    )
    assert done.returncode == 0, done.stderr
    run_commands(text, tmp_path)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", ["gantry", "bouncing_ball"])
def test_the_page_on_export_tells_the_flags_as_they_are(fmi, model, tmp_path, uncompiled):
    path = getattr(loopwright.fmus, model).build(out=tmp_path, fmi=fmi)
    with zipfile.ZipFile(path) as archive:
        tree = ET.fromstring(archive.read("modelDescription.xml"))
    text = (ROOT / "docs" / "reference" / "exported_fmus.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)`(?: \(2\.0: `(\w+)`\))? \|(.*)\|$", text.split("## Integrators")[0], re.MULTILINE)
    rows = [
        row for row in rows if row[2].count("|") == 3
    ]  # of models with both interfaces; diagrams have a table of theirs
    with_events = "true" if model == "bouncing_ball" else "false"
    spelling = {
        "canGetAndSetFMUState": "canGetAndSetFMUstate",
        "canSerializeFMUState": "canSerializeFMUstate",
        "providesDirectionalDerivatives": "providesDirectionalDerivative",
    }
    for column, interface in enumerate(("CoSimulation", "ModelExchange"), 0 if fmi == 3 else 2):
        told = {}
        for name, name2, cells in rows:
            cell = [c.strip() for c in cells.split("|")][column]
            if cell != "–":
                key = name if fmi == 3 else name2 or spelling.get(name, name)
                told[key] = with_events if cell == "with events" else cell
        attributes = dict(tree.find(interface).attrib)
        del attributes["modelIdentifier"]
        assert told == attributes, interface


NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
TINY = 1e-6
"""Size below which a printed number may be rounding: another machine's has the same size, within a factor of a thousand."""


def printed(cell):
    """Return the text that a cell has printed, without empty lines and without progress, which slow machines show."""
    shown = [o for o in cell.get("outputs", []) if not any("widget" in kind for kind in o.get("data", {}))]
    texts = [o["text"] if "text" in o else o.get("data", {}).get("text/plain", "") for o in shown]
    return "\n".join(line for line in "".join(texts).splitlines() if line.strip())


def agree(one, other):
    """Whether two printed numbers are the same one, on two machines."""
    a, b = abs(float(one)), abs(float(other))
    if float(one) * float(other) >= 0 and 0 < max(a, b) < TINY and min(a, b) > 0:
        return max(a, b) < 1000 * min(a, b)
    return abs(float(one) - float(other)) <= 0.01 * max(a, b) + 1e-12


def check_printed(stored, made):
    """Compare the texts that a notebook holds with those of today; its cells with the tag "machine" print times."""
    for number, (old, new) in enumerate(zip(stored["cells"], made["cells"], strict=True)):
        if old["cell_type"] != "code" or "machine" in old["metadata"].get("tags", ()):
            continue
        texts = printed(old), printed(new)
        numbers = [NUMBER.findall(text) for text in texts]
        words = [NUMBER.sub("…", text) for text in texts]
        same = len(numbers[0]) == len(numbers[1]) and all(map(agree, *numbers))
        assert (words[0], same) == (words[1], True), (
            f"cell {number} holds what it printed once; execute the notebook again"
        )


@pytest.mark.parametrize(
    ("stored", "made", "fresh"),
    [
        ("within 8e-08 s", "within 1e-12 s", False),
        ("within 3e-12 s", "within 1e-12 s", True),
        ("11 switchings", "12 switchings", False),
        ("energy 0.218347 kWh", "energy 0.218348 kWh", True),
        ("energy 0.218 kWh", "power 0.218 kWh", False),
    ],
)
def test_a_notebook_with_old_numbers_is_noticed(stored, made, fresh):
    def notebook(text):
        output = {"output_type": "stream", "name": "stdout", "text": text}
        return {"cells": [{"cell_type": "code", "metadata": {}, "outputs": [output]}]}

    with nullcontext() if fresh else pytest.raises(AssertionError, match="cell 0"):
        check_printed(notebook(stored), notebook(made))


@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", QUICK)
def test_the_code_of_a_notebook_runs_and_prints_what_the_notebook_holds(name, monkeypatch):
    import nbformat

    monkeypatch.chdir(ROOT / "notebooks")
    stored = [
        cell
        for cell in nbformat.read(ROOT / "notebooks" / f"{name}.ipynb", as_version=4).cells
        if cell.cell_type == "code"
    ]
    scope, made = {}, []
    for cell in stored:
        with redirect_stdout(io.StringIO()) as text:
            exec(cell.source, scope)
        cell.outputs = [o for o in cell.outputs if o.get("name") == "stdout"]  # a kernel shows the others
        made.append({**cell, "outputs": [{"text": text.getvalue()}]})
    assert any(cell.outputs for cell in stored)
    check_printed({"cells": stored}, {"cells": made})
    assert plt.get_fignums()
    plt.close("all")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_saved_notebook_has_no_empty_outputs_errors_or_folders(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    outputs = [o for cell in cells for o in cell.get("outputs", [])]
    assert outputs
    for output in outputs:
        data = output.get("data", {"text/plain": output.get("text", "")})
        assert output["output_type"] != "error"
        assert not any("widget" in kind for kind in data), "progress bars and sliders are drawn again where it runs"
        assert any("".join(text).strip() for text in data.values())
        assert not re.search(r"(?<![\w.])/(root|home|tmp|Users)/", json.dumps(data)), "the folders of one machine"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_asks_one_question_draws_its_diagram_and_has_its_figure(path):
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert sum("".join(cell["source"]).count("**Question:**") for cell in cells) == 1
    outputs = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
    drawings = [data for data in outputs if "image/svg+xml" in data]
    assert drawings
    assert any("image/png" in data for data in outputs)
    assert not any("text/html" in data for data in drawings), "GitHub strips a live drawing: docs/notebooks.py saves it"
    for cell in cells:
        lines = "".join(cell["source"]).splitlines()
        assert cell["cell_type"] != "code" or len([line for line in lines if ".set" in line or "plt." in line]) < 6


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebooks_run(path):
    import nbformat
    from nbclient import NotebookClient

    stored, notebook = nbformat.read(path, as_version=4), nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(path.parent)}}).execute()
    check_printed(stored, notebook)
    shown = [o for cell in notebook.cells for o in cell.get("outputs", [])]
    assert any("image/png" in o.get("data", {}) for o in shown)


@pytest.mark.slow
def test_the_figures_of_the_pages_are_made(tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "figures.py", tmp_path],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ,
    )
    assert done.returncode == 0, done.stderr
    assert {file.name for file in tmp_path.iterdir()} == {
        "C_path.png",
        "first_loop.png",
        "speed_loop.svg",
        "frequency.png",
        "loop.png",
        "sweep.png",
    }
