"""Telemetry logs of autopilots (`.tlog`), and what their recorders said of them; decoded confined."""

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
from fieldkit.measure.evidence.confined import Confined, ConfinedAnswerError

SUFFIX: Final = ".tlog"
GLOBAL: Final = "GLOBAL_POSITION_INT"
LOCAL: Final = "LOCAL_POSITION_NED"
"""The messages that tell where an autopilot is."""

_PREFIX: Final = "mavlink_"
_ORDER_US: Final = 1_000
"""Times of one program on a clock that is slewed."""
_EITHER: Final = (-1e9, 1e9)
_ANGLE: Final = (-360.0, 360.0)
_HIGHEST: Final = (-1e6, 1e6)

COLUMNS: Final = columns(
    100,
    ("mavlink_messages", "count", "Messages of the autopilot that came whole, each once."),
    ("mavlink_sent", "count", "These, and those that are missing by the gaps in their numbers, and in silences."),
    (
        "mavlink_loss_most",
        "share",
        "1 - mavlink_messages/mavlink_sent: a bound, as a router withholds messages to other stations.",
    ),
    (
        "mavlink_periodic",
        "count",
        "Messages with time_boot_ms of streams whose period is known: requested, or a whole rate of up to 10 Hz.",
    ),
    ("mavlink_periodic_sent", "count", "These, and those that lack in both the periods and the numbers."),
    (
        "mavlink_loss",
        "share",
        "1 - mavlink_periodic/mavlink_periodic_sent.",
        Figure("MAVLink loss", Kind.COUNTED, "mavlink_periodic", "mavlink_periodic_sent", rank=82),
    ),
    ("mavlink_damaged", "count", "Frames of anybody whose checksum was wrong."),
    ("mavlink_rate_hz", "Hz", "Messages a second that the autopilot sent, apart from silences.", (0.0, 1e6)),
    (
        "mavlink_silence_s",
        "s",
        "Longest time in which no message of the autopilot came.",
        Figure("MAVLink silence", Kind.MEDIAN, rank=83),
    ),
    ("mavlink_slow_s", "s", "Longest time for which a requested message came at less than 0.7 of its rate."),
    ("mavlink_drop_rate", "share", "Most that the autopilot said it lost itself (SYS_STATUS, drop_rate_comm)."),
    ("mavlink_rssi_min", "count", "Least signal at either end, as a telemetry radio counts it (RADIO_STATUS)."),
    ("mavlink_armed", "bool", "Whether the motors were armed at any time.", Figure("armed", Kind.FLAG, rank=84)),
    ("mavlink_battery_begin", "share", "Charge of the battery in the first SYS_STATUS."),
    ("mavlink_battery_end", "share", "Charge in the last.", Figure("drone battery", Kind.MEDIAN, rank=85)),
    ("mavlink_battery_begin_v", "V", "Voltage of the battery in the first SYS_STATUS.", (0.0, 1e3)),
    ("mavlink_battery_end_v", "V", "Voltage in the last.", (0.0, 1e3)),
    ("mavlink_lat_begin_deg", "deg", "Degrees north in the first GLOBAL_POSITION_INT.", (-90.0, 90.0)),
    ("mavlink_lat_end_deg", "deg", "Degrees north in the last.", (-90.0, 90.0)),
    ("mavlink_lon_begin_deg", "deg", "Degrees east in the first GLOBAL_POSITION_INT.", _ANGLE),
    ("mavlink_lon_end_deg", "deg", "Degrees east in the last.", _ANGLE),
    (
        "mavlink_north_begin_m",
        "m",
        "Metres north of the autopilot's origin in the first LOCAL_POSITION_NED.",
        _EITHER,
    ),
    ("mavlink_north_end_m", "m", "Metres north in the last.", _EITHER),
    ("mavlink_east_begin_m", "m", "Metres east of it in the first LOCAL_POSITION_NED.", _EITHER),
    ("mavlink_east_end_m", "m", "Metres east in the last.", _EITHER),
    (
        "mavlink_height_min_m",
        "m",
        "Least height over the origin (LOCAL_POSITION_NED), or else home (GLOBAL_POSITION_INT); so the next two.",
        _HIGHEST,
    ),
    ("mavlink_height_mean_m", "m", "Mean of the heights.", Figure("height", Kind.MEDIAN, rank=86), _HIGHEST),
    ("mavlink_height_max_m", "m", "Largest of them.", _HIGHEST),
    (
        "mavlink_speed_mean_m_s",
        "m/s",
        "Mean speed over the ground, by the same message.",
        Figure("drone speed", Kind.MEDIAN, rank=87),
    ),
    ("mavlink_speed_max_m_s", "m/s", "Largest of it."),
    ("mavlink_climb_min_m_s", "m/s", "Least speed upwards, less than 0 where it sank.", _HIGHEST),
    ("mavlink_climb_max_m_s", "m/s", "Largest of it.", _HIGHEST),
    ("mavlink_roll_min_deg", "deg", "Farthest roll to the left (ATTITUDE).", _ANGLE),
    ("mavlink_roll_max_deg", "deg", "Farthest roll to the right.", _ANGLE),
    ("mavlink_pitch_min_deg", "deg", "Farthest pitch with the nose down (ATTITUDE).", _ANGLE),
    ("mavlink_pitch_max_deg", "deg", "Farthest pitch with the nose up.", _ANGLE),
)

