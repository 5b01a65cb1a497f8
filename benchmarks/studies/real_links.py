"""Predicted goodput of links that others measured: `python -m benchmarks.studies.real_links [--page PAGE]`.

The table docs/studies/real-links.csv has the columns of `fieldkit cosim goodput`, and the source of each link. The
links were selected by these rules before the first prediction, and no link was removed afterwards:

- The source is public and has, from one test: the goodput of iperf or iperf3 over at least 10 s, from the receiver if
  both ends report it; a signal below 0 dBm; and a PHY rate with MCS as `iw` prints it, with width, streams and guard
  interval (20 MHz if no width is printed).
- The rate is that of the data's direction: `rx bitrate` of the receiver, or `tx bitrate` of the sender. If both are
  known, the receiver's is used.
- Of repeated tests of an adapter the newest is used, once per direction, band, standard and width.
- `rate_logged` is the time or the end of the log. Byte counters in the source show whether it was before the data.
- `bus` is the bus of the adapter, which the prediction does not model.

Each link is predicted twice: with its logged mode, and with modes that minstrel_ht selects at its signal.
The program prints the errors of groups of links, and the predictions of each link. With `--page` it writes the errors
and the predictions of radios without a slow bus into a page.
"""

import argparse
import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from fieldkit.core import files
from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.studies.link_goodput import LoggedLink, predict_goodputs_bit_s

TABLE: Final = Path(__file__).resolve().parent.parent.parent / "docs/studies/real-links.csv"
BEGIN: Final = "<!-- written by benchmarks.studies.real_links: from here -->"
END: Final = "<!-- written by benchmarks.studies.real_links: to here -->"
_INTEGERS: Final = ("width_mhz", "streams", "guard_interval_ns", "mcs")
_SLOW_BUSES: Final = ("usb", "sdio")


@dataclass(frozen=True)
class MeasuredLink:
    """A link that was measured.

    Attributes:
        cells: Its row of the table.
        link: What its radio logged.
    """

    cells: Mapping[str, str]
    link: LoggedLink

    @property
    def goodput_bit_s(self) -> float:
        """Measured goodput."""
        return float(self.cells["goodput_bit_s"])

    @property
    def has_slow_bus(self) -> bool:
        """True if the adapter is on a bus that can be slower than its radio."""
        return self.cells["bus"] in _SLOW_BUSES

    @property
    def groups(self) -> tuple[str, str]:
        """Names of its groups: by bus and time of the logged rate, and by bus, standard and width."""
        bus = "USB, SDIO" if self.has_slow_bus else "PCIe, SoC"
        time = "before" if self.cells["rate_logged"].startswith("before") else "during or after"
        return f"{bus}; rate logged {time} the test", f"{bus}; {self.kind}"

    @property
    def kind(self) -> str:
        """Standard without the band, and width."""
        return f"{self.link.standard.split()[0]}, {self.link.width_mhz} MHz"


@dataclass(frozen=True)
class Prediction:
    """The predictions of a link.

    Attributes:
        measured: The link.
        logged_bit_s: Goodput with the logged mode; nan if it is not modelled.
        selected_bit_s: Goodput with selected modes; nan if they are not modelled.
    """

    measured: MeasuredLink
    logged_bit_s: float
    selected_bit_s: float


def read_links(path: Path) -> list[MeasuredLink]:
    """Return the links of the table."""
    with path.open(encoding="utf-8", newline="") as file:
        return [MeasuredLink(row, _link(row)) for row in csv.DictReader(file)]


def _link(row: Mapping[str, str]) -> LoggedLink:
    integers: dict[str, Any] = {name: int(row[name]) for name in _INTEGERS}
    return LoggedLink(float(row["signal_dbm"]), row["standard"], protocol=row["protocol"], **integers)


def predict(links: Sequence[MeasuredLink]) -> list[Prediction]:
    """Return the predictions of links."""
    logged = [measured.link for measured in links]
    selected = [replace(link, mcs=None) for link in logged]
    goodputs = predict_goodputs_bit_s([*logged, *selected], {})

    def value(link: LoggedLink) -> float:
        goodput_bit_s = goodputs[link]
        return math.nan if isinstance(goodput_bit_s, ConfigurationError) else goodput_bit_s

    return [Prediction(*each) for each in zip(links, map(value, logged), map(value, selected), strict=True)]


