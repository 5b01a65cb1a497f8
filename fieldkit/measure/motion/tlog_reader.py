"""Decode telemetry logs of MAVLink with pymavlink; run by `tlog` in a process of its own.

A log is frames, each behind the time in microseconds since 1970 UTC in 8 bytes, big-endian, as MAVProxy and
QGroundControl write it. Messages and fields are named as in https://mavlink.io/en/messages/common.html.
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

from fieldkit.measure.evidence import confined, sequence
from fieldkit.measure.evidence.confined import Json
from fieldkit.measure.motion import periodic, tlog
from fieldkit.measure.motion.periodic import StreamMessage

_TIME: Final = struct.Struct(">Q")
_MOST_US: Final = 2**52
"""In the year 2112."""
_FARTHEST_M: Final = 1e9
_MAGIC_1: Final = 0xFE
_MAGIC_2: Final = 0xFD
_SIGNED: Final = 1
_SIGNATURE_BYTES: Final = 13
_UNKNOWN_16: Final = 0xFFFF
_UNKNOWN_8: Final = 0xFF
_RADIO: Final = "RADIO_STATUS"
"""What a telemetry radio tells of its link, in a system of its own."""

Source = tuple[int, int]
"""Ids of a system and its component."""


@dataclass(frozen=True)
class LoggedFrame:
    """A frame of a log.

    Attributes:
        at_us: When it came, microseconds since 1970 UTC by the recorder's clock.
        data: The frame.
    """

    at_us: int
    data: bytes

    @property
    def source(self) -> Source:
        """Who sent it."""
        system = 3 if self.data[0] == _MAGIC_1 else 5
        return self.data[system], self.data[system + 1]

    @property
    def number(self) -> int:
        """Its number among those of its sender, from 0 to 255."""
        return self.data[2 if self.data[0] == _MAGIC_1 else 4]

    @property
    def kind(self) -> int:
        """Id of its message."""
        return self.data[5] if self.data[0] == _MAGIC_1 else int.from_bytes(self.data[7:10], "little")


def frames(data: bytes) -> Iterator[LoggedFrame]:
    """Yield the frames of a log.

    Raises:
        ValueError: It is cut off in a frame, or has something else than a frame where one is to begin.
    """
    at = 0
    while at < len(data):
        head = data[at + _TIME.size : at + _TIME.size + 3]
        if len(head) < 3:
            raise ValueError(f"it is cut off after {at} bytes")
        size = 8 + head[1] if head[0] == _MAGIC_1 else 12 + head[1] + _SIGNATURE_BYTES * (head[2] & _SIGNED)
        if head[0] not in {_MAGIC_1, _MAGIC_2}:
            raise ValueError(f"no frame begins {at + _TIME.size} bytes from its start")
        frame = data[at + _TIME.size : at + _TIME.size + size]
        if len(frame) < size:
            raise ValueError(f"it is cut off after {at} bytes")
        (at_us,) = _TIME.unpack_from(data, at)
        if at_us >= _MOST_US:
            raise ValueError(f"a time is after 2112, {at} bytes from its start")
        yield LoggedFrame(at_us, frame)
        at += _TIME.size + size


class TlogDecoder:
    """Decodes frames of the common dialect.

    Attributes:
        damaged: Frames whose checksum was wrong.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._link = dialect.MAVLink(None)

    def message(self, frame: LoggedFrame) -> Any | None:  # noqa: ANN401 (of a class that the dialect generates)
        """Return the message in a frame; None where it is damaged, or of another dialect."""
        try:
            found = self._link.decode(bytearray(frame.data))
        except dialect.MAVError:
            self.damaged += 1
            return None
        return None if found.get_type().startswith("UNKNOWN") else found


def answer(question: Json) -> Json:
    """Answer a question about the log at `path`.

    With `positions` the places that messages of this name tell, else a summary of the log; both of the autopilot in
    `system`, 0 for the only one.

    Raises:
        ValueError: It is no log, or there is not one autopilot.
    """
    data = Path(question["path"]).read_bytes()
    autopilot = _autopilot(data, question["system"])
    if "positions" in question:
        return {"rows": list(_positions(data, autopilot, question["positions"]))}
    return _summary(data, autopilot, question["ended_us"], question["intervals_us"])


def _autopilot(data: bytes, wanted: int) -> Source:
    """Return whose heartbeats are those of an autopilot.

    Raises:
        ValueError: Nobody's, or those of several systems.
    """
    decoder, found = TlogDecoder(), Counter[Source]()
    for frame in frames(data):
        if frame.kind == dialect.MAVLINK_MSG_ID_HEARTBEAT and wanted in {0, frame.source[0]}:
            beat = decoder.message(frame)
            found[frame.source] += beat is not None and beat.autopilot != dialect.MAV_AUTOPILOT_INVALID
    found += Counter()  # without those of 0
    if not found:
        raise ValueError(f"no heartbeat of an autopilot{f' of system {wanted}' if wanted else ''}")
    if len(found) > 1:
        raise ValueError(f"autopilots of systems {', '.join(str(system) for system, _ in sorted(found))}: name one")
    return next(iter(found))


