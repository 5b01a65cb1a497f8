"""Messages of the emulated sensors: one small generator per ROS message type, in ROS 1 serialization.

ROS 1 serializes a message's fields in order without padding, little-endian; a string or sequence has its length in 4
bytes before it (wiki.ros.org/msg). Each generator packs the fields of its type with the standard library alone,
because the libraries that support all types would cost each robot 20 MB of memory.

The motion of the robot comes from `robot_motion`. Frames and units follow REP 103 and REP 105: metres, radians, x
ahead, y to the left. In the frame `map`, x is east and y is north, as in the orientation of an IMU (REP 145).
Odometry starts at 0 where the robot was switched on, with x along its heading at that time. Covariances are the
values that drivers of such robots report. The laser ranges are computed from the world. Most numbers that vary in a
real sensor contain noise, so that they compress no better than real data.
"""

import math
import struct
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from random import Random
from typing import Final

from sim_backends.emulated.ros.laser import ranges_m
from sim_backends.emulated.ros.robot_motion import AT_REST, RobotMotionState
from sim_backends.emulated.ros.sensor_specs import LASER_SCAN, LaserTarget, Sensor, Template, check, packed_string
from sim_backends.world.motion import GRAVITY_M_S2

LASER_RANGE_M: Final = (0.12, 3.5)  # LDS-01, ROBOTIS e-Manual
LASER_NOISE_M: Final = 0.015  # LDS-01 from 0.12 to 0.499 m, ROBOTIS e-Manual
# Variances of x, y, z (m^2) and of the rotations about these axes (rad^2), from the controller of a Husky
# (husky_control/config/control.yaml of github.com/husky/husky). The twist has the same numbers, in m^2/s^2 and
# rad^2/s^2.
ODOMETRY_VARIANCES: Final = (0.001, 0.001, 0.001, 0.001, 0.001, 0.03)
# Variances of orientation (rad^2), angular velocity (rad^2/s^2) and acceleration (m^2/s^4) that a TurtleBot3 reports:
# constants, far above its noise (ROBOTIS OpenCR, turtlebot3_sensor.cpp).
IMU_VARIANCES: Final = (0.0025, 0.02, 0.04)
LASER_INTENSITIES: Final = range(1_000, 12_000)

ON_GROUND_RANGE_M: Final = 0.1
"""Reading of a downward range sensor on a robot that is on the ground."""

FIELD_T: Final = (20e-6, -44e-6)
"""Magnetic field to the north and up: about 48 uT, inclined as in mid-latitudes (IGRF)."""

FIX_NOISE_M: Final = (0.1, 0.5)
"""Standard deviation of the fixes of a GNSS receiver that averages, horizontal and vertical."""

# The world's origin is at latitude 0, longitude 0, where WGS 84 has these radii.
EAST_RADIUS_M: Final = 6_378_137.0
NORTH_RADIUS_M: Final = 6_335_439.327

_POINT_BYTES: Final = 16  # noise is read from multiples of this offset, so that the fields of points stay aligned
_ONE_TRANSFORM: Final = struct.pack("<I", 1)


Generator = Callable[[Sensor, Random, RobotMotionState], bytes]
"""Returns the serialized fields that follow the header, or all fields of a type without a header."""


class Source:
    """Generates the messages of one sensor.

    Args:
        sensor: The sensor.
        targets: Laser targets in the robot's world.
        moving_targets: Returns the laser targets that move: the other robots at their current positions.

    Raises:
        ConfigurationError: The error of `sensor_specs.check`.
    """

    def __init__(
        self,
        sensor: Sensor,
        targets: Sequence[LaserTarget] = (),
        moving_targets: Callable[[], Sequence[LaserTarget]] = tuple,
    ) -> None:
        check(sensor)
        self._sensor = sensor
        self._generate = _template_generator(sensor.template) if sensor.template else GENERATORS[sensor.type]
        if sensor.type == LASER_SCAN:
            self._generate = partial(_laser_scan, targets=targets, moving_targets=moving_targets)
        self._has_header = sensor.template is None or sensor.template.has_header
        self._prefix = _ONE_TRANSFORM if sensor.type == "tf2_msgs/TFMessage" else b""
        # The seed is the topic, so that equal robots publish equal values, independently of their start time.
        self._noise = Random(sensor.topic)  # noqa: S311 (no secret)

    def message(self, number: int, stamp_ns: int, motion: RobotMotionState = AT_REST) -> bytes:
        """Return message `number`, serialized, for a motion and a time stamp in nanoseconds since the epoch."""
        if not self._has_header:
            return self._generate(self._sensor, self._noise, motion)
        stamp = struct.pack("<3I", number & 0xFFFFFFFF, *divmod(stamp_ns, 10**9))
        return (
            self._prefix
            + stamp
            + packed_string(self._sensor.frame)
            + self._generate(self._sensor, self._noise, motion)
        )


