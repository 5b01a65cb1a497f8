"""Compare middlewares on a lossy radio: `python -m benchmarks.studies.middleware [--figures FOLDER] [--table FILE]`.

The program needs root. Six campaigns of benchmarks/studies/middleware/ run in parallel, because a repeat mostly
waits; `--only` selects some of them, `--full` those that last hours. The program can be stopped at any time; the same
command continues the campaigns. At the end it prints the conditions of the runs for docs/studies/middleware.md,
writes the table docs/studies/middleware.csv, and draws the figures.

Two repeats, as in the campaigns, show only large differences. On a quiet machine `--repeats 12` measures each place
twelve times, in about two and a half hours. The intervals then treat repeats as the independent samples.
`--from-table docs/studies/middleware.csv --figures docs/studies` only draws the figures, from the table.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from benchmarks.studies import middleware_table
from benchmarks.studies.middleware_cells import BYTES, CAMPAIGNS, MiddlewareCell, MiddlewareFindings, read
from fieldkit.core import files
from fieldkit.report import figures
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.theme import Style

LAB: Final = Path(__file__).with_name("middleware")
ROOT: Final = LAB.parents[2]
ROS2: Final = ROOT / ".ros2" / "bin" / "python"
"""A real ROS 2, as installed by `.ci/install --dev`."""

STYLES: Final[dict[str, Style]] = {
    "CycloneDDS": Style("blue", "o"),
    "CycloneDDS, tuned": Style("blue", "o", "dashed"),
    "Fast DDS": Style("orange", "D"),
    "Fast DDS, tuned": Style("orange", "D", "dashed"),
    "Zenoh": Style("red", "s"),
    "Zenoh, tuned": Style("red", "s", "dashed"),
    "ROS 1": Style("green", "^"),
    "ROS 1, tuned": Style("green", "^", "dashed"),
}
KINDS: Final = ("best effort", "reliable")
SIZES: Final = {100: "100 B", 1_000: "1 kB", 10_000: "10 kB", 100_000: "100 kB", 1_000_000: "1 MB"}
DODGE_M: Final = 1.1
"""Offset between series at the same distance, so that they do not overlap."""
MARGIN_M: Final = 7.0
ROBOTS_DODGE: Final = 0.06
"""Offset between series at the same number of robots."""


def copy_lab(folder: Path, repeats: int | None = None) -> None:
    """Copy missing files of the lab into a folder, so that the files of a started campaign do not change.

    The profile of the robots with a real ROS 2 is written each time.

    Args:
        folder: The folder.
        repeats: Number of repeats for separate campaigns, or None for the number in the files.
    """
    robots = folder / "robots"
    robots.mkdir(parents=True, exist_ok=True)
    for source in LAB.glob("*.yaml"):
        if not (folder / source.name).exists():
            shutil.copy(source, folder)
        if (
            repeats
            and source.stem in CAMPAIGNS
            and not (new_file := folder / f"{campaign_name(source.stem, repeats)}.yaml").exists()
        ):
            text = source.read_text(encoding="utf-8")
            text = re.sub(r"(?m)^name: .*$", f"name: {campaign_name(source.stem, repeats)}", text)
            new_file.write_text(re.sub(r"(?m)^repeats: .*$", f"repeats: {repeats}", text), encoding="utf-8")
    (robots / "ros2_burger.yaml").write_text(ros2_robot(), encoding="utf-8")


def campaign_name(campaign: str, repeats: int | None) -> str:
    """Return the name of a campaign, with the number of repeats if it is not the number in the file: `dds-12`."""
    return f"{campaign}-{repeats}" if repeats else campaign


def ros2_robot() -> str:
    """Return the profile of a robot of the lab that has a real ROS 2."""
    text = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    for old, new in (
        ("name: turtlebot3_burger", "name: ros2_burger"),
        ("variant: ros1", "variant: ros2"),
        ("  ping: ping", f"  ping: ping\n  python: {ROS2}"),
    ):
        if old not in text:
            raise ValueError(f"the profile of a TurtleBot no longer contains {old!r}")
        text = text.replace(old, new, 1)
    return text


def run(folder: Path, names: Sequence[str]) -> None:
    """Run or continue campaigns, each with a log file; report those that failed.

    Repeats with late packets, on a busy machine, are void. The valid repeats of a failed campaign are still used.
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    running = []
    for name in names:
        site = "ros2-lab.yaml" if "ros2" in name else "fieldkit.yaml"
        command = (sys.executable, "-m", "fieldkit", "campaign", f"{name}.yaml", "--site", site)
        with (folder / f"{name}.log").open("a", encoding="utf-8") as log:
            running.append(subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log))
    for name, process in zip(names, running, strict=True):
        if process.wait() != 0:
            print(f"{name}: exit code {process.returncode}, see {folder / name}.log", file=sys.stderr)


