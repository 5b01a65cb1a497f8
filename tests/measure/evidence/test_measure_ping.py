import math
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from statistics import fmean

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import ping, ping_gaps
from fieldkit.measure.evidence.delay_quantiles import quantile_of_sent
from fieldkit.measure.evidence.ping import Ping, Problem, Reply
from fieldkit.measure.evidence.ping_gaps import AnswerGap
from tests.helpers.paths import DATA

OUTPUTS = DATA / "ping" / "20221126"


def test_all_lines_of_real_outputs_are_parsed() -> None:
    outputs = sorted(set(OUTPUTS.iterdir()) - {OUTPUTS / "about.txt"})
    assert len(outputs) >= 10
    for path in outputs:
        assert ping.read(path).unknown_lines == (), path.name


def test_outputs_of_other_ping_programs_are_parsed_except_for_messages_of_others() -> None:
    unknown = {
        path.name: ping.read(path).unknown_lines
        for path in (*(DATA / "busybox/1.35.0").glob("ping-[!a]*.txt"), *(DATA / "ping/20101006").iterdir())
    }
    assert {name: lines for name, lines in unknown.items() if lines} == {
        "normal.txt": ("^C",),
        "names.txt": ("^C",),
        "ping-no-route.txt": ("ping: sendto: Network is unreachable",),
    }


def test_a_duplicate_of_busybox_counts_once_and_its_times_are_in_milliseconds() -> None:
    result = ping.read(DATA / "busybox/1.35.0/ping-duplicates.txt")
    assert [(reply.seq, reply.duplicate) for reply in result.replies] == [
        (0, False),
        (0, True),
        (2, False),
        (3, False),
    ]
    assert result.rtt_s == (0.170 / 1e3, 0.157 / 1e3, 0.149 / 1e3)
    assert {reply.at_utc_ns for reply in result.replies} == {None}


def test_gaps_of_an_interrupted_busybox_run_start_from_0() -> None:
    lines = ["PING 10.9.9.9 (10.9.9.9): 56 data bytes", "64 bytes from 10.9.9.9: seq=2 ttl=64 time=0.157 ms"]
    assert ping.parse("\n".join(lines)).unanswered_seqs == (0, 1)


def test_a_normal_output_is_parsed() -> None:
    reply_times_ns = (1_795_206_644_916_480_000, 1_795_206_645_119_498_000, 1_795_206_645_323_428_000)
    times_s = (0.159 / 1e3, 0.054 / 1e3, 0.052 / 1e3)
    assert ping.read(OUTPUTS / "normal.txt") == Ping(
        payload_bytes=56,
        replies=tuple(
            Reply(seq, rtt_s, at_utc_ns, duplicate=False, damaged=False)
            for seq, rtt_s, at_utc_ns in zip((1, 2, 3), times_s, reply_times_ns, strict=True)
        ),
        problems=(),
        transmitted=3,
        received=3,
        unknown_lines=(),
        summary_s=(0.052 / 1e3, 0.088 / 1e3, 0.159 / 1e3),
    )


@pytest.mark.parametrize(
    ("name", "payload_bytes", "answers", "summary", "gaps"),
    [
        ("../../busybox/1.35.0/ping-normal", 56, 3, (3, 3), ()),
        ("../../busybox/1.35.0/ping-duplicates", 56, 3, (4, 3), (1,)),
        ("../../busybox/1.35.0/ping-all-lost", 56, 0, (3, 0), (0, 1, 2)),
        ("../../busybox/1.35.0/ping-unreachable", 56, 0, (4, 0), (0, 1, 2, 3)),
        ("../../busybox/1.35.0/ping-no-route", 56, 0, (None, None), ()),
        ("../../busybox/1.35.0/ping-sigint", 56, 4, (4, 4), ()),
        ("../../busybox/1.35.0/ping-payload-2", 2, 3, (3, 3), ()),
        ("../../busybox/1.35.0/ping-payload-8192", 8192, 3, (3, 3), ()),
        ("../20101006/normal", 56, 4, (4, 4), ()),
        ("../20101006/names", 56, 4, (4, 4), ()),
        ("../20101006/all-lost", 56, 0, (5, 0), (1, 2, 3, 4, 5)),
        ("all-lost", 56, 0, (3, 0), (1, 2, 3)),
        ("all-lost-O", 56, 0, (3, 0), (1, 2, 3)),
        ("duplicates", 56, 2, (3, 2), (2,)),
        ("from-address", 56, 2, (2, 2), ()),
        ("from-interface", 56, 2, (2, 2), ()),
        ("interrupted", 56, 4, (None, None), ()),
        ("payload-8", 8, 2, (2, 2), ()),
        ("payload-8192", 8192, 3, (3, 3), ()),
        ("sigint", 56, 2, (2, 2), ()),
        ("unreachable", 56, 0, (4, 0), (1, 2, 3, 4)),
    ],
)
def test_answers_and_gaps_of_real_outputs(
    name: str, payload_bytes: int, answers: int, summary: tuple[int | None, int | None], gaps: tuple[int, ...]
) -> None:
    result = ping.read(OUTPUTS / f"{name}.txt")
    assert result.payload_bytes == payload_bytes
    assert len(result.answers) == answers
    assert ((result.transmitted, result.received), result.unanswered_seqs) == (summary, gaps)


