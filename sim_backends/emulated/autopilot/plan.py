"""The plan of a mission: its items as they came, and where they lead."""

import math
from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.autopilot.fence import is_within
from sim_backends.emulated.autopilot.mavlink import Message, dialect
from sim_backends.emulated.ros.messages import EAST_RADIUS_M, NORTH_RADIUS_M

MOST_ITEMS: Final = 500

WAITS: Final = frozenset({dialect.MAV_CMD_NAV_WAYPOINT, dialect.MAV_CMD_NAV_LOITER_TIME, dialect.MAV_CMD_NAV_DELAY})
"""Whose first parameter says how many seconds to stay."""
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
"""For gimbals, which ground stations put into every plan: this drone has none, and goes on."""

_ABOVE_HOME: Final = (dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT, dialect.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT)
_ABOVE_SEA: Final = (dialect.MAV_FRAME_GLOBAL, dialect.MAV_FRAME_GLOBAL_INT)


@dataclass(frozen=True)
class Item:
    """One item, as in MISSION_ITEM_INT.

    Attributes:
        frame: MAV_FRAME.
        command: MAV_CMD.
        parameters: The first four of the command.
        x: Latitude, 1e-7 degrees.
        y: Longitude, 1e-7 degrees.
        z: Height in metres, above what the frame says.
        autocontinue: As it came.
    """

    frame: int
    command: int
    parameters: tuple[float, float, float, float]
    x: int
    y: int
    z: float
    autocontinue: int = 1


def item_of(message: Message) -> Item:
    """Return the item in a MISSION_ITEM_INT."""
    parameters = (message.param1, message.param2, message.param3, message.param4)
    return Item(message.frame, message.command, parameters, message.x, message.y, message.z, message.autocontinue)


def goal_m(frame: int, x: int, y: int, z: float, home_m: Vector) -> Vector | None:
    """Return where a place of MAVLink is, metres east, north, up of home; None for a frame that is not flown in."""
    if frame not in _ABOVE_HOME + _ABOVE_SEA or not math.isfinite(z):
        return None
    east_m, north_m = world_m(x, y)
    up_m = z - (home_m[2] if frame in _ABOVE_SEA else 0.0)
    return east_m - home_m[0], north_m - home_m[1], up_m


def world_m(latitude_e7: int, longitude_e7: int) -> tuple[float, float]:
    """Return where a place is in the world, metres east and north of its origin."""
    return math.radians(longitude_e7 / 1e7) * EAST_RADIUS_M, math.radians(latitude_e7 / 1e7) * NORTH_RADIUS_M


def degrees_e7(east_m: float, north_m: float) -> tuple[int, int]:
    """Return latitude and longitude of a place in the world, 1e-7 degrees; `world_m` the other way."""
    latitude, longitude = math.degrees(north_m / NORTH_RADIUS_M), math.degrees(east_m / EAST_RADIUS_M)
    return round(latitude * 1e7), round(longitude * 1e7)


def fault(item: Item, home_m: Vector, fence_m: tuple[float, float]) -> int:
    """Return what is wrong with an item, MAV_MISSION_RESULT: ACCEPTED is nothing.

    Args:
        item: The item.
        home_m: Where home is in the world.
        fence_m: How far from home the drone may fly, over the ground and up.
    """
    if item.command not in FLOWN | PASSED:
        return int(dialect.MAV_MISSION_UNSUPPORTED)
    placeless = item.command == dialect.MAV_CMD_NAV_LAND and item.x == item.y == 0
    if item.command not in PLACED or placeless:
        return int(dialect.MAV_MISSION_ACCEPTED)
    goal = goal_m(item.frame, item.x, item.y, item.z, home_m)
    if goal is None:
        return int(dialect.MAV_MISSION_UNSUPPORTED_FRAME)
    if item.command == dialect.MAV_CMD_NAV_TAKEOFF:  # straight up, wherever it stands
        goal = (0.0, 0.0, goal[2])
    inside = is_within(goal, fence_m)
    return int(dialect.MAV_MISSION_ACCEPTED if inside else dialect.MAV_MISSION_DENIED)
