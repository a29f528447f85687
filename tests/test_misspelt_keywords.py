"""Misspelt keywords of everything public: an error of Loopwright's own names the argument and the one that is near it."""

import enum
import inspect

import pytest

import loopwright
from loopwright.blocks import Gain, Input, LoopwrightError, OptionError, Output, State, Value
from loopwright.diagrams import Requirements, experiments, subsystem
from loopwright.diagrams.frequency import loop_class
from loopwright.diagrams.paper.experiments import Experiment
from support.carts import cart_contact
from support.public_calls import calls, drive

PACKAGES = (
    loopwright.blocks,
    loopwright.diagrams,
    loopwright.fmus,
    loopwright.frequency,
    loopwright.sweeps,
    loopwright.types,
)
HOUSE = "loopwright."
RETURNED = (loop_class(), Experiment)
"""Classes of objects that public functions return, and that no package exports."""
NO_SUBJECTS = (Exception, KeyboardInterrupt, enum.Enum, Value, loopwright.types.FmuInstance)
"""Errors and choices; values, whose constructor tells it in words of its own; an FMU that a run alone calls."""


def public_classes():
    for package in PACKAGES:
        for name in package.__all__:
            value = getattr(package, name)
            if inspect.isclass(value) and not issubclass(value, NO_SUBJECTS):
                yield value
    yield from RETURNED


def callables_of(cls):
    """Yield the constructor and the public methods of a class that this project has written."""
    for base in cls.__mro__:
        for name, member in vars(base).items():
            plain = getattr(member, "__func__", member)
            if not inspect.isfunction(plain) or not base.__module__.startswith(HOUSE):
                continue
            if name == "__new__" and not issubclass(cls, tuple):
                continue
            if not name.startswith("_") or name in ("__init__", "__new__", "__call__"):
                yield name, plain


def public_callables():
    """Return all that takes arguments by name, and whether it takes names of any kind."""
    found = {}
    for package in PACKAGES:
        for name in package.__all__:
            value = getattr(package, name)
            if inspect.isfunction(value):
                found[name] = value
    for module in (loopwright.diagrams.experiments,):
        for name in module.__all__:
            if inspect.isfunction(value := getattr(module, name)):
                found[f"experiments.{name}"] = value
    for cls in {c.__name__: c for c in public_classes()}.values():
        for name, function in callables_of(cls):
            found.setdefault(f"{cls.__name__}.{name}", function)
    return found


CALLABLES = public_callables()
OPEN = {
    n for n, f in CALLABLES.items() if any(p.kind is p.VAR_KEYWORD for p in inspect.signature(f).parameters.values())
}
"""Callables that hand options on: they are called with good arguments besides."""


def names_of(subject):
    return sorted(name for name in CALLABLES.keys() - OPEN if name.partition(".")[0] == subject)


