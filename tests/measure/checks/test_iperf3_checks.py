"""JSON of both ends of real iperf3 tests has no contradiction in any version, but a changed number is one."""

import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.checks import iperf3_checks
from fieldkit.measure.checks.iperf3_checks import IperfSettings
from fieldkit.measure.evidence import iperf3
from tests.helpers.paths import DATA

VERSIONS = ("3.1.3", "3.7", "3.12", "3.17.1", "3.18")
WITH_THREADS = ("3.17.1", "3.18")
TESTS = ("tcp", "udp", "udp-reverse")
NUMBERS = ("bytes", "seconds", "packets", "lost_packets", "retransmits")


def document(version: str, test: str, end: str) -> Any:  # noqa: ANN401 (any JSON)
    return json.loads((DATA / "iperf3" / version / f"{test}-{end}.json").read_text(encoding="utf-8"))


def settings_of(test: str) -> IperfSettings:
    tcp = test == "tcp"
    protocol = Protocol.TCP if tcp else Protocol.UDP
    return IperfSettings(
        protocol, streams=1 + tcp, payload_bytes=1400, reverse=test.endswith("reverse"), duration_s=3.0
    )


def contradictions(client: Any, server: Any, test: str) -> list[str]:  # noqa: ANN401 (any JSON)
    ends = [iperf3.parse(json.dumps(end)) for end in (client, server)]
    reverse = test.endswith("reverse")
    contradictions_of_ends = (
        iperf3_checks.check_one_end(end, sends=sends) for end, sends in zip(ends, (not reverse, reverse), strict=True)
    )
    return [*chain(*contradictions_of_ends), *iperf3_checks.compare_ends(ends[0], ends[1], settings_of(test))]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("test", TESTS)
def test_both_ends_of_a_real_test_have_no_contradiction(version: str, test: str) -> None:
    assert contradictions(document(version, test, "client"), document(version, test, "server"), test) == []


@pytest.mark.parametrize("end", ["client", "server"])
@pytest.mark.parametrize(("uncounted", "is_possible"), [(1, True), (5, True), (6, False), (-1, False)])
def test_intervals_of_versions_with_threads_may_lack_one_percent(
    end: str, uncounted: int, *, is_possible: bool
) -> None:
    """The main thread of iperf3 sets the bytes of an interval to 0 while the thread of the stream adds to them."""
    for version in ("3.12", "3.18"):
        ends = {name: document(version, "udp", name) for name in ("client", "server")}
        interval = ends[end]["intervals"][1]
        for counts in (interval["sum"], *interval["streams"]):
            counts["bytes"] -= uncounted * 1400
            counts["bits_per_second"] = 8 * counts["bytes"] / counts["seconds"]
        has_no_contradiction = not contradictions(ends["client"], ends["server"], "udp")
        assert has_no_contradiction is (is_possible and version == "3.18")


@given(
    version=st.sampled_from(VERSIONS),
    test=st.sampled_from(TESTS),
    end=st.sampled_from(["client", "server"]),
    change=st.tuples(st.integers(0, 10), st.sampled_from(NUMBERS), st.sampled_from([0, 0.5, 1.1, 2, 10])),
)
def test_a_changed_number_in_an_interval_is_a_contradiction(
    version: str, test: str, end: str, change: tuple[int, str, float]
) -> None:
    """Columns are computed from the changed numbers."""
    number, key, factor = change
    ends = {name: document(version, test, name) for name in ("client", "server")}
    intervals = ends[end]["intervals"]
    total = intervals[number % len(intervals)]["sum"]
    sends = (end == "client") != test.endswith("reverse")
    if key not in total or (sends and key in {"packets", "lost_packets"}):
        return
    old_value = total[key]
    total[key] = type(old_value)(old_value * factor)
    if abs(total[key] - old_value) > (0.002 if key == "seconds" else 0):
        assert (
            contradictions(ends["client"], ends["server"], test) or total[key] == 0 == intervals[-1]["sum"]["bytes"]
        )


@given(version=st.sampled_from(VERSIONS), test=st.sampled_from(TESTS), number=st.integers(0, 10))
def test_a_missing_interval_is_a_contradiction(version: str, test: str, number: int) -> None:
    ends = {name: document(version, test, name) for name in ("client", "server")}
    receiver = ends["client" if test.endswith("reverse") else "server"]
    removed_interval = receiver["intervals"].pop(number % len(receiver["intervals"]))
    reasons = contradictions(ends["client"], ends["server"], test)
    may_lack_bytes = 3 * (128 << 10 if test == "tcp" else 1400) if version in WITH_THREADS else 0
    assert reasons or removed_interval["sum"]["bytes"] <= may_lack_bytes, "a column would change"


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("test", TESTS)
@pytest.mark.parametrize("end", ["client", "server"])
def test_the_json_of_another_test_is_a_contradiction(version: str, test: str, end: str) -> None:
    ends = {name: document(version, test, name) for name in ("client", "server")}
    ends[end] = document(version, next(other for other in TESTS if other != test), end)
    assert "they are different tests" in " ".join(contradictions(ends["client"], ends["server"], test))


def changed_settings() -> Iterator[tuple[str, Any, str]]:
    yield "protocol", "SCTP", "a different protocol"
    yield "num_streams", 7, "a different number of streams"
    yield "reverse", 2, "a different direction"
    yield "blksize", 64, "a different datagram size"


@pytest.mark.parametrize(("key", "value", "reason"), list(changed_settings()))
@pytest.mark.parametrize("version", VERSIONS)
def test_a_test_with_other_settings_is_a_contradiction(version: str, key: str, value: object, reason: str) -> None:
    ends = {name: document(version, "udp", name) for name in ("client", "server")}
    ends["server"] = copy.deepcopy(ends["server"])
    ends["server"]["start"]["test_start"][key] = value
    assert reason in " ".join(contradictions(ends["client"], ends["server"], "udp"))


def test_a_test_that_ended_early_or_started_at_another_time_is_reported() -> None:
    client, server = (iperf3.parse(json.dumps(document("3.12", "tcp", end))) for end in ("client", "server"))
    (reason,) = iperf3_checks.compare_ends(client, server, replace(settings_of("tcp"), duration_s=10.0))
    assert reason == "the client's intervals last 3.0 s in total instead of 10 s"
    start_ns = 10**9 * (client.start.start_utc_s or 0)
    assert iperf3_checks.date_problem(client, (start_ns - 10**9, start_ns + 5 * 10**9)) is None
    assert iperf3_checks.date_problem(client, None) is None
    hour_ns = 3600 * 10**9
    problem = iperf3_checks.date_problem(client, (start_ns - hour_ns, start_ns - hour_ns + 10**10))
    assert problem == "it began 3590 s after the attempt"
