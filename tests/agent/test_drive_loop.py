"""The loop of the driver on a simulated clock: messages compared with rosbags, the lease, and the final zeros."""

import json
import math
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from fieldkit.agent.driving import drive
from fieldkit.agent.driving.drive_messages import VelocityEncoder, read_odometry
from fieldkit.agent.driving.steering import DriveVelocity, OdometryPose
from fieldkit.agent.messaging.middleware import Deliver, MiddlewareError, Topic

STAMPED = "geometry_msgs/msg/TwistStamped"
STORES = {False: get_typestore(Stores.ROS1_NOETIC), True: get_typestore(Stores.ROS2_HUMBLE)}
TASK = {
    "legs": [[0.5, 0.0]],
    "speed_m_s": 0.5,
    "turn_rad_s": 2.0,
    "acceleration_m_s2": 1.0,
    "fence_m": 3.0,
    "lease_s": 2.0,
    "odometry_s": 0.5,
    "limit_s": 60.0,
}


def odometry(pose: OdometryPose, *, cdr: bool, frame: str = "odom", child_frame: str = "base_footprint") -> bytes:
    """Serialize a message with rosbags."""
    store = STORES[cdr]
    kinds = store.types
    numbers = (0, 0) if cdr else (0, 0, 0)
    stamp = kinds["builtin_interfaces/msg/Time"](0, 0)
    header = kinds["std_msgs/msg/Header"](*((stamp, frame) if cdr else (numbers[0], stamp, frame)))
    point = kinds["geometry_msgs/msg/Point"](pose.x_m, pose.y_m, 0.0)
    orientation = kinds["geometry_msgs/msg/Quaternion"](
        0.0, 0.0, math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2)
    )
    zeros = np.zeros(36)
    vector = kinds["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
    message = kinds["nav_msgs/msg/Odometry"](
        header,
        child_frame,
        kinds["geometry_msgs/msg/PoseWithCovariance"](kinds["geometry_msgs/msg/Pose"](point, orientation), zeros),
        kinds["geometry_msgs/msg/TwistWithCovariance"](kinds["geometry_msgs/msg/Twist"](vector, vector), zeros),
    )
    serialize = store.serialize_cdr if cdr else store.serialize_ros1
    return bytes(serialize(message, "nav_msgs/msg/Odometry"))


@pytest.mark.parametrize("cdr", [False, True])
@pytest.mark.parametrize("frame_names", [("odom", "base_footprint"), ("", ""), ("o", "abcdefghi")])
def test_messages_equal_those_of_rosbags(frame_names: tuple[str, str], cdr: bool) -> None:
    pose = OdometryPose(3.5, -2.25, 1.25)
    parsed_pose = read_odometry(odometry(pose, cdr=cdr, frame=frame_names[0], child_frame=frame_names[1]), cdr=cdr)
    assert parsed_pose == pytest.approx(pose)
    kinds = STORES[cdr].types
    vector = kinds["geometry_msgs/msg/Vector3"]
    expected = kinds["geometry_msgs/msg/Twist"](vector(0.25, 0.0, 0.0), vector(0.0, 0.0, -0.5))
    serialize = STORES[cdr].serialize_cdr if cdr else STORES[cdr].serialize_ros1
    twist = VelocityEncoder("geometry_msgs/msg/Twist", "", cdr=cdr).encode(DriveVelocity(0.25, -0.5), 7)
    assert twist == bytes(serialize(expected, "geometry_msgs/msg/Twist"))


@given(
    st.text(st.characters(codec="ascii", categories=["L", "N"]), max_size=20),
    st.integers(0, (1 << 31) * 10**9 - 1),
    st.booleans(),
)
def test_stamped_velocities_equal_those_of_rosbags(frame: str, at_ns: int, cdr: bool) -> None:
    store, kind = STORES[cdr], "geometry_msgs/msg/TwistStamped"
    encoder = VelocityEncoder(kind, frame, cdr=cdr)
    for sequence in (1, 2):
        data = encoder.encode(DriveVelocity(0.25, -0.5), at_ns)
        message: Any = store.deserialize_cdr(data, kind) if cdr else store.deserialize_ros1(data, kind)
        assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(at_ns, 10**9)
        assert message.header.frame_id == frame
        assert cdr or message.header.seq == sequence
        linear, angular = message.twist.linear, message.twist.angular
        assert (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z) == (0.25, 0.0, 0.0, 0.0, 0.0, -0.5)
        assert data == bytes(store.serialize_cdr(message, kind) if cdr else store.serialize_ros1(message, kind))


@given(st.binary(max_size=300), st.booleans())
def test_invalid_odometry_is_none(data: bytes, cdr: bool) -> None:
    pose = read_odometry(data, cdr=cdr)
    assert pose is None or all(map(math.isfinite, pose))
    sample = odometry(OdometryPose(1.0, 2.0, 0.5), cdr=cdr)
    assert read_odometry(sample[: min(len(data), 80)], cdr=cdr) is None


def test_odometry_with_nan_is_none() -> None:
    sample = odometry(OdometryPose(1.0, 2.0, 0.5), cdr=False)
    offset = sample.index(struct.pack("<d", 1.0))
    assert read_odometry(sample[:offset] + struct.pack("<d", math.nan) + sample[offset + 8 :], cdr=False) is None


class World:
    """A middleware whose robot drives as commanded, and a clock that advances while the driver waits."""

    version = "world 1"

    def __init__(self, orders: Path, *, orders_end_s: float = math.inf) -> None:
        self.now_s = 100.0
        self.orders, self.orders_end_s = orders, orders_end_s
        self.pose = OdometryPose(1.0, 1.0, 0.3)
        self.sent: list[DriveVelocity] = []
        self.stamps_ns: list[int] = []
        self.frames: set[str] = set()
        self.types: set[str] = set()
        self.count_subscribers: Callable[[], int] = lambda: 1
        self.deliver: Deliver | None = None
        self.is_stopped = False

    # The methods of a clock and of an event.
    def monotonic(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return round(1e9 * self.now_s)

    def sleep(self, for_s: float) -> None:
        self.wait(for_s)  # the robot continues to move and reports its odometry

    def is_set(self) -> bool:
        return self.is_stopped

    def wait(self, for_s: float) -> bool:
        self.now_s += for_s
        velocity = self.sent[-1] if self.sent else DriveVelocity()
        x, y, yaw = self.pose
        ahead = velocity.forward_m_s * for_s
        self.pose = OdometryPose(
            x + ahead * math.cos(yaw), y + ahead * math.sin(yaw), yaw + velocity.turn_rad_s * for_s
        )
        if self.deliver is not None:
            self.deliver(odometry(self.pose, cdr=False), 0)
        if self.now_s < self.orders_end_s:
            order = "out" if self.now_s < 104 else "back"
            self.orders.write_text(f"{round(1e3 * self.now_s)} {order} 2\n", encoding="ascii")
        return self.is_stopped

    # The methods of a middleware.
    def publisher(self, topic: Topic) -> Any:  # noqa: ANN401
        def write(data: bytes) -> bool:
            if topic.type == STAMPED:
                message: Any = STORES[False].deserialize_ros1(data, STAMPED)
                self.stamps_ns.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
                self.frames.add(message.header.frame_id)
            values = struct.unpack("<6d", data[-48:])
            self.sent.append(DriveVelocity(values[0], values[5]))
            return True

        return SimpleNamespace(write=write, matched=self.count_subscribers)

    def subscribe(self, topic: Topic, deliver: Deliver) -> Callable[[], int]:
        self.deliver = deliver
        return lambda: 1

    def other_types(self, topic: Topic) -> set[str]:
        return self.types - {topic.type}


def run(
    world: World, monkeypatch: pytest.MonkeyPatch, folder: Path, *, kind: str = "geometry_msgs/msg/Twist"
) -> tuple[str, list[dict[str, Any]], dict[str, Any]]:
    """Drive; return the reason for the stop, the log and the last status."""
    monkeypatch.setattr(drive, "time", world)
    monkeypatch.setattr(drive, "now_s", world.monotonic)
    arguments: Mapping[str, Any] = {
        "cdr": False,
        "command": {"name": "/cmd_vel", "type": kind},
        **({"frame": "base"} if kind == STAMPED else {}),
        "odometry": {"name": "/odom", "type": "nav_msgs/msg/Odometry"},
        "task": TASK,
        "orders": str(world.orders),
        "status": str(folder / "status"),
    }
    stop_reason = drive.drive(world, arguments, folder / "log", world)  # type: ignore[arg-type]
    log = [json.loads(line) for line in (folder / "log").read_text(encoding="ascii").splitlines()]
    return stop_reason, log, json.loads((folder / "status").read_text(encoding="ascii"))


def test_robot_drives_out_and_back_and_ends_with_zero_velocity(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    world = World(tmp_path / "orders")
    stop_reason, log, status = run(world, monkeypatch, tmp_path)
    assert (stop_reason, status["ended"], status["phase"]) == ("", "home", "home")
    assert log[-1].items() - {("crc32", log[-1]["crc32"]), ("n", log[-1]["n"])} <= status.items()
    assert max(line["x_m"] for line in log) == pytest.approx(0.5, abs=0.05)
    assert math.dist(world.pose[:2], (1.0, 1.0)) < 0.05
    assert len(world.sent) > 100
    assert world.sent[-8:] == [DriveVelocity()] * 8
    assert {line["phase"] for line in log} >= {"out", "there", "back", "home"}


def test_stamped_velocities_have_the_time_of_the_robot_and_the_frame_of_its_profile(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    world = World(tmp_path / "orders")
    stop_reason, log, status = run(world, monkeypatch, tmp_path, kind=STAMPED)
    assert (stop_reason, status["ended"], world.frames) == ("", "home", {"base"})
    assert world.stamps_ns == sorted(set(world.stamps_ns))
    assert log[0]["utc_ns"] in world.stamps_ns
    assert world.sent[-8:] == [DriveVelocity()] * 8


@pytest.mark.parametrize("kind", ["geometry_msgs/msg/Twist", STAMPED])
def test_lost_laptop_stops_the_robot(kind: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    world = World(tmp_path / "orders", orders_end_s=100.9)
    stop_reason, log, status = run(world, monkeypatch, tmp_path, kind=kind)
    assert stop_reason == status["ended"] == "no order from the laptop for 2 s"
    assert log[-1]["utc_ns"] / 1e9 < 100.9 + 2.0 + 0.7
    assert world.sent[-8:] == [DriveVelocity()] * 8


def test_signal_stops_the_robot(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    world = World(tmp_path / "orders")
    world.count_subscribers = lambda: setattr(world, "is_stopped", world.now_s > 100.5) or 1  # type: ignore[func-returns-value]
    monkeypatch.setattr(World, "is_set", lambda self: self.now_s > 101.0)
    stop_reason, _, status = run(world, monkeypatch, tmp_path)
    assert stop_reason == status["ended"] == "ordered to stop"
    assert world.sent[-8:] == [DriveVelocity()] * 8


def test_signal_before_the_start_cancels_the_drive(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    world = World(tmp_path / "orders")
    world.count_subscribers, world.is_stopped = lambda: 0, True
    with pytest.raises(drive.DriveCancelledError):
        run(world, monkeypatch, tmp_path)
    assert not world.sent


def test_missing_subscription_and_odometry_are_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    world = World(tmp_path / "orders")
    world.count_subscribers = lambda: 0
    with pytest.raises(MiddlewareError, match=r"/cmd_vel has no subscription of geometry_msgs/msg/Twist$"):
        run(world, monkeypatch, tmp_path)
    world.types = {STAMPED}
    with pytest.raises(
        MiddlewareError, match=f"of geometry_msgs/msg/Twist, but it has endpoints of type {STAMPED}: change"
    ):
        run(world, monkeypatch, tmp_path)
    world = World(tmp_path / "orders")
    monkeypatch.setattr(World, "subscribe", lambda *_: lambda: 1)
    with pytest.raises(MiddlewareError, match="no odometry arrives on /odom"):
        run(world, monkeypatch, tmp_path)
    assert not world.sent
