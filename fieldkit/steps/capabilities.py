"""Optional capabilities of a step, in addition to the contract of `Step`.

Each capability is a class with one method, or with several that belong together. The code that plans, runs and
evaluates trials uses `isinstance` to find the steps with a capability, and ignores other steps. A kind that ships
with fieldkit derives from its capabilities, so that mypy checks the signatures of its methods. For a kind of another
package it is enough to define the methods.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, Self

from typing_extensions import override

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.core.columns import Value
from fieldkit.core.model import Role
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.steps.scene import Announce, Flow, ListeningPort, Need, PingSource, RecordedFile, Refusal, Scene
from fieldkit.steps.surroundings import EarlierStep, EnclosingStep


class Capability(ABC):  # noqa: B024 (its subclasses have the abstract methods)
    """Base class of capabilities: a class has a capability if it derives from it or defines all of its methods.

    It is not a `typing.Protocol`, because the metaclass of protocols conflicts with the metaclass of pydantic models.
    """

    @classmethod
    @override
    def __subclasshook__(cls, candidate: type) -> bool:
        # Classes of steps inherit this method, but it applies to the capabilities only.
        if Capability in cls.__bases__ and not _undefined_methods(cls, candidate):
            return True
        return NotImplemented  # type: ignore[no-any-return]


# Execution.


class Prepares(Capability):
    """A step with processes that must be ready before it, such as a listener."""

    @abstractmethod
    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Start the processes; return the function that runs the step.

        A capture calls it in a thread while tcpdump starts. Both functions raise the errors of `Step.run`.
        """


class DescribesActions(Capability):
    """A step with actions that are not commands on a robot."""

    @abstractmethod
    def dry_run_notes(self, scene: Scene) -> Iterator[str]:
        """Yield a line for each such action, without the actions of the steps inside; `--dry-run` prints them."""


class Moves(Capability):
    """A step that moves robots from their places."""

    @abstractmethod
    def moves(self) -> frozenset[Role]:
        """Return the roles of these robots."""

    @abstractmethod
    def abort_notes(self, scene: Scene) -> Iterator[str]:
        """Yield a sentence for each of these robots about its behaviour if the attempt is stopped immediately."""


class Roams(Capability):
    """A step during which robots may change their access point, and with it the channel.

    Any other change of a robot's channel makes an attempt void.
    """

    @abstractmethod
    def roams(self) -> frozenset[Role]:
        """Return the roles of these robots."""


class Restarts(Capability):
    """A step that restarts robots. Any other restart makes an attempt void."""

    @abstractmethod
    def restarts(self) -> frozenset[Role]:
        """Return the roles of these robots."""


class AsksOperator(Capability):
    """A step that may prompt the operator."""

    @abstractmethod
    def may_prompt(self) -> bool:
        """Return True if the step may prompt the operator; then no other step may run at the same time."""


# Settings, and position in the procedure.


class DependsOnCast(Capability):
    """A step with settings that depend on the robots."""

    @abstractmethod
    def resolved(self, cast: Cast, path_s: float | None = None) -> Self:
        """Return this step with the values of these settings. A plan contains only resolved steps.

        Args:
            cast: The robot in each role.
            path_s: Duration of the path of the robot that moves during the step, in seconds; None if no robot moves.
        """


class ReducesSettings(Capability):
    """A step whose method `resolved` may reduce settings."""

    @abstractmethod
    def adjustments(self, cast: Cast) -> Iterator[str]:
        """Yield a sentence for each setting that is reduced."""


class ChecksPlacement(Capability):
    """A step that is not allowed everywhere in a procedure."""

    @abstractmethod
    def placement_error(self, earlier: Sequence[EarlierStep], within: Sequence[EnclosingStep]) -> str | None:
        """Return the reason why the step is not allowed at its position in the procedure; None if it is.

        Args:
            earlier: The steps that start before it.
            within: The steps around it, the outermost first.
        """


# Requirements.


class HasRefusals(Capability):
    """A step that cannot work with every tool or limit of a robot."""

    @abstractmethod
    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """Yield the reasons why the step cannot work on its robots, without the reasons of the steps inside."""


