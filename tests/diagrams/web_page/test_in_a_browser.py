"""Pages in a real browser, opened from the disk: they run, answer, keep to themselves, and have a run's samples."""

import csv
import re
import time
from functools import cache

import numpy as np
import pytest

from loopwright import experiments
from support.browser import opened
from support.web_modules import Module

pytestmark = pytest.mark.slow
SIZES = [(1100, 900), (390, 844)]
RELATIVE = 1e-9
"""Of a signal's largest value: elementary functions differ by an ulp, and the loops damp that."""
POINTER = """async ([moves, pause]) => {
    const canvas = document.querySelector('.scene canvas'), box = canvas.getBoundingClientRect();
    for (const [type, x, y] of moves) {
        const at = {clientX: box.left + x * box.width, clientY: box.top + y * box.height, pointerId: 1, bubbles: true};
        canvas.dispatchEvent(new PointerEvent(type, at));
        await new Promise(done => setTimeout(done, pause));
    }
}"""


@cache
def hand_page(folder):
    return experiments.hand_page(folder / "hand.html")


@pytest.fixture
def file(tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    hand_page(folder)
    return folder / "hand.html"


def read_csv(path):
    with open(path, encoding="utf-8", newline="") as stream:
        names, *rows = csv.reader(stream)
    return [name.partition(" [")[0] for name in names], np.array(rows, dtype=float)


def test_a_robot_that_is_pulled_moves_as_the_same_run_in_python(file, tmp_path):
    circle = [("pointermove", 0.5 + 0.33 * np.cos(a), 0.5 - 0.42 * np.sin(a)) for a in np.linspace(0.3, 2.0, 60)]
    with opened(file) as page:
        page.evaluate(POINTER, [[("pointerdown", 0.75, 0.2), *circle, ("pointerup", 0.5, 0.5)], 20])  # in real time
        page.evaluate("page.pause()")
        changed_at = page.evaluate("page.ticks")
        page.evaluate("page.set('admittance_perp.stiffness', 800)")
        page.evaluate("page.advance(500)")
        with page.expect_download() as download:
            page.click("#save")
        download.value.save_as(tmp_path / "hand.csv")
    names, rows = read_csv(tmp_path / "hand.csv")
    assert names[0] == "t"
    assert len(rows) == changed_at + 500 > 800  # the pull took more than a second
    column = {name: rows[:, i] for i, name in enumerate(names)}
    assert column["eta[1]"][-1] - column["eta[1]"][0] > 0.05  # it was pulled along the path

    hand = np.stack([column["hand_position[1]"], column["hand_position[2]"], column["hand_grip"]], axis=1)
    run = run_again(hand, changed_at)
    assert np.array_equal(run.t, rows[:, 0])
    worst = {name: np.abs(column[name] - run[name]).max() / max(np.abs(run[name]).max(), 1e-12) for name in names[1:]}
    assert max(worst.values()) < RELATIVE, {name: value for name, value in worst.items() if value >= RELATIVE}


def run_again(hand, changed_at):
    """Return the run in Python in which the hand moves as it did, and the stiffness changes at the same tick."""
    last = len(hand) - 1

    def following(t):  # what is read after a tick acts at the one that follows
        return min(round(t / 1e-3) + 1, last)

    inputs = {
        "hand_position": lambda t: hand[following(t), :2],
        "hand_grip": lambda t: hand[following(t), 2],
        "admittance_perp.stiffness": lambda t: 800.0 if following(t) >= changed_at else 200.0,
    }
    now = [0.0]
    found = (
        experiments.guided_by_hand()
        .diagram.simulation()
        .run_realtime(
            last * 1e-3,
            inputs=inputs,
            frame=1e-9,  # one tick
            clock=lambda: now[0],
            sleep=lambda seconds: now.__setitem__(0, now[0] + seconds),
        )
    )
    return found.run


def test_elementary_functions_are_the_packages_own(file):
    """The browser's functions are asked for the choice of step sizes alone; else samples would hang on the browser."""
    module = Module(file.read_text(encoding="utf-8"))
    assert set(module.imports) <= {"exp", "log", "pow"}  # no sine, cosine or tangent hyperbolic


def test_steps_resets_and_a_slider(file):
    with opened(file) as page:
        assert page.evaluate("[page.ticks, page.running]") == [1, False]
        page.click("#step")
        page.click("#step")
        assert page.evaluate("page.ticks") == 3
        page.click("#play")
        page.wait_for_timeout(500)
        page.click("#play")
        assert page.inner_text("#play") == "Run"
        ran = page.evaluate("page.ticks")
        assert ran > 100
        page.wait_for_timeout(200)
        assert page.evaluate("page.ticks") == ran
        page.get_by_label("stiffness k⊥", exact=True).fill("0.9")  # the way of the slider
        assert page.get_by_label("stiffness k⊥, value").input_value() == "1815"
        assert page.evaluate("page.sliders.get('admittance_perp.stiffness').value") == 1815.0
        page.get_by_text("stiffness k⊥").dblclick()
        assert page.evaluate("page.sliders.get('admittance_perp.stiffness').value") == 200.0
        page.click("#reset")
        assert page.evaluate("[page.ticks, page.time, page.record.count]") == [1, 0, 1]
        page.keyboard.press("Tab")
        page.evaluate("document.activeElement.blur()")
        page.keyboard.press("ArrowRight")
        assert page.evaluate("page.ticks") == 2


def test_a_run_that_cannot_continue_says_why(file):
    """Pulled out of the domain of the path's coordinates, the run stops and the page says so; a reset begins again."""
    with opened(file) as page:
        page.evaluate("page.set('admittance_perp.stiffness', 0)")  # beyond the slider's range
        page.evaluate("for (const [n, v] of [['hand_y', 0.5], ['hand_z', 0.5], ['grip', 1]]) page.set(n, v)")
        page.evaluate("page.advance(20000)")
        text = page.inner_text("#note")
        assert text.startswith("It has ended: controller.path_projection.left is not positive after t = 0.")
        assert "Change what led there, and reset." in text
        ticks = page.evaluate("page.ticks")
        for button in ("#step", "#play"):
            page.click(button)
        assert page.evaluate("[page.ticks, page.running]") == [ticks, False]
        assert page.inner_text("#note") == text
        page.evaluate("page.set('admittance_perp.stiffness', 200)")
        page.click("#reset")
        assert page.evaluate("[page.ticks, page.model.failed]") == [1, False]
        assert not page.is_visible("#note")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_it_fits_the_screen_in_both_schemes(file, size, scheme):
    with opened(file, size, scheme) as page:
        page.evaluate("page.advance(3000)")
        page.wait_for_timeout(100)
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        assert page.is_visible(".scene canvas")
        ground = page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
        assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 25, 31)"}[scheme]


