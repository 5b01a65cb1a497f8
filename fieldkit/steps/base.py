"""The contract of a step: data from a procedure that owns all that its kind needs, does and leaves."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from inspect import isabstract
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Self

from fieldkit.backends.protocols import Cast, Testbed
from fieldkit.config import schema
from fieldkit.config.schema import CoreSchema, Field, Strict
from fieldkit.core import plugins
from fieldkit.core.columns import Column, Measured, Value, prefixed
from fieldkit.core.errors import ConfigurationError, RobotError
from fieldkit.core.lazy import dataclass
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.remote import jobs
from fieldkit.steps import kinds
from fieldkit.steps.scene import Announce, Flow, ListeningPort, Need, Pinging, Planned, RecordedFile, Refusal, Scene

StepName = Annotated[
    str,
    schema.shaped(r"^[a-z][a-z0-9_]{0,30}$", "a name: small letters, digits and _, a small letter first, 31 in all"),
]
FileName = Annotated[
    str, schema.shaped(r"^[a-z][a-z0-9_.-]{0,40}$", "the name of a file: small letters, digits, _ . and -, 41 in all")
]
"""What a step, and a bag, may be called."""


@dataclass(frozen=True)
class View:
    """One attempt as its measures see it.

    Attributes:
        scene: The attempt.
        evidence: What it left.
        within: The steps that the one that is measured ran inside, the outermost first.
    """

    scene: Scene
    evidence: AttemptEvidence
    within: Sequence["Nest"] = ()

    def capture(self, role: Role) -> Capture | None:
        """Return what a robot captured while the step ran; None where it did not, or its capture is not whole."""
        return self.evidence.whole_capture(capture_around(self.within, role))

    def captured(self, *roles: Role) -> bool:
        """Return whether all of these robots captured while the step ran."""
        return all(capture_around(self.within, role) is not None for role in roles)


def capture_around(within: Sequence["Nest"], role: Role) -> str | None:
    """Return the file of the innermost capture of a robot around a step; None where it does not capture.

    Args:
        within: The steps that the one that is asked about stands inside, the outermost first.
        role: Whose capture.
    """
    files = (nest.captures().get(role) for nest in reversed(within))
    return next((file for file in files if file is not None), None)


class Step(Strict, ABC):
    """One action of a procedure. Its kind owns all that there is to know of it.

    Its fields are its YAML. What plans, preflight, gates, rows and reports must know they ask here, and know no kind
    by name. `commands` is pure: `--dry-run` prints it, tests compare it with golden lines, and `run` uses the same
    jobs. To add a kind, write its module and name its class in `fieldkit.steps.kinds`, or in an entry point of the
    group `fieldkit.steps`.

    Attributes:
        columns: What steps of its kind measure.
        name: Tells it from others of its kind in one procedure; its jobs, files and columns begin with it.
    """

    columns: ClassVar[tuple[Column, ...]] = ()

    name: StepName = Field(default="", exclude_if=schema.is_empty)

    @property
    def prefix(self) -> str:
        """The name that jobs, files and columns begin with; empty where they stand for themselves."""
        return self.name

    def own_name(self, what: str) -> str:
        """Return what a job or a file of the step is called: `up.recv.bag`; `recv.bag` of a step without a name."""
        return prefixed(self.prefix, what)

    # What it does.

    @abstractmethod
    def commands(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job in the order in which it starts."""

    @abstractmethod
    def run(self, scene: Scene, testbed: Testbed, announce: Announce) -> None:
        """Carry the step out.

        Raises:
            LinkError: A robot did not answer.
            RobotError: A robot could not do it.
        """

    def prepare(self, scene: Scene, testbed: Testbed) -> Callable[[Announce], None]:
        """Bring up what must be up before the step begins, and return what carries it out.

        Who runs the step at once may do so beside work of its own, in a thread. Errors as `run`, of both.
        """
        return partial(self.run, scene, testbed)

    def own(self, scene: Scene) -> Iterator[Planned]:
        """Yield the jobs of the step itself, without those of steps inside."""
        return self.commands(scene)

    def beside(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (most steps are nothing but commands)
        """Yield what the testbed does beside the commands, in words: `--dry-run` prints it."""
        return iter(())

    def cut_short(self, scene: Scene) -> Iterator[str]:  # noqa: ARG002 (most leave robots where they are)
        """Yield in words what robots do that move where somebody stops the attempt at once."""
        return iter(())

    @abstractmethod
    def roles(self) -> frozenset[Role]:
        """Return the roles that the step needs."""

    @abstractmethod
    def expected_s(self, protocol: Protocol) -> float:
        """Return about how many seconds the step takes on a good link."""

    def with_record(self, duration_s: float) -> Self:  # noqa: ARG002 (most steps record nothing)
        """Return this step with every recording in it `duration_s` long."""
        return self

    def fitted(self, cast: Cast, way_s: float | None = None) -> Self:  # noqa: ARG002 (most ask nothing of robots)
        """Return this step with what it leaves to its robots filled in; a plan has such steps alone.

        Args:
            cast: Who plays which role.
            way_s: How long the way takes along which a robot moves meanwhile; None where none does.
        """
        return self

    def shortened(self, cast: Cast) -> Iterator[str]:  # noqa: ARG002 (most do what they say, or not at all)
        """Yield in words of what `fitted` makes less than the step says."""
        return iter(())

    # What it needs.

    def listens(self) -> tuple[ListeningPort, ...]:
        """Return where robots listen for the step, by which its packets are told from others in a capture."""
        return ()

    def restarts(self) -> frozenset[Role]:
        """Return whose robots the step restarts; where nobody is to, a restart spoils an attempt."""
        return frozenset()

    def moves(self) -> frozenset[Role]:
        """Return whose robots the step itself moves from their places."""
        return frozenset()

    def misplaced(self, earlier: Sequence["Step"], within: Sequence["Nest"]) -> str | None:  # noqa: ARG002 (most fit)
        """Return why a procedure cannot have the step where it stands, None where it can.

        Args:
            earlier: The steps that begin before it.
            within: The steps that it stands inside, the outermost first.
        """
        return None

    def asks(self) -> bool:
        """Return whether a person may be asked to do something for it, so that no other step runs beside it."""
        return False

    def refusals(self, scene: Scene) -> Iterator[Refusal]:  # noqa: ARG002 (most tools can do what they are for)
        """Yield what cannot work with the tools of the scene."""
        return iter(())

    def needs(self, scene: Scene) -> Iterator[Need]:  # noqa: ARG002 (most need programs alone)
        """Yield what the step needs of robots beside the programs of its `commands`."""
        return iter(())

    def live_topics(self, role: Role) -> tuple[str, ...]:  # noqa: ARG002 (most hear none)
        """Return the ROS topics that must be alive on the robot in `role`."""
        return ()

    def bytes_left(self, scene: Scene, role: Role) -> float:  # noqa: ARG002 (a few lines of text are counted for all)
        """Return about how many bytes the step leaves on the robot in `role`, texts apart."""
        return 0.0

    def reserve_bytes(self, scene: Scene, role: Role) -> int:  # noqa: ARG002 (most write until the disk is full)
        """Return how many bytes its programs want to find free on the robot in `role`, beside what they write."""
        return 0

    # What it sends and leaves.

    @abstractmethod
    def claims(self) -> tuple[str, ...]:
        """Return what the step has for itself in a repeat, in words: no other step of its name may have the same."""

    @abstractmethod
    def files(self) -> tuple[str, ...]:
        """Return the names of all files that the step leaves in an attempt's folder, logs too.

        A bag is named by its stem, which may be a folder, and by its stem and `.bag`: how it is really called is for
        the robot's profile to say.
        """

    def recorded(self, cast: Cast) -> Iterator[RecordedFile]:  # noqa: ARG002 (most make none)
        """Yield the files that the step makes for others to send."""
        return iter(())

    def records_on(self) -> frozenset[Role]:
        """Return the roles of `recorded`, for whom the cast is not known yet."""
        return frozenset()

    def flows(self, scene: Scene) -> Iterator[Flow]:  # noqa: ARG002 (most send nothing over the radio)
        """Yield what the step sends over the radio."""
        return iter(())

    # What that tells.

    def problems(self, view: View) -> Iterator[str]:  # noqa: ARG002 (what it declares is asked for anyway)
        """Yield the reasons for which the step's evidence is not whole, a sentence each without a full stop."""
        return iter(())

    def declared(self) -> tuple[Column, ...]:
        """Return which of its kind's columns the step measures."""
        return self.columns

    def measure(self, view: View) -> Measured:  # noqa: ARG002 (most of those that measure nothing)
        """Return the columns that the step declares: a value for each, or why there is none."""
        return Measured()

    def in_words(self, values: Mapping[str, Value]) -> Iterator[str]:  # noqa: ARG002 (not all is worth a word)
        """Yield the most important of the step's figures for people: `IP loss 3.2 %`."""
        return iter(())

    def transfer(self, scene: Scene, within: Sequence["Nest"]) -> Transfer | None:  # noqa: ARG002 (most send no file)
        """Return what tells the packets of the file that the step sends; None where it sends none.

        Args:
            scene: The attempt.
            within: The steps that it stands inside, the outermost first.
        """
        return None

    def pinging(self) -> Pinging | None:
        """Return who prints the round-trip times that the step measures, and where; None where it measures none."""
        return None


@cache
def known() -> Mapping[str, type[Step]]:
    """Return every kind of step by name, fieldkit's own first.

    Raises:
        ConfigurationError: As `kinds.load`, or what stands for a kind is no `Step`, or lacks methods of it.
    """
    found: dict[str, type[Step]] = {}
    for point, loaded in kinds.load():
        where, remedy = plugins.where(point), plugins.REMEDY
        if not (isinstance(loaded, type) and issubclass(loaded, Step)):
            raise ConfigurationError("a kind of step is a subclass of Step", where=where, remedy=remedy)
        if isabstract(loaded):
            lacking = ", ".join(sorted(loaded.__abstractmethods__))
            raise ConfigurationError(f"the kind of step lacks {lacking}", where=where, remedy=remedy)
        found[point.name] = loaded
    return MappingProxyType(found)


@dataclass(frozen=True)
class StepEntry:
    """One entry under `steps:`, a mapping with one key: the kind of step.

    Attributes:
        kind: The key.
        step: The step.
    """

    kind: str
    step: Step

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: Any) -> CoreSchema:  # noqa: ANN401 (of pydantic)
        return schema.by_kind(known, cls, lambda entry: (entry.kind, entry.step), "step")