def test_a_duplicate_is_kept_and_marked_but_does_not_count() -> None:
    result = ping.read(OUTPUTS / "duplicates.txt")
    assert [(reply.seq, reply.duplicate) for reply in result.replies] == [(1, False), (1, True), (3, False)]
    assert result.rtt_s == (0.159 / 1e3, 0.052 / 1e3)


def test_errors_have_source_text_and_request() -> None:
    problems = ping.read(OUTPUTS / "unreachable.txt").problems
    assert problems[0] == Problem(1, "10.9.0.1", "Destination Host Unreachable", 1_795_206_651_395_678_000)
    assert [problem.seq for problem in problems] == [1, 2, 3, 4]


def test_a_payload_too_short_for_a_time_stamp_gives_no_round_trip_times() -> None:
    result = ping.read(OUTPUTS / "payload-8.txt")
    assert len(result.answers) == 2
    assert result.rtt_s == ()


def test_a_reply_with_a_wrong_checksum_does_not_count() -> None:
    result = ping.parse("64 bytes from 10.9.0.2: icmp_seq=1 ttl=64 time=1.00 ms (BAD CHECKSUM!)\n")
    assert (len(result.replies), len(result.answers), result.unanswered_seqs) == (1, 0, ())


def test_gaps_of_an_interrupted_run_end_at_the_last_known_number() -> None:
    lines = [f"64 bytes from 10.9.0.2: icmp_seq={seq} ttl=64 time=1.00 ms" for seq in (2, 5)]
    assert ping.parse("\n".join(lines)).unanswered_seqs == (1, 3, 4)


def test_a_truncated_line_is_reported_unchanged() -> None:
    truncated_line = "[1795206656.303416] 64 bytes from 127.0.0.1: icmp_seq=4 tt"
    assert ping.parse(truncated_line).unknown_lines == (truncated_line,)


def test_a_missing_output_is_an_evidence_error(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError, match="cannot be read"):
        ping.read(tmp_path / "ping.txt")


fragments = st.sampled_from([
    "PING ", "64 bytes from ", "10.0.0.1", ": icmp_seq=", ": icmp_req=", ": seq=", "icmp_seq=", "1",
    "9" * 5000, "٣", " ttl=", " time=", "1.0",
    " ms", " (DUP!)", "[", "]", "\n", "\r", "From ", " packets transmitted, ", " received, ", "\x00", "56(84)",
    " bytes of data.", " data bytes", " packets received, ", "-", ".", "²",
])  # fmt: skip


@given(st.one_of(st.text(), st.lists(fragments, max_size=30).map("".join)))
@example("64 bytes from 1: icmp_seq=" + "9" * 5000)
def test_any_text_raises_no_error(text: str) -> None:
    result = ping.parse(text)
    assert len(result.answers) <= len(result.replies) <= text.count("\n") + 1
    assert len(result.unanswered_seqs) <= 65536


@given(st.binary())
def test_bytes_that_are_not_text_raise_no_error(data: bytes) -> None:
    ping.parse(data.decode(errors="replace"))


@given(st.data())
def test_other_lines_in_a_real_output_do_not_change_the_result(data: st.DataObject) -> None:
    text = (OUTPUTS / "duplicates.txt").read_text(encoding="utf-8")
    lines = text.split("\n")
    noise = st.text(st.characters(exclude_characters="\n"), min_size=1).filter(lambda line: "e" not in line)
    index = data.draw(st.integers(0, len(lines)))
    result = ping.parse("\n".join([*lines[:index], data.draw(noise), *lines[index:]]))
    assert (result.replies, result.transmitted) == (ping.parse(text).replies, 3)


def ping_with_answers(*seqs_ms: tuple[int, int], n_sent: int) -> Ping:
    """Return a ping of `n_sent` requests with the times of its answers in ms."""
    replies = tuple(Reply(seq, 1e-3, at_ms * 1_000_000, duplicate=False, damaged=False) for seq, at_ms in seqs_ms)
    return Ping(56, replies, (), n_sent, len(replies), ())


INTERVAL_S = 0.1


def test_the_longest_gap_has_the_number_of_lost_requests() -> None:
    gap = ping_gaps.longest_gap(
        ping_with_answers((1, 100), (2, 201), (6, 640), (7, 700), (9, 900), n_sent=10), INTERVAL_S
    )
    assert gap == AnswerGap(0.439, 3, is_open=False)
    assert ping_gaps.longest_gap(ping_with_answers((1, 100), (2, 200), (3, 350), n_sent=3), INTERVAL_S) == AnswerGap(
        0.15, 0, is_open=False
    )
    # A late answer creates no additional gap: the answer to 2 arrived after that to 3.
    assert ping_gaps.longest_gap(ping_with_answers((1, 100), (3, 300), (2, 310), n_sent=3), INTERVAL_S) == AnswerGap(
        0.21, 0, is_open=False
    )


