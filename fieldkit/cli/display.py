"""Show events, tables, findings and errors: as a live line, plain lines or JSON. The only user of rich."""

import json
import os
import re
import sys
import textwrap
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from itertools import zip_longest
from pathlib import Path
from typing import Final

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fieldkit.cli.hints import completed
from fieldkit.cli.progress import ProgressBar, Words
from fieldkit.core import prompts
from fieldkit.core.errors import typed
from fieldkit.core.events import (
    Asked,
    CampaignEnded,
    CampaignPlanned,
    CampaignTrial,
    CampaignWent,
    Event,
    Finding,
    Note,
    PhaseStarted,
    RepeatEnded,
    Request,
    Sink,
    TrialEnded,
    TrialStopped,
)
from fieldkit.core.model import Status, Verdict
from fieldkit.core.text import harmless
from fieldkit.core.units import format_bytes, format_duration

_PLAIN_WIDTH: Final = 160
_INDENT: Final = 8
_STYLE: Final = {Status.VALID: "green", Status.VOID: "yellow", Status.FAILED: "red"}


class _Output(Console):
    """A stream whose reader may go away, which is for the command line to see, as of what is printed without rich."""

    def on_broken_pipe(self) -> None:
        """See `Console.on_broken_pipe`."""
        raise BrokenPipeError


def _console(*, stderr: bool = False) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    return _Output(stderr=stderr, highlight=False, width=None if stream.isatty() else _PLAIN_WIDTH, soft_wrap=True)


def show_error(text: str) -> None:
    """Print an error with its remedy on standard error."""
    _console(stderr=True).print(_harmless(Text.assemble(("error: ", "bold red"), completed(text))))


def show_note(text: str) -> None:
    """Print on standard error what a reader should know of the output."""
    _console(stderr=True).print(_harmless(Text.assemble(("note: ", "yellow"), completed(text))))


