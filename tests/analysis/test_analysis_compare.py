"""Comparison of two runs: pairing of conditions, differences, and concerns about comparability."""

import dataclasses
import random
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.analysis import comparison_results
from fieldkit.analysis.compare import Comparison, Difference, compare
from tests.helpers.tables import COMPARABLE, RepeatRow, bursty, parsed, replace

UDP = bursty(COMPARABLE, 20, seed=1)


def compared(a: Sequence[RepeatRow], b: Sequence[RepeatRow], **options: Any) -> Comparison:  # noqa: ANN401 (as compare)
    """Compare the rows of two trials."""
    return compare(
        parsed(moved(a, trial="one")),
        parsed(moved(b, trial="another")),
        **options,
    )


def only(comparison: Comparison, quantity: str) -> Difference:
    (result,) = (difference for difference in comparison.differences if difference.quantity.name == quantity)
    return result


def moved(rows: Sequence[RepeatRow], **changes: Any) -> list[RepeatRow]:  # noqa: ANN401 (as replace)
    return [replace(row, **changes) for row in rows]


def test_a_run_compared_with_itself_has_no_difference() -> None:
    result = compared(UDP, UDP)
    assert result.concerns == ()
    assert {difference.value for difference in result.differences} == {0.0}
    assert {difference.cliffs_delta for difference in result.differences} == {0.0}
    assert {difference.p_holm for difference in result.differences} == {1.0}
    assert not any(difference.excludes_zero for difference in result.differences)


def test_a_known_shift_is_detected() -> None:
    slower = [replace(row, rtt_median_s=(row.rtt_median_s or 0) + 0.005) for row in UDP]
    difference = only(compared(UDP, slower), "rtt_median_s")
    assert difference.interval is not None
    assert difference.value == pytest.approx(0.005)
    assert difference.interval.low < 0.005 < difference.interval.high
    assert difference.excludes_zero
    assert difference.cliffs_delta is not None
    assert difference.cliffs_delta > 0.5


def test_a_share_without_its_counts_is_not_in_the_effect_size() -> None:
    rows = bursty(COMPARABLE, 10, seed=1)
    lost = replace(rows[0], repeat=11, ip_packets_sent=None, ip_packets_received=None, ip_loss=1.0)
    result = only(compared(rows, [*rows, lost]), "ip_loss")
    assert (result.b and result.b.n, result.value, result.cliffs_delta) == (10, 0.0, 0.0)


def test_a_condition_of_only_one_run_is_kept() -> None:
    farther, tcp = moved(UDP, distance="55ft", distance_m=16.764), moved(UDP, protocol="tcp")
    result = compared([*UDP, *farther], [*tcp, *UDP])
    assert [(pair.name, pair.missing_in) for pair in result.pairs] == [
        ("los, master, 9.144 m, udp", ""),
        ("los, master, 16.764 m, udp", "B"),
        ("los, master, 9.144 m, tcp", "A"),
    ]
    assert all(difference.value is None for pair in result.pairs[1:] for difference in pair.differences)


def test_a_quantity_of_only_one_run_is_kept() -> None:
    difference = only(compared(UDP, moved(UDP, transfer_s=None)), "transfer_s")
    assert (difference.b, difference.value, difference.interval, difference.cliffs_delta, difference.p_holm) == (
        None,
        None,
        None,
        None,
        None,
    )


def test_a_condition_without_valid_repeats_is_kept() -> None:
    result = compared(UDP, moved(UDP, status="void"))
    assert [pair.missing_in for pair in result.pairs] == [""]
    assert all(difference.b is None for difference in result.differences)
    assert result.refusals == ()


def test_void_repeats_change_nothing() -> None:
    void = moved(UDP, status="void", rtt_median_s=9.0, sent_bytes=1)
    result = compared(UDP, [*UDP, *void])
    assert result.concerns == ()
    assert [dataclasses.replace(difference, b=None) for difference in result.differences] == [
        dataclasses.replace(difference, b=None) for difference in compared(UDP, UDP).differences
    ]


