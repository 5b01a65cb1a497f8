"""MAVLink microservices of the emulated autopilot: parameters, time, ping, logs, files, message intervals, missions.

Sources: https://mavlink.io/en/services/, https://mavlink.io/en/services/mission.html. The receiver of a mission
requests each item, and repeats the request if the item does not arrive: the autopilot for an upload, the ground
station for a download.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.mavlink_frames import Message, dialect
from sim_backends.emulated.autopilot.mission_plan import MAX_ITEMS, Item, item_of
from sim_backends.emulated.autopilot.parameters import NAME_BYTES, Parameters

_NO_NUMBER: Final = -1
"""Value of `param_index` if a client names the parameter instead of giving its number."""
_INT, _FLOAT = dialect.MAV_PARAM_TYPE_INT32, dialect.MAV_PARAM_TYPE_REAL32
_WARNING: Final = dialect.MAV_SEVERITY_WARNING

_FTP_HEADER: Final = struct.Struct("<HBBBBBxI")
_FTP_BYTES: Final = 251
"""Length of the payload of FILE_TRANSFER_PROTOCOL."""
_ACK, _NAK = 128, 129
_OPEN_OPCODES: Final = frozenset({4, 11, 14})
"""Opcodes that open a file or compute its checksum: OpenFileRO, OpenFileWO, CalcFileCRC32."""
_CLOSE_OPCODES: Final = frozenset({1, 2})
"""Opcodes that end sessions: TerminateSession, ResetSessions."""
_LIST_DIRECTORY: Final = 3
_END_OF_FILE, _UNKNOWN_COMMAND, _NOT_FOUND = 6, 7, 10


class ParameterService:
    """Lists, reads and sets parameters (https://mavlink.io/en/services/parameter.html).

    PX4 encodes integers bytewise and reports an unknown name in a text message. ArduPilot encodes integers with a C
    cast, ignores the type in the client's message, and does not answer for an unknown name.

    Args:
        firmware: Family of the autopilot, PX4 or ArduCopter.
        parameters: Its parameters.
        on_change: Called with the name of a parameter that was set.
        report: Called with the severity and the text of a STATUSTEXT message.
    """

    def __init__(
        self,
        firmware: Firmware,
        parameters: Parameters,
        on_change: Callable[[str], None],
        report: Callable[[int, str], None],
    ) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self._on_change = on_change
        self._report = report

    def handle(self, message: Message) -> Iterator[Message]:
        """Yield the answers to PARAM_REQUEST_LIST, PARAM_REQUEST_READ or PARAM_SET."""
        names, kind = self._parameters.names, message.get_type()
        if kind == "PARAM_REQUEST_LIST":
            yield from (self.value(name) for name in names)
        elif kind in {"PARAM_REQUEST_READ", "PARAM_SET"}:
            name = decoded_name(message.param_id)
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
        """Set a parameter to the value in a PARAM_SET message, unless its value or, with PX4, its type is wrong."""
        value = message.param_value
        if not self._firmware.is_ardupilot:
            expected_type = _INT if self._parameters.is_integer(name) else _FLOAT
            if message.param_type != expected_type:
                self._report(dialect.MAV_SEVERITY_INFO, f"[pm] param types mismatch param: {name}")
                return
            if expected_type == _INT:
                (value,) = struct.unpack("<i", struct.pack("<f", value))
        if self._parameters.set(name, value):
            self._on_change(name)

    def value(self, name: str) -> Message:
        """Return PARAM_VALUE of a parameter."""
        parameters = self._parameters
        value, is_integer = parameters.firmware_value(name), parameters.is_integer(name)
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
    if opcode in _CLOSE_OPCODES:
        result, data = _ACK, b""
    elif opcode in _OPEN_OPCODES:
        data = bytes([_NOT_FOUND])
    elif opcode == _LIST_DIRECTORY:
        data = bytes([_END_OF_FILE])
    header = _FTP_HEADER.pack((number + 1) % 65_536, session, result, len(data), opcode, 0, offset)
    payload = list((header + data).ljust(_FTP_BYTES, b"\0"))
    return dialect.MAVLink_file_transfer_protocol_message(
        0, message.get_srcSystem(), message.get_srcComponent(), payload
    )


def decoded_name(name: str | bytes) -> str:
    """Return a name in a message: it ends at the first zero byte, and bytes that are not printable become "?"."""
    raw = name if isinstance(name, bytes) else name.encode("utf-8", "replace")
    return "".join(
        letter if letter.isprintable() else "?" for letter in raw.split(b"\0")[0].decode("ascii", "replace")
    )


MIN_INTERVAL_NS: Final = 20_000_000
"""Minimum interval of a message."""
HEARTBEAT_US: Final = 1_000_000
"""Default interval of the heartbeat."""


class Streams:
    """The messages that a port sends, each at its rate.

    Args:
        default_hz: Default rates by message id; 0 for all others.
        now_ns: Time of the first messages.
    """

    def __init__(self, default_hz: Mapping[int, float], now_ns: int) -> None:
        self._default_hz = {dialect.MAVLINK_MSG_ID_HEARTBEAT: 1e6 / HEARTBEAT_US, **default_hz}
        self._interval_ns = {kind: round(1e9 / rate_hz) for kind, rate_hz in self._default_hz.items() if rate_hz}
        self._due_ns = dict.fromkeys(self._interval_ns, now_ns)

    def due(self, now_ns: int) -> Iterator[int]:
        """Yield the ids of the messages that are due; missed messages are not sent later."""
        for kind, due_ns in self._due_ns.items():
            if due_ns <= now_ns:
                interval_ns = self._interval_ns[kind]
                # The first time after `now_ns` that is a whole number of intervals after `due_ns`.
                self._due_ns[kind] = now_ns + interval_ns - (now_ns - due_ns) % interval_ns
                yield kind

    @property
    def next_ns(self) -> int:
        """Time of the next message; the heartbeat is always sent."""
        return min(self._due_ns.values())

    def set_interval(self, kind: int, interval_us: float, now_ns: int) -> None:
        """Set the interval of a message (MAV_CMD_SET_MESSAGE_INTERVAL).

        0 means the default rate; -1, or 0 without a default rate, disables the message. The heartbeat is not
        disabled, but gets its default interval. The shortest interval is `MIN_INTERVAL_NS`.
        """
        if interval_us == 0 and self._default_hz.get(kind):
            interval_us = 1e6 / self._default_hz[kind]
        self._due_ns.pop(kind, None)
        self._interval_ns.pop(kind, None)
        if interval_us > 0:
            self._interval_ns[kind] = max(round(interval_us * 1e3), MIN_INTERVAL_NS)
            self._due_ns[kind] = now_ns
        elif kind == dialect.MAVLINK_MSG_ID_HEARTBEAT:
            self.set_interval(kind, HEARTBEAT_US, now_ns)  # clients detect a vehicle only by its heartbeat

    def interval_us(self, kind: int) -> int:
        """Return the interval of a message, or -1 if it is disabled."""
        return self._interval_ns.get(kind, -1000) // 1000

    def set_default(self, kind: int, rate_hz: float, now_ns: int) -> None:
        """Set the default rate of a message, and its current rate (see `set_interval`); 0 disables it."""
        self._default_hz[kind] = rate_hz
        self.set_interval(kind, 1e6 / rate_hz if rate_hz else -1, now_ns)


RETRY_NS: Final = 250_000_000
"""Time to wait for an item before the request is repeated."""
TRIES: Final = 20
"""Maximum number of requests for an item. The protocol recommends 5; a weak radio loses half of the messages."""

_MISSION: Final = dialect.MAV_MISSION_TYPE_MISSION


@dataclass
class _Upload:
    """Upload in progress from one client, `(system, component)`."""

    client: tuple[int, int]
    count: int
    requested_ns: int
    items: list[Item] = field(default_factory=list)
    tries: int = 1


class MissionTransfer:
    """The vehicle's side of the mission protocol.

    Args:
        items: Returns the vehicle's mission.
        check: Returns the MAV_MISSION_RESULT for an item: accepted, or the reason why the item is invalid.
        load: Loads a new mission.
    """

    def __init__(
        self,
        items: Callable[[], tuple[Item, ...]],
        check: Callable[[Item], int],
        load: Callable[[tuple[Item, ...]], None],
    ) -> None:
        self._items = items
        self._check = check
        self._load = load
        self._upload: _Upload | None = None
        self._last_upload: tuple[tuple[int, int], int, int] | None = None  # client, last item, result

    def handle(self, message: Message, now_ns: int) -> Iterator[Message]:
        """Yield the answers to a message of the protocol; empty for other messages."""
        client = (message.get_srcSystem(), message.get_srcComponent())
        kind = message.get_type()
        if getattr(message, "mission_type", _MISSION) != _MISSION:
            yield from self._other_plan(message, kind, client)
        elif kind == "MISSION_COUNT":
            yield self._start_upload(message.count, client, now_ns)
        elif kind == "MISSION_ITEM_INT":
            yield from self._accept_item(message, client, now_ns)
        elif kind == "MISSION_REQUEST_LIST":
            yield dialect.MAVLink_mission_count_message(*client, len(self._items()))
        elif kind in {"MISSION_REQUEST_INT", "MISSION_REQUEST"}:
            yield self._item(message.seq, client)
        elif kind == "MISSION_CLEAR_ALL":
            self._upload = None
            self._load(())
            yield _ack(client, dialect.MAV_MISSION_ACCEPTED)
        elif kind == "MISSION_ACK" and self._upload and self._upload.client == client:
            self._upload = None  # cancelled by the client

    def retries(self, now_ns: int) -> Iterator[Message]:
        """Yield the repeated request for an overdue item, if any; after `TRIES` requests, the end of the upload."""
        upload = self._upload
        if upload is None or now_ns - upload.requested_ns < RETRY_NS:
            return
        if upload.tries == TRIES:
            self._upload = None
            yield _ack(upload.client, dialect.MAV_MISSION_OPERATION_CANCELLED)
            return
        upload.tries, upload.requested_ns = upload.tries + 1, now_ns
        yield _request(upload)

    def _start_upload(self, count: int, client: tuple[int, int], now_ns: int) -> Message:
        """Return the answer to MISSION_COUNT: the request for the first item, or a result."""
        if self._upload is not None and self._upload.client != client:
            return _ack(client, dialect.MAV_MISSION_DENIED)
        self._last_upload = None
        if count > MAX_ITEMS:
            return _ack(client, dialect.MAV_MISSION_NO_SPACE)
        if count == 0:
            self._upload = None
            self._load(())
            return _ack(client, dialect.MAV_MISSION_ACCEPTED)
        if self._upload is None or self._upload.count != count or self._upload.items:
            self._upload = _Upload(client, count, now_ns)
        return _request(self._upload)

    def _accept_item(self, message: Message, client: tuple[int, int], now_ns: int) -> Iterator[Message]:
        """Yield the answer to an item of an upload: the request for the next item, or the result."""
        upload = self._upload
        if upload is None or upload.client != client:
            if self._last_upload is not None and self._last_upload[:2] == (client, message.seq):
                # The client repeats the last item, because the answer was lost.
                yield _ack(client, self._last_upload[2])
            return
        if message.seq != len(upload.items):
            return  # The item is late, or a duplicate.
        item = item_of(message)
        fault = self._check(item)
        if fault != dialect.MAV_MISSION_ACCEPTED:
            self._upload, self._last_upload = None, (client, message.seq, fault)
            yield _ack(client, fault)
            return
        upload.items.append(item)
        upload.requested_ns, upload.tries = now_ns, 1
        if len(upload.items) < upload.count:
            yield _request(upload)
            return
        self._upload, self._last_upload = None, (client, message.seq, dialect.MAV_MISSION_ACCEPTED)
        self._load(tuple(upload.items))
        yield _ack(client, dialect.MAV_MISSION_ACCEPTED)

    def _item(self, number: int, client: tuple[int, int]) -> Message:
        """Return an item of the mission, for a download."""
        items = self._items()
        if number >= len(items):
            return _ack(client, dialect.MAV_MISSION_INVALID_SEQUENCE)
        item = items[number]
        return dialect.MAVLink_mission_item_int_message(
            *(*client, number, item.frame, item.command, 0, item.autocontinue),
            *(*item.parameters, item.x, item.y, item.z),
        )

    def _other_plan(self, message: Message, kind: str, client: tuple[int, int]) -> Iterator[Message]:
        """Yield the answers to messages about fences and rally points, which the vehicle does not have."""
        if kind == "MISSION_REQUEST_LIST":
            yield dialect.MAVLink_mission_count_message(*client, 0, message.mission_type)
        elif kind in {"MISSION_COUNT", "MISSION_CLEAR_ALL"}:
            empty = kind == "MISSION_CLEAR_ALL" or message.count == 0
            result = dialect.MAV_MISSION_ACCEPTED if empty else dialect.MAV_MISSION_UNSUPPORTED
            yield dialect.MAVLink_mission_ack_message(*client, result, message.mission_type)


def _request(upload: _Upload) -> Message:
    return dialect.MAVLink_mission_request_int_message(*upload.client, len(upload.items))


def _ack(client: tuple[int, int], result: int) -> Message:
    return dialect.MAVLink_mission_ack_message(*client, result)
