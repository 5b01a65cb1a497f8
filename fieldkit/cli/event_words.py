"""Texts of events, as the display shows them."""

import re
import textwrap
from typing import Final

from rich.cells import cell_len

from fieldkit.core import prompts
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
    Words,
)
from fieldkit.core.model import Status, Verdict
from fieldkit.core.units import TimeEstimate

_INDENT: Final = 8
_BEFORE_UNIT: Final = re.compile(r"(?<=\d) (?=(?:%|[mu]?s)(?![^\s,;)]))")
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
                + (f", {void} void and repeated" if void else "")
                + (f", {failed} failed" if failed else "")
            )
            words = ((f"{counts}: {folder}", "bold"),)
        case TrialStopped(folder, done, total):
            command = f"to continue: {shell_command('fieldkit', 'resume', folder)}"
            words = ((f"stopped, {done} of {total} repeats are done; {command}", "bold"),)
        case _:
            words = event.words
    return words


def _repeat_words(event: RepeatEnded, width: int | None) -> Words:
    """Return the text of a repeat. On a terminal, a text that is longer than a line is folded."""
    head, status = f"{event.done:3d}/{event.total}  {event.repeat:7} ", f"{event.status:6} "
    measured = f"measured: {event.summary}" if event.reason and event.summary else event.summary
    text = "; ".join(filter(None, (event.reason, measured)))
    remaining_time = f"  ({TimeEstimate(event.left_s, event.left_most_s)} left)" if event.left_s > 0 else ""
    if width is not None:  # the live line shows the remaining time
        remaining_time, available = "", width - len(head) - len(status)
        if cell_len(text) > available:
            text = _fold_below(text, width) if event.reason else _fold_after(text, width - available, width)
    remedy = f"\n{' ' * _INDENT}remedy: {event.remedy}" if event.remedy else ""
    style = _STYLE[Status.FAILED] if event.summary.startswith(NOTHING_ARRIVED) else ""
    return ((head, ""), (status, _STYLE[event.status]), (text, style), (remaining_time, "dim"), (remedy, ""))


def _fold_below(text: str, width: int) -> str:
    """Return a text folded into indented lines that start below the current line."""
    indent = f"\n{' ' * _INDENT}"
    return indent + indent.join(_wrap(text, max(width - _INDENT, _INDENT)))


def _fold_after(text: str, start_column: int, width: int) -> str:
    """Return a text that starts in column `start_column` and continues on indented lines."""
    lines = _wrap(text, max(width, start_column + _INDENT), " " * start_column, " " * _INDENT)
    return "\n".join(lines)[start_column:]


def _wrap(text: str, width: int, initial_indent: str = "", subsequent_indent: str = "") -> list[str]:
    """Return the lines of a text. A line never ends between a number and `%`, `s`, `ms` or `us`."""
    # textwrap breaks lines only at ASCII white space.
    joined = _BEFORE_UNIT.sub("\N{NO-BREAK SPACE}", text)
    lines = textwrap.wrap(joined, width, initial_indent=initial_indent, subsequent_indent=subsequent_indent)
    return [line.replace("\N{NO-BREAK SPACE}", " ") for line in lines]
