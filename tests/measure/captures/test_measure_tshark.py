"""Captures of all link types compared with output of tshark (version and command: tests/data/README.md)."""

from ipaddress import ip_address
from pathlib import Path

from fieldkit.measure.captures import pcap
from tests.helpers.dissected import rows
from tests.helpers.paths import DATA

TSHARK = DATA / "tshark" / "4.0.17"


def _number(text: str, *, missing: int = 0) -> int:
    return int(text, 0) if text else missing


def _address(text: str) -> int:
    address = ip_address(text)
    return int(address) | (0xFFFF << 32 if address.version == 4 else 0)


def _read_tshark_output(path: Path) -> list[tuple[int, ...]]:
    """Return rows: time, length, addresses, IP id, offset, ports, TCP numbers, flags, MSS, payload, UDP length."""
    printed_rows: list[tuple[int, ...]] = []
    for line in path.read_text().splitlines():
        cells = line.split(",")
        seconds, fraction = cells[0].split(".")
        ipv4_or_ipv6 = {name: cells[index] or cells[index + 1] for name, index in (("id", 6), ("offset", 8))}
        ports = [
            next((cells[index] for index in (first, first + 2, first + 4) if cells[index]), "") for first in (11, 12)
        ]
        printed_rows.append((
            int(seconds + fraction),
            int(cells[1]),
            _address(cells[2] or cells[4]),
            _address(cells[3] or cells[5]),
            _number(ipv4_or_ipv6["id"]),
            _number(ipv4_or_ipv6["offset"]) * 8,
            *(_number(port, missing=-1) for port in ports),
            *map(_number, cells[17:23]),
        ))  # fmt: skip
    return printed_rows


def test_columns_equal_the_output_of_tshark() -> None:
    capture = pcap.read(TSHARK / "mixed.pcapng")
    # The output of tshark has no protocol after extension headers, more_fragments, header and payload lengths,
    # TCP time stamps, and echo identifiers.
    columns = [(*row[:4], *row[5:7], *row[10:15], *row[16:19]) for row in rows(capture.packets)]
    assert columns == _read_tshark_output(TSHARK / "mixed.csv")
    assert (capture.frames, capture.frames - len(capture.packets), capture.damage) == (357, 0, None)
