"""The process of a co-simulated medium, which runs a network for packets and a physics simulator for robots.

`client` runs it as `python -m sim_backends.emulated.cosimulated.cosim_process FD SEED FRAMING`. It answers the same
requests as the process of a radio model, and two more: `simulate`, with simulators and policy, and `body`, with the
body of a robot.

A session is one run of the coordinator, which advances physics and network together, in windows of simulated time.
Its time is 0 when the session starts, and each window lasts until the monotonic clock reaches its end. If the set of
stations or the relay changes, a new session starts, and the packets on the air or in the queue of the old session are
lost.
"""

import gc
import os
import socket
import sys
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from typing_extensions import override

from fieldkit.core.errors import FieldkitError
from fieldkit.core.model import LinkSample, Vector
from sim_backends.cosim.run_record import Fate, Window
from sim_backends.emulated.cosimulated.clock import RealTime
from sim_backends.emulated.cosimulated.cosim_session import CosimSession
from sim_backends.emulated.cosimulated.real_agents import RealPacket
from sim_backends.emulated.cosimulated.simulators import LabSettings, RobotBody, Simulators
from sim_backends.emulated.cosimulated.steering import FlightSteering, GroundSteering, Steering
from sim_backends.emulated.medium.framing import FRAMINGS, NO_ROBOT, Framing
from sim_backends.emulated.medium.medium_stats import MediumStats
from sim_backends.emulated.medium.ports import FlowDelays, Port, round_up
from sim_backends.emulated.medium.server import (
    BURST,
    DEVICE_PACKETS,
    INTERFACE_POLL_NS,
    READ_BYTES,
    AttemptLog,
    MediumServer,
)
from sim_backends.emulated.process.worker import Message
from sim_backends.radio.core.links import PACKET, PROCESSING_NS, TRANSMISSION_NS, LinkCounters, Pair
from sim_backends.world.motion import STILL, State

_MAX_SLEEP_NS: Final = 10_000_000
"""Maximum sleep. If the process wakes up later, packets may have waited for the additional time."""
_END_NS: Final = 1 << 62
"""A simulated time that no session reaches."""
_WINDOWS: Final = 1000
"""Number of windows after which the ends of the windows are deleted from the record of the coordinator, so that the
record does not grow without limit."""
_MAX_LAG_NS: Final = 1_000_000_000
"""A simulation that lags behind real time by more than this does not catch up, so that its later results are usable.
Packets that wait during the lag are delivered late, so their repeat is void."""


class _NewSession(BaseException):
    """Raised to leave the coordinator of a session that another session has replaced."""


