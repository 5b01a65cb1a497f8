"""Samples of a radio link that a robot takes during an attempt, and the parsers of the programs' output.

During an attempt, a script on each robot, the sampler, reads the state of the link several times per second. Its file
`ROLE-link.txt`, which is usually compressed, has sections. Each section has a line `==> SECONDS NAME <==` and the
output at this time: `link`, `survey` and `station` of iw, or `wireless` of /proc/net/wireless. The seconds are
counted from boot; the time of boot is computed from the host state before the attempt or, without it, after it.

The format of iw's lines is defined in its source files station.c, link.c and survey.c. Versions 3 to 6 differ only in
added lines.
Drivers omit values that they do not support. A received power of 0 dBm or more is invalid: some drivers print 0 or a
percentage.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Final, TypeVar

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import LinkSample, Role, StationSample
from fieldkit.measure.evidence import host, link_samples, reading

T = TypeVar("T")

_IW_STATION: Final = re.compile(r"^Station (\S{1,40}) \(on ", re.MULTILINE)
_CONNECTED: Final = re.compile(r"^Connected to (\S{1,40}) \(on ", re.MULTILINE)
_SURVEY: Final = re.compile(r"^Survey data from ", re.MULTILINE)
# Uses [ \t] instead of `\s`, which would also match line feeds.
_LINE: Final = re.compile(r"^[ \t]*([A-Za-z ]{1,30}):[ \t]*(\S[^\n]{0,200})$", re.MULTILINE)
_IW_COUNT: Final = re.compile(r"([0-9]{1,18})\b", re.ASCII)
_POWER: Final = re.compile(r"(-[0-9]{1,3})(?:\.[0-9]{1,2})?\b(?: \[[^\]\n]{0,60}\])? ?dBm", re.ASCII)
_RATE: Final = re.compile(r"([0-9]{1,6}(?:\.[0-9]{1,2})?) MBit/s", re.ASCII)
_LINK_PACKETS: Final = re.compile(r"[0-9]{1,18} bytes \(([0-9]{1,18}) packets\)", re.ASCII)
_WIRELESS_LINE: Final = re.compile(r"[0-9a-f]{4} +-?[0-9]{1,4}\.? +(-[0-9]{1,3})\.? +(-?[0-9]{1,4})\.? ", re.ASCII)
_UNKNOWN_NOISE: Final = -256.0  # /proc/net/wireless prints it if the driver does not report the noise
_NS_PER_MS: Final = 1_000_000
_SECTION: Final = re.compile(
    r"^==> ([0-9]{1,10})\.([0-9]{2}) (link|survey|station|wireless) <==\n", re.MULTILINE | re.ASCII
)
_TICK_NS: Final = 10_000_000  # resolution of the seconds since boot


def parse_stations(text: str) -> tuple[StationSample, ...]:
    """Return the stations in the output of `iw dev INTERFACE station dump` or `station get`."""
    parts = _IW_STATION.split(text)
    return tuple(_station(name, _lines(section)) for name, section in zip(parts[1::2], parts[2::2], strict=True))


def _station(name: str, lines: Mapping[str, str]) -> StationSample:
    return StationSample(
        station=name.lower(),
        signal_dbm=_parse_value(_POWER, lines, "signal", float),
        tx_rate_bit_s=_rate_bit_s(lines, "tx bitrate"),
        rx_rate_bit_s=_rate_bit_s(lines, "rx bitrate"),
        tx_packets=_parse_value(_IW_COUNT, lines, "tx packets", int),
        rx_packets=_parse_value(_IW_COUNT, lines, "rx packets", int),
        tx_retries=_parse_value(_IW_COUNT, lines, "tx retries", int),
        tx_failures=_parse_value(_IW_COUNT, lines, "tx failed", int),
        beacon_losses=_parse_value(_IW_COUNT, lines, "beacon loss", int),
    )


def parse_cell(text: str) -> StationSample | None:
    """Return the associated access point in the output of `iw dev INTERFACE link`; None if not associated."""
    if (connected := _CONNECTED.search(text)) is None:
        return None
    lines = _lines(text[connected.end() :])
    return StationSample(
        station=connected[1].lower(),
        signal_dbm=_parse_value(_POWER, lines, "signal", float),
        tx_rate_bit_s=_rate_bit_s(lines, "tx bitrate"),
        rx_rate_bit_s=_rate_bit_s(lines, "rx bitrate"),
        tx_packets=_parse_value(_LINK_PACKETS, lines, "TX", int),
        rx_packets=_parse_value(_LINK_PACKETS, lines, "RX", int),
    )


def parse_channel(text: str) -> tuple[float | None, int | None, int | None]:
    """Return noise in dBm, active time in ns and busy time in ns of the channel in use; None for missing values.

    Both times are None if one of them is missing.

    Args:
        text: Output of `iw dev INTERFACE survey dump`.
    """
    for section in _SURVEY.split(text)[1:]:
        lines = _lines(section)
        if "[in use]" in lines.get("frequency", ""):
            active_ms = _parse_value(_IW_COUNT, lines, "channel active time", int)
            busy_ms = _parse_value(_IW_COUNT, lines, "channel busy time", int)
            noise_dbm = _parse_value(_POWER, lines, "noise", float)
            if active_ms is None or busy_ms is None:
                return noise_dbm, None, None
            return noise_dbm, active_ms * _NS_PER_MS, busy_ms * _NS_PER_MS
    return None, None, None


def parse_wireless(line: str) -> tuple[float | None, float | None]:
    """Return signal and noise in dBm from a line of /proc/net/wireless without the interface's name.

    The noise is None if the driver does not report it; both values are None if the line has no negative signal.
    """
    match = _WIRELESS_LINE.match(line)
    if match is None:
        return None, None
    signal_dbm, noise_dbm = float(match[1]), float(match[2])
    return signal_dbm, noise_dbm if _UNKNOWN_NOISE < noise_dbm < 0 else None


def _lines(text: str) -> dict[str, str]:
    """Return the first value of each name in lines `NAME: VALUE`; later values belong to single antennas."""
    lines: dict[str, str] = {}
    for name, value in _LINE.findall(text):
        lines.setdefault(name, value)
    return lines


def _parse_value(pattern: re.Pattern[str], lines: Mapping[str, str], name: str, kind: Callable[[str], T]) -> T | None:
    match = pattern.match(lines.get(name, ""))
    return None if match is None else kind(match[1])


def _rate_bit_s(lines: Mapping[str, str], name: str) -> float | None:
    rate = _parse_value(_RATE, lines, name, float)
    return rate * 1e6 if rate else None


def read(folder: Path, role: Role) -> Sequence[LinkSample]:
    """Return the samples of an attempt, in the order of time.

    They are from the robot's sampler, and from the files with its state before and after the attempt.

    Raises:
        EvidenceError: The files are missing, or do not contain the robot's clock.
    """
    paths = [folder / name(role) for name in (host.before_file, host.after_file) if (folder / name(role)).is_file()]
    dumps = [(state.clock, host.station_dump(path)) for path in paths if (state := host.read_state(path)).clock]
    if not dumps or dumps[0][0] is None:
        raise EvidenceError("does not contain the clock", where=str(folder / host.before_file(role)))
    clock = dumps[0][0]
    boot_ns = (clock.lowest_ns + clock.highest_ns) // 2
    samples = [LinkSample(bounds.first_ns, parse_stations(dump)) for bounds, dump in dumps if bounds is not None]
    samples += [
        replace(sample, utc_ns=sample.utc_ns + boot_ns)
        for sample in parse(_sampler_text(folder / link_samples.robot_file(role)))
    ]
    return tuple(sorted((sample for sample in samples if _has_values(sample)), key=lambda sample: sample.utc_ns))


def _sampler_text(path: Path) -> str:
    """Return the text that a robot's sampler wrote; empty if there is no file."""
    if path.is_file():
        return reading.text(path)
    compressed = path.with_name(f"{path.name}.gz")
    if not compressed.is_file():
        return ""
    return reading.compressed(compressed).decode(errors="replace")