def by_distance(findings: MiddlewareFindings, name: str, quantity: "PlottedQuantity") -> Chart:
    """Return a chart of the measurements with two robots: one row of panels per message size.

    Best effort is on the left, and reliable on the right.
    """
    pairs = [cell for cell in findings.cells if cell.robots == 2]
    distances_m = [cell.distance_m for cell in pairs] or [0.0]
    panels = []
    for size in BYTES:
        for kind in KINDS:
            series = []
            for rank, label in enumerate(STYLES):
                series_cells = [
                    cell for cell in pairs if (cell.kind, cell.middleware, cell.size_bytes) == (kind, label, size)
                ]
                shift_m = (rank - (len(STYLES) - 1) / 2) * DODGE_M
                series.append(_series(label, [(cell.distance_m + shift_m, cell) for cell in series_cells], quantity))
            panel = quantity.panel(f"{SIZES[size]}, {kind}{_sample_count_text(pairs, size)}", "distance (m)", series)
            panels.append(replace(panel, left=min(distances_m) - MARGIN_M, right=max(distances_m) + MARGIN_M))
    return Chart(name=name, title=name, caption="", panels=panels)


def by_robots(findings: MiddlewareFindings) -> Chart:
    """Return a chart of loss and delay by the number of robots, all but one of which publish to that one."""
    panels = []
    for quantity in (LOSS, DELAY):
        for metres in sorted({cell.distance_m for cell in findings.cells if cell.robots > 2}):
            for size in sorted({cell.size_bytes for cell in _comparable(findings, metres)}):
                size_cells = [cell for cell in _comparable(findings, metres) if cell.size_bytes == size]
                numbers = sorted({cell.robots for cell in size_cells})
                series = [
                    _series(
                        label,
                        [
                            (cell.robots + ROBOTS_DODGE * rank, cell)
                            for cell in size_cells
                            if cell.middleware == label
                        ],
                        quantity,
                    )
                    for rank, label in enumerate(STYLES)
                ]
                panel = quantity.panel(f"{SIZES[size]} each at {metres:g} m, reliable", "robots", series)
                panels.append(replace(panel, x_ticks=[(number, str(number)) for number in numbers]))
    return Chart(name="middleware-robots", title="", caption="", panels=panels)


def _series(label: str, points: Sequence[tuple[float, MiddlewareCell]], quantity: "PlottedQuantity") -> Series:
    """Return the points of a middleware with their intervals.

    They are not connected by a line, which would suggest a trend that the wide intervals do not support.
    """
    measured = sorted(((x, cell) for x, cell in points if quantity.value(cell) is not None), key=lambda pair: pair[0])
    ends = [quantity.interval(cell) for _, cell in measured]
    return Series(
        label,
        STYLES[label],
        [x for x, _ in measured],
        [quantity.value(cell) or 0.0 for _, cell in measured],
        low=[low for low, _ in ends],
        high=[high for _, high in ends],
        join="none",
    )


def _sample_count_text(cells: Sequence[MiddlewareCell], size: int) -> str:
    """Return the number of samples and repeats of each point of a size: `, n = 80 (2 repeats)`.

    If the numbers of samples differ, the text has their range, and the repeats of the point with the most samples. It
    is empty without samples.
    """
    counts = sorted({(cell.samples, cell.repeats) for cell in cells if cell.size_bytes == size})
    if not counts or not counts[-1][0]:
        return ""
    least, most = counts[0], counts[-1]
    number = f"{least[0]}-{most[0]}" if least[0] != most[0] else str(most[0])
    return f", n = {number} ({most[1]} repeats)"