class CosimulatedMedium(MediumServer):
    """Moves packets between ports through the coordinator of a co-simulation.

    It implements the coordinator's observer and the devices of its agents. The arguments are those of
    `MediumServer`.
    """

    def __init__(self, seed: int, framing: Framing, channel: socket.socket) -> None:
        super().__init__(seed, framing, channel)
        self._simulators = Simulators("", "")
        self._policy: dict[str, Any] = {}
        self._bodies: dict[str, RobotBody] = {}
        self._steerings: dict[str, Steering] = {}
        self._session: CosimSession | None = None
        self._clock = RealTime()
        # Packets that were read and have not entered the network.
        self._queue: deque[RealPacket] = deque()
        # If the previous poll read all packets, a device that has packets now was still empty at `_arrived_after_ns`.
        self._arrived_after_ns = self._previous_poll_ns = time.monotonic_ns()
        self._window_lateness_counts: Counter[int] = Counter()
        # Delays that the sync policy adds, as processing delay. Their transmission part contains another value: the
        # delay of the network whose parts are unknown (`undivided_ns`).
        self._added_delays = FlowDelays()

    def run(self) -> None:
        """Run one session after another until the owner closes the socket."""
        while True:
            session = self._session
            try:
                if session is None:
                    self._poll(None)
                    self._queue.clear()
                    continue
                session.coordinator.advance(_END_NS, max_windows=_WINDOWS)
                session.coordinator.run.windows_ns.clear()
            except _NewSession:
                continue
            except _Closed:
                break
        if self._session is not None:
            self._session.close()

    # Methods of `Devices`.

    def wait(self, until_ns: int) -> None:
        """Implement `Devices.wait`: read packets and answer requests until a simulated time."""
        session = self._session
        while True:
            self._poll(self._clock.monotonic_ns(until_ns))
            if time.monotonic_ns() - self._polled_ns > INTERFACE_POLL_NS:
                self._update_interfaces()
            if self._session is not session:
                raise _NewSession
            # The answer to a request may have delayed simulated time.
            if self._clock.now_ns() >= until_ns:
                break
        if self._sample_ns is not None and time.monotonic_ns() >= self._sample_ns:
            self._sample()

    def wait_for_packet(self, until_ns: int) -> None:
        """Implement `Devices.wait_for_packet`; the wait also ends at the next event of the network."""
        assert self._session is not None
        event_ns = self._session.network.next_event_ns()
        due_ns = self._clock.monotonic_ns(until_ns if event_ns is None else min(until_ns, event_ns))
        while not self._queue and time.monotonic_ns() < due_ns:
            self._poll(due_ns, answers=False)

    def first_ns(self) -> int | None:
        """Implement `Devices.first_ns`: the time of the first packet in the queue."""
        return self._queue[0].at_ns if self._queue else None

    def pop_packets(self, last_ns: int) -> list[RealPacket]:
        """Implement `Devices.pop_packets`: remove the packets up to a time from the queue, and return them."""
        packets, queue = [], self._queue
        while queue and queue[0].at_ns <= last_ns:
            packets.append(queue.popleft())
        return packets

    def receivers(self, source: str) -> Sequence[str]:
        """Implement `Devices.receivers`: the other robots on the air."""
        robots_on_air, _ = self._routing_state
        return sorted(robots_on_air - {source})

    def _poll(self, due_ns: int | None, *, answers: bool = True) -> None:
        """Wait until a time of the monotonic clock, a packet or a request; read the packets and answer the request.

        The wait also ends after about 10 ms (`_MAX_SLEEP_NS`). If `answers` is False, a request is left for the next
        call. `_arrived_after_ns` is determined as in `sim_backends.emulated.medium.process.Medium._wait`.
        """
        polled_ns = time.monotonic_ns()
        ready = self._epoll.poll(0)
        if ready:
            self._arrived_after_ns, self._previous_poll_ns = self._previous_poll_ns, polled_ns
        elif due_ns is None or polled_ns < due_ns:
            if due_ns is not None:
                self._timer.set(due_ns)
            ready = self._epoll.poll(_MAX_SLEEP_NS / 1e9)
            self._arrived_after_ns = self._previous_poll_ns = min(time.monotonic_ns(), polled_ns + _MAX_SLEEP_NS)
        else:
            self._previous_poll_ns = polled_ns
        for fd, _ in ready:
            if fd in self._by_fd:
                self._read_port(self._by_fd[fd])
            elif answers and fd == self._channel.fileno() and not self._serve():
                raise _Closed

    def _read_port(self, port: Port) -> None:
        """Read the packets that wait at a port, at most `BURST`; the next call reads the others."""
        if port.backlog <= 0:
            port.backlog, port.backlog_since_ns = DEVICE_PACKETS, self._arrived_after_ns
        framing, routes = self._framing, port.routes
        for _ in range(BURST):
            try:
                content = os.read(port.fd, READ_BYTES)
                is_carried = framing.carries(content)
            except BlockingIOError:
                port.backlog = 0
                return
            except (OSError, IndexError):
                # The robot's namespace and its device no longer exist; a socket returns no bytes in this case.
                self._epoll.unregister(port.fd)
                return
            port.sent_packets += 1
            if not is_carried:
                port.other_packets += 1
                continue
            destination = framing.destination(content, routes)
            if destination == NO_ROBOT:
                port.unroutable_packets += 1
                continue
            if self._flows.delays_by_flow and (ip_packet := framing.ipv4(content)) is not None:
                self._flows.note_first_fragment(ip_packet)
                self._added_delays.note_first_fragment(ip_packet)
            now_ns = time.monotonic_ns()
            size_bytes = len(content) - framing.header_bytes
            waited_ns = now_ns - port.backlog_since_ns
            at_ns = self._clock.simulated_ns(now_ns)
            self._queue.append(RealPacket(at_ns, port.name, destination, content, size_bytes, waited_ns))
        port.backlog -= BURST

    # Methods of `WindowObserver`.

    def begin(self, states: Mapping[str, State]) -> None:
        """Implement `WindowObserver.begin`: the medium records no initial states."""

    def window(self, window: Window) -> None:
        """Implement `WindowObserver.window`: write the packets that arrived, and record the lateness."""
        session = self._session
        assert session is not None
        end_ns = self._clock.monotonic_ns(window.end_ns)
        if window.decided_fates:
            delivered_packets = session.agents.delivered_packets
            arrived_fates = [fate for fate in window.decided_fates if fate.arrived_ns is not None]
            for fate, packet in zip(arrived_fates, delivered_packets, strict=True):
                self._write(session, fate, packet, window.end_ns, end_ns)
            delivered_packets.clear()
            for fate in window.decided_fates:
                session.remove_packet(fate.packet)
        lag_ns = time.monotonic_ns() - end_ns
        self._window_lateness_counts[round_up(max(lag_ns, 0))] += 1
        if lag_ns > _MAX_LAG_NS:
            self._skip_lag(lag_ns)

    def _skip_lag(self, lag_ns: int) -> None:
        """Delay simulated time, and the packets that were read and have not entered the network."""
        self._clock.skip_lag(lag_ns)
        now_ns = self._clock.now_ns()
        self._queue = deque(
            packet._replace(at_ns=min(packet.at_ns, now_ns), waited_ns=packet.waited_ns + lag_ns)
            for packet in self._queue
        )

    def _write(
        self, session: CosimSession, fate: Fate, packet: RealPacket, end_ns: int, end_monotonic_ns: int
    ) -> None:
        """Write an arrived packet to its receiver, and count its delays."""
        port = self._ports[fate.packet.destination]
        try:
            os.write(port.fd, packet.content)
        except OSError:
            # The interface is down, or the robot has stopped.
            port.refused_packets += 1
            return
        assert fate.arrived_ns is not None
        late_ns = packet.waited_ns + time.monotonic_ns() - end_monotonic_ns
        delay, undivided_ns = session.network_delay(fate)
        delay += late_ns * PROCESSING_NS
        port.delays[packet.source] += delay + undivided_ns * PROCESSING_NS
        if self._flows.delays_by_flow and (ip_packet := self._framing.ipv4(packet.content)) is not None:
            # From sending until the packet entered the network, and from its arrival until the end of the window.
            added_ns = end_ns - fate.arrived_ns + fate.packet.enters_ns - fate.packet.sent_ns
            self._flows.count(ip_packet, delay, port.address.packed)
            added_delay = PACKET + added_ns * PROCESSING_NS + undivided_ns * TRANSMISSION_NS
            self._added_delays.count(ip_packet, added_delay, port.address.packed)
        self._packet_lateness_counts[round_up(late_ns)] += 1

    # Requests of the lab.

    @override
    def _answer(self, request: Message, descriptors: list[int]) -> Message:
        try:
            match request["do"]:
                case "simulate":
                    self._simulators = Simulators(**request["simulators"])
                    self._policy = request["policy"]
                    return {}
                case "body":
                    self._add_body(request, descriptors)
                    return {}
                case _:
                    return super()._answer(request, descriptors)
        except FieldkitError as error:
            return {"error": error.what, "remedy": error.remedy}

    def _add_body(self, request: Message, descriptors: list[int]) -> None:
        name, body = request["name"], RobotBody.from_json(request["body"])
        self._bodies[name] = body
        if descriptors:
            steering = FlightSteering if body.flies else GroundSteering
            self._steerings[name] = steering(descriptors, time.monotonic_ns())

    @override
    def _delays(self, request: Message) -> Message:
        source, destination = (self._ports[request[key]].address.ip for key in ("source", "destination"))
        flow = source, destination, request["protocol"], request["port"]
        added_delay = self._added_delays.delay_parts(*flow)
        parts = self._flows.delay_parts(*flow)
        return vars(replace(parts, policy_ns=added_delay.processing_ns, undivided_ns=added_delay.transmission_ns))

    @override
    def _stats(self) -> MediumStats:
        return replace(super()._stats(), window_lateness_counts=self._window_lateness_counts)

    @override
    def _place_stations(self, positions_m: dict[str, Vector], relay: str | None) -> None:
        """Place the robots that are on the air; the others are out of range of all stations."""
        start_ns = time.monotonic_ns()
        session, stations = self._session, tuple(self._ports)
        if session is None or session.stations != stations or (positions_m and session.settings.relay != relay):
            if session is not None:
                self._session = None
                session.close()
            self._queue.clear()
            self._clock = RealTime()
            settings = LabSettings(
                self._simulators, self._seed, self._options, self._world, self._antennas, self._bodies, relay
            )
            session = CosimSession(self, settings, self._steerings, self._policy, self._clock)
            if self._air_log is not None and session.builtin is not None:
                session.log_attempts(self._air_log.write)
        velocities_m_s = self._layout.velocities_m_s
        states = {
            name: State(position_m, velocities_m_s.get(name, STILL))
            for name, position_m in self._layout.positions_m.items()
        }
        session.physics.place(states, frozenset(positions_m))
        if self._session is not session:
            # Simulators were started. The lab waits for this, so no measurement is in progress.
            self._session = session
            self._skip_lag(time.monotonic_ns() - start_ns)

    @override
    def _log_attempts(self, log: AttemptLog | None) -> None:
        if self._session is not None and self._session.builtin is not None:
            self._session.log_attempts(log)

    @override
    def _sample_links(self, now_ns: int) -> Mapping[str, LinkSample]:
        return {} if self._session is None else self._session.sample_links()

    @override
    def _link_counters(self) -> dict[Pair, LinkCounters]:
        session = self._session
        return {} if session is None or session.builtin is None else session.builtin.radio.counters()


class _Closed(BaseException):
    """Raised when the owner has closed the socket."""


def main() -> None:
    """Run the process; the command line has the descriptor of the socket, the seed and the framing."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    medium = CosimulatedMedium(int(sys.argv[2]), FRAMINGS[sys.argv[3]], channel)
    # A garbage collection of all objects, which mostly belong to modules, would delay packets.
    gc.freeze()
    try:
        medium.run()
    except FieldkitError as error:
        # The lab shows the last line of the standard error output.
        sys.exit(f"{error.what}; {error.remedy}" if error.remedy else error.what)


if __name__ == "__main__":
    main()
