"""Equations read back from the sources of an exported FMU are those that were written."""

import zipfile

import casadi as ca
import numpy as np
import pytest

from loopwright.fmus import FmuError
from loopwright.fmus.export import read_equations, read_own_sources
from loopwright.fmus.export.c_code import generate, read_fmu_sources
from loopwright.fmus.export.written_equations import read_text
from support.exported import mass_spring_damper, pendulums


def every_operation():
    """A model whose equations have every operation that CasADi writes as C."""
    t, x, u, p = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p", 3)
    a, b, k = x[0], x[1], 0.1 + ca.fabs(x[1])
    yes = ca.logic_or(a < b, ca.logic_and(a <= u, ca.eq(p[0], p[1])))
    parts = [
        a + b,
        a - b,
        a * b,
        a / k,
        -a,
        ca.exp(a),
        ca.log(k),
        k**a,
        k**3.5,
        ca.sqrt(k),
        a**2,
        2 * a,
        ca.sin(a),
        ca.cos(a),
        ca.tan(a),
        ca.asin(a / 4),
        ca.acos(a / 4),
        ca.atan(a),
        ca.ne(a, b),
        ca.logic_not(a < b),
        ca.floor(a),
        ca.ceil(a),
        ca.fmod(a, k),
        ca.sign(a),
        ca.copysign(a, b),
        ca.if_else(yes, u, t),
        ca.erf(a),
        ca.fmin(a, b),
        ca.fmax(a, b),
        1 / k,
        ca.sinh(a),
        ca.cosh(a),
        ca.tanh(a),
        ca.asinh(a),
        ca.acosh(1 + k),
        ca.atanh(a / 4),
        ca.atan2(a, b),
        ca.log1p(k),
        ca.expm1(a),
        ca.hypot(a, b),
        ca.remainder(a, k),
        p[2] * 1.1 + 1e300 * t,
    ]
    rates = ca.vertcat(sum(w * part for w, part in zip(np.linspace(1, 2, len(parts)), parts, strict=True)), b)
    return mass_spring_damper(
        derivative=ca.Function("f", [t, x, u, p], [rates]), output=ca.Function("g", [t, x, u, p], [parts[5] * p[0]])
    )


@pytest.mark.parametrize("make", [mass_spring_damper, pendulums, every_operation])
@pytest.mark.parametrize("fmi", [2, 3])
def test_equations_are_read_back_with_the_values_of_the_model(make, fmi):
    spec = make()
    found = read_text(generate(spec, "token", fmi)[0])
    rng = np.random.default_rng(3)
    for _ in range(5):
        given = [rng.uniform(-2, 2, spec.derivative.numel_in(i)) for i in range(4)]
        for mine, theirs in ((found.derivative, spec.derivative), (found.output, spec.output)):
            shaped = [np.reshape(v, theirs.size_in(i), order="F") for i, v in enumerate(given)]
            np.testing.assert_allclose(
                np.array(mine(*given)).ravel(), np.array(theirs(*shaped)).ravel(), rtol=1e-12, atol=1e-13
            )
    assert found.variables[0].kind == "time"
    places = {v.name: (v.first, v.size) for v in found.variables}
    if make is mass_spring_damper:
        assert places["mass"] == (found.first["p"], 1)
        assert places["force"] == (found.first["u"], 1)
        assert places["velocity"] == (found.first["x"] + 1, 1)
        assert places["acceleration"] == (found.first["y"], 1)


def test_sources_that_are_none_or_more_than_scalar_operations_are_refused(tmp_path):
    text = generate(mass_spring_damper(), "token")[0]
    for old, new, said in (
        ("#define LW_N_P", "#define OTHER", "others than those of an exported FMU"),
        ("#define LW_N_Z 0", "#define LW_N_Z 1", "it has events"),
        ("/* lw_output:(", "/* other:(", "no function 'lw_output'"),
        ("  a0=", "  a0=casadi_low", "found 'casadi_low.*' in its function 'lw_derivative'; .* no scalar operations"),
        ("  a0=", "  for (;;) a0=", "found 'for .*' in its function"),
    ):
        with pytest.raises(FmuError, match=said):
            read_text(text.replace(old, new))
    with pytest.raises(FmuError, match="its sources can't be read"):
        read_equations(tmp_path / "missing.fmu")
    with zipfile.ZipFile(tmp_path / "empty.fmu", "w") as archive:
        archive.writestr("sources/other.c", "")
    with pytest.raises(FmuError, match="its sources can't be read"):
        read_equations(tmp_path / "empty.fmu")


def write_sources(path, spec, fmi=3, **changes):
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in {**read_fmu_sources(fmi), "model.c": generate(spec, "token", fmi)[0], **changes}.items():
            archive.writestr(f"sources/{name}", text)


def test_a_file_that_was_written_anew_is_read_anew(tmp_path):
    for spec, states, fmi in ((mass_spring_damper(), 2, 3), (pendulums(), 5, 2)):
        write_sources(tmp_path / "model.fmu", spec, fmi)
        assert read_equations(tmp_path / "model.fmu").states == states


def test_sources_of_another_version_are_refused(tmp_path):
    write_sources(tmp_path / "model.fmu", mass_spring_damper(), **{"integrators.c": "/* other steps */"})
    with pytest.raises(FmuError, match="another version of Loopwright has exported it"):
        read_equations(tmp_path / "model.fmu")


def test_sources_of_another_tool_may_have_any_encoding(tmp_path):
    write_sources(tmp_path / "model.fmu", mass_spring_damper())
    assert read_own_sources(tmp_path / "model.fmu") is not None
    write_sources(tmp_path / "model.fmu", mass_spring_damper(), **{"fmi3.c": "/* Länge */".encode("latin-1")})
    assert read_own_sources(tmp_path / "model.fmu") is None
