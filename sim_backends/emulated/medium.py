"""The medium: one process that carries every packet between the robots' TUN devices through the radio engine.

Run by `medium_client` as `python -m sim_backends.emulated.medium FD SEED`, FD being one end of a socket pair. It
ends by itself when the other end closes, and with it all TUN devices end: their descriptors are held here.
"""

import gc
import os
import select
import socket
import sys
import time
from ipaddress import IPv4Interface
from typing import Final

from fieldkit.deadline import Deadline
from sim_backends.emulated import medium_wire, wire
from sim_backends.emulated.medium_wire import MediumStats, PortCounters
from sim_backends.emulated.timerfd import Timer
from sim_backends.emulated.wire import Message
from sim_backends.radio.engine import Engine
from sim_backends.radio.parameters import LinkParameters, Pair

# Packets read from one robot before the others and the timer get their turn: 64 take about half a millisecond.
_BURST: Final = 64
# Longer than any packet of an interface with the MTU 1500 of Wi-Fi; each read allocates this much.
_READ_BYTES: Final = 2048
_OWNER_TIMEOUT_S: Final = 5.0
_NOBODY: Final = ""
_EVERYONE: Final = b"\xff\xff\xff\xff"


class Port:
    """One robot's TUN device, its counters, and where its packets go.

    Args:
        name: The robot.
        address: Its address.
        fd: The device.
    """

    def __init__(self, name: str, address: IPv4Interface, fd: int) -> None:
        self.name = name
        self.address = address
        self.fd = fd
        self.read = 0
        self.written = 0
        self.refused = 0
        self.unroutable = 0
        self.not_ipv4 = 0
        # Destination address -> robot, None for everyone; empty while the robot has no place.
        self.routes: dict[bytes, str | None] = {}

    @property
    def counters(self) -> PortCounters:
        """What crossed the device so far."""
        return PortCounters(self.read, self.written, self.refused, self.unroutable, self.not_ipv4)


class Medium:
    """Moves packets between ports; time is `time.monotonic_ns`.

    Args:
        seed: Seed of the radio engine.
        channel: Where the owner's requests come from.
    """

    def __init__(self, seed: int, channel: socket.socket) -> None:
        self._channel = channel
        self._engine: Engine[bytes] = Engine(seed)
        self._ports: dict[str, Port] = {}
        self._by_fd: dict[int, Port] = {}
        self._late_max_ns = 0
        self._armed_ns: int | None = None
        self._scheduling = _raise_priority()
        self._timer = Timer()
        self._epoll = select.epoll()
        self._epoll.register(self._timer.fd, select.EPOLLIN | select.EPOLLET)
        self._epoll.register(channel.fileno(), select.EPOLLIN)

    def run(self) -> None:
        """Carry packets and answer requests until the owner is gone."""
        by_fd = self._by_fd
        control = self._channel.fileno()
        while True:
            for fd, _ in self._epoll.poll():
                if fd in by_fd:
                    self._read(by_fd[fd])
                elif fd == control and not self._serve():
                    return
            self._hand_over()

    def _read(self, port: Port) -> None:
        """Give the packets that wait at `port` to the engine."""
        fd, name, routes, send, clock_ns = port.fd, port.name, port.routes, self._engine.send, time.monotonic_ns
        for _ in range(_BURST):
            try:
                packet = os.read(fd, _READ_BYTES)
            except BlockingIOError:
                return
            except OSError:
                # The robot's namespace is gone, and its device with it.
                self._epoll.unregister(fd)
                return
            port.read += 1
            if packet[0] >> 4 != 4:
                port.not_ipv4 += 1
                continue
            address = packet[16:20]
            destination = routes.get(address, _NOBODY)
            if destination == _NOBODY:
                if address[0] >> 4 != 0xE or not routes:
                    port.unroutable += 1
                    continue
                destination = None
            send(clock_ns(), name, packet, len(packet), destination)

    def _hand_over(self) -> None:
        """Write to the robots what has arrived, and set the timer for what arrives next."""
        now_ns = time.monotonic_ns()
        arrived = self._engine.deliveries(now_ns)
        if arrived:
            ports, write = self._ports, os.write
            # Arrivals are in order, so the first one waited longest.
            self._late_max_ns = max(self._late_max_ns, now_ns - arrived[0][0])
            for _, name, packet in arrived:
                port = ports[name]
                try:
                    write(port.fd, packet)
                    port.written += 1
                except OSError:
                    # The interface is down, or gone with its robot.
                    port.refused += 1
        next_ns = self._engine.next_event_ns()
        if next_ns is not None and next_ns != self._armed_ns:
            self._timer.set(next_ns)
            self._armed_ns = next_ns

    def _serve(self) -> bool:
        """Answer one request; return whether the owner is still there."""
        deadline = Deadline.after(_OWNER_TIMEOUT_S)
        received = wire.receive(self._channel, deadline)
        if received is None:
            return False
        request, descriptors = received
        try:
            reply = self._answer(request, descriptors)
        except (KeyError, TypeError, ValueError) as error:
            reply = {"error": f"{type(error).__name__}: {error}"}
        wire.send(self._channel, reply, deadline)
        return True

    def _answer(self, request: Message, descriptors: list[int]) -> Message:
        match request["do"]:
            case "attach":
                (fd,) = descriptors
                self._attach(request["name"], IPv4Interface(request["address"]), fd)
                return {}
            case "connect":
                self._connect(medium_wire.unpack_links(request["links"]), request["relay"])
                return {}
            case "stats":
                return medium_wire.pack_stats(self._stats())
            case other:
                raise ValueError(f"unknown request {other!r}")

    def _attach(self, name: str, address: IPv4Interface, fd: int) -> None:
        if name in self._ports or address.ip in {port.address.ip for port in self._ports.values()}:
            os.close(fd)
            raise ValueError(f"{name} or {address.ip} is attached already")
        os.set_blocking(fd, False)
        self._ports[name] = self._by_fd[fd] = Port(name, address, fd)
        self._epoll.register(fd, select.EPOLLIN)

    def _connect(self, links: dict[Pair, LinkParameters], relay: str | None) -> None:
        self._engine.connect(links, relay)
        for port in self._ports.values():
            port.routes = {self._ports[to].address.packed: to for sender, to in links if sender == port.name}
            if port.routes:
                port.routes[_EVERYONE] = port.routes[port.address.network.broadcast_address.packed] = None

    def _stats(self) -> MediumStats:
        ports = {name: port.counters for name, port in self._ports.items()}
        return MediumStats(self._scheduling, self._late_max_ns, self._engine.counters(), ports)


def _raise_priority() -> str:
    """Ask for the lowest real-time priority, so that a busy machine delays no packet; return what came of it.

    A medium that fills its core is paused by the kernel for 50 ms a second (sched_rt_runtime_us); late_max_ns tells.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except OSError as error:
        return f"normal, because real-time was refused: {error.strerror}"
    return "fifo 1"


def main() -> None:
    """Run the medium on the socket and seed named on the command line."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    medium = Medium(int(sys.argv[2]), channel)
    # Carrying packets makes no reference cycles, and a collection in the middle would delay them.
    gc.disable()
    medium.run()


if __name__ == "__main__":
    main()
