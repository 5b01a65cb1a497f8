"""The notation for the topics of a bridge, and their counters."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from fieldkit.ros.bridging.crossings import Crossing, CrossingTally, parse_qos
from fieldkit.ros.interfaces.qos import PROFILES, Durability, History, QosProfile, Reliability
from fieldkit.ros.interfaces.types import standard_types

SCAN = Crossing.parse("/scan:sensor_msgs/LaserScan")


def test_a_type_has_two_spellings_and_the_quality_has_a_default() -> None:
    assert Crossing.parse("/a/scan:sensor_msgs/msg/LaserScan") == Crossing(
        "/a/scan", "sensor_msgs/msg/LaserScan", PROFILES["default"]
    )
    assert SCAN.type_name == "sensor_msgs/msg/LaserScan"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", QosProfile()),
        ("sensor_data", PROFILES["sensor_data"]),
        ("sensor_data,depth=1", QosProfile(Reliability.BEST_EFFORT, depth=1)),
        ("transient_local,depth=1", QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)),
        ("best_effort,keep_all", QosProfile(Reliability.BEST_EFFORT, History.KEEP_ALL)),
        ("sensor_data,reliable", QosProfile(depth=5)),
    ],
)
def test_quality_is_a_profile_with_policies(text: str, expected: QosProfile) -> None:
    assert parse_qos(text) == expected


@pytest.mark.parametrize("text", ["sensor", "depth=0", "default,,", "reliable,sensor_data", "depth=9999999", " "])
def test_invalid_quality_is_rejected(text: str) -> None:
    with pytest.raises(ConfigurationError, match="not a quality of service"):
        parse_qos(text)


@pytest.mark.parametrize("text", ["", "scan:a/B", "/scan", "/scan:", "/:a/B", "/sc an:a/B", "/a//b:a/B", "/{x}:a/B"])
def test_invalid_topic_is_rejected(text: str) -> None:
    with pytest.raises(ConfigurationError, match="not a topic with its type"):
        Crossing.parse(text)


@given(st.lists(st.integers(1, 10**12), min_size=1, max_size=200))
def test_quantiles_of_delays_have_an_error_below_one_percent(delays_ns: list[int]) -> None:
    tally = CrossingTally()
    for delay_ns in delays_ns:
        tally.count(10, 0, delay_ns)
    result = tally.counts(SCAN, "ros1", "dds")
    ordered = sorted(delays_ns)
    for quantile_s, fraction in ((result.delay_median_s, 0.5), (result.delay_p99_s, 0.99)):
        exact_s = ordered[math.ceil(fraction * len(ordered)) - 1] / 1e9
        assert quantile_s == pytest.approx(exact_s, rel=0.0051)


def test_rates_are_between_the_first_and_the_last_message() -> None:
    tally = CrossingTally()
    for number in range(11):
        tally.count(100, 0, number * 10**8 + 1)
    result = tally.counts(SCAN, "ros1", "dds")
    assert (result.messages, result.bytes) == (11, 1100)
    assert result.per_s == pytest.approx(10)
    assert result.bytes_per_s == pytest.approx(1000)


def test_no_rate_and_no_delay_without_messages() -> None:
    result = CrossingTally().counts(SCAN, "ros1", "dds")
    assert (result.messages, result.per_s, result.bytes_per_s, result.delay_median_s, result.delay_p99_s) == (
        0,
        None,
        None,
        None,
        None,
    )


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("sensor_msgs/LaserScan", True),
        ("nav_msgs/Odometry", True),
        ("tf2_msgs/TFMessage", True),
        ("std_msgs/Char", True),
        # ROS 2 has added members to these types.
        ("sensor_msgs/Range", False),
        ("visualization_msgs/MarkerArray", False),
    ],
)
def test_types_that_differ_are_not_translatable(name: str, same: bool) -> None:
    assert standard_types().is_translatable(name) is same
