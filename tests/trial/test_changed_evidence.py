"""A change in one evidence file of a stored attempt makes the repeat void, or changes no column that depends on it.

The attempts are valid. They contain a transfer, pings, and iperf3 in both directions, with and without captures. They
were recorded on emulated robots with 5 % loss (`tests/data/README.md`).
"""

import json
import random
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.trial import gates
from tests.helpers.changed_evidence import (
    ATTEMPTS,
    StoredAttempt,
    changes,
    load_attempt,
    with_changed_bit,
    with_wrong_time,
)

Change = Callable[[bytes], bytes]
TRIAL = ATTEMPTS[0][0]


@cache
def attempt(protocol: Protocol) -> StoredAttempt:
    return load_attempt(TRIAL, protocol)


@pytest.mark.parametrize("protocol", Protocol)
def test_the_stored_attempts_are_valid(protocol: Protocol) -> None:
    assert attempt(protocol).verdict.problems == ()
    assert attempt(protocol).verdict.measured.values["rtt_received"] in range(10, 20), "of 20, some lost"


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(protocol=Protocol.UDP, seed=1409700485)  # the time of one iperf3 datagram by 8 us
@given(protocol=st.sampled_from(Protocol), seed=st.integers(0, 2**32))
def test_a_random_change_of_a_source_never_changes_a_column_of_a_valid_repeat(
    tmp_path_factory: pytest.TempPathFactory, protocol: Protocol, seed: int
) -> None:
    other = attempt(next(candidate for candidate in Protocol if candidate is not protocol))
    kind, name, content = next(changes(attempt(protocol), other, random.Random(seed)))
    verdict = attempt(protocol).judge_changed(name, content, tmp_path_factory.mktemp("changed"))
    assert attempt(protocol).undetected_changes(verdict) == {}, (kind, name)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(Protocol), st.sampled_from(("sender", "receiver")), st.integers(0), st.integers(-8000, 8000))
def test_one_wrong_time_in_a_capture_never_changes_the_clock_offset_by_more_than_its_error(
    tmp_path_factory: pytest.TempPathFactory, protocol: Protocol, role: str, index: int, microseconds: int
) -> None:
    name = f"{role}.pcap"
    changed = with_wrong_time((attempt(protocol).folder / name).read_bytes(), index, microseconds)
    verdict = attempt(protocol).judge_changed(name, changed, tmp_path_factory.mktemp("changed"))
    assert attempt(protocol).undetected_changes(verdict) == {}


def assert_problem(protocol: Protocol, name: str, change: Change | None, place: Path, reason: str) -> None:
    old = (attempt(protocol).folder / name).read_bytes()
    new = None if change is None else change(old)
    assert new != old
    problems = attempt(protocol).judge_changed(name, new, place).problems
    assert any(reason in problem for problem in problems), problems


def json_change(edit: Callable[[Any], object]) -> Change:
    def change(content: bytes) -> bytes:
        document = json.loads(content)
        edit(document)
        return json.dumps(document).encode()

    return change


def multiply_all(key: str, factor: float) -> Change:
    """Multiply the number at each occurrence of this key, at any depth of the JSON document."""

    def multiply(value: Any) -> None:  # noqa: ANN401 (of JSON)
        for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            multiply(inner)
        if isinstance(value, dict) and isinstance(value.get(key), int | float):
            value[key] = type(value[key])(value[key] * factor)

    return json_change(multiply)


def file_of_udp_attempt(name: str) -> Change:
    return lambda _: (attempt(Protocol.UDP).folder / name).read_bytes()


CAPTURES = ("sender.pcap", "receiver.pcap", "back.sender.pcap", "back.receiver.pcap")


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(Protocol), st.sampled_from(CAPTURES), st.integers(0), st.integers(0, 63))
def test_one_changed_bit_in_an_address_of_a_packet_is_found(
    tmp_path_factory: pytest.TempPathFactory, protocol: Protocol, name: str, index: int, bit: int
) -> None:
    def change(capture: bytes) -> bytes:
        return with_changed_bit(capture, index, 8 * _ADDRESSES_AT + bit)

    assert_problem(
        protocol, name, change, tmp_path_factory.mktemp("changed"), "packets have a wrong IPv4 header checksum"
    )


