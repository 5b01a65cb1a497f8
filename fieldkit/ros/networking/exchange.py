"""Exchange of test datagrams between all robots: multicast, unicast, and unicast in fragments."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, Final, cast

from fieldkit.agent import datagrams
from fieldkit.agent.datagrams import DatagramPorts
from fieldkit.backends.protocols import Cast
from fieldkit.core.deadline import Deadline
from fieldkit.core.errors import FieldkitError, RobotError
from fieldkit.core.model import Role
from fieldkit.core.threads import run_parallel
from fieldkit.remote import agent, evidence, jobs
from fieldkit.remote.jobs import Job
from fieldkit.ros.middlewares import ports as middleware_ports
from fieldkit.steps import agent_commands
from fieldkit.steps.scene import Shells

COUNT: Final = 20
"""Number of datagrams of each kind that a robot sends."""
INTERVAL_S: Final = 0.05

_PARTICIPANT_ID: Final = 119
"""Highest participant ID of a domain (RTPS 2.5, section 9.6.2.3). No ROS program on a robot has an ID that high, so
its port is free."""
_MULTICAST_GROUP: Final = "239.255.0.1"
"""Multicast group that DDS uses for discovery."""
_SEND_TIMEOUT_S: Final = 30.0
_READ_TIMEOUT_S: Final = 10.0
"""Timeouts for sending the datagrams of one robot, and for reading its counts."""
_COUNTS_FILE: Final = "counts.json"


@dataclass(frozen=True)
class Arrivals:
    """Test datagrams of one robot that arrived at another.

    Attributes:
        counts: Number of arrived datagrams by kind (`datagrams.SIZES`), out of `COUNT`; kinds without arrivals are
            omitted.
        error: The reason why the numbers are unknown; empty if they are known.
    """

    counts: Mapping[str, int]
    error: str = ""


def multicast_port(domain: int) -> int:
    """Return the port of multicast test datagrams; the participants of the DDS domain listen on it, too."""
    return min(middleware_ports.dds(domain, multicast=True).discovery)


def unicast_port(domain: int) -> int:
    """Return the port of unicast test datagrams."""
    # RTPS: the discovery port of a participant is d1 (10) and PG (2) times its ID above the multicast port.
    return multicast_port(domain) + 10 + 2 * _PARTICIPANT_ID


def exchange(cast: Cast, shells: Shells, domain: int, trial: str) -> dict[tuple[Role, Role], Arrivals]:
    """Send test datagrams from each robot to all others, one robot after the other.

    Args:
        cast: The robots.
        shells: Their shells.
        domain: ROS domain whose ports are used.
        trial: Name of the trial; the folder of that name on the robots is deleted afterwards.

    Returns:
        The arrivals by source and destination. They contain the error if a robot failed.
    """
    exchange_run = _Exchange(cast, shells, domain, trial)
    try:
        run_parallel(exchange_run.listen, cast)
        for role in cast:
            exchange_run.send(role)
    finally:
        run_parallel(exchange_run.end, cast)
    return {
        (source, destination): exchange_run.arrivals(source, destination)
        for source in cast
        for destination in cast
        if source is not destination
    }


class _Exchange:
    """An exchange in progress. The arguments are those of the function `exchange`."""

    def __init__(self, cast: Cast, shells: Shells, domain: int, trial: str) -> None:
        self._cast = cast
        self._shells = shells
        self._domain = domain
        self._trial = trial
        self._errors: dict[Role, str] = {}
        self._counts: dict[Role, Mapping[str, Mapping[str, int]]] = {}

    def listen(self, role: Role) -> None:
        """Start counting datagrams on a robot."""
        shell, job = self._shells[role], self._counting_job(role)
        with self._store_error(role):
            evidence.begin(shell, job.folder, role, self._cast[role].profile.radio.interface)
            agent.install(shell)
            jobs.start(shell, job)

    def send(self, role: Role) -> None:
        """Send datagrams from a robot to all others."""
        peers = [robot.address for other, robot in self._cast.items() if other is not role]
        argv = agent_commands.python(
            self._cast[role], agent.path_from_home(), "datagrams", self._arguments(role, peers=peers)
        )
        with self._store_error(role):
            self._shells[role].run(argv, deadline=Deadline.after(_SEND_TIMEOUT_S))

    def end(self, role: Role) -> None:
        """Stop counting on a robot, read the counts, and delete the files of the exchange."""
        shell, job = self._shells[role], self._counting_job(role)
        with self._store_error(role):
            try:
                jobs.stop(shell, job)
                counts = shell.run(("cat", f"{job.folder}/{_COUNTS_FILE}"), deadline=Deadline.after(_READ_TIMEOUT_S))
                self._counts[role] = parse_counts(counts.stdout)
            finally:
                evidence.discard(shell, self._trial)

    def arrivals(self, source: Role, destination: Role) -> Arrivals:
        """Return the test datagrams of one robot that arrived at another."""
        for role in (source, destination):
            if role in self._errors:
                return Arrivals({}, f"{self._cast[role].name}: {self._errors[role]}")
        return Arrivals(self._counts[destination].get(self._cast[source].address, {}))

    def _counting_job(self, role: Role) -> Job:
        robot = self._cast[role]
        limit_s = 2 * _SEND_TIMEOUT_S * len(self._cast)
        arguments = self._arguments(role, limit_s=limit_s)
        return Job(
            folder=jobs.work_folder(self._trial, "datagrams"),
            name="datagrams",
            argv=agent_commands.agent_command(robot, "datagrams", arguments),
            limit_s=limit_s,
            log="datagrams.log",
            stdout=_COUNTS_FILE,
            ready="log:up",
            ready_s=jobs.AGENT_READY_S,
        )

    def _arguments(self, role: Role, *, peers: list[str] | None = None, limit_s: float = 0.0) -> str:
        ports = DatagramPorts(
            address=self._cast[role].address,
            group=_MULTICAST_GROUP,
            multicast_port=multicast_port(self._domain),
            unicast_port=unicast_port(self._domain),
            token=self._trial[:32],
        )
        options = {"peers": peers or [], "count": COUNT, "interval_s": INTERVAL_S, "limit_s": limit_s}
        return agent_commands.compact({"ports": asdict(ports), **options})

    @contextmanager
    def _store_error(self, role: Role) -> Iterator[None]:
        """Catch errors in the body. The first error of a robot is stored for `arrivals`."""
        try:
            yield
        except FieldkitError as error:
            self._errors.setdefault(role, error.what)


def parse_counts(output: bytes) -> dict[str, dict[str, int]]:
    """Return the counts by address of the sender and kind from the output of a robot.

    Raises:
        RobotError: The output has another form.
    """
    try:
        counts = json.loads(output)
    except (ValueError, RecursionError):
        counts = None
    if not _is_valid(counts):
        raise RobotError("its agent sent no counts of datagrams", remedy="fieldkit check --ros   # again")
    return cast("dict[str, dict[str, int]]", counts)


def _is_valid(counts: Any) -> bool:  # noqa: ANN401 (any JSON value)
    return isinstance(counts, dict) and all(
        isinstance(by_kind, dict)
        and all(
            kind in datagrams.SIZES and type(count) is int and 0 <= count <= COUNT for kind, count in by_kind.items()
        )
        for by_kind in counts.values()
    )
