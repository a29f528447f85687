"""Drawings: where things stand, that wires are whole and apart, and what an SVG holds."""

import itertools
import os
import random
import re
import subprocess
import sys
from itertools import pairwise
from xml.etree import ElementTree as ET

import pytest

from loopwright.blocks import PID, Gain, Integrator, OptionError, Sine, Sum, TransferFunction
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.diagrams.drawing.drawing_layout import Net, _assign_tracks, _draw, _Part, arrange
from loopwright.diagrams.drawing.layers import Node, cut_loops
from loopwright.diagrams.drawing.rows import arrange_in_rows
from loopwright.fmus import Fmu, dc_motor

SVG = "{http://www.w3.org/2000/svg}"


def texts(svg):
    return ["".join(t.itertext()) for t in ET.fromstring(svg).iter(f"{SVG}text")]


def pi_loop():
    error = Sum(signs="+-", name="error")
    plant = Gain(gain=0.5, name="plant")
    lag = Integrator(name="lag")
    return Diagram("pi", lag(plant(error(Sine(frequency=1.0, name="wish"), lag.y).named("e"))).named("y"))


# --- layout ---------------------------------------------------------------------------------------------------------


def segments(nets):
    return [(net.key, a, b) for net in nets for run in net.runs for a, b in itertools.pairwise(run)]


def lies_on(point, segment):
    (x, y), ((a, b), (c, d)) = point, segment
    return min(a, c) - 1e-6 <= x <= max(a, c) + 1e-6 and min(b, d) - 1e-6 <= y <= max(b, d) + 1e-6


def problems(nodes, nets):
    """Yield what is wrong: nodes that overlap, wires through nodes, wires over wires, ends that aren't reached."""
    wires = segments(nets)
    for i, a in enumerate(nodes):
        for b in nodes[i + 1 :]:
            if a.x < b.x + b.width and b.x < a.x + a.width and a.y < b.y + b.height and b.y < a.y + a.height:
                yield "nodes overlap", a.key, b.key
        for key, (x1, y1), (x2, y2) in wires:
            inside_x = max(x1, x2) > a.x + 0.01 and min(x1, x2) < a.x + a.width - 0.01
            if inside_x and max(y1, y2) > a.y + 0.01 and min(y1, y2) < a.y + a.height - 0.01:
                yield "through a node", key, a.key
    for i, (key, a, b) in enumerate(wires):
        for other, c, d in wires[i + 1 :]:
            for along, across in ((0, 1), (1, 0)):
                parallel = a[across] == b[across] and c[across] == d[across] and abs(a[across] - c[across]) < 2
                common = min(max(a[along], b[along]), max(c[along], d[along])) - max(
                    min(a[along], b[along]), min(c[along], d[along])
                )
                if key != other and parallel and common > 1e-6:
                    yield "wire over wire", key, other
    by_key = {node.key: node for node in nodes}
    for net in nets:
        own = [(a, b) for _, a, b in segments([net])]
        source = by_key[net.source[0]]
        start = (source.x + source.width, source.y + source.outs[net.source[1]])
        reached = [s for s in own if lies_on(start, s)]
        for one in reached:
            reached += [
                s
                for s in own
                if (s not in reached and any(lies_on(p, one) for p in s))
                or (s not in reached and any(lies_on(p, s) for p in one))
            ]
        for key, pin in net.sinks:
            if not any(lies_on((by_key[key].x, by_key[key].y + by_key[key].ins[pin]), s) for s in reached):
                yield "not reached", net.key, key


def anything(seed, count):
    """Return nodes and nets at random, loops and plants among them."""
    chance = random.Random(seed)
    nodes = [
        Node(
            f"n{i}",
            chance.choice([60.0, 90.0, 120.0]),
            94.0,
            {f"i{j}": 20.0 + 18 * j for j in range(3)},
            {f"o{j}": 20.0 + 18 * j for j in range(2)},
            plant=chance.random() < 0.1,
        )
        for i in range(count)
    ]
    if seed % 3 == 0:
        nodes += [Node("<a", 0, 0, {}, {"o": 0.0}, -1), Node("<b", 0, 0, {}, {"o": 0.0}, -1)]
        nodes += [Node(">a", 0, 0, {"i": 0.0}, {}, 1)]
    sinks = {}
    for node in nodes:
        for pin in node.ins:
            if chance.random() < 0.7:
                source = chance.choice([n for n in nodes if n.outs])
                sinks.setdefault((source.key, chance.choice(list(source.outs))), []).append((node.key, pin))
    return nodes, [Net(f"{a} {b}", (a, b), ends, chance.choice([0.0, 40.0])) for (a, b), ends in sinks.items()]


