"""Parse and create the MAVLink frames that fieldkit uses (https://mavlink.io/en/guide/serialization.html)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Iterator

HEARTBEAT, ATTITUDE, LOCAL_POSITION_NED, COMMAND_LONG, COMMAND_ACK, SET_POINT, STATUSTEXT = 0, 30, 32, 76, 77, 84, 253
SYS_STATUS, PARAM_REQUEST_READ, PARAM_VALUE, GLOBAL_POSITION_INT, HOME_POSITION = 1, 20, 22, 33, 242
EKF_STATUS_REPORT, ESTIMATOR_STATUS = 193, 230
"""Message ids (https://mavlink.io/en/messages/common.html; EKF_STATUS_REPORT is defined in ardupilotmega). SET_POINT
is SET_POSITION_TARGET_LOCAL_NED."""
SET_MESSAGE_INTERVAL = 511
"""MAV_CMD_SET_MESSAGE_INTERVAL: message id, and interval in microseconds; 0 for the default rate."""
ACCEPTED, IN_PROGRESS = 0, 5
"""MAV_RESULT: the command is executed (ACCEPTED), or has no final result yet (IN_PROGRESS)."""
NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: in heartbeats of ground stations, cameras and loggers."""

OWN_SYSTEM, OWN_COMPONENT = 254, 155
"""System and component id of the recorder: a system id that vehicles do not usually have, and MAV_COMP_ID_LOG."""
TYPE_LOG = 38
"""MAV_TYPE_LOG."""

_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_SIGNED = 1
"""Flag of frames of MAVLink 2 that end with a signature."""
_SIGNATURE_BYTES = 13
_ACTIVE = 4
"""MAV_STATE_ACTIVE."""
_VERSION = 3
"""MAVLink version in heartbeats."""
CRC_EXTRA = {
    HEARTBEAT: 50,
    ATTITUDE: 39,
    LOCAL_POSITION_NED: 185,
    COMMAND_LONG: 152,
    COMMAND_ACK: 143,
    SET_POINT: 143,
    STATUSTEXT: 83,
    SYS_STATUS: 124,
    PARAM_REQUEST_READ: 214,
    PARAM_VALUE: 220,
    GLOBAL_POSITION_INT: 104,
    EKF_STATUS_REPORT: 71,
    ESTIMATOR_STATUS: 163,
    HOME_POSITION: 104,
}
"""Each message's CRC_EXTRA, a byte that depends on its definition (mavlink.io, serialization)."""


def frame_bytes(buffer: bytes | bytearray) -> int | None:
    """Return the length of the frame at the start of a buffer; None if the buffer has less than 3 bytes.

    The length depends on the first 3 bytes. The first byte must be a start marker of MAVLink 1 or 2 (mavlink.io,
    serialization). The frame itself may be incomplete.
    """
    if len(buffer) < 3:
        return None
    # The second byte is the length of the payload. Header and checksum have 8 (MAVLink 1) or 12 bytes (MAVLink 2).
    if buffer[0] == _MAGIC_1:
        return 8 + buffer[1]
    return 12 + buffer[1] + (_SIGNATURE_BYTES if buffer[2] & _SIGNED else 0)


def frames(buffer: bytearray) -> Iterator[bytes]:
    """Yield the complete frames of a buffer. The frames, and bytes outside of frames, are deleted from the buffer.

    A frame is accepted only if a start marker or the end of the buffer follows, because a stream may start in the
    middle of a frame. An incomplete frame at the end stays in the buffer.
    """
    while buffer:
        is_start = buffer[0] in (_MAGIC_1, _MAGIC_2)
        size = frame_bytes(buffer) if is_start else 1
        if size is None or len(buffer) < size:
            return
        if not is_start or (len(buffer) > size and buffer[size] not in (_MAGIC_1, _MAGIC_2)):
            del buffer[0]
            continue
        yield bytes(buffer[:size])
        del buffer[:size]


def checksum(data: bytes) -> int:
    """Return the CRC-16/MCRF4XX, which MAVLink calls X.25."""
    crc = 0xFFFF
    for byte in data:
        low = (byte ^ crc) & 0xFF
        low = (low ^ low << 4) & 0xFF
        crc = crc >> 8 ^ low << 8 ^ low << 3 ^ low >> 4
    return crc


def is_intact(frame: bytes) -> bool:
    """Return True if the checksum of a complete frame is correct; False for messages that are not in `CRC_EXTRA`."""
    message = parse_frame(frame)
    if message.kind not in CRC_EXTRA:
        return False
    end = (6 if frame[0] == _MAGIC_1 else 10) + frame[1]
    expected_checksum = checksum(frame[1:end] + bytes((CRC_EXTRA[message.kind],)))
    return int.from_bytes(frame[end : end + 2], "little") == expected_checksum


class FrameWriter:
    """Creates frames with sequence numbers.

    Args:
        system: System id of the sender.
        component: Component id of the sender.
    """

    def __init__(self, system: int = OWN_SYSTEM, component: int = OWN_COMPONENT) -> None:
        self._address = (system, component)
        self._sequence = 0

    def frame(self, kind: int, payload: bytes) -> bytes:
        """Return the next frame of MAVLink 2 with this message.

        Trailing zeros of the payload are omitted, except its first byte.
        """
        payload = payload.rstrip(b"\0") or payload[:1]
        header = (len(payload), 0, 0, self._sequence, *self._address)
        self._sequence = (self._sequence + 1) % 256
        body = bytes(header) + kind.to_bytes(3, "little") + payload
        return bytes((_MAGIC_2,)) + body + checksum(body + bytes((CRC_EXTRA[kind],))).to_bytes(2, "little")

    def heartbeat(self, vehicle: int = TYPE_LOG) -> bytes:
        """Return a heartbeat of a component that is not an autopilot.

        Args:
            vehicle: MAV_TYPE of the sender. The default is a logger, so that an autopilot does not take the sender
                for a ground station, whose loss may start a failsafe.
        """
        return self.frame(HEARTBEAT, struct.pack("<IBBBBB", 0, vehicle, NO_AUTOPILOT, 0, _ACTIVE, _VERSION))

    def command(self, target: tuple[int, int], command: int, *parameters: float) -> bytes:
        """Return a command to a system and component; omitted parameters are 0."""
        padded_parameters = (*parameters, *(0.0,) * (7 - len(parameters)))
        return self.frame(COMMAND_LONG, struct.pack("<7fHBBB", *padded_parameters, command, *target, 0))


@dataclass(frozen=True)
class ParsedFrame:
    """Message id (`kind`), sender and payload of a frame."""

    kind: int
    system: int
    component: int
    payload: bytes


def parse_frame(frame: bytes) -> ParsedFrame:
    """Return the message id, the sender and the payload of a complete frame."""
    size = frame[1]
    if frame[0] == _MAGIC_1:
        return ParsedFrame(frame[5], frame[3], frame[4], frame[6 : 6 + size])
    return ParsedFrame(int.from_bytes(frame[7:10], "little"), frame[5], frame[6], frame[10 : 10 + size])
