"""Read the position samples of one robot from a bag. The entry point group `fieldkit.positions` lists `read_bag`."""

from pathlib import Path

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.positions.position_files import MAX_STALE_S
from fieldkit.measure.positions.position_sources import PositionSource
from fieldkit.measure.positions.samples import PLACED, WGS84, Samples
from fieldkit.ros.bags import bag


def read_bag(path: Path, position_source: PositionSource) -> Samples:
    """Return the samples in a topic of a bag. Times are by the robot's clock.

    If several messages have the same time, the first is used.

    Raises:
        EvidenceError: The bag cannot be read; the topic has no positions, or several frames or types; or stamps are
            used and differ at the median by more than `MAX_STALE_S` from the times of reception.
    """
    topic = position_source.topic
    topic_data = bag.positions(path, topic, position_source.child)
    if not topic_data["rows"]:
        raise EvidenceError(
            f"no position in {topic}", where=str(path), remedy="check that a node publishes the topic"
        )
    ((kind, *other_kinds), (frame, *other_frames)) = topic_data["types"], topic_data["frames"]
    if other_kinds:
        raise EvidenceError(
            f"{topic} has messages of several types: {', '.join(topic_data['types'])}",
            where=str(path),
            remedy="check that only one node publishes the topic",
        )
    if other_frames:
        raise EvidenceError(
            f"{topic} has positions in several frames: {', '.join(topic_data['frames'])}",
            where=str(path),
            remedy="write the robot's frame as child: FRAME, in the step track",
        )
    times = np.array([row[:2] for row in topic_data["rows"]], dtype=np.int64)
    values = np.array([row[2:] for row in topic_data["rows"]], dtype=float)
    uses_header_stamps = position_source.stamps == "header"
    stale_s = abs(np.median(times[:, 0] - times[:, 1])) / 1e9
    if uses_header_stamps and stale_s > MAX_STALE_S:
        raise EvidenceError(
            f"the stamps of {topic} differ by {stale_s:.0f} s from the times of reception",
            where=str(path),
            remedy="write times: received, in the step",
        )
    times_ns, first = np.unique(times[:, 0 if uses_header_stamps else 1], return_index=True)
    frames = {"sensor_msgs/msg/NavSatFix": WGS84, "nav_msgs/msg/Odometry": PLACED}
    is_odometry = frames.get(kind) == PLACED
    yaws_rad = values[first, 3] if is_odometry else None
    return Samples(times_ns, values[first, :3], frames.get(kind, f"frame {frame}"), yaws_rad)
