"""What an emulated robot's sensors say: one small generator per ROS message type, serialized as ROS 1 does.

A robot at rest in a rectangular room. Numbers that a real sensor would jitter carry noise, so that nothing compresses
better than it would in the field.
"""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from rosbags.typesys import Stores, get_typestore

from fieldkit.errors import ConfigurationError, nearest
from sim_backends.emulated.spec import Sensor

_STORE: Final = get_typestore(Stores.ROS1_NOETIC)
_TYPES: Final = _STORE.types

GRAVITY_M_S2: Final = 9.80665  # standard gravity, ISO 80000-3
ROOM_HALF_M: Final = (2.0, 1.5)
LASER_RANGE_M: Final = (0.12, 3.5)  # LDS-01, ROBOTIS e-Manual
LASER_NOISE_M: Final = 0.015  # LDS-01 from 0.12 to 0.499 m, ROBOTIS e-Manual

Fields = dict[str, Any]
Generator = Callable[[Sensor, np.random.Generator], Fields]


class Source:
    """Makes the messages of one sensor.

    Args:
        sensor: Which.

    Raises:
        ConfigurationError: There is no generator for its type, or it lacks what its type needs.
    """

    def __init__(self, sensor: Sensor) -> None:
        check(sensor)
        self._sensor = sensor
        self._generate = GENERATORS[sensor.type]
        package, name = sensor.type.split("/")
        self._type = f"{package}/msg/{name}"
        # Equal robots say equal things, whenever they start.
        self._noise = np.random.default_rng(list(sensor.topic.encode()))
        self.definition, self.md5 = _STORE.generate_msgdef(self._type, ros_version=1)

    def message(self, number: int, stamp_ns: int) -> bytes:
        """Return message `number`, stamped in nanoseconds since the epoch, serialized."""
        header = _new(
            "std_msgs/Header",
            seq=number & 0xFFFFFFFF,
            stamp=_new("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9),
            frame_id=self._sensor.frame,
        )
        message = _TYPES[self._type](header=header, **self._generate(self._sensor, self._noise))
        return bytes(_STORE.serialize_ros1(message, self._type))


def check(sensor: Sensor) -> None:
    """Check that an emulated robot can publish `sensor`.

    Raises:
        ConfigurationError: There is no generator for its type, or it lacks what its type needs.
    """
    if sensor.type not in GENERATORS:
        known = nearest(sensor.type, GENERATORS, f"known types: {', '.join(GENERATORS)}")
        raise ConfigurationError(
            f"an emulated robot cannot publish {sensor.type}",
            where=f"topic {sensor.topic}",
            remedy=f"{known} Or add a generator to sim_backends/emulated/messages.py",
        )
    if sensor.rate_hz <= 0:
        raise ConfigurationError(
            "a topic with rate 0Hz says nothing", where=f"topic {sensor.topic}", remedy="write 5Hz"
        )
    if sensor.type == "sensor_msgs/LaserScan" and sensor.points is None:
        raise ConfigurationError(
            "a laser scan needs `points`, beams per turn", where=f"topic {sensor.topic}", remedy="write points: 360"
        )


def _new(kind: str, **fields: Any) -> Any:  # noqa: ANN401 (rosbags makes its types at run time)
    package, name = kind.split("/")
    return _TYPES[f"{package}/msg/{name}"](**fields)


def _vector(x: float, y: float, z: float) -> Any:  # noqa: ANN401 (rosbags makes its types at run time)
    return _new("geometry_msgs/Vector3", x=x, y=y, z=z)


def _upright() -> Any:  # noqa: ANN401 (rosbags makes its types at run time)
    return _new("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)


def _pose() -> Any:  # noqa: ANN401 (rosbags makes its types at run time)
    return _new(
        "geometry_msgs/Pose", position=_new("geometry_msgs/Point", x=0.0, y=0.0, z=0.0), orientation=_upright()
    )


def _diagonal(variance: float, size: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return (np.eye(size) * variance).ravel()


def _laser_scan(sensor: Sensor, noise: np.random.Generator) -> Fields:
    points = sensor.points or 0
    angle = np.arange(points) * (2 * math.pi / points)
    with np.errstate(divide="ignore"):
        walls = np.minimum(ROOM_HALF_M[0] / np.abs(np.cos(angle)), ROOM_HALF_M[1] / np.abs(np.sin(angle)))
    ranges = walls + noise.normal(0.0, LASER_NOISE_M, points)
    return {
        "angle_min": 0.0,
        "angle_max": float(angle[-1]),
        "angle_increment": 2 * math.pi / points,
        "time_increment": 1 / sensor.rate_hz / points,
        "scan_time": 1 / sensor.rate_hz,
        "range_min": LASER_RANGE_M[0],
        "range_max": LASER_RANGE_M[1],
        "ranges": np.clip(ranges, *LASER_RANGE_M).astype(np.float32),
        "intensities": noise.integers(1_000, 12_000, points).astype(np.float32),
    }


def _imu(_: Sensor, noise: np.random.Generator) -> Fields:
    return {
        "orientation": _upright(),
        "orientation_covariance": _diagonal(1e-4, 3),
        "angular_velocity": _vector(*noise.normal(0.0, 0.002, 3)),
        "angular_velocity_covariance": _diagonal(4e-6, 3),
        "linear_acceleration": _vector(*noise.normal((0.0, 0.0, GRAVITY_M_S2), 0.02)),
        "linear_acceleration_covariance": _diagonal(4e-4, 3),
    }


def _odometry(_: Sensor, noise: np.random.Generator) -> Fields:
    twist = _new(
        "geometry_msgs/Twist", linear=_vector(0.0, 0.0, 0.0), angular=_vector(0.0, 0.0, noise.normal(0.0, 1e-3))
    )
    covariance = _diagonal(1e-4, 6)
    return {
        "child_frame_id": "base_footprint",
        "pose": _new("geometry_msgs/PoseWithCovariance", pose=_pose(), covariance=covariance),
        "twist": _new("geometry_msgs/TwistWithCovariance", twist=twist, covariance=covariance),
    }


def _battery_state(_: Sensor, noise: np.random.Generator) -> Fields:
    unknown = math.nan  # sensor_msgs/BatteryState: "if unmeasured NaN"
    return {
        "voltage": 11.1 + noise.normal(0.0, 0.01),
        "temperature": unknown,
        "current": unknown,
        "charge": unknown,
        "capacity": unknown,
        "design_capacity": 1.8,
        "percentage": 0.8,
        "power_supply_status": 2,
        "power_supply_health": 1,
        "power_supply_technology": 3,
        "present": True,
        "cell_voltage": np.zeros(0, np.float32),
        "cell_temperature": np.zeros(0, np.float32),
        "location": "",
        "serial_number": "",
    }


def _range(_: Sensor, noise: np.random.Generator) -> Fields:
    infrared = 1  # sensor_msgs/Range.INFRARED
    low_m, high_m = 0.02, 4.0
    return {
        "radiation_type": infrared,
        "field_of_view": math.radians(25.0),
        "min_range": low_m,
        "max_range": high_m,
        "range": 0.1 + abs(noise.normal(0.0, 0.005)),
    }


def _nav_sat_fix(_: Sensor, noise: np.random.Generator) -> Fields:
    fix, gps, diagonal_known = 0, 1, 2  # NavSatStatus.STATUS_FIX, .SERVICE_GPS; COVARIANCE_TYPE_DIAGONAL_KNOWN
    return {
        "status": _new("sensor_msgs/NavSatStatus", status=fix, service=gps),
        "latitude": noise.normal(0.0, 1e-6),
        "longitude": noise.normal(0.0, 1e-6),
        "altitude": noise.normal(0.0, 0.5),
        "position_covariance": _diagonal(0.25, 3),
        "position_covariance_type": diagonal_known,
    }


def _magnetic_field(_: Sensor, noise: np.random.Generator) -> Fields:
    # Field of about 48 uT that dips, as in mid-latitudes (IGRF).
    return {
        "magnetic_field": _vector(*noise.normal((20e-6, 0.0, -44e-6), 1e-7)),
        "magnetic_field_covariance": _diagonal(1e-14, 3),
    }


def _fluid_pressure(_: Sensor, noise: np.random.Generator) -> Fields:
    return {"fluid_pressure": 101_325.0 + noise.normal(0.0, 3.0), "variance": 9.0}  # standard atmosphere, ISO 2533


def _temperature(_: Sensor, noise: np.random.Generator) -> Fields:
    return {"temperature": 20.0 + noise.normal(0.0, 0.1), "variance": 0.01}


def _pose_stamped(_: Sensor, __: np.random.Generator) -> Fields:
    return {"pose": _pose()}


GENERATORS: Final[dict[str, Generator]] = {
    "sensor_msgs/LaserScan": _laser_scan,
    "sensor_msgs/Imu": _imu,
    "nav_msgs/Odometry": _odometry,
    "sensor_msgs/BatteryState": _battery_state,
    "sensor_msgs/Range": _range,
    "sensor_msgs/NavSatFix": _nav_sat_fix,
    "sensor_msgs/MagneticField": _magnetic_field,
    "sensor_msgs/FluidPressure": _fluid_pressure,
    "sensor_msgs/Temperature": _temperature,
    "geometry_msgs/PoseStamped": _pose_stamped,
}
"""Generator per message type."""
