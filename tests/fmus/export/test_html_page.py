"""The page of documentation in each FMU, and equations as text."""

import math
import re
import zipfile
from html.parser import HTMLParser

import casadi as ca
import numpy as np
import pytest

from loopwright.fmus import ModelSpec, Variable, build, build_fmu, gantry
from loopwright.fmus.export.equation_text import equations, number
from loopwright.fmus.export.html_page import block_text, index_html
from support.exported import bouncing_ball, mass_spring_damper, pendulums, thermostat

pytestmark = pytest.mark.usefixtures("uncompiled")


def page(path):
    with zipfile.ZipFile(path) as archive:
        return archive.read("documentation/index.html").decode()


class Reader(HTMLParser):
    """The rows of the tables, the blocks of preformatted text, and every address that is referred to."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.blocks, self.references, self._cell, self._block = [], [], [], None, None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.references += [value for name, value in attributes if name in ("src", "href")]
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self._cell = ""
        elif tag == "pre":
            self._block = ""

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self.rows[-1].append(self._cell)
            self._cell = None
        elif tag == "pre":
            self.blocks.append(self._block)
            self._block = None

    def handle_data(self, data):
        if self._cell is not None:
            self._cell += data
        if self._block is not None:
            self._block += data


@pytest.mark.parametrize("options", [{"fmi": 3}, {"fmi": 2}])
@pytest.mark.parametrize("make", [mass_spring_damper, pendulums, thermostat])
def test_valid_html_in_one_file(make, options):
    html5lib = pytest.importorskip("html5lib")
    text = page(build_fmu(make(), documentation="m < 1 & k > 2\n\n<script>alert(1)</script>", **options))
    html5lib.HTMLParser(strict=True).parse(text)
    read = Reader(text)
    assert read.references == []
    assert "url(" not in text
    assert "<script" not in text
    assert read.blocks[0] == "m < 1 & k > 2\n\n<script>alert(1)</script>"


def test_every_variable_is_in_the_table():
    read = Reader(index_html(mass_spring_damper()))
    assert read.rows[0] == ["Name", "Causality", "Variability", "Unit", "Start", "Min", "Max", "Description"]
    assert [row[0] for row in read.rows[1:7]] == ["time", "mass", "damping", "stiffness", "force", "position"]
    rows = {row[0]: row[1:] for row in read.rows[1:]}
    assert rows["mass"] == ["parameter", "fixed", "kg", "2", "1e-06", "", ""]
    assert rows["force"] == ["input", "continuous", "N", "0", "", "", 'Force "from outside"']
    assert rows["position"][:4] == ["output, state", "continuous", "m", "0.1"]
    assert {"velocity", "der(velocity)", "acceleration", "internal_step"} < set(rows)


def test_arrays_and_their_elements():
    rows = {row[0]: row for row in Reader(index_html(pendulums())).rows}
    assert rows["gain (2 × 2)"][4] == "1, 2, 3, 4"
    assert rows["rate (2)"][4] == "all 0"
    rows = {row[0]: row for row in Reader(page(build_fmu(pendulums(), fmi=2))).rows}
    assert rows["gain[2,1]"][4] == "3"


def test_equations_are_those_of_the_model():
    states, outputs = Reader(index_html(mass_spring_damper())).blocks
    acceleration = "(force - damping*velocity - stiffness*position)/mass"
    assert states == f"der(position) = velocity\nder(velocity) = {acceleration}"
    assert outputs == f"acceleration = {acceleration}"


def test_events_and_what_they_do():
    read = Reader(index_html(bouncing_ball()))
    assert read.blocks[-2:] == [
        "bounce.indicator = height",
        "next(velocity) = where(bounce, -e*velocity, velocity)",
    ]
    assert ["bounce", "falling", "1", "Height above the floor"] in read.rows
    read = Reader(index_html(thermostat()))
    assert [row[0] for row in read.rows if row[1] in ("rising", "falling")] == ["too_warm", "too_cold"]
    assert "next(temperature)" not in read.blocks[-1]  # the jump leaves it alone
    assert read.blocks[-1].startswith("next(on) = where(")


def test_a_model_that_is_too_long_says_where_its_equations_are():
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("u", 0), ca.SX.sym("p", 0)
    long = x
    for k in range(500):
        long = ca.sin(long + k)
    f, g = ca.Function("f", [t, x, u, p], [long]), ca.Function("g", [t, x, u, p], [x])
    spec = ModelSpec("long", "", (), (Variable("y", "output"),), (), (Variable("x", start=0.0, state=True),), f, g)
    assert "sources/model.c" in index_html(spec)


def test_a_blocks_page_has_its_docstring_and_the_source_of_its_equations():
    text = Reader(page(build(gantry.nominal))).blocks[0]
    assert text == block_text(gantry.nominal)
    assert text.startswith(gantry.__doc__.strip().splitlines()[0])  # the class's first line is the description above
    assert (
        "start_position" not in text.partition("def ")[0]
    )  # no parameter of the FMU, nor are the table's rows repeated
    assert "(m_t,i + m_J,i) s̈_i = u_i − F_F,i(ṡ_i) − F_G,i + F_i" in text
    assert "def derivative(self, " in text
    assert "    coulomb = self.coulomb_scale * self.coulomb_friction * np.tanh(" in text
    assert Reader(page(build(gantry.nominal, documentation="Mine."))).blocks[0] == "Mine."


# ---- equations as text: read back by Python, they give the numbers of the trace ----

FUNCTIONS = {name: getattr(np, name) for name in ("exp", "log", "sqrt", "sin", "cos", "tan", "floor", "ceil", "sign")}
FUNCTIONS |= {
    name: getattr(np, name) for name in ("fmod", "copysign", "sinh", "cosh", "tanh", "log1p", "expm1", "hypot")
}
FUNCTIONS |= {"asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2, "asinh": np.arcsinh}
FUNCTIONS |= {"acosh": np.arccosh, "atanh": np.arctanh, "abs": abs, "min": min, "max": max, "erf": math.erf}
FUNCTIONS |= {"remainder": math.remainder, "where": lambda c, a, b: a if c else b}


def evaluated(lines, values):
    """Evaluate printed equations one after the other, as Python reads them."""
    space = FUNCTIONS | values
    for line in lines:
        name, expression = line.split(" = ", 1)
        space[name] = eval(re.sub(r"not\(", "not (", expression.replace("^", "**")), {}, space)
    return space


def everything(a, b):
    """Each operation that CasADi traces, and nestings that need their parentheses."""
    one = [
        a - (b - a),
        a / (b / a),
        a / (b * a),
        -(a + b),
        -(a**2),
        (-a) ** 2,
        (a + b) ** 2,
        a**b,
        (a**b) ** a,
        a ** (b**a),
    ]
    one += [
        (-a) ** ca.floor(b),
        2 * a,
        1 / a,
        1 / (a * b),
        a * (-3.25),
        -7.0 - a,
        (a - 2) ** 3,
        a - -b,
        a * (b + 1e-9),
        (2 * a) ** 0.5,
        -(-a * b),
    ]
    one += [
        ca.exp(a),
        ca.log(a),
        ca.sqrt(a),
        ca.sin(a),
        ca.cos(a),
        ca.tan(a),
        ca.asin(a / 9),
        ca.acos(b / 9),
        ca.atan(a),
    ]
    one += [ca.floor(a), ca.ceil(a), ca.fmod(a, b), ca.fabs(-a), ca.sign(a - b), ca.copysign(a, -b), ca.erf(a)]
    one += [
        ca.fmin(a, b),
        ca.fmax(a, b),
        ca.sinh(a),
        ca.cosh(a),
        ca.tanh(a),
        ca.asinh(a),
        ca.acosh(a + 1),
        ca.atanh(b / 9),
    ]
    one += [ca.atan2(a, b), ca.log1p(a), ca.expm1(a), ca.hypot(a, b), ca.remainder(a, b), ca.if_else(a < b, a, b)]
    one += [
        ca.if_else(ca.logic_and(a < b, a <= 2), a, b),
        ca.if_else(ca.logic_or(a == b, ca.logic_not(a > 2)), a, b * 2),
    ]
    one += [ca.if_else(ca.logic_or(ca.logic_and(a > 1, b > 1), a != b), a, b), ca.if_else((a < b) == (b < 2), a, b)]
    one += [ca.if_else(ca.logic_not(ca.logic_and(a < b, b < 9)), a, b)]
    return one


@pytest.mark.parametrize(("a", "b"), [(1.3, 2.1), (2.9, 0.7), (0.4, 0.4), (3.7, 5.2)])
def test_printed_equations_give_the_numbers_of_the_trace(a, b):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    f = ca.Function("f", [x, y], [ca.vertcat(*everything(x, y))])
    names = [f"r{i}" for i in range(f.numel_out(0))]
    lines = equations(f, [["a"], ["b"]], names)
    space = evaluated(lines, {"a": a, "b": b})
    np.testing.assert_allclose([space[n] for n in names], f(a, b).full().ravel(), rtol=1e-14, atol=0)


def test_shared_expressions_have_names_of_their_own():
    x = ca.SX.sym("x", 2)
    root = ca.sqrt(x[0] + x[1])
    f = ca.Function("f", [x], [ca.vertcat(root * x[0], root / x[1], ca.SX(1, 1))])
    lines = equations(f, [["w1", "w2"]], ["y1", "y2", "y3"])
    assert lines == ["w3 = sqrt(w1 + w2)", "y1 = w3*w1", "y2 = w3/w2", "y3 = 0"]


def test_numbers_are_in_full():
    assert [number(v) for v in (2.0, 0.1, 1e-6, 1 / 3, 1e300, -4)] == [
        "2",
        "0.1",
        "1e-06",
        "0.3333333333333333",
        "1e+300",
        "-4",
    ]


def test_an_open_bound_is_shown_as_one():
    rows = {row[0]: row[1:] for row in Reader(page(build(gantry.nominal))).rows[1:]}
    assert rows["translational_mass (2)"][4] == "> 0"
    assert rows["coulomb_scale"][4] == "0"
