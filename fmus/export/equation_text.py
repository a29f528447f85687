"""Text of traced equations, for people: ``der(velocity) = (force - stiffness*position)/mass``."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from ...blocks.tracing import MATH_FUNCTIONS, count_uses

_SUM, _PRODUCT, _POWER, _ATOM = 1, 2, 3, 4
_FUNCTIONS = {
    **MATH_FUNCTIONS,
    ca.OP_NOT: "not",
    ca.OP_FABS: "abs",
    ca.OP_SIGN: "sign",
    ca.OP_FMIN: "min",
    ca.OP_FMAX: "max",
    ca.OP_IF_ELSE_ZERO: "where",
}
# Operator, its precedence, and the least precedences at which its left and right operands need no parentheses.
_OPERATORS = {
    ca.OP_ADD: (" + ", _SUM, _SUM, _SUM),
    ca.OP_SUB: (" - ", _SUM, _SUM, _PRODUCT),
    ca.OP_MUL: ("*", _PRODUCT, _PRODUCT, _PRODUCT),
    ca.OP_DIV: ("/", _PRODUCT, _PRODUCT, _POWER),
    ca.OP_POW: ("^", _POWER, _ATOM, _ATOM),
    ca.OP_CONSTPOW: ("^", _POWER, _ATOM, _ATOM),
    ca.OP_LT: (" < ", 0, _SUM, _SUM),
    ca.OP_LE: (" <= ", 0, _SUM, _SUM),
    ca.OP_EQ: (" == ", 0, _SUM, _SUM),
    ca.OP_NE: (" != ", 0, _SUM, _SUM),
    ca.OP_AND: (" and ", -1, 0, 0),
    ca.OP_OR: (" or ", -1, _ATOM, _ATOM),
}

Term = tuple[str, int]


def number(value: float) -> str:
    """Return a number in full, without a needless ``.0``."""
    value = float(value)
    short = f"{value:.12g}"
    return short if float(short) == value else repr(value)


def _parenthesize(term: Term, least: int) -> str:
    return term[0] if term[1] >= least else f"({term[0]})"


def _term(op: int, operands: Sequence[Term]) -> Term | None:
    """Return the text of an operation; None if there is none."""
    first = operands[0] if operands else ("", _ATOM)
    if op in _OPERATORS:
        sign, precedence, left, right = _OPERATORS[op]
        return f"{_parenthesize(first, left)}{sign}{_parenthesize(operands[1], right)}", precedence
    if op == ca.OP_NEG:
        return f"-{_parenthesize(first, _PRODUCT)}", _SUM
    if op == ca.OP_SQ:
        return f"{_parenthesize(first, _ATOM)}^2", _POWER
    if op == ca.OP_TWICE:
        return f"2*{_parenthesize(first, _PRODUCT)}", _PRODUCT
    if op == ca.OP_INV:
        return f"1/{_parenthesize(first, _POWER)}", _PRODUCT
    if op == ca.OP_IF_ELSE_ZERO:
        return f"where({first[0]}, {operands[1][0]}, 0)", _ATOM
    if op in _FUNCTIONS:
        return f"{_FUNCTIONS[op]}({', '.join(text for text, _ in operands)})", _ATOM
    return first if op == ca.OP_ASSIGN else None


def _choice(op: int, operands: Sequence[Term], choices: dict[str, tuple[str, str]]) -> Term | None:
    """Return the text of a choice, which CasADi has as where(c, a, 0) + where(not(c), b, 0); else None."""
    if op == ca.OP_ADD and all(text in choices for text, _ in operands):
        (yes, a), (no, b) = (choices[text] for text, _ in operands)
        if no == f"not({yes})":
            return f"where({yes}, {a}, {b})", _ATOM
    return None


def equations(f: ca.Function, knowns: Sequence[Sequence[str]], unknowns: Sequence[str], limit: int = 400) -> list[str]:
    """Return a function of scalar operations as equations in text.

    ``f``: a function of dense columns with one column as its result.
    ``limit``: number of operations beyond which the text would be too long to read.
    Returns: one equation in each text, shared expressions first; empty without a scalar expansion, or beyond the limit.
    """
    try:
        f = f.expand()
    except RuntimeError:  # interpolation tables and the like have no scalar expansion
        return []
    if f.n_instructions() > limit + f.numel_in() + f.numel_out():
        return []
    taken = {name for group in knowns for name in group}
    uses = count_uses(f)
    work: dict[int, Term] = {}
    shared: list[str] = []
    choices: dict[str, tuple[str, str]] = {}
    results = dict.fromkeys(range(len(unknowns)), "0")  # a structural zero is no instruction
    for k in range(f.n_instructions()):
        op, out, operands = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
        if op == ca.OP_OUTPUT:
            results[f.sparsity_out(0).row()[out[1]]] = work[operands[0]][0]
            continue
        if op == ca.OP_CONST:
            value = f.instruction_constant(k)
            work[out[0]] = (number(value), _ATOM if value >= 0 else _SUM)
            continue
        if op == ca.OP_INPUT:
            work[out[0]] = (knowns[operands[0]][operands[1]], _ATOM)
            continue
        terms = [work[i] for i in operands]
        term = _choice(op, terms, choices) or _term(op, terms)
        if term is None:
            return []
        if op == ca.OP_IF_ELSE_ZERO:
            choices[term[0]] = (terms[0][0], terms[1][0])
        if uses[k] > 1 and len(term[0]) > 12:
            name = next(n for i in range(1, len(taken) + 2) if (n := f"w{i}") not in taken)
            taken.add(name)
            shared.append(f"{name} = {term[0]}")
            term = (name, _ATOM)
        work[out[0]] = term
    return [*shared, *(f"{name} = {results[i]}" for i, name in enumerate(unknowns))]
