"""The autopilot: what it answers to each message, and what it sends of itself. It knows no socket and no clock."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sim_backends.emulated.autopilot import mavlink
from sim_backends.emulated.autopilot.commands import Commands, int_in
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.mavlink import AUTOPILOT_COMPONENT, Message, dialect
from sim_backends.emulated.autopilot.parameters import NAME_BYTES, FlightLimits, Parameters
from sim_backends.emulated.autopilot.plan import Item, fault, goal_m
from sim_backends.emulated.autopilot.streams import Streams
from sim_backends.emulated.autopilot.telemetry import Telemetry
from sim_backends.emulated.autopilot.transfer import MissionTransfer
from sim_backends.emulated.autopilot.vehicle import Vehicle
from sim_backends.physics.collisions import Footprint
from sim_backends.physics.quadrotor import QuadrotorLimits

MOST_CLIENTS: Final = 16
SILENT_NS: Final = 15_000_000_000
"""A client that says nothing for as long hears nothing more."""

_ALL: Final = 0
_NO_NUMBER: Final = -1
_POSITION_IGNORED: Final = 0b111
_VELOCITY_IGNORED: Final = 0b111000
_LAST_MESSAGE_ID: Final = 0xFFFFFF

Address = tuple[str, int]
"""A client's, with its UDP port."""
Frame = tuple[Address, bytes]
"""For whom, and what."""


@dataclass
class _Client:
    """Who talks with the autopilot, from one address."""

    writer: mavlink.Writer
    streams: Streams
    heard_ns: int


