"""The campaign file: which trials there are to be."""

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, TypeVar

from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Document, Duration, Field, Int, Length, Span, Strict
from fieldkit.core.errors import ConfigurationError
from fieldkit.core.model import Distance, Placement, Protocol, Scenario, Topology
from fieldkit.trial.procedure import Procedure, load_procedure

Item = TypeVar("Item")


def _distinct(key: Callable[[Item], Hashable]) -> AfterValidator:
    def check(items: tuple[Item, ...]) -> tuple[Item, ...]:
        if len({key(item) for item in items}) < len(items):
            raise schema.complaint("something is named twice")
        return items

    return AfterValidator(check)


_ONCE: Final = (Field(min_length=1), _distinct(lambda item: item))


@dataclass(frozen=True)
class Turn:
    """One trial of a campaign; `str` gives the name by which campaign.yaml and people call it, `los 30ft master`.

    Attributes:
        procedure: Name of its procedure.
        scenario: The procedure's.
        topology: Topology.
        distance: Distance.
    """

    procedure: str
    scenario: Scenario
    topology: Topology
    distance: Distance

    @property
    def placement(self) -> Placement:
        """Where the robots are to stand."""
        return Placement(self.scenario, self.topology, self.distance)

    def __str__(self) -> str:
        return f"{self.procedure} {self.distance.label} {self.topology}"


class LeftOut(Strict):
    """Trials that a campaign leaves out: those that agree with everything named here.

    Attributes:
        procedure: Name of a procedure.
        topology: A topology.
        distance: One of the campaign's distances.
    """

    procedure: str | None = None
    topology: Topology | None = None
    distance: Span | None = None

    def covers(self, turn: Turn) -> bool:
        """Return whether it leaves out a trial."""
        return (
            self.procedure in {None, turn.procedure}
            and self.topology in {None, turn.topology}
            and (self.distance is None or self.distance.metres == turn.distance.metres)
        )


class Campaign(Strict):
    """A campaign file: trials of every procedure at every distance in every topology.

    Attributes:
        name: Part of the folder's name.
        procedures: Names of procedures; each brings its scenario.
        distances: Distances.
        topologies: Topologies.
        protocols: Protocols; empty takes each procedure's.
        repeats: Per protocol; None takes each procedure's.
        record: Duration of every recording, in seconds; None takes each procedure's.
        seed: Seed of the order, and of everything random in the trials.
        walk: How far people walk between the places at most, in metres; None for three times the shortest way.
        left_out: Trials that are left out.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,60}$")]
    procedures: Annotated[tuple[str, ...], *_ONCE]
    distances: Annotated[tuple[Span, ...], Field(min_length=1), _distinct(lambda one: one.metres)]
    topologies: Annotated[tuple[Topology, ...], *_ONCE]
    protocols: Annotated[tuple[Protocol, ...], _distinct(lambda item: item)] = ()
    repeats: Annotated[Int, Field(gt=0)] | None = None
    record: Annotated[Duration, Field(gt=0)] | None = None
    seed: Annotated[Int, Field(ge=0)]
    walk: Length | None = None
    left_out: tuple[LeftOut, ...] = Field(default=(), alias="except")


def load_campaign(path: Path) -> tuple[Campaign, Document]:
    """Return a campaign file, and its document for messages with lines; errors as `schema.load`."""
    document = schema.read(path)
    return schema.validate(document, Campaign), document


def load_procedures(campaign: Campaign, document: Document) -> tuple[Procedure, ...]:
    """Return the procedures of a campaign.

    Raises:
        ConfigurationError: As `load_procedure`; one that does not exist is named with its line.
    """
    found = []
    for index, name in enumerate(campaign.procedures):
        try:
            found.append(load_procedure(name))
        except ConfigurationError as error:
            where = error.where or document.where(("procedures", index))
            raise ConfigurationError(error.what, where=where, remedy=error.remedy) from error
    return tuple(found)


def turns(campaign: Campaign, procedures: Sequence[Procedure], document: Document) -> tuple[Turn, ...]:
    """Return the trials of a campaign in the order of its file.

    Raises:
        ConfigurationError: An entry under `except` leaves out nothing, or nothing is left.
    """
    every = [
        Turn(procedure.name, procedure.scenario, topology, distance)
        for topology in campaign.topologies
        for procedure in procedures
        for distance in campaign.distances
    ]
    for index, left_out in enumerate(campaign.left_out):
        if not any(map(left_out.covers, every)):
            raise ConfigurationError(
                "this leaves out no trial: the campaign has none like it",
                where=document.where(("except", index)),
                remedy="name what stands under procedures, topologies and distances",
            )
    kept = tuple(turn for turn in every if not _covered(turn, campaign.left_out))
    if not kept:
        raise ConfigurationError(
            "except leaves out every trial", where=document.where(("except",)), remedy="leave out fewer"
        )
    return kept


def _covered(turn: Turn, left_out: Iterable[LeftOut]) -> bool:
    return any(one.covers(turn) for one in left_out)
