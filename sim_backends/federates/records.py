"""Encoding of records inside messages: commands, packets, arrivals and drops."""

import math
import struct
from collections.abc import Iterable, Mapping
from functools import lru_cache
from typing import Any, Final, NamedTuple

from sim_backends.federates.agent_states import AgentTable
from sim_backends.federates.frames import FrameReader, MalformedFrameError, count_bytes, text_bytes
from sim_backends.network.packets import Arrival, Drop, Packet
from sim_backends.physics.body import Twist, Velocity

_PACKET: Final = struct.Struct("<QqQqqII")
_ARRIVAL: Final = struct.Struct("<QqII")
_DROP: Final = struct.Struct("<Q")
_DELAY_PARTS: Final = struct.Struct("<3q")
_COMMAND: Final = struct.Struct("<IHH")
_TWIST: Final = struct.Struct("<2d")
_VELOCITY: Final = struct.Struct("<4d")
TWIST, VELOCITY = 1, 2
"""Numbers of the types of commands in the protocol."""
COMMAND_TYPES: Final = (TWIST, VELOCITY)
_MAX_BYTES: Final = 1 << 62
"""Largest accepted size of a packet."""

LAYOUTS: Final = {
    "agent": "`name` text, `profile` text, `flies` u8, `antenna_m` f64 (its height above the body's position), "
    "`start` state",
    "state": "`agent` u32, `reserved` u32, `position_m` 3 f64, `velocity_m_s` 3 f64, `heading_rad` f64, `limit_m_s2` "
    "f64: 72 bytes",
    "command": "`agent` u32, `type` u16, `size` u16, then `size` bytes",
    f"command {TWIST}, twist": "`forward_m_s` f64, `turn_rad_s` f64: for robots that drive",
    f"command {VELOCITY}, velocity": "`velocity_m_s` 3 f64, `yaw_rad` f64, NaN to keep the heading: for robots that "
    "fly",
    "packet": "`id` u64, `number` i64, `size_bytes` u64, `sent_ns` i64, `enters_ns` i64, `source` u32, `destination` "
    "u32, `flow` text, `protocol` text",
    "arrival": "`id` u64, `at_ns` i64, `agent` u32, `reserved` u32",
    "drop": "`id` u64, `reason` text",
    "delay parts": "`queuing_ns` i64, `transmission_ns` i64, `propagation_ns` i64, none negative; the rest of the "
    "delay, from `enters_ns` to `at_ns`, is processing in hosts",
    "radio sample": "`agent` u32, `reserved` u32, `noise_dbm` f64, `active_ns` i64, `busy_ns` i64 (as in `iw survey "
    "dump`)",
    "link sample": "`agent` u32, `peer` u32, `signal_dbm` f64, `tx_rate_bit_s` f64, `rx_rate_bit_s` f64 (NaN if "
    "unknown), `tx_packets` u64, `rx_packets` u64, `tx_retries` u64, `tx_failures` u64 (as in `iw station dump`)",
}
"""Layout of each part of a message, for the reference."""

_text_bytes: Final = lru_cache(maxsize=4096)(text_bytes)
"""`text_bytes` with a cache, because most texts of packets are recurring names of flows and transports."""


def commands_bytes(commands: Mapping[str, Any], agents: AgentTable) -> bytes:
    """Return commands to agents as bytes.

    Raises:
        ValueError: A command has no layout, or is for an agent that was not announced.
    """
    parts = [count_bytes(len(commands))]
    for name, command in commands.items():
        if name not in agents.indices:
            raise ValueError(f"there is a command to {name}, which is not an agent")
        kind, body = _command(name, command)
        parts.append(_COMMAND.pack(agents.indices[name], kind, len(body)) + body)
    return b"".join(parts)


def command_type(command: object) -> int:
    """Return the number of a command's type; 0 if it has no layout."""
    return TWIST if isinstance(command, Twist) else VELOCITY if isinstance(command, Velocity) else 0


def _command(name: str, command: object) -> tuple[int, bytes]:
    if isinstance(command, Twist):
        return TWIST, _TWIST.pack(command.forward_m_s, command.turn_rad_s)
    if isinstance(command, Velocity):
        yaw_rad = math.nan if command.yaw_rad is None else command.yaw_rad
        return VELOCITY, _VELOCITY.pack(*command.velocity_m_s, yaw_rad)
    raise ValueError(f"the command {command!r} to {name} cannot be sent to an external federate")


def read_commands(reader: FrameReader, agents: AgentTable) -> dict[str, Twist | Velocity]:
    """Return the next list of commands in a frame, by agent.

    Raises:
        MalformedFrameError: A command is invalid, or its type is unknown.
    """
    commands: dict[str, Twist | Velocity] = {}
    for _ in range(reader.count(_COMMAND.size)):
        position = reader.position
        index, kind, size = reader.unpack(_COMMAND)
        name = agents.name(index, position)
        if (kind, size) == (TWIST, _TWIST.size):
            commands[name] = Twist(*reader.unpack(_TWIST))
        elif (kind, size) == (VELOCITY, _VELOCITY.size):
            e, n, u, yaw_rad = reader.unpack(_VELOCITY)
            commands[name] = Velocity((e, n, u), None if math.isnan(yaw_rad) else yaw_rad)
        else:
            raise MalformedFrameError(position + 4, f"a command of type {kind} and {size} bytes is not supported")
    return commands


