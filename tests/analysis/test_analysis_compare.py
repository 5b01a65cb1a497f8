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


def compare_rows(a: Sequence[RepeatRow], b: Sequence[RepeatRow], **options: Any) -> Comparison:  # noqa: ANN401 (as compare)
    """Compare the rows of two trials."""
    return compare(
        parsed(with_changes(a, trial="one")),
        parsed(with_changes(b, trial="another")),
        **options,
    )


def difference_of(comparison: Comparison, quantity: str) -> Difference:
    (result,) = (difference for difference in comparison.differences if difference.quantity.name == quantity)
    return result


def with_changes(rows: Sequence[RepeatRow], **changes: Any) -> list[RepeatRow]:  # noqa: ANN401 (as replace)
    return [replace(row, **changes) for row in rows]


def test_a_run_compared_with_itself_has_no_difference() -> None:
    result = compare_rows(UDP, UDP)
    assert result.concerns == ()
    assert {difference.value for difference in result.differences} == {0.0}
    assert {difference.cliffs_delta for difference in result.differences} == {0.0}
    assert {difference.p_holm for difference in result.differences} == {1.0}
    assert not any(difference.excludes_zero for difference in result.differences)


def test_a_known_shift_is_detected() -> None:
    slower = [replace(row, rtt_median_s=(row.rtt_median_s or 0) + 0.005) for row in UDP]
    difference = difference_of(compare_rows(UDP, slower), "rtt_median_s")
    assert difference.interval is not None
    assert difference.value == pytest.approx(0.005)
    assert difference.interval.low < 0.005 < difference.interval.high
    assert difference.excludes_zero
    assert difference.cliffs_delta is not None
    assert difference.cliffs_delta > 0.5


def test_a_share_without_its_counts_is_not_in_the_effect_size() -> None:
    rows = bursty(COMPARABLE, 10, seed=1)
    lost_row = replace(rows[0], repeat=11, ip_packets_sent=None, ip_packets_received=None, ip_loss=1.0)
    result = difference_of(compare_rows(rows, [*rows, lost_row]), "ip_loss")
    assert (result.b and result.b.n, result.value, result.cliffs_delta) == (10, 0.0, 0.0)


def test_a_condition_of_only_one_run_is_kept() -> None:
    farther, tcp = with_changes(UDP, distance="55ft", distance_m=16.764), with_changes(UDP, protocol="tcp")
    result = compare_rows([*UDP, *farther], [*tcp, *UDP])
    assert [(pair.name, pair.missing_in) for pair in result.pairs] == [
        ("los, master, 9.144 m, udp", ""),
        ("los, master, 16.764 m, udp", "B"),
        ("los, master, 9.144 m, tcp", "A"),
    ]
    assert all(difference.value is None for pair in result.pairs[1:] for difference in pair.differences)


def test_a_quantity_of_only_one_run_is_kept() -> None:
    difference = difference_of(compare_rows(UDP, with_changes(UDP, transfer_s=None)), "transfer_s")
    assert (difference.b, difference.value, difference.interval, difference.cliffs_delta, difference.p_holm) == (
        None,
        None,
        None,
        None,
        None,
    )


def test_a_condition_without_valid_repeats_is_kept() -> None:
    result = compare_rows(UDP, with_changes(UDP, status="void"))
    assert [pair.missing_in for pair in result.pairs] == [""]
    assert all(difference.b is None for difference in result.differences)
    assert result.refusals == ()


def test_void_repeats_do_not_change_a_comparison() -> None:
    void = with_changes(UDP, status="void", rtt_median_s=9.0, sent_bytes=1)
    result = compare_rows(UDP, [*UDP, *void])
    assert result.concerns == ()
    assert [dataclasses.replace(difference, b=None) for difference in result.differences] == [
        dataclasses.replace(difference, b=None) for difference in compare_rows(UDP, UDP).differences
    ]


def test_a_single_repeat_has_a_difference_and_no_interval() -> None:
    difference = difference_of(compare_rows(UDP, UDP[:1]), "transfer_s")
    assert difference.value is not None
    assert (difference.interval, difference.p_holm) == (None, None)


@pytest.mark.parametrize(
    ("limit_s", "repeats", "is_within"),
    [(0.1, 20, True), (1e-6, 20, False), (0.1, 1, False)],
    ids=["wide", "narrow", "no interval"],
)
def test_the_whole_interval_must_be_within_a_threshold(limit_s: float, repeats: int, *, is_within: bool) -> None:
    result = compare_rows(UDP, UDP[:repeats], thresholds={"rtt_median_s": limit_s})
    assert difference_of(result, "rtt_median_s").within is is_within
    assert result.exceeds_threshold is not is_within


def test_a_point_within_a_threshold_is_not_enough() -> None:
    difference = difference_of(compare_rows(UDP, UDP), "rtt_median_s")
    assert difference.interval is not None
    assert compare_rows(UDP, UDP, thresholds={"rtt_median_s": 0.99 * difference.interval.high}).exceeds_threshold
    assert not compare_rows(UDP, UDP, thresholds={"rtt_median_s": 1.01 * difference.interval.high}).exceeds_threshold


