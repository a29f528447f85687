"""A drawing that answers: what it says of blocks and wires, the views that it has, and how it behaves in a browser."""

import json
import re
import shutil
import subprocess
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from loopwright.blocks import Gain, Integrator, Sine, Sum
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, dc_motor

SVG = "{http://www.w3.org/2000/svg}"


def nested():
    """Return y' = 3 (r - y) with the controller in a subsystem, and another one inside it."""

    @subsystem
    def inner(e):
        return Gain(gain=3.0, name="kp")(e).named("demand")

    @subsystem
    def controller(r, y):
        return inner(Sum(signs="+-", name="error")(r, y))

    lag = Integrator(name="lag")
    return Diagram("loop", lag(controller(Sine(frequency=0.5, name="wish"), lag.y)).named("y"))


def content(html):
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)[1])


def test_every_combination_of_open_subsystems_is_drawn_once():
    data = content(nested().draw().html)
    assert sorted(map(tuple, (v["open"] for v in data["views"]))) == [
        (),
        ("controller",),
        ("controller", "controller.inner"),
    ]
    shown = {tuple(v["open"]): v["svg"] for v in data["views"]}
    for opened, svg in shown.items():
        blocks = {e.get("data-block") for e in ET.fromstring(svg).iter() if e.get("data-block")}
        assert ("controller.error" in blocks) == ("controller" in opened)
        assert ("controller.inner.kp" in blocks) == ("controller.inner" in opened)


def test_a_block_says_its_parameters_and_where_its_inputs_come_from():
    kp = content(nested().draw().html)["blocks"]["controller.inner.kp"]
    assert kp["title"] == "controller.inner.kp · Gain"
    assert ["gain", "3"] in kp["facts"]
    assert ["input u", "controller.error.y"] in kp["facts"]


def test_a_file_is_named_without_its_folders(uncompiled):
    motor = Fmu(dc_motor.build(), name="motor")
    html = Diagram("drive", motor(voltage=1.0, load_torque=0.0)).draw().html
    assert ["file", "dc_motor.fmu"] in content(html)["blocks"]["motor"]["facts"]
    assert str(motor.file.parent) not in html


def test_a_wire_says_its_names_unit_readers_and_the_signal_of_a_run():
    diagram = nested()
    run = diagram.simulate(2.0, solver="RK45", rtol=1e-9, atol=1e-12, progress=False)
    said = content(diagram.draw(run=run).html)["signals"]["lag.y"]
    facts = dict(said["facts"])
    assert said["title"] == "y"
    assert facts["goes to"] == "controller.error.u2"
    w = np.pi  # y' = 3 (sin w t - y), y(0) = 0
    y = (9.0 * np.sin(w * run.t) - 3.0 * w * np.cos(w * run.t) + 3.0 * w * np.exp(-3.0 * run.t)) / (9.0 + w**2)
    assert float(facts["at t = 2 s"].replace("−", "-")) == pytest.approx(y[-1], rel=1e-5)
    low, high = (float(v.replace("−", "-")) for v in facts["smallest, largest"].split(", "))
    assert (low, high) == pytest.approx((y.min(), y.max()), rel=1e-4, abs=1e-6)
    points = np.array([p.split(",") for p in said["curves"][0].split()], dtype=float)
    assert points[:, 1] == pytest.approx(
        90.0 - 90.0 * (np.interp(points[:, 0] / 200.0, run.t, y) - y.min()) / (y.max() - y.min()), abs=0.2
    )


def test_a_curve_keeps_the_extremes_of_a_long_signal():
    diagram = Diagram("long", Sine(frequency=50.0, amplitude=2.0, name="s"))
    run = diagram.simulate(10.0, step=1e-3, progress=False)
    points = content(diagram.draw(run=run).html)["signals"]
    assert points == {}  # nothing reads it, and it has no name
    diagram = Diagram("long", Sine(frequency=50.0, amplitude=2.0, name="s").y.named("fast"))
    run = diagram.simulate(10.0, step=1e-3, progress=False)
    curve = content(diagram.draw(run=run).html)["signals"]["s.y"]["curves"][0].split()
    heights = np.array([p.split(",")[1] for p in curve], dtype=float)
    assert len(heights) <= 242
    assert np.sort(heights)[100:-100].size
    assert np.mean((heights < 1.0) | (heights > 89.0)) > 0.9  # each bin has a crest and a trough


class Hostile(Gain):
    """Text </script><script>alert(1)</script> of a tool."""


def test_hostile_texts_stay_texts():
    html = Diagram("d", Hostile(gain=1.0, name="g")(Sine(frequency=1.0, name="s"))).draw().html
    assert content(html)["blocks"]["g"]["about"] == "Text </script><script>alert(1)</script> of a tool."
    assert html.count("<script") == html.count("</script>") == 2


def test_it_is_a_page_of_its_own_without_a_network(tmp_path):
    page = nested().draw(tmp_path / "loop.html")
    text = (tmp_path / "loop.html").read_text(encoding="utf-8")
    assert page.html in text
    assert not re.search(r'(src|href)="|https?://(?!www\.w3\.org/2000/svg)', text)


STEPS = """
<script>
const count = () => document.querySelectorAll('.lw-view [data-block]').length;
const click = e => e.dispatchEvent(new MouseEvent('click', {bubbles: true}));
const find = text => { const i = document.querySelector('input'); i.value = text; i.dispatchEvent(new Event('input')); };
const said = () => document.querySelector('.lw-panel').textContent;
const seen = [count()];
click(document.querySelector('[data-subsystem="controller"]'));
seen.push(count());
find('kp');
seen.push(count(), document.querySelector('.lw-found').dataset.block, said().includes('controller.error.y'));
find('demand');
seen.push(said().includes('controller.inner.kp.y'));
click([...document.querySelectorAll('button')].find(b => b.textContent === 'close all'));
seen.push(count());
document.body.innerHTML = JSON.stringify(seen);
</script>
"""


@pytest.mark.slow
def test_in_a_browser_subsystems_open_and_names_are_found(tmp_path):
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert browser, "a browser is needed: install chromium (apt-get install chromium), then run this test again"
    nested().draw(tmp_path / "loop.html", closed=True)
    page = tmp_path / "steps.html"
    page.write_text((tmp_path / "loop.html").read_text(encoding="utf-8") + STEPS, encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    command = [browser, *options, f"--user-data-dir={tmp_path / 'user'}", "--dump-dom", f"file://{page}"]
    dom = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    seen = json.loads(re.search(r"<body>(\[.*?\])", dom)[1])
    assert seen == [2, 3, 4, "controller.inner.kp", True, True, 2]
