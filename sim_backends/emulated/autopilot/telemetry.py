"""Telemetry of the emulated autopilot: messages with the state of the vehicle."""

import math
from collections.abc import Callable, Mapping
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot import mavlink_frames
from sim_backends.emulated.autopilot.mavlink_frames import Message, dialect
from sim_backends.emulated.autopilot.mission_plan import degrees_e7
from sim_backends.emulated.autopilot.modes import LANDING, Mode
from sim_backends.emulated.autopilot.onboard_estimates import CELLS
from sim_backends.emulated.autopilot.parameters import Parameters
from sim_backends.emulated.autopilot.vehicle import Vehicle
from sim_backends.world.motion import GRAVITY_M_S2

_UNKNOWN_CELL: Final = 0xFFFF
"""Voltage value that means that the battery does not have this cell."""
_NAN: Final = math.nan
_METADATA: Final = "mftp:///etc/extras/component_general.json.xz"
"""Location of PX4's metadata; the emulated file transfer answers that this file does not exist."""
_MAGNET_GAUSS: Final = 0.21, 0.0, 0.42
"""Magnetic field north, east, down in gauss; typical for middle latitudes."""
_SEA_HPA: Final = 1013.25

_SENSORS: Final = (
    dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | dialect.MAV_SYS_STATUS_SENSOR_3D_MAG
    | dialect.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
    | dialect.MAV_SYS_STATUS_SENSOR_GPS
    | dialect.MAV_SYS_STATUS_SENSOR_BATTERY
    | dialect.MAV_SYS_STATUS_GEOFENCE
    | dialect.MAV_SYS_STATUS_PREARM_CHECK
)
"""Sensors and checks that SYS_STATUS reports."""


