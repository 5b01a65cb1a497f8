"""Samples of the radios' links during an attempt: names of their files, and the file that a testbed writes.

The samples come from the sampler, which is a script on the robot (`robot_link_samples`), or from a testbed that
models the radios (`Oracle.links`). A testbed's `link.csv` has a line per time, robot and peer station, and one line
for a robot without peers. If the testbed has access points, the last column, `cell`, is the access point with which
the robot is associated; empty if it is not associated.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from itertools import groupby
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.model import LinkSample, Role, StationSample
from fieldkit.measure.evidence import reading

FILE: Final = laptop_files.LINK

_HEADER: Final = (
    "utc_ns,role,noise_dbm,active_ns,busy_ns,station,signal_dbm,tx_bit_s,rx_bit_s,"
    "tx_packets,rx_packets,tx_retries,tx_failures"
)
_CELL_HEADER: Final = f"{_HEADER},cell"
_DBM: Final = r"(-?[0-9]{1,4}\.[0-9]{2})?"
_COUNT: Final = r"([0-9]{1,18})?"
_STATION: Final = r"([A-Za-z0-9:._-]{1,40})?"
_ROW: Final = re.compile(
    rf"([0-9]{{1,19}}),({Role.PATTERN}),{_DBM},{_COUNT},{_COUNT},{_STATION},{_DBM}" + rf",{_COUNT}" * 6, re.ASCII
)
_CELL_ROW: Final = re.compile(f"{_ROW.pattern},{_STATION}", re.ASCII)


def robot_file(role: Role) -> str:
    """Return the name of the file that a robot's sampler writes, without the suffix `.gz` of a compressed file."""
    return f"{role}-link.txt"


def text(samples: Mapping[Role, Sequence[LinkSample]]) -> str:
    """Return the file text for samples of a testbed."""
    has_cells = any(sample.cell for role_samples in samples.values() for sample in role_samples)
    lines = (
        line for role, role_samples in samples.items() for line in _rows(role, role_samples, has_cells=has_cells)
    )
    return reading.counted_csv_text(_CELL_HEADER if has_cells else _HEADER, lines)


def _rows(role: Role, samples: Sequence[LinkSample], *, has_cells: bool) -> Iterator[str]:
    for sample in samples:
        radio = (sample.utc_ns, role, _dbm(sample.noise_dbm), sample.active_ns, sample.busy_ns)
        for station in sample.stations or (StationSample(""),):
            rates = (None if rate is None else round(rate) for rate in (station.tx_rate_bit_s, station.rx_rate_bit_s))
            counts = (station.tx_packets, station.rx_packets, station.tx_retries, station.tx_failures)
            cell = (sample.cell,) if has_cells else ()
            values = (*radio, station.station, _dbm(station.signal_dbm), *rates, *counts, *cell)
            yield ",".join("" if value is None else str(value) for value in values)


def _dbm(power: float | None) -> str | None:
    return None if power is None else f"{power:.2f}"


def read(path: Path) -> Mapping[Role, Sequence[LinkSample]]:
    """Return the samples in a testbed's file by role, in the order of time.

    Raises:
        EvidenceError: The file is missing, truncated, or not a file of link samples.
    """
    has_cells = f"{_CELL_HEADER}\n" in reading.text(path)
    header, pattern = (_CELL_HEADER, _CELL_ROW) if has_cells else (_HEADER, _ROW)
    rows = map(_parse_row, reading.read_counted_csv(path, header, pattern, "is not a file of link samples"))
    samples: dict[Role, list[LinkSample]] = {}
    for (role, _), group in groupby(rows, key=lambda row: (row[0], row[1].utc_ns)):
        samples.setdefault(role, []).append(merge(sample for _, sample in group))
    return {role: sorted(role_samples, key=lambda sample: sample.utc_ns) for role, role_samples in samples.items()}


def _parse_row(match: re.Match[str]) -> tuple[Role, LinkSample]:
    utc_ns, role, noise, active, busy, station, signal, *numbers_and_cell = match.groups()
    # The numbers are rates and counts, in the order of the attributes of `StationSample`.
    numbers = [None if number is None else int(number) for number in numbers_and_cell[:6]]
    peer = StationSample(station, _parse_dbm(signal), *numbers) if station else None
    radio = LinkSample(
        int(utc_ns),
        cell=numbers_and_cell[6] if len(numbers_and_cell) > 6 else None,
        noise_dbm=_parse_dbm(noise),
        active_ns=None if active is None else int(active),
        busy_ns=None if busy is None else int(busy),
        stations=(peer,) if peer else (),
    )
    return Role(role), radio


def _parse_dbm(text: str | None) -> float | None:
    return None if text is None else float(text)


def merge(samples: Iterable[LinkSample]) -> LinkSample:
    """Merge samples of the same time into one; later values replace earlier ones."""
    return reduce(_merge_two, samples)


def _merge_two(first: LinkSample, second: LinkSample) -> LinkSample:
    stations = {station.station: station for station in (*first.stations, *second.stations)}
    return LinkSample(
        first.utc_ns,
        tuple(stations.values()),
        second.cell or first.cell,
        first.noise_dbm if second.noise_dbm is None else second.noise_dbm,
        first.active_ns if second.active_ns is None else second.active_ns,
        first.busy_ns if second.busy_ns is None else second.busy_ns,
    )
