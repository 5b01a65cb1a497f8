"""How much room the evidence of a trial takes, before it is there."""

from pathlib import PurePosixPath
from typing import Final

from fieldkit.backends.protocols import Robot
from fieldkit.core.model import Role
from fieldkit.steps.capture import SNAP_BYTES, Capture
from fieldkit.steps.record import Record
from fieldkit.steps.transfer import Transfer
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import steps_of

SPARE: Final = 2.0
"""Evidence may be so many times as large as estimated: repeats are redone, segments sent again."""

RESERVE_BYTES: Final = 100 << 20
"""Room that a trial leaves on every disk, for what is neither evidence nor fieldkit's."""

ROSBAG_RESERVE_BYTES: Final = 1 << 30
"""ROS 1's rosbag records nothing where less is free, and says so in its log alone (ros_comm 1.15, recorder.cpp)."""

# A message without its arrays, and with those that it usually has; see the ROS message definitions.
_MESSAGE_BYTES: Final = {
    "sensor_msgs/LaserScan": 100,
    "sensor_msgs/Imu": 340,
    "sensor_msgs/BatteryState": 100,
    "nav_msgs/Odometry": 720,
    "sensor_msgs/CompressedImage": 100_000,
    "sensor_msgs/Image": 1_000_000,
    "sensor_msgs/PointCloud2": 1_000_000,
}
_OTHER_MESSAGE_BYTES: Final = 1_000
# A range and an intensity per beam, 4 bytes each.
_BEAM_BYTES: Final = 8
# Of a topic that the profile does not describe.
_UNKNOWN_BYTES_PER_S: Final = 100_000
# Of rosbag's format 2.0: a record header and an index entry per message; chunks and message definitions once.
_RECORD_BYTES: Final = 60
_BAG_BYTES: Final = 16_384

# An Ethernet frame carries so much of a file; each is captured with a header, and TCP acknowledges it with another.
_SEGMENT_BYTES: Final = 1_448
_FRAME_BYTES: Final = SNAP_BYTES + 16
_FRAMES_PER_SEGMENT: Final = 2
# Host state before and after, logs, ping's lines; about 20 kB on a robot with Wi-Fi.
_TEXT_BYTES: Final = 100_000


def evidence_bytes(plan: Plan, role: Role) -> int:
    """Return about how many bytes one attempt leaves on the robot in `role`, with `SPARE`; 0 if no step runs there.

    Topics are taken at the rate and type that the profile gives.
    """
    if role not in plan.procedure.roles():
        return 0
    files = {record.bag(plan.robots()[record.robot]): _bag_bytes(plan, record) for record in _records(plan)}
    transfers = list(steps_of(plan.procedure, Transfer))
    total = float(_TEXT_BYTES)
    total += sum(_bag_bytes(plan, record) for record in _records(plan) if record.robot is role)
    total += sum(files.get(one.sent(plan.bags()), 0.0) for one in transfers if one.receiver is role)
    if any(role in capture.robots for capture in steps_of(plan.procedure, Capture)):
        segments = sum(files.get(one.sent(plan.bags()), 0.0) for one in transfers) / _SEGMENT_BYTES
        total += segments * _FRAMES_PER_SEGMENT * _FRAME_BYTES
    return round(total * SPARE)


def attempt_bytes(plan: Plan) -> int:
    """Return about how many bytes one attempt leaves on the laptop, with `SPARE`."""
    return sum(evidence_bytes(plan, role) for role in Role) + plan.lab_bytes


def reserve_bytes(plan: Plan, role: Role) -> int:
    """Return how many bytes must stay free on the robot in `role`."""
    word = plan.cast[role].profile.ros.command.record[0]
    by_rosbag = PurePosixPath(word).name == "rosbag" and any(one.robot is role for one in _records(plan))
    return ROSBAG_RESERVE_BYTES if by_rosbag else RESERVE_BYTES


def trial_bytes(plan: Plan) -> int:
    """Return about how many bytes the whole trial leaves on the laptop, with `SPARE`."""
    return attempt_bytes(plan) * plan.repeats * len(plan.protocols)


def _records(plan: Plan) -> list[Record]:
    return list(steps_of(plan.procedure, Record))


def _bag_bytes(plan: Plan, record: Record) -> float:
    robot = plan.robots()[record.robot]
    return _BAG_BYTES + record.duration * sum(_bytes_per_s(robot, topic) for topic in record.topics)


def _bytes_per_s(robot: Robot, name: str) -> float:
    for topic in robot.profile.ros.topics:
        if topic.name == name:
            message = _MESSAGE_BYTES.get(topic.type, _OTHER_MESSAGE_BYTES) + _BEAM_BYTES * (topic.points or 0)
            return topic.rate * (message + _RECORD_BYTES)
    return _UNKNOWN_BYTES_PER_S
