"""Frames of MAVLink, as far as a recorder and a pilot must know them (https://mavlink.io/en/guide/serialization.html)."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Iterator

HEARTBEAT, ATTITUDE, LOCAL_POSITION_NED, COMMAND_LONG, COMMAND_ACK, SET_POINT, STATUSTEXT = 0, 30, 32, 76, 77, 84, 253
SYS_STATUS, PARAM_REQUEST_READ, PARAM_VALUE, GLOBAL_POSITION_INT, HOME_POSITION = 1, 20, 22, 33, 242
EKF_STATUS_REPORT, ESTIMATOR_STATUS = 193, 230
"""Ids of messages (https://mavlink.io/en/messages/common.html; EKF_STATUS_REPORT is of ardupilotmega); a set-point is
SET_POSITION_TARGET_LOCAL_NED."""
SET_MESSAGE_INTERVAL = 511
"""MAV_CMD_SET_MESSAGE_INTERVAL: the message, and the time between two in microseconds; 0 for as often as usual."""
ACCEPTED, IN_PROGRESS = 0, 5
"""MAV_RESULT: ACCEPTED is the result of a command that is done; IN_PROGRESS is not a final result yet."""
NO_AUTOPILOT = 8
"""MAV_AUTOPILOT_INVALID: what beats is a ground station, a camera, a logger."""

OWN_SYSTEM, OWN_COMPONENT = 254, 155
"""Who the recorder is: MAV_COMP_ID_LOG of a system that no vehicle is."""
TYPE_LOG = 38
"""MAV_TYPE_LOG."""

_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_SIGNED = 1
_SIGNATURE_BYTES = 13
_ACTIVE = 4
"""MAV_STATE_ACTIVE."""
_VERSION = 3
"""Of MAVLink, as every heartbeat has it."""
EXTRA = {
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
"""What the checksum of a message ends with: of its definition (mavlink.io, serialization, CRC_EXTRA)."""


def frame_bytes(buffer: bytes | bytearray) -> int | None:
    """Return the length of the frame that a buffer begins with, by its header; None where that is not whole yet.

    The first byte is one of those that frames begin with (mavlink.io, serialization).
    """
    if len(buffer) < 3:
        return None
    if buffer[0] == _MAGIC_1:
        return 8 + buffer[1]
    return 12 + buffer[1] + (_SIGNATURE_BYTES if buffer[2] & _SIGNED else 0)


def frames(buffer: bytearray) -> Iterator[bytes]:
    """Take the whole frames from a buffer, and what is before, between and behind them and is none.

    A frame behind which none begins is none: somebody listened from the middle of one on. What may become one stays.
    """
    while buffer:
        begins = buffer[0] in (_MAGIC_1, _MAGIC_2)
        size = frame_bytes(buffer) if begins else 1
        if size is None or len(buffer) < size:
            return
        if not begins or (len(buffer) > size and buffer[size] not in (_MAGIC_1, _MAGIC_2)):
            del buffer[0]
            continue
        yield bytes(buffer[:size])
        del buffer[:size]


def checksum(data: bytes) -> int:
    """Return CRC-16/MCRF4XX, which MAVLink calls X.25."""
    crc = 0xFFFF
    for byte in data:
        low = (byte ^ crc) & 0xFF
        low = (low ^ low << 4) & 0xFF
        crc = crc >> 8 ^ low << 8 ^ low << 3 ^ low >> 4
    return crc


def is_intact(frame: bytes) -> bool:
    """Return whether a whole frame has the checksum that it must have; unknown, and so not, of most messages."""
    found = head(frame)
    if found.kind not in EXTRA:
        return False
    end = (6 if frame[0] == _MAGIC_1 else 10) + frame[1]
    wanted = checksum(frame[1:end] + bytes((EXTRA[found.kind],)))
    return int.from_bytes(frame[end : end + 2], "little") == wanted


class FrameWriter:
    """Makes own frames, numbered.

    Args:
        system: Who sends them.
        component: And which part of it.
    """

    def __init__(self, system: int = OWN_SYSTEM, component: int = OWN_COMPONENT) -> None:
        self._own = (system, component)
        self._sequence = 0

    def frame(self, kind: int, payload: bytes) -> bytes:
        """Return the next frame, of MAVLink 2, with this message; zeros at its end are left out."""
        payload = payload.rstrip(b"\0") or payload[:1]
        head = (len(payload), 0, 0, self._sequence, *self._own)
        self._sequence = (self._sequence + 1) % 256
        body = bytes(head) + kind.to_bytes(3, "little") + payload
        return bytes((_MAGIC_2,)) + body + checksum(body + bytes((EXTRA[kind],))).to_bytes(2, "little")

    def heartbeat(self, vehicle: int = TYPE_LOG) -> bytes:
        """Return a heartbeat: of a logger, whose silence later lets no autopilot think that its pilot is gone."""
        return self.frame(HEARTBEAT, struct.pack("<IBBBBB", 0, vehicle, NO_AUTOPILOT, 0, _ACTIVE, _VERSION))

    def command(self, target: tuple[int, int], command: int, *parameters: float) -> bytes:
        """Return a command to a system and its component; the parameters behind those that are given are 0."""
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        return self.frame(COMMAND_LONG, struct.pack("<7fHBBB", *seven, command, *target, 0))


@dataclass(frozen=True)
class FrameHead:
    """What is read of a frame."""

    kind: int
    system: int
    component: int
    payload: bytes


def head(frame: bytes) -> FrameHead:
    """Return who sent a whole frame, of which kind it is, and its payload."""
    size = frame[1]
    if frame[0] == _MAGIC_1:
        return FrameHead(frame[5], frame[3], frame[4], frame[6 : 6 + size])
    return FrameHead(int.from_bytes(frame[7:10], "little"), frame[5], frame[6], frame[10 : 10 + size])
