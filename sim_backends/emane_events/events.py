"""Encoding of EMANE's events: `event.proto`, `locationevent.proto` and `pathlossevent.proto` of EMANE 1.5.

A datagram of the event channel is a big-endian u16 with the size of the message `Event`, and the message. The message
has the identifier and the sequence number of its publisher, and one or more serialized events. Each is for one NEM
(network emulation module, a radio in EMANE) or for all NEMs.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.emane_events.protobuf import (
    MalformedEventError,
    Value,
    as_bytes,
    as_integer,
    as_real,
    bytes_field,
    double_field,
    fields,
    fields_by_number,
    float_field,
    integer_field,
)

LOCATION, PATHLOSS = 100, 101
"""Identifiers of events (EMANE, `include/emane/events/eventids.h`)."""
ALL_NEMS: Final = 0
MAX_NEM: Final = 65534
"""Identifier that means all NEMs, and the largest identifier of a NEM."""
_SIZE: Final = struct.Struct("!H")
_UUID_BYTES: Final = 16


@dataclass(frozen=True)
class EmaneVelocity:
    """Velocity of a NEM.

    Attributes:
        azimuth_deg: Clockwise from north.
        elevation_deg: Above the horizon.
        speed_m_s: Magnitude.
    """

    azimuth_deg: float
    elevation_deg: float
    speed_m_s: float


@dataclass(frozen=True)
class NemLocation:
    """Location of a NEM.

    Attributes:
        nem: Its identifier.
        latitude_deg: Latitude, WGS 84.
        longitude_deg: Longitude.
        altitude_m: Height above the ellipsoid.
        velocity: Its velocity; None if the event has none.
    """

    nem: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    velocity: EmaneVelocity | None = None


@dataclass(frozen=True)
class NemPathloss:
    """Path loss between the NEM that receives the event and another one.

    Attributes:
        nem: The other NEM.
        forward_db: Loss from it to the NEM that receives the event.
        reverse_db: Loss in the other direction.
    """

    nem: int
    forward_db: float
    reverse_db: float


@dataclass(frozen=True)
class SerializedEvent:
    """An event within a datagram.

    Attributes:
        nem: NEM that receives the event, or `ALL_NEMS`.
        event: Identifier of the kind of event: `LOCATION`, `PATHLOSS` or another one.
        content: The event as an encoded message, for example `LocationEvent`.
    """

    nem: int
    event: int
    content: bytes


@dataclass(frozen=True)
class EventDatagram:
    """A datagram of the event channel.

    Attributes:
        publisher: Identifier of its publisher, a UUID of 16 bytes.
        number: Its sequence number.
        events: Its events.
    """

    publisher: bytes
    number: int
    events: Sequence[SerializedEvent]

    def encode(self) -> bytes:
        """Return the encoded bytes.

        Raises:
            ValueError: The datagram is too large, or a number is invalid.
        """
        serializations = b"".join(
            bytes_field(
                1, integer_field(1, event.nem) + integer_field(2, event.event) + bytes_field(3, event.content)
            )
            for event in self.events
        )
        message = bytes_field(1, self.publisher) + integer_field(2, self.number) + bytes_field(3, serializations)
        if len(message) >= 1 << 16:
            raise ValueError(f"an event of {len(message)} bytes is too large for a datagram")
        return _SIZE.pack(len(message)) + message

    @staticmethod
    def decode(datagram: bytes) -> "EventDatagram":
        """Return the datagram that is encoded in these bytes.

        Raises:
            MalformedEventError: The bytes are not a datagram.
        """
        if len(datagram) < _SIZE.size or _SIZE.unpack_from(datagram)[0] != len(datagram) - _SIZE.size:
            raise MalformedEventError("the size of the datagram differs from the size in its header")
        values = fields_by_number(datagram[_SIZE.size :], (1, 2, 3))
        publisher = as_bytes(values[1])
        if len(publisher) != _UUID_BYTES:
            raise MalformedEventError(f"the publisher's identifier has {len(publisher)} bytes")
        events = [_decode_event(content) for field, content in fields(as_bytes(values[3])) if field == 1]
        return EventDatagram(publisher, as_integer(values[2]), events)


def _decode_event(content: Value) -> SerializedEvent:
    values = fields_by_number(as_bytes(content), (1, 2, 3))
    return SerializedEvent(as_integer(values[1], 1 << 32), as_integer(values[2], 1 << 32), as_bytes(values[3]))


def encode_locations(locations: Sequence[NemLocation]) -> bytes:
    """Return the message `LocationEvent`."""
    return b"".join(bytes_field(1, _location_bytes(location)) for location in locations)


def _location_bytes(location: NemLocation) -> bytes:
    position = (
        double_field(1, location.latitude_deg)
        + double_field(2, location.longitude_deg)
        + double_field(3, location.altitude_m)
    )
    content = integer_field(1, location.nem) + bytes_field(2, position)
    if (velocity := location.velocity) is None:
        return content
    return content + bytes_field(
        3,
        double_field(1, velocity.azimuth_deg)
        + double_field(2, velocity.elevation_deg)
        + double_field(3, velocity.speed_m_s),
    )


def decode_locations(content: bytes) -> list[NemLocation]:
    """Return the locations of a message `LocationEvent`; orientations are ignored.

    Raises:
        MalformedEventError: The bytes are not a `LocationEvent`, or a number is not finite.
    """
    return [_decode_location(as_bytes(value)) for field, value in fields(content) if field == 1]


def _decode_location(content: bytes) -> NemLocation:
    values = fields_by_number(content, (1, 2))
    position = _three_numbers(as_bytes(values[2]))
    velocity = EmaneVelocity(*_three_numbers(as_bytes(values[3]))) if 3 in values else None
    return NemLocation(as_integer(values[1], 1 << 32), *position, velocity)


def _three_numbers(content: bytes) -> tuple[float, float, float]:
    """Return the three numbers in a message, which must be finite."""
    values = fields_by_number(content, (1, 2, 3))
    first, second, third = (as_real(values[field]) for field in (1, 2, 3))
    if not math.isfinite(first + second + third):
        raise MalformedEventError("a number is not finite")
    return first, second, third


def encode_pathlosses(losses: Sequence[NemPathloss]) -> bytes:
    """Return the message `PathlossEvent`."""
    return b"".join(
        bytes_field(1, integer_field(1, loss.nem) + float_field(2, loss.forward_db) + float_field(3, loss.reverse_db))
        for loss in losses
    )


def decode_pathlosses(content: bytes) -> list[NemPathloss]:
    """Return the losses of a message `PathlossEvent`.

    Raises:
        MalformedEventError: The bytes are not a `PathlossEvent`.
    """
    losses = []
    for field, value in fields(content):
        if field == 1:
            values = fields_by_number(as_bytes(value), (1, 2, 3))
            losses.append(NemPathloss(as_integer(values[1], 1 << 32), as_real(values[2]), as_real(values[3])))
    return losses
