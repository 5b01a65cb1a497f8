"""Base class of media: devices of robots, requests of the lab, interfaces, link samples, recordings of the air.

A medium is a process that carries the packets of the robots' TUN or TAP devices. `process` contains the medium of a
radio model, and `sim_backends.emulated.cosimulated` contains the medium of a co-simulation.
"""

import os
import select
import socket
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping, Set
from dataclasses import dataclass, field
from ipaddress import IPv4Interface
from typing import Final, Self

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import LinkSample, Vector
from sim_backends.emulated.medium.air_log import AirLog
from sim_backends.emulated.medium.framing import Framing
from sim_backends.emulated.medium.medium_stats import MediumStats, pack_links, pack_stats
from sim_backends.emulated.medium.ports import FlowDelays, Port
from sim_backends.emulated.medium.timerfd import Timer
from sim_backends.emulated.process import worker
from sim_backends.emulated.process.worker import Message
from sim_backends.radio.antennas import Antenna, decode_antenna
from sim_backends.radio.core.links import LinkCounters, Pair
from sim_backends.radio.mac.frames import TransmissionAttempt
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import Attitude
from sim_backends.world.world import World

BURST: Final = 64
"""Maximum number of packets read from one robot before other robots and the timer are served: about 0.5 ms."""
READ_BYTES: Final = 2048
"""Size of a read, which is longer than any packet of an interface with the MTU 1500 of Wi-Fi."""
DEVICE_PACKETS: Final = 500
"""Default queue length of a TUN device, TUN_READQ_SIZE of the kernel's tun.c."""
INTERFACE_POLL_NS: Final = 1_000_000
"""Polling interval of the robots' interfaces; a poll takes 0.6 us for three robots."""

_OWNER_TIMEOUT_S: Final = 5.0
"""Timeout of a message from or to the owner."""
# The link sampler of a robot has the same sampling interval.
_SAMPLE_NS: Final = 200_000_000
_MAX_SAMPLES: Final = 10_000
"""Maximum number of samples that are kept per robot: the last 33 minutes."""

AttemptLog = Callable[[TransmissionAttempt], None]


@dataclass(frozen=True)
class Layout:
    """Positions of the robots in the last request of the lab.

    Attributes:
        positions_m: Position of each robot, metres east, north, up; empty before the first request.
        velocities_m_s: Velocity of each robot, metres per second east, north, up; at rest without an entry.
        attitudes: Attitude of each robot; empty if no antenna has a pattern.
        relay: The robot whose access point relays between the others; None if they communicate directly.
    """

    positions_m: dict[str, Vector] = field(default_factory=dict)
    velocities_m_s: dict[str, Vector] = field(default_factory=dict)
    attitudes: dict[str, Attitude] = field(default_factory=dict)
    relay: str | None = None

    @classmethod
    def from_message(cls, message: Message) -> Self:
        """Return the layout from a request to place the robots."""
        positions_m = {name: tuple(position_m) for name, position_m in message["positions"].items()}
        velocities_m_s = {name: tuple(velocity) for name, velocity in message["velocities"].items()}
        attitudes = {name: Attitude(*angles_rad) for name, angles_rad in message.get("attitudes", {}).items()}
        return cls(positions_m, velocities_m_s, attitudes, message["relay"])


