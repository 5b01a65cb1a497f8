"""Telemetry logs of autopilots (`.tlog`), decoded in a sandboxed process, and the summaries of their recorders."""

import json
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from fieldkit.core.columns import Column, Figure, Kind, Measured, Value, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.text import JSON_ERRORS
from fieldkit.measure.evidence import reading
from fieldkit.measure.evidence.sandbox import ReaderError, SandboxedReader

SUFFIX: Final = ".tlog"
GLOBAL: Final = "GLOBAL_POSITION_INT"
LOCAL: Final = "LOCAL_POSITION_NED"
"""The messages with an autopilot's position."""

_PREFIX: Final = "mavlink_"
_TIME_TOLERANCE_US: Final = 1_000
"""Tolerance for the order of times, because the clock may be slewed."""
_OFFSET_BOUNDS_M: Final = (-1e9, 1e9)
_ANGLE: Final = (-360.0, 360.0)
_HEIGHT_BOUNDS: Final = (-1e6, 1e6)
"""Bounds of possible values of columns, also for vertical speeds; other values are omitted."""

COLUMNS: Final = columns(
    100,
    ("mavlink_messages", "count", "Messages of the autopilot that were received intact, without duplicates."),
    (
        "mavlink_sent",
        "count",
        "mavlink_messages, and messages that are missing according to gaps in sequence numbers and silences.",
    ),
    (
        "mavlink_loss_most",
        "share",
        "1 - mavlink_messages/mavlink_sent; an upper bound, because a router filters messages to other stations.",
    ),
    (
        "mavlink_periodic",
        "count",
        "Messages with time_boot_ms of streams whose period is known: requested, or an integer rate up to 10 Hz.",
    ),
    (
        "mavlink_periodic_sent",
        "count",
        "mavlink_periodic, and messages that are missing by both their period and the sequence numbers.",
    ),
    (
        "mavlink_loss",
        "share",
        "1 - mavlink_periodic/mavlink_periodic_sent.",
        Figure("MAVLink loss", Kind.COUNTED, "mavlink_periodic", "mavlink_periodic_sent", rank=82),
    ),
    ("mavlink_damaged", "count", "Frames of all senders with a wrong checksum."),
    ("mavlink_rate_hz", "Hz", "Messages per second that the autopilot sent, without silences.", (0.0, 1e6)),
    (
        "mavlink_silence_s",
        "s",
        "Longest time without a message of the autopilot.",
        Figure("MAVLink silence", Kind.MEDIAN, rank=83),
    ),
    ("mavlink_slow_s", "s", "Longest time in which a requested message arrived at less than 0.7 of its rate."),
    ("mavlink_drop_rate", "share", "Largest loss reported by the autopilot (SYS_STATUS, drop_rate_comm)."),
    ("mavlink_rssi_min", "count", "Smallest signal at either end, in units of the telemetry radio (RADIO_STATUS)."),
    ("mavlink_armed", "bool", "Whether the motors were armed at any time.", Figure("armed", Kind.FLAG, rank=84)),
    ("mavlink_battery_begin", "share", "Charge of the battery in the first SYS_STATUS."),
    (
        "mavlink_battery_end",
        "share",
        "Charge of the battery in the last SYS_STATUS.",
        Figure("drone battery", Kind.MEDIAN, rank=85),
    ),
    ("mavlink_battery_begin_v", "V", "Voltage of the battery in the first SYS_STATUS.", (0.0, 1e3)),
    ("mavlink_battery_end_v", "V", "Voltage of the battery in the last SYS_STATUS.", (0.0, 1e3)),
    ("mavlink_lat_begin_deg", "deg", "Latitude in the first GLOBAL_POSITION_INT.", (-90.0, 90.0)),
    ("mavlink_lat_end_deg", "deg", "Latitude in the last GLOBAL_POSITION_INT.", (-90.0, 90.0)),
    ("mavlink_lon_begin_deg", "deg", "Longitude in the first GLOBAL_POSITION_INT.", _ANGLE),
    ("mavlink_lon_end_deg", "deg", "Longitude in the last GLOBAL_POSITION_INT.", _ANGLE),
    (
        "mavlink_north_begin_m",
        "m",
        "Metres north of the autopilot's origin in the first LOCAL_POSITION_NED.",
        _OFFSET_BOUNDS_M,
    ),
    (
        "mavlink_north_end_m",
        "m",
        "Metres north of the autopilot's origin in the last LOCAL_POSITION_NED.",
        _OFFSET_BOUNDS_M,
    ),
    (
        "mavlink_east_begin_m",
        "m",
        "Metres east of the autopilot's origin in the first LOCAL_POSITION_NED.",
        _OFFSET_BOUNDS_M,
    ),
    (
        "mavlink_east_end_m",
        "m",
        "Metres east of the autopilot's origin in the last LOCAL_POSITION_NED.",
        _OFFSET_BOUNDS_M,
    ),
    (
        "mavlink_height_min_m",
        "m",
        "Smallest height over the origin (LOCAL_POSITION_NED), or if unknown over home (GLOBAL_POSITION_INT).",
        _HEIGHT_BOUNDS,
    ),
    (
        "mavlink_height_mean_m",
        "m",
        "Mean height; see mavlink_height_min_m.",
        Figure("height", Kind.MEDIAN, rank=86),
        _HEIGHT_BOUNDS,
    ),
    ("mavlink_height_max_m", "m", "Largest height; see mavlink_height_min_m.", _HEIGHT_BOUNDS),
    (
        "mavlink_speed_mean_m_s",
        "m/s",
        "Mean speed over the ground (LOCAL_POSITION_NED, or GLOBAL_POSITION_INT).",
        Figure("drone speed", Kind.MEDIAN, rank=87),
    ),
    ("mavlink_speed_max_m_s", "m/s", "Largest speed over the ground."),
    ("mavlink_climb_min_m_s", "m/s", "Smallest vertical speed, negative for descent.", _HEIGHT_BOUNDS),
    ("mavlink_climb_max_m_s", "m/s", "Largest vertical speed.", _HEIGHT_BOUNDS),
    ("mavlink_roll_min_deg", "deg", "Smallest roll angle, negative to the left (ATTITUDE).", _ANGLE),
    ("mavlink_roll_max_deg", "deg", "Largest roll angle.", _ANGLE),
    ("mavlink_pitch_min_deg", "deg", "Smallest pitch angle, negative with the nose down (ATTITUDE).", _ANGLE),
    ("mavlink_pitch_max_deg", "deg", "Largest pitch angle.", _ANGLE),
)

