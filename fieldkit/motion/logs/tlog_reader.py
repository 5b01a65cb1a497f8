"""Decoder of MAVLink telemetry logs with pymavlink, which `tlog` runs in a sandboxed process.

A log is a sequence of frames. Each frame is preceded by its time in microseconds since 1970 UTC (8 bytes,
big-endian), as in logs of MAVProxy and QGroundControl. Messages and fields are named as in https://mavlink.io/en/messages/common.html.
"""

import math
import struct
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from fieldkit.measure.evidence import sandbox_process, sequence
from fieldkit.measure.evidence.sandbox import Json
from fieldkit.motion.logs import periodic, tlog
from fieldkit.motion.logs.periodic import StreamMessage

_TIME: Final = struct.Struct(">Q")
_MAX_TIME_US: Final = 2**52
"""Upper bound of times, in the year 2112."""
_MAX_DISTANCE_M: Final = 1e9
_MAGIC_1: Final = 0xFE
_MAGIC_2: Final = 0xFD
"""First byte of a frame of MAVLink 1, and of MAVLink 2."""
_SIGNED_FLAG: Final = 1
_SIGNATURE_BYTES: Final = 13
_UNKNOWN_16: Final = 0xFFFF
_UNKNOWN_8: Final = 0xFF
"""Values of unsigned fields of 16 and 8 bits that mean *unknown*."""
_RADIO: Final = "RADIO_STATUS"
"""Status of a telemetry radio's link; the radio has a separate system ID."""

Source = tuple[int, int]
"""IDs of a system and of one of its components."""


@dataclass(frozen=True)
class LoggedFrame:
    """A frame of a log.

    Attributes:
        at_us: Time of arrival, microseconds since 1970 UTC by the recorder's clock.
        data: Bytes of the frame.
    """

    at_us: int
    data: bytes

    @property
    def source(self) -> Source:
        """System ID and component ID of the sender. Their positions differ between MAVLink 1 and MAVLink 2."""
        system_index = 3 if self.data[0] == _MAGIC_1 else 5
        return self.data[system_index], self.data[system_index + 1]

    @property
    def number(self) -> int:
        """Sequence number that the sender assigned, from 0 to 255."""
        return self.data[2 if self.data[0] == _MAGIC_1 else 4]

    @property
    def kind(self) -> int:
        """ID of its message."""
        return self.data[5] if self.data[0] == _MAGIC_1 else int.from_bytes(self.data[7:10], "little")


def frames(data: bytes) -> Iterator[LoggedFrame]:
    """Yield the frames of a log.

    Raises:
        ValueError: The log is truncated within a frame, or a frame has an invalid start or time.
    """
    offset = 0
    while offset < len(data):
        head = data[offset + _TIME.size : offset + _TIME.size + 3]
        if len(head) < 3:
            raise ValueError(f"it is truncated after {offset} bytes")
        size = 8 + head[1] if head[0] == _MAGIC_1 else 12 + head[1] + _SIGNATURE_BYTES * (head[2] & _SIGNED_FLAG)
        if head[0] not in {_MAGIC_1, _MAGIC_2}:
            raise ValueError(f"no frame starts at offset {offset + _TIME.size}")
        frame = data[offset + _TIME.size : offset + _TIME.size + size]
        if len(frame) < size:
            raise ValueError(f"it is truncated after {offset} bytes")
        (at_us,) = _TIME.unpack_from(data, offset)
        if at_us >= _MAX_TIME_US:
            raise ValueError(f"the time at offset {offset} is after the year 2112")
        yield LoggedFrame(at_us, frame)
        offset += _TIME.size + size


class TlogDecoder:
    """Decoder of frames of the common dialect.

    Attributes:
        damaged_frames: Number of frames that cannot be decoded, usually because their checksum is wrong.
    """

    def __init__(self) -> None:
        self.damaged_frames = 0
        self._link = dialect.MAVLink(None)

    def message(self, frame: LoggedFrame) -> Any | None:  # noqa: ANN401 (of a class that the dialect generates)
        """Return the message in a frame; None if the frame is damaged, or of another dialect."""
        try:
            message = self._link.decode(bytearray(frame.data))
        except dialect.MAVError:
            self.damaged_frames += 1
            return None
        return None if message.get_type().startswith("UNKNOWN") else message


