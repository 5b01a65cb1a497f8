"""Rows of trial.csv for a scenario that reproduces a trial of robots: one row per protocol, as in that trial."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from fieldkit.core.columns import Value
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Distance, Protocol, RepeatId, Role, Status, Topology
from fieldkit.core.units import plain_number
from fieldkit.trial.simulated import PlannedExchange, SimulatedRepeat, SimulatedRobot, SimulatedTrial
from sim_backends.cosim.commands.flow_rows import BACKEND, motion_columns
from sim_backends.cosim.commands.results import FlowResult, FlowRoundTrips, SeedResult
from sim_backends.cosim.programs.senders import REPLY
from sim_backends.cosim.recording.captures import assign_addresses, first_tcp_packet_ns, packets_between
from sim_backends.cosim.recording.recorder import CAPTURES
from sim_backends.cosim.scenario.agent_setup import make_bodies
from sim_backends.cosim.scenario.external import writes_captures
from sim_backends.cosim.scenario.reproduced_trial import ReproducedRepeat, ReproducedTrial
from sim_backends.cosim.scenario.schema import CosimScenario
from sim_backends.world.world import load_world

_TTL: Final = 64
"""Time to live of packets, as in captures."""
_ICMP_HEADER_BYTES: Final = 8
_IP_HEADER_BYTES: Final = 20


class ReproducedRows:
    """Generates the rows of the trial that a scenario reproduces.

    Args:
        scenario: The scenario.
        trial: The section of the scenario that describes the trial.
        policy: The sync policy, as text.

    Attributes:
        flows: Names of the flows whose packets the rows include.

    Raises:
        ConfigurationError: The scenario does not agree with the procedure.
    """

    def __init__(self, scenario: CosimScenario, trial: ReproducedTrial, policy: str) -> None:
        self._scenario = scenario
        self._policy = policy
        self._has_captures = scenario.network.federate is None or writes_captures(scenario)
        self._repeats = trial.repeats(scenario.traffic, scenario.duration_ns)
        first_repeat = self._repeats[0]
        self._agents = {Role.SENDER: first_repeat.transfer.source, Role.RECEIVER: first_repeat.transfer.to[0]}
        if scenario.topology is Topology.MASTER and scenario.relay is not None:
            self._agents[Role.RELAY] = scenario.relay
        self._addresses = {name: str(address) for name, address in assign_addresses(sorted(scenario.agents)).items()}
        self._trial = SimulatedTrial(
            trial.procedure,
            robots={
                role: SimulatedRobot(name, scenario.agents[name].robot, self._addresses[name])
                for role, name in self._agents.items()
            },
            topology=scenario.topology,
            distance=self._distance(),
            record_s=trial.record,
            backend=BACKEND,
            seed=0,  # each row has its own seed
        )
        self._check(trial)
        self.flows = frozenset(name for repeat in self._repeats for name in _flow_names(repeat))

    def _distance(self) -> Distance:
        """Return the horizontal distance from the sender to the relay, or to the receiver if there is no relay."""
        starts = make_bodies(self._scenario, load_world(self._scenario.world))
        peer = self._agents.get(Role.RELAY, self._agents[Role.RECEIVER])
        points_m = [starts[name].place_m[:2] for name in (self._agents[Role.SENDER], peer)]
        metres = round(math.dist(*points_m), 3)
        return Distance(metres, f"{plain_number(metres, 6)}m")

    def _check(self, trial: ReproducedTrial) -> None:
        """Check that the line of sight and the traffic of the scenario agree with the procedure.

        Raises:
            ConfigurationError: The scenario and the procedure differ.
        """
        procedure = trial.procedure
        remedy = "change the scenario, or remove `trial` from it"
        if self._trial.scenario != self._scenario.line:
            raise ConfigurationError(
                f"the procedure {procedure} is for {self._trial.scenario}, but the line of the scenario is "
                f"{self._scenario.line}",
                where=f"scenario {self._scenario.name}: trial.procedure",
                remedy=remedy,
            )
        for repeat in self._repeats:
            for setting_name, planned, simulated in _compared_settings(self._trial.exchange(repeat.protocol), repeat):
                if planned != simulated:
                    raise ConfigurationError(
                        f"{setting_name} is {simulated}, but {planned} in the procedure {procedure}",
                        where=f"scenario {self._scenario.name}: trial.{repeat.protocol}",
                        remedy=remedy,
                    )

    def rows(self, trial: str, number: int, result: SeedResult, recording: Path) -> Iterator[Mapping[str, Value]]:
        """Yield a row for each protocol whose transfer has sent a packet.

        Args:
            trial: Name of the folder of all runs.
            number: Number of the run, from 1.
            result: The result of the run.
            recording: The folder of its recording.
        """
        flows = {flow.name: flow for flow in result.flows}
        identity: dict[str, Value] = {
            "trial": trial,
            "procedure": f"{self._trial.procedure} ({self._scenario.name}, {self._policy})",
            "seed": result.seed,
        }
        for repeat in self._repeats:
            transfer_name, ping_name, _ = _flow_names(repeat)
            if (transfer := flows.get(transfer_name)) is None:
                continue
            ping = flows.get(ping_name)
            reason = result.stop_reason or (
                "the run ended before the transfer was complete" if transfer.packets_under_way else ""
            )
            captures = self._captures(repeat, recording)
            values = self._values(repeat, transfer, ping)
            if repeat.protocol is Protocol.TCP and not reason and Role.RECEIVER in captures:
                values |= _tcp_completion(captures[Role.RECEIVER], repeat, transfer)
            simulated = SimulatedRepeat(
                repeat=RepeatId(repeat.protocol, number),
                status=Status.FAILED if reason else Status.VALID,
                reason=reason,
                captures=captures,
                ping="" if ping is None or ping.round_trips is None else self._ping_text(repeat, ping.round_trips),
                values=values,
            )
            yield self._trial.row(simulated, identity)

    def _captures(self, repeat: ReproducedRepeat, recording: Path) -> dict[Role, bytes]:
        """Return the capture of each end for which the network wrote one, with the packets of the repeat only."""
        if not self._has_captures:
            return {}
        paths = {role: recording / CAPTURES / f"{self._agents[role]}.pcap" for role in (Role.SENDER, Role.RECEIVER)}
        return {
            role: packets_between(path.read_bytes(), repeat.begin_ns, repeat.end_ns)
            for role, path in paths.items()
            if path.exists()
        }

    def _ping_text(self, repeat: ReproducedRepeat, trips: FlowRoundTrips) -> str:
        """Return the round trips of a ping as output of iputils `ping -n -D`."""
        address, payload_bytes = self._addresses[repeat.ping.to[0]], repeat.ping.size_bytes
        icmp_bytes = payload_bytes + _ICMP_HEADER_BYTES
        lines = [f"PING {address} ({address}) {payload_bytes}({icmp_bytes + _IP_HEADER_BYTES}) bytes of data."]
        for sequence, at_ns, trip_s in trips.times:
            seconds, microseconds = divmod(at_ns // 1000, 10**6)
            lines.append(
                f"[{seconds}.{microseconds:06}] {icmp_bytes} bytes from {address}: icmp_seq={sequence + 1} "
                f"ttl={_TTL} time={1e3 * trip_s:.6f} ms"
            )
        loss = 1 - trips.reply_count / trips.request_count if trips.request_count else 0.0
        summary = (
            f"{trips.request_count} packets transmitted, {trips.reply_count} received, "
            f"{100 * loss:g}% packet loss, time 0ms"
        )
        return "\n".join((*lines, "", f"--- {address} ping statistics ---", summary, ""))

    def _values(self, repeat: ReproducedRepeat, transfer: FlowResult, ping: FlowResult | None) -> dict[str, Value]:
        """Return the columns whose values come from the simulation itself, not from its captures."""
        sent_bytes = repeat.transfer.size_bytes
        values: dict[str, Value] = {
            "sent_bytes": sent_bytes,
            "received_bytes": transfer.arrived_bytes,
            "file_loss": 1 - transfer.arrived_bytes / sent_bytes,
            **motion_columns("transfer", transfer),
        }
        if ping is not None:
            values |= motion_columns("rtt", ping)
        if repeat.protocol is Protocol.TCP and self._has_captures:
            values["tcp_congestion_control"] = self._scenario.tcp.congestion
        if repeat.protocol is Protocol.UDP:
            values |= {
                "datagrams_sent": transfer.sent_packets,
                "datagrams_received": transfer.arrived_packets,
                "datagram_loss": transfer.loss,
            }
        return values


def _tcp_completion(capture: bytes, repeat: ReproducedRepeat, transfer: FlowResult) -> dict[str, Value]:
    """Return the time from the arrival of the first segment until the program has received the complete file.

    The result is empty if the capture has no such segment, or the file is not complete.
    """
    first_ns = None if repeat.transfer.port is None else first_tcp_packet_ns(capture, repeat.transfer.port)
    if first_ns is None or transfer.last_arrived_ns is None or transfer.arrived_bytes < repeat.transfer.size_bytes:
        return {}
    return {"completion_s": (transfer.last_arrived_ns - first_ns) / 1e9}


def _flow_names(repeat: ReproducedRepeat) -> tuple[str, str, str]:
    """Return the names of the flows of the transfer, of the echo requests and of the replies."""
    (transfer,), (ping,) = repeat.transfer.flows, repeat.ping.flows
    return transfer, ping, ping + REPLY


def _compared_settings(
    planned: PlannedExchange, repeat: ReproducedRepeat
) -> Iterator[tuple[str, float | None, float | None]]:
    """Yield each setting of a repeat, with its value in the procedure and in the scenario."""
    yield "the port of the transfer", planned.port, repeat.transfer.port
    yield "the number of echo requests", planned.requests, repeat.ping.count
    yield "the interval of echo requests in seconds", planned.interval_s, repeat.ping.interval
    yield "the payload of an echo request in bytes", planned.payload_bytes, repeat.ping.size_bytes
