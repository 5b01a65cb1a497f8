"""The medium: one process that carries every packet between the robots' TUN or TAP devices through the radio model.

`medium_client` runs it as `python -m sim_backends.emulated.medium.process FD SEED FRAMING`; FD is one end of a socket
pair. The process exits when the other end closes. The kernel then removes the devices, because only this process
holds their descriptors.
"""

import gc
import os
import select
import socket
import sys
import time
from collections import Counter, deque
from collections.abc import Set
from dataclasses import dataclass, field
from ipaddress import IPv4Interface
from typing import Final, Self

from fieldkit.core.deadline import Deadline
from fieldkit.core.model import LinkSample, Vector
from sim_backends.emulated.medium.air_log import AirLog
from sim_backends.emulated.medium.framing import FRAMINGS, NO_ROBOT, Framing
from sim_backends.emulated.medium.ports import FlowDelays, MediumStats, Port, pack_links, pack_stats, rounded_up
from sim_backends.emulated.medium.timerfd import Timer
from sim_backends.emulated.process import worker
from sim_backends.emulated.process.worker import Message
from sim_backends.radio.fixed_links import UniformLinks
from sim_backends.radio.links import PACKET, processing_ns
from sim_backends.radio.model import RadioModel, WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.radio.world_channel import Antenna
from sim_backends.world.world import World

# Packets read from one robot before other robots and the timer are served: 64 take about half a millisecond.
_BURST: Final = 64
# Longer than any packet of an interface with the MTU 1500 of Wi-Fi; each read allocates this much.
_READ_BYTES: Final = 2048
# A TUN device holds this many packets: its default queue length, TUN_READQ_SIZE of the kernel's tun.c.
_DEVICE_PACKETS: Final = 500
# Longest sleep of the medium. After a longer sleep, packets may have waited for the excess.
_MAX_SLEEP_NS: Final = 10_000_000
_OWNER_TIMEOUT_S: Final = 5.0
# Polling interval of the robots' interfaces; a poll takes 0.6 us for three robots.
_INTERFACE_POLL_NS: Final = 1_000_000
# The sampling interval of a robot's own link sampler.
_SAMPLE_NS: Final = 200_000_000
_MAX_SAMPLES: Final = 10_000
"""Samples kept per robot: half an hour."""


@dataclass(frozen=True)
class _Layout:
    """Places of the robots in the last request of the lab.

    Attributes:
        positions_m: Position of each robot, metres east, north, up; empty before the first request.
        velocities_m_s: Velocity of each robot.
        relay: The robot whose access point relays between the others; None if they communicate directly.
    """

    positions_m: dict[str, Vector] = field(default_factory=dict)
    velocities_m_s: dict[str, Vector] = field(default_factory=dict)
    relay: str | None = None

    @classmethod
    def from_message(cls, message: Message) -> Self:
        """Return the layout from a request to place the robots."""
        positions_m = {name: tuple(place_m) for name, place_m in message["positions"].items()}
        velocities_m_s = {name: tuple(velocity) for name, velocity in message["velocities"].items()}
        return cls(positions_m, velocities_m_s, message["relay"])


