import math
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from fieldkit.core.units import (
    FRACTION_PER_UNIT,
    format_bytes,
    format_distance,
    format_duration,
    parse_distance,
    parse_duration_s,
    parse_offset_m,
    parse_quantity,
    plain_number,
)


@pytest.mark.parametrize(
    ("text", "metres", "label"),
    [("30ft", 9.144, "30ft"), ("9.1m", 9.1, "9.1m"), ("30 ft", 9.144, "30ft"), (".5km", 500.0, ".5km")],
)
def test_distances_are_converted_to_metres_and_keep_their_label(text: str, metres: float, label: str) -> None:
    distance = parse_distance(text)
    assert math.isclose(distance.metres, metres)
    assert distance.label == label


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("30", "no unit"),
        ("30feet", "unknown unit 'feet'"),
        ("thirty", "not a distance"),
        ("-3m", "below zero"),
        ("0m", "not above zero"),
        ("", "not a distance"),
        ("nanm", "not a distance"),
        ("3m\n", ""),
    ],
)
def test_an_error_in_a_distance_has_a_remedy(text: str, message: str) -> None:
    if not message:
        assert parse_distance(text).label == "3m"
        return
    with pytest.raises(ConfigurationError, match=message) as error_info:
        parse_distance(text)
    assert error_info.value.exit_code == 2
    assert error_info.value.remedy


@given(st.floats(min_value=0.001, max_value=1e6))
def test_durations_scale_with_their_unit(value: float) -> None:
    text = f"{value:.6f}"
    assert math.isclose(parse_duration_s(f"{text}s"), 1000 * parse_duration_s(f"{text}ms"), rel_tol=1e-12)


@given(st.decimals(min_value=0, max_value=10**9, places=6), st.sampled_from([("s", 0), ("ms", 3), ("us", 6)]))
def test_a_duration_is_the_nearest_float_to_its_decimal_text(number: Decimal, unit: tuple[str, int]) -> None:
    symbol, places = unit
    assert parse_duration_s(f"{number:f}{symbol}") == float(f"{number:f}e-{places}")


@given(st.text(max_size=12))
def test_the_distance_parser_raises_only_configuration_errors(text: str) -> None:
    try:
        distance = parse_distance(text)
    except ConfigurationError:
        return
    assert distance.metres > 0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.42, "0.4 s"), (9.96, "10 s"), (59.6, "1 min 00 s"), (185, "3 min 05 s"), (3725, "1 h 02 min")],
)
def test_durations_are_formatted_for_people(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text


@pytest.mark.parametrize(
    ("label", "text"),
    [("40ft", "40 ft (12.19 m)"), ("9.1m", "9.1 m"), (".5 km", ".5 km (500.00 m)"), ("80cm", "80 cm (0.80 m)")],
)
def test_a_distance_is_formatted_in_the_unit_of_the_operator(label: str, text: str) -> None:
    assert format_distance(parse_distance(label)) == text


@pytest.mark.parametrize(
    ("size_bytes", "text"), [(200, "0.2 kB"), (35e6, "35 MB"), (1.24e9, "1.2 GB"), (5e12, "5000 GB")]
)
def test_sizes_are_formatted_for_people(size_bytes: float, text: str) -> None:
    assert format_bytes(size_bytes) == text


def test_a_length_may_be_in_millimetres() -> None:
    assert parse_distance("5mm").metres == pytest.approx(0.005)
    assert parse_offset_m("-30 mm") == pytest.approx(-0.03)


@given(st.floats(1e-15, 9e14))
def test_a_plain_number_is_a_number_of_a_quantity(value: float) -> None:
    metres = parse_quantity(f"{plain_number(value)}m", {"m": 1.0}, "length") if value < 1e11 else value
    assert metres == pytest.approx(value, rel=1e-11)
    assert "e" not in plain_number(value, 3)


def test_the_example_of_a_tiny_share_is_a_share() -> None:
    with pytest.raises(ConfigurationError) as error:
        parse_quantity("0.0000001", FRACTION_PER_UNIT, "share")
    assert "write for example 0.00001%" in error.value.remedy
