"""Which middleware on a lossy radio: `python -m benchmarks.middleware [--figures docs/studies] [--page PAGE]`.

As root. Six campaigns of benchmarks/middleware/ run beside each other, for a repeat mostly waits; `--only` takes some
of them, `--full` those that last hours. Stop it at any time: the same command continues where it stopped. Then it
prints the tables of docs/studies/middleware.md, or writes them into PAGE, and draws its figures.

Two repeats, as the campaigns have, show large differences only. On a quiet machine `--repeats 12` measures each place
twelve times, in about two and a half hours. Then the repeat is the unit of the intervals.
`--from-page docs/studies/middleware.md --figures docs/studies` draws the figures from the tables of the page alone.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from benchmarks import middleware_page
from benchmarks.middleware_cells import BYTES, CAMPAIGNS, MiddlewareCell, MiddlewareFindings, read
from fieldkit.core import files
from fieldkit.report import figures
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.theme import Style

LAB: Final = Path(__file__).with_name("middleware")
ROOT: Final = LAB.parents[1]
ROS2: Final = ROOT / ".ros2" / "bin" / "python"
"""A real ROS 2, as `.ci/install --dev` puts it there."""
BEGIN: Final = "<!-- written by benchmarks.middleware: from here -->"
END: Final = "<!-- written by benchmarks.middleware: to here -->"

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
KINDS: Final = {"best effort": "best effort", "reliable": "reliable"}
SIZES: Final = {100: "100 B", 1_000: "1 kB", 10_000: "10 kB", 100_000: "100 kB", 1_000_000: "1 MB"}
DODGE_M: Final = 1.1
"""Between series at one distance, so that none hides another."""
AROUND_M: Final = 7.0
ROBOTS_DODGE: Final = 0.06
"""Between series at one number of robots."""


def lab(folder: Path, repeats: int | None = None) -> None:
    """Put the lab's files into a folder where it lacks them: a campaign that was begun there keeps its own.

    Args:
        folder: Where to.
        repeats: How often each place is measured in campaigns of their own; None for what the files say.
    """
    robots = folder / "robots"
    robots.mkdir(parents=True, exist_ok=True)
    for source in LAB.glob("*.yaml"):
        if not (folder / source.name).exists():
            shutil.copy(source, folder)
        if (
            repeats
            and source.stem in CAMPAIGNS
            and not (made := folder / f"{called(source.stem, repeats)}.yaml").exists()
        ):
            text = source.read_text(encoding="utf-8")
            text = re.sub(r"(?m)^name: .*$", f"name: {called(source.stem, repeats)}", text)
            made.write_text(re.sub(r"(?m)^repeats: .*$", f"repeats: {repeats}", text), encoding="utf-8")
    (robots / "ros2_burger.yaml").write_text(ros2_robot(), encoding="utf-8")


def called(campaign: str, repeats: int | None) -> str:
    """Return the name of a campaign with its own number of repeats: `dds-12`."""
    return f"{campaign}-{repeats}" if repeats else campaign


def ros2_robot() -> str:
    """Return the profile of a robot of the lab that has a real ROS 2."""
    text = (ROOT / "robots" / "turtlebot3_burger.yaml").read_text(encoding="utf-8")
    for known, other in (
        ("name: turtlebot3_burger", "name: ros2_burger"),
        ("variant: ros1", "variant: ros2"),
        ("  ping: ping", f"  ping: ping\n  python: {ROS2}"),
    ):
        if known not in text:
            raise ValueError(f"the profile of a TurtleBot has no {known!r} any more")
        text = text.replace(known, other, 1)
    return text


def run(folder: Path, names: Sequence[str]) -> None:
    """Run campaigns, or go on with them, each with its log beside it; say which did not end well.

    Repeats whose packets were too late on a busy machine are void, and what is valid counts all the same.
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


def by_distance(found: MiddlewareFindings, name: str, drawn: "DrawnFigure") -> Chart:
    """Return a chart of two robots: a row of panels per size, best effort on the left and reliable on the right."""
    two = [one for one in found.cells if one.robots == 2]
    ends = [one.distance_m for one in two] or [0.0]
    panels = []
    for size in BYTES:
        for kind, how in KINDS.items():
            series = []
            for rank, label in enumerate(STYLES):
                mine = [one for one in two if (one.kind, one.who, one.size_bytes) == (kind, label, size)]
                shift_m = (rank - (len(STYLES) - 1) / 2) * DODGE_M
                series.append(_series(label, [(one.distance_m + shift_m, one) for one in mine], drawn))
            panel = drawn.panel(f"{SIZES[size]}, {how}{_counted(two, size)}", "distance (m)", series)
            panels.append(replace(panel, left=min(ends) - AROUND_M, right=max(ends) + AROUND_M))
    return Chart(name=name, title=name, caption="", panels=panels)


