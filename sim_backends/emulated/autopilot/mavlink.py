"""MAVLink frames, by the common dialect; the only user of `pymavlink`.

Constants and messages have the names of the dialect (https://mavlink.io/en/messages/common.html).
"""

from collections.abc import Iterator
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

Message = Any
"""One message: an object with its fields as attributes, of a class that the dialect generates."""

__all__ = [
    "AUTOPILOT_COMPONENT",
    "COMMON_CAPABILITIES",
    "EKF_STATUS_REPORT",
    "Message",
    "Writer",
    "addressee",
    "dialect",
    "ekf_status_report",
    "read",
]

AUTOPILOT_COMPONENT: Final[int] = dialect.MAV_COMP_ID_AUTOPILOT1
COMMON_CAPABILITIES: Final[int] = (
    dialect.MAV_PROTOCOL_CAPABILITY_MISSION_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    | dialect.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    | dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
)
EKF_STATUS_REPORT: Final = 193
"""Of ArduPilot's own dialect."""


def ekf_status_report(flags: int) -> Message:
    """Return ArduPilot's message of what its estimates are worth, with these flags of what it knows."""
    from pymavlink.dialects.v20 import ardupilotmega  # noqa: PLC0415 (60 ms, and only ArduPilot says it)

    return ardupilotmega.MAVLink_ekf_status_report_message(flags, *(0.1,) * 5)


def read(datagram: bytes) -> Iterator[Message]:
    """Yield the messages in a datagram; bytes that are none are left out, and so is a frame that is cut off.

    Each datagram is read for itself: one that was cut does not spoil the next.
    """
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True  # bad data is a message of its own, and no error
    for message in parser.parse_buffer(datagram) or ():
        if message.get_type() != "BAD_DATA" and not message.get_type().startswith("UNKNOWN"):
            yield message


def addressee(message: Message) -> tuple[int, int]:
    """Return whom a message is for, system and component; 0 is everybody's, and a message without a field for it."""
    return getattr(message, "target_system", 0), getattr(message, "target_component", 0)


class Writer:
    """Makes the frames for one receiver, who tells by their numbers how many were lost.

    Args:
        system: Id of the system that sends them.
    """

    def __init__(self, system: int) -> None:
        self._link = dialect.MAVLink(None, srcSystem=system, srcComponent=AUTOPILOT_COMPONENT)

    def frame(self, message: Message) -> bytes:
        """Return the next frame, with this message."""
        packed: bytes = message.pack(self._link)
        self._link.seq = (self._link.seq + 1) % 256
        return packed
