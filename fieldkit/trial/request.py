"""The operator's request for a trial, and the plan that is made from it."""

import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from types import MappingProxyType

from fieldkit import __version__
from fieldkit.backends.protocols import Cast
from fieldkit.config.profiles import TELEMETRY
from fieldkit.core import plugins
from fieldkit.core.columns import SCHEMA_VERSION, Column
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import FIXED_ROLES, Distance, Protocol, Role, Topology
from fieldkit.measure.evidence import link
from fieldkit.trial import step_packages
from fieldkit.trial.columns import OTHERS, additional_columns, robot_columns
from fieldkit.trial.frozen import freeze
from fieldkit.trial.hashes import code_hash, data_hash
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import Procedure


@dataclass(frozen=True)
class TrialRequest:
    """Request of the operator. If a value is None, the value of the procedure is used.

    Attributes:
        procedure: The procedure.
        distance: The distance.
        topology: Topology.
        protocols: Protocols; if empty, the protocols of the procedure are used.
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
    def effective_topology(self) -> Topology:
        """The requested topology, or the topology of the procedure."""
        return self.topology or self.procedure.topology


def make_plan(
    request: TrialRequest,
    *,
    backend: str,
    cast: Cast,
    now: datetime,
    session: str | None = None,
    lab_bytes: int = 0,
    simulators: Mapping[str, str] = MappingProxyType({}),
) -> Plan:
    """Return the plan of a request.

    Args:
        request: The request.
        backend: Name of the backend.
        cast: The robot in each role. Robots in roles that the procedure does not use are not part of the plan.
        now: Start of the trial, which is part of its name.
        session: ID of the run of fieldkit; None if the run contains only this trial.
        lab_bytes: Maximum number of bytes that the lab adds to an attempt (`Backend.lab_bytes`).
        simulators: Simulators of the backend (`simulators_of`).

    Raises:
        ConfigurationError: No robot has a role that the procedure or the topology needs; or the procedure needs a
            common ROS master, but its robots do not share one; or the commands of a step cannot be derived.
    """
    procedure, topology = request.procedure, request.effective_topology
    _require_roles(procedure, topology, cast)
    _require_ros_master(procedure, topology, cast)
    if request.record_s is not None:
        procedure = procedure.with_record(request.record_s)
    procedure = procedure.resolved(cast)
    stamp = now.astimezone(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    trial = f"{stamp}_{procedure.name}_{request.distance.label}_{topology}"
    others_column = (OTHERS,) if procedure.places else ()
    plan = Plan(
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
        profiles_sha256=data_hash(_robot_data(cast)),
        # Expectations are excluded, because they do not affect the measurement.
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
        record_s=request.record_s,
        cast={role: robot for role, robot in cast.items() if role in FIXED_ROLES or role in procedure.roles()},
        procedure=procedure,
        lab_bytes=lab_bytes,
        simulators=dict(simulators),
        step_packages=step_packages.packages_of_kinds(placed.kind for placed in procedure.walk()),
        columns=freeze(
            (
                *others_column,
                *additional_columns(placed.step for placed in procedure.walk()),
                *robot_columns(procedure.roles()),
                *_telemetry_columns(cast),
            )
        ),
    )
    plan.program_copies()  # raises now, before robots start, if the commands of another package's step are invalid
    return plan


def _telemetry_columns(cast: Cast) -> Iterator[Column]:
    """Yield the columns of telemetry sources, which only trials of robots with such sources have."""
    for role in link.ROLES:
        if role in cast and TELEMETRY in cast[role].profile.sections:
            from fieldkit.telemetry import telemetry_columns  # noqa: PLC0415 (few profiles have sources)

            yield from telemetry_columns.of_role(role)


def _robot_data(cast: Cast) -> dict[str, object]:
    """Return the data that distinguishes the robots of this trial from the robots of other trials."""
    # In earlier versions all profiles had the key "mavlink". With this key, the hash is equal to the hash that these
    # versions computed.
    data: dict[str, object] = {
        role: {"mavlink": None, **robot.profile.model_dump(mode="json")} for role, robot in cast.items()
    }
    # The hash includes the role of the ROS master instead of its address, which does not affect the measurement.
    data |= {"ros_master": role for role, robot in cast.items() if robot.address == robot.ros_master}  # noqa: B035
    return data


def _require_ros_master(procedure: Procedure, topology: Topology, cast: Cast) -> None:
    if procedure.needs_ros_master and not any(robot.ros_master for robot in cast.values()):
        raise ConfigurationError(
            f"procedure {procedure.name} needs one ROS master for all robots; in {topology} they do not share one",
            remedy="set the robot that runs it in the site file: ros_master: relay",
        )


def _require_roles(procedure: Procedure, topology: Topology, cast: Cast) -> None:
    """Raise an error if the cast lacks a role of the procedure or of the topology."""
    required = {Role.SENDER, Role.RECEIVER} | ({Role.RELAY} if topology is Topology.MASTER else set())
    if missing := (procedure.roles() | required) - cast.keys():
        raise ConfigurationError(
            f"no robot has the role {', '.join(sorted(missing))} in topology {topology}",
            remedy=f"name a robot under roles.{topology} in the site file",
        )
