"""What the autopilot tells of itself without being asked each time: the messages, and how often each is due."""

import math
from collections.abc import Callable, Mapping
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.mavlink import Message, dialect
from sim_backends.emulated.autopilot.plan import degrees_e7
from sim_backends.emulated.autopilot.vehicle import Mode, Vehicle

CELL_V: Final = (3.5, 4.2)
"""Voltage of a lithium polymer cell, empty and full."""
CELLS: Final = 3
_HOVER_A: Final = 10.0
_REST_A: Final = 0.5
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
_CAPABILITIES: Final = (
    dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
_VERSION: Final = 0x010F00FF
"""1.15.0, a release: the PX4 whose modes these are."""

FLIGHT_S: Final = 15 * 60
"""How long a charge lasts in the air."""


class Battery:
    """A charge that flying uses up; at rest it lasts longer by the ratio of the currents."""

    def __init__(self, now_ns: int) -> None:
        self._last_ns = now_ns
        self.left = 1.0
        self.current_a = _REST_A

    def advance(self, now_ns: int, *, driven: bool) -> None:
        """Use what the time since the last call takes."""
        self.current_a = _HOVER_A if driven else _REST_A
        used = (now_ns - self._last_ns) / 1e9 / FLIGHT_S * self.current_a / _HOVER_A
        self.left, self._last_ns = max(0.0, self.left - used), now_ns

    @property
    def voltage_v(self) -> float:
        """That of the whole battery, in proportion to what is left."""
        empty, full = CELL_V
        return CELLS * (empty + (full - empty) * self.left)


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
        self.battery = Battery(now_ns)
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
        }
        """By the ids of the messages."""

    @property
    def _boot_ms(self) -> int:
        return (self._vehicle.body.now_ns - self._on_ns) // 1_000_000 % (1 << 32)

    @property
    def _world_m(self) -> Vector:
        home, here = self._vehicle.home_m, self._vehicle.body.position_m
        return home[0] + here[0], home[1] + here[1], home[2] + here[2]

    def _heartbeat(self) -> Message:
        vehicle = self._vehicle
        main, sub = vehicle.mode.value
        base = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | dialect.MAV_MODE_FLAG_STABILIZE_ENABLED
        base |= dialect.MAV_MODE_FLAG_GUIDED_ENABLED
        base |= dialect.MAV_MODE_FLAG_AUTO_ENABLED if vehicle.mode is not Mode.OFFBOARD else 0
        base |= dialect.MAV_MODE_FLAG_SAFETY_ARMED if vehicle.armed else 0
        return dialect.MAVLink_heartbeat_message(
            dialect.MAV_TYPE_QUADROTOR,
            dialect.MAV_AUTOPILOT_PX4,
            base,
            main << 16 | sub << 24,
            dialect.MAV_STATE_ACTIVE if vehicle.armed else dialect.MAV_STATE_STANDBY,
            3,
        )

    def _sys_status(self) -> Message:
        battery = self.battery
        return dialect.MAVLink_sys_status_message(
            *(_SENSORS,) * 3,
            *(200, round(battery.voltage_v * 1e3), round(battery.current_a * 1e2), math.ceil(battery.left * 100)),
            *(0,) * 6,
        )

    def _battery_status(self) -> Message:
        battery = self.battery
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
        elif mode is Mode.LAND:
            state = dialect.MAV_LANDED_STATE_LANDING
        return dialect.MAVLink_extended_sys_state_message(dialect.MAV_VTOL_STATE_UNDEFINED, state)

    def _vfr_hud(self) -> Message:
        east, north, up = self._vehicle.body.velocity_m_s
        speed_m_s = math.hypot(east, north)
        heading_deg = round(math.degrees(self._heading_rad)) % 360
        return dialect.MAVLink_vfr_hud_message(speed_m_s, speed_m_s, heading_deg, 0, self._world_m[2], up)

    def _autopilot_version(self) -> Message:
        return dialect.MAVLink_autopilot_version_message(
            _CAPABILITIES, _VERSION, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, self._system
        )
