"""Samples of the radios' links during an attempt: what a robot's own sampler wrote, or its testbed (`Oracle.links`).

A robot's `ROLE-link.txt`, which most robots compress, has sections, each a line `==> SECONDS NAME <==` and what was
printed then: `link`, `survey` and `station` by iw, `wireless` by the kernel. The seconds are those since boot; when
that was, its state before tells. A testbed's `link.csv` has a line for each station that a radio knows at a moment.
"""

import gzip
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from itertools import groupby
from pathlib import Path
from typing import Final

from fieldkit.core import laptop_files
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import LinkSample, Role, StationSample
from fieldkit.measure.evidence import counted_csv, host, iw, reading

FILE: Final = laptop_files.LINK

_HEADER: Final = (
    "utc_ns,role,noise_dbm,active_ns,busy_ns,station,signal_dbm,tx_bit_s,rx_bit_s,"
    "tx_packets,rx_packets,tx_retries,tx_failures"
)
_DBM: Final = r"(-?[0-9]{1,4}\.[0-9]{2})?"
_COUNT: Final = r"([0-9]{1,18})?"
_STATION: Final = r"([A-Za-z0-9:._-]{1,40})?"
_ROW: Final = re.compile(
    rf"([0-9]{{1,19}}),({Role.PATTERN}),{_DBM},{_COUNT},{_COUNT},{_STATION},{_DBM}" + rf",{_COUNT}" * 6, re.ASCII
)
_SECTION: Final = re.compile(
    r"^==> ([0-9]{1,10})\.([0-9]{2}) (link|survey|station|wireless) <==\n", re.MULTILINE | re.ASCII
)
_TICK_NS: Final = 10_000_000


def file(role: Role) -> str:
    """Return the file that a robot's own sampler writes, without the ending of a compressed one."""
    return f"{role}-link.txt"


def text(samples: Mapping[Role, Sequence[LinkSample]]) -> str:
    """Return samples of a testbed as `read` reads them."""
    return counted_csv.text(_HEADER, (line for role in samples for line in _rows(role, samples)))


def _rows(role: Role, samples: Mapping[Role, Sequence[LinkSample]]) -> Iterator[str]:
    for sample in samples[role]:
        radio = (sample.utc_ns, role, _dbm(sample.noise_dbm), sample.active_ns, sample.busy_ns)
        for station in sample.stations or (StationSample(""),):
            rates = (None if rate is None else round(rate) for rate in (station.tx_rate_bit_s, station.rx_rate_bit_s))
            counts = (station.tx_packets, station.rx_packets, station.tx_retries, station.tx_failures)
            values = (*radio, station.station, _dbm(station.signal_dbm), *rates, *counts)
            yield ",".join("" if value is None else str(value) for value in values)


def _dbm(power: float | None) -> str | None:
    return None if power is None else f"{power:.2f}"


def read(path: Path) -> Mapping[Role, Sequence[LinkSample]]:
    """Return what a testbed noted, by robot, in the order of time.

    Raises:
        EvidenceError: The file is missing or not whole.
    """
    rows = map(_parsed, counted_csv.read(path, _HEADER, _ROW, "does not say how links were"))
    samples: dict[Role, list[LinkSample]] = {}
    for (role, _), same in groupby(rows, key=lambda row: (row[0], row[1].utc_ns)):
        samples.setdefault(role, []).append(_joined(one for _, one in same))
    return {role: sorted(one, key=lambda sample: sample.utc_ns) for role, one in samples.items()}


def _parsed(match: re.Match[str]) -> tuple[Role, LinkSample]:
    utc_ns, role, noise, active, busy, station, signal, *counts = match.groups()
    numbers = [None if count is None else int(count) for count in counts]
    known = StationSample(station, _power(signal), *numbers) if station else None
    radio = LinkSample(
        int(utc_ns),
        noise_dbm=_power(noise),
        active_ns=None if active is None else int(active),
        busy_ns=None if busy is None else int(busy),
        stations=(known,) if known else (),
    )
    return Role(role), radio


