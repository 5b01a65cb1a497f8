"""What the autopilot tells of itself without being asked each time: the messages, and how often each is due."""

import math
from collections.abc import Callable, Mapping
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.battery import CELLS
from sim_backends.emulated.autopilot.firmware import LANDING, Mode
from sim_backends.emulated.autopilot.mavlink import EKF_STATUS_REPORT, Message, dialect, ekf_status_report
from sim_backends.emulated.autopilot.plan import degrees_e7
from sim_backends.emulated.autopilot.vehicle import Vehicle

_UNKNOWN_CELL: Final = 0xFFFF

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
_ESTIMATED: Final = (
    dialect.ESTIMATOR_ATTITUDE
    | dialect.ESTIMATOR_VELOCITY_HORIZ
    | dialect.ESTIMATOR_VELOCITY_VERT
    | dialect.ESTIMATOR_POS_HORIZ_REL
    | dialect.ESTIMATOR_POS_HORIZ_ABS
    | dialect.ESTIMATOR_POS_VERT_ABS
    | dialect.ESTIMATOR_PRED_POS_HORIZ_REL
    | dialect.ESTIMATOR_PRED_POS_HORIZ_ABS
)
"""What it knows of itself: all. EKF_STATUS_REPORT has the same bits."""


class Telemetry:
    """Makes messages of the state of a vehicle.

    Args:
        vehicle: The vehicle.
        system: Its id.
        now_ns: When it was switched on, by the clock of the vehicle.
    """

    def __init__(self, vehicle: Vehicle, system: int, now_ns: int) -> None:
        self._vehicle = vehicle
        self._system = system
        self._on_ns = now_ns
        d = dialect
        self.makers: Final[Mapping[int, Callable[[], Message]]] = {
            d.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            d.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            d.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps_raw_int,
            d.MAVLINK_MSG_ID_ATTITUDE: self._attitude,
            d.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._local_position,
            d.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            d.MAVLINK_MSG_ID_MISSION_CURRENT: self.mission_current,
            d.MAVLINK_MSG_ID_VFR_HUD: self._vfr_hud,
            d.MAVLINK_MSG_ID_BATTERY_STATUS: self._battery_status,
            d.MAVLINK_MSG_ID_AUTOPILOT_VERSION: self._autopilot_version,
            d.MAVLINK_MSG_ID_HOME_POSITION: self._home_position,
            d.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended_sys_state,
            **self._estimates(),
        }
        """By the ids of the messages."""

    def _estimates(self) -> dict[int, Callable[[], Message]]:
        """Return what each family tells of its estimate of position."""
        if self._vehicle.firmware.autopilot == dialect.MAV_AUTOPILOT_ARDUPILOTMEGA:
            return {EKF_STATUS_REPORT: lambda: ekf_status_report(_ESTIMATED)}
        return {dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS: self._estimator_status}

    def _estimator_status(self) -> Message:
        return dialect.MAVLink_estimator_status_message(self._boot_ms * 1000, _ESTIMATED, *(0.1,) * 8)

    @property
    def _boot_ms(self) -> int:
        return (self._vehicle.body.now_ns - self._on_ns) // 1_000_000 % (1 << 32)

    @property
    def _world_m(self) -> Vector:
        home, here = self._vehicle.home_m, self._vehicle.body.position_m
        return home[0] + here[0], home[1] + here[1], home[2] + here[2]

    def _heartbeat(self) -> Message:
        vehicle, firmware = self._vehicle, self._vehicle.firmware
        base = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | firmware.base
        px4 = firmware.autopilot == dialect.MAV_AUTOPILOT_PX4
        base |= dialect.MAV_MODE_FLAG_AUTO_ENABLED if px4 and vehicle.mode is not Mode.OFFBOARD else 0
        base |= dialect.MAV_MODE_FLAG_SAFETY_ARMED if vehicle.armed else 0
        return dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_QUADROTOR,
            firmware.autopilot,
            base,
            firmware.modes[vehicle.mode],
            dialect.MAV_STATE_ACTIVE if vehicle.armed else dialect.MAV_STATE_STANDBY,
            3,
        )

    def _sys_status(self) -> Message:
        battery = self._vehicle.battery
        ill = dialect.MAV_SYS_STATUS_PREARM_CHECK if self._vehicle.unfit else 0
        return dialect.MAVLink_sys_status_message(
            *(_SENSORS, _SENSORS, _SENSORS & ~ill),
            *(200, round(battery.voltage_v * 1e3), round(battery.current_a * 1e2), math.ceil(battery.left * 100)),
            *(0,) * 6,
        )

    def _battery_status(self) -> Message:
        battery = self._vehicle.battery
        cells = [round(battery.voltage_v / CELLS * 1e3)] * CELLS + [_UNKNOWN_CELL] * (10 - CELLS)
        return dialect.MAVLink_battery_status_message(
            0,
            dialect.MAV_BATTERY_FUNCTION_ALL,
            dialect.MAV_BATTERY_TYPE_LIPO,
            0x7FFF,
            cells,
            *(round(battery.current_a * 1e2), -1, -1, math.ceil(battery.left * 100)),
        )

    def _gps_raw_int(self) -> Message:
        east_m, north_m, up_m = self._world_m
        east, north, _ = self._vehicle.body.velocity_m_s
        return dialect.MAVLink_gps_raw_int_message(
            self._boot_ms * 1000,
            dialect.GPS_FIX_TYPE_3D_FIX,
            *degrees_e7(east_m, north_m),
            round(up_m * 1e3),
            *(80, 120, round(math.hypot(east, north) * 1e2), self._course_cdeg(east, north), 12),
        )

    @staticmethod
    def _course_cdeg(east: float, north: float) -> int:
        return round(math.degrees(math.atan2(east, north)) * 100) % 36_000

    @property
    def _heading_rad(self) -> float:
        """From north to the right, as MAVLink has it."""
        return math.remainder(math.pi / 2 - self._vehicle.body.yaw_rad, math.tau)

    def _attitude(self) -> Message:
        return dialect.MAVLink_attitude_message(
            self._boot_ms, *self._vehicle.body.tilt_rad, self._heading_rad, 0.0, 0.0, 0.0
        )

    def _local_position(self) -> Message:
        (x, y, z), (east, north, up) = self._vehicle.body.position_m, self._vehicle.body.velocity_m_s
        return dialect.MAVLink_local_position_ned_message(self._boot_ms, y, x, -z, north, east, -up)

    def _global_position(self) -> Message:
        east_m, north_m, up_m = self._world_m
        east, north, up = (round(one * 1e2) for one in self._vehicle.body.velocity_m_s)
        return dialect.MAVLink_global_position_int_message(
            self._boot_ms,
            *degrees_e7(east_m, north_m),
            *(round(up_m * 1e3), round(self._vehicle.body.position_m[2] * 1e3)),
            *(north, east, -up, round(math.degrees(self._heading_rad) * 100) % 36_000),
        )

    def _home_position(self) -> Message:
        east_m, north_m, up_m = self._vehicle.home_m
        return dialect.MAVLink_home_position_message(
            *degrees_e7(east_m, north_m), round(up_m * 1e3), 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0
        )

    def mission_current(self) -> Message:
        """Return MISSION_CURRENT, which answers questions, too."""
        mission = self._vehicle.mission
        return dialect.MAVLink_mission_current_message(mission.current, len(mission.items))

    def _extended_sys_state(self) -> Message:
        body, mode = self._vehicle.body, self._vehicle.mode
        state = dialect.MAV_LANDED_STATE_IN_AIR
        if body.on_ground:
            state = dialect.MAV_LANDED_STATE_ON_GROUND
        elif mode is Mode.TAKEOFF:
            state = dialect.MAV_LANDED_STATE_TAKEOFF
        elif mode in LANDING:
            state = dialect.MAV_LANDED_STATE_LANDING
        return dialect.MAVLink_extended_sys_state_message(dialect.MAV_VTOL_STATE_UNDEFINED, state)

    def _vfr_hud(self) -> Message:
        east, north, up = self._vehicle.body.velocity_m_s
        speed_m_s = math.hypot(east, north)
        heading_deg = round(math.degrees(self._heading_rad)) % 360
        return dialect.MAVLink_vfr_hud_message(speed_m_s, speed_m_s, heading_deg, 0, self._world_m[2], up)

    def _autopilot_version(self) -> Message:
        firmware = self._vehicle.firmware
        return dialect.MAVLink_autopilot_version_message(
            firmware.capabilities, firmware.version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, self._system
        )
