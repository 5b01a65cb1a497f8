"""Flows as rows of trial.csv, so that aggregate, compare, report and export read simulations beside trials.

A flow under one seed is a result. What a simulation cannot know as a trial does has no column here: sizes of files,
clocks, captures. Delays are the network's own; what the sync policy added to them is in none of them.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from typing import Final

from fieldkit.core.columns import SCHEMA_VERSION, Value, csv_text
from fieldkit.core.model import Topology, Vector
from sim_backends.cosim.commands.flows import FlowResult
from sim_backends.cosim.commands.results import SeedResult
from sim_backends.cosim.scenario.schema import CosimScenario

BACKEND: Final = "cosim"

_OF_NO_PROCEDURE: Final = frozenset({"name", "summary", "policy", "seeds", "duration"})
"""Keys of a scenario that leave it the same procedure: what is compared, and how often and how long it is run."""


def table(trial: str, scenario: CosimScenario, policy: str, number: int, result: SeedResult) -> str:
    """Return a trial.csv with a row for each flow of a run.

    Args:
        trial: Name of the folder in which all runs are.
        scenario: What was run.
        policy: The sync policy in words.
        number: Number of the run, from 1.
        result: What came of it.
    """
    rows = [
        _identity(trial, scenario, policy, result, flow)
        | {"repeat": number}
        | {name: value for name, value in _measured(flow).items() if not _is_missing(value)}
        for flow in result.flows
    ]
    names = list(dict.fromkeys(name for row in rows for name in row))
    return csv_text(names, ([row.get(name) for name in names] for row in rows))


def _identity(
    trial: str, scenario: CosimScenario, policy: str, result: SeedResult, flow: FlowResult
) -> dict[str, Value]:
    distance_m = _distance_m(flow, scenario, result.starts_m)
    written = scenario.model_dump(mode="json", by_alias=True)
    procedure = {key: value for key, value in written.items() if key not in _OF_NO_PROCEDURE}
    return {
        "schema_version": SCHEMA_VERSION,
        "trial": f"{trial}/{flow.name}",
        "procedure": f"{scenario.name} {flow.name} ({policy})",
        "scenario": str(scenario.line),
        "topology": str(scenario.topology),
        "backend": BACKEND,
        "distance_m": distance_m,
        "distance": f"{distance_m:g}m",
        "protocol": flow.protocol,
        "attempt": 1,
        "status": "failed" if result.stopped else "valid",
        "reason": result.stopped,
        "seed": result.seed,
        "sender": flow.source,
        "receiver": flow.destination,
        "relay": scenario.relay or "",
        "profiles_sha256": _digest(written["agents"]),
        "procedure_sha256": _digest(procedure),
    }


def _measured(flow: FlowResult) -> dict[str, Value]:
    delay_s, distances_m = flow.delay_s, flow.distances_m
    datagrams: dict[str, Value] = {}
    if flow.protocol == "udp":
        datagrams = {"datagrams_sent": flow.sent, "datagrams_received": flow.arrived, "datagram_loss": flow.loss}
    return (
        datagrams
        | _pinged(flow)
        | {
            "byte_loss": 1 - flow.arrived_bytes / flow.sent_bytes if flow.sent_bytes else math.nan,
            "transfer_s": flow.first_to_last_s,
            "transfer_from": "receiver",
            "one_way_min_s": delay_s.least,
            "one_way_median_s": delay_s.median,
            "one_way_mean_s": delay_s.mean,
            "one_way_p95_s": delay_s.p95,
            "one_way_error_s": 0.0,
            "delay_variation_median_s": delay_s.median - delay_s.least,
            "delay_variation_p95_s": delay_s.p95 - delay_s.least,
            "jitter_s": flow.jitter_s,
            "delay_s": delay_s.mean,
            "delay_packets": flow.arrived,
            "transfer_distance_start_m": distances_m[0],
            "transfer_distance_min_m": distances_m[1],
            "transfer_distance_mean_m": distances_m[2],
            "transfer_distance_max_m": distances_m[3],
            "transfer_sender_speed_m_s": flow.sender_m_s,
            "transfer_relative_speed_m_s": flow.relative_m_s,
        }
    )


def _pinged(flow: FlowResult) -> dict[str, Value]:
    """Return the columns of a ping, whose request and answer carry 8 bytes of header, here UDP's, as ICMP's."""
    trips = flow.round_trips
    if trips is None:
        return {}
    return {
        "rtt_sent": trips.sent,
        "rtt_received": trips.answered,
        "rtt_loss": 1 - trips.answered / trips.sent if trips.sent else math.nan,
        "rtt_payload_bytes": flow.sent_bytes // flow.sent if flow.sent else math.nan,
        "rtt_min_s": trips.network_s.least,
        "rtt_median_s": trips.network_s.median,
        "rtt_mean_s": trips.network_s.mean,
        "rtt_p95_s": trips.network_s.p95,
        "rtt_max_s": trips.network_s.most,
        "rtt_jitter_s": trips.jitter_s,
    }


def _is_missing(value: Value) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _distance_m(flow: FlowResult, scenario: CosimScenario, starts_m: Mapping[str, Vector]) -> float:
    """Return the distance of a flow at time 0, to the millimetre: with a relay the one to it, as trials have it."""
    relayed = scenario.topology is Topology.MASTER and scenario.relay is not None
    other = scenario.relay if relayed and scenario.relay else flow.destination
    return round(math.dist(starts_m[flow.source], starts_m[other]), 3)


def _digest(written: object) -> str:
    return hashlib.sha256(json.dumps(written, sort_keys=True).encode()).hexdigest()[:16]
