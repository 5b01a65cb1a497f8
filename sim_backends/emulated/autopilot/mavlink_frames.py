"""MAVLink frames of the common dialect, and the port that sends and receives them.

No other module of the emulated autopilot imports `pymavlink`. Constants and messages have the names of the dialect
(https://mavlink.io/en/messages/common.html). The port acts like an autopilot behind a router: all clients receive one
stream of frames, with the same sequence numbers and message rates. As in mavlink-router, a frame with a target is
sent only to the clients that have sent frames of this system and component, so other clients receive gaps in the
sequence numbers.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

Message = Any
"""A message: an object with its fields as attributes, of a class that the dialect generates."""

__all__ = [
    "AUTOPILOT_COMPONENT",
    "AVAILABLE_MODES",
    "COMMON_CAPABILITIES",
    "COMPONENT_METADATA",
    "EKF_STATUS_REPORT",
    "PROTOCOL_VERSION",
    "Message",
    "Writer",
    "available_modes",
    "component_metadata",
    "dialect",
    "ekf_status_report",
    "protocol_version",
    "read",
    "target_of",
]

AUTOPILOT_COMPONENT: Final[int] = dialect.MAV_COMP_ID_AUTOPILOT1
COMMON_CAPABILITIES: Final[int] = (
    dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
EKF_STATUS_REPORT: Final = 193
"""Message of ArduPilot's dialect."""
PROTOCOL_VERSION: Final = 300
COMPONENT_METADATA: Final = 397
AVAILABLE_MODES: Final = 435
"""Messages of the common dialect that are missing in pymavlink's `common`."""


class _RawMessage(dialect.MAVLink_message):  # type: ignore[misc]  # pymavlink has no types
    """A message that pymavlink's dialect `common` lacks, with a payload that is already packed.

    Args:
        number: Message id.
        name: Name of the message.
        payload: The packed fields.
        crc_extra: CRC_EXTRA of the message: a number, derived from its fields, that the checksum of a frame includes.
    """

    def __init__(self, number: int, name: str, payload: bytes, crc_extra: int) -> None:
        super().__init__(number, name)
        self._packed = payload
        self._extra = crc_extra

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:  # noqa: ANN401 (of pymavlink)
        """Return the frame of this message."""
        packed: bytes = self._pack(mav, self._extra, self._packed, force_mavlink1)
        return packed


def protocol_version() -> Message:
    """Return PROTOCOL_VERSION: the autopilot sends MAVLink 2, and accepts versions 1 and 2.

    Source: https://mavlink.io/en/messages/common.html#PROTOCOL_VERSION.
    """
    payload = struct.pack("<3H8s8s", 200, 100, 200, b"", b"")
    return _RawMessage(PROTOCOL_VERSION, "PROTOCOL_VERSION", payload, 217)


def component_metadata(boot_ms: int, uri: str) -> Message:
    """Return COMPONENT_METADATA with the URI of the general metadata file, and with the checksum 0 (unknown)."""
    payload = struct.pack("<II100s", boot_ms, 0, uri.encode("ascii"))
    return _RawMessage(COMPONENT_METADATA, "COMPONENT_METADATA", payload, 182)


def available_modes(count: int, index: int, standard: int, custom: int, name: str) -> Message:
    """Return AVAILABLE_MODES of one mode; indices start at 1.

    Args:
        count: Number of modes.
        index: Index of this mode.
        standard: MAV_STANDARD_MODE, 0 for a mode that is not standard.
        custom: Custom mode of HEARTBEAT.
        name: Display name.
    """
    payload = struct.pack("<IIBBB35s", custom, 0, count, index, standard, name.encode("ascii"))
    return _RawMessage(AVAILABLE_MODES, "AVAILABLE_MODES", payload, 134)


def ekf_status_report(flags: int) -> Message:
    """Return ArduPilot's EKF_STATUS_REPORT with these flags."""
    from pymavlink.dialects.v20 import ardupilotmega  # noqa: PLC0415 (takes 60 ms; only ArduPilot sends it)

    return ardupilotmega.MAVLink_ekf_status_report_message(flags, *(0.1,) * 5)


def read(datagram: bytes) -> Iterator[Message]:
    """Yield the messages in a datagram; other bytes, incomplete frames and unknown messages are skipped.

    Each datagram is parsed separately, so that an incomplete frame does not affect the next datagram.
    """
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True  # bad data becomes a message instead of an error
    for message in parser.parse_buffer(datagram) or ():
        if message.get_type() != "BAD_DATA" and not message.get_type().startswith("UNKNOWN"):
            yield message


def target_of(message: Message) -> tuple[int, int]:
    """Return the target system and component of a message, each 0 (broadcast) if the message has no such field."""
    return getattr(message, "target_system", 0), getattr(message, "target_component", 0)


class Writer:
    """Packs the frames of one port, with their sequence numbers.

    Args:
        system: Id of the sending system.
    """

    def __init__(self, system: int) -> None:
        self._link = dialect.MAVLink(None, srcSystem=system, srcComponent=AUTOPILOT_COMPONENT)

    def frame(self, message: Message) -> bytes:
        """Return the next frame, with this message."""
        packed: bytes = message.pack(self._link)
        self._link.seq = (self._link.seq + 1) % 256
        return packed


MAX_CLIENTS: Final = 16
SILENT_NS: Final = 15_000_000_000
"""A client that sends nothing for this long is removed."""

Address = tuple[str, int]
"""Address and UDP port of a client."""
Frame = tuple[Address, bytes]
"""Address of the receiver, and the frame."""


@dataclass
class _Client:
    """A client: time of its last message, and the systems and components whose frames it has sent."""

    received_ns: int
    senders: set[tuple[int, int]] = field(default_factory=set)

    def is_addressed(self, system: int, component: int) -> bool:
        """Return True if a frame with this target is for the client; 0 is a broadcast."""
        if not system:
            return True
        return any(
            system == sender_system and component in {0, sender_component}
            for sender_system, sender_component in self.senders
        )


_MAX_SENDERS: Final = 64
"""Maximum number of systems and components that are stored for a client."""


class MavlinkPort:
    """One port with its clients.

    Args:
        system: System id of the autopilot.
    """

    def __init__(self, system: int) -> None:
        self._writer = Writer(system)
        self._clients: dict[Address, _Client] = {}

    def set_system(self, system: int) -> None:
        """Set the system id of later frames."""
        self._writer = Writer(system)

    @property
    def is_used(self) -> bool:
        """True if there is a client."""
        return bool(self._clients)

    def register(self, sender: Address, message: Message, now_ns: int) -> bool:
        """Register the sender of a message as a client; return True unless there are `MAX_CLIENTS` other clients."""
        client = self._clients.get(sender)
        if client is None:
            if len(self._clients) == MAX_CLIENTS:
                return False
            client = self._clients[sender] = _Client(now_ns)
        client.received_ns = now_ns
        if len(client.senders) < _MAX_SENDERS:
            client.senders.add((message.get_srcSystem(), message.get_srcComponent()))
        return True

    def expire(self, now_ns: int) -> None:
        """Remove silent clients."""
        self._clients = {
            address: client for address, client in self._clients.items() if now_ns - client.received_ns < SILENT_NS
        }

    def frames(self, messages: Iterable[Message]) -> Iterator[Frame]:
        """Yield each message as a frame, once per client that receives it."""
        for message in messages:
            frame = self._writer.frame(message)
            target = target_of(message)
            for address, client in self._clients.items():
                if client.is_addressed(*target):
                    yield address, frame
