"""The operator's request for a trial, and the plan that it is frozen into."""

import platform
from dataclasses import dataclass
from datetime import UTC, datetime

from fieldkit import __version__
from fieldkit.backends.protocols import Cast
from fieldkit.core import plugins
from fieldkit.core.columns import SCHEMA_VERSION
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FIXED_ROLES, Distance, Protocol, Role, Topology
from fieldkit.trial import step_packages
from fieldkit.trial.columns import OTHERS, of_steps
from fieldkit.trial.frozen import freeze
from fieldkit.trial.hashes import code_hash, data_hash
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure


@dataclass(frozen=True)
class TrialRequest:
    """Request of the operator; None takes the procedure's own value.

    Attributes:
        procedure: The procedure.
        distance: The distance.
        topology: Topology.
        protocols: Protocols; empty takes the procedure's.
        repeats: Repeats per protocol.
        record_s: Duration of every recording, in seconds.
        seed: Seed.
        notes: Free text.
    """

    procedure: Procedure
    distance: Distance
    topology: Topology | None = None
    protocols: tuple[Protocol, ...] = ()
    repeats: int | None = None
    record_s: float | None = None
    seed: int = 1
    notes: str = ""

    @property
    def chosen_topology(self) -> Topology:
        """The topology asked for, or the procedure's."""
        return self.topology or self.procedure.topology


def make_plan(
    request: TrialRequest,
    *,
    backend: str,
    cast: Cast,
    now: datetime,
    session: str | None = None,
    lab_bytes: int = 0,
) -> Plan:
    """Freeze a request.

    Args:
        request: What the operator asked for.
        backend: Name of the backend.
        cast: Who plays which role; robots in roles of other procedures' own take no part.
        now: Start of the trial, part of its name.
        session: The run of fieldkit that the trial is part of; None for the trial alone.
        lab_bytes: How many bytes the lab itself adds to an attempt at most (`Backend.lab_bytes`).

    Raises:
        ConfigurationError: The procedure or the topology needs a role that nobody plays, or a ROS master that robots
            share where each has its own.
    """
    procedure, topology = request.procedure, request.chosen_topology
    _demand_roles(procedure, topology, cast)
    _demand_ros_master(procedure, topology, cast)
    if request.record_s is not None:
        procedure = procedure.with_record(request.record_s)
    procedure = procedure.resolved(cast)
    stamp = now.astimezone(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    trial = f"{stamp}_{procedure.name}_{request.distance.label}_{topology}"
    others = (OTHERS,) if procedure.places else ()
    return Plan(
        schema_version=SCHEMA_VERSION,
        trial=trial,
        versions={
            **plugins.versions(),
            "fieldkit": __version__,
            "python": platform.python_version(),
            **{
                package: plugins.version(package)
                for package in ("google-re2", "jmespath", "numpy", "paramiko", "rosbags")
            },
        },
        code_sha256=code_hash(),
        profiles_sha256=data_hash(_what_robots_are(cast)),
        # What is demanded of figures changes none of them.
        procedure_sha256=data_hash(procedure.model_dump(mode="json", exclude={"expect"})),
        backend=backend,
        session=session or trial,
        seed=request.seed,
        notes=request.notes,
        topology=topology,
        distance=request.distance.label,
        distance_m=request.distance.metres,
        protocols=request.protocols or procedure.protocols,
        repeats=request.repeats or procedure.repeats,
        cast={role: robot for role, robot in cast.items() if role in FIXED_ROLES or role in procedure.roles()},
        procedure=procedure,
        lab_bytes=lab_bytes,
        step_packages=step_packages.of_kinds(placed.kind for placed in procedure.walk()),
        columns=freeze((*others, *of_steps(placed.step for placed in procedure.walk()))) or None,
    )


def _what_robots_are(cast: Cast) -> dict[str, object]:
    """Return what makes trials on other robots other trials."""
    found: dict[str, object] = {role: robot.profile.model_dump(mode="json") for role, robot in cast.items()}
    # By role: addresses are another lab's, and measure nothing else.
    found |= {"ros_master": role for role, robot in cast.items() if robot.address == robot.ros_master}  # noqa: B035
    return found


def _demand_ros_master(procedure: Procedure, topology: Topology, cast: Cast) -> None:
    if procedure.needs_ros_master and not any(robot.ros_master for robot in cast.values()):
        raise ConfigurationError(
            f"procedure {procedure.name} is about one ROS master of all robots; in {topology} each has its own",
            remedy="write into the site file who runs it: ros_master: relay",
        )


def _demand_roles(procedure: Procedure, topology: Topology, cast: Cast) -> None:
    """Refuse a cast that lacks a role of the procedure, or of who is placed."""
    placed = {Role.SENDER, Role.RECEIVER} | ({Role.RELAY} if topology is Topology.MASTER else set())
    if missing := (procedure.roles() | placed) - cast.keys():
        raise ConfigurationError(
            f"nobody plays {', '.join(sorted(missing))} in topology {topology}",
            remedy=f"name a robot under roles.{topology} in the site file",
        )