@pytest.mark.drawn(1)
@pytest.mark.parametrize("seed", range(60))
def test_wires_reach_their_ends_and_lie_on_nothing_else(seed):
    nodes, nets = anything(seed, 3 + seed % 12 if seed < 50 else 40)
    arrange(nodes, nets)
    assert list(problems(nodes, nets)) == []


@pytest.mark.drawn(1)
@pytest.mark.parametrize("seed", range(60))
def test_wires_between_rows_reach_their_ends_and_lie_on_nothing_else(seed):
    nodes, nets = anything(seed, 6 + seed % 12 if seed < 50 else 40)
    wide, _ = arrange(nodes, nets)
    for net in nets:
        net.runs, net.dots, net.below = [], [], 0.0
    width, height = arrange_in_rows(nodes, nets, wide / 3)
    assert list(problems(nodes, nets)) == []
    points = [p for net in nets for run in net.runs for p in run]
    assert all(-1e-6 <= x <= width + 1e-6 and -1e-6 <= y <= height + 1e-6 for x, y in points)
    assert max(n.x + n.width for n in nodes) < wide
    for node in nodes:  # pins of a subsystem's border are on it
        assert not node.side or node.x == pytest.approx(0.0 if node.side < 0 else width)


def test_a_chain_is_read_like_lines_of_text():
    u = Sine(frequency=1.0, name="source").y
    for i in range(20):
        u = Gain(gain=1.0 + i, name=f"g{i}")(u)
    diagram = Diagram("chain", u)
    at = positions(diagram.draw(width=500.0).svg)
    source, gains = at.pop("source"), sorted(at, key=lambda name: (at[name][1], at[name][0]))
    assert gains == [f"g{i}" for i in range(20)]
    assert len({y for _, y in at.values()}) > 2
    assert source[0] < at["g0"][0]
    assert abs(source[1] - at["g0"][1]) < 20.0
    assert diagram.draw(width=500.0).size[0] < 600.0
    flat = positions(diagram.draw(width=1e5).svg)
    assert len({y for name, (_, y) in flat.items() if name != "source"}) == 1


def test_what_exchanges_heights_in_a_channel_takes_a_step_aside():
    # each of two wires would have to turn ahead of the other one
    left = [Node("a", 10.0, 40.0, {}, {"o": 0.0}), Node("b", 10.0, 40.0, {}, {"o": 20.0}, y=20.0)]
    right = [Node("c", 10.0, 10.0, {"i": 40.0}, {}, x=200.0), Node("d", 10.0, 10.0, {"i": 0.0}, {}, x=200.0)]
    nets = [Net("n", ("a", "o"), [("c", "i")]), Net("m", ("b", "o"), [("d", "i")])]
    parts = [_Part(n, (a, a.outs["o"]), [(b, b.ins["i"])]) for n, a, b in zip(nets, left, right, strict=True)]
    _assign_tracks(parts, 10.0, 100.0, outside=False)
    assert len(parts) == 3  # one of them has a knee
    _draw({0: parts})
    assert [p for p in problems([*left, *right], nets) if p[0] == "wire over wire"] == []


def test_loops_are_cut_behind_the_plant_and_else_where_they_are_entered():
    wires = [("r", "sum"), ("sum", "c"), ("c", "p"), ("p", "sum")]
    assert set(wires) - set(cut_loops(["p", "c", "sum", "r"], wires, {"p"})) == {("p", "sum")}
    assert set(wires) - set(cut_loops(["p", "c", "sum", "r"], wires, set())) == {("p", "sum")}
    assert cut_loops(["a"], [("a", "a")], set()) == []


