"""Texts of events, as the display shows them."""

import textwrap
from typing import Final

from rich.cells import cell_len

from fieldkit.cli.progress import Words
from fieldkit.core import prompts
from fieldkit.core.campaign_events import CampaignEnded, CampaignPlanned, CampaignTrial, CampaignWent
from fieldkit.core.errors import shell_command
from fieldkit.core.events import (
    NOTHING_ARRIVED,
    Asked,
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
from fieldkit.core.sweep_events import SweepEnded, SweepPlanned, SweepRunEnded
from fieldkit.core.units import TimeEstimate, format_bytes, format_count

_INDENT: Final = 8
_STYLE: Final = {Status.VALID: "green", Status.VOID: "yellow", Status.FAILED: "red"}


def event_words(event: Event, width: int | None = None) -> Words:
    """Return the styled texts of an event; empty if only the live line shows the event.

    Args:
        event: The event.
        width: Columns of a terminal with a live line, or None for a file.
    """
    words: Words = ()
    match event:
        case Note(text):
            words = ((text, ""),)
        case Request(text, may_skip):
            words = (f"\n>>> {text}\n", "bold"), (f"    {prompts.answer_hint(may_skip=may_skip)}", "")
        case Asked(text, how):
            words = (f"\n>>> {text}?\n", "bold"), (f"    {how}", "")
        case Finding(status=Verdict.WARN):
            where = f"{event.robot}: {event.check}: "
            words = ("warning: ", "yellow"), (f"{where}{event.detail}\n  remedy: {event.remedy}", "")
        case PhaseStarted(name, repeat=""):
            words = ((f"{name} ...", "dim"),)
        case RepeatEnded():
            words = _repeat_words(event, width)
        case TrialEnded(folder, valid, void, failed):
            counts = (
                f"{valid} valid"
                + (f", {void} void and redone" if void else "")
                + (f", {failed} failed" if failed else "")
            )
            words = ((f"{counts}: {folder}", "bold"),)
        case TrialStopped(folder, done, total):
            command = f"to continue: {shell_command('fieldkit', 'resume', folder)}"
            words = ((f"stopped, {done} of {total} repeats are done; {command}", "bold"),)
        case CampaignPlanned() | CampaignTrial() | CampaignWent() | CampaignEnded():
            words = _campaign_words(event)
        case _:
            words = _sweep_words(event)
    return words


def _campaign_words(event: CampaignPlanned | CampaignTrial | CampaignWent | CampaignEnded) -> Words:
    if isinstance(event, CampaignTrial):
        return ((f"trial {event.number} of {event.total}: {event.trial}", "bold"),)
    done = f"campaign: {event.done} of {event.total} trials are done"
    match event:
        case CampaignPlanned(trials=()):
            return ((done, ""),)
        case CampaignPlanned():
            names = (f"\n{number:5d}  {name}" for number, name in enumerate(event.trials, start=event.done + 1))
            disk = f"{format_bytes(event.needed_bytes)} of disk ({format_bytes(event.free_bytes)} free)"
            duration = TimeEstimate(event.left_s, event.left_most_s)
            failed_links = " if links fail" if not duration.is_certain else ""
            cost = f"{event.walk_m:.0f} m to walk with robots, about {duration}{failed_links}; at most {disk}"
            return ((f"{done}; {cost}{''.join(names)}", ""),)
        case CampaignWent():
            duration = TimeEstimate(event.left_s, event.left_most_s)
            left = f", about {duration} left" if event.done < event.total else ""
            return ((f"{done}{left}", ""),)
        case CampaignEnded():
            hint = "" if event.done == event.total else "; to continue, run the same command again"
            return ((f"{done}{hint}: {event.folder}", "bold"),)


def _sweep_words(event: Event) -> Words:
    """Return the texts of an event of a sweep; empty for others, and for finished runs, as there may be thousands."""
    match event:
        case SweepPlanned():
            done = f"; {event.done:,} are done" if event.done else ""
            factors = f"{format_count(event.settings, 'setting')} with {format_count(event.seeds, 'seed')}"
            return ((f"{event.total:,} runs: {factors}{done}", ""),)
        case SweepRunEnded() if event.reason:
            remedy = f"\n{' ' * _INDENT}remedy: {event.remedy}" if event.remedy else ""
            head = f"{event.settings}, seed {event.seed}: " if event.settings else f"seed {event.seed}: "
            return ((head, ""), (f"failed (attempt {event.attempt}): ", "red"), (event.reason, ""), (remedy, ""))
        case SweepEnded():
            failed = f", {event.failed:,} failed" if event.failed else ""
            return ((f"{event.done:,} of {event.total:,} runs are done{failed}: {event.folder}", "bold"),)
    return ()


def _repeat_words(event: RepeatEnded, width: int | None) -> Words:
    """Return a repeat as one line. On a terminal, a longer line is folded, with the measured figures below it."""
    head, status = f"{event.done:3d}/{event.total}  {event.repeat:7} ", f"{event.status:6} "
    measured = f"measured: {event.summary}" if event.reason and event.summary else event.summary
    text = "; ".join(filter(None, (event.reason, measured)))
    left = f"  ({TimeEstimate(event.left_s, event.left_most_s)} left)" if event.left_s > 0 else ""
    if width is not None:  # the live line shows the remaining time
        left, available = "", width - len(head) - len(status)
        if cell_len(text) > available:
            text = _fold_below(text, width) if event.reason else _fold_after(text, width - available, width)
    remedy = f"\n{' ' * _INDENT}remedy: {event.remedy}" if event.remedy else ""
    style = _STYLE[Status.FAILED] if event.summary.startswith(NOTHING_ARRIVED) else ""
    return ((head, ""), (status, _STYLE[event.status]), (text, style), (left, "dim"), (remedy, ""))


def _fold_below(text: str, width: int) -> str:
    """Return a text folded into indented lines that start below the current line."""
    indent = f"\n{' ' * _INDENT}"
    return indent + indent.join(textwrap.wrap(text, max(width - _INDENT, _INDENT)))


def _fold_after(text: str, start_column: int, width: int) -> str:
    """Return a text that starts in column `start_column` and continues on indented lines."""
    lines = textwrap.wrap(
        text, max(width, start_column + _INDENT), initial_indent=" " * start_column, subsequent_indent=" " * _INDENT
    )
    return "\n".join(lines)[start_column:]