_READER: Final = Confined("fieldkit.measure.motion.tlog_reader")


@dataclass(frozen=True)
class Told:
    """What a recorder said of its log when it ended.

    Attributes:
        frames: Frames in the log.
        left_out: Frames that had no room in it.
        ended_us: When it ended, microseconds since 1970 UTC by its robot's clock.
        refused: Ids of messages whose rate the autopilot did not set, each with the MAV_RESULT that it gave.
        crc32: CRC-32 of the log; None from a recorder of an older version.
        slow_s: Longest time for which a requested message was too slow; None if none was requested, or as above.
    """

    frames: int
    left_out: int
    ended_us: int
    refused: Mapping[int, int]
    crc32: int | None = None
    slow_s: float | None = None


def told(path: Path) -> Told:
    """Return what the recorder said.

    Raises:
        EvidenceError: It is missing, or not what a recorder says.
    """
    try:
        data = json.loads(reading.text(path))
        refused = {_whole(int(kind)): _whole(result) for kind, result in data["refused"].items()}
        frames, left_out, ended_us = (_whole(data[name]) for name in ("frames", "left_out", "ended_us"))
        crc32 = _whole(data["crc32"]) if "crc32" in data else None
        slow_s = max((_duration_s(lasted) for lasted in data.get("slow_s", {}).values()), default=None)
        return Told(frames, left_out, ended_us, refused, crc32, slow_s)
    except JSON_ERRORS as error:
        raise EvidenceError(
            "does not say what was recorded", where=str(path), remedy="read the recorder's log: was it ended?"
        ) from error