def test_what_is_between_an_fmu_and_its_controller_is_on_the_right_of_the_fmu():
    keys = ["wish", "position_loop", "speed_loop", "motor", "angle"]
    wires = [*pairwise(keys), ("motor", "speed_loop"), ("angle", "position_loop")]
    cut = set(wires) - set(cut_loops(keys, wires, {"motor"}, {"position_loop": 0, "speed_loop": 0}))
    assert cut == {("motor", "speed_loop"), ("angle", "position_loop")}
    without_controllers = cut_loops(keys, wires, {"motor"})
    assert set(wires) - set(without_controllers) == {("motor", "speed_loop"), ("motor", "angle")}


@pytest.mark.parametrize("kind", ["sampled", "sum", "pid"])
def test_a_plant_is_right_of_its_controller_however_it_is_written(kind):
    plant = TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name="plant")  # written first, with its disturbance
    feed = Sum(signs="++", name="feed")
    r, d = Sine(frequency=1.0, name="wish"), Sine(frequency=2.0, name="disturbance")
    if kind == "sampled":

        @subsystem(sample_time=0.1)
        def controller(r, y):
            return Gain(gain=2.0, name="law")(r - y)

        command = controller(r, plant.y)
    elif kind == "sum":
        command = Gain(gain=2.0, name="controller")(Sum(signs="+-", name="error")(r, plant.y))
    else:
        command = PID(kp=2.0, ki=1.0, name="controller")(r, plant.y)
    at = positions(Diagram("loop", plant(feed(d, command))).draw().svg)
    assert at["wish"][0] < at["controller"][0] < at["feed"][0] < at["plant"][0]


def test_a_cascade_is_drawn_from_its_reference_to_the_plant_whatever_is_written_first():
    plant = TransferFunction(numerator=1.0, denominator=[1.0, 1.0, 0.0], name="plant")
    speed = TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name="speed")

    @subsystem(sample_time=0.01)
    def inner(wanted, w):
        return Gain(gain=5.0, name="kp")(wanted - w)

    @subsystem(sample_time=0.1)
    def outer(r, y):
        return Gain(gain=2.0, name="kp")(r - y)

    wish, load = Sine(frequency=1.0, name="wish"), Sine(frequency=2.0, name="load")
    force = inner(outer(wish, plant.y), speed.y)  # the inner loop's call comes first
    drawing = Diagram("cascade", plant(Sum(name="feed")(speed(force), load))).draw(width=5000)
    at = positions(drawing.svg)
    assert at["wish"][0] < at["outer"][0] < at["inner"][0] < at["speed"][0] < at["plant"][0]


def test_long_chains_of_blocks_need_no_recursion():
    keys = [f"k{i}" for i in range(3000)]
    wires = list(itertools.pairwise(keys))
    assert cut_loops(keys, wires, set()) == wires


# --- SVG ------------------------------------------------------------------------------------------------------------


def positions(svg):
    """Return where the titles of blocks stand."""
    found = {}
    for group in ET.fromstring(svg).iter(f"{SVG}g"):
        title, box = group.find(f"{SVG}title"), group.find(f"{SVG}rect")
        if title is not None and box is not None:
            found[title.text.partition(":")[0]] = (float(box.get("x")), float(box.get("y")))
    return found


def test_signals_run_from_left_to_right():
    at = positions(pi_loop().draw().svg)
    assert at["wish"][0] < at["error"][0] < at["plant"][0] < at["lag"][0]


def test_names_of_wires_and_signs_of_sums_are_written():
    shown = texts(pi_loop().draw().svg)
    assert {"e", "y", "Σ", "+", "−", "wish", "lag", "0.5", "1", "s"} <= set(shown)


def test_fig_3_shows_every_block_box_rate_and_fmu():
    diagram = experiments.compliance(delay=1).diagram
    shown = texts(diagram.draw().svg)
    assert {path.rpartition(".")[2] for path in diagram.blocks} <= set(shown)
    assert "FMU gantry.fmu" in shown
    assert sum("every 1 ms" in text for text in shown) == 2
    assert {"v_par", "v_perp", "eta", "xi", "motor_force"} <= set(shown)
    at = positions(diagram.draw(closed=True).svg)
    assert at["controller"][0] < at["plant"][0]


