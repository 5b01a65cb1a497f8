"""JSON Schemas of the messages in an MCAP file, and functions that create the messages.

`foxglove.*` are well-known schemas: Foxglove displays messages with these names and fields
(https://docs.foxglove.dev/docs/sdk/schemas).
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from enum import IntEnum
from functools import cache
from typing import Any, Final

from fieldkit.core.columns import Column
from fieldkit.core.model import LinkSample, Vector
from fieldkit.export.mcap import Json
from fieldkit.measure.evidence.ping import Reply
from fieldkit.telemetry.telemetry_samples import TelemetrySample
from fieldkit.trial.columns import IDENTITY, Row


class Level(IntEnum):
    """Level of a log message, with Foxglove's numbers."""

    INFO = 2
    WARNING = 3
    ERROR = 4


def time(t_ns: int) -> Json:
    """Return a time stamp in the format of Foxglove's messages."""
    seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
    return {"sec": seconds, "nsec": nanoseconds}


def log(t_ns: int, level: Level, text: str, *, name: str, file: str, line: int = 0) -> Json:
    """Return a message with the schema `LOG`.

    Args:
        t_ns: Time in nanoseconds since 1970 UTC.
        level: Level of the message.
        text: Text of the message.
        name: Name of the repeat.
        file: File of the trial that the message refers to.
        line: Line in this file; 0 for the whole file.
    """
    return {"timestamp": time(t_ns), "level": level, "message": text, "name": name, "file": file, "line": line}


def phase(t_ns: int, repeat: str, name: str) -> Json:
    """Return a message with the schema `PHASE`: the phase that starts in the attempt whose folder is `repeat`."""
    return {"timestamp": time(t_ns), "repeat": repeat, "phase": name}


def rtt(t_ns: int, repeat: str, reply: Reply) -> Json:
    """Return a message with the schema `RTT`: a reply to ping printed at `t_ns`. `repeat` is the attempt's folder."""
    head = {"timestamp": time(t_ns), "repeat": repeat}
    fields = {"seq": reply.seq, "rtt_s": reply.rtt_s, "duplicate": reply.duplicate, "damaged": reply.damaged}
    return {**head, **_present(fields)}


def link(repeat: str, sample: LinkSample) -> Json:
    """Return a message with the schema `LINK`: a sample of a radio in the attempt whose folder is `repeat`."""
    radio = {
        "noise_dbm": sample.noise_dbm,
        "active_s": None if sample.active_ns is None else sample.active_ns / 1e9,
        "busy_s": None if sample.busy_ns is None else sample.busy_ns / 1e9,
    }
    stations = [_present(asdict(station)) for station in sample.stations]
    return {"timestamp": time(sample.utc_ns), "repeat": repeat, **_present(radio), "stations": stations}


def telemetry(repeat: str, sample: TelemetrySample) -> Json:
    """Return a message with the schema `TELEMETRY`: values of a source in the attempt whose folder is `repeat`."""
    return {"timestamp": time(sample.utc_ns), "repeat": repeat, **sample.values}


def _present(values: Mapping[str, Any]) -> Json:
    return {name: value for name, value in values.items() if value is not None}


def repeat(t_ns: int, folder: str, row: Row, table: tuple[Column, ...]) -> Json:
    """Return a message with the schema `repeat_schema`: the known numbers of the attempt in `folder`."""
    measured = {name: row[name] for name in _measured(table) if name in row}
    head = {"timestamp": time(t_ns), "repeat": folder, "status": row["status"], "reason": row.get("reason", "")}
    return head | measured


def transform(t_ns: int, child: str, position_m: Vector, frame: str = "field") -> Json:
    """Return a robot's position in a frame, as a message with the schema `TRANSFORMS`.

    The rotation is always 0, because the orientation of the robot is unknown.
    """
    transform = {
        "timestamp": time(t_ns),
        "parent_frame_id": frame,
        "child_frame_id": child,
        "translation": dict(zip("xyz", position_m, strict=True)),
        "rotation": {"x": 0, "y": 0, "z": 0, "w": 1},
    }
    return {"transforms": [transform]}


def location(t_ns: int, robot: str, place: Vector) -> Json:
    """Return a robot's geographic position as a message with the schema `LOCATION`.

    Args:
        t_ns: Time in nanoseconds since 1970 UTC.
        robot: Name of the robot.
        place: Latitude and longitude in degrees, and height above the ellipsoid in metres; NaN without a height.
    """
    latitude_deg, longitude_deg, height_m = place
    fields = {"timestamp": time(t_ns), "frame_id": robot, "latitude": latitude_deg, "longitude": longitude_deg}
    return fields if math.isnan(height_m) else fields | {"altitude": height_m}


def _object(title: str, properties: Json, *, optional: tuple[str, ...] = ()) -> Json:
    required = [name for name in properties if name not in optional]
    return {"title": title, "type": "object", "properties": properties, "required": required}


def _numbers(names: Iterable[str]) -> Json:
    return {name: {"type": "number"} for name in names}


def _typed(kind: str, description: str, **limits: object) -> Json:
    return {"type": kind, "description": description, **limits}


_TIME: Final = _object(
    "time",
    {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999}},
)
_REPEAT: Final = _typed(
    "string",
    "Folder of an attempt. Its name is that of the repeat, udp-07; for a void attempt with its number, udp-07.void1.",
)

