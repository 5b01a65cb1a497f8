"""The command `fieldkit cosim table`, which compares the numbers of the paper with those of simulations.

The paper is the publication that fieldkit reproduces (cited in docs/index.md).
"""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Final

from fieldkit.cli.display import showing_progress
from fieldkit.core.text import print_text
from fieldkit.core.units import format_count
from sim_backends.cosim.commands import settings
from sim_backends.cosim.commands.settings import progress_reporter
from sim_backends.cosim.commands.sheets import Sheet, SheetColumn, SheetPart, Value, wrapped
from sim_backends.cosim.studies.paper_claims import Claim, claim_setups, compute_claims
from sim_backends.cosim.studies.paper_setups import flow_samples
from sim_backends.cosim.studies.paper_tables import Agreement, PaperCell, PaperRow, paper_table

_TITLES: Final = {
    "1": "table 1, masterless, UGV to UGV",
    "2": "table 2, masterless, UGV to UAV",
    "3": "table 3, master-based (ROS 1), UGV to UGV",
    "claims": "changes by the paper's adaptive masterless system, in %",
    "emane": "EMANE, before and after node 10 moved",
}
_LABELS: Final = {
    "line": SheetColumn("line", "sight", "with or without line of sight"),
    "distance_m": SheetColumn("distance_m", "distance (m)", ""),
    "protocol": SheetColumn("protocol", "protocol", ""),
    "radio": SheetColumn("radio", "radio", ""),
    "when": SheetColumn("when", "when", ""),
}
_REASON: Final = SheetColumn("loss_reason", "main reason", "most frequent reason why packets did not arrive")


def run(arguments: argparse.Namespace) -> int:
    """Run the simulations of a table or of the claims of the paper; print the numbers of both."""
    which, changes = arguments.which, settings.read_changes(arguments)
    seeds = range(1, arguments.seeds + 1) if arguments.seed is None else (arguments.seed,)
    table = None if which == "claims" else paper_table(which, changes)
    setups = claim_setups(changes) if table is None else table.setups
    with showing_progress() as sink:
        progress = partial(progress_reporter(sink), f"table {which}", len(setups) * len(seeds))
        progress(0)
        samples = flow_samples(setups, seeds, workers=settings.read_workers(arguments), progress=progress)
    title = f"{_TITLES[which]}, {format_count(len(seeds), 'seed')}"
    if table is None:
        claim_sheet(title, compute_claims(setups, samples)).show(arguments.format)
        return 0
    rows = table.rows(samples)
    paper_sheet(title, rows, is_ping=which == "emane").show(arguments.format)
    if arguments.format in {"table", "markdown"}:
        print_text(wrapped(summary(rows)))
    return 0


def paper_sheet(title: str, rows: Sequence[PaperRow], *, is_ping: bool) -> Sheet:
    """Return a table of the paper.

    Args:
        title: Its title.
        rows: Its rows.
        is_ping: True if delays are round trips, which are shown in milliseconds.
    """
    labels = [_LABELS[name] for name in rows[0].labels]
    delay, loss = _columns("delay", 1e3 if is_ping else 1.0), _columns("loss", 100)
    columns = [*labels, *delay, *loss, _REASON]
    values = [(*row.labels.values(), *_values(row.delay), *_values(row.loss), row.reason) for row in rows]
    # Labels that are equal in all rows are omitted, because they do not distinguish rows.
    shown_labels = [label.name for label in labels if len({row.labels[label.name] for row in rows}) > 1]
    delay_name = "mean round trip (ms)" if is_ping else "sum of delays (s)"
    return Sheet(
        columns,
        values,
        [
            SheetPart(f"{title}: {delay_name}", [*shown_labels, *(column.name for column in delay)]),
            SheetPart(
                "packets that did not arrive (%)",
                [*shown_labels, *(column.name for column in loss if column.head != "seeds"), _REASON.name],
            ),
        ],
    )


def _columns(name: str, factor: float) -> list[SheetColumn]:
    """Return the columns of delays or losses; `factor` converts from the SI unit to the shown unit."""
    suffix = "" if name == "loss" else "_s"
    return [
        SheetColumn(f"{name}_paper{suffix}", "paper", "as printed", factor, digits=6),
        SheetColumn(f"{name}{suffix}", "simulated", "mean over seeds", factor),
        SheetColumn(f"{name}_low{suffix}", "from", "lower end of its 95 % interval", factor),
        SheetColumn(f"{name}_high{suffix}", "to", "upper end of this interval", factor),
        SheetColumn(f"{name}_seeds", "seeds", "number of seeds for which packets arrived" if name == "delay" else ""),
        SheetColumn(
            f"{name}_agreement",
            "verdict",
            "agrees if the printed value, with its precision, is within the interval, or equals the simulated mean",
        ),
        SheetColumn(f"{name}_off{suffix}", "deviation", "simulated value minus the printed one", factor),
    ]


def _values(cell: PaperCell) -> tuple[Value, ...]:
    measured = cell.measured
    return (
        cell.printed.value,
        measured.value,
        measured.low,
        measured.high,
        cell.seeds,
        str(cell.agreement),
        cell.difference,
    )


def summary(rows: Sequence[PaperRow]) -> str:
    """Return the number of cells of a table that agree, as text."""
    cells = [cell for row in rows for cell in (row.delay, row.loss)]
    agreeing_cells = [cell for cell in cells if cell.agreement is Agreement.AGREES]
    by_mean = sum(cell.agrees_by_mean for cell in agreeing_cells)
    return (
        f"{len(agreeing_cells)} of {format_count(len(cells), 'cell')} agree: {by_mean} by the simulated mean, "
        f"{len(agreeing_cells) - by_mean} only because the simulated interval is wide. "
        "Assumptions for values that the paper does not state: fieldkit docs paper"
    )


def claim_sheet(title: str, claims: Sequence[Claim]) -> Sheet:
    """Return the table of the paper's claims.

    Args:
        title: Its title.
        claims: The claims with their results.
    """
    columns = (
        SheetColumn("than", "compared with", ""),
        SheetColumn("lines", "sight", "with line of sight, without, or all"),
        SheetColumn("quantity", "quantity", ""),
        SheetColumn("paper", "paper", "as stated in the paper", 100, digits=6),
        SheetColumn("tables", "tables", "from its tables 1 and 3", 100),
        SheetColumn(
            "ours",
            "simulated",
            "relative change of the delay of a packet, or change of the loss in percentage points",
            100,
        ),
        SheetColumn("low", "from", "lower end of its 95 % interval", 100),
        SheetColumn("high", "to", "upper end of this interval", 100),
        SheetColumn("row_count", "n", "number of rows of the tables that the change is based on"),
        SheetColumn("agreement", "verdict", "agrees if the paper's statement is within the interval"),
    )
    rows = [
        (
            claim.compared_system,
            claim.sight_group,
            claim.quantity,
            None if claim.claimed_change is None else claim.claimed_change.value,
            claim.change_in_tables,
            *(claim.measured_change.value, claim.measured_change.low, claim.measured_change.high),
            claim.rows,
            str(claim.agreement or ""),
        )
        for claim in claims
    ]
    return Sheet(columns, rows, [SheetPart(title, [column.name for column in columns])])
