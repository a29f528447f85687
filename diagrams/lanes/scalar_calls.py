"""C functions that are called for one lane after the other: tables and matrix products, compiled as for one run."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import casadi as ca

from .no_lanes import NoLanesError
from .vector_code import VectorCode, write_vectors

_LARGEST = 8192
"""Numbers that such a function keeps on the stack, at most."""
_KINDS = ("const double *arg[{sz_arg}]", "double *res[{sz_res}]", "double work[{sz_w}]", "long long ints[{sz_iw}]")
_AS_ALONE, _FUSED = "#pragma STDC FP_CONTRACT OFF\n", "\n#pragma STDC FP_CONTRACT ON\n"
# Without fused products the bits are those of the code for one run.


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
