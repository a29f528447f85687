"""Rules of a block as a value: parameters, ports, and pure equations; see `check_block`."""

from __future__ import annotations

import inspect
import math
import pickle
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import Block, DefinitionError, Layout, LoopwrightError, Shape, UnitError, parse_unit
from ...blocks.tracing import Point, Values, bundle, size, state_after_start, with_values
from .exercise import Exercise, numbers_of


def rule_error(
    rule: str, text: str, block: Block, port: str | None = None, kind: type[LoopwrightError] = DefinitionError
) -> LoopwrightError:
    """Return the error for a rule that is not kept."""
    return kind(f"{rule}: {text}", block=block.label, port=port)


def check_values(block: Block) -> str:
    """Check equality, pickling and ``replace``, and return a summary."""
    same = block.replace()
    if same != block or hash(same) != hash(block):
        raise rule_error(
            "values",
            f"replace() without changes gave {same!r}, which is not equal to {block!r}; expected an equal block. Leave "
            "the constructor and == as they are, and check parameters in check().",
            block,
        )
    try:
        copy = pickle.loads(pickle.dumps(block))
        pickled = "pickled"
    except Exception as error:  # an object's pickling may raise anything
        culprit = next((n for n, v in block.parameters.items() if not _can_be_pickled(v)), None)
        if culprit is None:
            raise rule_error(
                "values",
                f"it can't be pickled ({type(error).__name__}: {error}); expected a value that can. Define its class "
                "at the top of a module, and keep nothing on it but parameters.",
                block,
            ) from error
        copy, pickled = block, f"not pickled, since its {culprit} can't be"
    if copy != block or vars(copy).keys() != vars(block).keys():
        raise rule_error(
            "values",
            f"pickled and read back it is {copy!r} with the attributes {sorted(vars(copy))}; expected {block!r} with "
            f"{sorted(vars(block))}. Keep nothing on it but parameters.",
            block,
        )
    changed = [name for name in block.parameters if _check_replace(block, name)]
    return f"{pickled}; {len(changed)} of {len(block.parameters)} parameters replaced"


def _can_be_pickled(value: object) -> bool:
    try:
        pickle.dumps(value)
    except Exception:
        return False
    return True


def _check_replace(block: Block, name: str) -> bool:
    """Change one parameter and change it back; return whether it has another value that is allowed."""
    old = block.parameters[name]
    for value in _other_values(old):
        if np.array_equal(value, old):
            continue
        try:
            variant = block.replace(**{name: value})
        except LoopwrightError:  # out of bounds, or it doesn't fit the other parameters
            continue
        if not np.array_equal(variant.parameters[name], value) or variant == block:
            raise rule_error(
                "values",
                f"replace({name}={value!r}) gave {variant!r}, "
                f"{'equal to the block' if variant == block else 'with another value'}; expected another block with "
                "this value. Don't change parameters in the constructor.",
                block,
                name,
            )
        if variant.replace(**{name: old}) != block:
            raise rule_error(
                "values",
                f"replace({name}={value!r}) and back gave {variant.replace(**{name: old})!r}; expected {block!r}. Let "
                "no parameter depend on another one.",
                block,
                name,
            )
        return True
    return False


