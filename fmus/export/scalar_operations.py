"""Scalar operations of CasADi's functions, read, and computed where they are constant, to the same bits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import DefinitionError

_BOOLEAN = {ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_AND, ca.OP_OR, ca.OP_NOT}
FIND, TAKE = -1, -2
"""Operations of tables: the place of a value between breakpoints, and an entry of a table."""
CHOOSE = -3
"""One of two values by a condition: the sum of both, of which one is zero."""


@dataclass(frozen=True)
class ScalarNode:
    """A value.

    ``place``: argument and entry, of an input; the table, of `FIND`; table and offset of `TAKE`.
    """

    operation: int
    arguments: tuple[int, ...] = ()
    constant: float = 0.0
    place: tuple[int, int] = (0, 0)

    @property
    def is_boolean(self) -> bool:
        """Whether it is true or false."""
        return self.operation in _BOOLEAN


@dataclass(frozen=True, eq=False)
class Lookup:
    """A lookup that is no scalar operation; its results are arguments of a function behind the ordinary ones."""

    kind: int
    table: np.ndarray
    count: int


def split_lookups(function: Any, expand: Callable[[Any], Any]) -> tuple[Any, tuple[Lookup, ...]]:
    """Return a function as scalar operations, and its lookups in tables.

    Their results are further arguments of the function, and what they look up further results, in this order.

    ``expand``: returns a function as scalar operations where that is possible, else the function.
    Raises `DefinitionError` if it has other operations that are not scalar.
    """
    made = expand(function)
    if made.is_a("SXFunction"):
        return made, ()
    symbols = function.mx_in()
    results = function.call(symbols, True, False)
    flat = ca.Function(function.name(), symbols, results)
    kinds = {ca.OP_LOW: FIND, ca.OP_GETNONZEROS_PARAM: TAKE}
    nodes, lookups, fresh, arguments = [], [], [], []
    for k in range(flat.n_instructions()):
        if (kind := kinds.get(flat.instruction_id(k))) is None:
            continue
        node = flat.instruction_MX(k)
        table, sought = (node.dep(0), node.dep(1))
        if not table.is_constant():
            continue  # expand says so
        nodes.append(node)
        fresh.append(ca.MX.sym(f"lookup{len(nodes)}", node.numel()))
        arguments.append(sought)
        lookups.append(Lookup(kind, np.ravel(np.array(table.to_DM())), node.numel()))
    shaped = [ca.reshape(one, node.shape) for one, node in zip(fresh, nodes, strict=True)]
    replaced = ca.graph_substitute([*results, *arguments], nodes, shaped)
    replaced = [ca.densify(ca.vec(one)) for one in replaced]
    made = expand(ca.Function(function.name(), [*symbols, *fresh], replaced))
    if not made.is_a("SXFunction"):
        raise DefinitionError(
            "found equations that are no scalar operations, such as a solver's or an external function's; expected "
            "sums, products, elementary functions, comparisons and tables. Write them with these."
        )
    return made, tuple(lookups)


@dataclass
class Scalars:
    """The operations of a function of scalar operations.

    ``results``: by result of the function: the nodes of its entries.
    """

    nodes: list[ScalarNode] = field(default_factory=list)
    results: list[list[int]] = field(default_factory=list)

    @classmethod
    def of(cls, function: Any, lookups: Sequence[Lookup], tables: Tables) -> Scalars:
        """Read the operations of a function; its last arguments and results are those of lookups."""
        found = cls(results=[[-1] * function.numel_out(i) for i in range(function.n_out())])
        ordinary = function.n_in() - len(lookups)
        known: dict[ScalarNode, int] = {}
        waiting: list[tuple[int, int, int]] = []  # node, lookup, entry

        def add(node: ScalarNode) -> int:
            if node.operation >= 0 and node in known:
                return known[node]
            found.nodes.append(node)
            known[node] = len(found.nodes) - 1
            return known[node]

        work: dict[int, int] = {}
        inputs: dict[tuple[int, int], int] = {}
        for k in range(function.n_instructions()):
            operation = function.instruction_id(k)
            read, written = function.instruction_input(k), function.instruction_output(k)
            if operation == ca.OP_OUTPUT:
                found.results[written[0]][written[1]] = work[read[0]]
            elif operation == ca.OP_INPUT and read[0] >= ordinary:
                place = (read[0], read[1])
                if place not in inputs:
                    found.nodes.append(ScalarNode(lookups[read[0] - ordinary].kind))
                    inputs[place] = len(found.nodes) - 1
                    waiting.append((inputs[place], read[0] - ordinary, read[1]))
                work[written[0]] = inputs[place]
            elif operation == ca.OP_INPUT:
                work[written[0]] = add(ScalarNode(operation, place=(read[0], read[1])))
            elif operation == ca.OP_CONST:
                value = float(function.instruction_constant(k))
                work[written[0]] = add(ScalarNode(operation, constant=value, place=(0, int(np.signbit(value)))))
            else:
                work[written[0]] = add(ScalarNode(operation, tuple(work[i] for i in read)))
        for i, row in enumerate(found.results):  # zeros of the sparsity are no instructions
            found.results[i] = [add(ScalarNode(ca.OP_CONST)) if node < 0 else node for node in row]
        first = function.n_out() - len(lookups)
        for node, which, entry in waiting:
            sought = found.results[first + which]
            number = tables.add(lookups[which])
            argument = sought[entry] if len(sought) > 1 else sought[0]
            found.nodes[node] = ScalarNode(lookups[which].kind, (argument,), place=(number, 0))
        del found.results[first:]
        return found

    def folded(self, known: Callable[[int, int], float | None]) -> Scalars:
        """Return the same values with what is constant computed, to the same bits.

        ``known``: returns the value of an input that is constant, by argument and entry; else None.
        """
        found = Scalars()
        new: dict[int, int] = {}
        nodes: dict[ScalarNode, int] = {}

        def add(node: ScalarNode) -> int:
            if node not in nodes:
                found.nodes.append(node)
                nodes[node] = len(found.nodes) - 1
            return nodes[node]

        def constant(value: float) -> int:
            return add(ScalarNode(ca.OP_CONST, constant=value, place=(0, int(np.signbit(value)))))

        done: set[int] = set()
        for root in (node for row in self.results for node in row):
            for old in self.before(root, done):
                node = self.nodes[old]
                arguments = tuple(new[argument] for argument in node.arguments)
                value = known(*node.place) if node.operation == ca.OP_INPUT else _fold(found, node.operation, arguments)
                choice = _find_choice(found, node.operation, arguments)
                if isinstance(value, int):
                    new[old] = value
                elif choice is not None:
                    new[old] = add(ScalarNode(CHOOSE, choice))
                else:
                    new[old] = add(replace(node, arguments=arguments)) if value is None else constant(value)
        found.results = [[new[node] for node in row] for row in self.results]
        return found

    def needed(self, roots: Iterable[int]) -> Counter[int]:
        """Return how often each value is used that some values are computed from, and the values themselves."""
        uses: Counter[int] = Counter()
        stack = [*roots]
        uses.update(stack)
        seen = set()
        while stack:
            node = stack.pop()
            if node in seen:
                continue
            seen.add(node)
            for argument in self.nodes[node].arguments:
                uses[argument] += 2 if self.nodes[node].operation == ca.OP_SQ else 1  # it is written twice
                stack.append(argument)
        return uses

    def of_time(self, values: Iterable[int]) -> frozenset[int]:
        """Return those of some values that follow from time and parameters alone, with what they are computed from.

        Inputs other than the time, and constants, are not in it.
        """
        kinds: dict[int, tuple[bool, bool]] = {}  # with the time; with inputs or states
        done: set[int] = set()
        for root in values:
            for node in self.before(root, done):
                one = self.nodes[node]
                if one.operation == ca.OP_INPUT:
                    kinds[node] = one.place[0] == 0, one.place[0] in (1, 2)
                else:
                    before = [kinds[argument] for argument in one.arguments]
                    kinds[node] = any(t for t, _ in before), any(other for _, other in before)
        found = {node for node, (timed, other) in kinds.items() if timed and not other}
        waiting = [*found]
        while waiting:  # with what they are computed from, such as 2π times a frequency
            for node in self.nodes[waiting.pop()].arguments:
                if node not in found and self.nodes[node].arguments:
                    found.add(node)
                    waiting.append(node)
        return frozenset(found)

    def before(self, root: int, done: set[int]) -> Iterator[int]:
        """Yield the values that one is computed from, and it, each behind those that it needs, but for some."""
        stack = [(root, False)]
        while stack:
            node, ready = stack.pop()
            if node in done:
                continue
            if ready:
                done.add(node)
                yield node
                continue
            stack.append((node, True))
            stack += [(argument, False) for argument in reversed(self.nodes[node].arguments)]


_EXACTLY: dict[int, Callable[..., Any]] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_TWICE: lambda x: 2.0 * x,
    ca.OP_INV: lambda x: 1.0 / x,
    ca.OP_FABS: np.abs,
    ca.OP_SQRT: np.sqrt,
    ca.OP_FLOOR: np.floor,
    ca.OP_CEIL: np.ceil,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_EQ: np.equal,
    ca.OP_NE: np.not_equal,
    ca.OP_NOT: np.logical_not,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
}
"""Operations whose results are the same bits everywhere."""


def _fold(scalars: Scalars, operation: int, arguments: tuple[int, ...]) -> float | int | None:
    """Return the value of an operation on constants, or the node that it is equal to in every bit; None otherwise."""
    nodes = [scalars.nodes[argument] for argument in arguments]
    values = [node.constant if node.operation == ca.OP_CONST else None for node in nodes]
    if operation in _EXACTLY and None not in values and values:
        with np.errstate(all="ignore"):
            return float(_EXACTLY[operation](*map(np.float64, values)))
    if operation == ca.OP_MUL and 1.0 in values:
        return arguments[1 - values.index(1.0)]
    if operation == ca.OP_DIV and values[1] == 1.0:
        return arguments[0]
    if operation == ca.OP_SUB and values[1] == 0.0 and not np.signbit(values[1]):
        return arguments[0]
    if operation in (ca.OP_AND, ca.OP_OR):
        for value, other in zip(values, (1, 0), strict=True):
            if value is not None and bool(value) == (operation == ca.OP_AND) and nodes[other].is_boolean:
                return arguments[other]
            if value is not None and bool(value) != (operation == ca.OP_AND):
                return float(bool(value))
    if operation == ca.OP_IF_ELSE_ZERO:
        if values[0] is not None:
            return arguments[1] if values[0] else 0.0
        if nodes[1].operation == operation and nodes[1].arguments[0] == arguments[0]:
            return arguments[1]
    return None


def _find_choice(scalars: Scalars, operation: int, arguments: tuple[int, ...]) -> tuple[int, int, int] | None:
    """Return condition and values where a sum of two values is a choice of one."""
    if operation != ca.OP_ADD:
        return None
    nodes = [scalars.nodes[argument] for argument in arguments]
    if any(node.operation != ca.OP_IF_ELSE_ZERO for node in nodes):
        return None
    for one, other in (nodes, nodes[::-1]):
        condition = scalars.nodes[other.arguments[0]]
        if condition.operation == ca.OP_NOT and condition.arguments[0] == one.arguments[0]:
            return one.arguments[0], one.arguments[1], other.arguments[1]
    return None


class Tables:
    """Tables of numbers, each once."""

    def __init__(self) -> None:
        self.values: list[np.ndarray] = []
        self._known: dict[bytes, int] = {}

    def add(self, lookup: Lookup) -> int:
        """Return the number of a lookup's table."""
        key = lookup.table.tobytes()
        if key not in self._known:
            self._known[key] = len(self.values)
            self.values.append(lookup.table)
        return self._known[key]
