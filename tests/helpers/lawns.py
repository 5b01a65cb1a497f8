"""Synthetic tables of repeats under all conditions, for reports; they also have void repeats."""

from itertools import product

import numpy as np

from fieldkit.core.model import Protocol, Status
from fieldkit.core.units import parse_distance
from tests.helpers import tables
from tests.helpers.tables import RepeatRow, replace

DISTANCES = ("10ft", "20ft", "55ft")


def row(number: int = 1, **changes: object) -> RepeatRow:
    """A valid UDP repeat with changed values."""
    default = replace(
        tables.ROW,
        **dict.fromkeys(("ip_packets_sent", "ip_packets_received", "ip_loss", "file_loss")),
        trial="20261121T120000.000000Z_los_10ft_master",
        distance="10ft",
        distance_m=3.048,
        repeat=number,
        started_utc_ns=1_795_262_400_000_000_000 + number * 10_000_000_000,
        seed=1,
        sender="turtlebot-1",
        receiver="turtlebot-2",
        datagrams_sent=36,
        datagrams_received=34,
        datagram_loss=2 / 36,
        rtt_median_s=0.016,
        transfer_s=0.5,
    )
    return replace(default, **changes)


def lawn(repeats: int = 4) -> list[RepeatRow]:
    """Synthetic repeats on the lawn, with both scenarios, topologies, protocols and backends at three distances."""

    random = np.random.default_rng(5)
    rows = []
    conditions = product(("field", "emulated"), ("los", "nlos"), ("master", "masterless"), DISTANCES, Protocol)
    for backend, scenario, topology, label, protocol in conditions:
        distance = parse_distance(label)
        for number in range(1, repeats + 1):
            is_void = number == 2 and label == "55ft"
            rows.append(
                row(
                    number,
                    trial=f"{scenario}_{label}_{topology}_{backend}",
                    procedure=scenario,
                    scenario=scenario,
                    topology=topology,
                    backend=backend,
                    distance=label,
                    distance_m=distance.metres,
                    protocol=str(protocol),
                    status=str(Status.VOID if is_void else Status.VALID),
                    reason="the receiver's capture dropped 7 packets" if is_void else None,
                    **_figures(protocol, int(random.binomial(36, distance.metres / 60)), random.normal(0, 1e-4)),
                )
            )
    return rows


def _figures(protocol: Protocol, lost: int, noise_s: float) -> dict[str, object]:
    if protocol is Protocol.TCP:
        return {
            "datagrams_sent": None,
            "datagrams_received": None,
            "datagram_loss": None,
            "tcp_byte_loss": lost / 3600,
            "rtt_median_s": 0.005 + noise_s,
        }
    return {"datagrams_received": 36 - lost, "datagram_loss": lost / 36, "rtt_median_s": 0.016 + noise_s}
