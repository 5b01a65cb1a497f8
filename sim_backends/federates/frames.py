"""Frames of the wire protocol: header, kinds of message, and a reader that checks every length before it reads.

The protocol is described in docs/federates.md; `MessageKind` has the layout of each message. Both sides
are untrusted: no length or count of a frame is used before it has been compared with the number of bytes that have
arrived.
"""

import struct
from enum import IntEnum
from typing import Any, Final, NamedTuple

VERSION: Final = 1
MAGIC: Final = b"FIELDKIT"
MAX_FRAME_BYTES: Final = 16 << 20
"""Largest size of a body."""
MAX_HELLO_BYTES: Final = 4 << 20
"""Largest size of the body of `hello`."""
MAX_JOIN_BYTES: Final = 2048
"""Largest size of the body of `join`."""
MAX_TEXT_BYTES: Final = 1000
"""Largest size of a text in a body."""
MAX_AGENTS: Final = 10_000
"""Largest number of agents in a run."""
PHYSICS, NETWORK = 1, 2
"""Numbers of the roles in `hello` and `welcome`."""
ROLES: Final = {PHYSICS: "physics", NETWORK: "network"}

_COUNT: Final = struct.Struct("<I")
_LENGTH: Final = struct.Struct("<H")
_HEADER: Final = struct.Struct("<IHHII")
HEADER_BYTES: Final = _HEADER.size
# Positions of the fields of a header, for errors.
_SIZE_POSITION, KIND_POSITION, _RESERVED_POSITION, REQUEST_POSITION, COPY_POSITION = 0, 4, 6, 8, 12


class MessageKind(IntEnum):
    """Kind of a message: its sender, and the layout of its body.

    Attributes:
        JOIN: federate: only on a connection that the federate opened: `magic` 8 bytes `FIELDKIT`, `version` u16,
            `token` text
        HELLO: coordinator: `magic` 8 bytes, `version` u16, `role` u8 (1 physics, 2 network), `reserved` u8,
            `heartbeat_ms` u32, `seed` u64, `step_ns` i64, `end_ns` i64, `configuration_hash` 32 bytes, `token` text,
            `name` text, `agents` u32, each an agent, `configuration` u32 bytes of JSON
        WELCOME: federate: `version` u16, `role` u8, `reserved` u8, `capabilities` u32, `step_ns` i64,
            `next_event_ns` i64, `configuration_hash` 32 bytes, `name` text, `software` text, `commands` u16, each a
            u16, `transports` u16, each a text, `transmitters` u32, each a u32 agent, `emitters` u32, each 3 f64
        ADVANCE_PHYSICS: coordinator: `to_ns` i64, `from_ns` i64, `commands` u32, each a command
        STATES: federate: `at_ns` i64, `new` u32, each u32 index and text name, `states` u32, each a state
        ADVANCE_NETWORK: coordinator: `to_ns` i64, `since_ns` i64, `reckoning_ns` i64, `new` u32 as in states,
            `states` u32, each a state, `packets` u32, each a packet
        OUTCOMES: federate: `at_ns` i64, `next_event_ns` i64, `arrivals` u32, each an arrival, `drops` u32, each a
            drop, and optionally the delay parts of each arrival
        PING: coordinator: `value` i64
        PONG: federate: `value` i64 of the ping
        BUSY: federate: `at_ns` i64, the time that it has reached
        FORK: coordinator: `copy` u32, the number of a new copy, which is made of the copy in the header
        DONE: federate: empty; answers fork
        RELEASE: coordinator: empty; the copy in the header is not used again; there is no answer
        ERROR: federate: `text`; answers any request; the session ends
        BYE: coordinator: empty; the run ends, and there is no answer
        SAMPLE_LINKS: coordinator: empty; only to a network with the capability *samples links*
        LINKS: federate: `radios` u32, each a radio sample, `links` u32, each a link sample
    """

    JOIN = 1
    HELLO = 2
    WELCOME = 3
    ADVANCE_PHYSICS = 4
    STATES = 5
    ADVANCE_NETWORK = 6
    OUTCOMES = 7
    PING = 8
    PONG = 9
    BUSY = 10
    FORK = 11
    DONE = 12
    RELEASE = 13
    ERROR = 14
    BYE = 15
    SAMPLE_LINKS = 16
    LINKS = 17


_KINDS: Final = {int(kind): kind for kind in MessageKind}


class MalformedFrameError(ValueError):
    """A frame does not follow the protocol.

    Args:
        position: Number of the wrong byte, from the beginning of the frame.
        description: Description of the error.
    """

    def __init__(self, position: int, description: str) -> None:
        super().__init__(f"byte {position}: {description}")
        self.position = position


class UnknownKindError(MalformedFrameError):
    """A frame has an unknown kind; the received bytes may be text that the program printed."""


class Header(NamedTuple):
    """The header of a frame.

    Attributes:
        size: Number of bytes after the header.
        kind: Kind of message.
        request: Number of the request.
        copy: Copy of the federate; 0 for the original.
    """

    size: int
    kind: MessageKind
    request: int
    copy: int


