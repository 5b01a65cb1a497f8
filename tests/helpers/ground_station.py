"""A small ground station without a network; it passes datagrams to an autopilot and reads the answers."""

import math
import struct
from collections.abc import Callable, Iterable
from typing import Final

from pymavlink.dialects.v20 import common as d

from sim_backends.emulated.autopilot.autopilot import Autopilot
from sim_backends.emulated.autopilot.firmware import Firmware
from sim_backends.emulated.autopilot.flight import MakeAirframe
from sim_backends.emulated.autopilot.mavlink_frames import Message
from sim_backends.emulated.autopilot.mission_plan import degrees_e7
from sim_backends.emulated.autopilot.parameters import FlightLimits, Parameters
from sim_backends.emulated.autopilot.px4 import PX4
from sim_backends.physics.ground import Ground
from sim_backends.physics.robot_limits import DUCKIEDRONE
from sim_backends.world.world import World

SYSTEM: Final = 7
LIMITS: Final = FlightLimits(speed_m_s=3.0, height_m=30.0, fence_m=100.0)
TICK_NS: Final = 20_000_000
HOME_M: Final = (120.0, -40.0, 0.0)
RELATIVE: Final = d.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT


class GroundStation:
    """Client of a new autopilot, with a simulated clock.

    Args:
        is_lost: Returns True if the next datagram, in either direction, is lost.
        limits: Limits of the drone's profile.
        world: World that it flies in; None for open flat ground.
        firmware: Family of the autopilot.
        boot_s: Its boot time.
        make_airframe: Creates its airframe; None for an airframe that the autopilot itself moves.
    """

    def __init__(
        self,
        is_lost: Callable[[], bool] = lambda: False,
        limits: FlightLimits = LIMITS,
        world: World | None = None,
        firmware: Firmware = PX4,
        *,
        boot_s: float = 0.0,
        make_airframe: MakeAirframe | None = None,
    ) -> None:
        obstacles = Ground(world, None).obstacles
        self.autopilot = Autopilot(
            firmware=firmware,
            system=SYSTEM,
            limits=limits,
            airframe_limits=DUCKIEDRONE,
            obstacles=obstacles,
            now_ns=0,
            boot_s=boot_s,
            make_airframe=make_airframe,
        )
        self.autopilot.vehicle.place(HOME_M, math.pi / 2, 0)
        self._ardupilot = firmware.is_ardupilot
        self._parameters = Parameters(firmware.parameters(limits))
        self.now_ns = 0
        self.received: list[Message] = []
        self._is_lost = is_lost
        self._link = d.MAVLink(None, srcSystem=255, srcComponent=190)
        self._reader = d.MAVLink(None)

    def send_message(self, message: Message) -> list[Message]:
        """Send a message; return the answers."""
        return self.send(message.pack(self._link))

    def send(self, datagram: bytes) -> list[Message]:
        """Send bytes; return the answers."""
        if self._is_lost():
            return []
        return self._receive(frame for _, frame in self.autopilot.receive(datagram, ("gcs", 1), self.now_ns))

    def advance_world(self) -> None:
        """Advance the world to the current time; the default world has nothing that moves."""

    def wait(self, seconds: float, *, heartbeats: bool = True) -> list[Message]:
        """Advance the time; return the received messages."""
        received, until_ns = [], self.now_ns + round(seconds * 1e9)
        while self.now_ns < until_ns:
            if heartbeats and self.now_ns % 1_000_000_000 == 0:
                self.send_message(d.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
            self.now_ns += TICK_NS
            self.advance_world()
            received += self._receive(frame for _, frame in self.autopilot.advance(self.now_ns))
        return received

    def command(self, command: int, *parameters: float) -> int:
        """Send a COMMAND_LONG; return the result in its COMMAND_ACK."""
        seven = (*parameters, *(0.0,) * (7 - len(parameters)))
        answers = self.send_message(d.MAVLink_command_long_message(SYSTEM, 1, command, 0, *seven))
        (ack,) = [answer for answer in answers if answer.get_type() == "COMMAND_ACK"]
        assert ack.command == command
        return int(ack.result)

    def request_rate(self, rate_hz: float, *kinds: int) -> None:
        """Request messages at a rate."""
        for kind in kinds:
            assert self.command(d.MAV_CMD_SET_MESSAGE_INTERVAL, kind, 1e6 / rate_hz) == d.MAV_RESULT_ACCEPTED

    def texts(self) -> list[tuple[int, str]]:
        """Return the severity and text of each received STATUSTEXT."""
        return [(message.severity, message.text) for message in self.received if message.get_type() == "STATUSTEXT"]

    def set(self, name: str, value: float) -> None:
        """Set a parameter by its name, and check its new value."""

        is_integer = self._parameters.is_integer(name)
        bytewise = is_integer and not self._ardupilot
        packed = struct.unpack("<f", struct.pack("<i", round(value)))[0] if bytewise else value
        kind = d.MAV_PARAM_TYPE_INT32 if is_integer else d.MAV_PARAM_TYPE_REAL32
        (reply,) = self.send_message(d.MAVLink_param_set_message(SYSTEM, 1, name.encode(), packed, kind))
        assert reply.param_value == struct.unpack("<f", struct.pack("<f", packed))[0], name

    def last(self, kind: str) -> Message:
        """Return the newest message of a kind."""
        return next(message for message in reversed(self.received) if message.get_type() == kind)

    def _receive(self, frames: Iterable[bytes]) -> list[Message]:
        received = [
            message for frame in frames if not self._is_lost() for message in self._reader.parse_buffer(frame)
        ]
        self.received += received
        return received


def item(number: int, east_m: float, north_m: float, up_m: float, command: int = d.MAV_CMD_NAV_WAYPOINT) -> Message:
    """Return an item of a mission, at a position relative to `HOME_M`."""
    x, y = degrees_e7(HOME_M[0] + east_m, HOME_M[1] + north_m)
    return d.MAVLink_mission_item_int_message(SYSTEM, 1, number, RELATIVE, command, 0, 1, 0, 0, 0, 0, x, y, up_m)


def upload(gcs: GroundStation, items: list[Message]) -> int:
    """Upload items, repeating messages without an answer; return the result."""
    message = d.MAVLink_mission_count_message(SYSTEM, 1, len(items))
    for _ in range(200):
        for answer in gcs.send_message(message) + gcs.wait(0.3):
            if answer.get_type() == "MISSION_ACK":
                return int(answer.type)
            if answer.get_type() == "MISSION_REQUEST_INT":
                message = items[answer.seq]
    raise AssertionError("the upload did not end")
