"""Options of ns-3: `network.options` of a scenario. `network.cc` reads them."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from typing_extensions import override

from fieldkit.config.schema import Field, Int, Location
from sim_backends.federates.simulator_options import SimulatorOptions


class Ns3Options(SimulatorOptions):
    """Options of the network [ns-3](ns3.md).

    Attributes:
        standard: Standard of all radios; if omitted, 802.11n if all radios have it, otherwise 802.11g.
        ampdu_bytes: Largest aggregate of frames in 802.11n; 0 sends frames singly, as the built-in network does.
        topics: With `udp`, topics with `reliability: best_effort` are sent as UDP datagrams with the headers of RTPS,
            without discovery; if omitted, a scenario with topics is refused.
        delay_parts: File for the [parts of each delay](ns3.md#parts-of-the-delay); `{seed}` is replaced by the seed
            of the run.
        pcap: Beginning of the names of captures of 802.11 frames with radiotap, one per radio, for example
            `air-{seed}-`; with an access point, their times have 1 s more.
    """

    standard: Literal["802.11a", "802.11g", "802.11n"] | None = None
    ampdu_bytes: Annotated[Int, Field(ge=0, le=65535)] = 0
    topics: Literal["udp"] | None = None
    delay_parts: Annotated[str, Field(min_length=1)] | None = None
    pcap: Annotated[str, Field(min_length=1)] | None = None

    @override
    def unsupported(self, scenario: Mapping[str, Any]) -> Iterator[tuple[str, Location]]:
        for key in ("loss", "delay", "rate", "jitter"):
            if key in scenario["radio"]:
                yield f"ns-3 simulates Wi-Fi, not fixed links; remove {key}", ("radio", key)
        for number, fault in enumerate(scenario["faults"]):
            if fault["kind"] == "jammer":
                yield "ns-3 has no jammers; remove the fault", ("faults", number, "kind")
        for number, traffic in enumerate(scenario["traffic"]):
            yield from ((text, ("traffic", number, key)) for text, key in self._unsupported_traffic(traffic))

    def _unsupported_traffic(self, traffic: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield why traffic is not supported, with its key."""
        if traffic["protocol"] == "ros1":
            yield "ns-3 does not carry topics of ROS 1; use udp or tcp", "protocol"
        elif traffic["protocol"] == "topic":
            if self.topics is None:
                yield (
                    "ns-3 carries topics only with network.options.topics: udp; set it, or use udp or tcp",
                    "protocol",
                )
            elif traffic.get("qos", {}).get("reliability", "reliable") == "reliable":
                key = "qos" if "qos" in traffic else "protocol"
                yield "with topics: udp, ns-3 carries no reliable topics; set reliability: best_effort", key
