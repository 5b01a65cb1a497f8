"""Data of emulated sensors that the lab sends to robots, without the code that generates their messages."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

from fieldkit.core.errors import ConfigurationError, did_you_mean

LASER_SCAN: Final = "sensor_msgs/LaserScan"
GENERATED_TYPES: Final = (
    LASER_SCAN,
    "sensor_msgs/Imu",
    "nav_msgs/Odometry",
    "tf2_msgs/TFMessage",
    "sensor_msgs/BatteryState",
    "sensor_msgs/Range",
    "sensor_msgs/NavSatFix",
    "sensor_msgs/MagneticField",
    "sensor_msgs/FluidPressure",
    "sensor_msgs/Temperature",
    "geometry_msgs/PoseStamped",
)
"""Message types that `messages.GENERATORS` supports; other types need a template."""


@dataclass(frozen=True)
class Template:
    """Serialized parts of the messages of a type that has no generator.

    A robot sends these parts in each message, and fills one list of numbers between them with random values.

    Attributes:
        has_header: True if the message starts with a header.
        head: Content before the list that is filled, without the header, serialized, in hexadecimal digits. It is the
            whole content if no list is filled.
        tail: Content after the list, in the same form.
        size_bytes: Size of the list without its length field; 0 if no list is filled.
        floats: True if the list holds 4-byte floats; False if any bytes are valid values.
    """

    has_header: bool
    head: str
    tail: str
    size_bytes: int
    floats: bool


@dataclass(frozen=True)
class Sensor:
    """One topic that a robot publishes.

    Attributes:
        topic: For example `/scan`.
        type: ROS message type, `package/Name`.
        rate_hz: Messages per second.
        frame: `frame_id` of the header.
        points: For a laser scan, beams per turn; for a point cloud, its points; None if the profile has no number.
        template: Parts of the messages of a type without a generator; None for a type with one.
        child_frame: Frame of the robot, for odometry and transforms; REP 105 calls it `base_link`. Empty if the
            profile names none.
    """

    topic: str
    type: str
    rate_hz: float
    frame: str
    points: int | None
    template: Template | None = None
    child_frame: str = ""


@dataclass(frozen=True)
class Definition:
    """Message definition that a publisher announces.

    Attributes:
        text: Fields of the type and of all types in it.
        md5: MD5 sum of the definition, with which ROS compares types.
    """

    text: str
    md5: str


@dataclass(frozen=True)
class LaserTarget:
    """An upright solid that reflects beams.

    Attributes:
        outline_m: Corners of the outline from above, in order, metres east and north. For a cylinder, its centre.
        radius_m: Radius of a cylinder, 0 for other solids.
        base_m: Height of the bottom.
        top_m: Height of the top.
    """

    outline_m: tuple[tuple[float, float], ...]
    radius_m: float
    base_m: float
    top_m: float

    def edges_m(self) -> Iterator[tuple[tuple[float, float], tuple[float, float]]]:
        """Yield the two ends of each edge of the outline."""
        yield from pairwise((*self.outline_m, self.outline_m[0]))


class Neighbour(NamedTuple):
    """Body of another robot: an upright cylinder around its antenna.

    Attributes:
        number: Index of the robot in the lab's list of robots, from 0.
        radius_m: Radius of the cylinder.
        below_m: Height of the antenna above the bottom of the cylinder.
        above_m: Height of the top above the antenna.
    """

    number: int
    radius_m: float
    below_m: float
    above_m: float


def check(sensor: Sensor) -> None:
    """Check that an emulated robot can publish `sensor`.

    Raises:
        ConfigurationError: Its type has neither a generator nor a template, its rate is 0, or a laser scan has no
            `points`.
    """
    if sensor.type not in GENERATED_TYPES and sensor.template is None:
        hint = did_you_mean(sensor.type, GENERATED_TYPES, f"known types: {', '.join(GENERATED_TYPES)}")
        raise ConfigurationError(
            f"an emulated robot cannot publish {sensor.type}",
            where=f"topic {sensor.topic}",
            remedy=f"{hint} Or add a generator to sim_backends/emulated/ros/messages.py",
        )
    if sensor.rate_hz <= 0:
        raise ConfigurationError(
            "a topic with rate 0Hz publishes nothing",
            where=f"topic {sensor.topic}",
            remedy="write a rate above 0Hz, for example 5Hz",
        )
    if sensor.type == LASER_SCAN and sensor.points is None:
        raise ConfigurationError(
            "a laser scan needs `points`, the number of beams per turn",
            where=f"topic {sensor.topic}",
            remedy="write for example points: 360",
        )


def packed_string(text: str) -> bytes:
    """Return a string in ROS 1 serialization: its length, then its bytes."""
    data = text.encode()
    return struct.pack("<I", len(data)) + data