def _other_values(value: object) -> list[ArrayLike]:
    """Return other values to try for a parameter."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value - 1]
    if isinstance(value, float | np.ndarray):
        return [1.25 * value + 0.0 if np.any(value) else value + 0.5, 0.75 * value, value + 0.125, value - 0.125]
    return []


def check_ports(block: Block) -> str:
    """Check the declarations of the ports, and return their number."""
    kinds = {"inputs": block.inputs, "outputs": block.outputs, "states": block.states, "events": block.events}
    count = 0
    for kind, ports in kinds.items():
        if [*ports] != [*getattr(block, kind)]:
            raise rule_error(
                "ports",
                f"its {kind} are {[*ports]}, then {[*getattr(block, kind)]}; expected the same. Use parameters alone.",
                block,
            )
        for name, port in ports.items():
            count += 1
            if port.name != name:
                raise rule_error(
                    "ports",
                    f"it is under {name!r} and calls itself {port.name!r}; expected one name. Give name={name!r}.",
                    block,
                    name,
                )
            like = getattr(port, "like", None)
            if like is not None and like not in block.inputs:
                raise rule_error(
                    "ports",
                    f"found like={like!r}; expected an input: {', '.join(block.inputs) or 'there are none'}. Name one.",
                    block,
                    name,
                )
            units = (port.unit,) if isinstance(port.unit, str) else port.unit or ()
            for unit in units:
                parse_unit(unit)
            if isinstance(port.unit, tuple) and port.shape is not None and len(units) != size(port.shape):
                raise rule_error(
                    "units",
                    f"found {len(units)} units for shape {port.shape}; expected one for each entry, or one for all. "
                    "Give as many.",
                    block,
                    name,
                    UnitError,
                )
    return f"{count}"


def describe_units(block: Block) -> str:
    """Return what an FMU of a block's equations lacks, "" if nothing: units for all of its variables, or for none."""
    if not (hasattr(block, "derivative") or block.events):  # it has no FMU
        return ""
    units = {name: port.unit for ports in (block.inputs, block.outputs, block.states) for name, port in ports.items()}
    numeric = (name for name, value in block.parameters.items() if _is_numeric(value))
    units |= {name: type(block).parameter_specs[name].unit for name in numeric}
    without = [name for name, unit in units.items() if unit is None]
    if not 0 < len(without) < len(units):
        return ""
    return f"as an FMU it needs one for {', '.join(without)}, too: unit='1' for no dimension"


def _is_numeric(value: Any) -> bool:
    return isinstance(value, int | float | np.ndarray) and not isinstance(value, bool)


# --- purity -----------------------------------------------------------------------------------------------------------


def check_purity(exercise: Exercise, sampled: bool, places: list[Point]) -> int:
    """Evaluate every equation several times, and return the number of equations."""
    block = exercise.block
    T = exercise.sample_time if sampled else math.nan
    shadow = with_values(block, numbers_of(block, T, "exact"))
    first = [_evaluate_all(shadow, point, T if sampled else None) for point in places]
    before = _attributes(shadow)  # caches are filled by now
    for number, point in enumerate(places):
        for equation, value in _evaluate_all(shadow, point, T if sampled else None).items():
            if first[number].get(equation, value) != value:
                raise rule_error(
                    "purity",
                    f"its {equation} gives other values when it is called again with the same arguments ({point}); "
                    "expected the same ones. Let it depend on nothing but (t, x, u) and parameters; a block's memory "
                    "is a State.",
                    block,
                )
        after = _attributes(shadow)
        changed = sorted(n for n in before.keys() | after.keys() if before.get(n) != after.get(n))
        if changed:
            raise rule_error(
                "purity",
                f"its attribute {changed[0]!r} was changed by its equations; expected none to change. A block is a "
                "value: keep it in a State.",
                block,
            )
    return len(set().union(*first))


def _evaluate_all(block: Block, point: Point, T: float | None) -> dict[str, bytes]:
    """Return the result of every equation as bytes, without those that fail: tracing says why they do."""
    result = {}
    for equation in ("output", "derivative", "update", "guards", "indicators", "jump", "initial"):
        if not hasattr(block, equation) or (equation == "update" and T is None):
            continue
        t, x, u, fired = point.arguments()
        given = [bundle("x", x), bundle("u", u)]
        arguments = [given[1]] if equation == "initial" else [t, *given]
        if equation == "jump":
            arguments.append(bundle("fired", fired))
        try:
            found = _call(block, equation, arguments, T)
        except Exception:  # a user's equation may raise anything
            continue
        _expect_unchanged(block, equation, point, x, u)
        result[equation] = _to_bytes(found)
    return result


