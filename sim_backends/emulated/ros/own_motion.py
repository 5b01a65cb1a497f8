"""Motion of an emulated robot as its sensors know it: its wheels count, and satellites see its place.

The lab says each way when it begins, and the robot works out the rest, so that nothing is late. Who carries it back
to its place turns no wheel: its odometry goes on from where it was. A robot that steers itself (`helm`) says where it
is, from the place where the lab put it last.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.steered import SteeredRecord
from sim_backends.world.motion import STILL, WayPoints


@dataclass(frozen=True)
class OwnWay:
    """Way of one robot, which stands at its end; of one point, its place.

    Attributes:
        began_ns: When it begins, by the monotonic clock, which all robots of a machine share.
        points_m: Where it goes, metres east, north, up.
        speed_m_s: How fast.
        facing_rad: Where the robot faces before it goes, from east towards north.
    """

    began_ns: int
    points_m: Sequence[Vector]
    speed_m_s: float
    facing_rad: float


@dataclass(frozen=True)
class OwnMotion:
    """A robot at one moment.

    Attributes:
        x_m: How far its wheels took it ahead of where it was switched on, as it faced then.
        y_m: And to the left of that.
        yaw_rad: How far it turned to the left since.
        speed_m_s: How fast it drives, ahead.
        place_m: Where it is, metres east, north, up.
        heading_rad: Where it faces, from east towards north.
        turn_rad_s: How fast it turns to the left; who is led along a way does so at once.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    speed_m_s: float = 0.0
    place_m: Vector = (0.0, 0.0, 0.0)
    heading_rad: float = 0.0
    turn_rad_s: float = 0.0


AT_REST: Final = OwnMotion()


def say(path: Path, way: OwnWay) -> None:
    """Add a way to the file in which a robot's sensors look for it."""
    with path.open("a", encoding="ascii") as file:
        file.write(json.dumps(asdict(way)) + "\n")


class Odometer:
    """Counts from when it is made.

    Args:
        path: The file of ways, which may be missing.
        now_ns: When that is, by the monotonic clock.
        steered: The file in which the robot says how it steers itself; None for one that cannot.
    """

    def __init__(self, path: Path, now_ns: int, steered: Path | None = None) -> None:
        self._path = path
        self._record = None if steered is None else SteeredRecord.open(steered)
        self._read_bytes = 0
        self._way: OwnWay | None = None
        self._base = AT_REST
        self._look(now_ns)
        self._base = AT_REST
        if self._way is not None:
            here = _driven(self._way, AT_REST, now_ns)
            turned = -here.yaw_rad
            x_m, y_m = _turned(here.x_m, here.y_m, turned)
            self._base = OwnMotion(-x_m, -y_m, turned)

    def at(self, now_ns: int) -> OwnMotion:
        """Return how the robot is at a moment; asked with times that never go back."""
        self._look(now_ns)
        return self._steered(now_ns) or self._carried(now_ns)

    @property
    def way_ns(self) -> int:
        """When the way began that the lab said last, 0 before it said any."""
        return 0 if self._way is None else self._way.began_ns

    def _steered(self, now_ns: int) -> OwnMotion | None:
        """Return how it is by its own power; None if it has not used that since the lab put it where it is."""
        said = None if self._record is None else self._record.read()
        if said is None or said.way_ns != self.way_ns:
            return None
        now = said.at(now_ns)
        speed_m_s = said.speed_m_s if now.moves else 0.0  # a velocity that is reckoned on does not turn
        return OwnMotion(*now.wheels, speed_m_s, now.place_m, now.heading_rad, now.turn_rad_s)

    def _carried(self, now_ns: int) -> OwnMotion:
        """Return how it is on the way that the lab said last."""
        return self._base if self._way is None else _driven(self._way, self._base, now_ns)

    def _look(self, now_ns: int) -> None:
        """Take in what the lab has said since."""
        try:
            if self._path.stat().st_size == self._read_bytes:
                return
            with self._path.open("rb") as file:
                file.seek(self._read_bytes)
                said = file.read()
        except FileNotFoundError:
            return
        whole = said[: said.rfind(b"\n") + 1]
        self._read_bytes += len(whole)
        for line in whole.splitlines():
            way = OwnWay(**json.loads(line))
            then_ns = min(way.began_ns, now_ns)
            self._base = self._steered(then_ns) or self._carried(then_ns)
            self._way = way


def _driven(way: OwnWay, base: OwnMotion, now_ns: int) -> OwnMotion:
    """Return how a robot is at a moment on its way, which was so when that began."""
    elapsed_ns = now_ns - way.began_ns
    points_m = [(point_m[0], point_m[1], 0.0) for point_m in way.points_m]  # its speed is that over the map
    (east_m, north_m, _), velocity_m_s, _ = WayPoints("", points_m, way.speed_m_s).at(elapsed_ns)[""]
    heading_rad = way.facing_rad
    if velocity_m_s != STILL:
        heading_rad = math.atan2(velocity_m_s[1], velocity_m_s[0])
    elif elapsed_ns > 0 and len(points_m) > 1:
        before, last = points_m[-2:]
        heading_rad = math.atan2(last[1] - before[1], last[0] - before[0])
    x_m, y_m = _turned(east_m - points_m[0][0], north_m - points_m[0][1], base.yaw_rad - way.facing_rad)
    return OwnMotion(
        base.x_m + x_m,
        base.y_m + y_m,
        base.yaw_rad + math.remainder(heading_rad - way.facing_rad, 2 * math.pi),
        math.hypot(*velocity_m_s[:2]),
        (east_m, north_m, _height_m(way, elapsed_ns)),
        heading_rad,
    )


def _height_m(way: OwnWay, elapsed_ns: int) -> float:
    """Return how high a robot is, the ground being straight between the points of its way."""
    left_m = max(elapsed_ns, 0) / 1e9 * way.speed_m_s
    for begin, end in pairwise(way.points_m):
        long_m = math.dist(begin[:2], end[:2])
        if left_m < long_m:
            return begin[2] + left_m / long_m * (end[2] - begin[2])
        left_m -= long_m
    return way.points_m[-1][2]


def _turned(x: float, y: float, by_rad: float) -> tuple[float, float]:
    cos, sin = math.cos(by_rad), math.sin(by_rad)
    return cos * x - sin * y, sin * x + cos * y