_READER: Final = SandboxedReader("fieldkit.motion.logs.tlog_reader")


@dataclass(frozen=True)
class RecorderSummary:
    """Summary that a recorder wrote at the end of its log.

    Attributes:
        frames: Number of frames in the log.
        dropped_frames: Number of frames that did not fit into the log.
        ended_us: End of the recording, microseconds since 1970 UTC by its robot's clock.
        refusals: MAV_RESULT by message ID, for messages whose rate the autopilot did not set.
        crc32: CRC-32 of the log; None for a recorder of an older version.
        slow_s: Longest time for which the rate of a requested message was too low; None if no message was requested,
            or for a recorder of an older version.
    """

    frames: int
    dropped_frames: int
    ended_us: int
    refusals: Mapping[int, int]
    crc32: int | None = None
    slow_s: float | None = None


def read_summary(path: Path) -> RecorderSummary:
    """Return the summary of a recorder.

    Raises:
        EvidenceError: The file is missing, or is not a summary of a recorder.
    """
    try:
        data = json.loads(reading.text(path))
        refusals = {
            _non_negative_int(int(kind)): _non_negative_int(result) for kind, result in data["refused"].items()
        }
        frames, dropped_frames, ended_us = (
            _non_negative_int(data[name]) for name in ("frames", "left_out", "ended_us")
        )
        crc32 = _non_negative_int(data["crc32"]) if "crc32" in data else None
        slow_s = max((_duration_s(duration) for duration in data.get("slow_s", {}).values()), default=None)
        return RecorderSummary(frames, dropped_frames, ended_us, refusals, crc32, slow_s)
    except JSON_ERRORS as error:
        raise EvidenceError(
            "is not a summary of a recording", where=str(path), remedy="read the recorder's log: was it killed?"
        ) from error


