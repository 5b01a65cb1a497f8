"""Show events, tables, findings and errors: live, as plain lines or as JSON."""

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

from fieldkit.cli.event_words import event_words
from fieldkit.cli.hints import add_options
from fieldkit.core.events import Event, Finding, Sink
from fieldkit.core.model import Verdict
from fieldkit.core.text import json_text, sanitized

_PLAIN_WIDTH: Final = 160
"""Width of lines in a file or a pipe, in columns."""
_RULE: Final = " ─"
"""Start of the line below the head of a table."""


class _Output(Console):
    """A console that raises `BrokenPipeError` if the program that reads its stream has exited, as `print` does.

    The console of rich would exit without an exception.
    """

    @override
    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def _console(*, stderr: bool = False) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    return _Output(stderr=stderr, highlight=False, width=None if stream.isatty() else _PLAIN_WIDTH, soft_wrap=True)


def show_error(text: str) -> None:
    """Print an error with its remedy on standard error."""
    _console(stderr=True).print(_sanitized(Text.assemble(("error: ", "bold red"), add_options(text))))


def show_note(text: str) -> None:
    """Print a note about the output on standard error."""
    _console(stderr=True).print(_sanitized(Text.assemble(("note: ", "yellow"), add_options(text))))


def fits_terminal(head: Sequence[str], rows: Sequence[Sequence[str]]) -> bool:
    """Return True if the terminal is wide enough for a table. Files and pipes have no limit."""
    return not sys.stdout.isatty() or _table_width(_widths([head, *rows])) <= _console().width


def print_folded(text: str) -> None:
    """Print a text. On a terminal, lines are folded between words."""
    text = sanitized(text)
    print(textwrap.fill(text, _console().width) if sys.stdout.isatty() else text)


def print_table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    title: str = "",
    right: Sequence[int] = (),
    fold: Sequence[int] | None = None,
) -> None:
    """Print a table; columns whose index is in `right` are aligned to the right. A cell may have several lines.

    Only the columns `fold` are folded, in this order and between words, because a broken name or number would be
    misread. By default this is the last column unless it is aligned to the right. If a terminal is too narrow for the
    folded table, each row is printed as a block with a line per cell.
    """
    console = _console()
    cells = [[sanitized(cell) for cell in row] for row in (head, *rows)]
    widths = _widths(cells)
    last = len(head) - 1
    if fold is None:
        fold = () if last in right else (last,)
    for index in fold:
        words = (word for row in cells for word in row[index].split())
        available = console.width - 1 - (_table_width(widths) - widths[index])
        widths[index] = min(widths[index], max([available, *map(cell_len, words)]))
    if sys.stdout.isatty() and _table_width(widths) > console.width:
        _print_blocks(cells, title, console)
        return
    if title:
        console.print(Text(sanitized(title), style="bold"))
    lines = _render_lines(cells, widths, right)
    rule = next(index for index, line in enumerate(lines) if line.startswith(_RULE))
    console.print(Text("\n".join(lines[:rule]), style="bold"))
    print("\n".join(lines[rule:]))


def _render_lines(cells: Sequence[Sequence[str]], widths: Sequence[int], right: Sequence[int]) -> list[str]:
    """Return the lines of a table without styles, trailing spaces and blank lines. The first row is the head."""
    grid = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    head, *rows = cells
    for index, (name, width) in enumerate(zip(head, widths, strict=True)):
        grid.add_column(Text(name), justify="right" if index in right else "left", width=width, no_wrap=True)
    for row in rows:
        grid.add_row(*(Text(_fold_cell(cell, width)) for cell, width in zip(row, widths, strict=True)))
    rendered = io.StringIO()
    Console(file=rendered, width=_table_width(widths) + 1, color_system=None).print(grid)
    return [line.rstrip() for line in rendered.getvalue().splitlines() if line.strip()]


def _fold_cell(cell: str, width: int) -> str:
    """Return a cell with lines that are wider than `width` folded between words.

    The wrapping of rich cuts lines that contain characters with a width of two columns.
    """
    return "\n".join(
        line if cell_len(line) <= width else "\n".join(_fold_words(line.split(), width)) for line in cell.split("\n")
    )


def _print_blocks(cells: Sequence[Sequence[str]], title: str, console: Console) -> None:
    """Print each row as a block: the first cell, then a folded line with its head for each other cell."""
    head, *rows = cells
    indent = 2 + max(map(cell_len, head[1:]), default=0) + 2
    if title:
        console.print(Text(sanitized(title), style="bold"))
    for first, *others in rows:
        console.print(Text("\n".join(_fold_words(first.split() or [head[0]], console.width)), style="bold"))
        for name, cell in zip(head[1:], others, strict=True):
            if words := cell.split():
                start = f"  {name}{' ' * (indent - 2 - cell_len(name))}"
                print(start + f"\n{' ' * indent}".join(_fold_words(words, console.width - indent)))


