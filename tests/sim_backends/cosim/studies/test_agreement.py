"""The rule by which a printed number agrees with a measured one: cases by hand, and any rounding."""

import math
from decimal import ROUND_HALF_UP, Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.studies.agreement import Agreement, Printed, agreement
from sim_backends.cosim.studies.intervals import IntervalEstimate

NAN = math.nan


@pytest.mark.parametrize(
    ("printed", "ours", "expected"),
    [
        # The mean rounds to the printed number, with any interval.
        (Printed("0.4"), IntervalEstimate(0.36, 0.355, 0.365), Agreement.AGREES),
        (Printed("0.4"), IntervalEstimate(0.36, NAN, NAN), Agreement.AGREES),
        # The interval contains the printed number, although the mean rounds to another one.
        (Printed("0.4"), IntervalEstimate(0.9, 0.44, 1.36), Agreement.AGREES),
        (Printed("0.4"), IntervalEstimate(0.9, 0.46, 1.34), Agreement.ABOVE),
        (Printed("0.4"), IntervalEstimate(0.3, 0.25, 0.34), Agreement.BELOW),
        (Printed("0.40"), IntervalEstimate(0.36, 0.355, 0.365), Agreement.BELOW),
        # An interval within the numbers that round to the printed one, and one around them.
        (Printed("10", step="10"), IntervalEstimate(7.0, 6.9, 7.1), Agreement.AGREES),
        (Printed("10"), IntervalEstimate(7.0, 6.9, 7.1), Agreement.BELOW),
        (Printed("10"), IntervalEstimate(30.0, -20.0, 80.0), Agreement.AGREES),
        # In percent, and in milliseconds.
        (Printed("10", per_si=100, step="10"), IntervalEstimate(0.16, 0.151, 0.169), Agreement.ABOVE),
        (Printed("5.377", per_si=1000), IntervalEstimate(0.0053774, NAN, NAN), Agreement.AGREES),
        (Printed("5.377", per_si=1000), IntervalEstimate(0.0053776, NAN, NAN), Agreement.ABOVE),
        (Printed("-12", per_si=100), IntervalEstimate(-0.20, -0.25, -0.15), Agreement.BELOW),
        (Printed("0.4"), IntervalEstimate(NAN, NAN, NAN), Agreement.NOTHING),
    ],
)
def test_cases_by_hand(printed: Printed, ours: IntervalEstimate, expected: Agreement) -> None:
    assert agreement(printed, ours) is expected


@given(
    st.decimals(-1000, 1000, places=6),
    st.integers(0, 4),
    st.sampled_from([1, 100, 1000]),
)
def test_a_rounded_number_agrees_with_its_original(value: Decimal, places: int, per_si: int) -> None:
    text = str(value.quantize(Decimal(1).scaleb(-places), ROUND_HALF_UP))
    ours = float(value / per_si)
    assert agreement(Printed(text, per_si), IntervalEstimate(ours, NAN, NAN)) is Agreement.AGREES


@given(
    st.decimals(-1000, 1000, places=3),
    st.sampled_from(["0.1", "1", "10"]),
    st.floats(0.5001, 100),
    st.booleans(),
)
def test_a_number_more_than_half_a_step_away_disagrees(number: Decimal, step: str, away: float, above: bool) -> None:
    printed = Printed(str(number), step=step)
    ours = printed.value + away * float(step) * (1 if above else -1)
    expected = Agreement.ABOVE if above else Agreement.BELOW
    assert agreement(printed, IntervalEstimate(ours, NAN, NAN)) is expected
    ends = printed.value, ours
    assert agreement(printed, IntervalEstimate(ours, min(ends), max(ends))) is Agreement.AGREES
