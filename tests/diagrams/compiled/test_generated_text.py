"""CasADi's C code for the compiler: vectors that are there are not asked for."""

import re

import casadi as ca

from loopwright.diagrams import experiments
from loopwright.diagrams.compiled import write_code
from loopwright.diagrams.compiled.generated_text import put_in_order, write_functions
from loopwright.diagrams.flat import kinds_of

ASKED = re.compile(r"arg\[\d+\]\?|if\s*\(res\[\d+\]!=0\)")


def test_a_tick_does_not_ask_at_each_number_whether_its_vector_is_there():
    flat = experiments.hand_guiding().diagram.flatten()
    (text,) = write_code(flat, kinds_of(flat, every=False)).texts
    assert "res[2][55]=" in text
    assert not ASKED.search(text)


def test_functions_that_others_call_without_all_vectors_still_ask():
    x = ca.SX.sym("x")
    inner = ca.Function("inner", [x], [x + 1.0, x * 2.0], {"never_inline": True})
    y = ca.MX.sym("y", 3)
    outer = ca.Function("outer", [y], [ca.vertcat(*(inner(y[i])[1] for i in range(3)))])
    text = write_functions("made", [outer])
    assert re.search(r"res1\[0\]=0;", text)  # the first result is left out
    assert re.search(r"if\s*\(res\[0\]!=0\)\s*res\[0\]\[0\]=", text)


def test_operations_stand_in_the_order_in_which_they_can_begin():
    x = ca.SX.sym("x", 4)
    slow = ca.sin(ca.sin(x[0])) + x[1]  # CasADi writes all of this before the products
    text = write_functions("made", [ca.Function("made", [x], [ca.vertcat(slow, x[2] * x[3])])])
    assert text.index("sin(") < text.index("*a")
    ordered = put_in_order(text)
    assert ordered.index("*v") < ordered.index("sin(")
    assert len(re.findall(r"=.*\bsin\(|=.*[*+].*;", ordered)) == len(re.findall(r"=.*\bsin\(|=.*[*+].*;", text))