def _fold_words(words: Sequence[str], width: int) -> list[str]:
    """Return lines of whole words. A word that is longer than `width` is put on a separate line and is not broken."""
    lines = [""]
    for word in words:
        extended_line = f"{lines[-1]} {word}".lstrip()
        if cell_len(extended_line) <= width or not lines[-1]:
            lines[-1] = extended_line
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
    """Print findings robot by robot, with a remedy for each that is not ok, and the counts at the end."""
    console = _console()
    width = max(len(finding.check) for finding in findings)
    for robot in dict.fromkeys(finding.robot for finding in findings):
        console.print(Text(robot, style="bold"))
        for finding in (item for item in findings if item.robot == robot):
            word, style = _MARKS[finding.status]
            grid = Table.grid(padding=(0, 2, 0, 0))
            grid.add_column(width=6, justify="right")
            grid.add_column(width=width)
            grid.add_column(overflow="fold")
            grid.add_row(Text(word, style=style), Text(finding.check), _sanitized(Text(finding.detail)))
            with console.capture() as capture:
                console.print(grid, soft_wrap=False)
            print("\n".join(line.rstrip() for line in capture.get().splitlines()))
            if finding.remedy:  # not folded, so that it can be copied
                console.print(_sanitized(Text.assemble("        ", (add_options(finding.remedy), "cyan"))))
    counts = {verdict: sum(finding.status is verdict for finding in findings) for verdict in Verdict}
    names = {Verdict.OK: "ok", Verdict.WARN: "warned", Verdict.FAIL: "failed"}
    worst = max(findings, key=lambda item: list(Verdict).index(item.status)).status
    counts_text = ", ".join(f"{counts[verdict]} {name}" for verdict, name in names.items() if counts[verdict])
    console.print(Text(counts_text, style=_MARKS[worst][1]))


@contextmanager
def showing_events(*, as_json: bool) -> Iterator[Sink]:
    """Show events while the body runs: as JSON lines, as a live line on a terminal, or as plain lines."""
    if as_json:
        yield _serialize(_print_json)
    elif sys.stdout.isatty():
        line = _LiveLine()
        live = Live(line, console=_console(), refresh_per_second=8, transient=True)

        def sink(event: Event) -> None:
            line.progress.update(event)
            if line.progress.is_needed:
                live.start()
            else:
                live.stop()
            if (text := event_text(event, live.console.width)) is not None:
                live.console.print(text)

        try:
            yield _serialize(sink)
        finally:
            live.stop()
    else:
        yield _serialize(_print_plain)


@contextmanager
def showing_progress() -> Iterator[Sink]:
    """Show the progress of a computation on standard error while the body runs, if that is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    line = _LiveLine()
    live = Live(line, console=_console(stderr=True), refresh_per_second=8, transient=True)

    def sink(event: Event) -> None:
        line.progress.update(event)
        live.start()

    try:
        yield sink
    finally:
        live.stop()


def _serialize(sink: Sink) -> Sink:
    """Return a sink that shows one event at a time and discards events after a write error.

    A measurement must not stop because its progress cannot be displayed.
    """
    lock = threading.RLock()  # reentrant: a signal handler may interrupt the thread while it holds the lock

    def show(event: Event) -> None:
        try:
            with lock:
                sink(event)
        except OSError:
            with Path(os.devnull).open("wb") as null:
                os.dup2(null.fileno(), sys.stdout.fileno())

    return show


def event_text(event: Event, width: int | None = None) -> Text | None:
    """Return the displayed text of an event, or None if only the live line shows it."""
    parts = event_words(event, width)
    return _sanitized(Text.assemble(*((add_options(text), style) for text, style in parts))) if parts else None


def _sanitized(text: Text) -> Text:
    text.plain = sanitized(text.plain)
    return text


def _print_plain(event: Event) -> None:
    if (text := event_text(event)) is not None:
        print(text.plain, flush=True)


def _print_json(event: Event) -> None:
    name = re.sub(r"(?<!^)(?=[A-Z])", "_", type(event).__name__).lower()
    fields = {key: add_options(value) if isinstance(value, str) else value for key, value in asdict(event).items()}
    print(json_text({"event": name, "utc_ns": time.time_ns(), **fields}), flush=True)


class _LiveLine:
    """The line at the bottom of the terminal that shows the progress."""

    def __init__(self) -> None:
        from fieldkit.cli.progress import ProgressBar  # noqa: PLC0415 (only a terminal has a live line)

        self.progress = ProgressBar()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        text = Text.assemble(*self.progress.words(options.max_width - 1), no_wrap=True, overflow="crop")
        yield _sanitized(text)
