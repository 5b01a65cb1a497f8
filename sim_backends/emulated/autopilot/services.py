"""Small services of the autopilot: parameters, time, ping, logs and file transfer (https://mavlink.io/en/services/)."""

import struct
from collections.abc import Callable, Iterator
from typing import Final

from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.mavlink import Message, dialect
from sim_backends.emulated.autopilot.parameters import NAME_BYTES, Parameters

_NO_NUMBER: Final = -1
_INT, _FLOAT = dialect.MAV_PARAM_TYPE_INT32, dialect.MAV_PARAM_TYPE_REAL32
_WARNING: Final = dialect.MAV_SEVERITY_WARNING

_FTP_HEADER: Final = struct.Struct("<HBBBBBxI")
_FTP_BYTES: Final = 251
_ACK, _NAK = 128, 129
_OPENS: Final = frozenset({4, 11, 14})
"""Opcodes that open a file or compute its checksum: OpenFileRO, OpenFileWO, CalcFileCRC32."""
_CLOSES: Final = frozenset({1, 2})
"""TerminateSession, ResetSessions."""
_LISTS: Final = 3
_END_OF_FILE, _UNKNOWN_COMMAND, _NOT_FOUND = 6, 7, 10


class ParameterService:
    """Lists, reads and sets parameters (https://mavlink.io/en/services/parameter.html).

    PX4 encodes integers bytewise and reports an unknown name by a text. ArduPilot encodes them by a C cast, ignores
    the type in the client's message, and does not answer for an unknown name.

    Args:
        firmware: Family of the autopilot.
        parameters: Its parameters.
        changed: Called with the name of a parameter that was set.
        report: Called with the severity and a text for people.
    """

    def __init__(
        self,
        firmware: Firmware,
        parameters: Parameters,
        changed: Callable[[str], None],
        report: Callable[[int, str], None],
    ) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self._changed = changed
        self._report = report

    def handle(self, message: Message) -> Iterator[Message]:
        """Yield the answers to PARAM_REQUEST_LIST, PARAM_REQUEST_READ or PARAM_SET."""
        names, kind = self._parameters.names, message.get_type()
        if kind == "PARAM_REQUEST_LIST":
            yield from (self.value(name) for name in names)
        elif kind in {"PARAM_REQUEST_READ", "PARAM_SET"}:
            name = text(message.param_id)
            number = getattr(message, "param_index", _NO_NUMBER)
            if number != _NO_NUMBER:
                name = names[number] if 0 <= number < len(names) else ""
            if name not in names:
                if not self._firmware.is_ardupilot and name:
                    self._report(dialect.MAV_SEVERITY_INFO, f"[pm] unknown param: {name}")
                return
            if kind == "PARAM_SET":
                self._set(name, message)
            yield self.value(name)

    def _set(self, name: str, message: Message) -> None:
        value = message.param_value
        if not self._firmware.is_ardupilot:
            expected = _INT if self._parameters.is_integer(name) else _FLOAT
            if message.param_type != expected:
                self._report(dialect.MAV_SEVERITY_INFO, f"[pm] param types mismatch param: {name}")
                return
            if expected == _INT:
                (value,) = struct.unpack("<i", struct.pack("<f", value))
        if self._parameters.set(name, value):
            self._changed(name)

    def value(self, name: str) -> Message:
        """Return PARAM_VALUE of a parameter."""
        parameters = self._parameters
        value, is_integer = parameters.listed(name), parameters.is_integer(name)
        if is_integer and not self._firmware.is_ardupilot:
            (value,) = struct.unpack("<f", struct.pack("<i", round(value)))
        return dialect.MAVLink_param_value_message(
            name.encode("ascii").ljust(NAME_BYTES, b"\0"),
            value,
            _INT if is_integer else _FLOAT,
            len(parameters.names),
            parameters.names.index(name),
        )


def answers(message: Message, now_ns: int) -> Iterator[Message]:
    """Yield the answers to TIMESYNC, PING, LOG_REQUEST_LIST and FILE_TRANSFER_PROTOCOL.

    There are no logs and no files: lists are empty, and files are not found.
    """
    kind = message.get_type()
    if kind == "TIMESYNC" and message.tc1 == 0:
        yield dialect.MAVLink_timesync_message(now_ns, message.ts1)
    elif kind == "PING" and message.target_system == message.target_component == 0:
        sender = message.get_srcSystem(), message.get_srcComponent()
        yield dialect.MAVLink_ping_message(message.time_usec, message.seq, *sender)
    elif kind == "LOG_REQUEST_LIST":
        yield dialect.MAVLink_log_entry_message(0, 0, 0, 0, 0)
    elif kind == "FILE_TRANSFER_PROTOCOL":
        yield _file_answer(message)


def _file_answer(message: Message) -> Message:
    """Return the answer to a request of the file transfer protocol (https://mavlink.io/en/services/ftp.html)."""
    request = bytes(message.payload)[:_FTP_BYTES]
    number, session, opcode, _, _, _, offset = _FTP_HEADER.unpack_from(request)
    result, data = _NAK, bytes([_UNKNOWN_COMMAND])
    if opcode in _CLOSES:
        result, data = _ACK, b""
    elif opcode in _OPENS:
        data = bytes([_NOT_FOUND])
    elif opcode == _LISTS:
        data = bytes([_END_OF_FILE])
    header = _FTP_HEADER.pack((number + 1) % 65_536, session, result, len(data), opcode, 0, offset)
    payload = list((header + data).ljust(_FTP_BYTES, b"\0"))
    return dialect.MAVLink_file_transfer_protocol_message(
        0, message.get_srcSystem(), message.get_srcComponent(), payload
    )


def text(name: str | bytes) -> str:
    """Return a name in a message: it ends at the first zero byte, and bytes that are not printable become "?"."""
    raw = name if isinstance(name, bytes) else name.encode("utf-8", "replace")
    return "".join(
        letter if letter.isprintable() else "?" for letter in raw.split(b"\0")[0].decode("ascii", "replace")
    )
