"""Read bags with rosbags; run by `bag` in a process of its own. The only module that reads bags."""

import math
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rosbags import rosbag1

from fieldkit.measure.evidence import bag, confined
from fieldkit.measure.evidence.confined import Json

if TYPE_CHECKING:
    from rosbags import rosbag2
    from rosbags.highlevel import AnyReader

_BATTERY: Final = "sensor_msgs/msg/BatteryState"
_TREE: Final = "tf2_msgs/msg/TFMessage"
# Times and counts of a bag have so many bits; what rosbags read of a text or a database may be anything.
_MOST: Final = 1 << 63
_MOST_TOPICS: Final = 10_000


def answer(question: Json) -> Json:
    """Return the contents of the bag at `path`; with `heard` when they came, with a `topic` its last battery state.

    With `positions` it returns those of one topic.

    Raises:
        Exception: It cannot be read; any, as rosbags and what it is built on raise for bytes that are no bag.
    """
    path = Path(question["path"])
    if "positions" in question:
        return positions(path, question["positions"], question["child"])
    if "topic" in question:
        share = battery_share(path, question["topic"])
        return {"share": None if math.isnan(share) else share}
    if "heard" in question:
        return {"topics": heard(_ros2(path.parent) if path.suffix in bag.ROS2 else rosbag1.Reader(path))}
    if path.suffix not in bag.ROS2:
        return contents(rosbag1.Reader(path))
    if path.suffix == ".db3":
        _check_database(path)
    return contents(_ros2(path)) | {"closed": contents(_ros2(path.parent))["messages"]}


def _ros2(path: Path) -> "rosbag2.Reader":
    from rosbags import rosbag2  # noqa: PLC0415 (SQLite, YAML and MCAP take a third of the start of this process)

    from fieldkit.measure.evidence import bag_paths  # noqa: PLC0415 (as above)

    bag_paths.allow_any()
    return rosbag2.Reader(path)


def contents(reader: "rosbag1.Reader | rosbag2.Reader") -> Json:
    """Return the contents of a bag, by the names of `Bag`."""
    with reader:
        by_topic = {_text(topic): _count(info.msgcount) for topic, info in reader.topics.items()}
        messages, started_ns = _count(reader.message_count), _count(reader.start_time)
        if len(by_topic) > _MOST_TOPICS or sum(by_topic.values()) != messages:
            raise ValueError(f"its {len(by_topic)} topics do not have the {messages} messages that it counts")
        # rosbags counts to one nanosecond after the last message.
        duration_s = (_count(reader.duration) - 1) / 1e9 if messages else 0.0
        return {
            "messages": messages,
            "started_utc_ns": started_ns,
            "duration_s": duration_s,
            "messages_by_topic": by_topic,
        }


def heard(reader: "rosbag1.Reader | rosbag2.Reader") -> Json:
    """Return what came of each topic, by the names of `Heard`."""
    found: dict[str, dict[str, int]] = {}
    with reader:
        for connection, stamp_ns, _ in reader.messages():
            at_ns, topic = _count(stamp_ns), _text(connection.topic)
            one = found.setdefault(topic, {"messages": 0, "first_utc_ns": at_ns, "last_utc_ns": at_ns, "gap_ns": 0})
            if len(found) > _MOST_TOPICS:
                raise ValueError(f"it has more than {_MOST_TOPICS} topics")
            one["messages"] += 1
            one["gap_ns"] = max(one["gap_ns"], at_ns - one["last_utc_ns"])
            one["last_utc_ns"] = at_ns
    return found


def battery_share(path: Path, topic: str) -> float:
    """Return what the last `sensor_msgs/BatteryState` of a topic says; NaN if there is none."""
    share = math.nan
    with _decoding(path) as reader:
        chosen = [one for one in reader.connections if one.topic == topic and one.msgtype == _BATTERY]
        for connection, _, data in reader.messages(chosen) if chosen else ():
            message: Any = reader.deserialize(data, connection.msgtype)
            share = float(message.percentage)
    return share


