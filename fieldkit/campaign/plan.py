"""The plan of a campaign: its trials in order, frozen in its folder when it starts."""

import hashlib
import secrets
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from fieldkit.analysis import expectations
from fieldkit.campaign import order
from fieldkit.campaign.order import PlannedTrial
from fieldkit.config import schema
from fieldkit.config.schema import AfterValidator, Document, Duration, Field, Int, Length, Span, Strict
from fieldkit.core import laptop_files
from fieldkit.core.errors import ConfigurationError, FieldkitError
from fieldkit.core.model import Protocol, Topology
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.procedure import Procedure, Repeats, load_procedure
from fieldkit.trial.stored import plans
from fieldkit.trial.stored.sources import Note

CAMPAIGN_FILE: Final = laptop_files.CAMPAIGN

Item = TypeVar("Item")


def _require_distinct(key: Callable[[Item], Hashable]) -> AfterValidator:
    def check(items: tuple[Item, ...]) -> tuple[Item, ...]:
        if len({key(item) for item in items}) < len(items):
            raise schema.validation_error("an entry occurs twice")
        return items

    return AfterValidator(check)


_NONEMPTY_AND_DISTINCT: Final = (Field(min_length=1), _require_distinct(lambda item: item))


class Exclusion(Strict):
    """Excluded trials of a campaign: all trials that match every given key.

    Attributes:
        procedure: Name of a procedure.
        topology: A topology.
        distance: One of the campaign's distances.
    """

    procedure: str | None = None
    topology: Topology | None = None
    distance: Span | None = None

    def matches(self, trial: PlannedTrial) -> bool:
        """Return True if the trial is excluded."""
        return (
            self.procedure in {None, trial.procedure}
            and self.topology in {None, trial.topology}
            and (self.distance is None or self.distance.metres == trial.distance.metres)
        )


class CampaignFile(Strict):
    """The file of `fieldkit campaign`: trials of every procedure at every distance in every topology.

    How to write a campaign file: [campaign](campaign.md).

    Attributes:
        name: Letters, digits, `-` and `_`; the folder is `campaign_NAME`.
        procedures: List of procedures; each determines its scenario.
        distances: List of distances.
        topologies: List of `master`, `masterless`.
        protocols: List of `tcp`, `udp`; if empty, the protocols of each procedure.
        repeats: Repeats per protocol; by default the repeats of each procedure.
        record: Duration of every recording; by default the duration in each procedure.
        seed: Seed of the order and of all randomness in the trials, from 0. Campaigns with the same seed draw the
            same numbers.
        walk: Maximum distance over which the robots are carried in total, `300m`; without it, three times the
            shortest path.
        left_out: List of exclusions: trials that match every key of an entry are excluded.
        expect: [Expectations](values.md#expectations). Each applies to every trial that measures its quantity, in
            addition to the expectations of the trial's procedure.
    """

    name: Annotated[
        str, schema.pattern_field(r"^[A-Za-z0-9][A-Za-z0-9_-]{0,60}$", "a name: at most 61 letters, digits, - and _")
    ]
    procedures: Annotated[tuple[str, ...], *_NONEMPTY_AND_DISTINCT]
    distances: Annotated[tuple[Span, ...], Field(min_length=1), _require_distinct(lambda distance: distance.metres)]
    topologies: Annotated[tuple[Topology, ...], *_NONEMPTY_AND_DISTINCT]
    protocols: Annotated[tuple[Protocol, ...], _require_distinct(lambda item: item)] = ()
    repeats: Repeats | None = None
    record: Annotated[Duration, Field(gt=0)] | None = None
    seed: Annotated[Int, Field(ge=0, lt=10**15)]
    walk: Length | None = None
    left_out: tuple[Exclusion, ...] = Field(default=(), alias="except")
    expect: tuple[str, ...] = Field(default=(), exclude_if=schema.is_empty)


