"""Ground-truth motion of an emulated robot, sampled from the record that its base or autopilot writes.

All times come from these samples, not from reports of fieldkit or of its programs on the robot.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Self

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.motion_record import RecordedMotion

PERIOD_S: Final = 0.02
"""Interval between two samples; the base and the autopilot write at this rate while the robot moves."""
STATIONARY_M_S: Final = 0.02
STATIONARY_RAD_S: Final = 0.02
"""A robot whose speed and rate of turn are below these limits is stationary."""
STOPPED_FOR_S: Final = 0.4
"""A robot has stopped once it is stationary for this time; a new attempt sets it in motion after one second."""
STATIONARY_FOR_S: Final = 5.0
"""The same for a robot that was stationary before the fault, which may start to move late."""
DESCENDS_M_S: Final = 0.1
"""A drone descends if its vertical speed is below the negative of this."""
GROUND_M: Final = 0.02
"""A drone is on the ground if it is stationary and at most this high above its start position."""
MOVED_AGAIN_M: Final = 0.05
TURNED_AGAIN_RAD: Final = 0.1
"""A stopped robot moves again if it travels or turns farther than this."""


class MotionSample(NamedTuple):
    """Motion of a robot at one time.

    Attributes:
        at_s: Monotonic time.
        east_m: Position east of the start position.
        north_m: Position north of the start position.
        up_m: Height above the start position.
        speed_m_s: Speed in three dimensions.
        rises_m_s: Vertical speed, positive upwards.
        heading_rad: Heading relative to the start, positive to the left.
        turn_rad_s: Rate of turn.
    """

    at_s: float
    east_m: float
    north_m: float
    up_m: float
    speed_m_s: float
    rises_m_s: float
    heading_rad: float
    turn_rad_s: float

    @property
    def is_stationary(self) -> bool:
        """True if the robot is stationary."""
        return self.speed_m_s < STATIONARY_M_S and abs(self.turn_rad_s) < STATIONARY_RAD_S

    @property
    def from_start_m(self) -> float:
        """Horizontal distance from the start position."""
        return math.hypot(self.east_m, self.north_m)

    @property
    def on_ground(self) -> bool:
        """True if the robot is a drone on the ground."""
        return self.is_stationary and self.up_m < GROUND_M


def stopped_s(samples: Sequence[MotionSample], since_s: float, for_s: float = STOPPED_FOR_S) -> float | None:
    """Time from `since_s` until a ground robot was stationary for at least `for_s`; None if it did not stop."""
    return _start_s(samples, since_s, for_s, lambda sample: sample.is_stationary)


def grounded_s(samples: Sequence[MotionSample], since_s: float, for_s: float = STOPPED_FOR_S) -> float | None:
    """Time from `since_s` until a drone was on the ground for at least `for_s`; None if it was not."""
    return _start_s(samples, since_s, for_s, lambda sample: sample.on_ground)


def descended_s(samples: Sequence[MotionSample], since_s: float) -> float | None:
    """Time from `since_s` until a drone first descended or was on the ground; None if it did neither."""
    descent_times = (
        sample.at_s
        for sample in samples
        if sample.at_s >= since_s and (sample.rises_m_s < -DESCENDS_M_S or sample.on_ground)
    )
    at_s = next(descent_times, None)
    return None if at_s is None else at_s - since_s


def moved_again_m(samples: Sequence[MotionSample], stopped_at_s: float) -> float:
    """Distance that a robot moved after it had stopped, in metres; a turn counts as half a metre per radian.

    Args:
        samples: The motion of the robot.
        stopped_at_s: The time at which it had stopped.
    """
    later = [sample for sample in samples if sample.at_s >= stopped_at_s]
    if not later:
        return 0.0
    reference = later[0]
    distance_m = max(
        math.dist((reference.east_m, reference.north_m, reference.up_m), (sample.east_m, sample.north_m, sample.up_m))
        for sample in later
    )
    turned_rad = max(abs(math.remainder(sample.heading_rad - reference.heading_rad, math.tau)) for sample in later)
    return max(
        distance_m if distance_m > MOVED_AGAIN_M else 0.0, turned_rad / 2 if turned_rad > TURNED_AGAIN_RAD else 0.0
    )


def _start_s(
    samples: Sequence[MotionSample], since_s: float, for_s: float, condition: Callable[[MotionSample], bool]
) -> float | None:
    """Time from `since_s` until a condition became true and stayed true for `for_s`; None if it did not."""
    start_s: float | None = None
    for sample in samples:
        if sample.at_s < since_s:
            continue
        if not condition(sample):
            start_s = None
        elif start_s is None:
            start_s = sample.at_s
        if start_s is not None and sample.at_s - start_s >= for_s:
            return start_s - since_s
    return None


class MotionSampler:
    """Samples the motion of one robot in a thread; a context manager.

    Args:
        record: Returns the motion record of the robot, like `EmulatedRobot.recorded_motion`.
        start_m: Present position of the stationary robot: east, north, up.
    """

    def __init__(self, record: Callable[[], RecordedMotion | None], start_m: Vector) -> None:
        self.samples: list[MotionSample] = []
        self._record = record
        self._start_m = start_m
        self._begun_ns = time.monotonic_ns()
        self._heading_rad: float | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="motion sampler", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    @property
    def newest(self) -> MotionSample | None:
        """The newest sample; None before the first."""
        return self.samples[-1] if self.samples else None

    def _run(self) -> None:
        while not self._stopping.wait(PERIOD_S):
            now_ns = time.monotonic_ns()
            record = self._record()
            if record is None or record.time_ns < self._begun_ns:  # from before a relocation
                self.samples.append(MotionSample(now_ns / 1e9, *([0.0] * 7)))
            else:
                self.samples.append(self._sample(record.at(now_ns), now_ns))

    def _sample(self, motion: RecordedMotion, now_ns: int) -> MotionSample:
        if self._heading_rad is None:
            self._heading_rad = motion.heading_rad
        east_m, north_m, up_m = (
            newest - origin_m for newest, origin_m in zip(motion.position_m, self._start_m, strict=True)
        )
        return MotionSample(
            now_ns / 1e9,
            east_m,
            north_m,
            up_m,
            math.hypot(*motion.velocity_m_s),
            motion.velocity_m_s[2],
            math.remainder(motion.heading_rad - self._heading_rad, math.tau),
            motion.turn_rad_s,
        )
