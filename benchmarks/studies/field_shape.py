"""The paper's field trial on emulated robots: `python -m benchmarks.studies.field_shape [--figures FOLDER]`, as root.

*The paper* is the publication whose field trials fieldkit automates (docs/index.md).

Four campaigns (benchmarks/studies/lawn/: two topologies, with line of sight and behind the wall) run in parallel,
because a repeat mostly waits; 640 repeats take 21 to 25 minutes. The program can be stopped at any time; the same
command continues the campaigns. At the end it prints the table of docs/studies/field-shape.md and draws its two
figures.
"""

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.analysis import table_files
from fieldkit.analysis.cells import Cell, Estimate, aggregate
from fieldkit.analysis.quantities import Quantity
from fieldkit.analysis.repeats import Repeats
from fieldkit.analysis.wording import scale
from fieldkit.core import files
from fieldkit.core.columns import Kind
from fieldkit.report import figures
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.theme import Style
from fieldkit.report.wording import estimate
from fieldkit.trial.columns import trial_columns

LAB: Final = Path(__file__).with_name("lawn")
CAMPAIGNS: Final = ("master-los", "master-nlos", "masterless-los", "masterless-nlos")
METRES_PER_FOOT: Final = 0.3048
DODGE_FT: Final = 0.35
"""Offset in feet between series at the same distance, so that intervals do not overlap."""

PAPER_DELAY: Final = Quantity("paper_delay_s", "mean RTT", Kind.MEDIAN, "s")
BY: Final = ("topology", "scenario", "protocol", "distance_m")
STYLES: Final[dict[tuple[str, str], Style]] = {
    ("master", "los"): Style("blue", "o"),
    ("master", "nlos"): Style("red", "s"),
    ("masterless", "los"): Style("blue", "o", "dashed"),
    ("masterless", "nlos"): Style("red", "s", "dashed"),
}
# Panels of the two figures, and columns of the table: title, protocol and quantity.
LOSS: Final = (
    ("UDP: IP packets", "udp", "ip_loss"),
    ("UDP: datagrams of 8,192 bytes", "udp", "datagram_loss"),
    ("UDP: bytes of the file", "udp", "file_loss"),
    ("TCP: bytes lost, then retransmitted", "tcp", "tcp_byte_loss"),
)
DELAY: Final = (
    ("TCP: 502 bytes there and back", "tcp", PAPER_DELAY.name),
    ("UDP: 8,192 bytes there and back", "udp", PAPER_DELAY.name),
)
TABLE_COLUMNS: Final = (
    ("IP packets", "udp", "ip_loss"),
    ("datagrams", "udp", "datagram_loss"),
    ("file, UDP", "udp", "file_loss"),
    ("TCP bytes lost, then retransmitted", "tcp", "tcp_byte_loss"),
    ("RTT, 502 bytes", "tcp", PAPER_DELAY.name),
    ("RTT, 8,192 bytes", "udp", PAPER_DELAY.name),
)


def copy_lab(folder: Path, repeats_each: int | None) -> None:
    """Copy the lab's files into a folder if it does not exist; the files of a started campaign must not change."""
    if folder.exists():
        return
    shutil.copytree(LAB, folder)
    if repeats_each is not None:
        for name in CAMPAIGNS:
            path = folder / f"{name}.yaml"
            text = path.read_text(encoding="utf-8")
            path.write_text(text.replace("repeats: 20", f"repeats: {repeats_each}"), encoding="utf-8")


def run(folder: Path) -> None:
    """Run or continue all campaigns, each with a log file.

    Raises:
        subprocess.CalledProcessError: A campaign failed; its log contains the reason.
    """
    environment = os.environ | {"PYTHONPATH": str(LAB.parent.parent), "PYTHONUNBUFFERED": "1"}
    running = []
    for name in CAMPAIGNS:
        command = (sys.executable, "-m", "fieldkit", "campaign", f"{name}.yaml")
        with (folder / f"{name}.log").open("a", encoding="utf-8") as log:
            running.append(subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log))
    for process in running:
        process.wait()
    for process in running:
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, process.args)


def read(folder: Path) -> Repeats:
    """Return all attempts of the campaigns."""
    return table_files.read(sorted(folder.glob("trials/campaign_*/*/trial.csv")), trial_columns())


def chart(cells: Sequence[Cell], name: str, panels: Sequence[tuple[str, str, str]]) -> Chart:
    """Return a chart of panels, each given as title, protocol and quantity."""
    drawn_panels = [_panel(cells, *panel) for panel in panels]
    return Chart(name=name, title=name, caption="", panels=drawn_panels)


