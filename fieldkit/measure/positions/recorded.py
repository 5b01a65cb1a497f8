"""Samples of one robot out of what an account names: the messages of a bag or a telemetry log, GPX, or CSV."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import bag, reading
from fieldkit.measure.evidence.confined import Confined, ConfinedAnswerError
from fieldkit.measure.positions.accounts import Account
from fieldkit.measure.positions.samples import (
    MOST_SAMPLES,
    PLACED,
    WGS84,
    Samples,
    demand_rising,
    read_csv,
)

MOST_STALE_S: Final = 10.0
"""A message that was stamped longer before or after it came has another clock's time."""

_TLOG: Final = ".tlog"
_GPX_READER: Final = Confined("fieldkit.measure.positions.gpx_reader")


def read_file(path: Path) -> Samples:
    """Return what stands in GPX or CSV, told apart by how the name ends; times are the file's own.

    Raises:
        EvidenceError: It is neither, or not whole.
    """
    match path.suffix.lower():
        case ".csv":
            return read_csv(path)
        case ".gpx":
            return _read_gpx(path)
    raise EvidenceError("is neither GPX nor CSV", where=str(path), remedy="name a file that ends in .gpx or .csv")


def _read_gpx(path: Path) -> Samples:
    try:
        points = _GPX_READER.ask({"path": str(path.absolute())}, reading.size(path))["points"]
    except ConfinedAnswerError as error:
        raise EvidenceError(f"cannot be read as GPX: {error}", where=str(path)) from error
    if len(points) > MOST_SAMPLES:
        raise EvidenceError(f"has more than {MOST_SAMPLES} points", where=str(path), remedy="cut it to the trial")
    try:
        demand_rising([at_ns for at_ns, *_ in points], [f"point {number}" for number in range(1, len(points) + 1)])
    except EvidenceError as error:
        where = ", ".join(filter(None, (str(path), error.where)))
        raise EvidenceError(error.what, where=where, remedy=error.remedy) from error
    values = np.array(
        [[math.nan if value is None else value for value in point[1:]] for point in points], dtype=float
    )
    if not (np.isfinite(values[:, :2]).all() and (abs(values[:, :2]) <= (90, 180)).all()):
        raise EvidenceError("has a point that is no place", where=str(path), remedy="export the track again")
    return Samples(np.array([at_ns for at_ns, *_ in points]), values, WGS84)


def read_topic(path: Path, account: Account) -> Samples:
    """Return what a topic of a bag tells, or a kind of message in a telemetry log; times are the recorder's.

    Raises:
        EvidenceError: It cannot be read, or tells no places.
    """
    return read_tlog(path, account) if path.suffix == _TLOG else read_bag(path, account)


def read_tlog(path: Path, account: Account) -> Samples:
    """Return what messages of a telemetry log tell; times are the recorder's.

    With stamps, a message was true as long before it came as the autopilot's own time says, by the one that came
    soonest: a radio may hold others back.

    Raises:
        EvidenceError: The log cannot be read, has no such message, or the autopilot was started anew meanwhile.
    """
    from fieldkit.measure.motion import tlog  # noqa: PLC0415 (its columns take 2 ms to make, and few have one)

    rows = tlog.positions(path, account.system, account.topic)
    if not rows:
        raise EvidenceError(f"no {account.topic}", where=str(path), remedy="ask for it in rates, in the step mavlink")
    came_ns = np.array([row[0] for row in rows], dtype=np.int64) * 1_000
    times_ns = came_ns
    if account.stamps == "header":
        boot_ns = np.array([row[1] for row in rows], dtype=np.int64) * 1_000_000
        if (np.diff(boot_ns) < -MOST_STALE_S * 1e9).any():
            raise EvidenceError("the autopilot was started anew", where=str(path), remedy="write times: received")
        times_ns = boot_ns + (came_ns - boot_ns).min()
    times_ns, first = np.unique(times_ns, return_index=True)
    demand_rising([int(times_ns[0]), int(times_ns[-1])][: len(times_ns)], [str(path)] * 2)
    values = np.array([row[2:] for row in rows], dtype=float)[first]
    is_local = account.topic == tlog.LOCAL
    return Samples(times_ns, values[:, :3], PLACED if is_local else WGS84, values[:, 3] if is_local else None)


def read_bag(path: Path, account: Account) -> Samples:
    """Return what a topic of a bag tells; times are the robot's.

    Of messages of one time the first counts.

    Raises:
        EvidenceError: The bag cannot be read, or the topic tells no places, or in other frames or by another clock.
    """
    topic = account.topic
    told = bag.positions(path, topic, account.child)
    if not told["rows"]:
        raise EvidenceError(f"no position of {topic}", where=str(path), remedy="does the topic publish?")
    ((kind, *other_kinds), (frame, *other_frames)) = told["types"], told["frames"]
    if other_kinds or other_frames:
        raise EvidenceError(
            f"{topic} tells places in {', '.join(told['frames'])}", where=str(path), remedy="name the child frame"
        )
    times = np.array([row[:2] for row in told["rows"]], dtype=np.int64)
    values = np.array([row[2:] for row in told["rows"]], dtype=float)
    stamped = account.stamps == "header"
    stale_s = abs(np.median(times[:, 0] - times[:, 1])) / 1e9
    if stamped and stale_s > MOST_STALE_S:
        raise EvidenceError(
            f"the stamps of {topic} are {stale_s:.0f} s from when its messages came",
            where=str(path),
            remedy="write times: received, in the step",
        )
    times_ns, first = np.unique(times[:, 0 if stamped else 1], return_index=True)
    frames = {"sensor_msgs/msg/NavSatFix": WGS84, "nav_msgs/msg/Odometry": PLACED}
    is_odometry = frames.get(kind) == PLACED
    yaws_rad = values[first, 3] if is_odometry else None
    return Samples(times_ns, values[first, :3], frames.get(kind, f"frame {frame}"), yaws_rad)


def from_start(samples: Samples, account: Account) -> Samples:
    """Return odometry in the frame of the placement: from where its robot stood, and faced, when the step began.

    Args:
        samples: Odometry, its times by the laptop's clock.
        account: Says from where and when.

    Raises:
        EvidenceError: It does not tell where the robot stood then.
    """
    assert samples.yaws_rad is not None
    if account.heading_rad is None:
        raise EvidenceError(
            f"{account.topic} tells no direction on the ground, and nobody says where its robot faced"
        )
    at = int(np.searchsorted(samples.times_ns, account.began_utc_ns, side="right")) - 1
    if at < 0:
        late_s = (int(samples.times_ns[0]) - account.began_utc_ns) / 1e9
        raise EvidenceError(f"{account.topic} begins {late_s:.1f} s after the robot may have moved")
    turn_rad = account.heading_rad - float(samples.yaws_rad[at])
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    from_start_m = samples.values - samples.values[at]
    turned = np.column_stack(
        (
            cos * from_start_m[:, 0] - sin * from_start_m[:, 1],
            sin * from_start_m[:, 0] + cos * from_start_m[:, 1],
            from_start_m[:, 2],
        )
    )
    return replace(samples, values=turned + np.array(account.start))