@pytest.mark.parametrize(
    ("ping_", "duration_s", "n_lost", "is_open"),
    [
        pytest.param(
            ping_with_answers((1, 100), (3, 300), n_sent=5), 0.2, 2, True, id="as long at the end as within"
        ),
        pytest.param(ping_with_answers((1, 100), (4, 400), n_sent=5), 0.3, 2, False, id="a lost echo at the end"),
        pytest.param(ping_with_answers((1, 100), (2, 200), (3, 300), n_sent=26), 2.3, 23, True, id="down at the end"),
        pytest.param(ping_with_answers((24, 100), (25, 200), n_sent=25), 2.3, 23, True, id="down at the start"),
        pytest.param(ping_with_answers(n_sent=30), 3.0, 30, True, id="no answer at all"),
        pytest.param(ping_with_answers((1, 100), n_sent=12), 1.1, 11, True, id="a single answer"),
        pytest.param(
            ping_with_answers((1, 100), (31, 3100), n_sent=42), 3.0, 29, True, id="1 s down at the end, longer within"
        ),
        pytest.param(
            ping_with_answers((65535, 100), (0, 200), (1, 300), n_sent=65537), 6553.4, 65534, True, id="16 bits"
        ),
    ],
)
def test_a_gap_at_the_start_or_end_is_a_lower_bound(
    ping_: Ping, duration_s: float, n_lost: int, is_open: bool
) -> None:
    result = ping_gaps.longest_gap(ping_, INTERVAL_S)
    assert result == AnswerGap(pytest.approx(duration_s), n_lost, is_open)  # type: ignore[arg-type]
    values = ping_gaps.measure_gap(ping_, INTERVAL_S).values
    suffix = ("_at_least_s", "_lost_at_least") if is_open else ("_s", "_lost")
    assert values == {
        f"rtt_gap{name}": pytest.approx(value) for name, value in zip(suffix, (duration_s, n_lost), strict=True)
    }


def test_sequence_numbers_of_a_long_ping_may_wrap() -> None:
    answers = [(seq & 0xFFFF, 100 * seq) for seq in range(1, 70_001) if not 66_000 < seq <= 66_010]
    assert ping_gaps.longest_gap(ping_with_answers(*answers, n_sent=70_000), INTERVAL_S) == AnswerGap(
        1.1, 10, is_open=False
    )


def test_without_time_stamps_there_is_no_gap() -> None:
    assert ping_gaps.longest_gap(ping_with_answers((1, 100), n_sent=1), INTERVAL_S) is None
    assert ping_gaps.longest_gap(ping.read(DATA / "busybox/1.35.0/ping-duplicates.txt"), INTERVAL_S) is None
    columns = {column.name for column in (*ping_gaps.GAP_COLUMNS, *ping_gaps.OPEN_GAP_COLUMNS)}
    assert ping_gaps.measure_gap(None, INTERVAL_S).missing.keys() == columns


@given(st.lists(st.booleans(), min_size=1, max_size=60))
def test_every_ping_has_either_a_gap_or_its_lower_bound(replies: list[bool]) -> None:
    result = ping_with_answers(
        *((seq, 100 * seq) for seq, is_answered in enumerate(replies, 1) if is_answered), n_sent=len(replies)
    )
    measured = ping_gaps.measure_gap(result, INTERVAL_S)
    longest_run = max((len(list(run)) for is_answered, run in groupby(replies) if not is_answered), default=0)
    if len(replies) == 1 and replies[0]:
        assert not measured.values
    else:
        (n_lost,) = (value for name, value in measured.values.items() if "lost" in name)
        assert len(measured.values) == 2
        assert n_lost == longest_run


@given(st.lists(st.floats(0, 1, width=32), max_size=30), st.integers(0, 30))
def test_the_median_of_all_requests_counts_a_lost_request_as_infinitely_late(rtt_s: list[float], n_lost: int) -> None:
    padded = sorted([*rtt_s, *[math.inf] * n_lost])
    middle_values = padded[(len(padded) - 1) // 2 : len(padded) // 2 + 1]
    expected = fmean(middle_values) if middle_values and math.inf not in middle_values else None
    assert quantile_of_sent(rtt_s, len(padded), 0.5) == (expected if expected is None else pytest.approx(expected))


def test_a_ping_with_half_of_its_echoes_lost_has_no_median_of_all_requests() -> None:
    def measure_values(n_sent: int) -> Measured:
        return ping.measure(ping_with_answers((1, 100), (2, 200), (3, 300), n_sent=n_sent))

    assert measure_values(3).values["rtt_median_sent_s"] == measure_values(3).values["rtt_median_s"]
    assert measure_values(5).values["rtt_median_sent_s"] == 1e-3
    assert "rtt_median_sent_s" in measure_values(6).missing


def test_a_killed_ping_has_no_median_of_all_requests() -> None:
    output = replace(ping_with_answers((1, 100), (2, 200), n_sent=2), transmitted=None, received=None)
    assert "rtt_median_s" in ping.measure(output).values
    assert "rtt_median_sent_s" in ping.measure(output).missing
