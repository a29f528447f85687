"""C code over vectors, each entry of which belongs to another run.

Functions of scalar operations are written in vector operations. Functions that have no such form, as tables and matrix
products, are called for one lane after the other, compiled as for one run. Methods of fixed step are the text that runs
and exported FMUs use, with vectors as its numbers.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from ...blocks.tracing import MATH_FUNCTIONS, count_uses
from ...fmus.export import c_number
from ...fmus.runtime import read_sources

_INFIX = {ca.OP_ADD: "+", ca.OP_SUB: "-", ca.OP_MUL: "*", ca.OP_DIV: "/"}
_COMPARED = {ca.OP_LT: "<", ca.OP_LE: "<=", ca.OP_EQ: "==", ca.OP_NE: "!="}
_CALLS = {**MATH_FUNCTIONS, ca.OP_SIGN: "sign"}
_LOGIC = (ca.OP_NOT, ca.OP_AND, ca.OP_OR)
_LARGEST = 8192
"""Numbers that a function which is called lane by lane keeps on the stack, at most."""
_KINDS = ("const double *arg[{sz_arg}]", "double *res[{sz_res}]", "double work[{sz_w}]", "long long ints[{sz_iw}]")
_AS_ALONE, _FUSED = "#pragma STDC FP_CONTRACT OFF\n", "\n#pragma STDC FP_CONTRACT ON\n"
# Without fused products the bits are those of the code for one run.


@dataclass(frozen=True)
class VectorCode:
    """The C code of a function."""

    text: str  # NAME_prepare(fixed arguments, kept) and NAME(arguments, kept, results)
    kept: int  # vectors that are computed from fixed arguments, once


@dataclass
class _Value:
    """The result of an operation: its C expression, whether it is a mask, and whether fixed arguments determine it."""

    text: str
    fixed: bool
    mask: bool = False
    product: bool = False
    uses: int = 0
    place: int | None = None
    constant: float | None = None


def write_vectors(
    name: str, function: Any, arguments: Sequence[str], fixed: Collection[int], *, inlined: bool = True
) -> VectorCode:
    """Write a function of scalar operations as C code over vectors.

    Its operations are those of the function, one for one, but for two: a product that is used in one sum alone is
    written within it, so that the processor may do both at once (FMA), and a division by what ``fixed`` arguments
    (those that don't change in a run) determine is a product with its reciprocal. The compiler takes long to inline a
    large one.
    """
    writer = _Writer(function, arguments, fixed)
    writer.write()
    given = "".join(f"const vec *restrict {arguments[i]}, " for i in sorted(fixed))
    all_given = "".join(f"const vec *restrict {argument}, " for argument in arguments)
    made = ", ".join(f"vec *restrict out{i}" for i in range(function.n_out()))
    head = f"static void {name}_prepare({given}vec *restrict kept) {{\n"
    kind = "static inline __attribute__((always_inline))" if inlined else "static"
    body = f"{kind} void {name}({all_given}const vec *restrict kept, {made}) {{\n"
    text = f"{head}{''.join(writer.early)}}}\n\n{body}{''.join(writer.late)}}}\n"
    return VectorCode(text, writer.kept)


class _Writer:
    def __init__(self, function: Any, arguments: Sequence[str], fixed: Collection[int]):
        self._f, self._arguments, self._fixed = function, arguments, fixed
        self.early: list[str] = []
        self.late: list[str] = []
        self.kept = 0
        self._made = 0
        self._reciprocals: dict[str, _Value] = {}

    def write(self) -> None:
        f = self._f
        uses = count_uses(f)
        work: dict[int, _Value] = {}
        filled: set[tuple[int, int]] = set()
        for k in range(f.n_instructions()):
            op, out, operands = f.instruction_id(k), f.instruction_output(k), f.instruction_input(k)
            if op == ca.OP_OUTPUT:
                place = out[0], f.sparsity_out(out[0]).row()[out[1]]
                filled.add(place)
                self.late.append(f"    out{place[0]}[{place[1]}] = {self._late(self._number(work[operands[0]]))};\n")
            elif op == ca.OP_INPUT:
                place = operands[0], f.sparsity_in(operands[0]).row()[operands[1]]
                work[out[0]] = _Value(f"{self._arguments[place[0]]}[{place[1]}]", place[0] in self._fixed)
            elif op == ca.OP_CONST:
                value = f.instruction_constant(k)
                work[out[0]] = _Value(f"splat({c_number(value)})", True, constant=value)
            elif op == ca.OP_ASSIGN:
                work[out[0]] = work[operands[0]]
            else:
                work[out[0]] = self._operation(op, [work[i] for i in operands], uses[k])
        for i in range(f.n_out()):
            for j in range(f.numel_out(i)):
                if (i, j) not in filled:  # a structural zero is no operation
                    self.late.append(f"    out{i}[{j}] = splat(0.0);\n")

    def _operation(self, op: int, operands: Sequence[_Value], uses: int) -> _Value:
        fixed = all(value.fixed for value in operands)
        a, *rest = operands
        if op in _COMPARED:
            x, y = (self._use(self._number(value), fixed) for value in operands)
            return self._new(f"{x} {_COMPARED[op]} {y}", fixed, mask=True)
        if op in _LOGIC:
            masks = [self._use(self._mask(value), fixed) for value in operands]
            text = f"~{masks[0]}" if op == ca.OP_NOT else f"{masks[0]} {'&' if op == ca.OP_AND else '|'} {masks[1]}"
            return self._new(text, fixed, mask=True)
        if op == ca.OP_IF_ELSE_ZERO:
            mask, value = self._use(self._mask(a), fixed), self._use(self._number(rest[0]), fixed)
            return self._new(f"where({mask}, {value})", fixed)
        if op == ca.OP_DIV and rest[0].fixed and not fixed:
            below = self._number(rest[0])
            if below.text not in self._reciprocals:
                self._reciprocals[below.text] = self._new(f"1.0 / {below.text}", True)
            rest, op = [self._reciprocals[below.text]], ca.OP_MUL
        x, *others = (self._use(self._number(value), fixed, op) for value in (a, *rest))
        if op in _INFIX:
            product = op == ca.OP_MUL and uses == 1 and not fixed
            return self._new(f"{x} {_INFIX[op]} {others[0]}", fixed, product=product)
        if op == ca.OP_SQ:
            return self._new(f"{x} * {x}", fixed, product=uses == 1 and not fixed)
        if op == ca.OP_TWICE:
            return self._new(f"2.0 * {x}", fixed)
        if op == ca.OP_INV:
            return self._new(f"1.0 / {x}", fixed)
        if op == ca.OP_NEG:
            return self._new(f"-{x}", fixed)
        if op in _CALLS:
            return self._new(f"vec_{_CALLS[op]}({', '.join([x, *others])})", fixed)
        raise NoLanesError("it has an operation that has no form over vectors")

    def _new(self, text: str, fixed: bool, *, mask: bool = False, product: bool = False) -> _Value:
        if product:  # written where it is used
            return _Value(text, False, product=True)
        name = f"v{self._made}"
        self._made += 1
        line = f"    const {'mask' if mask else 'vec'} {name} = {text};\n"
        (self.early if fixed else self.late).append(line)
        return _Value(name, fixed, mask)

    def _use(self, value: _Value, fixed: bool, op: int | None = None) -> str:
        """Return a value in an operation, which is done once if it is fixed."""
        if value.product:
            if op in (ca.OP_ADD, ca.OP_SUB):
                return f"({value.text})"
            made = self._new(value.text, False)
            value.text, value.product = made.text, False
        return value.text if fixed else self._late(value)

    def _late(self, value: _Value) -> str:
        """Return a value in the function: what is fixed was kept."""
        if value.product:
            return value.text
        if not value.fixed or value.constant is not None or "[" in value.text:
            return value.text
        if value.place is None:
            value.place, self.kept = self.kept, self.kept + 1
            text = f"(vec){value.text}" if value.mask else value.text
            self.early.append(f"    kept[{value.place}] = {text};\n")
        return f"((mask)kept[{value.place}])" if value.mask else f"kept[{value.place}]"

    def _number(self, value: _Value) -> _Value:
        """Return a value as a number: 1 where a mask is true."""
        return self._new(f"one_where({self._use(value, value.fixed)})", value.fixed) if value.mask else value

    def _mask(self, value: _Value) -> _Value:
        if value.mask:
            return value
        return self._new(f"{self._use(value, value.fixed)} != 0.0", value.fixed, mask=True)


class ScalarFunctions:
    """Functions that have no form over vectors; their C code comes before all that calls them."""

    def __init__(self) -> None:
        self._functions: list[Any] = []

    def write(self) -> str:
        """Return the C code of all functions that were asked for; empty without any."""
        if not self._functions:
            return ""
        generator = ca.CodeGenerator("scalars.c")
        for function in self._functions:
            generator.add(function)
        return f"{_AS_ALONE}{generator.dump()}{_FUSED}"

    def write_calls(
        self, name: str, function: Any, arguments: Sequence[str], fixed: Collection[int], *, inlined: bool = True
    ) -> VectorCode:
        """Write a function over vectors: in vector operations where it has them, else as a call for each lane.

        Each lane has the bits that the function has when it is compiled for one run. See `write_vectors`.
        """
        if function.is_a("SXFunction"):
            return write_vectors(name, function, arguments, fixed, inlined=inlined)
        if max(function.sz_w(), function.sz_iw()) > _LARGEST:
            raise NoLanesError(f"a function of it needs more than {_LARGEST} numbers of memory")
        symbols, scalar = function.mx_in(), f"scalar{len(self._functions)}"
        whole = ca.Function(scalar, symbols, [ca.densify(made) for made in function.call(symbols)])
        self._functions.append(whole)
        ins = [(f"a{i}", arguments[i], whole.numel_in(i)) for i in range(whole.n_in())]
        outs = [(f"r{i}", f"out{i}", whole.numel_out(i)) for i in range(whole.n_out())]
        sizes = {key: getattr(whole, key)() + 1 for key in ("sz_arg", "sz_res", "sz_w", "sz_iw")}
        room = [f"double {own}[{size}];" for own, _, size in (*ins, *outs) if size]
        room += [f"{kind.format(**sizes)};" for kind in _KINDS]
        bound = [f"arg[{i}] = {own if size else 0};" for i, (own, _, size) in enumerate(ins)]
        bound += [f"res[{i}] = {own if size else 0};" for i, (own, _, size) in enumerate(outs)]
        read = [f"for (int i = 0; i < {n}; i++) {own}[i] = {from_}[i][lane];" for own, from_, n in ins if n]
        made = [f"for (int i = 0; i < {n}; i++) {into}[i][lane] = {own}[i];" for own, into, n in outs if n]
        given = "".join(f"const vec *restrict {arguments[i]}, " for i in sorted(fixed))
        all_given = "".join(f"const vec *restrict {argument}, " for argument in arguments)
        results = ", ".join(f"vec *restrict out{i}" for i in range(whole.n_out()))
        lines = "\n        ".join(
            [*bound, *read, f"{scalar}(arg, res, ints, work, 0);", *made]  # a call may change its lists
        )
        text = (
            f"static void {name}_prepare({given}vec *restrict kept) {{ (void)kept; }}\n\n"
            f"static void {name}({all_given}const vec *restrict kept, {results}) {{\n"
            f"    {' '.join(room)}\n    (void)kept;\n    EACH_LANE {{\n        {lines}\n    }}\n}}\n"
        )
        return VectorCode(text, 0)


def write_methods(name: str, equation: str) -> str:
    """Write ``NAME_lw_rk4`` and so on, for the C type of an equation, behind its rates ``NAME_rate(e, t, x, f)``."""
    needs = {"EQUATION": equation, "NUMBER": "vec", "RATE": f"{name}_rate", "INLINE": "INLINE"}
    text = "".join(f"#define LW_{key} {value}\n" for key, value in needs.items())
    return re.sub(r"\b(lw|LW)_", rf"{name}_\1_", f"{text}{read_sources('fixed_step.c')}\n")


class NoLanesError(Exception):
    """Runs of a diagram can't go side by side in the lanes of a vector; the text says why, as a clause."""
