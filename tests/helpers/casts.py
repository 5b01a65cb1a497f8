"""Casts and plans for pure tests."""

from datetime import UTC, datetime

from fieldkit.backends.protocols import Robot
from fieldkit.config.profiles import load_profile
from fieldkit.core.model import Protocol, Role, Topology
from fieldkit.core.units import parse_distance
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import load_procedure
from fieldkit.trial.request import Request, make_plan

TURTLEBOT = load_profile("turtlebot3_burger")
DUCKIEDRONE = load_profile("duckiedrone")

CAST = {
    Role.SENDER: Robot("turtlebot-1", Role.SENDER, TURTLEBOT, "10.42.0.1"),
    Role.RECEIVER: Robot("turtlebot-2", Role.RECEIVER, TURTLEBOT, "10.42.0.2"),
    Role.RELAY: Robot("duckiedrone-1", Role.RELAY, DUCKIEDRONE, "10.42.0.3"),
}


def los_plan(*, repeats: int = 2, protocols: tuple[Protocol, ...] = (), record_s: float | None = None) -> Plan:
    request = Request(
        procedure=load_procedure("los"),
        distance=parse_distance("30ft"),
        topology=Topology.MASTER,
        protocols=protocols,
        repeats=repeats,
        record_s=record_s,
        seed=7,
    )
    return make_plan(request, backend="field", cast=CAST, now=datetime(2026, 11, 20, 12, 0, tzinfo=UTC))
