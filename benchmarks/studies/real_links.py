"""Predicted goodput of links that others measured: `python -m benchmarks.studies.real_links [--links N]`.

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

Each link is predicted twice: with its logged mode, and with modes that minstrel_ht selects at its signal and width.
"""

import argparse
import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from fieldkit.core.errors import ConfigurationError
from sim_backends.cosim.studies.link_goodput import LoggedLink, predict_goodputs_bit_s

TABLE: Final = Path(__file__).resolve().parent.parent.parent / "docs/studies/real-links.csv"
_INTEGERS: Final = ("width_mhz", "streams", "guard_interval_ns", "mcs")
_TOO_SLOW_BUSES: Final = ("usb", "sdio")


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
    def group(self) -> str:
        """Bus of the adapter, and time of the logged rate."""
        bus = "USB, SDIO" if self.cells["bus"] in _TOO_SLOW_BUSES else "PCIe, SoC"
        return f"{bus}; rate logged {'before' if self.cells['rate_logged'].startswith('before') else 'with'} the data"

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


def _cells(predictions: Sequence[Prediction]) -> Iterator[str]:
    """Yield the number of links; for logged, then selected modes median error, median magnitude, 90th percentile."""
    yield str(len(predictions))
    for name in ("logged_bit_s", "selected_bit_s"):
        values = errors(predictions, name)
        if not len(values):
            yield from ("-",) * 3
            continue
        magnitudes = np.abs(values)
        yield f"{100 * np.median(values):+.0f}"
        yield f"{100 * np.median(magnitudes):.0f}"
        yield f"{100 * np.quantile(magnitudes, 0.9):.0f}"


def _print_summary(predictions: Sequence[Prediction]) -> None:
    print("Errors in %: median, median of the magnitudes, 90th percentile of the magnitudes\n")
    print("| links | number | logged mode: median | magnitude | p90 | selected modes: median | magnitude | p90 |")
    print("|-|-|-|-|-|-|-|-|")
    groups: dict[str, list[Prediction]] = {}
    for each in predictions:
        groups.setdefault(each.measured.group, []).append(each)
    for each in predictions:
        groups.setdefault(f"{each.measured.group.split(';')[0]}; {each.measured.kind}", []).append(each)
    for name, group in groups.items():
        print("|", " | ".join((name, *_cells(group))), "|")


def _print_links(predictions: Sequence[Prediction]) -> None:
    print("\n| link | measured (Mbit/s) | logged mode | selected modes | error (%) | error, selected |")
    print("|-|-|-|-|-|-|")
    for each in predictions:
        measured = each.measured
        label = f"{measured.cells['radio']}, {measured.kind}, {measured.cells['direction']}, {measured.cells['bus']}"
        values = (measured.goodput_bit_s, each.logged_bit_s, each.selected_bit_s)
        relative = [100 * (value / measured.goodput_bit_s - 1) for value in values[1:]]
        print("|", label, "|", " | ".join(f"{value / 1e6:.0f}" for value in values), end=" | ")
        print(" | ".join(f"{value:+.0f}" for value in relative), "|")


def main() -> None:
    """Predict the links of the table, and print the errors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--links", type=int, metavar="N", help="only the first N links")
    predictions = predict(read_links(TABLE)[: parser.parse_args().links])
    _print_summary(predictions)
    _print_links(predictions)


if __name__ == "__main__":
    main()