class MediumServer(ABC):
    """Devices and requests of a medium; times are those of `time.monotonic_ns`.

    Args:
        seed: Seed of all random draws.
        framing: Framing of the devices.
        channel: Socket of the requests of the owner, which is the process of the lab.
    """

    def __init__(self, seed: int, framing: Framing, channel: socket.socket) -> None:
        self._channel = channel
        self._framing = framing
        self._seed = seed
        self._options = RadioOptions()
        self._world: World | None = None
        self._antennas: dict[str, Antenna] = {}
        self._air_log: AirLog | None = None
        # Time of the next link sample, or None if links are not sampled.
        self._sample_ns: int | None = None
        self._samples: deque[Mapping[str, LinkSample]] = deque(maxlen=_MAX_SAMPLES)
        self._layout = Layout()
        # The robots on the air and the number of ports, for which the routes of the ports were computed.
        self._routing_state: tuple[Set[str], int] = frozenset(), 0
        # Robots whose interface was up in the last poll, and the time of this poll.
        self._on_air_robots: set[str] = set()
        self._polled_ns = 0
        self._ports: dict[str, Port] = {}
        self._by_fd: dict[int, Port] = {}
        # Number of packets by lateness.
        self._packet_lateness_counts: Counter[int] = Counter()
        self._flows = FlowDelays()
        self._scheduling = _raise_priority()
        self._timer = Timer()
        self._epoll = select.epoll()
        self._epoll.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._epoll.register(channel.fileno(), select.EPOLLIN)
        # A TUN device is writable while its interface is up.
        self._writable = select.epoll()

    @abstractmethod
    def _place_stations(self, positions_m: dict[str, Vector], relay: str | None) -> None:
        """Place the robots that are on the air, and only these."""

    @abstractmethod
    def _log_attempts(self, log: AttemptLog | None) -> None:
        """Pass every later transmission attempt to `log`; None stops logging."""

    @abstractmethod
    def _sample_links(self, now_ns: int) -> Mapping[str, LinkSample]:
        """Return a sample of the links of all radios."""

    @abstractmethod
    def _link_counters(self) -> dict[Pair, LinkCounters]:
        """Return the counters of each directed link."""

    def _serve(self) -> bool:
        """Answer one request; return False if the owner has closed the socket."""
        deadline = Deadline.after(_OWNER_TIMEOUT_S)
        message = worker.receive(self._channel, deadline)
        if message is None:
            return False
        request, descriptors = message
        try:
            reply = self._answer(request, descriptors)
        except (KeyError, TypeError, ValueError) as error:
            reply = {"error": f"{type(error).__name__}: {error}"}
        worker.send(self._channel, reply, Deadline.after(_OWNER_TIMEOUT_S))
        return True

    def _answer(self, request: Message, descriptors: list[int]) -> Message:
        """Execute a request of the lab and return the reply."""
        match request["do"]:
            case "attach":
                (fd,) = descriptors
                self._attach(request["name"], IPv4Interface(request["address"]), fd)
                self._antennas[request["name"]] = decode_antenna(request["antenna"])
                return {}
            case "use":
                self._options = RadioOptions.model_validate(request["options"])
                self._world = None if request["world"] is None else World.model_validate(request["world"])
                return {}
            case "place":
                self._layout = Layout.from_message(request)
                self._on_air_robots = self._robots_with_interface_up()
                self._place()
                return {}
            case "record":
                self._record(descriptors)
                return {}
            case "links":
                return self._links(continue_sampling=request["continue_sampling"])
            case "delays" | "stats" as kind:
                return self._delays(request) if kind == "delays" else pack_stats(self._stats())
            case other:
                raise ValueError(f"unknown request {other!r}")

    def _attach(self, name: str, address: IPv4Interface, fd: int) -> None:
        if name in self._ports or address.ip in {port.address.ip for port in self._ports.values()}:
            os.close(fd)
            raise ValueError(f"{name} or {address.ip} is already attached")
        os.set_blocking(fd, False)
        self._ports[name] = self._by_fd[fd] = Port(name, address, fd)
        self._epoll.register(fd, select.EPOLLIN)
        self._writable.register(fd, select.EPOLLOUT)

    def _robots_with_interface_up(self) -> set[str]:
        """Return the robots whose interface is up.

        The medium polls this set, because a change (`ip link`, an empty battery) causes no event.
        """
        self._polled_ns = time.monotonic_ns()
        return {self._by_fd[fd].name for fd, events in self._writable.poll(0) if events & select.EPOLLOUT}

    def _update_interfaces(self) -> None:
        """Poll the robots' interfaces; if the robots on the air have changed, place the robots again."""
        on_air = self._robots_with_interface_up()
        if on_air != self._on_air_robots and self._layout.positions_m:
            self._on_air_robots = on_air
            self._place()

    def _place(self) -> None:
        """Place the robots that are on the air; if the access point is off the air, no station is placed."""
        positions_m = {
            name: position_m for name, position_m in self._layout.positions_m.items() if name in self._on_air_robots
        }
        relay = self._layout.relay
        if relay is not None and relay not in positions_m:
            positions_m, relay = {}, None
        self._place_stations(positions_m, relay)
        if (positions_m.keys(), len(self._ports)) != self._routing_state:
            self._route(positions_m.keys())

    def _route(self, robots_on_air: Set[str]) -> None:
        """Give each robot on the air routes to the others that are on the air; other robots have no routes."""
        self._routing_state = frozenset(robots_on_air), len(self._ports)
        for port in self._ports.values():
            is_on_air = port.name in robots_on_air
            others = [name for name in robots_on_air if name != port.name] if is_on_air else []
            port.routes = self._framing.routes(port.address, {name: self._ports[name].address for name in others})

    def _record(self, descriptors: list[int]) -> None:
        """Record transmissions to a new pair of files, or stop recording if there are no descriptors."""
        if self._air_log is not None:
            self._air_log.close()
        names = (*self._ports, *self._options.access_points, *self._options.neighbours)
        self._air_log = AirLog(descriptors, names, framing=self._framing) if descriptors else None
        self._log_attempts(None if self._air_log is None else self._air_log.write)

    def _sample(self) -> None:
        """Sample the links of all radios; packets that arrive during the sampling are delivered in the next round."""
        now_ns = time.monotonic_ns()
        self._sample_ns = now_ns + _SAMPLE_NS
        self._samples.append(self._sample_links(now_ns))

    def _links(self, *, continue_sampling: bool) -> Message:
        """Return the link samples since the last request, including one taken now."""
        self._sample()
        reply = pack_links(self._samples)
        self._samples.clear()
        if not continue_sampling:
            self._sample_ns = None
        return reply

    def _delays(self, request: Message) -> Message:
        """Return the delays of the packets of one flow."""
        source, destination = (self._ports[request[key]].address.ip for key in ("source", "destination"))
        return vars(self._flows.delay_parts(source, destination, request["protocol"], request["port"]))

    def _stats(self) -> MediumStats:
        ports = {name: port.counters for name, port in self._ports.items()}
        delays = {
            (source, name): parts
            for name, port in self._ports.items()
            for source, parts in port.delay_parts().items()
        }
        return MediumStats(self._scheduling, self._packet_lateness_counts, self._link_counters(), ports, delays)


def _raise_priority() -> str:
    """Request the lowest real-time priority, and return the result as text.

    With this priority, no process of normal priority delays a packet.

    If the medium uses all time of its core, the kernel pauses it for 50 ms in each second (sched_rt_runtime_us),
    which increases the lateness.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError as error:
        return f"normal, because real-time was refused: {error.strerror}"
    return "fifo 1"
