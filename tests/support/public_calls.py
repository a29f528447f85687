"""Calls of everything public with good arguments, for tests that spoil one of them."""

import time
from functools import cache, partial

import control
import numpy as np

import loopwright.blocks as blocks
import loopwright.diagrams as diagrams
import loopwright.fmus as fmus
import loopwright.frequency as frequency
import loopwright.sweeps as sweeps
import loopwright.types as types
from loopwright.blocks import Constant, Gain, Integrator, StateSpace, Step
from loopwright.diagrams import Diagram, Requirements, experiments, subsystem
from loopwright.diagrams.web_page.shown_signals import ShownColumns
from loopwright.diagrams.web_page.web_page import Played

from .carts import cart_contact

QUIET = {"progress": False}


@cache
def drive():
    """Return a sampled PI controller around a damped oscillator."""
    A, B = np.array([[0.0, 1.0], [-9.0, -0.6]]), np.array([0.0, 9.0])
    plant = StateSpace(A=A, B=B, C=np.array([1.0, 0.0]), D=0.0, name="plant")

    @subsystem(sample_time=0.02)
    def control(e):
        return Gain(gain=0.2, name="kp")(e) + Gain(gain=0.3, name="ki")(Integrator(name="i")(e))

    e = (Step(times=0.1, values=1.0, name="step") - plant.y).named("e")
    return Diagram("drive", plant(control(e).named("u")).named("y"))


@cache
def run():
    return drive().simulate(0.1, **QUIET)


@cache
def model():
    return drive().linearize()


@cache
def loop():
    return model().loop("u")


@cache
def plain():
    return control.ss([[0.0, 1.0], [-1.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]], [[0.0]])


@cache
def data():
    w = np.geomspace(0.1, 10.0, 30)
    return control.frd(control.tf([2.0], [1.0, 1.0, 0.0]), w)


@cache
def admittance():
    return diagrams.AdmittanceLoop.of(experiments.force_tracking().diagram)


@cache
def swept():
    return drive().sweep({"kp.gain": (0.1, 0.3)}, 0.1, signals="y", workers=1, compile=False, **QUIET)


@cache
def sensitivities():
    return drive().sensitivities("u", ["kp.gain"])


@cache
def worst():
    return drive().worst_case({"kp.gain": (0.1, 0.3)}, "u", count=2, starts=0)


@cache
def limit():
    return cart_contact().stability_limit("stiffness", per_decade=30)


@cache
def simulation():
    """Return a simulation that is open until the process ends."""
    opened = drive().simulation(step=0.02).__enter__()
    opened.advance(0.1)
    return opened


@cache
def sampled():
    """Return a diagram that has a clock alone."""

    @subsystem(sample_time=0.02)
    def control(u):
        return Gain(gain=0.2, name="kp")(u).named("y")

    return Diagram("sampled", control(Constant(value=0.5, name="u")))


def web_page():
    columns = ShownColumns(sampled().wired.flatten(None), "sampled")
    return types.WebPage("<!doctype html>", "sampled", 300, "", Played(sampled(), columns, {}, {}))


@cache
def spec():
    return fmus.model_spec(fmus.mass_spring_damper.nominal, name="i")


@cache
def fig3_parts():
    """Return the arguments of an experiment's diagram."""
    structure = experiments.path_following().diagram.structure
    plant = next(block for block in structure.blocks.values() if isinstance(block, fmus.Fmu))
    line = blocks.Line(start=(-1.0, 0.0), end=(1.0, 0.0))
    return {"plant": plant, "path": line, "par": diagrams.Channel((-1.0, -2.0)), "perp": diagrams.Channel((-1.0, -2.0))}