class Telemetry:
    """Builds messages with the state of a vehicle.

    Args:
        vehicle: The vehicle.
        parameters: Its parameters.
    """

    def __init__(self, vehicle: Vehicle, parameters: Parameters) -> None:
        self._vehicle = vehicle
        self._parameters = parameters
        self._pings = 0
        d = dialect
        is_ardupilot = vehicle.firmware.is_ardupilot
        self.builders: Final[Mapping[int, Callable[[], Message | None]]] = {
            d.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            d.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            d.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw_int,
            d.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            d.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            d.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            d.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._origin,
            d.MAVLINK_MSG_ID_MISSION_CURRENT: self.mission_current,
            d.MAVLINK_MSG_ID_VFR_HUD: self._vfr_hud,
            d.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery_status,
            d.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._autopilot_version,
            d.MAVLINK_MSG_ID_HOME_POSITION: self._home_position,
            d.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_sys_state,
            mavlink_frames.PROTOCOL_VERSION: mavlink_frames.protocol_version,
            **(self._ardupilot_builders() if is_ardupilot else self._px4_builders()),
        }
        """Builders by message id; a builder returns None while its message is not available."""
        self.streamed_only: Final = frozenset({mavlink_frames.EKF_STATUS_REPORT})
        """Messages that have a rate, but are not sent on request."""

    def _ardupilot_builders(self) -> dict[int, Callable[[], Message | None]]:
        return {
            dialect.MAVLINK_MSG_ID_RAW_IMU: self._raw_imu,
            dialect.MAVLINK_MSG_ID_TIMESYNC: self._timesync,
            mavlink_frames.EKF_STATUS_REPORT: lambda: mavlink_frames.ekf_status_report(self._vehicle.estimate.flags),
        }

    def _px4_builders(self) -> dict[int, Callable[[], Message | None]]:
        return {
            dialect.MAVLINK_MSG_ID_ALTITUDE: self._altitude,
            dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: self._estimator_status,
            dialect.MAVLINK_MSG_ID_HIGHRES_IMU: self._highres_imu,
            dialect.MAVLINK_MSG_ID_ODOMETRY: self._odometry,
            dialect.MAVLINK_MSG_ID_PING: self._ping,
            mavlink_frames.COMPONENT_METADATA: lambda: mavlink_frames.component_metadata(self._boot_ms, _METADATA),
        }

    def available_modes(self, index: float) -> list[Message]:
        """Return AVAILABLE_MODES of one mode, or of all modes for index 0; empty for an unknown index."""
        firmware = self._vehicle.firmware
        count = len(firmware.names)
        return [
            mavlink_frames.available_modes(count, number, _STANDARD.get(mode, 0), firmware.modes[mode], name)
            for number, (mode, name) in enumerate(firmware.names.items(), 1)
            if index in {0, number}
        ]

    @property
    def _boot_ms(self) -> int:
        since_ns = self._vehicle.body.now_ns - self._vehicle.estimate.booted_ns
        return round(since_ns / 1e6) % (1 << 32)

    @property
    def _boot_us(self) -> int:
        return self._boot_ms * 1000

    @property
    def _velocity_ned(self) -> Vector:
        east, north, up = self._vehicle.body.velocity_m_s
        return north, east, -up

    def _heartbeat(self) -> Message:
        vehicle, firmware = self._vehicle, self._vehicle.firmware
        base = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | firmware.base_mode
        is_px4 = not firmware.is_ardupilot
        is_automatic = vehicle.mode not in {Mode.OFFBOARD, Mode.STABILIZE, Mode.ALT_HOLD, Mode.POSHOLD}
        base |= dialect.MAV_MODE_FLAG_AUTO_ENABLED if is_px4 and is_automatic else 0
        base |= dialect.MAV_MODE_FLAG_SAFETY_ARMED if vehicle.is_armed else 0
        return dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_QUADROTOR, firmware.autopilot, base, firmware.modes[vehicle.mode], self._state(), 3
        )

    def _state(self) -> int:
        """Return MAV_STATE: ArduCopter is ACTIVE after it lifts off, PX4 while it is armed."""
        vehicle = self._vehicle
        is_ardupilot = vehicle.firmware.is_ardupilot
        if vehicle.failsafes.active and (is_ardupilot or vehicle.is_armed):
            return int(dialect.MAV_STATE_CRITICAL)
        is_active = vehicle.is_armed and not (is_ardupilot and vehicle.land_detector.has_landed)
        return int(dialect.MAV_STATE_ACTIVE if is_active else dialect.MAV_STATE_STANDBY)

    def _sys_status(self) -> Message:
        battery = self._vehicle.battery
        failed_check = dialect.MAV_SYS_STATUS_PREARM_CHECK if self._vehicle.arming_errors else 0
        return dialect.MAVLink_sys_status_message(
            *(_SENSORS, _SENSORS, _SENSORS & ~failed_check),
            # 200: the processor load is 20 %. The zeros are error counters.
            *(200, _u16(battery.voltage_v * 1e3), round(battery.current_a * 1e2), math.ceil(battery.charge * 100)),
            *(0,) * 6,
        )

    def _battery_status(self) -> Message:
        battery = self._vehicle.battery
        cells = [_u16(battery.voltage_v / CELLS * 1e3)] * CELLS + [_UNKNOWN_CELL] * (10 - CELLS)
        return dialect.MAVLink_battery_status_message(
            0,
            dialect.MAV_BATTERY_FUNCTION_ALL,
            dialect.MAV_BATTERY_TYPE_LIPO,
            0x7FFF,  # unknown temperature
            cells,
            *(round(battery.current_a * 1e2), round(battery.used_mah), -1, math.ceil(battery.charge * 100)),
        )

    def _gps_raw_int(self) -> Message:
        east_m, north_m, up_m = self._vehicle.body.place_m
        east, north, _ = self._vehicle.body.velocity_m_s
        has_fix = self._vehicle.estimate.has_fix(self._vehicle.body.now_ns)
        fix = self._vehicle.firmware.fix_type if has_fix else dialect.GPS_FIX_TYPE_NO_FIX
        return dialect.MAVLink_gps_raw_int_message(
            self._boot_us,
            fix,
            *degrees_e7(east_m, north_m),
            round(up_m * 1e3),
            # HDOP 0.8, VDOP 1.2, and 12 satellites.
            *(80, 120, round(math.hypot(east, north) * 1e2), self._course_cdeg(east, north), 12),
        )

    @staticmethod
    def _course_cdeg(east: float, north: float) -> int:
        return round(math.degrees(math.atan2(east, north)) * 100) % 36_000

    @property
    def _heading_rad(self) -> float:
        """Heading from north clockwise, as in MAVLink."""
        return math.remainder(math.pi / 2 - self._vehicle.body.yaw_rad, math.tau)

    @property
    def _rates(self) -> Vector:
        return 0.0, 0.0, -self._vehicle.body.turn_rad_s

    @property
    def _quaternion(self) -> tuple[float, float, float, float]:
        """Rotation from NED to the body axes (forward, right, down): w, x, y, z."""
        (roll, pitch), yaw = self._vehicle.body.tilt_rad, self._heading_rad
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(half / 2), math.sin(half / 2)) for half in (roll, pitch, yaw))
        return (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )

    def _in_body(self, vector: Vector) -> Vector:
        """Return a NED vector in body axes: forward, right, down."""
        w, x, y, z = self._quaternion
        north, east, down = vector
        return (
            (1 - 2 * (y * y + z * z)) * north + 2 * (x * y + w * z) * east + 2 * (x * z - w * y) * down,
            2 * (x * y - w * z) * north + (1 - 2 * (x * x + z * z)) * east + 2 * (y * z + w * x) * down,
            2 * (x * z + w * y) * north + 2 * (y * z - w * x) * east + (1 - 2 * (x * x + y * y)) * down,
        )

    def _attitude(self) -> Message:
        return dialect.MAVLink_attitude_message(
            self._boot_ms, *self._vehicle.body.tilt_rad, self._heading_rad, *self._rates
        )

    def _attitude_quaternion(self) -> Message:
        return dialect.MAVLink_attitude_quaternion_message(self._boot_ms, *self._quaternion, *self._rates)

    def _highres_imu(self) -> Message:
        up_m = self._vehicle.body.place_m[2]
        acceleration = self._in_body((0.0, 0.0, -GRAVITY_M_S2))
        return dialect.MAVLink_highres_imu_message(
            self._boot_us,
            *acceleration,
            *self._rates,
            *self._in_body(_MAGNET_GAUSS),
            # Differential pressure 0, temperature 25 degrees; all fields are valid.
            *(_pressure_hpa(up_m), 0.0, up_m, 25.0, 0xFFFF),
        )

    def _raw_imu(self) -> Message:
        acceleration = (round(part / GRAVITY_M_S2 * 1e3) for part in self._in_body((0.0, 0.0, -GRAVITY_M_S2)))
        rates = (round(part * 1e3) for part in self._rates)
        field = (round(part * 1e3) for part in self._in_body(_MAGNET_GAUSS))
        return dialect.MAVLink_raw_imu_message(self._boot_us, *acceleration, *rates, *field)

    def _odometry(self) -> Message | None:
        local_m = self._vehicle.local_m
        if local_m is None:
            return None
        east, north, up = local_m
        return dialect.MAVLink_odometry_message(
            *(self._boot_us, dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD),
            *(north, east, -up),
            self._quaternion,
            *self._in_body(self._velocity_ned),
            *self._rates,
            *([_NAN] * 21, [_NAN] * 21),
            *(0, dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT, 100),
        )

    def _altitude(self) -> Message:
        above_m = self._vehicle.body.position_m[2]
        local_m = self._vehicle.local_m
        sea_m = self._vehicle.body.place_m[2]
        return dialect.MAVLink_altitude_message(
            self._boot_us, sea_m, sea_m, local_m[2] if local_m else _NAN, above_m, _NAN, _NAN
        )

    def _estimator_status(self) -> Message:
        return dialect.MAVLink_estimator_status_message(self._boot_us, self._vehicle.estimate.flags, *(0.1,) * 8)

    def _timesync(self) -> Message:
        return dialect.MAVLink_timesync_message(0, self._boot_ms * 1_000_000)

    def _ping(self) -> Message:
        self._pings += 1
        return dialect.MAVLink_ping_message(self._boot_us, self._pings % (1 << 32), 0, 0)

    def _local_position(self) -> Message | None:
        local_m = self._vehicle.local_m
        if local_m is None:
            return None
        east, north, up = local_m
        return dialect.MAVLink_local_position_ned_message(self._boot_ms, north, east, -up, *self._velocity_ned)

    def _global_position(self) -> Message:
        east_m, north_m, up_m = self._vehicle.body.place_m
        velocity = (round(part * 1e2) for part in self._velocity_ned)
        return dialect.MAVLink_global_position_int_message(
            self._boot_ms,
            *degrees_e7(east_m, north_m),
            *(round(up_m * 1e3), round(self._vehicle.body.position_m[2] * 1e3)),
            *(*velocity, round(math.degrees(self._heading_rad) * 100) % 36_000),
        )

    def _origin(self) -> Message | None:
        origin_m = self._vehicle.estimate.origin_m
        if origin_m is None:
            return None
        return dialect.MAVLink_gps_global_origin_message(
            *degrees_e7(*origin_m[:2]), round(origin_m[2] * 1e3), self._boot_us
        )

    def _home_position(self) -> Message | None:
        vehicle = self._vehicle
        home_m = vehicle.estimate.to_local(vehicle.home_m)
        if home_m is None:
            return None
        east, north, up = home_m
        return dialect.MAVLink_home_position_message(
            *degrees_e7(*vehicle.home_m[:2]),
            *(round(vehicle.home_m[2] * 1e3), north, east, -up),
            *([1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0),
        )

    def mission_current(self) -> Message:
        """Return MISSION_CURRENT, which is also sent as an answer."""
        mission = self._vehicle.mission
        return dialect.MAVLink_mission_current_message(mission.current, len(mission.items))

    def _extended_sys_state(self) -> Message:
        vehicle = self._vehicle
        state = dialect.MAV_LANDED_STATE_IN_AIR
        if vehicle.land_detector.has_landed:
            state = dialect.MAV_LANDED_STATE_ON_GROUND
        elif vehicle.mode is Mode.TAKEOFF:
            state = dialect.MAV_LANDED_STATE_TAKEOFF
        elif vehicle.mode in LANDING:
            state = dialect.MAV_LANDED_STATE_LANDING
        return dialect.MAVLink_extended_sys_state_message(dialect.MAV_VTOL_STATE_UNDEFINED, state)

    def _vfr_hud(self) -> Message:
        east, north, up = self._vehicle.body.velocity_m_s
        speed_m_s = math.hypot(east, north)
        heading_deg = round(math.degrees(self._heading_rad)) % 360
        return dialect.MAVLink_vfr_hud_message(
            speed_m_s, speed_m_s, heading_deg, 0, self._vehicle.body.place_m[2], up
        )

    def _autopilot_version(self) -> Message:
        firmware = self._vehicle.firmware
        uid = round(self._parameters["MAV_SYS_ID"])
        return dialect.MAVLink_autopilot_version_message(
            firmware.capabilities, firmware.version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, uid
        )


_STANDARD: Final = {
    Mode.POSHOLD: 1,
    Mode.ALT_HOLD: 4,
    Mode.RTL: 5,
    Mode.MISSION: 6,
    Mode.LAND: 7,
    Mode.TAKEOFF: 8,
}
"""MAV_STANDARD_MODE (https://mavlink.io/en/services/standard_modes.html)."""


def _u16(value: float) -> int:
    return min(max(round(value), 0), 0xFFFE)


def _pressure_hpa(up_m: float) -> float:
    """Return the pressure at a height above the sea (ICAO standard atmosphere)."""
    return float(_SEA_HPA * max(0.0, 1 - 2.25577e-5 * up_m) ** 5.25588)
