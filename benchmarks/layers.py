"""Cost of each layer of the radio model: `python -m benchmarks.layers [--json]`, as root.

Layers are added one after the other. With each of them, the radio model alone (the engine) is measured in virtual
time: processor time per packet of 64 bytes of UDP payload between two stations, one of which always has packets to
send, and its share of the packets' air time (above 100 % a saturated channel does not run in real time). The medium
(the process that carries packets between robots) is measured too: round trips of ping between two namespaces, and
their mean without the delays from the model. Finally the engine with all layers is measured with several numbers of
stations, which are in range of each other and send to the first one.
"""

import argparse
import json
import os
import re
import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from benchmarks.medium import PAYLOAD_BYTES, RADIO, quantile
from benchmarks.swarm import swarm
from fieldkit.core.model import DelayParts
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.antennas import antenna_of
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.models.radio_model import RadioModel, WifiInWorld
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.world import World, load_world

PACKET_BYTES: Final = PAYLOAD_BYTES + 28
QUEUED: Final = 10
"""Packets in the queue of each sender; a packet that arrived is replaced by a new one."""
PACKETS: Final = 5_000
PINGS: Final = 300
STATIONS: Final = (2, 10, 50)

Figures = dict[str, float]


@dataclass(frozen=True)
class Layer:
    """Options of the radio model, with one layer more than the options before.

    Attributes:
        name: The layer that is added.
        options: Its options, as in a site file.
        world: Name of the world around the stations, None for open ground.
    """

    name: str
    options: Mapping[str, object]
    world: str | None = None

    def radio(self) -> RadioOptions:
        """Return the validated options."""
        return RadioOptions.model_validate(self.options)

    def load(self) -> World | None:
        """Return the world, None for open ground."""
        return None if self.world is None else load_world(self.world)

    def model(self, stations: int) -> RadioModel[int]:
        """Return the radio model, without a medium."""
        options = self.radio()
        if options.is_fixed:
            return UniformLinks(1, options)
        return WifiInWorld(1, options, {_name(n): antenna_of(RADIO) for n in range(stations)}, self.load())


FULL: Final = {"shadowing_db": 4.0, "fading": True}
LAYERS: Final = (
    Layer("fixed links", {"loss": "0%", "delay": "0.2ms", "rate": "54Mbit/s"}),
    Layer("Wi-Fi in one mode", {"fading": False, "mode": "g54"}),
    Layer("+ rate choice", {"fading": False}),
    Layer("+ shadowing", {"fading": False, "shadowing_db": 4.0}),
    Layer("+ world", {"fading": False, "shadowing_db": 4.0}, "lawn"),
    Layer("+ fading", FULL, "lawn"),
)


def _name(number: int) -> str:
    return f"s{number}"


def _places(stations: int) -> dict[str, tuple[float, float, float]]:
    return {_name(number): (1.0 + 0.5 * number, 1.0, 0.3) for number in range(stations)}


def measure_engine(layer: Layer, stations: int, packets: int) -> Figures:
    """Return the processor time per packet to the first station from all others, and its share of the air time."""
    model = layer.model(stations)
    receiver, *senders = _places(stations)
    model.place(0, _places(stations), None)
    for number in range(QUEUED * len(senders)):
        model.send(0, senders[number % len(senders)], number, PACKET_BYTES, receiver)
    # The first packets create tables and random streams, which are not measured.
    _transmit(model, receiver, packets // 10)
    cpu_s, air_s = _transmit(model, receiver, packets)
    return {"cpu_us": 1e6 * cpu_s / packets, "core_percent": 100 * cpu_s / air_s}


def _transmit(model: RadioModel[int], receiver: str, packets: int) -> tuple[float, float]:
    """Return processor time and virtual time in s of a number of packets; each arrival triggers another one."""
    arrived, first_ns, now_ns, started_s = 0, model.next_event_ns() or 0, 0, time.process_time()
    while arrived < packets:
        now_ns = model.next_event_ns() or now_ns
        for _, _, number, source, _ in model.deliveries(now_ns):
            arrived += 1
            model.send(now_ns, source, number, PACKET_BYTES, receiver)
    return time.process_time() - started_s, (now_ns - first_ns) / 1e9


def round_trips(layer: Layer) -> Figures:
    """Return round trips in ms through the medium, and their mean without the delays from the model."""
    with swarm(2, layer.radio(), layer.load()) as (medium, (client, _)):
        client.run("ping", "-c", "3", "10.9.0.2")
        before_ms = _modelled_ms(medium)
        pings = client.run("ping", "-c", str(PINGS), "-i", "0.01", "10.9.0.2", timeout_s=60.0).stdout
        rtt_ms = [float(value) for value in re.findall(r"time=([\d.]+)", pings)]
        modelled_ms = (_modelled_ms(medium) - before_ms) / len(rtt_ms)
    return {
        "rtt_median_ms": statistics.median(rtt_ms),
        "rtt_p99_ms": quantile(rtt_ms, 0.99),
        "added_mean_ms": statistics.fmean(rtt_ms) - modelled_ms,
    }


def _modelled_ms(medium: MediumClient) -> float:
    return sum(map(_parts_ms, medium.stats().delays.values()))


def _parts_ms(parts: DelayParts) -> float:
    return (parts.transmission_ns + parts.propagation_ns + parts.queuing_ns) / 1e6


def measure_round(packets: int) -> dict[str, Figures]:
    """Return the figures of one round per layer, and per number of stations with all layers."""
    figures = {layer.name: {**measure_engine(layer, 2, packets), **round_trips(layer)} for layer in LAYERS}
    return figures | {f"all, {count} stations": measure_engine(LAYERS[-1], count, packets) for count in STATIONS}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--packets", type=int, default=PACKETS, help="packets per measurement of the engine")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    load_before = os.getloadavg()[0]
    rounds = [measure_round(options.packets) for _ in range(options.rounds)]
    if options.json:
        print(json.dumps({"load_before": load_before, "rounds": rounds}, indent=2))
        return
    print(f"{options.rounds} rounds, medians; load before: {load_before:.2f}, after: {os.getloadavg()[0]:.2f}")
    columns = list(rounds[0][LAYERS[0].name])
    print(f"{'':22}" + "".join(f"{column:>15}" for column in columns))
    for name, first in rounds[0].items():
        values = {column: statistics.median(results[name][column] for results in rounds) for column in first}
        print(
            f"{name:22}"
            + "".join(f"{values[column]:>15.3g}" if column in values else f"{'':>15}" for column in columns)
        )


if __name__ == "__main__":
    main()
