"""Time that a mesh takes to heal: `python -m benchmarks.studies.mesh --out FOLDER [--figure FILE.svg]`, as root.

The program runs trials of four layouts and two hello intervals in sequence, unless FOLDER already has them, on
emulated robots without fading, with five repeats each. This takes 2 hours. Then it prints a table of the gap
(`rtt_gap_s`: the longest time without a reply to a ping) with the bound of 13.7 hello intervals, and draws a figure.
In each repeat a robot on the path is switched off, and the mesh must find another path. The bound is valid only if
the other path has at most as many hops; in `detour` and `ring` it has more, so healing may take longer
(docs/studies/mesh.md). The layout `row` has no other path, so its healing time starts when the robot is switched on
again.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import fieldkit
from fieldkit.core import files
from fieldkit.report import figures
from fieldkit.report.charts import Chart, Panel, Series
from fieldkit.report.theme import Style

HERE: Final = Path(__file__).parent
HELLOS_S: Final = (1, 4)
BOUND_HELLOS: Final = 13.7
"""babeld detects the first missing hello 1.7 intervals after the last received one, checks again once per interval,
and drops a neighbour 12 checks later."""

SITE: Final = """\
backend: emulated
robots:
  r1: {{profile: box}}
  r2: {{profile: box}}
  r3: {{profile: box}}
  r4: {{profile: box}}
  r5: {{profile: box}}
  r6: {{profile: box}}
  r7: {{profile: box}}
roles:
  masterless: {{{roles}}}
emulated:
  ros: builtin
  world: open
  radio: {{fading: false}}
  mesh: {{protocol: babel, hello: {hello_s}s}}
"""


@dataclass(frozen=True)
class Layout:
    """A layout of robots.

    Attributes:
        label: Its description.
        procedure: Name of the procedure, which is shipped or in `benchmarks/studies/mesh`.
        distance: Distance from sender to receiver.
        others: Further roles.
        away_s: Time for which the only path is interrupted; 0 if there is another path.
    """

    label: str
    procedure: str
    distance: str
    others: tuple[str, ...]
    away_s: float = 0.0


LAYOUTS: Final = {
    "ways": Layout("two paths of 4 hops", "mesh_heal", "220m", ("first", "middle", "left", "last")),
    "detour": Layout("3 hops, detour of 4", "mesh_detour", "130m", ("first", "last", "left", "middle", "right")),
    "ring": Layout("ring of six: 2 hops, detour of 4", "mesh_ring", "104m", ("first", "left", "middle", "right")),
    "row": Layout(
        "row of six, back after 60 s", "mesh_row", "300m", ("first", "middle", "left", "last"), away_s=60.0
    ),
}


def gaps_s(out: Path, name: str, hello_s: int, repeats: int) -> list[float]:
    """Return the gap of each valid repeat of a layout, minus `Layout.away_s`; run its trial if it does not exist."""
    layout, lab = LAYOUTS[name], out / f"{name}-{hello_s}s"
    if not (lab / "trials").exists():
        _make_lab(lab, layout, hello_s)
        trial = ("trial", layout.procedure, layout.distance, "--repeats", str(repeats))
        subprocess.run((sys.executable, "-m", "fieldkit", *trial), cwd=lab, check=True)
    rows = fieldkit.load(lab / "trials").repeats.to_pylist()
    return [row["rtt_gap_s"] - layout.away_s for row in rows if row["status"] == "valid"]


def _make_lab(lab: Path, layout: Layout, hello_s: int) -> None:
    (lab / "robots").mkdir(parents=True)
    shutil.copy(HERE / "mesh" / "box.yaml", lab / "robots")
    shutil.copytree(HERE / "mesh", lab / "procedures", ignore=shutil.ignore_patterns("box.yaml"))
    roles = ", ".join(f"{role}: r{number}" for number, role in enumerate(("sender", "receiver", *layout.others), 1))
    (lab / "fieldkit.yaml").write_text(SITE.format(roles=roles, hello_s=hello_s), encoding="utf-8")


def table(gaps_by_layout: Mapping[tuple[str, int], list[float]]) -> str:
    """Return a Markdown table, a line per layout and hello interval."""
    lines = [
        "| layout | hello interval | repeats | shortest gap | median gap | longest gap | bound |",
        "| --- " * 7 + "|",
    ]
    for (name, hello_s), gaps in gaps_by_layout.items():
        seconds = (
            f"{gap_s:.1f} s" for gap_s in (min(gaps), statistics.median(gaps), max(gaps), BOUND_HELLOS * hello_s)
        )
        lines.append(f"| {LAYOUTS[name].label} | {hello_s} s | {len(gaps)} | {' | '.join(seconds)} |")
    return "\n".join(lines)


def chart(gaps_by_layout: Mapping[tuple[str, int], list[float]]) -> Chart:
    """Return a chart with a panel per hello interval: each repeat, and the bound."""
    panels = []
    for hello_s in HELLOS_S:
        points = [(place, gap_s) for place, name in enumerate(LAYOUTS, 1) for gap_s in gaps_by_layout[name, hello_s]]
        places, gaps = ([point[axis] for point in points] for axis in (0, 1))
        bound_s = BOUND_HELLOS * hello_s
        series = [
            Series("a repeat", Style("blue", "o", "none"), places, gaps, join="none"),
            Series("bound", Style("red", "", "dashed"), [0.5, len(LAYOUTS) + 0.5], [bound_s, bound_s]),
        ]
        ticks = [(float(place), name) for place, name in enumerate(LAYOUTS, 1)]
        right = len(LAYOUTS) + 0.5
        panels.append(
            Panel(f"hello {hello_s} s", "layout", "gap (s)", series, "", x_ticks=ticks, right=right, left=0.5)
        )
    return Chart(name="mesh-heal", title="mesh-heal", caption="", panels=panels)


def main() -> None:
    """Run missing trials, print the table, draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the labs and their trials")
    parser.add_argument("--figure", type=Path, help="SVG file to draw")
    parser.add_argument("--repeats", type=int, default=5, help="repeats of each trial (default: 5)")
    options = parser.parse_args()
    load_before = os.getloadavg()[0]
    gaps_by_layout = {
        (name, hello_s): gaps_s(options.out, name, hello_s, options.repeats)
        for name in LAYOUTS
        for hello_s in HELLOS_S
    }
    print(table(gaps_by_layout))
    print(f"load {load_before:.1f} before, {os.getloadavg()[0]:.1f} after")
    if options.figure:
        files.write(options.figure, figures.paper(chart(gaps_by_layout), "svg"))


if __name__ == "__main__":
    main()