def answer(request: Json) -> Json:
    """Return the answer to a request about the log at `path`.

    It contains the positions in the messages that the key `positions` names, or else a summary of the log.
    Both concern the autopilot with the system ID `system`; 0 selects the only autopilot in the log.

    Raises:
        ValueError: The file is not a log, or does not contain exactly one such autopilot.
    """
    data = Path(request["path"]).read_bytes()
    autopilot = _autopilot(data, request["system"])
    if "positions" in request:
        return {"rows": list(_positions(data, autopilot, request["positions"]))}
    return _summary(data, autopilot, request["ended_us"], request["intervals_us"])


def _autopilot(data: bytes, system_id: int) -> Source:
    """Return the sender of an autopilot's heartbeats.

    Raises:
        ValueError: There are no such heartbeats, or several senders of them.
    """
    decoder, heartbeats = TlogDecoder(), Counter[Source]()
    for frame in frames(data):
        if frame.kind == dialect.MAVLINK_MSG_ID_HEARTBEAT and system_id in {0, frame.source[0]}:
            heartbeat = decoder.message(frame)
            is_autopilot = heartbeat is not None and heartbeat.autopilot != dialect.MAV_AUTOPILOT_INVALID
            heartbeats[frame.source] += is_autopilot
    heartbeats += Counter()  # removes senders with a count of 0
    if not heartbeats:
        raise ValueError(f"no heartbeat from an autopilot{f' of system {system_id}' if system_id else ''}")
    if len(heartbeats) > 1:
        systems = ", ".join(str(system) for system, _ in sorted(heartbeats))
        raise ValueError(f"it has autopilots of systems {systems}: choose one with the key system")
    return next(iter(heartbeats))


def _summary(data: bytes, autopilot: Source, ended_us: int, intervals_us: Mapping[str, int]) -> Json:
    """Return the counts and values from which `tlog.read` computes the columns."""
    decoder, series = TlogDecoder(), defaultdict[str, list[float]](list)
    kinds, numbers, frame_count, backward_us = Counter[str](), list[tuple[int, int]](), 0, 0
    first_us, last_us, previous_us = _MAX_TIME_US, 0, 0
    streams = defaultdict[str, list[StreamMessage]](list)
    for frame in frames(data):
        frame_count += 1
        first_us, last_us = min(first_us, frame.at_us), max(last_us, frame.at_us)
        backward_us, previous_us = max(backward_us, previous_us - frame.at_us), frame.at_us
        is_autopilot, damaged_frames = frame.source == autopilot, decoder.damaged_frames
        message = decoder.message(frame)
        # Messages of other dialects have a sequence number, too.
        if is_autopilot and decoder.damaged_frames == damaged_frames:
            numbers.append((frame.at_us, frame.number))
        if message is not None and (is_autopilot or message.get_type() == _RADIO):
            kinds[message.get_type()] += 1
            if is_autopilot and hasattr(message, "time_boot_ms"):
                stream = streams[message.get_type()]
                stream.append(StreamMessage(frame.at_us, message.time_boot_ms, len(numbers) - 1))
            for name, value in _message_values(message):
                if math.isfinite(value):
                    series[name].append(value)
    return {
        "frames": frame_count,
        "times": [first_us, last_us, backward_us],
        "damaged": decoder.damaged_frames,
        "system": autopilot[0],
        "kinds": dict(kinds),
        "numbers": vars(sequence.count_messages(numbers, ended_us)),
        "periodic": periodic.count_messages(numbers, streams, ended_us, intervals_us),
        "values": dict(_column_values(series)),
    }


def _message_values(message: Any) -> Iterator[tuple[str, float]]:  # noqa: ANN401 (as `TlogDecoder.message`)
    """Yield names and values of a message's fields, in SI units, degrees and shares; `rssi` in units of the radio."""
    match message.get_type():
        case "HEARTBEAT":
            yield "armed", float(bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED))
        case "ATTITUDE":
            yield "roll_deg", math.degrees(message.roll)
            yield "pitch_deg", math.degrees(message.pitch)
        case tlog.LOCAL:
            yield from (("north_m", message.x), ("east_m", message.y), ("height_m/local", -message.z))
            yield from (("speed_m_s/local", math.hypot(message.vx, message.vy)), ("climb_m_s/local", -message.vz))
        case tlog.GLOBAL:
            yield from (("lat_deg", message.lat / 1e7), ("lon_deg", message.lon / 1e7))
            yield "height_m/global", message.relative_alt / 1e3
            yield "speed_m_s/global", math.hypot(message.vx, message.vy) / 1e2
            yield "climb_m_s/global", -message.vz / 1e2
        case "SYS_STATUS":
            yield "drop_rate", message.drop_rate_comm / 1e4
            if message.battery_remaining >= 0:
                yield "battery", message.battery_remaining / 1e2
            if message.voltage_battery != _UNKNOWN_16:
                yield "battery_v", message.voltage_battery / 1e3
        case "RADIO_STATUS":
            yield from (("rssi", rssi) for rssi in (message.rssi, message.remrssi) if rssi != _UNKNOWN_8)


