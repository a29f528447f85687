"""Elementary functions of exported FMUs, beside mpmath: errors in units in the last place, special values, bits."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import zipfile

import mpmath
import numpy as np
import pytest

from loopwright.blocks import Block, Output, State
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, build
from loopwright.fmus.export import compile_shared, own_functions, processor_flags
from loopwright.fmus.export.elementary_tables import FUNCTIONS, prepare_functions
from loopwright.fmus.models import gantry
from support.elementary import ONE_FUNCTION, RUNTIME, RUNTIME_SINGLE, arguments, powers, signed, source, source_single

BOUNDS = {"sin": 0.78, "cos": 0.78, "tanh": 0.58, "exp": 0.52, "expm1": 0.6, "log": 0.52, "pow": 0.54}
"""Largest errors in ulp that docs/reference/exported_fmus.md states, for results that are neither tiny nor near overflow."""


SINGLE_BOUNDS = {"sin": 0.8, "cos": 0.8, "tanh": 1.9, "exp": 0.78, "expm1": 0.78, "log": 0.56, "pow": 0.79}
"""Largest errors of single precision in ulp that docs/howto/c_for_a_target.md states."""


class Functions:
    """The functions of a compiled library, for arrays."""

    def __init__(self, path, kind=float):
        self._library, self._kind = ctypes.CDLL(str(path)), kind

    def __call__(self, name, x, z=None):
        x = np.ascontiguousarray(x, dtype=self._kind)
        z = x if z is None else np.ascontiguousarray(z, dtype=self._kind)
        y = np.empty_like(x)
        pointers = [ctypes.c_void_p(a.ctypes.data) for a in (x, z, y)]
        getattr(self._library, f"many_{name}")(*pointers, ctypes.c_longlong(x.size))
        return y


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    out = tmp_path_factory.mktemp("elementary") / "functions.so"
    compile_shared({"all.c": source(), "elementary.c": RUNTIME.read_text("utf-8")}, out, compiled=["all.c"])
    return Functions(out)


def ulps(found, exact):
    nearest = float(exact)
    return float(abs(mpmath.mpf(found) - exact) / mpmath.mpf(math.ulp(nearest))) if nearest else abs(found) / 5e-324


def largest_error(ours, name, n, seed):
    rng = np.random.default_rng(seed)
    worst = 0.0
    if name == "pow":
        with mpmath.workprec(160):
            for x, z in powers(n, rng):
                for a, b, y in zip(x.tolist(), z.tolist(), ours("pow", x, z).tolist(), strict=True):
                    worst = max(worst, ulps(y, mpmath.power(mpmath.mpf(a), mpmath.mpf(b)).real))
        return worst
    for x in arguments(name, n, rng):
        with mpmath.workprec(1300 if name in ("sin", "cos") and np.abs(x).max() > 1e9 else 200):
            for a, y in zip(x.tolist(), ours(name, x).tolist(), strict=True):
                worst = max(worst, ulps(y, getattr(mpmath, name)(mpmath.mpf(a))))
    return worst


@pytest.mark.parametrize("name", FUNCTIONS)
def test_errors_stay_below_their_bounds(name, ours):
    assert largest_error(ours, name, 250, 1) < BOUNDS[name]


# --- single precision: NumPy's functions in double precision are exact beside it ----------------------------------------


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    out = tmp_path_factory.mktemp("elementary") / "single.so"
    sources = {"all.c": source_single(), "elementary_single.c": RUNTIME_SINGLE.read_text("utf-8")}
    compile_shared(sources, out, compiled=["all.c"])
    return Functions(out, np.float32)


def floats(step, first=0):
    """Every so many-th float of all that there are, NaNs too."""
    return np.arange(first, 2**32, step, dtype=np.uint64).astype(np.uint32).view(np.float32)


def single_ulps(found, exact):
    with np.errstate(all="ignore"):
        error = np.abs(found.astype(float) - exact) / np.maximum(np.spacing(np.abs(exact).astype(np.float32)), 1.4e-45)
    same = (found.astype(float) == exact) | (np.isnan(found) & np.isnan(exact))
    error[same | (np.isinf(found) & (np.abs(exact) > np.finfo(np.float32).max))] = 0.0
    return float(np.max(error))  # NaN where only one is NaN


def single_powers(n, rng):
    x = np.exp(rng.normal(size=n) * rng.choice([1e-3, 0.1, 1, 20], n)).astype(np.float32)
    y = rng.uniform(-100, 100, n) / np.maximum(np.abs(np.log(x.astype(float))), 1e-7)
    y = np.where(rng.random(n) < 0.3, rng.integers(-20, 20, n), y).astype(np.float32)
    return np.where((y == np.round(y)) & (rng.random(n) < 0.3), -x, x).astype(np.float32), y


def largest_single_error(single, name, step):
    with np.errstate(all="ignore"):
        if name == "pow":
            x, y = single_powers(2**32 // step, np.random.default_rng(step))
            return single_ulps(single("pow", x, y), np.power(x.astype(float), y.astype(float)))
        x = floats(step)
        return single_ulps(single(name, x), getattr(np, name)(x.astype(float)))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_errors_of_single_precision_stay_below_their_bounds(name, single):
    assert 0.2 < largest_single_error(single, name, 40_009) < SINGLE_BOUNDS[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_errors_of_many_floats_stay_below_their_bounds(name, single):
    assert largest_single_error(single, name, 211) < SINGLE_BOUNDS[name]


def test_rounding_and_extremes_of_single_precision_are_exact(single):
    x = np.concatenate([floats(40_009), np.array([0.0, -0.0, 0.5, -0.5, 8388607.5, -8388607.5, 8388608.0], np.float32)])
    for name in ("floor", "ceil"):
        with np.errstate(invalid="ignore"):  # a signaling NaN
            found, exact = single(name, x), getattr(np, name)(x)
        np.testing.assert_array_equal(found, exact)
        np.testing.assert_array_equal(np.signbit(found[exact == 0]), np.signbit(exact[exact == 0]))
    x = np.where(np.isnan(x), np.float32(np.nan), x)
    y = x[::-1]
    np.testing.assert_array_equal(single("fmin", x, y), np.fmin(x, y))
    np.testing.assert_array_equal(single("fmax", x, y), np.fmax(x, y))


SPECIAL_POWERS = [
    (-0.0, 3.0, -0.0),
    (-0.0, -3.0, -np.inf),
    (0.0, -2.0, np.inf),
    (-2.0, 3.0, -8.0),
    (-2.0, 2.0, 4.0),
    (-2.0, 0.5, np.nan),
    (-1.0, np.inf, 1.0),
    (1.0, np.nan, 1.0),
    (np.nan, 0.0, 1.0),
    (np.inf, -1.0, 0.0),
    (-np.inf, 3.0, -np.inf),
    (0.5, np.inf, 0.0),
    (0.5, -np.inf, np.inf),
    (2.0, 128.0, np.inf),
    (-2.0, 16777217.0, np.inf),
    (2.0, -149.0, 2.0**-149),
    (4.0, 1e-20, 1.0),
]


@pytest.mark.parametrize(("x", "y", "exact"), SPECIAL_POWERS)
def test_special_powers_of_single_precision(x, y, exact, single):
    found = single("pow", [x], [y])[0]
    assert np.array_equal(found, np.float32(exact), equal_nan=True)
    assert np.isnan(exact) or np.signbit(found) == np.signbit(exact)


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_errors_of_many_arguments_stay_below_their_bounds(name, ours):
    assert largest_error(ours, name, 20_000, 2) < BOUNDS[name]


def test_tiny_results_and_those_near_overflow_are_within_one_ulp(ours):
    x = np.concatenate([np.linspace(-745.1, -690, 300), np.linspace(690, 709.78, 300)])
    with mpmath.workprec(160):
        worst = max(
            ulps(y, mpmath.exp(mpmath.mpf(a))) for a, y in zip(x.tolist(), ours("exp", x).tolist(), strict=True)
        )
        z = x / math.log(3.7)
        worst = max(
            worst,
            *(
                ulps(y, mpmath.power(mpmath.mpf(3.7), mpmath.mpf(b)))
                for b, y in zip(z.tolist(), ours("pow", np.full(len(z), 3.7), z).tolist(), strict=True)
            ),
        )
    assert worst < 1.03


def same(found, expected):
    """Whether two arrays are equal but for one ulp, with signs of zeros, and NaN where the other has it."""
    with np.errstate(all="ignore"):
        near = (found == expected) | (np.abs(found - expected) <= 2.3e-16 * np.abs(expected))
    near |= np.isnan(found) & np.isnan(expected)
    return near & ((np.signbit(found) == np.signbit(expected)) | np.isnan(expected))


SPECIAL = np.array([0.0, 1.0, 2.0, 0.5, 3.0, 2.5, 5e-324, 2e-308, 1e-20, 1e308, math.inf])
SPECIAL = np.concatenate([SPECIAL, -SPECIAL, [math.nan]])


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if name != "pow"])
def test_special_values_are_those_of_the_c_standard(name, ours):
    with np.errstate(all="ignore"):
        expected = getattr(np, name)(SPECIAL)
    assert same(ours(name, SPECIAL), expected).all()


def test_special_powers_are_those_of_the_c_standard(ours):
    x, z = (a.ravel() for a in np.meshgrid(SPECIAL, SPECIAL))
    with np.errstate(all="ignore"):
        expected = np.power(x, z)
    assert same(ours("pow", x, z), expected).all()


def test_odd_and_even_functions_are_so_in_every_bit(ours):
    x = 10 ** np.random.default_rng(3).uniform(-20, 20, 500)
    for name in ("sin", "tanh"):
        assert (ours(name, -x) == -ours(name, x)).all()
    assert (ours("cos", -x) == ours("cos", x)).all()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="another compiler is compared: needs gcc on the path")
@pytest.mark.parametrize("level", ["-O0", "-O1", "-O2", "-O3"])
def test_another_compiler_makes_the_same_bits(level, ours, tmp_path):
    (tmp_path / "all.c").write_text(source(), encoding="utf-8")
    (tmp_path / "elementary.c").write_text(RUNTIME.read_text("utf-8"), encoding="utf-8")
    flags = [level, "-std=c11", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run(["gcc", *flags, "-o", tmp_path / "f.so", tmp_path / "all.c", "-lm"], check=True, cwd=tmp_path)
    theirs, rng = Functions(tmp_path / "f.so"), np.random.default_rng(4)
    for name in FUNCTIONS:
        pairs = powers(3000, rng) if name == "pow" else ((x, x) for x in arguments(name, 3000, rng))
        for x, z in pairs:
            assert ours(name, x, z).tobytes() == theirs(name, x, z).tobytes()


def test_the_c_text_holds_only_what_equations_call():
    assert prepare_functions("a = atan2(x, y) + sqrt(z);") == ""
    text = prepare_functions("a = tanh(x);")
    assert "#define tanh lw_tanh" in text
    assert "lw_exp_table" not in text
    assert "lw_sin" not in text
    assert prepare_functions("a = arcsin(x)") == ""


def test_an_fmu_asks_the_platform_for_none_of_them():
    with zipfile.ZipFile(gantry.build()) as archive:
        (library,) = (
            n for n in archive.namelist() if n.startswith("binaries/") and n.endswith((".so", ".dll", ".dylib"))
        )
        held = archive.read(library)
        assert "sources/elementary.c" in archive.namelist()
    assert b"\0tanh\0" not in held
    assert b"\0sin\0" not in held


def test_the_functions_of_fused_code_err_by_a_few_units_in_the_last_place_of_1(tmp_path):
    names = ("sin", "cos", "tanh")
    before, after = own_functions(" ".join(f"{name}(x)" for name in names), "k")
    text = (
        before + "".join(ONE_FUNCTION.format(name, "").replace(f" lw_{name}(", f" {name}(") for name in names) + after
    )
    compile_shared({"all.c": text}, tmp_path / "fast.so", more_flags=processor_flags())
    fast, rng = Functions(tmp_path / "fast.so"), np.random.default_rng(7)
    for name in names:
        x = np.concatenate([rng.uniform(-25, 25, 500), signed(rng, 10 ** rng.uniform(-12, 6, 500)), [0.0]])
        exact = np.array([float(getattr(mpmath, name)(mpmath.mpf(float(v)))) for v in x])
        assert np.abs(fast(name, x) - exact).max() < 5e-16
        assert np.isnan(fast(name, [math.nan])).all()


@pytest.mark.drawn(3)
@pytest.mark.parametrize("function", [np.sin, np.cos, np.tanh, np.exp, np.expm1, np.log, np.log1p, np.log10])
def test_a_plant_with_any_of_them_is_exported(function, tmp_path):
    class Plant(Block):
        """A state whose rate is a function of it."""

        x = State(start=1.0, output=True)
        y = Output()

        def derivative(self, t, x, u):
            return -function(x.x)

        def output(self, t, x, u):
            return function(x.x)

    run = Diagram("plant", Fmu(build(Plant(), out=tmp_path / "plant.fmu"), name="plant")()).simulate(0.1, step=0.1)
    np.testing.assert_allclose(run["plant.y"], function(run["plant.x"]), rtol=1e-15, atol=1e-15)
