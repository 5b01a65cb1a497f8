"""The paper's field trial on emulated robots: `python -m benchmarks.field_shape [--figures FOLDER]`, as root.

Four campaigns (benchmarks/lawn/: two topologies, with line of sight and behind the wall) run beside each other, for a
repeat mostly waits; 640 repeats take 21 to 25 minutes. Stop it whenever you like: the same command goes on where it
stopped. Then it prints the table of docs/studies/field-shape.md and draws its two figures.
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

from fieldkit.analysis import repeats
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
"""Between series at one distance, so that no interval hides another."""

PAPER_DELAY: Final = Quantity("paper_delay_s", "mean RTT", Kind.MEDIAN, "s")
BY: Final = ("topology", "scenario", "protocol", "distance_m")
STYLES: Final[dict[tuple[str, str], Style]] = {
    ("master", "los"): Style("blue", "o"),
    ("master", "nlos"): Style("red", "s"),
    ("masterless", "los"): Style("blue", "o", "dashed"),
    ("masterless", "nlos"): Style("red", "s", "dashed"),
}
LOSS: Final = (
    ("UDP: IP packets", "udp", "ip_loss"),
    ("UDP: datagrams of 8,192 bytes", "udp", "datagram_loss"),
    ("UDP: bytes of the file", "udp", "file_loss"),
    ("TCP: bytes, before TCP repaired it", "tcp", "tcp_byte_loss"),
)
DELAY: Final = (
    ("TCP: 502 bytes there and back", "tcp", PAPER_DELAY.name),
    ("UDP: 8,192 bytes there and back", "udp", PAPER_DELAY.name),
)
SHOWN: Final = (
    ("IP packets", "udp", "ip_loss"),
    ("datagrams", "udp", "datagram_loss"),
    ("file, UDP", "udp", "file_loss"),
    ("TCP bytes, repaired", "tcp", "tcp_byte_loss"),
    ("RTT, 502 bytes", "tcp", PAPER_DELAY.name),
    ("RTT, 8,192 bytes", "udp", PAPER_DELAY.name),
)


def lab(folder: Path, repeats_each: int | None) -> None:
    """Put the lab's files into a folder; a campaign that was begun there keeps its own."""
    if folder.exists():
        return
    shutil.copytree(LAB, folder)
    if repeats_each is not None:
        for name in CAMPAIGNS:
            path = folder / f"{name}.yaml"
            text = path.read_text(encoding="utf-8")
            path.write_text(text.replace("repeats: 20", f"repeats: {repeats_each}"), encoding="utf-8")


def run(folder: Path) -> None:
    """Run all campaigns, or go on with them, each with its log beside it.

    Raises:
        subprocess.CalledProcessError: One of them did not end well; its log says why.
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
    return repeats.read(sorted(folder.glob("trials/campaign_*/*/trial.csv")), trial_columns())


def chart(cells: Sequence[Cell], name: str, panels: Sequence[tuple[str, str, str]]) -> Chart:
    """Return a chart of panels that are given as title, protocol and quantity."""
    drawn = [_panel(cells, *panel) for panel in panels]
    return Chart(name=name, title=name, caption="", panels=drawn)


def _panel(cells: Sequence[Cell], title: str, protocol: str, quantity: str) -> Panel:
    own = [cell for cell in cells if cell.key["protocol"] == protocol]
    largest = max(cell.estimates[quantity].value for cell in own)
    written = scale(own[0].estimates[quantity].quantity, own)
    factor, unit = written.factor, written.unit
    series = []
    for rank, ((topology, scenario), style) in enumerate(STYLES.items()):
        mine = [cell for cell in own if (cell.key["topology"], cell.key["scenario"]) == (topology, scenario)]
        found = [cell.estimates[quantity] for cell in mine]
        series.append(
            Series(
                label=f"{topology}, {'in sight' if scenario == 'los' else 'behind the wall'}",
                style=style,
                x=[feet(cell) + (rank - 1.5) * DODGE_FT for cell in mine],
                y=[factor * one.value for one in found],
                low=[_end(one, one.low, factor) for one in found],
                high=[_end(one, one.high, factor) for one in found],
            )
        )
    top = max(1.0 if unit == "%" else 0.0, 1.6 * factor * largest)
    return Panel(
        title, "distance (ft)", f"lost ({unit})" if unit == "%" else f"mean RTT ({unit})", series, "", top=top
    )


def _end(one: Estimate, end: float | None, factor: float) -> float | None:
    """Return an end of an interval to draw; where nothing was lost it tells of the number of repeats alone."""
    return None if end is None or one.value == 0 else factor * end


def feet(cell: Cell) -> float:
    """Return a cell's distance in feet."""
    metres = cell.key["distance_m"]
    assert isinstance(metres, float)
    return metres / METRES_PER_FOOT


