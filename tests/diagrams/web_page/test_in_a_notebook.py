"""A page in JupyterLab: it is played, and its samples are in Python; saved and untrusted it is still there."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import nbformat
import pytest

from support.browser import launched

pytestmark = pytest.mark.slow
DIAGRAM = """\
from loopwright import Diagram, subsystem
from loopwright.blocks import Constant, DiscreteIntegrator

@subsystem(sample_time=1e-3)
def ramp(u):
    return DiscreteIntegrator(name="total")(u).named("y")

page = Diagram("ramp", ramp(Constant(value=0.0, name="u"))).to_html(inputs={"u": (-2.0, 2.0)}, plots=["y"])
page"""
LOOK = """\
run, again = page.run, page.simulate()
print(len(run.t), run["y"][-1] == again["y"][-1], (run["y"] == again["y"]).all(), page.changes[-1].value)"""
PLAYED = "async () => { page.play(); await new Promise(done => setTimeout(done, 600)); page.pause(); }"


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Start JupyterLab, and return its folder and address."""
    folder = tmp_path_factory.mktemp("lab")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {f"JUPYTER_{name}_DIR": str(folder / name.lower()) for name in ("CONFIG", "DATA", "RUNTIME")}
    options = [f"--port={port}", "--ip=127.0.0.1", "--IdentityProvider.token=", f"--ServerApp.root_dir={folder}"]
    options += ["--no-browser", "--allow-root", "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate"]
    server = subprocess.Popen(
        [sys.executable, "-m", "jupyterlab", *options],
        env={**os.environ, **own},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    for _ in range(240):
        try:
            socket.create_connection(("127.0.0.1", port)).close()
            break
        except OSError:
            time.sleep(0.25)
    yield folder, f"http://127.0.0.1:{port}/lab/tree"
    server.send_signal(signal.SIGTERM)
    try:
        server.wait(60)
    except subprocess.TimeoutExpired:  # a busy machine
        server.kill()
        server.wait()


@contextmanager
def notebook(address, name):
    with launched() as browser:
        view = browser.new_page(viewport={"width": 1300, "height": 1000})
        view.goto(f"{address}/{name}?reset")
        view.wait_for_selector(".jp-Notebook .jp-Cell", timeout=90_000)
        yield view


def run_cell(view, number):
    """Run a cell; what is run before the kernel is ready is lost, though the page shows it as idle."""
    prompt = view.locator(".jp-Cell").nth(number).locator(".jp-InputPrompt")
    for _ in range(20):
        view.click(f".jp-Cell >> nth={number}")
        view.keyboard.press("Escape")
        view.keyboard.press("Shift+Enter")
        view.wait_for_timeout(3000)
        if prompt.inner_text().strip() != "[ ]:":
            return
    raise AssertionError("the kernel runs no cell")


def page_in(view):
    view.wait_for_selector(".jp-OutputArea iframe[srcdoc]", timeout=90_000)
    for _ in range(100):
        for frame in view.frames:
            if frame.parent_frame and frame.query_selector("#play"):
                return frame
        view.wait_for_timeout(100)
    raise AssertionError("the frame has no page")


def test_what_is_played_comes_back_to_python(lab):
    folder, address = lab
    cells = [nbformat.v4.new_code_cell(source) for source in (DIAGRAM, LOOK)]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    made = nbformat.v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})
    nbformat.write(made, folder / "play.ipynb")
    with notebook(address, "play.ipynb") as view:
        run_cell(view, 0)
        page = page_in(view)
        page.evaluate(PLAYED)
        page.evaluate("page.set('u', 1.5)")
        page.evaluate(PLAYED)
        ticks = page.evaluate("page.ticks")
        assert ticks > 600
        view.wait_for_timeout(500)
        run_cell(view, 1)
        view.wait_for_selector(".jp-Cell >> nth=1 >> .jp-OutputArea-output pre", timeout=60_000)
        assert view.inner_text(".jp-Cell >> nth=1 >> .jp-OutputArea-output").split() == [
            str(ticks),
            "True",
            "True",
            "1.5",
        ]
        view.keyboard.press("Control+s")
        view.wait_for_timeout(1500)
    saved = json.loads((folder / "play.ipynb").read_text(encoding="utf-8"))
    assert set(saved["cells"][0]["outputs"][0]["data"]) == {"text/html", "text/plain"}  # the page; no widget's view

    with notebook(address, "play.ipynb") as view:  # as it was saved, without running a cell
        assert page_in(view).evaluate("page.advance(10)") == 10

    saved["cells"][0]["source"] += "\n"  # a notebook of another is not trusted
    (folder / "other.ipynb").write_text(json.dumps(saved), encoding="utf-8")
    with notebook(address, "other.ipynb") as view:
        view.wait_for_selector(".jp-OutputArea img", timeout=60_000)
        assert "is shown in a trusted notebook" in view.inner_text(".jp-Cell >> nth=0 >> .jp-OutputArea-output")
        assert not view.query_selector(".jp-OutputArea iframe")