def errors(predictions: Sequence[Prediction], name: str) -> np.ndarray:
    """Return the relative errors of the predictions in an attribute, without links that are not modelled."""
    ratios = np.array([getattr(each, name) / each.measured.goodput_bit_s for each in predictions])
    finite: np.ndarray = ratios[np.isfinite(ratios)]
    return finite - 1


def _errors_cells(predictions: Sequence[Prediction]) -> Iterator[str]:
    """Yield the number of links; for logged, then selected modes median error, median magnitude, 90th percentile."""
    yield str(len(errors(predictions, "selected_bit_s")))
    for name in ("logged_bit_s", "selected_bit_s"):
        values = errors(predictions, name)
        magnitude, high = np.quantile(np.abs(values), (0.5, 0.9))
        yield f"{100 * np.median(values):+.0f}; {100 * magnitude:.0f}; {100 * high:.0f}"


def errors_table(predictions: Sequence[Prediction]) -> Iterator[str]:
    """Yield the lines of the table of errors by groups of links; links that are not modelled are left out."""
    yield "| bus; links | compared | logged mode: median error (%); magnitude: median; p90 | same, selected modes |"
    yield "|-|-|-|-|"
    for level in (0, 1):
        groups: dict[str, list[Prediction]] = {}
        for each in predictions:
            if math.isfinite(each.selected_bit_s):
                groups.setdefault(each.measured.groups[level], []).append(each)
        for name in sorted(groups):
            yield f"| {' | '.join((name, *_errors_cells(groups[name])))} |"


def summary(predictions: Sequence[Prediction]) -> str:
    """Return how many links, radios and places there are."""
    numbers = [len({each.measured.cells[name] for each in predictions}) for name in ("radio", "place")]
    return (
        f"{len(predictions)} links of {numbers[0]} radios at {numbers[1]} places, selected by rules in the program "
        "that precede the first prediction:"
    )


def links_table(predictions: Sequence[Prediction]) -> Iterator[str]:
    """Yield the lines of the table of links."""
    yield "| radio | PHY rate (Mbit/s) | measured (Mbit/s) | logged mode | selected modes |"
    yield "|-|-|-|-|-|"
    for each in predictions:
        measured, mode = each.measured, "-"
        values = ["not modelled"] * 2
        if math.isfinite(each.selected_bit_s):
            mode = _rate_text(measured.link)
            values = [
                _with_error(value, measured.goodput_bit_s) for value in (each.logged_bit_s, each.selected_bit_s)
            ]
        label = f"{measured.cells['radio']}, {measured.cells['direction']}, {measured.kind}"
        yield f"| {label} | {mode} | {measured.goodput_bit_s / 1e6:.0f} | {' | '.join(values)} |"


def _rate_text(link: LoggedLink) -> str:
    mode = link.mode()
    return "-" if mode is None else f"{mode.rate_bit_s / 1e6:.0f}"


def _with_error(predicted_bit_s: float, measured_bit_s: float) -> str:
    return f"{predicted_bit_s / 1e6:.0f} ({100 * (predicted_bit_s / measured_bit_s - 1):+.0f} %)"


def main() -> None:
    """Predict the links of the table, and print the errors or write them into a page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--links", type=int, metavar="N", help="only the first N links")
    parser.add_argument("--page", type=Path, help="page into which the tables are written")
    options = parser.parse_args()
    predictions = predict(read_links(TABLE)[: options.links])
    lines = [summary(predictions), "", *errors_table(predictions), ""]
    if options.page is None:
        print("\n".join((*lines, *links_table(predictions))))
        return
    lines += links_table([each for each in predictions if not each.measured.has_slow_bus])
    text = options.page.read_text(encoding="utf-8")
    before, after = text.index(BEGIN) + len(BEGIN), text.index(END)
    files.write(options.page, "\n".join((text[:before], "", *lines, "", text[after:])).encode())


if __name__ == "__main__":
    main()
