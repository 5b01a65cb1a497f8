"""Exports a recording as an MCAP file, for Foxglove and other readers of MCAP: states of robots, and packets.

No other module of `sim_backends` imports mcap. The file format is defined at https://mcap.dev/spec. Foxglove displays
messages with the schemas `foxglove.*` (https://docs.foxglove.dev/docs/sdk/schemas).
"""

import heapq
import json
import math
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import Any, BinaryIO, Final

from mcap.writer import CompressionType, Writer

from sim_backends.cosim.recording.replay import Recording
from sim_backends.cosim.run_record import Fate

Json = Mapping[str, Any]
Message = tuple[int, str, Json]
"""Simulated time in nanoseconds, topic, and content."""

_NUMBER: Final = {"type": "number"}
_TEXT: Final = {"type": "string"}


def _object(title: str, properties: Json, *optional: str) -> Json:
    """Return the JSON schema of an object; all its properties are required, except those in `optional`."""
    required = [name for name in properties if name not in optional]
    return {"title": title, "type": "object", "properties": properties, "required": required}


_TIME: Final = _object(
    "time",
    {"sec": {"type": "integer", "minimum": 0}, "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999}},
)
_VECTOR: Final = _object("foxglove.Vector3", dict.fromkeys("xyz", _NUMBER))
_TRANSFORM: Final = _object(
    "foxglove.FrameTransform",
    {
        "timestamp": _TIME,
        "parent_frame_id": _TEXT,
        "child_frame_id": _TEXT,
        "translation": _VECTOR,
        "rotation": _object("foxglove.Quaternion", dict.fromkeys("xyzw", _NUMBER)),
    },
)
_TRANSFORMS: Final = _object(
    "foxglove.FrameTransforms",
    {"timestamp": _TIME, "transforms": {"type": "array", "items": _TRANSFORM}},
    "timestamp",
)
_STATE: Final = _object("fieldkit.cosim.State", {"timestamp": _TIME, "position_m": _VECTOR, "velocity_m_s": _VECTOR})
_PACKET: Final = _object(
    "fieldkit.cosim.Packet",
    {
        "timestamp": _TIME,
        "flow": _TEXT,
        "number": {"type": "integer"},
        "source": _TEXT,
        "destination": _TEXT,
        "protocol": _TEXT,
        "size_bytes": {"type": "integer"},
        "arrived": {
            "type": "boolean",
            "description": "True if it arrived; absent if the packet was still under way at the end of the run.",
        },
        "reason": {"type": "string", "description": "Reason why it never arrived; absent otherwise."},
        "delay_s": {
            "type": "number",
            "description": "Time from sending until the packet is available to its receiver; this includes the delay "
            "that the sync policy added.",
        },
        "added_s": {
            "type": "number",
            "description": "Part of the delay that the sync policy added.",
        },
    },
    "arrived",
    "reason",
    "delay_s",
    "added_s",
)


def write_mcap(file: BinaryIO, recording: Recording) -> None:
    """Write a recording as MCAP; equal recordings give equal bytes. Times are simulated times, which start at 0.

    The topics are `/tf` with the positions and headings of the robots in the frame `world`, `/states/ROBOT` with
    positions and velocities, and `/packets/FLOW` with each packet and its fate, at the time of sending.

    Args:
        file: The file to write.
        recording: The recording.

    Raises:
        OSError: The file cannot be written.
    """
    writer = Writer(file, compression=CompressionType.ZSTD)
    writer.start(library=f"fieldkit {version('fieldkit')}")
    settings = recording.manifest.about
    writer.add_metadata(
        "fieldkit",
        {
            "scenario": settings.scenario,
            "policy": settings.policy,
            "parameters": json.dumps(dict(settings.parameters), sort_keys=True),
            "seed": str(settings.seed),
            "digest": recording.manifest.digest,
            "ending": recording.manifest.ending.value,
        },
    )
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    for at_ns, topic, content in heapq.merge(_states(recording), _packets(recording), key=lambda message: message[0]):
        if topic not in channels:
            schema = _schema_of(topic)
            if schema["title"] not in schemas:
                schemas[schema["title"]] = writer.register_schema(schema["title"], "jsonschema", _encoded(schema))
            channels[topic] = writer.register_channel(topic, "json", schemas[schema["title"]])
        writer.add_message(channels[topic], log_time=at_ns, publish_time=at_ns, data=_encoded(content))
    writer.finish()  # type: ignore[no-untyped-call]


def _schema_of(topic: str) -> Json:
    return {"tf": _TRANSFORMS, "states": _STATE, "packets": _PACKET}[topic.split("/")[1]]


def _states(recording: Recording) -> Iterator[Message]:
    for at_ns, agent, state in recording.states:
        time, position = _time(at_ns), _vector(state.position_m)
        half_rad = (state.heading_rad or 0.0) / 2  # rotation about the up axis; 0 (east) without a heading
        transform = {
            "timestamp": time,
            "parent_frame_id": "world",
            "child_frame_id": agent,
            "translation": position,
            "rotation": {"x": 0, "y": 0, "z": math.sin(half_rad), "w": math.cos(half_rad)},
        }
        yield at_ns, "/tf", {"timestamp": time, "transforms": [transform]}
        velocity = _vector(state.velocity_m_s)
        yield at_ns, f"/states/{agent}", {"timestamp": time, "position_m": position, "velocity_m_s": velocity}


def _packets(recording: Recording) -> Iterator[Message]:
    for fate in sorted(recording.run.fates.values(), key=lambda fate: fate.packet.sent_ns):
        packet = fate.packet
        flow, number = packet.identity
        content = {
            "timestamp": _time(packet.sent_ns),
            "flow": flow,
            "number": number,
            "source": packet.source,
            "destination": packet.destination,
            "protocol": packet.protocol,
            "size_bytes": packet.size_bytes,
        }
        yield packet.sent_ns, f"/packets/{flow}", content | _fate(fate)


def _fate(fate: Fate) -> dict[str, Any]:
    """Return the fields that describe the fate of a packet; none while the packet is under way."""
    if fate.arrived_ns is None or fate.counted_ns is None:
        return {"arrived": False, "reason": fate.reason} if fate.reason else {}
    packet = fate.packet
    added_ns = packet.enters_ns - packet.sent_ns + fate.counted_ns - fate.arrived_ns
    return {"arrived": True, "delay_s": (fate.counted_ns - packet.sent_ns) / 1e9, "added_s": added_ns / 1e9}


def _time(at_ns: int) -> Json:
    seconds, nanoseconds = divmod(at_ns, 10**9)
    return {"sec": seconds, "nsec": nanoseconds}


def _vector(values: tuple[float, float, float]) -> Json:
    return dict(zip("xyz", values, strict=True))


def _encoded(value: Json) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
