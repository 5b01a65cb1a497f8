"""Upload and download of missions over MAVLink (https://mavlink.io/en/services/mission.html).

The receiver requests each item, and repeats the request if the item does not arrive: the autopilot for an upload, the
ground station for a download.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from sim_backends.emulated.autopilot.mavlink import Message, dialect
from sim_backends.emulated.autopilot.plan import MAX_ITEMS, Item, item_of

RETRY_NS: Final = 250_000_000
"""Time to wait for an item before the request is repeated."""
TRIES: Final = 20
"""Maximum number of requests for an item. The protocol's 5 suit links with little loss; a weak radio loses half."""

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
        check: Returns the fault of an item, as MAV_MISSION_RESULT.
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
        self._ended: tuple[tuple[int, int], int, int] | None = None  # client, last item, result

    def handle(self, message: Message, now_ns: int) -> Iterator[Message]:
        """Yield the answers to a message of the protocol; empty for other messages."""
        client = (message.get_srcSystem(), message.get_srcComponent())
        kind = message.get_type()
        if getattr(message, "mission_type", _MISSION) != _MISSION:
            yield from self._other_plan(message, kind, client)
        elif kind == "MISSION_COUNT":
            yield self._begin(message.count, client, now_ns)
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
        """Yield the repeated request for an item that is overdue, if there is one."""
        upload = self._upload
        if upload is None or now_ns - upload.requested_ns < RETRY_NS:
            return
        if upload.tries == TRIES:
            self._upload = None
            yield _ack(upload.client, dialect.MAV_MISSION_OPERATION_CANCELLED)
            return
        upload.tries, upload.requested_ns = upload.tries + 1, now_ns
        yield _request(upload)

    def _begin(self, count: int, client: tuple[int, int], now_ns: int) -> Message:
        if self._upload is not None and self._upload.client != client:
            return _ack(client, dialect.MAV_MISSION_DENIED)
        self._ended = None
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
        upload = self._upload
        if upload is None or upload.client != client:
            if self._ended is not None and self._ended[:2] == (client, message.seq):  # the answer was lost
                yield _ack(client, self._ended[2])
            return
        if message.seq != len(upload.items):
            return  # late, or a duplicate
        item = item_of(message)
        fault = self._check(item)
        if fault != dialect.MAV_MISSION_ACCEPTED:
            self._upload, self._ended = None, (client, message.seq, fault)
            yield _ack(client, fault)
            return
        upload.items.append(item)
        upload.requested_ns, upload.tries = now_ns, 1
        if len(upload.items) < upload.count:
            yield _request(upload)
            return
        self._upload, self._ended = None, (client, message.seq, dialect.MAV_MISSION_ACCEPTED)
        self._load(tuple(upload.items))
        yield _ack(client, dialect.MAV_MISSION_ACCEPTED)

    def _item(self, number: int, client: tuple[int, int]) -> Message:
        items = self._items()
        if number >= len(items):
            return _ack(client, dialect.MAV_MISSION_INVALID_SEQUENCE)
        item = items[number]
        return dialect.MAVLink_mission_item_int_message(
            *(*client, number, item.frame, item.command, 0, item.autocontinue),
            *(*item.parameters, item.x, item.y, item.z),
        )

    def _other_plan(self, message: Message, kind: str, client: tuple[int, int]) -> Iterator[Message]:
        """Yield the answers about fences and rally points, which the vehicle does not have."""
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
