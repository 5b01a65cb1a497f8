"""Reader of bags with the rosbags library, which `bag` runs in a sandboxed process."""

import math
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rosbags import rosbag1

from fieldkit.core.units import format_count
from fieldkit.measure.evidence import sandbox_process
from fieldkit.measure.evidence.sandbox import Json
from fieldkit.ros.bags import bag

if TYPE_CHECKING:
    from rosbags import rosbag2
    from rosbags.highlevel import AnyReader

_BATTERY: Final = "sensor_msgs/msg/BatteryState"
_TF_MESSAGE: Final = "tf2_msgs/msg/TFMessage"
# Limits of valid bags: rosbags does not check the times and counts that it reads from text or a database.
_MAX_COUNT: Final = 1 << 63
_MAX_TOPICS: Final = 10_000


def answer(request: Json) -> Json:
    """Return the answer to a request about the bag at `path`.

    The keys of the request select the answer: number and times of the messages by topic (`topic_stats`), the charge
    in the last battery state (`topic`), the positions in one topic (`positions`), or else the contents of the bag.

    Raises:
        Exception: The bag cannot be read; rosbags and its dependencies raise any exception for invalid bytes.
    """
    path = Path(request["path"])
    if "positions" in request:
        return positions(path, request["positions"], request["child"])
    if "topic" in request:
        share = battery_share(path, request["topic"])
        return {"share": None if math.isnan(share) else share}
    if "topic_stats" in request:
        return {
            "topics": topic_stats(
                _open_ros2(path.parent) if path.suffix in bag.ROS2_SUFFIXES else rosbag1.Reader(path)
            )
        }
    if path.suffix not in bag.ROS2_SUFFIXES:
        return contents(rosbag1.Reader(path))
    if path.suffix == ".db3":
        _check_database(path)
    # The first reader counts the messages in the file, the second one reads their number from metadata.yaml.
    return contents(_open_ros2(path)) | {"metadata_messages": contents(_open_ros2(path.parent))["messages"]}


def _open_ros2(path: Path) -> "rosbag2.Reader":
    # The readers of SQLite, YAML and MCAP take a third of the start-up time, and ROS 1 bags do not need them.
    from rosbags import rosbag2  # noqa: PLC0415

    from fieldkit.ros.bags import bag_paths  # noqa: PLC0415

    bag_paths.allow_any()
    return rosbag2.Reader(path)


def contents(reader: "rosbag1.Reader | rosbag2.Reader") -> Json:
    """Return the contents of a bag, keyed by the attributes of `RecordingContents`."""
    with reader:
        by_topic = {_checked_name(topic): _checked_count(info.msgcount) for topic, info in reader.topics.items()}
        messages, started_ns = _checked_count(reader.message_count), _checked_count(reader.start_time)
        if len(by_topic) > _MAX_TOPICS or sum(by_topic.values()) != messages:
            raise ValueError(
                f"its index counts {format_count(messages, 'message')}, but the sum of its topics differs, or it has "
                f"more than {_MAX_TOPICS} topics"
            )
        # The duration of rosbags ends one nanosecond after the last message.
        duration_s = (_checked_count(reader.duration) - 1) / 1e9 if messages else 0.0
        return {
            "messages": messages,
            "started_utc_ns": started_ns,
            "duration_s": duration_s,
            "messages_by_topic": by_topic,
        }


def topic_stats(reader: "rosbag1.Reader | rosbag2.Reader") -> Json:
    """Return the number and the times of the messages of each topic, keyed by the attributes of `TopicStats`."""
    by_topic: dict[str, dict[str, int]] = {}
    with reader:
        for connection, stamp_ns, _ in reader.messages():
            at_ns, topic = _checked_count(stamp_ns), _checked_name(connection.topic)
            initial = {"messages": 0, "first_utc_ns": at_ns, "last_utc_ns": at_ns, "gap_ns": 0}
            stats = by_topic.setdefault(topic, initial)
            if len(by_topic) > _MAX_TOPICS:
                raise ValueError(f"it has more than {_MAX_TOPICS} topics")
            stats["messages"] += 1
            stats["gap_ns"] = max(stats["gap_ns"], at_ns - stats["last_utc_ns"])
            stats["last_utc_ns"] = at_ns
    return by_topic