def test_a_single_repeat_has_a_difference_and_no_interval() -> None:
    difference = only(compared(UDP, UDP[:1]), "transfer_s")
    assert difference.value is not None
    assert (difference.interval, difference.p_holm) == (None, None)


@pytest.mark.parametrize(
    ("limit_s", "repeats", "within"),
    [(0.1, 20, True), (1e-6, 20, False), (0.1, 1, False)],
    ids=["wide", "narrow", "no interval"],
)
def test_the_whole_interval_must_be_within_a_threshold(limit_s: float, repeats: int, *, within: bool) -> None:
    result = compared(UDP, UDP[:repeats], thresholds={"rtt_median_s": limit_s})
    assert only(result, "rtt_median_s").within is within
    assert result.exceeds_threshold is not within


def test_a_point_within_a_threshold_is_not_enough() -> None:
    difference = only(compared(UDP, UDP), "rtt_median_s")
    assert difference.interval is not None
    assert compared(UDP, UDP, thresholds={"rtt_median_s": 0.99 * difference.interval.high}).exceeds_threshold
    assert not compared(UDP, UDP, thresholds={"rtt_median_s": 1.01 * difference.interval.high}).exceeds_threshold


def test_a_condition_of_only_one_run_is_not_within_the_threshold() -> None:
    farther = moved(UDP, distance="55ft", distance_m=16.764)
    assert compared([*UDP, *farther], UDP, thresholds={"rtt_median_s": 1.0}).exceeds_threshold
    assert compared(UDP, [*UDP, *farther], thresholds={"rtt_median_s": 1.0}).exceeds_threshold
    without = moved(farther, rtt_median_s=None)
    assert not compared([*UDP, *without], UDP, thresholds={"rtt_median_s": 1.0}).exceeds_threshold


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"profiles_sha256": "ffff"}, "profiles_sha256: A has aaaa, B has ffff (los, master, 9.144 m, udp)"),
        ({"procedure_sha256": "ffff"}, "procedure_sha256: A has bbbb, B has ffff (los, master, 9.144 m, udp)"),
        ({"procedure_sha256": None}, "procedure_sha256: A has bbbb, B has unknown (los, master, 9.144 m, udp)"),
        ({"rtt_payload_bytes": 56}, "rtt_payload_bytes: A has 8192, B has 56 (los, master, 9.144 m, udp)"),
        ({"paper_window_bytes": 502}, "paper_window_bytes: A has 8192, B has 502 (los, master, 9.144 m, udp)"),
        (
            {"sent_bytes": 293_797, "datagrams_sent": 36},
            "sent_bytes, median: A has 230,695 B, B has 293,797 B (los, master, 9.144 m, udp)",
        ),
        (
            {"datagrams_sent": 15},
            "bytes per datagram: A has 7,955 B, B has 15,380 B (los, master, 9.144 m, udp)",
        ),
    ],
)
def test_incomparable_runs_have_a_reason(changes: dict[str, Any], message: str) -> None:
    result = compared(UDP, moved(UDP, **changes))
    assert [str(concern) for concern in result.refusals] == [message]


def test_runs_with_different_congestion_controls_are_not_comparable() -> None:
    cubic, bbr = (moved(UDP, tcp_congestion_control=name) for name in ("cubic", "bbr"))
    (refusal,) = compared(cubic, bbr).refusals
    assert str(refusal) == "tcp_congestion_control: A has cubic, B has bbr (los, master, 9.144 m, udp)"
    assert not compared(cubic, UDP).refusals, "of trials of an earlier version it is unknown"
    simulated = compared(cubic, moved(bbr, backend="cosim"))
    assert not simulated.refusals, "a simulation has its own TCP"
    assert str(refusal) in map(str, simulated.concerns)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"code_sha256": "ffff"}, "code_sha256: A has cccc, B has ffff"),
        ({"sent_bytes": 235_000}, None),
        ({"sent_bytes": None}, "sent_bytes, median: A has 230,695 B, B has unknown (los, master, 9.144 m, udp)"),
        ({"rtt_payload_bytes": None}, "rtt_payload_bytes: A has 8192, B has unknown (los, master, 9.144 m, udp)"),
    ],
)
def test_a_possible_difference_is_only_a_note(changes: dict[str, Any], message: str | None) -> None:
    result = compared(UDP, moved(UDP, **changes))
    assert result.refusals == ()
    assert [str(concern) for concern in result.concerns][:1] == ([message] if message else [])


