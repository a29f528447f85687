"""Unit strings: read, compared, described."""

import math

import pytest

from loopwright.blocks.core.errors import UnitError
from loopwright.blocks.core.units import (
    Unit,
    combine_units,
    common_unit,
    convert_unit,
    describe_mismatch,
    difference_unit,
    parse_unit,
    print_unit,
    raise_unit,
    rate_of,
    root_unit,
    same_unit,
    sum_unit,
    with_unit,
)

# By hand, from the definitions of the SI units: (kg, m, s, A, K, mol, cd, rad), factor.
KNOWN = {
    "1": ((0, 0, 0, 0, 0, 0, 0, 0), 1.0),
    "m": ((0, 1, 0, 0, 0, 0, 0, 0), 1.0),
    "mm": ((0, 1, 0, 0, 0, 0, 0, 0), 1e-3),
    "m/s": ((0, 1, -1, 0, 0, 0, 0, 0), 1.0),
    "m/s2": ((0, 1, -2, 0, 0, 0, 0, 0), 1.0),
    "m^2": ((0, 2, 0, 0, 0, 0, 0, 0), 1.0),
    "s-1": ((0, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "1/s": ((0, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "Hz": ((0, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "kg": ((1, 0, 0, 0, 0, 0, 0, 0), 1.0),
    "g": ((1, 0, 0, 0, 0, 0, 0, 0), 1e-3),
    "kg.m2": ((1, 2, 0, 0, 0, 0, 0, 0), 1.0),
    "N": ((1, 1, -2, 0, 0, 0, 0, 0), 1.0),
    "N.m": ((1, 2, -2, 0, 0, 0, 0, 0), 1.0),
    "N.s/m": ((1, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "N s/m": ((1, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "kN/mm": ((1, 0, -2, 0, 0, 0, 0, 0), 1e6),
    "Pa": ((1, -1, -2, 0, 0, 0, 0, 0), 1.0),
    "J": ((1, 2, -2, 0, 0, 0, 0, 0), 1.0),
    "W": ((1, 2, -3, 0, 0, 0, 0, 0), 1.0),
    "V": ((1, 2, -3, -1, 0, 0, 0, 0), 1.0),
    "Ohm": ((1, 2, -3, -2, 0, 0, 0, 0), 1.0),
    "H": ((1, 2, -2, -2, 0, 0, 0, 0), 1.0),
    "A": ((0, 0, 0, 1, 0, 0, 0, 0), 1.0),
    "rad/s": ((0, 0, -1, 0, 0, 0, 0, 1), 1.0),
    "deg": ((0, 0, 0, 0, 0, 0, 0, 1), math.pi / 180),
    "rpm": ((0, 0, -1, 0, 0, 0, 0, 1), math.pi / 30),
    "J/(kg.K)": ((0, 2, -2, 0, -1, 0, 0, 0), 1.0),
    "min": ((0, 0, 1, 0, 0, 0, 0, 0), 60.0),
    "ms": ((0, 0, 1, 0, 0, 0, 0, 0), 1e-3),
    "m.s": ((0, 1, 1, 0, 0, 0, 0, 0), 1.0),
    "Nm": ((1, 2, -2, 0, 0, 0, 0, 0), 1.0),
    "mNm": ((1, 2, -2, 0, 0, 0, 0, 0), 1e-3),
    "N·m": ((1, 2, -2, 0, 0, 0, 0, 0), 1.0),
    "N*m": ((1, 2, -2, 0, 0, 0, 0, 0), 1.0),
    "Nm/rad": ((1, 2, -2, 0, 0, 0, 0, -1), 1.0),
    "m³/s": ((0, 3, -1, 0, 0, 0, 0, 0), 1.0),
    "m·s⁻²": ((0, 1, -2, 0, 0, 0, 0, 0), 1.0),
    "W/(m²·K)": ((1, 0, -3, 0, -1, 0, 0, 0), 1.0),
    "N/(m/s)": ((1, 0, -1, 0, 0, 0, 0, 0), 1.0),
    "V/krpm": ((1, 2, -2, -1, 0, 0, 0, -1), 0.03 / math.pi),
    "m3/h": ((0, 3, -1, 0, 0, 0, 0, 0), 1 / 3600),
    "l/min": ((0, 3, -1, 0, 0, 0, 0, 0), 1e-3 / 60),
    "L/min": ((0, 3, -1, 0, 0, 0, 0, 0), 1e-3 / 60),
    "mbar": ((1, -1, -2, 0, 0, 0, 0, 0), 100.0),
    "kW": ((1, 2, -3, 0, 0, 0, 0, 0), 1e3),
    "kWh": ((1, 2, -2, 0, 0, 0, 0, 0), 3.6e6),
    "mAh": ((0, 0, 1, 1, 0, 0, 0, 0), 3.6),
    "km/h": ((0, 1, -1, 0, 0, 0, 0, 0), 1 / 3.6),
    "t": ((1, 0, 0, 0, 0, 0, 0, 0), 1e3),
    "%": ((0, 0, 0, 0, 0, 0, 0, 0), 1e-2),
    "ppm": ((0, 0, 0, 0, 0, 0, 0, 0), 1e-6),
}


@pytest.mark.parametrize("text", KNOWN)
def test_reads_units(text):
    exponents, factor = KNOWN[text]
    unit = parse_unit(text)
    assert unit.exponents == exponents
    assert unit.factor == pytest.approx(factor, rel=1e-15)
    assert unit.offset == 0.0
    assert unit.text == text


def test_temperature_has_an_offset():
    assert parse_unit("degC") == Unit("degC", (0, 0, 0, 0, 1, 0, 0, 0), 1.0, 273.15)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("Nmm", "unknown symbol 'Nmm'. Did you mean 'Nm'"),
        ("Voltt", "unknown symbol 'Voltt'. Did you mean 'V'?"),
        ("kmh", "unknown symbol 'kmh'. Did you mean 'km/h'?"),
        ("m/", "can't be read at ''"),
        ("N/(m/s", "ambiguous after '/'"),
        ("foo", "Write it as FMI does: 'm/s2'"),
        ("", "can't be read at ''"),
        ("m/s/s", "ambiguous after '/'"),
        ("N/m.s", "parentheses: 'J/(kg.K)'"),
        ("m2s", "can't be read at 'm2s'"),
        ("degC.m", "Use 'K' for differences"),
    ],
)
def test_refuses_what_it_cant_read(text, part):
    with pytest.raises(UnitError) as error:
        parse_unit(text)
    assert part in str(error.value)
    assert repr(text) in str(error.value)


def test_same_unit():
    assert same_unit("N.m", "J")
    assert same_unit("N s/m", "kg/s")
    assert not same_unit("mm", "m")
    assert not same_unit("degC", "K")
    assert not same_unit("rad/s", "Hz")


def test_describes_a_mismatch():
    assert describe_mismatch("mm", "m") == "mm and m differ by a factor of 0.001: put Gain(gain=0.001) between"
    assert "Gain(gain=57.2957795131)" in describe_mismatch("rad", "deg")
    assert describe_mismatch("N", "m") == (
        "N (kg.m.s-2) and m (m) are of different dimensions: check which ports are meant"
    )
    assert describe_mismatch("degC", "K") == (
        "degC and K differ by an offset of 273.15: put UnitConversion(from_unit='degC', to_unit='K') between"
    )
    assert describe_mismatch("N.m", "J") == "N.m and J are the same"


@pytest.mark.parametrize("text", [*KNOWN, "degC"])
def test_rate_is_a_unit_per_second(text):
    unit, rate = parse_unit(text), parse_unit(rate_of(text))
    assert rate.exponents == tuple(n - (i == 2) for i, n in enumerate(unit.exponents))
    assert rate.factor == pytest.approx(unit.factor, rel=1e-15)
    assert rate.offset == 0.0


def test_rate_reads_well():
    assert [rate_of(u) for u in ("m", "m/s", "m/s2", "1", "N.s/m")] == ["m/s", "m/s2", "m/s3", "1/s", "N.s/(m.s)"]


@pytest.mark.parametrize(
    ("factors", "text"),
    [
        ((("N/(m/s)", 1), ("m/s", 1)), "N"),
        ((("m³/s", 1), ("s", 1)), "m3"),
        ((("Nm", 1), ("rad/s", 1)), "Nm.rad/s"),
        ((("kg.m2", 1), ("s", -3), ("A", -1)), "kg.m2/(s3.A)"),
        ((("m", 1), ("m", -1)), "1"),
        ((("s", -1),), "1/s"),
    ],
)
def test_products_of_units_are_written_as_fmi_does(factors, text):
    made = combine_units(*factors)
    assert made == text
    want = [sum(parse_unit(u).exponents[i] * n for u, n in factors) for i in range(8)]
    assert list(parse_unit(text).exponents) == want
    assert math.isclose(parse_unit(made).factor, math.prod(parse_unit(u).factor ** n for u, n in factors))


def test_units_that_have_no_product_or_root():
    assert combine_units(("degC", 1), ("W", 1)) is None
    assert root_unit("m.s2", 2) is None
    assert rate_of("N/(m/s)") == "N/m"


@pytest.mark.parametrize(
    ("terms", "text", "offset", "relative"),
    [
        ([("degC", 1), ("degC", -1)], "K", 0.0, True),
        ([("degC", -1), ("degC", 1)], "K", 0.0, True),
        ([("degC", 1), (difference_unit("degC"), -1)], "degC", 273.15, False),
        ([("degC", 1), ("degC", -1), ("degC", 1)], "degC", 273.15, False),
        ([(None, 1), ("degC", 1)], "degC", 273.15, False),
        ([("degC", 1), (None, -1)], "degC", 273.15, None),
        ([("degC", 1), ("degC", 1)], "degC", 273.15, None),
        ([("degC", -1)], "degC", 273.15, None),
        ([("m", 1), ("m", -1)], "m", 0.0, False),
        ([("m", 1), (None, -1)], "m", 0.0, False),
    ],
)
def test_a_sum_of_temperatures(terms, text, offset, relative):
    unit = parse_unit(sum_unit(*terms))
    assert (unit.text, unit.offset, unit.relative) == (text, offset, relative)


def test_one_of_several_numbers_is_a_difference_only_if_all_are():
    difference = difference_unit("degC")
    found = [
        parse_unit(common_unit(*units)).relative
        for units in (("degC", "degC"), (difference,) * 2, ("degC", difference))
    ]
    assert found == [False, True, None]
    assert sum_unit((None, 1), ("degC", -1)) is None
    assert convert_unit("degC", difference) == (1.0, 0.0)
    assert combine_units((difference, 1), ("W/K", 1)) == "W"
    with pytest.raises(UnitError, match="may be either"):
        convert_unit(sum_unit(("degC", 1), ("degC", 1)), "K")


def test_power_with_an_angle_is_power_without_one():
    assert same_unit(combine_units(("N.m", 1), ("rad/s", 1)), "W")
    assert not same_unit(combine_units(("N.m", 1), ("rpm", 1)), "W")
    assert not same_unit(combine_units(("N.m", 1), ("1/s", 1)), "W.rad")


def test_powers_conversions_and_print():
    powers = ("m", 2), ("m2", 1.5), ("s", -1), ("m", 0.3)
    assert [raise_unit(*power) for power in powers] == ["m2", "m3", "1/s", None]
    assert [root_unit("m2/s2", 2), root_unit("m", 2), combine_units(("m", 1), ("mm", -1))] == ["m/s", None, "m/mm"]
    assert convert_unit("°C", "K") == (1.0, 273.15)
    assert describe_mismatch("mm", "m") == "mm and m differ by a factor of 0.001: put Gain(gain=0.001) between"
    assert [*map(print_unit, ("N.s/m", "m/s2", "deg", "degC", "1"))] == ["N·s/m", "m/s²", "°", "°C", ""]
    assert [with_unit("t", "s"), with_unit("|S|", "1")] == ["t [s]", "|S|"]