def parse(text: str) -> Sequence[LinkSample]:
    """Return the samples in the text of a robot's sampler. Their times are in nanoseconds since boot.

    An incomplete last line, written when the sampler was stopped, is omitted.
    """
    parts = _SECTION.split(text[: text.rfind("\n") + 1])[1:]
    sections = [
        _parse_section(int(seconds) * 10**9 + int(hundredths) * _TICK_NS, name, body)
        for seconds, hundredths, name, body in zip(*(parts[offset::4] for offset in range(4)), strict=True)
    ]
    return [link_samples.merge(group) for _, group in groupby(sections, key=lambda sample: sample.utc_ns)]


def _parse_section(at_ns: int, name: str, body: str) -> LinkSample:
    match name:
        case "station":
            return LinkSample(at_ns, parse_stations(body))
        case "link":
            cell = parse_cell(body)
            return LinkSample(at_ns, (cell,) if cell else (), cell=cell.station if cell else None)
        case "survey":
            noise_dbm, active_ns, busy_ns = parse_channel(body)
            return LinkSample(at_ns, noise_dbm=noise_dbm, active_ns=active_ns, busy_ns=busy_ns)
        case _:
            signal_dbm, noise_dbm = parse_wireless(body)
            stations = () if signal_dbm is None else (StationSample("", signal_dbm),)
            return LinkSample(at_ns, stations, noise_dbm=noise_dbm)


def _has_values(sample: LinkSample) -> bool:
    return sample != LinkSample(sample.utc_ns)
