"""The helm of an emulated robot: how what steers it, a base controller or an autopilot, moves it in the lab.

Whoever is at the helm asks where the robot was put, works out where its own power takes it from there, and says so;
the lab tells the medium, and the robot's sensors follow. Carrying it elsewhere is the lab's, at any time: what the
helm says of a way that is over is not heard any more.
"""

from pathlib import Path

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.own_motion import Odometer, OwnMotion
from sim_backends.emulated.ros.steered import Steered, SteeredRecord
from sim_backends.world.motion import STILL


class Helm:
    """Steers one robot; one process of a robot has it.

    Args:
        ways: The file in which the lab says how it moves the robot (`own_motion.append_path`).
        record: The file in which the robot says how it moves itself.
        now_ns: When it is made, by the monotonic clock.

    Raises:
        OSError: The record cannot be made.
    """

    def __init__(self, ways: Path, record: Path, now_ns: int) -> None:
        self._record = SteeredRecord.open(record)
        self._odometer = Odometer(ways, now_ns, record)
        self._way_ns: int | None = None

    def put(self, now_ns: int) -> OwnMotion | None:
        """Return where the lab has put the robot since this was asked last; None if it has not.

        The first time it is where the robot is, also after the process at the helm has ended and begun again.

        Args:
            now_ns: When that is; never before what was asked last.
        """
        here = self._odometer.at(now_ns)
        if self._odometer.way_ns == self._way_ns:
            return None
        self._way_ns = self._odometer.way_ns
        return here

    def say(
        self,
        now_ns: int,
        place_m: Vector,
        velocity_m_s: Vector = STILL,
        *,
        heading_rad: float = 0.0,
        turn_rad_s: float = 0.0,
        wheels: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        """Say where the robot is by its own power and how it moves; see `Steered`.

        While it moves this is to be said often, ten times a second or more: one that is silent for
        `steered.SILENT_NS` stands. Once it stands, say so once.

        Raises:
            OSError: There is no room for it.
        """
        way_ns = self._way_ns or 0
        self._record.write(Steered(now_ns, way_ns, place_m, velocity_m_s, heading_rad, turn_rad_s, wheels))