class HasNeeds(Capability):
    """A step that needs permissions or settings on robots."""

    @abstractmethod
    def needs(self, scene: Scene) -> Iterator[Need]:
        """Yield the preflight checks of the step, in addition to the search for the programs of its `jobs`."""


class Subscribes(Capability):
    """A step that subscribes to ROS topics."""

    @abstractmethod
    def live_topics(self, role: Role) -> tuple[str, ...]:
        """Return the ROS topics that must be published on the robot in `role`."""


class UsesSpace(Capability):
    """A step that writes more than small text files on robots."""

    @abstractmethod
    def stored_bytes(self, scene: Scene, role: Role) -> float:
        """Return the approximate size of its files on the robot in `role`, in bytes, without small text files."""


class ReservesSpace(Capability):
    """A step whose programs need free disk space beyond their output."""

    @abstractmethod
    def reserve_bytes(self, scene: Scene, role: Role) -> int:
        """Return this space on the robot in `role`, in bytes."""


# Traffic and files.


class Listens(Capability):
    """A step that listens on ports."""

    @abstractmethod
    def listens(self) -> tuple[ListeningPort, ...]:
        """Return the listening ports of the step, which identify its packets in a capture."""


class SendsTraffic(Capability):
    """A step with traffic on the radio."""

    @abstractmethod
    def flows(self, scene: Scene) -> Iterator[Flow]:
        """Yield the traffic of the step on the radio, without the traffic of the steps inside."""


class SendsFile(Capability):
    """A step that sends a file."""

    @abstractmethod
    def transfer(self, scene: Scene, within: Sequence[EnclosingStep]) -> Transfer | None:
        """Return the transfer of the file, with its ports, addresses and captures; None if the step sends no file.

        Args:
            scene: The attempt.
            within: The steps around it, the outermost first.
        """


class Pings(Capability):
    """A step that measures round-trip times."""

    @abstractmethod
    def ping_source(self) -> PingSource | None:
        """Return the source of the step's round-trip times; None if it measures none."""


class Records(Capability):
    """A step that records files, which other steps may send."""

    @abstractmethod
    def recordings(self, cast: Cast) -> Iterator[RecordedFile]:
        """Yield the recordings of the step."""

    @abstractmethod
    def records_on(self) -> frozenset[Role]:
        """Return the roles of `recordings`, which do not depend on the cast."""

    @abstractmethod
    def with_record(self, duration_s: float) -> Self:
        """Return this step with recordings of the duration `duration_s`."""


class WritesOnLaptop(Capability):
    """A step with files that the laptop writes."""

    @abstractmethod
    def laptop_files(self) -> tuple[str, ...]:
        """Return the names in `Step.files` of files that the laptop writes.

        `fieldkit.core.laptop_files` defines these names.
        """


# Measurements.


class Summarizes(Capability):
    """A step with important figures."""

    @abstractmethod
    def summary(self, values: Mapping[str, Value]) -> Iterator[str]:
        """Yield the most important figures for the line of a repeat: `IP packet loss 3.2 %`.

        Parts with the word `loss` come first in that line.
        """


CAPABILITIES: Final[tuple[type[Capability], ...]] = tuple(Capability.__subclasses__())


def missing_methods(kind: type) -> tuple[str, ...]:
    """Return the missing methods of all capabilities that a class defines only in part, sorted.

    fieldkit never calls the methods of a capability that is defined only in part.
    """
    missing = set[str]()
    for capability in CAPABILITIES:
        undefined_methods = _undefined_methods(capability, kind)
        if undefined_methods < _methods(capability):
            missing |= undefined_methods
    return tuple(sorted(missing))


def _methods(capability: type[Capability]) -> frozenset[str]:
    return frozenset(name for name in vars(capability) if not name.startswith("_"))


def _undefined_methods(capability: type[Capability], candidate: type) -> frozenset[str]:
    """Return the methods of a capability that a class does not define."""
    return frozenset(name for name in _methods(capability) if not callable(getattr(candidate, name, None)))