LOG: Final = _object(
    "foxglove.Log",
    {
        "timestamp": _TIME,
        "level": {"oneOf": [{"title": level.name, "const": int(level)} for level in Level]},
        "message": _typed("string", "What happened."),
        "name": _typed("string", "The repeat."),
        "file": _typed("string", "File of the trial that the message refers to."),
        "line": _typed("integer", "Line of this file; 0 for the whole file.", minimum=0),
    },
)
TRANSFORMS: Final = _object(
    "foxglove.FrameTransforms",
    {
        "transforms": {
            "type": "array",
            "items": _object(
                "foxglove.FrameTransform",
                {
                    "timestamp": _TIME,
                    "parent_frame_id": {"type": "string"},
                    "child_frame_id": {"type": "string"},
                    "translation": _object("foxglove.Vector3", _numbers("xyz")),
                    "rotation": _object("foxglove.Quaternion", _numbers("xyzw")),
                },
            ),
        }
    },
)
LOCATION: Final = _object(
    "foxglove.LocationFix",
    {"timestamp": _TIME, "frame_id": {"type": "string"}, **_numbers(("latitude", "longitude", "altitude"))},
    optional=("altitude",),
)
PHASE: Final = _object(
    "fieldkit.Phase",
    {
        "timestamp": _TIME,
        "repeat": _REPEAT,
        "phase": _typed("string", "Phase that starts: record, transfer or ping; idle if a phase ends."),
    },
)
RTT: Final = _object(
    "fieldkit.Rtt",
    {
        "timestamp": _TIME,
        "repeat": _REPEAT,
        "seq": _typed("integer", "Sequence number of the echo request."),
        "rtt_s": _typed("number", "Round-trip time in seconds; absent if ping printed no time."),
        "duplicate": _typed("boolean", "True if the request had been answered before."),
        "damaged": _typed("boolean", "True if the checksum was wrong."),
    },
    optional=("rtt_s",),
)
PACKET: Final = _object(
    "fieldkit.Packet",
    {
        "timestamp": _TIME,
        "repeat": _REPEAT,
        "protocol": _typed("integer", "IP protocol number: 1 ICMP, 6 TCP, 17 UDP."),
        "source": _typed("string", "Source address."),
        "destination": _typed("string", "Destination address."),
        "source_port": _typed("integer", "Source port; absent if the packet has no port."),
        "destination_port": _typed("integer", "Destination port; absent if the packet has no port."),
        "wire_bytes": _typed("integer", "Length of the frame on the link."),
        "payload_bytes": _typed("integer", "Bytes after the IP header."),
        "fragment_offset": _typed("integer", "Offset of the payload in its datagram, in bytes."),
        "lost": _typed("boolean", "True if the receiver's capture has no copy; absent if unknown."),
        "copy": _typed("boolean", "True if the same packet had been received before; absent if unknown."),
    },
    optional=("source_port", "destination_port", "lost", "copy"),
)

_STATION: Final = {
    "station": _typed("string", "Address of the other radio, or its name; empty if unknown."),
    "signal_dbm": _typed("number", "Signal received from this station, in dBm."),
    "tx_rate_bit_s": _typed("number", "PHY rate of the last frame to this station, in bit/s."),
    "rx_rate_bit_s": _typed("number", "PHY rate of the last frame from this station, in bit/s."),
    "tx_packets": _typed("integer", "Packets sent to this station; counters may start at any number."),
    "rx_packets": _typed("integer", "Packets received from this station."),
    "tx_retries": _typed("integer", "Retransmissions of frames to this station."),
    "tx_failures": _typed("integer", "Packets to this station that were dropped after the last retry."),
    "beacon_losses": _typed("integer", "Number of times that beacons of this station were lost."),
}
_CHANNEL: Final = {
    "noise_dbm": _typed("number", "Noise in the channel, in dBm; absent if the radio does not report it."),
    "active_s": _typed("number", "Time for which the radio was on its channel, since an arbitrary start."),
    "busy_s": _typed("number", "Part of active_s in which the channel was busy."),
}
LINK: Final = _object(
    "fieldkit.Link",
    {
        "timestamp": _TIME,
        "repeat": _REPEAT,
        **_CHANNEL,
        "stations": {
            "type": "array",
            "items": _object("fieldkit.Station", _STATION, optional=tuple(_STATION)[1:]),
        },
    },
    optional=tuple(_CHANNEL),
)


_QUANTITIES: Final = {
    "signal_dbm": _typed("number", "Received signal strength, in dBm."),
    "sinr_db": _typed("number", "Ratio of signal to interference and noise, in dB."),
    "noise_dbm": _typed("number", "Noise, in dBm."),
    "band": _typed("string", "Access technology, band or channel."),
    "cell": _typed("string", "Cell or access point."),
    "tx_rate_bit_s": _typed("number", "Rate of transmission, in bit/s."),
    "rx_rate_bit_s": _typed("number", "Rate of reception, in bit/s."),
    "neighbours": _typed("number", "Number of other cells, stations or mesh nodes that the radio received."),
}
TELEMETRY: Final = _object(
    "fieldkit.Telemetry", {"timestamp": _TIME, "repeat": _REPEAT, **_QUANTITIES}, optional=tuple(_QUANTITIES)
)


@cache
def _measured(table: tuple[Column, ...]) -> Json:
    """Return the schema of each numeric or boolean column of a table, by name; columns of `IDENTITY` are excluded."""
    kinds = {int: "integer", float: "number", bool: "boolean"}
    return {
        column.name: _typed(kinds[column.type], f"{column.meaning} Unit: {column.unit}.")
        for column in table
        if column.type in kinds and column not in IDENTITY
    }


@cache
def repeat_schema(table: tuple[Column, ...]) -> Json:
    """Return the schema of the messages that `repeat` creates from the rows of a table."""
    measured = _measured(table)
    return _object(
        "fieldkit.Repeat",
        {
            "timestamp": _TIME,
            "repeat": _REPEAT,
            "status": _typed("string", "valid, void or failed."),
            "reason": _typed("string", "Reason why the attempt is not valid; empty if it is valid."),
            **measured,
        },
        optional=tuple(measured),
    )