def _panel(cells: Sequence[Cell], title: str, protocol: str, quantity: str) -> Panel:
    protocol_cells = [cell for cell in cells if cell.key["protocol"] == protocol]
    largest = max(cell.estimates[quantity].value for cell in protocol_cells)
    axis_scale = scale(protocol_cells[0].estimates[quantity].quantity, protocol_cells)
    factor, unit = axis_scale.factor, axis_scale.unit
    series = []
    for rank, ((topology, scenario), style) in enumerate(STYLES.items()):
        series_cells = [
            cell for cell in protocol_cells if (cell.key["topology"], cell.key["scenario"]) == (topology, scenario)
        ]
        estimates = [cell.estimates[quantity] for cell in series_cells]
        series.append(
            Series(
                label=f"{topology}, {'in sight' if scenario == 'los' else 'behind the wall'}",
                style=style,
                x=[distance_ft(cell) + (rank - (len(STYLES) - 1) / 2) * DODGE_FT for cell in series_cells],
                y=[factor * item.value for item in estimates],
                low=[_end(item, item.low, factor) for item in estimates],
                high=[_end(item, item.high, factor) for item in estimates],
            )
        )
    top = max(1.0 if unit == "%" else 0.0, 1.6 * factor * largest)
    return Panel(
        title, "distance (ft)", f"lost ({unit})" if unit == "%" else f"mean RTT ({unit})", series, "", top=top
    )


def _end(source: Estimate, end: float | None, factor: float) -> float | None:
    """Return an end of an interval to draw; None if there is no interval.

    The result is also None if the value is 0, because the interval would then depend only on the number of repeats.
    """
    return None if end is None or source.value == 0 else factor * end


def distance_ft(cell: Cell) -> float:
    """Return a cell's distance in feet."""
    metres = cell.key["distance_m"]
    assert isinstance(metres, float)
    return metres / METRES_PER_FOOT


def table(cells: Sequence[Cell], attempts: Repeats) -> Iterator[str]:
    """Yield a Markdown table with a line per condition and the lateness of the emulator."""
    yield "| " + " | ".join(["condition", *(title for title, _, _ in TABLE_COLUMNS), "late, p99 / max (ms)"]) + " |"
    yield "| " + " | ".join(["---"] * (len(TABLE_COLUMNS) + 2)) + " |"
    for topology, scenario, metres in sorted({_place(cell) for cell in cells}):
        by_protocol = {
            str(cell.key["protocol"]): cell for cell in cells if _place(cell) == (topology, scenario, metres)
        }
        values = [
            _text(by_protocol[protocol].estimates[quantity]) if protocol in by_protocol else ""
            for _, protocol, quantity in TABLE_COLUMNS
        ]
        rows = (attempts.texts["topology"] == topology) & (attempts.texts["scenario"] == scenario)
        rows &= attempts.numbers["distance_m"] == metres
        late = [
            _milliseconds(attempts.numbers[f"emulator_late_{statistic}_s"][rows], reduce)
            for statistic, reduce in LATE
        ]
        label = f"{topology}, {scenario.upper()}, {metres / METRES_PER_FOOT:.0f} ft"
        yield "| " + " | ".join([label, *values, " / ".join(late)]) + " |"


LATE: Final[tuple[tuple[str, Callable[..., float]], ...]] = (("p99", np.nanmedian), ("max", np.nanmax))
"""Statistics of the lateness: the median over the repeats of their p99, and the maximum of all packets."""


def _place(cell: Cell) -> tuple[str, str, float]:
    return str(cell.key["topology"]), str(cell.key["scenario"]), float(cell.key["distance_m"] or 0.0)


def _text(source: Estimate) -> str:
    return estimate(source) if source.value else "0"


def _milliseconds(values: np.ndarray[tuple[int], np.dtype[np.float64]], reduce: Callable[..., float]) -> str:
    return f"{1e3 * float(reduce(values)):.2f}"


def main() -> None:
    """Run or continue the campaigns, print the table, draw the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("field-shape"), help="folder of the lab and its trials")
    parser.add_argument("--figures", type=Path, help="write field-shape-loss.svg and field-shape-delay.svg there")
    parser.add_argument("--repeats", type=int, help="fewer repeats, for a test")
    parser.add_argument("--no-run", action="store_true", help="read the existing results")
    options = parser.parse_args()
    copy_lab(options.out, options.repeats)
    if not options.no_run:
        run(options.out)
    attempts = read(options.out)
    cells = aggregate(attempts, BY, quantities=(*attempts.quantities, PAPER_DELAY))
    statuses, counts = np.unique(attempts.texts["status"], return_counts=True)
    summary = ", ".join(f"{count} {status}" for status, count in zip(statuses, counts, strict=True))
    print(f"{summary}; load average {os.getloadavg()[1]:.1f} over the last 5 minutes")
    print("\n".join(table(cells, attempts)))
    if options.figures:
        for name, panels in (("field-shape-loss", LOSS), ("field-shape-delay", DELAY)):
            files.write(options.figures / f"{name}.svg", figures.paper(chart(cells, name, panels), "svg"))


if __name__ == "__main__":
    main()
