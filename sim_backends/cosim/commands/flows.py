"""The results of each flow of a run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.model import Vector
from sim_backends.cosim.programs.pings import REPLY
from sim_backends.cosim.run import Fate, Run

Floats = NDArray[np.float64]

_JITTER_GAIN = 1 / 16
"""Gain of the estimator (RFC 3550, section 6.4.1)."""


@dataclass(frozen=True)
class FlowSpread:
    """Statistics of times of packets that arrived, in seconds; nan if none did.

    Attributes:
        least: The minimum.
        mean: The mean.
        median: The median.
        p95: The 95th percentile.
        most: The maximum.
    """

    least: float
    mean: float
    median: float
    p95: float
    most: float


@dataclass(frozen=True)
class FlowRoundTrips:
    """The round trips of a ping; requests that may still get a reply are ignored.

    Attributes:
        sent: Number of requests.
        answered: Number of requests whose reply arrived.
        network_s: Time that request and reply together spent in the network.
        jitter_s: Mean absolute difference of successive round trips; nan if there are fewer than two.
    """

    sent: int
    answered: int
    network_s: FlowSpread
    jitter_s: float


@dataclass(frozen=True)
class FlowResult:
    """The results of a flow. Packets that were under way at the end of the run count only in `under_way`.

    Attributes:
        name: The flow.
        source: The sending agent.
        destination: The receiving agent.
        protocol: Its transport.
        sent: Number of packets whose fate is decided.
        arrived: Number of them that arrived.
        under_way: Number of packets whose fate is not decided.
        sent_bytes: Total size of sent packets.
        arrived_bytes: Total size of packets that arrived.
        delay_s: Time in the network, of packets that arrived.
        first_to_last_s: Time from the first arrival to the last.
        jitter_s: Interarrival jitter after the last packet (RFC 3550, section 6.4.1); nan for fewer than two packets.
        added_s: Mean delay that the sync policy added, before and after the network.
        distances_m: Distance of sender and receiver at the first packet; minimum, mean and maximum over all packets.
        sender_m_s: Mean speed of the sender at the times of sending.
        relative_m_s: Mean magnitude of its velocity relative to the receiver.
        round_trips: The round trips of a ping; None for other flows.
    """

    name: str
    source: str
    destination: str
    protocol: str
    sent: int
    arrived: int
    under_way: int
    sent_bytes: int
    arrived_bytes: int
    delay_s: FlowSpread
    first_to_last_s: float
    jitter_s: float
    added_s: float
    distances_m: tuple[float, float, float, float]
    sender_m_s: float
    relative_m_s: float
    round_trips: FlowRoundTrips | None

    @property
    def loss(self) -> float:
        """Share of the packets that never arrived; nan without packets."""
        return 1 - self.arrived / self.sent if self.sent else np.nan


def flow_results(run: Run) -> tuple[FlowResult, ...]:
    """Return the results of each flow, in the order of their names."""
    flows: dict[str, list[Fate]] = {}
    for fate in run.fates.values():
        flows.setdefault(fate.packet.identity[0], []).append(fate)
    return tuple(_result(name, flows[name], flows.get(name + REPLY)) for name in sorted(flows))


def _result(name: str, fates: Sequence[Fate], replies: Sequence[Fate] | None) -> FlowResult:
    packet = fates[0].packet
    decided = [fate for fate in fates if fate.is_decided]
    times = [
        (fate.packet.sent_ns, fate.packet.enters_ns, fate.arrived_ns, fate.counted_ns)
        for fate in decided
        if fate.arrived_ns is not None and fate.counted_ns is not None
    ]
    arrived = [fate for fate in decided if fate.arrived_ns is not None]
    sent_ns, enters_ns, arrived_ns, counted_ns = np.array(times, np.int64).reshape(-1, 4).T
    delay_s = (arrived_ns - enters_ns) / 1e9
    distances_m = _distances([fate.true[0].position_m for fate in fates], [fate.true[1].position_m for fate in fates])
    velocities = [fate.true[0].velocity_m_s for fate in fates], [fate.true[1].velocity_m_s for fate in fates]
    return FlowResult(
        name=name,
        source=packet.source,
        destination=packet.destination,
        protocol=packet.protocol,
        sent=len(decided),
        arrived=len(arrived),
        under_way=len(fates) - len(decided),
        sent_bytes=sum(fate.packet.size_bytes for fate in decided),
        arrived_bytes=sum(fate.packet.size_bytes for fate in arrived),
        delay_s=_spread(delay_s),
        first_to_last_s=float(np.ptp(arrived_ns)) / 1e9 if len(arrived_ns) else np.nan,
        jitter_s=_jitter_s(delay_s[np.argsort(arrived_ns, kind="stable")]),
        added_s=_mean(enters_ns - sent_ns + counted_ns - arrived_ns) / 1e9,
        distances_m=(
            float(distances_m[0]),
            float(distances_m.min()),
            float(distances_m.mean()),
            float(distances_m.max()),
        ),
        sender_m_s=_mean(np.linalg.norm(velocities[0], axis=1)),
        relative_m_s=_mean(_distances(*velocities)),
        round_trips=None if replies is None else _round_trips(fates, replies),
    )


def _round_trips(requests: Sequence[Fate], replies: Sequence[Fate]) -> FlowRoundTrips:
    by_number = {reply.packet.identity[1]: reply for reply in replies}
    sent, trips_s = 0, []
    for request in sorted(requests, key=lambda fate: fate.packet.identity[1]):
        reply = by_number.get(request.packet.identity[1])
        back_s = None if reply is None else _network_s(reply)
        there_s = _network_s(request)
        if there_s is not None and back_s is not None:
            trips_s.append(there_s + back_s)
        sent += bool(request.reason) or (reply is not None and reply.is_decided)
    jitter_s = float(np.abs(np.diff(trips_s)).mean()) if len(trips_s) > 1 else np.nan
    return FlowRoundTrips(sent, len(trips_s), _spread(np.array(trips_s)), jitter_s)


def _network_s(fate: Fate) -> float | None:
    """Return the time that a packet spent in the network; None if it did not arrive."""
    return None if fate.arrived_ns is None else (fate.arrived_ns - fate.packet.enters_ns) / 1e9


def _distances(first: Sequence[Vector], second: Sequence[Vector]) -> Floats:
    return np.asarray(np.linalg.norm(np.subtract(first, second), axis=1), np.float64)


def _spread(values: Floats) -> FlowSpread:
    if not len(values):
        return FlowSpread(*(np.nan,) * 5)
    p50, p95 = np.quantile(values, [0.5, 0.95])
    return FlowSpread(float(values.min()), float(values.mean()), float(p50), float(p95), float(values.max()))


def _mean(values: NDArray[np.float64] | NDArray[np.int64]) -> float:
    return float(values.mean()) if len(values) else np.nan


def _jitter_s(delays_s: Floats) -> float:
    """Return the jitter of packets from their delays, in the order of arrival."""
    changes_s = np.abs(np.diff(delays_s))
    # The recursion J += (|D| - J) / 16 from J = 0, as a weighted sum.
    weights = _JITTER_GAIN * (1 - _JITTER_GAIN) ** np.arange(len(changes_s))[::-1]
    return float(weights @ changes_s) if len(changes_s) else np.nan