def _power(said: str | None) -> float | None:
    return None if said is None else float(said)


def read_own(folder: Path, role: Role) -> Sequence[LinkSample]:
    """Return what a robot's own sampler wrote, and before and after it the state of the host, in the order of time.

    Raises:
        EvidenceError: It left nothing, or does not say what its clock showed.
    """
    edges = [folder / name(role) for name in (host.before, host.after) if (folder / name(role)).is_file()]
    told = [(state.clock, host.stations(path)) for path in edges if (state := host.state(path)).clock]
    if not told or told[0][0] is None:
        raise EvidenceError("does not say what its clock showed", where=str(folder / host.before(role)))
    clock = told[0][0]
    ahead_ns = (clock.lowest_ns + clock.highest_ns) // 2
    own = [LinkSample(exchange.first_ns, iw.stations(said)) for exchange, said in told if exchange is not None]
    own += [replace(sample, utc_ns=sample.utc_ns + ahead_ns) for sample in parse(_written(folder / file(role)))]
    return tuple(sorted((sample for sample in own if _tells(sample)), key=lambda one: one.utc_ns))


def _written(path: Path) -> str:
    """Return the text of a robot's sampler, nothing where there is none."""
    if path.is_file():
        return reading.text(path)
    packed = path.with_name(f"{path.name}.gz")
    if not packed.is_file():
        return ""
    reading.size(packed)  # a file, and readable
    try:
        with gzip.open(packed, "rb") as file_:
            found = file_.read(reading.MOST_TEXT_BYTES)
    except (OSError, EOFError, zlib.error) as error:
        raise EvidenceError(f"cannot be read: {error}", where=str(packed)) from error
    return found.decode(errors="replace")


def parse(text: str) -> Sequence[LinkSample]:
    """Return what the text of a robot's sampler says; times are nanoseconds since boot.

    A line that was cut when the sampler was ended is left out.
    """
    parts = _SECTION.split(text[: text.rfind("\n") + 1])[1:]
    sections = [
        _section(int(seconds) * 10**9 + int(hundredths) * _TICK_NS, name, said)
        for seconds, hundredths, name, said in zip(*(parts[at::4] for at in range(4)), strict=True)
    ]
    return [_joined(same) for _, same in groupby(sections, key=lambda one: one.utc_ns)]


def _section(at_ns: int, name: str, said: str) -> LinkSample:
    match name:
        case "station":
            return LinkSample(at_ns, iw.stations(said))
        case "link":
            cell = iw.cell(said)
            return LinkSample(at_ns, (cell,) if cell else (), cell=cell.station if cell else None)
        case "survey":
            noise_dbm, active_ns, busy_ns = iw.channel(said)
            return LinkSample(at_ns, noise_dbm=noise_dbm, active_ns=active_ns, busy_ns=busy_ns)
        case _:
            signal_dbm, noise_dbm = iw.wireless(said)
            stations = () if signal_dbm is None else (StationSample("", signal_dbm),)
            return LinkSample(at_ns, stations, noise_dbm=noise_dbm)


def _joined(samples: Iterable[LinkSample]) -> LinkSample:
    """Return what was told at one moment as one; of a station told twice, what was told last with most."""
    return reduce(_both, samples)


def _both(one: LinkSample, other: LinkSample) -> LinkSample:
    stations = {station.station: station for station in (*one.stations, *other.stations)}
    return LinkSample(
        one.utc_ns,
        tuple(stations.values()),
        other.cell or one.cell,
        one.noise_dbm if other.noise_dbm is None else other.noise_dbm,
        one.active_ns if other.active_ns is None else other.active_ns,
        one.busy_ns if other.busy_ns is None else other.busy_ns,
    )


def _tells(one: LinkSample) -> bool:
    return one != LinkSample(one.utc_ns)
