"""Random diagrams with clocks, continuous states, events, algebraic loops and FMUs, for Loopwright and the reference loop."""

from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cache, partial, reduce
from math import ceil, gcd
from typing import Any

import numpy as np

from loopwright.diagrams import AlgebraicLoopError, Diagram, subsystem
from loopwright.fmus import Fmu, StepOptions, build

from .plain_blocks import HUNDREDTH, KINDS, Draw, Pendulum
from .reference_loop import DelicateError, Part, ReferenceLoop

FAMILIES = ("sampled", "continuous", "hybrid", "plants", "slower")
"""Of the last two with FMUs, "slower" with communication steps of their own; every other one of these has no solver."""
PERIODS = (2, 3, 4, 5, 6, 10, Fraction(20, 3))
EVENTFUL = ("alarm", "takes", "latch", "counter", "relay", "resettable_integrator", "crossings", "compare")
"""Kinds that are drawn more often: what they keep jumps."""
SOLVERS = {"rk4": 1e-9, "DOP853": 1e-11, "RK45": 1e-10, "auto": 1e-11, "Radau": 1e-10, "RK23": 1e-8}
"""Relative tolerances, by solver; rk4 has none, and takes small steps."""
STEP = Fraction(1, 1000)
"""Step of rk4 in s, at most."""


@dataclass
class Random:
    """A random diagram in both forms, with the options of its run and the instants that it records."""

    family: str
    seed: int
    diagram: Diagram
    parts: list[Part]
    samples: list[Fraction]
    end: Fraction
    options: dict[str, Any]

    @property
    def tolerance(self):
        """Relative tolerance of values: of rounding where everything is sampled, else of the solver."""
        if self.family == "sampled":
            return 1e-13
        if self.options["solver"] == "rk4":
            return 3e-5 if any(p.kinks for p in self.parts) else 1e-7
        return max(1e-8, 300 * self.options["rtol"])


@dataclass
class Node:
    """A block in one of the subsystems, 0 is the diagram itself."""

    name: str
    frame: int
    block: Any
    part: Part
    reads: tuple[str, ...]
    makes: str
    sources: list[str] = field(default_factory=list)
    own: Fraction | None = None
    """Communication step in s that an FMU asks for."""


def reference(case):
    """Return what the reference loop records of a diagram; None where rounding would decide what happens."""
    try:
        apart = 1e-5 if case.options.get("solver") == "rk4" else 1e-8
        return ReferenceLoop(case.parts, case.samples, apart).run()
    except DelicateError:
        return None


def make_if_possible(family, seed):
    """Return the diagram with this number; None where its initial values depend on each other."""
    try:
        return make(family, seed)
    except AlgebraicLoopError:
        return None


def run(case, *, compiled="auto"):
    """Run Loopwright's diagram."""
    return case.diagram.simulate(float(case.end), compile=compiled, progress=False, **case.options)


def differences(case, expected, found):
    """Return in words where a run is not what the reference loop has recorded."""
    times = [float(t) for t in expected.t]
    if found.t.tolist() != times:
        return [f"samples at {sorted(set(found.t) ^ set(times))[:4]}"]
    told = []
    for name, values in expected.values.items():
        away = np.abs(found[name] - values) / max(1.0, np.max(np.abs(values)))
        if not np.all(away <= case.tolerance):
            first = int(np.argmax(~(away <= case.tolerance)))
            told.append(
                f"{name}: {found[name][first]} for {values[first]} at {times[first]}, {np.max(away):.1e} at most"
            )
    events: dict[tuple[str, str], tuple[list[float], list[float]]] = {}
    for t, part, event in expected.events:
        events.setdefault((part, event), ([], []))[0].append(t)
    for e in found.events:
        events.setdefault((e.block.rpartition(".")[2], e.event), ([], []))[1].append(e.t)
    near = 10 * case.tolerance
    for (part, event), (first, second) in events.items():
        if len(first) != len(second) or any(
            abs(a - b) > near for a, b in zip(sorted(first), sorted(second), strict=True)
        ):
            told.append(f"{part}.{event} at {second[:4]} for {first[:4]}, {len(second)} for {len(first)} times")
    return told