def _summary(data: bytes, autopilot: Source, ended_us: int, intervals_us: Mapping[str, int]) -> Json:
    decoder, series = TlogDecoder(), defaultdict[str, list[float]](list)
    kinds, numbers, count, back_us = Counter[str](), list[tuple[int, int]](), 0, 0
    first_us, last_us, before_us = _MOST_US, 0, 0
    streams = defaultdict[str, list[StreamMessage]](list)
    for frame in frames(data):
        count += 1
        first_us, last_us = min(first_us, frame.at_us), max(last_us, frame.at_us)
        back_us, before_us = max(back_us, before_us - frame.at_us), frame.at_us
        is_its, damaged = frame.source == autopilot, decoder.damaged
        message = decoder.message(frame)
        if is_its and decoder.damaged == damaged:  # its number, too, if nothing else, whatever dialect it is of
            numbers.append((frame.at_us, frame.number))
        if message is not None and (is_its or message.get_type() == _RADIO):
            kinds[message.get_type()] += 1
            if is_its and hasattr(message, "time_boot_ms"):
                stream = streams[message.get_type()]
                stream.append(StreamMessage(frame.at_us, message.time_boot_ms, len(numbers) - 1))
            for name, value in _told(message):
                if math.isfinite(value):
                    series[name].append(value)
    return {
        "frames": count,
        "times": [first_us, last_us, back_us],
        "damaged": decoder.damaged,
        "system": autopilot[0],
        "kinds": dict(kinds),
        "numbers": vars(sequence.counted(numbers, ended_us)),
        "periodic": periodic.lost(numbers, streams, ended_us, intervals_us),
        "values": dict(_reduced(series)),
    }


def _told(message: Any) -> Iterator[tuple[str, float]]:  # noqa: ANN401 (as `TlogDecoder.message`)
    """Yield what a message tells, in SI units and degrees."""
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
            yield from (("rssi", one) for one in (message.rssi, message.remrssi) if one != _UNKNOWN_8)


def _reduced(series: dict[str, list[float]]) -> Iterator[tuple[str, float]]:
    """Yield what the values of a series come to, by the columns' names without their prefix."""
    for name in ("height_m", "speed_m_s", "climb_m_s"):
        # Over a link that loses much, one may have come and not the other; both count from home.
        series[name] = series[f"{name}/local"] or series[f"{name}/global"]
    for name in ("battery", "battery_v", "north_m", "east_m", "lat_deg", "lon_deg"):
        what, unit = name.split("_", 1) if "_" in name else (name, "")
        if values := series[name]:
            yield f"{what}_begin_{unit}".rstrip("_"), values[0]
            yield f"{what}_end_{unit}".rstrip("_"), values[-1]
    reductions: dict[str, Callable[[list[float]], float]] = {"min": min, "mean": fmean, "max": max}
    for name, wanted in _REDUCED.items():
        what, _, unit = name.partition("_")
        for one in wanted:
            if values := series[name]:
                yield f"{what}_{one}_{unit}".rstrip("_"), float(reductions[one](values))
    for name, of in (("armed", series["armed"]), ("drop_rate", series["drop_rate"]), ("rssi_min", series["rssi"])):
        if of:
            yield name, (min if name == "rssi_min" else max)(of)


_REDUCED: Final = {
    "height_m": ("min", "mean", "max"),
    "speed_m_s": ("mean", "max"),
    "climb_m_s": ("min", "max"),
    "roll_deg": ("min", "max"),
    "pitch_deg": ("min", "max"),
}


def _positions(data: bytes, autopilot: Source, kind: str) -> Iterator[tuple[int, int, float, float, float, float]]:
    """Yield of each message when it came, in us, the autopilot's own time, in ms, the place, and the heading.

    Of `LOCAL_POSITION_NED` metres east, north and up, of `GLOBAL_POSITION_INT` degrees north and east, and metres up.
    The heading is that of the last ATTITUDE, in radians from east to north.
    """
    decoder, heading_rad, rows = TlogDecoder(), math.nan, []
    for frame in frames(data):
        if frame.source != autopilot or (message := decoder.message(frame)) is None:
            continue
        if message.get_type() == "ATTITUDE":
            heading_rad = math.pi / 2 - message.yaw
        elif message.get_type() == kind == tlog.GLOBAL:
            place = message.lat / 1e7, message.lon / 1e7, message.alt / 1e3
            rows.append((frame.at_us, message.time_boot_ms, *place, heading_rad))
        elif message.get_type() == kind == tlog.LOCAL:
            place = message.y, message.x, -message.z
            rows.append((frame.at_us, message.time_boot_ms, *place, heading_rad))
    bounds = (90.0, 180.0, _FARTHEST_M) if kind == tlog.GLOBAL else (_FARTHEST_M,) * 3
    if not all(abs(value) <= bound for row in rows for value, bound in zip(row[2:5], bounds, strict=True)):  # nor NaN
        raise ValueError(f"a {kind} tells no place")
    first_rad = next((row[5] for row in rows if math.isfinite(row[5])), 0.0)
    for row in rows:
        yield (*row[:5], row[5] if math.isfinite(row[5]) else first_rad)


if __name__ == "__main__":
    confined.serve(answer)
