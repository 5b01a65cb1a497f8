"""What a step is: data from a procedure that knows its remote commands and how to carry them out."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, TypeVar

from fieldkit.backends.protocols import Cast, Robot, Testbed
from fieldkit.config.schema import Strict
from fieldkit.core.model import Protocol, Role
from fieldkit.remote.jobs import Job
from fieldkit.remote.shell import Shell
from fieldkit.steps import variants
from fieldkit.steps.variants import Tool, Variants

if TYPE_CHECKING:
    from fieldkit.steps import Entry

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
        bags: The bag that the procedure records on each robot, in `folder`.
        variants: Which tools the robots have, where that was looked up.
        here: The attempt's folder on this machine, for what no robot can know; None where no attempt is made.
    """

    protocol: Protocol
    cast: Cast
    folder: str
    bags: Mapping[Role, str] = field(default_factory=lambda: MappingProxyType({}))
    variants: Mapping[Role, Variants] = field(default_factory=lambda: MappingProxyType({}))
    here: Path | None = None

    def robot(self, role: Role) -> Robot:
        """Return the robot in `role`."""
        return self.cast[role]

    def tools(self, role: Role) -> Variants:
        """Return the tools of the robot in `role`: those found, or those that its profile lets expect."""
        return self.variants.get(role) or variants.expected(self.cast[role].profile)


@dataclass(frozen=True)
class Planned:
    """A job that a step will run.

    Attributes:
        role: Whose robot runs it.
        job: The job.
        program: The tool behind the command line, which preflight looks for.
        setup: Shell files to source before looking for it.
        tool: Which tool that is, if it is one that has variants.
    """

    role: Role
    job: Job
    program: str
    setup: tuple[str, ...] = ()
    tool: Tool | None = None


@dataclass(frozen=True)
class Refusal:
    """Why a step cannot work with the tools that a robot has.

    Attributes:
        role: Whose robot.
        what: Why not, in one sentence without a full stop.
        remedy: What to do about it.
    """

    role: Role
    what: str
    remedy: str


class Step(Strict, ABC):
    """One action of a procedure.

    `commands` is pure: `--dry-run` prints it, tests compare it with golden lines, and `run` uses the same jobs.
    """

    @abstractmethod
    def commands(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job in the order in which it starts."""

    def refusals(self, scene: Scene) -> Iterator[Refusal]:  # noqa: ARG002 (most tools can do what they are for)
        """Yield what cannot work with the tools of the scene."""
        return iter(())

    def beside(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (most steps are nothing but commands)
        """Yield what the lab does beside the commands, in words: `--dry-run` prints it."""
        return iter(())

    @abstractmethod
    def run(self, scene: Scene, lab: Testbed, announce: Announce) -> None:
        """Carry the step out.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A robot could not do it.
        """

    @abstractmethod
    def roles(self) -> frozenset[Role]:
        """Return the roles that the step needs."""

    @abstractmethod
    def leaves(self) -> tuple[str, ...]:
        """Return what the step leaves of a repeat, in words: jobs and files that no other step of it may share."""

    @abstractmethod
    def expected_s(self, protocol: Protocol) -> float:
        """Return about how many seconds the step takes on a good link."""


class Nest(Step, ABC):
    """A step that others run inside.

    Attributes:
        during: The steps inside.
    """

    during: tuple["Entry", ...]

    def inside(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job of the steps inside, in the order in which it starts."""
        for entry in self.during:
            yield from entry.step.commands(scene)

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`."""
        for entry in self.during:
            yield from entry.step.refusals(scene)

    def beside(self, scene: Scene) -> Iterator[str]:
        """See `Step.beside`."""
        for entry in self.during:
            yield from entry.step.beside(scene)

    def roles_inside(self) -> frozenset[Role]:
        """Return the roles that the steps inside need."""
        return frozenset().union(*(entry.step.roles() for entry in self.during))

    def inside_s(self, protocol: Protocol) -> float:
        """Return about how many seconds the steps inside take on a good link."""
        return sum(entry.step.expected_s(protocol) for entry in self.during)


Item = TypeVar("Item")
T = TypeVar("T")

_HUNG_UP_S: Final = 10.0
_WAKE_S: Final = 0.5


def together(
    call: Callable[[Item], T], items: Collection[Item], *, hang_up: Callable[[], None] | None = None
) -> list[T]:
    """Call `call` with each of `items` at once, one thread each; return the results, or raise the first error.

    Ctrl-C does not wait for the threads: who catches it ends what they wait for. With `hang_up`, which ends that, it
    does for a while, so that what they write is not touched before.
    """
    # Made before any thread is: Ctrl-C in the midst of starting one must not lose sight of it.
    futures: list[Future[T]] = [Future() for _ in items]
    try:
        for future, item in zip(futures, items, strict=True):
            Thread(target=_answer, args=(future, call, item), daemon=True).start()
        # Python sees a Ctrl-C that came just before it blocked only when it wakes.
        while wait(futures, _WAKE_S).not_done:
            continue
    except BaseException:
        if hang_up is not None:
            running = [future for future in futures if not future.cancel()]
            hang_up()
            wait(running, _HUNG_UP_S)
        raise
    return [future.result() for future in futures]


def _answer(future: Future[T], call: Callable[[Item], T], item: Item) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(call(item))
    except BaseException as error:  # noqa: BLE001 (whoever asks for the result gets it)
        future.set_exception(error)
