"""What is drawn inside blocks, colours in the dark, and files of other kinds."""

import io
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Block,
    Compare,
    Constant,
    DeadZone,
    Delay,
    Function,
    Gain,
    Input,
    Integrator,
    Lookup1D,
    Output,
    Ramp,
    Recorded,
    Saturation,
    Sine,
    Step,
    TransferFunction,
    TransportDelay,
    ZeroPoleGain,
)
from loopwright.diagrams import Diagram
from loopwright.diagrams.drawing.symbols import symbol_of

SVG = "{http://www.w3.org/2000/svg}"


@pytest.mark.parametrize(
    ("block", "text", "below"),
    [
        (Gain(gain=-0.5), "−0.5", ""),
        (Gain(gain=[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), "2 × 3", ""),
        (Constant(value=(1.0, 2.5)), "(1, 2.5)", ""),
        (Integrator(), "1", "s"),
        (TransferFunction(numerator=[1.0, -2.0], denominator=[0.1, 1.0, 0.0, 3.0]), "s − 2", "0.1 s³ + s² + 3"),
        (TransferFunction(numerator=2.0, denominator=[1.23456, 7.65432, 9.87654, 3.21012]), "2", "a(s)"),
        (ZeroPoleGain(zeros=[-4.0], poles=[0.0, -1.5], gain=3.0), "3 (s + 4)", "s(s + 1.5)"),
        (ZeroPoleGain(zeros=[], poles=[-1.0], gain=3.0), "3", "(s + 1)"),
        (Delay(steps=12), "z⁻¹²", ""),
        (TransportDelay(delay=0.25), "exp(−0.25 s)", ""),
        (PID(kp=1.0, ki=2.0), "PI", ""),
        (PID(kp=1.0, kd=2.0, filter_time=0.1), "PD", ""),
        (Compare(">="), "≥", ""),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Block) else None,
)
def test_a_block_shows_its_value_or_transfer_function(block, text, below):
    symbol = symbol_of(block)
    assert (symbol.text, symbol.below) == (text, below)


def scaled(points, size):
    return np.array([(x, y * size) for x, y in points])


@pytest.mark.parametrize(
    ("block", "reach", "equation"),
    [
        (Saturation(lower=-1.0, upper=2.0), 3.6, lambda u: np.clip(u, -1.0, 2.0)),
        (Saturation(upper=2.0), 3.6, lambda u: np.minimum(u, 2.0)),
        (DeadZone(limit=0.5), 1.0, lambda u: u - np.clip(u, -0.5, 0.5)),
    ],
    ids=["saturation", "one limit", "dead zone"],
)
def test_a_characteristic_is_that_of_the_equation(block, reach, equation):
    u, y = np.array(symbol_of(block).curve).T
    exact = equation(reach * u)
    if block.lower is None and block.limit is None:
        exact = np.maximum(exact, -2.0)  # drawn as far down as up
    assert y == pytest.approx(0.9 * exact / np.max(np.abs(exact)), abs=1e-12)


def test_a_table_is_drawn_through_its_points():
    table = Lookup1D(breakpoints=(0.0, 1.0, 4.0), values=(2.0, 6.0, 0.0))
    assert np.array(symbol_of(table).curve) == pytest.approx(
        np.array([(-1.0, -0.3), (-0.5, 0.9), (1.0, -0.9)]), abs=1e-12
    )


@pytest.mark.parametrize(
    ("source", "end", "equation"),
    [
        (Sine(frequency=2.0, amplitude=3.0, bias=1.0), 0.75, lambda t: 1.0 + 3.0 * np.sin(4.0 * np.pi * t)),
        (Ramp(slope=2.0, start_time=1.0), 1.3, lambda t: 2.0 * np.maximum(t - 1.0, 0.0)),
        (Step(times=(1.0, 2.0), values=(4.0, -1.0)), 2.6, lambda t: np.select([t >= 2.0, t >= 1.0], [-1.0, 4.0])),
        (Recorded(times=(0.0, 1.0, 2.0), values=(0.0, 1.0, 0.0)), 2.6, lambda t: np.interp(t, [0, 1, 2], [0, 1, 0])),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Block) else None,
)
def test_a_source_shows_its_waveform(source, end, equation):
    x, y = np.array(symbol_of(source).curve).T
    t = (x + 1.0) / 2.0 * end
    exact = equation(t)
    assert y == pytest.approx(1.7 * (exact - exact.min()) / (exact.max() - exact.min()) - 0.85, abs=1e-9)


def test_a_block_of_ones_own_says_what_is_in_it():
    class Lag(Block):
        u = Input()
        y = Output()

        @property
        def drawn_inside(self):
            return "K / T s + 1 < 2"

        def output(self, t, x, u):
            return u.u

    svg = Diagram("own", Lag(name="lag")(Function(lambda u: u, name="f")(Sine(frequency=1.0)))).draw().svg
    shown = ["".join(t.itertext()) for t in ET.fromstring(svg).iter(f"{SVG}text")]
    assert {"K", "T s + 1 < 2"} <= set(shown)
    assert "Lag" not in shown


def test_what_has_no_symbol_shows_its_kind(uncompiled):
    from loopwright.fmus import Fmu, dc_motor

    motor = Fmu(dc_motor.build(), name="motor")
    svg = Diagram("drive", motor(voltage=1.0, load_torque=0.0)).draw().svg
    shown = ["".join(t.itertext()) for t in ET.fromstring(svg).iter(f"{SVG}text")]
    assert {"FMU dc_motor.fmu", "voltage"} <= set(shown)


def test_a_drawing_is_dark_where_its_page_is():
    svg = Diagram("d", Gain(gain=2.0)(Sine(frequency=1.0))).draw().svg
    style = next(ET.fromstring(svg).iter(f"{SVG}style")).text
    for page in ("prefers-color-scheme:dark", '[data-theme="dark"]', '[data-jp-theme-light="false"]'):
        assert page in style
    used = {kind for e in ET.fromstring(svg).iter() for kind in (e.get("class") or "").split() if kind != "lw-drawing"}
    assert all(f".{kind}" in style for kind in used)


def test_a_drawing_is_written_as_pixels_and_as_a_page(tmp_path):
    from matplotlib.image import imread
    from pypdfium2 import PdfDocument

    drawing = Diagram("d", Gain(gain=2.0)(Sine(frequency=1.0))).draw()
    width, height = drawing.size
    pixels = imread(io.BytesIO(drawing.save(tmp_path / "d.png").read_bytes()), format="png")
    assert pixels.shape[:2] == pytest.approx((2 * height, 2 * width), abs=2)
    assert pixels[..., :3].min() < 0.3  # something is drawn
    pages = PdfDocument(str(drawing.save(tmp_path / "d.pdf")))
    assert len(pages) == 1
    assert pages[0].get_size() == pytest.approx((0.75 * width, 0.75 * height), abs=1)
    pages.close()
