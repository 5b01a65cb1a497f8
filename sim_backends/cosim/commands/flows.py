"""What became of each flow of a run, in numbers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.model import Vector
from sim_backends.cosim.programs.pings import REPLY
from sim_backends.cosim.run import Fate, Run

Floats = NDArray[np.float64]

_JITTER_GAIN = 1 / 16
"""RFC 3550, section 6.4.1."""


@dataclass(frozen=True)
class FlowSpread:
    """Values in seconds, of packets that arrived; nan where none did.

    Attributes:
        least: The smallest.
        mean: Their mean.
        median: Their median.
        p95: Their 95th percentile.
        most: The largest.
    """

    least: float
    mean: float
    median: float
    p95: float
    most: float


@dataclass(frozen=True)
class FlowRoundTrips:
    """What became of the requests of a ping; those whose answer may still come count nowhere.

    Attributes:
        sent: Requests.
        answered: Those whose answer arrived.
        network_s: How long the network had request and answer together.
        jitter_s: Mean absolute difference of one round trip from the next; nan of fewer than two.
    """

    sent: int
    answered: int
    network_s: FlowSpread
    jitter_s: float


@dataclass(frozen=True)
class FlowResult:
    """What became of the packets of a flow. Those that were under way when the run ended count nowhere else.

    Attributes:
        name: The flow.
        source: Who sent.
        destination: Who was to receive.
        protocol: Transport that carried it.
        sent: Packets whose fate is known.
        arrived: Those of them that arrived.
        under_way: Packets whose fate is not.
        sent_bytes: Sum of the sizes of what was sent.
        arrived_bytes: Of what arrived.
        delay_s: How long the network had each that arrived.
        first_to_last_s: From the first arrival to the last.
        jitter_s: Interarrival jitter after the last packet (RFC 3550, section 6.4.1); nan of fewer than two.
        added_s: Mean of what the sync policy added to the delay, before the network got a packet and behind it.
        distances_m: Between sender and receiver at the first packet, and least, mean and largest of all packets.
        sender_m_s: Mean speed of the sender when it sent.
        relative_m_s: Mean magnitude of its velocity less the receiver's.
        round_trips: Of the requests of a ping; None of other flows.
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
        """Share of the packets that never arrived; nan of none."""
        return 1 - self.arrived / self.sent if self.sent else np.nan


def flow_results(run: Run) -> tuple[FlowResult, ...]:
    """Return what became of each flow, in the order of their names."""
    flows: dict[str, list[Fate]] = {}
    for fate in run.fates.values():
        flows.setdefault(fate.packet.identity[0], []).append(fate)
    return tuple(_result(name, flows[name], flows.get(name + REPLY)) for name in sorted(flows))


def _result(name: str, fates: Sequence[Fate], replies: Sequence[Fate] | None) -> FlowResult:
    packet = fates[0].packet
    known = [fate for fate in fates if fate.is_known]
    times = [
        (fate.packet.sent_ns, fate.packet.enters_ns, fate.arrived_ns, fate.counted_ns)
        for fate in known
        if fate.arrived_ns is not None and fate.counted_ns is not None
    ]
    arrived = [fate for fate in known if fate.arrived_ns is not None]
    sent_ns, enters_ns, arrived_ns, counted_ns = np.array(times, np.int64).reshape(-1, 4).T
    delay_s = (arrived_ns - enters_ns) / 1e9
    distances_m = _apart([fate.true[0].position_m for fate in fates], [fate.true[1].position_m for fate in fates])
    velocities = [fate.true[0].velocity_m_s for fate in fates], [fate.true[1].velocity_m_s for fate in fates]
    return FlowResult(
        name=name,
        source=packet.source,
        destination=packet.destination,
        protocol=packet.protocol,
        sent=len(known),
        arrived=len(arrived),
        under_way=len(fates) - len(known),
        sent_bytes=sum(fate.packet.size_bytes for fate in known),
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
        relative_m_s=_mean(_apart(*velocities)),
        round_trips=None if replies is None else _round_trips(fates, replies),
    )


def _round_trips(requests: Sequence[Fate], replies: Sequence[Fate]) -> FlowRoundTrips:
    answers = {reply.packet.identity[1]: reply for reply in replies}
    sent, trips_s = 0, []
    for request in sorted(requests, key=lambda fate: fate.packet.identity[1]):
        answer = answers.get(request.packet.identity[1])
        back_s = None if answer is None else _network_s(answer)
        there_s = _network_s(request)
        if there_s is not None and back_s is not None:
            trips_s.append(there_s + back_s)
        sent += bool(request.reason) or (answer is not None and answer.is_known)
    jitter_s = float(np.abs(np.diff(trips_s)).mean()) if len(trips_s) > 1 else np.nan
    return FlowRoundTrips(sent, len(trips_s), _spread(np.array(trips_s)), jitter_s)


def _network_s(fate: Fate) -> float | None:
    """Return how long the network had a packet; None for one that did not arrive."""
    return None if fate.arrived_ns is None else (fate.arrived_ns - fate.packet.enters_ns) / 1e9


def _apart(one: Sequence[Vector], other: Sequence[Vector]) -> Floats:
    return np.asarray(np.linalg.norm(np.subtract(one, other), axis=1), np.float64)


def _spread(values: Floats) -> FlowSpread:
    if not len(values):
        return FlowSpread(*(np.nan,) * 5)
    p50, p95 = np.quantile(values, [0.5, 0.95])
    return FlowSpread(float(values.min()), float(values.mean()), float(p50), float(p95), float(values.max()))


def _mean(values: NDArray[np.float64] | NDArray[np.int64]) -> float:
    return float(values.mean()) if len(values) else np.nan


def _jitter_s(delays_s: Floats) -> float:
    """Return the jitter of packets by their delays in the order in which they arrived."""
    changes_s = np.abs(np.diff(delays_s))
    # J += (|D| - J) / 16 from J = 0, written out.
    weights = _JITTER_GAIN * (1 - _JITTER_GAIN) ** np.arange(len(changes_s))[::-1]
    return float(weights @ changes_s) if len(changes_s) else np.nan