def _column_values(series: dict[str, list[float]]) -> Iterator[tuple[str, float]]:
    """Yield names of columns, without their prefix, and their values, computed from series of values.

    A column is named by quantity, statistic and unit: the largest value of `climb_m_s` is `climb_max_m_s`.
    """
    for name in ("height_m", "speed_m_s", "climb_m_s"):
        # Either message can be missing if the link has many losses. Heights are over the autopilot's origin in the
        # local message, and over home in the global one.
        series[name] = series[f"{name}/local"] or series[f"{name}/global"]
    for name in ("battery", "battery_v", "north_m", "east_m", "lat_deg", "lon_deg"):
        quantity, unit = name.split("_", 1) if "_" in name else (name, "")
        if values := series[name]:
            yield f"{quantity}_begin_{unit}".rstrip("_"), values[0]
            yield f"{quantity}_end_{unit}".rstrip("_"), values[-1]
    reductions: dict[str, Callable[[list[float]], float]] = {"min": min, "mean": fmean, "max": max}
    for name, statistics in _REDUCTIONS.items():
        quantity, _, unit = name.partition("_")
        for statistic in statistics:
            if values := series[name]:
                yield f"{quantity}_{statistic}_{unit}".rstrip("_"), float(reductions[statistic](values))
    for name, source in (("armed", "armed"), ("drop_rate", "drop_rate"), ("rssi_min", "rssi")):
        if values := series[source]:
            yield name, (min if name == "rssi_min" else max)(values)


_REDUCTIONS: Final = {
    "height_m": ("min", "mean", "max"),
    "speed_m_s": ("mean", "max"),
    "climb_m_s": ("min", "max"),
    "roll_deg": ("min", "max"),
    "pitch_deg": ("min", "max"),
}


def _positions(data: bytes, autopilot: Source, kind: str) -> Iterator[tuple[int, int, float, float, float, float]]:
    """Yield time of arrival in us, the autopilot's time in ms, three coordinates and the heading of each message.

    The coordinates of `LOCAL_POSITION_NED` are metres east, north and up; those of `GLOBAL_POSITION_INT` are latitude
    and longitude in degrees, and metres above the sea. The heading is from the last ATTITUDE before the message, in
    radians from east to north. Before the first ATTITUDE it is the heading of the next position that has one; without
    any it is 0.

    Raises:
        ValueError: A message has an impossible position.
    """
    decoder, heading_rad, rows = TlogDecoder(), math.nan, []
    for frame in frames(data):
        if frame.source != autopilot or (message := decoder.message(frame)) is None:
            continue
        if message.get_type() == "ATTITUDE":
            heading_rad = math.pi / 2 - message.yaw
        elif message.get_type() == kind == tlog.GLOBAL:
            position = message.lat / 1e7, message.lon / 1e7, message.alt / 1e3
            rows.append((frame.at_us, message.time_boot_ms, *position, heading_rad))
        elif message.get_type() == kind == tlog.LOCAL:
            position = message.y, message.x, -message.z
            rows.append((frame.at_us, message.time_boot_ms, *position, heading_rad))
    bounds = (90.0, 180.0, _MAX_DISTANCE_M) if kind == tlog.GLOBAL else (_MAX_DISTANCE_M,) * 3
    # The comparison is false for NaN, too.
    if not all(abs(value) <= bound for row in rows for value, bound in zip(row[2:5], bounds, strict=True)):
        raise ValueError(f"a {kind} contains no valid position")
    first_rad = next((row[5] for row in rows if math.isfinite(row[5])), 0.0)
    for row in rows:
        yield (*row[:5], row[5] if math.isfinite(row[5]) else first_rad)


if __name__ == "__main__":
    sandbox_process.serve(answer)