def _template_generator(template: Template) -> Generator:
    """Return a generator that fills the template's list with random bytes, or with normally distributed floats."""
    head, tail, size_bytes = bytes.fromhex(template.head), bytes.fromhex(template.tail), template.size_bytes
    pool = b""

    def generate(_: Sensor, noise: Random, __: RobotMotionState) -> bytes:
        nonlocal pool
        if not template.floats:
            return head + noise.randbytes(size_bytes) + tail
        # The floats are drawn only once, because drawing those of a large cloud takes longer than the period of the
        # topic. Each message contains them from another offset.
        if not pool:
            # Twice the list, so that a whole list follows each offset.
            pool = 2 * struct.pack(f"<{size_bytes // 4}f", *_gaussian(noise, 1.0, *[0.0] * (size_bytes // 4)))
        start = _POINT_BYTES * noise.randrange(max(1, size_bytes // _POINT_BYTES))
        return head + pool[start : start + size_bytes] + tail

    return generate


def _float32s(values: Sequence[float]) -> bytes:
    return struct.pack(f"<I{len(values)}f", len(values), *values)


def _float64s(*parts: Sequence[float]) -> bytes:
    """Return doubles as fields of fixed length, which are serialized without their length."""
    return b"".join(struct.pack(f"<{len(part)}d", *part) for part in parts)


def _diagonal(*variances: float) -> list[float]:
    return [
        variance if row == column else 0.0
        for row, variance in enumerate(variances)
        for column in range(len(variances))
    ]


def _gaussian(noise: Random, deviation: float, *means: float) -> list[float]:
    return [noise.gauss(mean, deviation) for mean in means]


def _heading_quaternion(yaw_rad: float) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of a rotation to the left."""
    return (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def _reported_range_m(value_m: float, low_m: float, high_m: float) -> float:
    """Return a distance as a sensor of this range reports it (REP 117)."""
    if value_m < low_m:
        return -math.inf
    return math.inf if value_m > high_m else value_m


def _laser_scan(
    sensor: Sensor,
    noise: Random,
    motion: RobotMotionState,
    targets: Sequence[LaserTarget] = (),
    moving_targets: Callable[[], Sequence[LaserTarget]] = tuple,
) -> bytes:
    points = sensor.points or 0
    step = 2 * math.pi / points
    low_m, high_m = LASER_RANGE_M
    true_ranges_m = ranges_m(chain(targets, moving_targets()), motion.position_m, motion.heading_rad, points, high_m)
    turn_s = 1 / sensor.rate_hz
    angles = (0.0, step * (points - 1), step)
    scalars = struct.pack("<7f", *angles, turn_s / points, turn_s, low_m, high_m)
    ranges = [_reported_range_m(noise.gauss(range_m, LASER_NOISE_M), low_m, high_m) for range_m in true_ranges_m]
    intensities = noise.choices(LASER_INTENSITIES, k=points)
    echoes = [0 if range_m == math.inf else echo for range_m, echo in zip(ranges, intensities, strict=True)]
    return scalars + _float32s(ranges) + _float32s(echoes)


def _imu(_: Sensor, noise: Random, motion: RobotMotionState) -> bytes:
    # On an assigned path the robot turns and accelerates in zero time, which gyroscope and accelerometer cannot show.
    orientation_covariance, angular_covariance, acceleration_covariance = (
        _diagonal(*[variance] * 3) for variance in IMU_VARIANCES
    )
    orientation = _float64s(_heading_quaternion(motion.heading_rad), orientation_covariance)
    angular_velocity = _float64s(_gaussian(noise, 0.002, 0.0, 0.0, motion.turn_rad_s), angular_covariance)
    acceleration = _float64s(_gaussian(noise, 0.02, 0.0, 0.0, GRAVITY_M_S2), acceleration_covariance)
    return orientation + angular_velocity + acceleration


def _child_frame(sensor: Sensor) -> bytes:
    return packed_string(sensor.child_frame or "base_link")


def _odometry(sensor: Sensor, noise: Random, motion: RobotMotionState) -> bytes:
    covariance = _diagonal(*ODOMETRY_VARIANCES)
    angular = (0.0, 0.0, noise.gauss(motion.turn_rad_s, 1e-3))
    pose = _float64s((motion.x_m, motion.y_m, 0.0), _heading_quaternion(motion.yaw_rad), covariance)
    twist = _float64s((motion.speed_m_s, 0.0, 0.0), angular, covariance)
    return _child_frame(sensor) + pose + twist


def _transforms(sensor: Sensor, _: Random, motion: RobotMotionState) -> bytes:
    """Return one transform, from the odometry frame to the robot's frame: the robot's pose in odometry (REP 105)."""
    return _child_frame(sensor) + _float64s((motion.x_m, motion.y_m, 0.0), _heading_quaternion(motion.yaw_rad))


def _battery_state(_: Sensor, noise: Random, _motion: RobotMotionState) -> bytes:
    voltage, design_capacity, percentage = noise.gauss(11.1, 0.01), 1.8, 0.8
    unknown = math.nan  # sensor_msgs/BatteryState: "if unmeasured NaN"
    discharging, good, polymer, present = 2, 1, 3, True  # POWER_SUPPLY_STATUS, _HEALTH, _TECHNOLOGY
    measured_fields = struct.pack("<7f", voltage, *[unknown] * 4, design_capacity, percentage)
    state = struct.pack("<3B?", discharging, good, polymer, present)
    no_cells = _float32s(()) * 2  # voltages and temperatures of the cells
    return measured_fields + state + no_cells + packed_string("") * 2  # location and serial number of the battery


def _range(_: Sensor, noise: Random, motion: RobotMotionState) -> bytes:
    infrared = 1  # sensor_msgs/Range.INFRARED
    low_m, high_m = 0.02, 4.0
    down_m = max(ON_GROUND_RANGE_M, motion.position_m[2]) + abs(noise.gauss(0.0, 0.005))
    return struct.pack("<B4f", infrared, math.radians(25.0), low_m, high_m, _reported_range_m(down_m, low_m, high_m))


def _nav_sat_fix(_: Sensor, noise: Random, motion: RobotMotionState) -> bytes:
    fix, gps, diagonal_known = 0, 1, 2  # NavSatStatus.STATUS_FIX, .SERVICE_GPS; COVARIANCE_TYPE_DIAGONAL_KNOWN
    east_m, north_m, up_m = motion.position_m
    latitude, longitude = math.degrees(north_m / NORTH_RADIUS_M), math.degrees(east_m / EAST_RADIUS_M)
    horizontal_m, vertical_m = FIX_NOISE_M
    horizontal_deg = math.degrees(horizontal_m / EAST_RADIUS_M)
    fix_position = (*_gaussian(noise, horizontal_deg, latitude, longitude), noise.gauss(up_m, vertical_m))
    covariance = _diagonal(horizontal_m**2, horizontal_m**2, vertical_m**2)
    return struct.pack("<bH", fix, gps) + _float64s(fix_position, covariance) + struct.pack("<B", diagonal_known)


def _magnetic_field(_: Sensor, noise: Random, motion: RobotMotionState) -> bytes:
    north_t, up_t = FIELD_T
    ahead_t, left_t = north_t * math.sin(motion.heading_rad), north_t * math.cos(motion.heading_rad)
    return _float64s(_gaussian(noise, 1e-7, ahead_t, left_t, up_t), _diagonal(*[1e-14] * 3))


def _fluid_pressure(_: Sensor, noise: Random, motion: RobotMotionState) -> bytes:
    # Standard atmosphere, ISO 2533, at a height above the sea; then the variance.
    pressure_pa = 101_325.0 * (1 - 0.0065 * motion.position_m[2] / 288.15) ** 5.25588
    return _float64s((noise.gauss(pressure_pa, 3.0), 9.0))


def _temperature(_: Sensor, noise: Random, _motion: RobotMotionState) -> bytes:
    return _float64s((noise.gauss(20.0, 0.1), 0.01))  # then the variance


def _pose_stamped(_: Sensor, __: Random, motion: RobotMotionState) -> bytes:
    # In the world's frame, which REP 105 calls `map`.
    return _float64s(motion.position_m, _heading_quaternion(motion.heading_rad))


GENERATORS: Final[dict[str, Generator]] = {
    "sensor_msgs/LaserScan": _laser_scan,
    "sensor_msgs/Imu": _imu,
    "nav_msgs/Odometry": _odometry,
    "tf2_msgs/TFMessage": _transforms,
    "sensor_msgs/BatteryState": _battery_state,
    "sensor_msgs/Range": _range,
    "sensor_msgs/NavSatFix": _nav_sat_fix,
    "sensor_msgs/MagneticField": _magnetic_field,
    "sensor_msgs/FluidPressure": _fluid_pressure,
    "sensor_msgs/Temperature": _temperature,
    "geometry_msgs/PoseStamped": _pose_stamped,
}
"""Generator per message type; its keys are `sensor_specs.GENERATED_TYPES`."""
