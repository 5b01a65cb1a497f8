"""Helm of an emulated robot: moves the robot for the process that steers it, a base controller or an autopilot.

The process reads where the lab put the robot, computes the motion from there, and writes it to a record, which the
lab passes to the medium and the robot's sensors read. The lab may put the robot elsewhere at any time; records that
refer to an earlier path are then ignored.
"""

from pathlib import Path

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.own_motion import Odometer, OwnMotion
from sim_backends.emulated.ros.steered import Steered, SteeredRecord
from sim_backends.world.motion import STILL


class Helm:
    """Steers one robot; only one process of a robot may have it.

    Args:
        paths: The file of the paths that the lab assigns (`own_motion.append_path`).
        record: The file in which the robot records its motion.
        now_ns: Time of creation, by the monotonic clock.

    Raises:
        OSError: The record cannot be created.
    """

    def __init__(self, paths: Path, record: Path, now_ns: int) -> None:
        self._record = SteeredRecord.open(record)
        self._odometer = Odometer(paths, now_ns, record)
        self._path_start_ns: int | None = None

    def poll_placement(self, now_ns: int) -> OwnMotion | None:
        """Return where the lab has put the robot since the last call, or None if it has not.

        The first call returns where the robot is, also after the process has been restarted.

        Args:
            now_ns: Time by the monotonic clock; must not decrease from call to call.
        """
        here = self._odometer.at(now_ns)
        if self._odometer.path_start_ns == self._path_start_ns:
            return None
        self._path_start_ns = self._odometer.path_start_ns
        return here

    def write(
        self,
        now_ns: int,
        place_m: Vector,
        velocity_m_s: Vector = STILL,
        *,
        heading_rad: float = 0.0,
        turn_rad_s: float = 0.0,
        wheels: Vector = (0.0, 0.0, 0.0),
    ) -> None:
        """Record the robot's position and motion; see `Steered`.

        Call it ten times a second or more while the robot moves, because a robot without a record for
        `steered.SILENT_NS` stops; and once after it has stopped.

        Raises:
            OSError: There is no space for it.
        """
        path_start_ns = self._path_start_ns or 0
        self._record.write(Steered(now_ns, path_start_ns, place_m, velocity_m_s, heading_rad, turn_rad_s, wheels))