def _duration_s(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e9:
        raise ValueError
    return float(value)


def _whole(value: object) -> int:
    if type(value) is not int or not 0 <= value < 2**62:
        raise ValueError
    return value


@dataclass(frozen=True)
class Tlog:
    """What a log says.

    Attributes:
        frames: Its frames, of anybody.
        kinds: Messages of the autopilot by their names.
        values: Values of columns.
        first_us: Earliest time of a frame, microseconds since 1970 UTC by the recorder's clock.
        last_us: Latest time.
        back_us: Longest step back from one frame to the next.
    """

    frames: int
    kinds: Mapping[str, int]
    values: Mapping[str, Value]
    first_us: int
    last_us: int
    back_us: int


def read(path: Path, system: int, ended_us: int, intervals_us: tuple[tuple[str, int], ...] = ()) -> Tlog:
    """Return what a log says of an autopilot.

    Args:
        path: The log.
        system: Id of its system; 0 for the only one.
        ended_us: When it ended; 0 if that is unknown.
        intervals_us: Names of messages with their requested intervals.

    Raises:
        EvidenceError: It is missing, cut off, damaged, or of no autopilot.
    """
    found = _asked(path, system, ended_us=ended_us, intervals_us=dict(intervals_us))
    counts = found["numbers"]
    sent = counts["messages"] + counts["lost"]
    periodic, lacking = found["periodic"]
    values = {
        "messages": counts["messages"],
        "sent": sent,
        "loss_most": 1 - counts["messages"] / sent if sent else None,
        "periodic": periodic or None,
        "periodic_sent": periodic + lacking or None,
        "loss": lacking / (periodic + lacking) if periodic else None,
        "damaged": found["damaged"],
        "rate_hz": counts["rate_hz"],
        "silence_s": counts["silence_s"],
        **found["values"],
    }
    values["armed"] = None if values.get("armed") is None else bool(values["armed"])
    return Tlog(
        found["frames"],
        found["kinds"],
        {_PREFIX + name: value for name, value in values.items() if value is not None},
        *found["times"],
    )


def contradictions(log: Tlog, said: Told, sum_of_file: int, window: tuple[int, int] | None) -> Iterator[str]:
    """Yield what cannot be true of a log, what its recorder said of it, and the attempt.

    Args:
        log: The log.
        said: What the recorder said.
        sum_of_file: CRC-32 of the log's file.
        window: The recorder's clock before and after the attempt, nanoseconds since 1970 UTC; None if not known.
    """
    if said.crc32 is not None and said.crc32 != sum_of_file:
        yield "was changed: its checksum is not the one that its recorder wrote"
    if log.last_us > said.ended_us + _ORDER_US:
        yield f"has a frame of {(log.last_us - said.ended_us) / 1e6:.3f} s after its recorder ended"
    if log.back_us > _ORDER_US:
        yield f"has a frame that is {log.back_us / 1e6:.3f} s earlier than the one before it"
    if window is not None and not window[0] // 1000 <= log.first_us <= log.last_us <= -(-window[1] // 1000):
        yield "has frames from before the attempt or after it, by the recorder's clock"


def sum_of(path: Path) -> int:
    """Return the CRC-32 of a log; raises `EvidenceError` as `reading.mapped`."""
    return zlib.crc32(reading.mapped(path))


def measure(log: Tlog | None, slow_s: float | None = None) -> Measured:
    """Return the columns of a log, None where it is not whole, and of how long a requested message was too slow."""
    if log is None:
        return Measured.nothing(COLUMNS, "the telemetry log is not whole")
    values = {**log.values, "mavlink_slow_s": slow_s}
    found = {column.name: _possible(column, values.get(column.name)) for column in COLUMNS}
    return Measured.of(found, "the autopilot does not tell")


def _possible(column: Column, value: Value | None) -> Value | None:
    """Return a value of the column's type; None where it is none that there can be."""
    if value is None or isinstance(value, bool | str):
        return value
    low, high = column.possible
    return column.type(value + 0) if low <= value <= high else None  # 0 for -0


def positions(path: Path, system: int, kind: str) -> list[list[Any]]:
    """Return what messages of a kind say of where an autopilot was; see `tlog_reader`.

    Raises:
        EvidenceError: As `read`.
    """
    rows: list[list[Any]] = _asked(path, system, positions=kind)["rows"]
    return rows


def _asked(path: Path, system: int, **what: object) -> Any:  # noqa: ANN401 (of JSON)
    try:
        size_bytes = reading.size(path)
        return _READER.ask({"path": str(path.absolute()), "system": system, **what}, size_bytes)
    except ConfinedAnswerError as error:
        raise EvidenceError(
            f"cannot be read as a telemetry log: {error}", where=str(path), remedy="read the recorder's log"
        ) from error