def make(family, seed):
    """Return the diagram of a family with this number."""
    rng = np.random.default_rng([FAMILIES.index(family), seed])
    pick = lambda options: options[int(rng.integers(len(options)))]  # noqa: E731
    end = Fraction(int(rng.integers(40, 80)), 100) if family != "sampled" else Fraction(5)
    frames = [None]
    if family != "continuous":
        for _ in range(int(rng.integers(1, 4))):
            period = Fraction(pick(PERIODS)) / 100
            frames.append((period, pick((Fraction(0), Fraction(0), HUNDREDTH))))
    nodes = []

    def add(name_of_kind, frame, **given):
        kind = KINDS[name_of_kind]
        name = f"{name_of_kind}{len(nodes)}"
        clock = frames[frame]
        made, part = kind.make(Draw(rng, name, None if clock is None else float(clock[0]), end), **given)
        nodes.append(Node(name, frame, made, replace(part, clock=clock), kind.reads, kind.makes))

    solved = family != "sampled" and (family != "slower" or seed % 2 == 0)  # else nothing moves between ticks
    frames_at_hand = range(int(not solved), len(frames))
    for name_of_kind in ("sine", "step", "logic_train", "clock"):
        add(name_of_kind, pick(frames_at_hand))
    for _ in range(int(rng.integers(6, 16))):
        frame = pick(frames_at_hand)
        fits = {n: k for n, k in KINDS.items() if (k.sampled if frame else k.continuous)}
        shares = np.array([(4 if k.reads else 1) * (3 if n in EVENTFUL else 1) for n, k in fits.items()], dtype=float)
        add(str(rng.choice(list(fits), p=shares / shares.sum())), frame)
    if family in ("plants", "slower"):
        for _ in range(int(rng.integers(1, 3)) + (family == "slower")):
            own = Fraction(pick(PERIODS)) / 100 if family == "slower" and rng.random() < 0.7 else None
            add_plant(nodes, rng, own)
    for i, node in enumerate(nodes):
        for wanted in node.reads:
            allowed = [
                n
                for j, n in enumerate(nodes)
                if n.makes == wanted and (j < i or not node.part.direct or not n.part.direct)
            ]
            allowed = [n for n in allowed if n is not node] or [n for n in nodes if n.makes == wanted and not n.reads]
            jumping = [n for n in allowed if n.part.events and n.part.z]
            source = pick(jumping if jumping and node.frame and rng.random() < 0.6 else allowed)
            node.sources.append(f"{source.name}.{pick(source.part.ports)}")
    if family in ("hybrid", "plants") or (family == "slower" and solved):
        add_alarm(nodes, add, pick, frames, rng, end)
    loops = rng.random() < 0.4
    if loops:
        close_loops(nodes, frames_at_hand, frames, rng, end)
    clocks = sorted({n.part.clock for n in nodes} - {None} | {(n.own, Fraction(0)) for n in nodes if n.own})
    solver = pick([name for name in SOLVERS if family in ("continuous", "hybrid") or name != "rk4"])
    options = {"step": None, "every": pick((1, 1, 1, 2, 3))}
    if family != "sampled":
        options |= {"solver": solver, "rtol": SOLVERS[solver], "atol": 0.1 * SOLVERS[solver]}
    if family != "sampled" and solver == "rk4":
        base = base_of(clocks, None) if clocks else HUNDREDTH
        options |= {"step": base / ceil(base / STEP), "every": 15}
    elif family == "continuous" or not clocks:
        options["step"] = pick((Fraction(1, 100), Fraction(1, 50), Fraction(1, 40)))
    elif family != "sampled" and rng.random() < 0.5:
        options["step"] = base_of(clocks, None) / pick((1, 1, 2))
    step = options["step"]
    settle_plants(nodes, step, clocks)
    parts = [replace(n.part, inputs=tuple(n.sources)) for n in nodes]
    samples = visited(parts, clocks, step, end, options["every"])
    made = assemble(f"{family}{seed}", nodes, frames, loops=loops)
    return Random(family, seed, made, parts, samples, end, options)


def add_alarm(nodes, add, pick, frames, rng, end):
    """Add an event at the very time of a tick, and a block that sees it there."""
    frame = int(rng.integers(1, len(frames)))
    period, offset = frames[frame]
    add("alarm", 0, at=offset + period * int(rng.integers(1, max(2, end / period - 1))))
    add(pick(("hold", "unit_delay")), frame)
    nodes[-1].sources = [f"{nodes[-2].name}.y"]


def close_loops(nodes, frames_at_hand, frames, rng, end):
    """Add one or two algebraic loops: e₁ = w₁ − a tanh(b e₂), e₂ = w₂ + … in one subsystem."""
    frame = frames_at_hand[int(rng.integers(len(frames_at_hand)))]
    clock = frames[frame]
    signals = [f"{n.name}.{p}" for n in nodes if n.makes == "real" for p in n.part.ports]
    begin, made = len(nodes), []
    for _ in range(int(rng.integers(1, 3))):
        for name_of_kind in ("difference", "bend"):
            name = f"{name_of_kind}{begin + len(made)}"
            kind = KINDS[name_of_kind]
            block, part = kind.make(Draw(rng, name, None if clock is None else float(clock[0]), end))
            made.append(Node(name, frame, block, replace(part, clock=clock), kind.reads, kind.makes))
    sums, bends = made[::2], made[1::2]
    for i, (total, bent) in enumerate(zip(sums, bends, strict=True)):
        total.sources = [signals[int(rng.integers(len(signals)))], f"{bends[i - 1].name}.y"]
        bent.sources = [f"{total.name}.y"]
    nodes += made