def test_closed_boxes_hide_what_is_in_them():
    diagram = experiments.compliance().diagram
    assert "pid_par" not in texts(diagram.draw(closed=True).svg)
    assert "force_sensor" in texts(diagram.draw(closed="controller").svg)
    assert "pid_par" in texts(diagram.draw(subsystem="controller").svg)
    assert "plant" not in texts(diagram.draw(subsystem="controller").svg)


def test_the_inside_of_a_box_names_what_enters_and_leaves():
    shown = texts(experiments.compliance().diagram.draw(subsystem="controller").svg)
    assert {"position", "eta_d", "motor_force"} <= set(shown)


def test_many_blocks_are_drawn_closed():
    @subsystem(sample_time=0.1)
    def chain(u):
        for i in range(45):
            u = Gain(gain=1.0, name=f"g{i}")(u)
        return {"y": u}

    diagram = Diagram("many", chain(Sine(frequency=1.0)).y)
    assert "g3" not in texts(diagram.draw().svg)
    assert "g3" in texts(diagram.draw(closed=False).svg)


def test_forty_blocks_wired_at_random():
    chance = random.Random(3)
    signals = [Sine(frequency=1.0, name="s").y]
    for i in range(40):
        if chance.random() < 0.5:
            signals.append(Sum(signs="++", name=f"b{i}")(chance.choice(signals), chance.choice(signals)))
        else:
            signals.append(Integrator(name=f"b{i}")(chance.choice(signals)))
    diagram = Diagram("random", *signals[-8:])
    svg = diagram.draw(closed=False).svg
    assert set(diagram.blocks) <= set(positions(svg))


def test_texts_are_escaped_and_nested_boxes_keep_their_conditions():
    @subsystem(enabled="reset")
    def inner(u):
        return {"y": Integrator()(u)}

    @subsystem(sample_time=0.01, delay=1)
    def outer(u):
        return {"y": inner(Gain(gain=2.0)(u), enable=u).y}

    shown = texts(Diagram("nested", outer(Sine(frequency=1.0)).y).draw().svg)
    assert any("every 10 ms · delay 1 sample" in text for text in shown)
    assert any("enabled, reset" in text for text in shown)


@pytest.mark.slow
def test_the_same_diagram_is_drawn_the_same_in_every_process():
    script = "from loopwright.diagrams import experiments; print(experiments.compliance().diagram.draw().svg)"
    drawn = {
        subprocess.run(
            [sys.executable, "-c", script],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("1", "2")
    }
    assert len(drawn) == 1


@pytest.mark.slow
def test_drawing_needs_no_matplotlib_and_shows_in_notebooks():
    script = (
        "import sys; from loopwright.diagrams import experiments; d = experiments.compliance().diagram; "
        "print(d._repr_svg_()[:4], 'matplotlib' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True).stdout
    assert found.split() == ["<svg", "False"]


def test_a_drawing_is_written_as_svg(tmp_path):
    drawing = pi_loop().draw(tmp_path / "pi.svg")
    assert (tmp_path / "pi.svg").read_text(encoding="utf-8") == drawing.svg
    with pytest.raises(OptionError, match="there is no folder"):
        pi_loop().draw(tmp_path / "nowhere" / "pi.svg")
    with pytest.raises(OptionError, match=r"name it pi\.svg"):
        pi_loop().draw(tmp_path / "pi.gif")


def test_unknown_boxes_are_refused_with_a_near_name():
    diagram = experiments.compliance().diagram
    for options in ({"subsystem": "controler"}, {"closed": "controler"}):
        with pytest.raises(OptionError, match="controller"):
            diagram.draw(**options)


def test_an_fmu_is_the_end_of_the_forward_path(uncompiled):
    motor = Fmu(dc_motor.build(), name="motor")
    error = Sum(signs="+-", name="error")(Sine(frequency=1.0, name="wish"), motor[next(iter(motor.outputs))])
    first, *others = motor.inputs
    wires = {first: Gain(gain=1.0, name="law")(error)}
    wires |= {name: Sine(frequency=1.0, name=f"other_{name}") for name in others}
    at = positions(Diagram("drive", motor(**wires)).draw().svg)
    assert at["wish"][0] < at["error"][0] < at["law"][0] < at["motor"][0]


def test_every_number_in_the_svg_is_finite():
    assert not re.search(r"nan|inf\b", experiments.compliance().diagram.draw().svg.replace("information", ""))
