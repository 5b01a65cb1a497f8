"""Casts and plans for tests without processes or robots."""

from datetime import UTC, datetime

from fieldkit.backends.protocols import Robot
from fieldkit.config import schema
from fieldkit.config.profiles import RobotProfile, Ros, load_profile
from fieldkit.core.model import Protocol, Role, Topology
from fieldkit.core.units import parse_distance
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure, load_procedure
from fieldkit.trial.request import TrialRequest, make_plan

TURTLEBOT = load_profile("turtlebot3_burger")
DUCKIEDRONE = load_profile("duckiedrone")

CAST = {
    Role.SENDER: Robot(name="turtlebot-1", address="10.42.0.1", profile=TURTLEBOT),
    Role.RECEIVER: Robot(name="turtlebot-2", address="10.42.0.2", profile=TURTLEBOT),
    Role.RELAY: Robot(name="duckiedrone-1", address="10.42.0.3", profile=DUCKIEDRONE),
}


def ros_of(profile: RobotProfile) -> Ros:
    """The ROS section of a profile that has one."""
    assert profile.ros is not None
    return profile.ros


PLAIN = """\
name: los
summary: "Line of sight without ROS: capture on both ends, transfer a generated file, ping"
scenario: los
topology: master
protocols: [tcp, udp]
repeats: 20
steps:
  - capture:
      robots: [sender, receiver]
      port: 1234
      during:
        - send: {from: sender, to: receiver, size: 100kB, into: recv.bag, port: 1234}
        - ping: {from: sender, to: receiver, count: 10, interval: 200ms, payload_bytes: {tcp: 502, udp: 8192}}
"""


def los_plan(*, repeats: int = 2, protocols: tuple[Protocol, ...] = (), record_s: float | None = None) -> Plan:
    """The plan of a trial of the shipped procedure `los`, which records a bag (`fieldkit.ros`)."""
    return _plan(load_procedure("los"), repeats, protocols, record_s)


def plain_plan(*, repeats: int = 2, protocols: tuple[Protocol, ...] = ()) -> Plan:
    """A plan like the result of `los_plan`, but with steps that need neither `fieldkit.ros` nor `fieldkit.motion`."""
    return _plan(schema.validate(schema.parse(PLAIN, source="los.yaml"), Procedure), repeats, protocols)


def _plan(procedure: Procedure, repeats: int, protocols: tuple[Protocol, ...], record_s: float | None = None) -> Plan:
    request = TrialRequest(
        procedure=procedure,
        distance=parse_distance("30ft"),
        topology=Topology.MASTER,
        protocols=protocols,
        repeats=repeats,
        record_s=record_s,
        seed=7,
    )
    return make_plan(request, backend="field", cast=CAST, now=datetime(2026, 11, 20, 12, 0, tzinfo=UTC))


def ros2_robot(name: str, address: str = "10.42.0.1") -> Robot:
    """A robot whose profile has ROS 2."""
    profile = TURTLEBOT.model_copy(update={"ros": ros_of(TURTLEBOT).model_copy(update={"variant": "ros2"})})
    return Robot(name=name, address=address, profile=profile)