class ProtocolFrame(NamedTuple):
    """A received frame.

    Attributes:
        header: Its header.
        body: The bytes after it.
    """

    header: Header
    body: bytes


def encode(kind: MessageKind, request: int, copy: int, body: bytes = b"") -> bytes:
    """Return the bytes of a frame.

    Raises:
        ValueError: The body is too long.
    """
    if len(body) > MAX_FRAME_BYTES:
        raise ValueError(f"a frame of {len(body)} bytes is longer than {MAX_FRAME_BYTES}")
    return _HEADER.pack(len(body), kind, 0, request, copy) + body


def read_header(data: bytes | bytearray, max_bytes: int = MAX_FRAME_BYTES) -> Header:
    """Return the header of a frame.

    Args:
        data: The first bytes of the frame, at least `HEADER_BYTES`.
        max_bytes: Largest allowed size of the body.

    Raises:
        MalformedFrameError: The size, the kind or the reserved field is invalid.
    """
    size, kind, reserved, request, copy = _HEADER.unpack_from(data)
    message_kind = _KINDS.get(kind)
    if message_kind is None:
        raise UnknownKindError(KIND_POSITION, f"there is no kind of message {kind}")
    if size > max_bytes:
        raise MalformedFrameError(_SIZE_POSITION, f"a size of {size} bytes is above {max_bytes}")
    if reserved:
        raise MalformedFrameError(_RESERVED_POSITION, f"the reserved field is {reserved}, not 0")
    return Header(size, message_kind, request, copy)


class FrameReader:
    """Reads the body of a frame in order.

    Args:
        body: The body.
    """

    def __init__(self, body: bytes) -> None:
        self._body = body
        self._offset = 0

    @property
    def position(self) -> int:
        """Number of the next byte, from the beginning of the frame."""
        return HEADER_BYTES + self._offset

    @property
    def remaining_bytes(self) -> int:
        """Number of bytes that have not been read."""
        return len(self._body) - self._offset

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Return the next values of the body, which have this layout.

        Raises:
            MalformedFrameError: The frame ends too early.
        """
        offset, self._offset = self._offset, self._offset + layout.size
        if self._offset > len(self._body):
            self._fail_at_end()
        return layout.unpack_from(self._body, offset)

    def read_bytes(self, size: int) -> bytes:
        """Return the next bytes of the body.

        Raises:
            MalformedFrameError: The frame ends too early.
        """
        offset, self._offset = self._offset, self._offset + size
        if self._offset > len(self._body):
            self._fail_at_end()
        return self._body[offset : self._offset]

    def text(self) -> str:
        """Return the next text of the body.

        Raises:
            MalformedFrameError: The text is too long or not UTF-8, or the frame ends too early.
        """
        position = self.position
        (length,) = self.unpack(_LENGTH)
        if length > MAX_TEXT_BYTES:
            raise MalformedFrameError(position, f"a text of {length} bytes is longer than {MAX_TEXT_BYTES}")
        try:
            return self.read_bytes(length).decode()
        except UnicodeDecodeError as error:
            raise MalformedFrameError(position + 2 + error.start, "the text is not UTF-8") from None

    def count(self, item_bytes: int, layout: struct.Struct = _COUNT) -> int:
        """Return the next count of items.

        Args:
            item_bytes: Smallest size of an item.
            layout: Layout of the count.

        Raises:
            MalformedFrameError: The frame is too small for that many items.
        """
        position = self.position
        (count,) = self.unpack(layout)
        if count * item_bytes > len(self._body) - self._offset:
            raise MalformedFrameError(
                position, f"{count} items of at least {item_bytes} bytes do not fit in the rest of the frame"
            )
        return int(count)

    def short_count(self, item_bytes: int) -> int:
        """Return the next count of items, stored in two bytes. Arguments and errors are those of `count`."""
        return self.count(item_bytes, _LENGTH)

    def check_end(self) -> None:
        """Check that there are no more bytes.

        Raises:
            MalformedFrameError: There are more bytes.
        """
        if self._offset != len(self._body):
            raise MalformedFrameError(self.position, f"{len(self._body) - self._offset} bytes follow the message")

    def _fail_at_end(self) -> None:
        raise MalformedFrameError(HEADER_BYTES + len(self._body), "the frame ends too early")


def text_bytes(text: str) -> bytes:
    """Return a text with its length as bytes.

    Raises:
        ValueError: The text is too long.
    """
    encoded = text.encode(errors="replace")
    if len(encoded) > MAX_TEXT_BYTES:
        raise ValueError(f"a text of {len(encoded)} bytes is longer than {MAX_TEXT_BYTES}: {text[:40]}...")
    return _LENGTH.pack(len(encoded)) + encoded


def count_bytes(count: int) -> bytes:
    """Return a count as bytes."""
    return _COUNT.pack(count)


def short_count_bytes(count: int) -> bytes:
    """Return a count as two bytes."""
    return _LENGTH.pack(count)