_ADDRESSES_AT = 12
"""Offset of the source and the destination in the IPv4 header. Captured frames start with this header (DLT_RAW)."""

JSON = "receiver-iperf3.json"
SENT = "sender-iperf3.json"


@pytest.mark.parametrize(
    ("protocol", "name", "change", "reason"),
    [
        (Protocol.TCP, JSON, multiply_all("bytes", 10), "bit/s by its bytes"),
        (Protocol.UDP, JSON, multiply_all("bytes", 10), "bit/s by its bytes"),
        (Protocol.UDP, JSON, multiply_all("lost_packets", 10), "but counts"),
        (Protocol.UDP, JSON, multiply_all("packets", 2), "datagrams"),
        (Protocol.UDP, SENT, multiply_all("packets", 0.5), "datagrams"),
        (Protocol.UDP, JSON, multiply_all("jitter_ms", 3), "different jitters"),
        (Protocol.TCP, SENT, multiply_all("retransmits", 100), "iperf3 retransmitted"),
        (Protocol.TCP, JSON, json_change(lambda test: test["intervals"].pop(1)), "but the previous one ends at"),
        (Protocol.TCP, JSON, json_change(lambda test: test["intervals"].pop()), "its summary"),
        (Protocol.TCP, JSON, json_change(lambda test: test["start"].update(cookie="x")), "they are different tests"),
        (
            Protocol.TCP,
            JSON,
            json_change(lambda test: test["start"]["timestamp"].update(timesecs=1)),
            "before the attempt",
        ),
        (Protocol.TCP, JSON, json_change(lambda test: test["start"]["connected"].pop()), "report different ports"),
        (Protocol.UDP, JSON, file_of_udp_attempt("back.receiver-iperf3.json"), "they are different tests"),
        (Protocol.UDP, JSON, file_of_udp_attempt("bare.receiver-iperf3.json"), "they are different tests"),
        (Protocol.UDP, "bare.receiver-iperf3.json", multiply_all("bytes", 10), "bit/s by its bytes"),
    ],
)
def test_other_evidence_contradicts_changed_iperf3_results(
    protocol: Protocol, name: str, change: Change, reason: str, tmp_path: Path
) -> None:
    assert_problem(protocol, name, change, tmp_path, reason)


@pytest.mark.parametrize("protocol", Protocol)
@pytest.mark.parametrize("factor", [0.5, 1.3, 10])
@pytest.mark.parametrize("test", ["", "back."])
def test_bytes_are_compared_with_captures_although_both_reports_are_consistent(
    protocol: Protocol, factor: float, test: str, tmp_path: Path
) -> None:
    """The reports of both ends have the same wrong numbers, as if iperf3 itself had counted wrongly."""
    stored_attempt = attempt(protocol)
    for path in stored_attempt.folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    for role in ("sender", "receiver"):
        name = f"{test}{role}-iperf3.json"
        content = (stored_attempt.folder / name).read_bytes()
        for key in ("bytes", "bits_per_second", *(("packets", "lost_packets") if protocol is Protocol.UDP else ())):
            content = multiply_all(key, factor)(content)
        (tmp_path / name).unlink()
        (tmp_path / name).write_bytes(content)
    actual = gates.judge(stored_attempt.plan, stored_attempt.repeat, AttemptEvidence(tmp_path)).problems
    assert any("capture" in reason for reason in actual), actual


def keep_lines(keep: Callable[[str], bool]) -> Change:
    return lambda content: "".join(line for line in content.decode().splitlines(keepends=True) if keep(line)).encode()


def change_numbers(
    change: Callable[[float], float], pattern: str = r"(time=)([0-9.]+)", form: str = "{:.2f}"
) -> Change:
    def changed(content: bytes) -> bytes:
        return re.sub(
            pattern, lambda match: match[1] + form.format(change(float(match[2]))), content.decode()
        ).encode()

    return changed


def remove_reply(content: bytes) -> bytes:
    """Remove one reply, and adapt the summary."""
    text = content.decode()
    without = re.sub(r"^\[.*icmp_seq=\d+ .*\n", "", text, count=1, flags=re.MULTILINE)
    return re.sub(r"(\d+) received", lambda match: f"{int(match[1]) - 1} received", without).encode()


