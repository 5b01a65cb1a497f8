"""Options of ns-3: `network.options` of a scenario. `configuration.h` reads them."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from typing_extensions import override

from fieldkit.config.schema import Field, Int, Location
from fieldkit.core.model import Vector
from fieldkit.core.units import parse_offset_m
from sim_backends.federates.simulator_options import SimulatorOptions
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import World


class Ns3Options(SimulatorOptions):
    """Options of the network simulator [ns-3](ns3.md).

    Attributes:
        standard: Standard of all radios. If omitted, it is 802.11n if all profiles have this standard, otherwise
            802.11g.
        ampdu_bytes: Largest aggregate of frames in 802.11n; 0 sends frames singly, as the built-in network does
            between robots without `radio.phy`.
        topics: With `udp`, topics with `reliability: best_effort` are sent as UDP datagrams with the headers of RTPS,
            without discovery.
        delay_parts: File for the [parts of each delay](ns3.md#parts-of-the-delay); `{seed}` is replaced by the seed
            of the run.
        pcap: Prefix of the names of captures of 802.11 frames with radiotap, one per radio, for example
            `air-{seed}-`. Their time stamps are 1 ms later than simulated time, with an access point 1 s.
    """

    standard: Literal["802.11a", "802.11g", "802.11n"] | None = None
    ampdu_bytes: Annotated[Int, Field(ge=0, le=65535)] = 0
    topics: Literal["udp"] | None = None
    delay_parts: Annotated[str, Field(min_length=1)] | None = None
    pcap: Annotated[str, Field(min_length=1)] | None = None

    @override
    def unsupported(self, scenario: Mapping[str, Any]) -> Iterator[tuple[str, Location]]:
        if RadioOptions.model_validate(scenario["radio"]).is_fixed:
            for key in ("standard", "ampdu_bytes", "pcap"):
                if getattr(self, key):
                    yield f"fixed links have no Wi-Fi; remove {key}", ("network", "options", key)
        if scenario["network"]["transports"] == "builtin":
            if self.topics is not None:
                yield "transports: builtin carries all topics; remove topics", ("network", "options", "topics")
            return
        for number, traffic in enumerate(scenario["traffic"]):
            yield from ((text, ("traffic", number, key)) for text, key in self._unsupported_traffic(traffic))

    def _unsupported_traffic(self, traffic: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield each reason why ns-3's transports do not support some traffic, with the key."""
        if traffic["protocol"] in {"ros1", "ros1-udp"}:
            yield "ns-3 has no ROS 1; set network.transports: builtin", "protocol"
        elif traffic["protocol"] == "topic":
            if self.topics is None:
                yield (
                    "ns-3 has no topics; set network.transports: builtin, or network.options.topics: udp",
                    "protocol",
                )
            elif traffic.get("qos", {}).get("reliability", "reliable") == "reliable":
                key = "qos" if "qos" in traffic else "protocol"
                remedy = "set reliability: best_effort, or network.transports: builtin instead of topics"
                yield f"topics: udp carries no reliable topics; {remedy}", key

    @override
    def further_configuration(self, configuration: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters of fixed links as `link`, or the position of each fault's jammer as `jammers`."""
        scenario = configuration["scenario"]
        radio = RadioOptions.model_validate(scenario["radio"])
        if radio.is_fixed:
            return {"link": dataclasses.asdict(radio.link())}
        world = World.model_validate(configuration["world"])
        return {"jammers": [_jammer_m(fault, world) for fault in scenario["faults"]]}


def _jammer_m(fault: Mapping[str, Any], world: World) -> Vector | None:
    """Return the position of a jammer; None for a jammer that an agent carries, and for other faults."""
    if fault["kind"] != "jammer" or "at_m" not in fault:
        return None
    east_m, north_m = fault["at_m"]
    return east_m, north_m, world.ground_m((east_m, north_m)) + parse_offset_m(fault["height"])