def battery_share(path: Path, topic: str) -> float:
    """Return the charge in the last `sensor_msgs/BatteryState` of a topic; NaN if it is unknown or there is none."""
    share = math.nan
    with _open_decoder(path) as reader:
        connections = [
            connection
            for connection in reader.connections
            if connection.topic == topic and connection.msgtype == _BATTERY
        ]
        for connection, _, data in reader.messages(connections) if connections else ():
            message: Any = reader.deserialize(data, connection.msgtype)
            share = float(message.percentage)
    return share


def positions(path: Path, topic: str, child: str) -> Json:
    """Return the robot positions in the messages of a topic.

    Args:
        path: The bag.
        topic: The topic.
        child: Child frame whose position is returned, for a topic of transforms; empty for all transforms.

    Returns:
        `types` and `frames` of the messages, and `rows`: time in the header and time of recording in ns, three
        coordinates, and the yaw in radians. For fixes, the coordinates are latitude and longitude in degrees and
        altitude in metres. Fixes without a position and poses with NaN or infinite values are omitted.
    """
    rows: list[tuple[int, int, float, float, float, float]] = []
    types, frames = set[str](), set[str]()
    with _open_decoder(path) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        for connection, received_ns, data in reader.messages(connections) if connections else ():
            message: Any = reader.deserialize(data, connection.msgtype)
            types.add(connection.msgtype)
            for part in message.transforms if connection.msgtype == _TF_MESSAGE else (message,):
                if (pose := _pose(connection.msgtype, part, child)) is not None:
                    stamp = part.header.stamp
                    frames.add(_checked_name(part.header.frame_id))
                    rows.append((int(stamp.sec) * 10**9 + int(stamp.nanosec), received_ns, *pose))
    return {"types": sorted(types), "frames": sorted(frames), "rows": rows}


def _open_decoder(path: Path) -> "AnyReader":
    """Return a reader of the bag at `path` that decodes messages."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 (takes 30 ms, and few queries need it)
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    from fieldkit.ros.bags import bag_paths  # noqa: PLC0415

    bag_paths.allow_any()

    # A bag in SQLite does not contain the definitions of its message types.
    types = get_typestore(Stores.ROS2_FOXY)
    return AnyReader([path.parent if path.suffix in bag.ROS2_SUFFIXES else path], default_typestore=types)


def _pose(msgtype: str, message: Any, child: str) -> tuple[float, float, float, float] | None:  # noqa: ANN401
    """Return the coordinates and the yaw in a message; None if it has no valid position of the frame `child`."""
    match msgtype:
        case "sensor_msgs/msg/NavSatFix":
            coordinates = (message.latitude, message.longitude, message.altitude)
            has_fix = message.status.status >= 0 and all(map(math.isfinite, coordinates[:2]))
            latitude, longitude, altitude = map(float, coordinates)
            return (latitude, longitude, altitude, 0.0) if has_fix else None
        case "nav_msgs/msg/Odometry" | "geometry_msgs/msg/PoseWithCovarianceStamped":
            position, orientation = message.pose.pose.position, message.pose.pose.orientation
        case "geometry_msgs/msg/PoseStamped":
            position, orientation = message.pose.position, message.pose.orientation
        case "geometry_msgs/msg/TransformStamped" | "tf2_msgs/msg/TFMessage":
            if child and message.child_frame_id.strip("/") != child.strip("/"):
                return None
            position, orientation = message.transform.translation, message.transform.rotation
        case _:
            raise TypeError(f"{msgtype} contains no position")
    x, y, z, w = (float(getattr(orientation, axis)) for axis in "xyzw")
    # Yaw from a unit quaternion: the rotation about the vertical z axis (REP 103).
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    pose = (float(position.x), float(position.y), float(position.z), yaw)
    return pose if all(map(math.isfinite, pose)) else None


def _check_database(path: Path) -> None:
    """Check every page of an SQLite database, because the message count can be correct even if pages are damaged."""
    import sqlite3  # noqa: PLC0415 (needed only for bags in SQLite)

    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as database:
        ((result, *_), *_) = database.execute("PRAGMA quick_check(1)")
    if result != "ok":
        raise ValueError(result)


def _checked_count(value: object) -> int:
    if type(value) is not int or not 0 <= value < _MAX_COUNT:
        raise ValueError(f"{value!r:.40} is not a time or a number of messages")
    return value


def _checked_name(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.40} is not the name of a topic or frame")
    return value


if __name__ == "__main__":
    sandbox_process.serve(answer)
