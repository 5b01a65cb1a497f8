"""Repeats and packets that expectations require, compared with judgements of trials with perfect results."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.analysis import expectations, judgements, sample_size
from fieldkit.analysis.judgements import Ruling
from fieldkit.analysis.quantities import Quantity
from fieldkit.core.columns import Kind
from tests.analysis.test_expectations import PACKETS, losses

GAP = Quantity("rtt_gap_s", "longest gap", Kind.MEDIAN, "s")
RECOVERED = Quantity("link_down_recovered", "back after link-down", Kind.FLAG, "share")
RATE = Quantity("goodput_bit_s", "goodput", Kind.MEDIAN, "bit/s")
RETRIES = Quantity("retries", "retries", Kind.MEAN, "count")
QUANTITIES = (PACKETS, GAP, RECOVERED, RATE, RETRIES)


def warning(text: str, repeats: int) -> str:
    return " ".join(sample_size.unmet_requirements([expectations.parse(text, QUANTITIES)], QUANTITIES, repeats))


@pytest.mark.parametrize(
    ("text", "repeats", "message"),
    [
        (
            "90 % of rtt_gap_s < 300 ms",
            20,
            "needs at least 29 repeats for 95 % confidence, if all meet it; this trial has 20",
        ),
        ("90 % of rtt_gap_s < 300 ms", 29, ""),
        (
            "max rtt_gap_s < 300 ms",
            20,
            (
                "applies only to the repeats of this trial; to show with 95 % confidence that at least 90 % of all "
                "repeats meet it, at least 29 repeats are needed; with 20, it can be shown only for 86 %"
            ),
        ),
        ("max rtt_gap_s < 300 ms", 29, ""),
        (
            "ip_loss < 2 %",
            20,
            (
                "needs at least 189 repeats for 95 % confidence, even if nothing is lost; this trial has 20; to "
                "check only the packets of this trial, write: ip_loss < 2 % of all packets"
            ),
        ),
        (
            "ip_loss < 2 % of all packets",
            20,
            "needs at least 1498 packets per condition for 95 % confidence, even if no packet is lost",
        ),
        (
            "link_down_recovered > 90 %",
            20,
            "needs at least 35 repeats for 95 % confidence, if it is true in all of them; this trial has 20",
        ),
        ("rtt_gap_s < 300 ms", 6, ""),
        (
            "rtt_gap_s < 300 ms",
            5,
            (
                "needs at least 6 repeats for 95 % confidence for any distribution of the repeats; this "
                "trial has 5"
            ),
        ),
        (
            "goodput_bit_s > 1 Mbit/s",
            1,
            "needs at least 2 repeats, because fewer give no interval; this trial has 1",
        ),
        ("retries < 3", 2, ""),
    ],
)  # fmt: skip
def test_unmet_requirements_of_an_expectation_are_reported_before_a_trial(
    text: str, repeats: int, message: str
) -> None:
    assert warning(text, repeats) == (message and f"expected {text}: {message}")


@given(st.integers(1, 60), st.integers(1, 60))
@example(5, 1)  # the bound equals the share except for rounding
def test_an_expectation_holds_in_a_perfect_trial_unless_there_is_a_warning(percent: int, repeats: int) -> None:
    for text in (f"ip_loss < {percent} %", f"{percent} % of ip_loss < 1 %"):
        (judgement,) = judgements.judge([expectations.parse(text, QUANTITIES)], [losses(*[0] * repeats)])
        assert (judgement.ruling is Ruling.HOLDS) is (warning(text, repeats) == "")
