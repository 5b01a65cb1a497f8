"""The section of a scenario file that names a trial of robots, which the scenario reproduces for a comparison."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Annotated, NamedTuple

from fieldkit.config import schema
from fieldkit.config.schema import Duration, Field, Location, Strict
from fieldkit.core.errors import did_you_mean
from fieldkit.core.model import Protocol
from sim_backends.cosim.scenario.agent_plans import FileTraffic, Name, PingTraffic, Traffic


class ReproducedFlows(Strict):
    """The traffic that reproduces the steps of a procedure under one protocol.

    Attributes:
        transfer: Name of the traffic of kind `file` that reproduces the transfer.
        ping: Name of the traffic of kind `ping` that reproduces the ping.
    """

    transfer: Name
    ping: Name


class ReproducedTrial(Strict):
    """The trial of robots that a scenario reproduces.

    A run with `--out` has a row for each protocol, with the columns of this trial, measured from captures as in a
    trial of robots. These settings of the traffic must agree with the procedure: the port of the transfer, and the
    number, interval and size of the echo requests. The scenario determines topology, line, robots and distance.

    Attributes:
        procedure: Name of the procedure.
        record: Duration of every recording, as with `--record` of `fieldkit trial`; if omitted, the duration that the
            procedure states.
        tcp: The traffic under TCP; if omitted, there are no rows for TCP.
        udp: The traffic under UDP; if omitted, there are no rows for UDP.
    """

    procedure: str
    record: Annotated[Duration | None, Field(gt=0)] = None
    tcp: ReproducedFlows | None = None
    udp: ReproducedFlows | None = None

    @schema.model_validator(mode="after")
    def _has_a_protocol(self) -> "ReproducedTrial":
        if not self.flows:
            raise schema.validation_error(
                "name the traffic of at least one protocol: udp: {transfer: ..., ping: ...}"
            )
        return self

    @property
    def flows(self) -> dict[Protocol, ReproducedFlows]:
        """The traffic by protocol."""
        flows = {Protocol.TCP: self.tcp, Protocol.UDP: self.udp}
        return {protocol: selected_flows for protocol, selected_flows in flows.items() if selected_flows is not None}

    def problems(self, traffic: Sequence[Traffic]) -> Iterator[tuple[str, Location]]:
        """Yield the first contradiction between this section and the traffic, if any, with the keys of its value."""
        by_name = {entry.title: entry for entry in traffic}
        ends: set[tuple[str, ...]] = set()
        for protocol, flows in self.flows.items():
            selected_flows = {
                "transfer": (flows.transfer, "file", protocol.value),
                "ping": (flows.ping, "ping", "udp"),
            }
            for key, (name, kind, transport) in selected_flows.items():
                entry = by_name.get(name)
                if entry is None:
                    hint = did_you_mean(name, by_name, f"traffic: {', '.join(by_name)}")
                    yield f"there is no traffic {name!r}; {hint}", (protocol.value, key)
                    return
                ends.add((entry.source, *entry.to))
                if (entry.kind, entry.protocol) != (kind, transport) or len(entry.to) > 1 or len(ends) > 1:
                    yield (
                        f"{name} is not traffic of kind {kind} with protocol {transport} between the same two agents",
                        (protocol.value, key),
                    )
                    return
        # For each protocol, the start of its first and of its last traffic.
        spans = [
            sorted(by_name[name].start for name in (flows.transfer, flows.ping)) for flows in self.flows.values()
        ]
        spans.sort()
        if any(earlier[-1] >= later[0] for earlier, later in pairwise(spans)):
            yield "the traffic of one protocol starts before all traffic of the other protocol has started", ()

    def repeats(self, traffic: Sequence[Traffic], duration_ns: int) -> tuple["ReproducedRepeat", ...]:
        """Return the part of a run for each protocol: first TCP, then UDP, even if UDP runs first.

        Args:
            traffic: The traffic of the scenario.
            duration_ns: Duration of the scenario.
        """
        by_name = {entry.title: entry for entry in traffic}
        selected_flows = [
            (protocol, by_name[flows.transfer], by_name[flows.ping]) for protocol, flows in self.flows.items()
        ]
        begins_ns = [round(min(transfer.start, ping.start) * 1e9) for _, transfer, ping in selected_flows]
        ends_ns = [min((later for later in begins_ns if later > begin), default=duration_ns) for begin in begins_ns]
        return tuple(
            ReproducedRepeat(protocol, transfer, ping, begin_ns, end_ns)
            for (protocol, transfer, ping), begin_ns, end_ns in zip(selected_flows, begins_ns, ends_ns, strict=True)
            if isinstance(transfer, FileTraffic) and isinstance(ping, PingTraffic)  # guaranteed by `problems`
        )


class ReproducedRepeat(NamedTuple):
    """The part of a run that reproduces the repeat of one protocol.

    Attributes:
        protocol: The protocol.
        transfer: The traffic that is the transfer.
        ping: The traffic that is the ping.
        begin_ns: Simulated time at which the first of them starts.
        end_ns: Simulated time at which the next repeat starts or the run ends.
    """

    protocol: Protocol
    transfer: FileTraffic
    ping: PingTraffic
    begin_ns: int
    end_ns: int
