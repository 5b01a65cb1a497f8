"""Rows of trial.csv for the flows of a simulated run: one row per flow."""

import hashlib
import json
import math
from collections.abc import Collection, Iterator, Mapping
from typing import Final

from fieldkit.core.columns import SCHEMA_VERSION, Value
from fieldkit.core.model import Topology, Vector
from fieldkit.core.units import plain_number
from sim_backends.cosim.commands.results import FlowResult, SeedResult
from sim_backends.cosim.scenario.schema import CosimScenario

BACKEND: Final = "cosim"

_NOT_PROCEDURE: Final = frozenset({"name", "summary", "policy", "seeds", "duration", "trial"})
"""Keys of a scenario that are not part of the procedure: their values do not change the hash of the procedure."""


def flow_rows(
    trial: str,
    scenario: CosimScenario,
    policy: str,
    number: int,
    result: SeedResult,
    *,
    excluded_flows: Collection[str] = (),
) -> Iterator[dict[str, Value]]:
    """Yield a row for each flow of a run; unknown values are omitted.

    Args:
        trial: Name of the folder of all runs.
        scenario: The scenario.
        policy: The sync policy, as text.
        number: Number of the run, from 1.
        result: The result of the run.
        excluded_flows: Names of flows for which no row is yielded.
    """
    for flow in result.flows:
        if flow.name not in excluded_flows:
            values = {name: value for name, value in _measured_columns(flow).items() if not _is_missing(value)}
            yield _identity(trial, scenario, policy, result, flow) | {"repeat": number} | values


def _identity(
    trial: str, scenario: CosimScenario, policy: str, result: SeedResult, flow: FlowResult
) -> dict[str, Value]:
    """Return the columns that identify a row: trial, conditions, agents and status."""
    distance_m = _distance_m(flow, scenario, result.starts_m)
    identity: dict[str, Value] = {
        "schema_version": SCHEMA_VERSION,
        "trial": f"{trial}/{flow.name}",
        "procedure": f"{scenario.name} {flow.name} ({policy})",
        "scenario": str(scenario.line),
        "topology": str(scenario.topology),
        "backend": BACKEND,
        "distance_m": distance_m,
        "distance": f"{plain_number(distance_m, 6)}m",
        "protocol": flow.protocol,
        "attempt": 1,
        "status": "failed" if result.stop_reason else "valid",
        "reason": result.stop_reason,
        "seed": result.seed,
        "sender": flow.source,
        "receiver": flow.destination,
        "relay": scenario.relay or "",
    }
    return identity | scenario_hashes(scenario)


def scenario_hashes(scenario: CosimScenario) -> dict[str, Value]:
    """Return the columns with the hashes of the agents and of the procedure of a scenario (16 hex digits each)."""
    scenario_data = scenario.model_dump(mode="json", by_alias=True)
    procedure = {key: value for key, value in scenario_data.items() if key not in _NOT_PROCEDURE}
    return {"profiles_sha256": _digest(scenario_data["agents"]), "procedure_sha256": _digest(procedure)}


def _measured_columns(flow: FlowResult) -> dict[str, Value]:
    """Return the columns with the measured values of a flow; values that do not exist are nan."""
    delay_s = flow.delay_s
    datagrams: dict[str, Value] = {}
    if flow.protocol == "udp":
        datagrams = {
            "datagrams_sent": flow.sent_packets,
            "datagrams_received": flow.arrived_packets,
            "datagram_loss": flow.loss,
        }
    return (
        datagrams
        | _ping_columns(flow)
        | {
            "byte_loss": 1 - flow.arrived_bytes / flow.sent_bytes if flow.sent_bytes else math.nan,
            "transfer_s": flow.first_to_last_s,
            "transfer_from": "receiver",
            "one_way_min_s": delay_s.minimum,
            "one_way_median_s": delay_s.median,
            "one_way_mean_s": delay_s.mean,
            "one_way_p95_s": delay_s.p95,
            "one_way_error_s": 0.0,
            "delay_variation_median_s": delay_s.median - delay_s.minimum,
            "delay_variation_p95_s": delay_s.p95 - delay_s.minimum,
            "jitter_s": flow.jitter_s,
            "delay_s": delay_s.mean,
            "delay_packets": flow.arrived_packets,
        }
        | motion_columns("transfer", flow)
    )


def _ping_columns(flow: FlowResult) -> dict[str, Value]:
    """Return the columns of a ping.

    A simulated ping is sent over a transport such as UDP. The headers of UDP and ICMP have 8 bytes, so payload sizes
    are comparable with the sizes of a real ping.
    """
    trips = flow.round_trips
    if trips is None:
        return {}
    return {
        "rtt_sent": trips.request_count,
        "rtt_received": trips.reply_count,
        "rtt_loss": 1 - trips.reply_count / trips.request_count if trips.request_count else math.nan,
        "rtt_payload_bytes": flow.sent_bytes // flow.sent_packets if flow.sent_packets else math.nan,
        "rtt_min_s": trips.network_s.minimum,
        "rtt_median_s": trips.network_s.median,
        "rtt_mean_s": trips.network_s.mean,
        "rtt_p95_s": trips.network_s.p95,
        "rtt_max_s": trips.network_s.maximum,
        "rtt_jitter_s": trips.jitter_s,
    }


def motion_columns(step: str, flow: FlowResult) -> dict[str, Value]:
    """Return the columns of distances and speeds during a flow.

    Args:
        step: Prefix of the columns, `transfer` or `rtt`.
        flow: The flow.
    """
    start_m, min_m, mean_m, max_m = flow.distances_m
    return {
        f"{step}_distance_start_m": start_m,
        f"{step}_distance_min_m": min_m,
        f"{step}_distance_mean_m": mean_m,
        f"{step}_distance_max_m": max_m,
        f"{step}_sender_speed_m_s": flow.sender_m_s,
        f"{step}_relative_speed_m_s": flow.relative_m_s,
    }


def _is_missing(value: Value) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _distance_m(flow: FlowResult, scenario: CosimScenario, starts_m: Mapping[str, Vector]) -> float:
    """Return the distance in metres, rounded to millimetres, at which the sender and its peer start.

    The peer is the relay if packets are relayed, otherwise the receiver.
    """
    is_relayed = scenario.topology is Topology.MASTER and scenario.relay is not None
    peer = scenario.relay if is_relayed and scenario.relay else flow.destination
    return round(math.dist(starts_m[flow.source], starts_m[peer]), 3)


def _digest(value: object) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:16]
