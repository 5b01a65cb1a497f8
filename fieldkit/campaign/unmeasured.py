"""Trials of a campaign without an attempt: reports list them, so that missing conditions are not overlooked."""

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from fieldkit.campaign.plan import CAMPAIGN_FILE, CampaignPlan
from fieldkit.config import schema
from fieldkit.core.errors import FieldkitError
from fieldkit.trial import store
from fieldkit.trial.plan import PLAN_FILE
from fieldkit.trial.sources import Note


def unmeasured(paths: Iterable[Path], sources: Collection[str], note: Note) -> Iterator[str]:
    """Yield the name of each planned trial without an attempt: `nlos 60m masterless`.

    Args:
        paths: Folders of campaigns, or folders that contain campaigns, such as `trials`.
        sources: Folders of the trials that have attempts.
        note: Receives a sentence about each campaign whose plan cannot be read.
    """
    for folder in dict.fromkeys(candidate for path in paths for candidate in (path, *_below(path))):
        if (folder / CAMPAIGN_FILE).is_file():
            try:
                yield from _unmeasured(folder, sources)
            except FieldkitError as error:
                note(f"the missing trials are not known: {error.located}")


def _below(path: Path) -> list[Path]:
    return sorted(child for child in path.iterdir() if child.is_dir()) if path.is_dir() else []


def _unmeasured(folder: Path, sources: Collection[str]) -> Iterator[str]:
    plans = [
        store.read_plan(Path(source))
        for source in sources
        if Path(source).absolute().parent == folder.absolute() and (Path(source) / PLAN_FILE).is_file()
    ]
    measured = {(plan.procedure.name, plan.topology, plan.distance_m) for plan in plans}
    for trial in schema.load(folder / CAMPAIGN_FILE, CampaignPlan).trials():
        if (trial.procedure, trial.topology, trial.distance.metres) not in measured:
            yield str(trial)