STAMP = r"(\[)([0-9.]+)"


@pytest.mark.parametrize("protocol", Protocol)
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (remove_reply, "answer that ping did not print"),
        (keep_lines(lambda line: "icmp_seq" not in line or "seq=3 " in line), "ping counted"),
        (change_numbers(lambda ms: 10 * ms), "summary"),
        (change_numbers(lambda ms: ms + 50), "summary"),
        (change_numbers(lambda ms: 1.5 * ms), "summary"),
        (change_numbers(lambda s: s + 3600, STAMP, "{:.6f}"), "before or after the attempt"),
        (change_numbers(lambda s: s + 1.1, STAMP, "{:.6f}"), "after its arrival"),
        (change_numbers(lambda s: s - 0.05, STAMP, "{:.6f}"), "after its arrival"),
        (
            lambda text: text.replace(b"20 packets transmitted", b"40 packets transmitted"),
            "40 requests instead of 20",
        ),
    ],
)
def test_captures_and_counters_contradict_changed_pings(
    protocol: Protocol, change: Change, reason: str, tmp_path: Path
) -> None:
    assert_problem(protocol, "ping.txt", change, tmp_path, reason)


def test_capture_contradicts_changed_ping_times_with_a_consistent_summary(tmp_path: Path) -> None:
    """All times in the file are 5 ms longer, so that only the capture contradicts them."""

    def add_5_ms(content: bytes) -> bytes:
        text = change_numbers(lambda ms: ms + 5, form="{:.3f}")(content).decode()
        return re.sub(r"= ([0-9./]+) ms", "= " + _summary(text) + " ms", text).encode()

    def _summary(text: str) -> str:
        times = [float(number) for number in re.findall(r"time=([0-9.]+)", text)]
        return f"{min(times):.3f}/{sum(times) / len(times):.3f}/{max(times):.3f}/0.1"

    assert_problem(Protocol.TCP, "ping.txt", add_5_ms, tmp_path, "ms longer than in the sender's capture")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda content: content[: len(content) // 2], "differs from scan.bag from byte"),
        (lambda content: content[:8192], "the kernel of the receiver dropped 0"),
        (lambda content: content[:100] + bytes([content[100] ^ 1]) + content[101:], "differs from scan.bag"),
        (lambda _: b"", "the kernel of the receiver dropped 0"),
    ],
)
def test_a_udp_file_that_differs_from_the_received_data_makes_the_repeat_void(
    change: Change, reason: str, tmp_path: Path
) -> None:
    assert len((attempt(Protocol.UDP).folder / "recv.bag").read_bytes()) > 8192
    assert_problem(Protocol.UDP, "recv.bag", change, tmp_path, reason)


def test_datagrams_dropped_by_the_kernel_are_a_loss_of_the_receiver(tmp_path: Path) -> None:
    """An overflow of the socket buffer is legitimate: the kernel counts it (RcvbufErrors)."""
    stored_attempt = attempt(Protocol.UDP)
    for path in stored_attempt.folder.iterdir():
        (tmp_path / path.name).symlink_to(path)
    for name, content in (
        ("recv.bag", (stored_attempt.folder / "recv.bag").read_bytes()[:8192]),
        ("receiver-after.txt", _with_dropped_datagrams(stored_attempt.folder / "receiver-after.txt", 9)),
    ):
        (tmp_path / name).unlink()
        (tmp_path / name).write_bytes(content)
    assert gates.judge(stored_attempt.plan, stored_attempt.repeat, AttemptEvidence(tmp_path)).problems == ()


def _with_dropped_datagrams(path: Path, count: int) -> bytes:
    """Return the state in this file, with this number of additional datagrams that the kernel dropped."""
    text = path.read_text(encoding="utf-8")
    names, values = re.findall(r"^Udp: (.*)$", text, re.MULTILINE)
    table = dict(zip(names.split(), map(int, values.split()), strict=True))
    table["RcvbufErrors"] += count
    return text.replace(f"Udp: {values}", "Udp: " + " ".join(map(str, table.values()))).encode()