class Autopilot:
    """An autopilot and its vehicle.

    Args:
        firmware: Of which family it is.
        system: Its MAVLink id.
        limits: What the robot's profile lets it do.
        can: What its body can do.
        around: What is in its way in the world, the floor too.
        now_ns: When it is switched on.
    """

    def __init__(
        self,
        *,
        firmware: Firmware,
        system: int,
        limits: FlightLimits,
        can: QuadrotorLimits,
        around: Sequence[Footprint],
        now_ns: int,
    ) -> None:
        self._system = system
        self._parameters = Parameters(firmware.parameters(limits))
        self.vehicle = Vehicle(firmware, self._parameters, can, around, now_ns)
        self._telemetry = Telemetry(self.vehicle, system, now_ns)
        self._commands = Commands(self.vehicle, self._parameters)
        self._transfer = MissionTransfer(lambda: self.vehicle.mission.items, self._fault, self.vehicle.load)
        self._clients: dict[Address, _Client] = {}

    def receive(self, datagram: bytes, sender: Address, now_ns: int) -> Iterator[Frame]:
        """Yield the answers to a datagram, whatever is in it; take them all.

        Args:
            datagram: What came.
            sender: The address that it came from.
            now_ns: When.
        """
        for message in mavlink.read(datagram):
            client = self._client(sender, now_ns)
            if client is not None and self._is_for_us(message):
                for answer in self._answers(message, client, now_ns):
                    yield sender, client.writer.frame(answer)

    def advance(self, now_ns: int) -> Iterator[Frame]:
        """Fly until this moment and yield what is due; take it all."""
        self.vehicle.advance(now_ns)
        self.vehicle.battery.advance(now_ns, driven=self.vehicle.armed)
        self._clients = {at: one for at, one in self._clients.items() if now_ns - one.heard_ns < SILENT_NS}
        news = [*self._news(now_ns), *self._transfer.remind(now_ns)]
        for address, client in self._clients.items():
            for message in (*news, *(self._telemetry.makers[kind]() for kind in client.streams.due(now_ns))):
                yield address, client.writer.frame(message)

    def next_ns(self) -> int | None:
        """Return when `advance` has something to send next, None while nobody listens."""
        return min((one.streams.next_ns for one in self._clients.values()), default=None)

    def _client(self, sender: Address, now_ns: int) -> _Client | None:
        """Return who this is, None for one too many."""
        client = self._clients.get(sender)
        if client is None:
            if len(self._clients) == MOST_CLIENTS:
                return None
            client = self._clients[sender] = _Client(mavlink.Writer(self._system), Streams(now_ns), now_ns)
        client.heard_ns = now_ns
        return client

    def _is_for_us(self, message: Message) -> bool:
        system, component = mavlink.addressee(message)
        return system in {_ALL, self._system} and component in {_ALL, AUTOPILOT_COMPONENT}

    def _fault(self, item: Item) -> int:
        return fault(item, self.vehicle.home_m, self.vehicle.fence_m)

    def _news(self, now_ns: int) -> Iterator[Message]:
        """Yield, for everybody, what the vehicle has to say since the last time."""
        mission, remarks = self.vehicle.mission, self.vehicle.remarks
        yield from (dialect.MAVLink_mission_item_reached_message(number) for number in mission.reached(now_ns))
        for remark in remarks:
            yield dialect.MAVLink_statustext_message(dialect.MAV_SEVERITY_WARNING, remark.encode("ascii"))
        self.vehicle.remarks = []

    def _answers(self, message: Message, client: _Client, now_ns: int) -> Iterator[Message]:
        kind = message.get_type()
        if kind in {"COMMAND_LONG", "COMMAND_INT"}:
            yield from self._command(message, client, now_ns)
        elif kind.startswith("MISSION_"):
            if kind == "MISSION_SET_CURRENT" and message.seq < len(self.vehicle.mission.items):
                self.vehicle.mission.go_on_at(message.seq)
                yield self._telemetry.mission_current()
            yield from self._transfer.handle(message, now_ns)
        elif kind.startswith("PARAM_"):
            yield from self._parameter(message, kind)
        elif kind == "REQUEST_DATA_STREAM":
            rate_hz = message.req_message_rate if message.start_stop else 0
            client.streams.request(message.req_stream_id, rate_hz, now_ns)
        elif kind == "SET_MODE":
            self._commands.set_mode(message.custom_mode)
        elif kind in {"SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"}:
            self._set_point(message)
        elif kind == "TIMESYNC" and message.tc1 == 0:
            yield dialect.MAVLink_timesync_message(now_ns, message.ts1)

    def _command(self, message: Message, client: _Client, now_ns: int) -> Iterator[Message]:
        """Yield the answer to a command: its COMMAND_ACK, and the message that it asked for."""
        asked = message.param1
        told: Message | None = None
        if message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            told = self._told(asked)
        elif message.command == dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            told = self._told(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        elif message.command == dialect.MAV_CMD_GET_HOME_POSITION:
            told = self._told(dialect.MAVLINK_MSG_ID_HOME_POSITION)
        elif message.command == dialect.MAV_CMD_GET_MESSAGE_INTERVAL and int_in(asked, _LAST_MESSAGE_ID):
            told = dialect.MAVLink_message_interval_message(int(asked), client.streams.interval_us(int(asked)))
        if told is not None:
            result = int(dialect.MAV_RESULT_ACCEPTED)
        elif message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(asked, message.param2, client, now_ns)
        elif message.command in _QUESTIONS:
            result = int(dialect.MAV_RESULT_DENIED)
        else:
            result = self._commands.run(message)
        asker = message.get_srcSystem(), message.get_srcComponent()
        yield dialect.MAVLink_command_ack_message(message.command, result, 0xFF, 0, *asker)
        if told is not None:
            yield told

    def _told(self, kind: float) -> Message | None:
        """Return the message of an id, None for one that it does not make."""
        make = self._telemetry.makers.get(int(kind)) if int_in(kind, _LAST_MESSAGE_ID) else None
        return make() if make else None

    def _set_interval(self, kind: float, interval_us: float, client: _Client, now_ns: int) -> int:
        known = int_in(kind, _LAST_MESSAGE_ID) and int(kind) in self._telemetry.makers
        if not known or not math.isfinite(interval_us):
            return int(dialect.MAV_RESULT_DENIED)
        client.streams.set_interval(int(kind), interval_us, now_ns)
        return int(dialect.MAV_RESULT_ACCEPTED)

    def _parameter(self, message: Message, kind: str) -> Iterator[Message]:
        """Yield parameters that are asked for or set; one that could not be set as it stands."""
        names = self._parameters.names
        if kind == "PARAM_REQUEST_LIST":
            yield from (self._value(name, number) for number, name in enumerate(names))
        elif kind in {"PARAM_REQUEST_READ", "PARAM_SET"}:
            name = _text(message.param_id)
            number = getattr(message, "param_index", _NO_NUMBER)
            if number != _NO_NUMBER:
                name = names[number] if 0 <= number < len(names) else ""
            if name in names:
                if kind == "PARAM_SET" and message.param_type == dialect.MAV_PARAM_TYPE_REAL32:
                    self._parameters.set(name, message.param_value)
                yield self._value(name, names.index(name))

    def _value(self, name: str, number: int) -> Message:
        return dialect.MAVLink_param_value_message(
            name.encode("ascii").ljust(NAME_BYTES, b"\0"),
            self._parameters.told(name),
            dialect.MAV_PARAM_TYPE_REAL32,
            len(self._parameters.names),
            number,
        )

    def _set_point(self, message: Message) -> None:
        """Take a place or a velocity; with a velocity, the place beside it is left out of account."""
        if message.get_type() == "SET_POSITION_TARGET_GLOBAL_INT":
            args = message.coordinate_frame, message.lat_int, message.lon_int, message.alt
            place = goal_m(*args, self.vehicle.home_m)
        elif message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED:
            place = (message.y, message.x, -message.z)
        else:
            return
        velocity = (message.vy, message.vx, -message.vz)
        if not message.type_mask & _VELOCITY_IGNORED:
            if all(map(math.isfinite, velocity)):
                self.vehicle.wish(velocity, place=False)
        elif not message.type_mask & _POSITION_IGNORED and place and all(map(math.isfinite, place)):
            self.vehicle.wish(place, place=True)


_QUESTIONS: Final = frozenset(
    {
        dialect.MAV_CMD_REQUEST_MESSAGE,
        dialect.MAV_CMD_GET_MESSAGE_INTERVAL,
    }
)


def _text(name: str | bytes) -> str:
    """Return a name as it is in a message: with bytes of any kind, zeros behind it."""
    raw = name if isinstance(name, bytes) else name.encode("utf-8", "replace")
    return raw.split(b"\0")[0].decode("ascii", "replace")
