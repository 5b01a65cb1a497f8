"""What a step is: data from a procedure that knows its remote commands and how to carry them out."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

from fieldkit.backends import Cast, Robot
from fieldkit.config import Strict
from fieldkit.model import Protocol, Role
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell

Shells = Mapping[Role, Shell]
Announce = Callable[[str, float | None], None]
"""Told the name of a phase that begins, and how many seconds it should take where that is known."""


@dataclass(frozen=True)
class Scene:
    """One attempt at one repeat, as far as command lines depend on it.

    Attributes:
        protocol: The transport protocol under test.
        cast: Who plays which role.
        folder: The attempt's folder on every robot.
    """

    protocol: Protocol
    cast: Cast
    folder: str

    def robot(self, role: Role) -> Robot:
        """Return the robot in `role`."""
        return self.cast[role]


@dataclass(frozen=True)
class Planned:
    """A job that a step will run.

    Attributes:
        role: Whose robot runs it.
        job: The job.
        program: The tool behind the command line, which preflight looks for.
        setup: Shell files to source before looking for it.
    """

    role: Role
    job: Job
    program: str
    setup: tuple[str, ...] = ()


class Step(Strict, ABC):
    """One action of a procedure.

    `commands` is pure: `--dry-run` prints it, tests compare it with golden lines, and `run` uses the same jobs.
    """

    @abstractmethod
    def commands(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job in the order in which it starts."""

    @abstractmethod
    def run(self, scene: Scene, shells: Shells, announce: Announce) -> None:
        """Carry the step out.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A robot could not do it.
        """

    @abstractmethod
    def roles(self) -> frozenset[Role]:
        """Return the roles that the step needs."""

    @abstractmethod
    def expected_s(self, protocol: Protocol) -> float:
        """Return about how many seconds the step takes on a good link."""


T = TypeVar("T")


def together(*calls: Callable[[], T]) -> list[T]:
    """Run `calls` at once, one thread each; return their results in order, or raise the first error."""
    with ThreadPoolExecutor(max_workers=len(calls)) as pool:
        return [future.result() for future in [pool.submit(call) for call in calls]]