def packets_bytes(packets: Iterable[Packet], agents: AgentTable) -> bytes:
    """Return packets as bytes."""
    indices, pack = agents.indices, _PACKET.pack
    parts = [
        pack(packet_id, number, size_bytes, sent_ns, enters_ns, indices[source], indices[destination])
        + _text_bytes(flow)
        + _text_bytes(protocol)
        for packet_id, source, destination, size_bytes, (flow, number), sent_ns, enters_ns, protocol in packets
    ]
    return count_bytes(len(parts)) + b"".join(parts)


def read_packets(reader: FrameReader, agents: AgentTable) -> list[Packet]:
    """Return the next list of packets in a frame.

    Raises:
        MalformedFrameError: A packet is invalid.
    """
    packets = []
    for _ in range(reader.count(_PACKET.size + 4)):
        position = reader.position
        packet_id, number, size_bytes, sent_ns, enters_ns, source, destination = reader.unpack(_PACKET)
        if size_bytes > _MAX_BYTES:
            raise MalformedFrameError(position + 16, f"a packet of {size_bytes} bytes is too large")
        ends = agents.name(source, position + 40), agents.name(destination, position + 44)
        identity = reader.text(), number
        packets.append(Packet(packet_id, *ends, size_bytes, identity, sent_ns, enters_ns, reader.text()))
    return packets


def arrivals_bytes(arrivals: Iterable[Arrival], agents: AgentTable) -> bytes:
    """Return arrivals as bytes.

    Raises:
        KeyError: A receiver was not announced.
    """
    parts = [
        _ARRIVAL.pack(arrival.packet_id, arrival.at_ns, agents.indices[arrival.receiver], 0) for arrival in arrivals
    ]
    return count_bytes(len(parts)) + b"".join(parts)


def read_arrivals(reader: FrameReader, agents: AgentTable) -> list[Arrival]:
    """Return the next list of arrivals in a frame.

    Raises:
        MalformedFrameError: An arrival is invalid.
    """
    count = reader.count(_ARRIVAL.size)
    begin, names = reader.position, agents.names
    arrivals: list[Arrival] = []
    for packet_id, at_ns, index, reserved in _ARRIVAL.iter_unpack(reader.read_bytes(count * _ARRIVAL.size)):
        if reserved or index >= len(names):
            position = begin + len(arrivals) * _ARRIVAL.size
            if reserved:
                raise MalformedFrameError(position + 20, f"the reserved field is {reserved}, not 0")
            agents.name(index, position + 16)  # raises
        arrivals.append(Arrival(packet_id, names[index], at_ns))
    return arrivals


def drops_bytes(drops: Iterable[Drop]) -> bytes:
    """Return drops as bytes."""
    parts = [_DROP.pack(drop.packet_id) + text_bytes(drop.reason) for drop in drops]
    return count_bytes(len(parts)) + b"".join(parts)


def read_drops(reader: FrameReader) -> list[Drop]:
    """Return the next list of drops in a frame.

    Raises:
        MalformedFrameError: A drop is invalid.
    """
    return [Drop(reader.unpack(_DROP)[0], reader.text()) for _ in range(reader.count(_DROP.size + 2))]


class ArrivalDelay(NamedTuple):
    """Parts of the delay of an arrival; the rest of its delay is processing in hosts.

    Attributes:
        queuing_ns: Time in queues.
        transmission_ns: Time from the first attempt to transmit a frame until the end of the received frame.
        propagation_ns: Time in the air.
    """

    queuing_ns: int
    transmission_ns: int
    propagation_ns: int


def arrival_delays_bytes(delays: Iterable[ArrivalDelay]) -> bytes:
    """Return the parts of the delay of each arrival as bytes."""
    return b"".join(_DELAY_PARTS.pack(*parts) for parts in delays)


def read_arrival_delays(reader: FrameReader, count: int) -> list[ArrivalDelay]:
    """Return the parts of the delays of `count` arrivals.

    Raises:
        MalformedFrameError: The frame ends too early, or a part is negative.
    """
    begin = reader.position
    delays = [
        ArrivalDelay(*parts) for parts in _DELAY_PARTS.iter_unpack(reader.read_bytes(count * _DELAY_PARTS.size))
    ]
    for number, parts in enumerate(delays):
        if min(parts) < 0:
            raise MalformedFrameError(begin + number * _DELAY_PARTS.size, f"a part of a delay is {min(parts)} ns")
    return delays