def by_robots(found: MiddlewareFindings) -> Chart:
    """Return a chart of how loss and delay grow with the robots that publish to one."""
    panels = []
    for drawn in (LOST, LATE):
        for metres in sorted({one.distance_m for one in found.cells if one.robots > 2}):
            for size in sorted({one.size_bytes for one in _beside(found, metres)}):
                mine = [one for one in _beside(found, metres) if one.size_bytes == size]
                numbers = sorted({one.robots for one in mine})
                series = [
                    _series(
                        label, [(one.robots + ROBOTS_DODGE * rank, one) for one in mine if one.who == label], drawn
                    )
                    for rank, label in enumerate(STYLES)
                ]
                panel = drawn.panel(f"{SIZES[size]} each at {metres:g} m, reliable", "robots", series)
                panels.append(replace(panel, x_ticks=[(number, str(number)) for number in numbers]))
    return Chart(name="middleware-robots", title="", caption="", panels=panels)


def _series(label: str, points: Sequence[tuple[float, MiddlewareCell]], drawn: "DrawnFigure") -> Series:
    """Return the points of a middleware with their intervals; no line joins them, for these are too wide."""
    known = sorted(((x, cell) for x, cell in points if drawn.value(cell) is not None), key=lambda pair: pair[0])
    ends = [drawn.interval(cell) for _, cell in known]
    return Series(
        label,
        STYLES[label],
        [x for x, _ in known],
        [drawn.value(cell) or 0.0 for _, cell in known],
        low=[low for low, _ in ends],
        high=[high for _, high in ends],
        join="none",
    )


def _counted(cells: Sequence[MiddlewareCell], size: int) -> str:
    """Return of how many samples and repeats each point of a size is: `, n = 80 (2 repeats)`."""
    counts = sorted({(cell.samples, cell.repeats) for cell in cells if cell.size_bytes == size})
    if not counts or not counts[-1][0]:
        return ""
    least, most = counts[0], counts[-1]
    number = f"{least[0]}-{most[0]}" if least[0] != most[0] else str(most[0])
    return f", n = {number} ({most[1]} repeats)"


def _beside(found: MiddlewareFindings, distance_m: float) -> list[MiddlewareCell]:
    """Return what was measured of several robots at a place, and of two with the same settings."""
    there = [one for one in found.cells if one.distance_m == distance_m and one.kind == "reliable"]
    alike = {(one.who, one.size_bytes) for one in there if one.robots > 2}
    return [one for one in there if (one.who, one.size_bytes) in alike]


def _lost(cell: MiddlewareCell) -> float | None:
    return None if cell.loss is None else 100 * cell.loss


def _lost_interval(cell: MiddlewareCell) -> tuple[float | None, float | None]:
    low, high = (None if end is None else 100 * end for end in (cell.loss_low, cell.loss_high))
    return low, high


def _no_interval(_cell: MiddlewareCell) -> tuple[None, None]:
    return None, None


def _late(cell: MiddlewareCell) -> float | None:
    return None if cell.delay_p95_s is None else 1e3 * cell.delay_p95_s


@dataclass(frozen=True)
class DrawnFigure:
    """A figure of cells as panels have it.

    Attributes:
        y_label: Its name and unit.
        value: Takes it of a cell.
        interval: Takes its 95 % interval, if there is one.
        bottom: Lower end of its axis.
        top: Upper end.
        log: Whether that is logarithmic.
    """

    y_label: str
    value: Callable[[MiddlewareCell], float | None]
    interval: Callable[[MiddlewareCell], tuple[float | None, float | None]]
    bottom: float
    top: float
    log: bool = False

    def panel(self, title: str, x_label: str, series: Sequence[Series]) -> Panel:
        """Return a panel of series of it."""
        return Panel(title, x_label, self.y_label, series, "", bottom=self.bottom, top=self.top, log=self.log)


LOST: Final = DrawnFigure("samples lost (%)", _lost, _lost_interval, 0.0, 100.0)
LATE: Final = DrawnFigure("delay, 95 % (ms)", _late, _no_interval, 1.0, 10_000.0, log=True)


BIMODAL: Final = " *"
BIMODAL_NOTE: Final = (
    "`*`: not a rate. The loss is bimodal, a repeat loses few or nearly all "
    "([every repeat](middleware-link.md#images-over-zenoh-every-repeat))."
)