# --- FMUs --------------------------------------------------------------------------------------------------------------


@cache
def pendulum_fmu():
    return build(Pendulum(), internal_step=5e-4)


def add_plant(nodes, rng, own):
    """Add a pendulum as an FMU, with its equations in the reference loop; ``own`` is its communication step or None."""
    name, w, damping, angle = f"plant{len(nodes)}", *(float(v) for v in rng.uniform([1, 0.1, -2], [4, 0.5, 2]))
    start, stepping = {"w": w, "damping": damping, "y": angle}, StepOptions(communication_step=own)
    made = Fmu(pendulum_fmu(), name=name, start=start, stepping=stepping)
    part = Part(
        name,
        lambda t, x, z, u: x[0],
        x=(angle, 0.0),
        rate=lambda t, x, z, u: (x[1], u[0] - w**2 * np.sin(x[0]) - damping * x[1]),
        direct=False,
        plant=((Fraction(1), Fraction(0)),),  # until `settle_plants`
    )
    nodes.append(Node(name, 0, made, part, ("real",), "real", own=own))


def settle_plants(nodes, step, clocks):
    """Find the ticks at which each plant steps: those of the subsystems that it is wired to, see "Communication points"."""
    plants = [n for n in nodes if n.part.plant]
    if not plants:
        return
    of = {n.name: n for n in nodes}
    above = {n.name: {s.partition(".")[0] for s in n.sources} for n in nodes}
    below = {n.name: {m.name for m in nodes if n.name in above[m.name]} for n in nodes}

    def reach(name, ways):
        """What is wired to it, directly or through blocks in continuous time."""
        found, waiting = set(), [name]
        while waiting:
            for other in ways[waiting.pop()] - found:
                found.add(other)
                if of[other].part.clock is None and not of[other].part.plant:
                    waiting.append(other)
        return found

    groups = {n.name: {n.name} for n in plants}
    reached = {n.name: reach(n.name, above) | reach(n.name, below) for n in plants}
    for n in plants:
        for other in reached[n.name] & set(groups):
            joined = groups[n.name] | groups[other]
            for name in joined:
                groups[name] = joined
    for n in plants:
        own = {of[m].part.clock for name in groups[n.name] for m in reached[name]} - {None}
        ticks = [(base_of(clocks, step), Fraction(0))] if step else sorted(own or set(clocks))
        ticks = [(n.own, Fraction(0))] if n.own else ticks
        n.part = replace(n.part, plant=tuple(ticks))


# --- instants ----------------------------------------------------------------------------------------------------------


def base_of(clocks, step):
    """Return the greatest common divisor of all sample times and offsets, and of the step."""
    times = [t for clock in clocks for t in clock if t] + ([step] if step else [])
    return reduce(
        lambda a, b: Fraction(
            gcd(a.numerator * b.denominator, b.numerator * a.denominator), a.denominator * b.denominator
        ),
        times,
    )


def visited(parts, clocks, step, end, every):
    """Return the recorded ones of the ticks that are visited: at which a subsystem acts, or all where there is a step.

    The end is recorded in any case.
    """
    if step:
        base = base_of(clocks, step)
        ticks = {k * base for k in range(int(end / base) + 1)}
    else:
        used = {c for part in parts for c in part.clocks}
        ticks = {o + k * p for p, o in used for k in range(int((end - o) / p) + 1)}
    kept = sorted(ticks | {Fraction(0)})[::every]
    return kept if kept[-1] == end else [*kept, end]


# --- the diagram -------------------------------------------------------------------------------------------------------


def assemble(name, nodes, frames, *, loops):
    """Build Loopwright's diagram: signals cross the borders of subsystems straight."""
    of = {n.name: n for n in nodes}

    def wire(signal):
        owner, _, port = signal.partition(".")
        return getattr(of[owner].block, port)

    def call(node):
        return node.block(*map(wire, node.sources))

    def inside(frame):
        return {f"o{i}": as_call(call(n)) for i, n in enumerate(n for n in nodes if n.frame == frame)}

    def as_call(made):
        return made

    calls = [call(n) for n in nodes if n.frame == 0]
    for i, clock in enumerate(frames):
        if clock is not None and any(n.frame == i for n in nodes):
            made = subsystem(name=f"box{i}", sample_time=clock[0], offset=clock[1])(partial(inside, i))
            calls.append(made())
    return Diagram(name, *calls, **({"loops": "solve"} if loops else {}))