def load_campaign(path: Path) -> tuple[CampaignFile, Document]:
    """Return a campaign file and its parsed document, which locates errors by line.

    Raises the same errors as `schema.load`.
    """
    document = schema.read(path)
    return schema.validate(document, CampaignFile), document


def load_procedures(campaign: CampaignFile, document: Document) -> tuple[Procedure, ...]:
    """Return the procedures of a campaign, with the campaign's expectations of figures that they measure.

    Raises:
        ConfigurationError: A procedure cannot be loaded (see `load_procedure`), an expectation is invalid, or no
            procedure measures its figure.
    """
    procedures = []
    for index, name in enumerate(campaign.procedures):
        with document.locating_errors("procedures", index):
            procedures.append(load_procedure(name))
    for index, text in enumerate(campaign.expect):
        with document.locating_errors("expect", index):
            procedures = _with_expectation(procedures, text)
    return tuple(procedures)


def _with_expectation(procedures: Sequence[Procedure], text: str) -> list[Procedure]:
    """Return the procedures, with the expectation added to each procedure that measures its figure.

    Raises:
        ConfigurationError: The text is not an expectation, or no procedure measures the figure.
    """
    quantity = expectations.parse(text, (figure for procedure in procedures for figure in procedure.figures)).quantity
    return [
        procedure.model_copy(update={"expect": (*procedure.expect, text)})
        if quantity in {figure.name for figure in procedure.figures}
        else procedure
        for procedure in procedures
    ]


def trials_of(
    campaign: CampaignFile, procedures: Sequence[Procedure], document: Document
) -> tuple[PlannedTrial, ...]:
    """Return the trials of a campaign in the order of its file.

    Raises:
        ConfigurationError: An entry under `except` excludes no trial, or all trials are excluded.
    """
    combinations = [
        PlannedTrial(procedure.name, procedure.scenario, topology, distance)
        for topology in campaign.topologies
        for procedure in procedures
        for distance in campaign.distances
    ]
    for index, exclusion in enumerate(campaign.left_out):
        if not any(map(exclusion.matches, combinations)):
            raise ConfigurationError(
                "this entry excludes nothing: no trial of the campaign matches it",
                where=document.where(("except", index)),
                remedy="use values of procedures, topologies and distances",
            )
    included = tuple(trial for trial in combinations if not _is_excluded(trial, campaign.left_out))
    if not included:
        raise ConfigurationError(
            "except excludes every trial", where=document.where(("except",)), remedy="exclude fewer trials"
        )
    return included


def _is_excluded(trial: PlannedTrial, exclusions: Iterable[Exclusion]) -> bool:
    return any(exclusion.matches(trial) for exclusion in exclusions)


class CampaignPlan(Strict):
    """A campaign's frozen inputs, `campaign.yaml` in its folder.

    Attributes:
        file_sha256: Hash of the campaign file.
        backend: Name of the backend.
        session: Identifies the campaign in the robots' locks.
        campaign: The campaign file.
        procedures: Its procedures.
        order: The names of its trials, in the order of execution.
    """

    file_sha256: str
    backend: str
    session: str
    campaign: CampaignFile
    procedures: tuple[Procedure, ...]
    order: tuple[str, ...]

    def trials(self) -> tuple[PlannedTrial, ...]:
        """Return the trials in order."""
        trials_by_name = {str(trial): trial for trial in trials_of(self.campaign, self.procedures, _empty_document())}
        return tuple(trials_by_name[name] for name in self.order)

    def procedure(self, trial: PlannedTrial) -> Procedure:
        """Return the procedure of a trial."""
        return next(procedure for procedure in self.procedures if procedure.name == trial.procedure)