def calls():
    """Return public callables by name, each with good arguments by name."""
    d = drive
    lag = {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "poles": [-1.0, -2.0], "reach": 1e-8}
    short = {"duration": 0.1, "workers": 1, "progress": False}
    return {
        "hold": lambda: (blocks.hold, {"A": np.eye(2), "T": 0.1, "method": "exact"}),
        "parse_unit": lambda: (blocks.parse_unit, {"text": "N.m"}),
        "Circle": lambda: (blocks.Circle, {"radius": 1.0, "center": [0.0, 0.0], "clockwise": False}),
        "Ellipse": lambda: (blocks.Ellipse, {"semi_axes": [1.0, 2.0], "center": [0.0, 0.0], "clockwise": False}),
        "Line": lambda: (blocks.Line, {"start": [0.0, 0.0], "end": [1.0, 0.0]}),
        "CubicSpline": lambda: (blocks.CubicSpline, {"points": [[0.0, 0.0], [1.0, 1.0], [2.0, 0.0]], "closed": False}),
        "Diagram": lambda: (
            lambda name, root, loops: Diagram(name, root, loops=loops),
            {"name": "d", "root": Gain(gain=1.0, name="g")(Step(times=0.0, values=1.0, name="s")), "loops": "error"},
        ),
        "Diagram[]": lambda: (lambda path: d()[path], {"path": "kp"}),
        "Diagram.replace": lambda: (lambda changes: d().replace(changes), {"changes": {"kp.gain": 1.0}}),
        "Diagram.replace name": lambda: (lambda value: d().replace({"kp.gain": value}), {"value": 1.0}),
        "Diagram.sampled": lambda: (d().sampled, {"sample_time": 0.02, "method": "exact"}),
        "Diagram.simulate": lambda: (
            d().simulate,
            {
                "duration": 0.1,
                "progress": False,
                "step": 0.02,
                "solver": "RK45",
                "rtol": 1e-6,
                "atol": 1e-9,
                "max_step": 0.1,
                "record": ["y"],
                "every": 1,
                "states": True,
                "overwrite": False,
                "coupling": "jacobi",
                "start": run().final_state,
                "start_exchange": "agree",
                "compile": False,
                "fuse": False,
            },
        ),
        "Diagram.simulation": lambda: (d().simulation, {"step": 0.01, "solver": "RK45"}),
        "Diagram.operating_point": lambda: (d().operating_point, {"t": 0.0, "states": {"i.y": 0.1}}),
        "Diagram.trim": lambda: (
            d().trim,
            {
                "free": {"kp.gain": (0.1, 1.0)},
                "targets": {"y": 0.0},
                "rates": {},
                "fixed": ["i.y"],
                "at": 0.0,
                "tolerance": 1e-9,
            },
        ),
        "Diagram.linearize": lambda: (
            d().linearize,
            {"at": 0.0, "inputs": ["u"], "outputs": ["y"], "openings": [], "plants": None, "stairs": None},
        ),
        "Diagram.linearize_batch": lambda: (d().linearize_batch, {"points": [0.0], "variants": [{"kp.gain": 1.0}]}),
        "Diagram.continuous": lambda: (d().continuous, {}),
        "Diagram.sweep": lambda: (
            d().sweep,
            {
                **short,
                "parameters": {"kp.gain": (0.1, 0.2)},
                "samples": "latin",
                "count": 2,
                "seed": 0,
                "seeds": (),
                "signals": "y",
                "reduce": {"end": sweeps.final("y")},
                "to": None,
                "overwrite": False,
                "client": None,
                "lanes": False,
                "compile": False,
            },
        ),
        "Diagram.sensitivities": lambda: (
            d().sensitivities,
            {"loop": "u", "parameters": ["kp.gain"], "at": 0.0, "delay": 0, "skew": 0.0},
        ),
        "Diagram.worst_case": lambda: (
            d().worst_case,
            {
                "parameters": {"kp.gain": (0.1, 0.3)},
                "loop": "u",
                "quantity": "disk_margin",
                "samples": "latin",
                "count": 2,
                "seed": 0,
                "starts": 0,
                "steps": 1,
                "at": 0.0,
                "delay": 0,
                "progress": None,
            },
        ),
        "Diagram.report_coupling": lambda: (d().report_coupling, {"coupling": "jacobi", "step": 0.01}),
        "Diagram.flatten": lambda: (d().flatten, {"step": 0.01}),
        "Diagram.draw": lambda: (d().draw, {"path": None, "closed": False, "subsystem": "control"}),
        "Diagram.frequency_response": lambda: (
            d().frequency_response,
            {"wire": "u", "frequencies": [5.0], "amplitude": 0.1},
        ),
        "Linearization.loop": lambda: (lambda wire: model().loop(wire), {"wire": "u"}),
        "Linearization.sensitivity": lambda: (lambda wire: model().sensitivity(wire), {"wire": "u"}),
        "Linearization.complementary": lambda: (lambda wire: model().complementary(wire), {"wire": "u"}),
        "LoopTransfer.bode": lambda: (loop().bode, {"omega": [1.0], "labels": ["L"], "db": True, "hz": False}),
        "LoopTransfer.bode others": lambda: (lambda other: loop().bode(other), {"other": plain()}),
        "LoopTransfer.nyquist": lambda: (loop().nyquist, {"omega": [1.0], "labels": ["L"]}),
        "LoopTransfer.nichols": lambda: (loop().nichols, {"omega": [1.0], "labels": ["L"]}),
        "LoopTransfer.step": lambda: (loop().step, {"t": 1.0, "labels": ["L"]}),
        "LoopTransfer.gang_of_four": lambda: (loop().gang_of_four, {"measured": "y", "omega": [1.0], "labels": ["L"]}),
        "Run[]": lambda: (lambda name: run()[name], {"name": "y"}),
        "Run.at": lambda: (run().at, {"t": 0.04}),
        "Run.unit": lambda: (run().unit, {"name": "y"}),
        "Run.plot": lambda: (run().plot, {"names": "y"}),
        "Run.to_pandas": lambda: (run().to_pandas, {"names": "y"}),
        "Run.open": lambda: (diagrams.Run.open, {"path": "/nowhere"}),
        "Snapshot[]": lambda: (lambda name: run().at(0.04)[name], {"name": "y"}),
        "Sweep[]": lambda: (lambda name: swept()[name], {"name": "y"}),
        "Sensitivities[]": lambda: (
            lambda parameter, quantity: sensitivities()[parameter, quantity],
            {"parameter": "kp.gain", "quantity": "ms"},
        ),
        "Sensitivities.of": lambda: (sensitivities().of, {"quantity": "ms", "count": 1}),
        "Sensitivities.plot": lambda: (sensitivities().plot, {"quantity": "ms", "count": 1}),
        "WorstCase.plot": lambda: (worst().plot, {"parameters": ["kp.gain"]}),
        "margins": lambda: (frequency.margins, {"loop": loop(), "delay": 0, "skew": 0.0}),
        "disk_margin": lambda: (frequency.disk_margin, {"loop": loop(), "delay": 0, "skew": 0.0}),
        "mimo_disk_margin": lambda: (frequency.mimo_disk_margin, {"loop": loop(), "delay": 0, "skew": 0.0}),
        "periodic_margins": lambda: (frequency.periodic_margins, {"loop": loop()}),
        "nyquist_count": lambda: (frequency.nyquist_count, {"loop": loop(), "delay": 0}),
        "sensitivity": lambda: (frequency.sensitivity, {"loop": loop()}),
        "complementary": lambda: (frequency.complementary, {"loop": loop()}),
        "gang_of_four": lambda: (frequency.gang_of_four, {"plant": plain(), "controller": plain()}),
        "compare_with_control": lambda: (frequency.compare_with_control, {"loop": loop(), "delay": 0}),
        "measured_margins": lambda: (frequency.measured_margins, {"data": data(), "uncertainty": 0.01}),
        "delayed_hold": lambda: (frequency.delayed_hold, {"plant": plain(), "sample_time": 0.1, "delay": 0.05}),
        "delayed_hold_margin": lambda: (
            frequency.delayed_hold_margin,
            {"plant": plain(), "controller": control.ss([], [], [], [[0.5]], 0.1), "largest": 20.0},
        ),
        "loop_at": lambda: (frequency.loop_at, {"plant": plain(), "controller": plain(), "where": "input"}),
        "place": lambda: (frequency.place, lag),
        "sampled_gains": lambda: (
            frequency.sampled_gains,
            {"poles": [-2.0, -3.0, -4.0], "sample_time": 0.01, "delay": 0, "integral": "forward"},
        ),
        "sampled_poles": lambda: (
            frequency.sampled_poles,
            {"gains": [24.0, 26.0, 9.0], "sample_time": 0.01, "delay": 0, "integral": "forward"},
        ),
        "read_frequency_data": lambda: (frequency.read_frequency_data, {"file": "/nowhere.csv", "dt": 0.0}),
        "final": lambda: (sweeps.final, {"signal": "y"}),
        "maximum": lambda: (sweeps.maximum, {"signal": "y", "since": 0.0}),
        "minimum": lambda: (sweeps.minimum, {"signal": "y", "since": 0.0}),
        "mean": lambda: (sweeps.mean, {"signal": "y", "since": 0.0}),
        "settling_time": lambda: (sweeps.settling_time, {"signal": "y", "band": 0.1, "target": 0.0, "since": 0.0}),
        "Box": lambda: (sweeps.Box, {"low": 1.0, "high": 2.0, "scale": "log"}),
        "Coupling": lambda: (
            diagrams.Coupling,
            {"scheme": "iterated", "order": (), "tolerance": 1e-9, "passes": 5, "error": None, "shortest": 1e-9},
        ),
        "Requirements": lambda: (
            Requirements,
            {
                "step": {"overshoot": 0.1},
                "loops": {"u": {"ms": 2.0}},
                "variants": ["sampled_d1"],
                "numbers": {"a.b": (0.0, 1.0)},
                "contact": None,
                "stable": True,
                "ms": 2.0,
            },
        ),
        "RunOptions.of": lambda: (
            lambda options: types.RunOptions.of(options, block="d"),
            {"options": {"step": 0.1}},
        ),
        "subsystem": lambda: (
            diagrams.subsystem,
            {"sample_time": 0.1, "method": "exact", "name": "s", "offset": 0.0, "delay": 0},
        ),
        "first_order_hold": lambda: (
            diagrams.first_order_hold,
            {"u": Gain(gain=1.0)(1.0), "sample_time": 0.1, "offset": 0.0, "name": "s"},
        ),
        "check_block": lambda: (
            diagrams.check_block,
            {
                "block": Gain(gain=1.0),
                "inputs": {},
                "shapes": {},
                "sample_time": 0.01,
                "ticks": 3,
                "seed": 0,
                "kinds": ["sampled"],
                "duration": 0.1,
            },
        ),
        "poles": lambda: (
            diagrams.poles,
            {"loop": admittance(), "stiffness": 100.0, "damping": 0.0, "mass": 0.0, "tool_mass": 0.0},
        ),
        "growth_rate": lambda: (diagrams.growth_rate, {"loop": admittance(), "stiffness": 100.0}),
        "crossing_frequency": lambda: (diagrams.crossing_frequency, {"loop": admittance(), "stiffness": 100.0}),
        "passivity": lambda: (diagrams.passivity, {"loop": admittance(), "low": 1.0, "high": 10.0, "per_decade": 10}),
        "rendered_admittance": lambda: (diagrams.rendered_admittance, {"loop": admittance(), "omega": [1.0]}),
        "rendered_response": lambda: (diagrams.rendered_response, {"loop": admittance(), "omega": [1.0]}),
        "rendered_system": lambda: (diagrams.rendered_system, {"loop": admittance()}),
        "target_admittance": lambda: (diagrams.target_admittance, {"loop": admittance(), "omega": [1.0]}),
        "rule_of_thumb": lambda: (diagrams.rule_of_thumb, {"loop": admittance(), "damping": 0.0}),
        "stability_limit": lambda: (
            diagrams.stability_limit,
            {"loop": admittance(), "over": "stiffness", "low": 1e3, "high": 1e5, "per_decade": 5, "damping": 0.0},
        ),
        "stability_map": lambda: (
            diagrams.stability_map,
            {"loop": admittance(), "x_values": [1e3, 1e4], "y_values": [0.0, 1.0], "x": "stiffness", "y": "damping"},
        ),
        "stiffness_limits": lambda: (diagrams.stiffness_limits, {"loop": admittance(), "dampings": [0.0]}),
        "confirm_sensitivity": lambda: (
            diagrams.confirm_sensitivity,
            {"found": sensitivities(), "row": next(iter(sensitivities())), "delay": 0, "skew": 0.0},
        ),
        "analyse": lambda: (
            diagrams.analyse,
            {
                "diagram": d(),
                "at": 0.0,
                "loops": ["u"],
                "only": ("subject",),
                "stairs": None,
                "requirements": None,
                "about": {"a": "b"},
                "decibels": False,
                "hertz": False,
                "measured": None,
                "worst_case": None,
                "contacts": None,
                "workers": 1,
            },
        ),
        "Contact.admittance": lambda: (cart_contact().admittance, {"omega": [1.0]}),
        "Contact.passivity": lambda: (cart_contact().passivity, {"low": 1.0, "high": 10.0, "per_decade": 30}),
        "Contact.loop": lambda: (cart_contact().loop, {"vary": "stiffness", "damping": 1.0}),
        "Contact.stability_limit": lambda: (
            cart_contact().stability_limit,
            {"vary": "stiffness", "low": 1e2, "high": 1e4, "per_decade": 30, "damping": 0.0},
        ),
        "Contact.stability_map": lambda: (
            cart_contact().stability_map,
            {"x_values": [1e2, 1e3], "y_values": [0.0, 1.0], "x": "stiffness", "y": "damping"},
        ),
        "Contact.confirm": lambda: (cart_contact().confirm, {"limit": limit(), "push": 1e-6, "method": "solver"}),
        "Simulation.time_of": lambda: (simulation().time_of, {"k": 1}),
        "Simulation.advance": lambda: (simulation().advance, {"duration": 0.02, "progress": None}),
        "Diagram.to_html": lambda: (
            sampled().to_html,
            {
                "path": "/nowhere/page.html",
                "inputs": {"u": (-1.0, 1.0)},
                "sliders": {"kp.gain": (0.0, 1.0)},
                "plots": ["y"],
                "step": None,
                "solver": "auto",
                "speed": 1.0,
                "span": 10.0,
                "title": "drive",
            },
        ),
        "Diagram.to_c": lambda: (
            sampled().to_c,
            {
                "folder": "/nowhere/c",
                "name": "own",
                "subsystem": None,
                "outside": (),
                "outputs": None,
                "number": "double",
                "own_functions": False,
            },
        ),
        "to_c": lambda: (
            diagrams.to_c,
            {
                "model": sampled(),
                "folder": "/nowhere/c",
                "name": "own",
                "subsystem": None,
                "outside": (),
                "outputs": None,
                "number": "double",
                "own_functions": False,
            },
        ),
        "Diagram.to_ssp": lambda: (
            sampled().to_ssp,
            {"path": "/nowhere/x.ssp", "stop": None, "step": None, "flat": False},
        ),
        "read_ssp": lambda: (diagrams.read_ssp, {"file": "/nowhere/x.ssp", "variant": None}),
        "WebPage.save": lambda: (web_page().save, {"path": "/nowhere/page.html"}),
        "Simulation.run_realtime": lambda: (
            simulation().run_realtime,
            {
                "duration": 0.02,
                "speed": 100.0,
                "inputs": {"kp.gain": 0.3},
                "frame": 0.01,
                "catch_up": 100.0,
                "stop": None,
                "on_frame": None,
                "background": False,
                "clock": time.perf_counter,
                "sleep": time.sleep,
            },
        ),
        "Simulation.save": lambda: (simulation().save, {}),
        "Simulation.restore": lambda: (simulation().restore, {"state": run().final_state}),
        "Simulation.run": lambda: (simulation().run, {"final": True}),
        "Simulation.set_parameters": lambda: (
            simulation().set_parameters,
            {"path": "control.kp", "block": drive()["kp"].replace(gain=0.3)},
        ),
        "fmus.build_fmu": lambda: (
            fmus.build_fmu,
            {"spec": spec(), "out": "/nowhere/x.fmu", "fmi": 3, "arrays": True, "platform": None, "documentation": ""},
        ),
        "fmus.build_python": lambda: (
            fmus.build_python,
            {
                "block": fmus.mass_spring_damper.nominal,
                "out": "/nowhere/x.fmu",
                "name": "i",
                "internal_step": 1e-3,
                "stop_time": 1.0,
                "step_size": 1e-3,
                "files": (),
            },
        ),
        "fmus.doctor": lambda: (fmus.doctor, {"file": "/nowhere.fmu", "run": False, "limits": None}),
        "fmus.read_description": lambda: (
            fmus.read_description,
            {"file": "/nowhere.fmu", "sizes": None, "limits": None},
        ),
        "fmus.tune": lambda: (fmus.tune, {"path": "/nowhere.fmu"}),
        "fmus.model_spec": lambda: (
            fmus.model_spec,
            {
                "block": fmus.mass_spring_damper.nominal,
                "name": "i",
                "internal_step": 1e-3,
                "stop_time": 1.0,
                "step_size": 1e-3,
                "integrator": "rk4",
                "tolerance": 1e-8,
            },
        ),
        "fmus.build": lambda: (
            fmus.build,
            {"block": Gain, "out": "/nowhere/x.fmu", "name": "i", "fmi": 3, "arrays": True, "platform": None},
        ),
        "fmus.build of a diagram": lambda: (
            partial(fmus.build, platform="of no machine"),  # an error that ends before anything is compiled
            {
                "block": sampled(),
                "name": "i",
                "subsystem": None,
                "outside": (),
                "outputs": None,
                "communication": "any",
                "solver": None,
                "clocks": False,
                "start": None,
                "own_functions": False,
            },
        ),
        "Isolation": lambda: (
            fmus.Isolation,
            {"step_time": 60.0, "start_time": 300.0, "memory": None, "output": 2.56e8},
        ),
        "StepOptions": lambda: (
            fmus.StepOptions,
            {
                "tolerance": None,
                "event_mode": None,
                "early_return": None,
                "retries": 10,
                "rollback": False,
                "input_derivatives": False,
                "time": "multiplied",
                "communication_step": None,
            },
        ),
        "ArchiveLimits": lambda: (
            fmus.ArchiveLimits,
            {"size": 8e9, "entries": 1000, "ratio": 100.0, "description": 10**9, "elements": 10**7},
        ),
        "Fmu": lambda: (fmus.Fmu, {"file": "/nowhere.fmu", "start": {}, "rename": {}, "isolate": None, "ports": None}),
    }
