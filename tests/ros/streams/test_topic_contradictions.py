"""Logs of a topic are compared with each other and with the captures, which reveals every change in one of them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fieldkit.agent.messaging import records, stream
from fieldkit.core.columns import Measured
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Role
from fieldkit.ros.streams import topic_captures, topic_checks, topic_columns, topic_samples
from tests.helpers import topic_attempts
from tests.helpers.captures import Frame
from tests.helpers.topic_attempts import MS, PERIOD, PLAN, SAMPLES, SECOND, Row, TopicAttempt, attempt, best_effort

KINDS = {
    "reliable over UDP": attempt(),
    "best effort with losses": attempt(plan=best_effort(), lost=(3, 4, 17, 39)),
    "reliable with samples given up": attempt(lost=(0, 20, 21)),
    "over TCP": attempt(tcp=True),
}
ANY = st.sampled_from(sorted(KINDS))


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("topic")


def is_sample(row: Row) -> bool:
    return row[0] == records.SAMPLE


def with_samples(rows: Sequence[Row], change: Callable[[int, Row], Row | None]) -> tuple[Row, ...]:
    """Return rows in which each sample is replaced by `change(index, row)`, or removed if the result is None."""
    samples = [row for row in rows if is_sample(row)]
    changed_samples = [change(index, row) for index, row in enumerate(samples)]
    return (*(row for row in rows if not is_sample(row)), *(row for row in changed_samples if row is not None))


def with_rows(attempt: TopicAttempt, end: str, rows: Sequence[Row]) -> TopicAttempt:
    return replace(attempt, sent=tuple(rows)) if end == "sent" else replace(attempt, received=tuple(rows))


def later(row: Row, by_ns: int) -> Row:
    return (*row[:4], row[4] + by_ns)


def assert_detected(reasons: list[str], measured: Measured, before: Measured) -> None:
    """Assert that an attempt is void, or that every column has its previous value or is withheld."""
    if reasons:
        return
    for name, value in before.values.items():
        now = measured.values.get(name)
        if now is None or now == value:
            continue
        assert isinstance(now, float), f"{name} is {now}, not {value}"
        assert isinstance(value, float), f"{name} is {now}, not {value}"
        tolerance = max(topic_captures.SLOW_S, 0.1 * now) if name.endswith("_s") else 0.0
        assert now == pytest.approx(value, abs=tolerance + 1e-4), f"{name} is {now}, not {value}"


@pytest.mark.parametrize("signed", [True, False], ids=["signed", "unsigned"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_valid_attempt_has_no_contradiction(kind: str, signed: bool, tmp_path: Path) -> None:
    reasons, measured = topic_attempts.judge_attempt(KINDS[kind], tmp_path, signed=signed)
    assert reasons == []
    # The fastest packet took 1 ms, its record 0.2 ms, and the slowest packet 84 us more.
    assert measured.values["topic_delay_median_s"] == pytest.approx(1.24e-3, abs=6e-5)


HOUR = 3600 * SECOND
SHIFTS = (HOUR, -HOUR, 50 * MS, -50 * MS, 10 * MS, -2 * MS, SECOND)


@pytest.mark.parametrize("shift_ns", SHIFTS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_log_with_shifted_arrivals_is_detected(kind: str, shift_ns: int, tmp_path: Path) -> None:
    attempt = KINDS[kind]
    received = with_samples(attempt.received, lambda _, row: later(row, shift_ns))
    reasons, _ = topic_attempts.judge_attempt(replace(attempt, received=received), tmp_path)
    assert reasons
    reason = "earlier than the packets" if shift_ns < 0 else "later than its capture for every sample"
    reason = "from before its start or after its end" if abs(shift_ns) == HOUR else reason
    assert reason in reasons[0]


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_without_half_of_the_arrivals_is_detected(kind: str, tmp_path: Path) -> None:
    attempt = KINDS[kind]
    received = with_samples(attempt.received, lambda place, row: row if place % 2 else None)
    reasons, _ = topic_attempts.judge_attempt(replace(attempt, received=received), tmp_path)
    if kind == "reliable with samples given up":  # samples after a gap need not be delivered to the program
        assert reasons
        return
    assert "that arrived according to its capture" in reasons[0]


def other_numbers(_: int, row: Row) -> Row:
    return (*row[:2], row[2] + 1000, *row[3:])


def other_sizes(place: int, row: Row) -> Row:
    return (row[0], row[1] - 500 if place == 7 else row[1], *row[2:])


def other_sending(place: int, row: Row) -> Row:
    return (*row[:3], row[3] - (40 * MS if place == 7 else 0), row[4])


@pytest.mark.parametrize(
    ("change", "expected_reason"),
    [
        (other_numbers, "numbers that the publisher's log does not have"),
        (other_sizes, "with a size other than 1016 bytes"),
        (other_sending, "the publisher did not send"),
    ],
)
@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_field_in_the_subscribers_log_is_detected(
    kind: str, change: Callable[[int, Row], Row], expected_reason: str, tmp_path: Path
) -> None:
    attempt = replace(KINDS[kind], received=with_samples(KINDS[kind].received, change))
    reasons, _ = topic_attempts.judge_attempt(attempt, tmp_path)
    assert any(expected_reason in reason for reason in reasons)


@pytest.mark.parametrize(
    ("change", "expected_reason"),
    [
        (other_numbers, "do not start at 0, or have a gap"),
        (other_sizes, "the publisher's log has 1 sample with a size other"),
        (lambda place, row: None if place % 2 else row, "do not start at 0, or have a gap"),
        (lambda place, row: row if place < 30 else None, "accounts for 30 instead of 40 samples"),
    ],
)
def test_a_wrong_field_in_the_publishers_log_is_detected(
    change: Callable[[int, Row], Row | None], expected_reason: str, tmp_path: Path
) -> None:
    attempt = KINDS["best effort with losses"]
    reasons, _ = topic_attempts.judge_attempt(replace(attempt, sent=with_samples(attempt.sent, change)), tmp_path)
    assert any(expected_reason in reason for reason in reasons)


def test_the_captures_reveal_the_same_change_in_both_logs(tmp_path: Path) -> None:
    attempt = KINDS["reliable over UDP"]

    def earlier(_: int, row: Row) -> Row:
        return (*row[:3], row[3] - 30 * MS, row[4])

    changed_attempt = replace(
        attempt, sent=with_samples(attempt.sent, earlier), received=with_samples(attempt.received, earlier)
    )
    reasons, _ = topic_attempts.judge_attempt(changed_attempt, tmp_path)
    assert any("different times of sending" in reason for reason in reasons)


@pytest.mark.parametrize("signed", [True, False])
def test_the_publishers_log_is_not_accepted_as_the_subscribers(signed: bool, tmp_path: Path) -> None:
    attempt = KINDS["reliable over UDP"]
    topic_attempts.write(attempt, tmp_path, signed=signed)
    sent = (tmp_path / "sender-topic.bin").read_bytes()
    (tmp_path / "receiver-topic.bin").write_bytes(sent)
    log = topic_samples.read_log(tmp_path / "receiver-topic.bin")
    reasons = list(topic_checks.check_logs(PLAN, log, log))
    assert "the subscriber's log is a copy of the publisher's" in reasons
    assert ("the subscriber's log was written by the publisher of the topic" in reasons) is signed


def test_the_log_of_another_topic_is_detected(tmp_path: Path) -> None:
    topic_attempts.write(KINDS["over TCP"], tmp_path)
    sent, received = (topic_samples.read_log(tmp_path / f"{role}-topic.bin") for role in ("sender", "receiver"))
    (publisher, subscriber) = topic_checks.check_logs(replace(PLAN, topic="/other"), sent, received)
    assert "publisher's log is of another topic" in publisher
    assert "subscriber's log is of another topic" in subscriber


def test_a_record_from_before_or_after_the_attempt_is_detected(tmp_path: Path) -> None:
    topic_attempts.write(KINDS["over TCP"], tmp_path)
    log = topic_samples.read_log(tmp_path / "sender-topic.bin")
    role = Role.SENDER
    first, last = int(log.times_ns.min()), int(log.times_ns.max())
    assert not list(topic_checks.check_times({role: log}, {role: (first, last)}))
    assert not list(topic_checks.check_times({role: log}, {}))
    (early,) = topic_checks.check_times({role: log}, {role: (first + SECOND, last)})
    assert "a record from 1.000 s before the attempt" in early
    (late,) = topic_checks.check_times({role: log}, {role: (first, last - SECOND)})
    assert "a record from 1.000 s after the attempt" in late


@pytest.mark.parametrize("kind", KINDS)
def test_samples_in_the_log_that_never_arrived_are_detected(kind: str, tmp_path: Path) -> None:
    """The subscriber's capture does not contain ten samples that are in its log."""
    attempt = KINDS[kind]
    incomplete_attempt = replace(
        attempt,
        receiver_frames=tuple(frame for frame in attempt.receiver_frames if not is_data(frame) or frame.time_ns % 4),
    )
    sent_samples = [row for row in attempt.sent if is_sample(row)]
    arrived_numbers = {row[2] for row in attempt.received if is_sample(row)}
    extra = [later(row, topic_attempts.AHEAD + 2 * MS) for row in sent_samples if row[2] not in arrived_numbers]
    received = tuple(sorted((*attempt.received, *extra), key=lambda row: row[4]))
    if extra:
        reasons, _ = topic_attempts.judge_attempt(replace(incomplete_attempt, received=received), tmp_path)
        assert any("the subscriber's capture lacks" in reason for reason in reasons)