def table(cells: Sequence[Cell], found: Repeats) -> Iterator[str]:
    """Yield a Markdown table, a line per condition, with how late the emulator was."""
    yield "| " + " | ".join(["condition", *(title for title, _, _ in SHOWN), "late, p99 / max (ms)"]) + " |"
    yield "| " + " | ".join(["---"] * (len(SHOWN) + 2)) + " |"
    for topology, scenario, metres in sorted({_place(cell) for cell in cells}):
        alike = {str(cell.key["protocol"]): cell for cell in cells if _place(cell) == (topology, scenario, metres)}
        said = [
            _said(alike[protocol].estimates[quantity]) if protocol in alike else "" for _, protocol, quantity in SHOWN
        ]
        here = (found.texts["topology"] == topology) & (found.texts["scenario"] == scenario)
        here &= found.numbers["distance_m"] == metres
        late = [_milliseconds(found.numbers[f"emulator_late_{which}_s"][here], how) for which, how in LATE]
        label = f"{topology}, {scenario.upper()}, {metres / METRES_PER_FOOT:.0f} ft"
        yield "| " + " | ".join([label, *said, " / ".join(late)]) + " |"


LATE: Final[tuple[tuple[str, Callable[..., float]], ...]] = (("p99", np.nanmedian), ("max", np.nanmax))
"""The median repeat's, and the latest packet of all."""


def _place(cell: Cell) -> tuple[str, str, float]:
    return str(cell.key["topology"]), str(cell.key["scenario"]), float(cell.key["distance_m"] or 0.0)


def _said(one: Estimate) -> str:
    return estimate(one) if one.value else "0"


def _milliseconds(values: np.ndarray[tuple[int], np.dtype[np.float64]], how: Callable[..., float]) -> str:
    return f"{1e3 * float(how(values)):.2f}"


def main() -> None:
    """Run or go on, print the table, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("field-shape"), help="folder of the lab and its trials")
    parser.add_argument("--figures", type=Path, help="write field-shape-loss.svg and field-shape-delay.svg there")
    parser.add_argument("--repeats", type=int, help="fewer, to try it")
    parser.add_argument("--no-run", action="store_true", help="read what is there")
    options = parser.parse_args()
    lab(options.out, options.repeats)
    if not options.no_run:
        run(options.out)
    found = read(options.out)
    cells = aggregate(found, BY, quantities=(*found.quantities, PAPER_DELAY))
    statuses, counts = np.unique(found.texts["status"], return_counts=True)
    ended = ", ".join(f"{count} {status}" for status, count in zip(statuses, counts, strict=True))
    print(f"{ended}; load average {os.getloadavg()[1]:.1f} over the last 5 minutes")
    print("\n".join(table(cells, found)))
    if options.figures:
        for name, panels in (("field-shape-loss", LOSS), ("field-shape-delay", DELAY)):
            files.write(options.figures / f"{name}.svg", figures.paper(chart(cells, name, panels), "svg"))


if __name__ == "__main__":
    main()
