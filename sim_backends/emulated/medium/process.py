"""The medium: one process that carries every packet between the robots' TUN or TAP devices through the radio model.

`medium_client` runs it as `python -m sim_backends.emulated.medium.process FD SEED FRAMING`; FD is one end of a socket
pair. The process exits when the other end closes. The kernel then removes the devices, because only this process
holds their descriptors.
"""

import gc
import os
import socket
import sys
import time
from collections.abc import Mapping
from typing import Final

from typing_extensions import override

from fieldkit.core.model import LinkSample, Vector
from sim_backends.emulated.medium.framing import FRAMINGS, NO_ROBOT, Framing
from sim_backends.emulated.medium.ports import Port, round_up
from sim_backends.emulated.medium.server import (
    BURST,
    DEVICE_PACKETS,
    INTERFACE_POLL_NS,
    READ_BYTES,
    AttemptLog,
    MediumServer,
)
from sim_backends.radio.core.links import PACKET, LinkCounters, Pair, processing_ns
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.models.radio_model import RadioModel, WifiInWorld

# Timeout of a poll. If the process sleeps longer, packets may have waited for the additional time.
_MAX_SLEEP_NS: Final = 10_000_000


class Medium(MediumServer):
    """Moves packets between ports through a radio model. The arguments are those of `MediumServer`."""

    def __init__(self, seed: int, framing: Framing, channel: socket.socket) -> None:
        super().__init__(seed, framing, channel)
        self._model: RadioModel[bytes] = UniformLinks(seed, self._options)
        # Number of ports for which the model was created.
        self._ports_in_model = 0
        # True if a radio has access categories, which depend on the DSCP of packets.
        self._has_priorities = False
        # A device that has packets now was still empty at `_arrived_after_ns`, if the previous round read all
        # packets.
        self._arrived_after_ns = self._previous_poll_ns = time.monotonic_ns()
        # Time to which the timer is set.
        self._timer_ns: int | None = None

    def run(self) -> None:
        """Carry packets and answer requests until the owner closes the socket."""
        by_fd = self._by_fd
        control = self._channel.fileno()
        while True:
            ready = self._wait()
            if time.monotonic_ns() - self._polled_ns > INTERFACE_POLL_NS:
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
        """Wait for packets, requests or the timer; store the earliest time at which the packets can have arrived.

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
            port.backlog, port.backlog_since_ns = DEVICE_PACKETS, self._arrived_after_ns
        flows, requested_flows = self._flows, self._flows.delays_by_flow
        framing, has_priorities = self._framing, self._has_priorities
        carries, destination_of, header_bytes = framing.carries, framing.destination, framing.header_bytes
        # The sum of this value and the time of reading is the `Delay` of one packet that has waited since
        # `backlog_since_ns`: a plain number of ns in a `Delay` is processing delay, and `PACKET` counts one packet.
        delay_offset = PACKET - port.backlog_since_ns
        for _ in range(BURST):
            try:
                packet = os.read(fd, READ_BYTES)
                is_carried = carries(packet)
            except BlockingIOError:
                port.backlog = 0
                return
            except (OSError, IndexError):
                # The robot's namespace and its device no longer exist; a socket returns no bytes in this case.
                self._epoll.unregister(fd)
                return
            port.sent_packets += 1
            if not is_carried:
                port.other_packets += 1
                continue
            destination = destination_of(packet, routes)
            if destination == NO_ROBOT:
                port.unroutable_packets += 1
                continue
            if requested_flows and (ip_packet := framing.ipv4(packet)) is not None:
                flows.note_first_fragment(ip_packet)
            now_ns = clock_ns()
            delay = delay_offset + now_ns
            if has_priorities and (ip_packet := framing.ipv4(packet)) is not None:
                dscp = ip_packet[1] >> 2
                send(now_ns, name, packet, len(packet) - header_bytes, destination, before=delay, dscp=dscp)
                continue
            send(now_ns, name, packet, len(packet) - header_bytes, destination, before=delay)
        port.backlog -= BURST

    def _deliver(self) -> None:
        """Write arrived packets to the robots, and set the timer to the next event of the model."""
        now_ns = time.monotonic_ns()
        deliveries = self._model.deliveries(now_ns)
        if deliveries:
            ports, write, clock_ns = self._ports, os.write, time.monotonic_ns
            lateness_counts = self._packet_lateness_counts
            flows, requested_flows = self._flows, self._flows.delays_by_flow
            for at_ns, name, packet, source, delay in deliveries:
                port = ports[name]
                try:
                    write(port.fd, packet)
                except OSError:
                    # The interface is down, or the robot has stopped.
                    port.refused_packets += 1
                    continue
                late_ns = clock_ns() - at_ns
                port.delays[source] += delay + late_ns
                if requested_flows and (ip_packet := self._framing.ipv4(packet)) is not None:
                    flows.count(ip_packet, delay + late_ns, port.address.packed)
                lateness_counts[round_up(late_ns + processing_ns(delay))] += 1
        next_ns = self._model.next_event_ns()
        if next_ns is not None and next_ns != self._timer_ns:
            self._timer.set(next_ns)
            self._timer_ns = next_ns

    @override
    def _place_stations(self, positions_m: dict[str, Vector], relay: str | None) -> None:
        if len(self._ports) != self._ports_in_model:
            # A robot that is attached later needs a new model; packets on the air of the old model are lost.
            self._ports_in_model = len(self._ports)
            self._model = self._new_model()
            self._has_priorities = any(
                antenna.phy is not None and antenna.phy.access_categories for antenna in self._antennas.values()
            )
            self._model.use_meter()
            self._model.log_attempts(None if self._air_log is None else self._air_log.write)
        layout = self._layout
        self._model.place(time.monotonic_ns(), positions_m, relay, layout.velocities_m_s, layout.attitudes)

    def _new_model(self) -> RadioModel[bytes]:
        if self._options.is_fixed:
            return UniformLinks(self._seed, self._options)
        return WifiInWorld(self._seed, self._options, self._antennas, self._world)

    @override
    def _log_attempts(self, log: AttemptLog | None) -> None:
        self._model.log_attempts(log)

    @override
    def _sample_links(self, now_ns: int) -> Mapping[str, LinkSample]:
        return self._model.sample(now_ns, time.time_ns())

    @override
    def _link_counters(self) -> dict[Pair, LinkCounters]:
        return self._model.counters()


def main() -> None:
    """Run the medium; the command line has the descriptor of the socket, the seed and the framing."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    medium = Medium(int(sys.argv[2]), FRAMINGS[sys.argv[3]], channel)
    # Carrying packets makes no reference cycles, and a garbage collection would delay packets.
    gc.disable()
    medium.run()


if __name__ == "__main__":
    main()