def test_a_condition_of_only_one_run_is_not_within_the_threshold() -> None:
    farther = with_changes(UDP, distance="55ft", distance_m=16.764)
    assert compare_rows([*UDP, *farther], UDP, thresholds={"rtt_median_s": 1.0}).exceeds_threshold
    assert compare_rows(UDP, [*UDP, *farther], thresholds={"rtt_median_s": 1.0}).exceeds_threshold
    without_rtt = with_changes(farther, rtt_median_s=None)
    assert not compare_rows([*UDP, *without_rtt], UDP, thresholds={"rtt_median_s": 1.0}).exceeds_threshold


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
    result = compare_rows(UDP, with_changes(UDP, **changes))
    assert [str(concern) for concern in result.refusals] == [message]


def test_runs_with_different_congestion_controls_are_not_comparable() -> None:
    cubic, bbr = (with_changes(UDP, tcp_congestion_control=name) for name in ("cubic", "bbr"))
    (refusal,) = compare_rows(cubic, bbr).refusals
    assert str(refusal) == "tcp_congestion_control: A has cubic, B has bbr (los, master, 9.144 m, udp)"
    assert not compare_rows(cubic, UDP).refusals, "trials of earlier versions do not record the congestion control"
    simulated = compare_rows(cubic, with_changes(bbr, backend="cosim"))
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
    result = compare_rows(UDP, with_changes(UDP, **changes))
    assert result.refusals == ()
    assert [str(concern) for concern in result.concerns][:1] == ([message] if message else [])


def test_attempts_in_both_runs_are_reported() -> None:
    (concern,) = compare(parsed(UDP), parsed(UDP[:7])).concerns
    assert str(concern) == "attempts that are in both runs: A has 7, B has 7"
    assert not concern.refuses


@pytest.mark.parametrize(
    ("frames", "messages", "is_refused"),
    [
        (0, [], False),
        (7, ["segmentation offload: A has off, B has on (los, master, 9.144 m, udp)"], True),
        (None, ["segmentation offload: A has off, B has unknown (los, master, 9.144 m, udp)"], False),
    ],
)
def test_offload_in_one_of_two_runs_is_refused(frames: int | None, messages: list[str], *, is_refused: bool) -> None:
    without_rtt = with_changes(UDP, tcp_superframes=0)
    result = compare_rows(
        without_rtt,
        [*with_changes(UDP[:1], tcp_superframes=frames), *with_changes(UDP[1:], tcp_superframes=frames and 0)],
    )
    assert [str(concern) for concern in result.concerns] == messages
    assert bool(result.refusals) is is_refused


@pytest.mark.parametrize(("messages", "comparable"), [(5, True), (8, False)])
def test_a_short_recording_may_be_some_messages_longer(messages: int, *, comparable: bool) -> None:
    short_recordings = with_changes(UDP, sent_bytes=19_560, bag_messages=4, datagrams_sent=3)
    longer = with_changes(
        short_recordings, sent_bytes=19_560 + 1_500 * (messages - 4) + 10_000 * (messages > 5), bag_messages=messages
    )
    assert (not compare_rows(short_recordings, longer).refusals) is comparable


def test_runs_without_hashes_are_refused() -> None:
    old = with_changes(UDP, profiles_sha256=None, procedure_sha256=None)
    assert [concern.what for concern in compare_rows(old, old).refusals] == ["profiles_sha256", "procedure_sha256"]


def test_cells_with_different_mixtures_are_refused() -> None:
    nlos = with_changes(UDP, scenario="nlos")
    (refusal,) = compare_rows([*UDP, *nlos], UDP, by=("protocol",)).refusals
    assert str(refusal) == "scenario: A has los, nlos, B has los (udp)"


def test_the_same_concern_of_many_conditions_is_reported_once() -> None:
    rows = [*UDP, *with_changes(UDP, protocol="tcp"), *with_changes(UDP, scenario="nlos")]
    (refusal,) = compare_rows(rows, with_changes(rows, procedure_sha256="ffff")).refusals
    assert str(refusal).endswith("(los, master, 9.144 m, udp and 2 more)")


@given(st.integers(0, 50), st.integers(2, 12), st.integers(2, 12))
def test_swapping_the_runs_changes_all_signs(seed: int, n: int, m: int) -> None:
    a, b = bursty(COMPARABLE, n, seed=seed), bursty(COMPARABLE, m, seed=seed + 1)
    forward, reverse = (
        compare_rows(*runs, thresholds={"ip_loss": 0.1, "rtt_median_s": 0.002}) for runs in ((a, b), (b, a))
    )
    assert forward.exceeds_threshold == reverse.exceeds_threshold
    for difference, reversed_difference in zip(forward.differences, reverse.differences, strict=True):
        assert difference.value == -(reversed_difference.value or 0)
        assert difference.cliffs_delta == -(reversed_difference.cliffs_delta or 0)
        assert difference.p_holm == reversed_difference.p_holm
        if difference.interval is not None and reversed_difference.interval is not None:
            assert (difference.interval.low, difference.interval.high) == (
                -reversed_difference.interval.high,
                -reversed_difference.interval.low,
            )


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_rows_changes_nothing(seed: int) -> None:
    a, b = list(UDP), bursty(COMPARABLE, 15, seed=2)
    before = comparison_results.to_csv(compare_rows(a, b))
    for rows in (a, b):
        random.Random(seed).shuffle(rows)
    assert comparison_results.to_csv(compare_rows(a, b)) == before
