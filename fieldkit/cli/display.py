"""Show events, tables, findings and errors: as a live line, plain lines or JSON. The only user of rich."""

import io
import os
import re
import sys
import textwrap
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Final

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text
from typing_extensions import override

from fieldkit.cli.hints import completed
from fieldkit.cli.progress import ProgressBar, Words
from fieldkit.core import prompts
from fieldkit.core.errors import typed
from fieldkit.core.events import (
    NOTHING_ARRIVED,
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
from fieldkit.core.text import harmless, json_text
from fieldkit.core.units import TimeEstimate, format_bytes

_PLAIN_WIDTH: Final = 160
_INDENT: Final = 8
_RULE: Final = " ─"
_STYLE: Final = {Status.VALID: "green", Status.VOID: "yellow", Status.FAILED: "red"}


class _Output(Console):
    """A stream whose reader may go away, which is for the command line to see, as of what is printed without rich."""

    @override
    def on_broken_pipe(self) -> None:
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
    text = harmless(text)
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
    the right: a name or a figure broken in two is read as another. Where a terminal is too narrow even so, each row
    is a block of lines instead, a cell per line.
    """
    console = _console()
    cells = [[harmless(cell) for cell in row] for row in (head, *rows)]
    widths = _widths(cells)
    last = len(head) - 1
    for index in fold if fold is not None else () if last in right else (last,):
        words = (word for row in cells for word in row[index].split())
        room = console.width - sum(widths) + widths[index] - 2 * len(widths) - 1
        widths[index] = min(widths[index], max([room, *map(cell_len, words)]))
    if sys.stdout.isatty() and _table_width(widths) > console.width:
        _print_blocks(cells, title, console)
        return
    if title:
        console.print(Text(harmless(title), style="bold"))
    lines = _drawn(cells, widths, right)
    rule = next(index for index, line in enumerate(lines) if line.startswith(_RULE))
    console.print(Text("\n".join(lines[:rule]), style="bold"))
    print("\n".join(lines[rule:]))


def _drawn(cells: Sequence[Sequence[str]], widths: Sequence[int], right: Sequence[int]) -> list[str]:
    """Return the lines of a table without styles, trailing spaces and blank lines; the first row is its head."""
    grid = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    head, *rows = cells
    for index, (name, width) in enumerate(zip(head, widths, strict=True)):
        grid.add_column(Text(name), justify="right" if index in right else "left", width=width, no_wrap=True)
    for row in rows:
        grid.add_row(*(Text(_wrapped(cell, width)) for cell, width in zip(row, widths, strict=True)))
    drawn = io.StringIO()
    Console(file=drawn, width=_table_width(widths) + 1, color_system=None).print(grid)
    return [line.rstrip() for line in drawn.getvalue().splitlines() if line.strip()]


def _wrapped(cell: str, width: int) -> str:
    """Return a cell whose lines are folded between words where they are wider than `width`.

    rich's own wrapping cuts lines that contain characters of two columns.
    """
    return "\n".join(
        line if cell_len(line) <= width else "\n".join(_folded(line.split(), width)) for line in cell.split("\n")
    )


def _print_blocks(cells: Sequence[Sequence[str]], title: str, console: Console) -> None:
    """Print rows as blocks: the first cell, then a line per other cell, folded between words, with its head."""
    head, *rows = cells
    indent = 2 + max(map(cell_len, head[1:]), default=0) + 2
    if title:
        console.print(Text(harmless(title), style="bold"))
    for first, *others in rows:
        console.print(Text("\n".join(_folded(first.split() or [head[0]], console.width)), style="bold"))
        for name, cell in zip(head[1:], others, strict=True):
            if words := cell.split():
                begin = f"  {name}{' ' * (indent - 2 - cell_len(name))}"
                print(begin + f"\n{' ' * indent}".join(_folded(words, console.width - indent)))


def _folded(words: Sequence[str], width: int) -> list[str]:
    """Return lines of whole words; one that is longer than `width` has a line of its own, and is not broken."""
    lines = [""]
    for word in words:
        longer = f"{lines[-1]} {word}".lstrip()
        if cell_len(longer) <= width or not lines[-1]:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _widths(cells: Sequence[Sequence[str]]) -> list[int]:
    return [
        max(cell_len(line) for cell in column for line in cell.split("\n")) for column in zip(*cells, strict=True)
    ]


def _table_width(widths: Sequence[int]) -> int:
    return sum(widths) + 2 * len(widths)


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
            lasts = TimeEstimate(event.left_s, event.left_most_s)
            dead = " if links are dead" if not lasts.is_certain else ""
            cost = f"{event.walk_m:.0f} m to carry robots, about {lasts}{dead}; at most {room}"
            return ((f"{done}; {cost}{''.join(names)}", ""),)
        case CampaignWent():
            lasts = TimeEstimate(event.left_s, event.left_most_s)
            left = f", about {lasts} left" if event.done < event.total else ""
            return ((f"{done}{left}", ""),)
        case CampaignEnded():
            how = "" if event.done == event.total else "; to go on, give the same command again"
            return ((f"{done}{how}: {event.folder}", "bold"),)


def _repeat(event: RepeatEnded, width: int | None) -> Words:
    """Return a repeat as one line; in a terminal, what it measured is folded below it where the line is longer."""
    head, status = f"{event.done:3d}/{event.total}  {event.repeat:7} ", f"{event.status:6} "
    measured = f"measured: {event.summary}" if event.reason and event.summary else event.summary
    said = "; ".join(filter(None, (event.reason, measured)))
    left = f"  ({TimeEstimate(event.left_s, event.left_most_s)} left)" if event.left_s > 0 else ""
    if width is not None:  # the live line says what is left
        left, room = "", width - len(head) - len(status)
        if cell_len(said) > room:
            said = _below(said, width) if event.reason else _continued(said, width - room, width)
    remedy = f"\n{' ' * _INDENT}remedy: {event.remedy}" if event.remedy else ""
    style = _STYLE[Status.FAILED] if event.summary.startswith(NOTHING_ARRIVED) else ""
    return ((head, ""), (status, _STYLE[event.status]), (said, style), (left, "dim"), (remedy, ""))


def _below(text: str, width: int) -> str:
    """Return a text folded into indented lines below the one where it begins."""
    indent = f"\n{' ' * _INDENT}"
    return indent + indent.join(textwrap.wrap(text, max(width - _INDENT, _INDENT)))


def _continued(text: str, begin: int, width: int) -> str:
    """Return a text that begins in column `begin` and is folded into indented lines."""
    lines = textwrap.wrap(
        text, max(width, begin + _INDENT), initial_indent=" " * begin, subsequent_indent=" " * _INDENT
    )
    return "\n".join(lines)[begin:]


def _harmless(text: Text) -> Text:
    text.plain = harmless(text.plain)
    return text


def _print_plain(event: Event) -> None:
    if (text := shown(event)) is not None:
        print(text.plain, flush=True)


def _print_json(event: Event) -> None:
    name = re.sub(r"(?<!^)(?=[A-Z])", "_", type(event).__name__).lower()
    fields = {key: completed(value) if isinstance(value, str) else value for key, value in asdict(event).items()}
    print(json_text({"event": name, "utc_ns": time.time_ns(), **fields}), flush=True)


class _LiveLine:
    """The line at the bottom of the terminal."""

    def __init__(self) -> None:
        self.progress = ProgressBar()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        text = Text.assemble(*self.progress.words(options.max_width - 1), no_wrap=True, overflow="crop")
        yield _harmless(text)
