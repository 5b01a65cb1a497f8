"""Motion of an emulated robot as the lab knows it: samples of the record that its base or its autopilot writes.

The times come from these samples alone, not from anything that fieldkit or its programs on the robot report.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Self

from fieldkit.core.model import Vector
from sim_backends.emulated.ros.steered import Steered

PERIOD_S: Final = 0.02
"""Between two samples; the base and the autopilot write at this rate while the robot moves."""
STILL_M_S: Final = 0.02
STILL_RAD_S: Final = 0.02
"""A robot below both is stationary."""
STILL_FOR_S: Final = 0.4
"""It has stopped where it was stationary for this time: a new attempt sets it in motion after a second."""
REMAINS_S: Final = 5.0
"""A robot that was stationary before a fault has stopped where it was stationary for this time: it may start late."""
DESCENDS_M_S: Final = 0.1
"""A drone that sinks faster than this descends."""
GROUND_M: Final = 0.02
"""A drone that is stationary at most this high over its place at the start is on the ground."""
AGAIN_M: Final = 0.05
AGAIN_RAD: Final = 0.1
"""A robot that goes or turns farther than this after it has stopped moves again."""


class MotionSample(NamedTuple):
    """Motion of a robot at one moment.

    Attributes:
        at_s: The moment, by the monotonic clock.
        east_m: Position east of the place at the start.
        north_m: Position north of it.
        up_m: Position above it.
        speed_m_s: Speed, in all three directions.
        rises_m_s: Vertical speed, upwards.
        heading_rad: Heading, relative to that at the start, to the left.
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
    def still(self) -> bool:
        """Whether it is stationary."""
        return self.speed_m_s < STILL_M_S and abs(self.turn_rad_s) < STILL_RAD_S

    @property
    def off_m(self) -> float:
        """Distance from its place at the start, over the ground."""
        return math.hypot(self.east_m, self.north_m)

    @property
    def on_ground(self) -> bool:
        """Whether a drone is on the ground."""
        return self.still and self.up_m < GROUND_M


def stopped_s(samples: Sequence[MotionSample], since_s: float, for_s: float = STILL_FOR_S) -> float | None:
    """Return how long after `since_s` a ground robot stopped, and was stationary `for_s`; None where it did not."""
    return _begins_s(samples, since_s, for_s, lambda sample: sample.still)


def grounded_s(samples: Sequence[MotionSample], since_s: float, for_s: float = STILL_FOR_S) -> float | None:
    """Return how long after `since_s` a drone was on the ground, and stayed `for_s`; None where it was not."""
    return _begins_s(samples, since_s, for_s, lambda sample: sample.on_ground)


def descended_s(samples: Sequence[MotionSample], since_s: float) -> float | None:
    """Return how long after `since_s` a drone first descended, or was on the ground; None where it did not."""
    first = (
        sample.at_s
        for sample in samples
        if sample.at_s >= since_s and (sample.rises_m_s < -DESCENDS_M_S or sample.on_ground)
    )
    at_s = next(first, None)
    return None if at_s is None else at_s - since_s


def moved_again_m(samples: Sequence[MotionSample], stopped_at_s: float) -> float:
    """Return how far a robot went from where it had stopped; in metres, a turn counts half a metre per radian.

    Args:
        samples: Its motion.
        stopped_at_s: When it had stopped.
    """
    after = [sample for sample in samples if sample.at_s >= stopped_at_s]
    if not after:
        return 0.0
    rest = after[0]
    gone_m = max(
        math.dist((rest.east_m, rest.north_m, rest.up_m), (sample.east_m, sample.north_m, sample.up_m))
        for sample in after
    )
    turned_rad = max(abs(math.remainder(sample.heading_rad - rest.heading_rad, math.tau)) for sample in after)
    return max(gone_m if gone_m > AGAIN_M else 0.0, turned_rad / 2 if turned_rad > AGAIN_RAD else 0.0)


def _begins_s(
    samples: Sequence[MotionSample], since_s: float, for_s: float, holds: Callable[[MotionSample], bool]
) -> float | None:
    """Return how long after `since_s` something began to hold that held for `for_s`."""
    begin_s: float | None = None
    for sample in samples:
        if sample.at_s < since_s:
            continue
        if not holds(sample):
            begin_s = None
        elif begin_s is None:
            begin_s = sample.at_s
        if begin_s is not None and sample.at_s - begin_s >= for_s:
            return begin_s - since_s
    return None


class MotionSampler:
    """Samples the motion of one robot; use as a context manager.

    Args:
        record: Returns the record of the robot, as `EmulatedRobot.steered`.
        start_m: Place of the robot now, where it is stationary: east, north, up.
    """

    def __init__(self, record: Callable[[], Steered | None], start_m: Vector) -> None:
        self.samples: list[MotionSample] = []
        self._record = record
        self._start_m = start_m
        self._begun_ns = time.monotonic_ns()
        self._heading_rad: float | None = None
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._run, name="motion sampler", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._left.set()
        self._thread.join()

    @property
    def now(self) -> MotionSample | None:
        """The newest sample; None before the first one."""
        return self.samples[-1] if self.samples else None

    def _run(self) -> None:
        while not self._left.wait(PERIOD_S):
            now_ns = time.monotonic_ns()
            record = self._record()
            if record is None or record.time_ns < self._begun_ns:  # of an earlier motion: it was carried off since
                self.samples.append(MotionSample(now_ns / 1e9, *([0.0] * 7)))
            else:
                self.samples.append(self._sample(record.at(now_ns), now_ns))

    def _sample(self, motion: Steered, now_ns: int) -> MotionSample:
        if self._heading_rad is None:
            self._heading_rad = motion.heading_rad
        east_m, north_m, up_m = (now - then for now, then in zip(motion.place_m, self._start_m, strict=True))
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
