"""What a person sees: a live line or plain lines, JSON events, tables, errors. The only user of rich."""

import json
import re
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Final

from rich import box
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from fieldkit.columns import CellRow
from fieldkit.errors import ConfigurationError
from fieldkit.events import Event, Note, PhaseStarted, RepeatEnded, Sink, TrialEnded
from fieldkit.model import Status
from fieldkit.units import format_duration

_PLAIN_WIDTH: Final = 160
_STYLE: Final = {Status.VALID: "green", Status.VOID: "yellow", Status.FAILED: "red"}


def _console(*, stderr: bool = False) -> Console:
    stream = sys.stderr if stderr else sys.stdout
    return Console(stderr=stderr, highlight=False, width=None if stream.isatty() else _PLAIN_WIDTH, soft_wrap=True)


def show_error(text: str) -> None:
    """Print an error with its remedy on standard error."""
    _console(stderr=True).print(Text.assemble(("error: ", "bold red"), text))


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, title: str = "", right: Sequence[int] = ()) -> None:
    """Print a table; columns whose index is in `right` are aligned to the right."""
    grid = Table(box=box.SIMPLE_HEAD, title=title or None, title_justify="left", title_style="bold")
    for index, name in enumerate(head):
        grid.add_column(name, justify="right" if index in right else "left", overflow="fold")
    for row in rows:
        grid.add_row(*(Text(cell) for cell in row))
    console = _console()
    with console.capture() as shown:
        console.print(grid, soft_wrap=False)
    lines = (line.rstrip() for line in shown.get().splitlines())
    print("\n".join(line for line in lines if line))


def summary_table(cells: Sequence[CellRow]) -> None:
    """Print per condition a table: measures down, protocols across, each value with its 95 % interval."""
    groups: dict[tuple[str | None, ...], list[CellRow]] = {}
    for one in cells:
        groups.setdefault((one.procedure, one.distance, one.topology, one.backend), []).append(one)
    for condition, group in groups.items():
        rows = [
            ("repeats", *(_counts(one) for one in group)),
            *(
                (label, *(_value(one, name, factor, unit) for one in group))
                for label, name, factor, unit in _MEASURES
            ),
        ]
        shown = [row for row in rows if any(row[1:])]
        head = ("[95 % interval]", *((one.protocol or "").upper() for one in group))
        table(head, shown, title=", ".join(str(part) for part in condition), right=range(1, len(group) + 1))


_MEASURES: Final = (
    ("IP packet loss", "ip_loss", 100, "%"),
    ("UDP datagram loss", "datagram_loss", 100, "%"),
    ("TCP bytes lost and repaired", "tcp_byte_loss", 100, "%"),
    ("payload bytes lost", "byte_loss", 100, "%"),
    ("file bytes lost", "file_loss", 100, "%"),
    ("loss as the paper counts", "paper_loss", 100, "%"),
    ("echo loss", "rtt_loss", 100, "%"),
    ("RTT, median", "rtt_median_s", 1e3, "ms"),
    ("transfer time, median", "transfer_s", 1e3, "ms"),
)


def _counts(one: CellRow) -> str:
    parts = ((one.n_valid, "valid"), (one.n_void, "void"), (one.n_failed, "failed"))
    return ", ".join(f"{count} {word}" for count, word in parts if count) or "none"


def _value(one: CellRow, name: str, factor: float, unit: str) -> str:
    value, low, high = (getattr(one, name + end) for end in ("", "_low", "_high"))
    if value is None:
        return ""
    if low is None or high is None:
        return f"{factor * value:.2f} {unit}"
    return f"{factor * value:.2f} {unit} [{factor * low:.2f}, {factor * high:.2f}]"


@contextmanager
def watching(*, as_json: bool) -> Iterator[Sink]:
    """Show events while the body runs: as JSON lines, as a live line in a terminal, else as plain lines."""
    if as_json:
        yield _print_json
    elif sys.stdout.isatty():
        console = _console()
        line = _LiveLine()
        with Live(line, console=console, refresh_per_second=8, transient=True) as live:

            def sink(event: Event) -> None:
                line.take(event)
                if (text := in_words(event)) is not None:
                    live.console.print(text)

            yield sink
    else:
        yield _print_plain


def ask_operator(question: str) -> None:
    """Show the operator what to do and wait for Enter.

    Raises:
        ConfigurationError: There is no terminal to ask at.
    """
    if not sys.stdin.isatty():
        raise ConfigurationError(
            f"somebody must {question}, and there is no terminal to ask at",
            remedy="place the robots first, then add --yes",
        )
    input(f"\n>>> {question}; then press Enter ")


def in_words(event: Event) -> Text | None:
    """Return an event as a line for people, None for one that only the live line shows."""
    match event:
        case Note(text):
            return Text(text)
        case PhaseStarted(name, repeat=""):
            return Text(f"{name} ...", style="dim")
        case RepeatEnded():
            place = f"{event.done:3d}/{event.total}"
            said = f"{event.summary}; {event.reason}".strip("; ") if event.reason else event.summary
            return Text.assemble(
                (f"{place}  {event.repeat:7} ", ""),
                (f"{event.status:6} ", _STYLE[event.status]),
                said,
                (f"  ({format_duration(event.left_s)} left)" if event.left_s > 0 else "", "dim"),
            )
        case TrialEnded(folder, valid, void, failed):
            counts = (
                f"{valid} valid"
                + (f", {void} void and redone" if void else "")
                + (f", {failed} failed" if failed else "")
            )
            return Text(f"{counts}: {folder}", style="bold")
    return None


def _print_plain(event: Event) -> None:
    if (text := in_words(event)) is not None:
        print(text.plain, flush=True)


def _print_json(event: Event) -> None:
    name = re.sub(r"(?<!^)(?=[A-Z])", "_", type(event).__name__).lower()
    print(json.dumps({"event": name, "utc_ns": time.time_ns(), **asdict(event)}), flush=True)


class _LiveLine:
    """The line at the bottom of the terminal: repeat, phase, time left of both."""

    def __init__(self) -> None:
        self._phase = PhaseStarted("")
        self._phase_began_s = 0.0
        self._trial_left: Callable[[], float] | None = None

    def take(self, event: Event) -> None:
        if isinstance(event, PhaseStarted):
            self._phase = event
            self._phase_began_s = time.monotonic()
        elif isinstance(event, RepeatEnded):
            ends_s = time.monotonic() + event.left_s
            self._trial_left = lambda: max(0.0, ends_s - time.monotonic())

    def __rich__(self) -> Text:
        if not self._phase.name:
            return Text("")
        text = Text.assemble(("  > ", "cyan"), f"{self._phase.repeat} {self._phase.name}".strip())
        spent_s = time.monotonic() - self._phase_began_s
        if self._phase.expected_s is None:
            text.append(f"  {format_duration(spent_s)}", style="dim")
        else:
            text.append(f"  {format_duration(max(0.0, self._phase.expected_s - spent_s))} left", style="dim")
        if self._trial_left is not None:
            text.append(f"   trial: {format_duration(self._trial_left())} left", style="dim")
        return text
