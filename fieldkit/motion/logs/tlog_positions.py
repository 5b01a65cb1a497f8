"""Position samples of one robot from a telemetry log: the entry point `tlog` of `fieldkit.positions`."""

from pathlib import Path

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.positions.position_files import MAX_STALE_S
from fieldkit.measure.positions.position_sources import PositionSource
from fieldkit.measure.positions.samples import PLACED, WGS84, Samples, require_increasing
from fieldkit.motion.logs import tlog


def read_tlog(path: Path, position_source: PositionSource) -> Samples:
    """Return the samples of a message type in a telemetry log. Times are by the recorder's clock.

    If `stamps` is `header`, a time is the autopilot's time since boot plus a constant offset. The offset is computed
    from the message with the lowest delay, because a radio may delay other messages.

    Raises:
        EvidenceError: The log cannot be read, has no such message, or the autopilot restarted during the recording.
    """
    rows = tlog.positions(path, position_source.system, position_source.topic)
    if not rows:
        raise EvidenceError(
            f"no {position_source.topic}", where=str(path), remedy="request it: set `rates` in the `mavlink` step"
        )
    received_ns = np.array([row[0] for row in rows], dtype=np.int64) * 1_000
    times_ns = received_ns
    if position_source.stamps == "header":
        boot_ns = np.array([row[1] for row in rows], dtype=np.int64) * 1_000_000
        if (np.diff(boot_ns) < -MAX_STALE_S * 1e9).any():
            raise EvidenceError(
                "the autopilot restarted", where=str(path), remedy="write times: received, in the `mavlink` step"
            )
        times_ns = boot_ns + (received_ns - boot_ns).min()
    times_ns, first = np.unique(times_ns, return_index=True)
    # The times are sorted and unique, so only the range of the first and the last one must be checked.
    require_increasing([int(times_ns[0]), int(times_ns[-1])][: len(times_ns)], [str(path)] * 2)
    values = np.array([row[2:] for row in rows], dtype=float)[first]
    is_local = position_source.topic == tlog.LOCAL
    return Samples(times_ns, values[:, :3], PLACED if is_local else WGS84, values[:, 3] if is_local else None)