class Nest(Step, ABC):
    """A step that others run inside.

    Attributes:
        during: The steps inside.
        disturbs: Whether the steps inside may fail because of it, so that their evidence need not be whole.
        parallel: Whether the steps inside run at the same time.
        leads: Whether it has a way along which steps inside can last.
    """

    disturbs: ClassVar[bool] = False
    parallel: ClassVar[bool] = False
    leads: ClassVar[bool] = False

    during: tuple[StepEntry, ...]

    def captures(self) -> Mapping[Role, str]:
        """Return the files of what is captured while the steps inside run, by whose packets these are."""
        return {}

    def inside(self, scene: Scene) -> Iterator[Planned]:
        """Yield every job of the steps inside, in the order in which it starts."""
        for entry in self.during:
            yield from entry.step.commands(scene)

    def own(self, scene: Scene) -> Iterator[Planned]:
        """See `Step.own`."""
        others = {(planned.role, planned.job.name) for planned in self.inside(scene)}
        return (planned for planned in self.commands(scene) if (planned.role, planned.job.name) not in others)

    def refusals(self, scene: Scene) -> Iterator[Refusal]:
        """See `Step.refusals`."""
        for entry in self.during:
            yield from entry.step.refusals(scene)

    def beside(self, scene: Scene) -> Iterator[str]:
        """See `Step.beside`."""
        for entry in self.during:
            yield from entry.step.beside(scene)

    def cut_short(self, scene: Scene) -> Iterator[str]:
        """See `Step.cut_short`."""
        for entry in self.during:
            yield from entry.step.cut_short(scene)

    def with_record(self, duration_s: float) -> Self:
        """See `Step.with_record`."""
        during = tuple(StepEntry(entry.kind, entry.step.with_record(duration_s)) for entry in self.during)
        return self.model_copy(update={"during": during})

    def fitted(self, cast: Cast, way_s: float | None = None) -> Self:
        """See `Step.fitted`."""
        during = tuple(StepEntry(entry.kind, entry.step.fitted(cast, way_s)) for entry in self.during)
        return self.model_copy(update={"during": during})

    def shortened(self, cast: Cast) -> Iterator[str]:
        """See `Step.shortened`."""
        for entry in self.during:
            yield from entry.step.shortened(cast)

    def flows_inside(self, scene: Scene) -> Iterator[Flow]:
        """Yield what the steps inside send over the radio, at any depth."""
        for entry in self.during:
            yield from entry.step.flows(scene)
            if isinstance(entry.step, Nest):
                yield from entry.step.flows_inside(scene)

    def end_inside(self, scene: Scene, testbed: Testbed) -> None:
        """End every job of the steps inside that runs.

        Raises:
            LinkError: A robot did not answer.
        """
        for planned in self.inside(scene):
            with suppress(RobotError):  # it was never started
                jobs.stop(testbed.shells[planned.role], planned.job)

    def roles_inside(self) -> frozenset[Role]:
        """Return the roles that the steps inside need."""
        return frozenset().union(*(entry.step.roles() for entry in self.during))

    def inside_s(self, protocol: Protocol) -> float:
        """Return about how many seconds the steps inside take on a good link."""
        return sum(entry.step.expected_s(protocol) for entry in self.during)
