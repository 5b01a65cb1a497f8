"""Stalls of topics in logs with known gaps."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.measure.transfers import stalls
from fieldkit.measure.transfers.deliveries import FlowSchedule
from fieldkit.ros.streams import topic_stalls
from fieldkit.ros.streams.topic_samples import TopicLog
from tests.ros.streams.test_measure_topics import FLOW, captures, log, publisher_log, subscriber_log

EXPECTED = FlowSchedule(interval_s=0.1, duration_s=9.9)
SECOND = 1_000_000_000


def measure(sent: TopicLog | None, received: TopicLog | None, **changes: Any) -> dict[str, Any]:  # noqa: ANN401
    publisher, subscriber = captures()
    schedule = replace(EXPECTED, **changes)
    result = topic_stalls.measure(FLOW, (sent, received), (publisher, subscriber), schedule)
    assert result.values.keys() | result.missing.keys() == {column.name for column in topic_stalls.COLUMNS}
    return {name.removeprefix("topic_"): value for name, value in result.values.items()}


@given(st.sets(st.integers(1, 98), max_size=95))
def test_consecutive_lost_samples_are_overdue_by_one_interval_each(lost: set[int]) -> None:
    arrived_numbers = [number for number in range(100) if number not in lost]
    result = measure(publisher_log(100), subscriber_log(arrived_numbers))
    overdue_s = [(later - earlier - 1) * 0.1 for earlier, later in pairwise(arrived_numbers)]
    assert result["stall_s"] == pytest.approx(max(overdue_s), abs=1e-6)
    assert result["stalls"] == sum(duration_s > 0.30001 for duration_s in overdue_s)


def test_repeated_or_late_samples_are_counted_once() -> None:
    assert measure(publisher_log(100), subscriber_log([*range(100), *range(50)]))["stalls"] == 0


@pytest.mark.parametrize(("last", "bound_s"), [(0, 9.8), (49, 4.9), (97, None), (99, None)])
def test_a_topic_that_never_recovered_has_a_lower_bound(last: int, bound_s: float | None) -> None:
    result = measure(publisher_log(100), subscriber_log(list(range(last + 1))))
    if bound_s is None:
        assert result == {"stall_s": pytest.approx(0.0), "stalls": 0}
    else:
        assert result == {"stall_at_least_s": pytest.approx(bound_s), "stalls": 1}


def test_a_publisher_that_stopped_writing_has_stalled() -> None:
    result = measure(publisher_log(50), subscriber_log(list(range(50))))
    assert result == {"stall_at_least_s": pytest.approx(4.9), "stalls": 1}


def test_a_topic_without_arrivals_has_a_lower_bound() -> None:
    assert measure(publisher_log(100), log([], [])) == {"stall_at_least_s": pytest.approx(9.9), "stalls": 1}


def test_a_subscription_without_its_first_samples_has_stalled() -> None:
    assert measure(publisher_log(100), subscriber_log(list(range(30, 100)))) == {
        "stall_s": pytest.approx(3.0),
        "stalls": 1,
    }


def test_a_clock_that_was_set_is_rejected() -> None:
    received = subscriber_log(list(range(100)))
    at_ns = received.samples.at_ns + np.where(received.samples.sequence >= 50, -10 * SECOND, 0)
    assert not measure(publisher_log(100), replace(received, samples=replace(received.samples, at_ns=at_ns)))
    publisher, subscriber = captures()
    forward = replace(
        subscriber,
        time_ns=subscriber.time_ns + 3600 * SECOND * (np.arange(len(subscriber)) > len(subscriber) // 2),
    )
    result = topic_stalls.measure(
        FLOW, (publisher_log(100), subscriber_log(list(range(100)))), (publisher, forward), EXPECTED
    )
    assert not result.values


def test_without_complete_logs_the_columns_are_empty() -> None:
    assert not measure(None, subscriber_log([1]))
    assert not measure(publisher_log(0), log([], []))


def test_its_columns_equal_those_of_other_flows() -> None:
    names = [column.name for column in stalls.declare_columns("topic", "the topic", 0)]
    assert [column.name for column in topic_stalls.COLUMNS] == names