def _comparable(findings: MiddlewareFindings, distance_m: float) -> list[MiddlewareCell]:
    """Return the cells of several robots at a distance, and those of two robots with the same settings."""
    at_distance = [cell for cell in findings.cells if cell.distance_m == distance_m and cell.kind == "reliable"]
    settings = {(cell.middleware, cell.size_bytes) for cell in at_distance if cell.robots > 2}
    return [cell for cell in at_distance if (cell.middleware, cell.size_bytes) in settings]


def _loss_percent(cell: MiddlewareCell) -> float | None:
    return None if cell.loss is None else 100 * cell.loss


def _loss_interval_percent(cell: MiddlewareCell) -> tuple[float | None, float | None]:
    low, high = (None if end is None else 100 * end for end in (cell.loss_low, cell.loss_high))
    return low, high


def _no_interval(_cell: MiddlewareCell) -> tuple[None, None]:
    return None, None


def _delay_p95_ms(cell: MiddlewareCell) -> float | None:
    return None if cell.delay_p95_s is None else 1e3 * cell.delay_p95_s


@dataclass(frozen=True)
class PlottedQuantity:
    """A quantity that panels show on the y axis.

    Attributes:
        y_label: Name and unit of the quantity.
        value: Function that returns the quantity of a cell.
        interval: Function that returns its 95 % confidence interval for a cell, or (None, None).
        bottom: Lower end of the axis.
        top: Upper end of the axis.
        log: True for a logarithmic axis.
    """

    y_label: str
    value: Callable[[MiddlewareCell], float | None]
    interval: Callable[[MiddlewareCell], tuple[float | None, float | None]]
    bottom: float
    top: float
    log: bool = False

    def panel(self, title: str, x_label: str, series: Sequence[Series]) -> Panel:
        """Return a panel that shows these series of the quantity."""
        return Panel(title, x_label, self.y_label, series, "", bottom=self.bottom, top=self.top, log=self.log)


LOSS: Final = PlottedQuantity("samples lost (%)", _loss_percent, _loss_interval_percent, 0.0, 100.0)
DELAY: Final = PlottedQuantity("delay, 95th percentile (ms)", _delay_p95_ms, _no_interval, 1.0, 10_000.0, log=True)


def main() -> None:
    """Run or continue the campaigns, write the table, draw the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("middleware"), help="folder of the lab and its trials")
    parser.add_argument("--figures", type=Path, help="write middleware-loss, -delay and -robots.svg there")
    parser.add_argument("--table", type=Path, help="write loss and delay of each cell into this CSV file")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--full", action="store_true", help="the campaigns that take hours")
    size.add_argument("--repeats", type=int, help="repeats at each place, in separate campaigns")
    parser.add_argument(
        "--only", nargs="+", choices=CAMPAIGNS, default=CAMPAIGNS, help="run only these; all are read"
    )
    parser.add_argument("--no-run", action="store_true", help="read the existing results")
    parser.add_argument("--from-table", type=Path, help="draw the figures from this CSV file, run nothing")
    options = parser.parse_args()
    if options.from_table:
        draw(MiddlewareFindings(middleware_table.cells(options.from_table), "", 0.0, 0.0), options.figures)
        return
    prefix = "full-" if options.full else ""
    names = [f"{prefix}{campaign_name(name, options.repeats)}" for name in CAMPAIGNS]
    if not options.no_run:
        copy_lab(options.out, options.repeats)
        run(options.out, [f"{prefix}{campaign_name(name, options.repeats)}" for name in options.only])
    findings = read(options.out, names)
    print(
        f"{time.strftime('%Y-%m-%d', time.gmtime(findings.ended_s))}: {findings.status_text}; packets were up to "
        f"{1e3 * findings.late_s:.1f} ms late; load average {os.getloadavg()[2]:.1f} when this was written."
    )
    if options.table:
        files.write(options.table, middleware_table.text(findings.cells, list(STYLES)).encode())
    if options.figures:
        draw(findings, options.figures)


def draw(findings: MiddlewareFindings, folder: Path) -> None:
    """Write the figures of docs/studies/middleware.md into a folder."""
    for chart in (
        by_distance(findings, "middleware-loss", LOSS),
        by_distance(findings, "middleware-delay", DELAY),
        by_robots(findings),
    ):
        files.write(folder / f"{chart.name}.svg", figures.paper(chart, "svg"))


if __name__ == "__main__":
    main()
