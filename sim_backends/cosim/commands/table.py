"""`fieldkit cosim table TABLE`: the paper's numbers beside ours, and whether they agree."""

import argparse
import shutil
import textwrap
from collections.abc import Sequence
from functools import partial
from typing import Final

from fieldkit.cli.display import working
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.clock import teller
from sim_backends.cosim.commands.sheets import Part, Sheet, SheetColumn, Value
from sim_backends.cosim.studies.agreement import Agreement
from sim_backends.cosim.studies.flow_samples import flow_samples
from sim_backends.cosim.studies.paper_tables import PaperCell, PaperRow, paper_table

_TITLES: Final = {
    "1": "table 1, masterless, UGV to UGV",
    "2": "table 2, masterless, UGV to UAV",
    "3": "table 3, master-based (ROS 1), UGV to UGV",
    "emane": "EMANE, 100 pings over a mesh of ten nodes, before and after one moved",
}
_LABELS: Final = {
    "line": SheetColumn("line", "line", ""),
    "distance_m": SheetColumn("distance_m", "m", ""),
    "protocol": SheetColumn("protocol", "by", ""),
    "radio": SheetColumn("radio", "radio", ""),
    "when": SheetColumn("when", "when", ""),
}
_REASON: Final = SheetColumn("loss_reason", "mostly", "why most of what did not arrive did not")


def run(arguments: argparse.Namespace) -> int:
    """Run a table of the paper with all seeds, and print its numbers beside ours."""
    table = paper_table(arguments.which, settings.changes(arguments))
    seeds = range(1, arguments.seeds + 1)
    with working() as sink:
        progress = partial(teller(sink), f"table {arguments.which}", len(table.setups) * len(seeds))
        progress(0)
        rows = table.rows(flow_samples(table.setups, seeds, progress=progress))
    title = f"{_TITLES[arguments.which]}, {format_count(len(seeds), 'seed')}"
    _sheet(title, rows, is_ping=arguments.which == "emane").show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        width = min(shutil.get_terminal_size().columns - 1, 98)
        print(textwrap.fill(_summary(rows), width))
    return 0


def _sheet(title: str, rows: Sequence[PaperRow], *, is_ping: bool) -> Sheet:
    labels = [_LABELS[name] for name in rows[0].labels]
    delay, loss = _columns("delay", "ms" if is_ping else "s", 1e3 if is_ping else 1.0), _columns("loss", "%", 100)
    columns = [*labels, *delay, *loss, _REASON]
    found = [(*row.labels.values(), *_values(row.delay), *_values(row.loss), row.reason) for row in rows]
    # What is the same in all rows is left to the title.
    shown = [one.name for one in labels if len({row.labels[one.name] for row in rows}) > 1]
    what = "mean round trip" if is_ping else "sum of the delays of a transmission of 10 s"
    return Sheet(
        columns,
        found,
        [
            Part(f"{title}: {what}", [*shown, *(column.name for column in delay)]),
            Part(
                "packets that did not arrive",
                [*shown, *(column.name for column in loss if column.head != "seeds"), _REASON.name],
            ),
        ],
    )


def _columns(name: str, unit: str, factor: float) -> list[SheetColumn]:
    """Return the columns of a cell; values are in seconds or shares, and shown in `unit`."""
    suffix = "" if name == "loss" else "_s"
    return [
        SheetColumn(f"{name}_paper{suffix}", f"paper ({unit})", "as printed", factor, digits=6),
        SheetColumn(f"{name}{suffix}", f"ours ({unit})", "mean over seeds", factor),
        SheetColumn(f"{name}_low{suffix}", "from", "begin of its 95 % interval", factor),
        SheetColumn(f"{name}_high{suffix}", "to", "its end", factor),
        SheetColumn(f"{name}_seeds", "seeds", "with how many anything arrived" if name == "delay" else ""),
        SheetColumn(
            f"{name}_agreement",
            "verdict",
            "whether the printed value, as it was rounded, lies in the interval, or is our mean",
        ),
        SheetColumn(f"{name}_off{suffix}", "off", "ours less the paper's", factor),
    ]


def _values(cell: PaperCell) -> tuple[Value, ...]:
    ours = cell.ours
    return (cell.printed.value, ours.value, ours.low, ours.high, cell.seeds, str(cell.agreement), cell.off)


def _summary(rows: Sequence[PaperRow]) -> str:
    """Return in words how many cells agree."""
    cells = [cell for row in rows for cell in (row.delay, row.loss)]
    agree = [cell for cell in cells if cell.agreement is Agreement.AGREES]
    by_mean = sum(cell.agrees_by_mean for cell in agree)
    return (
        f"{len(agree)} of {format_count(len(cells), 'cell')} agree: {by_mean} by our mean, {len(agree) - by_mean} "
        "only because our interval is that wide. What the paper does not say and what was taken for it: docs/paper.md"
    )
