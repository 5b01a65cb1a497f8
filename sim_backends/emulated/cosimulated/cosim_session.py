"""A session of a lab on the co-simulation: one run of the coordinator, which advances physics and network."""

import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import permutations
from typing import Any, Protocol

from fieldkit.core.model import LinkSample
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.registry import make_policy
from sim_backends.cosim.run_record import Fate, WindowObserver
from sim_backends.emulated.cosimulated.clock import RealTime
from sim_backends.emulated.cosimulated.lab_physics import LabPhysics
from sim_backends.emulated.cosimulated.real_agents import Devices, RealAgents
from sim_backends.emulated.cosimulated.simulators import (
    BUILTIN,
    BuiltinNetwork,
    LabSettings,
    builtin_network,
    start_network,
    start_physics,
)
from sim_backends.emulated.cosimulated.steering import Steering
from sim_backends.emulated.medium.server import AttemptLog
from sim_backends.federates.protocols import FederateError, NetworkFederate
from sim_backends.federates.records import ArrivalDelay
from sim_backends.federates.remote import RemoteNetwork
from sim_backends.network.bare_ip import BROADCAST, broadcast_flow
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Arrival, Packet
from sim_backends.radio.core.links import PACKET, PROCESSING_NS, PROPAGATION_NS, QUEUING_NS, TRANSMISSION_NS, Delay
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.mac.frames import TransmissionAttempt


class CosimMedium(Devices, WindowObserver, Protocol):
    """The interface of the process that a session uses."""


class CosimSession:
    """One run of the coordinator.

    Args:
        medium: The devices of its agents, and its observer.
        settings: Simulators and their settings.
        steerings: Steering of each robot that programs can drive.
        policy: Name and parameters of the sync policy.
        clock: Converts between simulated time and the monotonic clock.

    Attributes:
        settings: Simulators and their settings.
        stations: Names of all stations.
        physics: The physics simulator, with the robots that the lab has placed.
        network: The network.
        builtin: The built-in network with its radio; None with another network.
        agents: The agents, whose packets come from real programs.
        coordinator: Advances physics and network.

    Raises:
        ConfigurationError: A simulator cannot be used with these settings.
        FederateError: A simulator failed, or has not answered in time.
    """

    def __init__(
        self,
        medium: "CosimMedium",
        settings: LabSettings,
        steerings: Mapping[str, Steering],
        policy: Mapping[str, Any],
        clock: RealTime,
    ) -> None:
        self.settings = settings
        self._clock = clock
        self.stations = tuple(settings.antennas)
        self.physics = LabPhysics(
            lambda states: start_physics(settings, states),
            steerings,
            tuple(settings.bodies),
            self.stations,
            step_ns=settings.simulators.step_ns,
            clock=clock,
        )
        self.builtin: BuiltinNetwork | None = None
        # Delays that the network has reported: by receiver and packet (built-in network), or by packet number.
        self._delays: dict[tuple[str, PacketIdentity], Delay] = {}
        self._arrival_delays: dict[int, ArrivalDelay] = {}
        if settings.simulators.network == BUILTIN:
            self.builtin = builtin_network(settings)
            self.builtin.federate.log_delays(self._log_delay)
            self.network: NetworkFederate = self.builtin.federate
        else:
            remote = start_network(settings, self.physics.states)
            remote.log_arrival_delays(self._log_arrival_delay)
            self.network = remote
        self.agents = RealAgents(self.physics, medium)
        self.coordinator = Coordinator(
            self.agents, self.network, make_policy(**policy), [*permutations(self.stations, 2)], observer=medium
        )

    def close(self) -> None:
        """Stop the simulators."""
        self.physics.close()
        if close := getattr(self.network, "close", None):
            close()

    def remove_packet(self, packet: Packet) -> None:
        """Remove a packet that was delivered or lost from the record of the coordinator."""
        del self.coordinator.run.fates[packet.identity]
        self._arrival_delays.pop(packet.packet_id, None)

    def network_delay(self, fate: Fate) -> tuple[Delay, int]:
        """Return the parts of a packet's delay in the network, and the rest in ns, whose parts are unknown.

        It is called at most once per packet, because the stored parts are deleted.

        Args:
            fate: The record of the packet's arrival.

        Raises:
            FederateError: The parts exceed the delay.
        """
        packet = fate.packet
        assert fate.arrived_ns is not None
        delay_ns = fate.arrived_ns - packet.enters_ns
        if (parts := self._arrival_delays.get(packet.packet_id)) is not None:
            return _delay_of_parts(packet, delay_ns, parts), 0
        identity = packet.identity
        # A broadcast is one transmission of the network, although the coordinator has a packet for each receiver.
        if packet.protocol == BROADCAST:
            identity = broadcast_flow(packet.source), identity[1]
        delay = self._delays.pop((packet.destination, identity), None)
        if delay is not None:
            return delay, 0
        return PACKET, delay_ns

    def log_attempts(self, log: AttemptLog | None) -> None:
        """Pass every transmission attempt to `log`, in real time, with the content of its packet; None stops it."""
        assert self.builtin is not None
        self.builtin.radio.log_attempts(None if log is None else partial(self._log_attempt, log))

    def _log_attempt(self, log: AttemptLog, attempt: TransmissionAttempt) -> None:
        content = None if attempt.payload is None else self.agents.content(attempt.payload.identity)
        start_ns, end_ns = self._clock.monotonic_ns(attempt.start_ns), self._clock.monotonic_ns(attempt.end_ns)
        log(replace(attempt, start_ns=start_ns, end_ns=end_ns, payload=content))

    def sample_links(self) -> Mapping[str, LinkSample]:
        """Return a sample of the links of all radios at their current positions; empty if the network has none."""
        if isinstance(self.network, RemoteNetwork):
            return self.network.sample_links()
        assert self.builtin is not None
        federate, radio = self.builtin
        positions_m = {name: state.position_m for name, state in self.physics.states.items()}
        radio.place(federate.now_ns, positions_m, self.settings.relay)
        return radio.sample(federate.now_ns, time.time_ns())

    def _log_delay(self, host: str, fragment: Fragment, delay: Delay) -> None:
        self._delays[host, fragment.identity] = delay

    def _log_arrival_delay(self, arrival: Arrival, parts: ArrivalDelay) -> None:
        self._arrival_delays[arrival.packet_id] = parts


def _delay_of_parts(packet: Packet, delay_ns: int, parts: ArrivalDelay) -> Delay:
    """Return a delay with its parts; time that the network has not attributed to a part counts as processing."""
    processing_ns = delay_ns - sum(parts)
    if processing_ns < 0:
        raise FederateError(
            f"the network reported parts of {sum(parts)} ns for a packet of {packet.source}, whose delay is "
            f"{delay_ns} ns"
        )
    return (
        PACKET
        + processing_ns * PROCESSING_NS
        + parts.transmission_ns * TRANSMISSION_NS
        + parts.propagation_ns * PROPAGATION_NS
        + parts.queuing_ns * QUEUING_NS
    )
