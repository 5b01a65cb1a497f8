"""Discovery times and gaps of recorded topics, from bags with known times and logs of real recorders."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags import rosbag2
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from fieldkit.core.errors import EvidenceError
from fieldkit.ros.bags import recorded_topics
from fieldkit.ros.bags.recorded_topics import RecordingReception
from tests.ros.bags.test_measure_bag import SUFFIXES

BEGAN_NS = 1_795_208_123_219_164_628
S = 10**9
# The output of rosbag 1.15.15 with its colours; see tests/data/rosbag.
ROSBAG = "\x1b[0m[ INFO] [{s}.{ns:09d}]: Subscribing to {topic}\x1b[0m\n"
RECORDING = "\x1b[0m[ INFO] [1795208130.000000000]: Recording to 'scan.bag'.\x1b[0m\n"
ROS2 = (
    "[INFO] [1795208123.200000000] [rosbag2_storage]: Opened database 'scan/scan_0.db3' for READ_WRITE.\n"
    "[INFO] [{s}.{ns:09d}] [rosbag2_recorder]: Listening for topics...\n"
    "[INFO] [1795208129.000000000] [rosbag2_recorder]: Subscribed to topic '/scan'\n"
)


def log(subscribed_ns: Mapping[str, int]) -> str:
    lines = [ROSBAG.format(s=at // S, ns=at % S, topic=topic) for topic, at in subscribed_ns.items()]
    return "".join(lines) + RECORDING


def write(folder: Path, text: str, arrivals_ns: Mapping[str, Sequence[int]]) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "std_msgs/msg/String"
    data = bytes(store.serialize_ros1(store.types[kind](data="x"), kind))
    (folder / "log").write_text(text, encoding="utf-8")
    (folder / "scan.bag").unlink(missing_ok=True)
    with Writer(folder / "scan.bag") as writer:
        for topic, stamps_ns in arrivals_ns.items():
            connection = writer.add_connection(topic, kind, typestore=store)
            for at_ns in stamps_ns:
                writer.write(connection, at_ns, data)


def read(folder: Path, *topics: str, duration_s: float = 5.0) -> RecordingReception:
    return recorded_topics.read(folder, "log", "scan.bag", topics, duration_s)


def test_the_slowest_topic_determines_the_discovery_time_and_any_topic_the_gap(tmp_path: Path) -> None:
    arrived_ns = {
        "/scan": [BEGAN_NS + at for at in (S // 2, S, 5 * S)],
        "/imu": [BEGAN_NS + S + S // 4, BEGAN_NS + 4 * S],
    }
    write(tmp_path, log({"/imu": BEGAN_NS, "/scan": BEGAN_NS}), arrived_ns)
    assert read(tmp_path, "/scan") == RecordingReception(discovered=True, messages=3, discovery_s=0.5, gap_s=4.0)
    assert read(tmp_path, "/scan", "/imu") == RecordingReception(
        discovered=True, messages=5, discovery_s=1.25, gap_s=4.0
    )


def test_the_discovery_of_a_topic_starts_with_its_subscription(tmp_path: Path) -> None:
    write(tmp_path, log({"/a": BEGAN_NS, "/b": BEGAN_NS + S}), {"/a": [BEGAN_NS + S], "/b": [BEGAN_NS + S + 1000]})
    assert read(tmp_path, "/b", duration_s=1.0).discovery_s == pytest.approx(1e-6)
    assert read(tmp_path, "/a", "/b").discovery_s == 1.0


def test_silence_until_the_end_is_a_gap(tmp_path: Path) -> None:
    write(tmp_path, log({"/scan": BEGAN_NS}), {"/scan": [BEGAN_NS + S, BEGAN_NS + 2 * S]})
    assert read(tmp_path, "/scan", duration_s=9.0).gap_s == 7.0
    assert read(tmp_path, "/scan", duration_s=1.0).gap_s == 1.0, "messages after the duration do not affect the gap"


def test_a_topic_without_a_message_is_not_discovered(tmp_path: Path) -> None:
    write(tmp_path, log({"/scan": BEGAN_NS, "/imu": BEGAN_NS}), {"/scan": [BEGAN_NS + S], "/imu": []})
    assert read(tmp_path, "/scan", "/imu") == RecordingReception(
        discovered=False, messages=1, discovery_s=None, gap_s=None
    )
    measured = recorded_topics.measure(read(tmp_path, "/imu"))
    assert dict(measured.values) == {"bag_discovered": False, "bag_messages": 0}
    assert measured.missing.keys() == {"bag_discovery_s", "bag_gap_s"}


def test_a_topic_with_a_longer_name_is_a_different_topic(tmp_path: Path) -> None:
    write(tmp_path, log({"/scan_2": BEGAN_NS, "/scan": BEGAN_NS + S}), {"/scan": [BEGAN_NS + 2 * S]})
    assert read(tmp_path, "/scan").discovery_s == 1.0


def test_a_recorder_without_its_master_discovers_no_topic(tmp_path: Path) -> None:
    (tmp_path / "log").write_text("", encoding="utf-8")
    measured = recorded_topics.measure(read(tmp_path, "/scan"))
    assert dict(measured.values) == {"bag_discovered": False}
    assert measured.missing.keys() == {"bag_discovery_s", "bag_messages", "bag_gap_s"}


def test_the_reception_without_a_complete_bag_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "log").write_text(log({"/scan": BEGAN_NS}), encoding="utf-8")
    assert not recorded_topics.measure(read(tmp_path, "/scan")).values


def test_an_unknown_log_gives_messages_but_no_discovery_time(tmp_path: Path) -> None:
    write(tmp_path, "recording\n", {"/scan": [BEGAN_NS]})
    assert read(tmp_path, "/scan") == RecordingReception(discovered=True, messages=1, discovery_s=None, gap_s=None)


def test_without_a_log_the_columns_are_missing(tmp_path: Path) -> None:
    with pytest.raises(EvidenceError):
        read(tmp_path, "/scan")
    assert not recorded_topics.measure(None).values


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_ros2_recorder_starts_the_discovery_of_all_topics_at_the_same_time(suffix: str, tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "std_msgs/msg/String"
    data = bytes(store.serialize_cdr(store.types[kind](data="x"), kind))
    with rosbag2.Writer(tmp_path / "scan", version=8, storage_plugin=SUFFIXES[suffix]) as writer:
        connection = writer.add_connection("/scan", kind, typestore=store)
        for at_ns in (BEGAN_NS + 2 * S, BEGAN_NS + 3 * S):
            writer.write(connection, at_ns, data)
    (tmp_path / "log").write_text(ROS2.format(s=BEGAN_NS // S, ns=BEGAN_NS % S), encoding="utf-8")
    result = recorded_topics.read(tmp_path, "log", f"scan/scan.{suffix}", ["/scan"], 4.0)
    assert result == RecordingReception(discovered=True, messages=2, discovery_s=2.0, gap_s=1.0)


@given(st.integers(0, 9_999_999_999 * S), st.sampled_from([ROSBAG, ROS2]))
def test_no_digit_of_a_stamp_is_lost(at_ns: int, text: str) -> None:
    text = text.format(s=at_ns // S, ns=at_ns % S, topic="/scan")
    assert recorded_topics.subscription_ns(text, ["/scan", "/imu"])["/scan"] == at_ns


@given(st.text())
def test_any_log_is_parsed_or_ignored(text: str) -> None:
    assert recorded_topics.subscription_ns(text, ["/scan"]).keys() <= {"/scan"}