def seconds_in(page, text):
    """Return the seconds that the page's note names; a busy machine makes them more than were waited for."""
    note = page.inner_text("#note")
    assert note.startswith(text)
    return float(re.search(r"for ([\d.]+) s", note)[1])


def test_a_delay_is_given_up_and_the_page_says_so(file):
    """The browser is held up for 0.7 s; then the page is out of sight as long: the run is late by that, and no jump."""
    away = """async hidden => {
        Object.defineProperty(document, 'hidden', {value: hidden, configurable: true});
        document.dispatchEvent(new Event('visibilitychange'));
    }"""
    with opened(file) as page:
        began = time.monotonic()
        page.evaluate("page.play()")
        page.wait_for_timeout(300)
        held = page.evaluate(
            """async () => {
                const before = page.ticks, began = performance.now();
                while (performance.now() < began + 700);
                await new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)));
                return [page.ticks - before, page.behind];
            }"""
        )
        assert held[0] < 300
        assert held[1] > 0.6
        assert 0.6 < seconds_in(page, "The browser held the page up for") < 1.05 * (time.monotonic() - began)
        hidden = time.monotonic()
        page.evaluate(away, True)
        page.wait_for_timeout(100)
        before = page.evaluate("page.ticks")
        page.wait_for_timeout(600)
        assert page.evaluate("page.ticks") == before
        page.evaluate(away, False)
        page.wait_for_timeout(100)
        assert before < page.evaluate("page.ticks") < before + 500
        assert 0.65 < seconds_in(page, "The page was out of sight for") < 1.05 * (time.monotonic() - hidden)
        page.click("#reset")
        assert page.is_hidden("#note")


def test_a_machine_that_is_too_slow_is_named_with_the_speed_that_it_reaches(file):
    """Each tick takes 2 ms, at a speed of 10: half of real time at most."""
    with opened(file) as page:
        page.evaluate(
            """() => {
                const run = page.model.run.bind(page.model);
                page.model.run = (...given) => {
                    const done = run(...given), began = performance.now();
                    while (performance.now() < began + 2 * done);
                    return done;
                };
                page.play();
            }"""
        )
        page.select_option("#speed", "10")
        page.wait_for_timeout(4000)
        found = re.match(
            r"Slower than asked for: (\S+) × real time instead of 10 ×, (\S+) s behind", page.inner_text("#note")
        )
        assert 0.0 < float(found[1]) <= 0.5
        assert float(found[2]) > 1.0