def tables(found: MiddlewareFindings, conditions: str) -> Iterator[str]:
    """Yield the lines that stand in docs/studies/middleware.md."""
    yield conditions
    yield ""
    yield "Two robots: samples lost, and the delay that 95 % of the others keep; - where the clocks do not tell it."
    yield BIMODAL_NOTE
    yield ""
    two = [one for one in found.cells if one.robots == 2]
    yield from _table(two, "distance_m", lambda metres: f"{metres:g} m", _loss_and_delay)
    yield ""
    yield "Best effort, samples lost (and `1 - (1 - p)^n` of the n packets of a sample of which a share p was lost):"
    yield ""
    fragmented = [one for one in two if one.expected_loss is not None and one.size_bytes >= 10_000]
    yield from _table(fragmented, "distance_m", lambda metres: f"{metres:g} m", _beside_expected)
    for metres in sorted({one.distance_m for one in found.cells if one.robots > 2}):
        yield ""
        yield f"Robots that publish to one at {metres:g} m, all streams together; delay of the first:"
        yield ""
        yield from _table(_beside(found, metres), "robots", lambda number: f"{number} robots", _loss_and_delay)


def _table(
    cells: Sequence[MiddlewareCell], across: str, head: Callable[[float], str], text: Callable[[MiddlewareCell], str]
) -> Iterator[str]:
    columns = sorted({getattr(one, across) for one in cells})
    yield "| " + " | ".join(["data", "kind", "middleware", *map(head, columns)]) + " |"
    yield "| " + " | ".join(["---"] * (3 + len(columns))) + " |"
    rows = {(one.size_bytes, one.kind, one.who) for one in cells}
    for size, kind, who in sorted(rows, key=lambda row: (row[0], row[1], list(STYLES).index(row[2]))):
        mine = {
            getattr(one, across): one for one in cells if (one.size_bytes, one.kind, one.who) == (size, kind, who)
        }
        said = [text(mine[column]) if column in mine else "" for column in columns]
        yield "| " + " | ".join([SIZES[size], kind, who, *said]) + " |"


def _loss_and_delay(cell: MiddlewareCell) -> str:
    lost, late = _lost(cell), _late(cell)
    if lost is None:
        return "not found"
    is_bimodal = (cell.who, cell.kind) == ("Zenoh", "reliable") and cell.size_bytes >= middleware_page.IMAGE_BYTES
    return f"{lost:.1f} %, " + ("-" if late is None else f"{late:.0f} ms") + BIMODAL * is_bimodal


def _beside_expected(cell: MiddlewareCell) -> str:
    lost, expected = _lost(cell), cell.expected_loss
    return "" if lost is None or expected is None else f"{lost:.0f} % ({100 * expected:.0f})"


def put(page: Path, lines: Sequence[str]) -> None:
    """Put tables into a page, between its two marks.

    Raises:
        ValueError: It has no such marks.
    """
    text = page.read_text(encoding="utf-8")
    before, after = text.index(BEGIN) + len(BEGIN), text.index(END)
    files.write(page, "\n".join((text[:before], "", *lines, "", text[after:])).encode())


def main() -> None:
    """Run or go on, print the tables or put them into the page, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("middleware"), help="folder of the lab and its trials")
    parser.add_argument("--figures", type=Path, help="write middleware-loss, -delay and -robots.svg there")
    parser.add_argument("--page", type=Path, help="put the tables into this page")
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--full", action="store_true", help="the campaigns that take hours")
    size.add_argument("--repeats", type=int, help="how often each place is measured, in campaigns of their own")
    parser.add_argument("--only", nargs="+", choices=CAMPAIGNS, default=CAMPAIGNS, help="run these; all are read")
    parser.add_argument("--no-run", action="store_true", help="read what is there")
    parser.add_argument("--from-page", type=Path, help="draw the figures from the tables of this page, run nothing")
    options = parser.parse_args()
    if options.from_page:
        draw(MiddlewareFindings(middleware_page.cells(options.from_page), "", 0.0, 0.0), options.figures)
        return
    prefix = "full-" if options.full else ""
    names = [f"{prefix}{called(one, options.repeats)}" for one in CAMPAIGNS]
    if not options.no_run:
        lab(options.out, options.repeats)
        run(options.out, [f"{prefix}{called(one, options.repeats)}" for one in options.only])
    found = read(options.out, names)
    conditions = (
        f"{time.strftime('%Y-%m-%d', time.gmtime(found.ended_s))}: {found.ended}; packets handed over late by up to "
        f"{1e3 * found.late_s:.1f} ms; load average {os.getloadavg()[2]:.1f} when this was written."
    )
    lines = list(tables(found, conditions))
    if options.page:
        put(options.page, lines)
    else:
        print("\n".join(lines))
    if options.figures:
        draw(found, options.figures)


def draw(found: MiddlewareFindings, folder: Path) -> None:
    """Write the figures of docs/studies/middleware.md into a folder."""
    for chart in (
        by_distance(found, "middleware-loss", LOST),
        by_distance(found, "middleware-delay", LATE),
        by_robots(found),
    ):
        files.write(folder / f"{chart.name}.svg", figures.paper(chart, "svg"))


if __name__ == "__main__":
    main()
