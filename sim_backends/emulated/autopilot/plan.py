"""Items of a mission as uploaded, and their positions."""

import math
from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.fence import is_within
from sim_backends.emulated.autopilot.mavlink import Message, dialect
from sim_backends.emulated.ros.messages import EAST_RADIUS_M, NORTH_RADIUS_M

MAX_ITEMS: Final = 500

WAITS: Final = frozenset({dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_LOITER_TIME, dialect.MAV_CMD_NAV_DELAY})
"""Commands whose first parameter is the time to stay in seconds."""
PLACED: Final = frozenset(
    {
        dialect.MAV_CMD_NAV_WAYPOINT,
        dialect.MAV_CMD_NAV_LOITER_TIME,
        dialect.MAV_CMD_NAV_TAKEOFF,
        dialect.MAV_CMD_NAV_LAND,
    }
)
FLOWN: Final = WAITS | PLACED | {dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH, dialect.MAV_CMD_DO_CHANGE_SPEED}
PASSED: Final = frozenset(
    {
        dialect.MAV_CMD_DO_MOUNT_CONTROL,
        dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE,
        dialect.MAV_CMD_DO_GIMBAL_MANAGER_PITCHYAW,
    }
)
"""Commands for gimbals, which ground stations add to every plan; the drone has no gimbal and skips them."""

_ABOVE_HOME: Final = (dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT, dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
_ABOVE_SEA: Final = (dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_GLOBAL_INT)


@dataclass(frozen=True)
class Item:
    """One item, as in MISSION_ITEM_INT.

    Attributes:
        frame: MAV_FRAME.
        command: MAV_CMD.
        parameters: First four parameters of the command.
        x: Latitude, 1e-7 degrees.
        y: Longitude, 1e-7 degrees.
        z: Height in metres above the reference of the frame.
        autocontinue: Its field as received.
    """

    frame: int
    command: int
    parameters: tuple[float, float, float, float]
    x: int
    y: int
    z: float
    autocontinue: int = 1


def item_of(message: Message) -> Item:
    """Return the item of a MISSION_ITEM_INT."""
    parameters = (message.param1, message.param2, message.param3, message.param4)
    return Item(message.frame, message.command, parameters, message.x, message.y, message.z, message.autocontinue)


def goal_m(frame: int, x: int, y: int, z: float, home_m: Vector) -> Vector | None:
    """Return a position of MAVLink in metres east, north, up of home; None for a frame that is not supported."""
    if frame not in _ABOVE_HOME + _ABOVE_SEA or not math.isfinite(z):
        return None
    east_m, north_m = world_m(x, y)
    up_m = z - (home_m[2] if frame in _ABOVE_SEA else 0.0)
    return east_m - home_m[0], north_m - home_m[1], up_m


def world_m(latitude_e7: int, longitude_e7: int) -> tuple[float, float]:
    """Return a position in the world, metres east and north of its origin."""
    return math.radians(longitude_e7 / 1e7) * EAST_RADIUS_M, math.radians(latitude_e7 / 1e7) * NORTH_RADIUS_M


def degrees_e7(east_m: float, north_m: float) -> tuple[int, int]:
    """Return latitude and longitude of a position in the world, 1e-7 degrees; the inverse of `world_m`."""
    latitude, longitude = math.degrees(north_m / NORTH_RADIUS_M), math.degrees(east_m / EAST_RADIUS_M)
    return round(latitude * 1e7), round(longitude * 1e7)


def fault(item: Item, home_m: Vector, fence_m: tuple[float, float]) -> int:
    """Return the fault of an item as MAV_MISSION_RESULT; ACCEPTED if it has none.

    Args:
        item: The item.
        home_m: Home in the world.
        fence_m: Maximum horizontal distance from home, and maximum height.
    """
    if item.command not in FLOWN | PASSED:
        return int(dialect.MAV_MISSION_UNSUPPORTED)
    has_no_position = item.command == dialect.MAV_CMD_NAV_LAND and item.x == item.y == 0
    if item.command not in PLACED or has_no_position:
        return int(dialect.MAV_MISSION_ACCEPTED)
    goal = goal_m(item.frame, item.x, item.y, item.z, home_m)
    if goal is None:
        return int(dialect.MAV_MISSION_UNSUPPORTED_FRAME)
    if item.command == dialect.MAV_CMD_NAV_TAKEOFF:  # straight up from where it is
        goal = (0.0, 0.0, goal[2])
    inside = is_within(goal, fence_m)
    return int(dialect.MAV_MISSION_ACCEPTED if inside else dialect.MAV_MISSION_DENIED)