class Medium:
    """Moves packets between ports; times are those of `time.monotonic_ns`.

    Args:
        seed: Seed of the radio model.
        framing: Framing of the devices.
        channel: Socket of the owner's requests.
    """

    def __init__(self, seed: int, framing: Framing, channel: socket.socket) -> None:
        self._channel = channel
        self._framing = framing
        self._seed = seed
        self._options = RadioOptions()
        self._world: World | None = None
        self._antennas: dict[str, Antenna] = {}
        self._model: RadioModel[bytes] = UniformLinks(seed, self._options)
        self._modelled_ports = 0
        self._routed: tuple[Set[str], int] = frozenset(), 0
        self._air_log: AirLog | None = None
        # Time of the next link sample, None if links are not sampled; and the samples since the last request.
        self._sample_ns: int | None = None
        self._sampled: deque[dict[str, LinkSample]] = deque(maxlen=_MAX_SAMPLES)
        self._layout = _Layout()
        self._on_air_robots: set[str] = set()
        self._polled_ns = 0
        self._ports: dict[str, Port] = {}
        self._by_fd: dict[int, Port] = {}
        self._late: Counter[int] = Counter()
        self._flows = FlowDelays()
        # A device with packets was empty at the earlier time, if the previous round read all of them.
        self._arrived_after_ns = self._previous_poll_ns = time.monotonic_ns()
        self._armed_ns: int | None = None
        self._scheduling = _raise_priority()
        self._timer = Timer()
        self._epoll = select.epoll()
        self._epoll.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._epoll.register(channel.fileno(), select.EPOLLIN)
        # A TUN device is writable while its interface is up.
        self._writable = select.epoll()

    def run(self) -> None:
        """Carry packets and answer requests until the owner closes the socket."""
        by_fd = self._by_fd
        control = self._channel.fileno()
        while True:
            ready = self._wait()
            if time.monotonic_ns() - self._polled_ns > _INTERFACE_POLL_NS:
                self._update_interfaces()
            for fd, _ in ready:
                if fd in by_fd:
                    self._read(by_fd[fd])
                elif fd == control and not self._serve():
                    return
            self._deliver()
            if self._sample_ns is not None and time.monotonic_ns() >= self._sample_ns:
                self._sample()

    def _wait(self) -> list[tuple[int, int]]:
        """Wait for packets, requests or the timer, and note the earliest time at which the packets can have arrived.

        Packets that are ready immediately arrived after the previous poll. Packets that wake the process have not
        waited, unless it slept longer than the poll's timeout.
        """
        polled_ns = time.monotonic_ns()
        ready = self._epoll.poll(0)
        if ready:
            self._arrived_after_ns, self._previous_poll_ns = self._previous_poll_ns, polled_ns
            return ready
        ready = self._epoll.poll(_MAX_SLEEP_NS / 1e9)
        self._arrived_after_ns = self._previous_poll_ns = min(time.monotonic_ns(), polled_ns + _MAX_SLEEP_NS)
        return ready

    def _read(self, port: Port) -> None:
        """Send the packets that wait at `port` to the model."""
        fd, name, routes, send, clock_ns = port.fd, port.name, port.routes, self._model.send, time.monotonic_ns
        if port.backlog <= 0:
            port.backlog, port.backlog_since_ns = _DEVICE_PACKETS, self._arrived_after_ns
        flows, requested = self._flows, self._flows.counted
        framing = self._framing
        carries, destination_of, header_bytes = framing.carries, framing.destination, framing.header_bytes
        # Added to the time of reading, this is the delay of one packet that has waited since `backlog_since_ns`.
        waited = PACKET - port.backlog_since_ns
        for _ in range(_BURST):
            try:
                packet = os.read(fd, _READ_BYTES)
                carried = carries(packet)
            except BlockingIOError:
                port.backlog = 0
                return
            except (OSError, IndexError):
                # The robot's namespace and its device no longer exist; a socket returns no bytes in this case.
                self._epoll.unregister(fd)
                return
            port.read += 1
            if not carried:
                port.not_ipv4 += 1
                continue
            destination = destination_of(packet, routes)
            if destination == NO_ROBOT:
                port.unroutable += 1
                continue
            if requested and (inner := framing.ipv4(packet)) is not None:
                flows.note_first_fragment(inner)
            now_ns = clock_ns()
            send(now_ns, name, packet, len(packet) - header_bytes, destination, before=waited + now_ns)
        port.backlog -= _BURST

    def _deliver(self) -> None:
        """Write arrived packets to the robots, and set the timer to the next arrival."""
        now_ns = time.monotonic_ns()
        arrived = self._model.deliveries(now_ns)
        if arrived:
            ports, write, clock_ns, late = self._ports, os.write, time.monotonic_ns, self._late
            flows, requested = self._flows, self._flows.counted
            for at_ns, name, packet, source, delayed in arrived:
                port = ports[name]
                try:
                    write(port.fd, packet)
                except OSError:
                    # The interface is down, or the robot has stopped.
                    port.refused += 1
                    continue
                late_ns = clock_ns() - at_ns
                port.delays[source] += delayed + late_ns
                if requested and (inner := self._framing.ipv4(packet)) is not None:
                    flows.count(inner, delayed + late_ns, port.address.packed)
                late[rounded_up(late_ns + processing_ns(delayed))] += 1
        next_ns = self._model.next_event_ns()
        if next_ns is not None and next_ns != self._armed_ns:
            self._timer.set(next_ns)
            self._armed_ns = next_ns

    def _serve(self) -> bool:
        """Answer one request; return False if the owner has closed the socket."""
        deadline = Deadline.after(_OWNER_TIMEOUT_S)
        received = worker.receive(self._channel, deadline)
        if received is None:
            return False
        request, descriptors = received
        try:
            reply = self._answer(request, descriptors)
        except (KeyError, TypeError, ValueError) as error:
            reply = {"error": f"{type(error).__name__}: {error}"}
        worker.send(self._channel, reply, deadline)
        return True

    def _answer(self, request: Message, descriptors: list[int]) -> Message:
        match request["do"]:
            case "attach":
                (fd,) = descriptors
                self._attach(request["name"], IPv4Interface(request["address"]), fd)
                self._antennas[request["name"]] = Antenna(**request["antenna"])
                return {}
            case "use":
                self._options = RadioOptions.model_validate(request["options"])
                self._world = None if request["world"] is None else World.model_validate(request["world"])
                return {}
            case "place":
                self._layout = _Layout.from_message(request)
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
            raise ValueError(f"{name} or {address.ip} is attached already")
        os.set_blocking(fd, False)
        self._ports[name] = self._by_fd[fd] = Port(name, address, fd)
        self._epoll.register(fd, select.EPOLLIN)
        self._writable.register(fd, select.EPOLLOUT)

    def _robots_with_interface_up(self) -> set[str]:
        """Return the robots whose interface is up; a change (`ip link`, an empty battery) sends no event."""
        self._polled_ns = time.monotonic_ns()
        return {self._by_fd[fd].name for fd, events in self._writable.poll(0) if events & select.EPOLLOUT}

    def _update_interfaces(self) -> None:
        """Update the set of robots on the air from the state of their interfaces."""
        on_air = self._robots_with_interface_up()
        if on_air != self._on_air_robots and self._layout.positions_m:
            self._on_air_robots = on_air
            self._place()

    def _place(self) -> None:
        """Place the robots that are on the air; if the access point is off the air, no station has a place."""
        positions_m = {
            name: place_m for name, place_m in self._layout.positions_m.items() if name in self._on_air_robots
        }
        relay = self._layout.relay
        if relay is not None and relay not in positions_m:
            positions_m, relay = {}, None
        if len(self._ports) != self._modelled_ports:
            # A robot that is attached later gets a new model; packets on the air of the old model are lost.
            self._modelled_ports = len(self._ports)
            self._model = self._new_model()
            self._model.use_meter()
            self._model.log_attempts(None if self._air_log is None else self._air_log.write)
        self._model.place(time.monotonic_ns(), positions_m, relay, self._layout.velocities_m_s)
        if (positions_m.keys(), len(self._ports)) != self._routed:
            self._route(positions_m.keys())

    def _route(self, present: Set[str]) -> None:
        """Give each robot that is present routes to the others, and other robots none."""
        self._routed = frozenset(present), len(self._ports)
        for port in self._ports.values():
            is_present = port.name in present
            others = [name for name in present if name != port.name] if is_present else []
            port.routes = self._framing.routes(port.address, {name: self._ports[name].address for name in others})

    def _new_model(self) -> RadioModel[bytes]:
        if self._options.fixed:
            return UniformLinks(self._seed, self._options)
        return WifiInWorld(self._seed, self._options, self._antennas, self._world)

    def _record(self, descriptors: list[int]) -> None:
        """Record transmissions to a new pair of files, or stop recording if there are no descriptors."""
        if self._air_log is not None:
            self._air_log.close()
        self._air_log = AirLog(descriptors, tuple(self._ports), framing=self._framing) if descriptors else None
        self._model.log_attempts(None if self._air_log is None else self._air_log.write)

    def _sample(self) -> None:
        """Sample the links of all radios; packets that arrive during the sampling are delivered in the next round."""
        now_ns = time.monotonic_ns()
        self._sample_ns = now_ns + _SAMPLE_NS
        self._sampled.append(self._model.sample(now_ns, time.time_ns()))

    def _links(self, *, continue_sampling: bool) -> Message:
        """Return the link samples since the last request, including one taken now."""
        self._sample()
        reply = pack_links(self._sampled)
        self._sampled.clear()
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
        return MediumStats(self._scheduling, self._late, self._model.counters(), ports, delays)


def _raise_priority() -> str:
    """Request the lowest real-time priority, so that other processes delay no packet; return the result as text.

    The kernel pauses a medium that fills its core for 50 ms per second (sched_rt_runtime_us), which increases the
    lateness.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError as error:
        return f"normal, because real-time was refused: {error.strerror}"
    return "fifo 1"


def main() -> None:
    """Run the medium; the command line has the descriptor of the socket, the seed and the framing."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    medium = Medium(int(sys.argv[2]), FRAMINGS[sys.argv[3]], channel)
    # Carrying packets makes no reference cycles, and a garbage collection would delay packets.
    gc.disable()
    medium.run()


if __name__ == "__main__":
    main()