def is_data(frame: Frame) -> bool:
    return len(frame.data) > 200


def test_an_overflowed_queue_is_not_a_contradiction(tmp_path: Path) -> None:
    """The program was suspended for 15 samples; its queue of 10 has the newest."""
    attempt = KINDS["reliable over UDP"]
    resumed_ns = next(row for place, row in enumerate(filter(is_sample, attempt.received)) if place == 30)[4]

    def delay_sample(place: int, row: Row) -> Row | None:
        if not 15 <= place < 30:
            return row
        return None if place < 20 else (*row[:4], resumed_ns - MS)

    reasons, measured = topic_attempts.judge_attempt(
        replace(attempt, received=with_samples(attempt.received, delay_sample)), tmp_path
    )
    assert reasons == []
    assert measured.values["topic_received"] == SAMPLES - 5
    assert "its program was delayed" in measured.missing["topic_delay_max_s"]


def test_a_capture_without_sample_headers_limits_the_number_of_arrivals(tmp_path: Path) -> None:
    """Older captures have a shorter snap length, so they do not contain the headers of samples over Zenoh."""
    attempt = KINDS["over TCP"]
    truncated_attempt = replace(
        attempt,
        sender_frames=truncate_frames(attempt.sender_frames),
        receiver_frames=truncate_frames(attempt.receiver_frames),
    )
    assert topic_attempts.judge_attempt(truncated_attempt, tmp_path)[0] == []
    early_rows = with_samples(attempt.received, lambda _, row: later(row, -20 * MS))
    assert (
        "earlier than the bytes in its capture"
        in topic_attempts.judge_attempt(replace(truncated_attempt, received=early_rows), tmp_path)[0][0]
    )
    few_rows = with_samples(attempt.received, lambda place, row: row if place < 8 else None)
    assert (
        "the subscriber's log lacks"
        in topic_attempts.judge_attempt(replace(truncated_attempt, received=few_rows), tmp_path)[0][0]
    )


