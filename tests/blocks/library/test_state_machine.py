"""The state machine: at ticks a Moore machine, in continuous time events; against a plain loop over the same table."""

import pickle

import numpy as np
import pytest

from loopwright.blocks import ParameterError, ShapeError, StateMachine, UnknownNameError
from support.switching import Driven, at_ticks, in_time

T = 0.1
MODES = ("approach", "contact", "retract")
MACHINE = StateMachine(
    modes=MODES,
    transitions={("approach", "contact"): "touch", ("contact", "retract"): "done", ("retract", "approach"): "home"},
)
OFF = {"touch": lambda t: 0.0, "done": lambda t: 0.0, "home": lambda t: 0.0}


def after(t0, t1=np.inf):
    """True from t0 on, until t1; ticks are met as they are rounded."""
    return lambda t: float(t0 <= t + 1e-9 and t + 1e-9 < t1)


def test_a_tick_decides_the_mode_of_the_next_tick():
    made = at_ticks(MACHINE, T, 8, **{**OFF, "touch": after(0.2), "done": after(0.5)})
    assert made["mode"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2]
    assert made["contact"].tolist() == [0, 0, 0, 1, 1, 1, 0, 0]
    np.testing.assert_allclose(made["time_in_mode"], [0.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.0, 0.1], rtol=0, atol=1e-15)


def test_random_machines_do_what_their_table_says():
    rng = np.random.default_rng(3)

    def column(values, i):
        return lambda t: values[round(t / T), i]

    for _ in range(6):
        n = int(rng.integers(2, 5))
        modes = tuple(f"m{i}" for i in range(n))
        pairs = [(a, b) for a in modes for b in modes if a != b and rng.random() < 0.7] or [("m0", "m1")]
        table = [(*pair, f"c{rng.integers(3)}") for pair in pairs]
        names = list(dict.fromkeys(row[2] for row in table))
        values = (rng.random((60, len(names))) < 0.3).astype(float)
        given = {name: column(values, i) for i, name in enumerate(names)}
        made = at_ticks(StateMachine(modes=modes, transitions=table, start=modes[-1]), T, 60, **given)
        mode = modes[-1]
        for k in range(60):
            assert made["mode"][k] == modes.index(mode)
            assert [made[m][k] for m in modes] == [float(m == mode) for m in modes]
            mode = next((b for a, b, c in table if a == mode and values[k, names.index(c)]), mode)


@pytest.mark.parametrize("first", ["left", "right"])
def test_the_first_transition_that_holds_is_taken(first):
    table = {("idle", "left"): "go_left", ("idle", "right"): "go_right"}
    order = table if first == "left" else dict(reversed(table.items()))
    machine = StateMachine(modes=("idle", "left", "right"), transitions=order)
    both = dict.fromkeys(machine.inputs, after(0.0))
    assert at_ticks(machine, T, 2, **both)[first].tolist() == [0.0, 1.0]
    assert in_time(machine, 0.5, **dict.fromkeys(machine.inputs, after(0.25)))[0](0.4)[first] == 1.0


def test_the_order_of_transitions_tells_two_machines_apart():
    table = {("a", "b"): "p", ("a", "c"): "q"}
    one, other = (StateMachine(modes=("a", "b", "c"), transitions=t) for t in (table, dict(reversed(table.items()))))
    assert one != other
    assert one == StateMachine(modes=("a", "b", "c"), transitions=[("a", "b", "p"), ("a", "c", "q")])


def test_transitions_are_events_in_continuous_time():
    given = {**OFF, "touch": lambda t: np.sin(t), "done": lambda t: t - 2.0, "home": lambda t: t - 3.1}
    outputs, log = in_time(MACHINE, 4.0, **given)
    times = [np.arcsin(0.5), 2.5, 3.6]
    assert [t for t, _ in log] == pytest.approx(times, abs=1e-14)
    assert [n for _, n in log] == [("approach_to_contact",), ("contact_to_retract",), ("retract_to_approach",)]
    assert outputs(2.0)["time_in_mode"] == pytest.approx(2.0 - times[0], abs=1e-14)
    assert [float(outputs(t)["mode"]) for t in (0.4, 0.6, 2.6, 3.7)] == [0.0, 1.0, 2.0, 0.0]
    assert [float(outputs(2.6)[m]) for m in MODES] == [0.0, 0.0, 1.0]


