"""The emulated autopilot, which answers messages and sends periodic ones. The caller passes datagrams and times."""

import math
from collections.abc import Iterator, Sequence
from typing import Final

from sim_backends.emulated.autopilot import mavlink_frames, microservices
from sim_backends.emulated.autopilot.commands import Commands, is_integer_up_to
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.flight import MakeAirframe, SetPoint
from sim_backends.emulated.autopilot.mavlink_frames import (
    AUTOPILOT_COMPONENT,
    AVAILABLE_MODES,
    Address,
    Frame,
    MavlinkPort,
    Message,
    dialect,
)
from sim_backends.emulated.autopilot.microservices import MissionTransfer, ParameterService, Streams
from sim_backends.emulated.autopilot.mission_plan import Item, fault, goal_m
from sim_backends.emulated.autopilot.parameters import FlightLimits, Parameters
from sim_backends.emulated.autopilot.telemetry import Telemetry
from sim_backends.emulated.autopilot.vehicle import Vehicle
from sim_backends.physics.collisions import Footprint
from sim_backends.physics.robot_limits import QuadrotorLimits

_ALL: Final = 0
"""System or component id that addresses all systems or components."""
# Bits of the field `type_mask` of a set-point (POSITION_TARGET_TYPEMASK).
_POSITION_IGNORED: Final = 0b111
_VELOCITY_IGNORED: Final = 0b111000
_YAW_IGNORED: Final = 0b10000000000
_LAST_MESSAGE_ID: Final = 0xFFFFFF
_TEXT_BYTES: Final = 50
"""Length of the text of a STATUSTEXT message."""