def test_attempts_in_both_runs_are_reported() -> None:
    (concern,) = compare(parsed(UDP), parsed(UDP[:7])).concerns
    assert str(concern) == "attempts that are in both runs: A has 7, B has 7"
    assert not concern.refuses


@pytest.mark.parametrize(
    ("frames", "message", "refused"),
    [
        (0, [], False),
        (7, ["segmentation offload: A has off, B has on (los, master, 9.144 m, udp)"], True),
        (None, ["segmentation offload: A has off, B has unknown (los, master, 9.144 m, udp)"], False),
    ],
)
def test_offload_in_one_of_two_runs_is_refused(frames: int | None, message: list[str], *, refused: bool) -> None:
    without = moved(UDP, tcp_superframes=0)
    result = compared(
        without, [*moved(UDP[:1], tcp_superframes=frames), *moved(UDP[1:], tcp_superframes=frames and 0)]
    )
    assert [str(concern) for concern in result.concerns] == message
    assert bool(result.refusals) is refused


@pytest.mark.parametrize(("messages", "comparable"), [(5, True), (8, False)])
def test_a_short_recording_may_be_some_messages_longer(messages: int, *, comparable: bool) -> None:
    short = moved(UDP, sent_bytes=19_560, bag_messages=4, datagrams_sent=3)
    longer = moved(short, sent_bytes=19_560 + 1_500 * (messages - 4) + 10_000 * (messages > 5), bag_messages=messages)
    assert (not compared(short, longer).refusals) is comparable


def test_runs_without_hashes_are_refused() -> None:
    old = moved(UDP, profiles_sha256=None, procedure_sha256=None)
    assert [concern.what for concern in compared(old, old).refusals] == ["profiles_sha256", "procedure_sha256"]


def test_cells_with_different_mixtures_are_refused() -> None:
    behind = moved(UDP, scenario="nlos")
    (refusal,) = compared([*UDP, *behind], UDP, by=("protocol",)).refusals
    assert str(refusal) == "scenario: A has los, nlos, B has los (udp)"


def test_the_same_concern_of_many_conditions_is_reported_once() -> None:
    rows = [*UDP, *moved(UDP, protocol="tcp"), *moved(UDP, scenario="nlos")]
    (refusal,) = compared(rows, moved(rows, procedure_sha256="ffff")).refusals
    assert str(refusal).endswith("(los, master, 9.144 m, udp and 2 more)")


@given(st.integers(0, 50), st.integers(2, 12), st.integers(2, 12))
def test_swapping_the_runs_changes_all_signs(seed: int, n: int, m: int) -> None:
    a, b = bursty(COMPARABLE, n, seed=seed), bursty(COMPARABLE, m, seed=seed + 1)
    forward, reverse = (
        compared(*runs, thresholds={"ip_loss": 0.1, "rtt_median_s": 0.002}) for runs in ((a, b), (b, a))
    )
    assert forward.exceeds_threshold == reverse.exceeds_threshold
    for difference, other in zip(forward.differences, reverse.differences, strict=True):
        assert difference.value == -(other.value or 0)
        assert difference.cliffs_delta == -(other.cliffs_delta or 0)
        assert difference.p_holm == other.p_holm
        if difference.interval is not None and other.interval is not None:
            assert (difference.interval.low, difference.interval.high) == (-other.interval.high, -other.interval.low)


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_rows_changes_nothing(seed: int) -> None:
    a, b = list(UDP), bursty(COMPARABLE, 15, seed=2)
    before = comparison_results.to_csv(compared(a, b))
    for rows in (a, b):
        random.Random(seed).shuffle(rows)
    assert comparison_results.to_csv(compared(a, b)) == before