def positions(path: Path, topic: str, child: str) -> Json:
    """Return what the messages of a topic say of where the robot was.

    Args:
        path: The bag.
        topic: The topic.
        child: Of a tree of transforms, the frame whose place is asked for.

    Returns:
        `type` and `frame` of the messages, and `rows`: when it was so, when it was recorded, three coordinates, and
        the yaw in radians. Fixes without a position are left out.
    """
    rows: list[tuple[int, int, float, float, float, float]] = []
    kinds, frames = set[str](), set[str]()
    with _decoding(path) as reader:
        chosen = [one for one in reader.connections if one.topic == topic]
        for connection, received_ns, data in reader.messages(chosen) if chosen else ():
            message: Any = reader.deserialize(data, connection.msgtype)
            kinds.add(connection.msgtype)
            for part in message.transforms if connection.msgtype == _TREE else (message,):
                if (found := _position(connection.msgtype, part, child)) is not None:
                    stamp = part.header.stamp
                    frames.add(_text(part.header.frame_id))
                    rows.append((int(stamp.sec) * 10**9 + int(stamp.nanosec), received_ns, *found))
    return {"types": sorted(kinds), "frames": sorted(frames), "rows": rows}


def _decoding(path: Path) -> "AnyReader":
    """Return a reader of the bag at a path that knows what messages are made of."""
    from rosbags.highlevel import AnyReader  # noqa: PLC0415 (takes 30 ms, and few questions need it)
    from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

    from fieldkit.measure.evidence import bag_paths  # noqa: PLC0415

    bag_paths.allow_any()

    # A bag in SQLite does not say what its types are made of.
    types = get_typestore(Stores.ROS2_FOXY)
    return AnyReader([path.parent if path.suffix in bag.ROS2 else path], default_typestore=types)


def _position(kind: str, message: Any, child: str) -> tuple[float, float, float, float] | None:  # noqa: ANN401
    """Return where a message has a robot, and how it is turned; None where it does not tell."""
    match kind:
        case "sensor_msgs/msg/NavSatFix":
            place = (message.latitude, message.longitude, message.altitude)
            has_fix = message.status.status >= 0 and all(map(math.isfinite, place[:2]))
            north, east, up = map(float, place)
            return (north, east, up, 0.0) if has_fix else None
        case "nav_msgs/msg/Odometry" | "geometry_msgs/msg/PoseWithCovarianceStamped":
            at, turned = message.pose.pose.position, message.pose.pose.orientation
        case "geometry_msgs/msg/PoseStamped":
            at, turned = message.pose.position, message.pose.orientation
        case "geometry_msgs/msg/TransformStamped" | "tf2_msgs/msg/TFMessage":
            if child and message.child_frame_id.strip("/") != child.strip("/"):
                return None
            at, turned = message.transform.translation, message.transform.rotation
        case _:
            raise TypeError(f"{kind} says no position")
    x, y, z, w = (float(getattr(turned, axis)) for axis in "xyzw")
    # Of a unit quaternion, the angle about the axis that points up (REP 103).
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    found = (float(at.x), float(at.y), float(at.z), yaw)
    return found if all(map(math.isfinite, found)) else None


def _check_database(path: Path) -> None:
    """Look at every page: a count of messages can be right where messages are cut off."""
    import sqlite3  # noqa: PLC0415 (as above)

    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as database:
        ((said, *_), *_) = database.execute("PRAGMA quick_check(1)")
    if said != "ok":
        raise ValueError(said)


def _count(value: object) -> int:
    if type(value) is not int or not 0 <= value < _MOST:
        raise ValueError(f"{value!r:.40} is no time or number of messages")
    return value


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.40} is no topic")
    return value


if __name__ == "__main__":
    confined.serve(answer)