def test_keys_pull_the_tool_and_move_sliders(file):
    with opened(file) as page:
        page.focus(".scene canvas")
        page.keyboard.down("ArrowLeft")
        page.wait_for_timeout(400)
        assert page.evaluate("[page.running, page.now('hand.force[1]') < -4, page.now('hand_grip')]") == [True, True, 1]
        page.keyboard.up("ArrowLeft")
        page.wait_for_timeout(200)
        assert page.evaluate("page.now('hand_grip')") == 0
        slider = "page.sliders.get('admittance_perp.stiffness').value"
        page.get_by_label("stiffness k⊥", exact=True).focus()
        before = page.evaluate(slider)
        page.keyboard.press("ArrowRight")
        assert page.evaluate(slider) == pytest.approx(before + 0.01 * 1850.0, abs=1.0)  # a hundredth of the way
        page.keyboard.press("End")
        assert page.evaluate(slider) == 2000.0
        page.get_by_label("stiffness k⊥: back to 200 N/m").click()
        assert page.evaluate(slider) == 200.0
        page.get_by_label("stiffness k⊥, value").fill("1e9")
        page.keyboard.press("Enter")
        assert page.evaluate(slider) == 2000.0  # the end of its range


def test_a_plot_has_every_extreme_however_long_it_is(file):
    """Of each pixel the smallest and the largest sample, added as they come: as from the whole record at once."""
    with opened(file) as page:
        page.evaluate("for (const [n, v] of [['hand_y', 0.7], ['hand_z', 0.6], ['grip', 1]]) page.set(n, v)")
        found = page.evaluate(
            """() => {
                for (let i = 0; i < 60; i++) { page.advance(237); page.draw(); }
                const plot = plots[2], {least, most, width, size, newest} = plot.envelope, worst = [0, 0, 0];
                const lows = new Map(), highs = new Map();
                for (let i = 0; i < page.record.count; i++) {
                    const bin = Math.floor(page.record.time(i) / width), v = page.record.value(i, plot.of.curves[0]);
                    lows.set(bin, Math.min(v, lows.get(bin) ?? Infinity));
                    highs.set(bin, Math.max(v, highs.get(bin) ?? -Infinity));
                }
                for (let bin = newest - size + 1; bin <= newest; bin++) {
                    worst[0] += least[0][bin % size] !== lows.get(bin);
                    worst[1] += most[0][bin % size] !== highs.get(bin);
                    worst[2] += 1;
                }
                return worst;
            }"""
        )
        assert found[:2] == [0, 0]
        assert found[2] > 500


def test_less_motion(file):
    """Plots move by a quarter of their width: 10 s end at 12.5 s at t = 10.4 s."""
    with opened(file, reduced_motion="reduce") as page:
        page.evaluate("page.advance(10400)")
        page.wait_for_timeout(100)
        assert page.evaluate("[plots[0].t0, plots[0].t1]") == [2.5, 12.5]


def test_it_keeps_pace(file, record_property):
    """What is sustained is reported, as it hangs on the machine: 1000 ticks and 60 pictures in a second.

    A picture takes 8 ms of the processor's time at most in scripts (1 ms on the machine where it was written), and is
    drawn without a new layout: the numbers that change ten times a second ask for one.
    """
    with opened(file) as page:
        metrics = page.context.new_cdp_session(page)
        metrics.send("Performance.enable", {"timeDomain": "threadTicks"})

        def read():
            return {one["name"]: one["value"] for one in metrics.send("Performance.getMetrics")["metrics"]}

        page.select_option("#span", "60")
        page.evaluate("page.advance(60000)")
        before = read()
        ticks, pictures, seconds, behind = page.evaluate(
            """async () => {
                let pictures = 0, stop = false;
                const count = () => { pictures++; if (!stop) requestAnimationFrame(count); };
                page.play();
                requestAnimationFrame(count);
                const ticks = page.ticks, began = performance.now();
                await new Promise(done => setTimeout(done, 3000));
                const seconds = (performance.now() - began) / 1000;
                stop = true; page.pause();
                return [page.ticks - ticks, pictures, seconds, page.behind];
            }"""
        )
        after = read()
        script, task = (1e3 * (after[f"{n}Duration"] - before[f"{n}Duration"]) / pictures for n in ("Script", "Task"))
        layouts = (after["LayoutCount"] - before["LayoutCount"]) / pictures
        text = (
            f"{ticks / seconds:.0f} ticks and {pictures / seconds:.1f} pictures per second, {behind:.2g} s behind; a picture "
            f"takes {script:.2f} ms in scripts, {task:.2f} ms in all, and {layouts:.2f} layouts"
        )
        record_property("pace", text)
        print(text)
        assert ticks > 0
        assert script < 8.0
        assert layouts < 1.0