def test_a_condition_that_is_true_already_acts_right_after_its_mode_is_entered():
    outputs, log = in_time(MACHINE, 2.0, **{**OFF, "touch": after(1.0), "done": after(0.5)})
    assert [n for _, n in log] == [("approach_to_contact",), ("contact_to_retract",)]
    assert [t for t, _ in log] == pytest.approx([1.0 - 1e-9] * 2, abs=1e-14)
    assert log[1][0] > log[0][0]
    assert outputs(1.5)["retract"] == 1.0


def test_a_condition_that_is_true_at_the_start_acts_right_after_it():
    outputs, log = in_time(MACHINE, 1.0, **{**OFF, "touch": after(0.0)})
    assert log[0][0] < 1e-12
    assert outputs(0.0)["approach"] == 1.0
    assert outputs(1e-6)["contact"] == 1.0


def test_a_machine_may_start_anywhere():
    assert at_ticks(MACHINE.replace(start="retract"), T, 1, **OFF)["mode"].tolist() == [2.0]


def test_a_loop_through_a_machine_is_never_algebraic():
    for sampled in (True, False):
        traced = Driven(MACHINE, sampled, T, **OFF).traced
        assert all(not (traced.depends[name] & set(MACHINE.inputs)) for name in traced.outputs)


def test_what_is_no_number_does_not_pass_for_false():
    run = Driven(MACHINE, True, T, **{**OFF, "touch": lambda t: np.nan})
    run.outputs(0.0)
    assert np.isnan(run.next).any()


def test_modes_are_signals_before_the_machine_is_wired():
    assert MACHINE.contact.port == "contact"
    assert MACHINE.time_in_mode.port == "time_in_mode"
    with pytest.raises(
        UnknownNameError, match=r"state_machine: it has no output or parameter 'contakt'\. Did you mean 'con"
    ):
        _ = MACHINE.contakt


def test_it_is_a_value():
    assert pickle.loads(pickle.dumps(MACHINE)) == MACHINE
    assert pickle.loads(pickle.dumps(MACHINE)).contact.port == "contact"
    assert MACHINE.replace() == MACHINE


def test_a_condition_is_a_scalar():
    with pytest.raises(ShapeError):
        at_ticks(MACHINE, T, 1, **{**OFF, "touch": lambda t: np.zeros(2)})


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"modes": "abc"}, r"modes: found 'abc'; expected a tuple of different names"),
        ({"modes": ("a", "a")}, r"modes: found \('a', 'a'\); expected a tuple of different names"),
        ({"transitions": {("a", "d"): "go"}}, r"transitions: found 'd', which is no mode\. Known: a, b"),
        ({"transitions": {}}, r"transitions: found \(\); expected \{\(from, to\): condition\}, three names"),
        ({"transitions": {"a": "b"}}, r"transitions: found \('a', 'b'\); expected \{\(from, to\): condition\}"),
        ({"transitions": {("a", "a"): "go"}}, r"transitions: found one from 'a' to itself; expected another mode"),
        ({"transitions": {("a", "b"): "b"}}, r"transitions: found the name 'b'; expected letters, digits and under"),
        ({"transitions": {("a", "b"): "2x"}}, r"transitions: found the name '2x'; expected letters"),
        ({"modes": ("a", "b", "name")}, r"modes: found the name 'name'; expected letters"),
        ({"modes": ("a", "b", "mode")}, r"modes: found the name 'mode'; expected letters"),
        ({"start": "c"}, r"start: found 'c', which is no mode\. Known: a, b"),
    ],
)
def test_a_machine_that_is_none_is_refused(changes, text):
    with pytest.raises(ParameterError, match=rf"state_machine\.{text}"):
        StateMachine(**{"modes": ("a", "b"), "transitions": {("a", "b"): "go"}, **changes})
