"""Statistics of the medium, and the messages with which the process of the medium sends them to the lab."""

from collections.abc import Iterable, Mapping
from dataclasses import astuple, dataclass, field

from fieldkit.core.model import DelayParts, LinkSample, StationSample
from sim_backends.emulated.process.worker import Message
from sim_backends.radio.core.links import LinkCounters, Pair


@dataclass(frozen=True)
class PortCounters:
    """Packet counters of the device of one robot.

    Attributes:
        sent_packets: Packets that the robot sent.
        delivered_packets: Packets delivered to the robot.
        refused_packets: Packets that arrived but that the robot's kernel refused.
        unroutable_packets: Packets to an address that no robot has, or from or to a robot that is off the air.
        other_packets: Packets that the medium does not carry: with IP framing those of other protocols than IPv4,
            with Ethernet framing those that are shorter than an Ethernet header.
    """

    sent_packets: int
    delivered_packets: int
    refused_packets: int
    unroutable_packets: int
    other_packets: int


@dataclass(frozen=True)
class MediumStats:
    """Statistics of the medium since its start.

    Attributes:
        scheduling: `fifo 1`, or the reason why the process has no real-time priority.
        packet_lateness_counts: Number of packets per lateness in ns, rounded by `round_up`. Lateness is the longest
            time that the packet can have waited to be read, plus the time from its arrival in the model until it was
            written.
        links: Counters per directed link.
        ports: Counters per robot.
        delays: Delays of the packets written to a robot, per pair of sender and receiver; lateness is counted as
            processing delay.
        window_lateness_counts: Number of windows of a co-simulation per lateness in ns, rounded by `round_up`. The
            lateness is the time from the end of the window until its packets were written. Empty for a medium
            without windows.
    """

    scheduling: str
    packet_lateness_counts: dict[int, int]
    links: dict[Pair, LinkCounters]
    ports: dict[str, PortCounters]
    delays: dict[Pair, DelayParts]
    window_lateness_counts: Mapping[int, int] = field(default_factory=dict)


def pack_stats(stats: MediumStats) -> Message:
    """Return the message for `stats`."""
    return {
        "scheduling": stats.scheduling,
        "packet_lateness_counts": [*stats.packet_lateness_counts.items()],
        "window_lateness_counts": [*stats.window_lateness_counts.items()],
        "links": [[*pair, vars(counters)] for pair, counters in stats.links.items()],
        "ports": {name: vars(counters) for name, counters in stats.ports.items()},
        "delays": [[*pair, vars(parts)] for pair, parts in stats.delays.items()],
    }


def unpack_stats(message: Message) -> MediumStats:
    """Return the statistics from a message of `pack_stats`."""
    return MediumStats(
        scheduling=message["scheduling"],
        packet_lateness_counts=dict(message["packet_lateness_counts"]),
        window_lateness_counts=dict(message["window_lateness_counts"]),
        links={(sender, receiver): LinkCounters(**values) for sender, receiver, values in message["links"]},
        ports={name: PortCounters(**values) for name, values in message["ports"].items()},
        delays={(source, robot): DelayParts(**values) for source, robot, values in message["delays"]},
    )


def pack_links(samples: Iterable[Mapping[str, LinkSample]]) -> Message:
    """Return the message for link samples; each item of `samples` maps robots to their samples at one time."""
    return {"links": [[name, astuple(sample)] for by_robot in samples for name, sample in by_robot.items()]}


def unpack_links(message: Message) -> dict[str, list[LinkSample]]:
    """Return the samples of each robot from a message of `pack_links`, in their order."""
    links: dict[str, list[LinkSample]] = {}
    for name, (utc_ns, stations, *radio) in message["links"]:
        station_samples = tuple(StationSample(*station) for station in stations)
        links.setdefault(name, []).append(LinkSample(utc_ns, station_samples, *radio))
    return links
