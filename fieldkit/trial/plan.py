"""The frozen inputs of a trial: what `trial.yaml` holds, and all that its CSV needs beside journal and evidence."""

import hashlib
import json
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Final

from fieldkit import __version__, config
from fieldkit.backends import Cast, Robot
from fieldkit.columns import SCHEMA_VERSION
from fieldkit.config import Int, Number, Strict
from fieldkit.errors import ConfigurationError
from fieldkit.measure.transfer import Transfer
from fieldkit.model import Distance, Placement, Protocol, RepeatId, Role, Topology
from fieldkit.procedures import Procedure, steps_of
from fieldkit.profiles import RobotProfile
from fieldkit.steps.base import Scene
from fieldkit.steps.transfer import Transfer as TransferStep

PLAN_FILE: Final = "trial.yaml"

_HASH_DIGITS: Final = 16


class CastMember(Strict):
    """Who played a role.

    Attributes:
        name: The robot's name in the lab.
        address: Its address on the radio.
        profile: What it was.
    """

    name: str
    address: str
    profile: RobotProfile


class Plan(Strict):
    """A trial's frozen inputs.

    Attributes:
        schema_version: Version of the CSV columns.
        trial: Name of the trial, and of its folder.
        versions: Versions of fieldkit, Python and the packages that measure.
        code_sha256: Hash over fieldkit's source.
        profiles_sha256: Hash over the profiles of the cast.
        procedure_sha256: Hash of the procedure.
        backend: Where the robots came from.
        seed: Seed of everything random.
        notes: The operator's.
        topology: Topology.
        distance: As the operator wrote it.
        distance_m: In metres.
        protocols: Protocols under test.
        repeats: Repeats per protocol.
        cast: Who plays which role.
        procedure: What is done.
    """

    schema_version: Int
    trial: str
    versions: dict[str, str]
    code_sha256: str
    profiles_sha256: str
    procedure_sha256: str
    backend: str
    seed: Int
    notes: str
    topology: Topology
    distance: str
    distance_m: Number
    protocols: tuple[Protocol, ...]
    repeats: Int
    cast: dict[Role, CastMember]
    procedure: Procedure

    def order(self) -> Iterator[RepeatId]:
        """Yield the planned repeats; protocols alternate, so that a slow change of the air meets each alike."""
        return (RepeatId(protocol, number + 1) for number in range(self.repeats) for protocol in self.protocols)

    @property
    def placement(self) -> Placement:
        """Where the robots are to stand."""
        return Placement(self.procedure.scenario, self.topology, Distance(self.distance_m, self.distance))

    def robots(self) -> Cast:
        """Return the cast as steps want it."""
        return {
            role: Robot(name=member.name, role=role, profile=member.profile, address=member.address)
            for role, member in self.cast.items()
        }

    def scene(self, repeat: RepeatId, folder: str) -> Scene:
        """Return what the command lines of one attempt depend on."""
        return Scene(protocol=repeat.protocol, cast=self.robots(), folder=folder)

    def transfer(self, protocol: Protocol) -> Transfer | None:
        """Return what is measured of the procedure's first transfer, None if it has none."""
        for step in steps_of(self.procedure, TransferStep):
            return Transfer(
                protocol=protocol,
                sender_address=self.cast[step.sender].address,
                receiver_address=self.cast[step.receiver].address,
                port=step.port,
                sent_file=step.file,
            )
        return None

    def expected_s(self) -> float:
        """Return about how many seconds the repeats take on a good link."""
        return self.repeats * sum(self.procedure.expected_s(protocol) for protocol in self.protocols)


@dataclass(frozen=True)
class Request:
    """What the operator asked for; None takes the procedure's own value.

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


def make_plan(request: Request, *, backend: str, cast: Cast, now: datetime) -> Plan:
    """Freeze a request.

    Args:
        request: What the operator asked for.
        backend: Name of the backend.
        cast: Who plays which role.
        now: Start of the trial, part of its name.

    Raises:
        ConfigurationError: The procedure or the topology needs a role that nobody plays.
    """
    placed = (Role.SENDER, Role.RECEIVER, *((Role.RELAY,) * (request.chosen_topology is Topology.MASTER)))
    missing = request.procedure.roles().union(placed) - cast.keys()
    if missing:
        raise ConfigurationError(
            f"nobody plays {', '.join(sorted(missing))} in topology {request.chosen_topology}",
            remedy=f"name a robot under roles.{request.chosen_topology} in the site file",
        )
    procedure = request.procedure
    if request.record_s is not None:
        procedure = procedure.with_record(request.record_s)
    topology = request.chosen_topology
    stamp = now.astimezone(UTC).strftime("%Y%m%dT%H%M%S.%fZ")
    profiles = {role: robot.profile for role, robot in cast.items()}
    return Plan(
        schema_version=SCHEMA_VERSION,
        trial=f"{stamp}_{procedure.name}_{request.distance.label}_{topology}",
        versions={
            "fieldkit": __version__,
            "python": platform.python_version(),
            **{package: version(package) for package in ("numpy", "paramiko", "rosbags")},
        },
        code_sha256=code_hash(),
        profiles_sha256=_hash({role: profile.model_dump(mode="json") for role, profile in profiles.items()}),
        procedure_sha256=_hash(procedure.model_dump(mode="json")),
        backend=backend,
        seed=request.seed,
        notes=request.notes,
        topology=topology,
        distance=request.distance.label,
        distance_m=request.distance.metres,
        protocols=request.protocols or procedure.protocols,
        repeats=request.repeats or procedure.repeats,
        cast={
            role: CastMember(name=robot.name, address=robot.address, profile=robot.profile)
            for role, robot in cast.items()
        },
        procedure=procedure,
    )


def dump_plan(plan: Plan) -> str:
    """Return the text of `trial.yaml`, which `config.load` reads back as an equal plan."""
    return config.dump(plan.model_dump(mode="json", by_alias=True, exclude_none=True))


def code_hash() -> str:
    """Return the hash over fieldkit's own source files, names and contents."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parent.parent
    for path in sorted((*package.rglob("*.py"), *package.rglob("*.sh"))):
        digest.update(f"{path.relative_to(package)}\0".encode() + path.read_bytes() + b"\0")
    return digest.hexdigest()[:_HASH_DIGITS]


def _hash(data: object) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:_HASH_DIGITS]