def truncate_frames(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    return tuple(
        replace(frame, data=frame.data[:100], wire_bytes=frame.wire_bytes or len(frame.data)) for frame in frames
    )


@given(
    kind=ANY,
    end=st.sampled_from(["sent", "received"]),
    field=st.integers(0, 4),
    some=st.tuples(st.integers(0, SAMPLES + 1), st.integers(1, SAMPLES + 2)),
    by=st.sampled_from(
        [1, -1, 7, 1000, -500, 3 * MS, -3 * MS, 15 * MS, 35 * MS, -35 * MS, PERIOD, SECOND, HOUR, -HOUR]
    ),
)
@example(kind="over TCP", end="received", field=4, some=(0, 5), by=35 * MS)
@example(kind="reliable with samples given up", end="received", field=4, some=(15, 24), by=SECOND)
def test_a_change_in_any_range_of_a_field_is_detected(
    kind: str, end: str, field: int, some: tuple[int, int], by: int, *, folder: Path
) -> None:
    attempt, (first, count) = KINDS[kind], some
    rows: list[Row] = list(getattr(attempt, end))
    before = topic_attempts.judge_attempt(attempt, folder)[1]
    for place in range(first, min(first + count, len(rows))):
        row = list(rows[place])
        row[field] = row[field] + by if field else by % 7 + 1
        rows[place] = (row[0], abs(row[1]) % 2**32, row[2], row[3], row[4])
    try:
        reasons, measured = topic_attempts.judge_attempt(with_rows(attempt, end, rows), folder)
    except EvidenceError:
        return
    assert_detected(reasons, measured, before)


@given(
    kind=ANY,
    end=st.sampled_from(["sent", "received"]),
    chosen=st.sets(st.integers(0, SAMPLES + 1), min_size=1),
    twice=st.booleans(),
)
def test_missing_or_duplicated_records_are_detected(
    kind: str, end: str, chosen: set[int], twice: bool, folder: Path
) -> None:
    attempt = KINDS[kind]
    before = topic_attempts.judge_attempt(attempt, folder)[1]
    rows: Sequence[Row] = getattr(attempt, end)
    times = [1 + twice if place in chosen else 1 if twice or place not in chosen else 0 for place in range(len(rows))]
    if not twice:
        times = [int(place not in chosen) for place in range(len(rows))]
    repeated_rows = tuple(row for row, count in zip(rows, times, strict=True) for _ in range(count))
    if not repeated_rows:
        return
    reasons, measured = topic_attempts.judge_attempt(with_rows(attempt, end, repeated_rows), folder)
    if kind == "reliable with samples given up" and end == "received" and not twice:
        return  # after a gap, it is unknown if the middleware delivered a sample
    assert_detected(reasons, measured, before)


@given(end=st.sampled_from(["sender", "receiver"]), place=st.integers(0), bit=st.integers(0, 7))
def test_a_flipped_bit_in_a_log_with_a_checksum_is_detected(end: str, place: int, bit: int, folder: Path) -> None:
    attempt = KINDS["over TCP"]
    topic_attempts.write(attempt, folder)
    path = folder / f"{end}-topic.bin"
    content = bytearray(path.read_bytes())
    content[place % len(content)] ^= 1 << bit
    path.write_bytes(content)
    try:
        log = topic_samples.read_log(path)
    except EvidenceError:
        return
    assert not log.is_complete, "a changed log is accepted as complete"


def test_constants_equal_those_of_the_agent() -> None:
    assert int(stream.SETTLING_S * 1e9) == topic_checks.SETTLING_NS
    assert (stream.MAGIC, stream.MIN_BYTES) == (
        topic_samples.MAGIC,
        topic_samples.HEAD_BYTES,
    )


def test_every_time_of_a_topic_is_compared_with_the_capture() -> None:
    """The test includes columns that are added later."""
    times = {column.name for column in topic_columns.COLUMNS if column.name.endswith("_s")} - {"topic_discovery_s"}
    assert times | {"topic_deadline_misses"} == topic_captures.PROGRAM_DELAY_FIGURES.keys()
