"""How topics of a bridge are written, and what is counted of them."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.errors import ConfigurationError
from fieldkit.ros.crossings import Crossing, CrossingTally, parse_qos
from fieldkit.ros.qos import PROFILES, Durability, History, QosProfile, Reliability
from fieldkit.ros.types import shipped

SCAN = Crossing.parse("/scan:sensor_msgs/LaserScan")


def test_a_topic_has_a_type_in_either_spelling_and_the_default_quality() -> None:
    assert Crossing.parse("/a/scan:sensor_msgs/msg/LaserScan") == Crossing(
        "/a/scan", "sensor_msgs/msg/LaserScan", PROFILES["default"]
    )
    assert SCAN.type_name == "sensor_msgs/msg/LaserScan"


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("", QosProfile()),
        ("sensor_data", PROFILES["sensor_data"]),
        ("sensor_data,depth=1", QosProfile(Reliability.BEST_EFFORT, depth=1)),
        ("transient_local,depth=1", QosProfile(durability=Durability.TRANSIENT_LOCAL, depth=1)),
        ("best_effort,keep_all", QosProfile(Reliability.BEST_EFFORT, History.KEEP_ALL)),
        ("sensor_data,reliable", QosProfile(depth=5)),
    ],
)
def test_a_quality_is_a_profile_and_policies(text: str, wanted: QosProfile) -> None:
    assert parse_qos(text) == wanted


@pytest.mark.parametrize("text", ["sensor", "depth=0", "default,,", "reliable,sensor_data", "depth=9999999", " "])
def test_other_words_are_no_quality(text: str) -> None:
    with pytest.raises(ConfigurationError, match="no quality of service"):
        parse_qos(text)


@pytest.mark.parametrize("text", ["", "scan:a/B", "/scan", "/scan:", "/:a/B", "/sc an:a/B", "/a//b:a/B", "/{x}:a/B"])
def test_what_is_no_topic_and_type_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="no topic and its type"):
        Crossing.parse(text)


@given(st.lists(st.integers(1, 10**12), min_size=1, max_size=200))
def test_delays_are_those_of_sorted_ones_to_a_percent(delays_ns: list[int]) -> None:
    tally = CrossingTally()
    for delay_ns in delays_ns:
        tally.count(10, 0, delay_ns)
    told = tally.counts(SCAN, "ros1", "dds")
    ordered = sorted(delays_ns)
    for found, share in ((told.delay_median_s, 0.5), (told.delay_p99_s, 0.99)):
        exact_s = ordered[math.ceil(share * len(ordered)) - 1] / 1e9
        assert found == pytest.approx(exact_s, rel=0.0051)


def test_rates_are_between_the_first_and_the_last() -> None:
    tally = CrossingTally()
    for number in range(11):
        tally.count(100, 0, number * 10**8 + 1)
    told = tally.counts(SCAN, "ros1", "dds")
    assert (told.messages, told.bytes) == (11, 1100)
    assert told.per_s == pytest.approx(10)
    assert told.bytes_per_s == pytest.approx(1000)


def test_nothing_carried_has_no_rate_and_no_delay() -> None:
    told = CrossingTally().counts(SCAN, "ros1", "dds")
    assert (told.messages, told.per_s, told.bytes_per_s, told.delay_median_s, told.delay_p99_s) == (
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
        # ROS 2 gave these more members.
        ("sensor_msgs/Range", False),
        ("visualization_msgs/MarkerArray", False),
    ],
)
def test_types_that_differ_are_not_translatable(name: str, same: bool) -> None:
    assert shipped().translatable(name) is same
