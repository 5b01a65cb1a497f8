"""The medium: one process that carries every packet between the robots' TUN or TAP devices through the radio model.

Run by `client` as `python -m sim_backends.emulated.medium.process FD SEED FRAMING`, FD being one end of a socket
pair. It ends by itself when the other end closes, and with it all devices end: their descriptors are held here.
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
from sim_backends.emulated.medium.flows import FlowDelays
from sim_backends.emulated.medium.framing import FRAMINGS, NOBODY, Framing
from sim_backends.emulated.medium.ports import MediumStats, Port, pack_links, pack_stats, rounded_up
from sim_backends.emulated.medium.timerfd import Timer
from sim_backends.emulated.process import ipc
from sim_backends.emulated.process.ipc import Message
from sim_backends.radio.delay import PACKET, processing_ns
from sim_backends.radio.fixed_links import UniformLinks
from sim_backends.radio.model import RadioModel, WifiInWorld
from sim_backends.radio.options import RadioOptions
from sim_backends.radio.world_channel import Antenna
from sim_backends.world.world import World

# Packets read from one robot before the others and the timer get their turn: 64 take about half a millisecond.
_BURST: Final = 64
# Longer than any packet of an interface with the MTU 1500 of Wi-Fi; each read allocates this much.
_READ_BYTES: Final = 2048
# A TUN device holds this many packets: its default queue length, TUN_READQ_SIZE of the kernel's tun.c.
_DEVICE_PACKETS: Final = 500
# Asleep, the medium wakes so often, and what comes after a longer sleep may have waited for the rest of it.
_BEAT_NS: Final = 10_000_000
_OWNER_TIMEOUT_S: Final = 5.0
# How often the medium looks whose interface is up; 0.6 us for three robots.
_LOOK_NS: Final = 1_000_000
# A robot's own sampler looks as often.
_SAMPLE_NS: Final = 200_000_000
_MOST_SAMPLED: Final = 10_000
"""Moments: half an hour."""


@dataclass(frozen=True)
class _Layout:
    """Places of the robots, as the lab told them last.

    Attributes:
        positions_m: Where each is, metres east, north, up; nobody is anywhere at first.
        velocities_m_s: How fast each moves.
        relay: Whose access point relays between the others; None where they talk directly.
    """

    positions_m: dict[str, Vector] = field(default_factory=dict)
    velocities_m_s: dict[str, Vector] = field(default_factory=dict)
    relay: str | None = None

    @classmethod
    def from_message(cls, message: Message) -> Self:
        """Return the layout that a request to place everybody has."""
        positions_m = {name: tuple(place_m) for name, place_m in message["positions"].items()}
        velocities_m_s = {name: tuple(velocity) for name, velocity in message["velocities"].items()}
        return cls(positions_m, velocities_m_s, message["relay"])


class Medium:
    """Moves packets between ports; time is `time.monotonic_ns`.

    Args:
        seed: Seed of the radio model.
        framing: What the devices carry.
        channel: Where the owner's requests come from.
    """

    def __init__(self, seed: int, framing: Framing, channel: socket.socket) -> None:
        self._channel = channel
        self._framing = framing
        self._seed = seed
        self._options = RadioOptions()
        self._world: World | None = None
        self._antennas: dict[str, Antenna] = {}
        self._model: RadioModel[bytes] = UniformLinks(seed, self._options)
        self._placed = 0
        self._routed: tuple[Set[str], int] = frozenset(), 0
        self._air_log: AirLog | None = None
        # When links are sampled next, None for not at all; and what they were when they were.
        self._sample_ns: int | None = None
        self._sampled: deque[dict[str, LinkSample]] = deque(maxlen=_MOST_SAMPLED)
        self._layout = _Layout()
        self._on: set[str] = set()
        self._looked_ns = 0
        self._ports: dict[str, Port] = {}
        self._by_fd: dict[int, Port] = {}
        self._late: Counter[int] = Counter()
        self._flows = FlowDelays()
        # A device that is found with packets now had none then, if the round before read all of them.
        self._since_ns = self._before_ns = time.monotonic_ns()
        self._armed_ns: int | None = None
        self._scheduling = _raise_priority()
        self._timer = Timer()
        self._epoll = select.epoll()
        self._epoll.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._epoll.register(channel.fileno(), select.EPOLLIN)
        # A TUN device can be written to as long as its interface is up.
        self._writable = select.epoll()

    def run(self) -> None:
        """Carry packets and answer requests until the owner is gone."""
        by_fd = self._by_fd
        control = self._channel.fileno()
        while True:
            ready = self._wait()
            if time.monotonic_ns() - self._looked_ns > _LOOK_NS:
                self._look()
            for fd, _ in ready:
                if fd in by_fd:
                    self._read(by_fd[fd])
                elif fd == control and not self._serve():
                    return
            self._hand_over()
            if self._sample_ns is not None and time.monotonic_ns() >= self._sample_ns:
                self._sample()

    def _wait(self) -> list[tuple[int, int]]:
        """Wait for packets, requests or the timer, and note since when the packets may have been there.

        Those that came while the medium was at work have waited since it looked before, at most. Those that wake it
        have not, unless it slept longer than it wanted to.
        """
        looked_ns = time.monotonic_ns()
        ready = self._epoll.poll(0)
        if ready:
            self._since_ns, self._before_ns = self._before_ns, looked_ns
            return ready
        ready = self._epoll.poll(_BEAT_NS / 1e9)
        self._since_ns = self._before_ns = min(time.monotonic_ns(), looked_ns + _BEAT_NS)
        return ready

    def _read(self, port: Port) -> None:
        """Give the packets that wait at `port` to the model."""
        fd, name, routes, send, clock_ns = port.fd, port.name, port.routes, self._model.send, time.monotonic_ns
        if port.backlog <= 0:
            port.backlog, port.backlog_since_ns = _DEVICE_PACKETS, self._since_ns
        flows, asked_for = self._flows, self._flows.counted
        framing = self._framing
        carries, destination_of, header_bytes = framing.carries, framing.destination, framing.header_bytes
        # A delay of one packet that waited since then, but for the moment of its reading.
        waited = PACKET - port.backlog_since_ns
        for _ in range(_BURST):
            try:
                packet = os.read(fd, _READ_BYTES)
                carried = carries(packet)
            except BlockingIOError:
                port.backlog = 0
                return
            except (OSError, IndexError):
                # The robot's namespace is gone, and its device with it; a socket then gives no byte.
                self._epoll.unregister(fd)
                return
            port.read += 1
            if not carried:
                port.not_ipv4 += 1
                continue
            destination = destination_of(packet, routes)
            if destination == NOBODY:
                port.unroutable += 1
                continue
            if asked_for and (inner := framing.ipv4(packet)) is not None:
                flows.see_leave(inner)
            now_ns = clock_ns()
            send(now_ns, name, packet, len(packet) - header_bytes, destination, before=waited + now_ns)
        port.backlog -= _BURST

    def _hand_over(self) -> None:
        """Write to the robots what has arrived, and set the timer for what arrives next."""
        now_ns = time.monotonic_ns()
        arrived = self._model.deliveries(now_ns)
        if arrived:
            ports, write, clock_ns, late = self._ports, os.write, time.monotonic_ns, self._late
            flows, asked_for = self._flows, self._flows.counted
            for at_ns, name, packet, source, delayed in arrived:
                port = ports[name]
                try:
                    write(port.fd, packet)
                except OSError:
                    # The interface is down, or gone with its robot.
                    port.refused += 1
                    continue
                late_ns = clock_ns() - at_ns
                port.delays[source] += delayed + late_ns
                if asked_for and (inner := self._framing.ipv4(packet)) is not None:
                    flows.count(inner, delayed + late_ns, port.address.packed)
                late[rounded_up(late_ns + processing_ns(delayed))] += 1
        next_ns = self._model.next_event_ns()
        if next_ns is not None and next_ns != self._armed_ns:
            self._timer.set(next_ns)
            self._armed_ns = next_ns

    def _serve(self) -> bool:
        """Answer one request; return whether the owner is still there."""
        deadline = Deadline.after(_OWNER_TIMEOUT_S)
        received = ipc.receive(self._channel, deadline)
        if received is None:
            return False
        request, descriptors = received
        try:
            reply = self._answer(request, descriptors)
        except (KeyError, TypeError, ValueError) as error:
            reply = {"error": f"{type(error).__name__}: {error}"}
        ipc.send(self._channel, reply, deadline)
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
                self._on = self._on_the_air()
                self._place()
                return {}
            case "record":
                self._record(descriptors)
                return {}
            case "links":
                return self._links(go_on=request["go_on"])
            case "delays" | "stats" as what:
                return self._delays(request) if what == "delays" else pack_stats(self._stats())
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

    def _on_the_air(self) -> set[str]:
        """Return the robots whose interface is up; what takes it down (`ip link`, a lost battery) tells nobody."""
        self._looked_ns = time.monotonic_ns()
        return {self._by_fd[fd].name for fd, events in self._writable.poll(0) if events & select.EPOLLOUT}

    def _look(self) -> None:
        """Take off the air whose interface has gone down, and back on it whose is up again."""
        on = self._on_the_air()
        if on != self._on and self._layout.positions_m:
            self._on = on
            self._place()

    def _place(self) -> None:
        """Let those on the air stand where they were placed; stations whose access point is off it hear nobody."""
        positions_m = {name: at for name, at in self._layout.positions_m.items() if name in self._on}
        relay = self._layout.relay
        if relay is not None and relay not in positions_m:
            positions_m, relay = {}, None
        if len(self._ports) != self._placed:
            # Who joins later finds a new model; what was on the air of the old one is lost.
            self._placed = len(self._ports)
            self._model = self._new_model()
            self._model.use_meter()
            self._model.log_attempts(None if self._air_log is None else self._air_log.write)
        self._model.place(time.monotonic_ns(), positions_m, relay, self._layout.velocities_m_s)
        if (positions_m.keys(), len(self._ports)) != self._routed:
            self._route(positions_m.keys())

    def _route(self, present: Set[str]) -> None:
        """Let each of those present have a way to each other one, and nobody else."""
        self._routed = frozenset(present), len(self._ports)
        for port in self._ports.values():
            here = port.name in present
            others = [name for name in present if name != port.name] if here else []
            port.routes = self._framing.routes(port.address, {name: self._ports[name].address for name in others})

    def _new_model(self) -> RadioModel[bytes]:
        if self._options.fixed:
            return UniformLinks(self._seed, self._options)
        return WifiInWorld(self._seed, self._options, self._antennas, self._world)

    def _record(self, descriptors: list[int]) -> None:
        """Write what goes over the air to a new pair of files, or to none."""
        if self._air_log is not None:
            self._air_log.close()
        self._air_log = AirLog(descriptors, tuple(self._ports), framing=self._framing) if descriptors else None
        self._model.log_attempts(None if self._air_log is None else self._air_log.write)

    def _sample(self) -> None:
        """Note what the radios tell of their links; what arrives meanwhile is handed over in the next round."""
        now_ns = time.monotonic_ns()
        self._sample_ns = now_ns + _SAMPLE_NS
        self._sampled.append(self._model.sample(now_ns, time.time_ns()))

    def _links(self, *, go_on: bool) -> Message:
        """Return what was noted of links since this was asked last, and of now."""
        self._sample()
        reply = pack_links(self._sampled)
        self._sampled.clear()
        if not go_on:
            self._sample_ns = None
        return reply

    def _delays(self, request: Message) -> Message:
        """Return what the packets of one flow were delayed by."""
        source, destination = (self._ports[request[end]].address.ip for end in ("source", "destination"))
        return vars(self._flows.told(source, destination, request["protocol"], request["port"]))

    def _stats(self) -> MediumStats:
        ports = {name: port.counters for name, port in self._ports.items()}
        delays = {
            (source, name): parts
            for name, port in self._ports.items()
            for source, parts in port.delay_parts().items()
        }
        return MediumStats(self._scheduling, self._late, self._model.counters(), ports, delays)


def _raise_priority() -> str:
    """Ask for the lowest real-time priority, so that a busy machine delays no packet; return what came of it.

    A medium that fills its core is paused by the kernel for 50 ms a second (sched_rt_runtime_us); the lateness tells.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError as error:
        return f"normal, because real-time was refused: {error.strerror}"
    return "fifo 1"


def main() -> None:
    """Run the medium on the socket, with the seed and the framing named on the command line."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    medium = Medium(int(sys.argv[2]), FRAMINGS[sys.argv[3]], channel)
    # Carrying packets makes no reference cycles, and a collection in the middle would delay them.
    gc.disable()
    medium.run()


if __name__ == "__main__":
    main()
