"""Events as people read them: texts, each with the style in which it stands out."""

from typing import Final

from fieldkit.core import prompts
from fieldkit.core.events import (
    CampaignEnded,
    CampaignPlanned,
    CampaignWent,
    Event,
    Finding,
    Note,
    PhaseStarted,
    RepeatEnded,
    Request,
    TrialEnded,
    TrialStopped,
)
from fieldkit.core.model import Status, Verdict
from fieldkit.core.units import format_bytes, format_duration

Words = tuple[tuple[str, str], ...]
"""Texts with their styles, in order."""

_STYLE: Final = {Status.VALID: "green", Status.VOID: "yellow", Status.FAILED: "red"}


def of(event: Event) -> Words:
    """Return an event in words, none for one that only the live line shows."""
    said: Words = ()
    match event:
        case Note(text):
            said = ((text, ""),)
        case Request(text, may_skip):
            said = (f"\n>>> {text}\n", "bold"), (f"    {prompts.how(may_skip=may_skip)}", "")
        case Finding(status=Verdict.WARN):
            where = f"{event.robot}: {event.check}: "
            said = ("warning: ", "yellow"), (f"{where}{event.detail}\n  remedy: {event.remedy}", "")
        case PhaseStarted(name, repeat=""):
            said = ((f"{name} ...", "dim"),)
        case RepeatEnded():
            said = _repeat(event)
        case TrialEnded(folder, valid, void, failed):
            counts = (
                f"{valid} valid"
                + (f", {void} void and redone" if void else "")
                + (f", {failed} failed" if failed else "")
            )
            said = ((f"{counts}: {folder}", "bold"),)
        case TrialStopped(folder, done, total):
            how = f"to go on: fieldkit resume {folder}"
            said = ((f"stopped, {done} of {total} repeats are done; {how}", "bold"),)
        case CampaignPlanned() | CampaignWent() | CampaignEnded():
            said = _campaign(event)
    return said


def _campaign(event: CampaignPlanned | CampaignWent | CampaignEnded) -> Words:
    done = f"campaign: {event.done} of {event.total} trials are done"
    match event:
        case CampaignPlanned():
            names = (f"\n{number:5d}  {name}" for number, name in enumerate(event.trials, start=event.done + 1))
            room = f"{format_bytes(event.needed_bytes)} of disk ({format_bytes(event.free_bytes)} free)"
            cost = f"{event.walk_m:.0f} m to carry robots, about {format_duration(event.left_s)}, up to {room}"
            return ((f"{done}; {cost}{''.join(names)}", ""),)
        case CampaignWent():
            return ((f"{done}, about {format_duration(event.left_s)} left", ""),)
        case CampaignEnded():
            how = "" if event.done == event.total else "; to go on, give the same command again"
            return ((f"{done}{how}: {event.folder}", "bold"),)


def _repeat(event: RepeatEnded) -> Words:
    return (
        (f"{event.done:3d}/{event.total}  {event.repeat:7} ", ""),
        (f"{event.status:6} ", _STYLE[event.status]),
        ("; ".join(filter(None, (event.reason, event.summary))), ""),
        (f"  ({format_duration(event.left_s)} left)" if event.left_s > 0 else "", "dim"),
    )