def _duration_s(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e9:
        raise ValueError
    return float(value)


def _non_negative_int(value: object) -> int:
    if type(value) is not int or not 0 <= value < 2**62:
        raise ValueError
    return value


@dataclass(frozen=True)
class Tlog:
    """Decoded contents of a log.

    Attributes:
        frames: Number of frames of all senders.
        kinds: Number of messages by message name: of the autopilot, and RADIO_STATUS of all senders.
        values: Values of the columns by name.
        first_us: Earliest time of a frame, microseconds since 1970 UTC by the recorder's clock.
        last_us: Latest time of a frame.
        back_us: Largest backward step between the times of consecutive frames.
    """

    frames: int
    kinds: Mapping[str, int]
    values: Mapping[str, Value]
    first_us: int
    last_us: int
    back_us: int


def read(path: Path, system: int, ended_us: int, intervals_us: tuple[tuple[str, int], ...] = ()) -> Tlog:
    """Return the contents of a log for one autopilot.

    Args:
        path: The log.
        system: System ID of the autopilot; 0 if the log has only one.
        ended_us: End of the recording; 0 if unknown.
        intervals_us: Names of messages with their requested intervals.

    Raises:
        EvidenceError: The log is missing, truncated, damaged, or contains no such autopilot.
    """
    contents = _query(path, system, ended_us=ended_us, intervals_us=dict(intervals_us))
    counts = contents["numbers"]
    sent_count = counts["messages"] + counts["lost"]
    periodic, lost_count = contents["periodic"]
    values = {
        "messages": counts["messages"],
        "sent": sent_count,
        "loss_most": 1 - counts["messages"] / sent_count if sent_count else None,
        "periodic": periodic or None,
        "periodic_sent": periodic + lost_count or None,
        "loss": lost_count / (periodic + lost_count) if periodic else None,
        "damaged": contents["damaged"],
        "rate_hz": counts["rate_hz"],
        "silence_s": counts["silence_s"],
        **contents["values"],
    }
    values["armed"] = None if values.get("armed") is None else bool(values["armed"])
    return Tlog(
        contents["frames"],
        contents["kinds"],
        {_PREFIX + name: value for name, value in values.items() if value is not None},
        *contents["times"],
    )


def contradictions(
    log: Tlog, summary: RecorderSummary, file_crc32: int, window: tuple[int, int] | None
) -> Iterator[str]:
    """Yield the contradictions between a log, the recorder's summary and the attempt, one sentence each.

    Args:
        log: The log.
        summary: Summary of the recorder.
        file_crc32: CRC-32 of the log's file.
        window: Readings of the recorder's clock before and after the attempt, nanoseconds since 1970 UTC; None if
            unknown.
    """
    if summary.crc32 is not None and summary.crc32 != file_crc32:
        yield "was changed: its checksum differs from the one that its recorder wrote"
    if log.last_us > summary.ended_us + _TIME_TOLERANCE_US:
        yield f"has a frame {(log.last_us - summary.ended_us) / 1e6:.3f} s after its recorder stopped"
    if log.back_us > _TIME_TOLERANCE_US:
        yield f"has a frame that is {log.back_us / 1e6:.3f} s earlier than the previous one"
    # The window is widened to whole microseconds, the resolution of the log.
    if window is not None and not window[0] // 1000 <= log.first_us <= log.last_us <= -(-window[1] // 1000):
        yield "has frames from before the attempt or after it, by the recorder's clock"


def crc32_of(path: Path) -> int:
    """Return the CRC-32 of a log. Raises the same errors as `reading.mapped`."""
    return zlib.crc32(reading.mapped(path))


def measure(log: Tlog | None, slow_s: float | None = None) -> Measured:
    """Return the columns.

    Args:
        log: Contents of the log; None if it is incomplete.
        slow_s: `RecorderSummary.slow_s`; None if it is unknown.
    """
    if log is None:
        return Measured.all_missing(COLUMNS, "the telemetry log is incomplete")
    values = {**log.values, "mavlink_slow_s": slow_s}
    possible = {column.name: _possible_value(column, values.get(column.name)) for column in COLUMNS}
    return Measured.from_optional(possible, "the autopilot does not report it")


def _possible_value(column: Column, value: Value | None) -> Value | None:
    """Return the value converted to the column's type; None if it is outside of the column's bounds."""
    if value is None or isinstance(value, bool | str):
        return value
    low, high = column.possible_range
    return column.type(value + 0) if low <= value <= high else None  # adding 0 converts -0 to 0


def positions(path: Path, system: int, kind: str) -> list[list[Any]]:
    """Return the autopilot's positions in the messages with the name `kind`; see `tlog_reader`.

    Raises:
        EvidenceError: For the same reasons as `read`.
    """
    rows: list[list[Any]] = _query(path, system, positions=kind)["rows"]
    return rows


def _query(path: Path, system: int, **parameters: object) -> Any:  # noqa: ANN401 (any JSON value)
    try:
        size_bytes = reading.size(path)
        return _READER.query({"path": str(path.absolute()), "system": system, **parameters}, size_bytes)
    except ReaderError as error:
        raise EvidenceError(
            f"cannot be read as a telemetry log: {error}", where=str(path), remedy="read the recorder's log"
        ) from error