@pytest.mark.parametrize("subject", sorted({name.partition(".")[0] for name in CALLABLES.keys() - OPEN}))
def test_a_misspelt_keyword_is_named_with_its_neighbours(subject):
    for function in map(CALLABLES.get, names_of(subject)):
        parameters = inspect.signature(function).parameters.values()
        own = [p.name for p in parameters if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
        own = [one for one in own if one not in ("self", "cls") and not one.startswith("_")]
        for right in own or ["nothing"]:
            wrong = right + "x"
            with pytest.raises(OptionError, match=f"has no argument '{wrong}'" + (f".*'{right}'" if own else "")):
                function(*[object()] * (len(own) < len(parameters)), **{wrong: 1.0})


@subsystem(sample_time=0.1)
def controller(error):
    return Gain(gain=1.0, name="g")(error)


GOOD = calls()
HANDED_ON = {
    "Diagram.simulate": (GOOD["Diagram.simulate"], "progress solver every"),
    "Diagram.simulation": (GOOD["Diagram.simulation"], "solver start_exchange"),
    "Diagram.operating_point": (GOOD["Diagram.operating_point"], "states max_step"),
    "Diagram.trim": (GOOD["Diagram.trim"], "targets tolerance solver"),
    "Diagram.linearize": (GOOD["Diagram.linearize"], "inputs openings solver"),
    "Diagram.linearize_batch": (GOOD["Diagram.linearize_batch"], "variants solver"),
    "Diagram.sweep": (GOOD["Diagram.sweep"], "parameters samples signals solver"),
    "Diagram.sensitivities": (GOOD["Diagram.sensitivities"], "parameters delay solver"),
    "Diagram.worst_case": (GOOD["Diagram.worst_case"], "quantity samples solver"),
    "Diagram.frequency_response": (GOOD["Diagram.frequency_response"], "amplitude solver"),
    "Input.__init__": (lambda: (Input, {}), "unit minimum"),
    "Output.__init__": (lambda: (Output, {}), "unit minimum"),
    "State.__init__": (lambda: (State, {}), "unit minimum"),
    "Requirements.__init__": (lambda: (Requirements, {"ms": 2.0}), "loops disk_margin"),
    "Subsystem.__init__": (lambda: (type(controller), {"function": lambda error: error}), "sample_time delay"),
    "Subsystem.__call__": (lambda: (controller, {}), "error"),
    "Subsystem.replace": (lambda: (controller.replace, {}), "sample_time"),
    "Diagram.report": (lambda: (drive().report, {}), "requirements path worst_case"),
    "Diagram.contact": (
        lambda: (drive().contact, {"position": "y", "velocity": "y", "port": "plant.u"}),
        "direction solver",
    ),
    "Experiment.simulate": (lambda: (experiments.path_following().simulate, {}), "progress every"),
    "Experiment.sweep": (lambda: (experiments.path_following().sweep, {"parameters": {}}), "samples solver"),
    "experiments.path_following": (lambda: (experiments.path_following, {}), "delay"),
    "experiments.compliance": (lambda: (experiments.compliance, {}), "delay"),
    "experiments.hand_guiding": (lambda: (experiments.hand_guiding, {}), "delay"),
    "experiments.hand_page": (lambda: (experiments.hand_page, {}), "delay"),
    "experiments.guided_by_hand": (lambda: (experiments.guided_by_hand, {}), "delay"),
    "experiments.force_tracking": (lambda: (experiments.force_tracking, {}), "cubic delay"),
    "crossing_frequency": (GOOD["crossing_frequency"], "stiffness damping"),
    "growth_rate": (GOOD["growth_rate"], "stiffness damping"),
    "stability_limit": (GOOD["stability_limit"], "over low damping"),
    "stability_map": (GOOD["stability_map"], "x_values damping"),
    "Contact.loop": (lambda: (cart_contact().loop, {"vary": "stiffness"}), "damping"),
    "Contact.stability_limit": (lambda: (cart_contact().stability_limit, {}), "vary low damping"),
    "Contact.stability_map": (
        lambda: (cart_contact().stability_map, {"x_values": [1e2, 1e3], "y_values": [0.0, 1.0]}),
        "damping",
    ),
}
"""Of each callable that hands options on: good arguments, and some of the names that it or another one knows."""


def test_all_that_hand_options_on_are_tried():
    known = {name.replace("Fig3Diagram", "Diagram") for name in OPEN} - {"Diagram.replace"}  # of a diagram's own names
    assert not known - HANDED_ON.keys()


@pytest.mark.parametrize("name", sorted(HANDED_ON))
def test_a_misspelt_option_is_named_with_its_neighbours_wherever_it_is_handed_on_to(name):
    make, names = HANDED_ON[name]
    for right in names.split():
        function, good = make()
        good.pop(right, None)
        with pytest.raises(LoopwrightError, match=f"'?{right}x'?.*'{right}'"):
            function(**good, **{right + "x": 1.0})


@pytest.mark.parametrize("call", ["analyse", "report"])
@pytest.mark.parametrize(("wrong", "line"), [("titel", "title"), ("title", "title"), ("autor", "author")])
def test_a_line_of_a_reports_heading_is_offered_where_it_is_written(call, wrong, line):
    function = getattr(drive(), call, None) or (lambda **options: loopwright.diagrams.analyse(drive(), **options))
    with pytest.raises(OptionError) as caught:
        function(**{wrong: "The tank"})
    assert f"has no argument '{wrong}'. Did you mean about={{'{line}': …}}" in str(caught.value)
    assert "written" not in str(caught.value)