def make_plan(path: Path, backend: str) -> tuple[CampaignPlan, Document]:
    """Return the plan of a campaign file and the parsed document, which locates errors by line.

    Raises:
        ConfigurationError: The file is invalid (see `load_campaign`, `load_procedures` and `trials_of`), or `walk` is
            too short for any order.
    """
    campaign, document = load_campaign(path)
    procedures = load_procedures(campaign, document)
    trials = trials_of(campaign, procedures, document)
    shortest_m = order.walk_m(order.shortest(trials))
    limit_m = order.DEFAULT_WALK * shortest_m if campaign.walk is None else campaign.walk
    if limit_m < shortest_m:
        raise ConfigurationError(
            f"the shortest path through all places is {shortest_m:.1f} m, but walk allows only {limit_m:g} m",
            where=document.where(("walk",)),
            remedy=f"walk: {shortest_m + 0.05:.1f}m allows only ascending or descending distances; "
            "twice that allows a random order",
        )
    plan = CampaignPlan(
        file_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        backend=backend,
        session=secrets.token_hex(8),
        campaign=campaign,
        procedures=procedures,
        order=tuple(map(str, order.shuffle(trials, seed=campaign.seed, limit_m=limit_m))),
    )
    return plan, document


def started_plan(folder: Path, current_plan: CampaignPlan, document: Document) -> CampaignPlan | None:
    """Return the frozen plan of the campaign in `folder`, or None if it has not started.

    Args:
        folder: The campaign's folder.
        current_plan: The plan made from the current file.
        document: The document of the file.

    Raises:
        ConfigurationError: The file has changed since the start, or campaign.yaml was edited.
    """
    if not (folder / CAMPAIGN_FILE).is_file():
        return None
    plan = schema.load(folder / CAMPAIGN_FILE, CampaignPlan)
    frozen_values, current_values = _fixed_values(plan), _fixed_values(current_plan)
    changed_keys = [key for key in current_values if current_values[key] != frozen_values[key]]
    if changed_keys:
        raise ConfigurationError(
            f"these have changed since the campaign started: {', '.join(changed_keys)}",
            where=document.where((changed_keys[0],)),
            remedy=f"undo that ({folder / CAMPAIGN_FILE} has the old values), or change name: to start another "
            "campaign",
        )
    return plan


def _fixed_values(plan: CampaignPlan) -> dict[str, Any]:
    """Return the values that must not change during a campaign, by their key in the file or a description."""
    data = plan.model_dump(mode="json", by_alias=True)
    return {**data["campaign"], "a file of its procedures": data["procedures"], "backend": data["backend"]}


def _empty_document() -> Document:
    return Document(data=None, source=CAMPAIGN_FILE, lines={})


def unmeasured(paths: Iterable[Path], sources: Collection[str], note: Note) -> Iterator[str]:
    """Yield the name of each planned trial without an attempt: `nlos 60m masterless`.

    Args:
        paths: Folders of campaigns, or folders that contain campaigns, such as `trials`.
        sources: Folders of the trials that have attempts.
        note: Receives a sentence about each campaign whose plan cannot be read.
    """
    for folder in dict.fromkeys(candidate for path in paths for candidate in (path, *_subfolders(path))):
        if (folder / CAMPAIGN_FILE).is_file():
            try:
                yield from _unmeasured_trials(folder, sources)
            except FieldkitError as error:
                note(f"cannot determine which trials are missing: {error.located}")


def _subfolders(path: Path) -> list[Path]:
    return sorted(child for child in path.iterdir() if child.is_dir()) if path.is_dir() else []


def _unmeasured_trials(folder: Path, sources: Collection[str]) -> Iterator[str]:
    measured_plans = [
        plans.read_plan(Path(source))
        for source in sources
        if Path(source).absolute().parent == folder.absolute() and (Path(source) / PLAN_FILE).is_file()
    ]
    measured_conditions = {(plan.procedure.name, plan.topology, plan.distance_m) for plan in measured_plans}
    for trial in schema.load(folder / CAMPAIGN_FILE, CampaignPlan).trials():
        if (trial.procedure, trial.topology, trial.distance.metres) not in measured_conditions:
            yield str(trial)
