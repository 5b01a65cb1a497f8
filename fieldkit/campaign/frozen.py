"""What a campaign was begun with: `campaign.yaml` in its folder, and that it is still so."""

import hashlib
import secrets
from pathlib import Path
from typing import Any, Final

from fieldkit.campaign import order
from fieldkit.campaign.file import Campaign, Turn, load_campaign, load_procedures, turns
from fieldkit.config import schema
from fieldkit.config.schema import Document, Strict
from fieldkit.core.errors import ConfigurationError
from fieldkit.trial.procedure import Procedure

FROZEN_FILE: Final = "campaign.yaml"


class Frozen(Strict):
    """A campaign's frozen inputs.

    Attributes:
        file_sha256: Hash of the campaign file.
        backend: Where the robots come from.
        session: Names the campaign on the robots' locks.
        campaign: The campaign file.
        procedures: Its procedures.
        order: Its trials, in the order in which they are run.
    """

    file_sha256: str
    backend: str
    session: str
    campaign: Campaign
    procedures: tuple[Procedure, ...]
    order: tuple[str, ...]

    def turns(self) -> tuple[Turn, ...]:
        """Return the trials in order."""
        every = {str(turn): turn for turn in turns(self.campaign, self.procedures, _nowhere())}
        return tuple(every[name] for name in self.order)

    def procedure(self, turn: Turn) -> Procedure:
        """Return the procedure of a trial."""
        return next(one for one in self.procedures if one.name == turn.procedure)


def freeze(path: Path, backend: str) -> tuple[Frozen, Document]:
    """Return what a campaign file asks for, its trials in order, and its document for messages with lines.

    Raises:
        ConfigurationError: As `load_campaign`, `load_procedures` and `turns`, or `walk` is too short for any order.
    """
    campaign, document = load_campaign(path)
    procedures = load_procedures(campaign, document)
    every = turns(campaign, procedures, document)
    shortest_m = order.walk_m(order.shortest(every))
    limit_m = order.DEFAULT_WALK * shortest_m if campaign.walk is None else campaign.walk
    if limit_m < shortest_m:
        raise ConfigurationError(
            f"the shortest way through all places is {shortest_m:.1f} m, walk allows {limit_m:g} m",
            where=document.where(("walk",)),
            remedy=f"walk: {shortest_m + 0.05:.1f}m leaves sweeps up and down; twice that, some choice",
        )
    frozen = Frozen(
        file_sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        backend=backend,
        session=secrets.token_hex(8),
        campaign=campaign,
        procedures=procedures,
        order=tuple(map(str, order.shuffled(every, seed=campaign.seed, limit_m=limit_m))),
    )
    return frozen, document


def begun(folder: Path, asked: Frozen, document: Document) -> Frozen | None:
    """Return what the campaign in `folder` was begun with, None when there is none yet.

    Args:
        folder: The campaign's folder.
        asked: What its file asks for now.
        document: The file.

    Raises:
        ConfigurationError: The file now asks for something else, or campaign.yaml was edited.
    """
    if not (folder / FROZEN_FILE).is_file():
        return None
    frozen = schema.load(folder / FROZEN_FILE, Frozen)
    before, now = _keys(frozen), _keys(asked)
    changed = [key for key in now if now[key] != before[key]]
    if changed:
        raise ConfigurationError(
            f"changed since the campaign was begun: {', '.join(changed)}",
            where=document.where((changed[0],)),
            remedy=f"undo that ({folder / FROZEN_FILE} says what it was), or begin another campaign: change name",
        )
    return frozen


def _keys(frozen: Frozen) -> dict[str, Any]:
    """Return what must not change under a campaign, as a file says it, by the name that a person knows it by."""
    data = frozen.model_dump(mode="json", by_alias=True)
    return {**data["campaign"], "a file of its procedures": data["procedures"], "backend": data["backend"]}


def _nowhere() -> Document:
    return Document(data=None, source=FROZEN_FILE, lines={})