def check_after_start(exercise: Exercise, sampled: bool, places: list[Point], shapes: Mapping[str, Shape]) -> str:
    """Check the states that ``after_start`` gives, and return a summary; ``shapes`` are those of the states."""
    # They are finite, have the states' shapes, are the same again for the same arguments, and come from arguments that
    # stay unchanged. From states after the branch it leads to themselves: a point taken twice is the same point.
    # With the states after that of the start, the outputs are those of the start; the first place is there.
    block = exercise.block
    T = exercise.sample_time if sampled else None
    shadow = with_values(block, numbers_of(block, math.nan if T is None else T, "exact"))

    def evaluate(x: Values, u: Values) -> np.ndarray:
        try:
            return state_after_start(shadow, shapes, bundle("x", x), bundle("u", u), T)
        except LoopwrightError as error:
            raise rule_error("after_start", f"{error.message}", block) from error.__cause__
        except Exception as error:  # a user's function may raise anything
            raise rule_error(
                "after_start",
                f"its after_start(x, u, T) failed with T = {T}: {type(error).__name__}: {error}; expected the states "
                f"{', '.join(shapes) or '()'}. Return one value for each; T is None in a continuous subsystem.",
                block,
            ) from error

    for point in places:
        _, x, u, _ = point.arguments()
        found = evaluate(x, u)
        _expect_unchanged(block, "after_start", point, x, u)
        if not np.array_equal(found, evaluate(x, u), equal_nan=True):
            raise rule_error(
                "purity",
                f"its after_start gives other values when it is called again with the same arguments ({point}); "
                "expected the same ones. Let it depend on nothing but (x, u, T) and parameters.",
                block,
            )
        if not np.all(np.isfinite(found)):
            raise rule_error(
                "after_start",
                f"it gave {found.tolist()} at {point}; expected finite states. Look at T, which is "
                f"{'None in a continuous subsystem' if T is None else f'{T:g} s here'}.",
                block,
            )
        split: Values = {**Layout.of(shapes).split(found)}
        again = evaluate(split, u)
        if np.max(np.abs(again - found) / (1.0 + np.abs(found)), initial=0.0) > 1e-9:
            raise rule_error(
                "after_start",
                f"from its own states {found.tolist()} it gave {again.tolist()} at {point}; expected the same, as they "
                "are past the start already. Give back x where the branch is over.",
                block,
            )
        if point is places[0] and shapes:
            one, other = (_outputs(shadow, states, u, T) for states in (x, split))
            if one is not None and other is not None and not np.allclose(one, other, rtol=1e-6, atol=1e-6):
                raise rule_error(
                    "after_start",
                    f"with the states {found.tolist()} its outputs are {other.tolist()}; expected those of the start, "
                    f"{one.tolist()}, at {point}. Give states that the branch leaves behind, such as an earlier value.",
                    block,
                )
    return f"{len(shapes)} states, at {len(places)} points"


def _outputs(block: Block, x: Values, u: Values, T: float | None) -> np.ndarray | None:
    """Return the outputs at t = 0, one after the other; None where they fail, which tracing says."""
    try:
        found = _call(block, "output", [np.float64(0.0), bundle("x", x), bundle("u", u)], T)
    except Exception:  # a user's equation may raise anything
        return None
    columns = found if isinstance(found, tuple | list) else (found,)
    return np.concatenate([np.ravel(np.asarray(column, dtype=float)) for column in columns])


def _call(block: Block, equation: str, arguments: list[Any], T: float | None) -> Any:
    """Return the result of an equation, which may take the sample time."""
    timed = T is not None and "T" in inspect.signature(getattr(block, equation)).parameters
    with np.errstate(all="ignore"):
        return getattr(block, equation)(*arguments, **({"T": np.float64(T)} if timed else {}))


def _expect_unchanged(block: Block, equation: str, point: Point, x: Values, u: Values) -> None:
    for name, given, now in [*((n, point.x[n], v) for n, v in x.items()), *((n, point.u[n], v) for n, v in u.items())]:
        if not np.array_equal(np.asarray(given), np.asarray(now), equal_nan=True):
            raise rule_error(
                "purity",
                f"its {equation} changes its argument {name!r} from {np.asarray(given).tolist()} to "
                f"{np.asarray(now).tolist()}; expected it unchanged. Return new values: y = u + 1, not u += 1.",
                block,
                name,
            )


def _to_bytes(value: object) -> bytes:
    if isinstance(value, dict):
        return b"".join(str(k).encode() + _to_bytes(v) for k, v in value.items())
    if isinstance(value, tuple | list):
        return b"|".join(map(_to_bytes, value))
    return np.asarray(value).tobytes()


def _attributes(block: Block) -> dict[str, object]:
    """Return every attribute's content as bytes by name, or its identity where it can't be pickled."""
    result: dict[str, object] = {}
    for name, value in vars(block).items():
        try:
            result[name] = pickle.dumps(value)
        except Exception:  # an object's pickling may raise anything
            result[name] = id(value)
    return result