def fits(head: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the terminal is as wide as a table; where the output goes elsewhere, lines have no end."""
    return not sys.stdout.isatty() or _table_width(_widths([head, *rows])) <= _console().width


def prose(text: str) -> None:
    """Print a text of several words, folded between them where the output is a terminal."""
    print(textwrap.fill(text, _console().width) if sys.stdout.isatty() else text)


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    title: str = "",
    right: Sequence[int] = (),
    fold: Sequence[int] | None = None,
) -> None:
    """Print a table; columns whose index is in `right` are aligned to the right. A cell may have several lines.

    Words are folded in the columns `fold` alone, in this order, by default in the last one unless that is aligned to
    the right: a name or a figure broken in two is read as another, so in a narrow terminal the table is too wide
    rather than wrong.
    """
    # Not by `rich.table`, which measures and cuts every cell several times: 100 ms for the list of all columns.
    console = _console()
    cells = [[harmless(cell) for cell in row] for row in (head, *rows)]
    widths = _widths(cells)
    last = len(head) - 1
    for index in fold if fold is not None else () if last in right else (last,):
        words = (word for row in cells for word in row[index].split())
        room = console.width - sum(widths) + widths[index] - 2 * len(widths) - 1
        widths[index] = min(widths[index], max([room, *map(cell_len, words)]))
    rule = " " + "─" * (_table_width(widths) - 1)
    first, *others = ("\n".join(_table_lines(row, widths, right, console)) for row in cells)
    if title:
        console.print(Text(harmless(title), style="bold"))
    console.print(Text(first, style="bold"))
    print("\n".join(text for text in (rule, *others) if text))


def _widths(cells: Sequence[Sequence[str]]) -> list[int]:
    return [
        max(cell_len(line) for cell in column for line in cell.split("\n")) for column in zip(*cells, strict=True)
    ]


def _table_width(widths: Sequence[int]) -> int:
    return sum(widths) + 2 * len(widths)


def _table_lines(row: Sequence[str], widths: Sequence[int], right: Sequence[int], console: Console) -> Iterator[str]:
    """Yield the lines of a row: one, or as many as its longest cell takes when it is folded."""
    folded = [_fold(cell, width, console) for cell, width in zip(row, widths, strict=True)]
    for parts in zip_longest(*folded, fillvalue=""):
        aligned = []
        for index, (part, width) in enumerate(zip(parts, widths, strict=True)):
            blank = " " * (width - cell_len(part))
            aligned.append(blank + part if index in right else part + blank)
        if line := f" {'  '.join(aligned)}".rstrip():
            yield line


def _fold(cell: str, width: int, console: Console) -> Sequence[str]:
    if "\n" not in cell and cell_len(cell) <= width:
        return (cell.rstrip(),)
    return [line.plain.rstrip() for line in Text(cell).wrap(console, width)]


_MARKS: Final = {Verdict.OK: ("ok", "green"), Verdict.WARN: ("warn", "yellow"), Verdict.FAIL: ("FAIL", "bold red")}


def show_findings(findings: Sequence[Finding]) -> None:
    """Print findings robot by robot, each that is not ok with what to type, and a count at the end."""
    console = _console()
    width = max(len(finding.check) for finding in findings)
    for robot in dict.fromkeys(finding.robot for finding in findings):
        console.print(Text(robot, style="bold"))
        for one in (finding for finding in findings if finding.robot == robot):
            word, style = _MARKS[one.status]
            grid = Table.grid(padding=(0, 2, 0, 0))
            grid.add_column(width=6, justify="right")
            grid.add_column(width=width)
            grid.add_column(overflow="fold")
            grid.add_row(Text(word, style=style), Text(one.check), _harmless(Text(one.detail)))
            with console.capture() as shown:
                console.print(grid, soft_wrap=False)
            print("\n".join(line.rstrip() for line in shown.get().splitlines()))
            if one.remedy:  # never broken, so that it can be copied
                console.print(_harmless(Text.assemble("        ", (completed(one.remedy), "cyan"))))
    counts = {verdict: sum(finding.status is verdict for finding in findings) for verdict in Verdict}
    names = {Verdict.OK: "ok", Verdict.WARN: "warned of", Verdict.FAIL: "failed"}
    worst = max(findings, key=lambda one: list(Verdict).index(one.status)).status
    said = ", ".join(f"{counts[verdict]} {name}" for verdict, name in names.items() if counts[verdict])
    console.print(Text(said, style=_MARKS[worst][1]))


@contextmanager
def watching(*, as_json: bool) -> Iterator[Sink]:
    """Show events while the body runs: as JSON lines, as a live line in a terminal, else as plain lines."""
    if as_json:
        yield _audible(_print_json)
    elif sys.stdout.isatty():
        line = _LiveLine()
        live = Live(line, console=_console(), refresh_per_second=8, transient=True)

        def sink(event: Event) -> None:
            line.progress.take(event)
            if line.progress.is_needed:
                live.start()
            else:
                live.stop()
            if (text := shown(event, live.console.width)) is not None:
                live.console.print(text)

        try:
            yield _audible(sink)
        finally:
            live.stop()
    else:
        yield _audible(_print_plain)


@contextmanager
def working() -> Iterator[Sink]:
    """Show on standard error how far a computation is while the body runs; nothing where that is no terminal."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    line = _LiveLine()
    live = Live(line, console=_console(stderr=True), refresh_per_second=8, transient=True)

    def sink(event: Event) -> None:
        line.progress.take(event)
        live.start()

    try:
        yield sink
    finally:
        live.stop()


def _audible(sink: Sink) -> Sink:
    """Tell one event at a time, whoever has one, and go on in silence once nobody reads.

    What is measured is worth more than what is told of it.
    """
    telling = threading.RLock()  # which a signal's handler may find held by what it interrupted

    def tell(event: Event) -> None:
        try:
            with telling:
                sink(event)
        except OSError:
            with Path(os.devnull).open("wb") as silence:
                os.dup2(silence.fileno(), sys.stdout.fileno())

    return tell


def shown(event: Event, width: int | None = None) -> Text | None:
    """Return an event as people see it, None for one that only the live line shows; errors as `words_of`."""
    said = words_of(event, width)
    return _harmless(Text.assemble(*((completed(text), style) for text, style in said))) if said else None


def words_of(event: Event, width: int | None = None) -> Words:
    """Return an event in words, none for one that only the live line shows.

    Args:
        event: What happened.
        width: Columns of the terminal, below which the live line stands; None for a file.
    """
    said: Words = ()
    match event:
        case Note(text):
            said = ((text, ""),)
        case Request(text, may_skip):
            said = (f"\n>>> {text}\n", "bold"), (f"    {prompts.how(may_skip=may_skip)}", "")
        case Asked(text, how):
            said = (f"\n>>> {text}?\n", "bold"), (f"    {how}", "")
        case Finding(status=Verdict.WARN):
            where = f"{event.robot}: {event.check}: "
            said = ("warning: ", "yellow"), (f"{where}{event.detail}\n  remedy: {event.remedy}", "")
        case PhaseStarted(name, repeat=""):
            said = ((f"{name} ...", "dim"),)
        case RepeatEnded():
            said = _repeat(event, width)
        case TrialEnded(folder, valid, void, failed):
            counts = (
                f"{valid} valid"
                + (f", {void} void and redone" if void else "")
                + (f", {failed} failed" if failed else "")
            )
            said = ((f"{counts}: {folder}", "bold"),)
        case TrialStopped(folder, done, total):
            how = f"to go on: {typed('fieldkit', 'resume', folder)}"
            said = ((f"stopped, {done} of {total} repeats are done; {how}", "bold"),)
        case CampaignPlanned() | CampaignTrial() | CampaignWent() | CampaignEnded():
            said = _campaign(event)
    return said


def _campaign(event: CampaignPlanned | CampaignTrial | CampaignWent | CampaignEnded) -> Words:
    if isinstance(event, CampaignTrial):
        return ((f"trial {event.number} of {event.total}: {event.trial}", "bold"),)
    done = f"campaign: {event.done} of {event.total} trials are done"
    match event:
        case CampaignPlanned(trials=()):
            return ((done, ""),)
        case CampaignPlanned():
            names = (f"\n{number:5d}  {name}" for number, name in enumerate(event.trials, start=event.done + 1))
            room = f"{format_bytes(event.needed_bytes)} of disk ({format_bytes(event.free_bytes)} free)"
            cost = f"{event.walk_m:.0f} m to carry robots, about {format_duration(event.left_s)}, up to {room}"
            return ((f"{done}; {cost}{''.join(names)}", ""),)
        case CampaignWent():
            left = f", about {format_duration(event.left_s)} left" if event.done < event.total else ""
            return ((f"{done}{left}", ""),)
        case CampaignEnded():
            how = "" if event.done == event.total else "; to go on, give the same command again"
            return ((f"{done}{how}: {event.folder}", "bold"),)


def _repeat(event: RepeatEnded, width: int | None) -> Words:
    """Return a repeat as one line; in a terminal, why it is not valid is folded below it where it is longer."""
    head, status = f"{event.done:3d}/{event.total}  {event.repeat:7} ", f"{event.status:6} "
    measured = f"measured: {event.summary}" if event.reason and event.summary else event.summary
    said = "; ".join(filter(None, (event.reason, measured)))
    left = f"  ({format_duration(event.left_s)} left)" if event.left_s > 0 else ""
    if width is not None:  # the live line says what is left
        left, room = "", width - len(head) - len(status)
        parts = event.summary.split(", ")
        while not event.reason and len(parts) > 1 and len(", ".join(parts)) > room:
            parts.pop()
        if not event.reason:
            said = ", ".join(parts)
        if len(said) > room:
            indent = f"\n{' ' * _INDENT}"
            said = indent + indent.join(textwrap.wrap(said, max(width - _INDENT, _INDENT)))
    remedy = f"\n{' ' * _INDENT}remedy: {event.remedy}" if event.remedy else ""
    return ((head, ""), (status, _STYLE[event.status]), (said, ""), (left, "dim"), (remedy, ""))


def _harmless(text: Text) -> Text:
    text.plain = harmless(text.plain)
    return text


def _print_plain(event: Event) -> None:
    if (text := shown(event)) is not None:
        print(text.plain, flush=True)


def _print_json(event: Event) -> None:
    name = re.sub(r"(?<!^)(?=[A-Z])", "_", type(event).__name__).lower()
    fields = {key: completed(value) if isinstance(value, str) else value for key, value in asdict(event).items()}
    print(json.dumps({"event": name, "utc_ns": time.time_ns(), **fields}), flush=True)


class _LiveLine:
    """The line at the bottom of the terminal."""

    def __init__(self) -> None:
        self.progress = ProgressBar()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        text = Text.assemble(*self.progress.words(options.max_width - 1), no_wrap=True, overflow="crop")
        yield _harmless(text)