class Autopilot:
    """An autopilot and its vehicle.

    Args:
        firmware: Behaviour of PX4 or of ArduCopter.
        system: MAVLink system id.
        limits: Limits of the robot's profile.
        airframe_limits: Limits of its airframe.
        obstacles: Obstacles in the world, including the floor.
        now_ns: Time of power-on.
        boot_s: Time from power-on until its position estimate has an origin.
        make_airframe: Creates the airframe; None for an airframe that the autopilot itself moves.

    Attributes:
        vehicle: The vehicle.
    """

    def __init__(
        self,
        *,
        firmware: Firmware,
        system: int,
        limits: FlightLimits,
        airframe_limits: QuadrotorLimits,
        obstacles: Sequence[Footprint],
        now_ns: int,
        boot_s: float = 0.0,
        make_airframe: MakeAirframe | None = None,
    ) -> None:
        self._firmware = firmware
        self._parameters = Parameters(firmware.parameters(limits))
        self._parameters.change("MAV_SYS_ID", system)
        self._system = system
        self.vehicle = Vehicle(
            firmware,
            self._parameters,
            airframe_limits,
            obstacles,
            now_ns,
            boot_s=boot_s,
            make_airframe=make_airframe,
        )
        self._telemetry = Telemetry(self.vehicle, self._parameters)
        self._commands = Commands(self.vehicle, self._parameters)
        self._transfer = MissionTransfer(lambda: self.vehicle.mission.items, self._fault, self.vehicle.load)
        self._parameter_service = ParameterService(
            firmware, self._parameters, self._apply_parameter, self.vehicle.report
        )
        self._port = MavlinkPort(system)
        self._now_ns = now_ns
        self._booted_ns = self.vehicle.estimate.booted_ns
        self._streams = self._default_streams()

    def receive(self, datagram: bytes, sender: Address, now_ns: int) -> Iterator[Frame]:
        """Yield the answers to a datagram, whose content may be invalid. The caller must consume all answers.

        Args:
            datagram: The datagram.
            sender: Its source address.
            now_ns: Time of reception.
        """
        self._now_ns = now_ns
        for message in mavlink_frames.read(datagram):
            if not self._port.register(sender, message, now_ns):
                continue
            if message.get_type() == "HEARTBEAT":
                self.vehicle.failsafes.on_heartbeat(message.get_srcSystem(), message.type, now_ns)
            elif self._is_addressed(message):
                yield from self._port.frames(self._replies(message, now_ns))

    def advance(self, now_ns: int) -> Iterator[Frame]:
        """Fly until this time and yield the frames that are due; the caller must consume all."""
        self._now_ns = now_ns
        self.vehicle.advance(now_ns)
        if self.vehicle.estimate.booted_ns != self._booted_ns:
            self._reboot()
        self._port.expire(now_ns)
        telemetry = (self._telemetry.builders[kind]() for kind in self._streams.due(now_ns))
        messages = (*self._reports(now_ns), *self._transfer.retries(now_ns), *telemetry)
        yield from self._port.frames(message for message in messages if message is not None)

    def next_ns(self) -> int | None:
        """Return the time of the next periodic frame that `advance` yields, or None if there are no clients."""
        return self._streams.next_ns if self._port.is_used else None

    def _reboot(self) -> None:
        """Start as after power-on: parameters are kept, and the system id and the rates are read from them."""
        self._booted_ns = self.vehicle.estimate.booted_ns
        self._system = round(self._parameters["MAV_SYS_ID"])
        self._port.set_system(self._system)
        self._streams = self._default_streams()

    def _default_streams(self) -> Streams:
        rates_hz = dict(self._firmware.streams_hz)
        for group in self._firmware.groups:
            rates_hz.update(dict.fromkeys(group.messages, self._parameters[group.parameter]))
        return Streams(rates_hz, self._now_ns)

    def _apply_parameter(self, name: str) -> None:
        """Apply a parameter that was set, if it is the rate of a group of messages."""
        for group in self._firmware.groups:
            if group.parameter == name:
                for kind in group.messages:
                    self._streams.set_default(kind, self._parameters[name], self._now_ns)

    def _is_addressed(self, message: Message) -> bool:
        system, component = mavlink_frames.target_of(message)
        return system in {_ALL, self._system} and component in {_ALL, AUTOPILOT_COMPONENT}

    def _fault(self, item: Item) -> int:
        return fault(item, self.vehicle.home_m, self.vehicle.fence.limits_m)

    def _reports(self, now_ns: int) -> Iterator[Message]:
        """Yield the vehicle's reports since the last call, for all clients."""
        mission, status_texts = self.vehicle.mission, self.vehicle.status_texts
        yield from (dialect.MAVLink_mission_item_reached_message(number) for number in mission.reached_items(now_ns))
        for severity, text in status_texts:
            yield dialect.MAVLink_statustext_message(severity, text.encode("ascii", "replace")[:_TEXT_BYTES])
        self.vehicle.status_texts.clear()

    def _replies(self, message: Message, now_ns: int) -> Iterator[Message]:
        """Yield the answers to a message that is addressed to the autopilot."""
        kind = message.get_type()
        if kind in {"COMMAND_LONG", "COMMAND_INT"}:
            yield from self._run_command(message, now_ns)
        elif kind.startswith("MISSION_"):
            if kind == "MISSION_SET_CURRENT" and message.seq < len(self.vehicle.mission.items):
                self.vehicle.mission.set_current(message.seq)
                yield self._telemetry.mission_current()
            yield from self._transfer.handle(message, now_ns)
        elif kind.startswith("PARAM_"):
            yield from self._parameter_service.handle(message)
        elif kind == "REQUEST_DATA_STREAM":
            self._request_streams(message)
        elif kind == "SET_MODE":
            self._commands.set_mode(message.custom_mode)
        elif kind in {"SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"}:
            self._accept_set_point(message)
        else:
            yield from microservices.answers(message, now_ns)

    def _request_streams(self, message: Message) -> None:
        """Set the rate parameters of the requested groups of messages; rate 0 stops them. PX4 has no groups."""
        rate_hz = min(message.req_message_rate, 50) if message.start_stop else 0
        for group in self._firmware.groups:
            if message.req_stream_id in {dialect.MAV_DATA_STREAM_ALL, group.number}:
                self._parameters.set(group.parameter, rate_hz)
                self._apply_parameter(group.parameter)

    def _run_command(self, message: Message, now_ns: int) -> Iterator[Message]:
        """Yield the answer to a command: COMMAND_ACK, and the message that the command requests."""
        param1, requested_messages = message.param1, list[Message]()
        if message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            requested_messages = self._requested_messages(param1, message.param2)
        elif message.command in _REQUESTED_MESSAGES:
            requested_messages = self._requested_messages(_REQUESTED_MESSAGES[message.command], 0)
        elif message.command == dialect.MAV_CMD_GET_MESSAGE_INTERVAL and is_integer_up_to(param1, _LAST_MESSAGE_ID):
            interval_us = self._streams.interval_us(int(param1))
            requested_messages = [dialect.MAVLink_message_interval_message(int(param1), interval_us)]
        if requested_messages:
            result = int(dialect.MAV_RESULT_ACCEPTED)
        elif message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(param1, message.param2, now_ns)
        elif message.command in _REQUESTED_MESSAGES or message.command in _MESSAGE_QUERIES:
            result = self._firmware.unknown_message
        else:
            result = self._commands.run(message)
        sender = message.get_srcSystem(), message.get_srcComponent()
        yield dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *sender)
        yield from requested_messages

    def _requested_messages(self, kind: float, param2: float) -> list[Message]:
        """Return the messages that a client requests by id; empty if the autopilot does not send them on request."""
        if kind == AVAILABLE_MODES:
            return self._telemetry.available_modes(param2)
        build = self._telemetry.builders.get(int(kind)) if is_integer_up_to(kind, _LAST_MESSAGE_ID) else None
        telemetry = None if build is None or int(kind) in self._telemetry.streamed_only else build()
        return [] if telemetry is None else [telemetry]

    def _set_interval(self, kind: float, interval_us: float, now_ns: int) -> int:
        is_sent = is_integer_up_to(kind, _LAST_MESSAGE_ID) and int(kind) in self._telemetry.builders
        if not is_sent or not math.isfinite(interval_us):
            return self._firmware.unknown_rate
        self._streams.set_interval(int(kind), interval_us, now_ns)
        return int(dialect.MAV_RESULT_ACCEPTED)

    def _accept_set_point(self, message: Message) -> None:
        """Accept a position or a velocity, which must be finite; if a message has both, the velocity is used."""
        if message.get_type() == "SET_POSITION_TARGET_GLOBAL_INT":
            args = message.coordinate_frame, message.lat_int, message.lon_int, message.alt
            position_m = goal_m(*args, self.vehicle.home_m)
        elif message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED:
            position_m = self.vehicle.from_local((message.y, message.x, -message.z))
        else:
            return
        has_yaw = not message.type_mask & _YAW_IGNORED and math.isfinite(message.yaw)
        # MAVLink's yaw is clockwise from north.
        yaw_rad = math.remainder(math.pi / 2 - message.yaw, math.tau) if has_yaw else None
        velocity = (message.vy, message.vx, -message.vz)
        if not message.type_mask & _VELOCITY_IGNORED:
            if all(map(math.isfinite, velocity)):
                self.vehicle.accept_set_point(SetPoint(velocity, is_position=False, yaw_rad=yaw_rad))
        elif not message.type_mask & _POSITION_IGNORED and position_m and all(map(math.isfinite, position_m)):
            self.vehicle.accept_set_point(SetPoint(position_m, is_position=True, yaw_rad=yaw_rad))


_MESSAGE_QUERIES: Final = frozenset({dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAV_CMD_GET_MESSAGE_INTERVAL})
_REQUESTED_MESSAGES: Final = {
    dialect.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    dialect.MAV_CMD_REQUEST_PROTOCOL_VERSION: mavlink_frames.PROTOCOL_VERSION,
    dialect.MAV_CMD_GET_HOME_POSITION: dialect.MAVLINK_MSG_ID_HOME_POSITION,
}
"""Id of the message that a command requests, by command."""
