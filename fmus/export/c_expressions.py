"""Scalar operations as C that people read: named values, short expressions, few temporaries.

CasADi writes one operation a line in variables without names. Here an operation that one other needs is written inside
it, and a value has the name of the signal that it is. Every operation is the one that CasADi has, in the same grouping,
so that all bits are the same as long as the compiler contracts nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping

import casadi as ca

from ...blocks.core import DefinitionError
from ...blocks.tracing import MATH_FUNCTIONS
from .c_text import c_constant
from .elementary_tables import FUNCTIONS, SINGLE_FUNCTIONS
from .scalar_operations import CHOOSE, FIND, TAKE, ScalarNode, Scalars

OF_TIME = "_of_time"
"""End of names in double precision, where numbers are of single precision."""
_WIDEST = 84
"""Characters of an expression up to which it is written inside another one."""
_ATOM, _UNARY, _PRODUCT, _SUM, _RELATION, _LOGIC = 6, 5, 4, 3, 2, 1
_BINARY = {
    ca.OP_ADD: ("+", _SUM),
    ca.OP_SUB: ("-", _SUM),
    ca.OP_MUL: ("*", _PRODUCT),
    ca.OP_DIV: ("/", _PRODUCT),
    ca.OP_LT: ("<", _RELATION),
    ca.OP_LE: ("<=", _RELATION),
    ca.OP_EQ: ("==", _RELATION),
    ca.OP_NE: ("!=", _RELATION),
    ca.OP_AND: ("&&", _LOGIC),
    ca.OP_OR: ("||", _LOGIC),
}
OF_MATH = frozenset(MATH_FUNCTIONS.values())
"""Functions of math.h that are written."""


class NumberText:
    """How numbers are written in a source; notes the functions and tables that the source needs.

    In single precision, what follows from the time and parameters alone is in double precision nevertheless ("fine"): a
    float of the time is as coarse as a tick after some hours.

    ``real``: the C type of numbers.
    ``own_functions``: whether functions of math.h are replaced by ours, where we have them.
    """

    def __init__(self, real: str, *, single: bool, own_functions: bool):
        self.real, self.single = real, single
        self._own = own_functions
        self.tables_read = set[tuple[int, bool]]()
        self.tables_sought = set[tuple[int, bool]]()
        self._called: dict[bool, set[str]] = {False: set(), True: set()}

    def type_of(self, fine: bool) -> str:
        """Return the C type of a number."""
        return "double" if fine else self.real

    def constant(self, value: float, fine: bool = False) -> str:
        """Return a number as C text."""
        return c_constant(float(value), single=self.single and not fine)

    def bracketed(self, value: float, fine: bool = False) -> str:
        """Return a number as C text that may be written behind an operator."""
        text = self.constant(value, fine)
        return f"({text})" if text.startswith("-") else text

    def function(self, name: str, fine: bool = False) -> str:
        """Return the C name of a function of math.h."""
        end = "f" if self.single and not fine else ""
        return f"lw_{name}{end}" if name in self._replaced(fine) else f"{name}{end}"

    def _replaced(self, fine: bool) -> tuple[str, ...]:
        if not self._own:
            return ()
        return SINGLE_FUNCTIONS if self.single and not fine else FUNCTIONS

    def note(self, function: str, fine: bool) -> None:
        """Note that a function of math.h, or a helper, is called."""
        self._called[fine].add(function)

    def needs(self, function: str, fine: bool) -> bool:
        """Whether a function or a helper is called."""
        return function in self._called[fine]

    def table(self, number: int, fine: bool) -> str:
        """Return the C name of a table, and note that it is read."""
        self.tables_read.add((number, fine))
        return f"table_{number}{OF_TIME * fine}"

    @property
    def own_functions(self) -> tuple[list[str], list[str]]:
        """Functions of ours that are called: of single precision, and of double."""
        found = {fine: [f for f in self._replaced(fine) if self.needs(f, fine)] for fine in (False, True)}
        return (found[False], found[True]) if self.single else ([], found[False])

    @property
    def platform_functions(self) -> tuple[str, ...]:
        """Functions of math.h that are called."""
        called = {f for fine in (False, True) for f in self._called[fine].difference(self._replaced(fine))}
        return tuple(sorted({"fabs", *called} & OF_MATH))


class Expressions:
    """C text of values: written inside others, or assigned to variables.

    ``read``: returns the C text of an input, by argument, entry, and whether it is wanted in double precision.
    ``timed``: whether argument 0 is the time, 1 states, 2 inputs and 3 parameters.
    """

    def __init__(
        self,
        scalars: Scalars,
        uses: Mapping[int, int],
        read: Callable[[int, int, bool], str],
        numbers: NumberText,
        *,
        timed: bool = True,
    ):
        self._scalars, self._uses, self._read, self._numbers = scalars, uses, read, numbers
        self._texts: dict[int, tuple[str, int]] = {}
        self._done: set[int] = set()
        self._temporaries = 0
        self._fine = scalars.of_time(uses) if numbers.single and timed else frozenset()
        self.operations: Counter[str] = Counter()

    def compute(self, node: int, name: str | None = None) -> list[str]:
        """Return the statements that compute a value, into a constant of this name where one is given."""
        lines: list[str] = []
        for one in self._scalars.before(node, self._done):
            text, level = self._write(one)
            plain = self._scalars.nodes[one].operation in (ca.OP_INPUT, ca.OP_CONST)
            chosen = "?" in text  # nested choices are hard to read
            wanted = name if one == node and not plain else None
            if wanted is None and (
                plain or (self._uses.get(one, 0) < 2 and len(text) <= _WIDEST and one != node and not chosen)
            ):
                self._texts[one] = text, level
                continue
            if wanted is None:
                self._temporaries += 1
                wanted = f"t{self._temporaries}"
            kind = "bool" if self._scalars.nodes[one].is_boolean else self._numbers.type_of(one in self._fine)
            lines.append(f"const {kind} {wanted} = {text};")
            self._texts[one] = wanted, _ATOM
        return lines

    def text(self, node: int) -> str:
        """Return the C text of a value that has been computed, as a number."""
        return self._text_of(node, _LOGIC)

    def _text_of(self, node: int, level: int, fine: bool = False) -> str:
        """Return the C text of a value as a number, for an operation of some level, in double precision or not."""
        text, own = self._texts[node]
        one = self._scalars.nodes[node]
        if one.is_boolean:
            inner = text if own >= _ATOM else f"({text})"
            return f"({inner} ? {self._numbers.constant(1.0, fine)} : {self._numbers.constant(0.0, fine)})"
        if fine and node not in self._fine:  # a constant or a parameter
            text, own = self._leaf(one, fine)
        if node in self._fine and not fine:
            text, own = f"({self._numbers.real}){text if own >= _UNARY else f'({text})'}", _UNARY
        return text if own >= level else f"({text})"

    def _leaf(self, one: ScalarNode, fine: bool) -> tuple[str, int]:
        if one.operation == ca.OP_INPUT:
            return self._read(*one.place, fine), _UNARY if fine and one.place[0] else _ATOM
        text = self._numbers.constant(one.constant, fine)
        return text, _UNARY if text.startswith("-") else _ATOM

    def _truth(self, node: int, level: int) -> str:
        text, own = self._texts[node]
        if not self._scalars.nodes[node].is_boolean:
            zero = self._numbers.constant(0.0, node in self._fine)
            text, own = f"{text if own > _RELATION else f'({text})'} != {zero}", _RELATION
        return text if own >= level else f"({text})"

    def is_positive(self, node: int) -> bool:
        """Whether a value is a positive constant."""
        one = self._scalars.nodes[node]
        return one.operation == ca.OP_CONST and one.constant > 0.0

    def _write(self, number: int) -> tuple[str, int]:
        node = self._scalars.nodes[number]
        operation, arguments = node.operation, node.arguments
        fine = number in self._fine
        if operation in (ca.OP_INPUT, ca.OP_CONST):
            return self._leaf(node, fine)
        self.operations[_kind(operation)] += 1
        # Each branch returns the text with the precedence of its outermost operator, so that no needless brackets are
        # written.
        if operation in _BINARY:
            return self._binary(operation, arguments, fine)
        if operation == FIND:
            self._numbers.note("find", fine)
            self._numbers.tables_sought.add((node.place[0], fine))
            table = self._numbers.table(node.place[0], fine)
            return f"find_in_{table}({self._text_of(arguments[0], _LOGIC, fine)})", _ATOM
        if operation == TAKE:
            self._numbers.note("take", fine)
            table = self._numbers.table(node.place[0], fine)
            return f"{table}[(size_t)({self._text_of(arguments[0], _LOGIC, fine)})]", _ATOM
        if operation == ca.OP_NOT:
            return f"!{self._truth(arguments[0], _ATOM)}", _UNARY
        if operation == ca.OP_NEG:
            inner = self._text_of(arguments[0], _ATOM, fine)
            return f"-{inner}", _UNARY
        if operation == ca.OP_SQ:
            inner = self._text_of(arguments[0], _ATOM, fine)
            return f"{inner} * {inner}", _PRODUCT
        if operation == ca.OP_TWICE:
            return f"{self._numbers.constant(2.0, fine)} * {self._text_of(arguments[0], _UNARY, fine)}", _PRODUCT
        if operation == ca.OP_INV:
            return f"{self._numbers.constant(1.0, fine)} / {self._text_of(arguments[0], _UNARY, fine)}", _PRODUCT
        if operation == ca.OP_IF_ELSE_ZERO:
            condition = self._truth(arguments[0], _ATOM)
            return (
                f"({condition} ? {self._text_of(arguments[1], _SUM, fine)} : {self._numbers.constant(0.0, fine)})",
                _ATOM,
            )
        if operation == CHOOSE:
            self._numbers.note("choose", fine)
            condition = self._truth(arguments[0], _LOGIC)
            one, other = (self._text_of(argument, _LOGIC, fine) for argument in arguments[1:])
            return f"choose{OF_TIME * fine}({condition}, {one}, {other})", _ATOM
        if operation == ca.OP_SIGN:
            self._numbers.note("sign", fine)
            return f"sign_of{OF_TIME * fine}({self._text_of(arguments[0], _LOGIC, fine)})", _ATOM
        if operation in (ca.OP_ASSIGN, ca.OP_LIFT):
            return self._text_of(arguments[0], _ATOM, fine), _ATOM
        if operation not in MATH_FUNCTIONS:
            raise DefinitionError(
                f"found CasADi's operation {operation}, which is not written as C. Write the equation with sums, "
                "products, elementary functions and comparisons."
            )
        called = MATH_FUNCTIONS[operation]
        self._numbers.note(called, fine)
        listed = ", ".join(self._text_of(argument, _LOGIC, fine) for argument in arguments)
        return f"{self._numbers.function(called, fine)}({listed})", _ATOM

    def _binary(self, operation: int, arguments: tuple[int, ...], fine: bool) -> tuple[str, int]:
        sign, level = _BINARY[operation]
        if operation in (ca.OP_AND, ca.OP_OR):
            left, right = (self._truth(argument, _RELATION) for argument in arguments)
            return f"{left} {sign} {right}", level
        above = level + 1
        left = self._text_of(arguments[0], above if level == _RELATION else level, fine)
        right = self._text_of(arguments[1], above, fine)
        return f"{left} {sign} {right}", level


def _kind(operation: int) -> str:
    """Return what an operation counts as in a report."""
    if operation in (ca.OP_ADD, ca.OP_SUB, ca.OP_NEG):
        return "+ -"
    if operation in (ca.OP_MUL, ca.OP_SQ, ca.OP_TWICE):
        return "*"
    if operation in (ca.OP_DIV, ca.OP_INV):
        return "/"
    if operation in (FIND, TAKE):
        return "tables"
    if operation in MATH_FUNCTIONS:
        return MATH_FUNCTIONS[operation]
    return "comparisons"
