"""Types that differ between ROS 1 and ROS 2 but can be bridged; their samples are compared with those of rosbags."""

import time
from typing import Any

import pytest
from rosbags.serde import SerdeError

from fieldkit.agent.messaging.middleware import Deliver, Network, Topic
from fieldkit.core.errors import ConfigurationError
from fieldkit.ros.bridging import bridge, counterparts
from fieldkit.ros.bridging.bridge import Side
from fieldkit.ros.bridging.crossings import Crossing
from fieldkit.ros.interfaces.types import Distribution, MessageTypes, standard_types


class FakeMiddleware:
    """A middleware through which a test sends and receives samples; it records the requested topics."""

    version = "test"

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.topics: list[Topic] = []
        self.deliver: Deliver | None = None

    def publisher(self, topic: Topic) -> "FakeMiddleware":
        self.topics.append(topic)
        return self

    def subscribe(self, topic: Topic, deliver: Deliver) -> Any:  # noqa: ANN401
        self.topics.append(topic)
        self.deliver = deliver
        return lambda: 1

    def write(self, data: bytes) -> bool:
        self.written.append(data)
        return True

    def matched(self) -> int:
        return 1

    def drain(self, limit_s: float) -> None:
        """Do nothing."""

    def other_types(self, _: Topic) -> set[str]:
        return set()

    def close(self) -> None:
        """Do nothing."""


def bridge_sample(
    monkeypatch: pytest.MonkeyPatch, type_name: str, sample: bytes, types: MessageTypes, *, back: bool
) -> tuple[list[bytes], str, str]:
    """Return the converted samples, and the announced MD5 sum in ROS 1 and type name in DDS."""
    of_ros1, of_dds = FakeMiddleware(), FakeMiddleware()
    monkeypatch.setattr(
        "fieldkit.agent.messaging.middleware.adapter", lambda over: lambda _: of_ros1 if over == "ros1" else of_dds
    )
    network = Network("127.0.0.1")
    crossing = Crossing.parse(f"/t:{type_name}", back=back)
    source, target = (of_dds, of_ros1) if back else (of_ros1, of_dds)
    with bridge.bridge_topics(Side("ros1", network), Side("dds", network), [crossing], types):
        assert source.deliver is not None
        source.deliver(sample, time.time_ns())
    (ros1_topic,), (dds_topic,) = of_ros1.topics, of_dds.topics
    return target.written, ros1_topic.md5, dds_topic.dds_types[dds_topic.type]


# The MD5 sums are the output of `rosmsg md5` in Noetic.
@pytest.mark.parametrize(
    ("name", "md5"),
    [("Time", "cd7166c74c552c311fbcc2fe5a7bc289"), ("Duration", "3e286caf4241d664e55f3ad380e2ae46")],
)
@pytest.mark.parametrize("package", ["std_msgs", "builtin_interfaces"])
@pytest.mark.parametrize("back", [False, True])
def test_time_types_are_bridged_under_their_names(
    monkeypatch: pytest.MonkeyPatch, name: str, md5: str, package: str, *, back: bool
) -> None:
    types = standard_types()
    seconds = -7 if name == "Duration" else 7
    value = types.ros1.types[f"builtin_interfaces/msg/{name}"](seconds, 999_999_999)
    ros1 = bytes(types.ros1.serialize_ros1(types.ros1.types[f"std_msgs/msg/{name}"](value), f"std_msgs/msg/{name}"))
    kind = f"builtin_interfaces/msg/{name}"
    ros2 = bytes(types.ros2.serialize_cdr(types.ros2.types[kind](seconds, 999_999_999), kind))
    sample, expected = (ros2, ros1) if back else (ros1, ros2)
    written, announced_md5, dds_type = bridge_sample(monkeypatch, f"{package}/{name}", sample, types, back=back)
    assert written == [expected]
    assert (announced_md5, dds_type) == (md5, f"builtin_interfaces::msg::dds_::{name}_")


def ranges(variance: float) -> tuple[bytes, bytes]:
    """Return a range message, serialized by rosbags for Noetic and for Jazzy."""
    types = standard_types()
    messages = []
    for store, extra_fields in ((types.ros1, ()), (types.ros2, (variance,))):
        stamp = store.types["builtin_interfaces/msg/Time"](3, 4)
        numbers = {"seq": 0} if store is types.ros1 else {}
        header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="sonar", **numbers)
        messages.append(store.types["sensor_msgs/msg/Range"](header, 0, 0.5, 0.25, 4.0, 1.5, *extra_fields))
    ros1, ros2 = messages
    kind = "sensor_msgs/msg/Range"
    return bytes(types.ros1.serialize_ros1(ros1, kind)), bytes(types.ros2.serialize_cdr(ros2, kind))


def test_range_has_variance_0_in_ros_2_and_none_in_ros_1(monkeypatch: pytest.MonkeyPatch) -> None:
    noetic_range, jazzy_range = ranges(0.0)
    written, md5, _ = bridge_sample(monkeypatch, "sensor_msgs/Range", noetic_range, standard_types(), back=False)
    assert written == [jazzy_range]
    assert md5 == "c005c34273dc426c67a020a87bc24148"
    _, range_with_variance = ranges(0.125)
    assert range_with_variance != jazzy_range
    written, _, _ = bridge_sample(monkeypatch, "sensor_msgs/Range", range_with_variance, standard_types(), back=True)
    assert written == [noetic_range]


@pytest.mark.parametrize("cut", [1, 4, 5, 20])
def test_range_with_a_wrong_length_is_invalid(cut: int) -> None:
    pair = counterparts.of_type(standard_types(), "sensor_msgs/Range")
    assert pair is not None
    noetic_range, jazzy_range = ranges(0.0)
    for data in (noetic_range[:-cut], noetic_range + bytes(cut)):
        with pytest.raises(SerdeError):
            pair.to_ros2(standard_types(), data)
    with pytest.raises(SerdeError):
        pair.to_ros1(standard_types(), jazzy_range[:-cut])


def test_additional_members_depend_on_the_distribution() -> None:
    pairs = {
        distribution: counterparts.of_type(standard_types(distribution), "sensor_msgs/Range")
        for distribution in (Distribution.HUMBLE, Distribution.IRON)
    }
    assert [pair.added_bytes if pair else None for pair in pairs.values()] == [b"", bytes(4)]
    assert counterparts.of_type(standard_types(), "visualization_msgs/Marker") is None
    with pytest.raises(ConfigurationError, match="there is no message type"):
        counterparts.of_type(standard_types(), "sensor_msgs/Rnge")
