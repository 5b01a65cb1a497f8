"""Expectations: what can be written, and how intervals decide."""

from types import MappingProxyType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis import expectations, judgements, wording
from fieldkit.analysis.cells import Cell, Estimate
from fieldkit.analysis.judgements import Ruling
from fieldkit.analysis.quantities import Quantity
from fieldkit.core.columns import Kind
from fieldkit.core.errors import ConfigurationError

LOSS = Quantity("up.file_loss", "up: file bytes lost", Kind.MEAN, "share")
RTT = Quantity("rtt_median_s", "RTT", Kind.MEDIAN, "s")
SIGNAL = Quantity("signal_dbm", "signal", Kind.MEDIAN, "dBm")
KNOWN = (LOSS, RTT, SIGNAL)


def estimate(quantity: Quantity, value: float, low: float | None, high: float | None) -> Estimate:
    return Estimate(
        quantity=quantity, n=5, value=value, low=low, high=high, assured=None, p_order=None, wilson_low=None,
        wilson_high=None, events=None, trials=None, mean=value, median=value, p95=value, minimum=value, maximum=value,
    )  # fmt: skip


def cell(protocol: str, *found: Estimate) -> Cell:
    return Cell({"protocol": protocol}, 5, 0, 0, MappingProxyType({one.quantity.name: one for one in found}))


@pytest.mark.parametrize(
    ("text", "name", "is_below", "bound", "protocol"),
    [
        ("up.file_loss < 2 %", "up.file_loss", True, 0.02, None),
        ("udp rtt_median_s<5ms", "rtt_median_s", True, 0.005, "udp"),
        (" tcp  rtt_median_s > 1us ", "rtt_median_s", False, 1e-6, "tcp"),
        ("signal_dbm > -70 dBm", "signal_dbm", False, -70.0, None),
    ],
)
def test_what_can_be_demanded(text: str, name: str, is_below: bool, bound: float, protocol: str | None) -> None:
    found = expectations.parse(text, KNOWN)
    assert (found.quantity, found.is_below, found.protocol) == (name, is_below, protocol)
    assert found.bound == pytest.approx(bound)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no expectation"),
        ("up.file_loss", "is no expectation"),
        ("up.file_loss = 2 %", "is no expectation"),
        ("up.file_loss <= 2 %", "is no expectation"),
        ("up.file_loss < 2 % < 3 %", "is no expectation"),
        ("icmp up.file_loss < 2 %", "is no expectation"),
        ("file_loss < 2 %", "there is no figure 'file_loss'"),
        ("up.file_loss < 2", "has no unit"),
        ("up.file_loss < 2 ms", "unknown unit 'ms'"),
        ("rtt_median_s < fast", "is not a bound for rtt_median_s"),
    ],
)
def test_what_cannot_is_refused_with_a_remedy(text: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said) as caught:
        expectations.parse(text, KNOWN)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("low", "high", "below", "above"),
    [
        (0.000, 0.019, Ruling.HOLDS, Ruling.FAILS),
        (0.021, 0.030, Ruling.FAILS, Ruling.HOLDS),
        (0.019, 0.021, Ruling.OPEN, Ruling.OPEN),
        (0.020, 0.020, Ruling.FAILS, Ruling.FAILS),
        (None, None, Ruling.OPEN, Ruling.OPEN),
    ],
)
def test_the_whole_interval_decides(low: float | None, high: float | None, below: Ruling, above: Ruling) -> None:
    demanded = [expectations.parse(f"up.file_loss {sign} 2 %", KNOWN) for sign in "<>"]
    found = judgements.judge(demanded, [cell("tcp", estimate(LOSS, 0.01, low, high))])
    assert [one.ruling for one in found] == [below, above]


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 1))
def test_nothing_both_holds_and_fails(one: float, other: float, bound: float) -> None:
    low, high = sorted((one, other))
    demanded = [expectations.parse(f"signal_dbm {sign} {bound:.6f} dBm", KNOWN) for sign in "<>"]
    cells = [cell("tcp", estimate(SIGNAL, low, low, high))]
    below, above = (one.ruling for one in judgements.judge(demanded, cells))
    assert not (below is Ruling.HOLDS and above is Ruling.HOLDS)
    assert (below is Ruling.HOLDS) == (high < float(f"{bound:.6f}"))
    assert (above is Ruling.HOLDS) == (low > float(f"{bound:.6f}"))


def test_a_protocol_alone_is_judged_and_what_is_not_there_cannot_be_told() -> None:
    cells = [cell("tcp", estimate(RTT, 0.002, 0.001, 0.003)), cell("udp")]
    (alone,) = judgements.judge([expectations.parse("tcp rtt_median_s < 5 ms", KNOWN)], cells)
    assert alone.holds
    both = judgements.judge([expectations.parse("rtt_median_s < 5 ms", KNOWN)], cells)
    assert [one.ruling for one in both] == [Ruling.HOLDS, Ruling.OPEN]
    assert [wording.judged(one)[1:] for one in both] == [
        ("TCP", "2.00 ms", "[1.00, 3.00]", "holds"),
        ("UDP", "nothing", "", "cannot be told"),
    ]
    (nobody,) = judgements.judge([expectations.parse("udp rtt_median_s < 5 ms", KNOWN)], cells[:1])
    assert nobody.ruling is Ruling.OPEN
